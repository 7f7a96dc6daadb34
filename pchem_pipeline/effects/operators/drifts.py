"""Modulate offset, gain or light slowly or from frame to frame, for all pixels alike."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.charge_sums import ExposureProfile, exposure_nodes, exposure_profile
from pchem_pipeline.effects.estimators.common_modes import SIGNIFICANT, responsivity, run_position, successive
from pchem_pipeline.effects.estimators.series import (
    Levels,
    along_path,
    coherent_line,
    few_levels,
    likely_profiles,
    settling,
)
from pchem_pipeline.effects.framework.effect import (
    Dn,
    Effect,
    Factors,
    Frames,
    Plane,
    Ratio,
    SharedOffset,
    Turns,
)
from pchem_pipeline.effects.operators.offsets import OffsetEffect, quantile_means
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    FloatArray,
    PixelMaps,
    SampleLaw,
    TimeSeries,
)

_FEWEST = 8  # frames
_POSITIONS = 1001  # evenly spaced along the run, that stand for all


class Drift(Effect):
    """Base of what changes slowly along the run, zero on average; the strength is the change, end less start.

    A subclass gives the strength, its unit, and what follows the profile. Frames before the run are as the
    first one.
    """

    shape: Literal["linear", "settling", "path", "walk"] = Field(
        default="linear",
        description="time profile. linear; settling: exponential approach to the end; path: as listed in "
        "`path`; walk: random walk, the strength is the standard deviation of its end less the start",
    )
    settling_fraction: Ratio = Field(
        default=0.2, gt=0, le=10, description="settling: time constant in lengths of the run"
    )
    path: tuple[float, ...] = Field(
        default=(),
        max_length=4096,
        description="path: values at equally spaced frames from first to last of the run, in units of the "
        "strength, linear in between",
    )

    @model_validator(mode="after")
    def _path_where_it_belongs(self) -> Self:
        if self.shape == "path" and len(self.path) < 2:
            raise ValueError(f"{self.tag}: shape path needs `path` with 2 values or more")
        if self.shape != "path" and self.path:
            raise ValueError(f"{self.tag}: `path` is for shape path, not {self.shape}; leave one of them out")
        return self

    def in_frames(self, context: EffectContext) -> FloatArray:
        """Return the profile at the block's frames, in units of the strength, shape (n,)."""
        if self.shape != "walk":
            return self.profile(run_position(context.frames, context.n_frames))
        steps = context.random.generator().standard_normal(context.n_frames)
        walk = np.cumsum(steps) / np.sqrt(context.n_frames)
        return np.asarray(walk[context.frames.clip(0, context.n_frames - 1)] - walk.mean())

    def profile(self, position: FloatArray) -> FloatArray:
        """Return the profile at times 0..1 (first to last frame), in units of the strength, of mean 0."""
        if self.shape == "settling":
            return settling(position, self.settling_fraction)
        return along_path(position, self.path or (-0.5, 0.5))

    def values(self) -> FloatArray:
        """Return values, in the unit of the strength, that stand, each as likely, for those in a run."""
        position = np.linspace(0.0, 1.0, _POSITIONS)
        if self.shape == "walk":
            from scipy.special import ndtri

            # mean square of a walk around its own mean: a sixth of the variance of its end
            profile = ndtri((position * (_POSITIONS - 1) + 0.5) / _POSITIONS) / np.sqrt(6.0)
        else:
            profile = self.profile(position)
        return np.asarray(getattr(self, self.strength) * profile)

    @classmethod
    @abstractmethod
    def series(cls, evidence: Evidence, time: TimeSeries) -> FloatArray:
        """Return for each frame what follows the profile, about in the unit of the strength, shape (n,)."""

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the time profiles that the series of the frames may follow."""
        time = evidence.time
        if time is None or time.frames.size < _FEWEST or not evidence.maps.usable.any():
            return ()
        found = []
        for each in likely_profiles(cls.series(evidence, time), run_position(time.frames, time.n_run)):
            fields = {"shape": each.shape, "path": each.path, "settling_fraction": each.settling_fraction}
            fields[cls.strength] = cls.limited(cls.strength, each.size)
            found.append(cls.model_validate(fields))
        return found


class BiasDrift(Drift, OffsetEffect, tag="bias_drift"):
    """Slow offset of all pixels, zero on average over the run.

    The pedestal follows the temperature of the readout electronics and the ageing of its references: ``x +=
    b_t`` with b_t slow against a frame (pedestal drift; Rauscher 2015, PASP 127, 1144). The linear shape is
    the usual warming up; a shape of its own (``path``) is what a measured run really did; a random walk is
    what another run of the same camera may do. A slow sine is ``periodic_pickup`` at a few cycles per run.

    Signature: block means of the readout residual move together, by the same number of DN in every pixel,
    whatever its exposure; those of the charge do not move. A pixel's own histogram is smeared over the path.
    """

    title = "bias (pedestal) drift"
    source = "Rauscher 2015, PASP 127, 1144 (pedestal drift); Janesick 2001, ch. 7"
    factors = Factors("offset", "all pixels", "drifting")
    signature = ("frame.readout.trend", "frame.readout.slow", "frame.readout.lag1", "time.lag1.readout.mean")
    strength = "drift_dn"
    separate: ClassVar[Mapping[str, str]] = {
        "exposure_drift": "a map of exposures: an exposure drift is proportional to it, a bias drift uniform",
        "gain_drift": "a bright and a dark region: gain drift is proportional to the signal",
        "bias_jumps": "means of the quadrants, frame by frame: jumps are sudden and independent",
        "flicker_noise": "block means of single pixels: 1/f noise is independent, a drift common",
    }
    typical_values = (
        {"drift_dn": 0.09},
        {"drift_dn": -0.09},
        {"drift_dn": 0.09, "shape": "path", "path": (-0.5, 0.5, -0.5)},
    )
    drift_dn: Dn = Field(
        ge=-1e6,
        le=1e6,
        description="change of the bias from start to end, DN; path: its scale; "
        "walk: standard deviation of the end less the start, DN",
    )

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the offsets of the frames, DN."""
        return np.asarray((self.drift_dn * self.in_frames(context))[:, None, None])

    def offset_values(self) -> FloatArray:
        """Return values, DN, that the path goes through."""
        return quantile_means(self.values())

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law smeared over the path; of a walk that with its variance."""
        if self.shape == "walk":
            return model.with_variance(dn2=self.drift_dn**2 / 6.0)
        return super().sample_law(model, maps)

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


class GainDrift(Drift, tag="gain_drift"):
    """Slow change of 1/g of all pixels, zero on average over the run.

    The gain of amplifiers and the references of the ADC follow temperature and supply: ``x = round(mu + (1 +
    drift u_t) (K + R) / g)`` with u_t from -1/2 at the first frame to 1/2 at the last (gain stability: EMVA
    1288; Janesick 2007). A shape of its own (``path``) is what a measured run really did.

    Signature: block means of the readout residual move in proportion to the exposure of the pixel, and the
    residual follows the charge within a block; those of the charge do not move. A pixel's peaks widen in
    proportion to the electron number.
    """

    plane = Plane.ANALOG
    title = "conversion gain drift"
    source = "EMVA 1288 (stability of the gain); Janesick 2007"
    factors = Factors("gain", "all pixels", "drifting")
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
    typical_values = (
        {"drift": 0.006},
        {"drift": -0.006},
        {"drift": 0.006, "shape": "path", "path": (-0.5, 0.5, -0.5)},
    )
    drift: Ratio = Field(
        ge=-0.5,
        le=0.5,
        description="relative change of the gain from first to last frame, no unit; path: its scale",
    )

    @model_validator(mode="after")
    def _gain_stays_positive(self) -> Self:
        if np.abs(self.values()).max() >= 1:
            raise ValueError("gain_drift: drift times path takes the gain to zero; make one of them smaller")
        return self

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, scaled by the time profile of the gain."""
        return np.asarray(values * (1.0 + self.drift * self.in_frames(context))[:, None, None])

    @classmethod
    def series(cls, evidence: Evidence, time: TimeSeries) -> FloatArray:
        """Return the relative gain of the frames, without what of it is taken for charge."""
        return time.frame_gain

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the variance of the gain: that of the peaks grows as k^2."""
        return model.with_variance(per_electron2=float(self.values().var()))


class ExposureDrift(Drift, tag="exposure_drift"):
    """Relative change of H from the first frame to the last, the same in every pixel.

    PCH-EM assumes independent, identically distributed frames (Hendrickson et al. 2023, Sec. II-B). Here
    frame ``n`` of ``N`` sees ``H_n = H (1 + drift s_n)`` with a time profile s of mean 0 and range 1. Dark
    current doubles every 6 to 8 K, so a tenth of a kelvin over the run already drifts by 1 %.

    A ``path`` may be in any unit: its mean and range are taken out. Of a time constant or a path alone, the
    shape need not be told.

    Signature: block means of the electron number follow the drift with a slope proportional to H, those of
    the readout residual do not. For large N the variance grows by ``(drift H / g)^2 / 12`` DN^2 and is no
    longer that of any single PCD.
    """

    plane = Plane.EXPOSURE
    title = "exposure drift (of the light or the dark current)"
    source = "Widenhorn et al. 2002, Proc. SPIE 4669, 193 (dark current and temperature)"
    factors = Factors("light", "all pixels", "drifting")
    signature = ("frame.charge.trend", "frame.charge.slow", "time.block.charge.chi", "frame.charge.lag1")
    strength = "drift"
    separate: ClassVar[Mapping[str, str]] = {
        "glow": "a map of the change along the run: light drifts as H, a glow is local",
        "gain_drift": "the peak spacing: constant with an exposure drift",
        "bias_drift": "frames of zero integration time: constant with an exposure drift",
        "persistence": "a run after long darkness: no persistence",
        "exposure_flicker": "a photodiode or a thermometer: follows a drift",
    }
    #: at 1.6 % end to end, rising and falling, straight and settling
    typical_values = (
        {"drift": 0.016},
        {"drift": -0.016},
        {"drift": 0.016, "settling_fraction": 0.2},
        {"drift": -0.016, "settling_fraction": 0.2},
    )
    drift: Ratio = Field(
        ge=-2,
        le=2,
        description="relative change of the exposure from first to last frame, no unit; path: its range",
    )

    @model_validator(mode="before")
    @classmethod
    def _shape_of_numbers(cls, given: Any) -> Any:
        """Return the fields with the shape that a time constant, or a path, is of."""
        if not isinstance(given, Mapping) or "shape" in given:
            return given
        fields = {k: v for k, v in given.items() if k != "settling_fraction" or v is not None}
        path, settles = fields.get("path"), "settling_fraction" in fields
        if path and settles:
            raise ValueError(
                "exposure_drift: path and settling_fraction are two time profiles; give one of them"
            )
        return {**fields, "shape": "path" if path else "settling" if settles else "linear"}

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
        return np.asarray(values * factor[:, None, None])

    @classmethod
    def series(cls, evidence: Evidence, time: TimeSeries) -> FloatArray:
        """Return the relative exposures of the frames."""
        return time.frame_charge

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law mixed over the exposures of the run."""
        return model.with_exposures(*exposure_nodes(1.0 + self.values()))


