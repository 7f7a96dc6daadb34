"""From a list of effects to the law of the pixels' samples, to the exposure that they add, and to words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.errors import ConfigError, PchEmError, error_words
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.effects.framework.effect import Effect, Plane
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.law.sample_law import SampleLaw


class AddedExposure(NamedTuple):
    """Exposure beside H as a discrete mixture over the frames, (j, y, x) each or (j, n) of some pixels."""

    exposure_e: FloatArray  # the levels, e- per frame, >= 0
    weight: FloatArray  # part of the frames spent at each; the sum over j is 1

    def of(self, pixels: BoolArray | NDArray[np.intp] | tuple[slice, ...] | slice) -> AddedExposure:
        """Return that of some pixels: an index, a mask or slices of the axes after the first."""
        place = (slice(None), *(pixels if isinstance(pixels, tuple) else (pixels,)))
        return AddedExposure(self.exposure_e[place], self.weight[place])

    def flat(self) -> AddedExposure:
        """Return it with the pixels in one axis, (j, n)."""
        return AddedExposure(*(values.reshape(values.shape[0], -1) for values in self))

    def combined_with(self, other: AddedExposure) -> AddedExposure:
        """Return that of two independent ones together, all pairs of levels."""
        exposure = self.exposure_e[:, None] + other.exposure_e[None]
        weight = self.weight[:, None] * other.weight[None]
        shape = (-1, *self.weight.shape[1:])
        return AddedExposure(exposure.reshape(shape), weight.reshape(shape))


def added_exposures(
    effects: Sequence[Effect], frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps
) -> AddedExposure | None:
    """Return what effects add to the exposure of each pixel, all together; None where none adds any.

    Found in frames (frame, y, x), DN, of increasing numbers in the run, from the plain fit of these pixels.

    Raises:
        ConfigError: if an effect fails; it is named.
    """
    found: AddedExposure | None = None
    for effect in effects:
        # effects may come from other packages: whatever they raise is told with their name
        try:
            added = _in_its_place(effect, frames, numbers, maps)
        except Exception as error:
            raise ConfigError(
                f"model.effects: {effect.tag} ({type(effect).__module__}) cannot tell what it adds to the "
                f"exposure: {error_words(error)}; remove it from model.effects"
            ) from error
        if added is not None:
            found = added if found is None else found.combined_with(added)
    return found


def _in_its_place(
    effect: Effect, frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps
) -> AddedExposure | None:
    """Return what an effect adds inside its region, found in its frames; nothing in the others."""
    when = np.ones(numbers.size, np.bool_) if effect.when is None else effect.when.frames(numbers)
    added = effect.added_exposure(frames if when.all() else frames[when], numbers[when], maps)
    if added is None or effect.everywhere:
        return added
    shape = maps.bias.shape
    inside = np.ones(shape, np.bool_) if effect.region is None else effect.region.mask(shape)
    share = when.mean()
    none = np.zeros((1, *inside.shape))
    weight = np.concatenate([none + 1.0 - share * inside, share * np.where(inside, added.weight, 0.0)])
    return AddedExposure(np.concatenate([none, np.where(inside, added.exposure_e, 0.0)]), weight)


def pixel_maps(parameters: Sequence[FloatArray], usable: BoolArray) -> PixelMaps:
    """Return (H, g, mu, sigma) of n pixels as effects take them, each (n,), NaN where not usable."""
    columns = [np.asarray(values, np.float64).ravel() for values in parameters]
    known = np.asarray(usable, bool).ravel() & np.isfinite(np.stack(columns)).all(axis=0)
    return PixelMaps.known(columns, known)


@dataclass(frozen=True)
class PixelPlaces:
    """Where pixels lie on the sensor, and which frames they were seen in."""

    rows: IntArray  # of each pixel on the sensor, (n,)
    columns: IntArray  # of each pixel on the sensor, (n,)
    shape: tuple[int, int]  # rows and columns of the sensor
    frames: IntArray  # numbers of the frames in the run, (frame,); none where they have no order

    @classmethod
    def of_block(
        cls, block: tuple[slice, slice] | None, shape: tuple[int, int], frames: IntArray
    ) -> PixelPlaces:
        """Return those of a block of the sensor, row by row; None: all of it."""
        block = block or (slice(None), slice(None))
        y, x = (np.arange(size)[part] for size, part in zip(shape, block, strict=True))
        rows, columns = np.meshgrid(y, x, indexing="ij")
        return cls(rows.ravel(), columns.ravel(), shape, frames)

    def of(self, pixels: BoolArray | NDArray[np.intp]) -> PixelPlaces:
        """Return those of some of the pixels."""
        return replace(self, rows=self.rows[pixels], columns=self.columns[pixels])

    def inside(self, effect: Effect) -> BoolArray:
        """Return which pixels an effect acts on, shape (n,)."""
        if effect.region is None:
            return np.ones(self.rows.size, np.bool_)
        return np.asarray(effect.region.mask(self.shape)[self.rows, self.columns])

    def share(self, effect: Effect) -> float:
        """Return the share of the frames in which an effect acts."""
        if effect.when is None:
            return 1.0
        if not self.frames.size:
            raise ValueError("these samples have no frame order; leave out `when`")
        return effect.when.share(self.frames)


def along_chain(model: Sequence[Effect], new: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return a model with new effects, each where the signal comes to it; what it has keeps its order.

    In a plane effects act in the order of their list: a limit of the ADC before an offset that is added there
    is no limit of what comes out. Where any order will do it is that of the tags.
    """
    planes = list(Plane)

    def place(effect: Effect) -> tuple[int, int]:
        return planes.index(effect.plane), effect.along

    found = list(model)
    for effect in sorted(new, key=lambda effect: effect.tag):
        behind = [i for i, known in enumerate(found) if place(known) <= place(effect)]
        found.insert(behind[-1] + 1 if behind else 0, effect)
    return tuple(found)


