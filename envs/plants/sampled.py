"""From continuous time to steps."""

from __future__ import annotations

import numpy as np

from tailgate import num
from tailgate.core import Array


def zero_order_hold(A: Array, B: Array, dt: float) -> tuple[Array, Array]:
    """Return the matrices (n, n) and (n, m) of a step dt [s] of x' = A x + B u, with u held over it."""
    n, m = B.shape
    whole = np.zeros((n + m, n + m))
    whole[:n, :n], whole[:n, n:] = A * dt, B * dt
    step = num.expm(whole)
    return step[:n, :n], step[:n, n:]
