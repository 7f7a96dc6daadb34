"""Differential nonlinearity of the ADC: codes of unequal width, those of no width included.

The lower edge of code c lies at ``c - 1/2 + d_c`` (IEEE Std 1241): shifts of edges from the matching of
comparators and capacitors, the same code by code for everything that goes through that ADC. An error of the
weight of one binary bit repeats with the bit's period (period 16 in EMCCD bias frames, Harpsoe et al. 2012,
A&A 542, A23; binary offsets in many instruments, Boone et al. 2018, PASP 130, 064504). A missing code, of a
converter or of a look-up table behind it, is one whose two edges coincide: a DNL of -1 LSB.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.codes import (
    code_range,
    edge_shifts,
    few_shifts,
    roughness,
    usable_codes,
)
from pchem_pipeline.effects.estimators.regression import SIGNIFICANT, multiple_of
from pchem_pipeline.effects.framework.effect import Code, Count, Effect, Lsb, Plane, register_effect
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)

_CHUNK = 1024
# random edges further away would change their order, others further than a code leave it
_FARTHEST_RANDOM, _FARTHEST = 0.499, 1.0
# fall of chi2 that one of 8 bits must bring
_BIT_GAIN = 12.0


@register_effect
class AdcDnl(Effect):
    """Shifts of the code edges.

    Signature: counts per DN, summed over the pixels, deviate with alternating sign from code to code; every
    pixel's histogram fits worse, since the pattern is fixed in DN and not at a pixel's peaks.
    """

    tag: Literal["adc_dnl"] = Field(default="adc_dnl", description="name of the effect")
    plane = Plane.ADC
    along = 2
    title = "differential nonlinearity of the ADC (DNL), bit weight error, missing codes"
    source = "IEEE Std 1241; Harpsoe et al. 2012, A&A 542, A23; Boone et al. 2018, PASP 130, 064504"
    signature = (
        "code.rough",
        "code.alternating",
        "code.period2",
        "code.period4",
        "code.period8",
        "code.period16",
        "shape.goodness.mean",
    )
    strength = "dnl_lsb"
    power = 2.0
    may_be_at_bound = ("dnl_lsb",)
    separate: ClassVar[Mapping[str, str]] = {
        "gain_stitch": "a ramp over many codes: a stitch shifts all codes above it, DNL single codes",
        "clipping": "a shifted bias: DNL affects all codes, clipping the extreme one",
        "adc_inl": "a ramp or a shifted bias: DNL varies from code to code, INL smoothly",
    }
    dnl_lsb: Lsb = Field(
        ge=-1,
        le=1,
        description="random: rms deviation of the code widths, LSB; edges: scale of `edges`, LSB; bit: error "
        "of the bit's weight, sign included, LSB",
    )
    pattern: Literal["random", "bit", "edges"] = Field(
        default="random", description="random: by code; bit: one binary weight; edges: as listed"
    )
    per_column: bool = Field(
        default=False, description="random pattern: one ADC per column, with its own shifts"
    )
    bit: Count = Field(default=0, ge=0, le=23, description="bit pattern: which bit, 0 the least significant")
    first_code: Code = Field(default=0, ge=0, description="edges pattern: code of the first of `edges`, DN")
    edges: tuple[float, ...] = Field(
        default=(),
        max_length=1 << 16,
        description="edges pattern: shift of the lower edge of each code, in units of dnl_lsb",
    )

    #: at 0.006 LSB: random by code, and wrong weights of bits, as visible in fewer codes
    typical_values = (
        {"dnl_lsb": 0.006},
        *({"dnl_lsb": round(0.006 * 2 ** (bit / 2), 4), "pattern": "bit", "bit": bit} for bit in range(4)),
    )

    @model_validator(mode="after")
    def _edges_where_they_belong(self) -> Self:
        if (self.pattern == "edges") != bool(self.edges):
            raise ValueError("adc_dnl: pattern edges and the list `edges` belong together; give both or none")
        if self.per_column and self.pattern != "random":
            raise ValueError(f"adc_dnl: per_column is for pattern random, not {self.pattern}; leave it out")
        return self

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal at the ADC (frame, y, x), DN, moved against the edges' shifts."""
        if not values.size:
            return values.copy()
        code = np.rint(values).astype(np.int64)
        # no edge is further than a code away, so a sample is at most in the next one
        first, last = int(code.min()), int(code.max()) + 1
        columns = np.arange(context.shape[1]) if self.per_column else None
        shift = self._shifts(first, last, context, columns)
        index = code - first
        lower, upper = (shift[i] if columns is None else shift[i, columns] for i in (index, index + 1))
        place = values - code
        result: AnyArray = values + (place >= 0.5 + upper) - (place < -0.5 + lower)
        return result

    def _shifts(self, first: int, last: int, context: EffectContext, columns: IntArray | None) -> FloatArray:
        """Return the shifts of the edges of codes ``first .. last``, DN: (codes,) or (codes, x)."""
        if self.pattern != "random":
            return self._listed(np.arange(first, last + 1))
        parts = []
        for chunk in range(first // _CHUNK, last // _CHUNK + 1):
            # a negative code has no edge in the ADC, but the signal may lie there before it is cut
            draw = chunk & 0xFFFF
            if columns is None:
                parts.append(context.random.generator(draw=draw).standard_normal(_CHUNK))
            else:
                drawn = [
                    context.random.generator(x=int(x), draw=draw).standard_normal(_CHUNK) for x in columns
                ]
                parts.append(np.stack(drawn, axis=1))
        begin = first - first // _CHUNK * _CHUNK
        chosen = np.concatenate(parts)[begin : begin + last - first + 1]
        # a width is the difference of two edges
        shift = chosen * (self.dnl_lsb / np.sqrt(2.0))
        return np.asarray(np.clip(shift, -_FARTHEST_RANDOM, _FARTHEST_RANDOM), np.float64)

    def _listed(self, wanted: IntArray) -> FloatArray:
        """Return the shifts of the edges of successive codes that need no random numbers, DN.

        Where a list would change the order of two edges they coincide.
        """
        codes = np.arange(wanted[0] - 1, wanted[-1] + 1)
        if self.pattern == "bit":
            shift = (codes >> self.bit & 1) - 0.5
        else:
            place = codes - self.first_code
            inside = (place >= 0) & (place < len(self.edges))
            shift = np.where(inside, np.array(self.edges)[place.clip(0, len(self.edges) - 1)], 0.0)
        edges = codes + np.clip(self.dnl_lsb * shift, -_FARTHEST, _FARTHEST)
        return np.asarray((np.maximum.accumulate(edges) - codes)[1:], np.float64)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return a wrong bit or a few wrong edges where such explain the residuals, and all edges."""
        codes, residuals, expected = usable_codes(evidence.code)
        variance, significance = roughness(residuals, expected)
        few = few_shifts(residuals, expected)
        bit = _best_bit(codes, residuals, expected) if codes.size > 1 else None
        found = [] if bit is None else [cls(dnl_lsb=bit[1], pattern="bit", bit=bit[0])]
        if few is not None:
            found += cls._from_shifts(codes, few)
        if significance > SIGNIFICANT:
            found += cls._from_shifts(codes, edge_shifts(residuals, expected, variance))
        return found

    @classmethod
    def _from_shifts(cls, codes: IntArray, shifts: FloatArray) -> list[Self]:
        """Return the effect with these edges, its strength the rms deviation of the widths."""
        used = np.flatnonzero(shifts)
        size = float(np.sqrt(np.mean(np.diff(shifts) ** 2)))
        if not used.size or size <= 0:
            return []
        part = slice(int(used[0]), int(used[-1]) + 1)
        listed = tuple(np.round(shifts[part] / size, 4).tolist())
        first = int(codes[0]) + part.start
        return [cls(dnl_lsb=min(size, 1.0), pattern="edges", first_code=first, edges=listed)]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the edges moved.

        Random shifts are those of a simulation and unknown in a measurement: only a bit or a list can say
        where the edges are, and a random pattern leaves the law as it is.
        """
        if self.pattern == "random":
            return model
        first, last = code_range(maps)
        if self.pattern == "edges":
            first, last = self.first_code, self.first_code + len(self.edges) - 1
        return model.with_edges(first, self._listed(np.arange(first, last + 1)))


def _best_bit(codes: IntArray, residuals: FloatArray, expected: FloatArray) -> tuple[int, float] | None:
    """Return the bit whose wrong weight explains the rough part of the residuals, and the error, LSB."""
    weight = np.sqrt((expected[:-1] * expected[1:]) / (expected[:-1] + expected[1:]))
    rough = np.diff(residuals) * weight
    total, best = float((rough**2).sum()), None
    for bit in range(8):
        edges = (np.arange(codes[0], codes[-1] + 2) >> bit & 1) - 0.5
        pattern = np.diff(np.diff(edges)) * weight
        found = multiple_of(pattern, rough)
        error, gain = found.value, found.sigmas**2
        # what is left must not be much rougher than the counts, or it is not one bit
        left = (total - gain) / rough.size
        if gain > _BIT_GAIN and left < 1.5 and (best is None or gain > best[2]):
            best = (bit, max(-1.0, min(1.0, error)), gain)
    return None if best is None else best[:2]
