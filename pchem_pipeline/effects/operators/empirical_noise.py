"""Modulate offset, gain, light or read noise by a stationary noise, a wave or bursts that are measured."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.base.settings import Section
from pchem_pipeline.base.wording import percent
from pchem_pipeline.effects.framework.compose import in_place
from pchem_pipeline.effects.framework.context import DIMS, Dim
from pchem_pipeline.effects.framework.effect import MOST_TOLD, Dn, Effect, Plane
from pchem_pipeline.effects.framework.region import Span
from pchem_pipeline.effects.operators.offsets import add_offset
from pchem_pipeline.effects.types import AnyArray, EffectContext, FloatArray, IntArray, PixelMaps, SampleLaw

#: A distance: frames, rows, columns.
Lag = tuple[int, int, int]
#: Of a wave: per frame, row, column.
Cycles = tuple[float, float, float]
Shared = Literal["sample", "row", "column", "frame"]
Changed = Literal["offset", "gain", "light", "noise"]
_POINTS = 8  # of the spectrum's grid along an axis, for each unit of the largest distance
_REACH = 3  # of the moving average along an axis, for each of them
_MOST_TAPS, _SMALLEST_TAP = 200, 0.01  # of the moving average; of the largest weight
_LINE: dict[Dim, str] = {"frame": "frame", "y": "row", "x": "column"}
_NODES, _NARROWEST = 5, 0.05  # of the law of noise of changing size; relative, to be a law
_CHANGED = {"gain": "gain", "light": "light", "noise": "read noise"}


def root_mean_square(wave: Cycles) -> float:
    """Return that of a sine of amplitude 1, by its cycles per frame, row and column."""
    return 1.0 if all(2.0 * cycles % 1.0 == 0.0 for cycles in wave) else 0.5**0.5


class NoiseMode(Section):
    """A stationary noise of which each sample, row, column or frame has one value.

    The correlation at a distance holds for the opposite one, too; at those that are not given it is 0.
    """

    of: Shared = Field(description="one value for each sample, row, column or frame")
    share: float = Field(ge=0, le=1, description="share of the noise power, no unit")
    lags: tuple[Lag, ...] = Field(default=(), max_length=64, description="distances: frames, rows, columns")
    correlation: tuple[float, ...] = Field(
        default=(), max_length=64, description="correlation at each distance, no unit"
    )
    changes: Changed = Field(
        default="offset", description="what it changes: offset, gain, light, or size of the read noise"
    )
    signal_dn: float = Field(
        default=1.0,
        gt=0,
        description="gain, light: mean signal above the bias at which noise_dn holds, DN; noise: read noise "
        "at which it holds, DN",
    )
    burst: float | None = Field(
        default=None,
        gt=0,
        lt=1,
        description="share of the samples, rows, columns or frames with the noise; null: all, Gaussian",
    )
    negative: bool = Field(default=False, description="burst: lowers the signal")
    shape: tuple[tuple[float, ...], ...] = Field(
        default=(),
        max_length=16,
        description="of a frame: relative size in equal blocks of the sensor, rows of blocks; empty: uniform",
    )
    profile: tuple[float, ...] = Field(
        default=(),
        max_length=32,
        description="relative size along a row or column, at evenly spaced points; empty: uniform",
    )
    extent: tuple[Span, Span] | None = Field(
        default=None, description="shape, profile: range of rows and of columns, ends excluded; null: all"
    )
    wave: Cycles | None = Field(
        default=None, description="cycles per frame, row and column of a sine; null: noise"
    )

    @model_validator(mode="after")
    def _of_its_axes(self) -> Self:
        if len(self.lags) != len(self.correlation):
            raise ValueError("lags and correlation differ in length; give one correlation per lag")
        fixed = [axis for axis, dim in enumerate(("frame", "y", "x")) if dim not in DIMS[self.of]]
        if any(not any(lag) or any(lag[axis] for axis in fixed) for lag in self.lags):
            raise ValueError(f"lags of a {self.of} are (frames, rows, columns), not all 0, and 0 within it")
        if self.profile and (
            self.of not in ("row", "column") or len(self.profile) < 2 or not any(self.profile)
        ):
            raise ValueError("profile: needs of: row or column, and two points or more, not all 0")
        if self.shape and (self.of != "frame" or len({len(row) for row in self.shape}) != 1):
            raise ValueError("shape: needs of: frame, and rows of equally many blocks")
        if self.extent is not None and any(first >= end for first, end in self.extent):
            raise ValueError("extent: each range needs a first below its end")
        if self.burst is not None and self.lags:
            raise ValueError("burst: bursts are uncorrelated; leave lags out")
        if self.wave is not None and (
            self.lags
            or self.burst is not None
            or max(map(abs, self.wave)) > 0.5
            or any(self.wave[axis] for axis in fixed)
        ):
            raise ValueError(f"wave: at most half a cycle, and 0 within a {self.of}; no lags, no burst")
        return self

    def describe(self, rms: float | None) -> str:
        """Return in words what varies by so many DN (None: that is said elsewhere), and who shares it."""
        own = self.of == "sample" and (self.lags or self.wave is not None)
        whole = "" if own else f"common to each {self.of}"
        order = np.argsort(-np.abs(self.correlation))[:MOST_TOLD]
        apart = [f"{self.correlation[i]:+.2g} over {_lag_words(self.lags[i])}" for i in order]
        more = f" and {len(self.lags) - MOST_TOLD} other distances" if len(self.lags) > MOST_TOLD else ""
        shared = f"correlation {', '.join(apart)}{more}" if apart else ""
        if self.profile:
            whole = f"with a profile along each {self.of} ({', '.join(f'{p:+.2g}' for p in self.profile)})"
        if self.shape:
            whole += f", strongest in {self.strongest()}"
        what = "" if rms is None else self._size_words(rms)
        if self.wave is not None:
            shared = self._wave_words(self.wave)
        burst = "" if self.burst is None else f"only in {percent(self.burst)} of the {self.of}s"
        return ", ".join(part for part in (what, whole, burst, shared) if part)

    def _size_words(self, rms: float) -> str:
        # of bursts their size, not that of all the time
        size = rms if self.burst is None else rms * (-1.0 if self.negative else 1.0) / np.sqrt(self.burst)
        if self.changes == "offset":
            return f"{size:.2g} DN"
        share, of = 100.0 * size / self.signal_dn, _CHANGED[self.changes]
        at = "" if self.changes == "noise" else "at a signal "
        form = ".2g" if abs(share) < 100.0 else ".0f"
        form = form if self.burst is None else f"+{form}"
        return f"{share:{form}} % of the {of}, {size:.2g} DN {at}of {self.signal_dn:.3g} DN"

    def _wave_words(self, wave: Cycles) -> str:
        lines = [(each, _LINE[dim]) for each, dim in zip(wave, _LINE, strict=True) if dim in DIMS[self.of]]
        if root_mean_square(wave) == 1.0 and any(wave):
            return f"alternating from {', from '.join(f'{one} to {one}' for each, one in lines if each)}"
        cycles = [f"{each:{'.4g' if one == 'frame' else '.3g'}} per {one}" for each, one in lines]
        return f"a sine of {' and '.join(cycles).replace(' per', ' cycles per', 1)}"

    def values(self, number: int, context: EffectContext) -> FloatArray:
        """Return its values, of mean square 1, in a shape that fits (frame, y, x)."""
        if self.wave is not None:
            return self._on_the_wave(self.wave, number, context)
        if self.burst is None:
            return _field(self, number, context)
        some = context.random.uniform(DIMS[self.of], number) < self.burst
        return np.asarray(some * (-1.0 if self.negative else 1.0) / np.sqrt(self.burst))

    def _on_the_wave(self, wave: Cycles, number: int, context: EffectContext) -> FloatArray:
        """Return a sine of any phase; at half a cycle (or none) each way there is one phase only."""
        rms = root_mean_square(wave)
        turns: Any = wave[0] * context.frames[:, None, None]
        places: dict[Dim, Any] = {"y": context.rows[:, None], "x": np.arange(context.shape[1])}
        for dim, cycles in zip(("y", "x"), wave[1:], strict=True):
            turns = turns + cycles * places[dim] if dim in DIMS[self.of] else turns
        phase = context.random.uniform((), number) if rms < 1.0 else 0.0
        return np.asarray(np.cos(2.0 * np.pi * (turns + phase)) / rms)

    def widths(self, rms: float) -> tuple[FloatArray, FloatArray]:
        """Return how often the read noise is so many times as large, where it changes by ``rms``."""
        if self.burst is not None:
            size = rms * (-1.0 if self.negative else 1.0) / np.sqrt(self.burst)
            return np.array([1.0 - self.burst, self.burst]), np.array([1.0, abs(1.0 + size)])
        nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
        return weights / weights.sum(), np.maximum(np.abs(1.0 + rms * nodes), _NARROWEST)

    def strongest(self) -> str:
        """Return in words where a change of a frame has more than half of its largest size."""
        blocks = np.abs(self.shape)
        found = []
        for axis, lines in enumerate(("rows", "columns")):
            some = np.flatnonzero((blocks > 0.5 * blocks.max()).any(axis=1 - axis))
            low, high = (edge / blocks.shape[axis] for edge in (some[0], some[-1] + 1))
            if self.extent is None:
                found.append(f"the {lines} from {100.0 * low:.0f} to {100.0 * high:.0f} %")
            else:
                first, end = self.extent[axis]
                first, last = (round(first + part * (end - first)) for part in (low, high))
                found.append(f"{lines} {first} to {last - 1}")
        return " and ".join(found)

    def relative(self, rows: IntArray, columns: IntArray, shape: tuple[int, int]) -> FloatArray:
        """Return the relative size in some rows and columns of a sensor, in a shape that fits (y, x).

        Its mean square is 1 where shape and profile reach; beyond there is none.
        """
        (top, bottom), (left, right) = self.extent or ((0, shape[0]), (0, shape[1]))
        if self.shape:
            return self.across((rows - top) / (bottom - top), (columns - left) / (right - left))
        if self.profile and self.of == "row":
            return self.along((columns - left) / max(right - left - 1, 1))
        if self.profile:
            return self.along((rows - top) / max(bottom - top - 1, 1))[:, None]
        return np.ones((1, 1))

    def across(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """Return the size at positions from 0 to 1 across the blocks, (y, x); none beyond."""
        blocks = np.asarray(self.shape)
        scaled = [p * size for p, size in zip((rows, columns), blocks.shape, strict=True)]
        y, x = (
            np.clip(p, 0, size - 1).astype(np.int64) for p, size in zip(scaled, blocks.shape, strict=True)
        )
        inside = [(p >= 0.0) & (p < size) for p, size in zip(scaled, blocks.shape, strict=True)]
        return np.asarray(blocks[y][:, x] * np.outer(*inside) / np.sqrt(np.mean(blocks**2)))

    def along(self, position: FloatArray) -> FloatArray:
        """Return the size at positions from 0, the first pixel of a line, to 1; none beyond."""
        points = np.linspace(0.0, 1.0, len(self.profile))
        fine = np.interp(np.linspace(0.0, 1.0, 1001), points, self.profile)
        found = np.interp(position, points, self.profile, left=0.0, right=0.0)
        return np.asarray(found / np.sqrt(np.mean(fine**2)))

    def reaching(self, extent: tuple[Span, Span], by: tuple[int, int], whole: tuple[int, int]) -> NoiseMode:
        """Return it on pixels whose row and column numbers are larger ``by`` so much, ``whole`` of them.

        ``extent``: rows and columns that it reaches over where it says nothing of that.
        """
        if not (self.shape or self.profile):
            return self
        (top, bottom), (left, right) = self.extent or extent
        found = (top + by[0], bottom + by[0]), (left + by[1], right + by[1])
        every = found == ((0, whole[0]), (0, whole[1]))
        return self.model_copy(update={"extent": None if every else found})


def _lag_words(lag: Lag) -> str:
    """Describe a distance, for example ``1 frame and 2 columns``."""
    parts = [
        f"{abs(n)} {noun}{'s' if abs(n) > 1 else ''}"
        for n, noun in zip(lag, ("frame", "row", "column"), strict=True)
        if n
    ]
    slanted = sum(n < 0 for n in lag) % 2 == 1
    return f"{' and '.join(parts)}{' on the other diagonal' if slanted and len(parts) > 1 else ''}"


class EmpiricalNoise(Effect, tag="empirical_noise"):
    """Noise with a measured correlation over frames, rows and columns, a wave, or bursts.

    Where no known effect explains how samples vary together, it can still be told: a stationary Gaussian
    noise is its covariance by distance in frames, rows and columns, and no more (Wold 1938; Priestley
    1981). It is drawn as a moving average of white noise whose weights are the Fourier transform of the
    root of the spectrum. A single line of the spectrum is drawn as a wave, what comes now and then as
    bursts. Nothing is said of why.

    Signature: none of its own; it is measured where the data disagree with all that is known, and describes
    how samples vary together without a name for what makes them so.
    """

    plane = Plane.ANALOG
    title = "empirical correlated noise"
    source = "Wold 1938, Priestley 1981 (a stationary process by its spectrum)"
    strength = "noise_dn"
    power = 2.0
    empirical = True
    noise_dn: Dn = Field(ge=0, le=1e6, description="standard deviation of all of it, DN")
    modes: tuple[NoiseMode, ...] = Field(
        min_length=1,
        max_length=4,
        description="its parts: `of` (what has a value of its own: sample, row, column or frame), `share` of "
        "the power, `lags` (frames, rows, columns) and the `correlation` at each; its `profile`",
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with the noise referred to the input."""
        total: Any = 0.0
        electrons: Any = 0.0
        for number, mode in enumerate(self.modes):
            field = self.share_of(mode) * mode.values(number, context)
            if mode.shape or mode.profile:
                field = field * mode.relative(context.rows, np.arange(values.shape[2]), context.shape)
            if mode.changes == "offset":
                total = total + field
            elif mode.changes == "gain":
                electrons = electrons + field / mode.signal_dn * np.asarray(context.charge)
            elif mode.changes == "noise":
                if context.read_noise is not None:
                    electrons = electrons + field / mode.signal_dn * context.read_noise
            else:
                electrons = electrons + _of_light(field / mode.signal_dn, number, context)
        return add_offset(values + electrons, total, context)

    def share_of(self, mode: NoiseMode) -> float:
        """Return the standard deviation of a mode, DN."""
        power = sum(each.share for each in self.modes)
        return self.noise_dn * (mode.share / power) ** 0.5 if power > 0.0 else 0.0

    @classmethod
    def typical(cls) -> Sequence[Self]:
        """Return noise that a sample shares with the next row's."""
        mode = NoiseMode(of="sample", share=1.0, lags=((0, 1, 0),), correlation=(0.4,))
        return (cls(noise_dn=0.5, modes=(mode,)),)

    @property
    def measured_parts(self) -> int:
        """How many modes there are."""
        return len(self.modes)

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with shapes and profiles that reach as far in a window."""
        whole, size = ((0, shape[0]), (0, shape[1])), (rows[1] - rows[0], columns[1] - columns[0])
        return self._with(each.reaching(whole, (-rows[0], -columns[0]), size) for each in self.modes)

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with shapes and profiles that reach over the window in which they were found."""
        window = (0, rows[1] - rows[0]), (0, columns[1] - columns[0])
        return self._with(each.reaching(window, (rows[0], columns[0]), shape) for each in self.modes)

    def _with(self, modes: Iterable[NoiseMode]) -> Self:
        return self.model_copy(update={"modes": tuple(modes)})

    def halo(self) -> int:
        """Return how far the moving averages reach across rows, px."""
        return max(_average(mode).reach[1] for mode in self.modes)

    def history(self) -> int:
        """Return twice how far they reach along time: they are as long before a frame as behind it."""
        return 2 * max(_average(mode).reach[0] for mode in self.modes)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with its variance, exact for a Gaussian offset; with a profile its mean.

        That of the light is left out: in a pixel's histogram it is nearly a variance of the electron number.
        """
        for mode in self.modes:
            power = self.share_of(mode) ** 2
            if mode.changes == "offset":
                model = model.with_variance(dn2=power)
            elif mode.changes == "gain":
                model = model.with_variance(per_electron2=power / mode.signal_dn**2)
            elif mode.changes == "noise":
                weights, widths = mode.widths(self.share_of(mode) / mode.signal_dn)
                model = model.with_noise(weights, width=widths)
        return model

    def describe(self) -> str:
        """Return what is known of it."""
        of_all = len(self.modes) == 1 and self.modes[0].changes == "offset" and self.modes[0].burst is None
        parts = "; ".join(mode.describe(None if of_all else self.share_of(mode)) for mode in self.modes)
        if all(mode.changes == "offset" for mode in self.modes):
            return f"samples share noise of {self.noise_dn:.2g} DN{in_place(self)} ({parts})"
        changed = dict.fromkeys(_CHANGED.get(mode.changes, "offset") for mode in self.modes)
        return f"samples share a variation of the {' and the '.join(changed)}{in_place(self)} ({parts})"


class _Average(NamedTuple):
    """Weights of a moving average by distance, their squares sum up to 1; the largest distance by axis."""

    taps: tuple[tuple[Lag, float], ...]
    reach: Lag


def spectrum(lags: Sequence[Lag], values: Sequence[float]) -> FloatArray:
    """Return ``2 sum_l values_l cos(w l)`` on a grid of frequencies w, the part of lag 0 left out.

    Of covariances or correlations at distances, of which each stands for its opposite, too.
    """
    farthest = np.abs(np.array(lags, np.int64).reshape(-1, 3)).max(axis=0, initial=0)
    sizes = [max(_POINTS * int(far), 1) for far in farthest]
    found = np.zeros(sizes)
    for lag, value in zip(lags, values, strict=True):
        for sign in (1, -1):
            found[tuple(sign * n % size for n, size in zip(lag, sizes, strict=True))] += value
    return np.asarray(np.fft.fftn(found).real)


@functools.lru_cache(maxsize=64)
def _average(mode: NoiseMode) -> _Average:
    """Return the moving average whose spectrum is nearest to that of a mode."""
    power = np.maximum(1.0 + spectrum(mode.lags, mode.correlation), 0.0)
    weights = np.fft.ifftn(np.sqrt(power)).real
    far = [_REACH * size // _POINTS if size > 1 else 0 for size in weights.shape]
    frames, rows, columns = (range(-n, n + 1) for n in far)
    taps = [((t, y, x), float(weights[t, y, x])) for t in frames for y in rows for x in columns]
    taps.sort(key=lambda tap: -abs(tap[1]))
    kept = [tap for tap in taps[:_MOST_TAPS] if abs(tap[1]) >= _SMALLEST_TAP * abs(taps[0][1])]
    norm = sum(weight**2 for _, weight in kept) ** 0.5
    t, y, x = np.abs([lag for lag, _ in kept]).max(axis=0).tolist()
    return _Average(tuple((lag, weight / norm) for lag, weight in kept), (t, y, x))


def _of_light(change: FloatArray, number: int, context: EffectContext) -> FloatArray:
    """Return the electrons that a relative change of the light brings or takes, (frame, y, x), e-."""
    more = context.random.poisson(np.maximum(change, 0.0) * context.exposure, number)
    if change.min() >= 0.0:
        return more.astype(np.float64)
    from scipy import stats  # takes half a second, and every command that knows of effects imports this

    drawn = context.random.uniform(("frame", "y", "x"), len(DIMS) + number)
    lost = stats.binom.ppf(drawn, context.charge, np.clip(-change, 0.0, 1.0))
    return np.asarray(more - np.nan_to_num(lost), np.float64)


def _field(mode: NoiseMode, number: int, context: EffectContext) -> FloatArray:
    """Return the values of a mode, of variance 1, in a shape that fits (frame, y, x)."""
    white = context.random.normal(DIMS[mode.of], number)
    average = _average(mode)
    if len(average.taps) == 1:
        return white
    found, power = np.zeros(white.shape), np.zeros((1, *white.shape[1:]))
    for lag, weight in average.taps:
        # later frames are not known: the average lags behind by its reach
        lag = (lag[0] - average.reach[0], lag[1], lag[2])
        there = tuple(slice(max(-n, 0), size - max(n, 0)) for n, size in zip(lag, white.shape, strict=True))
        here = tuple(slice(max(n, 0), size + min(n, 0)) for n, size in zip(lag, white.shape, strict=True))
        if all(s.start < s.stop for s in (*there, *here)):
            found[there] += weight * white[here]
            power[(slice(None), *there[1:])] += weight**2
    # at the borders of the sensor some of the white noise is missing
    return np.asarray(found / np.sqrt(np.maximum(power, np.finfo(np.float64).tiny)))
