"""Couple samples: the offset of one follows the charge, the level or the code of others."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator
from scipy import special

from pchem_pipeline.base.settings import Section
from pchem_pipeline.base.wording import first_few
from pchem_pipeline.effects.estimators.common_modes import responsivity
from pchem_pipeline.effects.framework.compose import in_place
from pchem_pipeline.effects.framework.context import ALL_ROWS
from pchem_pipeline.effects.framework.draws import OF_PIXEL
from pchem_pipeline.effects.framework.effect import Count, Dn, Effect, Electrons, Factors, Plane, Ratio
from pchem_pipeline.effects.framework.evidence import PreviousBits
from pchem_pipeline.effects.framework.neighbours import neighbour_words, neighbours
from pchem_pipeline.effects.framework.region import Region, Span
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, FloatArray, PixelMaps, SampleLaw
from pchem_pipeline.model.arithmetic.significance import CLEAR


class InterpixelCapacitance(Effect, tag="interpixel_capacitance"):
    """Coupling of the sense nodes of the four nearest neighbours, before the read noise.

    Sense nodes couple electrically, so charge in one raises the voltage of the next: ``v_i = K_i + a sum_j
    (K_j - K_i)`` over the four nearest neighbours (Moore, Ninkov and Forrest 2004; Donlon, Ninkov and Baum
    2018). Along rows and columns it may differ, as the wiring does. Unlike diffusion or crosstalk by light
    the coupling is noiseless and deterministic: no electron moves.

    Signature: the readout residual follows the charge of the neighbours, then residuals of neighbours follow
    each other; charge of neighbours hardly does. The step per electron shrinks by ``1 - 4 coupling``, which
    no histogram tells from a larger gain; the neighbours shift a pixel by ``4 coupling H``.
    """

    plane = Plane.ANALOG
    title = "interpixel capacitance (IPC)"
    source = "Moore, Ninkov and Forrest 2004; Donlon, Ninkov and Baum 2018"
    factors = Factors("offset", "each pixel", "with the charge of its neighbours")
    signature = ("space.x.rk", "space.y.rk", "space.x.rr", "space.y.rr", "space.x.kk", "space.y.kk")
    strength = "coupling"
    reach_rows = 1
    separate: ClassVar[Mapping[str, str]] = {
        "optical_crosstalk": "single hot pixels: crosstalk adds whole electrons to neighbours, "
        "capacitance shifts their peaks by a fraction of an electron",
        "row_noise": "distant pixels of a row: correlated by row noise, not by capacitance",
        "column_noise": "distant pixels of a column: correlated by column noise, not by capacitance",
    }
    #: as in a monolithic sensor
    typical_values = ({"coupling": 0.0016},)
    coupling: Ratio = Field(
        ge=0, le=0.2, description="share of a neighbour's charge added to a pixel (mean of four), no unit"
    )
    anisotropy: Ratio = Field(
        default=0.0,
        ge=-1,
        le=1,
        description="(coupling along x less that along y) / (sum of the two), no unit",
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with the charge of the neighbours that there are."""
        result: AnyArray = values.copy()
        if context.charge is None:
            return result
        charge = context.charge.astype(np.float64)
        down = charge[:, 1:] - charge[:, :-1]
        down *= self.coupling * (1.0 - self.anisotropy)
        result[:, :-1] += down
        result[:, 1:] -= down
        across = charge[:, :, 1:] - charge[:, :, :-1]
        across *= self.coupling * (1.0 + self.anisotropy)
        result[:, :, :-1] += across
        result[:, :, 1:] -= across
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return what is typical, as strong as the residual follows neighbours; anisotropic if that shows."""
        x, y = (max(evidence.z.get(f"space.{axis}.rk", 0.0), 0.0) for axis in "xy")
        found = super().estimate(evidence)
        if not abs(x - y) > CLEAR * 2.0**0.5:
            return found
        differing = {"anisotropy": (x - y) / (x + y)}
        return [*(one.model_copy(update=differing) for one in found), *found]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with a smaller step, and charge of neighbours as exposed as the pixel."""
        exposure = np.nan_to_num(maps.quanta_exposure)
        squares = 4.0 * self.coupling**2 * (1.0 + self.anisotropy**2)
        return model.with_levels(
            scale=1.0 - 4.0 * self.coupling, shift_e=4.0 * self.coupling * exposure
        ).with_variance(e2=squares * exposure)


