"""Interpixel capacitance: a pixel shows a little of its neighbours' charge.

Sense nodes couple electrically, so charge in one raises the voltage of the next: ``v_i = K_i + a sum_j (K_j -
K_i)`` over the four nearest neighbours (Moore, Ninkov and Forrest 2004; Donlon, Ninkov and Baum 2018). Along
rows and columns it may differ, as the wiring does. Unlike
diffusion or crosstalk by light the coupling is noiseless and deterministic: no electron moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    PixelMaps,
    SampleLaw,
)
from pchem_pipeline.model.arithmetic.significance import CLEAR


@register_effect
class InterpixelCapacitance(Effect):
    """Coupling of the sense nodes of the four nearest neighbours, before the read noise.

    Signature: the readout residual follows the charge of the neighbours, then residuals of neighbours follow
    each other; charge of neighbours hardly does. The step per electron shrinks by ``1 - 4 coupling``, which
    no histogram tells from a larger gain; the neighbours shift a pixel by ``4 coupling H``.
    """

    tag: Literal["interpixel_capacitance"] = Field(
        default="interpixel_capacitance", description="name of the effect"
    )
    plane = Plane.ANALOG
    title = "interpixel capacitance (IPC)"
    source = "Moore, Ninkov and Forrest 2004; Donlon, Ninkov and Baum 2018"
    signature = (
        "space.x.rk", "space.y.rk", "space.x.rr", "space.y.rr", "space.x.kk", "space.y.kk",
    )  # fmt: skip
    strength = "coupling"
    reach_rows = 1
    separate: ClassVar[Mapping[str, str]] = {
        "optical_crosstalk": "single hot pixels: crosstalk adds whole electrons to neighbours, "
        "capacitance shifts their peaks by a fraction of an electron",
        "row_noise": "distant pixels of a row: correlated by row noise, not by capacitance",
        "column_noise": "distant pixels of a column: correlated by column noise, not by capacitance",
    }
    coupling: Ratio = Field(
        ge=0, le=0.2, description="share of a neighbour's charge added to a pixel (mean of four), no unit"
    )
    anisotropy: Ratio = Field(
        default=0.0,
        ge=-1,
        le=1,
        description="(coupling along x less that along y) / (sum of the two), no unit",
    )

    #: as in a monolithic sensor
    typical_values = ({"coupling": 0.0016},)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with the neighbours' charge; draws nothing.

        At the edges of the sensor the missing neighbours take and give nothing.
        """
        result: AnyArray = values.copy()
        if context.charge is None:
            return result
        charge = context.charge.astype(np.float64)
        down = charge[:, 1:] - charge[:, :-1]
        down *= self.coupling * (1.0 - self.anisotropy)
        result[:, :-1] += down
        result[:, 1:] -= down
        across = charge[:, :, 1:] - charge[:, :, :-1]
        across *= self.coupling * (1.0 + self.anisotropy)
        result[:, :, :-1] += across
        result[:, :, 1:] -= across
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return what is typical, as strong as the residual follows neighbours; anisotropic if that shows."""
        x, y = (max(evidence.z.get(f"space.{axis}.rk", 0.0), 0.0) for axis in "xy")
        found = super().estimate(evidence)
        if not abs(x - y) > CLEAR * 2.0**0.5:
            return found
        differing = {"anisotropy": (x - y) / (x + y)}
        return [*(one.model_copy(update=differing) for one in found), *found]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with a smaller step, the neighbours' mean charge and its variance.

        The four neighbours are taken to have the pixel's own exposure.
        """
        exposure = np.nan_to_num(maps.quanta_exposure)
        squares = 4.0 * self.coupling**2 * (1.0 + self.anisotropy**2)
        return model.with_levels(
            scale=1.0 - 4.0 * self.coupling, shift_e=4.0 * self.coupling * exposure
        ).with_variance(e2=squares * exposure)
