"""Compiled kernels of matrices for the plain loop: products, each row of a batch by itself. `tailgate.lanes` has those of large matrices.

Every sum has a fixed order and nothing is contracted, so that a row has the same bits in every batch.
"""

import numpy as np

from tailgate.jit import jit

_jit = jit(cache=True)


@_jit
def constant_times(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    """out (M, i, c) = x y[m] for one x (i, k) and y (M, k, c).

    Sums run from 0 over k in ascending order, and zeros of x count for nothing.
    """
    for m in range(y.shape[0]):
        for first in range(0, y.shape[2], 256):  # so many columns of y[m] stay in the cache
            last = min(first + 256, y.shape[2])
            for i in range(x.shape[0]):
                total = out[m, i, first:last]  # a slice is indexed from 0, which the compiler sees: it takes several at a time
                total[:] = 0.0
                for k in range(x.shape[1]):
                    v = x[i, k]
                    if v != 0.0:
                        row = y[m, k, first:last]
                        for c in range(len(total)):
                            total[c] += v * row[c]


@_jit
def times_each(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    """out (M, i, j, B) = x (M, i, k, B) times y (M, k, j, B), summed over k in ascending order. M, B of x or y may be 1: alike for all."""
    for m in range(out.shape[0]):
        mx, my = m if x.shape[0] > 1 else 0, m if y.shape[0] > 1 else 0
        for i in range(out.shape[1]):
            for j in range(out.shape[2]):
                for k in range(x.shape[2]):
                    first, last = x[mx, i, k], y[my, k, j]
                    total = out[m, i, j]
                    if len(first) == 1:
                        v = first[0]
                        if len(last) == 1:
                            for b in range(len(total)):
                                total[b] = v * last[0] if k == 0 else total[b] + v * last[0]
                        else:
                            for b in range(len(total)):
                                total[b] = v * last[b] if k == 0 else total[b] + v * last[b]
                    elif len(last) == 1:
                        v = last[0]
                        for b in range(len(total)):
                            total[b] = first[b] * v if k == 0 else total[b] + first[b] * v
                    else:
                        for b in range(len(total)):
                            total[b] = first[b] * last[b] if k == 0 else total[b] + first[b] * last[b]


@_jit
def add_moment(weight: np.ndarray, P: np.ndarray, off: np.ndarray, out: np.ndarray, first: bool) -> None:
    """out (N, n, n, B) takes on weight (P + off off') for weight (N, B), P as out and off (N, n, B); the first is what it begins with."""
    for m in range(P.shape[0]):
        w = weight[m]
        for i in range(P.shape[1]):
            for j in range(P.shape[2]):
                p, x, y, total = P[m, i, j], off[m, i], off[m, j], out[m, i, j]
                if first:
                    for b in range(len(total)):
                        total[b] = w[b] * (p[b] + x[b] * y[b])
                else:
                    for b in range(len(total)):
                        total[b] = total[b] + w[b] * (p[b] + x[b] * y[b])
