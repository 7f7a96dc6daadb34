"""The result of ``pchem methods`` in the folder of a run."""

from __future__ import annotations

from typing import Any

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.store.files import read_json
from pchem_pipeline.store.run_store import RunStore

#: File of the result in the folder of a run.
METHODS_FILE = "methods.json"


def read_methods(store: RunStore) -> dict[str, Any] | None:
    """Return the content of ``methods.json`` of a run, or None where there is none.

    Raises:
        StoreError: it cannot be read.
    """
    result = read_json(store.path / METHODS_FILE)
    if result is not None and not (isinstance(result, dict) and "study" in result):
        raise StoreError(f"{store.path / METHODS_FILE} is damaged; run pchem methods with --force")
    return result
