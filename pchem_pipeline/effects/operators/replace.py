"""Replace samples by others, or by a function of others, after they were digitised."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from pchem_pipeline.base.settings import Section
from pchem_pipeline.base.wording import percent
from pchem_pipeline.effects.estimators.common_modes import Multiple, multiple_of
from pchem_pipeline.effects.framework.compose import in_place
from pchem_pipeline.effects.framework.context import DIMS, Dim
from pchem_pipeline.effects.framework.effect import (
    DEPTH,
    FEWEST_SHOWN,
    MOST_TOLD,
    Code,
    Count,
    Effect,
    Factors,
    Plane,
    Ratio,
    Replacement,
)
from pchem_pipeline.effects.framework.evidence import PLACES, CodeResiduals, PredictedSamples
from pchem_pipeline.effects.framework.neighbours import (
    PREDICTORS,
    Predictor,
    along_axis,
    neighbour_words,
    neighbours,
    predicted,
)
from pchem_pipeline.effects.framework.region import Span
from pchem_pipeline.effects.types import (
    AnyArray,
    BoolArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)
from pchem_pipeline.model.arithmetic.significance import CERTAIN, CLEAR

Fault = Literal["zero", "one", "flip"]
_FAULTS: tuple[Fault, ...] = ("zero", "one", "flip")
_MOST_BITS = 24
_FEWEST_PERIODS = 4  # of a bit, that codes must span for it to be stuck


class BitErrors(Effect, tag="bit_errors"):
    """In a share of the samples one bit of the digital number reads 0, or 1, or its opposite.

    A solder joint, a marginal set-up time of a parallel bus or a weak driver makes one line of the data path
    read 0 (or 1, or its opposite) at times; a broken one makes it read so always (stuck-at faults of digital
    circuits, Eldred 1959). The sample is then off by the weight of that bit, 2^b DN.

    Signature: counts per DN, summed over the pixels, deviate with a period of twice the bit's weight: codes
    with the bit on one side lose what those with it on the other side gain; samples lie below or above all
    that the pixel allows; nothing moves in time or between pixels.
    """

    plane = Plane.READOUT
    title = "stuck, missing or flipping bit"
    source = "Eldred 1959, J. ACM 6, 33 (stuck-at faults); Boone et al. 2018, PASP 130, 064504"
    factors = Factors("code", "each pixel", "in single samples")
    signature = (
        "code.smooth", "tail.low.count", "code.period16", "code.period8", "code.period4",
        "shape.goodness.mean",
    )  # fmt: skip
    strength = "share"
    rough_law = True
    separate: ClassVar[Mapping[str, str]] = {
        "adc_dnl": "a ramp of light: bit errors put samples far from the ramp, DNL does not",
        "heavy_tailed_noise": "a shifted bias: bit errors are fixed in DN, heavy tails shift with the peaks",
        "rts_noise": "a shifted bias: bit errors affect all pixels and are fixed in DN",
        "clipping": "a shifted bias: clipping affects one code, a bit error is periodic in DN",
    }
    #: bits of 4, 8 and 16 DN that are lost in one of a thousand samples, and one that flips
    typical_values = (
        *({"share": 1e-3, "bit": bit} for bit in (2, 3, 4)),
        {"share": 1e-3, "bit": 3, "fault": "flip"},
    )
    share: Ratio = Field(ge=0, le=1, description="share of the samples with an error, no unit")
    bit: Count = Field(ge=0, lt=_MOST_BITS, description="the bit, 0 is the least significant")
    fault: Fault = Field(default="zero", description="value in error: zero, one, or flip (the opposite)")

    def faulty(self, codes: AnyArray) -> AnyArray:
        """Return what comes out instead of codes, DN."""
        weight = codes.dtype.type(1 << self.bit)
        if self.fault == "flip":
            return np.asarray(codes ^ weight)
        return np.asarray(codes | weight if self.fault == "one" else codes & ~weight)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN; a bit that the ADC does not have is never wrong."""
        if self.bit >= context.bit_depth:
            return values.copy()
        wrong = context.random.uniform(("frame", "y", "x")) < self.share
        return np.asarray(np.where(wrong, self.faulty(values), values))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the bit that explains the counts per code best, with each fault that it may have.

        Bits are told from peaks by pixels of different bias, and not in single histograms.
        """
        code = evidence.code
        codes = code.first + np.arange(code.expected.size)
        if evidence.time is None or evidence.strongest(*cls.signature) < CLEAR:
            return ()
        broken = _never_seen(codes, code.observed)
        if broken is not None:
            return (cls(share=1.0, bit=broken[0], fault=broken[1]),)
        bits = range(min(int(codes[-1]).bit_length(), _MOST_BITS))
        faults = [cls(share=1.0, bit=bit, fault=fault) for bit in bits for fault in _FAULTS]
        seen = {fault: _moved(code, fault.faulty(codes)) for fault in faults}
        ordered = sorted(faults, key=lambda fault: -seen[fault].sigmas)
        return [
            fault.model_copy(update={"share": min(seen[fault].value, 1.0)})
            for fault in ordered
            if fault.bit == ordered[0].bit and seen[fault].sigmas > CERTAIN
        ]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with satellites at the weight of the bit, of the share that each pixel has there.

        Right in how many samples move, and how far; not in from which of a pixel's codes.
        """
        from pchem_pipeline.effects.estimators.codes import code_range
        from pchem_pipeline.model.law.mass import sample_mass

        first, last = code_range(maps)
        codes = np.arange(first, last + 1)
        mass = np.nan_to_num(sample_mass(SampleLaw(), maps, codes, smallest=1e-50))
        is_set = (codes >> self.bit & 1).astype(np.float64)
        # shares of each pixel's samples whose bit is 0 and goes up, or 1 and goes down
        up, down = (mass @ (1.0 - is_set)) * (self.fault != "zero"), (mass @ is_set) * (self.fault != "one")
        weight = float(1 << self.bit)
        weights = self.share * np.stack([down, up], axis=1)
        weights = np.concatenate([weights, 1.0 - weights.sum(axis=1, keepdims=True)], axis=1)
        return model.with_noise(weights, shift_dn=np.array([-weight, weight, 0.0]))


