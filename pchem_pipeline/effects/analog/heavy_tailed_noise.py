"""Heavy-tailed read noise: some samples are noisier than the others, in every pixel.

The read noise of a source follower is Gaussian only where many traps act together; a few of them, or pickup
in bursts, make it a scale mixture: ``R`` has the pixel's ``sigma`` with probability ``1 - share`` and
``factor sigma`` with probability ``share`` (Tukey 1960, the contaminated normal). Noise histograms of CMOS
imagers with such tails are attributed to random telegraph noise of the source followers (Leyris et al.
2006; Wang, Rao, Mierop and Theuwissen 2006).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, PixelMaps, SampleLaw

# factor less 1 of noisy samples that move the tail and He4 by as many standard deviations
_WIDTH = 0.7


@register_effect
class HeavyTailedNoise(Effect):
    """Scale mixture of two Gaussians; the read noise of a pixel remains that of its quiet samples.

    Signature: the fourth Hermite score is positive in all pixels alike and samples lie below all that the PCD
    allows (above, the Poisson tail hides them); nothing in time or space. The variance of the noise becomes
    ``sigma^2 (1 + share (factor^2 - 1))``.
    """

    tag: Literal["heavy_tailed_noise"] = Field(default="heavy_tailed_noise", description="name of the effect")
    plane = Plane.ANALOG
    title = "non-Gaussian (heavy-tailed) read noise"
    source = (
        "Tukey 1960 (contaminated normal); Wang, Rao, Mierop and Theuwissen 2006, Leyris et al. 2006 (tails "
        "of CMOS read noise)"
    )
    signature = (
        "tail.low.count", "shape.He4.mean", "tail.low.pixels", "shape.He3.mean", "shape.He3C1.mean",
    )  # fmt: skip
    strength = "share"
    separate: ClassVar[Mapping[str, str]] = {
        "rts_noise": "longer runs: RTS noise stays in the same few pixels; or another number of "
        "correlated samples: it changes the levels of RTS noise",
        "adc_dnl": "a sweep of the bias: DNL is fixed in DN, tails shift with the peaks",
        "signal_dependent_noise": "frames without exposure: heavy tails remain",
    }
    share: Ratio = Field(ge=0, le=1, description="probability that a sample is noisy, no unit")
    factor: Ratio = Field(
        default=3.0,
        ge=1,
        le=30,
        description="noise of such a sample relative to others, no unit",
    )

    #: few noisy samples, and more but less noisy ones; the last are near a Student law of many degrees of
    #: freedom: kurtosis almost without tails
    typical_values = tuple(
        {"share": share, "factor": factor}
        for share, factor in ((2.4e-4, 3.0), (3e-3, 2.0), (6e-5, 5.0), (5e-2, 1.25), (2e-2, 1.6))
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with the noise of some samples enlarged."""
        noisy = context.random.uniform(("frame", "y", "x")) < self.share
        result: AnyArray = values.copy()
        if context.read_noise is not None:
            result[noisy] += (self.factor - 1.0) * context.read_noise[noisy]
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return what is typical; the wider the noisy samples, the more the tail shows them than He4 does."""
        tail, kurtosis = (max(evidence.z.get(name, 0.0), 1.0) for name in cls.signature[:2])
        width = 1.0 + _WIDTH * tail / kurtosis
        return sorted(super().estimate(evidence), key=lambda one: abs(np.log(one.factor / width)))

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with noise of two widths."""
        return model.with_noise(np.array([1.0 - self.share, self.share]), width=np.array([1.0, self.factor]))
