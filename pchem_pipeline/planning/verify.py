"""Check a plan by Monte Carlo: simulate pixels with so many frames, fit them, and look at their errors."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pchem_pipeline.model.arithmetic.robust import robust_sd
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.status import FAILED, flags_of
from pchem_pipeline.model.law.drawn_histograms import draw_histograms
from pchem_pipeline.planning.point import FloatArray, Point
from pchem_pipeline.planning.targets import Target


@dataclass(frozen=True)
class Check:
    """One target after the simulation; numbers are relative, of the bias in e-.

    Attributes:
        target: what was wanted.
        wanted: standard deviation wanted.
        rmse: root mean square error of the fitted pixels.
        rmse_stderr: its standard error.
        robust_sd: 1.4826 times the median absolute error; a few pixels far off do not move it.
    """

    target: Target
    wanted: float
    rmse: float
    rmse_stderr: float
    robust_sd: float

    @property
    def reached(self) -> bool:
        """Whether the error is what was wanted, within two standard errors of the simulation."""
        return self.rmse <= self.wanted + 2 * self.rmse_stderr


@dataclass(frozen=True)
class Verification:
    """Outcome of a simulation.

    Attributes:
        n_frames: frames of each pixel.
        n_pixels: simulated pixels.
        n_failed: of them without a value.
        n_flagged: of them flagged in what was wanted.
        checks: one a target.
    """

    n_frames: int
    n_pixels: int
    n_failed: int
    n_flagged: int
    checks: tuple[Check, ...]


def verify(targets: Sequence[Target], point: Point, n_frames: int, n_pixels: int, seed: int) -> Verification:
    """Simulate pixels under one exposure, that of the point, and fit them; see :func:`verify_samples`."""
    return verify_samples(targets, point, [point.quanta_exposure], [n_frames], n_pixels, seed)


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


def verify_samples(
    targets: Sequence[Target],
    point: Point,
    exposures: Sequence[float],
    frames: Sequence[int],
    n_pixels: int,
    seed: int,
) -> Verification:
    """Simulate pixels that differ in where their bias lies between two DN, and fit all samples jointly.

    Args:
        targets: what was wanted.
        point: the pixel; of several exposures its own does not matter.
        exposures: H of the samples, e-; 0 for bias frames.
        frames: of each sample, above 0.
        n_pixels: pixels to simulate.
        seed: of the random numbers.
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
    bits = functools.reduce(operator.or_, (int(flags_of(target.name)) for target in targets))
    words = fit.fit_status
    return Verification(
        sum(frames),
        n_pixels,
        int(np.count_nonzero(words & int(FAILED))),
        int(np.count_nonzero(words & bits)),
        tuple(_check(target, point, errors) for target in targets),
    )
