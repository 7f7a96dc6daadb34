"""Sudden changes of level in a noisy series: binary segmentation with local refinement.

A series of constant levels in white noise is cut where the sum of squares falls the most, the two parts are
cut again, and so on, until no cut gains what the Bayesian information criterion asks for (Scott and Knott
1974; Fryzlewicz 2014). Afterwards each cut is moved to its best place between its neighbours and dropped if
it no longer pays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["find_changes", "noise_variance", "segment_means"]


def noise_variance(series: NDArray[np.float64]) -> float:
    """Return the variance of the white part: half the mean squared difference of successive values.

    Sudden steps are so few that leaving out the largest twentieth of the differences takes care of them
    (the rest of a Gaussian's squares is 0.774 of its mean square).
    """
    squares = np.sort(np.diff(series) ** 2)
    kept = squares[: max(int(0.95 * squares.size), 1)]
    return float(kept.mean() / 2.0 / 0.774)


def find_changes(
    series: NDArray[np.float64], variance: float, *, penalty: float | None = None, largest: int = 256
) -> NDArray[np.int64]:
    """Return where new levels begin (indices, increasing; empty if the level never changes).

    Args:
        series: shape (n,).
        variance: of the noise around the levels.
        penalty: fall of the sum of squares, in units of the variance, that a cut must bring; by default
            ``4 log n + 6``, at which a series without changes is cut about once in a thousand times.
        largest: most cuts.
    """
    n = series.size
    if n < 4 or not variance > 0:
        return np.zeros(0, np.int64)
    least = (4.0 * np.log(n) + 6.0 if penalty is None else penalty) * variance
    sums = np.concatenate([[0.0], np.cumsum(series - series.mean())])
    cuts: list[int] = []
    parts = [(0, n)]
    while parts and len(cuts) < largest:
        first, last = parts.pop()
        place, gain = _best_cut(sums, first, last)
        if gain > least:
            cuts.append(place)
            parts += [(first, place), (place, last)]
    return _refined(sums, sorted(cuts), n, least)


def segment_means(series: NDArray[np.float64], cuts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean of each part of the series, shape (cuts + 1,)."""
    edges = np.concatenate([[0], cuts])
    lengths = np.diff(np.concatenate([edges, [series.size]]))
    return np.asarray(np.add.reduceat(series, edges) / lengths)


def _best_cut(sums: NDArray[np.float64], first: int, last: int) -> tuple[int, float]:
    """Return the best place to cut a part in two, and by how much the sum of squares falls."""
    if last - first < 2:
        return first, 0.0
    places: NDArray[Any] = np.arange(first + 1, last)
    left, right = places - first, last - places
    mean_left = (sums[places] - sums[first]) / left
    mean_right = (sums[last] - sums[places]) / right
    gains = left * right / (left + right) * (mean_left - mean_right) ** 2
    best = int(gains.argmax())
    return int(places[best]), float(gains[best])


def _refined(sums: NDArray[np.float64], cuts: list[int], n: int, least: float) -> NDArray[np.int64]:
    """Return the cuts, each at its best place between its neighbours, without those that do not pay."""
    for _ in range(2):
        kept = [0]
        for i in range(len(cuts)):
            upper = cuts[i + 1] if i + 1 < len(cuts) else n
            place, gain = _best_cut(sums, kept[-1], upper)
            if gain > least:
                kept.append(place)
        cuts = kept[1:]
    return np.array(cuts, np.int64)
