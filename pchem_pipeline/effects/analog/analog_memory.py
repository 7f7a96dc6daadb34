"""Memory of the analog chain: a sample holds a little of the one before.

A sense node that is not reset completely, or a sample capacitor that is charged too briefly, hands part of
a signal to the next one: ``v_t = K_t + a K_{t-1}`` (incomplete reset, Janesick 2001; the same between
successive pixels is the converter's memory, Boone et al. 2018). It is the signal that stays, not charge in
the pixel: charge that arrives late is still made of whole electrons, which frames of constant exposure
cannot show.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.framework.effect import Effect, Plane, register_effect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.framework.context import EffectContext
    from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
    from pchem_pipeline.model.law.sample_law import SampleLaw


@register_effect
class AnalogMemory(Effect):
    """Part of the charge of the frame before that a pixel shows again.

    Signature: the readout residual follows the charge of the frame before; residuals of successive frames
    hardly do. The mean rises by ``memory H`` e- and the variance of the noise by ``memory^2 H``.
    """

    tag: Literal["analog_memory"] = Field(default="analog_memory", description="name of the effect")
    plane: ClassVar[Plane] = Plane.ANALOG
    title: ClassVar[str] = "Memory of the analog chain (incomplete reset)"
    source: ClassVar[str] = "Janesick 2001 (incomplete reset); Boone et al. 2018 (memory of readout chains)"
    signature: ClassVar[tuple[str, ...]] = (
        "time.cross.readout_charge", "time.lag1.readout.mean", "time.lag1.charge.mean",
    )  # fmt: skip
    strength: ClassVar[str] = "memory"
    power: ClassVar[float] = 1.0
    separate: ClassVar[Mapping[str, str]] = {
        "flicker_noise": "frames without any exposure: flicker remains there, memory does not",
        "dark_current_rts": "one bright frame and then dark ones: memory fades within a frame, defects stay",
        "repeated_frames": "frame counters; repeated frames are equal in every sample",
    }
    memory: float = Field(
        ge=-0.5,
        le=0.5,
        description="part of the charge of the frame before that is read again, no unit; negative: overshoot",
    )

    def history(self) -> int:
        """Return 1: the frame before."""
        return 1

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the signal (frame, y, x), e-, with that of the frame before; draws nothing.

        The first frame of the block has none before it (it is only the history of the others).
        """
        result: NDArray[Any] = values.copy()
        if context.charge is not None:
            result[1:] += self.memory * context.charge[:-1]
        return result

    @classmethod
    def typical(cls) -> Sequence[Self]:
        """Return residue and overshoot."""
        return cls(memory=0.0024), cls(memory=-0.0024)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the regression of the residual on the charge of the frame before.

        A shift by d changes ``E[R | x]`` by ``d Var(r) / sigma^2`` on average, so that the correlation of r
        with the k before is ``a sd(r) sd(k) / sigma^2``, all in electrons.
        """
        if evidence.time is None:
            return ()
        maps, pairs = evidence.maps, evidence.time.n_pairs
        seen = np.asarray(evidence.time.lag_readout_charge, np.float64)
        response = evidence.readout_std * evidence.charge_std / maps.read_noise_dn**2 / maps.conversion_gain
        good = maps.usable & np.isfinite(seen) & np.isfinite(response)
        below = float((response[good] ** 2).sum()) * pairs
        above = float((response[good] * seen[good]).sum()) * pairs
        if below <= 0 or abs(above) < 2.5 * np.sqrt(below):
            return ()
        return (cls(memory=float(np.clip(above / below, -0.5, 0.5))),)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the mean charge of the frame before, and its variance."""
        exposure = np.nan_to_num(maps.quanta_exposure)
        return model.with_levels(shift_e=self.memory * exposure).with_variance(e2=self.memory**2 * exposure)
