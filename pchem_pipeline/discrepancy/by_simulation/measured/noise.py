"""Empirical component: correlated noise, from its covariance over frames, rows and columns.

The mean products of the readout residuals of pairs of samples are sorted by distance: near, far apart in one
row, in one column, and in both. Those of frames simulated with the model are subtracted; what is left beyond
chance is the covariance of a Gaussian noise. Its variance is known where whole rows, columns or frames share
it; that of single samples is read noise as well, so there it is the least with which the others are a
covariance. An offset may also run as a wave across rows, columns and frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from pchem_pipeline.base.arrays import BoolArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.discrepancy.by_simulation.measured.modes import MADE
from pchem_pipeline.discrepancy.by_simulation.measured.samples import (
    FARTHEST,
    Measurement,
    PartSamples,
    frames_apart,
)
from pchem_pipeline.discrepancy.observe.waves import Waves, waves_across
from pchem_pipeline.effects.estimators.common_modes import mean_response
from pchem_pipeline.effects.framework.evidence import Evidence
from pchem_pipeline.effects.operators.empirical_noise import (
    EmpiricalNoise,
    Lag,
    NoiseMode,
    Shared,
    root_mean_square,
    spectrum,
)
from pchem_pipeline.model.arithmetic.significance import CERTAIN, CLEAR

_SHARED: tuple[Shared, ...] = ("frame", "row", "column", "sample")
_LINES: tuple[Shared, ...] = ("row", "column")
_GROUPS = 60  # of frames, whose scatter tells the error
_MOST_LAGS = 64
# of the variance of single samples, over the least: a spectrum that vanishes needs a long moving average
_OVER_LEAST = 1.15
_FEWEST_POINTS, _MOST_POINTS = 3, 6  # of a shape along a line
_CLEAR_SHAPE = 8.0  # standard errors of a shape, the best of many
_BETTER = 1.1  # by which it must be clearer than the same value everywhere, in squares
_SHAPE_ERROR = 0.05  # relative, of what a shape makes of near samples: each column has its own response
_MOST = 0.9  # of the variance of the readout, that the noise may have


class Covariance(NamedTuple):
    """A mean product of residuals, each in its standard deviation, and its standard error."""

    value: float
    error: float


class Line(NamedTuple):
    """Mean products of residuals of two columns in a row (two rows in a column), and how many they are."""

    products: FloatArray
    counts: FloatArray


class Covariances(NamedTuple):
    """Mean products of residuals: by what shares one value and distance, and in lines by both places."""

    pairs: Mapping[tuple[Shared, Lag], Covariance]
    lines: Mapping[Shared, Line]


def residual_covariances(samples: PartSamples) -> Covariances:
    """Measure how the readout residuals of near and far samples vary together."""
    inside = samples.inside & samples.maps.usable
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return Covariances({}, {})
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    u = samples.scores(1, inside, *box)
    found: dict[tuple[Shared, Lag], Covariance] = {}
    for step in range(FARTHEST + 1):
        first, later = frames_apart(samples.numbers, step)
        if first.size >= 2 * _GROUPS:
            found |= _of_step(u[first], u[later], inside[box], step)
    whole = np.zeros((len(u), *inside.shape), np.float32)
    whole[(slice(None), *box)] = u
    turned = {"row": (whole, inside), "column": (whole.swapaxes(1, 2), inside.T)}
    # the shape of a line beyond the window is not known
    return Covariances(found, {of: _line(*turned[of]) for of in _LINES if of in samples.whole_lines})


def _line(u: Float32Array, inside: BoolArray) -> Line:
    """Return the mean products of two columns in the same row."""
    # a fast product needs the samples of a line side by side
    lines = (np.ascontiguousarray(block) for block in u.swapaxes(0, 1))
    products = sum(np.matmul(line.T, line) for line in lines)
    counts = len(u) * (inside.T.astype(np.float64) @ inside)
    return Line(np.asarray(products / np.maximum(counts, 1.0), np.float64), counts)


def _of_step(
    one: Float32Array, two: Float32Array, inside: BoolArray, step: int
) -> dict[tuple[Shared, Lag], Covariance]:
    """Return the covariances of frames with those ``step`` later."""
    far_y, far_x = (min(FARTHEST, (size - 1) // 4) for size in inside.shape)
    down, right = range(-far_y, far_y + 1), range(-far_x, far_x + 1)
    pixels = inside[None].astype(np.float32)
    starts = np.arange(_GROUPS) * len(one) // _GROUPS
    size = np.diff(starts, append=len(one))
    sums = _Pairs.of(one, two, down, right, starts)
    # how many pairs a frame has, to which a transform adds what floats leave
    counts = _Pairs(*(np.rint(n) for n in _Pairs.of(pixels, pixels, down, right, np.zeros(1, np.int64))))

    def mean(products: FloatArray, pairs: FloatArray) -> FloatArray:
        """Average over the pairs of each group of frames, 0 without any."""
        return np.asarray(products / np.maximum(pairs * size, 1.0))

    frame = mean(sums.frame, counts.frame)
    row, column = mean(sums.row, counts.row) - frame, mean(sums.column, counts.column) - frame
    sample = mean(sums.sample, counts.sample) - frame - row[:, None] - column[None, :]
    every: list[tuple[Shared, Lag, FloatArray, float]] = [
        ("frame", (step, 0, 0), frame, float(counts.frame[0])),
        *(("row", (step, dy, 0), row[i], float(counts.row[i, 0])) for i, dy in enumerate(down)),
        *(("column", (step, 0, dx), column[j], float(counts.column[j, 0])) for j, dx in enumerate(right)),
        *(
            ("sample", (step, dy, dx), sample[i, j], float(counts.sample[i, j, 0]))
            for i, dy in enumerate(down)
            for j, dx in enumerate(right)
        ),
    ]
    return {
        (shared, lag): _averaged(values, (1 + (step == 0)) / (pairs * len(one)))
        for shared, lag, values, pairs in every
        if pairs and (lag > (0, 0, 0) or (lag == (0, 0, 0) and shared != "sample"))
    }


def _averaged(values: FloatArray, variance: float) -> Covariance:
    """Return the mean of groups of frames; ``variance`` of it is by chance alone where nothing is shared."""
    return Covariance(float(values.mean()), float(np.sqrt(max(values.var(ddof=1) / values.size, variance))))


class _Pairs(NamedTuple):
    """Sums of products of pairs: near ones, far ones in a row, in a column, and in neither.

    Shapes (down, right, groups), (down, groups), (right, groups), (groups,).
    """

    sample: FloatArray
    row: FloatArray
    column: FloatArray
    frame: FloatArray

    @classmethod
    def of(cls, one: Float32Array, two: Float32Array, down: range, right: range, starts: IntArray) -> _Pairs:
        """Return those of frames (n, y, x) with others, by distance and by group of frames."""
        rows = [each.sum(axis=2, dtype=np.float64) for each in (one, two)]
        columns = [each.sum(axis=1, dtype=np.float64) for each in (one, two)]
        total = np.add.reduceat(rows[0].sum(axis=1) * rows[1].sum(axis=1), starts)
        near = _products(one, two, starts)[np.ix_(range(starts.size), down, right)]
        row, column = (
            _products(each[0], each[1], starts)[:, lags] for each, lags in ((rows, down), (columns, right))
        )
        frame = total - row.sum(axis=1) - column.sum(axis=1) + near.sum(axis=(1, 2))
        return cls(
            np.moveaxis(near, 0, -1),
            np.moveaxis(row - near.sum(axis=2), 0, -1),
            np.moveaxis(column - near.sum(axis=1), 0, -1),
            frame,
        )


def _products(one: NDArray[Any], two: NDArray[Any], starts: IntArray) -> FloatArray:
    """Return ``sum one[n, i] two[n, i + d]`` of groups of n by distance d, negative ones from the end."""
    axes = tuple(range(1, one.ndim))
    size = [n + FARTHEST for n in one.shape[1:]]
    products = np.conj(fft.rfftn(one, size, axes)) * fft.rfftn(two, size, axes)
    return np.asarray(fft.irfftn(np.add.reduceat(products, starts, axis=0), size, axes), np.float64)


def measured_noise(
    data: Covariances, model: Covariances, evidence: Evidence, inside: BoolArray
) -> Measurement | None:
    """Return the noise that samples of pixels ``inside``, (y, x), share; None: only what a model makes."""
    inside = inside & evidence.maps.usable
    own = {key: one for key, one in model.pairs.items() if abs(one.value) > CLEAR * one.error}
    none = Covariance(0.0, 0.0)
    left = {key: one.value - own.get(key, none).value for key, one in data.pairs.items()}
    error = {key: np.hypot(one.error, own.get(key, none).error) for key, one in data.pairs.items()}
    response = evidence.readout_std / evidence.maps.read_noise_dn**2
    of_offset = mean_response(evidence, inside)
    profiles: dict[Shared, _Profile] = {
        of: found
        for of in _LINES
        if (found := _profile(of, data, model, np.where(inside, response, np.nan))) is not None
    }
    for of, found in profiles.items():
        for key, taken in found.take_off(of, left, of_offset).items():
            error[key] = np.hypot(error[key], _SHAPE_ERROR * taken)
    # a fit to all statistics comes behind
    clear = [key for key in left if abs(left[key]) > CERTAIN * error[key]]
    modes: list[NoiseMode] = []
    powers: list[float] = []
    for shared in _SHARED:
        lags = [lag for what, lag in clear if what == shared and any(lag)]
        lags = sorted(sorted(lags, key=lambda lag: -abs(left[shared, lag]))[:_MOST_LAGS])
        here = left[shared, (0, 0, 0)] if (shared, (0, 0, 0)) in clear else 0.0
        values = [left[shared, lag] for lag in lags]
        least = max(0.0, -float(spectrum(lags, values).min()))
        power = max(here, least * (_OVER_LEAST if shared == "sample" else 1.0))
        if power > 0.0:
            correlation = tuple(round(value / power, 4) for value in values)
            modes.append(NoiseMode(of=shared, share=1.0, lags=tuple(lags), correlation=correlation))
            powers.append(power / of_offset**2)
    for of, found in profiles.items():
        modes.append(NoiseMode(of=of, share=1.0, profile=tuple(np.round(found.points, 3).tolist())))
        powers.append(found.power)
    if not modes:
        return None
    # of a mean product that is Gaussian
    gain = sum(0.5 * (left[key] / error[key]) ** 2 for key in clear)
    gain += sum(0.5 * found.clear**2 for found in profiles.values())
    most = _MOST * float(np.median(evidence.maps.read_noise_dn[inside])) ** 2
    noise = EmpiricalNoise(
        noise_dn=float(np.sqrt(min(sum(powers), most))),
        modes=tuple(
            mode.model_copy(update={"share": round(power / sum(powers), 4)})
            for mode, power in zip(modes, powers, strict=True)
        ),
    )
    return Measurement(noise, gain)


class _Profile(NamedTuple):
    """A shape of lines: its values at evenly spaced points, at each place, its power, DN^2, in its errors."""

    points: FloatArray
    shape: FloatArray
    power: float
    clear: float

    def take_off(
        self, of: Shared, left: dict[tuple[Shared, Lag], float], response: float
    ) -> dict[tuple[Shared, Lag], float]:
        """Subtract it from what lines share alike and from near samples; return what was from the latter."""
        alike = left[of, (0, 0, 0)]
        taken: dict[tuple[Shared, Lag], float] = {}
        for key in list(left):
            if key[0] == of:
                left[key] = 0.0
        for far in range(1, FARTHEST + 1):
            near: Lag = (0, 0, far) if of == "row" else (0, far, 0)
            if ("sample", near) in left:
                made = self.power * response**2 * float(np.mean(self.shape[:-far] * self.shape[far:]))
                taken["sample", near] = made - alike
                left["sample", near] -= made - alike
        return taken


def _profile(of: Shared, data: Covariances, model: Covariances, response: FloatArray) -> _Profile | None:
    """Return the shape along a line that lines have in varying amounts; None where it is even.

    The covariance of two places far apart is that of a few points between which it is linear; its largest
    principal component is the shape (Karhunen 1947, Loeve 1948). ``response``, (y, x), is in 1/DN or NaN.
    """
    if of not in data.lines:
        return None
    products, counts = data.lines[of]
    variance = 1.0 / np.maximum(counts, 1.0)
    if of in model.lines:
        products = products - model.lines[of].products
        variance += 1.0 / np.maximum(model.lines[of].counts, 1.0)
    known = np.isfinite(response)
    axis = 0 if of == "row" else 1
    unit = np.where(known, response, 0.0).sum(axis=axis) / np.maximum(known.sum(axis=axis), 1)
    size = unit.size
    n_points = min(_MOST_POINTS, size // 4)
    one, two = np.nonzero(np.triu((counts > 0) & (np.outer(unit, unit) > 0), FARTHEST + 1))
    if n_points < _FEWEST_POINTS or one.size < 4 * n_points**2:
        return None
    scale = unit[one] * unit[two]
    seen, weight = products[one, two] / scale, scale / np.sqrt(variance[one, two])
    hats = np.maximum(1.0 - np.abs(np.linspace(0, n_points - 1, size)[:, None] - np.arange(n_points)), 0.0)
    a, b = np.triu_indices(n_points)
    design = hats[one][:, a] * hats[two][:, b] + hats[one][:, b] * hats[two][:, a] * (a != b)
    fitted = np.linalg.lstsq(design * weight[:, None], seen * weight, rcond=None)[0]
    between = np.zeros((n_points, n_points))
    between[a, b] = between[b, a] = fitted
    shape = np.linalg.eigh(hats @ between @ hats.T)[1][:, -1] * np.sqrt(size)

    def power(shape: FloatArray) -> tuple[float, float]:
        """Return the power of a shape, and the same in standard errors."""
        made = shape[one] * shape[two] * weight
        square, product = float(made @ made), float(made @ (seen * weight))
        return (product / square, product / np.sqrt(square)) if square else (0.0, 0.0)

    (found, clear), (_, alike) = power(shape), power(np.ones(size))
    if clear < _CLEAR_SHAPE or clear**2 < _BETTER * alike**2 + _CLEAR_SHAPE**2 / 2.0:
        return None
    return _Profile(np.linalg.lstsq(hats, shape, rcond=None)[0], shape, found, clear)


def running_waves(samples: PartSamples) -> Waves:
    """Measure the waves that run across rows, columns and frames."""
    return waves_across(samples.frames, samples.numbers, samples.laws, samples.maps, samples.inside)


def measured_wave(data: Waves, model: Waves, evidence: Evidence, inside: BoolArray) -> Measurement | None:
    """Return the wave of steady phase in the pixels ``inside``, (y, x), beyond a model's, or None."""
    wave, made = data.steady, model.steady
    if wave is None or (made is not None and made.amplitude > MADE * wave.amplitude):
        return None
    per_frame, per_row, per_column = wave.per_frame or 0.0, wave.per_row, wave.per_column
    cycles = round(per_frame, 7), round(per_row, 6), round(per_column, 6)
    size = wave.amplitude * root_mean_square(cycles) / mean_response(evidence, inside)
    mode = NoiseMode(of="sample", share=1.0, wave=cycles)
    return Measurement(EmpiricalNoise(noise_dn=size, modes=(mode,)), wave.excess)
