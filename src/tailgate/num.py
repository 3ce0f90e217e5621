"""Arithmetic for batches in which a row's result never depends on the other rows.

BLAS, `einsum` and reductions choose their order of summation by shape, so a row gets other bits in another batch.
Library transcendentals differ between the vector body and the tail of a loop.
The scored path therefore uses only elementwise IEEE operations and the functions below; a test checks this.

Arrays are indexed (B, N, ...) and keep B contiguous in memory (`batch_last`), so elementwise operations run along the batch.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from tailgate.engine import elementary, matrices
from tailgate.engine.array import Traced
from tailgate.engine.compiled import elementwise
from tailgate.engine.functions import tracing as tracing
from tailgate.engine.hints import broken as broken
from tailgate.engine.hints import demand as demand
from tailgate.engine.hints import elsewhere as elsewhere
from tailgate.engine.hints import every as every
from tailgate.engine.hints import pick as pick
from tailgate.engine.hints import present as present
from tailgate.engine.hints import put as put
from tailgate.engine.hints import ring_next as ring_next
from tailgate.engine.hints import some as some
from tailgate.engine.hints import take as take
from tailgate.engine.loops import until as until
from tailgate.engine.matrices import congruent as congruent
from tailgate.engine.matrices import corrected as corrected
from tailgate.engine.matrices import moment as moment
from tailgate.engine.matrices import orthogonal as orthogonal
from tailgate.engine.matrices import predicted as predicted
from tailgate.engine.matrices import root as root
from tailgate.engine.matrices import solve as solve
from tailgate.engine.operations import Array

Shares = tuple[Array, Array, Array]


WORTH = 16  # numbers from which machine code is faster than numpy's passes

exp = elementwise(WORTH)(elementary.exp)
log = elementwise(WORTH)(elementary.log)
tanh = elementwise(WORTH)(elementary.tanh)
product = matrices.constant_times


def clip(x: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """Limit x to [low, high], elementwise."""
    return np.minimum(np.maximum(x, low), high)


_TO_LAST = [(*range(1, n), 0) if n else () for n in range(12)]  # per number of axes; np.moveaxis takes longer than a small product
_TO_FIRST = [(n - 1, *range(n - 1)) if n else () for n in range(12)]


def first_to_last(x: Array) -> Array:
    """Return (B, ...) as (..., B), a view."""
    return x.transpose(_TO_LAST[x.ndim])


def last_to_first(x: Array) -> Array:
    """Return (..., B) as (B, ...), a view."""
    return x.transpose(_TO_FIRST[x.ndim])


def batch_last(x: Array) -> Array:
    """Return the same (B, ...) array with B contiguous in memory."""
    return last_to_first(np.ascontiguousarray(first_to_last(x)))


def zeros(shape: Sequence[int], dtype: DTypeLike = np.float64) -> Array:
    """Return a (B, ...) array of zeros, B contiguous in memory."""
    return last_to_first(np.zeros((*shape[1:], shape[0]), dtype))


def full(shape: Sequence[int], value: ArrayLike | None, dtype: DTypeLike = np.float64) -> Array:
    """Return a (B, ...) array filled with `value` (broadcast over the trailing axes), B contiguous in memory."""
    out = zeros(shape, dtype)
    out[...] = value
    return out


def stack(columns: Sequence[Array]) -> Array:
    """Stack F arrays (B, ...) to (B, ..., F), B contiguous in memory."""
    return last_to_first(np.stack([first_to_last(c) for c in columns], axis=-2))


def matmul(x: Array, y: Array) -> Array:
    """Multiply (..., i, k) by (..., k, j), summing over k in ascending order.

    A constant x, one matrix for the batch or one (N, i, k) per agent, skips its structural zeros, even if y is infinite there.
    """
    alike = not isinstance(x, Traced) or x.fixed
    if alike and y.ndim > 3 and (x.ndim == 2 or (x.ndim == 3 and x.shape[0] in (1, *y.shape[1:-2]))):
        return matrices.constant_times(x, y)
    if x.ndim < y.ndim and not isinstance(x, Traced):
        x = x[(None,) * (y.ndim - x.ndim)]
    return matrices.product(x, y)


def matvec(x: Array, v: Array) -> Array:
    """Multiply (..., i, k) by (..., k), summing over k in ascending order."""
    return np.asarray(matmul(x, v[..., None])[..., 0])


def dot(x: Array, y: Array) -> Array:
    """Return the dot product of (..., k) and (..., k), summed in ascending order."""
    out = x[..., 0] * y[..., 0]
    for k in range(1, x.shape[-1]):
        out = out + x[..., k] * y[..., k]
    return np.asarray(out)


def transpose(x: Array) -> Array:
    """Swap the last two axes."""
    return np.swapaxes(x, -1, -2)


def quadratic(x: Array, weight: Array) -> Array:
    """Return x' W x for x (..., k) and W (..., k, k)."""
    return dot(x, matvec(weight, x))


