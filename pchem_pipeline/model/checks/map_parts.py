"""Parts of a sensor that differ: steps of a map along its columns or rows, and values with two modes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import bdtr, stdtr

from pchem_pipeline.model.law.parameters import FloatArray

#: Chance of a false alarm for a map, all places that are looked at together.
_ALARM = 1e-4
#: Lines on either side of a step: the fewest, and the most that are compared, so that shading stays smooth.
_FEWEST, _MOST = 4, 8
#: Pixels of a line that its median is of, and values that modes are looked for in.
_PIXELS, _VALUES = 512, 1 << 18
#: Share of the pixels that a mode has at least.
_SHARE = 0.05


@dataclass(frozen=True)
class Parts:
    """Parts of a map that differ.

    Attributes:
        axis: ``columns`` or ``rows`` for steps; ``modes`` for values with two modes.
        edges: first line of each part and the end of the last; of modes the value that divides them.
        medians: of each part, in the unit of the map.
    """

    axis: str
    edges: tuple[float, ...]
    medians: tuple[float, ...]


def map_parts(values: FloatArray) -> list[Parts]:
    """Find steps of a map along its columns and rows; without any, two modes of its values.

    A step is a jump of the medians of lines against a common slope, by at least the robust standard deviation
    of the pixels within the parts: a smaller one hardly matters to a median over the sensor.

    Args:
        values: the map, NaN where it has no value, shape (ny, nx).
    """
    found = []
    for axis, across in (("columns", values), ("rows", values.T)):
        edges = _steps(across)
        if len(edges) > 2:
            medians = (_median(across[:, a:b]) for a, b in pairwise(edges))
            found.append(Parts(axis, tuple(edges), tuple(medians)))
    return found or _two_modes(values)


def _median(values: FloatArray) -> float:
    return float(np.median(values[np.isfinite(values)]))


def _steps(values: FloatArray) -> list[int]:
    """Return the first column of each part, and the end of the last."""
    some = np.unique(np.linspace(0, len(values) - 1, min(len(values), _PIXELS)).astype(np.int64))
    chosen = values[some]
    full = np.isfinite(chosen).sum(axis=0) >= _FEWEST
    columns = np.flatnonzero(full)
    if columns.size < 2 * _FEWEST:
        return []
    lines = np.nanmedian(chosen[:, full], axis=0)
    spread = 1.4826 * float(np.nanmedian(np.abs(chosen[:, full] - lines)))
    limit, edges = _ALARM / (4.0 * lines.size), [0, lines.size]
    while True:
        p, at = min((_best_step(lines[a:b], a, spread) for a, b in pairwise(edges)))
        if p > limit:
            return [0, *(int(columns[i]) for i in edges[1:-1]), values.shape[1]]
        edges = sorted([*edges, at])


def _best_step(lines: FloatArray, first: int, spread: float) -> tuple[float, int]:
    """Return the p-value of the most significant step that is larger than a spread, and its place."""
    best = 1.0, -1
    for at in range(_FEWEST, lines.size - _FEWEST + 1):
        half = min(_MOST, at, lines.size - at)
        x = np.arange(2 * half) - (half - 0.5)
        design = np.stack([np.ones(2 * half), x, np.sign(x)], axis=1)
        inverse = np.linalg.inv(design.T @ design)
        near = lines[at - half : at + half]
        fitted = inverse @ design.T @ near
        freedom = 2 * half - 3
        error = np.sqrt(inverse[2, 2] * np.sum((near - design @ fitted) ** 2) / freedom)
        if abs(2.0 * fitted[2]) > max(spread, 1e-12 * float(np.abs(near).max())):
            best = min(best, (2.0 * float(stdtr(freedom, -abs(fitted[2]) / max(error, 1e-300))), first + at))
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
    counts = [
        int(np.diff(np.searchsorted(known, (c - quarter, c + quarter)))[0])
        for c in (medians[0], middle, medians[1])
    ]
    fewest = min(counts[0], counts[2])
    p = float(bdtr(counts[1], counts[1] + fewest, 0.5)) if fewest else 1.0
    return [Parts("modes", (middle,), medians)] if n * p < _ALARM else []
