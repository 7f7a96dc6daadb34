"""Loops of plain EM, straight from the paper's update equations, on histograms.

Nothing here is shared with the loops of this package's fit, so that the two can be compared.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.density_scores_numba import KK, N_MEANS, K, posterior


@kernel
def em_pixel(
    counts: NDArray[np.integer],
    theta: NDArray[np.float64],
    only_light: bool,
    max_iterations: int,
    tolerance: float,
) -> int:
    """Iterate in place until every parameter changes relatively by less than the tolerance.

    Args:
        counts: histogram, shape (B,); its bins are the values of x.
        theta: (H, 1/g, mu, sigma), mu in bins; overwritten.
        only_light: update H and g only; bias and read noise are known.
        max_iterations: largest number of steps.
        tolerance: relative change; that of mu is against sigma.

    Returns:
        Steps taken; negative where the parameters left the allowed range.
    """
    n, mean, means = 0.0, 0.0, np.empty(N_MEANS)
    for i in range(counts.size):
        n += counts[i]
        mean += counts[i] * float(i)
    mean /= n
    spread = 0.0
    for i in range(counts.size):
        spread += counts[i] * (i - mean) ** 2
    spread /= n
    for iteration in range(1, max_iterations + 1):
        a = b = c = 0.0
        for i in range(counts.size):
            if counts[i] > 0:
                posterior(float(i), theta[0], theta[1], theta[2], theta[3], means)  # eq. (gamma_nk)
                share = counts[i] / n
                a += share * means[K]
                b += share * means[KK]
                c += share * means[K] * (i - mean)
        bias, sigma = theta[2], theta[3]
        if only_light:
            step = (c + (mean - bias) * a) / b if b > 0 else -1.0
        else:
            step = c / (b - a * a) if b > a * a else -1.0
            bias = mean - a * step
            variance = spread - (b - a * a) * step * step
            sigma = np.sqrt(variance) if variance > 0 else -1.0
        if not (step > 0 and sigma > 0 and 1e-9 < a < 1e6 and step < 1e6):
            return -iteration
        change = max(
            abs(a / theta[0] - 1),
            abs(step / theta[1] - 1),
            abs(bias - theta[2]) / sigma,
            abs(sigma / theta[3] - 1),
        )
        theta[0], theta[1], theta[2], theta[3] = a, step, bias, sigma
        if change < tolerance:
            return iteration
    return max_iterations


@kernel
def em_tile(
    counts: NDArray[np.integer],
    parameters: NDArray[np.float64],
    only_light: bool,
    max_iterations: int,
    tolerance: float,
    steps: NDArray[np.int64],
) -> None:
    """Run :func:`em_pixel` on every pixel that has a start; the others get NaN and 0 steps.

    Args:
        counts: shape (n, B).
        parameters: (H, 1/g, mu, sigma), mu in bins, shape (n, 4); overwritten.
        only_light: update H and g only.
        max_iterations: largest number of steps.
        tolerance: relative change at which to stop.
        steps: steps of each pixel, shape (n,), output.
    """
    for pixel in range(counts.shape[0]):
        start = parameters[pixel]
        usable = start[0] > 0 and start[1] > 0 and start[3] > 0 and np.isfinite(start).all()
        if usable and counts[pixel].sum() > 0:
            steps[pixel] = em_pixel(counts[pixel], start, only_light, max_iterations, tolerance)
        else:
            steps[pixel] = 0
        if steps[pixel] <= 0:
            start[:] = np.nan
