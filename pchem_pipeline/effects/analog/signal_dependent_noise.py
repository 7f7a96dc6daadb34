"""Noise that grows with the number of electrons: the peaks widen from one to the next.

Each electron that is multiplied or collected with a gain of its own adds its own variance: ``Var(x | k) =
sigma^2 + s^2 k`` (excess noise, McIntyre 1966; cell-to-cell gain spread of silicon photomultipliers, Eckert
et al. 2010). A gain that differs from sample to sample is common to the sample's electrons: ``s^2 k^2``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.framework.effect import Effect, Electrons, Plane, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, PixelMaps, SampleLaw


@register_effect
class SignalDependentNoise(Effect):
    """Gaussian noise whose variance grows with the electron number or with its square.

    Signature: the score of width against electron number (He2C1) is positive in all pixels, and with it the
    third Hermite score; He2C2 tells the square from the number. Nothing in time or space.
    """

    tag: Literal["signal_dependent_noise"] = Field(
        default="signal_dependent_noise", description="name of the effect"
    )
    plane = Plane.ANALOG
    title = "signal-dependent noise (gain or excess noise)"
    source = "McIntyre 1966 (multiplication noise); Eckert et al. 2010 (peaks of SiPM spectra)"
    signature = (
        "shape.He2C1.mean", "shape.He3.mean", "shape.He2C1.slope", "shape.He4.mean", "shape.He2C2.mean",
    )  # fmt: skip
    strength = "noise_e"
    power = 2.0
    separate: ClassVar[Mapping[str, str]] = {
        "nonlinearity": "a series of exposures: nonlinearity bends the means, noise the variances",
        "noise_skew": "frames without exposure: skewness remains, signal-dependent noise vanishes",
        "heavy_tailed_noise": "frames without exposure: heavy tails remain, signal-dependent noise vanishes",
        "overdispersed_counts": "higher exposure: signal-dependent noise widens all peaks above 0 electrons",
        "gain_drift": "a repeated run: a drift has a time profile, noise has none",
    }
    noise_e: Electrons = Field(ge=0, description="noise of one electron, e-")
    growth: Literal["root", "linear"] = Field(
        default="root",
        description="root: each electron adds variance of its own (noise_e k^(1/2)); linear: the electrons "
        "of a sample share it (noise_e k)",
    )

    #: both growths
    typical_values = ({"noise_e": 0.06}, {"noise_e": 0.03, "growth": "linear"})

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with the noise of its electrons."""
        noise = context.random.normal(("frame", "y", "x"))
        if context.charge is not None:
            noise *= np.sqrt(context.charge) if self.growth == "root" else context.charge
        noise *= self.noise_e
        noise += values
        return noise

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with variance growing along the peaks."""
        more = self.noise_e**2
        return (
            model.with_variance(per_electron=more)
            if self.growth == "root"
            else model.with_variance(per_electron2=more)
        )
