"""Memory of the analog chain: a sample holds a little of the one before.

A sense node that is not reset completely, or a sample capacitor that is charged too briefly, hands part of
a signal to the next one: ``v_t = K_t + a K_{t-1}`` (incomplete reset, Janesick 2001; the same between
successive pixels is the converter's memory, Boone et al. 2018). Pixels may differ in it, and it may saturate
where the sample before was bright: ``a_i S (1 - exp(-K_{t-1} / S))``. It is the signal that stays, not charge
in the pixel: charge that arrives late is still made of whole electrons, which frames of constant exposure
cannot show.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field
from scipy import special

from pchem_pipeline.effects.estimators.long_memory import OF_PIXEL
from pchem_pipeline.effects.estimators.regression import SIGNIFICANT, multiple_of
from pchem_pipeline.effects.framework.effect import Effect, Electrons, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, FloatArray, PixelMaps, SampleLaw
from pchem_pipeline.model.arithmetic.significance import CERTAIN

_LINEAR = 0.15  # e- of a bright sample before, up to which a correlation is in proportion to the memory
_NODES = 40  # of a quadrature over the pixels' memories
_FAR = 30.0  # standard deviations: what lies farther is as unlikely
_USUAL = 0.5  # spread from which a fit begins


@register_effect
class AnalogMemory(Effect):
    """Part of the charge of the frame before that a pixel shows again.

    Signature: the readout residual follows the charge of the frame before; residuals of successive frames
    hardly do. The mean rises by ``memory H`` e- and the variance of the noise by ``memory^2 H``. Where pixels
    differ the squares of their correlations exceed what their mean makes of them.
    """

    tag: Literal["analog_memory"] = Field(default="analog_memory", description="name of the effect")
    plane = Plane.ANALOG
    title = "analog memory (incomplete reset)"
    source = "Janesick 2001 (incomplete reset); Boone et al. 2018 (memory of readout chains)"
    signature = (
        "time.cross.readout_charge", "time.lag1.readout.mean", "time.lag1.charge.mean",
        "time.cross.readout_charge.chi",
    )  # fmt: skip
    strength = "memory"
    reach_frames = 1
    separate: ClassVar[Mapping[str, str]] = {
        "flicker_noise": "frames without exposure: 1/f noise remains, memory vanishes",
        "dark_current_rts": "dark frames after a bright one: memory fades within a frame, blinking stays",
        "repeated_frames": "frame counters: repeated frames are equal in every sample",
    }
    memory: Ratio = Field(
        ge=-0.5,
        le=0.5,
        description="share of the previous charge that is read again, mean of the pixels, no unit; "
        "negative: overshoot",
    )
    spread: Ratio = Field(
        default=0.0,
        ge=0,
        le=2,
        description="standard deviation of the logarithm of the memory between pixels; 0: uniform",
    )
    saturation_e: Electrons | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="previous charge at which the memory saturates, e-; none: proportional",
    )

    #: residue, overshoot, and a residue that differs
    typical_values = ({"memory": 0.0024}, {"memory": -0.0024}, {"memory": 0.0024, "spread": 1.0})

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with that of the frame before.

        The first frame of the block has none before it (it is only the history of the others).
        """
        result: AnyArray = values.copy()
        if context.charge is not None:
            result[1:] += self._memories(context) * self._left(context.charge[:-1])
        return result

    def _memories(self, context: EffectContext) -> FloatArray | float:
        """Return the memory of the pixels, shape (1, y, x), or of all."""
        if self.spread == 0:
            return self.memory
        normal = special.ndtri(context.random.uniform(("y", "x"), OF_PIXEL[0]))
        return np.asarray(self.memory * np.exp(self.spread * normal - self.spread**2 / 2.0))

    def _left(self, charge: AnyArray) -> AnyArray:
        """Return what is left of a charge where all of it is remembered, e-."""
        if self.saturation_e is None:
            return charge
        return np.asarray(-self.saturation_e * np.expm1(-charge / self.saturation_e))

    def _left_of(self, exposure: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the mean, e-, and mean square, e-^2, of what is left of Poisson electrons."""
        if self.saturation_e is None:
            return exposure, exposure * (1.0 + exposure)
        # E[exp(-n K / S)], the generating function of K
        once, twice = (np.exp(exposure * np.expm1(-n / self.saturation_e)) for n in (1.0, 2.0))
        return self.saturation_e * (1.0 - once), self.saturation_e**2 * (1.0 - 2.0 * once + twice)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the regression of the residual on the charge of the frame before, alike or by pixel.

        A shift by d changes ``E[R | x]`` by ``d Var(r) / sigma^2`` on average, so that the correlation of r
        with the k before is ``a sd(r) sd(k) / sigma^2``, all in electrons.
        """
        if evidence.time is None:
            return ()
        maps, pairs = evidence.maps, evidence.time.n_pairs
        seen = np.asarray(evidence.time.lag_readout_charge, np.float64)
        response = evidence.readout_std * evidence.charge_std / maps.read_noise_dn**2 / maps.conversion_gain
        good = maps.usable & np.isfinite(seen) & np.isfinite(response)
        seen, response = seen[good], response[good]
        found = multiple_of(response, seen, pairs)
        if not abs(found.sigmas) > SIGNIFICANT:
            return ()
        memory = float(np.clip(found.value, -0.5, 0.5))
        k = maps.quanta_exposure[good] + evidence.charge_std[good]
        differing = _lognormal(seen, response, _LINEAR / k * response, pairs, memory)
        if differing is None:
            return (cls(memory=memory),)
        mean, spread = differing
        return cls(memory=memory), cls(memory=float(np.clip(mean, -0.5, 0.5)), spread=min(spread, 2.0))

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the mean of what is left of the frame before, and its variance."""
        mean, square = self._left_of(np.nan_to_num(maps.quanta_exposure))
        # the mean of a pixel's own memory is not told from its bias
        variance = (square - mean**2) * np.exp(self.spread**2)
        return model.with_levels(shift_e=self.memory * mean).with_variance(e2=self.memory**2 * variance)


def _lognormal(
    seen: FloatArray, response: FloatArray, limit: FloatArray, pairs: int, memory: float
) -> tuple[float, float] | None:
    """Return the likeliest mean and spread of lognormal memories of pixels; None where they may be alike.

    Args:
        seen: correlation of each pixel, shape (n,).
        response: what a memory of 1 makes of it in proportion, shape (n,).
        limit: size beyond which a correlation only tells that the memory is large, shape (n,).
        pairs: of frames, the inverse of the variance of a correlation.
        memory: of all pixels alike.
    """
    from scipy import optimize  # not for every command that knows of effects

    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    weights = weights / weights.sum()
    sign, root = np.sign(memory), np.sqrt(pairs)
    seen = sign * seen
    beyond = (seen > limit)[:, None]

    def misfit(log_mean: float, spread: float) -> float:
        foreseen = response[:, None] * np.exp(log_mean + spread * nodes - spread**2 / 2.0)
        density = np.exp(-(((seen[:, None] - foreseen) * root).clip(-_FAR, _FAR) ** 2) / 2.0)
        large = special.ndtr((foreseen - limit[:, None]) * root)
        return float(-np.log(np.where(beyond, large, density) @ weights).sum())

    start = float(np.log(np.abs(memory)))
    alike = optimize.minimize_scalar(misfit, (start, start + 0.2), args=(0.0,), options={"xtol": 0.01})
    one = optimize.minimize(
        lambda x: misfit(x[0], float(np.exp(x[1]))),
        (alike.x, np.log(_USUAL)),
        method="Nelder-Mead",
        options={"xatol": 0.01, "fatol": 0.1},
    )
    if alike.fun - one.fun < CERTAIN**2 / 2.0:
        return None
    return float(sign * np.exp(one.x[0])), float(np.exp(one.x[1]))
