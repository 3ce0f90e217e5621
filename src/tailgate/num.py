"""Batch arithmetic whose result for a row never depends on the other rows.

BLAS, `einsum` and reductions choose their order of summation by shape, so the same row gives other bits in
another batch; library transcendentals differ between the vector body and the tail of a loop. On the scored path
only elementwise IEEE operations and the functions below are used (a test looks for anything else).

Arrays are (B, N, ...) by index and keep B contiguous in memory (`batch_last`): every elementwise operation then
runs along the batch.
"""

import math
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from tailgate import linear
from tailgate.engine import elementary, matrices
from tailgate.engine.array import Traced
from tailgate.engine.compiled import elementwise
from tailgate.engine.functions import tracing as tracing
from tailgate.engine.loops import until as until
from tailgate.engine.matrices import orthogonal as orthogonal
from tailgate.engine.matrices import root as root
from tailgate.hints import broken as broken
from tailgate.hints import demand as demand
from tailgate.hints import elsewhere as elsewhere
from tailgate.hints import every as every
from tailgate.hints import pick as pick
from tailgate.hints import present as present
from tailgate.hints import put as put
from tailgate.hints import ring_next as ring_next
from tailgate.hints import some as some
from tailgate.hints import take as take

Array = NDArray[Any]


SMALL = 500  # products of numbers that numpy makes sooner than compiled code is loaded
WORTH = 16  # numbers for which machine code takes less time than numpy's many passes

exp = elementwise(WORTH)(elementary.exp)
log = elementwise(WORTH)(elementary.log)
tanh = elementwise(WORTH)(elementary.tanh)


def clip(x: Any, low: Any, high: Any) -> Any:
    """x within [low, high], elementwise."""
    return np.minimum(np.maximum(x, low), high)


@cache
def _lanes() -> Any:
    """The kernels of large matrices, which import numba: a single car does without."""
    return import_module("tailgate.lanes")


_TO_LAST = [(*range(1, n), 0) if n else () for n in range(12)]  # for each number of axes; np.moveaxis takes longer than a small product
_TO_FIRST = [(n - 1, *range(n - 1)) if n else () for n in range(12)]


def first_to_last(x: Array) -> Array:
    """(B, ...) to (..., B), a view."""
    return x.transpose(_TO_LAST[x.ndim])


def last_to_first(x: Array) -> Array:
    """(..., B) to (B, ...), a view."""
    return x.transpose(_TO_FIRST[x.ndim])


def batch_last(x: Array) -> Array:
    """The same (B, ...) array with B contiguous in memory."""
    return last_to_first(np.ascontiguousarray(first_to_last(x)))


def zeros(shape: Sequence[int], dtype: Any = np.float64) -> Array:
    """A (B, ...) array of zeros, B contiguous in memory."""
    return last_to_first(np.zeros((*shape[1:], shape[0]), dtype))


def full(shape: Sequence[int], value: Any, dtype: Any = np.float64) -> Array:
    """A (B, ...) array that holds `value` (broadcast over the trailing axes), B contiguous in memory."""
    out = zeros(shape, dtype)
    out[...] = value
    return out


def stack(columns: Sequence[Array]) -> Array:
    """F arrays (B, ...) to (B, ..., F), B contiguous in memory."""
    return last_to_first(np.stack([first_to_last(c) for c in columns], axis=-2))


def _constant(x: Array) -> Array | None:
    """x without its agent axis when it is one matrix for the whole batch."""
    return x if x.ndim == 2 else x[0] if x.ndim == 3 and x.shape[0] == 1 else None


def _last(x: Array) -> Array:
    """(B, ..., p, q) as (M, p, q, B) in memory: all axes but the first and the last two are one."""
    moved = np.ascontiguousarray(first_to_last(x), np.float64)
    return moved.reshape(math.prod(moved.shape[:-3]), *moved.shape[-3:])


def _products(x: Array, y: Array) -> int:
    """How many products of numbers x y takes."""
    return math.prod((*np.broadcast_shapes(x.shape[:-2], y.shape[:-2]), *x.shape[-2:], y.shape[-1]))


