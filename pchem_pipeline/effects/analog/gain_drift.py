"""Drift of the conversion gain: the DN per electron change in the course of the run, for all pixels alike.

The gain of amplifiers and the references of the ADC follow temperature and supply: ``x = round(mu + (1 +
drift u_t) (K + R) / g)`` with u_t from -1/2 at the first frame to 1/2 at the last (gain stability: EMVA
1288; Janesick 2007). A shape of its own (``path``) is what a measured run really did.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.base import Effect, Plane, register_effect
from pchem_pipeline.effects.common_modes import run_position
from pchem_pipeline.effects.response import PixelLaw, typical_pixels

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.context import EffectContext
    from pchem_pipeline.effects.evidence import Evidence, PixelMaps, TimeSeries
    from pchem_pipeline.model.marginal import MarginalModel

__all__ = ["GainDrift"]

_NODES = (3, 5, 9, 17)


@register_effect
class GainDrift(Effect):
    """Slow change of 1/g of all pixels, zero on average over the run.

    Signature: block means of the readout residual move in proportion to the exposure of the pixel, and the
    residual follows the charge within a block; those of the charge do not move. A pixel's peaks widen in
    proportion to the electron number.
    """

    tag: Literal["gain_drift"] = Field(default="gain_drift", description="name of the effect")
    plane: ClassVar[Plane] = Plane.ANALOG
    title: ClassVar[str] = "Drift of the conversion gain"
    source: ClassVar[str] = "EMVA 1288 (stability of the gain); Janesick 2007"
    signature: ClassVar[tuple[str, ...]] = (
        "frame.gain.trend", "frame.gain.slow", "time.block.readout.chi", "frame.readout.trend",
        "frame.readout.slow",
    )  # fmt: skip
    strength: ClassVar[str] = "drift"
    power: ClassVar[float] = 1.0
    separate: ClassVar[Mapping[str, str]] = {
        "bias_drift": "frames without exposure: a drift of the bias remains there, one of the gain does not",
        "exposure_drift": "a logged light level; the peaks keep their distance where it is the exposure",
        "signal_dependent_noise": "repeating the run: a drift has a course in time, noise has none",
        "flicker_noise": "dark and bright pixels: a drift of the gain grows with the signal",
    }
    drift: float = Field(
        ge=-0.5,
        le=0.5,
        description="linear: relative change of the gain (DN/e-) from the first frame to the last, no unit; "
        "path: its scale",
    )
    shape: Literal["linear", "path"] = Field(
        default="linear", description="linear; path: as listed in `path`"
    )
    path: tuple[float, ...] = Field(
        default=(),
        max_length=4096,
        description="gain at equally spaced frames from the first to the last of the run, in units of drift",
    )

    @model_validator(mode="after")
    def _path_where_it_belongs(self) -> Self:
        if self.shape == "path" and len(self.path) < 2:
            raise ValueError("gain_drift: shape path needs `path` with 2 values or more")
        if self.shape == "linear" and self.path:
            raise ValueError("gain_drift: `path` is for shape path, not linear; leave one of them out")
        if abs(self.drift) * float(np.abs(self._nodes() - _path_mean(self._nodes())).max()) >= 1:
            raise ValueError("gain_drift: drift times path takes the gain to zero; make one of them smaller")
        return self

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the signal (frame, y, x), e-, scaled by the course of the gain; draws nothing."""
        course = self._course(run_position(context.frames, context.n_frames))
        result: NDArray[Any] = values * (1.0 + self.drift * course)[:, None, None]
        return result

    @classmethod
    def typical(cls) -> Sequence[Self]:
        """Return a gain that rises, falls, and does both."""
        bow = cls(drift=0.006, shape="path", path=(-0.5, 0.5, -0.5))
        return cls(drift=0.006), cls(drift=-0.006), bow

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the regression of the gain of the blocks on time: linear, and a path where it explains more.

        The number of nodes of the path is that of the smallest Bayesian information criterion.
        """
        if evidence.time is None or evidence.time.block_start.size < 3:
            return ()
        gain, error, position = _block_gains(evidence, evidence.time)
        if gain.size < 3:
            return ()
        flat = _chi_square(gain, error, np.ones((gain.size, 1)))[0]
        line, (_, slope) = _chi_square(gain, error, np.stack([np.ones_like(position), position - 0.5], 1))
        linear = [cls(drift=float(np.clip(slope, -0.5, 0.5)))] if flat - line > 9.0 else []
        best, least = None, line + 2.0 * np.log(gain.size)
        for count in _NODES:
            if 3 * count > gain.size:
                break
            knots = np.linspace(0.0, 1.0, count)
            hats = np.clip(1.0 - np.abs(position[:, None] - knots) * (count - 1), 0.0, None)
            left, values = _chi_square(gain, error, hats)
            if flat - left > 9.0 + 3.0 * count and left + count * np.log(gain.size) < least - 6.0:
                best, least = values, left + count * np.log(gain.size)
        if best is None:
            return linear
        size = min(float(np.ptp(best)), 0.4)
        if size <= 0:
            return linear
        return [cls(drift=size, shape="path", path=tuple(np.round(best / np.ptp(best), 4).tolist())), *linear]

    def marginal(self, model: MarginalModel, maps: PixelMaps) -> MarginalModel:
        """Return the law with the variance of the gain: that of the peaks grows as k^2."""
        course = self.drift * self._course(np.linspace(0.0, 1.0, 1001))
        return model.with_variance(per_electron2=float(course.var()))

    def _nodes(self) -> NDArray[np.float64]:
        return np.array(self.path or (-0.5, 0.5))

    def _course(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the shape at positions 0..1 in the run, in units of ``drift``, zero on average."""
        nodes = self._nodes()
        return np.interp(position, np.linspace(0.0, 1.0, nodes.size), nodes) - _path_mean(nodes)


