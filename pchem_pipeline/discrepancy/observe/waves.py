"""Waves across rows and columns in the readout residuals: their spectrum over frames, rows and columns.

Means of rows and of columns show a wave that runs along one of them. Where samples are read one after the
other, what is picked up advances from sample to sample too, and leaves these means alone. Given the
histograms, frames without an effect are in random order, so that each power of the spectrum is nearly an
exponential number of mean 1, and their means over frames likewise (Fisher 1929).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from pchem_pipeline.base.arrays import BoolArray, CodeArray, Float32Array, IntArray
from pchem_pipeline.discrepancy.observe import laws as laws_of
from pchem_pipeline.discrepancy.observe.sums import FEWEST_FRAMES, FrameBlocks, Samples
from pchem_pipeline.discrepancy.observe.tables import PixelLaws
from pchem_pipeline.effects.framework.evidence import PixelMaps, Wave
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT, FALSE_ALARM
from pchem_pipeline.model.histogram.spectrum import FEWEST_LINES

_MOST_SAMPLES, _FRAMES_AT_ONCE = 1 << 22, 32
_ALL_OF_IT = 0.7  # of the amplitude of a wave at any phase, for one whose phase runs on
_ROUNDS, _STEPS = 8, 9
_NARROWER = 2.5  # from round to round
_AROUND = 7  # frequencies along rows and columns whose median is the noise of the one in their middle


@dataclass(frozen=True)
class Waves:
    """Waves across rows and columns that stand out, one whose phase runs on first; z of the spectrum."""

    found: tuple[Wave, ...]
    z: dict[str, float]

    @property
    def steady(self) -> Wave | None:
        """The one whose phase runs on from frame to frame."""
        return next((wave for wave in self.found if wave.per_frame is not None), None)


def waves_across(
    frames: CodeArray, numbers: IntArray, laws: PixelLaws, maps: PixelMaps, inside: BoolArray | None = None
) -> Waves:
    """Look for waves in the residuals of frames (frame, y, x), of pixels ``inside``, (y, x); None: all."""
    ny, nx = maps.usable.shape
    some = numbers - numbers[0] < max(_MOST_SAMPLES // maps.usable.size, 1)
    numbers = numbers[some]
    samples = Samples.by_laws(FrameBlocks.of(frames[: numbers.size]), laws, maps)
    samples = samples if inside is None else samples.without(~inside)
    pixels = int(np.count_nonzero(samples.usable))
    if numbers.size < FEWEST_FRAMES or min(ny, nx) < FEWEST_LINES or not pixels:
        return Waves((), {})
    u = np.concatenate([chunk for (chunk,) in samples.chunks((1,))])
    mean, ratio = _spectrum(u, numbers, pixels)
    z = {
        "space.sample.readout.line": laws_of.largest_power(ratio, 1),
        "space.sample.readout.spectrum": laws_of.largest_power(mean, numbers.size),
    }
    steady, loose = _steady(u, numbers, ratio), _loose(u, mean)
    if steady is not None and loose is not None and steady.amplitude > _ALL_OF_IT * loose.amplitude:
        loose = None
    return Waves(tuple(wave for wave in (steady, loose) if wave is not None), z)


def _spectrum(u: Float32Array, numbers: IntArray, pixels: int) -> tuple[Float32Array, Float32Array]:
    """Return powers over the noise's: the mean of the frames', (y, x), and along these, (frame, y, x)."""
    _, ny, nx = u.shape
    # spectra are larger than the frames: those of a few are made at a time
    over_time = np.zeros((int(numbers[-1] - numbers[0]) + 1, ny - 1, nx // 2), np.complex64)
    for first in range(0, len(u), _FRAMES_AT_ONCE):
        some = slice(first, first + _FRAMES_AT_ONCE)
        over_time[numbers[some] - numbers[0]] = fft.rfft2(u[some])[:, 1:, 1:]
    power = _squared(over_time)
    mean = _halved(power.sum(axis=0) / (pixels * numbers.size), nx)
    for row in range(ny - 1):
        power[:, row] = _squared(fft.fft(over_time[:, row], axis=0))
    del over_time
    power /= pixels * numbers.size
    for when in (0, len(power) // 2) if len(power) % 2 == 0 else (0,):
        power[when] = _halved(power[when], nx)
    for level in _levels(power):  # so that humps are no lines
        power /= level
    return mean, power


def _squared(values: NDArray[np.complex64]) -> Float32Array:
    """Return the squares of absolute values."""
    found = np.square(values.real)
    found += np.square(values.imag)
    return found


def _halved(power: Float32Array, columns: int) -> Float32Array:
    """Return powers with those of real waves halved: they have one phase, and twice the mean power."""
    power, rows = power.copy(), power.shape[0] + 1
    if rows % 2 == 0 and columns % 2 == 0:
        power[rows // 2 - 1, columns // 2 - 1] /= 2.0
    return power


def _levels(power: Float32Array) -> list[Float32Array]:
    """Return the noise power of each place and of each time, at least that of white noise."""
    series = power.reshape(len(power), -1)
    found = []
    for values, shape in ((series.T, (1, *power.shape[1:])), (series, (-1, 1, 1))):
        level = np.median(values, axis=1) / np.log(2.0)
        noise = np.where(level > 1.0 + BEYOND_DOUBT / np.sqrt(values.shape[1]), level, 1.0)
        found.append(noise.astype(np.float32).reshape(shape))
    return found


def _steady(u: Float32Array, numbers: IntArray, ratio: Float32Array) -> Wave | None:
    """Return the wave whose phase runs on from frame to frame, if one stands out."""
    place = np.unravel_index(int(ratio.argmax()), ratio.shape)
    excess = float(ratio[place]) - float(np.log(ratio.size))
    if excess < -np.log(FALSE_ALARM):
        return None
    sizes = ratio.shape[0], *u.shape[1:]
    # spectra along rows and columns begin behind the mean
    start = [(int(at) + (axis > 0)) / size for axis, (at, size) in enumerate(zip(place, sizes, strict=True))]
    places = {"t": numbers, "y": np.arange(u.shape[1]), "x": np.arange(u.shape[2])}
    cycles, sums = _climbed(u, places, start, sizes)
    best = complex(sums[0])
    amplitude = _waves_of_sine(cycles) * abs(best) / (_pixels(u) * len(u))
    return Wave(amplitude, cycles["t"], cycles["y"], cycles["x"], float(np.angle(best) + np.pi / 2.0), excess)


def _loose(u: Float32Array, mean: Float32Array) -> Wave | None:
    """Return the wave whose phase is new in every frame, if one stands out of the noise around it."""
    n, *shape = u.shape
    around = ndimage.median_filter(mean, _AROUND, mode="nearest")
    place = np.unravel_index(int((mean / around).argmax()), mean.shape)
    noise = float(around[place])
    sigma = (float(mean[place]) / noise - 1.0) * n**0.5
    excess = sigma**2 / 2.0 - float(np.log(mean.size))
    if sigma < 0.0 or excess < -np.log(FALSE_ALARM):
        return None
    start = [(int(at) + 1) / size for at, size in zip(place, shape, strict=True)]
    cycles, sums = _climbed(u, {"y": np.arange(shape[0]), "x": np.arange(shape[1])}, start, shape)
    power = float(np.mean(np.abs(sums) ** 2)) - noise * _pixels(u)
    amplitude = _waves_of_sine(cycles) * max(power, 0.0) ** 0.5 / _pixels(u)
    return Wave(amplitude, None, cycles["y"], cycles["x"], 0.0, excess)


def _waves_of_sine(cycles: Mapping[str, float]) -> float:
    """Return how many waves make up a sine: two, which are one where the phase is the same both ways."""
    return 1.0 if all(2.0 * each % 1.0 == 0.0 for each in cycles.values()) else 2.0


def _climbed(
    u: Float32Array, places: Mapping[str, IntArray], start: Sequence[float], sizes: Sequence[int]
) -> tuple[dict[str, float], NDArray[np.complexfloating]]:
    """Return the frequencies near a peak, each in turn by ever finer steps, and the sums of samples there.

    There is a sum for each place along an axis that is not in ``places``.
    """
    kept = "".join(letter for letter in "tyx" if letter not in places)
    steps = np.linspace(-1.0, 1.0, _STEPS)
    cycles = dict(zip(places, start, strict=True))
    size = {letter: _NARROWER / each for letter, each in zip(places, sizes, strict=True)}
    best: NDArray[np.complexfloating] = np.zeros(1, np.complex128)
    for _, letter in itertools.product(range(_ROUNDS), places):
        others = [each for each in places if each != letter]
        turned = [np.exp(-2j * np.pi * cycles[each] * places[each]).astype(np.complex64) for each in others]
        of = ",".join(("tyx", *others))
        along = np.einsum(f"{of}->{kept}{letter}", u, *turned, optimize=True)
        tried = cycles[letter] + size[letter] * steps
        sums = np.atleast_2d(along @ np.exp(-2j * np.pi * np.outer(places[letter], tried)))
        at = int((np.abs(sums) ** 2).sum(axis=0).argmax())
        cycles[letter], best = float(tried[at]), sums[:, at]
        size[letter] /= _NARROWER
    return {letter: (each + 0.5) % 1.0 - 0.5 for letter, each in cycles.items()}, best


def _pixels(u: Float32Array) -> float:
    """Return how many pixels have samples."""
    return max(float(np.count_nonzero(u.any(axis=0))), 1.0)
