"""Add shifts of code edges to a law that may have some already."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.model.law.sample_law import SampleLaw


def merged_edges(
    model: SampleLaw, first: int, shifts: NDArray[np.float64]
) -> tuple[int, NDArray[np.float64]]:
    """Return first code and shifts, DN, of the sum of the law's own shifts and these.

    Args:
        model: the law so far.
        first: code of the first shift.
        shifts: shift of the lower edge of the codes from ``first`` on, shape (n,).
    """
    if not model.edge_shift.size:
        return first, shifts
    start = min(first, model.edge_first)
    end = max(first + shifts.size, model.edge_first + model.edge_shift.size)
    total = np.zeros(end - start)
    total[first - start : first - start + shifts.size] += shifts
    own = model.edge_first - start
    total[own : own + model.edge_shift.size] += model.edge_shift
    return start, total
