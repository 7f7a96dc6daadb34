"""What the report's inspector is given: every stored map that fits, and a sample of pixels in full.

The list of maps is that of the store: each array with the dimensions (y, x) that ``variables.py`` names is
shown, with its words and unit.
"""

from __future__ import annotations

import functools
import math
import re
from collections import ChainMap
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, FloatArray, IntArray
from pchem_pipeline.base.errors import quoted
from pchem_pipeline.base.variables import CHARGE_RATES, VARIABLES, Variable
from pchem_pipeline.compute.executor import call_all
from pchem_pipeline.model.fit.status import MEANINGS
from pchem_pipeline.model.law.pcd import nearest_pcd
from pchem_pipeline.model.maps.ordered import Ordered
from pchem_pipeline.report.inspector import (
    InspectorData,
    MapEntry,
    PackedMap,
    PixelSample,
    choose_scale,
    pack_map,
    some_of,
)
from pchem_pipeline.stages.fit.fitted_model import FittedModel
from pchem_pipeline.store.run_store import RunStore

#: Bytes of base64 for the maps of a sensor of 512 x 512 pixels; larger ones get more, by the power 0.9, and
#: at most so many: what does not fit is shown by ``pchem view`` and, of all pixels, in the figures.
_MAPS_BUDGET, _MAPS_POWER, _MOST_BYTES = 2.8e6, 0.9, 6.8e6
#: Steps of a map's codes are an eighth of a pixel's standard error, and 4 % of a standard error itself; for
#: sensors of more pixels so many times that, with how true the values are then.
_COARSE = (
    (4_000_000, 16.0, "a standard error"),
    (1_000_000, 4.0, "a quarter of a standard error"),
    (0, 1.0, "a sixteenth of a standard error"),
)

#: What people call maps whose names are short for the store.
_LABELS = {
    "maps/goodness_q": "false-discovery rate q",
    "fit/n_iterations": "evaluations of the likelihood",
    "fit/goodness_chi2": "χ² of the fit",
    "fit/goodness_dof": "degrees of freedom of χ²",
    "fit/goodness_p": "goodness of fit p",
    "fit/outlier_share": "share of excluded frames",
    "summary/lag1_covariance": "covariance with the next frame",
    "summary/neighbour_covariance_x": "covariance with the neighbour in x",
    "summary/neighbour_covariance_y": "covariance with the neighbour in y",
    "histogram/origin": "first DN of the histogram",
    "histogram/under": "frames below the histogram",
    "histogram/over": "frames above the histogram",
    "histogram/minimum": "smallest DN",
    "histogram/maximum": "largest DN",
}

#: The maps that are first in the file, in case that not all fit.
_FIRST = (
    "fit/fit_status",
    *(
        f"maps/{name}{end}"
        for name in ("read_noise_e", "conversion_gain", "quanta_exposure", *CHARGE_RATES, "bias")
        for end in ("", "_stderr")
    ),
    "fit/goodness_p",
    "maps/quality",
)
#: Groups in the order of the list; what a group of ``fit`` repeats of ``maps`` is left out.
_GROUPS = ("maps", "fit", "discrepancy", "summary", "histogram", "truth")
_MANY_PIXELS = 1_000_000


def listed_maps(store: RunStore, shape: tuple[int, int]) -> list[MapEntry]:
    """Return the stored arrays with the dimensions (y, x) and the shape of the sensor, in the order shown.

    These are their words; the maps themselves are not read.
    """
    known = [variable for variable in VARIABLES.values() if variable.dims == ("y", "x")]
    groups = list(dict.fromkeys((*_GROUPS, *(variable.group for variable in known))))
    return [
        _entry(variable)
        for variable in sorted(known, key=lambda variable: groups.index(variable.group))
        if not (variable.group == "fit" and f"maps/{variable.name}" in VARIABLES)
        and store.has(variable.path)
        and store.array(variable.path).shape == shape
    ]


def _entry(variable: Variable) -> MapEntry:
    # the sentences of these groups begin with the name of the quantity, those of others explain it
    named = variable.group in ("maps", "truth")
    label = variable.long_name.split(":")[0] if named else variable.name.replace("_", " ")
    label = _LABELS.get(variable.path, label)
    label = label.replace(", quantisation included", "").replace(", quantisation removed", "")
    kind, words = "value", {}
    if variable.path == "fit/fit_status":
        kind, words = "bits", {int(bit): text for bit, text in MEANINGS.items()}
    elif variable.dtype == "uint8":
        found = re.findall(r"(\d+) ([^,;:]+)", variable.long_name)
        words = {int(number): text.strip() for number, text in found}
        kind = "words" if words else "value"
    elif variable.name.endswith("_stderr"):
        kind = "stderr"
    if kind in ("bits", "words"):
        label = variable.name.replace("_", " ")
    return MapEntry(variable.path, label, variable.unit, variable.long_name, kind, words)


def inspector_data(
    name: str, shape: tuple[int, int], maps: Sequence[MapEntry], sample: PixelSample
) -> InspectorData:
    """Return all that the inspector of a run holds."""
    return InspectorData(
        tuple(maps), sample, _coarse(shape[0] * shape[1])[1], f"pchem view {quoted(Path(name))}"
    )