def _path_mean(nodes: NDArray[np.float64]) -> float:
    """Return the mean of the piecewise linear path through equally spaced nodes."""
    return float((nodes.sum() - (nodes[0] + nodes[-1]) / 2.0) / (nodes.size - 1))


def _chi_square(
    values: NDArray[np.float64], error: NDArray[np.float64], basis: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64]]:
    """Return chi squared of a weighted least-squares fit, and its coefficients."""
    found = np.linalg.lstsq(basis / error[:, None], values / error, rcond=1e-6)[0]
    return float((((values - basis @ found) / error) ** 2).sum()), np.asarray(found, np.float64)


def _block_gains(
    evidence: Evidence, time: TimeSeries
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return relative gain, standard error and position in the run of each block.

    Two independent estimates are combined: block means of r regressed on ``H / g`` over the pixels (with an
    offset common to all, which is the bias's), and the slope of r against k within the frames. A change of
    the gain by a factor 1 + c moves them by ``c Var(r) / sigma^2`` and by what the exact law says.
    """
    owner = np.searchsorted(time.block_start, time.frames, side="right") - 1
    blocks, counts = np.unique(owner[owner >= 0], return_counts=True)
    position = np.array([run_position(time.frames[owner == b], time.n_run).mean() for b in blocks])
    between, between_error = _slopes_of_means(evidence, time, blocks, counts)
    within, within_error = _slopes_within(evidence, time, owner, blocks)
    weight, other = between_error**-2.0, within_error**-2.0
    good = weight + other > 0
    weight, other = weight[good], other[good]
    gain = (np.nan_to_num(between)[good] * weight + np.nan_to_num(within)[good] * other) / (weight + other)
    return gain, (weight + other) ** -0.5, position[good]


def _slopes_of_means(
    evidence: Evidence, time: TimeSeries, blocks: NDArray[np.intp], counts: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    maps = evidence.maps
    response = (evidence.readout_std / maps.read_noise_dn) ** 2 * maps.quanta_exposure / maps.conversion_gain
    good = maps.usable & np.isfinite(response) & (evidence.readout_std > 0)
    weight = evidence.readout_std[good] ** -2.0
    response = response[good]
    centred = response - (weight * response).sum() / weight.sum() if response.size else response
    information = float((weight * centred**2).sum())
    error = np.full(blocks.size, np.inf)
    # without a spread of exposures a drift of the gain looks like one of the bias
    if response.size < 3 or information < 1e-6 * float((weight * response**2).sum()):
        return np.zeros(blocks.size), error
    means = np.asarray(time.block_readout, np.float64)[blocks][:, good]
    slopes = np.nan_to_num(means) @ (weight * centred) / information
    return slopes, np.asarray((information * counts) ** -0.5, np.float64)


def _slopes_within(
    evidence: Evidence, time: TimeSeries, owner: NDArray[np.intp], blocks: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    response = _slope_response(evidence)
    frames = [time.frame_gain[owner == b] for b in blocks]
    scatter = float(np.sqrt(np.nanmean([np.nanvar(f) for f in frames])))
    if not np.isfinite(scatter) or scatter <= 0 or abs(response) < 1e-3:
        return np.zeros(blocks.size), np.full(blocks.size, np.inf)
    mean = np.nanmean(time.frame_gain)
    slopes = np.array([np.nanmean(f) - mean for f in frames]) / response
    return slopes, scatter / abs(response) / np.sqrt([f.size for f in frames])


def _slope_response(evidence: Evidence) -> float:
    """Return by how much the slope of r against k (in units of 1/g) rises with the relative gain."""
    above = below = 0.0
    for pixel, group in zip(*typical_pixels(evidence.maps, 4), strict=True):
        law = PixelLaw(evidence.maps, int(pixel))
        gain = float(np.asarray(evidence.maps.conversion_gain).reshape(-1)[pixel])
        centred = law.charge - law.charge @ law.mass
        small = 1e-4
        change = (law.scaled_mass(1.0 + small) - law.mass) / small
        above += group.size * float((law.readout * gain * centred) @ change)
        below += group.size * float((centred**2) @ law.mass)
    return above / below if below > 0 else 0.0
