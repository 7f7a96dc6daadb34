"""The arrays of the groups ``fit`` and ``samples``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import FREE_SATELLITES, INTERVALS, VARIABLES, interval_names, variables_of
from pchem_pipeline.model.fit.status import MEANINGS, FitStatus
from pchem_pipeline.run.stage import StageContext

if TYPE_CHECKING:
    from pchem_pipeline.store.run_store import RunStore
    from pchem_pipeline.store.tiles import Tile

_OF_SAMPLES = ("quanta_exposure", "quanta_exposure_stderr", "mean", "variance", "covariance")


class TileArrays:
    """The arrays of the groups ``fit`` and ``samples`` of a tile, filled piece by piece.

    Attributes:
        values: by group and name; pixels of the tile along the dimensions y and x.
    """

    def __init__(self, tile: Tile) -> None:
        self._tile = tile
        self.values: dict[str, dict[str, NDArray[Any]]] = {}

    def add(self, part: tuple[slice, slice], found: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
        """Take the arrays of a piece of the tile."""
        for group, arrays in found.items():
            held = self.values.setdefault(group, {})
            for name, values in arrays.items():
                variable = VARIABLES[f"{group}/{name}"]
                y = variable.dims.index("y")
                shape = (*values.shape[:y], *self._tile.shape, *values.shape[y + 2 :])
                whole = held.setdefault(name, np.empty(shape, values.dtype))
                whole[variable.index(part)] = values

    def leave_out(self, excluded: NDArray[np.bool_]) -> None:
        """Take the values of excluded pixels (y, x) away, and give them their word."""
        for group, arrays in self.values.items():
            for name, values in arrays.items():
                if values.dtype.kind == "f":
                    before = VARIABLES[f"{group}/{name}"].dims.index("y")
                    values[(slice(None),) * before + (excluded,)] = np.nan
        self.values["fit"]["fit_status"][excluded] = int(FitStatus.EXCLUDED)

    def write(self, store: RunStore) -> None:
        """Write them into a run."""
        for group, arrays in self.values.items():
            store.write_arrays(group, arrays, self._tile.region)


def create_fit_arrays(context: StageContext) -> None:
    """Make the arrays that the fit will have; the words of its status are explained with them."""
    left_out = {"fit_status", *(() if context.model.effects else FREE_SATELLITES)}
    if context.config.fit.intervals == "normal":
        left_out |= {path for name in INTERVALS for path in interval_names(name)}
    context.create(*(v.path for v in variables_of("fit") if v.name not in left_out))
    context.create(
        "fit/fit_status",
        flag_masks=[int(bit) for bit in MEANINGS],
        flag_meanings=" ".join(str(bit.name).lower() for bit in MEANINGS),
        flag_sentences={str(bit.name).lower(): sentence for bit, sentence in MEANINGS.items()},
    )
    if n := len(context.sensor.samples):
        lengths = {"sample": n, "sample_parameter": n + 3, "sample_parameter_2": n + 3}
        context.create(*(f"samples/{name}" for name in _OF_SAMPLES), lengths=lengths)
