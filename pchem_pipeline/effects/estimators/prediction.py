"""What the neighbours of a sample predict for it, as cameras that correct their pixels do.

Replacing a sample by the median of its eight neighbours is the usual correction of hot pixels and of
telegraph noise; their mean, or that of the left and the right one alone, are its cheaper forms.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

Predictor = Literal["median", "mean", "row"]
PREDICTORS: tuple[Predictor, ...] = get_args(Predictor)

_AROUND = tuple((dy, dx) for dy in range(3) for dx in range(3) if (dy, dx) != (1, 1))
# Batcher's odd-even merge sort of eight, as far as the sum of the middle two asks for it
_COMPARATORS = (
    (0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (1, 2), (5, 6),
    (0, 4), (1, 5), (2, 6), (3, 7), (2, 4), (3, 5),
)  # fmt: skip


def predicted(frames: NDArray[np.unsignedinteger[Any]], predictor: Predictor) -> NDArray[np.int32]:
    """Return what the neighbours predict for the samples inside the border, DN, halves cut off.

    Args:
        frames: codes (frame, y, x), DN.
        predictor: median or mean of the eight neighbours, or mean of the left and the right one.

    Returns:
        Of (frame, y - 2, x - 2) samples: those at the border have not all neighbours.
    """
    codes = frames.astype(np.int32)
    rows, columns = codes.shape[1] - 2, codes.shape[2] - 2
    around = [codes[:, dy : dy + rows, dx : dx + columns] for dy, dx in _AROUND]
    if predictor == "row":
        return np.asarray((around[3] + around[4]) // 2)
    if predictor == "mean":
        return np.asarray(sum(around[1:], around[0]) // 8)
    for low, high in _COMPARATORS:
        around[low], around[high] = (
            np.minimum(around[low], around[high]),
            np.maximum(around[low], around[high]),
        )
    return np.asarray((around[3] + around[4]) // 2)
