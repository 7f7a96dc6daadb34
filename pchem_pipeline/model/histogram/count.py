"""Per-pixel histograms of a stack of frames, in one pass and in memory that does not grow with it.

Every pixel has ``bins`` counts (the same number for the whole sensor) and an origin of its own, the DN of bin
0. While the range of a pixel fits into the window, the window follows it, and nothing is lost. A pixel with
a larger range keeps the window where it is, and what lies outside is counted exactly as under or over.

The result does not depend on how the frames are cut into blocks (but for the first one, of
``window_frames``) nor on which rows are done together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import CodeArray, IntArray
from pchem_pipeline.base.errors import InputError
from pchem_pipeline.model.histogram.count_numba import (
    count_frames,
    place_windows,
    recentre,
    update_extremes,
    update_range,
)

#: Smallest number of bins.
MINIMUM_BINS = 32
#: A window of so many bins is always allowed (if ``max_bins`` is), for the sake of hot pixels ...
_GENEROUS_BINS = 512
#: ... and up to this many times the window that half of the pixels need.
_HOT_FACTOR = 4
#: Largest number of bins of frames in memory.
_MOST_BINS = 1024
#: Samples left out at either end of a pixel's range where there are enough frames: glitches.
_TRIM = 3
_FRAMES_PER_TRIM = 64
#: DN above are no camera's, and squares of them would overflow the exact sums.
_LARGEST_DN = (1 << 24) - 1


def counts_dtype(n_frames: int) -> np.dtype[Any]:
    """Return the type of counts that cannot overflow: uint16, or uint32 above 65,535 frames."""
    return np.dtype(np.uint16 if n_frames <= np.iinfo(np.uint16).max else np.uint32)


@dataclass(frozen=True)
class RowHistograms:
    """Histograms of the pixels of some rows."""

    counts: CodeArray  # number of frames with DN = origin + bin, (y, x, bin)
    origin: NDArray[np.int32]  # DN of bin 0, (y, x)
    under: NDArray[np.uint32]  # number of frames below bin 0, (y, x)
    over: NDArray[np.uint32]  # number of frames above the last bin, (y, x)
    minimum: NDArray[np.int32]  # smallest DN seen, (y, x)
    maximum: NDArray[np.int32]  # largest DN seen, (y, x)


class HistogramAccumulator:
    """Histograms of the pixels of some rows, while the frames come in."""

    def __init__(self, shape: tuple[int, int], bins: int, n_frames: int) -> None:
        """Begin with no frames of some rows and columns; at most ``n_frames`` may come."""
        self._counts = np.zeros((*shape, bins), counts_dtype(n_frames))
        self._origin = np.zeros(shape, np.int32)
        self._under = np.zeros(shape, np.uint32)
        self._over = np.zeros(shape, np.uint32)
        self._minimum = np.full(shape, np.iinfo(np.int32).max, np.int32)
        self._maximum = np.full(shape, -1, np.int32)
        self._fixed = np.zeros(shape, np.bool_)
        self._first = True

    @classmethod
    def resumed(cls, held: RowHistograms, n_frames: int) -> HistogramAccumulator:
        """Go on after what `finish` returned; ``n_frames`` in the end, those included."""
        self = cls(held.counts.shape[:2], held.counts.shape[2], n_frames)
        for name, values in vars(held).items():
            getattr(self, f"_{name}")[...] = values
        # a window stays where it is for good once the range was too large for it
        self._fixed[...] = self._maximum.astype(np.int64) - self._minimum >= held.counts.shape[2]
        self._first = False
        return self

    def add(self, frames: CodeArray) -> None:
        """Count a block of frames, (frame, y, x).

        The first block of a stack places the windows of pixels that do not fit: let it always have the same
        number of frames.

        Raises:
            InputError: a DN has more than 24 bits.
        """
        if not len(frames):
            return
        low, high = frames[0].copy(), frames[0].copy()
        update_range(frames, low, high)
        if frames.dtype.itemsize > 2 and int(high.max()) > _LARGEST_DN:
            raise InputError(
                f"the frames have DN of {int(high.max())}, more than 24 bits; correct input.dtype, "
                "input.byte_order or input.bit_shift"
            )
        ranges = low, high, self._minimum, self._maximum  # of these frames, and of all before
        place_windows(frames, *ranges, self._counts, self._origin, self._fixed, self._first)
        self._first = False
        count_frames(frames, self._origin, self._counts, self._under, self._over)

    def finish(self) -> RowHistograms:
        """Return the histograms; no frames can be added any more."""
        recentre(self._counts, self._origin, self._minimum, self._maximum, self._fixed)
        return RowHistograms(
            self._counts, self._origin, self._under, self._over, self._minimum, self._maximum
        )


def most_bins(max_bins: int, dtype: np.dtype[Any]) -> int:
    """Return the largest number of bins that pixels of a type may get, at most ``max_bins``."""
    return min(max_bins, 1 << (8 * dtype.itemsize))


def pixels_by_range(frames: CodeArray, max_bins: int) -> IntArray:
    """Return the number of pixels by their range of DN in the first frames, (max_bins + 2,).

    Of each pixel the most extreme samples are left out, the more the more frames there are. The last number
    is of all pixels above ``max_bins``.
    """
    depth = 1 + min(_TRIM, frames.shape[0] // _FRAMES_PER_TRIM)
    low = np.full((depth, *frames.shape[1:]), np.iinfo(frames.dtype).max, frames.dtype)
    high = np.zeros_like(low)
    update_extremes(frames, low, high)
    widths = high[-1].astype(np.int64) - low[-1].astype(np.int64) + 1
    return np.bincount(np.clip(widths, 1, max_bins + 1).ravel(), minlength=max_bins + 2)


def choose_bins(pixels: IntArray, max_bins: int) -> int:
    """Return the number of bins that suits a sensor, a multiple of 16 from 32 on.

    A pixel of range r in the first frames (see `pixels_by_range`) needs ``2 r + 16`` bins: of the range of
    some hundred frames, its extremes left out, the range of a million frames is less than twice as much. The
    widest need counts, but not above ``max_bins``, or above both 512 and four times that of the median pixel.
    """
    needs = [_needed(width) for width in range(pixels.size)]
    median = int(np.searchsorted(np.cumsum(pixels), 0.5 * pixels.sum()))
    limit = min(max_bins, max(_GENEROUS_BINS, _HOT_FACTOR * needs[median]))
    if needs[median] > limit:
        return max_bins
    return max(needs[width] for width in np.flatnonzero(pixels).tolist() if needs[width] <= limit)


def _needed(width: int) -> int:
    return max(MINIMUM_BINS, -(-(2 * width + 16) // 16) * 16)


def histogram_frames(
    frames: CodeArray, *, bins: int | None = None, window_frames: int = 256
) -> RowHistograms:
    """Return the histograms of a stack of frames in memory, (frame, y, x) of an unsigned type.

    The first ``window_frames`` decide the windows, and the number of bins where it is not given.

    Raises:
        InputError: a DN has more than 24 bits.
    """
    n_frames, ny, nx = frames.shape
    if bins is None:
        bins = choose_bins(pixels_by_range(frames[:window_frames], _MOST_BINS), _MOST_BINS)
    histograms = HistogramAccumulator((ny, nx), bins, n_frames)
    for t in range(0, n_frames, window_frames):
        histograms.add(frames[t : t + window_frames])
    return histograms.finish()
