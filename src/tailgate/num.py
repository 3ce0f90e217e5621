"""Batch arithmetic whose result for a row never depends on the other rows.

BLAS, `einsum` and reductions choose their order of summation by shape, so the same row gives other bits in
another batch; library transcendentals differ between the vector body and the tail of a loop. On the scored path
only elementwise IEEE operations and the functions below are used (a test looks for anything else).

Arrays are (B, N, ...) by index and keep B contiguous in memory (`batch_last`): every elementwise operation then
runs along the batch.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tailgate import kernels
from tailgate.elementwise import clip as clip
from tailgate.elementwise import select as select

Array = NDArray[Any]

exp = kernels.exp
log = kernels.log
tanh = kernels.tanh


def batch_last(x: Array) -> Array:
    """The same (B, ...) array with B contiguous in memory."""
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(x, 0, -1)), -1, 0)


def zeros(shape: Sequence[int], dtype: Any = np.float64) -> Array:
    """A (B, ...) array of zeros, B contiguous in memory."""
    return np.moveaxis(np.zeros((*shape[1:], shape[0]), dtype), -1, 0)


def full(shape: Sequence[int], value: Any, dtype: Any = np.float64) -> Array:
    """A (B, ...) array that holds `value` (broadcast over the trailing axes), B contiguous in memory."""
    out = zeros(shape, dtype)
    out[...] = value
    return out


def stack(columns: Sequence[Array]) -> Array:
    """F arrays (B, ...) to (B, ..., F), B contiguous in memory."""
    return np.moveaxis(np.stack([np.moveaxis(c, 0, -1) for c in columns], axis=-2), -1, 0)


def _constant(x: Array) -> Array | None:
    """x without its agent axis when it is one matrix for the whole batch."""
    return x if x.ndim == 2 else x[0] if x.ndim == 3 and x.shape[0] == 1 else None


def matmul(x: Array, y: Array) -> Array:
    """(..., i, k) times (..., k, j), summed over k in ascending order."""
    fixed = _constant(x)
    if fixed is not None and y.ndim > 3:
        out = zeros((*y.shape[:-2], fixed.shape[0], y.shape[-1]))
        for i, k in zip(*np.nonzero(fixed), strict=True):  # row by row: structural zeros cost nothing
            out[..., i, :] += fixed[i, k] * y[..., k, :]
        return out
    batch = np.broadcast_shapes(x.shape[:-2], y.shape[:-2])
    out = zeros((*batch, x.shape[-2], y.shape[-1])) if batch else np.zeros((x.shape[-2], y.shape[-1]))
    np.multiply(x[..., :, 0, None], y[..., 0, None, :], out=out)
    for k in range(1, x.shape[-1]):
        out += x[..., :, k, None] * y[..., k, None, :]
    return out


def matvec(x: Array, v: Array) -> Array:
    """(..., i, k) times (..., k), summed over k in ascending order."""
    fixed = _constant(x)
    if fixed is not None and v.ndim > 2:
        out = zeros((*v.shape[:-1], fixed.shape[0]))
        for i, k in zip(*np.nonzero(fixed), strict=True):
            out[..., i] += fixed[i, k] * v[..., k]
        return out
    batch = np.broadcast_shapes(x.shape[:-2], v.shape[:-1])
    out = zeros((*batch, x.shape[-2])) if batch else np.zeros(x.shape[-2])
    np.multiply(x[..., :, 0], v[..., 0, None], out=out)
    for k in range(1, x.shape[-1]):
        out += x[..., :, k] * v[..., k, None]
    return out


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
    """Inverse of symmetric positive definite (..., q, q): closed form for q <= 2, else Gauss-Jordan in fixed order."""
    q = s.shape[-1]
    if q == 1:
        return np.asarray(1.0 / s)
    if q == 2:
        a, b, d = s[..., 0, 0], s[..., 0, 1], s[..., 1, 1]
        scale = 1.0 / (a * d - b * b)
        out = np.empty_like(s)
        out[..., 0, 0] = d * scale
        out[..., 1, 1] = a * scale
        out[..., 0, 1] = out[..., 1, 0] = -b * scale
        return out
    if s.ndim > 2 and len(s) > 1 and s.strides[0] == 0:  # the same for the whole batch
        return np.broadcast_to(inverse(s[:1]), s.shape)
    flat = np.array(s, np.float64, order="C").reshape(-1, q, q)
    flat_out = np.empty_like(flat)
    kernels.invert_each(flat, flat_out)
    full_out = flat_out.reshape(s.shape)
    return batch_last(full_out) if s.ndim > 2 else full_out


def apply(matrices: Array, x: Array) -> Array:
    """Each agent's own matrix, `transposed` (N, k, i), times its vector in x (B, N, k): (B, N, i), summed over k in ascending order."""
    flat = np.ascontiguousarray(np.moveaxis(x, 0, -1))
    out = np.empty((flat.shape[0], matrices.shape[2], flat.shape[2]))
    kernels.apply_each(matrices, flat, out)
    return np.moveaxis(out, -1, 0)


def transposed(matrices: Array) -> Array:
    """(N, i, k) as `apply` wants it: (N, k, i), contiguous."""
    return np.ascontiguousarray(np.swapaxes(matrices, 1, 2), np.float64)


def product(x: Array, y: Array) -> Array:
    """One (i, k) times one (k, j) of any size, compiled; summed over k in ascending order."""
    return np.asarray(kernels.product(np.ascontiguousarray(x, np.float64), np.ascontiguousarray(y, np.float64)))


def solve(m: Array, y: Array) -> Array:
    """M^-1 Y for one (n, n) and one (n, k), by elimination with row pivots in fixed order."""
    return np.asarray(kernels.solve(np.array(m, np.float64, order="C"), np.array(y, np.float64, order="C")))


def orthogonal(x: Array, y: Array) -> tuple[Array, Array]:
    """V'X, whose rows are orthogonal, and V'Y for X (M, q, n) and Y (M, q, p): each row of V'X to its own relative accuracy.

    Jacobi's rotations in fixed order; V is orthogonal. The squared lengths of the rows are the eigenvalues of X X', in no order.
    """
    n = x.shape[-1]
    both = np.ascontiguousarray(np.concatenate([x, y], axis=-1), np.float64)
    kernels.turn_rows(both, n)
    return both[..., :n], both[..., n:]


def root(s: Array) -> tuple[Array, Array]:
    """D^1/2 V' and D^-1/2 V' for symmetric positive definite V D V' (M, q, q): Y with Y'Y = S, and with Y'Y = S^-1."""
    rows, turn = orthogonal(s, np.broadcast_to(np.eye(s.shape[-1]), s.shape))
    half = np.sqrt(dot(rows, turn))[..., None]  # V'S = D V'
    return turn * half, turn / half


def in_ball(w: Array, c: Array) -> Array:
    """u_k = w_k / (c_k + mu) with the least mu >= 0 at which |u| <= 1, for w (B, P, q) and c (P, q) >= 0: (B, P, q). 0/0 counts as 0."""
    flat = np.ascontiguousarray(np.moveaxis(w, 0, -1))
    out = np.empty_like(flat)
    kernels.ball_each(flat, np.ascontiguousarray(c), out)
    return np.moveaxis(out, -1, 0)


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
    return np.asarray(kernels.dense(np.ascontiguousarray(x, np.float64), weight, bias, squash))
