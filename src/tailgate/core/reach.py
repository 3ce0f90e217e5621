"""Detectability with reachability in the graph: whether each agent can know the whole state from its own and its neighbours' readings."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array, Model

MARGIN = 1e-6  # eigenvalues this close to the unit circle do not die out, and singular values this small are zero


def reach(graph: Array) -> Array:
    """Return (N, N) bool, [i, j] when the knowledge of j comes to i, over any number of hops; everybody reaches itself."""
    out = np.array(graph, bool) | np.eye(len(graph), dtype=bool)
    while True:
        wider = np.array([np.any(out[row], axis=0) for row in out])
        if np.array_equal(wider, out):
            return out
        out = wider


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

    `graph` (N, N) stands in for the model's: nobody but oneself, for a filter that hears nobody.

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
