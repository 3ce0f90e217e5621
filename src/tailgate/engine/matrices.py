"""Products and inverses of small matrices, written once for plain and for traced arrays: sums in a fixed order, element by element.

Arrays are (B, ..., rows, columns). What is the same for all episodes has no B, or one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tailgate.engine.array import Traced


def structure(x: Any) -> Any:
    """Where a matrix that is the same for all episodes is not zero."""
    return (x.values() if isinstance(x, Traced) else np.asarray(x)) != 0.0


def constant_times(x: Any, y: Any) -> Any:
    """x (..., i, k) times y (B, ..., k, j), of an x that is the same for all: sums run from 0, and its zeros count for nothing."""
    out: Any = 0.0
    there = structure(x)
    for k in range(x.shape[-1]):
        out = np.where(there[..., k, None], out + x[..., k, None] * y[..., k, None, :], out)
    return out


def product(x: Any, y: Any) -> Any:
    """x (..., i, k) times y (..., k, j): sums begin with their first product."""
    out = x[..., :1] * y[..., :1, :]
    for k in range(1, x.shape[-1]):
        out = out + x[..., k : k + 1] * y[..., k : k + 1, :]
    return out


def inverse(s: Any) -> Any:
    """The inverse of symmetric positive definite (..., q, q) by Gauss and Jordan, without pivots."""
    q = s.shape[-1]
    a = [[s[..., i, j] for j in range(q)] for i in range(q)]
    for p in range(q):
        scale = 1.0 / a[p][p]
        a[p][p] = np.ones_like(scale)
        a[p] = [v * scale for v in a[p]]
        for i in range(q):
            if i != p:
                f = a[i][p]
                a[i][p] = np.zeros_like(f)
                a[i] = [v - f * w for v, w in zip(a[i], a[p], strict=True)]
    return np.stack([np.stack(row, axis=-1) for row in a], axis=-2)
