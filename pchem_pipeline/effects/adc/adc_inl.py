"""Integral nonlinearity of the ADC: a bent transfer curve.

What the ADC converts is ``x + a d(x)`` instead of x (IEEE Std 1241: INL is the deviation of the transfer
curve from the best line). The form d is a sine, ``sin(2 pi x / P + phi)``, or a smooth curve through knots:
one bend over the codes in use is a half or a whole period; segmented references and ramps have more, of any
form. It is fixed in DN, whatever the bias and the gain of a pixel.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.bends import Curve, best_bend, best_curve, through_knots
from pchem_pipeline.effects.estimators.codes import code_range
from pchem_pipeline.effects.framework.effect import Dn, Effect, Lsb, Plane, Radians, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, FloatArray, PixelMaps, SampleLaw

_FEWEST_KNOTS = 4
# places of the table of a curve from one knot to the next
_FINER = 32


@register_effect
class AdcInl(Effect):
    """Smooth deviation of the transfer curve, the same for every pixel.

    Signature: counts per DN, summed over the pixels, deviate smoothly along DN, beyond what the pixels' own
    bias and gain take up; pixels of different bias show the same pattern at the same DN.
    """

    tag: Literal["adc_inl"] = Field(default="adc_inl", description="name of the effect")
    plane = Plane.ADC
    along = 1
    title = "integral nonlinearity of the ADC (INL)"
    source = "IEEE Std 1241 (terminology and test methods for analog-to-digital converters)"
    signature = (
        "code.smooth",
        "shape.goodness.mean",
        "shape.He1C2.mean",
        "shape.He1C2.chi",
        "shape.He3.mean",
    )
    strength = "inl_lsb"
    separate: ClassVar[Mapping[str, str]] = {
        "gain_stitch": "a ramp of light over all codes: INL is curved everywhere, a stitch is one kink",
        "nonlinearity": "a shifted bias (pedestal): INL is fixed in DN, nonlinearity in charge",
        "adc_dnl": "a ramp over many codes: INL varies smoothly along DN, DNL from code to code",
        "signal_dependent_noise": "a shifted bias: INL shifts peaks, noise only widens them",
    }
    inl_lsb: Lsb = Field(
        ge=0, le=1e4, description="amplitude of the sine, or scale of `curve` (its largest value is 1), LSB"
    )
    form: Literal["sine", "curve"] = Field(
        default="sine", description="sine: of one period; curve: smooth through the values of `curve`"
    )
    period_dn: Dn = Field(
        default=100.0, ge=4, le=1e6, description="sine: period of the deviation, DN; two bends per period"
    )
    phase: Radians = Field(default=0.0, ge=-100, le=100, description="sine: phase at 0 DN, rad")
    first_dn: Dn = Field(default=0.0, description="curve: where the first value of `curve` lies, DN")
    spacing_dn: Dn = Field(
        default=10.0, gt=0, le=1e6, description="curve: from one value of `curve` to the next, DN"
    )
    curve: tuple[float, ...] = Field(
        default=(),
        max_length=1 << 10,
        description="curve: deviations in units of inl_lsb, through which a natural cubic spline goes; "
        "beyond the ends as at the ends",
    )

    #: at 0.065 LSB with periods of 60 and 150 DN, at two phases each
    typical_values = tuple(
        {"inl_lsb": 0.065, "period_dn": period, "phase": phase}
        for period, phase in itertools.product((60.0, 150.0), (0.0, 1.57))
    )

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if (self.form == "curve") != bool(self.curve):
            raise ValueError("adc_inl: form curve and the list `curve` belong together; give both or none")
        if self.curve and len(self.curve) < _FEWEST_KNOTS:
            raise ValueError(f"adc_inl: curve needs at least {_FEWEST_KNOTS} values, got {len(self.curve)}")
        return self

    @model_validator(mode="after")
    def _monotone(self) -> Self:
        if self.inl_lsb * self._steepest() >= 1.0:
            form = f"period_dn {self.period_dn}" if self.form == "sine" else f"spacing_dn {self.spacing_dn}"
            raise ValueError(
                f"adc_inl: inl_lsb {self.inl_lsb} at {form} turns the curve back; "
                f"keep inl_lsb below {1.0 / self._steepest():.4g}"
            )
        return self

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
        result: AnyArray = values + self._deviation(values)
        return result

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
        return sines if curve is None else [*cls._through(curve), *sines]

    @classmethod
    def _through(cls, curve: Curve) -> list[Self]:
        """Return the effect with this curve; none where it turns back."""
        size = float(np.abs(curve.values).max())
        listed = tuple(np.round(curve.values / size, 4).tolist())
        form = cls(inl_lsb=0.0, form="curve", first_dn=curve.first, spacing_dn=curve.spacing, curve=listed)
        return [form.model_copy(update={"inl_lsb": size})] if size * form._steepest() < 1.0 else []

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
