"""Several noisy series that jump between two levels each, at their own times, under a common mode.

A hidden Markov chain (Rabiner 1989, Proc. IEEE 77, 257): what is looked for in one series is told by the
levels at which it sits for the rest of the run, so that short visits and jumps of several series at once are
found where change points alone leave them open. By turns: the likeliest path through the states of all series
together at given levels, and the levels by least squares along it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from pchem_pipeline.effects.estimators.levels.change_points import Steps, centred, find_steps, noise_variance
from pchem_pipeline.effects.types import FloatArray, IntArray

Layout = TypeVar("Layout", bound=str)

_MOST_SERIES = 4  # states grow as powers of two
_ROUNDS = 8
_LARGEST_RATE = 0.25  # jumps per frame


@dataclass(frozen=True)
class _Noise:
    """Variance of each series beside the common mode, and of the mean of all."""

    own: float
    common: float

    def squares(self, rest: FloatArray) -> FloatArray:
        """Return the squares of deviations (..., m) in their errors, (...,)."""
        mean = rest.mean(axis=-1)
        return np.asarray(((rest - mean[..., None]) ** 2).sum(axis=-1) / self.own + mean**2 / self.common)

    def metric(self, m: int) -> FloatArray:
        """Return the inverse covariance of m series, (m, m)."""
        every = np.full((m, m), 1.0 / m)
        return np.asarray((np.eye(m) - every) / self.own + every / m / self.common)


def between_two_levels(series: FloatArray, gaps: FloatArray, steps: Sequence[Steps]) -> list[Steps]:
    """Return the jumps of each series between two levels, or the steps that are known if these fit better.

    By the squares of what is left, and Schwarz's price for each level and jump.

    Args:
        series: shape (n, m).
        gaps: time between each value and the one before, in units of the shortest, shape (n,).
        steps: of each series, as change points tell them.
    """
    n, m = series.shape
    jumps = np.abs(np.concatenate([np.diff(each.levels) for each in steps]))
    if not jumps.size or m > _MOST_SERIES:
        return list(steps)
    series = series - series.mean(axis=0)
    profile = np.stack([_profile(each, n) for each in steps], axis=1)
    contrast = series - series.mean(axis=1, keepdims=True)
    own = float(np.mean([noise_variance(one) for one in contrast.T])) * m / (m - 1.0)
    noise = _Noise(own, max(float((series - profile).mean(axis=1).var()), own / m))
    known = float(noise.squares(series - profile).sum()) + _price(n, jumps.size, jumps.size + m)
    levels, number = _start(profile, float(np.median(jumps))), jumps.size
    for _ in range(_ROUNDS):
        rate = min(max(number, 1) / (m * float(gaps[1:].sum())), _LARGEST_RATE)
        states, path = _likeliest(series, gaps, levels, rate, noise)
        levels = _fitted(series, states[path], levels, noise)
        number = np.count_nonzero(np.diff(states[path], axis=0))
    found = [_steps(states[path, q], levels[q]) for q in range(m)]
    rest = series - np.stack([_profile(each, n) for each in found], axis=1)
    two = float(noise.squares(rest - rest.mean(axis=0)).sum()) + _price(n, number, 2 * m)
    return found if two < known else list(steps)


def likeliest_parts(
    series: FloatArray, gaps: FloatArray, layouts: Mapping[Layout, FloatArray]
) -> tuple[Layout, list[Steps]]:
    """Return which groups of series jump together, and the jumps of each.

    Where series do, each by itself would be found to jump at slightly other times. By the same measure as
    between the two ways to find jumps.

    Args:
        series: shape (n, m).
        gaps: time between each value and the one before, in units of the shortest, shape (n,).
        layouts: weights of the series in the mean of each group, shape (p, m), p of 2 or more: each series by
            itself first.
    """
    n, m = series.shape
    contrast = series - series.mean(axis=1, keepdims=True)
    own = float(np.mean([noise_variance(one) for one in contrast.T])) * m / (m - 1.0)
    found: list[tuple[float, Layout, list[Steps]]] = []
    noise: _Noise | None = None
    for layout, weights in layouts.items():
        means = series @ weights.T
        steps = between_two_levels(means, gaps, find_steps(means, gaps))
        profile = np.stack([_profile(each, n) for each in steps], axis=1) @ (weights > 0)
        rest = series - profile - (series - profile).mean(axis=0)
        noise = noise or _Noise(own, max(float(rest.mean(axis=1).var()), own / m))
        levels = sum(each.levels.size for each in steps)
        price = _price(n, levels - len(steps), levels)
        found.append((float(noise.squares(rest).sum()) + price, layout, steps))
    _, layout, steps = min(found, key=lambda each: each[0])
    return layout, steps


def _price(n: int, jumps: int, levels: int) -> float:
    return float(np.log(n) * (2 * jumps + levels))


def _profile(steps: Steps, n: int) -> FloatArray:
    return np.repeat(steps.levels, np.diff([*steps.starts, n]))


def _steps(states: IntArray, levels: FloatArray) -> Steps:
    starts = np.concatenate([[0], np.flatnonzero(np.diff(states)) + 1])
    return Steps(starts, centred(levels[states[starts]], starts.tolist(), states.size))


def _start(profile: FloatArray, height: float) -> FloatArray:
    """Return two levels of each series, so far apart, between which its profile fits best, (m, 2)."""
    found = []
    for one in profile.T:
        lower = np.unique(one)
        lower = np.concatenate([lower, lower - height])
        apart = np.abs(one[:, None] - lower)
        left = (np.minimum(apart, np.abs(one[:, None] - lower - height)) ** 2).sum(axis=0)
        found.append(lower[left.argmin()] + np.array([0.0, height]))
    return np.array(found)


def _likeliest(
    series: FloatArray, gaps: FloatArray, levels: FloatArray, rate: float, noise: _Noise
) -> tuple[IntArray, IntArray]:
    """Return all states of the series together, (2^m, m), and the likeliest path through them (Viterbi)."""
    m = series.shape[1]
    states = np.array(list(itertools.product((0, 1), repeat=m)), np.int64)
    means = levels[np.arange(m), states]
    emitted = -0.5 * noise.squares(series[:, None, :] - means)
    changes = (states[:, None, :] != states).sum(axis=2)
    moves: dict[float, FloatArray] = {}
    best, back = emitted[0], np.zeros((len(series), len(states)), np.int64)
    for t in range(1, len(series)):
        gap = float(gaps[t])
        if gap not in moves:
            changed = 0.5 * (1.0 - (1.0 - 2.0 * rate) ** max(gap, 1.0))
            moves[gap] = changes * np.log(changed) + (m - changes) * np.log1p(-changed)
        ahead = best[:, None] + moves[gap]
        back[t] = ahead.argmax(axis=0)
        best = ahead.max(axis=0) + emitted[t]
    path = np.empty(len(series), np.int64)
    path[-1] = best.argmax()
    for t in range(len(series) - 1, 0, -1):
        path[t - 1] = back[t, path[t]]
    return states, path


def _fitted(series: FloatArray, states: IntArray, levels: FloatArray, noise: _Noise) -> FloatArray:
    """Return the levels by least squares where the states are known, (m, 2); an unvisited one stays."""
    m = series.shape[1]
    metric = noise.metric(m)
    shown = np.stack([states == level for level in (0, 1)], axis=2).astype(np.float64)  # (n, m, 2)
    system = np.einsum("tqi,qr,trj->qirj", shown, metric, shown, optimize=True).reshape(2 * m, 2 * m)
    wanted = np.einsum("tqi,tq->qi", shown, series @ metric).ravel()
    held = 1e-6 * np.trace(system) / (2 * m)
    found = np.linalg.solve(system + held * np.eye(2 * m), wanted + held * levels.ravel())
    return np.asarray(found.reshape(m, 2))