class AnalogMemory(Effect, tag="analog_memory"):
    """Part of the charge of the frame before that a pixel shows again.

    A sense node that is not reset completely, or a sample capacitor that is charged too briefly, hands part
    of a signal to the next one: ``v_t = K_t + a K_{t-1}`` (incomplete reset, Janesick 2001; the same between
    successive pixels is the converter's memory, Boone et al. 2018). Pixels may differ in it, and it may
    saturate where the sample before was bright: ``a_i S (1 - exp(-K_{t-1} / S))``. It is the signal that
    stays, not charge in the pixel: charge that arrives late is still made of whole electrons, which frames
    of constant exposure cannot show.

    Signature: the readout residual follows the charge of the frame before; residuals of successive frames
    hardly do. The mean rises by ``memory H`` e- and the variance of the noise by ``memory^2 H``. Where
    pixels differ the squares of their correlations exceed what their mean makes of them.
    """

    plane = Plane.ANALOG
    title = "analog memory (incomplete reset)"
    source = "Janesick 2001 (incomplete reset); Boone et al. 2018 (memory of readout chains)"
    factors = Factors("offset", "each pixel", "with the charge of the frame before")
    signature = (
        "time.cross.readout_charge", "time.lag1.readout.mean", "time.lag1.charge.mean",
        "time.cross.readout_charge.chi",
    )  # fmt: skip
    strength = "memory"
    reach_frames = 1
    separate: ClassVar[Mapping[str, str]] = {
        "flicker_noise": "frames without exposure: 1/f noise remains, memory vanishes",
        "dark_current_rts": "dark frames after a bright one: memory fades within a frame, blinking stays",
        "repeated_frames": "frame counters: repeated frames are equal in every sample",
    }
    #: residue and overshoot, alike in all pixels and not
    typical_values = tuple(
        {"memory": memory, "spread": spread} for spread in (0.0, 1.0) for memory in (0.0024, -0.0024)
    )
    memory: Ratio = Field(
        ge=-0.5,
        le=0.5,
        description="share of the previous charge that is read again, mean of the pixels, no unit; "
        "negative: overshoot",
    )
    spread: Ratio = Field(
        default=0.0,
        ge=0,
        le=2,
        description="standard deviation of the logarithm of the memory between pixels; 0: uniform",
    )
    saturation_e: Electrons | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="previous charge at which the memory saturates, e-; none: proportional",
    )

    def details(self) -> tuple[str, ...]:
        """Return how much pixels differ, where they do."""
        return ("spread",) if self.spread > 0.0 else ()

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with that of the frame before.

        The first frame of the block has none before it (it is only the history of the others).
        """
        result: AnyArray = values.copy()
        if context.charge is None:
            return result
        left, memory = context.charge[:-1], np.asarray(self.memory)
        if self.saturation_e is not None:
            left = -self.saturation_e * np.expm1(-left / self.saturation_e)
        if self.spread > 0:
            normal = special.ndtri(context.random.uniform(("y", "x"), OF_PIXEL[0]))
            memory = self.memory * np.exp(self.spread * normal - self.spread**2 / 2.0)
        result[1:] += memory * left
        return result

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the mean of what is left of the frame before, and its variance."""
        exposure = np.nan_to_num(maps.quanta_exposure)
        mean, square = exposure, exposure * (1.0 + exposure)
        if self.saturation_e is not None:
            # E[exp(-n K / S)], the generating function of K
            once, twice = (np.exp(exposure * np.expm1(-n / self.saturation_e)) for n in (1.0, 2.0))
            mean, square = self.saturation_e * (1.0 - once), self.saturation_e**2 * (1.0 - 2.0 * once + twice)
        # the mean of a pixel's own memory is not told from its bias
        variance = (square - mean**2) * np.exp(self.spread**2)
        return model.with_levels(shift_e=self.memory * mean).with_variance(e2=self.memory**2 * variance)


_LEAST_GAIN = 16.0  # fall of chi2 that the best of 8 bits must bring: by chance once in 2,000 stacks
_MORE_GAIN = 25.0  # that of a further bit
_MOST_PEAKS = 3  # bits with levels of their own in the law; of the others the variance


