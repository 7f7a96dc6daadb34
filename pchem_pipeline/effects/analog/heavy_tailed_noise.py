"""Heavy-tailed read noise: some samples are noisier than the others, in every pixel.

The read noise of a source follower is Gaussian only where many traps act together; a few of them, or pickup
in bursts, make it a scale mixture: ``R`` has the pixel's ``sigma`` with probability ``1 - share`` and
``factor sigma`` with probability ``share`` (Tukey 1960, the contaminated normal). Noise histograms of CMOS
imagers with such tails are attributed to random telegraph noise of the source followers (Leyris et al.
2006; Wang, Rao, Mierop and Theuwissen 2006).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.base import Effect, Plane, register_effect
from pchem_pipeline.effects.response import strength_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.context import EffectContext
    from pchem_pipeline.effects.evidence import Evidence, PixelMaps
    from pchem_pipeline.model.marginal import MarginalModel

__all__ = ["HeavyTailedNoise"]


@register_effect
class HeavyTailedNoise(Effect):
    """Scale mixture of two Gaussians; the read noise of a pixel remains that of its quiet samples.

    Signature: the fourth Hermite score is positive in all pixels alike and samples lie below all that the PCD
    allows (above, the Poisson tail hides them); nothing in time or space. The variance of the noise becomes
    ``sigma^2 (1 + share (factor^2 - 1))``.
    """

    tag: Literal["heavy_tailed_noise"] = Field(default="heavy_tailed_noise", description="name of the effect")
    plane: ClassVar[Plane] = Plane.ANALOG
    title: ClassVar[str] = "Non-Gaussian (heavy-tailed) read noise"
    source: ClassVar[str] = (
        "Tukey 1960 (contaminated normal); Wang, Rao, Mierop and Theuwissen 2006, Leyris et al. 2006 (tails "
        "of CMOS read noise)"
    )
    signature: ClassVar[tuple[str, ...]] = (
        "shape.He4.mean", "tail.low.count", "tail.low.pixels", "shape.goodness.mean", "shape.He2C2.mean",
    )  # fmt: skip
    strength: ClassVar[str] = "share"
    power: ClassVar[float] = 1.0
    separate: ClassVar[Mapping[str, str]] = {
        "rts_noise": "longer runs: telegraph noise stays in the same few pixels; or another "
        "number of correlated samples, which moves its levels",
        "adc_dnl": "a sweep of the bias: wrong codes stay where they are in DN, tails move along",
        "signal_dependent_noise": "frames without any exposure: the tails remain there",
    }
    share: float = Field(ge=0, le=1, description="probability that a sample is noisy, no unit")
    factor: float = Field(
        default=3.0,
        ge=1,
        le=30,
        description="noise of such a sample relative to that of the others, no unit",
    )

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the signal (frame, y, x), e-, with the noise of some samples enlarged."""
        noisy = context.random.uniform(("frame", "y", "x")) < self.share
        result: NDArray[Any] = values.copy()
        if context.read_noise is not None:
            result[noisy] += (self.factor - 1.0) * context.read_noise[noisy]
        return result

    @classmethod
    def typical(cls) -> Sequence[Self]:
        """Return mixtures of a few noisy samples and of more but less noisy ones."""
        return cls(share=2.4e-4, factor=3.0), cls(share=3e-3, factor=2.0), cls(share=6e-5, factor=5.0)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return mixtures with the fourth Hermite score that is seen, of several factors."""
        found: list[Self] = []
        for effect in cls.typical():
            found += strength_of(evidence, effect, "He4")
        return found

    def marginal(self, model: MarginalModel, maps: PixelMaps) -> MarginalModel:
        """Return the law with noise of two widths."""
        return model.with_noise(np.array([1.0 - self.share, self.share]), width=np.array([1.0, self.factor]))