def read_maps(
    store: RunStore, shape: tuple[int, int], index: IntArray, loaded: Arrays | None = None, threads: int = 1
) -> tuple[list[MapEntry], dict[str, FloatArray]]:
    """Read every stored map: packed, the important ones first, until the page is full; exact for some pixels.

    ``index`` is ``y * nx + x`` of these, ``loaded`` are maps that were read already, by path; each of the
    threads packs a map. The maps come in the order of the list, the values of those that fit by path, (n,).

    Raises:
        StoreError: an array is missing or corrupt.
    """
    maps = ChainMap(dict(loaded or {}), store.at())
    listed, n = listed_maps(store, shape), shape[0] * shape[1]
    budget = min(_MAPS_BUDGET * max(1.0, n / 512**2) ** _MAPS_POWER, _MOST_BYTES)
    order = sorted(listed, key=lambda entry: _importance(entry.path))
    found: dict[str, MapEntry] = {}
    exact: dict[str, FloatArray] = {}
    for start in range(0, len(order), threads):
        some = order[start : start + threads]
        tasks = [functools.partial(_coded, maps, entry, index, budget > 0) for entry in some]
        for entry, values in call_all(tasks, threads):
            if entry.same_as is not None and getattr(found.get(entry.same_as[0]), "packed", None) is None:
                entry = replace(
                    entry, same_as=None, packed=packed_map(maps, entry.path) if budget > 0 else None
                )
            if entry.same_as is None:
                # packing many pixels takes long: there the first map that does not fit is the last tried
                size = math.inf if entry.packed is None else 4 * len(entry.packed.data) / 3
                fits = size <= budget
                budget -= size if fits else math.inf if n > _MANY_PIXELS else 0.0
                entry = replace(entry, packed=entry.packed if fits else None)
            found[entry.path] = entry
            if entry.packed is not None or entry.same_as is not None:
                exact[entry.path] = values
    paths = [entry.path for entry in listed]
    return [found[path] for path in paths], {path: exact[path] for path in paths if path in exact}


def _coded(maps: Arrays, entry: MapEntry, index: IntArray, pack: bool) -> tuple[MapEntry, FloatArray]:
    """Return a map, packed if wanted, or as a multiple of another, and its values at some pixels, (n,)."""
    alike = _multiple_of_exposure(maps, entry.path)
    if alike is None and not pack:
        return entry, np.empty(0)
    packed = packed_map(maps, entry.path) if alike is None else None
    values = maps[entry.path].reshape(-1)[index].astype(np.float64)
    return replace(entry, packed=packed, same_as=alike), values


def _importance(path: str) -> tuple[int, int]:
    if path in _FIRST:
        return 0, _FIRST.index(path)
    group = path.split("/", 1)[0]
    return 1 + (_GROUPS.index(group) if group in _GROUPS else 1), 0


def packed_map(maps: Arrays, path: str) -> PackedMap:
    """Return a stored map, quantised well below its standard error.

    Raises:
        StoreError: it is missing or corrupt.
    """
    values = maps[path]
    coarse, _ = _coarse(values.size)
    step = 0.0
    if path.endswith("_stderr"):
        step = 0.04 * _median(values)
    elif f"{path}_stderr" in maps:
        step = _median(maps[f"{path}_stderr"]) / 8.0
    return pack_map(values, choose_scale(values, step=step, coarse=coarse))


def _coarse(n_pixels: int) -> tuple[float, str]:
    """Return the factor on the steps of a sensor's maps, and how true its values are."""
    return next((factor, words) for most, factor, words in _COARSE if n_pixels > most)


def _median(values: NDArray[Any]) -> float:
    known = Ordered.of(some_of(values.ravel()))
    return known.median if known.size else 0.0


def _multiple_of_exposure(maps: Arrays, path: str) -> tuple[str, float] | None:
    """Return the map of H, or of its error, with the factor that makes it this one; None for other maps."""
    rate = next((name for name in CHARGE_RATES if path.startswith(f"maps/{name}")), None)
    if rate is None:
        return None
    other = path.replace(rate, "quanta_exposure")
    if other not in maps:
        return None
    current, exposure = maps[path], maps[other]
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = _median(some_of(current.ravel()) / some_of(exposure.ravel()))
    same = factor != 0 and np.allclose(current, factor * exposure, rtol=1e-9, atol=0.0, equal_nan=True)
    return (other, factor) if same else None


def deciding_parameters(columns: Sequence[FloatArray], model: FittedModel) -> FloatArray | None:
    """Return the parameters whose thresholds are drawn, (4, n); None if they are the fitted ``columns``."""
    if not model.effects:
        return None
    known = np.flatnonzero(np.isfinite(columns).all(axis=0))
    deciding = np.full((4, columns[0].size), np.nan)
    if known.size:
        kept = [column[known] for column in columns]
        deciding[:, known] = nearest_pcd(kept, model.at(known).law(kept))
    return deciding
