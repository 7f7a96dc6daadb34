"""The answer of an earlier fit, from which the fit of more frames of the same pixels starts.

It is of the stage itself, kept when frames are appended and forgotten once it has been used: no other stage
writes or reads it, so it lies among the private files of the run. It is no part of the fingerprint, since the
maximum does not depend on where the climb to it starts.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.run.fingerprint import setting_values
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.files import write_atomic
from pchem_pipeline.store.remote_path import RemotePath

if TYPE_CHECKING:
    from pchem_pipeline.run.stage import StageContext

_FILE = "fit_start.npy"


def _place(store: Path) -> Path:
    return store / ".pchem" / _FILE


def keep_fit(context: StageContext) -> None:
    """Keep the pixels that were fitted well, unless the fit was another one.

    The file holds (H, g, mu, sigma, likelihood gap), float64, (y, x, 5); NaN for pixels without a start.
    """
    store = context.store
    record = store.records.read("fit")
    if record is None or not record.finished or not _same_fit(record.content, context):
        drop_fit(store.path)
        return
    names = (*PARAMETERS, "likelihood_gap")
    start = np.stack([store.read(f"fit/{name}") for name in names], axis=-1)
    start[store.read("fit/fit_status") != 0] = np.nan
    buffer = io.BytesIO()
    np.save(buffer, start)
    write_atomic(_place(store.path), buffer.getvalue())


def _same_fit(content: dict[str, Any], context: StageContext) -> bool:
    """Tell whether a fit was made with the present settings and model."""
    if content["settings"] != setting_values(STAGES["fit"], context):
        return False
    return bool(content["input"]["model"] == context.model.digest)


def kept_fit(store: Path, region: tuple[slice, slice]) -> NDArray[np.float64] | None:
    """Return what `keep_fit` kept of a tile, or None."""
    place = _place(store)
    if not place.exists():
        return None
    if isinstance(place, RemotePath):
        whole = np.load(io.BytesIO(place.read_bytes()), allow_pickle=False)
    else:
        whole = np.load(place, mmap_mode="r", allow_pickle=False)
    return np.array(whole[region])


def drop_fit(store: Path) -> None:
    """Forget it, once a fit has started from it."""
    _place(store).unlink(missing_ok=True)
