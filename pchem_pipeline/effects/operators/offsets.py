"""Modulate the offset: one number, DN, that the samples of a frame, row, column, tap or part share."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.common_modes import (
    line_excess,
    mean_response,
    mean_variance,
    responsivity,
    successive,
)
from pchem_pipeline.effects.estimators.series import coherent_line, incoherent_line, likeliest_parts
from pchem_pipeline.effects.framework.context import DIMS
from pchem_pipeline.effects.framework.effect import (
    Count,
    Dn,
    Effect,
    Factors,
    PerFrame,
    Plane,
    Radians,
    SharedOffset,
    Turns,
)
from pchem_pipeline.effects.framework.region import Span
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
    TimeSeries,
)
from pchem_pipeline.model.arithmetic.significance import CLEAR, POSSIBLE

# below this ratio of the spread of an offset to the read noise its shape is lost: the fourth cumulant that
# a Gaussian of the same variance misses is 2e-4 of the squared variance, for the worst (two-valued) law
_NARROW = 0.1


class OffsetEffect(Effect):
    """Base of what adds an offset to the samples of many pixels.

    In DN, since the disturbance sits behind the pixels' gains. A subclass gives the offsets of a block of
    frames, and the values that they take in the run; by these a pixel's own histogram is smeared.
    """

    plane = Plane.ANALOG

    @abstractmethod
    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the offsets of a block of frames, DN, with shape (frame, y, x) or 1 along each of them."""

    def offset_values(self) -> FloatArray | None:
        """Return equally likely values of the offset, DN; None: Gaussian, of the strength's deviation."""
        return None

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with the offsets referred to the input."""
        return add_offset(values, self.offsets(context), context)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law of samples to which one of the values is added.

        Values that spread little against the read noise become a variance: one number costs the fit nothing,
        each further component costs as much as the first.
        """
        values = self.offset_values()
        if values is None:
            return model.with_variance(dn2=getattr(self, self.strength) ** 2)
        spread = float(values.std())
        noise = maps.read_noise_dn[np.isfinite(maps.read_noise_dn)]
        if not noise.size or spread < _NARROW * float(np.median(noise)):
            return model.with_variance(dn2=spread**2)
        return model.with_noise(np.full(values.size, 1.0 / values.size), shift_dn=values - values.mean())


def add_offset(values: AnyArray, offset_dn: ArrayLike, context: EffectContext) -> AnyArray:
    """Return the analog signal (frame, y, x), e-, with offsets in DN referred to the input."""
    return np.asarray(values + np.asarray(offset_dn) * context.truth["conversion_gain"])


def quantile_means(values: FloatArray) -> FloatArray:
    """Return the means of seven equal parts of the sorted values, stretched to their variance."""
    means = np.array([part.mean() for part in np.array_split(np.sort(values), min(7, values.size))])
    centre, spread = float(values.mean()), float(means.std())
    return np.asarray(centre + (means - means.mean()) * (values.std() / spread if spread > 0 else 1.0))


class SharedNoise(OffsetEffect):
    """Base of noise that the pixels of a frame, row or column share: an offset that is new in every frame.

    What is sampled once for many pixels shifts them all: ``x += n_t`` with ``n_t ~ N(0, s^2)``; the strength
    is s. A pixel's own histogram only broadens, to ``(sigma^2 + s^2)^(1/2)`` DN.
    """

    power = 2.0
    shared_by: ClassVar[Literal["frame", "row", "column"]]  # what has one offset

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return one offset for each frame, or for each row or column of a frame, DN."""
        return np.asarray(getattr(self, self.strength) * context.random.normal(DIMS[self.shared_by]))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the excess variance of the means of rows (columns) within their frames (moment estimate)."""
        if evidence.time is None:
            return ()
        rows = cls.shared_by == "row"
        means = evidence.time.row_readout if rows else evidence.time.column_readout
        excess, error = line_excess(means, mean_variance(evidence, axis=1 if rows else 0))
        if excess < POSSIBLE * error:
            return ()
        return (cls.model_validate({cls.strength: excess**0.5 / responsivity(evidence)}),)

    def shared_offset(self) -> SharedOffset:
        """Return its offset."""
        return SharedOffset(self.shared_by, getattr(self, self.strength) ** 2)


