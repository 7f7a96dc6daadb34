"""The empirical component: what no known effect explains, measured as a mixture of shifts of the samples.

The samples are a mixture of their law and of shifts of it: those on a grid, and those towards the sample
beside or before. The shares of the shifts are those of maximum likelihood (Laird 1978; by Newton steps: Kim,
Carbonetto, Stephens and Anitescu 2020); those that the likelihood needs are kept. A neighbour must explain
more than a sample of the same pixel from another time, as it would by chance where the law alone is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.discrepancy.by_simulation.measured.samples import Distance, Measurement
from pchem_pipeline.discrepancy.observe.digital import equal_squares
from pchem_pipeline.discrepancy.observe.misplaced import with_others
from pchem_pipeline.effects.framework.compose import pixel_maps, sample_law
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.operators.replace import Empirical, MixtureShift, Together
from pchem_pipeline.model.arithmetic.limits import SMALLEST_MASS
from pchem_pipeline.model.arithmetic.significance import DECISIVE
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.mass import sample_mass

_MOST_PIXELS = 600  # that stand for all
_MOST_SAMPLES = 60_000  # that stand for all where each has a neighbour
_FINE = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)  # DN
_FARTHEST_E = 6.0  # electrons: shifts beyond are hits of particles or the like
_ITERATIONS, _HALVINGS = 20, 8
_CONVERGED = 0.01  # nats
_MOST_SHIFTS = 6
_LEAST = 1e-6  # share
#: Neighbours: one and two frames before, and those beside in the same frame.
_PLACES: tuple[Distance, ...] = (
    (-1, 0, 0), (-2, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1),
)  # fmt: skip
_TOWARDS = (1, 2, 4, 8)  # DN
_WITHIN = (0.5, 1.0)  # electrons
_CHANCE = 7  # frames between a sample and the one that stands for a neighbour by chance
_OF_CHANCE = 3.0  # times what that one explains, that a neighbour must
_TOGETHER: tuple[Together, ...] = ("row", "column", "frame")
_ROWS_TOGETHER = 4  # neighbouring rows
_SURE = 30.0  # nats, the most that a sample says
_ALIGNED = 3.0  # times as many equal squares of one parity as of the others
_FIRST_SHARE, _STEPS = 0.02, 60


@dataclass(frozen=True)
class _Mixture:
    """Numbers of samples of each kind, (n,), and mass of their codes with each move, none first, (l, n)."""

    counts: FloatArray
    mass: FloatArray

    def fitted(self, used: Sequence[int]) -> tuple[FloatArray, float]:
        """Return the shares of some of the moves, (l,), 0 for the others, and the log likelihood, nats.

        ``sum n log(M s) - N sum s`` is concave: Newton steps, each a problem of non-negative least squares,
        halved where they overshoot.
        """
        counts, mass = self.counts, self.mass[list(used)]
        total = float(counts.sum())
        share = np.full(len(used), 1e-3 / max(len(used) - 1, 1))
        share[0] = 1.0 - share[1:].sum()
        best = _likelihood(counts, mass, share)
        for _ in range(_ITERATIONS):
            law = np.maximum(share @ mass, SMALLEST_MASS)
            slope = mass @ (counts / law)
            scaled = mass * (np.sqrt(counts) / law)
            curvature = scaled @ scaled.T
            curvature += 1e-10 * np.trace(curvature) * np.eye(len(used))
            root = np.linalg.cholesky(curvature)
            target = np.linalg.solve(root, 2.0 * slope - total)
            step = optimize.nnls(root.T, target)[0] - share
            for _ in range(_HALVINGS):
                new = share + step
                new /= max(float(new.sum()), SMALLEST_MASS)
                value = _likelihood(counts, mass, new)
                if value > best:
                    break
                step /= 2.0
            else:
                break
            gain, share, best = value - best, new, value
            if gain < _CONVERGED:
                break
        found = np.zeros(len(self.mass))
        found[list(used)] = share
        return found, best

    def gain(self) -> float:
        """Return by how much likelier the samples are with moves, nats."""
        return self.fitted(range(len(self.mass)))[1] - self.fitted([0])[1]

    def needed(self) -> tuple[list[int], FloatArray, float]:
        """Return the moves that the likelihood needs, the shares of all, (l,), and what they gain, nats."""
        every, _ = self.fitted(range(len(self.mass)))
        used = [0, *(int(i) for i in np.argsort(-every[1:])[:_MOST_SHIFTS] + 1 if every[i] > _LEAST)]
        shares, best = self.fitted(used)
        for one in sorted(used[1:], key=lambda i: shares[i]):
            fewer = [i for i in used if i != one]
            without, likelihood = self.fitted(fewer)
            if best - likelihood < DECISIVE:
                used, shares, best = fewer, without, likelihood
        return [i for i in used[1:] if shares[i] > 0.0], shares, best - self.fitted([0])[1]


def _likelihood(counts: FloatArray, mass: FloatArray, share: FloatArray) -> float:
    return float(counts @ np.log(np.maximum(share @ mass, SMALLEST_MASS)))


@dataclass(frozen=True)
class _Laws:
    """The mass (n, c) of successive codes from the first of n pixels on, 0 at both ends, under a model."""

    pixels: IntArray
    first: IntArray
    mass: FloatArray

    @classmethod
    def of(
        cls,
        frames: NDArray[np.unsignedinteger],
        maps: PixelMaps,
        effects: Sequence[Effect],
        pixels: IntArray,
        margin: int,
    ) -> _Laws | None:
        """Return those of pixels that are usable; None where the effects give no law."""
        flat = tuple(values.ravel()[pixels] for values in maps.maps)
        try:
            law = sample_law(effects, pixel_maps(flat, np.ones(pixels.size, bool)))
        except ConfigError:
            return None
        own = frames.reshape(len(frames), -1)[:, pixels]
        first = own.min(axis=0).astype(np.int64) - margin
        length = int((own.max(axis=0).astype(np.int64) - first).max()) + 1 + margin
        mass = sample_mass(law, flat, first[:, None] + np.arange(length))
        mass[:, [0, -1]] = 0.0
        return cls(pixels, first, mass)

    def at(self, row: IntArray, code: IntArray) -> FloatArray:
        """Return the mass of codes in the pixels of some rows, 0 beyond what is known."""
        place = (code - self.first[row]).clip(0, self.mass.shape[1] - 1)
        return np.asarray(self.mass[row, place])

    def moved(self, move: MixtureShift, row: IntArray, code: IntArray, other: IntArray | None) -> FloatArray:
        """Return the mass of codes that have been moved, given the neighbours' codes."""
        if other is None:
            return self.at(row, code - move.shift_dn)
        if move.shift_dn:
            before = [code - move.shift_dn, code + move.shift_dn, code]
        elif move.part == 1.0:
            return np.asarray(code == other, np.float64)
        else:
            # x = floor((u + v) / 2) for two values of u
            before = [2 * code - other, 2 * code - other + 1]
        mass = sum(np.where(move.of(u, other) == code, self.at(row, u), 0.0) for u in before)
        if move.within_dn is not None and not move.shift_dn:
            mass = mass + np.where(abs(code - other) > move.within_dn, self.at(row, code), 0.0)
        return np.asarray(mass)


