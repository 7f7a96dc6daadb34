"""Compiled draws of electron numbers and read noise of samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.simulate.streams_numba import (
    normal_from_uniform,
    poisson_start,
    poisson_table,
    uniform_row,
)


class SampleKeys(NamedTuple):
    """What the random numbers of samples come from.

    Attributes:
        frames, ys, xs: counter words of frames, rows and columns, uint64.
        key: two words.
    """

    frames: NDArray[np.uint64]
    ys: NDArray[np.uint64]
    xs: NDArray[np.uint64]
    key: tuple[np.uint64, np.uint64]


class _Row(NamedTuple):
    """Room for a row of samples: tables of the electron numbers, uniform and normal numbers."""

    tables: FloatArray
    first: IntArray
    length: IntArray
    u: FloatArray
    v: FloatArray
    z: FloatArray


# tables up to this length are searched from the bottom, longer ones by bisection
_LINEAR = 48


@kernel
def _look_up(table, n, u):  # type: ignore[no-untyped-def]
    if n <= _LINEAR:
        i = 0
        while i < n - 1 and u > table[i]:
            i += 1
        return i
    low = 0
    high = n - 1
    while low < high:
        middle = (low + high) // 2
        if u > table[middle]:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def _widest(mean):  # type: ignore[no-untyped-def]
    widest = 1
    for x in range(mean.size):
        first, _, last = poisson_start(mean[x])
        widest = max(widest, last - first + 1)
    return widest


@kernel
def _prepared(exposure, n):  # type: ignore[no-untyped-def]
    """Return the room for a row of pixels with the tables of their electron numbers."""
    tables, first, length = np.empty((n, _widest(exposure))), np.empty(n, np.int64), np.empty(n, np.int64)
    for x in range(n):
        first[x], length[x] = poisson_table(exposure[x], tables[x])
    return _Row(tables, first, length, np.empty(n), np.empty(n), np.empty(n))


@kernel
def _draw_row(frame, y, keys, row, k):  # type: ignore[no-untyped-def]
    """Fill the electron numbers ``k`` of a row in a frame, and its normal numbers ``row.z``."""
    uniform_row(frame, y, keys.xs, np.uint64(0), keys.key[0], keys.key[1], row.u, row.v)
    normal_from_uniform(row.v, row.z)
    for x in range(keys.xs.size):
        k[x] = row.first[x] + _look_up(row.tables[x], row.length[x], row.u[x])


@kernel
def draw_rows(exposure, noise, keys, charge, read_noise):  # type: ignore[no-untyped-def]
    """Fill ``charge`` and ``read_noise`` (frame, y, x), e-, where the exposure is the same in all frames.

    Maps are (y, x) of the band, e-; ``keys`` those of :class:`SampleKeys`. Each pixel's table is built once.
    """
    nx = keys.xs.size
    for y in range(keys.ys.size):
        row = _prepared(exposure[y], nx)
        for t in range(keys.frames.size):
            _draw_row(keys.frames[t], keys.ys[y], keys, row, charge[t, y])
            for x in range(nx):
                read_noise[t, y, x] = noise[y, x] * row.z[x]
