"""The loop of :mod:`pchem_pipeline.model.fit.guard` over all pixels."""

from __future__ import annotations

from pchem_pipeline.base.arrays import BoolArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.tile_numba import Histograms

_CORE_TAIL = 0.02  # share of the frames beyond either end of the core
_FAR = 0.6  # widths of the core: a wider gap beyond it makes a sample far
_FEW_DN = 4.0


@kernel
def find_cores(given: Histograms, ends: IntArray, far: BoolArray) -> None:
    """Find the bins that no gap cuts off from the core of a histogram, which holds 96 % of the frames.

    Fill first bin and the one after the last of each sample, (n, J, 2), and whether samples are beyond, (n,).
    """
    for index in range(far.size):
        far[index] = False
        for j in range(given.dark.size):
            counts = given.counts[index, given.places[j] : given.places[j + 1]]
            n = 0.0
            for i in range(counts.size):
                n += counts[i]
            low, high, below, above = 0, counts.size - 1, 0.0, 0.0
            while low < high and below + counts[low] < _CORE_TAIL * n:
                below += counts[low]
                low += 1
            while high > low and above + counts[high] < _CORE_TAIL * n:
                above += counts[high]
                high -= 1
            gap = _FAR * (high - low + 1.0) + _FEW_DN
            first, last = low, high
            for i in range(low, -1, -1):
                if counts[i] > 0:
                    if first - i > gap:
                        far[index] = True
                        break
                    first = i
            for i in range(high, counts.size):
                if counts[i] > 0:
                    if i - last > gap:
                        far[index] = True
                        break
                    last = i
            ends[index, j, 0], ends[index, j, 1] = first, last + 1
