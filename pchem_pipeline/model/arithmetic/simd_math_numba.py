"""Exponential, logarithm and tail of the normal law of eight numbers side by side, to the last bits."""

from __future__ import annotations

import math

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.simd_numba import (
    Simd,
    counting,
    exponent_of,
    fused,
    least,
    most,
    nearest,
    scaled,
)

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
# the tail Q(z) of the normal law: exp(z^2 / 2) Q(z) (1 + sqrt(2) z) in t = (z - c) / (z + c) with
# c = 3.75 sqrt(2) (Shepherd and Laframboise 1981), through Chebyshev's nodes, off by 1.2e-16; odd and even
# powers
_TAIL_CENTRE = 3.75 * ROOT2
_TAIL_ODD = (
    *(1.5557166904899627e-10, -1.872105040481009e-09, 1.1631754354429562e-08, -2.8609115301612043e-08),
    *(-4.867799483683875e-07, 1.1192119577541115e-05, -0.00014507704027042086, 0.0008778129264476477),
    *(0.014181138709478203, 0.04615216058018874, 0.0411383692450726, -0.07012029929277348),
)
_TAIL_EVEN = (
    *(-1.311553673566738e-09, 1.598963335833402e-08, -1.2428563124008372e-07, 8.709910793112408e-07),
    *(-5.719024016673447e-06, 2.582326487088708e-05, 0.000146857189022479, -0.004873289841632631),
    *(-0.02934669928832467, -0.05440196507122231, 0.0017927077427395128, 0.6187563154189137),
)
_FARTHEST = 37.4  # where exp(-z^2 / 2) is 1e-304
_STEEP = 1e300  # makes a sign of a number
PER_ROOT_2PI = 1.0 / math.sqrt(2.0 * math.pi)


@kernel(borrows=True)
def simd_log(x: Simd) -> Simd:
    """Return log(x) of positive normal numbers, by ``2 artanh((f - 1)/(f + 1))`` of the fraction f."""
    top, rest = _ARTANH
    exponent = exponent_of(x * ROOT2)
    fraction = scaled(x, 0.0 - exponent)
    q = (fraction - 1.0) / (fraction + 1.0)
    z = q * q
    series = fused(z, fused(z, fused(z, top[0], top[1]), top[2]), top[3])
    series = fused(z, fused(z, fused(z, fused(z, series, rest[0]), rest[1]), rest[2]), rest[3])
    return fused(exponent, LN2, 2.0 * q * series)


@kernel(borrows=True)
def simd_exp(x: Simd) -> Simd:
    """Return exp(x) of numbers between -700 and 700: ``2^n`` and a polynomial for the rest."""
    top, middle, rest = _EXP
    power = nearest(x * _PER_LN2)
    y = fused(power, -_LN2_LOW, fused(power, -_LN2_HIGH, x))
    series = fused(y, fused(y, fused(y, top[0], top[1]), top[2]), top[3])
    series = fused(y, fused(y, fused(y, fused(y, series, middle[0]), middle[1]), middle[2]), middle[3])
    return scaled(fused(y, fused(y, fused(y, series, rest[0]), rest[1]), rest[2]), power)


@kernel(borrows=True)
def simd_tail(z: Simd) -> tuple[Simd, Simd, Simd]:
    """Return the nearer tail of the normal law, negative above the middle, the density, and z times that.

    The difference of two such tails is the mass between two values on one side of the middle without
    cancellation; where they lie on either side, it is the mass less one. Good to 1e-14 of itself within 8
    standard deviations and to 1e-12 at 37.4, beyond which all is as there.
    """
    near = least(most(z, -_FARTHEST), _FARTHEST)
    side = least(most(1.0 - near * _STEEP, -1.0), 1.0)
    distance = near * (0.0 - side)
    beside, slope = distance + _TAIL_CENTRE, fused(distance, ROOT2, 1.0)
    both = 1.0 / (beside * slope)
    t = (distance - _TAIL_CENTRE) * slope * both
    square = t * t
    odd = even = counting() * 0.0
    for power in range(len(_TAIL_ODD)):
        odd = fused(odd, square, _TAIL_ODD[power])
        even = fused(even, square, _TAIL_EVEN[power])
    bell = simd_exp(near * near * -0.5)
    density = bell * PER_ROOT_2PI
    return side * bell * fused(odd, t, even) * beside * both, density, near * density
