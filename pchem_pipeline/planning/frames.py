"""Frames that one sample needs, the precision that frames give, and the best exposure."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.errors.expected_information import expected_information, inverse_information
from pchem_pipeline.planning.point import FloatArray, Point
from pchem_pipeline.planning.targets import TARGET_NAMES, Target


@functools.lru_cache(maxsize=8192)
def _bound(point: Point) -> FloatArray:
    """Return the smallest covariance from one frame, rounding included; do not change it."""
    return inverse_information(
        expected_information(point.quanta_exposure, point.read_noise_e, point.conversion_gain)
    )


def frames_needed(target: Target, point: Point) -> float:
    """Return the number of frames with which one sample reaches a target, by the Cramer-Rao bound.

    Args:
        target: what is wanted.
        point: the pixel.

    Returns:
        Frames, whole; infinite where no number of them reaches it.
    """
    gradient = target.gradient(point)
    variance = float(gradient @ _bound(point) @ gradient)
    if not np.isfinite(variance):
        return float("inf")
    return float(np.ceil(max(variance / target.wanted(point) ** 2, 1.0)))


def precision(point: Point, n_frames: float) -> dict[str, float]:
    """Return the smallest standard deviations from so many frames: relative, that of the bias in e-.

    Args:
        point: the pixel.
        n_frames: frames of one sample.

    Returns:
        By parameter of :data:`~pchem_pipeline.planning.targets.TARGET_NAMES`; NaN where frames do not tell.
    """
    covariance = _bound(point) / n_frames
    found = {}
    for name, units in TARGET_NAMES.items():
        gradient = Target(name, 1.0, units[0]).gradient(point)
        found[name] = float(np.sqrt(gradient @ covariance @ gradient))
    return found


def exposure_grid(low: float, high: float, n: int) -> FloatArray:
    """Return exposures evenly spaced in their logarithm."""
    return np.asarray(np.geomspace(low, high, n))


def best_exposure(targets: Sequence[Target], point: Point, low: float, high: float) -> tuple[float, float]:
    """Return the exposure at which one sample needs the fewest frames for all targets.

    Args:
        targets: what is wanted.
        point: the pixel; its own exposure does not matter.
        low: smallest exposure allowed, e-.
        high: largest exposure allowed, e-.

    Returns:
        H (e-) and frames; the frames are infinite where no exposure reaches the targets.
    """

    def needed(log_exposure: float) -> float:
        there = replace(point, quanta_exposure=float(np.exp(log_exposure)))
        return max(frames_needed(target, there) for target in targets)

    grid = np.log(exposure_grid(low, high, 25))
    values = np.array([needed(x) for x in grid])
    best = int(np.argmin(values))
    if not np.isfinite(values[best]):
        return float("nan"), float("inf")
    ends = grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]
    found = min(grid[best], minimize_scalar(needed, bounds=ends, method="bounded").x, key=needed)
    return float(np.exp(found)), needed(found)


def frames_grid(
    target: Target, exposures: FloatArray, read_noises: FloatArray, conversion_gain: float
) -> FloatArray:
    """Return the frames needed over a grid, shape (read noises, exposures); infinite where none suffice.

    Args:
        target: what is wanted.
        exposures: H, e-.
        read_noises: s_e, e-.
        conversion_gain: g, e-/DN, for targets in DN.
    """
    return np.array(
        [
            [frames_needed(target, Point(float(h), float(s), conversion_gain)) for h in exposures]
            for s in read_noises
        ]
    )


def contour_data(targets: Sequence[Target], conversion_gain: float, *, fine: int = 28) -> dict[str, Any]:
    """Return the frames that one sample needs over exposure and read noise, for a figure.

    Args:
        targets: what is wanted.
        conversion_gain: g, e-/DN, for targets in DN.
        fine: points along each axis.
    """
    exposures, noises = exposure_grid(0.05, 30.0, fine), np.linspace(0.15, 0.9, fine)
    noises = noises[noises >= conversion_gain * np.sqrt(QUANTISATION_VARIANCE)]
    return {
        "exposures": exposures,
        "read_noises": noises,
        "frames": {
            str(target): frames_grid(target, exposures, noises, conversion_gain) for target in targets
        },
    }
