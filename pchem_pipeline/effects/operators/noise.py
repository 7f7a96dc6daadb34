"""Modulate the read noise of single pixels: its size, its shape, its memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field
from scipy import special

from pchem_pipeline.effects.framework.context import RandomSource
from pchem_pipeline.effects.framework.draws import OF_PIXEL, between_grid_points, frame_key, two_states
from pchem_pipeline.effects.framework.effect import Count, Effect, Electrons, Factors, Frames, Plane, Ratio
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)
from pchem_pipeline.model.arithmetic.significance import POSSIBLE

_SPACING = (1.0, 1 / 8, 1 / 64)


class FlickerNoise(Effect, tag="flicker_noise"):
    """Part of the power of the read noise that is correlated in time; the power of all stays as it is.

    The low-frequency noise of a source follower that correlated double sampling does not remove (1/f noise;
    van Vliet 1976; Kansy 1980) correlates successive frames of a pixel, each pixel by itself: ``R_t = (1 -
    share)^(1/2) sigma Z_t + share^(1/2) sigma U_t``. U is a stationary Ornstein-Uhlenbeck process, ``cov(U_t,
    U_{t+l}) = exp(-l / tau)``, with a Lorentzian spectrum, or the sum of three of them with tau spaced by
    factors of 8, nearly 1/f in between (McWhorter 1957).

    Signature: residuals of successive frames are alike and block means wander, each pixel by itself: neither
    frame means nor neighbours show anything, and a pixel's own histogram does not either.
    """

    plane = Plane.ANALOG
    title = "flicker (1/f) noise of the pixels"
    source = "van Vliet 1976; Kansy 1980 (double sampling of 1/f noise); McWhorter 1957"
    factors = Factors("offset", "each pixel", "correlated from frame to frame")
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
    #: from some frames to hundreds of frames long, and 1/f
    typical_values = (
        *({"share": 0.0036, "correlation_frames": tau} for tau in (3.0, 30.0, 300.0)),
        {"share": 0.0036, "correlation_frames": 300.0, "spectrum": "one_over_f"},
    )
    share: Ratio = Field(ge=0, le=1, description="share of the read noise power, no unit")
    correlation_frames: Frames = Field(
        default=30.0, gt=0, le=1e6, description="correlation time, frames; one_over_f: the longest one"
    )
    spectrum: Literal["lorentzian", "one_over_f"] = Field(
        default="lorentzian",
        description="lorentzian: one correlation time; one_over_f: it, an eighth and a 64th, of equal power",
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


# factor less 1 of noisy samples that move the tail and He4 by as many standard deviations
_WIDTH = 0.7


class HeavyTailedNoise(Effect, tag="heavy_tailed_noise"):
    """Scale mixture of two Gaussians; the read noise of a pixel remains that of its quiet samples.

    The read noise of a source follower is Gaussian only where many traps act together; a few of them, or
    pickup in bursts, make it a scale mixture: ``R`` has the pixel's ``sigma`` with probability ``1 - share``
    and ``factor sigma`` with probability ``share`` (Tukey 1960). In CMOS imagers such tails come from random
    telegraph noise of the source followers (Leyris et al. 2006; Wang et al. 2006).

    Signature: the fourth Hermite score is positive in all pixels alike and samples lie below all that the PCD
    allows (above, the Poisson tail hides them); nothing in time or space. The variance of the noise becomes
    ``sigma^2 (1 + share (factor^2 - 1))``.
    """

    plane = Plane.ANALOG
    title = "non-Gaussian (heavy-tailed) read noise"
    source = (
        "Tukey 1960 (contaminated normal); Wang, Rao, Mierop and Theuwissen 2006, Leyris et al. 2006 (tails "
        "of CMOS read noise)"
    )
    factors = Factors("read noise", "each pixel", "new in each frame")
    signature = ("tail.low.count", "shape.He4.mean", "tail.low.pixels", "shape.He3.mean", "shape.He3C1.mean")
    strength = "share"
    separate: ClassVar[Mapping[str, str]] = {
        "rts_noise": "longer runs: RTS noise stays in the same few pixels; or another number of "
        "correlated samples: it changes the levels of RTS noise",
        "adc_dnl": "a sweep of the bias: DNL is fixed in DN, tails shift with the peaks",
        "signal_dependent_noise": "frames without exposure: heavy tails remain",
    }
    #: few noisy samples, and more but less noisy ones; the last are near a Student law of many degrees of
    #: freedom: kurtosis almost without tails
    typical_values = tuple(
        {"share": share, "factor": factor}
        for share, factor in ((2.4e-4, 3.0), (3e-3, 2.0), (6e-5, 5.0), (5e-2, 1.25), (2e-2, 1.6))
    )
    share: Ratio = Field(ge=0, le=1, description="probability that a sample is noisy, no unit")
    factor: Ratio = Field(
        default=3.0, ge=1, le=30, description="noise of such a sample relative to others, no unit"
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with the noise of some samples enlarged."""
        noisy = context.random.uniform(("frame", "y", "x")) < self.share
        result: AnyArray = values.copy()
        if context.read_noise is not None:
            result[noisy] += (self.factor - 1.0) * context.read_noise[noisy]
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return what is typical; the wider the noisy samples, the more the tail shows them than He4 does."""
        tail, kurtosis = (max(evidence.z.get(name, 0.0), 1.0) for name in cls.signature[:2])
        width = 1.0 + _WIDTH * tail / kurtosis
        return sorted(super().estimate(evidence), key=lambda one: abs(np.log(one.factor / width)))

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with noise of two widths."""
        return model.with_noise(np.array([1.0 - self.share, self.share]), width=np.array([1.0, self.factor]))