class BinaryOffset(Effect, tag="binary_offset"):
    """Each bit that was 1 in the sample read before raises a sample by its offset, and each 0 lowers it.

    Currents of the output drivers, and charge left on the capacitors of a converter, depend on the code that
    it gave last: the next sample is off by an amount for each bit that was 1. Seen in 16 of 22 astronomical
    instruments, up to 4.5 DN, and it does not average away (Boone et al. 2018).

    Signature: samples follow single bits of the sample before them in the row, beyond its value; a pixel's
    own histogram only broadens, into two levels for each bit.
    """

    plane = Plane.ADC
    along = 2
    title = "binary offset (bit-dependent ADC memory)"
    source = "Boone et al. 2018, PASP 130, 064504"
    factors = Factors("offset", "each pixel", "with the code read before")
    signature = ("space.x.bits", "space.x.rk", "space.x.rr")
    strength = "offset_dn"
    separate: ClassVar[Mapping[str, str]] = {
        "interpixel_capacitance": "pixels above and below: ADC memory acts along the row only",
        "optical_crosstalk": "a bright spot: crosstalk depends on nearby charge, a binary offset on the code",
        "adc_dnl": "a dark neighbour: DNL stays, an offset by the previous code vanishes",
    }
    #: offsets by the lowest bits of 0.3 DN, and of the other sign
    typical_values = ({"offset_dn": 0.3}, {"offset_dn": -0.3}, {"offset_dn": 0.3, "bits": (0.0, 1.0)})
    offset_dn: Dn = Field(
        ge=-1e4, le=1e4, description="difference between a bit of 1 and of 0, in units of `bits`, DN"
    )
    bits: tuple[float, ...] = Field(
        default=(1.0,), max_length=24, description="relative offset of each bit, the least significant first"
    )

    @field_validator("bits")
    @classmethod
    def _some_bit(cls, bits: tuple[float, ...]) -> tuple[float, ...]:
        if not any(bits):
            raise ValueError("binary_offset: bits are all 0; give the relative offset of at least one")
        return bits

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal at the ADC (frame, y, x), DN; draws nothing.

        Column by column, since a sample's code has the offset in it; the first of a row has none.
        """
        top, result = 2**context.bit_depth - 1, values.copy()
        for x in range(1, values.shape[2]):
            before = np.clip(np.rint(result[:, :, x - 1]), 0, top).astype(np.int64)
            for bit, relative in enumerate(self.bits):
                if relative:
                    result[:, :, x] += self.offset_dn * relative * ((before >> bit & 1) - 0.5)
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the bits that samples follow: the best one, with every other that explains much more."""
        if evidence.time is None or evidence.time.previous_bits is None:
            return ()
        offsets = _pursued(evidence.time.previous_bits)
        if not offsets.any():
            return ()
        largest = offsets[np.abs(offsets).argmax()]
        relative = offsets / largest
        used = int(np.flatnonzero(relative)[-1]) + 1
        return (cls(offset_dn=float(largest), bits=tuple(np.round(relative[:used], 4).tolist())),)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with two levels for each bit, as likely each, and a normal law for the smallest."""
        order = sorted(self.bits, key=abs, reverse=True)
        for relative in order[:_MOST_PEAKS]:
            half = 0.5 * self.offset_dn * relative
            if half:
                model = model.with_noise([0.5, 0.5], shift_dn=[-half, half])
        rest = sum(relative**2 for relative in order[_MOST_PEAKS:])
        return model.with_variance(dn2=0.25 * self.offset_dn**2 * rest)


def _pursued(seen: PreviousBits) -> FloatArray:
    """Return the offset of each bit, DN: one bit after the other that lowers chi2 the most, all refitted."""
    offsets = np.zeros(seen.product.size)
    chosen: list[int] = []
    scale = seen.square / seen.variance
    while len(chosen) < offsets.size:
        left = (seen.product - seen.square @ offsets) / seen.variance
        free = np.diag(scale).copy()
        if chosen:
            part = scale[:, chosen]
            free -= np.einsum("ij,ji->i", part, np.linalg.solve(scale[np.ix_(chosen, chosen)], part.T))
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = np.where(free > 1e-3 * np.diag(scale), left**2 / free, 0.0)
        best = int(gain.argmax())
        if gain[best] < (_MORE_GAIN if chosen else _LEAST_GAIN):
            break
        chosen.append(best)
        offsets[chosen] = np.linalg.solve(
            scale[np.ix_(chosen, chosen)], (seen.product / seen.variance)[chosen]
        )
    return offsets


_LEAST_CLAMP_GAIN = 9.0  # nats: some 500 overlapping ranges are tried
_PRICE_OF_PLACE = 4.0  # nats that the choice of two ends brings by chance
# of an offset, the share that is taken from the lines: all of a large noise of frames would be too much where
# its response is not quite known
_SURE = 0.9
_MOST_LINES = 64  # groups of lines whose ranges are tried


class BlackClamp(Effect, tag="black_clamp"):
    """A part of what the clamp's pixels deviate in a frame, in the mean, is taken from all of its pixels.

    Cameras hold their black level by subtracting, frame by frame, what dark reference pixels or the frame
    itself show (EMCCD baseline clamp, black-level clamp of CMOS sensors). The mean of few pixels has noise,
    and where they collect charge it has their shot noise too: all pixels of the frame then move against them
    together.

    Signature: frame means of the readout residual scatter, against the charge of the clamp's pixels: where
    those got more, the frame is lower. Noise of frames is as common to the pixels, but follows no charge.
    """

    plane = Plane.ADC
    title = "frame-dependent black-level clamp"
    source = "Andor iXon manual (baseline clamp); Janesick 2001 (optically black pixels)"
    factors = Factors("offset", "pixels of a frame", "with the charge of the clamp's pixels")
    signature = (
        "frame.covariance", "frame.follows.line", "frame.readout.variance", "frame.charge.variance",
        "space.x.rk",
    )  # fmt: skip
    strength = "follow"
    reach_rows = ALL_ROWS  # the clamp may be anywhere
    may_be_at_bound = ("follow",)
    separate: ClassVar[Mapping[str, str]] = {
        "frame_noise": "clamp switched off: frame noise stays and is independent of charge",
        "exposure_flicker": "clamp switched off, or covered pixels: flicker is proportional to the light",
        "interpixel_capacitance": "distant pixels: a clamp couples the whole frame, capacitance neighbours",
    }
    #: clamps that take off a tenth of the mean of the frame, and of eight columns and rows
    typical_values = ({"follow": 0.1}, {"follow": 0.1, "columns": (0, 8)}, {"follow": 0.1, "rows": (0, 8)})
    follow: Ratio = Field(
        ge=0, le=1, description="share of the clamp's deviation that is subtracted, no unit; 1: all of it"
    )
    rows: Span | None = Field(default=None, description="rows of the clamp: first and last + 1; null: all")
    columns: Span | None = Field(
        default=None, description="columns of the clamp: first and last + 1; null: all"
    )
    pixels: Count | None = Field(
        default=None, ge=1, description="number of these pixels, for the read noise it adds; null: none"
    )

    @field_validator("rows", "columns")
    @classmethod
    def _some(cls, span: Span | None) -> Span | None:
        if span is not None and not 0 <= span[0] < span[1]:
            raise ValueError(f"black_clamp: {list(span)} holds no line; give [first, last + 1]")
        return span

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with what lies of its clamp in these rows and columns; without any it does nothing."""
        spans = [
            (max(first, low) - low, min(last, high) - low)
            for (first, last), (low, high) in zip(self._spans(shape), (rows, columns), strict=True)
        ]
        if any(first >= last for first, last in spans):
            return self.model_copy(update={"follow": 0.0, "rows": None, "columns": None})
        return self.model_copy(update={"rows": spans[0], "columns": spans[1]})

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with its rows and columns counted on the sensor."""
        size = (rows[1] - rows[0], columns[1] - columns[0])
        moved = [
            (first + low, last + low)
            for (first, last), (low, _) in zip(self._spans(size), (rows, columns), strict=True)
        ]
        kept = [None if span == (0, n) else span for span, n in zip(moved, shape, strict=True)]
        return self.model_copy(update={"rows": kept[0], "columns": kept[1]})

    def _spans(self, shape: tuple[int, int]) -> tuple[Span, Span]:
        return self.rows or (0, shape[0]), self.columns or (0, shape[1])

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal at the ADC (frame, y, x), DN, less what the clamp sees; draws nothing."""
        truth = context.truth
        usual = truth["bias"] + truth["quanta_exposure"] / truth["conversion_gain"]
        place = tuple(slice(*span) for span in self._spans(context.shape))
        if not usual[place].size:  # a sensor without these rows or columns
            return values.copy()
        deviation = (values[:, *place] - usual[place]).mean(axis=(1, 2), keepdims=True)
        return np.asarray(values - self.follow * deviation)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the rows, columns or the whole frame whose content the frames' offsets follow best.

        Nothing if a noise of frames explains them as well. With s the mean deviation of the clamp's pixels in
        a frame before the clamp, and f the part that is taken off, all samples move by ``-f s``, and the mean
        readout residual of the frame by alpha times that (alpha: `estimators/common_modes.py`). What lines
        show, less the offset of their frame, is theirs before the clamp, whatever else moves all pixels
        alike: so f is a regression on it.
        """
        if evidence.time is None or evidence.maps.usable.sum() < 2:
            return ()
        offset = evidence.time.frame_readout.astype(np.float64) / responsivity(evidence)
        offset = offset - offset.mean()
        seen = _SURE * offset
        best: tuple[Self, ...] = ()
        gain = _LEAST_CLAMP_GAIN
        for axis in (1, 0):
            content, count = _contents(evidence, axis)
            group = np.arange(count.size) // -(-count.size // _MOST_LINES)
            first = np.append(np.flatnonzero(np.diff(group, prepend=-1)), count.size)
            # sums of all lines before each, less the offset of the frame
            pixels = np.append(0.0, np.cumsum(count))[first]
            before = np.pad(np.cumsum(content, axis=1), ((0, 0), (1, 0)))[:, first] - seen[:, None] * pixels
            products, along = before.T @ before, before.T @ offset
            a, b = np.triu_indices(first.size, 1)
            square = np.maximum(products[a, a] + products[b, b] - 2.0 * products[a, b], 1e-12)
            against = np.maximum(along[a] - along[b], 0.0)
            share = np.minimum(against**2 / square / max(float(offset @ offset), 1e-300), 1.0 - 1e-9)
            gains = -0.5 * offset.size * np.log1p(-share)
            whole = pixels[b] - pixels[a] == pixels[-1]
            # a part of the frame only where it explains more than the frame
            gains[whole] += _PRICE_OF_PLACE
            place = int(gains.argmax())
            if gains[place] > gain:
                number, span = pixels[b] - pixels[a], (int(first[a[place]]), int(first[b[place]]))
                rows, columns = (span, None) if axis == 1 else (None, span)
                where = (None, None) if whole[place] else (rows, columns)
                follow = min(float(against[place] / square[place] * number[place]), 1.0)
                gain = float(gains[place])
                best = (cls(follow=follow, rows=where[0], columns=where[1], pixels=int(number[place])),)
        return best

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the variance of the clamp's mean, its pixels taken to be like these."""
        if self.pixels is None:
            return model
        variance = maps.read_noise_dn**2 + maps.quanta_exposure / maps.conversion_gain**2
        mean = float(np.nanmean(variance)) if np.isfinite(variance).any() else 0.0
        return model.with_variance(dn2=self.follow**2 * mean / self.pixels)


