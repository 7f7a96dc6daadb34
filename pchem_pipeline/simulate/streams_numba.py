"""Compiled random numbers: Philox4x32-10 blocks, normal and Poisson numbers by inversion, and samples.

Every number is a function of a key and a position, so there is no state to pass on and no order
in which numbers must be drawn. One block of 128 bits gives two uniform numbers of 52 bits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel

_MASK = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
# multipliers and Weyl constants of Philox4x32 (Salmon, Moraes, Dror and Shaw, SC11)
_M0 = np.uint64(0xD2511F53)
_M1 = np.uint64(0xCD9E8D57)
_W0 = np.uint64(0x9E3779B9)
_W1 = np.uint64(0xBB67AE85)
_SHIFT = np.uint64(12)
_TO_UNIT = 2.0**-52
_LARGEST = 1.0 - 2.0**-53


@kernel(inline=True)
def philox_block(c0, c1, c2, c3, k0, k1):  # type: ignore[no-untyped-def]
    """Return the four 32-bit words of one Philox4x32-10 block, as uint64 (arguments: uint64 below 2**32)."""
    for _ in range(10):
        p0 = _M0 * c0
        p1 = _M1 * c2
        c0, c1, c2, c3 = (p1 >> _HALF) ^ c1 ^ k0, p1 & _MASK, (p0 >> _HALF) ^ c3 ^ k1, p0 & _MASK
        k0 = (k0 + _W0) & _MASK
        k1 = (k1 + _W1) & _MASK
    return c0, c1, c2, c3


@kernel
def uniform_row(frame, y, xs, draw, k0, k1, first, second):  # type: ignore[no-untyped-def]
    """Fill ``first`` and ``second`` with the uniforms in (0, 1) of a row's positions (all uint64)."""
    for i in range(xs.size):
        a, b, c, d = philox_block(frame, xs[i], y, draw, k0, k1)
        # half a step off the grid: never 0 and never 1, so that every quantile is finite
        first[i] = (np.float64(((a << _HALF) | b) >> _SHIFT) + 0.5) * _TO_UNIT
        second[i] = (np.float64(((c << _HALF) | d) >> _SHIFT) + 0.5) * _TO_UNIT


@kernel
def fill_uniform(frames, ys, xs, draw, k0, k1, first, second):  # type: ignore[no-untyped-def]
    """Fill two (frame, y, x) arrays with the uniforms of all combinations of the coordinates (uint64)."""
    for t in range(frames.size):
        for j in range(ys.size):
            uniform_row(frames[t], ys[j], xs, draw, k0, k1, first[t, j], second[t, j])


# Wichura 1988, AS 241: numerator and denominator of three rational functions, highest power first
_CENTRE_NUM = (
    2.5090809287301226727e3,
    3.3430575583588128105e4,
    6.7265770927008700853e4,
    4.5921953931549871457e4,
    1.3731693765509461125e4,
    1.9715909503065514427e3,
    1.3314166789178437745e2,
    3.3871328727963666080e0,
)
_CENTRE_DEN = (
    5.2264952788528545610e3,
    2.8729085735721942674e4,
    3.9307895800092710610e4,
    2.1213794301586595867e4,
    5.3941960214247511077e3,
    6.8718700749205790830e2,
    4.2313330701600911252e1,
    1.0,
)
_MIDDLE_NUM = (
    7.74545014278341407640e-4,
    2.27238449892691845833e-2,
    2.41780725177450611770e-1,
    1.27045825245236838258e0,
    3.64784832476320460504e0,
    5.76949722146069140550e0,
    4.63033784615654529590e0,
    1.42343711074968357734e0,
)
_MIDDLE_DEN = (
    1.05075007164441684324e-9,
    5.47593808499534494600e-4,
    1.51986665636164571966e-2,
    1.48103976427480074590e-1,
    6.89767334985100004550e-1,
    1.67638483018380384940e0,
    2.05319162663775882187e0,
    1.0,
)
_FAR_NUM = (
    2.01033439929228813265e-7,
    2.71155556874348757815e-5,
    1.24266094738807843860e-3,
    2.65321895265761230930e-2,
    2.96560571828504891230e-1,
    1.78482653991729133580e0,
    5.46378491116411436990e0,
    6.65790464350110377720e0,
)
_FAR_DEN = (
    2.04426310338993978564e-15,
    1.42151175831644588870e-7,
    1.84631831751005468180e-5,
    7.86869131145613259100e-4,
    1.48753612908506148525e-2,
    1.36929880922735805310e-1,
    5.99832206555887937690e-1,
    1.0,
)


