"""Parts of a sensor that differ: steps of a map along its columns and rows, and values with two modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import bdtr, stdtr

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.arithmetic.statistics import OF_MEDIAN_DEVIATION

#: Chance of a false alarm for a map, all places that are looked at together.
_ALARM = 1e-4
#: Lines on either side of a step: the fewest, and the most that are compared, so that shading stays smooth.
_FEWEST, _MOST = 4, 8
#: Pixels of a line that its median is of, and values that modes are looked for in.
_PIXELS, _VALUES = 512, 1 << 18
#: Share of the pixels that a mode has at least.
_SHARE = 0.05

Box = tuple[int, int, int, int]


@dataclass(frozen=True)
class Parts:
    """Parts of a map that differ.

    Attributes:
        boxes: first row, end, first column and end of each part; empty for values with two modes.
        medians: of each part, or mode, in the unit of the map.
    """

    boxes: tuple[Box, ...]
    medians: tuple[float, ...]


def map_parts(values: FloatArray) -> list[Parts]:
    """Find steps of a map along its columns and rows; without any, two modes of its values.

    A step is a jump of the medians of lines against a common slope, by at least the robust standard deviation
    of the pixels within the parts: a smaller one hardly matters to a median over the sensor. The map (y, x),
    NaN where it has no value, is divided at the most significant one, and each part likewise.
    """
    # of each line, all of it and both halves are looked at
    boxes = _divided(values, (0, values.shape[0], 0, values.shape[1]), _ALARM / (3.0 * sum(values.shape)))
    boxes.sort()
    if len(boxes) == 1:
        return _two_modes(values)
    medians = (_median(values[y0:y1, x0:x1]) for y0, y1, x0, x1 in boxes)
    return [Parts(tuple(boxes), tuple(medians))]


def _divided(values: FloatArray, box: Box, limit: float) -> list[Box]:
    """Divide a part of the map at its steps, as long as these have a p-value of at most ``limit``."""
    y0, y1, x0, x1 = box
    part = values[y0:y1, x0:x1]
    (p, x), (p_row, y) = _step(part), _step(part.T)
    if min(p, p_row) > limit:
        return [box]
    halves = ((y0, y1, x0, x0 + x), (y0, y1, x0 + x, x1))
    if p_row < p:
        halves = ((y0, y0 + y, x0, x1), (y0 + y, y1, x0, x1))
    return [each for half in halves for each in _divided(values, half, limit)]


def _median(values: FloatArray) -> float:
    return float(np.median(values[np.isfinite(values)]))


def _step(values: FloatArray) -> tuple[float, int]:
    """Return p-value and place of the most significant step along the columns, whole or in halves."""
    middle = len(values) // 2  # where steps cross, those of the halves may cancel in the whole
    return min(_step_of(part) for part in (values, values[:middle], values[middle:]))


def _step_of(values: FloatArray) -> tuple[float, int]:
    if not len(values):
        return 1.0, -1
    some = np.unique(np.linspace(0, len(values) - 1, min(len(values), _PIXELS)).astype(np.int64))
    chosen = values[some]
    columns = np.flatnonzero(np.isfinite(chosen).sum(axis=0) >= _FEWEST)
    if columns.size < 2 * _FEWEST:
        return 1.0, -1
    lines = np.nanmedian(chosen[:, columns], axis=0)
    spread = OF_MEDIAN_DEVIATION * float(np.nanmedian(np.abs(chosen[:, columns] - lines)))
    p, at = _best_step(lines, spread)
    return p, int(columns[at])


def _best_step(lines: FloatArray, spread: float) -> tuple[float, int]:
    """Return the p-value of the most significant step that is larger than a spread, and its place."""
    best, places = (1.0, -1), np.arange(_FEWEST, lines.size - _FEWEST + 1)
    halves = np.minimum(np.minimum(places, lines.size - places), _MOST)
    for half in np.unique(halves).tolist():
        x = np.arange(2 * half) - (half - 0.5)
        design = np.stack([np.ones(2 * half), x, np.sign(x)], axis=1)
        inverse = np.linalg.inv(design.T @ design)
        at = places[halves == half]
        near = np.lib.stride_tricks.sliding_window_view(lines, 2 * half)[at - half]
        fitted = near @ design @ inverse
        freedom = 2 * half - 3
        error = np.sqrt(inverse[2, 2] * ((near - fitted @ design.T) ** 2).sum(axis=1) / freedom)
        p = 2.0 * stdtr(freedom, -np.abs(fitted[:, 2]) / np.maximum(error, 1e-300))
        p[np.abs(2.0 * fitted[:, 2]) <= np.maximum(spread, 1e-12 * np.abs(near).max(axis=1))] = 1.0
        best = min(best, (float(p.min()), int(at[p.argmin()])))
    return best


def _two_modes(values: FloatArray) -> list[Parts]:
    """Return two modes: fewer values half-way than at either, which no distribution of one mode has."""
    known = values[np.isfinite(values)]
    known = np.sort(known[:: -(-known.size // _VALUES) or 1])
    n = known.size
    size = np.arange(1, n)
    low = np.cumsum(known)[:-1]
    share = size * (n - size) * ((known.sum() - low) / (n - size) - low / size) ** 2  # Otsu's criterion
    ends = int(_SHARE * n), n - int(_SHARE * n)
    if ends[1] - ends[0] < 2:
        return []
    cut = ends[0] + int(np.argmax(share[ends[0] : ends[1] - 1])) + 1
    medians = float(np.median(known[:cut])), float(np.median(known[cut:]))
    quarter, middle = 0.125 * (medians[1] - medians[0]), 0.5 * (medians[0] + medians[1])
    centres = np.array([medians[0], middle, medians[1]])
    low, high = np.searchsorted(known, (centres - quarter, centres + quarter))
    left, between, right = (high - low).tolist()
    fewest = min(left, right)
    p = float(bdtr(between, between + fewest, 0.5)) if fewest else 1.0
    return [Parts((), medians)] if n * p < _ALARM else []
