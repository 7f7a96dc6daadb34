"""Slow changes that all pixels share: their time profile along the run, and how it is found in a series."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.common_modes import run_position
from pchem_pipeline.effects.estimators.time_profiles import TimeProfile, along_path, likely_profiles, settling
from pchem_pipeline.effects.framework.effect import Effect, Ratio
from pchem_pipeline.effects.types import EffectContext, Evidence, FloatArray, TimeSeries

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
        if self.shape == "walk":
            return _walk(context)
        return self.profile(run_position(context.frames, context.n_frames))

    def profile(self, position: FloatArray) -> FloatArray:
        """Return the profile in units of the strength, of mean 0 over the run; none of a walk.

        Args:
            position: times from 0 (first frame) to 1 (last frame).
        """
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
        position = run_position(time.frames, time.n_run)
        return [cls.of(profile) for profile in likely_profiles(cls.series(evidence, time), position)]

    @classmethod
    def of(cls, found: TimeProfile) -> Self:
        """Return it with a profile that was found, its strength kept within the limits of its field."""
        fields = {"shape": found.shape, "path": found.path, "settling_fraction": found.settling_fraction}
        return cls.model_validate({cls.strength: cls.limited(cls.strength, found.size), **fields})


def _walk(context: EffectContext) -> FloatArray:
    """Return a random walk over the run with an end of unit variance, at the block's frames."""
    steps = context.random.generator().standard_normal(context.n_frames)
    walk = np.cumsum(steps) / np.sqrt(context.n_frames)
    return np.asarray(walk[context.frames.clip(0, context.n_frames - 1)] - walk.mean())