class RowNoise(SharedNoise, tag="row_noise"):
    """Random offset per row and frame: noise of a ramp, reference or supply while a row is read.

    A common design rule keeps it below a tenth of the read noise, because the eye finds stripes long before
    the pixel statistics do.

    Signature: the variance of the row means of the readout residual exceeds that of ``n_x`` independent
    pixels by ``row_noise_dn^2``; neighbours along x are correlated.
    """

    title = "row noise (row temporal noise)"
    source = "Gow et al. 2007, IEEE Trans. Electron Devices 54, 1321"
    factors = Factors("offset", "pixels of a row", "new in each frame")
    signature = ("space.row.readout.variance", "space.x.rr")
    strength = "row_noise_dn"
    shared_by = "row"
    separate: ClassVar[Mapping[str, str]] = {
        "read_order_noise": "distant pixels of a row: 1/f noise correlates them less than neighbours",
        "periodic_pickup": "spectrum of the row means within a frame: pickup is a line, row noise is flat",
        "interpixel_capacitance": "distant pixels of a row: row noise correlates them like neighbours",
        "frame_noise": "row means within a frame: frame noise is common to all",
    }
    typical_values = ({"row_noise_dn": 0.35},)
    row_noise_dn: Dn = Field(ge=0, le=1e6, description="standard deviation of the rows' offsets, DN")


class ColumnNoise(SharedNoise, tag="column_noise"):
    """Random offset per column and frame: what a column's reference or sampling capacitor picks up once.

    For sensors with one amplifier and ADC per column.

    Signature: the variance of the column means of the readout residual exceeds that of ``n_y`` independent
    pixels by ``column_noise_dn^2``; neighbours along y are correlated.
    """

    title = "column noise (column temporal noise)"
    source = "Gow et al. 2007, IEEE Trans. Electron Devices 54, 1321"
    factors = Factors("offset", "pixels of a column", "new in each frame")
    signature = ("space.column.readout.variance", "space.y.rr")
    strength = "column_noise_dn"
    shared_by = "column"
    separate: ClassVar[Mapping[str, str]] = {
        "interpixel_capacitance": "distant pixels of a column: column noise correlates them like neighbours",
        "frame_noise": "column means within a frame: frame noise is common to all",
        "row_noise": "row and column means within a frame: only column means scatter",
    }
    typical_values = ({"column_noise_dn": 0.32},)
    column_noise_dn: Dn = Field(ge=0, le=1e6, description="standard deviation of the columns' offsets, DN")


