"""What series of numbers follow along the frames: profiles, sudden changes, few levels, spectral lines.

**Sudden changes**: each series is piecewise constant in white noise; whatever is added to all of them alike
(drift, noise of the whole frame) is projected out. The levels of all series are cut at one time after the
other, that which lowers the sum of squares the most (binary segmentation: Scott and Knott 1974; Fryzlewicz
2014); at the end each cut is moved to its best place between its neighbours and dropped if it no longer
pays.

Contrasts do not tell a jump of one series from the opposite jump of all the others. So the levels are those
of the series themselves: at every cut all may jump, beside a smooth common mode, and what is no jump
against its error is taken out again.

**Lines**: the means of the readout residual are a field over frames t and lines y (rows or columns). A sine
in it is found in the periodogram over both, or, if its phase is new in every frame, in the periodogram over
y alone, averaged over frames (Bretthorst 1988: the periodogram is the likelihood of a single line in white
noise).
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from pchem_pipeline.base.arrays import Float32Array
from pchem_pipeline.effects.framework.evidence import Wave
from pchem_pipeline.effects.types import AnyArray, FloatArray, IntArray
from pchem_pipeline.model.arithmetic.significance import CERTAIN, FALSE_ALARM

#: Time constants, lengths of the run: shorter ones are hardly a drift, longer ones are straight lines.
SETTLING = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
# nodes of a path that is fitted, each twice as fine as the one before, and values that come on each at least
_NODES, _PER_NODE = (3, 5, 9, 17, 33), 3
_STIFF = 1e-3  # relative: nodes without values follow their neighbours
_MOST_CUTS = 100
_FAR_BELOW = 25.0  # of the criterion, below the best: not to be considered


class TimeProfile(NamedTuple):
    """A time profile that a series may follow."""

    shape: Literal["linear", "settling", "path"]  # line, exponential approach to the end, broken line
    size: float  # value at the end less that at the start; of a broken line its range
    criterion: float  # deviance with the price of the coefficients (Bayesian information criterion)
    gain: float  # by how much the deviance is below that of a constant
    path: tuple[float, ...] = ()  # nodes of a broken line, evenly spaced along the run, in units of the size
    settling_fraction: float = 0.2  # time constant of an approach, lengths of the run

    def exceeds_chance(self) -> bool:
        """Return whether it lowers the deviance by more than chance does, by three standard deviations."""
        free = {"linear": 1, "settling": 2, "path": len(self.path) - 1}[self.shape]
        return self.gain > free + 3.0 * float(np.sqrt(2.0 * free))


def settling(position: FloatArray, fraction: float) -> FloatArray:
    """Return an exponential approach at times 0..1, of mean 0, range 1 and time constant ``fraction``."""
    whole = -np.expm1(-1.0 / fraction)
    mean = (1.0 - fraction * whole) / whole
    return np.asarray(-np.expm1(-position / fraction) / whole - mean)


def along_path(position: FloatArray, path: Sequence[float]) -> FloatArray:
    """Return a broken line of mean 0 through nodes at equal distances, at times from 0 (first frame) to 1."""
    nodes = np.array(path)
    # the mean of a broken line counts its ends by half
    mean = (nodes.sum() - (nodes[0] + nodes[-1]) / 2.0) / (nodes.size - 1)
    return np.asarray(np.interp(position, np.linspace(0.0, 1.0, nodes.size), nodes) - mean)


def hats(position: FloatArray, nodes: int) -> FloatArray:
    """Return weights (positions, nodes) of linear interpolation between nodes at equal distances in 0..1."""
    knots = np.linspace(0.0, 1.0, nodes)
    return np.asarray(np.clip(1.0 - np.abs(position[:, None] - knots) * (nodes - 1), 0.0, None))


def likely_profiles(series: FloatArray, position: FloatArray) -> list[TimeProfile]:
    """Return the time profiles that a series may follow, the likeliest first; none if it may be constant.

    Of the best line, exponential approach and broken line those that explain more than chance and, with more
    freedom than the line, more than it by the Bayesian information criterion. Values with white noise, (n,),
    at times from 0 (first frame of the run) to 1 (last frame), (n,).
    """
    line, *curves = _time_profiles(series, position)
    kept = [line, *(curve for curve in curves if curve.criterion < line.criterion)]
    found = sorted((p for p in kept if p.exceeds_chance()), key=lambda p: p.criterion)
    return [profile for profile in found if profile.criterion < found[0].criterion + _FAR_BELOW]


def _time_profiles(series: FloatArray, position: FloatArray) -> tuple[TimeProfile, TimeProfile, TimeProfile]:
    """Return the line, the exponential approach and the broken line that fit a series best."""
    n = series.size

    def fit(basis: FloatArray, stiff: float = 0.0) -> tuple[FloatArray, float]:
        """Return the coefficients of a basis (n, k), and the deviance."""
        k = basis.shape[1]
        rows = stiff * float(np.sqrt(n / k)) * np.diff(np.eye(k), 2, axis=0)
        wanted = np.append(series, np.zeros(len(rows)))
        values = np.linalg.lstsq(np.concatenate([basis, rows]), wanted, rcond=1e-6)[0]
        chi2 = float(((series - basis @ values) ** 2).sum())
        return values, n * float(np.log(max(chi2, 1e-300) / n))

    constant = fit(np.ones((n, 1)))[1]

    def multiple(shape: Literal["linear", "settling"], profile: FloatArray, numbers: float) -> TimeProfile:
        values, deviance = fit(np.stack([np.ones(n), profile], axis=1))
        return TimeProfile(shape, float(values[1]), deviance + numbers * np.log(n), constant - deviance)

    def settled(fraction: float) -> TimeProfile:
        found = multiple("settling", settling(position, fraction), 3.0)
        return found._replace(settling_fraction=fraction)

    def path(nodes: int) -> TimeProfile:
        values, deviance = fit(hats(position, nodes), _STIFF)
        size = float(np.ptp(values)) or 1.0
        listed = tuple(np.round(values / size, 6).tolist())
        return TimeProfile("path", size, deviance + nodes * np.log(n), constant - deviance, listed)

    numbers = [nodes for nodes in _NODES if nodes == _NODES[0] or _PER_NODE * nodes <= n]
    return (
        multiple("linear", position - 0.5, 2.0),
        settled(_settling_time(lambda fraction: settled(fraction).criterion)),
        min(map(path, numbers), key=lambda each: each.criterion),
    )


def _settling_time(left: Callable[[float], float]) -> float:
    """Return the time constant, in lengths of the run, for which ``left`` is least."""
    from scipy.optimize import minimize_scalar  # not for every command that knows of effects

    losses = [left(fraction) for fraction in SETTLING]
    best = int(np.argmin(losses))
    ends = SETTLING[max(best - 1, 0)], SETTLING[min(best + 1, len(SETTLING) - 1)]
    options = {"xatol": 0.01}
    found = minimize_scalar(lambda log: left(float(np.exp(log))), bounds=np.log(ends), options=options)
    return float(np.exp(found.x)) if found.fun < losses[best] else SETTLING[best]


Layout = TypeVar("Layout", bound=str)

# cosines of the common mode, where it wanders
_WAVES = (0, 12)


@dataclass(frozen=True)
class Steps:
    """Levels of one series, with mean 0 over it, and where each begins, the first at 0, (s,) both."""

    starts: IntArray
    levels: FloatArray


def likeliest_parts(
    series: FloatArray, gaps: FloatArray, layouts: Mapping[Layout, FloatArray]
) -> tuple[Layout, list[Steps]]:
    """Return which groups of series (n, m) jump together, and the jumps of each.

    By the squares of what is left in all series, and Schwarz's price for each level and jump. ``gaps`` as in
    `find_steps`; ``layouts`` are weights of the series in the mean of each group, (p, m), p of 2 or more.
    """
    n, own = len(series), _own_variance(series)
    found: list[tuple[float, Layout, list[Steps]]] = []
    for layout, weights in layouts.items():
        steps = find_steps(series @ weights.T, gaps)
        profiles = [np.repeat(each.levels, np.diff([*each.starts, n])) for each in steps]
        rest = series - np.stack(profiles, axis=1) @ (weights > 0)
        rest -= rest.mean(axis=1, keepdims=True) + rest.mean(axis=0)
        levels = sum(each.levels.size for each in steps)
        price = np.log(n) * (3 * levels - 2 * len(steps))
        squares = float((rest**2).sum() / own) if own > 0 else 0.0
        found.append((squares + float(price), layout, steps))
    _, layout, steps = min(found, key=lambda each: each[0])
    return layout, steps


def find_steps(series: FloatArray, gaps: FloatArray | None = None) -> list[Steps]:
    """Return the levels of each series of (n, m), m of 2 or more, and where they begin.

    A cut must lower the sum of squares by ``4 log(n m) + 6`` times the variance of the noise (twice what the
    Bayesian information criterion asks for: series without steps are cut about once in a thousand times).
    ``gaps``: time between each value and the one before, in units of the shortest, (n,): a change during a
    long gap is so much likelier than one between two neighbours. All alike if None.
    """
    n, m = series.shape
    variance = _own_variance(series)
    if n < 4 or not variance > 0:
        return [Steps(np.zeros(1, np.int64), np.zeros(1)) for _ in range(m)]
    contrast = (series - series.mean(axis=1, keepdims=True)) / np.sqrt(variance)
    bonus = 2.0 * np.log(np.ones(n) if gaps is None else np.maximum(gaps, 1.0))
    least = 4.0 * np.log(n * m) + 6.0
    cuts = [0, n]
    while len(cuts) < _MOST_CUTS + 2:
        gain, cut = max(_best_cut(contrast, first, last, bonus) for first, last in pairwise(cuts))
        if gain <= least:
            break
        bisect.insort(cuts, cut)
    for cut in cuts[1:-1]:
        i = cuts.index(cut)
        gain, place = _best_cut(contrast, cuts[i - 1], cuts[i + 1], bonus)
        cuts[i : i + 1] = [place] if gain > least else []
    # where the common mode may wander, only its edge tells a step of one series: no more freedom than seen
    _, starts, levels = min(
        (_with_common(series, cuts[1:-1], variance, waves) for waves in _WAVES), key=lambda one: one[0]
    )
    return [
        Steps(np.array(begins, np.int64), level - (level * np.diff([*begins, n])).sum() / n)
        for level, begins in zip(levels, starts, strict=True)
    ]


def _own_variance(series: FloatArray) -> float:
    """Return the variance of the white noise of each series by itself."""
    n, m = series.shape
    contrast = series - series.mean(axis=1, keepdims=True)
    return float(np.mean([_noise_variance(one) for one in contrast.T])) * m / (m - 1.0) if n > 3 else 0.0


def _noise_variance(series: FloatArray) -> float:
    """Return the variance of the white part: half the mean squared difference of successive values."""
    squares = np.sort(np.diff(series) ** 2)
    # less the largest twentieth, the sudden steps; of a Gaussian the rest is 0.774 of the mean square
    return float(squares[: max(int(0.95 * squares.size), 1)].mean() / 2.0 / 0.774)


def _with_common(
    series: FloatArray, cuts: list[int], variance: float, n_waves: int
) -> tuple[float, list[list[int]], list[FloatArray]]:
    """Return Schwarz's criterion, which series jump at the cuts, and the levels of all, common mode included.

    Least squares in which the common mode counts less, by as much as it is noisier than a mean of ``m`` white
    series, and may wander smoothly (some cosines).
    """
    n, m = series.shape
    noise = _noise_variance(series.mean(axis=1))
    weight = min(1.0, float(np.sqrt(variance / m / noise))) if noise > 0 else 1.0
    metric = np.eye(m) - (1.0 - weight) / m
    waves = np.cos(np.pi * np.outer(np.arange(n) + 0.5, np.arange(1, n_waves + 1)) / n)
    common = np.concatenate([waves[:, None, :] * row.sum() for row in metric], axis=1).reshape(n * m, n_waves)
    starts = [[0, *cuts] for _ in range(m)]
    while True:
        segments = np.concatenate(
            [_indicators(begins, n, metric[:, q]) for q, begins in enumerate(starts)], axis=1
        )
        design = np.concatenate([segments, common], axis=1)
        inverse = np.linalg.pinv(design.T @ design, rcond=1e-10, hermitian=True)
        wanted = (series @ metric).ravel()
        found = inverse @ (design.T @ wanted)
        owner = np.repeat(np.arange(m), [len(begins) for begins in starts])
        levels = [found[: owner.size][owner == q] for q in range(m)]
        weakest: dict[int, tuple[float, int]] = {}
        for q, (begins, level) in enumerate(zip(starts, levels, strict=True)):
            here = np.flatnonzero(owner == q)
            spread = np.diag(inverse)[here]
            errors = variance * (spread[1:] + spread[:-1] - 2.0 * inverse[here[1:], here[:-1]])
            squares = np.diff(level) ** 2 / np.maximum(errors, np.finfo(np.float64).tiny)
            for cut, square in zip(begins[1:], squares, strict=True):
                weakest[cut] = min(weakest.get(cut, (np.inf, q)), (float(square), q))
        # one series a cut: the others' jumps are the surer without it
        dropped = {(cut, q) for cut, (square, q) in weakest.items() if square < CERTAIN**2}
        if not dropped:
            left = float(((wanted - design @ found) ** 2).sum()) / variance
            return left + float(np.log(n)) * found.size, starts, levels
        starts = [[cut for cut in begins if (cut, q) not in dropped] for q, begins in enumerate(starts)]


def _indicators(begins: list[int], n: int, row: FloatArray) -> FloatArray:
    """Return the columns of a design that one series' levels have, (n * m, levels)."""
    inside = np.repeat(np.eye(len(begins)), np.diff([*begins, n]), axis=0)
    return (inside[:, None, :] * row[:, None]).reshape(n * row.size, len(begins))


