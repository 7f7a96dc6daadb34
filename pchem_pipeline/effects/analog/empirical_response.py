"""What is measured and not understood: samples that follow the charge of others, here, there or before.

Whatever hands signal from one sample to another without noise of its own is, to first order, a linear
response (Volterra 1930; Priestley 1981, transfer functions): so much of the charge of the sample at this
distance, of each other sample of the row, of the frame before. Nothing is said about why.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.base.settings import Section
from pchem_pipeline.effects.framework.compose import place_words
from pchem_pipeline.effects.framework.context import ALL_ROWS
from pchem_pipeline.effects.framework.effect import MOST_TOLD, Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.framework.neighbours import neighbour_words, neighbours
from pchem_pipeline.effects.framework.region import Region, Span
from pchem_pipeline.effects.types import AnyArray, EffectContext, FloatArray, PixelMaps, SampleLaw

#: What a sample follows: another one, or each other one of a row, a column or a frame.
Source = Literal["sample", "row", "column", "frame"]
#: Along the rows the columns are counted from the other end, and along the columns the rows.
Axis = Literal["rows", "columns"]
AXES: dict[Axis, int] = {"rows": 2, "columns": 1}
_ALONG: dict[Source, tuple[int, ...]] = {"sample": (), "row": (2,), "column": (1,), "frame": (1, 2)}
_FAR = 8.0  # standard deviations of the charge, and electrons, beyond which there is none


class ResponseTerm(Section):
    """A sample, or a row, column or frame of samples, that others follow."""

    of: Source = Field(default="sample", description="what is followed: a sample, or a row, column, frame")
    place: tuple[int, int, int] = Field(
        default=(0, 0, 0),
        description="where it is from the sample that follows: frames, rows, columns (before it: negative)",
    )
    weight: float = Field(default=1.0, ge=-1, le=1, description="relative response, no unit")
    number: int = Field(
        default=1, ge=1, description="how many samples a row, column or frame has, for the law of the pixels"
    )
    mirrored: tuple[Axis, ...] = Field(
        default=(),
        max_length=2,
        description="along what the sensor is mirrored: the place is then from the sample's mirror image",
    )
    above: float = Field(
        default=0.0,
        ge=0,
        description="charge of a sample up to which it is not followed, e-; 0: all of it is",
    )
    columns: tuple[int, int] | None = Field(
        default=None, description="first column of those that follow, and the one behind; null: all"
    )

    @model_validator(mode="after")
    def _of_the_past(self) -> Self:
        if self.place[0] > 0 or any(self.place[axis] for axis in _ALONG[self.of]):
            raise ValueError("place: of this frame or before it; 0 along what is followed as a whole")
        if self.of == "sample" and not any(self.place) and not self.mirrored:
            raise ValueError("place: a sample does not follow itself")
        if self.of != "sample" and (self.above or self.mirrored):
            raise ValueError("above, mirrored: of single samples only")
        return self

    @property
    def source(self) -> int | None:
        """The column that a single one follows across rows or frames; None where it is told by distance."""
        if self.of != "sample" or self.mirrored or self.columns is None:
            return None
        if self.columns[1] - self.columns[0] > 1:
            return None
        return self.columns[0] + self.place[2] if any(self.place[:2]) and self.place[2] else None

    def describe(self) -> str:
        """Return in words what is followed."""
        if self.of == "sample":
            what = f"what exceeds {self.above:g} e- in " if self.above else ""
            if self.mirrored:
                beside = neighbour_words(self.place).removeprefix("the sample ").strip()
                along = " and ".join(self.mirrored)
                return f"{what}its mirror image along the {along}{f', {beside}' if beside else ''}"
            if self.source is not None:
                return f"{what}{neighbour_words((*self.place[:2], 0))} in column {self.source}"
            return f"{what}{neighbour_words(self.place)}"
        where = neighbour_words(self.place).removeprefix("the sample ").strip()
        what = f"each {'other ' if not any(self.place) else ''}sample of the {self.of}"
        return what + (f" {where}" if any(self.place) else "")

    def seen(self, charge: FloatArray, exposure: FloatArray) -> FloatArray:
        """Return the charge that each sample follows, about its mean (frame, y, x), e-.

        Args:
            charge: electrons of the samples (frame, y, x).
            exposure: mean number of electrons (y, x).
        """
        charge = np.maximum(charge - self.above, 0.0) - excess_moments(exposure, self.above)[0]
        axes = _ALONG[self.of]
        sums = np.broadcast_to(charge.sum(axis=axes, keepdims=True), charge.shape) if axes else charge
        if not any(self.place) and not self.mirrored:
            return np.asarray(sums - charge)
        sums = np.flip(sums, tuple(AXES[each] for each in self.mirrored))
        found, known = neighbours(np.ascontiguousarray(sums), self.place)
        return np.where(known, found, 0.0)


def excess_moments(exposure: FloatArray, above: float) -> tuple[FloatArray, FloatArray]:
    """Return the mean and the variance of what Poisson counts have above a number, e- and e-^2.

    Args:
        exposure: mean counts, any shape.
        above: the number, 0 or more.
    """
    if above == 0.0:
        return exposure, exposure
    largest = float(np.max(np.nan_to_num(exposure), initial=0.0))
    chance, mean, square = np.exp(-exposure), np.zeros(exposure.shape), np.zeros(exposure.shape)
    for k in range(1, math.ceil(largest + _FAR * largest**0.5 + _FAR)):
        chance = chance * exposure / k
        excess = max(k - above, 0.0)
        mean += excess * chance
        square += excess**2 * chance
    return mean, square - mean**2


@register_effect
class EmpiricalResponse(Effect):
    """Samples that follow the charge of others by parts that are measured.

    Signature: none of its own; it is measured where the data disagree with all that is known, and describes
    which samples follow which without a name for what makes them so.
    """

    tag: Literal["empirical_response"] = Field(default="empirical_response", description="name of the effect")
    plane = Plane.ANALOG
    title = "empirical response to the charge of other samples"
    source = "Volterra 1930, Priestley 1981 (linear responses)"
    strength = "response"
    empirical = True
    far_reaching = True
    response: Ratio = Field(
        ge=0,
        le=1,
        description="share of the charge of another sample that is added, for weight 1, no unit",
    )
    terms: tuple[ResponseTerm, ...] = Field(
        min_length=1,
        max_length=32,
        description="what samples follow: `of` (sample, row, column, frame), `place`, relative `weight`",
    )

    #: a sample that follows the one read four before it
    typical_values = ({"response": 0.01, "terms": (ResponseTerm(place=(0, 0, -4)),)},)

    def halo(self) -> int:
        """Return how far across rows samples follow others, px."""
        return max(
            ALL_ROWS if 1 in _ALONG[term.of] or "columns" in term.mirrored else abs(term.place[1])
            for term in self.terms
        )

    def history(self) -> int:
        """Return how many frames before it matter."""
        return max(-term.place[0] for term in self.terms)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with parts of the charge of other samples about its mean."""
        charge = np.asarray(context.charge, np.float64)
        exposure = np.asarray(context.truth["quanta_exposure"], np.float64)
        found = np.array(values, np.float64)
        for term in self.terms:
            columns = slice(*term.columns) if term.columns else slice(None)
            found[..., columns] += self.response * term.weight * term.seen(charge, exposure)[..., columns]
        return found

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with the columns of its terms, and the places of mirror images, as a window has them."""
        return self._moved((rows, columns), shape, -1)

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with the columns of its terms, and places of mirror images, as the sensor has them."""
        return self._moved((rows, columns), shape, 1)

    def _moved(self, window: tuple[Span, Span], shape: tuple[int, int], way: int) -> Self:
        # of what is mirrored in the middle of the window the image in that of the sensor lies elsewhere
        middle = [size - first - end for size, (first, end) in zip(shape, window, strict=True)]
        by = way * window[1][0]
        last = shape[1] if way > 0 else window[1][1] - window[1][0]

        def moved(term: ResponseTerm) -> ResponseTerm:
            frames, *place = term.place
            for number, along in enumerate(("columns", "rows")):
                place[number] += way * middle[number] if along in term.mirrored else 0
            found = term.model_copy(update={"place": (frames, *place)})
            if term.columns is None:
                return found
            ends = tuple(min(max(edge + by, 0), last) for edge in term.columns)
            return found.model_copy(update={"columns": ends})

        return self.model_copy(update={"terms": tuple(moved(term) for term in self.terms)})

    def by_law(self, shape: tuple[int, int]) -> Sequence[Self]:
        """Return it in columns that follow by the same terms."""
        if all(term.columns is None for term in self.terms):
            return (self,)
        ends = {0, shape[1]}.union(*(term.columns for term in self.terms if term.columns))
        own = (self.region and self.region.columns) or ((0, shape[1]),)
        found = []
        for first, end in itertools.pairwise(sorted(end for end in ends if end <= shape[1])):
            terms = tuple(
                term.model_copy(update={"columns": None})
                for term in self.terms
                if term.columns is None or term.columns[0] <= first < term.columns[1]
            )
            columns = tuple((max(first, a), min(end, b)) for a, b in own if max(first, a) < min(end, b))
            if terms and columns:
                place = {} if self.region is None else self.region.numbers()
                region = Region.model_validate({**place, "columns": columns})
                found.append(self.model_copy(update={"terms": terms, "region": region}))
        return found

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the variance of what samples follow, of electrons as many as the pixel's own.

        Terms of some columns are left out: see `by_law`.
        """
        exposure = np.nan_to_num(maps.quanta_exposure)
        power: Any = sum(
            term.number * term.weight**2 * excess_moments(exposure, term.above)[1]
            for term in self.terms
            if term.columns is None
        )
        return model.with_variance(e2=self.response**2 * power)

    def describe(self) -> str:
        """Return what is known of it."""
        place = f" in {place_words(self)}" if place_words(self) else ""
        followed: dict[str, list[str]] = {}
        for term in sorted(self.terms, key=lambda term: -abs(term.weight)):
            only = f" in {Region(columns=(term.columns,)).describe()}" if term.columns else ""
            followed.setdefault(term.describe(), []).append(
                f"{100.0 * self.response * term.weight:+.2g} %{only}"
            )
        told = [f"{_few(parts)} of {what}" for what, parts in list(followed.items())[:MOST_TOLD]]
        more = f", and {len(followed) - MOST_TOLD} more" if len(followed) > MOST_TOLD else ""
        return f"samples{place} depend on the charge of other samples ({', '.join(told)}{more})"


def _few(parts: Sequence[str]) -> str:
    """Return the first of some parts in words, and how many more there are."""
    more = f" and {len(parts) - MOST_TOLD} more" if len(parts) > MOST_TOLD else ""
    return f"{', '.join(parts[:MOST_TOLD])}{more}"