def _contents(evidence: Evidence, axis: int) -> tuple[FloatArray, FloatArray]:
    """Return how rows (axis 1) or columns (axis 0) deviate in each frame, sums in DN, and their pixels."""
    time, usable = evidence.time, evidence.maps.usable
    assert time is not None
    charge, readout = (
        (time.row_charge, time.row_readout) if axis == 1 else (time.column_charge, time.column_readout)
    )
    count = usable.sum(axis=axis).astype(np.float64)
    gain = np.where(usable, evidence.maps.conversion_gain, 0.0).sum(axis=axis) / np.maximum(count, 1.0)
    content = np.nan_to_num((readout + charge / np.where(gain > 0, gain, 1.0)) * count).astype(np.float64)
    return content - content.mean(axis=0), count


#: What a sample follows: another one, or each other one of a row, a column or a frame.
Source = Literal["sample", "row", "column", "frame"]
#: Along the rows the columns are counted from the other end, and along the columns the rows.
Axis = Literal["rows", "columns"]
AXES: dict[Axis, int] = {"rows": 2, "columns": 1}
ALONG: dict[Source, tuple[int, ...]] = {"sample": (), "row": (2,), "column": (1,), "frame": (1, 2)}
_FAR = 8.0  # standard deviations of the charge, and electrons, beyond which there is none


