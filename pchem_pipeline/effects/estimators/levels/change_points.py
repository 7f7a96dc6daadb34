"""Sudden changes of level in several noisy series that share a common mode.

Each series is piecewise constant in white noise; whatever is added to all of them alike (drift, noise of the
whole frame) is projected out. Cuts are added one at a time, that which lowers the sum of squares the most
(binary segmentation: Scott and Knott 1974; Fryzlewicz 2014), with all levels fitted anew after each, so that
a jump in one series is not taken for jumps in the others. At the end each cut is moved to its best place
between its neighbours and dropped if it no longer pays.

Contrasts do not tell a jump of one series from the opposite jump of all the others. So the levels are those
of the series themselves: wherever one was cut all may jump, beside a smooth common mode, and what is no jump
against its error is taken out again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pchem_pipeline.effects.types import FloatArray, IntArray
from pchem_pipeline.model.arithmetic.significance import CERTAIN

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


def noise_variance(series: FloatArray) -> float:
    """Return the variance of the white part: half the mean squared difference of successive values.

    Sudden steps are so few that leaving out the largest twentieth of the differences takes care of them
    (the rest of a Gaussian's squares is 0.774 of its mean square).
    """
    squares = np.sort(np.diff(series) ** 2)
    kept = squares[: max(int(0.95 * squares.size), 1)]
    return float(kept.mean() / 2.0 / 0.774)


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
    contrast = series - series.mean(axis=1, keepdims=True)
    contrast = contrast - contrast.mean(axis=0)
    variance = float(np.mean([noise_variance(one) for one in contrast.T])) if n > 3 else 0.0
    starts = [[0] for _ in range(m)]
    if n < 4 or not variance > 0:
        return [Steps(np.zeros(1, np.int64), np.zeros(1)) for _ in range(m)]
    bonus = 2.0 * variance * np.log(np.ones(n) if gaps is None else np.maximum(gaps, 1.0))
    least = (4.0 * np.log(n * m) + 6.0) * variance
    for _ in range(largest):
        rest = contrast - _fitted(contrast, starts)[1]
        found = max(
            (*_best_cut(rest[:, q], first, last, bonus), q)
            for q in range(m)
            for first, last in zip(starts[q], [*starts[q][1:], n], strict=True)
        )
        if found[0] <= least:
            break
        starts[found[2]] = sorted([*starts[found[2]], found[1]])
    for _ in range(2):
        _refine(contrast, starts, bonus, least)
    if sum(len(s) for s in starts) == m:
        return [Steps(np.zeros(1, np.int64), np.zeros(1)) for _ in range(m)]
    # where the common mode may wander, only its edge tells a step of one series: no more freedom than seen
    own = variance * m / (m - 1.0)
    _, starts, levels = min(
        (_with_common(series, starts, own, waves) for waves in _WAVES), key=lambda one: one[0]
    )
    return [
        Steps(np.array(begins, np.int64), centred(level, begins, n))
        for level, begins in zip(levels, starts, strict=True)
    ]


def _with_common(
    series: FloatArray, starts: list[list[int]], variance: float, n_waves: int
) -> tuple[float, list[list[int]], list[FloatArray]]:
    """Return which series jump at the cuts, and the levels of all, the common mode included.

    Least squares in which the common mode counts less, by as much as it is noisier than a mean of ``m`` white
    series, and may wander smoothly (some cosines). First comes what is left, with Schwarz's price of each
    number.
    """
    n, m = series.shape
    noise = noise_variance(series.mean(axis=1))
    weight = min(1.0, float(np.sqrt(variance / m / noise))) if noise > 0 else 1.0
    metric = np.eye(m) - (1.0 - weight) / m
    waves = np.cos(np.pi * np.outer(np.arange(n) + 0.5, np.arange(1, n_waves + 1)) / n)
    common = np.concatenate([waves[:, None, :] * row.sum() for row in metric], axis=1).reshape(n * m, n_waves)
    cuts = _together(sorted({cut for begins in starts for cut in begins[1:]}))
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


def _together(cuts: list[int]) -> list[int]:
    """Return the cuts with one in place of those that are next to each other."""
    groups: list[list[int]] = []
    for cut in cuts:
        if groups and cut - groups[-1][-1] <= 1:
            groups[-1].append(cut)
        else:
            groups.append([cut])
    return [group[len(group) // 2] for group in groups]


def _indicators(begins: list[int], n: int, row: FloatArray) -> FloatArray:
    """Return the columns of a design that one series' levels have, (n * m, levels)."""
    inside = np.repeat(np.eye(len(begins)), np.diff([*begins, n]), axis=0)
    return (inside[:, None, :] * row[:, None]).reshape(n * row.size, len(begins))


def centred(levels: FloatArray, starts: list[int], n: int) -> FloatArray:
    """Return levels less their mean over n values, each from its start on."""
    lengths = np.diff([*starts, n])
    return np.asarray(levels - (levels * lengths).sum() / n)


def _fitted(contrast: FloatArray, starts: list[list[int]]) -> tuple[list[FloatArray], FloatArray]:
    """Return the least-squares levels of all series, and their contrast at each time, (n, m).

    Normal equations of the contrasts: the length of a segment on the diagonal, less its overlap in time with
    every other over m.
    """
    n, m = contrast.shape
    owner = np.repeat(np.arange(m), [len(s) for s in starts])
    first = np.concatenate([np.array(s) for s in starts])
    last = np.concatenate([np.array([*s[1:], n]) for s in starts])
    overlap = np.minimum(last[:, None], last) - np.maximum(first[:, None], first)
    system = np.diag((last - first).astype(np.float64)) - overlap.clip(0) / m
    sums = np.concatenate([np.zeros((1, m)), np.cumsum(contrast, axis=0)])
    levels = np.linalg.lstsq(system, sums[last, owner] - sums[first, owner], rcond=1e-10)[0]
    found = [levels[owner == q] for q in range(m)]
    profile = np.stack([np.repeat(v, np.diff([*s, n])) for v, s in zip(found, starts, strict=True)], axis=1)
    return found, profile - profile.mean(axis=1, keepdims=True)


def _best_cut(series: FloatArray, first: int, last: int, bonus: FloatArray) -> tuple[float, int]:
    """Return by how much the best cut of a part lowers the sum of squares, and its place."""
    n = last - first
    if n < 2:
        return 0.0, first
    left = np.arange(1, n)
    sums = np.cumsum(series[first:last])
    mean = sums[-1] / n
    gains = (sums[:-1] - left * mean) ** 2 * n / (left * (n - left)) + bonus[first + 1 : last]
    best = int(gains.argmax())
    return float(gains[best]), first + 1 + best


def _refine(contrast: FloatArray, starts: list[list[int]], bonus: FloatArray, least: float) -> None:
    """Move each cut to its best place between its neighbours; take out those that do not pay."""
    n, m = contrast.shape
    for q in range(m):
        for begin in starts[q][1:]:
            levels, profile = _fitted(contrast, starts)
            i = starts[q].index(begin)
            first, last = starts[q][i - 1], [*starts[q], n][i + 1]
            part = contrast[:, q] - profile[:, q]
            # the cut's own step comes back: a step in one of m series is this large in their contrast
            part[begin:last] += (levels[q][i] - levels[q][i - 1]) * (1.0 - 1.0 / m)
            gain, place = _best_cut(part, first, last, bonus)
            starts[q] = starts[q][:i] + ([place] if gain > least else []) + starts[q][i + 1 :]
