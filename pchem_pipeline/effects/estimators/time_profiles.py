"""Time profiles of a slow change along the run, and which of them a series follows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from pchem_pipeline.effects.types import FloatArray

#: Time constants, lengths of the run: shorter ones are hardly a drift, longer ones are straight lines.
SETTLING = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
# nodes of a path that is fitted, each twice as fine as the one before, and values that come on each at least
_NODES, _PER_NODE = (3, 5, 9, 17, 33), 3
_STIFF = 1e-3  # relative: nodes without values follow their neighbours
_FAR_BELOW = 25.0  # of the criterion, below the best: not to be considered


class TimeProfile(NamedTuple):
    """A time profile that a series may follow.

    Attributes:
        shape: straight line, exponential approach to the end, or broken line.
        size: value at the end less that at the start; of a broken line its range.
        criterion: deviance with the price of the coefficients (Bayesian information criterion).
        gain: by how much the deviance is below that of a constant.
        path: nodes of a broken line at equal distances along the run, in units of the size.
        settling_fraction: time constant of an approach, lengths of the run.
    """

    shape: Literal["linear", "settling", "path"]
    size: float
    criterion: float
    gain: float
    path: tuple[float, ...] = ()
    settling_fraction: float = 0.2

    def exceeds_chance(self) -> bool:
        """Return whether it lowers the deviance by more than chance does, by three standard deviations."""
        free = {"linear": 1, "settling": 2, "path": len(self.path) - 1}[self.shape]
        return self.gain > free + 3.0 * float(np.sqrt(2.0 * free))


def settling(position: FloatArray, fraction: float) -> FloatArray:
    """Return an exponential approach to the end, of mean 0 and range 1 over the run.

    Args:
        position: times from 0 (first frame) to 1 (last frame).
        fraction: time constant in lengths of the run.
    """
    whole = -np.expm1(-1.0 / fraction)
    mean = (1.0 - fraction * whole) / whole
    profile: FloatArray = -np.expm1(-position / fraction) / whole - mean
    return profile


def along_path(position: FloatArray, path: Sequence[float]) -> FloatArray:
    """Return a broken line through nodes at equal distances along the run, of mean 0 over the run.

    Args:
        position: times from 0 (first frame) to 1 (last frame).
        path: the nodes, at least two.
    """
    nodes = np.array(path)
    # the mean of a broken line counts its ends by half
    mean = (nodes.sum() - (nodes[0] + nodes[-1]) / 2.0) / (nodes.size - 1)
    return np.asarray(np.interp(position, np.linspace(0.0, 1.0, nodes.size), nodes) - mean)


def hats(position: FloatArray, nodes: int) -> FloatArray:
    """Return weights (positions, nodes) of linear interpolation between nodes at equal distances in 0..1."""
    knots = np.linspace(0.0, 1.0, nodes)
    return np.asarray(np.clip(1.0 - np.abs(position[:, None] - knots) * (nodes - 1), 0.0, None))


def likely_profiles(series: FloatArray, position: FloatArray) -> list[TimeProfile]:
    """Return the time profiles that a series may follow, the likeliest first; none if it may be constant.

    Of the best line, exponential approach and broken line those that explain more than chance and, with more
    freedom than the line, more than it by the Bayesian information criterion.

    Args:
        series: with white noise, shape (n,).
        position: times from 0 (first frame of the run) to 1 (last frame), shape (n,).
    """
    line, *curves = _time_profiles(series, position)
    kept = [line, *(curve for curve in curves if curve.criterion < line.criterion)]
    found = sorted((p for p in kept if p.exceeds_chance()), key=lambda p: p.criterion)
    return [profile for profile in found if profile.criterion < found[0].criterion + _FAR_BELOW]


def _time_profiles(series: FloatArray, position: FloatArray) -> tuple[TimeProfile, TimeProfile, TimeProfile]:
    """Return the line, the exponential approach and the broken line that fit a series best."""
    n = series.size

    def fit(basis: FloatArray, stiff: float = 0.0) -> tuple[FloatArray, float]:
        """Return the coefficients of a basis (n, k), and the deviance."""
        k = basis.shape[1]
        rows = stiff * float(np.sqrt(n / k)) * np.diff(np.eye(k), 2, axis=0)
        wanted = np.append(series, np.zeros(len(rows)))
        values = np.linalg.lstsq(np.concatenate([basis, rows]), wanted, rcond=1e-6)[0]
        chi2 = float(((series - basis @ values) ** 2).sum())
        return values, n * float(np.log(max(chi2, 1e-300) / n))

    constant = fit(np.ones((n, 1)))[1]

    def multiple(profile: FloatArray, fraction: float | None = None) -> TimeProfile:
        values, deviance = fit(np.stack([np.ones(n), profile], axis=1))
        size, gain = float(values[1]), constant - deviance
        if fraction is None:
            return TimeProfile("linear", size, deviance + 2.0 * np.log(n), gain)
        return TimeProfile("settling", size, deviance + 3.0 * np.log(n), gain, settling_fraction=fraction)

    def settled(fraction: float) -> TimeProfile:
        return multiple(settling(position, fraction), fraction)

    def path(nodes: int) -> TimeProfile:
        values, deviance = fit(hats(position, nodes), _STIFF)
        size = float(np.ptp(values)) or 1.0
        listed = tuple(np.round(values / size, 6).tolist())
        return TimeProfile("path", size, deviance + nodes * np.log(n), constant - deviance, listed)

    numbers = [nodes for nodes in _NODES if nodes == _NODES[0] or _PER_NODE * nodes <= n]
    return (
        multiple(position - 0.5),
        settled(_settling_time(lambda fraction: settled(fraction).criterion)),
        min(map(path, numbers), key=lambda each: each.criterion),
    )


def _settling_time(left: Callable[[float], float]) -> float:
    """Return the time constant of an exponential approach that leaves least, in lengths of the run.

    Args:
        left: what an approach with a time constant leaves.
    """
    from scipy.optimize import minimize_scalar  # not for every command that knows of effects

    losses = [left(fraction) for fraction in SETTLING]
    best = int(np.argmin(losses))
    ends = SETTLING[max(best - 1, 0)], SETTLING[min(best + 1, len(SETTLING) - 1)]
    options = {"xatol": 0.01}
    found = minimize_scalar(lambda log: left(float(np.exp(log))), bounds=np.log(ends), options=options)
    return float(np.exp(found.x)) if found.fun < losses[best] else SETTLING[best]