class ResponseTerm(Section):
    """A sample, or a row, column or frame of samples, that others follow."""

    of: Source = Field(default="sample", description="what is followed: a sample, or a row, column, frame")
    place: tuple[int, int, int] = Field(
        default=(0, 0, 0),
        description="distance from the sample that follows: frames, rows, columns; negative: earlier",
    )
    weight: float = Field(default=1.0, ge=-1, le=1, description="relative response, no unit")
    number: int = Field(default=1, ge=1, description="samples per row, column or frame, for the PCD")
    mirrored: tuple[Axis, ...] = Field(
        default=(), max_length=2, description="axes of a mirror image, from which the place is then counted"
    )
    above: float = Field(default=0.0, ge=0, description="only charge above this is followed, e-; 0: all")
    columns: tuple[int, int] | None = Field(
        default=None, description="columns that follow, first and last + 1; null: all"
    )

    @model_validator(mode="after")
    def _of_the_past(self) -> Self:
        if self.place[0] > 0 or any(self.place[axis] for axis in ALONG[self.of]):
            raise ValueError("place: give no later frame, and 0 along a row, column or frame")
        if self.of == "sample" and not any(self.place) and not self.mirrored:
            raise ValueError("place: a sample does not follow itself")
        if self.of != "sample" and (self.above or self.mirrored):
            raise ValueError("above and mirrored need of: sample")
        return self

    @property
    def source(self) -> int | None:
        """The column that a single one follows across rows or frames; None where it is told by distance."""
        if self.of != "sample" or self.mirrored or self.columns is None:
            return None
        if self.columns[1] - self.columns[0] > 1:
            return None
        return self.columns[0] + self.place[2] if any(self.place[:2]) and self.place[2] else None

    def describe(self) -> str:
        """Return in words what is followed."""
        if self.of == "sample":
            what = f"what exceeds {self.above:g} e- in " if self.above else ""
            if self.mirrored:
                beside = neighbour_words(self.place).removeprefix("the sample ").strip()
                along = " and ".join(self.mirrored)
                return f"{what}its mirror image along the {along}{f', {beside}' if beside else ''}"
            if self.source is not None:
                return f"{what}{neighbour_words((*self.place[:2], 0))} in column {self.source}"
            return f"{what}{neighbour_words(self.place)}"
        where = neighbour_words(self.place).removeprefix("the sample ").strip()
        what = f"each {'other ' if not any(self.place) else ''}sample of the {self.of}"
        return what + (f" {where}" if any(self.place) else "")

    def seen(self, charge: FloatArray, exposure: FloatArray) -> FloatArray:
        """Return the charge (frame, y, x) that samples follow, less its mean by the exposure (y, x), e-."""
        charge = np.maximum(charge - self.above, 0.0) - excess_moments(exposure, self.above)[0]
        axes = ALONG[self.of]
        sums = np.broadcast_to(charge.sum(axis=axes, keepdims=True), charge.shape) if axes else charge
        if not any(self.place) and not self.mirrored:
            return np.asarray(sums - charge)
        sums = np.flip(sums, tuple(AXES[each] for each in self.mirrored))
        found, known = neighbours(np.ascontiguousarray(sums), self.place)
        return np.where(known, found, 0.0)


