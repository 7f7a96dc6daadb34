"""Interpixel capacitance: a pixel shows a little of its neighbours' charge.

Sense nodes couple electrically, so charge in one raises the voltage of the next: ``v_i = K_i + a sum_j (K_j -
K_i)`` over the four nearest neighbours (Moore, Ninkov and Forrest 2004; Donlon, Ninkov and Baum 2018). Unlike
diffusion or crosstalk by light the coupling is noiseless and deterministic: no electron moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.base import Effect, Plane, register_effect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.context import EffectContext
    from pchem_pipeline.effects.evidence import Evidence, PixelMaps
    from pchem_pipeline.model.marginal import MarginalModel

__all__ = ["InterpixelCapacitance"]


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
    plane: ClassVar[Plane] = Plane.ANALOG
    title: ClassVar[str] = "Interpixel capacitance (IPC)"
    source: ClassVar[str] = "Moore, Ninkov and Forrest 2004; Donlon, Ninkov and Baum 2018"
    signature: ClassVar[tuple[str, ...]] = ("space.x.rk", "space.y.rk", "space.x.rr", "space.y.rr")
    strength: ClassVar[str] = "coupling"
    power: ClassVar[float] = 1.0
    separate: ClassVar[Mapping[str, str]] = {
        "optical_crosstalk": "single hot pixels: light makes whole electrons in the neighbours, "
        "capacitance moves their peaks by a fraction of one",
        "row_noise": "distant pixels of a row: row noise reaches them, capacitance does not",
        "column_noise": "distant pixels of a column: column noise reaches them, capacitance does not",
    }
    coupling: float = Field(
        ge=0, le=0.2, description="part of a neighbour's charge that a pixel shows (each of four), no unit"
    )

    def halo(self) -> int:
        """Return 1: the rows above and below."""
        return 1

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the signal (frame, y, x), e-, with the neighbours' charge; draws nothing.

        At the edges of the sensor the missing neighbours take and give nothing.
        """
        result: NDArray[Any] = values.copy()
        if context.charge is None:
            return result
        charge = self.coupling * context.charge
        down = charge[:, 1:] - charge[:, :-1]
        result[:, :-1] += down
        result[:, 1:] -= down
        across = charge[:, :, 1:] - charge[:, :, :-1]
        result[:, :, :-1] += across
        result[:, :, 1:] -= across
        return result

    @classmethod
    def typical(cls) -> Sequence[Self]:
        """Return it as in a monolithic sensor."""
        return (cls(coupling=0.0016),)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the regression of the residual on the charge of the neighbour.

        A shift by d changes ``E[R | x]`` by ``d Var(r) / sigma^2`` on average, so that the correlation of
        one's r with the other's k is ``a`` times the mean of ``sd(r_i) sd(k_j) / sigma_i^2``, all in
        electrons.
        """
        time = evidence.time
        if time is None:
            return ()
        above = below = 0.0
        readout, charge = _responses(evidence)
        for axis, name in ((1, "x.rk"), (0, "y.rk")):
            pairs = time.neighbour_pairs.get(name, 0)
            response = _pair_mean(readout, charge, axis)
            if pairs and np.isfinite(response):
                above += pairs * response * time.neighbours[name]
                below += pairs * response**2
        if below <= 0 or above < 3.0 * np.sqrt(below):
            return ()
        return (cls(coupling=min(above / below, 0.2)),)

    def marginal(self, model: MarginalModel, maps: PixelMaps) -> MarginalModel:
        """Return the law with a smaller step, the neighbours' mean charge and its variance.

        The four neighbours are taken to have the pixel's own exposure.
        """
        exposure = np.nan_to_num(maps.quanta_exposure)
        return model.with_levels(
            scale=1.0 - 4.0 * self.coupling, shift_e=4.0 * self.coupling * exposure
        ).with_variance(e2=4.0 * self.coupling**2 * exposure)


def _responses(evidence: Evidence) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sd(r) / sigma^2 (1/e-) and sd(k) (e-) of each pixel, NaN where there is no fit."""
    maps = evidence.maps
    noise = np.where(maps.usable, maps.read_noise_dn, np.nan)
    return evidence.readout_std / noise**2 / maps.conversion_gain, np.where(
        maps.usable, evidence.charge_std, np.nan
    )


def _pair_mean(readout: NDArray[np.float64], charge: NDArray[np.float64], axis: int) -> float:
    """Return the mean of readout times the neighbour's charge along an axis, both ways; NaN without pairs."""
    n = readout.shape[axis]
    first, second = np.arange(n - 1), np.arange(1, n)
    products = [
        np.take(readout, a, axis) * np.take(charge, b, axis) for a, b in ((first, second), (second, first))
    ]
    found = np.concatenate([p[np.isfinite(p)] for p in products])
    return float(found.mean()) if found.size else np.nan