# cycles in the run below which a change is a drift
_SLOWEST = 20


class ExposureFlicker(Effect, tag="exposure_flicker"):
    """Relative fluctuation of H from frame to frame, the same in all pixels.

    The intensity noise of a lamp or laser, a shutter that jitters, or a temperature that jumps multiplies the
    exposure of all pixels of frame t by ``a_t`` of mean 1 and standard deviation s. Successive frames may be
    alike (``correlation_frames``), or the flicker may be a sine: a lamp on the mains, aliased by the frame
    rate. A lamp that misses a cycle or a laser that hops between modes takes a few values only (``levels``).

    Signature: the frame means of the electron number scatter more than their shot noise, those of the readout
    residual do not, and the two do not vary together.
    """

    plane = Plane.EXPOSURE
    title = "exposure flicker (intensity noise)"
    source = "EMVA Standard 1288, release 4.0 (2021), sec. 6; Petermann 1988, Laser Diode Modulation"
    factors = Factors("light", "all pixels", "new in each frame")
    signature = ("frame.charge.variance", "frame.charge.line", "frame.charge.largest", "frame.charge.lag1")
    strength = "rms"
    power = 2.0
    may_be_at_bound = ("phase_cycles",)
    separate: ClassVar[Mapping[str, str]] = {
        "glow": "a map of the bright frames: flicker is proportional to H, a glow local",
        "exposure_drift": "a longer run: flicker averages out",
        "frame_noise": "covered pixels, or frames without exposure: constant with flicker",
        "overdispersed_counts": "pixels of one frame: all are correlated by flicker",
    }
    #: at 2 %: from frame to frame, slower, and on the mains (100 Hz at 30 frames/s)
    typical_values = (
        {"rms": 0.02},
        {"rms": 0.02, "correlation_frames": 5.0},
        {"rms": 0.02, "period_frames": 3.0},
    )
    rms: Ratio = Field(ge=0, le=1, description="standard deviation of the exposure over its mean, no unit")
    correlation_frames: Frames = Field(
        default=0.0, ge=0, description="correlation time (to 1/e), frames; 0: independent frames"
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
        return np.asarray(values * factor[:, None, None])

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
        return np.asarray(path[context.frames.clip(0, context.n_frames - 1)])

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return rms, and memory or period, from the variance, lags and spectrum of the frames' exposures."""
        profile = exposure_profile(evidence)
        if profile is None or evidence.time is None:
            return ()
        return [*cls._sine(profile, evidence.time.n_run), *cls._random(profile)][:4]

    @classmethod
    def _random(cls, profile: ExposureProfile) -> list[Self]:
        """Return a flicker new in every frame, and one with a memory, where there is more than shot noise."""
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
        found: list[Self] = []
        if fast > SIGNIFICANT * fast_error:
            found.append(cls(rms=min(float(np.sqrt(fast)), 1.0)))
        # fast = s^2 (1 - rho): the lag-1 correlation of an exponential memory
        rho = 1.0 - fast / whole if whole > 3.0 * whole_error else 0.0
        if 0.0 < rho < 0.98 and whole - fast > 3.0 * np.hypot(fast_error, whole_error):
            memory = float(-1.0 / np.log(rho))
            if memory < n / _SLOWEST:
                found.insert(0, cls(rms=min(float(np.sqrt(whole)), 1.0), correlation_frames=memory))
        levels = few_levels(profile.deviation, profile.variance)
        if levels is None:
            return found
        rounded = {
            "rms": min(levels.rms, 1.0),
            "levels": tuple(np.round((levels.values - levels.values.mean()) / levels.rms, 4).tolist()),
            "shares": tuple(levels.shares.tolist()),
        }
        return [*(cls(**(one.model_dump() | rounded)) for one in found), *found]

    @classmethod
    def _sine(cls, profile: ExposureProfile, n_run: int) -> list[Self]:
        """Return a sine at the highest line of the spectrum, if one stands out."""
        line = coherent_line(profile.deviation[:, None], profile.frames, n_run)
        if line is None or line.per_frame is None or not 0.0 < line.per_frame < 1.0:
            return []
        rms = min(line.amplitude / 2.0**0.5, 1.0)
        cycles = line.phase / (2.0 * np.pi) % 1.0
        return [cls(rms=rms, period_frames=1.0 / line.per_frame, phase_cycles=cycles)]

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
