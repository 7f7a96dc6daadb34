"""Rows and columns that are, sample by sample, those before them in the same frame.

In analog data that never happens by chance, unless a line is a few pixels long.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe import laws

_FIRST = 2  # samples of a line that are compared before all of them are
_IMPOSSIBLE = 1e-3  # repeats by chance, below which each is proof


def repeated_lines(frames: NDArray[np.unsignedinteger[Any]]) -> dict[str, int]:
    """Return how many rows and how many columns of frames (frame, y, x) repeat the one before."""
    return {"rows": _repeats(frames), "columns": _repeats(frames.swapaxes(1, 2))}


def _repeats(frames: NDArray[np.unsignedinteger[Any]]) -> int:
    """Return how many rows repeat the one above."""
    first = frames[:, :, :_FIRST]
    t, y = np.nonzero((first[:, 1:] == first[:, :-1]).all(axis=2))
    return int((frames[t, y + 1] == frames[t, y]).all(axis=1).sum())


def line_statistics(found: dict[str, int], alike: NDArray[np.float64], n_frames: int) -> dict[str, float]:
    """Return the statistics of repeated lines; none of lines so short that chance repeats them.

    Args:
        found: repeats of rows and of columns.
        alike: log of the chance that two samples of a pixel are equal, (y, x).
        n_frames: that were looked at.
    """
    z = {}
    for axis, name in ((1, "rows"), (0, "columns")):
        expected = n_frames * float(np.exp(np.minimum(alike.sum(axis=axis), 0.0)).sum())
        if expected < _IMPOSSIBLE and alike.shape[1 - axis] > 1:
            z[f"space.repeated.{name}"] = laws.repeats(found[name], expected)
    return z
