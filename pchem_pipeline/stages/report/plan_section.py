"""What the report says on frames: those that precisions need at the run's median pixel."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.model.maps.ordered import median_of
from pchem_pipeline.planning.frames import contour_data, frames_needed, precision
from pchem_pipeline.planning.point import Point
from pchem_pipeline.planning.targets import Target, parse_target

_TARGETS = ("conversion_gain=1%", "read_noise_e=1%", "quanta_exposure=1%", "bias=0.02e-")
_DRAWN = _TARGETS[:2]
_FINE = 14  # points along each axis of the figure


def plan_section(maps: Mapping[str, NDArray[Any]], n_frames: int | None) -> dict[str, Any] | None:
    """Return the numbers of the section, or None where no pixel has a value.

    Args:
        maps: of the run.
        n_frames: frames of the run, or None where pixels differ.
    """
    names = ("quanta_exposure", "read_noise_e", "conversion_gain")
    medians = [median_of(maps[name]) for name in names if name in maps]
    if len(medians) < len(names) or not np.isfinite(medians).all():
        return None
    exposure, noise, gain = medians
    try:
        point = Point(exposure, noise, gain)
    except ConfigError:
        return None
    rows = [
        {"target": str(target), "name": target.name, "frames": frames_needed(target, point)}
        for target in map(parse_target, _TARGETS)
    ]
    reached = {} if n_frames is None else precision(point, n_frames)
    mark = (exposure, noise)
    return {"rows": rows, "reached": reached, "n_frames": n_frames, "mark": mark, "contours": _contours()}


@functools.cache
def _contours() -> dict[str, Any]:
    """Return the frames over exposure and read noise; relative targets look alike for every sensor."""
    targets: list[Target] = [parse_target(text) for text in _DRAWN]
    return contour_data(targets, 0.01, fine=_FINE)
