"""Offsets that many pixels share: how they are added, how an effect tells of its own, and such noise."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np

from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.plane import Plane

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from pchem_pipeline.effects.framework.context import EffectContext
    from pchem_pipeline.effects.framework.evidence import PixelMaps
    from pchem_pipeline.model.law.sample_law import SampleLaw

#: what the random numbers of an offset depend on
_KEYS: dict[str, tuple[Literal["frame", "y", "x"], ...]] = {
    "frame": ("frame",),
    "row": ("frame", "y"),
    "column": ("frame", "x"),
}


class SharedOffset(NamedTuple):
    """An offset of all pixels of a frame, of a row, of a column, or along a wave across the sensor.

    Attributes:
        of: what has one offset; a wave has a sine and a cosine of its own in each frame.
        variance: of the offset, of a wave's sine and of its cosine, in any frame of the camera, DN^2; None:
            other frames have another one.
        cycles_per_row, cycles_per_column: of a wave, from row to row and from column to column.
    """

    of: Literal["frame", "row", "column", "wave"]
    variance: float | None
    cycles_per_row: float = 0.0
    cycles_per_column: float = 0.0


def add_offset(values: NDArray[Any], offset_dn: ArrayLike, context: EffectContext) -> NDArray[Any]:
    """Return the analog signal (frame, y, x), e-, with offsets in DN referred to the input."""
    result: NDArray[Any] = values + np.asarray(offset_dn) * context.truth["conversion_gain"]
    return result


class SharedNoise(Effect):
    """Base of noise that the pixels of a frame, row or column share: a Gaussian offset, new in every frame.

    In DN, since the disturbance sits behind the pixels' gains. The strength is its standard deviation. A
    pixel's own histogram only broadens, its read noise becomes ``(sigma^2 + strength^2)^(1/2)`` DN.

    Attributes:
        shared_by: what has one offset.
    """

    plane: ClassVar[Plane] = Plane.ANALOG
    power: ClassVar[float] = 2.0
    shared_by: ClassVar[Literal["frame", "row", "column"]]

    @property
    def _variance(self) -> float:
        """Variance of the offsets, DN^2."""
        return float(getattr(self, self.strength)) ** 2

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the signal (frame, y, x), e-, with the offsets referred to the input."""
        offsets = context.random.normal(_KEYS[self.shared_by])
        return add_offset(values, getattr(self, self.strength) * offsets, context)

    def shared_offset(self) -> SharedOffset:
        """Return its offset."""
        return SharedOffset(self.shared_by, self._variance)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the variance of the offsets: exact, a Gaussian on a Gaussian."""
        return model.with_variance(dn2=self._variance)
