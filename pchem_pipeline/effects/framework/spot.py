"""A spot on the sensor: what is bright at one place and fades away from it."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.effects.framework.region import Span

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


def spot_to_window(
    spot: dict[str, Any], falloff: Falloff, rows: Span, columns: Span, shape: tuple[int, int]
) -> dict[str, float]:
    """Return a spot as it is on some rows and columns that are taken for a sensor of their own.

    Args:
        spot: ``centre_y``, ``centre_x``, ``radius`` and ``peak_e`` of an effect, and whatever else it has.
        falloff: see :func:`spot_image`.
        rows: first, and behind the last.
        columns: likewise.
        shape: rows and columns of the sensor.
    """
    centre, size = (spot["centre_y"], spot["centre_x"]), (rows[1] - rows[0], columns[1] - columns[0])
    # the brightest of these pixels is the one nearest to the centre
    nearest = [
        np.array([min(max(int(c * n), low), high - 1)])
        for c, n, (low, high) in zip(centre, shape, (rows, columns), strict=True)
    ]
    left = spot_image(nearest[0], nearest[1], shape, centre, spot["radius"], falloff)
    y, x = ((c * n - low) / m for c, n, (low, _), m in zip(centre, shape, (rows, columns), size, strict=True))
    radius = spot["radius"] * max(shape) / max(size)
    return {"centre_y": y, "centre_x": x, "radius": radius, "peak_e": spot["peak_e"] * float(left[0, 0])}


def spot_to_sensor(
    spot: dict[str, Any], rows: Span, columns: Span, shape: tuple[int, int]
) -> dict[str, float]:
    """Return on the sensor a spot that lies on some of its rows and columns; see `spot_to_window`."""
    centre, size = (spot["centre_y"], spot["centre_x"]), (rows[1] - rows[0], columns[1] - columns[0])
    y, x = ((c * m + low) / n for c, n, (low, _), m in zip(centre, shape, (rows, columns), size, strict=True))
    return {"centre_y": y, "centre_x": x, "radius": spot["radius"] * max(size) / max(shape)}
