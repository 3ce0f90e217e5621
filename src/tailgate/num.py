"""Batch arithmetic whose result for a row never depends on the other rows.

BLAS, `einsum` and reductions choose their order of summation by shape, so the same row gives other bits in
another batch; library transcendentals differ between the vector body and the tail of a loop. On the scored path
only elementwise IEEE operations and the functions below are used (a test looks for anything else).

Arrays are (B, N, ...) by index and keep B contiguous in memory (`batch_last`): every elementwise operation then
runs along the batch.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

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
from tailgate.engine.matrices import orthogonal as orthogonal
from tailgate.engine.matrices import root as root

Array = NDArray[Any]
Shares = tuple[Array, Array, Array]


WORTH = 16  # numbers for which machine code takes less time than numpy's many passes

exp = elementwise(WORTH)(elementary.exp)
log = elementwise(WORTH)(elementary.log)
tanh = elementwise(WORTH)(elementary.tanh)
congruent: Callable[..., Array] = matrices.congruent
moment: Callable[..., Array] = matrices.moment
predicted: Callable[..., Array] = matrices.predicted
corrected: Callable[..., tuple[Array, Array]] = matrices.corrected


def clip(x: Any, low: Any, high: Any) -> Any:
    """Return x within [low, high], elementwise."""
    return np.minimum(np.maximum(x, low), high)


_TO_LAST = [(*range(1, n), 0) if n else () for n in range(12)]  # for each number of axes; np.moveaxis takes longer than a small product
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


def zeros(shape: Sequence[int], dtype: Any = np.float64) -> Array:
    """Return a (B, ...) array of zeros, B contiguous in memory."""
    return last_to_first(np.zeros((*shape[1:], shape[0]), dtype))


def full(shape: Sequence[int], value: Any, dtype: Any = np.float64) -> Array:
    """Return a (B, ...) array that holds `value` (broadcast over the trailing axes), B contiguous in memory."""
    out = zeros(shape, dtype)
    out[...] = value
    return out


def stack(columns: Sequence[Array]) -> Array:
    """Stack F arrays (B, ...) to (B, ..., F), B contiguous in memory."""
    return last_to_first(np.stack([first_to_last(c) for c in columns], axis=-2))


def matmul(x: Array, y: Array) -> Array:
    """Return (..., i, k) times (..., k, j), summed over k in ascending order.

    One matrix x for a whole batch, or one (N, i, k) for each agent of it: its structural zeros count for nothing, whatever y holds there.
    """
    alike = not isinstance(x, Traced) or x.fixed
    if alike and y.ndim > 3 and (x.ndim == 2 or (x.ndim == 3 and x.shape[0] in (1, *y.shape[1:-2]))):
        return cast(Array, matrices.constant_times(x, y))
    if x.ndim < y.ndim and not isinstance(x, Traced):
        x = x[(None,) * (y.ndim - x.ndim)]
    return cast(Array, matrices.product(x, y))


def matvec(x: Array, v: Array) -> Array:
    """Return (..., i, k) times (..., k), summed over k in ascending order, as `matmul` does."""
    return np.asarray(matmul(x, v[..., None])[..., 0])


def dot(x: Array, y: Array) -> Array:
    """Return (..., k) times (..., k), (...), summed in ascending order."""
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
    """Return the inverse of a symmetric positive definite (..., q, q), see `matrices.inverse`."""
    if s.ndim > 2 and len(s) > 1 and s.strides[0] == 0:  # the same for the whole batch
        return np.broadcast_to(inverse(s[:1]), s.shape)
    return cast(Array, matrices.inverse(s))


def apply(matrix: Array, x: Array, base: Array | None = None) -> Array:
    """Return each agent's matrix times its vector, plus `base`: (B, N, i).

    The matrices are (N, i, k), or one (1, i, k) for all; x (B, N, k), base (B, N, i). Sums run over k in ascending order; structural zeros
    of the matrices are skipped.
    """
    return cast(Array, matrices.applied(matrix, x, base))


def fused(heard: Array, x: Array, M: Array, shares: Shares | None = None, step: tuple[Array, Array] | None = None) -> tuple[Array, Array]:
    """Return xb (B, N, n) and Q^-1 (B, N, n, n) of x (B, N, n) and M (B or 1, N, n, n), see `matrices.spreads` and `matrices.means`.

    shares: its weight, total and begin, (B or 1, ...); none: all weigh the same. step: its A and Q.
    """
    weight, total, begin = shares or (np.ones((1, *heard.shape)), np.count_nonzero(heard, axis=1)[None], np.full((1, len(heard)), -0.0))
    L, spread = matrices.spreads(heard, M, weight, total, begin, step)
    xb = matrices.means(heard, x, L, spread, weight, total)
    return xb, spread if len(spread) == len(x) else np.broadcast_to(spread, (len(x), *spread.shape[1:]))


def product(x: Array, y: Array) -> Array:
    """Return one (i, k) times one (k, j), summed over k in ascending order, without the zeros of x."""
    return cast(Array, matrices.constant_times(x, y))


def solve(m: Array, y: Array) -> Array:
    """Return M^-1 Y for one (n, n) and one (n, k), by elimination with row pivots in fixed order."""
    return cast(Array, matrices.solve(m, y))


def expm(m: Array) -> Array:
    """Return the exponential of one square matrix: Taylor's series of M / 2^s, squared s times."""
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
    """Return the largest |eigenvalue| of one square matrix, as the limit of |M^(2^k)|^(1 / 2^k)."""
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
    """Return one network layer (B, i) -> (B, o) in float64 and fixed order, with tanh if `squash`."""
    out = matrices.dense(x, weight, bias)
    return cast(Array, tanh(out) if squash else out)
