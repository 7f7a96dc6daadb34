"""Whether samples are nearer to those of the same pixel one frame before than to those of other frames.

Whatever ties successive samples together, in proportion or not, changes how often they nearly agree. Of two
pairs of successive frames ``(x, y)`` and ``(x', y')`` the agreements of x with y and of x' with y' are
counted, less those of x with y' and of x' with y: what the law of either sample makes is in both, so that
without an effect the sum over pixels and frames has mean 0, and for its variance the sum of the squares.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe import laws
from pchem_pipeline.discrepancy.observe.digital.predicted import MOST_PAIRED, groups_of
from pchem_pipeline.effects.framework.evidence import PixelMaps

_WITHIN = (0.0, 0.15, 0.5, 1.5)  # read noises
_INDEPENDENT = 2.5  # of these
_FEWEST = 50.0  # pairs of which one agrees and another does not


def nearer_statistics(
    frames: NDArray[np.unsignedinteger[Any]], edges: NDArray[np.int64], maps: PixelMaps
) -> dict[str, float]:
    """Return the statistic of samples that are nearer to the one before than chance makes them.

    Args:
        frames: codes (frame, y, x), DN.
        edges: positions of the blocks, (b + 1,).
        maps: parameters of the pixels.
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
