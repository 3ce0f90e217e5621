"""Detectability with reachability in the graph: whether each agent can know the whole state from its own and its neighbours' readings."""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from math import comb

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.memo import remembered
from tailgate.core import Array, Model

TOLERANCE = 1e-7  # singular values below this share of the largest are zero
SUBSETS = 5000  # most that are looked through
MARGIN = 1e-6  # eigenvalues this close to the unit circle do not die out, and singular values this small are zero


def hops(graph: Array, directed: bool = False) -> Array:
    """Return the edges (N, N) between two agents, whichever way they are heard unless `directed`; infinite where nothing joins them."""
    from scipy.sparse.csgraph import shortest_path  # takes long to import

    return np.asarray(shortest_path(np.array(graph, bool), directed=directed, unweighted=True))


def reach(graph: Array) -> Array:
    """Return (N, N) bool, [i, j] when the knowledge of j comes to i, over any number of hops; everybody reaches itself."""
    return np.isfinite(hops(graph, directed=True))


def eigenvalues(A: Array) -> Array:
    """Return the eigenvalues (n,) complex. States that do not drive each other in a circle are taken apart first.

    In a long string of vehicles the same poles come again in every vehicle. Taken all together, their rounding spreads them far apart.
    """
    from scipy.sparse.csgraph import connected_components

    count, part = connected_components(A != 0.0, directed=True, connection="strong")
    return np.concatenate([np.linalg.eigvals(A[np.ix_(part == i, part == i)]) for i in range(count)])


def lasting(A: Array) -> tuple[Array, ...]:
    """Return orthonormal bases (n, g) of the eigenvectors of each eigenvalue that does not die out."""
    return _lasting(np.ascontiguousarray(A, np.float64).tobytes(), len(A))


@lru_cache(maxsize=16)  # the same plant is asked for by every part of an evaluation
def _lasting(data: bytes, n: int) -> tuple[Array, ...]:
    A = np.frombuffer(data).reshape(n, n)
    values = eigenvalues(A)
    values = values[np.abs(values) >= 1.0 - MARGIN]
    out: list[Array] = []
    seen: list[complex] = []
    for value in sorted(values, key=lambda v: (v.real, v.imag)):
        if any(abs(value - other) < 1e-4 for other in seen):  # one eigenvalue, split by rounding
            continue
        seen.append(value)
        near = values[np.abs(values - value) < 1e-4]
        together = _null_space(A, near.sum() / len(near))
        out += [together] if together.size else [_null_space(A, one) for one in near]  # close, but not equal
    return tuple(basis for basis in out if basis.size)


def _null_space(A: Array, value: complex) -> Array:
    """Return orthonormal eigenvectors (n, g) of A for an eigenvalue."""
    _, size, right = np.linalg.svd(np.eye(len(A)) * value - A)
    return np.asarray(right[size <= MARGIN * max(1.0, float(size[0]))].conj().T)


def blind(model: Model, graph: Array | None = None) -> list[int]:
    """Return the agents that cannot know the whole state from their own sensors and those of the agents that reach them.

    `graph` (N, N) replaces the model's: for a filter that hears nobody, each agent reaches itself alone.

    Popov, Belevitch and Hautus: (A, C) is detectable if no eigenvector of an eigenvalue that does not die out has C v = 0.
    """
    bases, known = lasting(model.A), reach(model.graph if graph is None else graph)
    out, cache = [], {}
    for i in range(model.agents):
        key = known[i].tobytes()
        if key not in cache:
            C = model.C[known[i]].reshape(-1, model.states)
            size = max(1.0, float(np.max(np.abs(C), initial=0.0)))
            cache[key] = all(
                np.linalg.matrix_rank(C @ basis, tol=MARGIN * size) == basis.shape[1] for basis in bases
            )
        if not cache[key]:
            out.append(i)
    return out


def require_detectable(model: Model, where: str) -> None:
    """Raise InputError, naming the agents, unless every agent can know the whole state."""
    agents = blind(model)
    if agents:
        names = ", ".join(map(str, agents))
        raise InputError(
            f"{where}: undetectable for agents", names,
            "for each agent a state that its own sensors and those of the agents that reach it can tell: every mode that does not die out",
        )


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

    (A, C) is k-sparse observable where it stays observable without any k sensors (Fawzi, Tabuada and Diggavi 2014). By the test of Popov,
    Belevitch and Hautus: C v = 0 for no eigenvector v of A, of each set of sensors that is left.
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
        if q - k < g or comb(q, k) > SUBSETS or not all(_rank(seen[list(rest)]) == g for rest in combinations(range(q), q - k)):
            return k - 1
    return q


def _rank(seen: Array) -> int:
    return int(np.count_nonzero(np.linalg.svd(seen, compute_uv=False) > TOLERANCE))
