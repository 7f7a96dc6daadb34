"""Persistence: the ghost of an earlier bright image, released slowly into the frames of the run.

Traps that a bright exposure has filled empty with their own time constants, and the exposure of frame t
becomes ``H + A_p exp(-t / tau)`` with the image A of before (Smith et al. 2008, "A theory for image
persistence in HgCdTe photodiodes"). Its map is that of the earlier image and not of H: a spot here, or any
image on a coarse grid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.charge_sums import block_charge, block_signal, exposure_nodes
from pchem_pipeline.effects.estimators.fading_images import FadingCells, fading_of
from pchem_pipeline.effects.estimators.spots import best_spot
from pchem_pipeline.effects.estimators.time_profiles import SETTLING
from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.effect import (
    Effect,
    ElectronsPerFrame,
    Frames,
    Plane,
    Ratio,
    register_effect,
)
from pchem_pipeline.effects.framework.region import Span
from pchem_pipeline.effects.framework.spot import spot_image, spot_to_sensor, spot_to_window
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, FloatArray, IntArray, PixelMaps

# rows and columns of the grids: to find something, and to describe it
_GRIDS = (8, 32)
#: cells along a side of an image that was found in a part of the sensor: it stands in the YAML
_MOST_CELLS = 48
# by how many times as clearly the samples must show it as the charge
_MORE = 1.25
_BRIGHTEST = 1e6  # e- per frame that an afterglow begins with
# time constants tried, in lengths of the run
_DECAYS = (*SETTLING, 2.0)


@register_effect
class Persistence(Effect):
    """Exposure left over from an earlier image, fading away from the first frame on.

    Signature: block means of the electron number fall along the run in a connected part of the sensor, not in
    proportion to H; nothing in the readout residual.
    """

    tag: Literal["persistence"] = Field(default="persistence", description="name of the effect")
    plane = Plane.EXPOSURE
    title = "image persistence"
    source = "Smith et al. 2008, Proc. SPIE 7021, 70210J"
    signature = (
        "frame.charge.quadrants",
        "frame.charge.trend",
        "time.block.charge.chi",
        "frame.charge.slow",
    )
    strength = "peak_e"
    may_be_at_bound = ("slow_share", "centre_y", "centre_x")
    separate: ClassVar[Mapping[str, str]] = {
        "glow": "a run after a longer time in the dark: persistence is gone, a glow is not",
        "exposure_drift": "a run after a longer time in the dark: persistence is gone, a drift is not",
        "dark_current_rts": "a longer run: single pixels blink repeatedly, persistence fades once in regions",
        "bias_drift": "electron numbers in dark frames: persistence changes them, a bias drift does not",
    }
    peak_e: ElectronsPerFrame = Field(
        ge=0, le=_BRIGHTEST, description="largest additional exposure in the first frame, e- per frame"
    )
    decay_frames: Frames = Field(gt=0, description="time constant of the fading, frames")
    slow_decay_frames: Frames | None = Field(
        default=None, gt=0, description="time constant of a second, slower part, frames; null: none"
    )
    slow_share: Ratio = Field(
        default=0.5, ge=0, le=1, description="share of the slower part in the first frame, no unit"
    )
    centre_y: Ratio = Field(
        default=0.5, ge=0, le=1, description="row of the spot's centre over the number of rows, no unit"
    )
    centre_x: Ratio = Field(
        default=0.5, ge=0, le=1, description="column of the spot's centre over the number of columns, no unit"
    )
    radius: Ratio = Field(
        default=0.2,
        gt=0,
        description="standard deviation of the Gaussian spot over the longer side of the sensor, no unit",
    )
    image: tuple[tuple[float, ...], ...] = Field(
        default=(),
        description="instead of the spot: relative brightness of the earlier image on a coarse grid over the "
        "whole sensor (rows of numbers >= 0, the largest counts as 1, linear in between); empty: the spot",
    )

    #: a spot of 0.15 e- that fades within a quarter of a run of 4000 frames
    typical_values = ({"peak_e": 0.15, "decay_frames": 1000.0},)

    @model_validator(mode="after")
    def _image_is_a_grid(self) -> Self:
        if not self.image:
            return self
        if len({len(row) for row in self.image}) != 1 or not self.image[0]:
            raise ValueError("persistence: the rows of image have different lengths or none; give a grid")
        values = [value for row in self.image for value in row]
        if min(values) < 0 or max(values) == 0:
            raise ValueError("persistence: image needs numbers >= 0 and one above 0; correct it")
        return self

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with its spot or image counted from these rows and columns."""
        if self.image:
            return self._seen_image(rows, columns, shape)
        return self.model_copy(update=spot_to_window(vars(self), "gaussian", rows, columns, shape))

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with its spot or image counted on the sensor; an image is dark elsewhere."""
        if self.image:
            return self._found_image(rows, columns, shape)
        return self.model_copy(update=spot_to_sensor(vars(self), rows, columns, shape))

    def _seen_image(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with the image as a grid over the window, as fine as that over the sensor."""
        spans = (rows, columns)
        cells = (len(self.image), len(self.image[0]))
        places = [
            (low + (np.arange(n) + 0.5) * (high - low) / n) / size
            for (low, high), n, size in zip(spans, cells, shape, strict=True)
        ]
        values = self._image_at(*places)
        brightest = float(values.max())
        grid = _numbers(values / brightest) if brightest > 0 else ((1.0,),)
        return self.model_copy(update={"image": grid, "peak_e": self.peak_e * brightest})

    def _found_image(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with the image as a grid over the sensor, as fine where that takes few cells."""
        parts, cells = [], (len(self.image), len(self.image[0]))
        for (low, high), n, size in zip((rows, columns), cells, shape, strict=True):
            many = min(-(-n * size // (high - low)), _MOST_CELLS)
            parts.append(((np.arange(many) + 0.5) / many * size - low) / (high - low))
        y, x = parts
        values = self._image_at(y, x) * ((y > 0) & (y < 1))[:, None] * ((x > 0) & (x < 1))
        brightest = float(values.max())
        if not brightest > 0:  # it lies between the centres of cells
            values[np.abs(y - 0.5).argmin(), np.abs(x - 0.5).argmin()] = brightest = 1.0
        return self.model_copy(
            update={"image": _numbers(values / brightest), "peak_e": self.peak_e * brightest}
        )

    def _image_at(self, y: FloatArray, x: FloatArray) -> FloatArray:
        """Return the image, relative to its largest value, at places 0..1 of the sensor."""
        grid = np.asarray(self.image)
        values: FloatArray = _hats(y, grid.shape[0]) @ (grid / grid.max()) @ _hats(x, grid.shape[1]).T
        return values

    def pattern(self, rows: IntArray, shape: tuple[int, int]) -> FloatArray:
        """Return the earlier image in some rows, relative to its largest value, shape (rows, columns)."""
        columns = np.arange(shape[1])
        if self.image:
            return self._image_at((rows + 0.5) / shape[0], (columns + 0.5) / shape[1])
        return spot_image(rows, columns, shape, (self.centre_y, self.centre_x), self.radius)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the exposure with what the earlier image left (frame, y, x), e-; draws nothing."""
        if self.peak_e == 0:
            return values.copy()
        left = self._left(context.frames)
        result: AnyArray = values + left[:, None, None] * self.pattern(context.rows, context.shape)
        return result

    def added_exposure(
        self, frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps
    ) -> AddedExposure | None:
        """Return the ghost, with three levels for its time profile."""
        left = self._left(numbers)
        mean = float(left.mean())
        if not mean > 0:
            return None
        weights, nodes = exposure_nodes(left / mean)
        rows, columns = maps.usable.shape
        image = mean * self.pattern(np.arange(rows), (rows, columns))
        return AddedExposure(
            nodes[:, None, None] * image, np.broadcast_to(weights[:, None, None], (nodes.size, rows, columns))
        )

    def _left(self, frames: IntArray) -> FloatArray:
        """Return what is left of the largest value in each frame, e-."""
        # frames before the run are simulated only as memory of the first: as exposed as that one
        t = np.maximum(frames, 0)
        left: FloatArray = np.exp(-t / self.decay_frames)
        if self.slow_decay_frames is not None:
            left = (1.0 - self.slow_share) * left + self.slow_share * np.exp(-t / self.slow_decay_frames)
        return self.peak_e * left

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return a spot and an image from the pixels' block means, fitted with a falling exponential each.

        What all pixels do in proportion to H is taken out first. The amplitudes are averaged over the cells
        of a coarse grid; the time constant is the one that explains most. It is found in the charge; the
        samples themselves hold all of it, however strong it is.
        """
        blocks = block_charge(evidence)
        if blocks is None or evidence.time is None:
            return ()
        exposure = evidence.maps.quanta_exposure
        tried = [
            FadingCells.of(blocks, exposure, decay * evidence.time.n_run, _GRIDS[0]) for decay in _DECAYS
        ]
        best = max(tried, key=lambda cells: cells.score)
        if best.score < 4.0:
            return ()
        # the charge is less noisy, unless the fits that tell it are wrong
        signal = block_signal(evidence) or blocks
        whole = FadingCells.of(signal, exposure, best.decay, _GRIDS[0])
        if whole.score > _MORE * best.score:
            blocks, best = signal, whole
        finer = FadingCells.of(blocks, exposure, best.decay, _GRIDS[1])
        fading = fading_of(blocks, best, evidence.time.n_run)
        fields: dict[str, Any] = {
            "decay_frames": fading.decay,
            "slow_decay_frames": fading.slow_decay,
            "slow_share": fading.slow_share,
        }
        found: list[Self] = []
        bright = finer.image()
        peak = float(bright.max())
        # an afterglow brighter than any scene is only extrapolated to the first frame
        if 0.0 < peak * fading.scale <= _BRIGHTEST:
            found.append(cls(peak_e=peak * fading.scale, image=_numbers(bright / peak), **fields))
        spot = best_spot(finer.amplitude, finer.noise, finer.exposure, exposure.shape)
        if spot is not None and spot.peak * fading.scale <= _BRIGHTEST:
            found.append(cls(peak_e=spot.peak * fading.scale, **(fields | spot.place)))
        return found


def _numbers(image: FloatArray) -> tuple[tuple[float, ...], ...]:
    """Return a grid for the YAML."""
    return tuple(tuple(float(round(v, 3)) for v in row) for row in image)


def _hats(position: FloatArray, n: int) -> FloatArray:
    """Return weights (positions, n) of linear interpolation between the centres of n cells in 0..1."""
    centres = (np.arange(n) + 0.5) / n
    return np.stack([np.interp(position, centres, row) for row in np.eye(n)], axis=1)
