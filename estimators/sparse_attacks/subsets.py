"""Sparse observability, and the subsets of sensors that an estimator goes through.

(A, C) is k-sparse observable where it stays observable without any k sensors. s attacked sensors can be corrected where it is 2s-sparse
observable (Fawzi, Tabuada and Diggavi 2014; Shoukry and Tabuada 2016): two explanations of the same readings differ in 2s sensors at most.
"""

from itertools import combinations
from math import comb

import numpy as np

from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.memo import remembered
from tailgate.core import Array, Model
from tailgate.core.reach import eigenvalues

MOST = 5000  # filters, or subsets that are looked through
TOLERANCE = 1e-7  # singular values below this share of the largest are zero


def modes(A: Array) -> list[Array]:
    """Return orthonormal bases (n, g) of the eigenvectors of each eigenvalue of A, complex."""
    out = []
    for z in eigenvalues(A):
        _, values, rows = np.linalg.svd(A - z * np.eye(len(A)))
        g = max(1, int(np.count_nonzero(values <= TOLERANCE * max(values[0], 1.0))))
        out.append(rows[-g:].conj().T)
    return out


@remembered("A", "C")
def sparsity(model: Model) -> Array:
    """Return the largest k for each agent (N,) at which its own readings are k-sparse observable; -1 where they are not with all.

    By the test of Popov, Belevitch and Hautus: C v = 0 for no eigenvector v of A, of each set of sensors that is left.
    """
    bases = modes(model.A)
    return np.array([min(_seen(C, basis) for basis in bases) for C in model.C])


def _seen(C: Array, basis: Array) -> int:
    """Return without how many of the sensors C (q, n), whichever they are, all eigenvectors of a basis (n, g) are still seen."""
    size = np.linalg.norm(C, axis=1, keepdims=True)
    seen, g = (C / np.where(size > 0.0, size, 1.0)) @ basis, basis.shape[1]
    q = len(seen)
    if g == 1:
        return int(np.count_nonzero(np.abs(seen[:, 0]) > TOLERANCE)) - 1
    for k in range(q + 1):
        if q - k < g or comb(q, k) > MOST or not all(_rank(seen[list(rest)]) == g for rest in combinations(range(q), q - k)):
            return k - 1
    return q


def _rank(seen: Array) -> int:
    return int(np.count_nonzero(np.linalg.svd(seen, compute_uv=False) > TOLERANCE))


def correctable(model: Model) -> int:
    """Return the largest number s of attacked sensors that every agent can correct on its own readings; -1 if one observes too little."""
    return int(np.min(sparsity(model) // 2))


def require(model: Model, s: int, name: str, most: int = MOST) -> None:
    """Raise NotApplicable where s attacked sensors cannot be corrected; it names the largest s that can.

    Raises InputError where there are more than `most` subsets without s sensors.
    """
    largest = correctable(model)
    if s > largest:
        q, k = len(model.sensors), int(np.min(sparsity(model)))
        wanted = f"at most {largest}: the {q} sensors" if largest >= 0 else f"another system: the {q} sensors"
        reason = f"are {k}-sparse observable, and s needs 2s" if k >= 0 else "do not observe the state"
        raise NotApplicable(f"{name}.s", s, f"{wanted} of an agent {reason}")
    if comb(len(model.sensors), s) > most:
        raise InputError(f"{name}.s", s, f"fewer subsets than {comb(len(model.sensors), s)}: at most {most}")


def without(q: int, s: int) -> Array:
    """Return (K, q) bool, the subsets of q - s sensors; in the first, the last sensors are left out."""
    kept = [np.isin(np.arange(q), some) for some in combinations(range(q), q - s)]
    return np.array(kept).reshape(-1, q)
