"""Drift of the bias: one slow offset common to all pixels.

The pedestal follows the temperature of the readout electronics and the ageing of its references: ``x += b_t``
with b_t slow against a frame (pedestal drift; Rauscher 2015, PASP 127, 1144). The linear shape is the usual
warming up; a shape of its own (``path``) is what a measured run really did; a random walk is what another run
of the same camera may do. A slow sine is ``periodic_pickup`` at a few cycles per run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.common_modes import responsivity
from pchem_pipeline.effects.families.drifts import Drift
from pchem_pipeline.effects.families.offsets import OffsetEffect, quantile_means
from pchem_pipeline.effects.framework.effect import Dn, SharedOffset, register_effect
from pchem_pipeline.effects.types import EffectContext, Evidence, FloatArray, PixelMaps, SampleLaw, TimeSeries


@register_effect
class BiasDrift(Drift, OffsetEffect):
    """Slow offset of all pixels, zero on average over the run.

    Signature: block means of the readout residual move together, by the same number of DN in every pixel,
    whatever its exposure; those of the charge do not move. A pixel's own histogram is smeared over the path.
    """

    tag: Literal["bias_drift"] = Field(default="bias_drift", description="name of the effect")
    title = "bias (pedestal) drift"
    source = "Rauscher 2015, PASP 127, 1144 (pedestal drift); Janesick 2001, ch. 7"
    signature = (
        "frame.readout.trend",
        "frame.readout.slow",
        "frame.readout.lag1",
        "time.lag1.readout.mean",
    )
    strength = "drift_dn"
    separate: ClassVar[Mapping[str, str]] = {
        "exposure_drift": "a map of exposures: an exposure drift is proportional to it, a bias drift uniform",
        "gain_drift": "a bright and a dark region: gain drift is proportional to the signal",
        "bias_jumps": "means of the quadrants, frame by frame: jumps are sudden and independent",
        "flicker_noise": "block means of single pixels: 1/f noise is independent, a drift common",
    }
    drift_dn: Dn = Field(
        ge=-1e6,
        le=1e6,
        description="linear, settling: bias at the end less that at the start, DN; path: its scale, DN; "
        "walk: standard deviation of the end less the start, DN",
    )

    #: at 0.09 DN: rising, falling, there and back
    typical_values = (
        {"drift_dn": 0.09},
        {"drift_dn": -0.09},
        {"drift_dn": 0.09, "shape": "path", "path": (-0.5, 0.5, -0.5)},
    )

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the offsets of the frames, DN."""
        return np.asarray((self.drift_dn * self.in_frames(context))[:, None, None])

    def offset_values(self) -> FloatArray:
        """Return values, DN, that the path goes through."""
        return quantile_means(self.values())

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law smeared over the path; of a walk that with its variance."""
        return (
            model.with_variance(dn2=self.drift_dn**2 / 6.0)
            if self.shape == "walk"
            else super().sample_law(model, maps)
        )

    @classmethod
    def series(cls, evidence: Evidence, time: TimeSeries) -> FloatArray:
        """Return the offsets of the frames, DN."""
        return np.asarray(time.frame_readout / responsivity(evidence))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the time profiles that the frames' means follow, and a random walk like the path."""
        found = list(super().estimate(evidence))
        # a random walk of variance s^2 u has steps of variance s^2 / (nodes - 1) between nodes
        sizes = [one.drift_dn * float(np.linalg.norm(np.diff(one.path))) for one in found if one.path]
        return [*found, *(cls(drift_dn=size, shape="walk") for size in sizes)]

    def shared_offset(self) -> SharedOffset:
        """Return the offset of a frame: others may be at any place of the drift."""
        return SharedOffset("frame", self.drift_dn**2)
