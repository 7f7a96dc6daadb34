"""Frames by Monte Carlo: simulate pixels, fit them, and look at their errors and flags.

The Cramer-Rao bound sees the peak of the likelihood alone. Where peaks of the histogram are weak, or few DN
are an electron, other electron numbers or gains may be nearly as likely, and such pixels are flagged.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.arithmetic.statistics import robust_sd
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.status import FAILED, FLAGGED, flags_of
from pchem_pipeline.model.law.mass import draw_histograms
from pchem_pipeline.planning.targets import Point, Target

_PIXELS = 200  # simulated for a number of frames; 5 % of them have a standard error of 1.5 %
_FLAGGED = 0.05  # largest share of pixels without a value or flagged
_STEP = 1.1  # of the frames, within which their number is found


@dataclass(frozen=True)
class Check:
    """One target after the simulation; numbers are relative, of the bias in e-."""

    target: Target
    wanted: float  # standard deviation wanted
    rmse: float  # root mean square error of the pixels that are not flagged
    rmse_stderr: float
    robust_sd: float  # 1.4826 times the median absolute error; a few pixels far off do not move it

    @property
    def reached(self) -> bool:
        """Whether the error is what was wanted, within two standard errors of the simulation."""
        return self.rmse <= self.wanted + 2 * self.rmse_stderr


@dataclass(frozen=True)
class Verification:
    """Outcome of a simulation: pixels, those without a value, those flagged in what was wanted, targets."""

    n_pixels: int
    n_failed: int
    n_flagged: int
    checks: tuple[Check, ...]

    @property
    def reached(self) -> bool:
        """Whether all targets are reached, and at most 5 % of the pixels are flagged or without a value."""
        few = self.n_failed + self.n_flagged <= _FLAGGED * self.n_pixels
        return few and all(check.reached for check in self.checks)


def frames_simulated(
    targets: Sequence[Target],
    point: Point,
    exposures: Sequence[float],
    shares: Sequence[float],
    bound: float,
    most: float,
    *,
    every_flag: bool = False,
) -> float:
    """Compute the frames in total with which simulated pixels reach the targets, to 10 %, by bisection.

    The samples have H, e-, 0 for bias frames (that of the point does not matter), and shares of the frames
    that add up to 1. Fewer frames than the Cramer-Rao bound are not tried; infinite where the most are too
    few. ``every_flag``: flags count that do not concern what is wanted, too.
    """

    def reached(frames: float) -> bool:
        numbers = [max(int(np.ceil(frames * share)), 2) for share in shares]
        return verify(targets, point, exposures, numbers, _PIXELS, 1, every_flag=every_flag).reached

    if bound > most or not reached(most):
        return float("inf")
    if reached(bound):
        return bound
    low, high = bound, most
    while high > _STEP * low:
        middle = float(np.ceil(np.sqrt(low * high)))
        low, high = (low, middle) if reached(middle) else (middle, high)
    return high


def _check(target: Target, point: Point, errors: FloatArray) -> Check:
    gradient = target.gradient(point)
    gradient[0] *= point.quanta_exposure
    values = errors @ gradient
    values = values[np.isfinite(values)]
    if values.size < 2:
        return Check(target, target.wanted(point), float("nan"), float("nan"), float("nan"))
    square = values**2
    root = float(np.sqrt(square.mean()))
    spread = float(square.std(ddof=1) / np.sqrt(square.size))
    robust = robust_sd(values, 0.0)
    return Check(target, target.wanted(point), root, spread / (2 * root), robust)


def verify(
    targets: Sequence[Target],
    point: Point,
    exposures: Sequence[float],
    frames: Sequence[int],
    n_pixels: int,
    seed: int,
    *,
    every_flag: bool = False,
) -> Verification:
    """Simulate pixels whose biases differ by fractions of a DN, and fit all samples jointly.

    Arguments are as in `frames_simulated`, with the frames of each sample, above 0.
    """
    rng = np.random.default_rng(seed)
    bias = 100.0 + rng.random(n_pixels)
    drawn = [
        draw_histograms(rng, h, point.conversion_gain, bias, point.read_noise_e, n)
        for h, n in zip(exposures, frames, strict=True)
    ]
    fit = fit_histograms(
        [d.counts for d in drawn], [d.origin for d in drawn], dark=[h == 0 for h in exposures]
    )
    brightest = int(np.argmax(exposures))
    found = np.stack(
        [fit.quanta_exposure[:, brightest], fit.conversion_gain, fit.bias, fit.read_noise_dn], axis=1
    )
    truth = drawn[brightest].truth
    errors = found / truth - 1  # relative; of mu in e-
    errors[:, 2] = (found[:, 2] - truth[:, 2]) * truth[:, 1]
    flags = functools.reduce(operator.or_, (flags_of(target.name) for target in targets))
    failed = (fit.fit_status & int(FAILED)) != 0
    flagged = ~failed & ((fit.fit_status & int(FLAGGED if every_flag else flags)) != 0)
    good = errors[~failed & ~flagged]
    return Verification(
        n_pixels,
        int(np.count_nonzero(failed)),
        int(np.count_nonzero(flagged)),
        tuple(_check(target, point, good) for target in targets),
    )
