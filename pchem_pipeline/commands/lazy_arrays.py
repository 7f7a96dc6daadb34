"""Groups of a store as xarray datasets that read when they are used.

xarray's own way reads a chunk that is missing as NaN or 0, and raises the errors of zarr.
"""

from __future__ import annotations

from typing import Any

import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core.indexing import IndexingSupport, LazilyIndexedArray, explicit_indexing_adapter

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.base.variables import variable_at
from pchem_pipeline.store.run_store import RunStore


class StoredArray(BackendArray):
    """An array of a store, as xarray indexes it; a copy by pickle refers to the same store."""

    def __init__(self, store: RunStore, name: str) -> None:
        array = store.array(name)
        self.store, self.name, self.shape, self.dtype = store, name, array.shape, array.dtype

    def __getitem__(self, key: Any) -> Any:
        return explicit_indexing_adapter(key, self.shape, IndexingSupport.BASIC, self._read)

    def _read(self, region: Any) -> NDArray[Any]:
        return self.store.read(self.name, region)


def lazy_dataset(store: RunStore, group: str) -> xr.Dataset:
    """Return a group of a store as a dataset; damage is one line where it is read.

    Raises:
        StoreError: the arrays do not belong together.
    """
    found = {}
    try:
        for name in store.arrays(group):
            path = f"{group}/{name}"
            lazy = LazilyIndexedArray(StoredArray(store, path))
            found[name] = xr.Variable(variable_at(path).dims, lazy, dict(store.array(path).attrs))
        return xr.Dataset(found, attrs=store.attributes(group))
    except ValueError as error:  # shapes of other arrays
        raise StoreError(f"{store.path / group} is damaged ({error}); {store.cure(group)}") from error
