"""The model with which the maps of a run were fitted, whatever its configuration says by now."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.variables import FREE_SATELLITES
from pchem_pipeline.effects.framework.compose import AddedExposure, PixelPlaces, pixel_maps, sample_law
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.law.sample_law import SampleLaw
from pchem_pipeline.run.model_versions import ModelVersion, Region, model_of, read_added_exposure
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.store.run_store import RunStore


def fitted_effects(store: RunStore) -> tuple[Effect, ...]:
    """Return the effects of the model of the stored fit, in their order; none without a fit.

    Raises:
        ConfigError: an effect came from a package that is no longer there.
    """
    version = model_of(store, "fit")
    return () if version is None else version.effects


@dataclass(frozen=True)
class FittedModel:
    """The model with which pixels of a run were fitted; without effects the PCD, without a version no fit.

    ``added`` is the exposure that effects add to the n pixels, (j, n); None: nothing.
    """

    effects: tuple[Effect, ...] = ()
    added: AddedExposure | None = None
    version: ModelVersion | None = None
    places: PixelPlaces | None = None

    @classmethod
    def read(cls, store: RunStore, region: Region | None = None) -> FittedModel:
        """Read that of the pixels of a region of the sensor; None: all of it."""
        version = model_of(store, "fit")
        if version is None or not version.effects:
            return cls(version=version)
        added = read_added_exposure(store, version, region)
        places = pixel_places(store, region)
        return cls(version.effects, None if added is None else added.flat(), version, places)

    def at(self, index: IntArray) -> FittedModel:
        """Return the model of some of the pixels."""
        return replace(
            self,
            added=None if self.added is None else self.added.of(index),
            places=None if self.places is None else self.places.of(index),
        )

    def law(self, maps: Sequence[FloatArray], *, without: Sequence[str] = ()) -> SampleLaw:
        """Return the law of the samples of the pixels, ``without`` the effects of some tags.

        The maps are their fitted (H, g, mu, sigma), NaN where the fit failed.
        """
        effects = [effect for effect in self.effects if effect.tag not in without]
        return sample_law(effects, pixel_maps(maps, np.ones(maps[0].shape, bool)), self.added, self.places)


def pixel_places(store: RunStore, region: Region | None) -> PixelPlaces:
    """Return where the pixels of a region lie, and the numbers of the frames, if these have an order."""
    sensor = SensorInfo.read(store)
    frames = sensor.n_frames if sensor.kind == "frames" else 0
    return PixelPlaces.of_block(region, sensor.shape, np.arange(frames))


def fitted_satellites(store: RunStore, region: Region | None) -> tuple[FloatArray, FloatArray] | None:
    """Return amplitude (e-) and weight of the free satellites of a region, shape (n,); None: none."""
    if not all(store.has(f"fit/{name}") for name in FREE_SATELLITES):
        return None
    amplitude, weight = (store.read(f"fit/{name}", region).ravel() for name in FREE_SATELLITES)
    return amplitude, weight
