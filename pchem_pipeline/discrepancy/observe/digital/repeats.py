"""Samples that are equal to others more often than chance makes them: frames, rows, columns, squares.

Lines that repeat those before them, of the same frame or of the frame before, never come by chance in analog
data unless they are a few pixels long. Squares of equal samples are made by compression with losses, binning
that is undone and repeated pixels; nothing analog does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.discrepancy.observe import laws
from pchem_pipeline.discrepancy.observe.tables import PixelHistograms
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE

Frames = NDArray[np.unsignedinteger[Any]]

_FIRST = 2  # samples of a line that are compared before all of them are
_MOST_CODES = 1 << 26  # of all pixels together
_AT_ONCE = 1 << 16  # samples


@dataclass(frozen=True)
class Repeats:
    """Lines that are, sample by sample, the one before.

    Attributes:
        frames: positions of frames equal to the one before.
        rows_in_time: rows of other frames that are those of the frame before.
        rows, columns: those that are the row above, and the column on the left.
        consecutive: frames that directly follow another.
    """

    frames: IntArray
    rows_in_time: int
    rows: int
    columns: int
    consecutive: int

    @classmethod
    def of(cls, frames: Frames, numbers: IntArray) -> Repeats:
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

    def statistics(self, alike: FloatArray, n_frames: int) -> dict[str, float]:
        """Return the statistics of repeats; none of lines so short that chance repeats them in a frame.

        Args:
            alike: log of the chance that two samples of a pixel are equal, (y, x).
            n_frames: that were looked at.
        """
        by_axis = {"rows": alike.sum(axis=1), "columns": alike.sum(axis=0)}
        chance = {name: float(np.exp(np.minimum(same, 0.0)).sum()) for name, same in by_axis.items()}
        frames = float(np.exp(min(alike.sum(), 0.0)))
        z = {
            "frame.repeated": laws.repeats(self.frames.size, self.consecutive * frames),
            "frame.repeated_rows": laws.repeats(self.rows_in_time, self.consecutive * chance["rows"]),
        }
        for name, found in (("rows", self.rows), ("columns", self.columns)):
            expected = n_frames * chance[name]
            if expected < SIGNIFICANCE and by_axis[name].size > 1:
                z[f"space.repeated.{name}"] = laws.repeats(found, expected)
        return z


def _equal_lines(one: Frames, other: Frames) -> BoolArray:
    """Return which lines of two stacks (frame, line, sample) are equal, (frame, line)."""
    equal = np.asarray((one[:, :, :_FIRST] == other[:, :, :_FIRST]).all(axis=2))
    at = np.nonzero(equal)
    equal[at] = (one[at] == other[at]).all(axis=1)
    return equal


def log_alike(seen: PixelHistograms, shape: tuple[int, ...]) -> FloatArray:
    """Return the log of the chance that two samples of a pixel are equal, in the shape of the sensor."""
    real = seen.counts.astype(np.float32)
    total = np.maximum(real.sum(axis=1) + seen.outside.sum(axis=1), 1.0)
    alike = np.einsum("ib,ib->i", real, real) / total**2
    return np.asarray(np.log(np.maximum(alike, 1e-12)).reshape(shape), np.float64)


def equal_squares(frames: Frames) -> IntArray:
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


def square_statistics(
    found: IntArray, seen: PixelHistograms, usable: BoolArray, top: int
) -> dict[str, float]:
    """Return the statistic of squares of equal samples; none without squares of usable pixels.

    Given the histograms, frames without an effect are in random order.

    Args:
        found: how often the samples of each square are equal, (y-1, x-1).
        seen: histograms of the pixels.
        usable: pixels that count, (y, x).
        top: the highest DN of all, which does not count.
    """
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
    aligned[:, top - first : top - first + 1] = 0.0
    chance = aligned.reshape(*usable.shape, length)
    down = chance[1:] * chance[:-1]
    alike = np.einsum("yxc,yxc->yx", down[:, 1:], down[:, :-1])
    expected = float(alike[good].sum()) * float(counts[inside].sum(axis=1).max())
    return {"space.equal.squares": laws.poisson(int(found[good].sum()), expected)}
