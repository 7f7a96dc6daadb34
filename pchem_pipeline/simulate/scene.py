"""What a simulated sensor looks at: an exposure of all pixels, an image, or a sequence of images."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.framework.effect import Effect, Plane
from pchem_pipeline.simulate.truth import Defect, TruthMaps

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.context import EffectContext
    from pchem_pipeline.simulate.settings import SimulateSettings


class _Sequence(Effect):
    """Frame n sees image n; after the last one the sequence begins anew. For pixels that see anything."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    tag: Literal["scene"] = "scene"
    plane: ClassVar[Plane] = Plane.EXPOSURE
    images: FloatArray

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the exposure (frame, y, x), e-."""
        seen = self.images[context.frames % len(self.images)][:, context.rows]
        return np.where(context.truth["quanta_exposure"] > 0.0, seen, 0.0)


def with_scene(
    truth: TruthMaps, settings: SimulateSettings, scene: float | FloatArray
) -> tuple[TruthMaps, SimulateSettings]:
    """Return the sensor and its settings when it looks at a scene.

    A number, an image (y, x), or a sequence (image, y, x), e- per frame: all of the exposure, the dark one
    included. Dead and stuck pixels see nothing.

    Raises:
        ConfigError: its shape is not the sensor's, or a value is impossible.
    """
    values = np.asarray(scene, np.float64)
    if values.ndim not in (0, 2, 3) or (values.ndim and values.shape[-2:] != truth.shape):
        raise ConfigError(
            f"scene of shape {values.shape}, but the sensor has {truth.shape}; give a number, an image of "
            "that shape, or a sequence of such images"
        )
    if not (np.isfinite(values) & (values >= 0.0)).all():
        raise ConfigError("scene: negative exposure; give 0 or more e- in each pixel")
    sees = (truth.defect != Defect.DEAD) & (truth.defect != Defect.STUCK)
    if values.ndim < 3:
        return replace(truth, quanta_exposure=np.where(sees, values, 0.0)), settings
    mean = np.maximum(values.mean(axis=0), np.finfo(np.float64).tiny)
    effects = (_Sequence(images=values), *settings.effects)
    return (
        replace(truth, quanta_exposure=np.where(sees, mean, 0.0)),
        settings.model_copy(update={"effects": effects}),
    )
