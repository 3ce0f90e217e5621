"""Elementary functions and random numbers, written once for plain and for traced arrays.

They use +, -, *, / and exact operations on bits in a fixed order.
A result therefore depends neither on the batch, nor on the machine's mathematical library, nor on the compiler.

References: Salmon et al., *Parallel random numbers: as easy as 1, 2, 3*, SC11 (Philox4x32-10); Box and Muller 1958.
"""

from __future__ import annotations

import numpy as np

from tailgate.engine.operations import Array
from tailgate.engine.routines import routine

LN2_HI = 6.93147180369123816490e-01  # ln 2 with its last bits zero: n * LN2_HI is exact for |n| < 2**20
LN2_LO = 1.90821492927058770002e-10
LOG2_E = 1.44269504088896338700e00
TWO_PI = 6.283185307179586
TWO_52, TWO_52_BITS = 4503599627370496.0, np.int64(0x4330000000000000)  # adding these bits turns a whole number below 2**52 into a float
ONE_BITS = np.uint64(0x3FF0000000000000)
LOW, SHIFT = np.uint64(0xFFFFFFFF), np.uint64(32)


def _polynomial(z: Array, *coefficients: float) -> Array:
    """Evaluate a polynomial by Horner's scheme, the highest power first."""
    out = coefficients[0] * z + coefficients[1]
    for c in coefficients[2:]:
        out = out * z + c
    return out


@routine
def exp(x: Array) -> Array:
    """Return e to the power x; below the normal range it is 0."""
    z = np.where(x == x, x, 0.0)
    y = np.minimum(np.maximum(z, -708.0), 709.7)
    n = np.floor(y * LOG2_E + 0.5)
    r = (y - n * LN2_HI) - n * LN2_LO
    factorials = (6227020800.0, 479001600.0, 39916800.0, 3628800.0, 362880.0, 40320.0, 5040.0, 720.0, 120.0, 24.0, 6.0)
    p = _polynomial(r, *(1.0 / f for f in factorials), 0.5, 1.0, 1.0)
    p = p * ((n.astype(np.int64) + 1022) << 52).view(np.float64) * 2.0  # 2**n in two exact steps, because n may be 1024
    return np.where(x == x, np.where(z > 709.7, np.inf, np.where(z >= -708.0, p, 0.0)), x)


def log_normal(x: Array, e: Array | float) -> Array:
    """Return the logarithm of x 2^e for a normal positive x."""
    bits = x.view(np.int64)
    e = e + ((((bits >> 52) & 0x7FF) | TWO_52_BITS).view(np.float64) - (TWO_52 + 1022.0))
    m = ((bits & 0x000FFFFFFFFFFFFF) | 0x3FE0000000000000).view(np.float64)  # in [1/2, 1)
    low = m < 0.7071067811865476
    m, e = np.where(low, 2.0 * m, m), np.where(low, e - 1.0, e)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = _polynomial(z, *(1.0 / k for k in (23.0, 21.0, 19.0, 17.0, 15.0, 13.0, 11.0, 9.0, 7.0, 5.0, 3.0)), 1.0)
    return e * LN2_HI + (2.0 * s * p + e * LN2_LO)


@routine
def log(x: Array) -> Array:
    """Return the natural logarithm: -inf of 0, NaN of negative numbers."""
    x = np.where(x == x, x, -1.0)
    plain = (x > 0.0) & (x < np.inf)
    other = np.where(x > 0.0, x, np.where(x == 0.0, -np.inf, np.nan))
    x = np.where(plain, x, 1.0)
    small = x.view(np.int64) < 0x0010000000000000  # denormal: scaled up first
    x = np.where(small, np.minimum(x, 1.0) * 18014398509481984.0, x)
    return np.where(plain, log_normal(x, np.where(small, -54.0, 0.0)), other)


@routine
def tanh(x: Array) -> Array:
    """Return the hyperbolic tangent, to an absolute error below 4e-16."""
    out = 1.0 - 2.0 / (exp(2.0 * x) + 1.0)
    return np.where(x > 20.0, 1.0, np.where(x < -20.0, -1.0, out))


def sincos_turn(u: Array) -> tuple[Array, Array]:
    """Return sine and cosine of 2 pi u, for turns u within [0, 1)."""
    quarter = np.floor(4.0 * u + 0.5)
    t = TWO_PI * (u - 0.25 * quarter)  # |t| <= pi/4
    z = t * t
    odd = (355687428096000.0, -1307674368000.0, 6227020800.0, -39916800.0, 362880.0, -5040.0, 120.0, -6.0)
    even = (20922789888000.0, -87178291200.0, 479001600.0, -3628800.0, 40320.0, -720.0, 24.0)
    s = _polynomial(z, *(1.0 / f for f in odd), 1.0) * t
    c = _polynomial(z, *(1.0 / f for f in even), -0.5, 1.0)
    first, second, third = quarter == 1.0, quarter == 2.0, quarter == 3.0
    sine, cosine = np.where(first | third, c, s), np.where(first | third, s, c)
    return np.where(second | third, -sine, sine), np.where(first | second, -cosine, cosine)


def philox(c0: Array, c1: Array, c2: Array, c3: Array, k0: Array, k1: Array) -> tuple[Array, Array, Array, Array]:
    """Return the four words of Philox4x32-10; counter and key are words of 32 bits, each in a uint64."""
    for _ in range(10):  # bits above 32 do not influence the result
        p0, p1 = np.uint64(0xD2511F53) * (c0 & LOW), np.uint64(0xCD9E8D57) * (c2 & LOW)
        c0, c1, c2, c3 = (p1 >> SHIFT) ^ c1 ^ k0, p1, (p0 >> SHIFT) ^ c3 ^ k1, p0
        k0, k1 = k0 + np.uint64(0x9E3779B9), k1 + np.uint64(0xBB67AE85)
    return c0 & LOW, c1 & LOW, c2 & LOW, c3 & LOW


@routine
def uniform_pair(key: Array, episode: Array, step: Array, stream: Array, block: Array) -> tuple[Array, Array]:
    """Return two uniforms in (0, 1) of 52 bits each, never 0 nor 1; all arguments are uint64."""
    w0, w1, w2, w3 = philox(episode, block, step, stream, key & LOW, key >> SHIFT)
    half = 1.1102230246251565e-16

    def number(high: Array, low: Array) -> Array:
        mantissa = (((high << SHIFT) | low) >> np.uint64(12)) | ONE_BITS  # of a number in [1, 2)
        return (mantissa.view(np.float64) - 1.0) + half

    return number(w0, w1), number(w2, w3)


@routine
def normal_pair(key: Array, episode: Array, step: Array, stream: Array, block: Array) -> tuple[Array, Array]:
    """Return two standard normals, by Box and Muller."""
    u, v = uniform_pair(key, episode, step, stream, block)
    radius = np.sqrt(-2.0 * log_normal(u, 0.0))
    sine, cosine = sincos_turn(v)
    return radius * cosine, radius * sine