def _best_cut(series: FloatArray, first: int, last: int, bonus: FloatArray) -> tuple[float, int]:
    """Return by how much the best cut of a part of all series lowers the sum of squares, and its place."""
    n = last - first
    if n < 2:
        return 0.0, first
    left = np.arange(1, n)
    sums = np.cumsum(series[first:last], axis=0)
    squares = ((sums[:-1] - left[:, None] * sums[-1] / n) ** 2).sum(axis=1)
    gains = squares * n / (left * (n - left)) + bonus[first + 1 : last]
    best = int(gains.argmax())
    return float(gains[best]), first + 1 + best


_MOST_LEVELS = 6
_STEPS = 200  # of EM; levels that are as far apart as the noise is wide take some fifty


class Levels(NamedTuple):
    """Rising values and how often each is taken, (k,) both; the shares sum to 1."""

    values: FloatArray
    shares: FloatArray

    @property
    def rms(self) -> float:
        """Standard deviation."""
        return float(np.sqrt(self.shares @ (self.values - self.shares @ self.values) ** 2))


def few_levels(seen: FloatArray, variance: float) -> Levels | None:
    """Return the fewest values that explain what is seen, (n,); None where a normal law does so as well.

    Mixtures of normal laws of known variance by EM, two values and more as long as Schwarz's criterion falls.
    """
    price = math.log(seen.size)  # of a value and its share: twice half a logarithm
    whole = float(seen.var())
    total = max(whole, variance)
    best, criterion = None, -0.5 * seen.size * (math.log(2.0 * math.pi * total) + whole / total) - 0.5 * price
    for k in range(2, _MOST_LEVELS + 1):
        levels = _fitted(seen, variance, k)
        now = float(_log_density(levels, seen, variance)[0].sum()) - (k - 0.5) * price
        if now > criterion:
            best, criterion = levels, now
        elif best is not None:
            break
    return best


