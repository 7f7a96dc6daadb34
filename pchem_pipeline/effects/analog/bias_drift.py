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
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.common_modes import (
    WORTH_A_GUESS,
    responsivity,
    run_position,
    successive,
)
from pchem_pipeline.effects.estimators.time_profiles import (
    NODES,
    Fit,
    check_path,
    fitted,
    fitted_profile,
    hats,
    profile_at,
    settling,
    settling_time,
)
from pchem_pipeline.effects.families.offsets import OffsetEffect, quantile_means
from pchem_pipeline.effects.framework.effect import Dn, Ratio, register_effect
from pchem_pipeline.effects.framework.shared_offset import SharedOffset
from pchem_pipeline.effects.types import (
    EffectContext,
    Evidence,
    FloatArray,
    PixelMaps,
    SampleLaw,
    TimeSeries,
)

_FRAMES_PER_NODE = 12  # so that a node's error is well below that of a frame
_WORTH_A_CURVE = 4.0  # of the Bayesian information criterion, beyond a line


@register_effect
class BiasDrift(OffsetEffect):
    """Slow offset of all pixels, zero on average over the run.

    Signature: block means of the readout residual move together, by the same number of DN in every pixel,
    whatever its exposure; those of the charge do not move. A pixel's own histogram is smeared over the path.
    """

    tag: Literal["bias_drift"] = Field(default="bias_drift", description="name of the effect")
    title: ClassVar[str] = "bias (pedestal) drift"
    source: ClassVar[str] = "Rauscher 2015, PASP 127, 1144 (pedestal drift); Janesick 2001, ch. 7"
    signature: ClassVar[tuple[str, ...]] = (
        "frame.readout.trend",
        "frame.readout.slow",
        "frame.readout.lag1",
        "time.lag1.readout.mean",
    )
    strength: ClassVar[str] = "drift_dn"
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
    shape: Literal["linear", "settling", "path", "walk"] = Field(
        default="linear",
        description="linear; settling: exponential approach to the end; path: as listed in `path`; walk: "
        "random walk",
    )
    settling_fraction: Ratio = Field(
        default=0.2, gt=0, le=10, description="settling: time constant in lengths of the run"
    )
    path: tuple[float, ...] = Field(
        default=(),
        max_length=4096,
        description="bias at equally spaced frames from first to last of the run, in units of drift_dn",
    )

    #: at 0.09 DN: rising, falling, there and back
    typical_values = (
        {"drift_dn": 0.09},
        {"drift_dn": -0.09},
        {"drift_dn": 0.09, "shape": "path", "path": (-0.5, 0.5, -0.5)},
    )

    @model_validator(mode="after")
    def _path_where_it_belongs(self) -> Self:
        check_path(self.tag, self.shape, self.path)
        return self

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the offsets of the frames, DN."""
        if self.shape == "walk":
            offset = _walk(context)
        else:
            offset = self._path_at(run_position(context.frames, context.n_frames))
        return np.asarray((self.drift_dn * offset)[:, None, None])

    def offset_values(self) -> FloatArray:
        """Return values, DN, that the path goes through."""
        return quantile_means(self.drift_dn * self._path_at(np.linspace(0.0, 1.0, 1001)))

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law smeared over the path; of a walk that with its variance."""
        if self.shape == "walk":
            # mean square of a walk around its own mean: a sixth of the variance of its end
            return model.with_variance(dn2=self.drift_dn**2 / 6.0)
        return super().sample_law(model, maps)

    def _path_at(self, position: FloatArray) -> FloatArray:
        """Return the shape at positions 0..1 in the run, in units of ``drift_dn``, zero on average."""
        fraction = self.settling_fraction if self.shape == "settling" else None
        return profile_at(position, fraction, self.path)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the regression of the frames' means on time: a line, and time profiles that explain more.

        Those are an exponential approach, a path with as many nodes as the Bayesian information criterion
        asks for, and a random walk like that path.
        """
        if evidence.time is None or evidence.time.frames.size < 8:
            return ()
        time, alpha = evidence.time, responsivity(evidence)
        position = run_position(time.frames, time.n_run)
        means, frames = time.frame_readout, position.size

        def criterion(fit: Fit) -> float:
            return frames * float(np.log(max(fit.chi2, 1e-300) / frames)) + fit.price(frames)

        line = fitted_profile(means, position)
        fraction = settling_time(lambda f: criterion(fitted_profile(means, settling(position, f))))
        settled = fitted_profile(means, settling(position, fraction))
        paths = [fitted(means, hats(position, n)) for n in NODES if frames >= _FRAMES_PER_NODE * n]
        path = min(paths, key=criterion, default=line)
        slope, error = _slope(position, means)
        found = [cls(drift_dn=slope / alpha)] if abs(slope) > WORTH_A_GUESS * error else []
        least = criterion(line) - _WORTH_A_CURVE
        if criterion(settled) < least:
            size = settled.values[1] / alpha
            found.insert(0, cls(drift_dn=size, shape="settling", settling_fraction=fraction))
        if not criterion(path) < least:
            if found or evidence.strongest("frame.readout.slow") <= 3.0:
                return found
            return [cls(drift_dn=max(_wander(time), 1e-9) / alpha, shape="walk")]
        nodes = path.values
        size = float(np.ptp(nodes)) or 1.0
        bent = cls(drift_dn=size / alpha, shape="path", path=tuple(np.round(nodes / size, 6).tolist()))
        # a random walk of variance s^2 u has steps of variance s^2 / (nodes - 1) between nodes
        walk = cls(drift_dn=float(np.sqrt((np.diff(nodes) ** 2).sum())) / alpha, shape="walk")
        if criterion(settled) < min(least, criterion(path)):
            return [*found, bent, walk]
        return [bent, *found, walk]

    def shared_offset(self) -> SharedOffset:
        """Return the offset of a frame: others may be at any place of the drift."""
        return SharedOffset("frame", self.drift_dn**2)


def _walk(context: EffectContext) -> FloatArray:
    """Return a random walk over the run with an end of unit variance, at the block's frames."""
    steps = context.random.generator().standard_normal(context.n_frames)
    walk = np.cumsum(steps) / np.sqrt(context.n_frames)
    return np.asarray(walk[context.frames.clip(0, context.n_frames - 1)] - walk.mean())


def _slope(position: FloatArray, means: FloatArray) -> tuple[float, float]:
    """Return the slope of the means against the position, and its standard error, DN per run."""
    centred = position - position.mean()
    square = float((centred**2).sum())
    if square <= 0:
        return 0.0, np.inf
    slope = float((centred * means).sum() / square)
    left = means - means.mean() - slope * centred
    return slope, float(np.sqrt((left**2).sum() / max(means.size - 2, 1) / square))


def _wander(time: TimeSeries) -> float:
    """Return the end's standard deviation, DN, of a walk that makes block means scatter as they do."""
    edges = np.searchsorted(time.frames, time.block_start)
    lengths = np.diff([*edges, time.frames.size])
    whole = lengths == lengths.max()
    blocks = (np.add.reduceat(time.frame_readout, edges) / lengths)[whole]
    inside = np.diff(time.frame_readout)[successive(time.frames)].var() / 2.0
    excess = float(blocks.var() - inside / lengths.max()) if blocks.size > 1 else 0.0
    return float(np.sqrt(6.0 * max(excess, 0.0)))
