"""Exposure that effects add to single pixels, as the search for a discrepancy left it in the store.

It belongs to the effects that it was found with: under a model without them, or with other parameters, it
counts for nothing, and the effects leave H the mean exposure.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.stages.identities import known_added_exposure

if TYPE_CHECKING:
    from pchem_pipeline.store.run_store import RunStore

__all__ = ["fitted_added_exposure", "read_added_exposure", "write_added_exposure"]

_EXPOSURE, _WEIGHT = "discrepancy/added_exposure", "discrepancy/added_weight"
Region = tuple[slice, slice]


def write_added_exposure(
    store: RunStore,
    added: AddedExposure | None,
    effects: Sequence[Effect],
    rows: tuple[int, int],
    columns: tuple[int, int],
) -> None:
    """Keep what the effects add in a window of the sensor, or that they add nothing.

    Args:
        store: the run.
        added: (j, y, x) of the window; None: nothing.
        effects: of the model.
        rows: of the window, first and end.
        columns: likewise.
    """
    for name in (_EXPOSURE, _WEIGHT):
        store.delete(name)
    if added is None:
        return
    arrays = [np.ascontiguousarray(values, np.float64) for values in added]
    digest = hashlib.sha256(b"".join(values.tobytes() for values in arrays)).hexdigest()
    attributes: dict[str, Any] = {
        "rows": list(rows),
        "columns": list(columns),
        "effects": [e.model_dump(mode="json") for e in effects if _adds(e)],
        "digest": digest,
    }
    store.write_array(_WEIGHT, arrays[1])
    store.write_array(_EXPOSURE, arrays[0], attributes)


def _adds(effect: Effect) -> bool:
    return type(effect).added_exposure is not Effect.added_exposure


def read_added_exposure(
    store: RunStore, effects: Sequence[Effect], shape: tuple[int, int], region: Region | None = None
) -> AddedExposure | None:
    """Return what the effects of a model add to the pixels of a region, or None where that is nothing.

    Args:
        store: the run.
        effects: of the model.
        shape: rows and columns of the sensor.
        region: of the sensor; None: all of it.
    """
    if known_added_exposure(store, [e.model_dump(mode="json") for e in effects]) is None:
        return None
    attributes = store.attributes(_EXPOSURE)
    window = [slice(*attributes[name]) for name in ("rows", "columns")]
    wanted = [
        slice(*part.indices(n)[:2])
        for part, n in zip(region or (slice(None), slice(None)), shape, strict=True)
    ]
    common = [slice(max(w.start, p.start), min(w.stop, p.stop)) for w, p in zip(window, wanted, strict=True)]
    if any(c.start >= c.stop for c in common):
        return None
    inside = tuple(slice(c.start - w.start, c.stop - w.start) for c, w in zip(common, window, strict=True))
    place = tuple(slice(c.start - p.start, c.stop - p.start) for c, p in zip(common, wanted, strict=True))
    found: list[NDArray[np.float64]] = []
    for name in (_EXPOSURE, _WEIGHT):
        part = store.read(name, (slice(None), *inside))
        whole = np.zeros((part.shape[0], *(p.stop - p.start for p in wanted)))
        if name == _WEIGHT:
            whole[0] = 1.0
        whole[(slice(None), *place)] = part
        found.append(whole)
    return AddedExposure(found[0], found[1])


def fitted_added_exposure(
    store: RunStore, effects: Sequence[Effect], region: Region | None = None
) -> AddedExposure | None:
    """Return what the stored fit was made with; None also where it was made before the arrays were.

    Args:
        store: the run.
        effects: of the model of the fit.
        region: of the sensor; None: all of it.
    """
    record = store.records.read("fit")
    taken = None if record is None else (record.content.get("input") or {}).get("added_exposure")
    if taken is None or taken != store.attributes(_EXPOSURE).get("digest"):
        return None
    ny, nx = store.array("histogram/origin").shape
    return read_added_exposure(store, effects, (ny, nx), region)