def matmul(x: Array, y: Array) -> Array:
    """(..., i, k) times (..., k, j), summed over k in ascending order; (B, ..., i, j) has B contiguous in memory.

    One matrix x for a whole batch, or one (N, i, k) for each agent of it: its structural zeros count for nothing, whatever y holds there.
    """
    if tracing() or x.ndim == y.ndim == 2 or _products(x, y) <= SMALL:
        alike = not isinstance(x, Traced) or x.fixed
        if alike and y.ndim > 3 and (x.ndim == 2 or (x.ndim == 3 and x.shape[0] in (1, *y.shape[1:-2]))):
            return cast(Array, matrices.constant_times(x, y))
        return cast(Array, matrices.product(x, y))
    fixed = _constant(x)
    if y.ndim > 3 and (fixed is not None or (x.ndim == 3 and x.shape[:1] == y.shape[1:-2])):
        flat = _last(y)
        m, k, j, b = flat.shape
        if fixed is None:
            held = _applied(x, flat.reshape(m, k, j * b))
        else:
            held = np.empty((m, len(fixed), j * b))
            linear.constant_times(np.ascontiguousarray(fixed, np.float64), flat.reshape(m, k, j * b), held)
        return last_to_first(held.reshape(*y.shape[1:-2], x.shape[-2], j, b))
    batch = np.broadcast_shapes(x.shape[:-2], y.shape[:-2])
    first, *middle = batch
    out = np.zeros((math.prod(middle), x.shape[-2], y.shape[-1], first))
    linear.times_each(_last(_spread(x, middle)), _last(_spread(y, middle)), out)
    return last_to_first(out.reshape(*middle, *out.shape[1:]))


def _spread(x: Array, middle: Sequence[int]) -> Array:
    """x with all axes, (B or 1, *middle, p, q), or (B or 1, 1, p, q) where it is the same along the only one in the middle."""
    out = x[(None,) * (len(middle) + 3 - x.ndim)]
    alike = len(middle) == 1 and out.shape[1] == 1
    return out if alike or list(out.shape[1:-2]) == list(middle) else np.broadcast_to(out, (len(out), *middle, *out.shape[-2:]))


def matvec(x: Array, v: Array) -> Array:
    """(..., i, k) times (..., k), summed over k in ascending order, as `matmul` does."""
    return np.asarray(matmul(x, v[..., None])[..., 0])


def dot(x: Array, y: Array) -> Array:
    """(..., k) and (..., k) to (...), summed in ascending order."""
    out = x[..., 0] * y[..., 0]
    for k in range(1, x.shape[-1]):
        out = out + x[..., k] * y[..., k]
    return np.asarray(out)


def transpose(x: Array) -> Array:
    """Swap the last two axes."""
    return np.swapaxes(x, -1, -2)


def quadratic(x: Array, weight: Array) -> Array:
    """x' W x for x (..., k) and W (..., k, k)."""
    return dot(x, matvec(weight, x))


def inverse(s: Array) -> Array:
    """Inverse of symmetric positive definite (..., q, q), see `matrices.inverse`."""
    q = s.shape[-1]
    if s.ndim > 2 and len(s) > 1 and s.strides[0] == 0:  # the same for the whole batch
        return np.broadcast_to(inverse(s[:1]), s.shape)
    if tracing() or q <= 2 or s.size <= SMALL:
        return cast(Array, matrices.inverse(s))
    flat = _last(s if s.ndim > 2 else s[None])
    out = np.empty_like(flat)
    _lanes().invert_each(flat, out)
    full_out = last_to_first(out.reshape(*s.shape[1:-2], q, q, flat.shape[3]))
    return full_out if s.ndim > 2 else full_out[0]


def apply(matrix: Array, x: Array, base: Array | None = None) -> Array:
    """Each agent's own matrix (N, i, k), or one (1, i, k) for all, times its vector in x (B, N, k), and base (B, N, i) with it: (B, N, i).

    Sums run over k in ascending order, and structural zeros of the matrices count for nothing.
    """
    if tracing() or math.prod(x.shape) * matrix.shape[1] <= SMALL:
        moved = matrices.constant_on(matrix, x)
        return cast(Array, moved if base is None else base + moved)
    under = _NOTHING if base is None else np.ascontiguousarray(first_to_last(base), np.float64)
    return last_to_first(_applied(matrix, np.ascontiguousarray(first_to_last(x), np.float64), under))


_NOTHING = np.empty((0, 0, 0))


def _applied(matrices: Array, x: Array, base: Array = _NOTHING) -> Array:
    out = np.empty((len(x), matrices.shape[-2], x.shape[2]))
    _lanes().apply_each(np.ascontiguousarray(matrices, np.float64), x, base, out)
    return out


def predicted(A: Array, B: Array, c: Array, L: Array, merge: Array, heard: Array, x: Array, u: Array) -> Array:
    """merge_i sum_j L_j (A x_j + B u_j + c) (B, N, n) over the j in heard (N, N) bool, for x (B, N, n) and u (B, N, m)."""
    if tracing() or x.size * len(A) <= SMALL:
        return cast(Array, matrices.predicted(A, B, c, L, merge, heard, x, u))
    flat = np.ascontiguousarray(first_to_last(x), np.float64)
    out = np.empty_like(flat)
    _lanes().predict_each(A, B, c, L, merge, heard, flat, np.ascontiguousarray(first_to_last(u), np.float64), out)
    return last_to_first(out)


