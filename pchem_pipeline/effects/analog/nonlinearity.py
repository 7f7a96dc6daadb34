"""Nonlinear response: the step from one electron to the next changes with their number.

The capacitance of the sense node and the gain of the source follower depend on the voltage, so the response
of a pixel bends (Janesick 2007, chapter on V/V and V/e- nonlinearity): ``k`` electrons give
``k (1 + b (k - 1) / 2)`` in units of the first step, and the step from ``k`` to ``k + 1`` is ``1 + b k``.
What comes after the read noise (an amplifier, a converter) bends that as well: it is ``1 + b k`` times as
large at ``k`` electrons.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.effects.framework.effect import Effect, PerElectron, Plane, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, PixelMaps, SampleLaw

Noise = Literal["kept", "bent"]


@register_effect
class Nonlinearity(Effect):
    """Relative change of the step per electron, the same in every pixel.

    Signature: the score of position against the square of the electron number (He1C2) has one sign in all
    pixels; then He3C1 and He3; He2C1 where the read noise is bent, too. Nothing in time or space. The gain
    that the PCD finds is that of the steps which the pixel's exposure reaches.
    """

    tag: Literal["nonlinearity"] = Field(default="nonlinearity", description="name of the effect")
    plane = Plane.ANALOG
    title = "nonlinearity of the pixel's response"
    source = "Janesick 2007 (V/V and V/e- nonlinearity)"
    signature = (
        "shape.He1C2.mean", "code.smooth", "shape.He3C1.mean", "shape.He1C2.slope", "shape.C3.mean",
    )  # fmt: skip
    strength = "step_change"
    separate: ClassVar[Mapping[str, str]] = {
        "adc_inl": "a sweep of the bias: INL is fixed in DN, pixel nonlinearity in electrons",
        "signal_dependent_noise": "a series of exposures: nonlinearity bends the means, noise the variances",
        "noise_skew": "a series of exposures: nonlinearity grows with the signal, skewed noise does not",
        "branching_counts": "a series of exposures: nonlinear peak spacing is the same at any exposure",
    }
    step_change: PerElectron = Field(
        ge=-0.2,
        le=0.2,
        description="relative change of the peak spacing per electron, 1/e-",
    )
    noise: Noise = Field(
        default="kept",
        description="kept: nonlinearity before the read noise (sense node); bent: after it (amplifiers)",
    )

    #: steps that grow and steps that shrink, before the read noise and after
    typical_values = tuple(
        {"step_change": change, "noise": noise} for noise in ("kept", "bent") for change in (2e-3, -2e-3)
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
