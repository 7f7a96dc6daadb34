"""Whether samples follow the bits of the sample read just before them in their row.

What a sample has in common with the value of the one before is crosstalk of many kinds; what it has in common
with single bits of it, beyond that value, is only of the converter's making. Differences of successive frames
are regressed, so that nothing constant counts; without an effect they are independent of all others.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe import laws
from pchem_pipeline.discrepancy.observe.digital.predicted import MOST_PAIRED, groups_of
from pchem_pipeline.effects.framework.evidence import PreviousBits

FloatArray = NDArray[np.float64]

BITS = 8  # the lowest ones
_SMALLEST = 1e-4  # variance of a bit that the value before leaves, relative: below it is that value


def previous_bits(
    frames: NDArray[np.unsignedinteger[Any]],
    edges: NDArray[np.int64],
    usable: NDArray[np.bool_],
    noise: FloatArray,
) -> PreviousBits | None:
    """Return the regression of samples on the bits of those before; None where there are too few.

    Args:
        frames: codes (frame, y, x), DN.
        edges: positions of the blocks, (b + 1,).
        usable: pixels that count, (y, x).
        noise: standard deviation of the samples of each pixel, DN, (y, x).
    """
    pairs = usable[:, 1:] & usable[:, :-1]
    first = groups_of(edges, usable.size, MOST_PAIRED)
    if not first.size or not pairs.any():
        return None
    # of each group two pairs of frames
    later = (first[:, None] + np.array([1, 3])).ravel()
    one, two = frames[later], frames[later - 1]
    weight = np.where(pairs, 1.0 / noise[:, 1:], 0.0).astype(np.float32)
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
    kept = (eigenvalues > _SMALLEST * eigenvalues.max()) if eigenvalues.size else np.zeros(0, np.bool_)
    if not kept.any():
        return {}
    projected = vectors.T[kept] @ (found.product / scale)
    total = float(np.sum(projected**2 / eigenvalues[kept])) / max(found.variance, 1e-300)
    return {"space.x.bits": float(laws.chi_square(total, float(kept.sum())))}
