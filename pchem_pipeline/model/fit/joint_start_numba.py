"""Starting points of the joint fit: those of each sample, and the line of variance against mean.

The photon-transfer relation ``var_j = sigma^2 + (mean_j - mu) / g`` gives 1/g as a slope whatever the read
noise (two-sample and series photon transfer); without a sample of no electrons the read noise that splits the
intercept is scanned. Where the peaks are resolved, the starts of the single samples are better.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.joint_climb_numba import floor_of
from pchem_pipeline.model.fit.joint_types_numba import (
    CENTRE,
    MEAN,
    N_FRAMES,
    OCCUPIED,
    VARIANCE,
    Samples,
    histogram_of,
)
from pchem_pipeline.model.fit.start_numba import start_cumulants, start_peak, start_regression

_NOISES = (0.15, 0.22, 0.3, 0.38, 0.46, 0.55, 0.65, 0.8, 0.95, 1.15)  # e-
_SCALES = (1.0, 0.85, 1.18, 0.7, 1.4)  # of the slope of the line
N_NOISES = len(_NOISES)
N_LINE = N_NOISES * len(_SCALES)
N_SCAN = 100  # starts of the scan of one coarsely quantised sample
N_SINGLE = 3  # starts of each sample
_SMALLEST_EXPOSURE = 0.02
_SCAN_FIRST, _SCAN_RATIO = 0.62, 1.035  # DN per electron; finer than the width of a maximum in g
_SCAN_NOISES = (0.2, 0.36)  # e-


@kernel
def fill_theta(
    samples: Samples, a: float, bias: float, noise2: float, exact: bool, theta: NDArray[np.float64]
) -> bool:
    """Fill ``theta`` for a step, a bias and a read noise: exposures from the means.

    Args:
        samples: of the pixel.
        a: 1/g, DN.
        bias: mu less the centre, DN.
        noise2: sigma^2, DN^2; negative: what the variances leave.
        exact: bounds of the exact likelihood.
        theta: out.

    Returns:
        Whether that makes sense.
    """
    if not (a > 0.0 and math.isfinite(a) and math.isfinite(bias)):
        return False
    n_samples = samples.dark.size
    n = rest = 0.0
    brightest = 0.0
    for j in range(n_samples):
        facts = samples.facts[j]
        exposure = 0.0
        if not samples.dark[j]:
            exposure = max((facts[CENTRE] + facts[MEAN] - bias) / a, _SMALLEST_EXPOSURE)
        brightest = max(brightest, exposure)
        theta[j] = math.log(max(exposure, 1e-6))
        weight = facts[N_FRAMES] / (1.0 + exposure)
        rest += weight * (facts[VARIANCE] - exposure * a * a)
        n += weight
    if noise2 < 0.0:
        noise2 = max(rest / n, 0.02 * a * a)
    theta[n_samples] = a
    theta[n_samples + 1] = bias
    theta[n_samples + 2] = max(math.log(max(noise2, 1e-6)), floor_of(a, exact))
    return brightest > _SMALLEST_EXPOSURE


@kernel
def variance_line(samples: Samples) -> tuple[float, float, float]:
    """Return the slope of the variances against the means, and the point (mean, variance) that it is through.

    Weighted by the inverse variance of a variance near a normal law. The slope is 0 where the means do not
    differ.
    """
    weight_sum = x_sum = y_sum = 0.0
    for j in range(samples.dark.size):
        facts = samples.facts[j]
        weight = facts[N_FRAMES] / max(facts[VARIANCE] ** 2, 1e-6)
        weight_sum += weight
        x_sum += weight * (facts[CENTRE] + facts[MEAN])
        y_sum += weight * facts[VARIANCE]
    x0, y0 = x_sum / weight_sum, y_sum / weight_sum
    xx = xy = 0.0
    for j in range(samples.dark.size):
        facts = samples.facts[j]
        weight = facts[N_FRAMES] / max(facts[VARIANCE] ** 2, 1e-6)
        x = facts[CENTRE] + facts[MEAN] - x0
        xx += weight * x * x
        xy += weight * x * (facts[VARIANCE] - y0)
    return (xy / xx if xx > 0.0 else 0.0), x0, y0


@kernel
def line_start(
    which: int, samples: Samples, line: tuple[float, float, float], exact: bool, theta: NDArray[np.float64]
) -> bool:
    """Fill ``theta`` with one of the `N_LINE` starts on the line of variance against mean."""
    slope, x0, y0 = line
    a = slope * _SCALES[which // N_NOISES]
    if not a > 0.0:
        return False
    noise2 = (_NOISES[which % N_NOISES] * a) ** 2
    bias = x0 - (y0 - noise2) / a
    for j in range(samples.dark.size):
        if samples.dark[j]:  # it knows bias and read noise by itself
            if which % N_NOISES > 0:
                return False
            bias = samples.facts[j, CENTRE] + samples.facts[j, MEAN]
            noise2 = samples.facts[j, VARIANCE]
    answer: bool = fill_theta(samples, a, bias, noise2, exact, theta)
    return answer


@kernel
def scan_start(which: int, samples: Samples, theta: NDArray[np.float64]) -> bool:
    """Fill ``theta`` with one of the `N_SCAN` starts of a single sample at few DN per electron.

    Whole numbers hide the side lobes of its characteristic function there. Mean and variance leave a curve
    in (H, mu) for each step and read noise.
    """
    a = _SCAN_FIRST * _SCAN_RATIO ** (which // len(_SCAN_NOISES))
    noise = _SCAN_NOISES[which % len(_SCAN_NOISES)]
    facts = samples.facts[0]
    exposure = (facts[VARIANCE] - 1.0 / 12.0) / (a * a) - noise * noise
    if exposure < 0.03:
        return False
    bias = facts[CENTRE] + facts[MEAN] - exposure * a
    answer: bool = fill_theta(samples, a, bias, (noise * a) ** 2, True, theta)
    return answer


@kernel
def single_start(
    which: int,
    j: int,
    samples: Samples,
    basis: NDArray[np.float64],
    work: NDArray[np.float64],
    theta: NDArray[np.float64],
) -> tuple[bool, bool]:
    """Fill ``theta`` with one of the `N_SINGLE` starts of sample j.

    Returns:
        Whether there is one, and whether its side lobe stands clear of the noise.
    """
    if samples.dark[j] or samples.facts[j, OCCUPIED] < 3:
        return False, False
    own = np.empty(4)
    histogram = histogram_of(samples, j)
    clear = False
    if which == 0:
        found, clear = start_regression(histogram, basis, work, own)
    elif which == 1:
        found = start_peak(histogram, work, own)
    else:
        found = start_cumulants(histogram, own)
    if not found:
        return False, False
    bias = samples.facts[j, CENTRE] + own[2]
    noise2 = math.exp(own[3])
    for i in range(samples.dark.size):
        if samples.dark[i]:
            bias = samples.facts[i, CENTRE] + samples.facts[i, MEAN]
            noise2 = samples.facts[i, VARIANCE]
    return fill_theta(samples, own[1], bias, noise2, False, theta), clear
