"""PCH-EM in the plain form of the paper: one start, EM steps, a stop on small changes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.methods.base import Estimates, Method, PixelSamples, Sample
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.model.fit.starts import starting_points
from pchem_pipeline.model.law.pcd import pcd_posterior


class PlainEm(Method):
    """EM alone, eqs. (update_eqns) to (gamma_nk) of Hendrickson et al. 2023.

    One starting point in closed form; it stops when no parameter changes relatively by more than a tolerance
    from one step to the next, or after a number of steps. EM slows down with the read noise (its error falls
    by a factor near 1 per step above 0.4 e-), so there it stops early, still near its start; and it never
    leaves a local maximum that is off by one electron.
    """

    name = "plain_em"
    title = "PCH-EM, plain EM of the paper"
    source = "Hendrickson et al. 2023, eqs. (update_eqns) to (gamma_nk)"
    needs = "one sample"
    remark = "does not converge above about 0.4 e- read noise"
    order = 11

    def estimate(self, pixels: PixelSamples, settings: MethodsSettings) -> Estimates:
        """Return where EM stops, in the first sample."""
        sample = pixels.samples[0]
        start = closed_form_start(sample)
        parameters, steps = run_em(sample, start, False, settings)
        reasons = {
            "no starting point": ~np.isfinite(start[:, 1]),
            "EM left the allowed range": steps < 0,
            "stopped at the largest number of steps": steps == settings.em_iterations,
        }
        return Estimates.where(parameters, reasons)


def closed_form_start(sample: Sample) -> FloatArray:
    """Return the likeliest closed-form start of each pixel, (H, g, mu, sigma), shape (n, 4), or NaN."""
    return sample.likeliest(starting_points(sample.counts, sample.origin))


def run_em(
    sample: Sample, start: FloatArray, only_light: bool, settings: MethodsSettings
) -> tuple[FloatArray, IntArray]:
    """Run EM from (H, g, mu, sigma), shape (n, 4), NaN where there is no start.

    ``only_light``: bias and read noise are known, H and g are looked for.

    Returns:
        (H, g, mu, sigma), NaN without a result, and the steps taken (negative: out of range; 0: no start).
    """
    theta, steps = np.full(start.shape, np.nan), np.zeros(start.shape[0], np.int64)
    total = sample.counts.sum(axis=1)
    usable = np.isfinite(start).all(axis=1) & (start[:, [0, 1, 3]] > 0).all(axis=1)
    going = np.flatnonzero(usable & (total > 0))
    theta[going] = start[going]
    pixel, place = np.nonzero(sample.counts[going])
    share = sample.counts[going][pixel, place] / total[going][pixel]
    x = np.asarray(sample.origin[going][pixel] + place, np.float64)
    for step in range(1, settings.em_iterations + 1):
        if going.size == 0:
            break
        before = theta[going]
        after = _em_step(pixel, x, share, before, only_light)
        inside = (after[:, [1, 3]] > 0).all(axis=1) & (after[:, 0] > 1e-9) & (after[:, 0] < 1e6)
        inside &= after[:, 1] > 1e-6
        unit = np.stack([before[:, 0], after[:, 1], after[:, 3], before[:, 3]], axis=1)
        change = np.abs((after - before) / unit).max(axis=1)
        theta[going] = np.where(inside[:, None], after, np.nan)
        steps[going] = np.where(inside, step, -step)
        left = inside & (change >= settings.em_tolerance)
        kept, number = left[pixel], np.cumsum(left) - 1
        pixel, x, share, going = number[pixel[kept]], x[kept], share[kept], going[left]
    return theta, steps


def _em_step(
    pixel: NDArray[np.intp], x: FloatArray, share: FloatArray, theta: FloatArray, only_light: bool
) -> FloatArray:
    """Return (H, g, mu, sigma) after one EM step, eqs. (update_eqns); NaN where it is not defined.

    Each occupied code x, DN, has a share of the samples of its pixel.
    """

    def mean_of(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(pixel, share * values, len(theta)), np.float64)

    given = pcd_posterior(x, *theta[pixel].T)  # eq. (gamma_nk)
    mean = mean_of(x)
    off = x - mean[pixel]
    a, b, c = mean_of(given.k), mean_of(given.kk), mean_of(given.k * off)
    bias, sigma = theta[:, 2], theta[:, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        if only_light:
            step = (c + (mean - bias) * a) / b
        else:
            step = c / (b - a * a)
            bias = mean - a * step
            sigma = np.sqrt(mean_of(off**2) - (b - a * a) * step * step)
        return np.stack([a, 1.0 / step, bias, sigma], axis=1)
