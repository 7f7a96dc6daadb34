"""Memory of the analog chain: a sample holds a little of the one before.

A sense node that is not reset completely, or a sample capacitor that is charged too briefly, hands part of
a signal to the next one: ``v_t = K_t + a K_{t-1}`` (incomplete reset, Janesick 2001; the same between
successive pixels is the converter's memory, Boone et al. 2018). Pixels may differ in it, and it may saturate
where the sample before was bright: ``a_i S (1 - exp(-K_{t-1} / S))``. It is the signal that stays, not charge
in the pixel: charge that arrives late is still made of whole electrons, which frames of constant exposure
cannot show.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field
from scipy import special

from pchem_pipeline.effects.estimators.long_memory import OF_PIXEL
from pchem_pipeline.effects.framework.effect import Effect, Electrons, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, FloatArray, PixelMaps, SampleLaw


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

    #: residue and overshoot, alike in all pixels and not
    typical_values = tuple(
        {"memory": memory, "spread": spread} for spread in (0.0, 1.0) for memory in (0.0024, -0.0024)
    )

    def details(self) -> tuple[str, ...]:
        """Return how much pixels differ, where they do."""
        return ("spread",) if self.spread > 0.0 else ()

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

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the mean of what is left of the frame before, and its variance."""
        mean, square = self._left_of(np.nan_to_num(maps.quanta_exposure))
        # the mean of a pixel's own memory is not told from its bias
        variance = (square - mean**2) * np.exp(self.spread**2)
        return model.with_levels(shift_e=self.memory * mean).with_variance(e2=self.memory**2 * variance)
