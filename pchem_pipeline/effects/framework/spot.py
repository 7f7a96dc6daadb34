"""A spot on the sensor: what is bright at one place and fades away from it."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Falloff = Literal["gaussian", "exponential"]


def spot_image(
    rows: NDArray[np.int64] | NDArray[np.float64],
    columns: NDArray[np.int64] | NDArray[np.float64],
    shape: tuple[int, ...],
    centre: tuple[float, float],
    radius: float,
    falloff: Falloff = "gaussian",
) -> NDArray[np.float64]:
    """Return the brightness of a spot relative to the sensor's brightest pixel, shape (rows, columns).

    Args:
        rows: of the pixels.
        columns: of the pixels.
        shape: rows and columns of the sensor.
        centre: its row over the number of rows, and its column over that of columns.
        radius: over the longer side of the sensor: standard deviation of a Gaussian, or the distance in which
            an exponential falls to 1/e.
        falloff: which of them.
    """
    side = max(shape)
    dy = ((rows + 0.5) / shape[0] - centre[0]) * shape[0] / side
    dx = ((columns + 0.5) / shape[1] - centre[1]) * shape[1] / side
    # the pixel nearest to the centre, which may lie between pixels or on the border
    nearest = [
        (min(max(int(c * n), 0), n - 1) + 0.5 - c * n) / side for c, n in zip(centre, shape, strict=True)
    ]
    away, least = (dy[:, None] ** 2 + dx**2) / radius**2, (nearest[0] ** 2 + nearest[1] ** 2) / radius**2
    if falloff == "gaussian":
        return np.asarray(np.exp(0.5 * (least - away)))
    return np.asarray(np.exp(np.sqrt(least) - np.sqrt(away)))
