"""From a list of effects to the law of the pixels' samples, and to words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.law.sample_law import SampleLaw

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["model_words", "pixel_maps", "sample_law"]


def pixel_maps(parameters: Sequence[NDArray[np.float64]], usable: NDArray[np.bool_]) -> PixelMaps:
    """Return (H, g, mu, sigma) of n pixels as effects take them, each (n,), NaN where not usable.

    Args:
        parameters: the four, any shape with n elements.
        usable: pixels with a fit that can be relied upon; those without finite parameters are none of them.
    """
    columns = [np.asarray(values, np.float64).ravel() for values in parameters]
    known = np.asarray(usable, bool).ravel() & np.isfinite(np.stack(columns)).all(axis=0)
    exposure, gain, bias, sigma = (np.where(known, values, np.nan) for values in columns)
    return PixelMaps(exposure, gain, bias, sigma, known)


def sample_law(effects: Sequence[Effect], maps: PixelMaps, added: AddedExposure | None = None) -> SampleLaw:
    """Return the law of the pixels' samples with all effects, composed in their order.

    Args:
        effects: of the run's model.
        maps: what is known of the n pixels before, each (n,).
        added: exposure that effects add to these pixels, (j, n) each or of that many pixels; None: nothing.

    Raises:
        ConfigError: if an effect cannot say what it does to these pixels; it is named.
    """
    model = SampleLaw()
    for effect in effects:
        # effects may come from other packages: whatever they raise is told with their name
        try:
            model = effect.sample_law(model, maps)
        except Exception as error:
            raise ConfigError(
                f"model.effects: {effect.tag} ({type(effect).__module__}) cannot be fitted with: "
                f"{type(error).__name__}: {error}; remove it from model.effects"
            ) from error
    if added is not None:
        exposure, weight = added.flat()
        model = model.with_added_exposure(exposure.T, weight.T)
    return model


def model_words(effects: Sequence[Effect]) -> str:
    """Return the model in words, for example ``PCD + row_noise + rts_noise``."""
    return " + ".join(["PCD", *(effect.tag for effect in effects)])