def congruent(A: Array, P: Array, Q: Array) -> Array:
    """A P A' + Q for one A and Q (n, n) and P (B, N, n, n), in the order of `matmul`."""
    if tracing() or P.size * len(A) <= SMALL:
        return cast(Array, matrices.congruent(A, P, Q))
    flat = _last(P)
    out = np.empty_like(flat)
    _lanes().spread_each(A, flat, Q, out)
    return last_to_first(out)


def moment(weights: Sequence[Array], covariances: Sequence[Array], offsets: Sequence[Array]) -> Array:
    """sum_i w_i (P_i + d_i d_i') (B, N, n, n) in that order, of w_i (B, N), P_i (B, N, n, n) and d_i (B, N, n)."""
    if tracing() or covariances[0].size <= SMALL:
        return cast(Array, matrices.moment(weights, covariances, offsets))
    out = np.empty(first_to_last(covariances[0]).shape)
    if any(len(part) != len(covariances[0]) for part in (*weights, *covariances, *offsets)):
        raise ValueError("weights, covariances and offsets have the same rows")
    for i, parts in enumerate(zip(weights, covariances, offsets, strict=True)):
        linear.add_moment(*(np.ascontiguousarray(first_to_last(part), np.float64) for part in parts), out, i == 0)
    return last_to_first(out)


Shares = tuple[Array, Array, Array]


def fused(heard: Array, x: Array, M: Array, shares: Shares | None = None, step: tuple[Array, Array] | None = None) -> tuple[Array, Array]:
    """xb (B, N, n) and Q^-1 (B, N, n, n) of x (B, N, n) and M (B or 1, N, n, n) by `lanes.fuse_each`.

    shares: its weight, total and begin, (B or 1, ...); none: all weigh the same. step: its A and Q.
    """
    shares = shares or (np.ones((1, *heard.shape)), np.count_nonzero(heard, axis=1)[None], np.full((1, len(heard)), -0.0))
    if tracing() or x.size * x.shape[-1] ** 2 <= SMALL:
        return cast(tuple[Array, Array], matrices.fused(heard, x, M, *shares, step))
    flat, spread, weight, total, begin = (np.ascontiguousarray(first_to_last(part), np.float64) for part in (x, M, *shares))
    mean, P = np.empty_like(flat), np.empty((*spread.shape[:-1], flat.shape[-1]))
    A, Q = step or (np.empty((0, 0)), np.empty((0, 0)))
    _lanes().fuse_each(A, Q, heard, spread, flat, weight, total, begin, P, mean)
    return last_to_first(mean), last_to_first(P)


def corrected(C: Array, W: Array, x: Array, P: Array, r: Array, keep: Array) -> tuple[Array, Array]:
    """x (B, N, n) and P (B, N, n, n) after an update by r (B, N, q), whose covariance has the inverse W: `lanes.correct_each`."""
    if tracing() or x.size * x.shape[-1] * C.shape[1] <= SMALL:
        return cast(tuple[Array, Array], matrices.corrected(C, W, x, P, r, keep))
    inverse, flat, known, off, mask = (np.ascontiguousarray(first_to_last(part), np.float64) for part in (W, x, P, r, keep))
    mean, covariance = np.empty_like(flat), np.empty((*known.shape[:-1], len(x)))
    _lanes().correct_each(C, inverse, flat, known, off, mask, mean, covariance)
    return last_to_first(mean), last_to_first(covariance)


def product(x: Array, y: Array) -> Array:
    """One (i, k) times one (k, j): summed over k in ascending order, without the zeros of x."""
    return cast(Array, matrices.constant_times(x, y))


def solve(m: Array, y: Array) -> Array:
    """M^-1 Y for one (n, n) and one (n, k), by elimination with row pivots in fixed order."""
    return cast(Array, matrices.solve(m, y))


def expm(m: Array) -> Array:
    """The exponential of one square matrix: Taylor's series of M / 2^s, squared s times."""
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
    """The largest |eigenvalue| of one square matrix, as the limit of |M^(2^k)|^(1 / 2^k)."""
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
    """One network layer (B, i) -> (B, o) in float64 and fixed order, with tanh if `squash`."""
    out = matrices.dense(x, weight, bias)
    return cast(Array, tanh(out) if squash else out)
