"""Linear drift of the quanta exposure during a capture (the sensor warms up, the lamp ages).

PCH-EM assumes independent, identically distributed frames (Hendrickson et al. 2023, Sec. II-B). Here frame
``n`` of ``N`` sees ``H_n = H (1 + drift (n / (N - 1) - 1/2))``, so they are not. Dark current doubles every
6 to 8 K, about 10 % per kelvin, so a tenth of a kelvin over the run already drifts by 1 %.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from pchem_pipeline.effects.base import Effect, Plane, register_effect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.context import EffectContext

__all__ = ["ExposureDrift"]


@register_effect
class ExposureDrift(Effect):
    """Relative change of H from the first frame to the last, the same in every pixel.

    Signature: block means of the electron number follow the drift with a slope proportional to H,
    those of the readout residual do not. The mean over the run stays; for large N the variance grows
    by ``(drift H / g)^2 / 12`` DN^2 and is no longer that of any single PCD.
    """

    tag: Literal["exposure_drift"] = Field(default="exposure_drift", description="name of the effect")
    plane: ClassVar[Plane] = Plane.EXPOSURE
    drift: float = Field(ge=-2, le=2, description="(H_last - H_first) / H_mean, no unit")

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the drifting exposure (frame, y, x), e-; draws nothing."""
        last = context.n_frames - 1
        # frames before the run are simulated only as memory of the first: as exposed as that one
        position = context.frames.clip(0, last) / last - 0.5 if last > 0 else context.frames * 0.0
        result: NDArray[Any] = values * (1.0 + self.drift * position)[:, None, None]
        return result
