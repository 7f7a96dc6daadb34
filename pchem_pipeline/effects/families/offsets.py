"""Offsets that many pixels share: how they come to the samples, and the law of a sample with one."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
from numpy.typing import ArrayLike

from pchem_pipeline.effects.framework.effect import Effect, Plane
from pchem_pipeline.effects.types import AnyArray, EffectContext, FloatArray, PixelMaps, SampleLaw

# below this ratio of the spread of an offset to the read noise its shape is lost: the fourth cumulant that
# a Gaussian of the same variance misses is 2e-4 of the squared variance, for the worst (two-valued) law
_NARROW = 0.1


class OffsetEffect(Effect):
    """Base of what adds an offset to the samples of many pixels.

    In DN, since the disturbance sits behind the pixels' gains. A subclass gives the offsets of a block of
    frames, and the values that they take in the run; by these a pixel's own histogram is smeared.
    """

    plane = Plane.ANALOG

    @abstractmethod
    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the offsets of a block of frames, DN, with shape (frame, y, x) or 1 along each of them."""

    def offset_values(self) -> FloatArray | None:
        """Return values, DN, that stand, each as likely, for the offset of a pixel in a run.

        None: the offsets are Gaussian, and the strength is their standard deviation.
        """
        return None

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with the offsets referred to the input."""
        return add_offset(values, self.offsets(context), context)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law of samples to which one of the values is added.

        Values that spread little against the read noise become a variance: one number costs the fit nothing,
        each further component costs as much as the first.
        """
        values = self.offset_values()
        if values is None:
            return model.with_variance(dn2=getattr(self, self.strength) ** 2)
        spread = float(values.std())
        noise = maps.read_noise_dn[np.isfinite(maps.read_noise_dn)]
        if not noise.size or spread < _NARROW * float(np.median(noise)):
            return model.with_variance(dn2=spread**2)
        return model.with_noise(np.full(values.size, 1.0 / values.size), shift_dn=values - values.mean())


def add_offset(values: AnyArray, offset_dn: ArrayLike, context: EffectContext) -> AnyArray:
    """Return the analog signal (frame, y, x), e-, with offsets in DN referred to the input."""
    result: AnyArray = values + np.asarray(offset_dn) * context.truth["conversion_gain"]
    return result


def sine_values(count: int) -> FloatArray:
    """Return ``count`` values that stand, equally likely, for the sine of a random phase (arcsine law).

    Gauss-Chebyshev quadrature: all moments up to order ``2 count - 1`` are exact.
    """
    return np.asarray(np.cos((2.0 * np.arange(count) + 1.0) * np.pi / (2.0 * count)))


def quantile_means(values: FloatArray, count: int = 7) -> FloatArray:
    """Return the means of ``count`` equal parts of the sorted values, stretched to their variance."""
    ordered = np.sort(values)
    means = np.array([part.mean() for part in np.array_split(ordered, min(count, ordered.size))])
    centre, spread = float(values.mean()), float(means.std())
    return np.asarray(centre + (means - means.mean()) * (values.std() / spread if spread > 0 else 1.0))