def _fitted(seen: FloatArray, variance: float, k: int) -> Levels:
    """Return k values and their shares by EM from equal shares."""
    start = np.quantile(seen, (np.arange(k) + 0.5) / k)
    levels = Levels(start, np.full(k, 1.0 / k))
    for _ in range(_STEPS):
        total, terms = _log_density(levels, seen, variance)
        belongs = np.exp(terms - total)
        number = np.maximum(belongs.sum(axis=1), 1e-9)
        levels = Levels(belongs @ seen / number, number / number.sum())
    order = np.argsort(levels.values)
    return Levels(levels.values[order], levels.shares[order])


def _log_density(levels: Levels, seen: FloatArray, variance: float) -> tuple[FloatArray, FloatArray]:
    """Return the log density of each of what is seen, (n,), and the logarithms of its terms, (k, n)."""
    terms = np.log(levels.shares)[:, None] - 0.5 * (
        (seen - levels.values[:, None]) ** 2 / variance + math.log(2.0 * math.pi * variance)
    )
    return np.logaddexp.reduce(terms, axis=0), terms


# frames of a spectrum over frames and lines: enough to tell a line, and bounded memory
_MOST_CELLS = 1 << 24
# slow changes that are no lines: cosines of up to so many half periods per run
_SLOW_WAVES = 6
# frequencies along frames over which the noise is taken as one
_STRETCH = 128
# lowest frequencies along lines (at half the resolution's steps), each with a noise of its own
_FRAME_LIKE = 5


