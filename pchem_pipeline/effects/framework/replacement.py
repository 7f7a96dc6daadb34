"""Samples in whose stead another number of their frame comes out, by a rule that says which and what."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Replacement(NamedTuple):
    """A rule: of the samples that exceed a number by more than so much, that number comes out.

    Attributes:
        value: the number, DN, shape (frame, y, x).
        inside: pixels for which the rule holds, shape (y, x).
        excess: by how much, DN.
        share: of those samples that is replaced, no unit.
    """

    value: NDArray[np.integer[Any]]
    inside: NDArray[np.bool_]
    excess: int
    share: float