class FrameNoise(SharedNoise, tag="frame_noise"):
    """Random offset per frame: noise of a reference that is sampled once per frame.

    It remains of pedestal noise after a correction by rows, and is why overscan or optically black pixels are
    subtracted frame by frame (Janesick 2001; Rauscher 2015 draws such pedestals).

    Signature: frame means of the readout residual scatter more than ``n`` independent pixels do, by
    ``frame_noise_dn^2``, white from frame to frame; those of the charge do not.
    """

    title = "frame noise (frame-to-frame offset noise)"
    source = "Janesick 2001, Scientific Charge-Coupled Devices; Rauscher 2015, PASP 127, 1144"
    factors = Factors("offset", "pixels of a frame", "new in each frame")
    signature = ("frame.readout.variance", "frame.readout.largest", "space.x.rr", "space.y.rr")
    strength = "frame_noise_dn"
    shared_by = "frame"
    separate: ClassVar[Mapping[str, str]] = {
        "black_clamp": "clamp switched off: frame noise stays, offsets of the clamp vanish",
        "exposure_flicker": "frames without light, or at short exposure: flicker vanishes",
        "periodic_pickup": "spectrum of the frame means of a longer run: pickup is a line, noise is flat",
        "bias_drift": "a longer run: a drift grows with time, noise does not",
    }
    typical_values = ({"frame_noise_dn": 0.12},)
    frame_noise_dn: Dn = Field(ge=0, le=1e6, description="standard deviation of the frames' offsets, DN")

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the excess variance of successive frames, so that a slow drift does not count.

        Half the mean squared difference of successive frame means, even and odd frames centred apart, less
        what the noise of pixels, rows and columns gives.
        """
        time = evidence.time
        if time is None:
            return ()
        expected = float(mean_variance(evidence))
        for lines, axis in ((time.row_readout, 1), (time.column_readout, 0)):
            excess, error = line_excess(lines, mean_variance(evidence, axis))
            if excess > POSSIBLE * error:
                expected += excess / lines.shape[1]
        means = time.frame_readout.astype(np.float64)
        for chosen in (time.frames % 2 == 0, time.frames % 2 == 1):
            if chosen.any():
                means[chosen] -= means[chosen].mean()
        steps = np.diff(means)[successive(time.frames)]
        if steps.size < 8 or not expected > 0:
            return ()
        excess = float((steps**2).mean() / 2.0 - expected)
        # successive differences share a frame: their squares are correlated by 1/4
        error = expected * np.sqrt(3.0 / steps.size)
        if excess < POSSIBLE * error:
            return ()
        return (cls(frame_noise_dn=float(np.sqrt(excess)) / responsivity(evidence)),)


class ReadoutAlternation(OffsetEffect, tag="readout_alternation"):
    """Offset of alternating sign, the same in every pixel: ``+alternation_dn`` in frames 0, 2, 4, ...

    Two banks of capacitors or ADCs, or two frame buffers, that take turns leave ``x += (-1)^t d``. (Along
    columns or rows such banks leave a fixed pattern, which is part of the bias map.)

    Signature: the mean readout residual of even frames exceeds that of odd ones by ``2 alternation_dn``; lag
    1 is anticorrelated as much as lag 2 is correlated. A pixel's histogram becomes two copies that far apart.
    """

    title = "even-odd readout alternation (ping-pong offset)"
    source = "Black and Hodges 1980, IEEE J. Solid-State Circuits 15, 1022 (interleaved ADCs)"
    factors = Factors("offset", "pixels of a frame", "alternating")
    signature = ("frame.readout.alternating", "frame.readout.lag1")
    strength = "alternation_dn"
    separate: ClassVar[Mapping[str, str]] = {
        "periodic_pickup": "another frame rate: pickup leaves half the frame rate",
        "frame_noise": "spectrum of the frame means: alternation is a line at half the frame rate",
    }
    typical_values = ({"alternation_dn": 0.024}, {"alternation_dn": -0.024})
    alternation_dn: Dn = Field(
        ge=-1e6, le=1e6, description="offset of even frames, DN; odd frames: the opposite"
    )

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the offsets of the frames, DN; draws nothing."""
        sign = 1.0 - 2.0 * (context.frames % 2)
        return np.asarray((self.alternation_dn * sign)[:, None, None], np.float64)

    def offset_values(self) -> FloatArray:
        """Return the offsets of even and of odd frames, DN."""
        return self.alternation_dn * np.array([-1.0, 1.0])

    def shared_offset(self) -> SharedOffset:
        """Return the offset of a frame, either of two."""
        return SharedOffset("frame", self.alternation_dn**2)