def _moved(code: CodeResiduals, to: IntArray) -> Multiple:
    """Return the share of the samples that come out as other codes, as the counts have it."""
    leaves = to != code.first + np.arange(to.size)
    at = to - code.first
    arrives = leaves & (at >= 0) & (at < to.size)
    change = np.where(leaves, -code.expected, 0.0)
    change += np.bincount(at[arrives], code.expected[arrives], to.size)
    return multiple_of(change, code.observed - code.expected, 1.0 / np.maximum(code.observed, 1.0))


def _never_seen(codes: IntArray, observed: FloatArray) -> tuple[int, Literal["zero", "one"]] | None:
    """Return the lowest bit that is the same in all samples although they span several of its periods."""
    used = codes[observed > 0]
    if not used.size:
        return None
    span, always, ever = int(used[-1] - used[0]), np.bitwise_and.reduce(used), np.bitwise_or.reduce(used)
    for bit in range(_MOST_BITS):
        if span < _FEWEST_PERIODS << (bit + 1):
            return None
        if not ever >> bit & 1:
            return bit, "zero"
        if always >> bit & 1:
            return bit, "one"
    return None


# longer runs of repeats are left out of the simulation if they are rarer than this
_RARE = 1e-12


class RepeatedFrames(Effect, tag="repeated_frames"):
    """Frame t, or a part of its rows, is frame t - 1 as it was delivered (which may itself be a repeat).

    A frame buffer that is read again before the next frame is in it, or a driver that fills a gap, hands out
    the frame before once more: every sample is the same. In analog data that never happens by chance, so a
    single case is proof (an equality test without false alarms).

    Signature: pairs of successive frames that are equal everywhere; then also correlations at lag 1, in
    charge and readout alike. A pixel's own histogram does not change, only fewer of its samples count.
    """

    plane = Plane.READOUT
    along = 2
    title = "repeated (duplicated) frames"
    source = "GenICam / GigE Vision frame identifiers; exact-equality test of successive frames"
    factors = Factors("code", "pixels of a frame", "in single frames")
    signature = ("frame.repeated", "frame.repeated_rows", "time.lag1.charge.mean", "time.lag1.readout.mean")
    strength = "probability"
    separate: ClassVar[Mapping[str, str]] = {
        "analog_memory": "successive frames: repeated ones are exactly equal, memory leaves differences",
        "flicker_noise": "successive frames: repeated ones are exactly equal, 1/f noise leaves differences",
    }
    typical_values = ({"probability": 1e-3},)
    probability: Ratio = Field(
        default=0.0, ge=0, le=0.5, description="probability that a frame repeats the one before, no unit"
    )
    frames: tuple[int, ...] = Field(
        default=(), max_length=1 << 20, description="numbers of further frames that repeat the one before"
    )
    rows: tuple[int, int] | None = Field(
        default=None, description="repeated rows: first and last + 1; null: all"
    )

    @field_validator("rows")
    @classmethod
    def _some_rows(cls, rows: tuple[int, int] | None) -> tuple[int, int] | None:
        if rows is not None and not 0 <= rows[0] < rows[1]:
            raise ValueError(f"repeated_frames: rows {list(rows)} hold none; give [first, last + 1]")
        return rows

    @field_validator("frames")
    @classmethod
    def _after_the_first(cls, frames: tuple[int, ...]) -> tuple[int, ...]:
        if any(frame < 1 for frame in frames):
            raise ValueError("repeated_frames: frame 0 is the first and repeats none; list frames from 1 on")
        return tuple(sorted(set(frames)))

    def history(self) -> int:
        """Return how long a run of repeats can get, frames."""
        random = math.ceil(math.log(_RARE) / math.log(self.probability)) if self.probability > 0 else 0
        breaks = np.flatnonzero(np.diff(self.frames) != 1) + 1
        return random + int(np.diff([0, *breaks, len(self.frames)]).max())

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN, with repeats in place of their frames."""
        frames = context.frames
        repeats = np.isin(frames, np.array(self.frames, np.int64))
        if self.probability > 0:
            repeats |= context.random.uniform(("frame",))[:, 0, 0] < self.probability
        # the first frame of the run has none before it
        repeats &= frames > 0
        index = np.arange(frames.size)
        source = np.maximum.accumulate(np.where(repeats, -1, index))
        # an original is looked for no further back than history reaches, so that it is the same one
        # whatever block is simulated; in a longer run of repeats the later ones are left as they are
        source = np.where((source < 0) | (index - source > self.history()), index, source)
        if self.rows is None:
            return np.asarray(values[source])
        chosen = np.flatnonzero((context.rows >= self.rows[0]) & (context.rows < self.rows[1]))
        result: AnyArray = values.copy()
        result[:, chosen] = values[source][:, chosen]
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the fraction of frames that equal the one before.

        The list of them would be that of one split only, and say nothing of the others. Where only rows are
        equal, a quarter of the rows stands for those that are: evidence has their number and not their place.
        """
        if evidence.time is None:
            return ()
        time, found = evidence.time, []
        pairs = max(int((np.diff(time.frames) == 1).sum()), 1)
        if time.repeated.size:
            found = [cls(probability=min(time.repeated.size / pairs, 0.5))]
        if time.repeated_rows:
            part = max(time.row_readout.shape[1] // 4, 1)
            found.append(cls(probability=min(time.repeated_rows / part / pairs, 0.5), rows=(0, part)))
        return found

    def representative(self, frames: IntArray) -> tuple[Self, float]:
        """Return repeats spread evenly over the frames, and how many more or fewer there are in the mean."""
        second = frames[1:][np.diff(frames) == 1]
        if self.frames or not self.probability * second.size > 0:
            return self, 1.0
        mean = self.probability * second.size
        shown = min(max(round(mean), FEWEST_SHOWN), second.size)
        places = (np.arange(shown) * second.size) // shown
        listed = tuple(int(frame) for frame in second[places])
        return type(self)(frames=listed, rows=self.rows), mean / shown


class RepeatedLines(Effect, tag="repeated_lines"):
    """In some frames a row, or a column, is the one before it, sample by sample.

    A line buffer that is read again before the next line is in it, or a lost line that a driver fills with
    the one before. In analog data two lines are never equal by chance, so a single case is proof.

    Signature: lines that equal the one before in the same frame; then also correlations of neighbours across
    the lines. A pixel's own histogram gets a share of its neighbour's samples, with that one's bias and
    gain, so it has no law of its own.
    """

    plane = Plane.READOUT
    along = 2
    title = "repeated rows or columns"
    source = "exact-equality test of neighbouring lines; GenICam / GigE Vision (packet resend)"
    factors = Factors("code", "pixels of a row or column", "in single frames")
    signature = ("space.repeated.rows", "space.repeated.columns")
    strength = "share"
    separate: ClassVar[Mapping[str, str]] = {
        "interpixel_capacitance": "neighbouring lines: repeated ones are exactly equal, coupled ones not",
        "repeated_frames": "neighbouring lines of a frame, not successive frames, are equal",
        "row_noise": "neighbouring lines: repeated ones are exactly equal, noisy ones not",
    }
    typical_values = ({"share": 1e-3}, {"share": 1e-3, "lines": "columns"})
    share: Ratio = Field(ge=0, le=0.5, description="probability that a line repeats the one before, no unit")
    lines: Literal["rows", "columns"] = Field(default="rows", description="which lines")

    def halo(self) -> int:
        """Return 1 for rows: the one above."""
        return 1 if self.lines == "rows" else 0

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN, with repeats; the first line has none before it."""
        axis, along = (1, "row") if self.lines == "rows" else (2, "column")
        repeats = context.random.uniform(DIMS[along]) < self.share
        return along_axis(values, np.where(repeats, -1, 0), axis)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the share of lines that equal the one before."""
        if evidence.time is None:
            return ()
        found: list[Self] = []
        rows, columns = evidence.maps.usable.shape
        for lines, pairs in (("rows", rows - 1), ("columns", columns - 1)):
            # in a sensor of one pixel's width or height lines are equal by chance
            if f"space.repeated.{lines}" in evidence.z and evidence.time.repeated_lines.get(lines, 0):
                share = evidence.time.repeated_lines[lines] / (pairs * evidence.n_frames)
                found.append(cls.model_validate({"share": min(share, 0.5), "lines": lines}))
        return sorted(found, key=lambda one: -one.share)

    def representative(self, frames: IntArray) -> tuple[Self, float]:
        """Return rare repeats more often than they are, and how much rarer they are."""
        return self._shown_at_least("share", FEWEST_SHOWN / max(frames.size, 1), 0.5)


Move = Literal["swapped", "early", "late", "sample_lost", "sample_twice", "line_lost", "line_twice"]

_Y, _X = 1, 2  # axes
_DIMS: Mapping[int, Dim] = {_Y: "y", _X: "x"}
_WHERE = 1  # draw of the sample or line from which on others follow
# of the shares of lines from the line after and before, by which two that are alike differ at most
_ALIKE = 2.0
# share of the lines that moves make, of those they can make, by which a guess is worth a try
_WORTH = 0.1
_HIDDEN = 2.5  # lines there may be for each that is seen


class MisplacedLines(Effect, tag="misplaced_lines"):
    """In some frames a row, or a column, holds the samples of other pixels.

    Two lines that change places, a line that comes a sample early or late, a sample or a whole line that is
    lost or delivered twice so that all that follow move up or down: what a frame grabber makes of a lost
    clock, a cable of the end of a packet. Every sample is then a good one, of another pixel.

    Signature: samples of a line that are likelier by the histograms of the pixels beside it than by their
    own, all together; nothing where pixels are alike. A pixel's own histogram gets a share of its
    neighbour's samples, with that one's bias and gain, so it has no law of its own.
    """

    plane = Plane.READOUT
    along = 2
    title = "misplaced rows or columns"
    source = "GenICam / GigE Vision (packet resend); likelihood ratio of lines at other places"
    factors = Factors("code", "pixels of a row or column", "in single frames")
    signature = ("space.misplaced.rows", "space.misplaced.columns")
    strength = "share"
    reach_rows = 2  # whether a row changes places with the next depends on the two before
    separate: ClassVar[Mapping[str, str]] = {
        "repeated_lines": "neighbouring lines: repeated lines are equal, misplaced ones are not",
        "interpixel_capacitance": "whole lines: capacitance changes all slightly, misplacement single ones",
    }
    typical_values = (
        {"share": 1e-2},
        {"share": 1e-2, "move": "late"},
        {"share": 1e-2, "move": "sample_lost"},
    )
    share: Ratio = Field(
        ge=0,
        le=0.5,
        description="probability per line, no unit; of a line lost or delivered twice: per frame",
    )
    move: Move = Field(
        default="swapped",
        description="swapped: with the next line; early, late: by one sample; sample_lost, sample_twice: "
        "the same from a random sample of the line on; line_lost, line_twice: all lines from a random one on "
        "hold those after or before them",
    )
    lines: Literal["rows", "columns"] = Field(default="rows", description="which lines")

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN; at the end of a line the last sample is repeated."""
        across, along = (_Y, _X) if self.lines == "rows" else (_X, _Y)
        if self.move == "swapped":
            return along_axis(values, self._exchanged(context, across), across)
        of_lines = self.move in ("line_lost", "line_twice")
        axis = across if of_lines else along
        drawn: tuple[Dim, ...] = ("frame",) if of_lines else ("frame", _DIMS[across])
        hit = context.random.uniform(drawn) < self.share
        if self.move not in ("early", "late"):
            size, place = _places(context, axis)
            hit = hit & (place >= np.floor(context.random.uniform(drawn, _WHERE) * size))
        later = self.move in ("early", "sample_lost", "line_lost")
        return along_axis(values, np.where(hit, 1 if later else -1, 0), axis)

    def _exchanged(self, context: EffectContext, across: int) -> IntArray:
        """Return from how many lines later each line comes; of overlapping pairs the first one counts."""
        size, place = _places(context, across)
        hit = (context.random.uniform(("frame", _DIMS[across])) < self.share) & (place < size - 1)
        first = hit & ~_before(hit, across)
        return np.where(first, 1, np.where(_before(first, across), -1, 0))

    def displaced(self) -> Mapping[Literal["rows", "columns"], FloatArray]:
        """Return the shares of lines that hold the samples of other pixels."""
        some = self.share / 2.0  # of the lines of a frame those after a random one
        found = {
            "swapped": {"next": self.share, "before": self.share},
            "early": {"early": self.share},
            "late": {"late": self.share},
            "sample_lost": {"lost": self.share},
            "sample_twice": {"twice": self.share},
            "line_lost": {"next": some},
            "line_twice": {"before": some},
        }[self.move]
        return {self.lines: np.array([found.get(place, 0.0) for place in PLACES])}

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the moves that leave lines where they are found, with the shares found there."""
        if evidence.time is None:
            return ()
        seen: list[tuple[float, Move, str]] = []
        for lines, shares in evidence.time.misplaced_lines.items():
            share = dict(zip(PLACES, (float(s) for s in shares), strict=True))
            after, before = share["next"], share["before"]
            guesses: dict[Move, float] = {"early": share["early"], "late": share["late"]}
            guesses |= {"sample_lost": share["lost"], "sample_twice": share["twice"]}
            if min(after, before) * _ALIKE > max(after, before):
                guesses["swapped"] = (after + before) / 2.0
            else:
                # from a random line on: half of them
                guesses["line_lost"], guesses["line_twice"] = 2.0 * after, 2.0 * before
            most = max(guesses.values())
            seen += [(guess, move, lines) for move, guess in guesses.items() if guess > _WORTH * most]
        # the histograms hold the misplaced samples, too, so that of many lines few are seen
        return [
            cls.model_validate({"share": min(times * guess, 0.5), "move": move, "lines": lines})
            for guess, move, lines in sorted(seen, key=lambda one: -one[0])
            for times in (1.0, _HIDDEN)
        ]


def _places(context: EffectContext, axis: int) -> tuple[int, IntArray]:
    """Return how many rows (columns) the sensor has, and which those here are, (1, y, 1) or (1, 1, x)."""
    if axis == _Y:
        return context.shape[0], context.rows[None, :, None]
    return context.shape[1], np.arange(context.shape[1])[None, None, :]


def _before(lines: BoolArray, axis: int) -> BoolArray:
    """Return for each line whether the one before it is marked; the first one has none."""
    moved = np.roll(lines, 1, axis)
    moved[(slice(None),) * axis + (0,)] = False
    return moved


_NEARLY_ALL = 0.8  # share of the samples beyond which what some have is taken for all
_FEWEST = 20.0  # samples above the threshold by chance


class PixelCorrection(Effect, tag="pixel_correction"):
    """A sample that exceeds what its neighbours predict by more than a threshold becomes the prediction.

    Scientific cameras correct hot and blinking pixels in their firmware, often by default and without a word
    in the file: hot-pixel correction with levels (Hamamatsu ``HOTPIXELCORRECT_LEVEL``), dynamic filters of
    telegraph noise (Andor ``SpuriousNoiseFilter``), static maps of blemishes.

    Signature: samples equal what their neighbours predict more often than what those of the next frame do,
    and exceed it less often; the upper tail of a pixel is cut, the more so the darker its neighbours. A
    pixel's own histogram has no law of its own, since the cut is where the neighbours put it: the search
    learns the sensor by what those predict (:meth:`replacement`), and in a fit the pixels keep the parameters
    of their corrected samples.
    """

    plane = Plane.READOUT
    along = 1
    title = "in-camera pixel correction (hot pixels, spurious noise)"
    source = "Hamamatsu DCAM-API (HOTPIXELCORRECT_LEVEL); Andor SDK3 (SpuriousNoiseFilter)"
    factors = Factors("code", "each pixel", "with the codes of its neighbours")
    signature = ("space.predicted.equal", "space.predicted.above", "shape.C3.mean")
    strength = "share"
    reach_rows = 1
    separate: ClassVar[Mapping[str, str]] = {
        "row_noise": "camera corrections switched off: row noise stays",
        "frame_noise": "camera corrections switched off: frame noise stays",
        "optical_crosstalk": "camera corrections switched off: crosstalk stays",
        "clipping": "pixels of different bias: clipping is at one code, a correction at none",
    }
    typical_values = ({"threshold_dn": 60},)
    threshold_dn: Code = Field(
        ge=1, le=1 << 20, description="excess over the prediction from which samples are replaced, DN"
    )
    share: Ratio = Field(
        default=1.0, ge=0, le=1, description="share of those samples that are replaced, no unit"
    )
    predictor: Predictor = Field(
        default="median",
        description="median or mean: of the eight neighbours; row: mean of the left and the right one",
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN, corrected; those at the border stay as they are."""
        rule = self.replacement(values)
        replaced = (values - rule.value > rule.excess) & rule.inside
        if self.share < 1.0:
            replaced &= context.random.uniform(("frame", "y", "x")) < self.share
        return np.where(replaced, rule.value, values).astype(values.dtype)

    def replacement(self, frames: AnyArray) -> Replacement:
        """Return the rule: what the neighbours predict, inside the border."""
        value, inside = frames.astype(np.int32), np.zeros(frames.shape[1:], np.bool_)
        if min(inside.shape) >= 3:
            value[:, 1:-1, 1:-1] = predicted(frames, self.predictor)
            inside[1:-1, 1:-1] = True
        return Replacement(value, inside, self.threshold_dn, self.share)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the threshold above which samples are too few, and the share that is replaced.

        Of the kinds of prediction, the one that samples equal too often the most. Firmware replaces all or
        none: a share near 1 is also guessed to be 1, since replaced neighbours lower later predictions, and
        samples then exceed those that did not exceed the first ones.
        """
        if evidence.time is None:
            return ()
        kinds = evidence.time.predicted
        best = max(PREDICTORS, key=lambda kind: kinds[kind].equal_z if kind in kinds else 0.0)
        if best not in kinds or kinds[best].equal_z < CERTAIN:
            return ()
        found = _threshold(kinds[best])
        if found is None:
            return ()
        shares = (1.0, found[1]) if _NEARLY_ALL <= found[1] < 1.0 else (found[1],)
        return [cls(threshold_dn=found[0], share=share, predictor=best) for share in shares]


def _threshold(seen: PredictedSamples) -> tuple[int, float] | None:
    """Return the threshold, DN, that best explains the deficit above it, and the share replaced, or None."""
    own, (one, _, _) = seen.above, seen.above_chance
    with np.errstate(divide="ignore", invalid="ignore"):
        fall = np.where(own > 0, own * np.log(own / one), 0.0) - (own - one)
        z = (one - own) / np.sqrt(own + one / 3.0)
    fall = np.where((z > CLEAR) & (one >= _FEWEST) & (seen.thresholds > 0), fall, 0.0)
    place = int(fall.argmax())
    if fall[place] <= 0.0:
        return None
    share = _replaced_share(float(own[place]), seen.above_chance[:, place])
    return int(seen.thresholds[place]), share


def _replaced_share(own: float, moments: FloatArray) -> float:
    """Return the share s of replaced samples from how many are above their own and others' predictions.

    A sample x exceeds the prediction of a chance frame with probability q(x); ``moments`` are E[q], E[q^2]
    and E[q^3] times the number of samples. Of the samples before the correction, those that come out are
    ``1 - s q`` (in other places), so that ``(1 - s) E[q / (1 - s q)]`` of those exceed their own.
    """
    first, second, third = moments
    ratio = min(third / second, 1.0) if second > 0 else 0.0
    share = np.linspace(0.0, 1.0, 2001)
    series = first + share * second + share**2 * third / np.maximum(1.0 - share * ratio, 1e-9)
    expected = (1.0 - share) * series
    return float(share[np.abs(expected - own).argmin()])


#: What is moved together.
Together = Literal["sample", "row", "column", "frame"]


class MixtureShift(Section):
    """A change of a sample: by a number of DN, or towards a neighbour.

    Towards a neighbour: by ``shift_dn`` where that is given, else by ``part`` of the difference, rounded down
    to whole DN. The neighbour in an earlier frame is the sample that was delivered; those in the
    same frame are as they were before any move.
    """

    weight: float = Field(default=1.0, ge=0, description="relative frequency of this shift, no unit")
    shift_dn: int = Field(default=0, description="shift, DN")
    towards: tuple[int, int, int] | None = Field(
        default=None, description="neighbour to shift towards: frames, rows, columns from the sample"
    )
    part: float = Field(default=1.0, ge=0, le=1, description="share of the difference, no unit")
    within_dn: int | None = Field(
        default=None, ge=0, description="largest difference to the neighbour, DN; null: any"
    )

    @model_validator(mode="after")
    def _of_the_past(self) -> Self:
        if self.towards is not None and (self.towards[0] > 0 or not any(self.towards)):
            raise ValueError("towards: give another sample of this frame or an earlier one")
        if self.towards is not None and self.shift_dn < 0:
            raise ValueError("shift_dn: give 0 or more with towards")
        return self

    def of(self, own: IntArray, other: IntArray | None) -> IntArray:
        """Return samples moved, DN; ``other`` are their neighbours."""
        if other is None:
            return own + self.shift_dn
        difference = other - own
        if self.shift_dn:
            step = self.shift_dn * np.sign(difference)
        else:
            step = np.floor(self.part * difference).astype(np.int64)
        if self.within_dn is not None:
            step = np.where(abs(difference) <= self.within_dn, step, 0)
        return np.asarray(own + step)

    def describe(self) -> str:
        """Return it in words."""
        if self.towards is None:
            return f"by {self.shift_dn:+d} DN"
        near = "" if self.within_dn is None else f" where they differ by at most {self.within_dn} DN"
        if self.shift_dn:
            return f"by {self.shift_dn} DN towards {neighbour_words(self.towards)}{near}"
        if self.part == 1.0:
            return f"to the value of {neighbour_words(self.towards)}{near}"
        return f"by {self.part:.2g} of the difference towards {neighbour_words(self.towards)}{near}"


class Empirical(Effect, tag="empirical"):
    """A share of the samples is moved, by so many DN or towards a neighbour.

    Where no known effect explains the samples, their law can still be told: the law of a sample, given one
    that was read beside or before it, is that of the model, mixed with moves. A move by a fixed number of DN
    is the mixing law of a deconvolution, which maximum likelihood makes a few atoms of (Laird 1978; Lindsay
    1983); one towards a neighbour is an atom of the mixture transition distribution of Raftery (1985).
    Nothing is said about why.

    Signature: none of its own; it is measured where the data disagree with all that is known, and describes
    the samples without a name for what makes them so.
    """

    plane = Plane.READOUT
    along = 3
    title = "empirical shifts of samples"
    source = "Laird 1978, Lindsay 1983 (mixing laws); Raftery 1985 (mixture transitions)"
    strength = "share"
    empirical = True
    #: a hundredth of the samples 8 DN too low
    typical_values = ({"share": 0.01, "moves": (MixtureShift(shift_dn=-8),)},)
    share: Ratio = Field(ge=0, le=1, description="share of shifted samples, no unit")
    moves: tuple[MixtureShift, ...] = Field(min_length=1, max_length=16, description="kinds of shifts")
    together: Together = Field(
        default="sample", description="what is shifted together: single samples, rows, columns or frames"
    )
    squares: tuple[int, int] | None = Field(
        default=None,
        description="replace squares of 2 x 2 pixels by their mean, rounded down; parity of "
        "their first row and column (0 even, 1 odd); null: none",
    )

    @model_validator(mode="after")
    def _has_moves(self) -> Self:
        if not sum(move.weight for move in self.moves) > 0:
            raise ValueError("empirical: give at least one of moves a weight above 0")
        if self.squares and (self.together != "sample" or self.moves != (MixtureShift(),)):
            raise ValueError("empirical: squares are averaged, not shifted; give moves: [{}]")
        return self

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it as it acts on some rows and columns that are taken for a sensor of their own."""
        if not self.squares:
            return self
        squares = (self.squares[0] + rows[0]) % 2, (self.squares[1] + columns[0]) % 2
        return self.model_copy(update={"squares": squares})

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return as an effect on the sensor what was found in some of its rows and columns."""
        return self.to_window(rows, columns, shape)  # of two parities each is the other of the other

    def shares(self) -> FloatArray:
        """Return the share of the samples that each move has."""
        weight = np.array([move.weight for move in self.moves])
        return np.asarray(self.share * weight / weight.sum())

    def halo(self) -> int:
        """Return how far the neighbours lie across rows, px."""
        reach = max(abs(move.towards[1]) if move.towards else int(bool(self.squares)) for move in self.moves)
        return reach * (DEPTH if self.history() else 1)

    def history(self) -> int:
        """Return how many frames before it matter: those of the neighbours, and of theirs."""
        return DEPTH * max(-move.towards[0] if move.towards else 0 for move in self.moves)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN, with some samples moved."""
        drawn = context.random.uniform(DIMS[self.together])
        which = np.searchsorted(np.cumsum(self.shares()), drawn.ravel(), side="right").reshape(drawn.shape)
        own = values.astype(np.int64)
        if self.squares:
            rows, columns = context.rows % 2, np.arange(values.shape[2]) % 2
            first = (rows == self.squares[0])[:, None] & (columns == self.squares[1])
            return _averaged(own, (drawn < self.share) & first).astype(values.dtype)
        found = own
        # each pass follows the moves of earlier frames one frame further back
        for _ in range(DEPTH if self.history() else 1):
            before, found = found, own
            for number, move in enumerate(self.moves):
                here: BoolArray = which == number
                if not here.any():
                    continue
                other = None
                if move.towards is not None:
                    other, known = neighbours(before if move.towards[0] else own, move.towards)
                    here = here & known
                found = np.where(here, move.of(own, other), found)
        return found.clip(0, 2**context.bit_depth - 1).astype(values.dtype)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with satellites at the shifts: exact; what neighbours add to it is left out."""
        own = [
            (share, m.shift_dn) for share, m in zip(self.shares(), self.moves, strict=True) if not m.towards
        ]
        if not own:
            return model
        shares, shifts = np.array(own, np.float64).T
        weights = np.append(shares, max(1.0 - float(shares.sum()), 0.0))
        return model.with_noise(weights, shift_dn=np.append(shifts, 0.0))

    def describe(self) -> str:
        """Return what is known of it."""
        if self.squares:
            rows, columns = (("even", "odd")[parity] for parity in self.squares)
            return (
                f"{percent(self.share)} of the squares of 2 x 2 pixels{in_place(self)}, from {rows} rows "
                f"and {columns} columns on, equal the mean of their samples"
            )
        shares = self.shares()
        order = np.argsort(-shares)[:MOST_TOLD]
        parts = [f"{percent(shares[i])} {self.moves[i].describe()}" for i in order]
        how = f" {self.moves[0].describe()}" if len(self.moves) == 1 else f" ({', '.join(parts)})"
        return f"{percent(self.share)} of the {self.together}s{in_place(self)} are shifted{how}"


def _averaged(values: IntArray, chosen: BoolArray) -> IntArray:
    """Return frames (frame, y, x) whose squares from chosen pixels on are their mean; none overlap."""
    result = values.copy()
    corners = [
        (slice(y, values.shape[1] - 1 + y), slice(x, values.shape[2] - 1 + x)) for y in (0, 1) for x in (0, 1)
    ]
    mean = sum(values[:, y, x] for y, x in corners) // 4
    for y, x in corners:
        result[:, y, x] = np.where(chosen[:, :-1, :-1], mean, result[:, y, x])
    return result
