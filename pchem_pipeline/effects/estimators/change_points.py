"""Sudden changes of level in several noisy series that share a common mode.

Each series is piecewise constant in white noise; whatever is added to all of them alike (drift, noise of the
whole frame) is projected out. The levels of all series are cut at one time after the other, that which lowers
the sum of squares the most (binary segmentation: Scott and Knott 1974; Fryzlewicz 2014); at the end each cut
is moved to its best place between its neighbours and dropped if it no longer pays.

Contrasts do not tell a jump of one series from the opposite jump of all the others. So the levels are those
of the series themselves: at every cut all may jump, beside a smooth common mode, and what is no jump against
its error is taken out again.
"""

from __future__ import annotations

import bisect
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np

from pchem_pipeline.effects.types import FloatArray, IntArray
from pchem_pipeline.model.arithmetic.significance import CERTAIN

Layout = TypeVar("Layout", bound=str)

# cosines of the common mode, where it wanders
_WAVES = (0, 12)


@dataclass(frozen=True)
class Steps:
    """Levels of one series.

    Attributes:
        starts: where each level begins, the first at 0, shape (s,).
        levels: shape (s,), with mean 0 over the series.
    """

    starts: IntArray
    levels: FloatArray


def likeliest_parts(
    series: FloatArray, gaps: FloatArray, layouts: Mapping[Layout, FloatArray]
) -> tuple[Layout, list[Steps]]:
    """Return which groups of series jump together, and the jumps of each.

    By the squares of what is left in all series, and Schwarz's price for each level and jump.

    Args:
        series: shape (n, m).
        gaps: time between each value and the one before, in units of the shortest, shape (n,).
        layouts: weights of the series in the mean of each group, shape (p, m), p of 2 or more.
    """
    n, own = len(series), _own_variance(series)
    found: list[tuple[float, Layout, list[Steps]]] = []
    for layout, weights in layouts.items():
        steps = find_steps(series @ weights.T, gaps)
        rest = series - np.stack([_profile(each, n) for each in steps], axis=1) @ (weights > 0)
        rest -= rest.mean(axis=1, keepdims=True) + rest.mean(axis=0)
        levels = sum(each.levels.size for each in steps)
        price = np.log(n) * (3 * levels - 2 * len(steps))
        squares = float((rest**2).sum() / own) if own > 0 else 0.0
        found.append((squares + float(price), layout, steps))
    _, layout, steps = min(found, key=lambda each: each[0])
    return layout, steps


def find_steps(series: FloatArray, gaps: FloatArray | None = None, *, largest: int = 100) -> list[Steps]:
    """Return the levels of each series and where they begin.

    A cut must lower the sum of squares by ``4 log(n m) + 6`` times the variance of the noise (twice what the
    Bayesian information criterion asks for: series without steps are cut about once in a thousand times).

    Args:
        series: shape (n, m), m of 2 or more.
        gaps: time between each value and the one before, in units of the shortest, shape (n,): a change
            during a long gap is so much likelier than one between two neighbours. All alike if None.
        largest: most cuts.
    """
    n, m = series.shape
    variance = _own_variance(series)
    if n < 4 or not variance > 0:
        return [Steps(np.zeros(1, np.int64), np.zeros(1)) for _ in range(m)]
    contrast = (series - series.mean(axis=1, keepdims=True)) / np.sqrt(variance)
    bonus = 2.0 * np.log(np.ones(n) if gaps is None else np.maximum(gaps, 1.0))
    least = 4.0 * np.log(n * m) + 6.0
    cuts = [0, n]
    while len(cuts) < largest + 2:
        gain, cut = max(_best_cut(contrast, first, last, bonus) for first, last in pairwise(cuts))
        if gain <= least:
            break
        bisect.insort(cuts, cut)
    for cut in cuts[1:-1]:
        i = cuts.index(cut)
        gain, place = _best_cut(contrast, cuts[i - 1], cuts[i + 1], bonus)
        cuts[i : i + 1] = [place] if gain > least else []
    # where the common mode may wander, only its edge tells a step of one series: no more freedom than seen
    _, starts, levels = min(
        (_with_common(series, cuts[1:-1], variance, waves) for waves in _WAVES), key=lambda one: one[0]
    )
    return [
        Steps(np.array(begins, np.int64), _centred(level, begins, n))
        for level, begins in zip(levels, starts, strict=True)
    ]


def _own_variance(series: FloatArray) -> float:
    """Return the variance of the white noise of each series by itself."""
    n, m = series.shape
    contrast = series - series.mean(axis=1, keepdims=True)
    return float(np.mean([_noise_variance(one) for one in contrast.T])) * m / (m - 1.0) if n > 3 else 0.0


