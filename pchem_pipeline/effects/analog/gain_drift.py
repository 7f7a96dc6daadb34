"""Drift of the conversion gain: the DN per electron change during the run, for all pixels alike.

The gain of amplifiers and the references of the ADC follow temperature and supply: ``x = round(mu + (1 +
drift u_t) (K + R) / g)`` with u_t from -1/2 at the first frame to 1/2 at the last (gain stability: EMVA
1288; Janesick 2007). A shape of its own (``path``) is what a measured run really did.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.families.drifts import Drift
from pchem_pipeline.effects.framework.effect import Plane, Ratio, register_effect
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    FloatArray,
    PixelMaps,
    SampleLaw,
    TimeSeries,
)


@register_effect
class GainDrift(Drift):
    """Slow change of 1/g of all pixels, zero on average over the run.

    Signature: block means of the readout residual move in proportion to the exposure of the pixel, and the
    residual follows the charge within a block; those of the charge do not move. A pixel's peaks widen in
    proportion to the electron number.
    """

    tag: Literal["gain_drift"] = Field(default="gain_drift", description="name of the effect")
    plane = Plane.ANALOG
    title = "conversion gain drift"
    source = "EMVA 1288 (stability of the gain); Janesick 2007"
    signature = (
        "frame.gain.trend", "frame.gain.slow", "frame.readout.trend", "frame.readout.slow",
        "frame.charge.trend", "frame.charge.slow",
    )  # fmt: skip
    strength = "drift"
    separate: ClassVar[Mapping[str, str]] = {
        "bias_drift": "frames without exposure: a bias drift remains, a gain drift vanishes",
        "exposure_drift": "peak spacing over time: constant if the exposure drifts; or a logged light level",
        "signal_dependent_noise": "a repeated run: a drift has a time profile, noise has none",
        "flicker_noise": "dark and bright pixels: a gain drift is proportional to the signal",
    }
    drift: Ratio = Field(
        ge=-0.5,
        le=0.5,
        description="linear: relative change of the gain (DN/e-) from the first frame to the last, no unit; "
        "path: its scale",
    )

    #: a gain that rises, falls, and does both
    typical_values = (
        {"drift": 0.006},
        {"drift": -0.006},
        {"drift": 0.006, "shape": "path", "path": (-0.5, 0.5, -0.5)},
    )

    @model_validator(mode="after")
    def _gain_stays_positive(self) -> Self:
        if np.abs(self.values()).max() >= 1:
            raise ValueError("gain_drift: drift times path takes the gain to zero; make one of them smaller")
        return self

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, scaled by the time profile of the gain."""
        result: AnyArray = values * (1.0 + self.drift * self.in_frames(context))[:, None, None]
        return result

    @classmethod
    def series(cls, evidence: Evidence, time: TimeSeries) -> FloatArray:
        """Return the relative gain of the frames, without what of it is taken for charge."""
        return time.frame_gain

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the variance of the gain: that of the peaks grows as k^2."""
        return model.with_variance(per_electron2=float(self.values().var()))
