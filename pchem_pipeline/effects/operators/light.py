"""Modulate the light of some pixels: spots that burst, grow or fade, and dark current that blinks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.charge_sums import block_charge, block_signal, exposure_nodes
from pchem_pipeline.effects.estimators.common_modes import run_position
from pchem_pipeline.effects.estimators.series import SETTLING
from pchem_pipeline.effects.estimators.spots import (
    FadingCells,
    Falloff,
    Spot,
    best_bursts,
    best_spot,
    fading_of,
    spot_image,
    spot_to_sensor,
    spot_to_window,
)
from pchem_pipeline.effects.framework.compose import AddedExposure
from pchem_pipeline.effects.framework.effect import (
    FEWEST_SHOWN,
    Effect,
    Electrons,
    ElectronsPerFrame,
    Factors,
    Frames,
    Plane,
    Ratio,
)
from pchem_pipeline.effects.framework.region import Span
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, FloatArray, IntArray, PixelMaps

_GRID = 16  # cells along either side of the map of what grows
_STRAIGHT = 50.0  # runs: a time constant so long is a straight line
_LEAST_GROWTH = 20.0  # chi2 that the best of some 1,000 spots must explain


class Glow(Effect, tag="glow"):
    """A spot of additional exposure that is there in a share of the frames, or grows along the run.

    Output amplifiers, and circuits beside the array, emit near-infrared light that the pixels around them
    collect (amplifier glow of CCDs, circuit glow of CMOS and infrared sensors); a light leak does the same.
    What is constant is part of H; what bursts, or grows while the electronics warm up, is not.

    Signature: mean electron numbers of the rows and columns around one place rise, in single frames or along
    the run, not in proportion to H; nothing in the readout residual.
    """

    plane = Plane.EXPOSURE
    title = "local glow or light leak"
    source = "Janesick 2001, Scientific Charge-Coupled Devices (amplifier luminescence)"
    factors = Factors("light", "a spot", "in bursts or growing")
    signature = (
        "space.row.charge.lag1", "space.column.charge.lag1", "space.row.charge.variance",
        "space.column.charge.variance", "frame.charge.quadrants", "space.x.kk", "time.block.charge.chi",
    )  # fmt: skip
    strength = "peak_e"
    may_be_at_bound = ("centre_y", "centre_x")
    separate: ClassVar[Mapping[str, str]] = {
        "exposure_flicker": "a map of the bright frames: flicker is proportional to H, a glow local",
        "exposure_drift": "a map of the change along the run: light drifts as H, a glow is local",
        "persistence": "a run after a longer time in the dark: persistence is gone, a glow grows again",
        "cosmic_rays": "longer runs: a glow is always at the same place",
        "optical_crosstalk": "dark frames without the source of the glow: crosstalk remains",
    }
    #: a corner that bursts in one frame of fifty, by 1 e-, and one that grows by 0.3 e-
    typical_values = ({"peak_e": 1.0, "burst_share": 0.02}, {"peak_e": 0.3})
    peak_e: Electrons = Field(
        ge=0, le=1e6, description="largest additional exposure of the brightest pixel, e-"
    )
    burst_share: Ratio | None = Field(
        default=None, gt=0, le=1, description="share of the frames with a burst; null: it grows along the run"
    )
    centre_y: Ratio = Field(
        default=0.0, ge=0, le=1, description="row of the centre over the number of rows, no unit"
    )
    centre_x: Ratio = Field(
        default=0.0, ge=0, le=1, description="column of the centre over the number of columns, no unit"
    )
    radius: Ratio = Field(
        default=0.2, gt=0, description="radius of the spot over the longer side of the sensor, no unit"
    )
    falloff: Falloff = Field(
        default="exponential",
        description="exponential: to 1/e within the radius; gaussian: of that standard deviation",
    )

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with its centre counted from these rows and columns, and the size that it has there."""
        return self.model_copy(update=spot_to_window(vars(self), self.falloff, rows, columns, shape))

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with its centre counted on the sensor."""
        return self.model_copy(update=spot_to_sensor(vars(self), rows, columns, shape))

    @property
    def localised(self) -> bool:
        """It is where its spot is."""
        return True

    def pattern(self, rows: IntArray, shape: tuple[int, ...]) -> FloatArray:
        """Return the spot in some rows relative to its brightest pixel, shape (rows, columns)."""
        centre = (self.centre_y, self.centre_x)
        return spot_image(rows, np.arange(shape[1]), shape, centre, self.radius, self.falloff)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the exposure with the glow (frame, y, x), e-."""
        if self.burst_share is None:
            size = run_position(context.frames, context.n_frames)
        else:
            size = (context.random.uniform(("frame",))[:, 0, 0] < self.burst_share).astype(np.float64)
        result: AnyArray = values.copy()
        bright = size > 0
        result[bright] += size[bright, None, None] * (self.peak_e * self.pattern(context.rows, context.shape))
        return result

    def added_exposure(
        self, frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps
    ) -> AddedExposure | None:
        """Return the glow's levels: with and without a burst, or three of its growth."""
        if self.peak_e == 0:
            return None
        if self.burst_share is None:
            # a straight line from 0 to 1 has the mean 1/2
            weights, factors = exposure_nodes((np.arange(400) + 0.5) / 200.0)
            sizes = 0.5 * factors
        else:
            weights, sizes = np.array([1.0 - self.burst_share, self.burst_share]), np.array([0.0, 1.0])
        image = self.peak_e * self.pattern(np.arange(maps.usable.shape[0]), maps.usable.shape)
        return AddedExposure(
            sizes[:, None, None] * image, np.broadcast_to(weights[:, None, None], (sizes.size, *image.shape))
        )

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return a spot that bursts, from rows and columns, and one that grows, from block means."""
        bursts, growing = best_bursts(evidence), _growing(evidence)
        found: list[tuple[Spot, float | None]] = [] if bursts is None else [bursts]
        if growing is not None:
            found.append((growing, None))
        return [
            cls.model_validate(
                {"peak_e": spot.peak, "falloff": spot.falloff, "burst_share": share, **spot.place}
            )
            for spot, share in found
        ]

    def representative(self, frames: IntArray) -> tuple[Self, float]:
        """Return rare bursts more often than they are, and how much rarer they are."""
        return self._shown_at_least("burst_share", FEWEST_SHOWN / max(frames.size, 1), 1.0)


def _growing(evidence: Evidence) -> Spot | None:
    """Return the spot whose exposure rises along a straight line over the run."""
    blocks = block_charge(evidence)
    if blocks is None or evidence.time is None:
        return None
    exposure = evidence.maps.quanta_exposure
    cells = FadingCells.of(blocks, exposure, _STRAIGHT * evidence.time.n_run, _GRID)
    rise = 1.0 / _STRAIGHT
    falloffs: tuple[Falloff, ...] = ("gaussian", "exponential")
    spot = best_spot(-rise * cells.amplitude, rise * cells.noise, cells.exposure, exposure.shape, falloffs)
    return spot if spot is not None and spot.worth > _LEAST_GROWTH else None


# rows and columns of the grids: to find something, and to describe it
_GRIDS = (8, 32)
#: cells along a side of an image that was found in a part of the sensor: it stands in the YAML
_MOST_CELLS = 48
# by how many times as clearly the samples must show it as the charge
_MORE = 1.25
_BRIGHTEST = 1e6  # e- per frame that an afterglow begins with
# time constants tried, in lengths of the run
_DECAYS = (*SETTLING, 2.0)


class Persistence(Effect, tag="persistence"):
    """Exposure left over from an earlier image, fading away from the first frame on.

    Traps that a bright exposure has filled empty with their own time constants: the exposure of frame t
    becomes ``H + A_p exp(-t / tau)`` with the image A of before (Smith et al. 2008), a spot here, or any
    image on a coarse grid.

    Signature: block means of the electron number fall along the run in a connected part of the sensor, not in
    proportion to H; nothing in the readout residual.
    """

    plane = Plane.EXPOSURE
    title = "image persistence"
    source = "Smith et al. 2008, Proc. SPIE 7021, 70210J"
    factors = Factors("light", "a part of the sensor", "fading")
    signature = ("frame.charge.quadrants", "frame.charge.trend", "time.block.charge.chi", "frame.charge.slow")
    strength = "peak_e"
    may_be_at_bound = ("slow_share", "centre_y", "centre_x")
    separate: ClassVar[Mapping[str, str]] = {
        "glow": "a run after a longer time in the dark: persistence is gone, a glow is not",
        "exposure_drift": "a run after a longer time in the dark: persistence is gone, a drift is not",
        "dark_current_rts": "a longer run: single pixels blink repeatedly, persistence fades once in regions",
        "bias_drift": "electron numbers in dark frames: persistence changes them, a bias drift does not",
    }
    #: a spot of 0.15 e- that fades within a quarter of a run of 4000 frames
    typical_values = ({"peak_e": 0.15, "decay_frames": 1000.0},)
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

    @property
    def localised(self) -> bool:
        """A spot is where it is; an image on a coarse grid has no sharp ends."""
        return not self.image

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with its spot or image, a grid as fine, counted from these rows and columns."""
        if not self.image:
            return self.model_copy(update=spot_to_window(vars(self), "gaussian", rows, columns, shape))
        cells = (len(self.image), len(self.image[0]))
        y, x = (
            (low + (np.arange(n) + 0.5) * (high - low) / n) / size
            for (low, high), n, size in zip((rows, columns), cells, shape, strict=True)
        )
        return self._with_image(self._image_at(y, x))

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with its spot or image counted on the sensor; an image is dark elsewhere."""
        if not self.image:
            return self.model_copy(update=spot_to_sensor(vars(self), rows, columns, shape))
        parts, cells = [], (len(self.image), len(self.image[0]))
        for (low, high), n, size in zip((rows, columns), cells, shape, strict=True):
            many = min(-(-n * size // (high - low)), _MOST_CELLS)  # as fine where that takes few cells
            parts.append(((np.arange(many) + 0.5) / many * size - low) / (high - low))
        y, x = parts
        values = self._image_at(y, x) * ((y > 0) & (y < 1))[:, None] * ((x > 0) & (x < 1))
        if not values.max() > 0:  # it lies between the centres of cells
            values[np.abs(y - 0.5).argmin(), np.abs(x - 0.5).argmin()] = 1.0
        return self._with_image(values)

    def _with_image(self, values: FloatArray) -> Self:
        """Return it with such an image; values are relative to the largest one of the image so far."""
        brightest = float(values.max())
        grid = _numbers(values / brightest) if brightest > 0 else ((1.0,),)
        return self.model_copy(update={"image": grid, "peak_e": self.peak_e * brightest})

    def _image_at(self, y: FloatArray, x: FloatArray) -> FloatArray:
        """Return the image, relative to its largest value, at places 0..1 of the sensor."""
        grid = np.asarray(self.image)
        return np.asarray(_hats(y, grid.shape[0]) @ (grid / grid.max()) @ _hats(x, grid.shape[1]).T)

    def pattern(self, rows: IntArray, shape: tuple[int, int]) -> FloatArray:
        """Return the earlier image in some rows, relative to its largest value, shape (rows, columns)."""
        columns = np.arange(shape[1])
        if self.image:
            return self._image_at((rows + 0.5) / shape[0], (columns + 0.5) / shape[1])
        return spot_image(rows, columns, shape, (self.centre_y, self.centre_x), self.radius)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the exposure with what the earlier image left (frame, y, x), e-; draws nothing."""
        left = self._left(context.frames)
        return np.asarray(values + left[:, None, None] * self.pattern(context.rows, context.shape))

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


