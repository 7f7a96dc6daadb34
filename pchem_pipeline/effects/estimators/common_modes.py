"""What the effects on the common mode share: sums of readout residuals, and the law of an offset.

An offset b of a whole frame, row or quadrant adds b to the samples of many pixels. The readout residual
``r = x - mu - E[K | x] / g`` follows it only in part where the peaks overlap, since some of b is taken for
charge: on average by ``alpha = Var(r) / sigma^2`` (Stein's identity for the Gaussian R of Hendrickson et al.
2023, eq. PCD_RV_definition). Estimates of offsets are therefore means of r divided by the mean alpha.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from pchem_pipeline.effects.types import (
    AnyArray,
    BoolArray,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)

#: Standard errors from which on an excess is worth a hypothesis. One split of the frames sees less than all
#: of them together, and a wrong hypothesis is thrown out by the comparison that follows: so not too many.
WORTH_A_GUESS = 2.0

# below this ratio of the spread of an offset to the read noise its shape is lost: the fourth cumulant that
# a Gaussian of the same variance misses is 2e-4 of the squared variance, for the worst (two-valued) law
_NARROW = 0.1


def run_position(frames: IntArray, n_run: int) -> FloatArray:
    """Return where frames lie in the run: 0 the first, 1 the last; frames before the run like the first."""
    return np.asarray(frames.clip(0, n_run - 1) / max(n_run - 1, 1), np.float64)


def responsivity(evidence: Evidence, inside: BoolArray | None = None) -> float:
    """Return the mean change of r per DN of a common offset, in (0, 1] (see the module's text).

    Args:
        evidence: of some pixels.
        inside: those that count, (y, x); None: all.
    """
    maps = evidence.maps
    some = maps.usable if inside is None else maps.usable & inside
    ratio = (evidence.readout_std[some] / maps.read_noise_dn[some]) ** 2
    ratio = ratio[np.isfinite(ratio)]
    return float(np.clip(ratio.mean(), 0.02, 1.0)) if ratio.size else 1.0


def mean_response(evidence: Evidence, inside: BoolArray | None = None) -> float:
    """Return the mean change of r over its standard deviation per DN of a common offset, 1/DN.

    Args:
        evidence: of some pixels.
        inside: those that count, (y, x); None: all.
    """
    maps = evidence.maps
    some = maps.usable if inside is None else maps.usable & inside
    return float(np.mean((evidence.readout_std / maps.read_noise_dn**2)[some]))


def mean_variance(evidence: Evidence, axis: int | tuple[int, int] = (0, 1)) -> FloatArray:
    """Return the variance, DN^2, that the pixels' own noise gives to means of r over usable pixels.

    ``axis`` as in a sum over (y, x): both for frame means, 1 for row means, 0 for column means; NaN where
    there is no usable pixel.
    """
    usable = evidence.maps.usable & np.isfinite(evidence.readout_std)
    n = usable.sum(axis)
    total = (np.where(usable, evidence.readout_std, 0.0) ** 2).sum(axis)
    return np.asarray(np.where(n > 0, total / np.maximum(n, 1) ** 2, np.nan), np.float64)


def successive(frames: AnyArray) -> BoolArray:
    """Return which frames follow the one before as closely as any here do, (n - 1,); of a period, all."""
    apart = np.diff(frames)
    return np.asarray(apart == apart.min(initial=apart.max(initial=1)))


def line_excess(means: AnyArray, variance: FloatArray) -> tuple[float, float]:
    """Return the variance of the lines' offsets beyond that of their pixels, and its standard error, DN^2.

    Args:
        means: mean of r of each line in each frame, shape (n, lines), NaN for lines without pixels.
        variance: what the pixels' noise gives to each, shape (lines,), NaN for such lines.
    """
    good = np.isfinite(variance) & np.isfinite(means).all(axis=0)
    n_frames, n_lines = means.shape[0], int(good.sum())
    if n_lines < 2 or n_frames < 2:
        return 0.0, np.inf
    kept = means[:, good].astype(np.float64)
    kept = kept - kept.mean(axis=1, keepdims=True)
    kept -= kept.mean(axis=0)
    expected = variance[good]
    degrees = (n_frames - 1) * (n_lines - 1)
    excess = float((kept**2).sum() / degrees - expected.mean())
    return excess, float(np.sqrt(2.0 / degrees) * np.sqrt((expected**2).mean()))


def line_noise(evidence: Evidence, of: Literal["row", "column"]) -> float | None:
    """Return the standard deviation of the rows' or columns' offsets, DN; None where none is worth a guess.

    From the excess variance of their means within their frames (moment estimate).
    """
    if evidence.time is None:
        return None
    rows = of == "row"
    means = evidence.time.row_readout if rows else evidence.time.column_readout
    excess, error = line_excess(means, mean_variance(evidence, axis=1 if rows else 0))
    return None if excess < WORTH_A_GUESS * error else excess**0.5 / responsivity(evidence)


def is_narrow(spread_dn: float, maps: PixelMaps) -> bool:
    """Return whether an offset of this standard deviation, DN, only broadens the pixels' histograms."""
    noise = maps.read_noise_dn[np.isfinite(maps.read_noise_dn)]
    return not noise.size or spread_dn < _NARROW * float(np.median(noise))


def with_offsets(model: SampleLaw, maps: PixelMaps, offsets_dn: FloatArray) -> SampleLaw:
    """Return the law of samples to which one of these offsets, DN, is added, each equally likely.

    Offsets that spread little against the read noise become a variance: one number costs the fit nothing,
    each further component costs as much as the first.
    """
    spread = float(offsets_dn.std())
    if is_narrow(spread, maps):
        return model.with_variance(dn2=spread**2)
    weights = np.full(offsets_dn.size, 1.0 / offsets_dn.size)
    return model.with_noise(weights, shift_dn=offsets_dn - offsets_dn.mean())


def chebyshev_nodes(count: int) -> FloatArray:
    """Return ``count`` values that stand, equally likely, for the sine of a random phase (arcsine law).

    Gauss-Chebyshev quadrature: all moments up to order ``2 count - 1`` are exact.
    """
    return np.asarray(np.cos((2.0 * np.arange(count) + 1.0) * np.pi / (2.0 * count)))


def quantile_means(values: FloatArray, count: int) -> FloatArray:
    """Return the means of ``count`` equal parts of the sorted values, stretched to their variance."""
    ordered = np.sort(values)
    means = np.array([part.mean() for part in np.array_split(ordered, min(count, ordered.size))])
    centre, spread = float(values.mean()), float(means.std())
    return np.asarray(centre + (means - means.mean()) * (values.std() / spread if spread > 0 else 1.0))
