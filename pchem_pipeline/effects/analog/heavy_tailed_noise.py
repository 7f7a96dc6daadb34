"""Heavy-tailed read noise: some samples are noisier than the others, in every pixel.

The read noise of a source follower is Gaussian only where many traps act together; a few of them, or pickup
in bursts, make it a scale mixture: ``R`` has the pixel's ``sigma`` with probability ``1 - share`` and
``factor sigma`` with probability ``share`` (Tukey 1960, the contaminated normal). Noise histograms of CMOS
imagers with such tails are attributed to random telegraph noise of the source followers (Leyris et al.
2006; Wang, Rao, Mierop and Theuwissen 2006).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.base import Effect, Plane, register_effect
from pchem_pipeline.effects.pixel_law import PixelLaw, typical_pixels
from pchem_pipeline.effects.response import strength_of
from pchem_pipeline.model.marginal import MarginalModel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.context import EffectContext
    from pchem_pipeline.effects.evidence import Evidence, PixelMaps

__all__ = ["HeavyTailedNoise"]

_Heavy = TypeVar("_Heavy", bound="HeavyTailedNoise")


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
        "tail.low.count", "shape.He4.mean", "tail.low.pixels", "shape.goodness.mean", "shape.He2C2.mean",
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
        """Return mixtures with the number of samples below the codes, or else the He4, that are seen."""
        below = _tail_below(evidence)
        found: list[Self] = []
        for effect in cls.typical():
            found += _of_tail(effect, evidence, *below)
        if found:
            return found
        for effect in cls.typical():
            found += strength_of(evidence, effect, "He4")
        return found

    def marginal(self, model: MarginalModel, maps: PixelMaps) -> MarginalModel:
        """Return the law with noise of two widths."""
        return model.with_noise(np.array([1.0 - self.share, self.share]), width=np.array([1.0, self.factor]))


def _tail_below(evidence: Evidence) -> tuple[float, list[PixelLaw], list[int]]:
    """Return the samples seen below the codes of the pixels, typical pixels, and how many each stands for.

    Single pixels with very many are another effect's: a pixel counts for at most a few more than the others.
    """
    usable = evidence.maps.usable
    seen = evidence.tail_low[usable].astype(np.float64)
    if not seen.size:
        return 0.0, [], []
    limit = 3.0 + 5.0 * float(seen.mean())
    chosen, groups = typical_pixels(evidence.maps)
    laws = [PixelLaw(evidence.maps, int(pixel), evidence.n_frames) for pixel in chosen]
    return float(np.minimum(seen, limit).sum()), laws, [group.size for group in groups]


def _of_tail(
    effect: _Heavy,
    evidence: Evidence,
    seen: float,
    laws: Sequence[PixelLaw],
    numbers: Sequence[int],
) -> list[_Heavy]:
    """Return the effect with the share that explains the samples below the codes; empty if there are few."""
    expected = more = 0.0
    for law, number in zip(laws, numbers, strict=True):
        wide = law.below(MarginalModel().with_noise([1.0], width=effect.factor))
        expected += number * evidence.n_frames * law.below(MarginalModel())
        more += number * evidence.n_frames * wide
    if seen < 5 or more <= 0 or seen - expected < 4.0 * np.sqrt(expected + 1.0):
        return []
    return [effect.model_copy(update={"share": min((seen - expected) / more, 1.0)})]
