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
from pchem_pipeline.effects.estimators.pixel_law import PixelLaw, refitted, typical_pixels
from pchem_pipeline.effects.estimators.regression import FEW_PIXELS
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
    BoolArray,
    EffectContext,
    Evidence,
    FloatArray,
    PixelMaps,
    SampleLaw,
)

_WHERE, _SIZE, _FULL, _EMPTY = OF_PIXEL
# standard deviation of the logarithms of lognormal steps
_LOGNORMAL = 0.4
# steps, e-, and samples averaged that the estimator looks for, with probabilities
_STEPS = (
    (0.5, 1), (0.7, 1), (1.0, 1), (1.5, 1), (2.5, 1), (4.0, 1), (1.3, 2), (2.0, 2), (1.5, 4), (3.0, 4),
)  # fmt: skip
# pixels that must stand out: most with strong traps are led so far astray that their fit is not usable
_FEWEST = 2
# share of the pixels guessed at least: what moves no statistic clearly cannot be scaled to what is there
_LEAST_FRACTION = 0.04
_PROBABILITIES = (0.01, 0.03, 0.08, 0.2, 0.4)
# what outlying pixels are compared by, with the form of the peaks before, and how far they must stand out
_PROFILE = ("He4", "C2", "He2C1", "He2C2", "He3C1")
_LIMITS = np.array([4.2, 6.0, 4.2, 4.5, 4.5, 5.0])
# standard deviations of a correlation in time beyond which a pixel has a slow trap
_SLOW = 5.0
# median step of slow traps that differ, over that of those which stand out
_OF_THE_LARGEST = (0.8, 0.55)
# standard deviations of the logarithms of its times by which hardly a trap is slower
_FARTHEST = 4.0
# spread of the times of real traps: those of one oxide differ by more than the frames of a run show
_USUAL_TIMES_SPREAD = 0.8
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

    #: double sampling at two steps, multiple sampling, and a slow trap
    typical_values = (
        {"fraction": 0.014, "amplitude_e": 1.0},
        {"fraction": 0.014, "amplitude_e": 2.5, "probability": 0.1},
        {"fraction": 0.014, "amplitude_e": 1.0, "spread": "exponential"},
        {"fraction": 0.014, "amplitude_e": 1.5, "samples": 4},
        {"fraction": 0.014, "amplitude_e": 0.5, "probability": 0.5, "sampling": "single"},
    )

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
        """Return steps of several sizes, each with the probability and share that outlying pixels ask for.

        Probability and order are those whose form of the peaks and scores resemble the outlying pixels'; the
        number of these gives the share.
        """
        found = cls._correlated(evidence)
        slow = cls._single(evidence)
        return [*found[: 5 - len(slow)], *slow]

    @classmethod
    def _correlated(cls, evidence: Evidence) -> list[Self]:
        outlying = _outlying(evidence)
        n, count = int(evidence.maps.usable.sum()), int(outlying.sum())
        # where most pixels stand out something else is wrong
        if count < _FEWEST or count > FEW_PIXELS * n:
            return []
        seen = np.array([np.median(values[outlying]) for values in _profile(evidence)])
        chosen = typical_pixels(evidence.maps, 3)[0]
        laws = [PixelLaw(evidence.maps, int(pixel), evidence.n_frames) for pixel in chosen]
        kinds = [
            cls(fraction=count / n, amplitude_e=amplitude, samples=samples, probability=q)
            for amplitude, samples in _STEPS
            for q in _PROBABILITIES
        ]
        profiles = _expected_profiles([kind._as_noise() for kind in kinds], laws, evidence.n_frames)
        misfit = ((np.arcsinh(profiles / 3.0) - np.arcsinh(seen / 3.0)) ** 2).sum(axis=1)
        best = []
        for step in np.split(np.arange(len(kinds)), len(_STEPS)):
            at = step[np.argmin(misfit[step])]
            # those too weak to stand out count too
            power = max(_survival(float((_LIMITS - _departure(profiles[at])).min())), 0.3)
            share = min(max(count / n / power, _LEAST_FRACTION), 1.0)
            best.append((misfit[at], kinds[at].model_copy(update={"fraction": share})))
        ranked = [effect for _, effect in sorted(best, key=lambda item: float(item[0]))]
        # real traps differ; the mean of those that stand out is well above that of all
        spread = ranked[0].model_copy(
            update={"spread": "exponential", "amplitude_e": 0.7 * ranked[0].amplitude_e}
        )
        # how many samples are averaged shows little in these profiles: the best of each is a guess
        likeliest = {effect.samples: effect for effect in reversed(ranked)}
        first = sorted(likeliest.values(), key=ranked.index)
        return [*first, spread, *(effect for effect in ranked if effect not in first)]

    @classmethod
    def _single(cls, evidence: Evidence) -> list[Self]:
        """Return a slow trap where the few pixels are strongly correlated in time."""
        time, maps = evidence.time, evidence.maps
        if time is None or time.n_pairs < 10:
            return []
        charge, readout = (
            np.asarray(lags, np.float64)[:, maps.usable] for lags in (time.lag_charge, time.lag_readout)
        )
        outlying = np.fmax(charge[0], readout[0]) * np.sqrt(time.n_pairs) > _SLOW
        if outlying.sum() < 3 or outlying.sum() > FEW_PIXELS * outlying.size:
            return []
        sd_k = evidence.charge_std[maps.usable][outlying]
        sd_r = (evidence.readout_std * maps.conversion_gain)[maps.usable][outlying]
        # k + r g is the sample itself, so its autocovariance is A^2 p (1 - p) rho
        both = (time.lag_readout_charge + time.lag_charge_readout)[maps.usable][outlying]
        near, _, far = (charge[:, outlying] * sd_k**2 + readout[:, outlying] * sd_r**2).mean(axis=1)
        rho = float(np.clip(max(far / near, 0.0) ** 0.5, 0.05, 0.995))
        amplitude = 2.0 * float(np.sqrt(max(near + float((both * sd_k * sd_r).mean()), 1e-6) / rho))
        alike = cls(
            fraction=float(outlying.mean()),
            amplitude_e=min(amplitude, 1e4),
            probability=0.5,
            sampling="single",
            correlation_frames=-1.0 / float(np.log(rho)),
        )
        # where traps differ, those that stand out have larger steps than most
        differing = [
            alike.model_copy(
                update={
                    "spread": "lognormal",
                    "times_spread": _USUAL_TIMES_SPREAD,
                    "amplitude_e": alike.amplitude_e * share,
                }
            )
            for share in _OF_THE_LARGEST
        ]
        return [alike, *differing]

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

    def _as_noise(self) -> SampleLaw:
        """Return the law of a pixel with a trap."""
        shifts, weights = np.array(self._pattern()).T
        return SampleLaw().with_noise(
            np.append(1.0 - self.probability, self.probability * weights),
            shift_e=np.append(0.0, self.amplitude_e * shifts),
        )


