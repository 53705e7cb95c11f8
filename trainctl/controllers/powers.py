"""Signed powers of many numbers at once, for laws that are full of them.

The mathematical library is called for one number after the other, and that took half of the time of the finite-time law. Here
``|x|**alpha = 2**(alpha log2 |x|)`` is a plain sum of products, which the compiler evaluates for four or eight numbers together.
It also is the same on every machine, as the library's is not.
"""

from __future__ import annotations

import math

import numpy as np

from trainctl.kernels import inlined
from trainctl.signals import Floats

#: As many numbers as one pass of the compiled loop takes, or two; what is left over is slow.
BLOCK = 8

#: Below this, the smallest number of full precision, a power is 0.
SMALLEST = 2.2250738585072014e-308

#: Bits of a number: exponent above the mantissa, and the exponent of 1.
MANTISSA, ONE = 52, 1023

#: Bits of sqrt(1/2), and those that keep 25 bits of the mantissa, whose product with an exponent is exact.
SQRT_HALF, UPPER = 0x3FE6A09E667F3BCD, -(1 << 28)

#: log2((1 + s) / (1 - s)) = s (L0 + L1 s**2 + ...), for |s| < 0.172.
L0, L1, L2, L3, L4, L5, L6, L7, L8, L9 = (2.0 / (math.log(2.0) * (2 * k + 1)) for k in range(10))

#: 2**f = E0 + E1 f + ..., for |f| <= 1/2.
E0, E1, E2, E3, E4, E5, E6, E7, E8, E9, E10, E11, E12, E13 = (math.log(2.0) ** k / math.factorial(k) for k in range(14))


@inlined()
def signed_powers(x: Floats, alpha: float, out: Floats) -> None:
    """Write sign(x) |x|**alpha into ``out``, good to 5e-16 of itself.

    Parameters
    ----------
    x : ndarray, shape (k,)
        Any numbers; k should be a multiple of ``BLOCK``.
    alpha : float
        Exponent, above 0 and at most 1.
    out : ndarray, shape (k,)
        The powers; NaN where ``x`` is not finite.
    """
    upper = np.int64(np.float64(alpha).view(np.int64) & UPPER).view(np.float64)
    lower = alpha - upper
    for k in range(len(x)):
        size = np.float64(abs(x[k]))
        bits = size.view(np.int64)
        exponent = (bits - SQRT_HALF) >> MANTISSA
        m = np.int64(bits - (exponent << MANTISSA)).view(np.float64)  # size = m 2**exponent, sqrt(1/2) <= m < sqrt(2)
        s = (m - 1.0) / (m + 1.0)
        p = s * s
        p2 = p * p
        p4 = p2 * p2
        log = s * (((L0 + L1 * p) + p2 * (L2 + L3 * p)) + p4 * ((L4 + L5 * p) + p2 * (L6 + L7 * p) + p4 * (L8 + L9 * p)))
        whole = math.floor(upper * exponent + alpha * log + 0.5)
        f = (upper * exponent - whole) + (lower * exponent + alpha * log)
        f2 = f * f
        f4 = f2 * f2
        power = ((E0 + E1 * f) + f2 * (E2 + E3 * f)) + f4 * (
            (E4 + E5 * f) + f2 * (E6 + E7 * f) + f4 * ((E8 + E9 * f) + f2 * (E10 + E11 * f) + f4 * (E12 + E13 * f))
        )
        scaled = power * np.int64(np.int64(whole + ONE) << MANTISSA).view(np.float64)
        out[k] = math.copysign(0.0 if size < SMALLEST else scaled + (size - size), x[k])