class PeriodicPickup(OffsetEffect, tag="periodic_pickup"):
    """Sine along rows, columns and frames.

    Switching supplies, clocks and mains reach the video signal, ``x += a sin(2 pi (f_y y + f_x x + f_t t) +
    phi)``. The phase runs on from row to row and frame to frame, or is new in every frame if the frames are
    not evenly spaced. The herring-bone pattern of the STIS CCD (Jansen et al. 2003) is the classic.

    Signature: the spectrum of the row means (over frames and rows) of the readout residual has one line, and
    frame means have one where the phase does not advance along the rows; the charge has none. Where samples
    are read one after the other, only the spectrum over rows, columns and frames has it. A pixel's own
    histogram is smeared by the arcsine law of a sine at random phase.
    """

    title = "periodic pickup (pattern noise, EMI)"
    source = "Jansen et al. 2003, HST Calibration Workshop (herring-bone noise of the STIS CCD)"
    factors = Factors("offset", "a wave over the sensor", "periodic")
    signature = (
        "space.row.readout.line", "frame.readout.line", "space.column.readout.line",
        "space.sample.readout.line", "space.sample.readout.spectrum", "space.row.readout.variance",
    )  # fmt: skip
    strength = "amplitude_dn"
    power = 2.0
    may_be_at_bound = ("cycles_per_row", "cycles_per_frame", "cycles_per_column")
    separate: ClassVar[Mapping[str, str]] = {
        "row_noise": "spectrum of the row means within a frame: pickup is a line, row noise is flat",
        "frame_noise": "spectrum of the frame means: pickup is a line, frame noise is flat",
        "readout_alternation": "another frame rate: pickup leaves half the frame rate",
        "bias_drift": "a second run: pickup has another phase, a warm-up drift is repeated",
    }
    #: at 0.092 DN: along rows and frames, frames alone, at random phase, along columns
    typical_values = (
        {"amplitude_dn": 0.092, "cycles_per_row": 0.17, "cycles_per_frame": 0.23},
        {"amplitude_dn": 0.092, "cycles_per_frame": 0.23},
        {"amplitude_dn": 0.092, "cycles_per_row": 0.17, "random_phase": True},
        {"amplitude_dn": 0.092, "cycles_per_column": 0.17, "cycles_per_frame": 0.23},
    )
    amplitude_dn: Dn = Field(ge=0, le=1e6, description="amplitude of the sine, DN")
    cycles_per_row: Turns = Field(
        default=0.0, ge=-0.5, le=0.5, description="f_y: advance of the phase from row to row, cycles"
    )
    cycles_per_frame: Turns = Field(
        default=0.0, ge=-0.5, le=0.5, description="f_t: advance of the phase from frame to frame, cycles"
    )
    cycles_per_column: Turns = Field(
        default=0.0,
        ge=-0.5,
        le=0.5,
        description="f_x: advance of the phase from column to column, cycles; 0 with column-parallel readout",
    )
    phase: Radians = Field(default=0.0, ge=-100, le=100, description="phase at row, column and frame 0, rad")
    random_phase: bool = Field(default=False, description="true: random phase in every frame")

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the sine in a block of frames, DN."""
        turn = 2j * np.pi
        start = np.exp(turn * self.cycles_per_frame * context.frames + 1j * self.phase)[:, None, None]
        if self.random_phase:
            start = start * np.exp(turn * context.random.uniform(("frame",)))
        # a product of unit vectors: as exact as the sine of the sum, and no sine for every sample
        along = start * np.exp(turn * self.cycles_per_row * context.rows)[None, :, None]
        if self.cycles_per_column:
            along = along * np.exp(turn * self.cycles_per_column * np.arange(context.shape[1]))
        return np.asarray(self.amplitude_dn * along.imag)

    def offset_values(self) -> FloatArray:
        """Return values, DN, of a sine at random phase (arcsine law): Gauss-Chebyshev quadrature."""
        return np.asarray(self.amplitude_dn * np.cos((2.0 * np.arange(5) + 1.0) * np.pi / 10.0))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the highest lines of the periodograms of the row and the column means, and of all samples.

        Over frames and lines together (the phase runs on), and within frames (random phase). What alternates
        from row to row and column to column, or from frame to frame, is no pickup.
        """
        if evidence.time is None:
            return ()
        time, alpha = evidence.time, responsivity(evidence)
        found = [(wave, mean_response(evidence)) for wave in time.waves]
        for means in (time.row_readout, time.column_readout):
            line, loose = coherent_line(means, time.frames, time.n_run), incoherent_line(means)
            # a phase that runs on explains all that a random one would
            if line is not None and loose is not None and line.amplitude >= 0.7 * loose.amplitude:
                loose = None
            for wave in filter(None, (line, loose)):
                across = wave._replace(per_row=0.0, per_column=wave.per_row)
                found.append((wave if means is time.row_readout else across, alpha))
        kept: list[Self] = []
        for wave, response in sorted(found, key=lambda each: -each[0].excess):
            if wave.alternates:
                continue
            pickup = cls(
                amplitude_dn=wave.amplitude / response,
                cycles_per_row=wave.per_row,
                cycles_per_column=wave.per_column,
                cycles_per_frame=wave.per_frame or 0.0,
                phase=0.0 if wave.per_frame is None else wave.phase,
                random_phase=wave.per_frame is None,
            )
            # rows and columns both see a line along frames alone
            places = [(p.cycles_per_row, p.cycles_per_column, p.cycles_per_frame) for p in (pickup, *kept)]
            if not any(np.allclose(places[0], other, rtol=0.0, atol=1e-4) for other in places[1:]):
                kept.append(pickup)
        return kept[:4]

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with the phase at the first row and column of a window."""
        return self._begun(rows[0], columns[0])

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with the phase at the first row and column of the sensor."""
        return self._begun(-rows[0], -columns[0])

    def _begun(self, row: int, column: int) -> Self:
        turns = self.cycles_per_row * row + self.cycles_per_column * column
        phase = (self.phase + 2.0 * np.pi * turns) % (2.0 * np.pi)
        return self.model_copy(update={"phase": 0.0 if self.random_phase else float(phase)})

    def shared_offset(self) -> SharedOffset:
        """Return the wave: in other frames its phase is another one."""
        variance = self.amplitude_dn**2 / 2.0
        if self.cycles_per_row == 0.0 and self.cycles_per_column == 0.0:
            return SharedOffset("frame", variance)
        return SharedOffset("wave", variance, self.cycles_per_row, self.cycles_per_column)


