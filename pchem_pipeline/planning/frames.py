"""Frames that one sample needs, the precision that frames give, and the best exposure."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.errors.expected_information import expected_information, inverse_information
from pchem_pipeline.planning.targets import TARGET_NAMES, Point, Target


@functools.lru_cache(maxsize=8192)
def _bound(point: Point) -> FloatArray:
    """Return the smallest covariance from one frame, rounding included; do not change it."""
    return inverse_information(
        expected_information(point.quanta_exposure, point.read_noise_e, point.conversion_gain)
    )


def frames_needed(target: Target, point: Point) -> float:
    """Return the number of frames with which one sample reaches a target, by the Cramer-Rao bound, or inf."""
    gradient = target.gradient(point)
    variance = float(gradient @ _bound(point) @ gradient)
    if not np.isfinite(variance):
        return float("inf")
    return float(np.ceil(max(variance / target.wanted(point) ** 2, 1.0)))


def precision(point: Point, n_frames: float) -> dict[str, float]:
    """Return the smallest standard deviation of each of `TARGET_NAMES` from so many frames of one sample.

    They are relative, of the bias in e-; NaN if undetermined.
    """
    covariance = _bound(point) / n_frames
    gradients = {name: Target(name, 1.0, units[0]).gradient(point) for name, units in TARGET_NAMES.items()}
    return {name: float(np.sqrt(each @ covariance @ each)) for name, each in gradients.items()}


def best_exposure(targets: Sequence[Target], point: Point, low: float, high: float) -> tuple[float, float]:
    """Return the exposure from ``low`` to ``high`` (e-) with the fewest frames for all targets, and these.

    They are infinite where no exposure reaches the targets; that of the point does not matter.
    """
    from scipy.optimize import minimize_scalar  # takes a fifth of a second, and reports import this

    def needed(log_exposure: float) -> float:
        exposed = replace(point, quanta_exposure=float(np.exp(log_exposure)))
        return max(frames_needed(target, exposed) for target in targets)

    grid = np.log(np.geomspace(low, high, 25))
    values = np.array([needed(x) for x in grid])
    best = int(np.argmin(values))
    if not np.isfinite(values[best]):
        return float("nan"), float("inf")
    ends = grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]
    found = min(grid[best], minimize_scalar(needed, bounds=ends, method="bounded").x, key=needed)
    return float(np.exp(found)), needed(found)
