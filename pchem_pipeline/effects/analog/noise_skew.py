"""Skewed read noise: an exponential part besides the Gaussian one (exGaussian).

What has not settled when it is sampled (a slow source follower, dielectric absorption, a rectifying clamp)
leans to one side. The exponentially modified Gaussian is the usual law of such a sum (Grushka 1972): ``R =
(1 - share^2)^(1/2) sigma Z + share sigma (E - 1)`` with ``Z`` standard normal and ``E`` exponential, both of
variance 1, so that ``R`` has mean 0, variance ``sigma^2`` and skewness ``2 share^3``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, FloatArray, PixelMaps, SampleLaw

#: Parts of the exponential up to a share of 0.6 (0.75 of the Gaussian part), and at most.
_LOBES, _ENOUGH_FOR, _MOST_LOBES = 8, 0.75, 16
_ROOT = 5.0


@register_effect
class NoiseSkew(Effect):
    """Exponential part of the read noise; mean and variance of the noise stay as they are.

    Signature: the third Hermite score has one sign in all pixels, and with it He4 and He3C1; nothing in
    time or space. Peaks lean to high DN (``share`` positive) or low DN (negative).
    """

    tag: Literal["noise_skew"] = Field(default="noise_skew", description="name of the effect")
    plane = Plane.ANALOG
    title = "skewed read noise (exponentially modified Gaussian)"
    source = "Grushka 1972 (exponentially modified Gaussian)"
    signature = (
        "shape.He3.mean", "shape.He2C1.mean", "shape.He3C1.mean", "shape.He4.mean", "code.smooth",
    )  # fmt: skip
    strength = "share"
    power = 3.0
    separate: ClassVar[Mapping[str, str]] = {
        "heavy_tailed_noise": "frames without exposure: skewed noise has one tail, heavy-tailed noise two",
        "signal_dependent_noise": "frames without exposure: the skewness remains",
        "nonlinearity": "a sweep of the exposure: the skewness is independent of the signal",
        "adc_inl": "a sweep of the bias: skewness shifts with the peaks, INL is fixed in DN",
        "rts_noise": "longer runs: RTS noise stays in the same few pixels",
    }
    share: Ratio = Field(
        ge=-1,
        le=1,
        description="standard deviation of the exponential part over the read noise, no unit; "
        "negative: tail to low DN",
    )

    #: a tail to high DN and one to low DN
    typical_values = ({"share": 0.4}, {"share": -0.4})

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with a part of the noise exchanged for an exponential one."""
        exponential = np.log(context.random.uniform(("frame", "y", "x")))
        exponential += 1.0
        exponential *= -self.share * context.truth["analog_read_noise_e"]
        if context.read_noise is not None:
            exponential -= (1.0 - self._gaussian) * context.read_noise
        exponential += values
        return exponential

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the exponential cut into parts, each a Gaussian of its mean and variance.

        Mean and variance of the noise stay exact. Its law is to 1e-6 nats per sample up to a share of 0.86,
        and to 1.5e-5 at 0.95.
        """
        shifts, weights, variances = _exponential_parts(self._lobes)
        width = np.sqrt(1.0 - self.share**2 * (1.0 - variances))
        return model.with_noise(weights, shift_sigma=self.share * shifts, width=width)

    @property
    def _lobes(self) -> int:
        """Parts of the exponential that are as wide in units of the Gaussian part, whatever the share."""
        wide = abs(self.share) / max(self._gaussian, 1e-3)
        return int(np.clip(np.ceil(_LOBES * wide / _ENOUGH_FOR), _LOBES, _MOST_LOBES))

    @property
    def _gaussian(self) -> float:
        return float(np.sqrt(1.0 - self.share**2))


def _exponential_parts(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean (less 1), weight and variance of n consecutive parts of an exponential of mean 1.

    The edges are at equal steps of the fifth root of the survival, so that the tail is resolved, which makes
    the skew.
    """
    edges = -_ROOT * np.log(1.0 - np.arange(n) / n)
    survival = np.append(np.exp(-edges), 0.0)
    first = np.append((edges + 1.0) * survival[:-1], 0.0)
    second = np.append((edges**2 + 2.0 * edges + 2.0) * survival[:-1], 0.0)
    weights = -np.diff(survival)
    means = -np.diff(first) / weights
    return means - 1.0, weights, -np.diff(second) / weights - means**2
