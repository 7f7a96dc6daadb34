"""Drift of the quanta exposure during a capture (the sensor warms up, the lamp ages).

PCH-EM assumes independent, identically distributed frames (Hendrickson et al. 2023, Sec. II-B). Here frame
``n`` of ``N`` sees ``H_n = H (1 + drift s_n)`` with a time profile s of mean 0 and range 1, so they are not.
Dark current doubles every 6 to 8 K, about 10 % per kelvin, so a tenth of a kelvin over the run already
drifts by 1 %.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.charge_sums import ExposureProfile, exposure_nodes, exposure_profile
from pchem_pipeline.effects.estimators.regression import multiple_of
from pchem_pipeline.effects.estimators.time_profiles import NODES, hats, profile_at, settling_time
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, FloatArray, PixelMaps, SampleLaw

_T = TypeVar("_T", bound="ExposureDrift")

# chi-square that each node of a free path must explain
_PRICE_OF_NODE = 2.5
# chi-square that the choice of the time constant explains by chance
_PRICE_OF_SETTLING = 3.0


@register_effect
class ExposureDrift(Effect):
    """Relative change of H from the first frame to the last, the same in every pixel.

    The time profile is a straight line, an exponential approach to the end (``settling_fraction``), or any
    given by its values at equal distances (``path``).

    Signature: block means of the electron number follow the drift with a slope proportional to H,
    those of the readout residual do not. The mean over the run stays; for large N the variance grows
    by ``(drift H / g)^2 / 12`` DN^2 and is no longer that of any single PCD.
    """

    tag: Literal["exposure_drift"] = Field(default="exposure_drift", description="name of the effect")
    plane: ClassVar[Plane] = Plane.EXPOSURE
    title: ClassVar[str] = "illumination or dark-current drift"
    source: ClassVar[str] = "Widenhorn et al. 2002, Proc. SPIE 4669, 193 (dark current and temperature)"
    signature: ClassVar[tuple[str, ...]] = (
        "frame.charge.trend",
        "frame.charge.slow",
        "time.block.charge.chi",
        "frame.charge.lag1",
    )
    strength: ClassVar[str] = "drift"
    separate: ClassVar[Mapping[str, str]] = {
        "glow": "a map of the change along the run: a drift is proportional to H, a glow local",
        "gain_drift": "readout residuals of bright and dim pixels: constant with an exposure drift",
        "bias_drift": "covered pixels, or frames without exposure: constant with an exposure drift",
        "persistence": "a map of the change: proportional to H for a drift",
        "exposure_flicker": "a reference photodiode, or the logged temperature",
    }
    drift: Ratio = Field(
        ge=-2, le=2, description="(H_last - H_first) / H_mean (range of the time profile for a path), no unit"
    )
    settling_fraction: Ratio | None = Field(
        default=None,
        gt=0,
        le=10,
        description="time constant of an exponential time profile, lengths of the run; null: a straight line",
    )
    path: tuple[float, ...] = Field(
        default=(),
        max_length=1000,
        description="profile at equal distances from the first frame to the last, linear in between, any "
        "unit (its mean and range are taken out); empty: a straight line",
    )

    #: at 1.6 % end to end, rising and falling, straight and settling
    typical_values = (
        {"drift": 0.016},
        {"drift": -0.016},
        {"drift": 0.016, "settling_fraction": 0.2},
        {"drift": -0.016, "settling_fraction": 0.2},
    )

    @model_validator(mode="after")
    def _one_profile(self) -> Self:
        if self.path and self.settling_fraction is not None:
            raise ValueError(
                "exposure_drift: path and settling_fraction are two time profiles; give one of them"
            )
        if self.path and max(self.path) == min(self.path):
            raise ValueError("exposure_drift: path needs at least two different values; leave it empty")
        return self

    def profile(self, position: FloatArray) -> FloatArray:
        """Return the profile s, of mean 0 and range 1 over the run, at times 0..1 (first to last frame)."""
        found = profile_at(position, self.settling_fraction, self.path)
        return found / float(np.ptp(self.path)) if self.path else found

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the drifting exposure (frame, y, x), e-; draws nothing."""
        last = context.n_frames - 1
        # frames before the run are simulated only as memory of the first: as exposed as that one
        position = context.frames.clip(0, last) / last if last > 0 else np.full(context.frames.shape, 0.5)
        factor = np.maximum(1.0 + self.drift * self.profile(position), 0.0)
        result: AnyArray = values * factor[:, None, None]
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the time profiles that least squares on the frames' exposures cannot tell from the best one.

        A profile is taken seriously where it explains two and a half standard deviations more than chance;
        one with more freedom only where that is not far below the best.
        """
        profile = exposure_profile(evidence)
        if profile is None or evidence.time is None:
            return ()
        position = profile.frames / max(evidence.time.n_run - 1, 1)
        # what flickers from frame to frame is noise to a drift
        noise = max(profile.variance, 0.5 * float(np.mean(np.diff(profile.deviation) ** 2)))

        def settled(fraction: float) -> tuple[float, Self]:
            return _fit(cls(drift=1.0, settling_fraction=fraction), profile, position, noise)

        curve: tuple[float, Self] = settled(settling_time(lambda fraction: -settled(fraction)[0]))
        line = _fit(cls(drift=1.0), profile, position, noise)
        path = _fit_path(cls, profile, position, noise)
        net = [line, (curve[0] - _PRICE_OF_SETTLING, curve[1]), path]
        best = max(chi2 for chi2, _ in net)
        likely = [pair for pair in net if pair[0] > max(6.5, best - 25.0)]
        return [effect for _, effect in sorted(likely, key=lambda pair: -pair[0])]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law mixed over the exposures of the run."""
        factors = 1.0 + self.drift * self.profile(np.linspace(0.0, 1.0, 401))
        return model.with_exposures(*exposure_nodes(factors))


def _fit(unit: _T, profile: ExposureProfile, position: FloatArray, noise: float) -> tuple[float, _T]:
    """Return the chi-square that a time profile explains, and it at its fitted strength."""
    shape = unit.profile(position)
    shape = shape - shape.mean()
    slope = multiple_of(shape, profile.deviation, 1.0 / noise)
    return slope.sigmas**2, unit.scaled(slope.value)


def _fit_path(
    cls: type[_T], profile: ExposureProfile, position: FloatArray, noise: float
) -> tuple[float, _T]:
    """Return the same for a broken line with free nodes, as many as pay; the chi-square less their price."""
    deviation = profile.deviation - profile.deviation.mean()
    best = (0.0, cls(drift=0.0))
    for n in NODES[1:]:
        basis = hats(position, n)
        # a little stiffness, so that nodes without frames follow their neighbours
        stiff = 1e-3 * position.size / n * np.diff(np.eye(n), 2, axis=0)
        nodes = np.linalg.solve(basis.T @ basis + stiff.T @ stiff, basis.T @ deviation)
        left = deviation - basis @ nodes
        net = float(deviation @ deviation - left @ left) / noise - _PRICE_OF_NODE * (n - 1)
        spread = float(np.ptp(nodes))
        if net > best[0] and spread > 0:
            path = tuple(float(round(v / spread, 4)) for v in nodes)
            best = (net, cls(drift=min(spread, 2.0), path=path))
    return best
