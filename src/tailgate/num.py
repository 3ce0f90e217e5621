"""Batch arithmetic whose result for a row never depends on the other rows.

BLAS, `einsum` and reductions choose their order of summation by shape, so the same row gives other bits in
another batch; library transcendentals differ between the vector body and the tail of a loop. On the scored path
only elementwise IEEE operations and the functions below are used (a test looks for anything else).

Arrays are (B, N, ...) by index and keep B contiguous in memory (`batch_last`): every elementwise operation then
runs along the batch.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tailgate import kernels

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
    left = s.copy(order="K")
    right = np.empty_like(s)
    right[...] = np.eye(q)
    for p in range(q):
        scale = 1.0 / left[..., p, p, None]
        left[..., p, :] *= scale
        right[..., p, :] *= scale
        for i in range(q):
            if i != p:
                factor = left[..., i, p, None].copy()
                left[..., i, :] -= factor * left[..., p, :]
                right[..., i, :] -= factor * right[..., p, :]
    return right


def dense(x: Array, weight: Array, bias: Array, squash: bool) -> Array:
    """One network layer (B, i) -> (B, o) in float64 and fixed order, with tanh if `squash`."""
    return np.asarray(kernels.dense(np.ascontiguousarray(x, np.float64), weight, bias, squash))
