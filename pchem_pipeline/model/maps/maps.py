"""Parameter maps: derived quantities with standard errors, quality, robust summaries, display transform."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray, IntegerArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.fit.status import FAILED, FitStatus, words_of
from pchem_pipeline.model.maps.ordered import Ordered

GOOD, CAUTION, NO_VALUE = 0, 1, 2

#: Percentiles in the summary of a map, %.
PERCENTILES = (1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0)


@dataclass(frozen=True)
class MapSummary:
    """Robust description of a map; a few hot pixels do not move it.

    Attributes:
        n_valid: pixels that are described: with a value, and not left out.
        n_missing: pixels without a value.
        n_left_out: pixels with a value that are left out.
        median: median of the values, in the unit of the map.
        median_stderr: standard error of the median, from order statistics.
        robust_sd: 1.4826 MAD, the standard deviation of a normal core.
        percentiles: percentile (%) to value.
        minimum, maximum: extremes.
        n_low, n_high: outliers below and above.
    """

    n_valid: int
    n_missing: int
    n_left_out: int
    median: float
    median_stderr: float
    robust_sd: float
    percentiles: Mapping[float, float]
    minimum: float
    maximum: float
    n_low: int
    n_high: int


def derived_maps(
    parameters: Mapping[str, FloatArray],
    covariance: FloatArray,
    integration_time: float | None,
    rate: str = "charge_rate",
) -> dict[str, FloatArray]:
    """Derive charge rate and read noise in electrons, with standard errors by the delta method.

    ``sigma_e- = sigma g`` and ``i_d = H / t_int``, which in the dark is the dark current (Hendrickson et al.
    2023, Sec. IV). The analog read noise is ``sigma_R = g sqrt(sigma^2 - 1/12)`` (below eq. X_density): NaN
    where the estimate is below rounding alone.

    From the four maps by name (``variables.PARAMETERS``) and the covariance of (H, g, mu, sigma), shape
    (..., 4, 4), to ``read_noise_e``, ``analog_read_noise_e`` and the ``rate``, ``charge_rate`` or in the dark
    ``dark_current``, each with ``<name>_stderr``; without an integration time, s, there is no rate.
    """
    gain, sigma = parameters["conversion_gain"], parameters["read_noise_dn"]
    analog_variance = sigma**2 - QUANTISATION_VARIANCE
    with np.errstate(invalid="ignore", divide="ignore"):
        analog = np.sqrt(np.where(analog_variance >= 0, analog_variance, np.nan))
        slope = np.where(analog > 0, gain * sigma / analog, np.nan)
    maps = {
        "read_noise_e": gain * sigma,
        "read_noise_e_stderr": _delta(sigma, gain, covariance),
        "analog_read_noise_e": gain * analog,
        "analog_read_noise_e_stderr": _delta(analog, slope, covariance),
    }
    if integration_time is not None:
        maps[rate] = parameters["quanta_exposure"] / integration_time
        maps[f"{rate}_stderr"] = _root(covariance[..., 0, 0]) / integration_time
    return maps


def _delta(by_gain: FloatArray, by_sigma: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the standard error of a function of g and sigma from its two derivatives."""
    variance = by_gain**2 * covariance[..., 1, 1] + 2.0 * by_gain * by_sigma * covariance[..., 1, 3]
    return _root(variance + by_sigma**2 * covariance[..., 3, 3])


def _root(variance: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.where(variance >= 0, variance, np.nan))