def sample_law(
    effects: Sequence[Effect],
    maps: PixelMaps,
    added: AddedExposure | None = None,
    places: PixelPlaces | None = None,
) -> SampleLaw:
    """Return the law of the pixels' samples with all effects, composed in their order.

    An effect with a region changes the law of its pixels only; one that acts in some of the frames makes it a
    mixture, see :meth:`~pchem_pipeline.model.law.sample_law.SampleLaw.mixed_with`. The n pixels have
    parameters ``maps``, (n,) each, known before, and exposures ``added`` by effects. Effects with a place or
    a time need the ``places`` of the pixels.

    Raises:
        ConfigError: an effect has no law of these pixels (ValueError, ConfigError); it is named.
        PchEmError: it raises anything else.
    """
    n = maps.bias.size
    groups = [(np.arange(n), SampleLaw())]
    for effect in effects:
        # effects may come from other packages: whatever they raise is told with their name
        try:
            for each in (effect,) if places is None else effect.by_law(places.shape):
                groups = [part for group in groups for part in _with_effect(each, *group, maps, places)]
        except Exception as error:
            kind = ConfigError if isinstance(error, ValueError | ConfigError) else PchEmError
            raise kind(
                f"model.effects: {effect_words(effect)} ({type(effect).__module__}) cannot be fitted with: "
                f"{error_words(error)}; remove it from model.effects"
            ) from error
    model = groups[0][1] if len(groups) == 1 else SampleLaw.joined(groups, n)
    if added is not None:
        exposure, weight = added.flat()
        model = model.with_added_exposure(exposure.T, weight.T)
    return model


def _with_effect(
    effect: Effect, pixels: NDArray[np.intp], law: SampleLaw, maps: PixelMaps, places: PixelPlaces | None
) -> list[tuple[NDArray[np.intp], SampleLaw]]:
    """Return groups of pixels with their laws: of one group, those on which an effect acts and the others."""
    if effect.everywhere:
        return [(pixels, effect.sample_law(law, _some(maps, pixels)))]
    if places is None:
        raise ValueError("pixels and frames of these samples are not known")
    inside = places.inside(effect)[pixels]
    share = places.share(effect)
    if share == 0.0 or not inside.any():
        return [(pixels, law)]
    within, outside = pixels[inside], pixels[~inside]
    own, near = law.of(inside), _some(maps, within)
    changed = effect.sample_law(own, near)
    if share < 1.0:
        noise = np.nan_to_num(near.read_noise_dn**2 - QUANTISATION_VARIANCE, nan=1.0)
        step = np.nan_to_num(1.0 / near.conversion_gain, nan=1.0)
        changed = own.mixed_with(changed, share, noise, step)
    return [(within, changed), *([(outside, law.of(~inside))] if outside.size else [])]


def _some(maps: PixelMaps, pixels: NDArray[np.intp]) -> PixelMaps:
    """Return the parameters of some pixels."""
    if pixels.size == maps.bias.size:
        return maps
    return maps.of(pixels)


def place_words(effect: Effect) -> str:
    """Return in words where and when an effect acts; nothing where that is everywhere and always."""
    return ", ".join(place.describe() for place in (effect.region, effect.when) if place is not None)


def in_place(effect: Effect) -> str:
    """Return the same behind " in ", for the end of a phrase; nothing where there is nothing to say."""
    return "" if effect.everywhere else f" in {place_words(effect)}"


def effect_words(effect: Effect) -> str:
    """Describe an effect, for example ``row_noise in columns 120 to 159, frames 0 to 99``."""
    return f"{effect.tag}{in_place(effect)}"


def model_words(effects: Sequence[Effect]) -> str:
    """Describe a model, for example ``PCD + row_noise + rts_noise``."""
    return " + ".join(["PCD", *map(effect_words, effects)])
