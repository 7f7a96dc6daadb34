"""What is measured and not understood: samples that come out moved by so many DN, in such a share.

Where no known effect explains the samples, their law can still be told. This component says which shares of
the samples come out moved, and by how much: the mixing law of a deconvolution, which maximum likelihood makes
a few atoms of (Laird 1978; Lindsay 1983). Nothing is said about why.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.framework.compose import place_words
from pchem_pipeline.effects.framework.effect import Effect, Plane, register_effect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.framework.context import EffectContext
    from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
    from pchem_pipeline.model.law.sample_law import SampleLaw


@register_effect
class Empirical(Effect):
    """A share of the samples is moved by one of several shifts, independently of all else.

    Signature: none of its own; it is measured where the data disagree with all that is known, and describes
    the samples without a name for what makes them so.
    """

    tag: Literal["empirical"] = Field(default="empirical", description="name of the effect")
    plane: ClassVar[Plane] = Plane.ADC
    title: ClassVar[str] = "Measured shifts of samples, without an explanation"
    source: ClassVar[str] = "Laird 1978, Lindsay 1983 (maximum likelihood of a mixing distribution)"
    strength: ClassVar[str] = "share"
    measured_only: ClassVar[bool] = True
    share: float = Field(ge=0, le=1, description="share of the samples that are moved, no unit")
    shift_dn: tuple[float, ...] = Field(min_length=1, max_length=16, description="by how much, DN")
    weight: tuple[float, ...] = Field(
        min_length=1, max_length=16, description="relative frequency of each of these shifts, no unit"
    )

    @model_validator(mode="after")
    def _of_equal_length(self) -> Self:
        if len(self.shift_dn) != len(self.weight) or min(self.weight) < 0 or not sum(self.weight) > 0:
            raise ValueError("empirical: give one weight, at least 0, for each of shift_dn")
        return self

    def shares(self) -> NDArray[np.float64]:
        """Return the share of the samples that each shift moves."""
        weight = np.asarray(self.weight, np.float64)
        return np.asarray(self.share * weight / weight.sum())

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the signal (frame, y, x), DN, with some samples moved."""
        drawn = context.random.uniform(("frame", "y", "x"))
        which = np.searchsorted(np.cumsum(self.shares()), drawn.ravel(), side="right").reshape(drawn.shape)
        moved: NDArray[Any] = values + np.append(self.shift_dn, 0.0)[which]
        return moved

    @classmethod
    def typical(cls) -> Sequence[Self]:
        """Return a hundredth of the samples 8 DN too low."""
        return (cls(share=0.01, shift_dn=(-8.0,), weight=(1.0,)),)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return none: it is measured where all else has failed, and competes with nothing."""
        return ()

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with satellites at the shifts: exact."""
        shares = self.shares()
        weights = np.append(shares, max(1.0 - float(shares.sum()), 0.0))
        return model.with_noise(weights, shift_dn=np.append(self.shift_dn, 0.0))

    def words(self) -> str:
        """Return what is known of it."""
        shares = self.shares()
        order = np.argsort(-shares)
        place = f" in {place_words(self)}" if place_words(self) else ""
        parts = [f"{shares[i]:.2g} by {self.shift_dn[i]:+.3g} DN" for i in order[:4]]
        return (
            f"a share of {self.share:.2g} of the samples{place} comes out moved at the converter "
            f"({', '.join(parts)})"
        )
