"""Flicker of the exposure: every frame is a little brighter or darker as a whole.

The intensity noise of a lamp or laser, a shutter that jitters, or a temperature that jumps multiplies the
exposure of all pixels of frame t by ``a_t`` of mean 1 and standard deviation s (EMVA Standard 1288, release
4.0, requires the source to be stable for this reason). Successive frames may be alike
(``correlation_frames``), or the flicker may be a sine: a lamp on the mains, aliased by the frame rate. A lamp
that misses a cycle or a laser that hops between modes takes a few values only (``levels``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.charge_sums import ExposureProfile, exposure_nodes, exposure_profile
from pchem_pipeline.effects.estimators.common_modes import successive
from pchem_pipeline.effects.estimators.level_mixtures import Levels, few_levels
from pchem_pipeline.effects.estimators.lines import coherent_line
from pchem_pipeline.effects.estimators.regression import SIGNIFICANT
from pchem_pipeline.effects.framework.effect import Effect, Frames, Plane, Ratio, Turns, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, FloatArray, PixelMaps, SampleLaw

# cycles in the run below which a change is a drift
_SLOWEST = 20

_T = TypeVar("_T", bound="ExposureFlicker")


@register_effect
class ExposureFlicker(Effect):
    """Relative fluctuation of H from frame to frame, the same in all pixels.

    Signature: the frame means of the electron number scatter more than their shot noise, those of the readout
    residual do not, and the two do not vary together.
    """

    tag: Literal["exposure_flicker"] = Field(default="exposure_flicker", description="name of the effect")
    plane = Plane.EXPOSURE
    title = "illumination flicker (intensity noise)"
    source = "EMVA Standard 1288, release 4.0 (2021), sec. 6; Petermann 1988, Laser Diode Modulation"
    signature = (
        "frame.charge.variance",
        "frame.charge.line",
        "frame.charge.largest",
        "frame.charge.lag1",
    )
    strength = "rms"
    power = 2.0
    may_be_at_bound = ("phase_cycles",)
    separate: ClassVar[Mapping[str, str]] = {
        "glow": "a map of the bright frames: flicker is proportional to H, a glow local",
        "exposure_drift": "a longer run: flicker has no trend",
        "frame_noise": "covered pixels, or frames without exposure: constant with flicker",
        "overdispersed_counts": "pixels of one frame: all are correlated by flicker",
    }
    rms: Ratio = Field(ge=0, le=1, description="standard deviation of the exposure over its mean, no unit")
    correlation_frames: Frames = Field(
        default=0.0,
        ge=0,
        description="time in which the memory of a fluctuation falls to 1/e, frames; 0: every frame anew",
    )
    period_frames: Frames | None = Field(
        default=None, gt=1, description="period of a sine, frames; null: random fluctuations"
    )
    phase_cycles: Turns = Field(
        default=0.0,
        ge=0,
        le=1,
        description="phase of the sine at frame 0, cycles (0: rising through the mean)",
    )
    levels: tuple[float, ...] = Field(
        default=(),
        max_length=64,
        description="values that the exposure takes, in any unit (rms gives their size); "
        "empty: log-normal fluctuations",
    )
    shares: tuple[float, ...] = Field(
        default=(), max_length=64, description="share of the frames at each of the levels; empty: equal"
    )

    #: at 2 %: from frame to frame, slower, and on the mains (100 Hz at 30 frames/s)
    typical_values = (
        {"rms": 0.02},
        {"rms": 0.02, "correlation_frames": 5.0},
        {"rms": 0.02, "period_frames": 3.0},
    )

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if self.period_frames is not None and (self.correlation_frames > 0 or self.levels):
            other = "levels" if self.levels else "correlation_frames"
            raise ValueError(f"exposure_flicker: a sine has no {other}; leave one of them out")
        if self.shares and len(self.shares) != len(self.levels):
            raise ValueError(
                f"exposure_flicker: {len(self.shares)} shares for {len(self.levels)} levels; give as many"
            )
        if self.shares and not (min(self.shares) > 0 and abs(sum(self.shares) - 1.0) < 1e-3):
            raise ValueError("exposure_flicker: shares are above 0 and sum to 1")
        if self.levels and not len(set(self.levels)) > 1:
            raise ValueError("exposure_flicker: levels needs at least two different values")
        return self

    def _law(self) -> Levels:
        """Return the relative exposures of the levels, of mean 1, and their shares."""
        values = np.array(self.levels)
        shares = np.array(self.shares or [1.0] * values.size)
        law = Levels(values, shares / shares.sum())
        centred = (values - law.shares @ values) / law.rms
        return Levels(np.maximum(1.0 + self.rms * centred, 0.0), law.shares)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the flickering exposure (frame, y, x), e-."""
        if self.rms == 0:
            return values.copy()
        if self.period_frames is not None:
            phase = context.frames / self.period_frames + self.phase_cycles
            factor = np.maximum(1.0 + self.rms * np.sqrt(2.0) * np.sin(2.0 * np.pi * phase), 0.0)
        elif self.levels:
            from scipy.special import ndtr

            # the levels in their order, by the share of the normal law below the fluctuation
            law = self._law()
            order = np.argsort(law.values)
            below = np.cumsum(law.shares[order])[:-1]
            factor = law.values[order][np.searchsorted(below, ndtr(self._fluctuation(context)))]
        else:
            # log-normal: never negative, mean exactly 1
            width = np.sqrt(np.log1p(self.rms**2))
            factor = np.exp(width * self._fluctuation(context) - 0.5 * width**2)
        result: AnyArray = values * factor[:, None, None]
        return result

    def _fluctuation(self, context: EffectContext) -> FloatArray:
        """Return a normal number of mean 0 and variance 1 for each frame, shape (n,)."""
        if self.correlation_frames == 0:
            return context.random.normal(("frame",))[:, 0, 0]
        from scipy.signal import lfilter

        # the whole run each time: a few hundred numbers cost less than keeping them
        kept = np.exp(-1.0 / self.correlation_frames)
        steps = context.random.generator().standard_normal(context.n_frames)
        steps[1:] *= np.sqrt(1.0 - kept**2)
        path = np.asarray(lfilter([1.0], [1.0, -kept], steps))
        fluctuation: FloatArray = path[context.frames.clip(0, context.n_frames - 1)]
        return fluctuation

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return rms, and memory or period, from the variance, lags and spectrum of the frames' exposures."""
        profile = exposure_profile(evidence)
        if profile is None or evidence.time is None:
            return ()
        return [*_sine(cls, profile, evidence.time.n_run), *_random(cls, profile)][:4]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law mixed over the exposures of the frames."""
        if self.period_frames is not None:
            factors = 1.0 + self.rms * np.sqrt(2.0) * np.sin(2.0 * np.pi * (np.arange(400) + 0.5) / 400)
            return model.with_exposures(*exposure_nodes(factors))
        if self.levels:
            law = self._law()
            return model.with_exposures(law.shares, law.values / (law.shares @ law.values))
        # Gauss-Hermite in the logarithm
        nodes, weights = np.polynomial.hermite_e.hermegauss(3)
        width = np.sqrt(np.log1p(self.rms**2))
        factors = np.exp(width * nodes - 0.5 * width**2)
        weights = weights / weights.sum()
        return model.with_exposures(weights, factors / (weights @ factors))


def _random(cls: type[_T], profile: ExposureProfile) -> list[_T]:
    """Return a flicker anew in every frame, and one with a memory, where there is more than shot noise."""
    n = profile.deviation.size
    step = np.diff(profile.deviation)[successive(profile.frames)]
    if step.size < 8:
        return []
    # differences do not see a drift; their variance has the kurtosis of a moving average
    fast = 0.5 * float(np.mean(step**2)) - profile.variance
    fast_error = profile.variance * np.sqrt(3.0 / step.size)
    smooth = profile.deviation - profile.deviation.mean()
    whole = float(smooth @ smooth) / (n - 1) - profile.variance
    whole_error = profile.variance * np.sqrt(2.0 / n)
    if max(fast / fast_error, whole / whole_error) < 3.0:
        return []
    found: list[_T] = []
    levels = few_levels(profile.deviation, profile.variance)
    if fast > SIGNIFICANT * fast_error:
        found.append(cls(rms=min(float(np.sqrt(fast)), 1.0)))
    # fast = s^2 (1 - rho): the lag-1 correlation of an exponential memory
    rho = 1.0 - fast / whole if whole > 3.0 * whole_error else 0.0
    if 0.0 < rho < 0.98 and whole - fast > 3.0 * np.hypot(fast_error, whole_error):
        memory = float(-1.0 / np.log(rho))
        if memory < n / _SLOWEST:
            found.insert(0, cls(rms=min(float(np.sqrt(whole)), 1.0), correlation_frames=memory))
    if levels is None:
        return found
    rounded = {
        "levels": tuple(np.round((levels.values - levels.values.mean()) / levels.rms, 4).tolist()),
        "shares": tuple(levels.shares.tolist()),
    }
    return [*(cls(**{**one.model_dump(), "rms": min(levels.rms, 1.0), **rounded}) for one in found), *found]


def _sine(cls: type[_T], profile: ExposureProfile, n_run: int) -> list[_T]:
    """Return a sine at the highest line of the spectrum, if one stands out."""
    line = coherent_line(profile.deviation[:, None], profile.frames.astype(np.int64), n_run)
    if line is None or not 0.0 < line.per_frame < 1.0:
        return []
    rms = min(line.amplitude / 2.0**0.5, 1.0)
    cycles = line.phase / (2.0 * np.pi) % 1.0
    return [cls(rms=rms, period_frames=1.0 / line.per_frame, phase_cycles=cycles)]
