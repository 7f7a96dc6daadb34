"""Which lines of a frame its offset follows, and how much: the part of a black-level clamp that can be seen.

With s the mean deviation of the clamp's pixels in a frame before the clamp, and f the part that is taken off,
all samples move by ``-f s``, and the mean readout residual of the frame by alpha times that (alpha:
:mod:`pchem_pipeline.effects.estimators.common_modes`). What lines show, less the offset of their frame, is
theirs before the clamp, whatever else moves all pixels alike: so f is a regression on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pchem_pipeline.effects.estimators.common_modes import responsivity
from pchem_pipeline.effects.types import Evidence, FloatArray

_LEAST_GAIN = 9.0  # nats: some 500 overlapping ranges are tried
_PRICE_OF_PLACE = 4.0  # nats that the choice of two ends brings by chance
# of an offset, the share that is taken from the lines: all of a large noise of frames would be too much where
# its response is not quite known
_SURE = 0.9
_MOST_LINES = 64  # groups of lines whose ranges are tried


@dataclass(frozen=True)
class Clamp:
    """Part that is taken off, and the lines whose mean it is of (None: all), with the number of pixels."""

    follow: float
    rows: tuple[int, int] | None
    columns: tuple[int, int] | None
    pixels: int


def best_clamp(evidence: Evidence) -> Clamp | None:
    """Return the clamp that explains the frames' offsets best; None if a noise of frames does as well."""
    if evidence.time is None or evidence.maps.usable.sum() < 2:
        return None
    offset = evidence.time.frame_readout.astype(np.float64) / responsivity(evidence)
    offset = offset - offset.mean()
    seen = _SURE * offset
    best, gain = None, _LEAST_GAIN
    for axis in (1, 0):
        content, count = _contents(evidence, axis)
        group = np.arange(count.size) // -(-count.size // _MOST_LINES)
        first = np.append(np.flatnonzero(np.diff(group, prepend=-1)), count.size)
        # sums of all lines before each, less the offset of the frame
        pixels = np.append(0.0, np.cumsum(count))[first]
        before = np.pad(np.cumsum(content, axis=1), ((0, 0), (1, 0)))[:, first] - seen[:, None] * pixels
        products, along = before.T @ before, before.T @ offset
        a, b = np.triu_indices(first.size, 1)
        square = np.maximum(products[a, a] + products[b, b] - 2.0 * products[a, b], 1e-12)
        against = np.maximum(along[a] - along[b], 0.0)
        share = np.minimum(against**2 / square / max(float(offset @ offset), 1e-300), 1.0 - 1e-9)
        gains = -0.5 * offset.size * np.log1p(-share)
        whole = pixels[b] - pixels[a] == pixels[-1]
        # a part of the frame only where it explains more than the frame
        gains[whole] += _PRICE_OF_PLACE
        place = int(gains.argmax())
        if gains[place] > gain:
            number, span = pixels[b] - pixels[a], (int(first[a[place]]), int(first[b[place]]))
            rows, columns = (span, None) if axis == 1 else (None, span)
            where = (None, None) if whole[place] else (rows, columns)
            follow = min(float(against[place] / square[place] * number[place]), 1.0)
            best, gain = Clamp(follow, *where, int(number[place])), float(gains[place])
    return best


def _contents(evidence: Evidence, axis: int) -> tuple[FloatArray, FloatArray]:
    """Return how rows (axis 1) or columns (axis 0) deviate in each frame, sums in DN, and their pixels."""
    time, usable = evidence.time, evidence.maps.usable
    assert time is not None
    charge, readout = (
        (time.row_charge, time.row_readout) if axis == 1 else (time.column_charge, time.column_readout)
    )
    count = usable.sum(axis=axis).astype(np.float64)
    gain = np.where(usable, evidence.maps.conversion_gain, 0.0).sum(axis=axis) / np.maximum(count, 1.0)
    content = np.nan_to_num((readout + charge / np.where(gain > 0, gain, 1.0)) * count).astype(np.float64)
    return content - content.mean(axis=0), count
