"""The vector of statistics: forms of the scores of pixels, of series of frames, of lines and of neighbours.

Every statistic has its mean and variance from theory, so that it is about N(0, 1) where the PCD holds. The
families shape, code and tail need the histograms alone, the others the sums of :mod:`.view`. Every form is
taken of every series, or of all lines, or of all pixels; those that are no statistics of the catalogue are
dropped.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.discrepancy.observe import laws
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.sums import CHANNELS
from pchem_pipeline.discrepancy.observe.tables import PixelLaws
from pchem_pipeline.discrepancy.observe.tables_numba import FOLD, CodeSums
from pchem_pipeline.discrepancy.observe.view import OF_LINES, FrameView
from pchem_pipeline.effects.framework.evidence import SCORES, CodeResiduals
from pchem_pipeline.model.arithmetic.significance import OUTLYING
from pchem_pipeline.model.histogram.spectrum import FEWEST_LINES

_TAIL = float(special.ndtr(-OUTLYING))
_ENOUGH = 25.0  # samples expected of a code or bin that is judged by itself
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
    """Return the statistics of standardised deviations of pixels, (n,): their mean, their squares, outliers.

    ``normal`` are the same as normal quantiles (None: they are), ``kurtosis`` is the excess of each; outliers
    are on both sides, or above only.
    """
    quantiles = z if normal is None else normal
    count = int(np.sum((np.abs(quantiles) if two_sided else quantiles) > OUTLYING))
    spread = np.sum(np.broadcast_to(np.maximum(2.0 + kurtosis, 1.0), z.shape))
    return {
        "mean": float(z.sum() / np.sqrt(z.size)),
        "chi": float((z @ z - z.size) / np.sqrt(spread)),
        "cnt": laws.poisson(count, _TAIL * z.size * (2.0 if two_sided else 1.0)),
    }


def named(start: str, forms: Mapping[str, float]) -> dict[str, float]:
    """Return statistics by the names that begin with ``start``."""
    return {f"{start}.{form}": value for form, value in forms.items()}


def goodness_of(chi_square: FloatArray) -> FloatArray:
    """Return (chi-square, mean, variance), (n, 3), as normal quantiles, 0 without degrees of freedom."""
    value, mean, variance = chi_square.T
    some = mean > 0.5
    z = laws.chi_square(value, np.where(some, mean, 1.0), np.where(some, variance, 2.0))
    return np.where(some, z, 0.0)


def sample_statistics(pixels: PixelLaws, exposure: FloatArray, residuals: CodeResiduals) -> dict[str, float]:
    """Return the families shape, code and tail but for clusters; at least one pixel is good."""
    good = pixels.good
    found = _score_statistics(pixels.scores[good], np.log(exposure[good]))
    moments = pixels.moments[good]
    for name in ("goodness", "peaks"):
        found |= named(f"shape.{name}", pixel_forms(goodness_of(moments[name]), two_sided=False))
    for side in ("low", "high"):
        near, far = moments[side], moments[f"far_{side}"]
        found[f"tail.{side}.count"] = _beyond(near.sum(axis=0), far.sum(axis=0))
        some = [np.array([np.count_nonzero(n), -np.expm1(-mean).sum()]) for n, mean in (near.T, far.T)]
        found[f"tail.{side}.pixels"] = _beyond(*some)
    return found | _code_statistics(pixels.codes, residuals)


def _beyond(near: FloatArray, far: FloatArray) -> float:
    """Return the statistic of samples (seen, expected) beyond the support and far beyond it."""
    # few samples of heavy tails are far out, where none is expected; many of a satellite are near
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
    poisson = np.where(codes.bins[2] >= _ENOUGH, codes.bins[1], 0.0)
    found["code.smooth"] = _absorbed_chi_square(codes.bins[0], codes.bin_covariance, poisson)
    for name, code in (("top", residuals.maximum), ("bottom", residuals.minimum)):
        at = code - residuals.first
        found[f"code.{name}"] = laws.pile_up(residuals.observed, residuals.expected, at, top=name == "top")
    return found


def period_statistics(fold: FloatArray, covariance: FloatArray) -> dict[str, float]:
    """Return the statistics of residuals by DN modulo 16; each period without the shorter ones in it."""
    code = np.arange(FOLD)
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


def _lag1(view: FrameView, u: FloatArray) -> float:
    """Return the statistic of products of successive frames of a block."""
    inside = np.ones(view.n, np.bool_)
    inside[view.edges[:-1]] = False
    t = np.flatnonzero(inside)
    products = u[t] * u[t - 1]
    return float((products.sum() + products.size / (view.n - 1.0)) / np.sqrt(max(products.size, 1)))


def _line(view: FrameView, u: FloatArray) -> float:
    blocks = view.full_blocks(u)
    length = blocks.shape[1]
    if length < FEWEST_LINES or blocks.shape[0] == 0:
        return float("nan")
    power = np.abs(np.fft.rfft(blocks, axis=1)[:, 1 : (length + 1) // 2]) ** 2 / length
    return laws.largest_power(power.mean(axis=0), blocks.shape[0])


def _series_forms(view: FrameView, u: FloatArray) -> dict[str, float]:
    """Return the statistics of a series of the frames, of variance 1 by chance, (n,)."""
    time = view.numbers - view.numbers.mean()
    sign = np.where(view.numbers % 2 == 0, 1.0, -1.0)
    sign -= sign.mean()
    return {
        "variance": float(laws.chi_square(u @ u, view.n)),
        "lag1": _lag1(view, u),
        "slow": view.slow(view.block_sums(u)[:, None]),
        "trend": float(time @ u / np.sqrt(time @ time) * np.sqrt((view.n - 1.0) / view.n)),
        "line": _line(view, u),
        "alternating": float(sign @ u / np.sqrt(max(float(sign @ sign), 1e-300))),
        "largest": laws.largest_normal(u),
    }


def frame_statistics(view: FrameView) -> dict[str, float]:
    """Return the family frame but for repeats."""
    pixels, series = view.pixels, view.series
    found: dict[str, float] = {}
    for name, u in series.items():
        found |= named(f"frame.{name}", _series_forms(view, u))
    for channel, name in enumerate(CHANNELS):
        found[f"frame.{name}.quadrants"] = _quadrants(view, channel)
    rho = float(pixels.cross.sum() / np.sqrt(pixels.variance[0].sum() * pixels.variance[1].sum()))
    product = float(series["charge"] @ series["readout"])
    found["frame.covariance"] = (product - view.n * rho) / np.sqrt(view.n * (1.0 + rho**2))
    of_lines = (view.rows, 1), (view.columns, 0)
    followed = [_follows(view, series["readout"], sums[:2], axis) for sums, axis in of_lines]
    found["frame.follows.line"] = laws.largest_normal(np.concatenate(followed))
    return found


def _follows(view: FrameView, offsets: FloatArray, sums: FloatArray, axis: int) -> FloatArray:
    """Return how offsets of frames, (n,), follow the charge of lines that their own residual does not hold.

    ``sums`` are of k and r of the lines, (2, n, m); the products, (m,), have variance 1 by chance.
    """
    of_charge, of_readout = view.pixels.variance.sum(axis=axis + 1)
    held = view.pixels.cross.sum(axis=axis) / np.maximum(of_readout, 1e-300)
    left = of_charge - held**2 * of_readout
    followed = offsets @ (sums[0] - held * sums[1])
    return np.asarray(followed[left > 0.0] / np.sqrt(view.n * left[left > 0.0]))


def quadrant_sums(values: FloatArray) -> FloatArray:
    """Return the sums of a map over top left, top right, bottom left, bottom right, (4,)."""
    y, x = values.shape[0] // 2, values.shape[1] // 2
    parts = (values[:y, :x], values[:y, x:], values[y:, :x], values[y:, x:])
    return np.array([part.sum() for part in parts])


def quadrant_series(rows: FloatArray) -> FloatArray:
    """Return the sums of each frame over the quadrants, (n, 4), from those of half rows, (2, n, y)."""
    y = rows.shape[2] // 2
    return np.stack(
        [rows[half][:, part].sum(axis=1) for part in (slice(0, y), slice(y, None)) for half in (0, 1)], 1
    )


def without_mode(values: FloatArray, pattern: FloatArray) -> FloatArray:
    """Return standardised values (..., m) without their projection on a pattern (m,)."""
    unit = pattern / np.sqrt(pattern @ pattern)
    return np.asarray(values - (values @ unit)[..., None] * unit)


def _quadrants(view: FrameView, channel: int) -> float:
    variance = quadrant_sums(view.pixels.variance[channel])
    some = variance > 0
    if some.sum() < 2:
        return float("nan")
    scale = np.sqrt(variance[some])
    u = quadrant_series(view.halves[channel])[:, some] / scale
    rest = without_mode(view.block_sums(u), quadrant_sums(view.pixels.mode[channel])[some] / scale)
    return view.slow(rest, int(some.sum()) - 1)


def product_statistics(view: FrameView) -> dict[str, float]:
    """Return the statistics of products of samples; their mean also by the name of the products alone."""
    found: dict[str, float] = {}
    for name, seen in view.correlations.items():
        z = seen.deviations[np.isfinite(seen.of_pixels)]
        if z.size and seen.count:
            forms = pixel_forms(z)
            found |= {name: forms["mean"], **named(name, forms)}
    return found


def block_statistics(view: FrameView) -> dict[str, float]:
    """Return the statistics of the means of pixels over blocks."""
    found: dict[str, float] = {}
    usable = view.pixels.usable
    for channel, name in enumerate(CHANNELS):
        sums, mode, weights = view.blocks[:, channel], view.pixels.mode[channel], view.pixels.weights[channel]
        rest = sums - (sums * weights).sum(axis=(1, 2))[:, None, None] * mode
        lengths = np.diff(view.edges)[:, None]
        u = rest[:, usable] / np.sqrt(lengths * view.remaining[channel][usable])
        chi2 = np.sum(u**2, axis=0)
        forms = pixel_forms(laws.chi_square(chi2, view.freedom), two_sided=False)
        found |= named(f"time.block.{name}", {**forms, "chi": view.slow(u, chi2.size)})
    return found


def line_statistics(view: FrameView) -> dict[str, float]:
    """Return the statistics of the sums over rows and columns."""
    found: dict[str, float] = {}
    for line, axis, sums in (("row", 2, view.rows), ("column", 1, view.columns)):
        variance, mode = view.variance.sum(axis), view.mode.sum(axis)
        for name, *each in zip(OF_LINES, sums, variance, mode, strict=True):
            found |= named(f"space.{line}.{name}", _line_forms(view, *each, waves=name == "readout"))
    return found | {f"space.row.{name}.halves": _halves(view, c) for c, name in enumerate(CHANNELS)}


def _line_forms(
    view: FrameView, values: FloatArray, variance: FloatArray, mode: FloatArray, *, waves: bool = False
) -> dict[str, float]:
    """Return the statistics of sums over lines (n, lines), the common mode of each frame removed."""
    m = int(np.count_nonzero(variance))
    if m < 2:
        return {}
    rest, unit = _without_common_mode(values, variance, mode)
    found = {"variance": float(laws.chi_square(np.sum(rest**2), view.n * (m - 1.0)))}
    adjacent = np.flatnonzero((variance[:-1] > 0) & (variance[1:] > 0))
    if adjacent.size and m > 2:
        found["lag1"] = _pair_products(rest, unit, adjacent, adjacent + 1)
    return {**found, "line": _line_over_lines(view, rest, m)} if waves else found


def _without_common_mode(
    values: FloatArray, variance: FloatArray, mode: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return sums over lines, (n, lines), in their standard deviations without the mode, and it, (lines,).

    The mode is a unit vector of standardised sums; of lines without variance all is 0.
    """
    scale = np.sqrt(np.where(variance > 0, variance, np.inf))
    unit = mode / scale / np.sqrt((mode**2 / scale**2).sum())
    return without_mode(values / scale, unit), unit


