"""The model with which the maps of a run were fitted, whatever its configuration says by now."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pchem_pipeline.base.variables import FREE_SATELLITES, PARAMETERS
from pchem_pipeline.effects.framework.compose import PixelPlaces, pixel_maps, sample_law
from pchem_pipeline.run.model_versions import Region, model_of, read_added_exposure
from pchem_pipeline.run.sensor import SensorInfo

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pchem_pipeline.effects.framework.added_exposure import AddedExposure
    from pchem_pipeline.effects.framework.effect import Effect
    from pchem_pipeline.model.electrons.electrons import KnownPixels
    from pchem_pipeline.model.law.sample_law import SampleLaw
    from pchem_pipeline.store.run_store import RunStore


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


def fitted_law(
    store: RunStore,
    maps: Sequence[NDArray[np.float64]],
    region: Region | None = None,
    *,
    without: Sequence[str] = (),
) -> SampleLaw:
    """Return the law of the samples of the pixels of a region, under the model of the stored fit.

    Args:
        store: the run.
        maps: fitted (H, g, mu, sigma) of the region; NaN where the fit failed.
        region: of the sensor; None: all of it.
        without: tags of effects to leave out.
    """
    effects = [effect for effect in fitted_effects(store) if effect.tag not in without]
    known = pixel_maps(maps, np.ones(maps[0].shape, bool))
    return sample_law(effects, known, fitted_added_exposure(store, region), pixel_places(store, region))


def fitted_satellites(
    store: RunStore, region: Region | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return amplitude (e-) and weight of the free satellites of a region, shape (n,); None: none."""
    if not all(store.has(f"fit/{name}") for name in FREE_SATELLITES):
        return None
    amplitude, weight = (store.read(f"fit/{name}", region).ravel() for name in FREE_SATELLITES)
    return amplitude, weight


def fitted_pixels(store: RunStore, region: Region | None = None) -> KnownPixels:
    """Return what the stored fit says of the pixels of a region."""
    from pchem_pipeline.model.electrons.electrons import KnownPixels  # loads compiled loops

    maps = [store.read(f"fit/{name}", region) for name in PARAMETERS]
    return KnownPixels(maps, fitted_law(store, maps, region), fitted_satellites(store, region))
