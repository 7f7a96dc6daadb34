"""Every array of two runs compared value by value, in blocks, with a digest of each for the record."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import VARIABLES
from pchem_pipeline.model.checks.run_differences import BlockDifference, compare_blocks
from pchem_pipeline.report.comparison import ArrayRow
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.store.run_store import RunStore

#: Groups that are left out, and why.
NOT_COMPARED = {
    "frames": "same digest of the camera files",
    "electrons": "computed from frames and maps",
    "ensemble_tiles": "intermediate sums, depend on the tiling",
}
#: What a computation counts of itself; no result.
_BOOKKEEPING = ("fit/n_iterations",)
_BLOCK_BYTES = 1 << 25


def compare_arrays(one: RunStore, other: RunStore, tolerance: float, reporter: Reporter) -> list[ArrayRow]:
    """Compare all arrays that either store has.

    Args:
        one: a run.
        other: a run on the same frames.
        tolerance: difference that counts as rounding, relative to the largest value of an array.
        reporter: hears of each array.

    Returns:
        A row for each array, in the order of the registry.
    """
    names = [
        name
        for name, variable in VARIABLES.items()
        if variable.group not in NOT_COMPARED and (one.has(name) or other.has(name))
    ]
    rows = []
    with reporter.progress("compare", len(names), "array") as advance:
        for name in names:
            rows.append(_row(name, one, other, tolerance))
            advance()
    return rows


def _row(name: str, one: RunStore, other: RunStore, tolerance: float) -> ArrayRow:
    counts = name not in _BOOKKEEPING
    here = one if one.has(name) else other
    array = here.array(name)
    dtype, shape = str(array.dtype), tuple(array.shape)
    if not (one.has(name) and other.has(name)):
        state: Any = "lost" if here is one else "new"
        return ArrayRow(name, state, counts, dtype, shape)
    if shape != tuple(other.array(name).shape):
        why = f"shape {shape} before, {tuple(other.array(name).shape)} now"
        return ArrayRow(name, "changed", counts, dtype, shape, why=why)
    digests, scales = zip(*(_digest(store, name) for store in (one, other)), strict=True)
    n_values = int(np.prod(shape))
    if digests[0] == digests[1] and str(other.array(name).dtype) == dtype:
        return ArrayRow(name, "identical", counts, dtype, shape, n_values, scale=scales[0], sha256=digests)
    scale = max(scales)
    found = BlockDifference(0, 0, 0, 0.0)
    for a, b in zip(_blocks(one, name), _blocks(other, name), strict=True):
        found += compare_blocks(a, b, scale=scale, tolerance=tolerance)
    return ArrayRow(
        name, "changed" if found.n_beyond else "equal", counts, dtype, shape, found.n_values,
        found.n_different, found.n_beyond, found.largest, scale, digests,
    )  # fmt: skip


def _digest(store: RunStore, name: str) -> tuple[str, float]:
    """Return the SHA-256 of an array's values in C order, and their largest absolute value."""
    digest, scale = hashlib.sha256(), 0.0
    for block in _blocks(store, name):
        digest.update(np.ascontiguousarray(block).data)
        if block.size:
            size = np.abs(block.astype(np.float64, copy=False))
            scale = max(scale, float(np.max(size, initial=0.0, where=np.isfinite(size))))
    return digest.hexdigest(), scale


def _blocks(store: RunStore, name: str) -> Iterator[NDArray[Any]]:
    """Read an array in blocks along its first axis, the same ones for every store."""
    array = store.array(name)
    shape = tuple(array.shape)
    if not shape:
        yield store.read(name)
        return
    row_bytes = max(1, int(np.prod(shape[1:])) * array.dtype.itemsize)
    chunk = int(array.chunks[0])
    rows = max(1, _BLOCK_BYTES // row_bytes)
    rows = max(rows // chunk, 1) * chunk if chunk <= 4 * rows else rows
    for start in range(0, shape[0], rows):
        yield store.read(name, (slice(start, min(start + rows, shape[0])),))
