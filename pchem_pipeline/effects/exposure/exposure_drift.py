"""Drift of the quanta exposure during a capture (the sensor warms up, the lamp ages).

PCH-EM assumes independent, identically distributed frames (Hendrickson et al. 2023, Sec. II-B). Here frame
``n`` of ``N`` sees ``H_n = H (1 + drift s_n)`` with a time profile s of mean 0 and range 1, so they are not.
Dark current doubles every 6 to 8 K, about 10 % per kelvin, so a tenth of a kelvin over the run already
drifts by 1 %.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.charge_sums import exposure_nodes
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
class ExposureDrift(Drift):
    """Relative change of H from the first frame to the last, the same in every pixel.

    A ``path`` may be in any unit: its mean and range are taken out. Of a time constant or a path alone, the
    shape need not be told.

    Signature: block means of the electron number follow the drift with a slope proportional to H,
    those of the readout residual do not. The mean over the run stays; for large N the variance grows
    by ``(drift H / g)^2 / 12`` DN^2 and is no longer that of any single PCD.
    """

    tag: Literal["exposure_drift"] = Field(default="exposure_drift", description="name of the effect")
    plane = Plane.EXPOSURE
    title = "illumination or dark-current drift"
    source = "Widenhorn et al. 2002, Proc. SPIE 4669, 193 (dark current and temperature)"
    signature = (
        "frame.charge.trend",
        "frame.charge.slow",
        "time.block.charge.chi",
        "frame.charge.lag1",
    )
    strength = "drift"
    separate: ClassVar[Mapping[str, str]] = {
        "glow": "a map of the change along the run: a drift is proportional to H, a glow local",
        "gain_drift": "readout residuals of bright and dim pixels: constant with an exposure drift",
        "bias_drift": "covered pixels, or frames without exposure: constant with an exposure drift",
        "persistence": "a map of the change: proportional to H for a drift",
        "exposure_flicker": "a reference photodiode, or the logged temperature",
    }
    drift: Ratio = Field(
        ge=-2, le=2, description="(H_last - H_first) / H_mean (range of the time profile for a path), no unit"
    )

    #: at 1.6 % end to end, rising and falling, straight and settling
    typical_values = (
        {"drift": 0.016},
        {"drift": -0.016},
        {"drift": 0.016, "settling_fraction": 0.2},
        {"drift": -0.016, "settling_fraction": 0.2},
    )

    @model_validator(mode="before")
    @classmethod
    def _shape_of_numbers(cls, given: Any) -> Any:
        """Return the fields with the shape that a time constant, or a path, is of."""
        if not isinstance(given, Mapping) or "shape" in given:
            return given
        told = {
            name: value for name, value in given.items() if name != "settling_fraction" or value is not None
        }
        if told.get("path") and "settling_fraction" in told:
            raise ValueError(
                "exposure_drift: path and settling_fraction are two time profiles; give one of them"
            )
        shape = "path" if told.get("path") else "settling" if "settling_fraction" in told else "linear"
        return {**told, "shape": shape}

    @model_validator(mode="after")
    def _path_has_a_range(self) -> Self:
        if self.path and max(self.path) == min(self.path):
            raise ValueError("exposure_drift: path needs at least two different values; leave it empty")
        return self

    def profile(self, position: FloatArray) -> FloatArray:
        """Return the profile, of mean 0 and range 1 over the run, at times 0..1 (first to last frame)."""
        found = super().profile(position)
        return found / float(np.ptp(self.path)) if self.path else found

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the drifting exposure (frame, y, x), e-."""
        factor = np.maximum(1.0 + self.drift * self.in_frames(context), 0.0)
        result: AnyArray = values * factor[:, None, None]
        return result

    @classmethod
    def series(cls, evidence: Evidence, time: TimeSeries) -> FloatArray:
        """Return the relative exposures of the frames."""
        return time.frame_charge

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law mixed over the exposures of the run."""
        return model.with_exposures(*exposure_nodes(1.0 + self.values()))