def electron_shifts(
    quanta_exposure: FloatArray, likelihood_gap: FloatArray, n_frames: int
) -> tuple[IntArray, FloatArray]:
    """Return numbers of electrons m, and how probable it is that H, and the bias, is off by as many.

    The peaks do not say which of them is that of no electron; the width of the law of the electron number
    does, to a standard error of ``s = H sqrt(2 / N)``. The likelihood of being m electrons off, to either
    side, is ``exp(-(m - d)^2 / (2 s^2))``, and ``(1 - 2 d) / (2 s^2)`` is the likelihood gap, whence d.

    m has the shape (k,), the probabilities (n, k); m = 0 for certain where a pixel has no value.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        square = np.minimum(2.0 * quanta_exposure**2 / n_frames, 0.5 / likelihood_gap)
    known = square > 0
    reach = 2 + int(min(6.0 * np.sqrt(square[known].max(initial=0.0)), 300.0))
    m = np.arange(-reach, reach + 1)
    probability = np.tile((m == 0).astype(np.float64), (square.size, 1))
    half, gap = square[known, None], likelihood_gap[known, None]
    weight = np.exp(np.minimum(m * (0.5 / half - gap) - 0.5 * m**2 / half, 0.0))
    probability[known] = weight / weight.sum(axis=1, keepdims=True)
    return m, probability


def quality_map(fit_status: IntegerArray, conversion_gain: FloatArray) -> NDArray[np.uint8]:
    """Grade the pixels: ``GOOD``, ``CAUTION`` (any bit in the status) or ``NO_VALUE`` (NaN)."""
    quality = np.where(fit_status == 0, GOOD, CAUTION).astype(np.uint8)
    quality[((fit_status & int(FAILED)) != 0) | ~np.isfinite(conversion_gain)] = NO_VALUE
    return quality


def status_counts(fit_status: IntegerArray) -> dict[str, int]:
    """Count the pixels with each reason, by its name in lower case, ``"ok"`` first; words of any shape."""
    counts = {words_of(bit): int(np.count_nonzero(fit_status & int(bit))) for bit in FitStatus if bit}
    return {"ok": int(np.count_nonzero(fit_status == 0))} | counts


def summarise(
    values: FloatArray | Ordered,
    *,
    left_out: BoolArray | None = None,
    percentiles: tuple[float, ...] = PERCENTILES,
    outlier_sigmas: float = 6.0,
) -> MapSummary:
    """Describe a map by order statistics alone.

    The standard error of the median is half the distance between the order statistics ``sqrt(n)/2`` ranks to
    either side: the median's rank has that standard deviation, whatever the distribution. Outliers lie beyond
    so many ``1.4826 MAD`` of the median. All is NaN where no pixel has a value.

    A map is NaN where there is no value, and pixels of the same shape may be left out; or its values come in
    order, without these. Percentiles are in %.
    """
    ordered = Ordered.of(values, left_out)
    n, missing, without = ordered.size, ordered.n_missing, ordered.n_left_out
    nan = float("nan")
    if n == 0:
        return MapSummary(0, missing, without, nan, nan, nan, dict.fromkeys(percentiles, nan), nan, nan, 0, 0)
    median, robust_sd = ordered.median, ordered.robust_sd
    middle, half = 0.5 * (n - 1), 0.5 * np.sqrt(n)
    limit = outlier_sigmas * robust_sd
    found = ordered.quantiles(np.asarray(percentiles) / 100.0)
    error = 0.5 * (ordered.at_rank(middle + half) - ordered.at_rank(middle - half))
    return MapSummary(
        n_valid=n,
        n_missing=missing,
        n_left_out=without,
        median=median,
        median_stderr=error if n > 1 else nan,
        robust_sd=robust_sd,
        percentiles=dict(zip(percentiles, found.tolist(), strict=True)),
        minimum=float(ordered.values[0]),
        maximum=float(ordered.values[-1]),
        n_low=ordered.n_below(median - limit),
        n_high=ordered.n_above(median + limit),
    )


def display_edges(ordered: Ordered, levels: ArrayLike) -> FloatArray:
    """Return the values from which pixels are at or above levels of a display of Beta(2,2) shape.

    The level of a value is ``F^-1(F~(x))`` (Hendrickson et al. 2023, Appendix C) with the empirical
    distribution function F~ and the quantile function of Beta(2,2), ``F(q) = 3 q^2 - 2 q^3``. Equal values
    share the middle of their ranks, so that ties stay ties and a change of sign turns the display round.

    The map has a value at least; the levels lie between 0 and 1. Infinite where no pixel is as high.
    """
    level = np.asarray(levels, dtype=np.float64)
    rank = ordered.size * level**2 * (3.0 - 2.0 * level)
    found = ordered.values[np.minimum(rank.astype(np.int64), ordered.size - 1)]
    first, last = (np.searchsorted(ordered.values, found, side) for side in ("left", "right"))
    higher = np.append(ordered.values, np.inf)[last]
    return np.where(0.5 * (first + last) >= rank, found, higher)