#: Parts of the exponential up to a share of 0.6 (0.75 of the Gaussian part), and at most.
_LOBES, _ENOUGH_FOR, _MOST_LOBES = 8, 0.75, 16
_ROOT = 5.0


class NoiseSkew(Effect, tag="noise_skew"):
    """Exponential part of the read noise; mean and variance of the noise stay as they are.

    What has not settled when it is sampled (a slow source follower, dielectric absorption, a rectifying
    clamp) leans to one side, by an exponentially modified Gaussian (Grushka 1972): ``R = (1 - share^2)^(1/2)
    sigma Z + share sigma (E - 1)`` with ``Z`` standard normal and ``E`` exponential, both of variance 1, so
    that ``R`` has mean 0, variance ``sigma^2`` and skewness ``2 share^3``.

    Signature: the third Hermite score has one sign in all pixels, and with it He4 and He3C1; nothing in time
    or space. Peaks lean to high DN (``share`` positive) or low DN (negative).
    """

    plane = Plane.ANALOG
    title = "skewed read noise (exponentially modified Gaussian)"
    source = "Grushka 1972 (exponentially modified Gaussian)"
    factors = Factors("read noise", "each pixel", "new in each frame")
    signature = ("shape.He3.mean", "shape.He2C1.mean", "shape.He3C1.mean", "shape.He4.mean", "code.smooth")
    strength = "share"
    power = 3.0
    separate: ClassVar[Mapping[str, str]] = {
        "heavy_tailed_noise": "frames without exposure: skewed noise has one tail, heavy-tailed noise two",
        "signal_dependent_noise": "frames without exposure: the skewness remains",
        "nonlinearity": "a sweep of the exposure: the skewness is independent of the signal",
        "adc_inl": "a sweep of the bias: skewness shifts with the peaks, INL is fixed in DN",
        "rts_noise": "longer runs: RTS noise stays in the same few pixels",
    }
    typical_values = ({"share": 0.4}, {"share": -0.4})
    share: Ratio = Field(
        ge=-1,
        le=1,
        description="standard deviation of the exponential part over the read noise, no unit; "
        "negative: tail to low DN",
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with a part of the noise exchanged for an exponential one."""
        exponential = np.log(context.random.uniform(("frame", "y", "x")))
        exponential += 1.0
        exponential *= -self.share * context.truth["analog_read_noise_e"]
        if context.read_noise is not None:
            exponential -= (1.0 - self._gaussian) * context.read_noise
        exponential += values
        return exponential

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the exponential cut into parts, each a Gaussian of its mean and variance.

        Mean and variance of the noise stay exact. Its law is to 1e-6 nats per sample up to a share of 0.86,
        and to 1.5e-5 at 0.95.
        """
        # parts that are as wide in units of the Gaussian part, whatever the share
        wide = abs(self.share) / max(self._gaussian, 1e-3)
        parts = int(np.clip(np.ceil(_LOBES * wide / _ENOUGH_FOR), _LOBES, _MOST_LOBES))
        shifts, weights, variances = _exponential_parts(parts)
        width = np.sqrt(1.0 - self.share**2 * (1.0 - variances))
        return model.with_noise(weights, shift_sigma=self.share * shifts, width=width)

    @property
    def _gaussian(self) -> float:
        return float(np.sqrt(1.0 - self.share**2))


def _exponential_parts(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean (less 1), weight and variance of n consecutive parts of an exponential of mean 1.

    Edges at equal steps of the fifth root of the survival resolve the tail, which makes the skew.
    """
    edges = -_ROOT * np.log(1.0 - np.arange(n) / n)
    survival = np.append(np.exp(-edges), 0.0)
    first = np.append((edges + 1.0) * survival[:-1], 0.0)
    second = np.append((edges**2 + 2.0 * edges + 2.0) * survival[:-1], 0.0)
    weights = -np.diff(survival)
    means = -np.diff(first) / weights
    return means - 1.0, weights, -np.diff(second) / weights - means**2


class SignalDependentNoise(Effect, tag="signal_dependent_noise"):
    """Gaussian noise whose variance grows with the electron number or with its square.

    Each electron that is multiplied or collected with a gain of its own adds its own variance: ``Var(x | k)
    = sigma^2 + s^2 k`` (excess noise, McIntyre 1966; cell-to-cell gain spread of silicon photomultipliers,
    Eckert et al. 2010). A gain that differs from sample to sample is common to the sample's electrons: ``s^2
    k^2``.

    Signature: the score of width against electron number (He2C1) is positive in all pixels, and with it the
    third Hermite score; He2C2 tells the square from the number. Nothing in time or space.
    """

    plane = Plane.ANALOG
    title = "signal-dependent noise (gain or excess noise)"
    source = "McIntyre 1966 (multiplication noise); Eckert et al. 2010 (peaks of SiPM spectra)"
    factors = Factors("read noise", "each pixel", "with the charge of the sample")
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
    typical_values = ({"noise_e": 0.06}, {"noise_e": 0.03, "growth": "linear"})
    noise_e: Electrons = Field(ge=0, description="noise of one electron, e-")
    growth: Literal["root", "linear"] = Field(
        default="root",
        description="root: each electron adds variance of its own (noise_e k^(1/2)); linear: the electrons "
        "of a sample share it (noise_e k)",
    )

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
        if self.growth == "root":
            return model.with_variance(per_electron=self.noise_e**2)
        return model.with_variance(per_electron2=self.noise_e**2)


_WHERE, _SIZE, _FULL, _EMPTY = OF_PIXEL
# standard deviation of the logarithms of lognormal steps
_LOGNORMAL = 0.4
# standard deviations of the logarithms of its times by which hardly a trap is slower
_FARTHEST = 4.0
# steps tried in every pixel: around that of all, or 0.35 to 7 e-, of which a fit refines the best one
_EQUAL = (0.5, 0.63, 0.8, 1.0, 1.25, 1.6, 2.0)
_SPREAD_E = tuple(0.35 * 1.35**i for i in range(11))
_FAST = 0.1  # correlation time, frames, of a trap whose state is drawn anew in every frame
#: Largest scatter of the logarithms of steps that are distributed so.
_SPREADS = {"equal": 0.2, "lognormal": 0.6}
_ALARM = 0.1  # pixels wrongly given levels, of those that have some


class RtsNoise(Effect, tag="rts_noise"):
    """Telegraph noise of a share of the pixels, each with one trap; zero on average.

    While an oxide trap is full the source follower reads ``amplitude_e`` more (Kandiah and Whiting 1978; Wang
    et al. 2006). Correlated double sampling subtracts the state at reset from that at the signal: three
    levels, -A, 0 and +A (Leyris et al. 2006), with q/2, 1 - q and q/2. The means of N samples each before and
    after (correlated multiple sampling) move in steps of A/N, for a jump at a random place among the 2 N
    samples. Without double sampling the two levels of the slow trap itself are seen.

    Signature: in few pixels the noise is heavy-tailed (He4), the fit is poor and samples lie below the bias
    by more than the noise, where no electrons hide them. Sampled twice, successive frames and neighbours are
    independent; else the residuals of these few pixels are alike for many frames.
    """

    plane = Plane.ANALOG
    title = "random telegraph noise (RTS noise, burst noise) of the source follower"
    source = (
        "Kandiah and Whiting 1978; Wang, Rao, Mierop and Theuwissen 2006; Leyris et al. 2006 (three levels "
        "behind correlated double sampling)"
    )
    factors = Factors("offset", "single pixels", "jumping")
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
    #: double and multiple sampling, slow traps that are alike, and real ones
    typical_values = (
        {"fraction": 0.014, "amplitude_e": 1.0},
        {"fraction": 0.014, "amplitude_e": 1.2, "samples": 2},
        {"fraction": 0.014, "amplitude_e": 1.5, "samples": 4},
        {"fraction": 0.014, "amplitude_e": 0.5, "probability": 0.5, "sampling": "single"},
        {"fraction": 0.014, "amplitude_e": 0.5, "probability": 0.5, "sampling": "single",
         "spread": "lognormal", "times_spread": 0.8},
    )  # fmt: skip
    fraction: Ratio = Field(ge=0, le=1, description="share of the pixels that have a trap, no unit")
    amplitude_e: Electrons = Field(
        ge=0, le=1e4, description="step of the trap, e-; exponential: its mean over these pixels"
    )
    spread: Literal["equal", "lognormal", "exponential"] = Field(
        default="equal",
        description="equal: the same step in all these pixels; lognormal: amplitude_e is the median, "
        "standard deviation of the logarithm 0.4; exponential: the mean",
    )
    probability: Ratio = Field(
        default=0.2,
        ge=0,
        le=1,
        description="probability; correlated: that the trap changes within a sample; single: that it is full",
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
        description="single: scatter between traps of the mean times full and empty (standard deviation of "
        "the logarithm); 0: none",
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with the steps of the pixels that have a trap."""
        result: AnyArray = values.copy()
        _, y, x = np.nonzero(context.random.uniform(("y", "x"), _WHERE) < self.fraction)
        if not y.size:
            return result

        def uniform(draw: int) -> FloatArray:
            return np.asarray(context.random.uniform(("y", "x"), draw)[0, y, x])

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
        return np.asarray(np.where(rank < 0, 0.0, np.sign(uniform - 0.5) * height))

    def _places(self) -> int:
        """Return between how many successive samples a jump can fall."""
        return 2 * self.samples - 1

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return what is typical, in as many pixels as stand out, and traps faster than the frames."""
        levels = cls.typical_as_seen(evidence, *cls.signature[:2], "time.block.readout.cnt")
        single = [one for one in levels if one.sampling == "single"]
        return [*levels, *(one.model_copy(update={"correlation_frames": _FAST}) for one in single[:1])]

    def with_satellites(self, amplitude_e: FloatArray, weight: FloatArray, share: float) -> Self:
        """Return it with the steps of these traps, as often full, in such a share of the pixels."""
        scatter = float(np.std(np.log(amplitude_e)))
        spread = next((name for name, most in _SPREADS.items() if scatter < most), "exponential")
        middle = float(np.mean(amplitude_e) if spread == "exponential" else np.median(amplitude_e))
        found = {"fraction": share, "amplitude_e": middle, "spread": spread, "probability": np.median(weight)}
        return self.model_validate(self.model_dump() | found)

    def details(self) -> tuple[str, ...]:
        """Return the step, how often it comes, and how long a slow trap takes."""
        found = ["amplitude_e", "probability"]
        if self.sampling == "single":
            found += ["correlation_frames"]
        return tuple(name for name in found if getattr(self, name) > 0.0)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law that looks for such levels in every pixel, with a weight of its own.

        The fit decides pixel by pixel, since the effect is in few of them. Steps that differ from pixel to
        pixel do so tenfold: they are sought whatever the stated one is.
        """
        steps = [f * self.amplitude_e for f in _EQUAL] if self.spread == "equal" else _SPREAD_E
        steps = steps if self.amplitude_e > 0 else ()
        alarm = min(max(_ALARM * self.fraction, 1e-5), 1e-3)
        return model.with_free_satellites(steps, pattern=self._pattern(), alarm=alarm)

    def _pattern(self) -> list[tuple[float, float]]:
        """Return (shift in steps, weight) of the levels beside the quiet one."""
        if self.sampling == "single":
            return [(1.0, 1.0)]
        heights = np.arange(1, self.samples + 1) / self.samples
        weights = np.where(heights < 1.0, 1.0, 0.5) / self._places()
        return [(float(s * h), float(w)) for h, w in zip(heights, weights, strict=True) for s in (-1, 1)]
