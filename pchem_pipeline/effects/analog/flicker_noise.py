"""Flicker noise: part of a pixel's read noise stays for many frames.

The low-frequency noise of a source follower that correlated double sampling does not remove (1/f noise; van
Vliet 1976; Kansy 1980 for its passage through double sampling) correlates successive frames of a pixel,
each pixel by itself: ``R_t = (1 - share)^(1/2) sigma Z_t + share^(1/2) sigma U_t``. U is a stationary
Ornstein-Uhlenbeck process, ``cov(U_t, U_{t+l}) = exp(-l / tau)``, whose spectrum is a Lorentzian, or the
sum of three of them with tau spaced by factors of 8, nearly 1/f in between (McWhorter 1957).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.long_memory import between_grid_points, frame_key
from pchem_pipeline.effects.framework.context import RandomSource
from pchem_pipeline.effects.framework.effect import Effect, Frames, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, FloatArray, IntArray
from pchem_pipeline.model.arithmetic.significance import POSSIBLE

_SPACING = (1.0, 1 / 8, 1 / 64)


@register_effect
class FlickerNoise(Effect):
    """Part of the power of the read noise that is correlated in time; the power of all stays as it is.

    Signature: residuals of successive frames are alike and block means wander, each pixel by itself: neither
    frame means nor neighbours show anything, and a pixel's own histogram does not either.
    """

    tag: Literal["flicker_noise"] = Field(default="flicker_noise", description="name of the effect")
    plane = Plane.ANALOG
    title = "flicker (1/f) noise of the pixels"
    source = "van Vliet 1976; Kansy 1980 (double sampling of 1/f noise); McWhorter 1957"
    signature = (
        "time.block.readout.chi", "time.lag1.readout.mean", "time.lag2.readout.mean",
        "time.lag3.readout.mean",
    )  # fmt: skip
    strength = "share"
    separate: ClassVar[Mapping[str, str]] = {
        "analog_memory": "frames without exposure: 1/f noise remains, memory vanishes",
        "dark_current_rts": "a sweep of the exposure time: blinking grows with it, 1/f noise does not",
        "bias_drift": "pairs of distant pixels: a bias drift is common to them",
        "bias_jumps": "pairs of pixels of a quadrant: bias jumps are common to them",
        "gain_drift": "dark and bright pixels: a gain drift is proportional to the signal",
        "rts_noise": "longer runs: slow RTS noise has two levels, in the same few pixels",
    }
    share: Ratio = Field(ge=0, le=1, description="share of the read noise power, no unit")
    correlation_frames: Frames = Field(
        default=30.0,
        gt=0,
        le=1e6,
        description="correlation time, frames; one_over_f: the longest one",
    )
    spectrum: Literal["lorentzian", "one_over_f"] = Field(
        default="lorentzian",
        description="lorentzian: one correlation time; one_over_f: it, an eighth and a 64th, of equal power",
    )

    #: from some frames to hundreds of frames long, and 1/f
    typical_values = (
        *({"share": 0.0036, "correlation_frames": tau} for tau in (3.0, 30.0, 300.0)),
        {"share": 0.0036, "correlation_frames": 300.0, "spectrum": "one_over_f"},
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with a part of the noise exchanged for a correlated one."""
        times = self._times()
        noise = _ornstein_uhlenbeck(context.random, context.frames, times[0], 0)
        for process, tau in enumerate(times[1:], 1):
            noise += _ornstein_uhlenbeck(context.random, context.frames, tau, process)
        noise *= np.sqrt(self.share / len(times)) * context.truth["analog_read_noise_e"]
        if context.read_noise is not None:
            noise -= (1.0 - np.sqrt(1.0 - self.share)) * context.read_noise
        noise += values
        return noise

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return what is typical where residuals of successive frames are alike."""
        alike = evidence.z.get("time.lag1.readout.mean", 0.0) > POSSIBLE
        return super().estimate(evidence) if alike else ()

    def details(self) -> tuple[str, ...]:
        """Return the correlation time."""
        return ("correlation_frames",)

    def _times(self) -> tuple[float, ...]:
        """Return the correlation times, frames."""
        factors = (1.0,) if self.spectrum == "lorentzian" else _SPACING
        return tuple(self.correlation_frames * factor for factor in factors)


def _ornstein_uhlenbeck(
    random: RandomSource, frames: IntArray, correlation_frames: float, process: int
) -> FloatArray:
    """Return a stationary Gaussian process with covariance exp(-lag / tau), (frame, y, x), by pixel."""

    def normal(frame: int) -> FloatArray:
        return random.normal(("y", "x"), frame_key(frame, process))

    def midpoint(frame: int, before: FloatArray, after: FloatArray, half: int) -> FloatArray:
        rho = float(np.exp(-half / correlation_frames))
        state = normal(frame)
        state *= np.sqrt((1.0 - rho**2) / (1.0 + rho**2))
        state += rho / (1.0 + rho**2) * (before + after)
        return state

    return np.concatenate(between_grid_points(frames, correlation_frames, normal, midpoint))
