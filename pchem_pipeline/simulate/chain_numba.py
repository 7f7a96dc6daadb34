"""Compiled forward chain without effects: electrons, read noise, gain, bias and ADC in one pass."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.simulate.streams_numba import (
    normal_from_uniform,
    poisson_start,
    poisson_table,
    uniform_row,
)

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
def _fill_tables(exposure, tables, first, length):  # type: ignore[no-untyped-def]
    """Fill the tables of the electron numbers of a row of pixels."""
    for x in range(exposure.size):
        first[x], length[x] = poisson_table(exposure[x], tables[x])


@kernel
def _draw_row(frame, y, xs, k0, k1, tables, first, length, u, v, k, z):  # type: ignore[no-untyped-def]
    """Fill the electron numbers ``k`` of a row in a frame, and its normal numbers ``z``."""
    uniform_row(frame, y, xs, np.uint64(0), k0, k1, u, v)
    normal_from_uniform(v, z)
    for x in range(xs.size):
        k[x] = first[x] + _look_up(tables[x], length[x], u[x])


@kernel
def simulate_rows(  # type: ignore[no-untyped-def]
    exposure, gain, bias, noise, frames, ys, xs, k0, k1, top, dn, electrons
):
    """Fill ``dn`` (frame, y, x), and ``electrons`` as far as it has frames.

    Maps are (y, x) of the band, e-, e-/DN, DN, e-; coordinates uint64; ``top`` the largest DN.
    """
    nx = xs.size
    u, v, z, k = np.empty(nx), np.empty(nx), np.empty(nx), np.empty(nx)
    first, length = np.empty(nx, np.int64), np.empty(nx, np.int64)
    for y in range(ys.size):
        tables = np.empty((nx, _widest(exposure[y])))
        _fill_tables(exposure[y], tables, first, length)
        for t in range(frames.size):
            _draw_row(frames[t], ys[y], xs, k0, k1, tables, first, length, u, v, k, z)
            line = dn[t, y]
            for x in range(nx):
                value = np.rint((k[x] + noise[y, x] * z[x]) / gain[y, x] + bias[y, x])
                line[x] = dn.dtype.type(min(max(value, 0.0), top))
            if t < electrons.shape[0]:
                for x in range(nx):
                    electrons[t, y, x] = k[x]


@kernel
def draw_rows(exposure, noise, frames, ys, xs, k0, k1, charge, read_noise):  # type: ignore[no-untyped-def]
    """Fill ``charge`` and ``read_noise`` (frame, y, x), e-, with the draws of :func:`simulate_rows`.

    For chains whose exposure is the same in all frames: a table for each pixel is built once.
    """
    nx = xs.size
    u, v, z = np.empty(nx), np.empty(nx), np.empty(nx)
    first, length = np.empty(nx, np.int64), np.empty(nx, np.int64)
    for y in range(ys.size):
        tables = np.empty((nx, _widest(exposure[y])))
        _fill_tables(exposure[y], tables, first, length)
        for t in range(frames.size):
            _draw_row(frames[t], ys[y], xs, k0, k1, tables, first, length, u, v, charge[t, y], z)
            for x in range(nx):
                read_noise[t, y, x] = noise[y, x] * z[x]
