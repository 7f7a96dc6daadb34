"""Many tests at once: which pixels disagree with the model when chance is allowed for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["false_discovery"]


def false_discovery(probability: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return the false-discovery rate at which each of many tests would be called significant.

    The step-up procedure of Benjamini and Hochberg (1995): with the p-values in ascending order,
    ``q_(i) = min_(j >= i) p_(j) n / j``. Among the pixels with q below a limit the expected share of those
    that agree with the model is at most that limit, for independent pixels.

    Args:
        probability: p-values, any shape; NaN where nothing was tested.

    Returns:
        q-values, same shape, NaN where nothing was tested.

    Example:
        >>> false_discovery(np.array([0.01, 0.04, 0.5])).round(2).tolist()
        [0.03, 0.06, 0.5]
    """
    found = np.full(probability.shape, np.nan)
    tested = np.isfinite(probability)
    values = np.asarray(probability[tested], np.float64)
    if values.size == 0:
        return found
    order = np.argsort(values, kind="stable")
    scaled = values[order] * values.size / np.arange(1, values.size + 1)
    adjusted = np.minimum.accumulate(scaled[::-1])[::-1]
    q = np.empty(values.size)
    q[order] = np.minimum(adjusted, 1.0)
    found[tested] = q
    return found
