"""Exposure that effects add to single pixels: what their histograms alone do not tell from H."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.effect import Effect
    from pchem_pipeline.effects.framework.evidence import PixelMaps


class AddedExposure(NamedTuple):
    """Exposure beside H as a discrete mixture over the frames, (j, y, x) each or (j, n) of a list of pixels.

    Attributes:
        exposure_e: the levels, e- per frame, >= 0.
        weight: the part of the frames spent at each; the sum over j is 1.
    """

    exposure_e: NDArray[np.float64]
    weight: NDArray[np.float64]

    def of(self, pixels: NDArray[np.bool_] | NDArray[np.intp] | tuple[slice, ...] | slice) -> AddedExposure:
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
    effects: Sequence[Effect],
    frames: NDArray[np.unsignedinteger],
    numbers: NDArray[np.int64],
    maps: PixelMaps,
) -> AddedExposure | None:
    """Return what effects add to the exposure of each pixel, all together; None where none adds any.

    Args:
        effects: of the model.
        frames: (frame, y, x), DN.
        numbers: their numbers in the run, increasing, shape (frame,).
        maps: plain fit of these pixels.

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
                f"exposure: {type(error).__name__}: {error}; remove it from model.effects"
            ) from error
        if added is not None:
            found = added if found is None else found.combined_with(added)
    return found


def _in_its_place(
    effect: Effect,
    frames: NDArray[np.unsignedinteger],
    numbers: NDArray[np.int64],
    maps: PixelMaps,
) -> AddedExposure | None:
    """Return what an effect adds inside its region, found in its frames; nothing in the others."""
    when = np.ones(numbers.size, np.bool_) if effect.when is None else effect.when.frames(numbers)
    added = effect.added_exposure(frames if when.all() else frames[when], numbers[when], maps)
    if added is None or effect.everywhere:
        return added
    rows, columns = maps.bias.shape
    inside = np.ones((rows, columns), np.bool_)
    if effect.region is not None:
        inside = effect.region.mask((rows, columns))
    share = when.mean()
    none = np.zeros((1, *inside.shape))
    weight = np.concatenate([none + 1.0 - share * inside, share * np.where(inside, added.weight, 0.0)])
    return AddedExposure(np.concatenate([none, np.where(inside, added.exposure_e, 0.0)]), weight)
