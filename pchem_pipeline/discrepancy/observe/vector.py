"""The vector of statistics: what the histograms alone give (shape, code, tail), and the order of all.

Every statistic has its mean and variance from theory, so that it is about N(0, 1) where the PCD holds.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.observe import laws
from pchem_pipeline.discrepancy.observe import tables_numba as column
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.tables_numba import CodeSums, PixelLaws
from pchem_pipeline.effects.framework.evidence import SCORES, CodeResiduals

FloatArray = NDArray[np.float64]

#: A pixel beyond this many standard deviations counts as one that stands out.
STANDS_OUT = 3.5
_TAIL = float(special.ndtr(-STANDS_OUT))
_ENOUGH = 25.0  # samples expected of a code or bin that is judged by itself
_LOW, _HIGH = [column.SEEN_LOW, column.EXPECTED_LOW], [column.SEEN_HIGH, column.EXPECTED_HIGH]
_FAR_LOW = [column.SEEN_FAR_LOW, column.EXPECTED_FAR_LOW]
_FAR_HIGH = [column.SEEN_FAR_HIGH, column.EXPECTED_FAR_HIGH]
_SMALLEST_EIGENVALUE = 0.02  # of residuals, relative to Poisson counts: below it the fits have absorbed them


def in_order(found: Mapping[str, float]) -> dict[str, float]:
    """Return the statistics that exist and are finite, in the order of the catalogue."""
    return {name: float(found[name]) for name in STATISTICS if name in found and np.isfinite(found[name])}


def pixel_forms(
    z: FloatArray,
    *,
    normal: FloatArray | None = None,
    kurtosis: FloatArray | float = 0.0,
    two_sided: bool = True,
) -> dict[str, float]:
    """Return the statistics of deviations of pixels, N(0, 1) by chance: their mean, their squares, outliers.

    Args:
        z: of mean 0 and variance 1, (n,).
        normal: the same as normal quantiles, (n,); None: they are.
        kurtosis: excess of each.
        two_sided: whether far below counts as far above.
    """
    quantiles = z if normal is None else normal
    count = int(np.sum((np.abs(quantiles) if two_sided else quantiles) > STANDS_OUT))
    spread = np.sum(np.broadcast_to(np.maximum(2.0 + kurtosis, 1.0), z.shape))
    return {
        "mean": float(z.sum() / np.sqrt(z.size)),
        "chi": float((z @ z - z.size) / np.sqrt(spread)),
        "cnt": laws.poisson(count, _TAIL * z.size * (2.0 if two_sided else 1.0)),
    }


def named(start: str, forms: Mapping[str, float]) -> dict[str, float]:
    """Return statistics by the names that begin with ``start``."""
    return {f"{start}.{form}": value for form, value in forms.items()}


def goodness_of(moments: FloatArray, chi_square: int = column.CHI2) -> FloatArray:
    """Return the goodness of fit of each pixel as a normal quantile, 0 without degrees of freedom, (n,).

    Args:
        moments: of the pixels.
        chi_square: column of the chi-square; its mean and variance follow it.
    """
    mean, variance = moments[:, chi_square + 1], moments[:, chi_square + 2]
    some = mean > 0.5
    z = laws.chi_square(moments[:, chi_square], np.where(some, mean, 1.0), np.where(some, variance, 2.0))
    return np.where(some, z, 0.0)


def sample_statistics(pixels: PixelLaws, exposure: FloatArray, residuals: CodeResiduals) -> dict[str, float]:
    """Return the families shape, code and tail (but for the clusters, which need frames).

    Args:
        pixels: laws of the pixels; at least one is good.
        exposure: H, (n,).
        residuals: counts per DN, with the extremes of the good pixels.
    """
    good = pixels.good
    found = _score_statistics(pixels.scores[good], np.log(exposure[good]))
    moments = pixels.moments[good]
    for name, chi_square in (("goodness", column.CHI2), ("peaks", column.PEAKS_CHI2)):
        z = goodness_of(moments, chi_square)
        found |= named(f"shape.{name}", pixel_forms(z, two_sided=False))
    for side, near, far in (
        ("low", moments[:, _LOW], moments[:, _FAR_LOW]),
        ("high", moments[:, _HIGH], moments[:, _FAR_HIGH]),
    ):
        found[f"tail.{side}.count"] = _beyond(near.sum(axis=0), far.sum(axis=0))
        pixels_near = [np.count_nonzero(near[:, 0]), -np.expm1(-near[:, 1]).sum()]
        pixels_far = [np.count_nonzero(far[:, 0]), -np.expm1(-far[:, 1]).sum()]
        found[f"tail.{side}.pixels"] = _beyond(np.array(pixels_near), np.array(pixels_far))
    return found | _code_statistics(pixels.codes, residuals)


def _beyond(near: FloatArray, far: FloatArray) -> float:
    """Return the statistic of samples (seen, expected) beyond the support and far beyond it.

    Few samples of heavy tails are far out, where none is expected; many of a satellite are near.
    """
    z = laws.poisson(int(near[0]), float(near[1]))
    return laws.best(z, laws.poisson(int(far[0]), float(far[1]))) if far[0] > 0 else z


def _score_statistics(scores: FloatArray, log_exposure: FloatArray) -> dict[str, float]:
    found: dict[str, float] = {}
    spread = log_exposure.std()
    for j, name in enumerate(SCORES):
        fit = np.isfinite(scores[:, 0, j])
        z, skewness, kurtosis = scores[fit, :, j].T
        if z.size == 0:
            continue
        normal = laws.without_skew(z, skewness)
        found |= named(f"shape.{name}", pixel_forms(z, normal=normal, kurtosis=kurtosis))
        if z.size >= 3 and spread > 1e-6:
            slope = log_exposure[fit] - log_exposure[fit].mean()
            found[f"shape.{name}.slope"] = float(slope @ z / np.sqrt(max(float(slope @ slope), 1e-300)))
    return found


def width_statistics(codes: CodeSums) -> tuple[dict[str, float], FloatArray]:
    """Return the statistics of the widths of codes, and the deviation of each, 0 of rare ones."""
    found = period_statistics(codes.fold, codes.fold_covariance) if codes.fold_covariance.trace() > 0 else {}
    _, expected, residual, variance = codes.single
    variance = np.maximum(variance, 0.05 * expected)
    judged = expected >= _ENOUGH
    z = np.where(judged, residual / np.sqrt(np.where(judged, variance, 1.0)), 0.0)
    middle = judged[:-2] & judged[1:-1] & judged[2:]
    if middle.sum() >= 4:
        # deviation from the mean of both neighbours; the variance of its square sum is that of white noise
        # under the weights (-1/2, 1, -1/2), whose autocorrelation is (1, -2/3, 1/6)
        rough = (z[1:-1] - 0.5 * (z[:-2] + z[2:]))[middle]
        m = rough.size
        found["code.rough"] = float(
            laws.chi_square(np.sum(rough**2) / 1.5, m, 2.0 * m * (1 + 8 / 9 + 1 / 18))
        )
    if judged.any():
        found["code.largest"] = laws.largest_normal(z[judged])
    return found, z


def _code_statistics(codes: CodeSums, residuals: CodeResiduals) -> dict[str, float]:
    found, _ = width_statistics(codes)
    smooth = _absorbed_chi_square(
        codes.bins[0], codes.bin_covariance, np.where(codes.bins[2] >= _ENOUGH, codes.bins[1], 0.0)
    )
    if np.isfinite(smooth):
        found["code.smooth"] = smooth
    at = np.array([residuals.maximum, residuals.minimum]) - residuals.first
    found["code.top"] = _pile_up(residuals.observed, residuals.expected, int(at[0]))
    found["code.bottom"] = _pile_up(
        residuals.observed[::-1], residuals.expected[::-1], residuals.observed.size - 1 - int(at[1])
    )
    return found


def period_statistics(fold: FloatArray, covariance: FloatArray) -> dict[str, float]:
    """Return the statistics of residuals by DN modulo 16; each period without the shorter ones in it.

    Args:
        fold: sums of the residuals, (16,).
        covariance: of these, (16, 16).
    """
    code = np.arange(16)
    sign = (-1.0) ** code
    found = {"code.alternating": float(sign @ fold / np.sqrt(max(float(sign @ covariance @ sign), 1e-300)))}
    scale = np.diag(covariance).clip(1e-300)
    for period in (2, 4, 8, 16):
        angles = [2.0 * np.pi * m * code / period for m in range(1, period // 2 + 1, 2)]
        waves = [np.cos(a) for a in angles] + ([np.sin(a) for a in angles] if period > 2 else [])
        basis = np.array(waves)
        small = _absorbed_chi_square(
            basis @ fold, basis @ covariance @ basis.T, np.diag(basis @ np.diag(scale) @ basis.T)
        )
        if np.isfinite(small):
            found[f"code.period{period}"] = small
    return found


def _absorbed_chi_square(values: FloatArray, covariance: FloatArray, poisson: FloatArray) -> float:
    """Return the normal quantile of the chi-square of correlated residuals, NaN where the fits absorb all.

    Directions in which hardly any variance is left of that of Poisson counts are left out: there the
    linear theory of the fits is not exact enough.
    """
    used = poisson > 0
    if not used.any():
        return float("nan")
    scale = 1.0 / np.sqrt(poisson[used])
    values = values[used] * scale
    eigenvalues, vectors = np.linalg.eigh(covariance[np.ix_(used, used)] * np.outer(scale, scale))
    kept = eigenvalues > _SMALLEST_EIGENVALUE
    if not kept.any():
        return float("nan")
    projected = vectors.T[kept] @ values
    return float(laws.chi_square(np.sum(projected**2 / eigenvalues[kept]), int(kept.sum())))


def _pile_up(observed: FloatArray, expected: FloatArray, at: int) -> float:
    """Return how surprising it is that no sample lies beyond a code and so many on it.

    The chance of none beyond the extreme code is uniform over repetitions, and given some, the counts on it
    follow a Poisson law: both as normal quantiles, averaged.
    """
    on = float(expected[at]) if 0 <= at < expected.size else 0.0
    beyond = float(expected[max(at + 1, 0) :].sum())
    count = int(observed[at]) if 0 <= at < observed.size else 1
    return laws.extreme(max(count, 1), on, beyond)
