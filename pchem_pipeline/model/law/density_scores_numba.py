"""The density of the PCD at one value, and the posterior moments of its electron number and its noise.

Of a value x the density is ``f(x) = sum_k Pois(k; H) N(x; mu + k a, sigma^2)``. By Fisher's identity its
scores are posterior means of those of the complete data (Louis 1982), which consist of ``k``, ``k^2``, ``e``,
``k e`` and ``e^2`` with ``e = x - mu - k a``.
"""

from __future__ import annotations

import math

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.limits import NEGLIGIBLE
from pchem_pipeline.model.law.density_numba import LOG_2PI

#: Places of the posterior means of k, k^2, e, k e and e^2.
K, KK, E, KE, EE = range(5)
N_MEANS = 5


@kernel(borrows=True)
def posterior(x: float, exposure: float, step: float, bias: float, sigma: float, means: FloatArray) -> float:
    """Fill the posterior means of a value and return its log density.

    The terms are summed from the largest on, each from the one before: the ratio of neighbours changes by the
    same factor at every electron. So the answer is exact however far out the value lies. The step is 1/g, DN.
    """
    along = step / (sigma * sigma)
    fall = math.exp(-step * along)
    k = max(math.floor((x - bias) / step + 0.5), 0.0) if exposure > 0.0 else 0.0
    e = x - bias - k * step
    up, down = math.exp((e - 0.5 * step) * along), math.exp((-e - 0.5 * step) * along)
    if up * exposure > k + 1.0:
        while up * exposure > k + 1.0:
            k += 1.0
            up *= fall
    else:
        while down * k > exposure:
            k -= 1.0
            down *= fall
    top, e = k, x - bias - k * step
    total, s_k, s_kk, s_e, s_ke, s_ee = 1.0, top, top * top, e, top * e, e * e
    for side in (1.0, -1.0):
        term, ratio, k = 1.0, math.exp((side * e - 0.5 * step) * along), top
        while side > 0.0 or k > 0.0:
            term *= ratio * (exposure / (k + 1.0) if side > 0.0 else k / exposure)
            ratio *= fall
            k += side
            if not term >= NEGLIGIBLE * total:
                break
            rest = x - bias - k * step
            total += term
            s_k += term * k
            s_kk += term * k * k
            s_e += term * rest
            s_ke += term * k * rest
            s_ee += term * rest * rest
    means[K], means[KK], means[E], means[KE], means[EE] = (
        s_k / total, s_kk / total, s_e / total, s_ke / total, s_ee / total,
    )  # fmt: skip
    log_mass = top * math.log(exposure) - math.lgamma(top + 1.0) if top > 0.0 else 0.0
    z = e / sigma
    return log_mass - exposure - 0.5 * z * z + math.log(total / sigma) - 0.5 * LOG_2PI


@kernel(borrows=True)
def density_scores(means: FloatArray, exposure: float, step: float, sigma: float, score: FloatArray) -> None:
    """Fill the slopes of a log density in (H, g, mu, sigma) from the posterior means; not in an H of 0."""
    inverse = 1.0 / (sigma * sigma)
    score[0] = means[K] / exposure - 1.0 if exposure > 0.0 else 0.0
    score[1] = -means[KE] * inverse * step * step
    score[2] = means[E] * inverse
    score[3] = (means[EE] * inverse - 1.0) / sigma


@kernel
def fill_posterior(x: FloatArray, parameters: FloatArray, out: FloatArray) -> None:
    """Fill posterior means and log density of values.

    Args:
        x: DN, shape (n,).
        parameters: (H, g, mu, sigma) of each, shape (4, n).
        out: out, the means, see `K`, and the log density; shape (6, n); NaN where a parameter is not valid.
    """
    means = np.empty(N_MEANS)
    for i in range(x.size):
        exposure, gain, bias, sigma = parameters[0, i], parameters[1, i], parameters[2, i], parameters[3, i]
        valid = exposure >= 0.0 and gain > 0.0 and sigma > 0.0
        if not (valid and math.isfinite(gain * (x[i] - bias) + exposure + sigma)):
            out[:, i] = math.nan
            continue
        out[N_MEANS, i] = posterior(x[i], exposure, 1.0 / gain, bias, sigma, means)
        for j in range(N_MEANS):
            out[j, i] = means[j]
