"""From sums with a known law to standard normal quantiles.

Every function takes what was seen and what is expected without any effect, and answers with a number that is
about N(0, 1) then; a large positive one says "too much". Far in the tails logarithms of the probabilities are
used, so that the answer stays finite and keeps growing with the effect.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE
from pchem_pipeline.model.arithmetic.statistics import chi_square as chi_square

_SMALL = 1e-12
# an event that is next to impossible counts as much as this many standard deviations
_CERTAIN = 10.0
#: Standard deviations: values beyond count as so many, so that a few of them make no mean.
FAR = 6.0
#: Slowest waves along a series whose squares are summed (the adaptive test of Neyman, Fan 1996).
SLOWEST = (2, 4, 8, 16, 32)
_SHORT_END = 0.25  # of the cubic root of a gamma law


def without_skew(z: FloatArray, skewness: FloatArray) -> FloatArray:
    """Return standardised sums with a known skewness as normal quantiles (Wilson and Hilferty 1931).

    The gamma law behind it ends on its short side, where the cubic root is steep; real sums do not quite end.
    """
    skew = np.where(np.abs(skewness) < 1e-6, 1e-6, skewness)
    root = np.cbrt(np.maximum(1.0 + 0.5 * skew * z, _SHORT_END))
    return np.asarray(6.0 / skew * (root - 1.0) + skew / 6.0)


def poisson(count: int, expected: float) -> float:
    """Return the normal quantile of a Poisson count, ties split; near 0 for none where none is expected."""
    expected = max(expected, _SMALL)
    if count == 0:
        return _quantile(np.log1p(-0.5 * np.exp(-expected)))
    return _quantile(_log_poisson_tail(count, expected))


def repeats(count: int, expected: float) -> float:
    """Return 10 for each coincidence that cannot happen; where they do happen, a normal quantile.

    That is ``2 sqrt(c + 3/8) - 2 sqrt(e + 3/8)``, of variance 1 for a Poisson count (Anscombe 1948).
    """
    if expected < SIGNIFICANCE:
        return float(_CERTAIN * count)
    return float(2.0 * (np.sqrt(count + 0.375) - np.sqrt(expected + 0.375)))


def largest_normal(values: FloatArray) -> float:
    """Return the normal quantile of the largest magnitude among independent N(0, 1) numbers."""
    log_tail = np.log(2.0) + special.log_ndtr(-float(np.max(np.abs(values))))
    return _of_many(log_tail, values.size)


def largest_power(power: NDArray[np.floating], averaged: int) -> float:
    """Return the normal quantile of the largest of many powers, of any shape.

    Each is the mean of ``averaged`` exponential numbers of mean 1 (Fisher's g-test of a periodogram).
    """
    total = averaged * float(np.max(power))
    tail = float(special.gammaincc(averaged, total))
    if tail > 1e-250:
        return _of_many(float(np.log(tail)), power.size)
    log_tail = float((averaged - 1.0) * np.log(total) - total - special.gammaln(averaged))
    return _of_many(log_tail, power.size)


def _of_many(log_tail: float, n: float) -> float:
    """Return the quantile of the smallest of n p-values given its logarithm."""
    log_none = n * np.log1p(-np.exp(min(log_tail, -1e-9)))
    if log_none < -1e-6:
        return float(special.ndtri_exp(log_none))
    return _quantile(np.log(n) + log_tail)


def _quantile(log_p: float) -> float:
    """Return the normal deviate exceeded with probability exp(log_p)."""
    return float(-special.ndtri_exp(min(log_p, -1e-9)))


def _log_poisson_tail(count: int, expected: float) -> float:
    """Return log(P(N > count) + P(N = count) / 2), count at least 1."""
    at = count * np.log(expected) - expected - special.gammaln(count + 1.0)
    tail = float(special.gammainc(count, expected))
    ratio = expected / (count + 1.0)
    above = np.log(tail) if tail > 1e-250 else at - np.log1p(-min(ratio, 0.5))
    return float(above + np.log1p(-0.5 * np.exp(min(at - above, 0.0))))


def pile_up(observed: FloatArray, expected: FloatArray, at: int, *, top: bool) -> float:
    """Return the normal quantile of the samples at the highest (``top``) or lowest code, with none beyond it.

    The chance of none beyond the extreme code is uniform over repetitions, and given some, the counts on it
    follow a Poisson law: both as normal quantiles, averaged. Outside of the (n,) codes nothing is expected.
    """
    known = 0 <= at < expected.size
    count, on = (max(int(observed[at]), 1), max(float(expected[at]), _SMALL)) if known else (1, _SMALL)
    beyond = float((expected[max(at + 1, 0) :] if top else expected[: max(at, 0)]).sum())
    # half of the chance of the extreme itself splits the ties
    nothing = _quantile(-beyond + np.log(0.5 + 0.5 * np.exp(-on)))
    piled = _quantile(_log_poisson_tail(count, on) - np.log(-np.expm1(-on)))
    return float((nothing + piled) / np.sqrt(2.0))


def best(*z: float, independent: float | None = None) -> float:
    """Return the normal quantile of the largest of a few normal quantiles, worth so many independent ones."""
    return _of_many(float(special.log_ndtr(-max(z))), len(z) if independent is None else independent)
