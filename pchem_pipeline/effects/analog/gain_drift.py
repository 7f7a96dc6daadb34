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
from pchem_pipeline.effects.estimators.pixel_law import PixelLaw, typical_pixels
from pchem_pipeline.effects.estimators.regression import SIGNIFICANT
from pchem_pipeline.effects.estimators.time_profiles import (
    NODES,
    check_path,
    fitted,
    fitted_profile,
    hats,
    profile_at,
    settling,
    settling_time,
)
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
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
_SMALL = 1e-4  # relative change of the gain


@register_effect
class GainDrift(Effect):
    """Slow change of 1/g of all pixels, zero on average over the run.

    Signature: block means of the readout residual move in proportion to the exposure of the pixel, and the
    residual follows the charge within a block; those of the charge do not move. A pixel's peaks widen in
    proportion to the electron number.
    """

    tag: Literal["gain_drift"] = Field(default="gain_drift", description="name of the effect")
    plane: ClassVar[Plane] = Plane.ANALOG
    title: ClassVar[str] = "conversion gain drift"
    source: ClassVar[str] = "EMVA 1288 (stability of the gain); Janesick 2007"
    signature: ClassVar[tuple[str, ...]] = (
        "frame.gain.trend", "frame.gain.slow", "frame.readout.trend", "frame.readout.slow",
        "frame.charge.trend", "frame.charge.slow",
    )  # fmt: skip
    strength: ClassVar[str] = "drift"
    power: ClassVar[float] = 1.0
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
    shape: Literal["linear", "settling", "path"] = Field(
        default="linear",
        description="linear; settling: exponential approach to the end; path: as listed in `path`",
    )
    settling_fraction: Ratio = Field(
        default=0.2, gt=0, le=10, description="settling: time constant in lengths of the run"
    )
    path: tuple[float, ...] = Field(
        default=(),
        max_length=4096,
        description="gain at equally spaced frames from the first to the last of the run, in units of drift",
    )

    #: a gain that rises, falls, and does both
    typical_values = (
        {"drift": 0.006},
        {"drift": -0.006},
        {"drift": 0.006, "shape": "path", "path": (-0.5, 0.5, -0.5)},
    )

    @model_validator(mode="after")
    def _path_where_it_belongs(self) -> Self:
        check_path(self.tag, self.shape, self.path)
        if abs(self.drift) * float(np.abs(self._profile(np.linspace(0.0, 1.0, 4097))).max()) >= 1:
            raise ValueError("gain_drift: drift times path takes the gain to zero; make one of them smaller")
        return self

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, scaled by the time profile of the gain; draws nothing."""
        profile = self._profile(run_position(context.frames, context.n_frames))
        result: AnyArray = values * (1.0 + self.drift * profile)[:, None, None]
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the regression of the blocks' gain on time: a line, and time profiles that explain more.

        Those are an exponential approach and a path with as many nodes as the Bayesian information criterion
        asks for; the likeliest comes first.
        """
        if evidence.time is None or evidence.time.block_start.size < 3:
            return ()
        gain, error, position = _block_gains(evidence, evidence.time)
        if gain.size < 3:
            return ()
        flat = fitted(gain, np.ones((gain.size, 1)), error)
        fraction = settling_time(lambda f: fitted_profile(gain, settling(position, f), error).chi2)
        curve = fitted_profile(gain, settling(position, fraction), error)
        line = fitted_profile(gain, position - 0.5, error)
        # three nodes can always be told; more of them where three blocks come on each
        paths = [fitted(gain, hats(position, n), error) for n in NODES[:-1] if n == 3 or 3 * n <= gain.size]
        path = min(paths, key=lambda fit: fit.chi2 + fit.price(gain.size))
        straight = line.chi2 + line.price(gain.size)
        found: list[tuple[float, Self]] = []
        if flat.chi2 - line.chi2 > SIGNIFICANT**2:
            found.append((straight, cls(drift=_limited(line.values[1]))))
        # the time constant is a number more
        left = curve.chi2 + curve.price(gain.size) + float(np.log(gain.size))
        if flat.chi2 - curve.chi2 > _improvement(3) and left < straight:
            size = _limited(curve.values[1])
            found.append((left, cls(drift=size, shape="settling", settling_fraction=fraction)))
        left = path.chi2 + path.price(gain.size)
        if flat.chi2 - path.chi2 > _improvement(path.values.size) and left < straight:
            spread = float(np.ptp(path.values))
            nodes = tuple(np.round(path.values / spread, 4).tolist())
            found.append((left, cls(drift=min(spread, 0.4), shape="path", path=nodes)))
        return [effect for _, effect in sorted(found, key=lambda pair: pair[0])]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the variance of the gain: that of the peaks grows as k^2."""
        profile = self.drift * self._profile(np.linspace(0.0, 1.0, 1001))
        return model.with_variance(per_electron2=float(profile.var()))

    def _profile(self, position: FloatArray) -> FloatArray:
        """Return the shape at positions 0..1 in the run, in units of ``drift``, zero on average."""
        fraction = self.settling_fraction if self.shape == "settling" else None
        return profile_at(position, fraction, self.path)


def _limited(drift: float) -> float:
    """Return a drift within the limits of its field."""
    return float(np.clip(drift, -0.5, 0.5))


def _improvement(nodes: int) -> float:
    """Return by how much chi squared falls by chance, plus three standard deviations of that."""
    free = nodes - 1
    return free + 3.0 * float(np.sqrt(2.0 * free))


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
        change = law.change(law.scaled(1.0 + _SMALL)) / _SMALL
        taken[i] = float(readout @ change) / (float(law.maps.quanta_exposure[0]) * step)
        scale = group.size * step / float(readout**2 @ law.mass)
        above += scale * float((charge * readout) @ change)
        below += scale * step * float(charge**2 @ law.mass)
    # the groups are in the order of the exposure
    shift = signal * np.interp(exposure, maps.quanta_exposure.reshape(-1)[chosen], taken)
    above += float((weight * pattern * shift).sum())
    return (above / below if below > 0 else 0.0), float(shift.mean())
