"""Guarantees of the resilient distributed estimators (thesis, Theorems 5.3.4 and 6.5.4, restated), for steady gains.

    (5.8)   norm_resilient     (6.26)   lasso_dkf

Formulas for a reader and for tests, not part of the scored path. The bounds are of one step: errors add up from step to step, the more the
larger the spectral radius of A.
"""

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array, Model
from tailgate.estimators.distributed.distributed_kalman import Fusion, fixed_point

MOST = 22  # sensors of which all combinations of signs are tried


def _white(model: Model) -> Array:
    """Return Sv_i^-1/2 C_i (N, q, n); any root gives the same norms."""
    from scipy.linalg import cholesky, solve_triangular

    pairs = zip(model.C, model.R, strict=True)
    return np.stack([solve_triangular(cholesky(R, lower=True), C, lower=True) for C, R in pairs])


def _push(model: Model, fusion: Fusion | None) -> tuple[Fusion, Array]:
    """Return the fixed point, and Q_i^-1 C_i' (N, n, q)."""
    fusion = fusion or fixed_point(model)
    return fusion, np.asarray(fusion.Qinv @ np.swapaxes(model.C, 1, 2))


def norm_bound(model: Model, lam: float, fusion: Fusion | None = None) -> Array:
    """Return (N,) lam |Q_i^-1 C_i' Sv_i^-1/2|_2: how far two attacks can part the estimates (5.8) of one step.

    Tight; half of it from the prior.

    Erratum: (5.11) of Theorem 5.3.4 has the factors in an order that does not multiply.
    """
    fusion = fusion or fixed_point(model)
    return np.asarray(lam * np.linalg.norm(fusion.Qinv @ np.swapaxes(_white(model), 1, 2), 2, axis=(1, 2)))


def norm_direction(model: Model, fusion: Fusion | None = None) -> Array:
    """Return (N, q) injections, of length 1 after whitening, that reach `norm_bound` in the limit of a large factor of either sign."""
    from scipy.linalg import cholesky

    fusion = fusion or fixed_point(model)
    _, _, right = np.linalg.svd(fusion.Qinv @ np.swapaxes(_white(model), 1, 2))
    return np.stack([cholesky(R, lower=True) @ v[0] for R, v in zip(model.R, right, strict=True)])


def lasso_bound(model: Model, lam: float | Array, fusion: Fusion | None = None) -> Array:
    """Return (N,) lam max_{s in {-1, 1}^q} |Q_i^-1 C_i' s|_2: as `norm_bound`, for (6.26). lam may be (N, q), a price of each sensor.

    Tight; half of it from the prior. Erratum: (6.29) of Theorem 6.5.4 repeats (5.11), which does not bound (6.26).
    Raises InputError for more sensors than all signs can be tried of.
    """
    push, signs = _worst_signs(model, lam, fusion)
    return np.asarray(np.linalg.norm(np.einsum("ink,ik->in", push, signs), axis=1))


def lasso_direction(model: Model, lam: float | Array = 1.0, fusion: Fusion | None = None) -> Array:
    """Return (N, q) signs s: injections that reach `lasso_bound` when multiplied by large factors of either sign."""
    return _worst_signs(model, lam, fusion)[1]


def _worst_signs(model: Model, lam: float | Array, fusion: Fusion | None) -> tuple[Array, Array]:
    """Return Q_i^-1 C_i' diag(lam) (N, n, q) and the signs (N, q) of the largest product."""
    q = model.C.shape[1]
    if q > MOST:
        raise InputError("model", f"{q} sensors", f"at most {MOST} sensors of each agent: all combinations of signs are tried")
    _, push = _push(model, fusion)
    push = push * np.broadcast_to(lam, model.C.shape[:2])[:, None]
    out = np.ones((model.agents, q))
    for i, matrix in enumerate(push):
        best = -1.0
        for first in range(0, 1 << (q - 1), 1 << 12):  # the last sign is 1: s and -s move equally far
            codes = np.arange(first, min(first + (1 << 12), 1 << (q - 1)))
            signs = np.where((codes[:, None] >> np.arange(q)) & 1, -1.0, 1.0)
            size = np.sum((signs @ matrix.T) ** 2, axis=1)
            if size.max() > best:
                best, out[i] = float(size.max()), signs[np.argmax(size)]
    return push, out