def _profile(evidence: Evidence) -> list[FloatArray]:
    """Return what outlying pixels are compared by: form of the peaks and some scores of the usable pixels."""
    usable = evidence.maps.usable
    return [
        np.nan_to_num(values[usable].astype(np.float64))
        for values in (evidence.peaks, *(evidence.scores[name] for name in _PROFILE))
    ]


def _departure(profile: FloatArray) -> FloatArray:
    """Return how far a profile departs from none: upwards in peaks and He4, either way in the others."""
    return np.concatenate([profile[:2], np.abs(profile[2:])])


def _outlying(evidence: Evidence) -> BoolArray:
    """Return which usable pixels stand out in something."""
    return np.asarray((_departure(np.array(_profile(evidence))) > _LIMITS[:, None]).any(axis=0))


def _expected_profiles(kinds: Sequence[SampleLaw], laws: Sequence[PixelLaw], n_frames: int) -> FloatArray:
    """Return the same for pixels of other laws, the median over the pixels: (kind, profile).

    The PCD is fitted to the exact law of such pixels, since it takes up much of the steps.
    """
    masses = [law.mass_of(kind) for kind in kinds for law in laws]
    fits = refitted(list(laws) * len(kinds), masses, n_frames)
    rows = []
    for fit, mass in zip(fits, masses, strict=True):
        change = fit.on_codes(*mass) - fit.mass
        scores = [fit.score_shift(name, change) * np.sqrt(n_frames) for name in _PROFILE]
        rows.append([fit.goodness(change, n_frames), *scores])
    found: FloatArray = np.median(np.array(rows).reshape(len(kinds), len(laws), -1), axis=1)
    return found


def _survival(z: float) -> float:
    """Return the probability that a standard normal number is above z."""
    from math import erfc, sqrt

    return 0.5 * erfc(z / sqrt(2.0))
