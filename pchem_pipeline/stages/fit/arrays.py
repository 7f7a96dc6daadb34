"""The arrays of the group ``fit``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import FREE_SATELLITES, INTERVALS, interval_names, variables_of
from pchem_pipeline.model.fit.status import MEANINGS, FitStatus
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.store.run_store import RunStore


def leave_out_excluded(
    arrays: Mapping[str, NDArray[Any]], status: str, stores: Iterable[RunStore], region: tuple[slice, slice]
) -> None:
    """Take the values of excluded pixels from the arrays of a tile, and give them their word.

    Args:
        arrays: by name, (y, x, ...); of the group ``samples`` (sample, y, x).
        status: name of the word.
        stores: of the runs whose frames were fitted.
        region: of the tile.
    """
    for store in stores:
        if not store.has("frames/excluded"):
            continue
        excluded = store.read("frames/excluded", region) != 0
        for name, values in arrays.items():
            if values.dtype.kind == "f":
                values[(slice(None), excluded) if first_is_sample(name) else excluded] = np.nan
        arrays[status][excluded] = int(FitStatus.EXCLUDED)


def first_is_sample(name: str) -> bool:
    """Tell whether the first dimension of an array is the sample."""
    return name.startswith("samples/") and name != "samples/covariance"


def create_fit_maps(context: StageContext) -> None:
    """Make the maps that the fit will have; the words of its status are explained with them."""
    left_out = {"fit_status", *(() if context.model.effects else FREE_SATELLITES)}
    if context.config.fit.intervals == "normal":
        left_out |= {path for name in INTERVALS for path in interval_names(name)}
    context.create_maps([v.path for v in variables_of("fit") if v.name not in left_out])
    context.create_maps(
        ["fit/fit_status"],
        flag_masks=[int(bit) for bit in MEANINGS],
        flag_meanings=" ".join(str(bit.name).lower() for bit in MEANINGS),
        flag_sentences={str(bit.name).lower(): sentence for bit, sentence in MEANINGS.items()},
    )
