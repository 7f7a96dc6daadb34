"""Samples that equal others, or follow their bits: of repeated lines, squares, neighbours, frames before.

Without an effect a sample is as independent of the others of its frame as of those of the next few frames,
whatever the pixels' histograms are: exchanging a few successive frames says what chance does. So it is asked
whether samples equal what their neighbours predict too often, or exceed it too seldom; whether they are
nearer to the one before than to those of other frames; and whether they follow single bits of the sample read
before. Lines that repeat those before them, of the same frame or of the frame before, never come by chance in
analog data unless they are a few pixels long. Squares of equal samples are made by compression with losses,
binning that is undone and repeated pixels; nothing analog does.

Frames are codes (frame, y, x), DN, usable pixels are (y, x), and edges are positions of the blocks, (b + 1,).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, CodeArray, FloatArray, IntArray
from pchem_pipeline.discrepancy.observe import laws
from pchem_pipeline.discrepancy.observe.tables import PixelHistograms
from pchem_pipeline.effects.framework.evidence import PixelMaps, PredictedSamples, PreviousBits
from pchem_pipeline.effects.framework.neighbours import PREDICTORS, predicted
from pchem_pipeline.model.arithmetic.significance import CLEAR, SIGNIFICANCE

GROUP = 4  # frames whose predictions are exchanged
#: Samples of all groups together, unless there is but one, where all frames of a group are compared with all,
#: and where they are compared two by two.
MOST_SAMPLES, MOST_PAIRED = 1 << 18, 1 << 19
_MOST_THRESHOLDS = 96
_FARTHEST = 4.0  # of the thresholds, standard deviations of the samples
_TAIL = 3e-3  # of samples above the threshold that is tested
_WITHIN = (0.0, 0.15, 0.5, 1.5)  # read noises
_INDEPENDENT = 2.5  # of these
_FEWEST = 50.0  # pairs of which one agrees and another does not
BITS = 8  # the lowest ones
_FIRST = 2  # samples of a line that are compared before all of them are
_MOST_CODES = 1 << 26  # of all pixels together
_AT_ONCE = 1 << 16  # samples
_SMALLEST = 1e-4  # variance of a bit that the value before leaves, relative: below it is that value


def groups_of(edges: IntArray, samples_of_a_frame: int, most_samples: int = MOST_SAMPLES) -> IntArray:
    """Return positions of the first frames of groups of successive ones, evenly spread over blocks, (n,).

    There are ``most_samples`` in all groups together, unless there is only one.
    """
    first = np.concatenate([np.arange(a, b - GROUP + 1, GROUP) for a, b in pairwise(edges)])
    most = max(most_samples // (GROUP * samples_of_a_frame), 1)
    chosen = first[:: max(-(-first.size // most), 1)]
    return np.asarray(chosen, np.int64)


def predicted_samples(frames: CodeArray, edges: IntArray, usable: BoolArray) -> dict[str, PredictedSamples]:
    """Return how samples compare with their predictions, by kind; none where frames or pixels are too few."""
    first, inside = groups_of(edges, usable.size), usable[1:-1, 1:-1]
    if min(usable.shape) < 3 or not inside.any() or not first.size:
        return {}
    chosen = frames[first[:, None] + np.arange(GROUP)].reshape(-1, *usable.shape)
    samples = chosen[:, 1:-1, 1:-1][:, inside].astype(np.int32).reshape(first.size, GROUP, -1)
    reach = _FARTHEST * float(samples.std(axis=(0, 1)).mean())
    step = max(1, int(np.ceil(reach / _MOST_THRESHOLDS)))
    found: dict[str, PredictedSamples] = {}
    for kind in PREDICTORS:
        own = predicted(chosen, kind)[:, inside].reshape(samples.shape)
        found[kind] = _compared(samples, own, step * np.arange(_MOST_THRESHOLDS), always=kind == "median")
    return found


def _compared(
    samples: NDArray[np.int32], prediction: NDArray[np.int32], thresholds: IntArray, *, always: bool
) -> PredictedSamples:
    """Compare samples (group, frame, pixel), DN, with the predictions of each frame of their group.

    Thresholds are compared only where samples equal the prediction too often, or ``always``.
    """
    own = samples - prediction
    others = np.stack([samples - np.roll(prediction, shift, axis=1) for shift in range(1, GROUP)])
    equal = np.count_nonzero(own == 0)
    # as many pairs of a sample with itself as with each other frame, of which the mean is taken
    chance = np.count_nonzero(others == 0) / (GROUP - 1)
    z = float((equal - chance) / np.sqrt(max(chance, 1.0) * GROUP / (GROUP - 1)))
    if not always and z < CLEAR:
        return PredictedSamples(z, thresholds[:0], np.zeros(0), np.zeros((GROUP - 1, 0)))
    first, second, third = others
    low, high = np.minimum(first, second), np.maximum(first, second)
    ordered = np.maximum(high, third), np.maximum(low, np.minimum(high, third)), np.minimum(low, third)
    at_least = np.array([_above(part, thresholds) for part in ordered])
    # of m of 3 above, one, two, three given ones are so in m, m (m - 1) / 2, ... of 3, 3, 1 choices
    exactly = at_least - np.append(at_least[1:], np.zeros((1, thresholds.size)), axis=0)
    moments = np.array([[1.0 / 3.0, 2.0 / 3.0, 1.0], [0.0, 1.0 / 3.0, 1.0], [0.0, 0.0, 1.0]])
    return PredictedSamples(z, thresholds, _above(own, thresholds), moments @ exactly)


def _above(deviations: NDArray[np.int32], thresholds: IntArray) -> FloatArray:
    """Return how many deviations are above each of evenly spaced thresholds from 0 on."""
    step = int(thresholds[1] - thresholds[0])
    positive = deviations[deviations > 0]
    # d > i step where i < ceil(d / step)
    cells = np.minimum((positive + (step - 1)) // step, thresholds.size)
    counts = np.bincount(cells, minlength=thresholds.size + 1)
    return np.asarray(counts[::-1].cumsum()[::-1][1:], np.float64)


def predicted_statistics(found: Mapping[str, PredictedSamples]) -> dict[str, float]:
    """Return the statistics of samples that equal, or exceed, what their neighbours predict."""
    if not found:
        return {}
    median = found["median"]
    first, second, _ = median.above_chance
    place = min(int(np.searchsorted(-first, -_TAIL * max(first[0], 1.0))), first.size - 1)
    variance = max(first[place] - second[place], 1.0) * GROUP / (GROUP - 1)
    return {
        "space.predicted.equal": laws.best(*(each.equal_z for each in found.values())),
        "space.predicted.above": float((median.above[place] - first[place]) / np.sqrt(variance)),
    }


def nearer_statistics(frames: CodeArray, edges: IntArray, maps: PixelMaps) -> dict[str, float]:
    """Return the statistic of samples that are nearer to the one before than chance makes them.

    Whatever ties successive samples together, in proportion or not, changes how often they nearly agree. Of
    two pairs of successive frames ``(x, y)`` and ``(x', y')`` the agreements of x with y and of x' with y'
    are counted, less those of x with y' and of x' with y: what the law of either sample makes is in both, so
    that without an effect the sum has mean 0, and for its variance the sum of the squares.
    """
    first = groups_of(edges, maps.usable.size, MOST_PAIRED)
    half = first.size // 2
    if not half or not maps.usable.any():
        return {}
    # the second pair comes from far away in time
    two = frames[np.stack([first[:half], first[half : 2 * half]])[..., None] + np.arange(4)][..., maps.usable]
    (x, other_x), (y, other_y) = (two[:, :, when].astype(np.int32) for when in ((0, 2), (1, 3)))
    apart = [np.abs(a - b) for a, b in ((x, y), (other_x, other_y), (x, other_y), (other_x, y))]
    noise = float(np.median(maps.read_noise_dn[maps.usable]))
    found = []
    for within in sorted({int(part * noise) for part in _WITHIN}):
        near = [(each <= within).view(np.int8) for each in apart]
        excess = near[0] + near[1] - near[2] - near[3]
        square = float(np.count_nonzero(excess)) + 3.0 * np.count_nonzero(np.abs(excess) == 2)
        if square >= _FEWEST:
            found.append(float(excess.sum(dtype=np.int64)) / np.sqrt(square))
    if not found:
        return {}
    return {"time.nearer": laws.best(*found, independent=min(float(len(found)), _INDEPENDENT))}


def previous_bits(frames: CodeArray, edges: IntArray, maps: PixelMaps) -> PreviousBits | None:
    """Return the regression of samples on the bits of those before; None where there are too few.

    What a sample has in common with the value of the one before is crosstalk of many kinds; what it has in
    common with single bits of it, beyond that value, is only of the converter's making. Differences of
    successive frames are regressed, so that nothing constant counts.
    """
    usable = maps.usable
    noise = np.sqrt(maps.read_noise_dn**2 + maps.quanta_exposure / maps.conversion_gain**2)
    pairs = usable[:, 1:] & usable[:, :-1]
    first = groups_of(edges, usable.size, MOST_PAIRED)
    if not first.size or not pairs.any():
        return None
    # of each group two pairs of frames
    later = (first[:, None] + np.array([1, 3])).ravel()
    one, two = frames[later], frames[later - 1]
    weight = np.where(pairs, 1.0 / np.where(usable, noise, 1.0)[:, 1:], 0.0).astype(np.float32)
    value = np.subtract(one, two, dtype=np.float32) if one.itemsize < 4 else one - two.astype(np.float64)
    own = (value[:, :, 1:] * weight).ravel()
    design = np.empty((1 + BITS, own.size), np.float32)
    design[0] = (value[:, :, :-1] * weight).ravel()
    low = [(part[:, :, :-1] & (2**BITS - 1)).astype(np.uint8) for part in (one, two)]
    for bit in range(BITS):
        changed = (low[0] >> bit & 1).view(np.int8) - (low[1] >> bit & 1).view(np.int8)
        design[1 + bit] = (changed * weight).ravel()
    square = (design @ design.T).astype(np.float64)
    product = (design @ own).astype(np.float64)
    if square[0, 0] <= 0.0:
        return None
    # what the value before explains is taken from the bits
    slope = square[1:, 0] / square[0, 0]
    left = square[1:, 1:] - np.outer(slope, square[0, 1:])
    variance = float(own @ own) / (len(one) * int(pairs.sum()))
    return PreviousBits(product[1:] - slope * product[0], left, variance)


def bit_statistics(found: PreviousBits | None) -> dict[str, float]:
    """Return the statistic of samples that follow bits of the one before."""
    if found is None:
        return {}
    scale = np.sqrt(np.maximum(np.diag(found.square), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(found.square / np.outer(scale, scale))
    kept = eigenvalues > _SMALLEST * eigenvalues.max()
    if not kept.any():
        return {}
    projected = vectors.T[kept] @ (found.product / scale)
    total = float(np.sum(projected**2 / eigenvalues[kept])) / max(found.variance, 1e-300)
    return {"space.x.bits": float(laws.chi_square(total, float(kept.sum())))}


# -- repeated lines and squares ---------------------------------------------------------------------


@dataclass(frozen=True)
class Repeats:
    """Lines that are, sample by sample, the one before."""

    frames: IntArray  # positions of frames equal to the one before
    rows_in_time: int  # number of rows of other frames that equal those of the frame before
    rows: int  # number of rows that equal the one above
    columns: int  # number of columns that equal the one on the left
    consecutive: int  # number of frames that directly follow another

    @classmethod
    def of(cls, frames: CodeArray, numbers: IntArray) -> Repeats:
        """Count those of frames (frame, y, x) with their numbers in the run."""
        consecutive = np.diff(numbers) == 1
        in_time = _equal_lines(frames[1:], frames[:-1]) & consecutive[:, None]
        whole = in_time.all(axis=1)
        turned = frames.swapaxes(1, 2)
        return cls(
            np.flatnonzero(whole) + 1,
            int(in_time[~whole].sum()),
            int(_equal_lines(frames[:, 1:], frames[:, :-1]).sum()),
            int(_equal_lines(turned[:, 1:], turned[:, :-1]).sum()),
            int(consecutive.sum()),
        )

    def statistics(self, seen: PixelHistograms, shape: tuple[int, ...]) -> dict[str, float]:
        """Return the statistics of repeats in frames (frame, y, x); none of lines that chance repeats."""
        real = seen.counts.astype(np.float32)
        total = np.maximum(real.sum(axis=1) + seen.outside.sum(axis=1), 1.0)
        # the log of the chance that two samples of a pixel are equal
        equal = np.maximum(np.einsum("ib,ib->i", real, real) / total**2, 1e-12)
        alike = np.asarray(np.log(equal).reshape(shape[1:]), np.float64)
        by_axis = {"rows": alike.sum(axis=1), "columns": alike.sum(axis=0)}
        chance = {name: float(np.exp(np.minimum(same, 0.0)).sum()) for name, same in by_axis.items()}
        frames = float(np.exp(min(alike.sum(), 0.0)))
        z = {
            "frame.repeated": laws.repeats(self.frames.size, self.consecutive * frames),
            "frame.repeated_rows": laws.repeats(self.rows_in_time, self.consecutive * chance["rows"]),
        }
        for name, found in (("rows", self.rows), ("columns", self.columns)):
            expected = shape[0] * chance[name]
            if expected < SIGNIFICANCE and by_axis[name].size > 1:
                z[f"space.repeated.{name}"] = laws.repeats(found, expected)
        return z


def _equal_lines(one: CodeArray, other: CodeArray) -> BoolArray:
    """Return which lines of two stacks (frame, line, sample) are equal, (frame, line)."""
    equal = np.asarray((one[:, :, :_FIRST] == other[:, :, :_FIRST]).all(axis=2))
    at = np.nonzero(equal)
    equal[at] = (one[at] == other[at]).all(axis=1)
    return equal


def equal_squares(frames: CodeArray) -> IntArray:
    """Return how often all samples of 2 x 2 pixels of frames (frame, y, x) are equal, (y-1, x-1).

    Those at the highest DN of all do not count: a particle's cloud leaves all of its pixels at the limit.
    """
    top = frames.max(initial=0)
    found = np.zeros((max(frames.shape[1] - 1, 0), max(frames.shape[2] - 1, 0)), np.int64)
    step = max(1, _AT_ONCE // frames[0].size)
    for some in (frames[first : first + step] for first in range(0, len(frames), step)):
        rows = some[:, 1:] == some[:, :-1]
        equal = rows[:, :, 1:] & rows[:, :, :-1] & (some[:, 1:, 1:] == some[:, 1:, :-1])
        found += np.count_nonzero(equal & (some[:, 1:, 1:] != top), axis=0)
    return found


def square_statistics(frames: CodeArray, seen: PixelHistograms, usable: BoolArray) -> dict[str, float]:
    """Return the statistic of squares of equal samples; none without squares of usable pixels."""
    counts, origin = seen.counts, seen.origin
    good = usable[1:, 1:] & usable[1:, :-1] & usable[:-1, 1:] & usable[:-1, :-1]
    first = int(origin[usable.ravel()].min(initial=origin.max(initial=0)))
    length = int(np.where(usable.ravel(), origin, first).max(initial=first)) - first + counts.shape[1]
    if not good.any() or length * usable.size > _MOST_CODES:
        return {}
    aligned = np.zeros((usable.size, length), np.float32)
    inside = np.flatnonzero(usable)
    columns = (origin[inside] - first)[:, None] + np.arange(counts.shape[1])
    total = np.maximum(counts[inside].sum(axis=1, keepdims=True), 1)
    aligned[inside[:, None], columns] = counts[inside] / total
    top = int(frames.max()) - first
    aligned[:, top : top + 1] = 0.0
    chance = aligned.reshape(*usable.shape, length)
    down = chance[1:] * chance[:-1]
    alike = np.einsum("yxc,yxc->yx", down[:, 1:], down[:, :-1])
    expected = float(alike[good].sum()) * float(counts[inside].sum(axis=1).max())
    return {"space.equal.squares": laws.poisson(int(equal_squares(frames)[good].sum()), expected)}
