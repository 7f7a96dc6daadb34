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

from pchem_pipeline.effects.estimators.pixel_law import PixelLaw, typical_pixels
from pchem_pipeline.effects.estimators.regression import SIGNIFICANT, multiple_of
from pchem_pipeline.effects.estimators.response import first_order
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, PixelMaps, SampleLaw

_TAIL_PIXELS, _TAIL_DOUBT = 40, 0.15
# widths that are guessed, at a share so small that samples and moments go in proportion to it
_FACTORS, _SMALL, _MOST = (1.25, 1.4, 1.6, 2.0, 2.5, 3.0, 5.0, 8.0, 13.0), 1e-3, 4


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

    #: few noisy samples, and more but less noisy ones; the last is near a Student law of many degrees of
    #: freedom: kurtosis almost without tails
    typical_values = tuple(
        {"share": share, "factor": factor}
        for share, factor in ((2.4e-4, 3.0), (3e-3, 2.0), (6e-5, 5.0), (5e-2, 1.25))
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
        """Return mixtures with the samples below the codes and the He4 that are seen.

        The share is the weighted mean of what either says; the factors for which they agree best, the best
        first.
        """
        tail = _TailBelow(evidence)
        found: list[tuple[float, Self]] = []
        for width in _FACTORS:
            effect = cls(share=_SMALL, factor=width)
            factor, error = first_order(evidence, effect, "He4", cut=8.0)
            other, other_error = tail.first_order(effect)
            errors = np.array([error, other_error])
            mean = multiple_of(np.ones(2), np.array([factor, other]), errors**-2.0)
            if mean.sigmas > SIGNIFICANT:
                disagreement = (factor - other) ** 2 / (error**2 + other_error**2)
                found.append((disagreement, effect.scaled(mean.value)))
        return [effect for _, effect in sorted(found, key=lambda item: item[0])[:_MOST]]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with noise of two widths."""
        return model.with_noise(np.array([1.0 - self.share, self.share]), width=np.array([1.0, self.factor]))


class _TailBelow:
    """The samples below the codes of the pixels: how many are seen, and how many there should be."""

    def __init__(self, evidence: Evidence):
        self.n_frames = evidence.n_frames
        seen = evidence.tail_low[evidence.maps.usable].astype(np.float64)
        # single pixels with very many are another effect's: they count for a few more than the others
        self.seen = float(np.minimum(seen, 3.0 + 5.0 * float(seen.mean())).sum()) if seen.size else 0.0
        # what is expected differs much between pixels, since codes are whole
        chosen, groups = typical_pixels(evidence.maps, _TAIL_PIXELS)
        self.numbers = np.array([group.size for group in groups])
        self.laws = [PixelLaw(evidence.maps, int(pixel), evidence.n_frames) for pixel in chosen]
        self.expected = self._number(SampleLaw())

    def _number(self, law: SampleLaw) -> float:
        below = np.array([pixel.below(law) for pixel in self.laws])
        return float((self.numbers * below).sum()) * self.n_frames

    def first_order(self, effect: HeavyTailedNoise) -> tuple[float, float]:
        """Return how many times an effect's share explains the samples, and the standard error."""
        more = self._number(SampleLaw().with_noise([1.0], width=effect.factor)) * effect.share
        if not more > 0:
            return 0.0, np.inf
        variance = max(self.seen, self.expected) + 1.0 + (_TAIL_DOUBT * self.expected) ** 2
        return (self.seen - self.expected) / more, float(np.sqrt(variance)) / more
