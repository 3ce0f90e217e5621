"""Compiled scalar kernels: elementary functions, the Philox generator, the policy network. Those of matrices are in `tailgate.linear`.

Everything here is written with +, -, *, / and exact bit operations in a fixed order, so that a result does not depend on the batch size, on
the machine's mathematical library, or on how the compiler vectorises a loop (no fast-math, no fused multiply-add). What
a kernel calls stands in its own file, because the on-disk cache of compiled code is invalidated by a change of that file alone.

Sources: Salmon et al., *Parallel random numbers: as easy as 1, 2, 3*, SC11 (Philox4x32-10); Box and Muller 1958.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from tailgate.jit import jit, numba

LN2_HI = 6.93147180369123816490e-01  # ln 2, its last bits zero: n * LN2_HI is exact for |n| < 2**20
LN2_LO = 1.90821492927058770002e-10
LOG2_E = 1.44269504088896338700e00
TWO_PI = 6.283185307179586
# A whole number below 2**52 becomes a float by its bits alone: the conversion has no vector instruction on most processors.
TWO_52, TWO_52_BITS = 4503599627370496.0, np.int64(0x4330000000000000)
ONE_BITS = np.uint64(0x3FF0000000000000)

_jit, _inline = jit(cache=True), jit(cache=True, inline="always")


@_inline
def _exp(x: float) -> float:
    z = x if x == x else 0.0
    y = min(max(z, -708.0), 709.7)  # what is computed raises no flag, whatever x is
    n = math.floor(y * LOG2_E + 0.5)
    r = (y - n * LN2_HI) - n * LN2_LO
    p = 1.0 / 6227020800.0
    p = p * r + 1.0 / 479001600.0
    p = p * r + 1.0 / 39916800.0
    p = p * r + 1.0 / 3628800.0
    p = p * r + 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    p = p * np.int64((np.int64(n) + 1022) << 52).view(np.float64) * 2.0  # 2**n in two exact steps: n may be 1024
    if x != x:
        return x
    if z > 709.7:
        return math.inf
    return p if z >= -708.0 else 0.0  # below the normal range: flushed, no denormals on the scored path


@_inline
def _log_normal(x: float, e: float) -> float:
    """Of x 2^e, for an x that is a normal positive number."""
    bits = np.float64(x).view(np.int64)
    e += np.int64(((bits >> 52) & 0x7FF) | TWO_52_BITS).view(np.float64) - (TWO_52 + 1022.0)
    m = np.int64((bits & 0x000FFFFFFFFFFFFF) | 0x3FE0000000000000).view(np.float64)  # in [1/2, 1)
    low = m < 0.7071067811865476
    m, e = 2.0 * m if low else m, e - 1.0 if low else e
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = 1.0 / 23.0
    p = p * z + 1.0 / 21.0
    p = p * z + 1.0 / 19.0
    p = p * z + 1.0 / 17.0
    p = p * z + 1.0 / 15.0
    p = p * z + 1.0 / 13.0
    p = p * z + 1.0 / 11.0
    p = p * z + 1.0 / 9.0
    p = p * z + 1.0 / 7.0
    p = p * z + 1.0 / 5.0
    p = p * z + 1.0 / 3.0
    p = p * z + 1.0
    return e * LN2_HI + (2.0 * s * p + e * LN2_LO)


@_inline
def _log(x: float) -> float:
    x = x if x == x else -1.0  # an ordered comparison with NaN raises a flag
    plain = (x > 0.0) & (x < math.inf)
    other = x if x > 0.0 else -math.inf if x == 0.0 else math.nan
    x = x if plain else 1.0  # without a branch, so that a loop over many is vectorised
    small = np.float64(x).view(np.int64) < 0x0010000000000000  # denormal: scale it up first
    x = min(x, 1.0) * 18014398509481984.0 if small else x  # of every x in a vectorised loop: it shall not overflow
    out = _log_normal(x, -54.0 if small else 0.0)
    return out if plain else other


@_inline
def _sincos_turn(u: float) -> tuple[float, float]:
    """Sine and cosine of 2 pi u, u in turns within [0, 1)."""
    quarter = np.floor(4.0 * u + 0.5)
    t = TWO_PI * (u - 0.25 * quarter)  # |t| <= pi/4
    z = t * t
    s = 1.0 / 355687428096000.0
    s = s * z - 1.0 / 1307674368000.0
    s = s * z + 1.0 / 6227020800.0
    s = s * z - 1.0 / 39916800.0
    s = s * z + 1.0 / 362880.0
    s = s * z - 1.0 / 5040.0
    s = s * z + 1.0 / 120.0
    s = s * z - 1.0 / 6.0
    s = (s * z + 1.0) * t
    c = 1.0 / 20922789888000.0
    c = c * z - 1.0 / 87178291200.0
    c = c * z + 1.0 / 479001600.0
    c = c * z - 1.0 / 3628800.0
    c = c * z + 1.0 / 40320.0
    c = c * z - 1.0 / 720.0
    c = c * z + 1.0 / 24.0
    c = c * z - 0.5
    c = c * z + 1.0
    first, second, third = quarter == 1.0, quarter == 2.0, quarter == 3.0
    sine, cosine = c if first or third else s, s if first or third else c
    return -sine if second or third else sine, -cosine if first or second else cosine


@_inline
def _tanh(x: float) -> float:
    """Absolute error below 4e-16."""
    if x > 20.0:
        return 1.0
    if x < -20.0:
        return -1.0
    out: float = 1.0 - 2.0 / (_exp(2.0 * x) + 1.0)
    return out


def _elementwise(function: Any) -> Callable[..., Any]:
    """A universal function of numpy, compiled or loaded at its first array; a single number is computed in Python, to the same bits."""

    @cache
    def made() -> Any:
        return numba().vectorize(["float64(float64)"], cache=True)(function.py_func)

    return lambda x: np.float64(function.py_func(x)) if isinstance(x, float) else made()(x)


exp, log, tanh = _elementwise(_exp), _elementwise(_log), _elementwise(_tanh)


@_inline
def _philox(c0, c1, c2, c3, k0, k1):
    """Philox4x32-10. Counter and key words are uint64 holding 32 bits each."""
    mask = np.uint64(0xFFFFFFFF)
    shift = np.uint64(32)
    for _ in range(10):  # whatever stands above 32 bits does not reach them; a product of two halves is one vector instruction
        p0 = np.uint64(0xD2511F53) * (c0 & mask)
        p1 = np.uint64(0xCD9E8D57) * (c2 & mask)
        c0, c1, c2, c3 = (p1 >> shift) ^ c1 ^ k0, p1, (p0 >> shift) ^ c3 ^ k1, p0
        k0 += np.uint64(0x9E3779B9)
        k1 += np.uint64(0xBB67AE85)
    return c0 & mask, c1 & mask, c2 & mask, c3 & mask


@_inline
def _uniform_pair(key, episode, step, stream, block):
    """Two uniforms in (0, 1), 52 bits each, never 0 nor 1."""
    w0, w1, w2, w3 = _philox(
        np.uint64(episode), np.uint64(block), np.uint64(step), np.uint64(stream),
        np.uint64(key) & np.uint64(0xFFFFFFFF), np.uint64(key) >> np.uint64(32),
    )  # fmt: skip
    a = (((w0 << np.uint64(32)) | w1) >> np.uint64(12)) | ONE_BITS  # the mantissa of a number in [1, 2)
    b = (((w2 << np.uint64(32)) | w3) >> np.uint64(12)) | ONE_BITS
    half = 1.1102230246251565e-16
    return (np.uint64(a).view(np.float64) - 1.0) + half, (np.uint64(b).view(np.float64) - 1.0) + half


@_jit
def philox_words(counter: np.ndarray, key: np.ndarray) -> np.ndarray:
    """Raw Philox4x32-10 words for a (..., 4) counter and (..., 2) key of uint32, flattened to (M, 4)."""
    out = np.empty((counter.shape[0], 4), np.uint32)
    for i in range(counter.shape[0]):
        w = _philox(
            np.uint64(counter[i, 0]), np.uint64(counter[i, 1]), np.uint64(counter[i, 2]), np.uint64(counter[i, 3]),
            np.uint64(key[i, 0]), np.uint64(key[i, 1]),
        )  # fmt: skip
        for j in range(4):
            out[i, j] = np.uint32(w[j])
    return out


@_jit
def fill_uniform(keys, episode, step, stream, out):
    """Uniforms in (0, 1) into out (E, B); element e of a row is word e % 2 of block e // 2."""
    for j in range((out.shape[0] + 1) // 2):
        for b in range(out.shape[1]):
            u0, u1 = _uniform_pair(keys[b], episode[b], step[b], stream, j)
            out[2 * j, b] = u0
            if 2 * j + 1 < out.shape[0]:
                out[2 * j + 1, b] = u1


@_jit
def fill_normal(keys, episode, step, stream, out):
    """Standard normals (Box-Muller) into out (E, B)."""
    for j in range((out.shape[0] + 1) // 2):
        for b in range(out.shape[1]):
            u0, u1 = _uniform_pair(keys[b], episode[b], step[b], stream, j)
            radius = math.sqrt(-2.0 * _log_normal(u0, 0.0))
            s, c = _sincos_turn(u1)
            out[2 * j, b] = radius * c
            if 2 * j + 1 < out.shape[0]:
                out[2 * j + 1, b] = radius * s


@_jit
def dense(x: np.ndarray, weight: np.ndarray, bias: np.ndarray, squash: bool) -> np.ndarray:
    """One layer: x (B, i) float64, weight (i, o), bias (o,); sums run over i in ascending order."""
    out = np.empty((x.shape[0], weight.shape[1]))
    for b in range(x.shape[0]):
        for o in range(weight.shape[1]):
            out[b, o] = bias[o]
        for i in range(weight.shape[0]):
            v = x[b, i]
            for o in range(weight.shape[1]):
                out[b, o] += v * weight[i, o]
        if squash:
            for o in range(weight.shape[1]):
                out[b, o] = _tanh(out[b, o])
    return out
