"""Time profiles of a slow change along the run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["SETTLING", "settling"]

#: time constants that estimators try, in lengths of the run
SETTLING = (0.05, 0.1, 0.2, 0.4)


def settling(position: NDArray[np.float64], fraction: float) -> NDArray[np.float64]:
    """Return an exponential approach to the end, of mean 0 and range 1 over the run.

    Args:
        position: times from 0 (first frame) to 1 (last frame).
        fraction: time constant in lengths of the run.
    """
    whole = -np.expm1(-1.0 / fraction)
    mean = (1.0 - fraction * whole) / whole
    profile: NDArray[np.float64] = -np.expm1(-position / fraction) / whole - mean
    return profile
