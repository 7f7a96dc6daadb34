"""Random telegraph noise: a trap in the source follower of some pixels shifts the signal by a step.

One oxide trap is full or empty; while it is full the source follower reads ``amplitude_e`` more (Kandiah
and Whiting 1978; Wang, Rao, Mierop and Theuwissen 2006). Correlated double sampling subtracts the state at
reset from that at the signal: three levels, -A, 0 and +A (Leyris et al. 2006), with q/2, 1 - q and q/2. The
means of N samples each before and after (correlated multiple sampling) move in steps of A/N, for a jump at
a random place among the 2 N samples. Without double sampling the two levels of the slow trap itself are
seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field
from scipy import special

from pchem_pipeline.effects.estimators.long_memory import OF_PIXEL, frame_key, two_states
from pchem_pipeline.effects.framework.effect import (
    Count,
    Effect,
    Electrons,
    Frames,
    Plane,
    Ratio,
    register_effect,
)
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    FloatArray,
    PixelMaps,
    SampleLaw,
)

_WHERE, _SIZE, _FULL, _EMPTY = OF_PIXEL
# standard deviation of the logarithms of lognormal steps
_LOGNORMAL = 0.4
# standard deviations of the logarithms of its times by which hardly a trap is slower
_FARTHEST = 4.0
# amplitudes tried in every pixel, in units of that of the effect
_EQUAL, _EXPONENTIAL = (0.5, 0.63, 0.8, 1.0, 1.25, 1.6, 2.0), (0.35, 0.5, 0.7, 1.0, 1.35, 1.8, 2.5, 3.4)
_ALARM = 0.1  # pixels wrongly given levels, of those that have some


@register_effect
class RtsNoise(Effect):
    """Telegraph noise of a share of the pixels, each with one trap; zero on average.

    Signature: in few pixels the noise is heavy-tailed (He4), the fit is poor and samples lie below the bias
    by more than the noise, where no electrons hide them. Sampled twice, successive frames are independent
    and neighbours are too; without double sampling the residuals of these few pixels are alike for many
    frames.
    """

    tag: Literal["rts_noise"] = Field(default="rts_noise", description="name of the effect")
    plane = Plane.ANALOG
    title = "random telegraph noise (RTS noise, burst noise) of the source follower"
    source = (
        "Kandiah and Whiting 1978; Wang, Rao, Mierop and Theuwissen 2006; Leyris et al. 2006 (three levels "
        "behind correlated double sampling)"
    )
    signature = (
        "shape.peaks.cnt", "shape.He4.chi", "shape.He3.chi", "shape.C2.cnt", "tail.low.count",
        "time.block.readout.cnt",
    )  # fmt: skip
    strength = "fraction"
    separate: ClassVar[Mapping[str, str]] = {
        "heavy_tailed_noise": "longer runs: RTS noise stays in the same few pixels; or another number of "
        "correlated samples: it changes the levels of RTS noise",
        "dark_current_rts": "a sweep of the exposure time: dark-current RTS grows with it, RTS noise of "
        "the source follower does not",
        "overdispersed_counts": "frames without exposure: RTS noise remains",
        "flicker_noise": "longer runs: slow RTS noise has two levels, in the same few pixels",
    }
    fraction: Ratio = Field(ge=0, le=1, description="share of the pixels that have a trap, no unit")
    amplitude_e: Electrons = Field(
        ge=0, le=1e4, description="step of the trap, e-; exponential: its mean over these pixels"
    )
    spread: Literal["equal", "lognormal", "exponential"] = Field(
        default="equal",
        description="equal: the same step in all these pixels; lognormal: the stated one is the median, with "
        "a standard deviation of 0.4 of the logarithm; exponential: distributed so",
    )
    probability: Ratio = Field(
        default=0.2,
        ge=0,
        le=1,
        description="correlated: that the trap changes its state within a sample; single: that it is full",
    )
    sampling: Literal["correlated", "single"] = Field(
        default="correlated",
        description="correlated: signal less reset, drawn anew in every frame; single: the trap as it is",
    )
    samples: Count = Field(
        default=1,
        ge=1,
        le=64,
        description="correlated: samples averaged before and after (1: double sampling)",
    )
    correlation_frames: Frames = Field(
        default=30.0, gt=0, le=1e6, description="single: correlation time of the trap, frames"
    )
    times_spread: Ratio = Field(
        default=0.0,
        ge=0,
        le=3,
        description="single: standard deviation of the logarithms of the mean times full and empty, which "
        "differ from trap to trap; 0: alike in all",
    )

    #: double sampling at two steps, multiple sampling, slow traps that are alike, and real ones
    typical_values = (
        {"fraction": 0.014, "amplitude_e": 1.0},
        {"fraction": 0.014, "amplitude_e": 2.5, "probability": 0.1},
        {"fraction": 0.014, "amplitude_e": 1.0, "spread": "exponential"},
        {"fraction": 0.014, "amplitude_e": 1.5, "samples": 4},
        {"fraction": 0.014, "amplitude_e": 0.5, "probability": 0.5, "sampling": "single"},
        {"fraction": 0.014, "amplitude_e": 0.5, "probability": 0.5, "sampling": "single",
         "spread": "lognormal", "times_spread": 0.8},
    )  # fmt: skip

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with the steps of the pixels that have a trap."""
        result: AnyArray = values.copy()
        _, y, x = np.nonzero(context.random.uniform(("y", "x"), _WHERE) < self.fraction)
        if not y.size:
            return result

        def uniform(draw: int) -> FloatArray:
            found: FloatArray = context.random.uniform(("y", "x"), draw)[0, y, x]
            return found

        step = self._steps(uniform)
        if self.sampling == "single":
            full, times = self._traps(uniform)
            longest = self.correlation_frames * float(np.exp(_FARTHEST * self.times_spread))
            states = two_states(context.frames, times, full, lambda t: uniform(frame_key(t)), longest)
            result[:, y, x] += step * (states - full)
        else:
            result[:, y, x] += step * self._differences(context.random.uniform(("frame", "y", "x"))[:, y, x])
        return result

    def _steps(self, uniform: Callable[[int], FloatArray]) -> FloatArray | float:
        """Return the steps of traps, e-, given the uniform numbers of each for a draw."""
        if self.spread == "exponential":
            return np.asarray(self.amplitude_e * -np.log(uniform(_SIZE)))
        if self.spread == "lognormal":
            return np.asarray(self.amplitude_e * np.exp(_LOGNORMAL * special.ndtri(uniform(_SIZE))))
        return self.amplitude_e

    def _traps(self, uniform: Callable[[int], FloatArray]) -> tuple[FloatArray | float, FloatArray | float]:
        """Return the probabilities of slow traps to be full, and their correlation times, frames."""
        if self.times_spread == 0 or not 0 < self.probability < 1:
            return self.probability, self.correlation_frames
        full, empty = (
            self.correlation_frames / of_the_other * np.exp(self.times_spread * special.ndtri(uniform(draw)))
            for of_the_other, draw in ((1.0 - self.probability, _FULL), (self.probability, _EMPTY))
        )
        return full / (full + empty), full * empty / (full + empty)

    def _differences(self, uniform: FloatArray) -> FloatArray:
        """Return signal less reset, in steps of the trap, from uniform numbers of any shape."""
        # position within the half that a number falls in: the half is the sign
        inside = np.abs(2.0 * uniform - 1.0)
        rank = np.floor((inside - (1.0 - self.probability)) / max(self.probability, 1e-300) * self._places())
        rank = rank.clip(-1, self._places() - 1)
        height = np.minimum(rank + 1.0, self._places() - rank) / self.samples
        found: FloatArray = np.where(rank < 0, 0.0, np.sign(uniform - 0.5) * height)
        return found

    def _places(self) -> int:
        """Return between how many successive samples a jump can fall."""
        return 2 * self.samples - 1

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return what is typical, in as many pixels as stand out: slow traps by what they do in time."""
        slow = cls.typical_as_seen(evidence, "time.block.readout.cnt")
        return [
            *(one for one in super().estimate(evidence) if one.sampling == "correlated"),
            *(one for one in slow if one.sampling == "single"),
        ]

    def details(self) -> tuple[str, ...]:
        """Return the step, how often it comes, and how long a slow trap takes."""
        found = ["amplitude_e", "probability"]
        if self.sampling == "single":
            found += ["correlation_frames"]
        return tuple(name for name in found if getattr(self, name) > 0.0)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law that looks for such levels in every pixel, with a weight of its own.

        The fit decides pixel by pixel, since the effect is in few of them; steps around the stated one are
        tried, more of them where they are spread.
        """
        factors = _EQUAL if self.spread == "equal" else _EXPONENTIAL
        steps = [f * self.amplitude_e for f in factors if self.amplitude_e > 0]
        alarm = min(max(_ALARM * self.fraction, 1e-5), 1e-3)
        return model.with_free_satellites(steps, pattern=self._pattern(), alarm=alarm)

    def _pattern(self) -> list[tuple[float, float]]:
        """Return (shift in steps, weight) of the levels beside the quiet one."""
        if self.sampling == "single":
            return [(1.0, 1.0)]
        heights = np.arange(1, self.samples + 1) / self.samples
        weights = np.where(heights < 1.0, 1.0, 0.5) / self._places()
        return [(float(s * h), float(w)) for h, w in zip(heights, weights, strict=True) for s in (-1, 1)]