# share of the pixels beyond which what seems to blink is something else
_FEW_PIXELS = 0.3


class DarkCurrentRts(Effect, tag="dark_current_rts"):
    """Two levels of the exposure, H and H + step, in a fraction of the pixels.

    Random telegraph signals of the dark current are found in few pixels of new sensors and in many irradiated
    ones, with exponentially distributed jumps (Hopkins and Hopkinson 1993; Goiffon et al. 2009; Virmontois et
    al. 2013). The state is a Markov chain with exponential dwell times.

    Signature: block means of the electron number wander in few pixels, strongly, and successive electron
    numbers are alike there; nothing in the readout residual, nothing in the other pixels.
    """

    plane = Plane.EXPOSURE
    title = "random telegraph signal of the dark current"
    source = (
        "Hopkins and Hopkinson 1993, IEEE Trans. Nucl. Sci. 40, 1567; Goiffon et al. 2009, ibid. 56, 2132"
    )
    factors = Factors("light", "single pixels", "jumping")
    signature = ("time.block.charge.cnt", "time.lag1.charge.cnt", "time.block.charge.chi", "shape.C2.cnt")
    strength = "fraction"
    resample_pixels = True
    separate: ClassVar[Mapping[str, str]] = {
        "rts_noise": "several exposure times: jumps of the dark current grow with it",
        "flicker_noise": "dark current jumps in the electron numbers, 1/f noise in the readout residuals",
        "persistence": "a longer run: persistence fades once in regions, single pixels blink repeatedly",
        "overdispersed_counts": "slower and longer runs: blinking is correlated in time",
    }
    #: in 1.1 % of the pixels, slow and fast, and with steps that differ
    typical_values = (
        {"fraction": 0.011},
        {"fraction": 0.011, "dwell_low_frames": 20.0, "dwell_high_frames": 20.0},
        {"fraction": 0.011, "steps": "exponential"},
    )
    fraction: Ratio = Field(ge=0, le=1, description="fraction of the pixels that blink, no unit")
    step_e: Electrons = Field(
        default=1.0,
        ge=0,
        le=1e6,
        description="additional exposure of the upper level, mean over these pixels, e-",
    )
    steps: Literal["equal", "exponential"] = Field(
        default="equal", description="equal: step_e in each of these pixels; exponential: step_e is the mean"
    )
    dwell_low_frames: Frames = Field(
        default=200.0, ge=0.5, description="mean time in the lower level, frames"
    )
    dwell_high_frames: Frames = Field(
        default=200.0, ge=0.5, description="mean time in the upper level, frames"
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the blinking exposure (frame, y, x), e-; touches the pixels that blink only."""
        result = values.copy()
        u = context.random.uniform(("y", "x"))[0]
        blinks = u < self.fraction
        for row in np.flatnonzero(blinks.any(axis=1)):
            # pixels that blink at a small fraction come first, so that they keep their numbers at a larger
            # one
            columns = np.flatnonzero(blinks[row])
            columns = columns[np.argsort(u[row, columns])]
            random = context.random.generator(y=int(context.rows[row]))
            for column in columns:
                result[:, row, column] += self._added(context, random)
        return result

    def _added(self, context: EffectContext, random: np.random.Generator) -> FloatArray:
        """Return the additional exposure of one pixel in each frame of the block, e-."""
        low, high = self.dwell_low_frames, self.dwell_high_frames
        step = self.step_e * (random.exponential() if self.steps == "exponential" else 1.0)
        starts_high = random.random() < high / (low + high)
        # an even number of dwell times, well above what the run holds; the same whatever the block
        cycles = context.n_frames / (low + high)
        pairs = int(2.0 + cycles * 1.5 + 6.0 * cycles**0.5)
        dwell = random.exponential(size=(pairs, 2)) * ((high, low) if starts_high else (low, high))
        changes = np.cumsum(dwell.reshape(-1))
        # frames before the run are as the first one
        passed = np.searchsorted(changes, np.maximum(context.frames, 0), side="right")
        return np.asarray(step * ((passed % 2 == 0) == starts_high))

    def added_exposure(
        self, frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps
    ) -> AddedExposure | None:
        """Return the levels above the lowest one, and the time spent there, of the pixels seen to blink.

        Each is fitted by itself, whatever the mean step of all: with up to two defects and their own steps.
        """
        from pchem_pipeline.model.law.telegraph import find_telegraph

        if self.fraction == 0 or self.step_e == 0:
            return None
        found: dict[tuple[int, int], tuple[FloatArray, FloatArray]] = {}
        good = maps.usable
        for y in np.flatnonzero(good.any(axis=1)):
            row = np.ascontiguousarray(frames[:, y].T)
            for x in np.flatnonzero(good[y]):
                telegraph = find_telegraph(row[x], numbers, np.array([values[y, x] for values in maps.maps]))
                if telegraph is not None:
                    found[int(y), int(x)] = telegraph
        # where most of them seem to blink, it is something else
        if not 0 < len(found) <= _FEW_PIXELS * good.size:
            return None
        levels = max(added.size for added, _ in found.values())
        exposure, weight = np.zeros((levels, *good.shape)), np.zeros((levels, *good.shape))
        weight[0] = 1.0
        for place, (added, share) in found.items():
            own = (slice(added.size), *place)
            exposure[own], weight[own] = added, share
        return AddedExposure(exposure, weight)

    def details(self) -> tuple[str, ...]:
        """Return the step and both dwell times: second moments tell only what they come to together."""
        return ("step_e", "dwell_low_frames", "dwell_high_frames") if self.step_e > 0.0 else ()
