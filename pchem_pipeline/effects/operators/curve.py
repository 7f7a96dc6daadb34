"""Curves: a monotone map of the voltage or the code, for all pixels or one for each column."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.effects.estimators.codes import (
    Stitch,
    best_bend,
    best_curve,
    best_stitch,
    code_range,
    edge_shifts,
    few_shifts,
    roughness,
    through_knots,
    usable_codes,
)
from pchem_pipeline.effects.estimators.common_modes import SIGNIFICANT, multiple_of
from pchem_pipeline.effects.framework.effect import (
    Code,
    Count,
    Dn,
    Effect,
    Factors,
    Lsb,
    PerElectron,
    Plane,
    Radians,
    Ratio,
)
from pchem_pipeline.effects.framework.evidence import CodeResiduals
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)

Noise = Literal["kept", "bent"]


class Nonlinearity(Effect, tag="nonlinearity"):
    """Relative change of the step per electron, the same in every pixel.

    The capacitance of the sense node and the gain of the source follower depend on the voltage (Janesick
    2007, V/V and V/e- nonlinearity): ``k`` electrons give ``k (1 + b (k - 1) / 2)`` in units of the first
    step, and the step from ``k`` to ``k + 1`` is ``1 + b k``. What comes after the read noise (an amplifier,
    a converter) makes that ``1 + b k`` times as large, too.

    Signature: the score of position against the square of the electron number (He1C2) has one sign in all
    pixels; then He3C1 and He3; He2C1 where the read noise is bent, too. Nothing in time or space. The gain
    that the PCD finds is that of the steps which the pixel's exposure reaches.
    """

    plane = Plane.ANALOG
    title = "nonlinearity of the pixel's response"
    source = "Janesick 2007 (V/V and V/e- nonlinearity)"
    factors = Factors("response", "each pixel", "with the charge of the sample")
    signature = ("shape.He1C2.mean", "code.smooth", "shape.He3C1.mean", "shape.He1C2.slope", "shape.C3.mean")
    strength = "step_change"
    separate: ClassVar[Mapping[str, str]] = {
        "adc_inl": "a sweep of the bias: INL is fixed in DN, pixel nonlinearity in electrons",
        "signal_dependent_noise": "a series of exposures: nonlinearity bends the means, noise the variances",
        "noise_skew": "a series of exposures: nonlinearity grows with the signal, skewed noise does not",
        "branching_counts": "a series of exposures: nonlinear peak spacing is the same at any exposure",
    }
    #: steps that grow and steps that shrink, before the read noise and after
    typical_values = tuple(
        {"step_change": change, "noise": noise} for noise in ("kept", "bent") for change in (2e-3, -2e-3)
    )
    step_change: PerElectron = Field(
        ge=-0.2, le=0.2, description="relative change of the peak spacing per electron, 1/e-"
    )
    noise: Noise = Field(
        default="kept",
        description="kept: nonlinearity before the read noise (sense node); bent: after it (amplifiers)",
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, on a bent comb; draws nothing."""
        if self.noise == "bent":
            bend = values.astype(np.float64)
        else:
            bend = np.zeros(values.shape) if context.charge is None else context.charge.astype(np.float64)
        bend *= bend - 1.0
        bend *= 0.5 * self.step_change
        bend += values
        return bend

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the comb bent, and the noise around it where that is."""
        law = model.with_levels(curvature=self.step_change)
        if self.noise == "kept":
            return law
        flat = maps.flat
        analog = np.maximum(flat.read_noise_dn**2 - QUANTISATION_VARIANCE, 0.0)
        variance = np.nan_to_num(analog * flat.conversion_gain**2)
        return law.with_variance(
            per_electron=2.0 * self.step_change * variance, per_electron2=self.step_change**2 * variance
        )


_FEWEST_KNOTS = 4
# places of the table of a curve from one knot to the next
_FINER = 32


class AdcInl(Effect, tag="adc_inl"):
    """Smooth deviation of the transfer curve, the same for every pixel.

    What the ADC converts is ``x + a d(x)`` instead of x (IEEE Std 1241: INL is the deviation of the transfer
    curve from the best line). The form d is a sine, ``sin(2 pi x / P + phi)``, or a smooth curve through
    knots. It is fixed in DN, whatever the bias and the gain of a pixel.

    Signature: counts per DN, summed over the pixels, deviate smoothly along DN, beyond what the pixels' own
    bias and gain take up; pixels of different bias show the same pattern at the same DN.
    """

    plane = Plane.ADC
    along = 1
    title = "integral nonlinearity of the ADC (INL)"
    source = "IEEE Std 1241 (terminology and test methods for analog-to-digital converters)"
    factors = Factors("code", "all pixels", "constant")
    signature = (
        "code.smooth", "shape.goodness.mean", "shape.He1C2.mean", "shape.He1C2.chi", "shape.He3.mean",
    )  # fmt: skip
    strength = "inl_lsb"
    separate: ClassVar[Mapping[str, str]] = {
        "gain_stitch": "a ramp of light over all codes: INL is curved everywhere, a stitch is one kink",
        "nonlinearity": "a shifted bias (pedestal): INL is fixed in DN, nonlinearity in charge",
        "adc_dnl": "a ramp over many codes: INL varies smoothly along DN, DNL from code to code",
        "signal_dependent_noise": "a shifted bias: INL shifts peaks, noise only widens them",
    }
    #: at 0.065 LSB with periods of 60 and 150 DN, at two phases each
    typical_values = tuple(
        {"inl_lsb": 0.065, "period_dn": period, "phase": phase}
        for period, phase in itertools.product((60.0, 150.0), (0.0, 1.57))
    )
    inl_lsb: Lsb = Field(
        ge=0, le=1e4, description="largest deviation of the sine, or of `curve` where it is 1, LSB"
    )
    form: Literal["sine", "curve"] = Field(
        default="sine", description="sine: of one period; curve: smooth through the values of `curve`"
    )
    period_dn: Dn = Field(
        default=100.0, ge=4, le=1e6, description="sine: period of the deviation, DN; two bends per period"
    )
    phase: Radians = Field(default=0.0, ge=-100, le=100, description="sine: phase at 0 DN, rad")
    first_dn: Dn = Field(default=0.0, description="curve: DN of the first value of `curve`")
    spacing_dn: Dn = Field(
        default=10.0, gt=0, le=1e6, description="curve: spacing of the values of `curve`, DN"
    )
    curve: tuple[float, ...] = Field(
        default=(),
        max_length=1 << 10,
        description="curve: deviations in units of inl_lsb, through which a natural cubic spline goes; "
        "beyond the ends as at the ends",
    )

    @model_validator(mode="after")
    def _of_one_form_and_monotone(self) -> Self:
        if (self.form == "curve") != bool(self.curve):
            raise ValueError("adc_inl: form curve and the list `curve` belong together; give both or none")
        if self.curve and len(self.curve) < _FEWEST_KNOTS:
            raise ValueError(f"adc_inl: curve needs at least {_FEWEST_KNOTS} values, got {len(self.curve)}")
        if self.inl_lsb * self._steepest() >= 1.0:
            form = f"period_dn {self.period_dn}" if self.form == "sine" else f"spacing_dn {self.spacing_dn}"
            raise ValueError(
                f"adc_inl: inl_lsb {self.inl_lsb} at {form} turns the curve back; "
                f"keep inl_lsb below {1.0 / self._steepest():.4g}"
            )
        return self

    @property
    def measured_parts(self) -> int:
        """One where the curve was measured, none of a sine."""
        return int(self.form == "curve")

    def _steepest(self) -> float:
        """Return the steepest fall of the form, per DN."""
        if self.form == "sine":
            return 2.0 * math.pi / self.period_dn
        return float(np.max(-np.diff(_table(self.curve)) / self._fine, initial=0.0))

    def scaled(self, factor: float) -> Self:
        """Return a copy of ``factor`` times the amplitude, as far as the curve stays monotone."""
        steepest = self._steepest()
        most = 0.99 / steepest if steepest > 0 else math.inf
        return super().scaled(min(factor, most / self.inl_lsb) if self.inl_lsb > 0 else factor)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal at the ADC (frame, y, x), DN, bent; draws nothing."""
        return np.asarray(values + self._deviation(values))

    def _deviation(self, values: AnyArray) -> FloatArray:
        if self.form == "curve":
            table = _table(self.curve)
            places = (values - self.first_dn) / self._fine
            return self.inl_lsb * np.interp(places, np.arange(table.size), table)
        turned = values * (2.0 * math.pi / self.period_dn)
        turned += self.phase
        np.sin(turned, out=turned)
        turned *= self.inl_lsb
        return turned

    @property
    def _fine(self) -> float:
        """Distance of the places of the table, DN."""
        return self.spacing_dn / _FINER

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the curve and the sines that explain the smooth residuals of the codes best."""
        sines = [
            cls(inl_lsb=bend.amplitude, period_dn=bend.period, phase=bend.phase)
            for bend in best_bend(evidence)
            if 2.0 * math.pi * bend.amplitude < bend.period
        ]
        curve = best_curve(evidence)
        if curve is None:
            return sines
        size = float(np.abs(curve.values).max())
        listed = tuple(np.round(curve.values / size, 4).tolist())
        form = cls(inl_lsb=0.0, form="curve", first_dn=curve.first, spacing_dn=curve.spacing, curve=listed)
        if size * form._steepest() < 1.0:  # else it turns back
            return [form.model_copy(update={"inl_lsb": size}), *sines]
        return sines

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the code edges where the bent curve crosses them."""
        first, last = code_range(maps)
        ideal = np.arange(first, last + 1) - 0.5
        edges = ideal.copy()
        # the slope of the deviation is below 1, so this contracts
        for _ in range(50):
            edges = ideal - self._deviation(edges)
        return model.with_edges(first, edges - ideal)


