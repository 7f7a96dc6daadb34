"""What is measured and not understood of electrons: lost, moved or followed by others, as many as are there.

To first order in its strength, whatever electrons do to each other shows in two things only: how far their
number varies more or less than Poisson, and how numbers of neighbours and of successive frames go together
(Cox and Isham 1980, Point processes, on factorial cumulants). The simplest events that make both describe the
samples; nothing is said about why.
"""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.base.settings import Section
from pchem_pipeline.base.units import per_cent
from pchem_pipeline.effects.estimators.electrons import binomial_upper
from pchem_pipeline.effects.framework.compose import place_words
from pchem_pipeline.effects.framework.effect import DEPTH, Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.framework.neighbours import neighbour_words, neighbours
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)

#: What happens to electrons: some that have others in their sample are lost or moved, or each brings others,
#: or all of a sample are lost together.
Fate = Literal["lost", "moved", "followed", "emptied"]
_MOST_LATER = 0.9  # others that an electron brings to later frames, beyond which there is no steady number
_EMPTY = 1e-9  # of its exposure, what a sample has that loses all of its electrons


class ElectronMode(Section):
    """Something that happens to electrons, in proportion to their number or to that of their pairs.

    Lost, moved: each electron with a chance for every other one in its sample. Followed: each brings a
    Poisson number of others, and those that come to a later frame bring others themselves. Emptied: a sample
    loses all of its electrons.
    """

    fate: Fate = Field(
        description="lost, moved (to the place), followed (by others, at the place), or emptied (all of them)"
    )
    weight: float = Field(default=1.0, gt=0, description="relative frequency, no unit")
    place: tuple[int, int, int] = Field(
        default=(0, 0, 0), description="where: frames later, rows and columns from the electron's pixel"
    )

    @model_validator(mode="after")
    def _of_the_future(self) -> Self:
        if self.place[0] < 0 or (self.fate == "moved") > any(self.place):
            raise ValueError("place: of this frame or a later one; electrons are moved to another sample")
        if self.fate == "emptied" and any(self.place):
            raise ValueError("place: a sample that is emptied has none")
        return self

    def describe(self, chance: float) -> str:
        """Return in words how the numbers vary together, with a chance (or a mean number)."""
        if self.fate == "emptied":
            return f"{per_cent(chance)} of the samples have no electrons"
        where = neighbour_words(self.place) if any(self.place) else "the same sample"
        if self.fate == "followed":
            return f"{chance:+.2g} electrons in {where} per electron"
        more = f", to {where}" if self.fate == "moved" else ""
        return f"a sample of k electrons loses {chance:.2g} k (k - 1) of them{more}"


@register_effect
class EmpiricalElectrons(Effect):
    """Electrons that are lost, one by one or together, moved or followed by others, as often as is measured.

    Signature: none of its own; it is measured where the data disagree with all that is known, and describes
    the law of the electron numbers without a name for what makes it so.
    """

    tag: Literal["empirical_electrons"] = Field(
        default="empirical_electrons", description="name of the effect"
    )
    plane = Plane.CHARGE
    title = "empirical electron-number correlations"
    source = "Cox and Isham 1980, Point processes (factorial cumulants)"
    strength = "chance"
    empirical = True
    chance: Ratio = Field(ge=0, le=0.5, description="largest probability or mean number (weight 1), no unit")
    modes: tuple[ElectronMode, ...] = Field(
        min_length=1, max_length=8, description="what happens: its `fate`, `place` and relative `weight`"
    )

    #: electrons of which each hundredth brings another one to the next frame
    typical_values = ({"chance": 0.01, "modes": (ElectronMode(fate="followed", place=(1, 0, 0)),)},)

    @property
    def measured_parts(self) -> int:
        """How many modes there are."""
        return len(self.modes)

    def halo(self) -> int:
        """Return how far electrons come across rows, px."""
        return max(abs(mode.place[1]) for mode in self.modes) * (DEPTH if self.history() else 1)

    def history(self) -> int:
        """Return how many frames before it matter."""
        return DEPTH * max(mode.place[0] for mode in self.modes)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, without those that go and with those that come."""
        own, chance = values.astype(np.int64), self._chances()
        for number, mode in enumerate(self.modes):
            if mode.fate != "followed":
                u = context.random.uniform(("frame", "y", "x"), number)
                emptied = mode.fate == "emptied"
                gone = np.where(u < chance[number], own, 0) if emptied else _gone(own, u, chance[number])
                own = own - gone + (_arrived(gone, mode.place) if mode.fate == "moved" else 0)
        followed = [n for n, mode in enumerate(self.modes) if mode.fate == "followed"]
        found = own
        for _ in range(DEPTH if self.history() else 1):
            before, found = found, own
            for number in followed:
                place = self.modes[number].place
                source = _arrived(before if place[0] else own, place)
                mean = np.asarray(chance[number] * source, np.float64)
                found = np.asarray(found + context.random.poisson(mean, number))
        return found.astype(values.dtype)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law of what is left, and of as many more as come; H is the exposure without all that.

        Those that come are taken for as independent as those that are there, and those that were moved for
        as many as those that come in their place.
        """
        here = later = 0.0
        for mode, chance in zip(self.modes, self._chances(), strict=True):
            if mode.fate == "lost":
                model = model.with_counts("lost", chance)
            elif mode.fate == "emptied":
                model = model.with_exposures((chance, 1.0 - chance), (_EMPTY, 1.0))
            elif mode.fate == "followed" and mode.place[0]:
                later += chance
            elif mode.fate == "followed":
                here += chance
        return model.with_exposures((1.0,), ((1.0 + here) / max(1.0 - later, 1.0 - _MOST_LATER),))

    def _chances(self) -> list[float]:
        """Return the chance, or mean number, of each mode."""
        largest = max(mode.weight for mode in self.modes)
        return [self.chance * mode.weight / largest for mode in self.modes]

    def describe(self) -> str:
        """Return what is known of it."""
        place = f" in {place_words(self)}" if place_words(self) else ""
        told = [mode.describe(chance) for mode, chance in zip(self.modes, self._chances(), strict=True)]
        return f"electron numbers{place} are not independent ({'; '.join(told)})"


def _gone(electrons: IntArray, u: FloatArray, chance: float) -> IntArray:
    """Return how many electrons of each sample go, each with a chance for every other one."""
    gone = np.zeros(electrons.shape, np.int64)
    here = np.nonzero(electrons > 1)
    k = electrons[here]
    gone[here] = binomial_upper(u[here], k, np.minimum(chance * (k - 1), 0.99))
    return gone


def _arrived(electrons: IntArray, place: tuple[int, int, int]) -> IntArray:
    """Return how many electrons come from the samples of which each is at a place, 0 from beyond the edge."""
    if not any(place):
        return electrons
    source, known = neighbours(electrons, (-place[0], -place[1], -place[2]))
    return np.where(known, source, 0)