def measured_mixture_shifts(
    frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps, effects: Sequence[Effect]
) -> Measurement | None:
    """Return the moves that samples of frames (t, y, x) need beside a model, given its maps; None: none."""
    found = (
        _measured_shifts(frames, maps, effects),
        _measured_towards(frames, numbers, maps, effects),
        _measured_squares(frames, maps),
    )
    best = max(filter(None, found), key=lambda one: one.gain, default=None)
    if best is None:
        return None
    return best._replace(gain=best.gain * len(frames) * int(np.count_nonzero(maps.usable)))


def _measured_squares(frames: NDArray[np.unsignedinteger], maps: PixelMaps) -> Measurement | None:
    """Return squares of 2 x 2 pixels, of one parity of rows and columns, whose samples are all equal."""
    equal, usable = equal_squares(frames), maps.usable
    good = usable[1:, 1:] & usable[1:, :-1] & usable[:-1, 1:] & usable[:-1, :-1]
    parities = [(y, x) for y in (0, 1) for x in (0, 1)]
    number = np.array([np.count_nonzero(good[y::2, x::2]) * len(frames) for y, x in parities])
    if not number.all():
        return None
    found = np.array([equal[y::2, x::2][good[y::2, x::2]].sum() for y, x in parities])
    best = int(np.argmax(found / number))
    others = np.delete(found, best).sum() + 1.0
    expected = number[best] * others / np.delete(number, best).sum()
    if found[best] < _ALIGNED * expected:
        return None
    gain = float(found[best] * np.log(found[best] / expected) - (found[best] - expected))
    share = float(found[best] - expected) / float(number[best])
    if gain < DECISIVE:
        return None
    gain /= len(frames) * np.count_nonzero(usable)
    return _component([MixtureShift()], [1], np.array([1.0 - share, share]), gain, squares=parities[best])


