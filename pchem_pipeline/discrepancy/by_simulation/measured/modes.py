"""Empirical component: common variation of gain, light or read noise in frames, rows or columns.

To first order a common change of the offset, the gain, the light or the read noise moves the sum of the
samples' scores for it by their Fisher information. Where there is none such a sum is Gaussian, and its
variance is the information; the excess of its variance is the power of the change, and of several changes the
true one has the clearest excess (Rao 1948: the score test).
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.discrepancy.by_simulation.measured.mixture_shifts import share_of
from pchem_pipeline.discrepancy.by_simulation.measured.samples import (
    FARTHEST,
    Measurement,
    PartSamples,
    frames_apart,
)
from pchem_pipeline.effects.estimators.series import coherent_line
from pchem_pipeline.effects.framework.evidence import PixelMaps, Wave
from pchem_pipeline.effects.operators.empirical_noise import (
    Changed,
    Cycles,
    EmpiricalNoise,
    Lag,
    NoiseMode,
    Shared,
    root_mean_square,
)
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT, CERTAIN, DECISIVE, POSSIBLE
from pchem_pipeline.model.law.pcd import pcd_posterior

_CHANGED: tuple[Changed, ...] = ("offset", "gain", "light", "noise")
_CLEAR = 15.0  # nats
_NEARLY = 0.5  # of the nats of the clearest change: another one may be it as well
# of what there is to win, by which bursts must explain more than a Gaussian: scores are skewed
_OF_GAUSSIAN = 0.3
_REACH = 20.0  # widths of the highest peak from it, up to where scores are told apart
_CHUNK = 256  # frames at once
_MOST_BLOCKS, _SMALLEST_BLOCK = 8, 4  # along an axis; px
_SIZES = (0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0)  # relative changes in bursts
_BETWEEN = (0.7, 0.8, 0.9, 1.1, 1.2, 1.35)  # of the likeliest of them
_MOST_IN_BURSTS = 0.3
_WAVES: tuple[Changed, ...] = ("gain", "light")  # one of the offset is periodic pickup
_SAME_PHASE = 0.25  # cycles from end to end, below which all lines of a frame share a wave
#: Of the amplitude of a wave, from which on a model that makes one makes this.
MADE = 0.5
_MOST_OF_POWER = 0.5  # of the power of a change, for it to be a wave


class Sums(NamedTuple):
    """Sums of scores of frames, rows or columns for one kind of change.

    Attributes:
        sums: (frame, line).
        information: of each line, (line,).
        numbers: of the frames in the run, increasing, (frame,).
        blocks: of frames, the same by blocks of the sensor, (frame, y', x') and (y', x'); None: of lines.
    """

    sums: FloatArray
    information: FloatArray
    numbers: IntArray
    blocks: tuple[FloatArray, FloatArray] | None = None

    @property
    def ratio(self) -> float:
        """Their mean square in that by chance."""
        known = self.information > 0.0
        return float(np.mean(self.sums[:, known] ** 2 / self.information[known])) if known.any() else 1.0

    @property
    def number(self) -> int:
        """How many there are."""
        return len(self.sums) * int(np.count_nonzero(self.information))


def common_scores(samples: PartSamples) -> dict[tuple[Shared, Changed], Sums]:
    """Sum the scores of the samples over frames, rows and columns, for each kind of change."""
    inside, numbers = samples.inside & samples.maps.usable, samples.numbers
    found: dict[tuple[Shared, Changed], Sums] = {}
    pixels = np.flatnonzero(inside.ravel())
    if not pixels.size:
        return found
    scores, n = CodeScores.of(samples.frames, samples.maps, pixels), len(samples.frames)
    for kind, changed in enumerate(_CHANGED):
        gathered: list[tuple[FloatArray, ...]] = []
        mean, square = np.zeros(inside.shape), np.zeros(inside.shape)
        for begin in range(0, n, _CHUNK):
            some = slice(begin, min(begin + _CHUNK, n))
            u = np.zeros((some.stop - begin, *inside.shape))
            u[:, inside] = scores.of_samples(kind, some)
            gathered.append((u.sum(axis=(1, 2))[:, None], u.sum(axis=2), u.sum(axis=1), _in_blocks(u)))
            mean += u.sum(axis=0) / n
            square += np.einsum("tyx,tyx->yx", u, u) / n
        power = np.maximum(square - mean**2, 0.0)
        frame, row, column, block = (np.concatenate(parts) for parts in zip(*gathered, strict=True))
        blocks = block - _in_blocks(mean[None]), _in_blocks(power[None])[0]
        found["frame", changed] = Sums(frame - mean.sum(), power.sum(keepdims=True)[0], numbers, blocks)
        found["row", changed] = Sums(row - mean.sum(axis=1), power.sum(axis=1), numbers)
        found["column", changed] = Sums(column - mean.sum(axis=0), power.sum(axis=0), numbers)
    return found


class CodeScores(NamedTuple):
    """Codes (frame, n), DN, and their `score_tables` from the ``first`` code of each pixel on."""

    codes: NDArray[np.unsignedinteger]
    first: IntArray
    tables: FloatArray

    @classmethod
    def of(cls, frames: NDArray[np.unsignedinteger], maps: PixelMaps, pixels: IntArray) -> CodeScores:
        """Return those of pixels of frames (frame, y, x) under their parameters; ``pixels`` are positions."""
        codes = frames.reshape(len(frames), -1)[:, pixels]
        first = codes.min(axis=0).astype(np.int64)
        length = codes_within_reach(maps, pixels, first, codes.max(axis=0))
        return cls(codes, first, score_tables(maps, pixels, first, length))

    def of_samples(self, kind: int, some: slice = slice(None)) -> FloatArray:
        """Return the scores of samples of some frames for a kind of change, (frame, n)."""
        table = self.tables[kind]
        codes = np.minimum(self.codes[some] - self.first, table.shape[1] - 1)
        return np.asarray(table[np.arange(self.first.size), codes])


def _in_blocks(values: FloatArray) -> FloatArray:
    """Return sums over equal blocks of the sensor, (frame, y', x')."""
    for axis in (1, 2):
        size = values.shape[axis]
        number = min(_MOST_BLOCKS, max(size // _SMALLEST_BLOCK, 1))
        # as blocks are found from a position: floor(i n / size)
        starts = -(-np.arange(number) * size // number)
        values = np.add.reduceat(values, starts, axis=axis)
    return values


def codes_within_reach(maps: PixelMaps, pixels: IntArray, first: IntArray, last: IntArray) -> int:
    """Return how many codes from the first on, (n,), tables need, but not far above the highest peak."""
    exposure, gain, bias, sigma = (values.ravel()[pixels] for values in maps.maps)
    most = np.ceil(exposure.max() + 8.0 * np.sqrt(exposure.max()) + 4.0)
    reach = bias + most / gain + _REACH * sigma
    return max(int(np.ceil((np.minimum(last, reach) - first).max())), 0) + 1


def score_tables(maps: PixelMaps, pixels: IntArray, first: IntArray, length: int) -> FloatArray:
    """Return the scores of codes for changes of their law, shape (5, n, c).

    Of offset (1/DN), relative gain, light and read noise, and a in the variance ``H + a H^2`` of electrons.
    """
    exposure, gain, bias, sigma = (values.ravel()[pixels][:, None] for values in maps.maps)
    given = pcd_posterior(first[:, None] + np.arange(length), exposure, gain, bias, sigma)
    variance = sigma**2
    excess = given.kk - (2.0 * exposure + 1.0) * given.k + exposure**2
    offset, scale = given.e / variance, given.ke / gain / variance
    return np.stack([offset, scale, given.k - exposure, given.ee / variance - 1.0, 0.5 * excess])


def measured_mode(
    data: dict[tuple[Shared, Changed], Sums],
    model: dict[tuple[Shared, Changed], Sums],
    maps: PixelMaps,
    inside: BoolArray,
) -> Measurement | None:
    """Return the change of gain, light or noise beyond that of frames simulated with a model, if clear.

    ``inside``, (y, x), are the pixels of the sums.
    """
    found = [_Change.of(key, sums, model[key]) for key, sums in data.items()]
    found.sort(key=lambda one: -one.gain)
    if not found or found[0].gain <= _CLEAR:
        return None
    best = found[0]
    # a strong change has spoilt the fit of the pixels by which they are told apart
    effects = [
        one.effect(maps, inside, best.gain)
        for one in found
        if one.shared == best.shared and one.gain > max(_CLEAR, _NEARLY * best.gain)
    ]
    # of an offset that all lines have the covariance tells more
    told = [e for e in effects if e.modes[0].changes != "offset" or e.modes[0].burst is not None]
    return Measurement(told[0], best.gain, tuple(told[1:])) if told else None


class _Change(NamedTuple):
    """A common change of a kind.

    Attributes:
        shared, changed: who shares it, and what it changes.
        sums: of its scores, weighted by its shape.
        shape: over the sensor, in blocks; none: even.
        power: mean square of it, beyond a model's, no unit.
        gain: in log-likelihood of the sums, nats.
        wave: its cycles, and rms; None: it is noise for the most part.
    """

    shared: Shared
    changed: Changed
    sums: Sums
    shape: tuple[tuple[float, ...], ...]
    power: float
    gain: float
    wave: tuple[Cycles, float] | None

    @classmethod
    def of(cls, key: tuple[Shared, Changed], data: Sums, model: Sums) -> _Change:
        """Measure it in sums beyond those of frames simulated with a model."""
        sums, shape = _shaped(data)
        expected = max(model.ratio, 1.0)
        known = sums.information[sums.information > 0.0]
        power = (sums.ratio - expected) / float(np.mean(known)) if known.size else 0.0
        ratio = max(sums.ratio / expected, 1.0)
        gain = 0.5 * sums.number * (ratio - 1.0 - float(np.log(ratio)))
        line = _line(sums, power, model) if key[1] in _WAVES else None
        if line is None:
            return cls(*key, sums, shape, power, gain, None)
        along = round(line.per_row, 6)
        wave = round(line.per_frame or 0.0, 7), along * (key[0] == "row"), along * (key[0] == "column")
        gain = max(gain, line.excess)
        return cls(*key, sums, shape, power, gain, (wave, line.amplitude * root_mean_square(wave)))

    def effect(self, maps: PixelMaps, inside: BoolArray, gain: float) -> EmpiricalNoise:
        """Return it as an effect at its size, ``gain`` being that of the clearest, nats."""
        of_noise, signal = self.changed == "noise", 1.0  # of an offset the scores are by DN
        if self.changed != "offset":
            scale = maps.read_noise_dn if of_noise else maps.quanta_exposure / maps.conversion_gain
            signal = float(np.median(scale[inside & maps.usable]))
        mode = functools.partial(
            NoiseMode,
            of=self.shared,
            share=1.0,
            changes=self.changed,
            signal_dn=round(signal, 3),
            shape=self.shape,
        )
        if self.wave is not None:
            wave, rms = self.wave
            return EmpiricalNoise(noise_dn=rms * signal, modes=(mode(wave=wave),))
        sums = self.sums
        if of_noise:  # lines with bursts had their part in the noise of the pixels
            sums = sums._replace(sums=sums.sums - np.median(sums.sums, axis=0))
        burst, size = _bursts(sums, gain)
        if burst is None:
            lags, correlation = _correlation(self.sums, self.power)
            rms = float(np.sqrt(self.power))
            return EmpiricalNoise(noise_dn=rms * signal, modes=(mode(lags=lags, correlation=correlation),))
        if of_noise and size > 0.0:
            size = np.sqrt(1.0 + 2.0 * size) - 1.0  # the score of a variance goes with the square
        rms = abs(float(size)) * burst**0.5
        return EmpiricalNoise(noise_dn=rms * signal, modes=(mode(burst=burst, negative=size < 0.0),))


def _shaped(one: Sums) -> tuple[Sums, tuple[tuple[float, ...], ...]]:
    """Return sums of frames weighted by the shape of the change over the sensor, and that; none where even.

    The shape is the largest principal component of the sums of blocks (Karhunen 1947, Loeve 1948) where its
    power lies beyond chance (Marchenko and Pastur 1967).
    """
    if one.blocks is None or one.blocks[1].size < 2:
        return one, ()
    sums, information = (each.reshape(*each.shape[:-2], -1) for each in one.blocks)
    scale = np.sqrt(np.maximum(information, np.finfo(np.float64).tiny))
    in_noise = np.where(information > 0.0, sums / scale, 0.0)
    n = len(in_noise)
    powers, shapes = np.linalg.eigh(in_noise.T @ in_noise / n)
    power, shape = float(powers[-1]), shapes[:, -1]
    chance = (1.0 + np.sqrt(shape.size / n)) ** 2 - 1.0
    if power - max(one.ratio, 1.0) < chance + BEYOND_DOUBT * power * np.sqrt(2.0 / n):
        return one, ()
    error = np.sqrt(power / n) / (power - 1.0)
    shape = np.where((abs(shape) > POSSIBLE * error) & (information > 0.0), shape / scale, 0.0)
    # as strong in the mean as a change that is the same everywhere, and mostly positive
    shape *= np.sign(shape.sum()) / np.sqrt(float(information @ shape**2) / information.sum())
    blocks = tuple(tuple(np.round(row, 3).tolist()) for row in shape.reshape(one.blocks[1].shape))
    return Sums((sums @ shape)[:, None], np.array([information @ shape**2]), one.numbers), blocks


def _line(one: Sums, power: float, model: Sums) -> Wave | None:
    """Return the wave that a change is for the most part; none that a model makes or whole frames share."""
    line, known = _highest_line(one), int(np.count_nonzero(one.information))
    if line is None or (one.information.size > 1 and abs(line.per_row) * known < _SAME_PHASE):
        return None
    made = _highest_line(model)
    if made is not None and made.amplitude > MADE * line.amplitude:
        return None
    return line if 0.5 * line.amplitude**2 > _MOST_OF_POWER * power else None


def _highest_line(one: Sums) -> Wave | None:
    """Return the highest line of the changes that scores tell, over frames and lines."""
    known = one.information > 0.0
    means = np.where(known, one.sums / np.where(known, one.information, 1.0), np.nan)
    return coherent_line(means, one.numbers, int(one.numbers[-1]) + 1)


def _correlation(one: Sums, power: float) -> tuple[tuple[Lag, ...], tuple[float, ...]]:
    """Return the correlations of a change over frames that are clear."""
    scaled = one.sums / np.maximum(one.information, np.finfo(np.float64).tiny)
    lags: list[Lag] = []
    found: list[float] = []
    for step in range(1, FARTHEST + 1):
        first, later = frames_apart(one.numbers, step)
        if not first.size:
            continue
        products = (scaled[first] * scaled[later])[:, one.information > 0.0]
        value, error = float(products.mean()), float(products.std() / np.sqrt(products.size))
        if abs(value) > CERTAIN * error:
            lags.append((step, 0, 0))
            found.append(round(float(np.clip(value / power, -0.99, 0.99)), 4))
    return tuple(lags), tuple(found)


def _bursts(one: Sums, gaussian: float) -> tuple[float | None, float]:
    """Return the share of lines that have a change, and its relative size; None where all have some."""
    known = one.information > 0.0
    sums = one.sums[:, known].ravel()
    information = np.broadcast_to(one.information[known], one.sums[:, known].shape).ravel()
    # no more can be gained than a Gaussian of a change far beyond chance explains
    most = min(gaussian, 0.5 * one.number * float(np.log(max(one.ratio, 1.0))))
    found: list[tuple[float, float, float]] = []

    def try_sizes(sizes: Iterable[float]) -> None:
        for size in sizes:
            share, gain = share_of(size * sums - 0.5 * size**2 * information)
            if share < _MOST_IN_BURSTS:
                found.append((gain, share, size))

    try_sizes(sign * size for sign in (1.0, -1.0) for size in _SIZES)
    if found:
        nearest = max(found)[2]
        try_sizes(nearest * factor for factor in _BETWEEN)
    gain, share, size = max(found, default=(0.0, 0.0, 0.0))
    return (share, size) if gain > gaussian + _OF_GAUSSIAN * most + DECISIVE else (None, 0.0)