def _noise_variance(series: FloatArray) -> float:
    """Return the variance of the white part: half the mean squared difference of successive values.

    Sudden steps are so few that leaving out the largest twentieth of the differences takes care of them
    (the rest of a Gaussian's squares is 0.774 of its mean square).
    """
    squares = np.sort(np.diff(series) ** 2)
    kept = squares[: max(int(0.95 * squares.size), 1)]
    return float(kept.mean() / 2.0 / 0.774)


def _profile(steps: Steps, n: int) -> FloatArray:
    return np.repeat(steps.levels, np.diff([*steps.starts, n]))


def _with_common(
    series: FloatArray, cuts: list[int], variance: float, n_waves: int
) -> tuple[float, list[list[int]], list[FloatArray]]:
    """Return which series jump at the cuts, and the levels of all, the common mode included.

    Least squares in which the common mode counts less, by as much as it is noisier than a mean of ``m`` white
    series, and may wander smoothly (some cosines). First comes what is left, with Schwarz's price of each
    number.
    """
    n, m = series.shape
    noise = _noise_variance(series.mean(axis=1))
    weight = min(1.0, float(np.sqrt(variance / m / noise))) if noise > 0 else 1.0
    metric = np.eye(m) - (1.0 - weight) / m
    waves = np.cos(np.pi * np.outer(np.arange(n) + 0.5, np.arange(1, n_waves + 1)) / n)
    common = np.concatenate([waves[:, None, :] * row.sum() for row in metric], axis=1).reshape(n * m, n_waves)
    starts = [[0, *cuts] for _ in range(m)]
    while True:
        segments = np.concatenate(
            [_indicators(begins, n, metric[:, q]) for q, begins in enumerate(starts)], axis=1
        )
        design = np.concatenate([segments, common], axis=1)
        inverse = np.linalg.pinv(design.T @ design, rcond=1e-10, hermitian=True)
        wanted = (series @ metric).ravel()
        found = inverse @ (design.T @ wanted)
        owner = np.repeat(np.arange(m), [len(begins) for begins in starts])
        levels = [found[: owner.size][owner == q] for q in range(m)]
        weakest: dict[int, tuple[float, int]] = {}
        place = 0
        for q, (begins, level) in enumerate(zip(starts, levels, strict=True)):
            here = np.arange(place, place + len(begins))
            place += len(begins)
            spread = np.diag(inverse)[here]
            errors = variance * (spread[1:] + spread[:-1] - 2.0 * inverse[here[1:], here[:-1]])
            squares = np.diff(level) ** 2 / np.maximum(errors, np.finfo(np.float64).tiny)
            for cut, square in zip(begins[1:], squares, strict=True):
                weakest[cut] = min(weakest.get(cut, (np.inf, q)), (float(square), q))
        # one series a cut: the others' jumps are the surer without it
        dropped = {(cut, q) for cut, (square, q) in weakest.items() if square < CERTAIN**2}
        if not dropped:
            left = float(((wanted - design @ found) ** 2).sum()) / variance
            return left + float(np.log(n)) * found.size, starts, levels
        starts = [[cut for cut in begins if (cut, q) not in dropped] for q, begins in enumerate(starts)]


def _indicators(begins: list[int], n: int, row: FloatArray) -> FloatArray:
    """Return the columns of a design that one series' levels have, (n * m, levels)."""
    inside = np.repeat(np.eye(len(begins)), np.diff([*begins, n]), axis=0)
    return (inside[:, None, :] * row[:, None]).reshape(n * row.size, len(begins))


def _centred(levels: FloatArray, starts: list[int], n: int) -> FloatArray:
    """Return levels less their mean over n values, each from its start on."""
    lengths = np.diff([*starts, n])
    return np.asarray(levels - (levels * lengths).sum() / n)


def _best_cut(series: FloatArray, first: int, last: int, bonus: FloatArray) -> tuple[float, int]:
    """Return by how much the best cut of a part of all series lowers the sum of squares, and its place."""
    n = last - first
    if n < 2:
        return 0.0, first
    left = np.arange(1, n)
    sums = np.cumsum(series[first:last], axis=0)
    squares = ((sums[:-1] - left[:, None] * sums[-1] / n) ** 2).sum(axis=1)
    gains = squares * n / (left * (n - left)) + bonus[first + 1 : last]
    best = int(gains.argmax())
    return float(gains[best]), first + 1 + best