# successive frames through which a record of noise goes on
_RECORD = 8


class ReadOrderNoise(OffsetEffect, tag="read_order_noise"):
    """Noise with a spectrum of ``1 / f`` along the samples of a tap, from one cycle per frame on.

    Where pixels leave the sensor one after the other through one amplifier (CCD, EMCCD, skipper) or few of
    them, the slow part of its noise is common to samples that follow each other: stripes along the rows that
    are soft at their ends. Each tap reads a block of columns, row by row, with noise of its own (Rauscher
    2015; Pyxel ``correlated_pink_noise_cmos``).

    Signature: row means of the readout residual scatter, those of adjacent rows alike, and neighbours along
    the row are correlated more than pixels far apart in it. A pixel's own histogram only broadens. The noise
    goes on from frame to frame, so that means of successive frames are a little alike.
    """

    title = "1/f noise along the readout"
    source = "Rauscher 2015, PASP 127, 1144 (correlated pink noise)"
    factors = Factors("offset", "pixels read one after the other", "new in each frame")
    signature = (
        "space.row.readout.lag1", "space.row.readout.variance", "space.x.rr", "space.y.rr",
        "space.row.readout.halves",
    )  # fmt: skip
    strength = "noise_dn"
    power = 2.0
    separate: ClassVar[Mapping[str, str]] = {
        "row_noise": "distant pixels of a row: 1/f noise correlates them less than neighbours",
        "frame_noise": "distant rows of a frame: 1/f noise does not correlate them",
        "interpixel_capacitance": "dark frames: amplifier noise stays, coupled charge vanishes",
        "periodic_pickup": "spectrum in readout order: pickup is a line, 1/f noise falls",
        "bias_jumps": "means of successive frames: a jump stays, those of 1/f noise are hardly alike",
    }
    typical_values = tuple({"noise_dn": 0.5, "taps": taps} for taps in (1, 4, 2, 8))
    noise_dn: Dn = Field(ge=0, le=1e6, description="standard deviation of the noise, DN")
    taps: Count = Field(
        default=1, ge=1, le=4096, description="column blocks read in parallel, with independent noise"
    )
    rows: Count | None = Field(
        default=None, ge=1, description="rows of the sensor where the frames have a part of them; null: all"
    )

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with as many taps as these columns have of its width, as a part of all rows."""
        taps = self._with_taps((columns[1] - columns[0]) / shape[1])
        return taps.model_copy(update={"rows": self.rows or shape[0]})

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with taps of the same width on all columns; one tap is one whatever the window."""
        whole = self.model_copy(update={"rows": None if self.rows == shape[0] else self.rows})
        return whole if self.taps == 1 else whole._with_taps(shape[1] / (columns[1] - columns[0]))

    def _with_taps(self, factor: float) -> Self:
        return self.model_copy(update={"taps": max(round(self.taps * factor), 1)})

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the noise of the taps in a block of frames, DN."""
        if self.noise_dn == 0:
            return np.zeros((1, 1, 1))
        rows, columns = context.shape
        taps = min(self.taps, columns)
        width = -(-columns // taps)
        amplitudes = pink_amplitudes(rows * width, _RECORD)
        noise = np.empty((context.frames.size, context.rows.size, columns))
        # waves longer than these rows, one by one: cycles over all rows, and shares of the variance
        whole = max(self.rows or rows, rows)
        cycles = np.arange(_RECORD, _RECORD * whole // rows) / _RECORD
        shares = 1.0 / (cycles * (0.5 + _RECORD * math.log(max(whole * width / 2.0, 1.0))))
        angles = math.tau * cycles * (np.arange(rows)[:, None] / whole + np.arange(_RECORD)[:, None, None])
        waves = np.concatenate([np.cos(angles), np.sin(angles)], axis=2) * np.sqrt(np.tile(shares, 2))
        rest = math.sqrt(max(1.0 - float(shares.sum()), 0.0))
        numbers = context.frames // _RECORD
        for number in np.unique(numbers):
            random = context.random.generator(frame=int(number))
            white = np.fft.rfft(random.standard_normal((taps, _RECORD * rows * width), np.float32))
            record = rest * np.fft.irfft(amplitudes * white, _RECORD * rows * width)
            series = record.reshape(taps, _RECORD, rows, width)
            series += np.moveaxis(waves @ random.standard_normal((2 * cycles.size, taps)), 2, 0)[..., None]
            some = np.flatnonzero(numbers == number)
            read = series[:, context.frames[some] % _RECORD][:, :, context.rows]
            noise[some] = read.transpose(1, 2, 0, 3).reshape(some.size, -1, taps * width)[:, :, :columns]
        noise *= self.noise_dn
        return noise

    def shared_offset(self) -> SharedOffset:
        """Return the noise of the taps."""
        return SharedOffset("readout", self.noise_dn**2, taps=self.taps)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return it with few taps, as strong as adjacent rows are alike: noise of rows makes none alike."""
        columns = evidence.maps.usable.shape[1]
        return [one for one in cls.typical_as_seen(evidence, cls.signature[0]) if columns % one.taps == 0]