def inverse(s: Array) -> Array:
    """Return the inverse of symmetric positive definite (..., q, q), see `matrices.inverse`."""
    if s.ndim > 2 and len(s) > 1 and s.strides[0] == 0:  # one matrix for the whole batch
        return np.broadcast_to(inverse(s[:1]), s.shape)
    return matrices.inverse(s)


def apply(matrix: Array, x: Array, base: Array | None = None) -> Array:
    """Multiply each agent's matrix (N, i, k), or one (1, i, k) for all, by x (B, N, k), and add base (B, N, i).

    Sums run over k in ascending order and skip structural zeros of the matrices. Returns (B, N, i).
    """
    moved = matrices.constant_on(matrix, x)
    return moved if base is None else base + moved


def fused(heard: Array, x: Array, M: Array, shares: Shares | None = None, step: tuple[Array, Array] | None = None) -> tuple[Array, Array]:
    """Fuse what agents hear: return xb (B, N, n) and Q^-1 (B, N, n, n), see `matrices.spreads` and `matrices.means`.

    Parameters
    ----------
    heard : (N, N) bool, [i, j] if i hears j
    x, M : estimates (B, N, n) and matrices (B or 1, N, n, n)
    shares : weight, total and begin, each (B or 1, ...); by default all weigh the same
    step : A and Q of a prediction that precedes, or None
    """
    weight, total, begin = shares or (np.ones((1, *heard.shape)), np.count_nonzero(heard, axis=1)[None], np.full((1, len(heard)), -0.0))
    L, spread = matrices.spreads(heard, M, weight, total, begin, step)
    xb = matrices.means(heard, x, L, spread, weight, total)
    return xb, spread if len(spread) == len(x) else np.broadcast_to(spread, (len(x), *spread.shape[1:]))


def expm(m: Array) -> Array:
    """Return the exponential of a square matrix: Taylor's series of M / 2^s, squared s times."""
    size = float(np.max(np.abs(m)) * len(m))
    halvings = max(0, math.frexp(size)[1] + 4) if size > 0.0 else 0
    small, term = np.array(m) / 2.0**halvings, np.eye(len(m))
    out = np.eye(len(m))
    for k in range(1, 19):
        term = product(term, small) / k
        out = out + term
    for _ in range(halvings):
        out = product(out, out)
    return out


def spectral_radius(m: Array) -> float:
    """Return the largest |eigenvalue| of a square matrix, as the limit of |M^(2^k)|^(1 / 2^k)."""
    power, size = np.array(m, np.float64), 0.0
    for k in range(60):
        scale = float(np.max(np.abs(power)))
        if scale == 0.0:
            return 0.0
        size += float(log(scale)) / 2.0**k
        power = power / scale
        power = product(power, power)
    return float(exp(size))


def dense(x: Array, weight: Array, bias: Array, squash: bool) -> Array:
    """Apply one network layer (B, i) -> (B, o) in float64 and fixed order, with tanh if `squash`."""
    out = matrices.dense(x, weight, bias)
    return tanh(out) if squash else out
