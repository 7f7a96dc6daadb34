"""Exponential and logarithm of eight numbers side by side, to the last bit or so."""

from __future__ import annotations

import math

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.simd_numba import Lanes, exponent_of, fused, nearest, scaled

LN2 = math.log(2.0)
ROOT2 = math.sqrt(2.0)
_PER_LN2 = 1.0 / LN2
_LN2_HIGH = float.fromhex("0x1.62e42fee00000p-1")  # its product with a small whole number is exact
_LN2_LOW = float.fromhex("0x1.a39ef35793c76p-33")

# polynomials through Chebyshev's nodes: artanh(q)/q in q^2 up to q = tan(pi/8), off by 3e-18, and exp(x) up
# to |x| = log(2)/2, off by 3e-16
_ARTANH = (
    (0.07404933786156531, 0.0765625655736915, 0.09091816120808513, 0.11111098523202137),
    (0.1428571438036914, 0.19999999999650955, 0.33333333333333826, 1.0),
)
_EXP = (
    (2.7626371065696354e-07, 2.764019739169484e-06, 2.480150431378554e-05, 0.00019841170230570286),
    (0.001388888893251478, 0.008333333385699212, 0.041666666666573066, 0.16666666666554314),
    (0.5000000000000006, 1.0000000000000067, 1.0),
)


@kernel(borrows=True)
def artanh_series(z: Lanes) -> Lanes:
    """Return ``artanh(q) / q`` of ``z = q^2``."""
    top, rest = _ARTANH
    series = fused(z, fused(z, fused(z, top[0], top[1]), top[2]), top[3])
    return fused(z, fused(z, fused(z, fused(z, series, rest[0]), rest[1]), rest[2]), rest[3])


@kernel(borrows=True)
def lanes_log(x: Lanes) -> Lanes:
    """Return log(x) of positive normal numbers.

    From the exponent and ``2 artanh((f - 1)/(f + 1))`` of the fraction f in [sqrt(1/2), sqrt(2)).
    """
    exponent = exponent_of(x * ROOT2)
    fraction = scaled(x, 0.0 - exponent)
    q = (fraction - 1.0) / (fraction + 1.0)
    return fused(exponent, LN2, 2.0 * q * artanh_series(q * q))


@kernel(borrows=True)
def lanes_exp(x: Lanes) -> Lanes:
    """Return exp(x) of numbers between -700 and 700: ``2^n`` and a polynomial for the rest."""
    top, middle, rest = _EXP
    power = nearest(x * _PER_LN2)
    y = fused(power, -_LN2_LOW, fused(power, -_LN2_HIGH, x))
    series = fused(y, fused(y, fused(y, top[0], top[1]), top[2]), top[3])
    series = fused(y, fused(y, fused(y, fused(y, series, middle[0]), middle[1]), middle[2]), middle[3])
    return scaled(fused(y, fused(y, fused(y, series, rest[0]), rest[1]), rest[2]), power)
