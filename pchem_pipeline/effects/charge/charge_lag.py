"""Charge lag: an electron is read one frame late.

An incomplete transfer out of the photodiode leaves each electron behind with probability f (Fossum and
Hondongwa 2014, "A Review of the Pinned Photodiode"; 0.1 e- and less in the pump-gate pixels of Ma et al.
2015). Poisson electrons that are delayed independently stay independent Poisson from frame to frame (Mirasol
1963, for the output of the queue M/G/infinity): at constant exposure this is invisible.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pchem_pipeline.effects.estimators.electrons import binomial_upper
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext


@register_effect
class ChargeLag(Effect):
    """Probability that an electron is read with the next frame instead of its own.

    Signature: none at constant exposure: what is late in one frame is replaced, on average and in law, by
    what was late in the frame before.
    """

    tag: Literal["charge_lag"] = Field(default="charge_lag", description="name of the effect")
    plane = Plane.CHARGE
    title = "charge transfer lag"
    source = "Fossum and Hondongwa 2014, IEEE J. Electron Devices Soc. 2, 33; Mirasol 1963"
    strength = "fraction"
    reach_frames = 1
    untestable = (
        "randomly delayed Poisson electrons remain independent and Poisson; a bright frame followed by dark "
        "ones would show it"
    )
    fraction: Ratio = Field(
        ge=0, le=0.9, description="probability that an electron is delayed by one frame, no unit"
    )

    #: at a fifth
    typical_values = ({"fraction": 0.2},)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, as read; the first frame gets nothing from before."""
        if self.fraction == 0:
            return values.copy()
        u = context.random.uniform(("frame", "y", "x"))
        late = binomial_upper(u.reshape(-1), values.reshape(-1), self.fraction).reshape(values.shape)
        result: AnyArray = values - late
        result[1:] += late[:-1]
        return result
