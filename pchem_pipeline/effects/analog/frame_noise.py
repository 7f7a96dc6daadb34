"""Frame noise: one random offset for each frame, common to all its pixels.

Noise of a reference that is sampled once per frame shifts the whole frame: ``x += f_t`` with
``f_t ~ N(0, s^2)``, new in every frame. It is what remains of pedestal noise after a correction by rows, and
why overscan or optically black pixels are subtracted frame by frame (Janesick 2001, Scientific
Charge-Coupled Devices; Rauscher 2015, PASP 127, 1144 draws such pedestals).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.common_modes import (
    line_excess,
    mean_variance,
    responsivity,
    successive,
)
from pchem_pipeline.effects.families.offsets import SharedNoise
from pchem_pipeline.effects.framework.effect import Dn, register_effect
from pchem_pipeline.effects.types import Evidence, FloatArray, TimeSeries
from pchem_pipeline.model.arithmetic.significance import POSSIBLE


@register_effect
class FrameNoise(SharedNoise):
    """Random offset per frame, in DN since the disturbance sits behind the pixels' gains.

    Signature: frame means of the readout residual scatter more than ``n`` independent pixels do, by
    ``frame_noise_dn^2``, white from frame to frame; those of the charge do not. A pixel's own histogram
    only broadens: its read noise becomes ``(sigma^2 + frame_noise_dn^2)^(1/2)`` DN.
    """

    tag: Literal["frame_noise"] = Field(default="frame_noise", description="name of the effect")
    title = "frame noise (frame-to-frame offset noise)"
    source = "Janesick 2001, Scientific Charge-Coupled Devices; Rauscher 2015, PASP 127, 1144"
    signature = (
        "frame.readout.variance",
        "frame.readout.largest",
        "space.x.rr",
        "space.y.rr",
    )
    strength = "frame_noise_dn"
    shared_by = "frame"
    separate: ClassVar[Mapping[str, str]] = {
        "black_clamp": "clamp switched off: frame noise stays, offsets of the clamp vanish",
        "exposure_flicker": "frames without light, or at short exposure: flicker vanishes",
        "periodic_pickup": "spectrum of the frame means of a longer run: pickup is a line, noise is flat",
        "bias_drift": "a longer run: a drift grows with time, noise does not",
    }
    frame_noise_dn: Dn = Field(ge=0, le=1e6, description="standard deviation of the frames' offsets, DN")

    #: at 0.12 DN
    typical_values = ({"frame_noise_dn": 0.12},)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the excess variance of successive frames, so that a slow drift does not count.

        Half the mean squared difference of successive frame means, even and odd frames centred apart, less
        what the noise of pixels, rows and columns gives.
        """
        if evidence.time is None:
            return ()
        expected = _expected(evidence, evidence.time)
        steps = _steps(evidence.time)
        if steps.size < 8 or not expected > 0:
            return ()
        excess = float((steps**2).mean() / 2.0 - expected)
        # successive differences share a frame: their squares are correlated by 1/4
        error = expected * np.sqrt(3.0 / steps.size)
        if excess < POSSIBLE * error:
            return ()
        return (cls(frame_noise_dn=float(np.sqrt(excess)) / responsivity(evidence)),)


def _expected(evidence: Evidence, time: TimeSeries) -> float:
    """Return the variance, DN^2, that pixels, rows and columns by themselves give to frame means."""
    expected = float(mean_variance(evidence))
    for means, axis in ((time.row_readout, 1), (time.column_readout, 0)):
        excess, error = line_excess(means, mean_variance(evidence, axis))
        if excess > 2.0 * error:
            expected += excess / means.shape[1]
    return expected


def _steps(time: TimeSeries) -> FloatArray:
    """Return differences of the frame means of successive frames, DN, without even-odd contrast."""
    means = time.frame_readout.astype(np.float64).copy()
    for parity in (0, 1):
        chosen = time.frames % 2 == parity
        if chosen.any():
            means[chosen] -= means[chosen].mean()
    return np.asarray(np.diff(means)[successive(time.frames)], np.float64)
