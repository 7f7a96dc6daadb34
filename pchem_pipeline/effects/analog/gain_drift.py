"""Drift of the conversion gain: the DN per electron change during the run, for all pixels alike.

The gain of amplifiers and the references of the ADC follow temperature and supply: ``x = round(mu + (1 +
drift u_t) (K + R) / g)`` with u_t from -1/2 at the first frame to 1/2 at the last (gain stability: EMVA
1288; Janesick 2007). A shape of its own (``path``) is what a measured run really did.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.common_modes import run_position
from pchem_pipeline.effects.estimators.pixel_law import SMALL_CHANGE, PixelLaw, typical_pixels
from pchem_pipeline.effects.estimators.time_profiles import likely_profiles
from pchem_pipeline.effects.families.drifts import Drift
from pchem_pipeline.effects.framework.effect import Plane, Ratio, register_effect
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    FloatArray,
    PixelMaps,
    SampleLaw,
    TimeSeries,
)

_LEAST_RESPONSE = 0.15


@register_effect
class GainDrift(Drift):
    """Slow change of 1/g of all pixels, zero on average over the run.

    Signature: block means of the readout residual move in proportion to the exposure of the pixel, and the
    residual follows the charge within a block; those of the charge do not move. A pixel's peaks widen in
    proportion to the electron number.
    """

    tag: Literal["gain_drift"] = Field(default="gain_drift", description="name of the effect")
    plane = Plane.ANALOG
    title = "conversion gain drift"
    source = "EMVA 1288 (stability of the gain); Janesick 2007"
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
    drift: Ratio = Field(
        ge=-0.5,
        le=0.5,
        description="linear: relative change of the gain (DN/e-) from the first frame to the last, no unit; "
        "path: its scale",
    )

    #: a gain that rises, falls, and does both
    typical_values = (
        {"drift": 0.006},
        {"drift": -0.006},
        {"drift": 0.006, "shape": "path", "path": (-0.5, 0.5, -0.5)},
    )

    @model_validator(mode="after")
    def _gain_stays_positive(self) -> Self:
        if np.abs(self.values()).max() >= 1:
            raise ValueError("gain_drift: drift times path takes the gain to zero; make one of them smaller")
        return self

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, scaled by the time profile of the gain."""
        result: AnyArray = values * (1.0 + self.drift * self.in_frames(context))[:, None, None]
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the time profiles that the blocks' gain follows."""
        if evidence.time is None or evidence.time.block_start.size < 3:
            return ()
        gain, error, position = _block_gains(evidence, evidence.time)
        return (
            [cls.of(profile) for profile in likely_profiles(gain, position, error)] if gain.size >= 3 else ()
        )

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the variance of the gain: that of the peaks grows as k^2."""
        return model.with_variance(per_electron2=float(self.values().var()))


def _block_gains(evidence: Evidence, time: TimeSeries) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return relative gain, standard error and position in the run of each block; empty if not of the gain.

    Where the gain alone drifts, the common mean of the residuals moves too, by the mean of ``H / g`` (in part
    taken for charge). Both say what the gain does, unless they contradict each other.
    """
    nothing = np.zeros(0), np.zeros(0), np.zeros(0)
    owner = np.searchsorted(time.block_start, time.frames, side="right") - 1
    blocks = [np.flatnonzero(owner == b) for b in np.unique(owner[owner >= 0])]
    response, common = _response(evidence)
    if not common > 0:
        return nothing
    # where the peaks overlap a change of the gain is taken for charge, and little is seen of it
    known = response > _LEAST_RESPONSE
    gain, error = _block_means(time.frame_gain / max(response, _LEAST_RESPONSE), blocks)
    error = error if known else np.full(error.size, 1e6)
    other, other_error = _block_means(time.frame_readout / common, blocks)
    if not (error.min() > 0 and other_error.min() > 0):
        return nothing
    weight = error**-2 + other_error**-2
    both = (gain * error**-2 + other * other_error**-2) / weight
    # what the gain itself follows of the common movement: all of it, or the bias moves
    information = float(((other / error) ** 2).sum())
    followed = float((other * gain * error**-2).sum()) / information
    if known and followed < 1.0 - 3.0 / np.sqrt(information):
        both, weight = gain, error**-2
    position = np.array([run_position(time.frames[b], time.n_run).mean() for b in blocks])
    return both, weight**-0.5, position


def _block_means(series: FloatArray, blocks: Sequence[NDArray[np.intp]]) -> tuple[FloatArray, FloatArray]:
    """Return the means of a series of frames in blocks, less that of all, and their standard errors."""
    means = np.array([series[b].mean() for b in blocks]) - series.mean()
    scatter = float(np.sqrt(np.mean([series[b].var() for b in blocks])))
    return means, scatter / np.sqrt([b.size for b in blocks])


def _response(evidence: Evidence) -> tuple[float, float]:
    """Return how the gain of a frame, as it is seen, and its mean residual (DN) rise with the relative gain.

    The former is the regression of r on k / g, among the samples of a pixel and among the means of the
    pixels. The exact law of typical pixels says how much of a change of the gain is taken for charge.
    """
    maps = evidence.maps
    good = maps.usable & np.isfinite(evidence.readout_std) & (evidence.readout_std > 0)
    if not good.any():
        return 0.0, 0.0
    exposure = maps.quanta_exposure[good]
    weight, signal = evidence.readout_std[good] ** -2.0, exposure / maps.conversion_gain[good]
    pattern = signal - (weight * signal).sum() / weight.sum()
    chosen, groups = typical_pixels(maps)
    taken, above, below = np.zeros(chosen.size), 0.0, float((weight * pattern * signal).sum())
    for i, (pixel, group) in enumerate(zip(chosen, groups, strict=True)):
        law = PixelLaw(maps, int(pixel), evidence.n_frames)
        step = 1.0 / float(law.maps.conversion_gain[0])
        charge, readout = law.charge - law.charge @ law.mass, law.readout - law.readout @ law.mass
        change = law.change(law.scaled(1.0 + SMALL_CHANGE)) / SMALL_CHANGE
        taken[i] = float(readout @ change) / (float(law.maps.quanta_exposure[0]) * step)
        scale = group.size * step / float(readout**2 @ law.mass)
        above += scale * float((charge * readout) @ change)
        below += scale * step * float(charge**2 @ law.mass)
    # the groups are in the order of the exposure
    shift = signal * np.interp(exposure, maps.quanta_exposure.reshape(-1)[chosen], taken)
    above += float((weight * pattern * shift).sum())
    return (above / below if below > 0 else 0.0), float(shift.mean())
