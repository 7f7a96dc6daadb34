"""Time profiles of a slow change along the run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from pchem_pipeline.effects.types import FloatArray

#: Time constants, lengths of the run: shorter ones are hardly a drift, longer ones are straight lines.
SETTLING = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
#: Nodes of a path that is fitted: each twice as fine as the one before.
NODES = (3, 5, 9, 17, 33)


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


def settling_time(left: Callable[[float], float]) -> float:
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


def profile_at(position: FloatArray, settling_fraction: float | None, path: Sequence[float]) -> FloatArray:
    """Return the profile of a slow change at times 0..1 of the run, of mean 0.

    Args:
        position: times from 0 (first frame) to 1 (last frame).
        settling_fraction: time constant of an exponential approach, lengths of the run; None: no such.
        path: nodes of a broken line; empty: a straight one from -1/2 to 1/2, unless it is an approach.
    """
    if settling_fraction is not None:
        return settling(position, settling_fraction)
    return along_path(position, path or (-0.5, 0.5))


def hats(position: FloatArray, nodes: int) -> FloatArray:
    """Return weights (positions, nodes) of linear interpolation between nodes at equal distances in 0..1."""
    knots = np.linspace(0.0, 1.0, nodes)
    return np.asarray(np.clip(1.0 - np.abs(position[:, None] - knots) * (nodes - 1), 0.0, None))


class Fit(NamedTuple):
    """A weighted least-squares fit: chi squared, and the coefficients, shape (k,)."""

    chi2: float
    values: FloatArray

    def price(self, n: int) -> float:
        """Return what its coefficients must bring by the Bayesian information criterion of n values."""
        return float(self.values.size * np.log(n))


def fitted(series: FloatArray, basis: FloatArray, error: FloatArray | None = None) -> Fit:
    """Fit a series (n,) with standard errors (n,), or with unknown ones that are alike, by a basis (n, k)."""
    error = np.ones(series.size) if error is None else error
    values = np.linalg.lstsq(basis / error[:, None], series / error, rcond=1e-6)[0]
    return Fit(float((((series - basis @ values) / error) ** 2).sum()), np.asarray(values, np.float64))


def fitted_profile(series: FloatArray, profile: FloatArray, error: FloatArray | None = None) -> Fit:
    """Fit a mean and a multiple of a time profile."""
    return fitted(series, np.stack([np.ones_like(profile), profile], axis=1), error)


def check_path(tag: str, shape: str, path: Sequence[float]) -> None:
    """Raise ValueError unless an effect has a path where, and only where, its shape is one."""
    if shape == "path" and len(path) < 2:
        raise ValueError(f"{tag}: shape path needs `path` with 2 values or more")
    if shape != "path" and path:
        raise ValueError(f"{tag}: `path` is for shape path, not {shape}; leave one of them out")
