"""Single pixels of a report: which are shown, which are held in full, and what their fits expect.

Held in full are the shown, flagged, worst and extreme ones, and an even sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, BoolArray, FloatArray, IntArray
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.base.wording import symbol
from pchem_pipeline.model.fit.status import MEANINGS, describe
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.maps.ordered import Ordered
from pchem_pipeline.report.data import MAP_NAMES, PixelFit
from pchem_pipeline.report.inspector import Notable, some_of
from pchem_pipeline.stages.fit.fitted_model import FittedModel
from pchem_pipeline.stages.report.stored import PixelHistograms
from pchem_pipeline.store.tiles import MAX_BINS

#: Pixels for each reason: a flag, a poor fit, an extreme value, a large standard error.
_FLAGGED, _POOR, _EXTREME, _UNSURE = 40, 60, 12, 8

#: Labels of the four shown pixels, and the ranks of read noise and quanta exposure at which they lie.
_CORNERS = (
    ("low read noise, low exposure", 0.1, 0.1),
    ("low read noise, high exposure", 0.1, 0.9),
    ("high read noise, low exposure", 0.9, 0.1),
    ("high read noise, high exposure", 0.9, 0.9),
)

#: Label, y and x of a pixel.
Chosen = tuple[str, int, int]


def choose_pixels(
    read_noise_e: FloatArray, quanta_exposure: FloatArray, fit_status: NDArray[Any]
) -> list[Chosen]:
    """Choose four pixels at low and high read noise and low and high exposure (fig:plot_per_pixel_fits).

    Ranks are taken among the pixels with a good fit (with any value, if fewer than four are good); the
    pixel nearest to the 10 or 90 % rank of both is taken, each once. Where no pixel has a value, one of each
    reason for it is shown, the most frequent reasons first. All maps have the shape (ny, nx).
    """
    known = np.isfinite(read_noise_e) & np.isfinite(quanta_exposure)
    if not known.any():
        _, first, counts = np.unique(fit_status, return_index=True, return_counts=True)
        commonest = first[np.argsort(-counts, kind="stable")[:4]].tolist()
        return [("no fit", *divmod(place, fit_status.shape[1])) for place in commonest]
    good = known & (fit_status == 0)
    free = good if good.sum() >= len(_CORNERS) else known
    maps = read_noise_e, quanta_exposure
    ordered = [Ordered.of(values, ~free) for values in maps]
    chosen: list[Chosen] = []
    for label, *ranks in _CORNERS[: ordered[0].size]:
        best = _nearest(maps, ordered, ranks, free)
        free[best] = False
        chosen.append((label, *best))
    return chosen


def _nearest(
    maps: Sequence[FloatArray], ordered: Sequence[Ordered], ranks: Sequence[float], free: BoolArray
) -> tuple[int, int]:
    """Return the free pixel whose values have ranks (0 to 1) nearest to given ones, in windows that grow."""
    reach = 0.02
    while True:
        inside = free.copy()
        for values, known, rank in zip(maps, ordered, ranks, strict=True):
            low, high = known.quantiles(np.clip([rank - reach, rank + reach], 0.0, 1.0))
            inside &= (values >= low) & (values <= high)
        y, x = np.nonzero(inside)
        distance = np.zeros(y.size)
        for values, known, rank in zip(maps, ordered, ranks, strict=True):
            distance += (known.shares(values[y, x]) - rank) ** 2
        if reach >= 1.0 or np.min(distance, initial=np.inf) < (reach - 1.0 / free.size) ** 2:
            best = int(np.argmin(distance))
            return int(y[best]), int(x[best])
        reach *= 2.0


def pixel_index(pixels: Sequence[tuple[int, int]], nx: int) -> IntArray:
    """Return ``y * nx + x`` of pixels (y, x)."""
    return np.array([y * nx + x for y, x in pixels], dtype=np.int64)


def pixel_fits(
    chosen: Sequence[Chosen],
    maps: Mapping[Any, Any],
    fit: Mapping[Any, Any],
    histograms: PixelHistograms,
    masses: Sequence[FloatArray],
    *,
    channel: bool = False,
) -> list[PixelFit]:
    """Return histograms and fits of chosen pixels; ``channel``: they are channels of ready-made histograms.

    ``maps`` and ``fit`` are indexed by (y, x), ``masses`` are those of :func:`bin_masses`.
    """
    names = (*PARAMETERS, "read_noise_e")
    found = []
    for i, (label, y, x) in enumerate(chosen):
        word, mass = int(fit["fit_status"][y, x]), masses[i] if masses else None
        found.append(
            PixelFit(
                label=label,
                y=y,
                x=x,
                origin=int(histograms.origin[i]),
                counts=histograms.counts[i],
                parameters={name: float(maps[name][y, x]) for name in names},
                stderr={name: float(maps[f"{name}_stderr"][y, x]) for name in names},
                status=describe(word) if word else "",
                goodness_p=float(fit["goodness_p"][y, x]) if "goodness_p" in fit else float("nan"),
                channel=channel,
                mass=None if mass is None or not np.isfinite(mass).all() else mass,
            )
        )
    return found


def bin_masses(
    columns: Sequence[FloatArray], histograms: PixelHistograms, model: FittedModel
) -> list[FloatArray]:
    """Return the probability of each bin of n pixels under a model with effects; NaN without parameters.

    None are returned under a model without effects, whose law is the PCD. ``columns`` are (H, g, mu, sigma).
    """
    counts = histograms.counts
    if not counts or not model.effects:
        return []
    found = np.full((len(counts), counts[0].size), np.nan)
    known = np.flatnonzero(np.isfinite(columns).all(axis=0))
    if known.size:
        kept = [column[known] for column in columns]
        codes = histograms.origin[known][:, None] + np.arange(counts[0].size)
        amplitude, weight = histograms.satellites[:, known]
        found[known] = sample_mass(model.at(known).law(kept), kept, codes, satellites=(amplitude, weight))
    return list(found)


def choose_inspected(
    maps: Arrays,
    fit: Arrays,
    shown: Sequence[tuple[int, int]],
    suspects: Sequence[tuple[int, int]] = (),
    *,
    bins: int = 1,
    everything: int = 4096,
    most: int = 2400,
) -> tuple[IntArray, list[Notable]]:
    """Choose the pixels that are in the report in full; ``maps`` and ``fit`` are (y, x).

    These are the ``shown`` ones, the ``suspects`` of the search for missing effects, odd ones, and an even
    sample. A sensor of at most ``everything`` pixels is taken whole, of a larger one ``most``; histograms of
    so many ``bins`` have at most `MAX_BINS` together. Return ``y * nx + x`` of each, the shown and odd ones
    first, shape (n,), and why they were chosen, those of the even sample excepted.
    """
    status = np.asarray(fit["fit_status"])
    ny, nx = status.shape
    everything, most = (min(n, MAX_BINS // bins) for n in (everything, most))
    rng, p = np.random.default_rng(20_231), fit.get("goodness_p", np.full(status.shape, np.nan))
    reasons = [
        ("shown in the report", "", pixel_index(shown, nx)),
        ("from the search for missing effects", "", pixel_index(suspects, nx)),
        ("poorest goodness of fit", "fit/goodness_p", _smallest(p, _POOR)),
        *_flagged(status, rng),
        *_extreme(maps),
    ]
    rest = np.arange(status.size) if status.size <= everything else _even(ny, nx, most, rng)
    index = np.concatenate([*(where for _, _, where in reasons), rest])
    _, once = np.unique(index, return_index=True)  # each where it comes first
    index = index[np.sort(once)]
    if status.size > everything:
        index = index[:most]
    found = [
        Notable(words, tuple(where[np.isin(where, index)].tolist()), path) for words, path, where in reasons
    ]
    return index, [each for each in found if each.pixels]


def _smallest(numbers: NDArray[Any], n: int) -> IntArray:
    """Return the places of the n smallest values in their order, of equal ones the first."""
    values = np.asarray(numbers, dtype=np.float64).ravel()
    some = some_of(values)
    some = some[np.isfinite(some)]
    # of all pixels there are as many below the n-th of some, and few more: sorting all takes long
    limit = np.partition(some, n - 1)[n - 1] if some.size > n else np.inf
    known = np.flatnonzero(np.isfinite(values) & (values <= limit))
    order = np.argsort(values[known], kind="stable")[:n]
    return np.asarray(known[order], dtype=np.int64)


def _flagged(status: NDArray[Any], rng: np.random.Generator) -> list[tuple[str, str, IntArray]]:
    """Return some pixels of each reason for caution or failure, drawn at random, in their order."""
    found = []
    for bit, words in MEANINGS.items():
        where = np.flatnonzero(status.ravel() & int(bit))
        if where.size > _FLAGGED:
            where = np.sort(rng.choice(where, _FLAGGED, replace=False))
        found.append((words, "", where.astype(np.int64)))
    return found


def _extreme(maps: Arrays) -> list[tuple[str, str, IntArray]]:
    found = []
    for name in MAP_NAMES:
        words = symbol(name)[1]
        for path, sign, n, what in (
            (name, -1.0, _EXTREME, f"largest {words}"),
            (name, 1.0, _EXTREME, f"smallest {words}"),
            (f"{name}_stderr", -1.0, _UNSURE, f"largest standard error of the {words}"),
        ):
            if path in maps:
                found.append((what, f"maps/{path}", _smallest(sign * maps[path], n)))
    return found


def _even(ny: int, nx: int, n: int, rng: np.random.Generator) -> IntArray:
    """Return about ``n`` pixels, one at random in each cell of a grid, in random order."""
    rows = int(np.clip(round((n * ny / nx) ** 0.5), 1, ny))
    columns = int(np.clip(round(n / rows), 1, nx))
    edges_y, edges_x = np.linspace(0, ny, rows + 1), np.linspace(0, nx, columns + 1)
    y = np.minimum(edges_y[:-1, None] + rng.random((rows, columns)) * (ny / rows), ny - 1).astype(np.int64)
    x = np.minimum(edges_x[None, :-1] + rng.random((rows, columns)) * (nx / columns), nx - 1).astype(np.int64)
    return rng.permutation((y * nx + x).ravel())