def excess_moments(exposure: FloatArray, above: float) -> tuple[FloatArray, FloatArray]:
    """Return mean (e-) and variance (e-^2) of what Poisson counts have above a number; means of any shape."""
    if above == 0.0:
        return exposure, exposure
    largest = float(np.max(np.nan_to_num(exposure), initial=0.0))
    chance, mean, square = np.exp(-exposure), np.zeros(exposure.shape), np.zeros(exposure.shape)
    for k in range(1, math.ceil(largest + _FAR * largest**0.5 + _FAR)):
        chance = chance * exposure / k
        excess = max(k - above, 0.0)
        mean += excess * chance
        square += excess**2 * chance
    return mean, square - mean**2


class EmpiricalResponse(Effect, tag="empirical_response"):
    """Samples that follow the charge of others by parts that are measured.

    Whatever hands signal from one sample to another without noise of its own is, to first order, a linear
    response (Volterra 1930; Priestley 1981, transfer functions): so much of the charge of the sample at this
    distance, of each other sample of the row, of the frame before. Nothing is said about why.

    Signature: none of its own; it is measured where the data disagree with all that is known, and describes
    which samples follow which without a name for what makes them so.
    """

    plane = Plane.ANALOG
    title = "empirical response to the charge of other samples"
    source = "Volterra 1930, Priestley 1981 (linear responses)"
    strength = "response"
    empirical = True
    far_reaching = True
    #: a sample that follows the one read four before it
    typical_values = ({"response": 0.01, "terms": (ResponseTerm(place=(0, 0, -4)),)},)
    response: Ratio = Field(
        ge=0, le=1, description="share of the charge of another sample that is added, for weight 1, no unit"
    )
    terms: tuple[ResponseTerm, ...] = Field(
        min_length=1,
        max_length=32,
        description="what samples follow: `of` (sample, row, column, frame), `place`, relative `weight`",
    )

    def halo(self) -> int:
        """Return how far across rows samples follow others, px."""
        return max(
            ALL_ROWS if 1 in ALONG[term.of] or "columns" in term.mirrored else abs(term.place[1])
            for term in self.terms
        )

    def history(self) -> int:
        """Return how many frames before it matter."""
        return max(-term.place[0] for term in self.terms)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with parts of the charge of other samples about its mean."""
        charge = np.asarray(context.charge, np.float64)
        exposure = np.asarray(context.truth["quanta_exposure"], np.float64)
        found = np.array(values, np.float64)
        for term in self.terms:
            columns = slice(*term.columns) if term.columns else slice(None)
            found[..., columns] += self.response * term.weight * term.seen(charge, exposure)[..., columns]
        return found

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with the columns of its terms, and the places of mirror images, as a window has them."""
        return self._moved((rows, columns), shape, -1)

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with the columns of its terms, and places of mirror images, as the sensor has them."""
        return self._moved((rows, columns), shape, 1)

    def _moved(self, window: tuple[Span, Span], shape: tuple[int, int], way: int) -> Self:
        # of what is mirrored in the middle of the window the image in that of the sensor lies elsewhere
        middle = [size - first - end for size, (first, end) in zip(shape, window, strict=True)]
        by = way * window[1][0]
        last = shape[1] if way > 0 else window[1][1] - window[1][0]

        def moved(term: ResponseTerm) -> ResponseTerm:
            frames, *place = term.place
            for number, along in enumerate(("columns", "rows")):
                place[number] += way * middle[number] if along in term.mirrored else 0
            found = term.model_copy(update={"place": (frames, *place)})
            if term.columns is None:
                return found
            ends = tuple(min(max(edge + by, 0), last) for edge in term.columns)
            return found.model_copy(update={"columns": ends})

        return self.model_copy(update={"terms": tuple(moved(term) for term in self.terms)})

    def by_law(self, shape: tuple[int, int]) -> Sequence[Self]:
        """Return it in columns that follow by the same terms."""
        if all(term.columns is None for term in self.terms):
            return (self,)
        ends = {0, shape[1]}.union(*(term.columns for term in self.terms if term.columns))
        own = (self.region and self.region.columns) or ((0, shape[1]),)
        found = []
        for first, end in itertools.pairwise(sorted(end for end in ends if end <= shape[1])):
            terms = tuple(
                term.model_copy(update={"columns": None})
                for term in self.terms
                if term.columns is None or term.columns[0] <= first < term.columns[1]
            )
            columns = tuple((max(first, a), min(end, b)) for a, b in own if max(first, a) < min(end, b))
            if terms and columns:
                place = {} if self.region is None else self.region.numbers()
                region = Region.model_validate({**place, "columns": columns})
                found.append(self.model_copy(update={"terms": terms, "region": region}))
        return found

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the variance of what is followed, terms of some columns excepted (`by_law`)."""
        exposure = np.nan_to_num(maps.quanta_exposure)
        power: Any = sum(
            term.number * term.weight**2 * excess_moments(exposure, term.above)[1]
            for term in self.terms
            if term.columns is None
        )
        return model.with_variance(e2=self.response**2 * power)

    def describe(self) -> str:
        """Return what is known of it."""
        followed: dict[str, list[str]] = {}
        for term in sorted(self.terms, key=lambda term: -abs(term.weight)):
            only = f" in {Region(columns=(term.columns,)).describe()}" if term.columns else ""
            followed.setdefault(term.describe(), []).append(
                f"{100.0 * self.response * term.weight:+.2g} %{only}"
            )
        words = first_few(f"{first_few(parts)} of {what}" for what, parts in followed.items())
        return f"samples{in_place(self)} depend on the charge of other samples ({words})"