def pink_amplitudes(n: int, record: int = 1) -> FloatArray:
    """Return factors that make white noise 1/f from one cycle in n samples on, of variance 1.

    They multiply the Fourier transform (``rfft``) of ``record`` times n samples, shape (frequency,).
    """
    cycles = np.arange(record * n // 2 + 1)
    amplitudes = np.where(cycles >= min(record, cycles[-1]), np.maximum(cycles, 1) ** -0.5, 0.0)
    weight = np.where((cycles == 0) | (2 * cycles == record * n), 1.0, 2.0)
    return np.asarray(amplitudes / np.sqrt((weight * amplitudes**2).sum() / (record * n)))


Path = tuple[tuple[int, float], ...]

# how the quadrants' means add up to those of the parts that jump together
Parts = Literal["quadrants", "top_bottom", "left_right"]
_PARTS: dict[Parts, FloatArray] = {
    "quadrants": np.eye(4),
    "top_bottom": np.array([[0.5, 0.5, 0.0, 0.0], [0.0, 0.0, 0.5, 0.5]]),
    "left_right": np.array([[0.5, 0.0, 0.5, 0.0], [0.0, 0.5, 0.0, 0.5]]),
}


class BiasJumps(OffsetEffect, tag="bias_jumps"):
    """Piecewise constant offset of each quadrant or half of the sensor, independent of the others.

    Each part, as if it had an amplifier of its own, sits on one of several levels and jumps to another, like
    the bias jumps of the CCDs of HST/WFPC2 (a tenth of a DN and more) and the "popcorn mesa" noise of HgCdTe
    arrays. An odd middle row or column belongs to the bottom or right.

    Signature: means of the readout residual wander in one quadrant and not in the others, in sudden steps;
    the charge does not. A pixel's own histogram becomes copies of itself at the levels.
    """

    title = "bias jumps (popcorn mesa noise)"
    source = "WFPC2 Data Handbook (STScI), bias jumps; Rauscher 2015, PASP 127, 1144"
    factors = Factors("offset", "a part of the sensor", "jumping")
    signature = (
        "frame.readout.quadrants", "frame.readout.slow", "frame.readout.lag1", "time.lag1.readout.mean",
    )  # fmt: skip
    random_realisation = True
    strength = "amplitude_dn"
    power = 2.0
    separate: ClassVar[Mapping[str, str]] = {
        "bias_drift": "means of the quadrants, frame by frame: a drift is slow and common to all",
        "flicker_noise": "means of the quadrants: 1/f noise of single pixels averages out",
        "rts_noise": "histograms of single pixels: RTS affects few, jumps a whole quadrant",
    }
    #: at 0.085 DN, with rare and with frequent jumps, and those of halves
    typical_values = (
        {"amplitude_dn": 0.085, "rate": 1e-3},
        {"amplitude_dn": 0.085, "rate": 1e-2},
        {"amplitude_dn": 0.085, "rate": 1e-2, "parts": "top_bottom"},
        {"amplitude_dn": 0.085, "rate": 1e-2, "parts": "left_right"},
    )
    amplitude_dn: Dn = Field(
        ge=0, le=1e6, description="distance between adjacent levels, DN; the scale of `path` if given"
    )
    rate: PerFrame = Field(default=1e-3, ge=0, le=0.5, description="jumps per frame of each part")
    levels: Count = Field(default=2, ge=2, le=64, description="number of evenly spaced levels")
    parts: Parts = Field(default="quadrants", description="parts of the sensor with separate outputs")
    path: tuple[Path, ...] = Field(
        default=(),
        description="the jumps as they were, instead of random ones: for each part (top left, top right, "
        "bottom left, bottom right; top, bottom; left, right) a list of [frame, level from that frame on "
        "in units of amplitude_dn]",
    )

    @model_validator(mode="after")
    def _path_for_each_part(self) -> Self:
        wanted = len(_PARTS[self.parts])
        if len(self.path) not in (0, wanted):
            raise ValueError(
                f"bias_jumps: path needs one list for each of {wanted} {self.parts}, got {len(self.path)}"
            )
        for part in self.path:
            if any(a[0] >= b[0] for a, b in pairwise(part)):
                raise ValueError("bias_jumps: frames of a path must increase; sort them")
        return self

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the offsets of the parts in a block of frames, DN."""
        below, right = {"quadrants": (2, 1), "top_bottom": (1, 0), "left_right": (0, 1)}[self.parts]
        rows, columns = (size // 2 for size in context.shape)
        part = below * (context.rows >= rows)[:, None] + right * (np.arange(context.shape[1]) >= columns)
        return np.asarray(self.amplitude_dn * self._levels(context)[:, part])

    def offset_values(self) -> FloatArray:
        """Return the levels, DN; of paths those of all parts, since the pixels' places are not known here."""
        even = np.asarray(np.arange(self.levels) - (self.levels - 1) / 2.0, np.float64)
        return self.amplitude_dn * quantile_means(_values(self.path) if self.path else even)

    def _levels(self, context: EffectContext) -> FloatArray:
        """Return the levels at the block's frames in units of ``amplitude_dn``, (frame, part)."""
        frames = context.frames.clip(0, context.n_frames - 1)
        found = np.zeros((frames.size, len(_PARTS[self.parts])))
        for part in range(found.shape[1]):
            if self.path:
                starts, levels = _level_steps(self.path[part], context.n_frames)
            else:
                starts, levels = self._drawn(context, part)
            if levels.size:
                found[:, part] = levels[np.searchsorted(starts[1:], frames, side="right")]
        return found

    def _drawn(self, context: EffectContext, part: int) -> tuple[IntArray, FloatArray]:
        """Return the frames at which random levels begin, the first being 0, and the levels."""
        generator = context.random.generator(draw=part)
        starts, first = [np.zeros(1, np.int64)], generator.integers(self.levels)
        size = int(self.rate * context.n_frames * 1.2) + 16
        while self.rate > 0 and starts[-1][-1] < context.n_frames:
            starts.append(starts[-1][-1] + np.cumsum(generator.geometric(self.rate, size)))
        frames = np.concatenate(starts)
        # a jump always goes to another level
        moves = generator.integers(1, self.levels, frames.size - 1)
        levels = (first + np.concatenate([[0], np.cumsum(moves)])) % self.levels
        return frames, np.asarray(levels - (self.levels - 1) / 2.0, np.float64)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return change points of the means of quadrants or halves, and random jumps of like size and rate.

        What is common to all is taken out first, so that neither a drift nor frame noise is taken for jumps.
        Jumps too many or too small to be told apart still leave a correlation in time: what is typical.
        """
        if evidence.time is None or evidence.time.frames.size < 16:
            return ()
        time = evidence.time
        means = time.quadrant_readout / responsivity(evidence)
        gaps = np.diff(time.frames, prepend=-1).astype(np.float64)
        parts, found = likeliest_parts(means, gaps, _PARTS)
        jumps = np.concatenate([np.diff(steps.levels) for steps in found])
        slow = evidence.strongest(*cls.signature[1:]) > CLEAR
        typical = cls.typical_as_seen(evidence, cls.signature[0]) if slow else []
        if not jumps.size:
            return typical
        size = float(np.sqrt((jumps**2).mean()))
        covered = len(found) * (int(time.frames[-1]) - int(time.frames[0]) + 1)
        rate = min(max(jumps.size / covered, 1e-6), 0.5)
        path = tuple(_as_path(time, steps.starts, steps.levels / size) for steps in found)
        as_seen = cls(amplitude_dn=size, rate=rate, parts=parts, path=path)
        faster = [one for one in typical if one.parts == parts and one.rate > rate]
        return [as_seen, as_seen.model_copy(update={"path": ()}), *faster]

    def shared_offset(self) -> SharedOffset:
        """Return that frames have one: at which level others are is not known."""
        return SharedOffset("frame", None)


def _level_steps(path: Path, n_frames: int) -> tuple[IntArray, FloatArray]:
    """Return the frames at which levels begin and the levels, zero on average over the run."""
    starts = np.array([frame for frame, _ in path], np.int64)
    levels = np.array([level for _, level in path], np.float64)
    if not levels.size:
        return starts, levels
    # the first level holds from the beginning of the run
    lasting = np.diff(np.concatenate([[0], starts[1:].clip(0, n_frames), [n_frames]]))
    return starts, levels - float((levels * lasting).sum() / n_frames)


def _values(paths: tuple[Path, ...]) -> FloatArray:
    """Return the levels that the paths go through, each as often as it lasts, zero on average."""
    # the length of the run is not known here: the last level is taken to last as long as the others do
    last = max((path[-1][0] for path in paths if path), default=0)
    end = last + max(1, last // max(1, max(len(path) for path in paths) - 1))
    found = [np.zeros(1)]
    for path in paths:
        starts, levels = _level_steps(path, end)
        if levels.size:
            lasting = np.diff(np.concatenate([[0], starts[1:], [end]]))
            found.append(np.repeat(levels, np.maximum(lasting * 512 // end, 1)))
    return np.concatenate(found)


def _as_path(time: TimeSeries, starts: IntArray, levels: FloatArray) -> Path:
    """Return levels with the frames at which they begin (the middle of a gap in time)."""
    cuts = starts[1:]
    begins = [int(time.frames[0]), *((time.frames[cuts - 1] + time.frames[cuts] + 1) // 2).tolist()]
    return tuple(zip(begins, np.round(levels, 6).tolist(), strict=True))