def _pair_products(rest: FloatArray, unit: FloatArray, one: IntArray, two: IntArray) -> float:
    """Return the statistic of the products of pairs of lines, standardised and without their unit mode."""
    n, shared = len(rest), float(unit[one] @ unit[two])
    return float((np.sum(rest[:, one] * rest[:, two]) + n * shared) / np.sqrt(n * one.size))


def _halves(view: FrameView, channel: int) -> float:
    """Return the statistic of the products of the sums over the left and the right half of the rows."""
    middle = view.pixels.usable.shape[1] // 2
    variance, mode = (
        np.concatenate([of[channel][:, :middle].sum(axis=1), of[channel][:, middle:].sum(axis=1)])
        for of in (view.pixels.variance, view.pixels.mode)
    )
    rows = len(variance) // 2
    left = np.flatnonzero((variance[:rows] > 0) & (variance[rows:] > 0))
    if left.size < 2:
        return float("nan")
    rest, unit = _without_common_mode(np.concatenate(view.halves[channel], axis=1), variance, mode)
    return _pair_products(rest, unit, left, rows + left)


def _line_over_lines(view: FrameView, rest: FloatArray, used: int) -> float:
    """Return the statistic of a wave across the lines, coherent over a block or over one frame."""
    blocks = view.full_blocks(rest)
    count, length, lines = blocks.shape
    if count == 0 or min(length, used) < FEWEST_LINES:
        return float("nan")
    power = np.abs(np.fft.fft(np.fft.rfft(blocks, axis=2)[:, :, 1:], axis=1)) ** 2 / (length * used)
    single = power[:, :, : (lines - 1) // 2].mean(axis=(0, 1))
    moving = np.ones(length, np.bool_)
    moving[[0, length // 2]] = False
    coherent = power.mean(axis=0)[moving]
    return laws.best(laws.largest_power(coherent, count), laws.largest_power(single, count * length))