@kernel(inline=True)
def _polynomial(c, r):  # type: ignore[no-untyped-def]
    upper = (((c[0] * r + c[1]) * r + c[2]) * r + c[3]) * r
    return (((upper + c[4]) * r + c[5]) * r + c[6]) * r + c[7]


@kernel(inline=True)
def _normal_centre(q):  # type: ignore[no-untyped-def]
    r = 0.180625 - q * q
    return q * _polynomial(_CENTRE_NUM, r) / _polynomial(_CENTRE_DEN, r)


@kernel
def _normal_tail(q, tail):  # type: ignore[no-untyped-def]
    r = math.sqrt(-math.log(tail))
    if r <= 5.0:
        z = _polynomial(_MIDDLE_NUM, r - 1.6) / _polynomial(_MIDDLE_DEN, r - 1.6)
    else:
        z = _polynomial(_FAR_NUM, r - 5.0) / _polynomial(_FAR_DEN, r - 5.0)
    return -z if q < 0.0 else z


@kernel
def normal_from_uniform(p, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` with standard normal quantiles of ``p`` (1-D), Wichura 1988, AS 241, PPND16.

    Two passes: the centre for everybody, which the compiler vectorises, then the tails.
    """
    for i in range(p.size):
        out[i] = _normal_centre(p[i] - 0.5)
    for i in range(p.size):
        q = p[i] - 0.5
        if abs(q) > 0.425:
            out[i] = _normal_tail(q, p[i] if q < 0.0 else 1.0 - p[i])


@kernel
def poisson_start(mean):  # type: ignore[no-untyped-def]
    """Return the first electron number whose probability matters, its probability, and the last one."""
    spread = 9.0 * math.sqrt(mean)
    first = max(0, int(mean - spread - 10.0))
    last = int(mean + spread + 20.0)
    if first == 0:
        return 0, math.exp(-mean), last
    if first < 100:
        return first, math.exp(first * math.log(mean) - mean - math.lgamma(first + 1.0)), last
    # the logarithms above would cancel: Loader 2000, with Stirling's series and the deviance
    stirling = (1.0 / 12.0 - (1.0 / 360.0 - 1.0 / (1260.0 * first * first)) / (first * first)) / first
    d = (first - mean) / mean
    deviance = mean * ((1.0 + d) * math.log1p(d) - d)
    return first, math.exp(-stirling - deviance) / math.sqrt(2.0 * math.pi * first), last


@kernel
def poisson_quantile(u, mean):  # type: ignore[no-untyped-def]
    """Return the smallest k with P(K <= k) >= u for K ~ Poisson(mean), by adding up the masses."""
    k, mass, last = poisson_start(mean)
    below = mass
    while u > below and k < last:
        k += 1
        mass *= mean / k
        below += mass
    return k


@kernel
def poisson_from_uniform(u, mean, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` with the Poisson quantiles of ``u`` (all 1-D, same length)."""
    for i in range(u.size):
        out[i] = poisson_quantile(u[i], mean[i])


@kernel
def poisson_table(mean, table):  # type: ignore[no-untyped-def]
    """Write the cumulative masses into ``table``; return (first k, number of entries).

    The sums are those of :func:`poisson_quantile`, so that looking up gives the same numbers.
    """
    k, mass, last = poisson_start(mean)
    first = k
    below = mass
    n = 0
    while True:
        table[n] = below
        n += 1
        if below >= _LARGEST or k >= last:
            return first, n
        k += 1
        mass *= mean / k
        below += mass


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
