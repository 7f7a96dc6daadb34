"""What the report's inspector is given: every stored map that fits, and a sample of pixels in full.

The list of maps is that of the store: each array with the dimensions (y, x) that ``variables.py`` names is
shown, with its words and unit.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import quoted
from pchem_pipeline.base.variables import FREE_LOBES, PARAMETERS, VARIABLES, Variable
from pchem_pipeline.effects.framework.compose import marginal_model, pixel_maps
from pchem_pipeline.model.fit.grown import marginal_mass
from pchem_pipeline.model.fit.status import MEANINGS
from pchem_pipeline.report.inspector.inspector_data import InspectorData, MapEntry, PixelSample
from pchem_pipeline.report.inspector.packing import PackedMap, choose_scale, pack_map
from pchem_pipeline.stages.fit.fitted_model import deciding_maps, fitted_added_exposure, fitted_effects
from pchem_pipeline.stages.report.inspected_pixels import ChosenPixels, choose_inspected

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.added_exposure import AddedExposure
    from pchem_pipeline.effects.framework.effect import Effect
    from pchem_pipeline.run.sensor import SensorInfo
    from pchem_pipeline.store.run_store import RunStore

__all__ = [
    "Listed",
    "gather_inspector",
    "grown_masses",
    "listed_maps",
    "map_entry",
    "packed_map",
    "read_sample",
]

#: Sensors with fewer pixels have all of them in the file.
_ALL_PIXELS = 4096
#: Pixels in full in the file of a larger sensor, and how many of them with the mass of a model with effects.
_SOME_PIXELS, _SOME_MASSES = 2400, 300
#: Bytes of base64 for the maps of a sensor of 512 x 512 pixels; larger ones get more, by the power 0.9.
_MAPS_BUDGET, _MAPS_POWER = 2.8e6, 0.9
_PAPER_PIXELS = 512 * 512
#: Steps of a map's codes: an eighth of a pixel's standard error, and 4 % of a standard error itself; four
#: times that for sensors beyond a million pixels.
_STEPS_PER_ERROR, _STEP_OF_ERRORS = 8.0, 0.04
_COARSE_PIXELS, _COARSE = 1_000_000, 4.0

#: What people call maps whose names are short for the store.
_LABELS = {
    "maps/goodness_q": "false-discovery rate q",
    "fit/n_iterations": "evaluations of the likelihood",
    "fit/goodness_chi2": "χ² of the fit",
    "fit/goodness_dof": "degrees of freedom of χ²",
    "fit/goodness_p": "goodness of fit p",
    "fit/outlier_share": "share of frames left out",
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
    "maps/read_noise_e",
    "maps/read_noise_e_stderr",
    "maps/conversion_gain",
    "maps/conversion_gain_stderr",
    "maps/quanta_exposure",
    "maps/quanta_exposure_stderr",
    "maps/dark_current",
    "maps/dark_current_stderr",
    "maps/bias",
    "maps/bias_stderr",
    "fit/goodness_p",
    "maps/quality",
)
#: Groups in the order of the list; what a group of ``fit`` repeats of ``maps`` is left out.
_GROUPS = ("maps", "fit", "discrepancy", "summary", "histogram", "truth")
_WORDS = re.compile(r"(\d+) ([^,;:]+)")


@dataclass(frozen=True)
class Listed:
    """A stored map: its variable and the attributes of its array."""

    variable: Variable
    attributes: Mapping[str, Any]


def listed_maps(store: RunStore, shape: tuple[int, int]) -> list[Listed]:
    """Return the stored arrays with the dimensions (y, x) and the shape of the sensor, in the order shown."""
    known = [variable for variable in VARIABLES.values() if variable.dims == ("y", "x")]
    groups = [*_GROUPS, *dict.fromkeys(v.group for v in known if v.group not in _GROUPS)]
    places = {path: i for i, path in enumerate(VARIABLES)}
    known.sort(key=lambda variable: (groups.index(variable.group), places[variable.path]))
    found = []
    for variable in known:
        repeated = variable.group == "fit" and f"maps/{variable.name}" in VARIABLES
        if not repeated and store.has(variable.path) and store.array(variable.path).shape == shape:
            found.append(Listed(variable, store.attributes(variable.path)))
    return found


def map_entry(listed: Listed) -> MapEntry:
    """Return the words of a stored map; the map itself is not read."""
    variable, attributes = listed.variable, listed.attributes
    # the sentences of these groups begin with the name of the quantity, those of others explain it
    named = variable.group in ("maps", "truth")
    label = variable.long_name.split(":")[0] if named else variable.name.replace("_", " ")
    label = _LABELS.get(variable.path, label)
    label = label.replace(", quantisation included", "").replace(", quantisation removed", "")
    kind, words = "value", {}
    if variable.path == "fit/fit_status":
        kind, words = "bits", {int(bit): text for bit, text in MEANINGS.items()}
    elif "flag_masks" in attributes:
        kind, words = "bits", _flag_words(attributes, "flag_masks")
    elif "flag_values" in attributes:
        kind, words = "words", _flag_words(attributes, "flag_values")
    elif variable.dtype == "uint8":
        words = {int(number): text.strip() for number, text in _WORDS.findall(variable.long_name)}
        kind = "words" if words else "value"
    elif variable.name.endswith("_stderr"):
        kind = "stderr"
    if kind in ("bits", "words"):
        label = variable.name.replace("_", " ")
    return MapEntry(variable.path, label, variable.unit, variable.long_name, kind, words)


def _flag_words(attributes: Mapping[str, Any], key: str) -> dict[int, str]:
    texts = str(attributes.get("flag_meanings", "")).split()
    return {int(n): text.replace("_", " ") for n, text in zip(attributes[key], texts, strict=False)}


def gather_inspector(
    store: RunStore,
    sensor: SensorInfo,
    maps: Mapping[str, NDArray[Any]],
    fit: Mapping[str, NDArray[Any]],
    shown: Sequence[tuple[int, int]],
    suspects: Sequence[tuple[int, int]] = (),
) -> InspectorData:
    """Pack the maps that fit and read the pixels that are shown in full.

    Args:
        store: the run.
        sensor: its input.
        maps: group ``maps``, (y, x).
        fit: ``fit_status`` and ``goodness_p``, (y, x).
        shown: pixels (y, x) that the report draws.
        suspects: pixels (y, x) to which the discrepancy verdict points.

    Raises:
        StoreError: an array is missing or corrupt.
    """
    listed = listed_maps(store, sensor.shape)
    entries = _packed(store, listed, sensor.shape)
    chosen = choose_inspected(maps, fit, shown, suspects, everything=_ALL_PIXELS, most=_SOME_PIXELS)
    here = [entry.path for entry in entries if entry.packed is not None or entry.same_as is not None]
    sample = read_sample(store, chosen, here, sensor.shape)
    kept_to = "a quarter" if sensor.ny * sensor.nx > _COARSE_PIXELS else "a sixteenth"
    return InspectorData(tuple(entries), sample, kept_to, f"pchem view {quoted(Path(store.path.name))}")


def _packed(store: RunStore, listed: Sequence[Listed], shape: tuple[int, int]) -> list[MapEntry]:
    """Pack maps, the important ones first, until the budget is spent."""
    n = shape[0] * shape[1]
    budget = _MAPS_BUDGET * max(1.0, n / _PAPER_PIXELS) ** _MAPS_POWER
    order = sorted(listed, key=lambda each: _importance(each.variable.path))
    found: dict[str, MapEntry] = {}
    for each in order:
        entry = map_entry(each)
        alike = _multiple_of_exposure(store, each.variable)
        if alike is not None and alike[0] in found and found[alike[0]].packed is not None:
            found[entry.path] = replace(entry, same_as=alike)
            continue
        packed = packed_map(store, each.variable)
        size = 4 * len(packed.data) / 3
        if size <= budget:
            budget -= size
            found[entry.path] = replace(entry, packed=packed)
        else:
            found[entry.path] = entry
    return [found[each.variable.path] for each in listed]


def _importance(path: str) -> tuple[int, int]:
    if path in _FIRST:
        return 0, _FIRST.index(path)
    group = path.split("/", 1)[0]
    return 1 + (_GROUPS.index(group) if group in _GROUPS else 1), 0


def packed_map(store: RunStore, variable: Variable) -> PackedMap:
    """Return a stored map, quantised well below its standard error.

    Raises:
        StoreError: it is missing or corrupt.
    """
    values = store.read(variable.path)
    coarse = _COARSE if values.size > _COARSE_PIXELS else 1.0
    step = 0.0
    if variable.name.endswith("_stderr"):
        step = _STEP_OF_ERRORS * _median(values)
    elif store.has(f"{variable.path}_stderr"):
        step = _median(store.read(f"{variable.path}_stderr")) / _STEPS_PER_ERROR
    return pack_map(values, choose_scale(values, step=step, coarse=coarse))


def _median(values: NDArray[Any]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else 0.0


def _multiple_of_exposure(store: RunStore, variable: Variable) -> tuple[str, float] | None:
    """Return the map of H, or of its error, with the factor that makes it this one; None for other maps."""
    if not variable.path.startswith("maps/dark_current"):
        return None
    other = variable.path.replace("dark_current", "quanta_exposure")
    if not store.has(other):
        return None
    current, exposure = store.read(variable.path), store.read(other)
    known = np.isfinite(current) & np.isfinite(exposure) & (exposure > 0)
    if not known.any() or (np.isfinite(current) != np.isfinite(exposure)).any():
        return None
    factor = float(np.median(current[known] / exposure[known]))
    same = np.allclose(current[known], factor * exposure[known], rtol=1e-9, atol=0.0)
    return (other, factor) if same else None


def read_sample(
    store: RunStore, chosen: ChosenPixels, paths: Sequence[str], shape: tuple[int, int]
) -> PixelSample:
    """Read pixels in full: values of the maps, histogram, and their mass under a model with effects.

    Args:
        store: the run.
        chosen: the pixels and why.
        paths: maps whose values are kept.
        shape: of the sensor.

    Raises:
        StoreError: an array is missing or corrupt.
    """
    index = chosen.index
    exact = {path: store.read(path).reshape(-1)[index].astype(np.float64) for path in paths}
    origin, counts = _histograms(store, index, shape)
    effects = fitted_effects(store)
    deciding, masses = None, []
    if effects:
        columns = [store.read(f"maps/{name}").reshape(-1)[index] for name in PARAMETERS]
        every = fitted_added_exposure(store)
        added = None if every is None else every.flat().of(index)
        known = np.isfinite(columns).all(axis=0)
        deciding = np.full((4, index.size), np.nan)
        if known.any():
            own = None if added is None else added.of(np.flatnonzero(known))
            deciding[:, known] = deciding_maps([column[known] for column in columns], effects, own)
        some = slice(0, _SOME_MASSES)
        lobes = [store.read(f"fit/{name}").reshape(-1)[index][some] for name in FREE_LOBES]
        first = None if added is None else added.of(some)
        masses = grown_masses(effects, [c[some] for c in columns], lobes, origin[some], counts[some], first)
    return PixelSample(index, exact, origin, counts, deciding, masses, chosen.reasons)


def grown_masses(
    effects: Sequence[Effect],
    columns: Sequence[NDArray[np.float64]],
    lobes: Sequence[NDArray[np.float64]],
    origin: NDArray[np.integer[Any]],
    counts: Sequence[NDArray[np.integer[Any]]],
    added: AddedExposure | None = None,
) -> list[NDArray[np.float64]]:
    """Return the probability of each bin of each pixel under a model with effects; NaN without parameters.

    Args:
        effects: of the model.
        columns: (H, g, mu, sigma) of n pixels.
        lobes: amplitude (e-) and weight of their free levels.
        origin: DN of the first bin of each.
        counts: their histograms, all of one length.
        added: exposure that the effects add to them, (j, n); None: nothing.
    """
    if not counts:
        return []
    n_bins = counts[0].size
    found = np.full((len(counts), n_bins), np.nan)
    known = np.isfinite(columns).all(axis=0)
    if known.any():
        kept = [column[known] for column in columns]
        own = None if added is None else added.of(np.flatnonzero(known))
        model = marginal_model(effects, pixel_maps(kept, np.ones(kept[0].size, bool)), own)
        codes = origin[known][:, None] + np.arange(n_bins)
        found[known] = marginal_mass(model, kept, codes, lobes=(lobes[0][known], lobes[1][known]))
    return list(found)


def _histograms(
    store: RunStore, index: NDArray[np.int64], shape: tuple[int, int]
) -> tuple[NDArray[np.int64], list[NDArray[np.integer[Any]]]]:
    """Read the histograms of pixels, chunk by chunk."""
    y, x = np.divmod(index, shape[1])
    origin = store.read("histogram/origin").reshape(-1)[index].astype(np.int64)
    high, wide = store.array("histogram/counts").chunks[:2]
    chunk = (y // high) * (shape[1] // wide + 1) + x // wide
    counts: list[NDArray[np.integer[Any]]] = [np.empty(0, np.int64)] * index.size
    for each in np.unique(chunk):
        here = np.flatnonzero(chunk == each)
        y0, x0 = int(y[here[0]] // high * high), int(x[here[0]] // wide * wide)
        region = (slice(y0, y0 + high), slice(x0, x0 + wide), slice(None))
        block = store.read("histogram/counts", region)
        for i in here:
            counts[i] = block[y[i] - y0, x[i] - x0].copy()
    return origin, counts
