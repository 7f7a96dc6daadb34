"""The model with which the maps of a run were fitted, whatever its configuration says by now."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pchem_pipeline.effects.framework.compose import PixelPlaces, pixel_maps, sample_law
from pchem_pipeline.model.electrons.extended_electrons import nearest_pcd
from pchem_pipeline.run.model_versions import Region, model_of, read_added_exposure
from pchem_pipeline.run.sensor import SensorInfo

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pchem_pipeline.effects.framework.added_exposure import AddedExposure
    from pchem_pipeline.effects.framework.effect import Effect
    from pchem_pipeline.store.run_store import RunStore

__all__ = ["deciding_maps", "fitted_added_exposure", "fitted_effects", "pixel_places"]


def fitted_effects(store: RunStore) -> tuple[Effect, ...]:
    """Return the effects of the model of the stored fit, in their order; none without a fit.

    Raises:
        ConfigError: an effect came from a package that is no longer there.
    """
    version = model_of(store, "fit")
    return () if version is None else version.effects


def fitted_added_exposure(store: RunStore, region: Region | None = None) -> AddedExposure | None:
    """Return the exposure that the effects of the stored fit add to the pixels of a region; None: nothing.

    Args:
        store: the run.
        region: of the sensor; None: all of it.
    """
    return read_added_exposure(store, model_of(store, "fit"), region)


def pixel_places(store: RunStore, region: Region | None = None) -> PixelPlaces:
    """Return where the pixels of a region lie, and the numbers of the frames, if these have an order."""
    sensor = SensorInfo.read(store)
    frames = sensor.n_frames if sensor.kind == "frames" else 0
    return PixelPlaces.of_block(region, sensor.shape, np.arange(frames))


def deciding_maps(
    maps: Sequence[NDArray[np.float64]],
    effects: Sequence[Effect],
    added: AddedExposure | None = None,
    places: PixelPlaces | None = None,
) -> tuple[NDArray[np.float64], ...]:
    """Return the parameters with which electron numbers are decided: the maps themselves without effects.

    Args:
        maps: fitted (H, g, mu, sigma), each of the same shape; NaN where the fit failed.
        effects: with which they were fitted.
        added: exposure that these add to the pixels, a pixel for each of the maps; None: nothing.
        places: of these pixels; None: not known.

    Returns:
        The four, in that shape; with effects those of the nearest PCD.
    """
    if not effects:
        return tuple(maps)
    model = sample_law(effects, pixel_maps(maps, np.ones(maps[0].shape, bool)), added, places)
    return tuple(values.reshape(maps[0].shape) for values in nearest_pcd(list(maps), model))