@lru_cache(maxsize=64)
def _table(curve: tuple[float, ...]) -> FloatArray:
    """Return the curve at many places."""
    knots = np.arange(float(len(curve)))
    return through_knots(knots, np.array(curve), np.arange(_FINER * knots[-1] + 1) / _FINER)


_CHUNK = 1024
# random edges further away would change their order, others further than a code leave it
_FARTHEST_RANDOM, _FARTHEST = 0.499, 1.0
# fall of chi2 that one of 8 bits must bring
_BIT_GAIN = 12.0


class AdcDnl(Effect, tag="adc_dnl"):
    """Shifts of the code edges.

    The lower edge of code c lies at ``c - 1/2 + d_c`` (IEEE Std 1241), from the matching of comparators and
    capacitors, the same for everything that goes through that ADC. An error of the weight of one binary bit
    repeats with the bit's period (Harpsoe et al. 2012; Boone et al. 2018). A missing code, of a converter or
    of a look-up table behind it, is one whose two edges coincide: a DNL of -1 LSB.

    Signature: counts per DN, summed over the pixels, deviate with alternating sign from code to code; every
    pixel's histogram fits worse, since the pattern is fixed in DN and not at a pixel's peaks.
    """

    plane = Plane.ADC
    along = 2
    title = "differential nonlinearity of the ADC (DNL, bit weight error, missing codes)"
    source = "IEEE Std 1241; Harpsoe et al. 2012, A&A 542, A23; Boone et al. 2018, PASP 130, 064504"
    factors = Factors("code", "all pixels", "constant")
    signature = (
        "code.rough", "code.alternating", "code.period2", "code.period4", "code.period8", "code.period16",
        "shape.goodness.mean",
    )  # fmt: skip
    strength = "dnl_lsb"
    power = 2.0
    may_be_at_bound = ("dnl_lsb",)
    separate: ClassVar[Mapping[str, str]] = {
        "gain_stitch": "a ramp over many codes: a stitch shifts all codes above it, DNL single codes",
        "clipping": "a shifted bias: DNL affects all codes, clipping the extreme one",
        "adc_inl": "a ramp or a shifted bias: DNL varies from code to code, INL smoothly",
    }
    #: at 0.006 LSB: random by code, and wrong weights of bits, as visible in fewer codes
    typical_values = (
        {"dnl_lsb": 0.006},
        *({"dnl_lsb": round(0.006 * 2 ** (bit / 2), 4), "pattern": "bit", "bit": bit} for bit in range(4)),
    )
    dnl_lsb: Lsb = Field(
        ge=-1,
        le=1,
        description="error of the code widths, LSB; random: its rms; edges: scale of `edges`; bit: error "
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
        return np.asarray(values + (place >= 0.5 + upper) - (place < -0.5 + lower))

    def _shifts(self, first: int, last: int, context: EffectContext, columns: IntArray | None) -> FloatArray:
        """Return the shifts of the edges of codes ``first .. last``, DN: (codes,) or (codes, x)."""
        if self.pattern != "random":
            return self._listed(np.arange(first, last + 1))
        # a negative code has no edge in the ADC, but the signal may lie there before it is cut
        draws = [chunk & 0xFFFF for chunk in range(first // _CHUNK, last // _CHUNK + 1)]

        def normal(x: int | None) -> FloatArray:
            parts = [context.random.generator(x=x, draw=draw).standard_normal(_CHUNK) for draw in draws]
            return np.concatenate(parts)[first % _CHUNK :][: last - first + 1]

        chosen = normal(None) if columns is None else np.stack([normal(int(x)) for x in columns], axis=1)
        # a width is the difference of two edges
        shift = chosen * (self.dnl_lsb / np.sqrt(2.0))
        return np.asarray(np.clip(shift, -_FARTHEST_RANDOM, _FARTHEST_RANDOM), np.float64)

    def _listed(self, wanted: IntArray) -> FloatArray:
        """Return shifts of edges that need no random numbers, DN; edges never change their order."""
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


_FARTHEST_ORIGIN = 1e6  # of the point at which both gains agree, DN
_FLATTEST = 1e-4  # gain changes below it are a step: with its point of agreement this many DN away


class GainStitch(Effect, tag="gain_stitch"):
    """Above ``level_dn`` the scale deviates by ``gain_change (x - origin_dn)``, below it by nothing.

    Dual-gain sensors read every pixel by a high and a low gain and join the two into one scale at a fixed
    level; so do ADCs with two slopes. If the gains are not matched exactly, the scale has a kink at the
    level, and a step where they are matched about another point.

    Signature: counts per DN, summed over the pixels, deviate on both sides of one DN, beyond what the pixels'
    own bias and gain take up; pixels of different bias show it at the same DN. A step shows sharply, at one
    code; a kink alone is hardly told from a bend of the whole curve (`adc_inl`).
    """

    plane = Plane.ADC
    along = 1
    title = "stitch point of two gains"
    source = "arXiv:2412.10109 (pCam6060); arXiv:2510.14484 (Marana 4.2)"
    factors = Factors("code", "all pixels", "constant")
    signature = ("code.smooth", "shape.goodness.mean", "shape.He1C2.mean", "shape.C3.mean")
    strength = "gain_change"
    separate: ClassVar[Mapping[str, str]] = {
        "adc_inl": "a ramp of light over all codes: a stitch is one kink, INL is curved everywhere",
        "nonlinearity": "a shifted bias (pedestal): a stitch is fixed in DN, nonlinearity in charge",
        "adc_dnl": "a ramp over many codes: a stitch shifts all codes above it, DNL single codes",
        "branching_counts": "a shifted bias: an excess of high electron numbers shifts with it",
        "signal_dependent_noise": "a shifted bias: a stitch is fixed in DN, noise in electrons",
    }
    #: gains that differ by 1 % above 130 DN, of either sign
    typical_values = ({"gain_change": 0.01, "level_dn": 130.0}, {"gain_change": -0.01, "level_dn": 130.0})
    gain_change: Ratio = Field(
        ge=-0.5, le=0.5, description="relative change of DN per electron above the level, no unit"
    )
    level_dn: Dn = Field(ge=0, le=1e6, description="level of the transition between the gains, DN")
    origin_dn: Dn | None = Field(
        default=None,
        ge=-_FARTHEST_ORIGIN,
        le=_FARTHEST_ORIGIN,
        description="DN at which both gains agree; null: the level (no step)",
    )

    @property
    def _origin(self) -> float:
        return self.level_dn if self.origin_dn is None else self.origin_dn

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal at the ADC (frame, y, x), DN, joined; draws nothing."""
        joined = values + self.gain_change * (values - self._origin)
        return np.asarray(np.where(values > self.level_dn, joined, values))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the break of the curve that explains the residuals of the codes best."""
        return [found for found in map(cls._of, best_stitch(evidence)) if found.gain_change]

    @classmethod
    def _of(cls, stitch: Stitch) -> Self:
        slope = float(np.clip(stitch.slope, -0.5, 0.5))
        if not stitch.step:
            return cls(gain_change=slope, level_dn=stitch.level)
        if abs(slope) < _FLATTEST:
            slope = _FLATTEST if stitch.step > 0 else -_FLATTEST
        origin = float(np.clip(stitch.level - stitch.step / slope, -_FARTHEST_ORIGIN, _FARTHEST_ORIGIN))
        return cls(gain_change=slope, level_dn=stitch.level, origin_dn=origin)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the code edges where the joined scale crosses them.

        A code that both gains reach is given the mass of both as one cell: right to first order of the step.
        """
        first, last = code_range(maps)
        ideal = np.arange(first, last + 1) - 0.5
        below = np.minimum(ideal, self.level_dn)
        crossing = (ideal + self.gain_change * self._origin) / (1.0 + self.gain_change)
        above = np.maximum(crossing, self.level_dn)
        return model.with_edges(first, below + above - self.level_dn - ideal)


# counts expected beyond the limit, and standard errors of the pile-up at it
_EXPECTED_BEYOND = 8.0
_PILE_UP = 4.0


class Clipping(Effect, tag="clipping"):
    """Smallest and largest digital number that come out, the same for every pixel.

    Black-level clamping, a limited ramp or a full column amplifier end the scale before the ADC does: every
    value beyond the limit becomes the limit, ``x = min(max(x, low), high)``, so the likelihood of that code
    is the whole tail beyond it (a censored observation, Tobin 1958). The cut at 0 and at ``2**bit_depth -
    1`` is not this effect: the ADC always makes it.

    Signature: counts pile up at one code, the extreme one, and none lie beyond it. A low limit near the bias
    pulls the bias up and the read noise down; a high one pulls the exposure down.
    """

    plane = Plane.ADC
    along = 3
    title = "clipping (black-level clamping, saturation)"
    source = "Tobin 1958, Econometrica 26, 24 (censored observations); EMVA 1288 (saturation)"
    factors = Factors("code", "all pixels", "constant")
    signature = ("code.top", "code.bottom", "code.largest", "shape.goodness.cnt")
    separate: ClassVar[Mapping[str, str]] = {
        "adc_dnl": "more light: there are no samples beyond a limit",
        "adc_inl": "a shifted bias or more light: clipping affects one code, INL all",
    }
    low: Code | None = Field(default=None, ge=0, description="smallest value, DN; null: limit of the ADC")
    high: Code | None = Field(default=None, ge=0, description="largest value, DN; null: limit of the ADC")

    @model_validator(mode="after")
    def _limits_in_order(self) -> Self:
        if self.low is None and self.high is None:
            raise ValueError("clipping without low and high does nothing; give one of them")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError(f"clipping: low {self.low} is not below high {self.high}; swap them")
        return self

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal at the ADC (frame, y, x), DN, inside the limits; draws nothing."""
        # the limits are whole DN, so to limit before rounding is to limit after it
        return np.asarray(np.clip(values, self.low, self.high))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the extreme codes at which counts pile up while those expected beyond are missing.

        Nothing is typical of a limit, which is a code of this very sensor: the default guesses are none.
        """
        code = evidence.code
        high = code.maximum if _piles_up(code, code.maximum, above=True) else None
        low = code.minimum if code.minimum > 0 and _piles_up(code, code.minimum, above=False) else None
        if high is None and low is None:
            return ()
        if high is None or low is None:
            return (cls(low=low, high=high),)
        return cls(low=low, high=high), cls(high=high), cls(low=low)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law that counts at the limits what lies beyond them."""
        return model.with_clip(self.low, self.high)


def _piles_up(code: CodeResiduals, limit: int, *, above: bool) -> bool:
    """Return whether a code holds what is missing beyond it."""
    at = limit - code.first
    if not 0 <= at < code.observed.size:
        return False
    beyond = slice(at + 1, None) if above else slice(0, at)
    missing = float(code.expected[beyond].sum() - code.observed[beyond].sum())
    excess = float(code.observed[at] - code.expected[at])
    return missing > _EXPECTED_BEYOND and excess > _PILE_UP * np.sqrt(float(code.expected[at]) + 1.0)
