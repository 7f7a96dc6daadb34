"""What the report of a joint fit is drawn from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.report.style.ranges import finite

__all__ = ["AXES", "JointData", "JointSample", "middle"]

#: Label, unit and noun of what the exposures are drawn against.
AXES = {
    "integration_time": ("integration time", "s", "dark current"),
    "light_level": ("light level", "", "charge per light level"),
}


@dataclass(frozen=True)
class JointSample:
    """One sample: its name, kind, integration time or light level, and frames."""

    name: str
    kind: str
    x: float | None
    n_frames: int


@dataclass(frozen=True)
class JointData:
    """All that the report of a joint fit shows.

    Attributes:
        title: heading.
        shape: rows and columns.
        n_frames: of all samples together.
        samples: in their order.
        against: integration_time, light_level or none.
        maps: shared maps and the line, with standard errors, (y, x).
        joint: arrays of the group ``joint``, (sample, y, x) or (y, x).
        status_words: bit to sentence.
        failed_mask: bits of pixels without a value.
        settings: of the joint fit, as YAML.
        notes: remarks of the stages.
        integration_time: none of its own.
        noun: what a row of data is.
    """

    title: str
    shape: tuple[int, int]
    n_frames: int
    samples: tuple[JointSample, ...]
    against: str
    maps: Mapping[str, NDArray[Any]]
    joint: Mapping[str, NDArray[Any]]
    status_words: Mapping[int, str]
    failed_mask: int
    settings: str = ""
    notes: tuple[str, ...] = ()
    integration_time: float | None = field(default=None, init=False)
    noun: str = "pixel"

    @property
    def on_line(self) -> list[int]:
        """Samples that the line goes through."""
        return [i for i, sample in enumerate(self.samples) if sample.x is not None]


def middle(values: NDArray[Any]) -> tuple[float, float, float, float]:
    """Return median, its standard error, and the 16 % and 84 % percentiles of the finite values."""
    known = np.sort(finite(values))
    if known.size == 0:
        return (float("nan"),) * 4
    low, centre, high = (float(q) for q in np.quantile(known, [0.1587, 0.5, 0.8413]))
    # of the median, from the ranks half a standard deviation of the rank to either side
    half, ranks = 0.5 * np.sqrt(known.size), np.arange(known.size)
    ends = np.interp([0.5 * (known.size - 1) - half, 0.5 * (known.size - 1) + half], ranks, known)
    return centre, 0.5 * float(ends[1] - ends[0]), low, high