def _measured_shifts(
    frames: NDArray[np.unsignedinteger], maps: PixelMaps, effects: Sequence[Effect]
) -> Measurement | None:
    """Return the shifts that histograms of pixels that stand for all need."""
    farthest = _FARTHEST_E / float(np.median(maps.conversion_gain[maps.usable]))
    sizes = [size for size in _FINE if size <= farthest]
    usable = np.flatnonzero(maps.usable.ravel())
    pixels = usable[:: max(usable.size // _MOST_PIXELS, 1)]
    laws = _Laws.of(frames, maps, effects, pixels, 1 + max(sizes, default=0))
    if laws is None or not sizes:
        return None
    moves = [MixtureShift(shift_dn=sign * size) for sign in (-1, 1) for size in sizes]
    histograms = histogram_frames(frames)
    counts = histograms.counts.reshape(-1, histograms.counts.shape[2])[pixels]
    row, column = np.nonzero(counts)
    code = histograms.origin.ravel()[pixels][row] + column
    mass = [laws.at(row, code), *(laws.moved(move, row, code, None) for move in moves)]
    mixture = _Mixture(counts[row, column].astype(np.float64), np.stack(mass))
    used, shares, gain = mixture.needed()
    return _component(moves, used, shares, gain / float(counts.sum()))


def _component(
    moves: Sequence[MixtureShift], used: Sequence[int], shares: FloatArray, gain: float, **how: object
) -> Measurement | None:
    total = float(shares[list(used)].sum())
    if not used or total <= 0.0:
        return None
    kept = tuple(moves[i - 1].model_copy(update={"weight": float(shares[i] / total)}) for i in used)
    return Measurement(Empirical.model_validate({"share": min(total, 1.0), "moves": kept, **how}), gain)


@dataclass(frozen=True)
class _Samples:
    """Samples whose neighbours are known, (m,), with the rows of their laws and places in the stack, (3, m).

    ``other`` is the code of the neighbour, ``chance`` that of its pixel at another time.
    """

    row: IntArray
    place: IntArray
    code: IntArray
    other: IntArray
    chance: IntArray


def _measured_towards(
    frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps, effects: Sequence[Effect]
) -> Measurement | None:
    """Return the moves towards neighbours that samples need, those of the one or two best neighbours."""
    pixels, some = _chosen(maps.usable, len(frames))
    step = 1.0 / float(np.median(maps.conversion_gain[maps.usable]))
    laws = _Laws.of(frames, maps, effects, pixels, max(_TOWARDS) + 1)
    if laws is None:
        return None
    best: tuple[float, Distance] | None = None
    for place in _PLACES:
        samples = _samples(frames, numbers, laws, place, some)
        if samples.code.size < _MOST_PIXELS:
            continue
        moves = _shifts_towards(place, step)
        gain = _mixture(laws, samples, moves, samples.other).gain()
        if gain > max(DECISIVE, 0.0 if best is None else best[0]):
            gain -= _OF_CHANCE * _mixture(laws, samples, moves, samples.chance).gain()
        if gain > max(DECISIVE, 0.0 if best is None else best[0]):
            best = gain, place
    if best is None:
        return None
    samples, moves = _samples(frames, numbers, laws, best[1], some), _shifts_towards(best[1], step)
    used, shares, gain = _mixture(laws, samples, moves, samples.other).needed()
    if not used:
        return None  # together they help, none of them is needed
    together, share = _together(laws, samples, moves, shares, frames.shape)
    if together != "sample":
        shares = shares * share / max(float(shares[used].sum()), _LEAST)
    return _component(moves, used, shares, gain / samples.code.size, together=together)


def without_squares(
    frames: NDArray[np.unsignedinteger], usable: BoolArray, effects: Sequence[Effect]
) -> NDArray[np.unsignedinteger]:
    """Return frames (t, y, x) with other samples of the pixels in place of squares that effects averaged."""
    for effect in effects:
        if isinstance(effect, Empirical) and effect.squares:
            inside = usable if effect.region is None else usable & effect.region.mask(usable.shape)
            moved = _in_equal_squares(frames, effect.squares) & inside
            alone = len(frames), inside.size
            frames = with_others(frames.reshape(*alone, 1), moved.reshape(alone)).reshape(frames.shape)
    return frames


def _in_equal_squares(frames: NDArray[np.unsignedinteger], parity: tuple[int, int]) -> BoolArray:
    """Return which samples lie in squares of equal ones, from a parity on, (frame, y, x)."""
    found = np.zeros(frames.shape, np.bool_)
    first = frames[:, parity[0] :: 2, parity[1] :: 2]
    others = [frames[:, parity[0] + y :: 2, parity[1] + x :: 2] for y, x in ((0, 1), (1, 0), (1, 1))]
    ny, nx = others[-1].shape[1:]
    equal = np.logical_and.reduce([first[:, :ny, :nx] == each[:, :ny, :nx] for each in others])
    for y in (0, 1):
        for x in (0, 1):
            found[:, parity[0] + y :: 2, parity[1] + x :: 2][:, :ny, :nx] = equal
    return found


def _chosen(usable: BoolArray, n_frames: int) -> tuple[IntArray, IntArray]:
    """Return pixels of whole rows that stand for all, and frames that have earlier ones."""
    rows = np.flatnonzero(usable.any(axis=1))
    groups = np.array_split(rows, max(-(-rows.size // _ROWS_TOGETHER), 1))
    most = max(_MOST_PIXELS // (usable.shape[1] * _ROWS_TOGETHER), 1)
    kept = np.concatenate(groups[:: -(-len(groups) // most)])
    some = np.zeros(usable.shape, np.bool_)
    some[kept] = usable[kept]
    pixels = np.flatnonzero(some.ravel())
    first = _CHANCE - min(place[0] for place in _PLACES)
    stride = max(-(-n_frames * pixels.size // _MOST_SAMPLES), 1)
    return pixels, np.arange(first, n_frames, stride)


def _samples(
    frames: NDArray[np.unsignedinteger], numbers: IntArray, laws: _Laws, place: Distance, some: IntArray
) -> _Samples:
    """Return the samples of some frames that have a neighbour at a place."""
    ny, nx = frames.shape[1:]
    before, down, right = place
    y, x = laws.pixels // nx, laws.pixels % nx
    some = some[numbers[some + before] == numbers[some] + before]
    row = np.flatnonzero((y + down >= 0) & (y + down < ny) & (x + right >= 0) & (x + right < nx))
    t, i = (each.ravel() for each in np.meshgrid(some, row, indexing="ij"))
    there = y[i] + down, x[i] + right
    code, other, chance = (
        frames[each].astype(np.int64)
        for each in ((t, y[i], x[i]), (t + before, *there), (t + before - _CHANCE, *there))
    )
    return _Samples(i, np.stack([t, y[i], x[i]]), code, other, chance)


def _shifts_towards(place: Distance, step: float) -> list[MixtureShift]:
    """Return the moves that are tried towards a neighbour, ``step`` DN per electron."""
    near = [max(int(part * step), 1) for part in _WITHIN]
    return [
        MixtureShift(towards=place),
        MixtureShift(towards=place, part=0.5),
        *(MixtureShift(towards=place, part=0.5, within_dn=within) for within in near),
        *(MixtureShift(towards=place, shift_dn=shift) for shift in _TOWARDS),
    ]


def _mixture(laws: _Laws, samples: _Samples, moves: Sequence[MixtureShift], other: IntArray) -> _Mixture:
    """Return the samples as a mixture of moves towards some neighbours."""
    mass = [laws.moved(move, samples.row, samples.code, other) for move in moves]
    return _Mixture(np.ones(samples.code.size), np.stack([laws.at(samples.row, samples.code), *mass]))


def _together(
    laws: _Laws, samples: _Samples, moves: Sequence[MixtureShift], shares: FloatArray, shape: tuple[int, ...]
) -> tuple[Together, float]:
    """Return what is moved alike, by the likelihood, and the share of it that is."""
    mass = _mixture(laws, samples, moves, samples.other).mass
    moved = shares[1:] @ mass[1:] / max(float(shares[1:].sum()), _LEAST)
    # by how much likelier samples are if they were moved, nats
    ratio = np.log(np.maximum(moved, SMALLEST_MASS) / np.maximum(mass[0], SMALLEST_MASS)).clip(-_SURE, _SURE)
    single = min(float(shares[1:].sum()), 1.0 - _LEAST)
    best = float(np.logaddexp(np.log1p(-single), np.log(single) + ratio).sum()) + DECISIVE
    found: tuple[Together, float] = ("sample", 0.0)
    for together in _TOGETHER:
        share, likelihood = share_of(_of_groups(ratio, samples.place, together, shape), single)
        if likelihood > best:
            best, found = likelihood, (together, share)
    return found


def _of_groups(ratio: FloatArray, place: IntArray, together: Together, shape: tuple[int, ...]) -> FloatArray:
    """Return by how much likelier rows, columns or frames are if they were moved, nats; -inf without any."""
    t, y, x = place
    group, count = {
        "row": (t * shape[1] + y, shape[0] * shape[1]),
        "column": (t * shape[2] + x, shape[0] * shape[2]),
        "frame": (t, shape[0]),
    }[together]
    known = np.bincount(group, minlength=count) > 0
    return np.where(known, np.bincount(group, ratio, count), -np.inf)


def share_of(ratio: FloatArray, first: float = _FIRST_SHARE) -> tuple[float, float]:
    """Return the share of moved groups, by EM from their log likelihood ratios, (n,), and the gain, nats."""
    ratio, share = ratio[np.isfinite(ratio)], first
    for _ in range(_STEPS if ratio.size else 0):
        share = float(special.expit(ratio + special.logit(share)).mean())
    with np.errstate(divide="ignore"):
        gain = np.logaddexp(np.log1p(-share), np.log(share) + ratio).sum()
    return share, float(gain)