def coherent_line(means: AnyArray, frames: IntArray, n_run: int) -> Wave | None:
    """Return the highest wave over frames and lines, as if these were rows, or None where none stands out.

    What is constant in time (part of the bias map), drifts (slower than three cycles per run) and alternation
    (half the frame rate) are taken away first. Means (n, lines), DN, with NaN for lines that do not count, of
    frames with these numbers, (n,), which may have gaps, in a run of ``n_run``.
    """
    field, lines = _prepared(means)
    if field.shape[0] < 64 or field.shape[1] < 1:
        return None
    n_lines = 2 * means.shape[1] if means.shape[1] > 1 else 1
    length = min(n_run, max(64, _MOST_CELLS // n_lines))
    inside = frames - frames[0] < length
    numbers = frames[inside]
    field = _without_slow(field[inside], numbers)
    grid = np.zeros((length, n_lines), np.float32)
    grid[np.ix_(numbers - numbers[0], lines)] = field
    spectrum = np.fft.fft(np.fft.rfft(grid, axis=1).astype(np.complex64), axis=0)
    power = np.asarray(np.abs(spectrum) ** 2, np.float32)  # at the non-negative frequencies along lines
    ratio = power / _level(power)
    place = np.unravel_index(int(ratio.argmax()), ratio.shape)
    excess = float(ratio[place]) - np.log(ratio.size)
    if excess < -np.log(FALSE_ALARM):
        return None
    start = (float(np.fft.fftfreq(length)[place[0]]), float(place[1] / n_lines))
    return _refined(field, numbers, lines, start, (1.0 / length, 1.0 / n_lines), float(excess))


def incoherent_line(means: AnyArray) -> Wave | None:
    """Return the highest wave within frames, of means as in `coherent_line`, whose phase is new in each."""
    field, lines = _prepared(means)
    if field.shape[0] < 16 or field.shape[1] < 8:
        return None
    field = field - field.mean(axis=1, keepdims=True)
    n_lines = 4 * means.shape[1]
    power = _mean_power(field, lines, np.arange(n_lines // 2 + 1) / n_lines)
    # the mean of a frame is gone, and with it the lowest frequencies
    kept = slice(6, None)
    level = float(np.median(power[kept]))
    place = 6 + int(power[kept].argmax())
    sigma = (power[place] / level - 1.0) * np.sqrt(field.shape[0])
    excess = float(sigma**2 / 2.0 - np.log(n_lines / 2.0)) if sigma > 0 else 0.0
    if excess < -np.log(FALSE_ALARM):
        return None
    fine = np.clip((place + np.linspace(-1.0, 1.0, 41)) / n_lines, 0.0, 0.5)
    peaks = _mean_power(field, lines, fine)
    best = int(peaks.argmax())
    amplitude = 2.0 * np.sqrt(max(float(peaks[best]) - level, 0.0) / lines.size)
    return Wave(float(amplitude), None, float(fine[best]), 0.0, 0.0, excess)


def _prepared(means: AnyArray) -> tuple[FloatArray, IntArray]:
    """Return the means of the lines that have pixels, constant pattern removed, and their numbers."""
    lines = np.flatnonzero(np.isfinite(means).all(axis=0))
    field = means[:, lines].astype(np.float64)
    return field - field.mean(axis=0), lines


def _without_slow(field: FloatArray, frames: IntArray) -> FloatArray:
    """Return the field without what no pickup does: the mean, slow changes and alternation of each line."""
    # fitted and not only left out of the spectrum, where gaps between the frames spread them widely
    position = (frames - frames[0]) / max(int(frames[-1] - frames[0]), 1)
    waves = [np.cos(np.pi * j * position) for j in range(_SLOW_WAVES + 1)]
    basis = np.linalg.qr(np.stack([*waves, 1.0 - 2.0 * (frames % 2)], axis=1))[0]
    return np.asarray(field - basis @ (basis.T @ field), np.float64)


def _level(power: Float32Array) -> Float32Array:
    """Return the noise power around each place, so that broad humps of the spectrum are no lines.

    By stretches of frequencies along frames: at each of the lowest frequencies along lines, where jumps and
    noise of frames are, and at all the others together.
    """
    level = np.empty_like(power)
    length = power.shape[0]
    for piece in np.array_split(np.arange(length), max(length // _STRETCH, 1)):
        level[piece, :_FRAME_LIKE] = np.median(power[piece, :_FRAME_LIKE], axis=0)
        if power.shape[1] > _FRAME_LIKE:
            level[piece, _FRAME_LIKE:] = np.median(power[piece, _FRAME_LIKE:])
    # what was fitted and taken away leaves holes; exponential powers have a median of log 2 of their mean
    return np.asarray(np.maximum(level, np.float32(0.5) * np.median(level)) / np.log(2.0), np.float32)


def _mean_power(field: FloatArray, lines: IntArray, frequencies: FloatArray) -> FloatArray:
    """Return the power along the lines at these frequencies, averaged over frames, per line."""
    waves = np.exp(-2j * np.pi * np.outer(lines, frequencies))
    return np.asarray((np.abs(field @ waves) ** 2).mean(axis=0) / lines.size, np.float64)


def _refined(
    field: FloatArray,
    frames: IntArray,
    lines: IntArray,
    start: tuple[float, float],
    width: tuple[float, float],
    excess: float,
) -> Wave:
    """Return the line near a peak of the spectrum: ever finer grids around the best place."""
    (f_frame, f_line), (w_frame, w_line) = start, width
    steps = np.linspace(-1.0, 1.0, 9)
    for _ in range(8):
        per_frame = f_frame + w_frame * steps
        along = f_line + w_line * steps if f_line else np.zeros(1)
        rows = field @ np.exp(-2j * np.pi * np.outer(lines, along))
        sums = np.exp(-2j * np.pi * np.outer(per_frame, frames)) @ rows
        i, j = np.unravel_index(int(np.abs(sums).argmax()), sums.shape)
        f_frame, f_line, best = float(per_frame[i]), float(along[j]), complex(sums[i, j])
        w_frame, w_line = w_frame / 2.5, w_line / 2.5
    # a sine is half the sum of two waves; at 0 and half a cycle per line and frame they fall together
    doubled = 1.0 if (f_line % 0.5 == 0.0 and f_frame % 0.5 == 0.0) else 2.0
    amplitude = doubled * abs(best) / field.size
    phase = float(np.angle(best) + np.pi / 2.0)
    if f_line == 0.0 and f_frame < 0.0:
        # along frames alone the negative frequency is the same line
        f_frame, phase = -f_frame, np.pi - phase
    return Wave(amplitude, _wrapped(f_frame), _wrapped(f_line), 0.0, phase, excess)


def _wrapped(frequency: float) -> float:
    """Return the same frequency within half a cycle on either side of 0."""
    return float((frequency + 0.5) % 1.0 - 0.5)
