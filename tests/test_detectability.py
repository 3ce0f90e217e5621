"""Detectability of linear systems: eigenvalues, reach, and poles of a long string."""

import numpy as np
import pytest

from tailgate.core import Model
from tailgate.core.reach import blind, eigenvalues, lasting, reach, require_detectable


def test_reach_is_the_transitive_closure():
    """[i, j] where some path leads from j to i, by powers of the adjacency matrix; any graph, loops and none."""
    rng = np.random.default_rng(0)
    for _ in range(30):
        n = int(rng.integers(1, 9))
        graph = rng.uniform(size=(n, n)) < rng.uniform(0.0, 0.4)
        paths = np.linalg.matrix_power(np.eye(n, dtype=int) + graph, n) > 0
        np.testing.assert_array_equal(reach(graph), paths)


def linear(A, C, graph=None):
    """A model from A (n, n) and C (N, q, n)."""
    A, C = np.asarray(A, float), np.asarray(C, float)
    n, (N, q, _) = len(A), C.shape
    graph = np.eye(N, dtype=bool) if graph is None else np.asarray(graph, bool)
    return Model(A, np.zeros((n, 0)), np.zeros(n), C, np.eye(n), np.array([np.eye(q)] * N), graph, 1.0, tuple(f"y{i}" for i in range(q)))


@pytest.mark.parametrize(
    "A, C, unseen",
    [
        ([[1.0, 1.0], [0.0, 1.0]], [[[1.0, 0.0]], [[0.0, 1.0]]], [1]),  # a position is lost to a speedometer
        ([[1.0, 0.0], [0.0, 1.0]], [[[1.0, 0.0]], [[1.0, 1.0]]], [0, 1]),  # two equal modes need two readings
        ([[1.0, 0.0], [0.0, 0.5]], [[[1.0, 0.0]], [[0.0, 1.0]]], [1]),  # what decays need not be seen
        ([[1.2, 0.0], [0.0, -1.2]], [[[1.0, 1.0]], [[1.0, 0.0]]], [1]),
        ([[0.0, -1.0], [1.0, 0.0]], [[[1.0, 0.0]], [[0.0, 0.0]]], [1]),  # a rotation shows itself in either coordinate
        ([[0.999999999, 0.0], [0.0, 0.9]], [[[1.0, 0.0]], [[0.0, 1.0]]], [1]),  # all but the unit circle
    ],
)  # fmt: skip
def test_detectability_of_small_systems(A, C, unseen):
    """Popov, Belevitch and Hautus, by hand; agents that hear each other can do what one of them can, and more."""
    assert blind(linear(A, C)) == unseen
    assert blind(linear(A, C, np.ones((2, 2)))) == []
    require_detectable(linear(A, C, np.ones((2, 2))), "here")


def test_detectability_agrees_with_the_rank_of_the_observability_matrix():
    """For random systems whose modes all last, observable and detectable are the same."""
    rng = np.random.default_rng(5)
    found = set()
    for _ in range(60):
        n = int(rng.integers(2, 7))
        T = np.linalg.qr(rng.normal(size=(n, n)))[0]
        A = T @ np.diag(rng.choice([1.0, -1.0, 1.1, 1.5], n)) @ T.T
        C = rng.normal(size=(1, int(rng.integers(1, 3)), n)) @ (T * (rng.uniform(size=n) < 0.8)) @ T.T
        rows = np.concatenate([C[0] @ np.linalg.matrix_power(A, k) for k in range(n)])
        seen = np.linalg.matrix_rank(rows, tol=1e-8) == n
        assert blind(linear(A, C)) == ([] if seen else [0])
        found.add(bool(seen))
    assert found == {True, False}


def test_the_poles_of_a_long_string_are_those_of_one_vehicle():
    """A cascade of 60 equal cars has one car's poles again and again, though numpy, given the whole, scatters them past 1."""
    rng = np.random.default_rng(1)
    own = np.array([[0.9, 0.1, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.0, 0.8]])
    push = 2.0 * rng.normal(size=(3, 3))
    n = 3 * 60
    A = np.zeros((n, n))
    for i in range(60):
        A[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = own
        if i:
            A[3 * i : 3 * i + 3, 3 * i - 3 : 3 * i] = push
    assert np.max(np.abs(np.linalg.eigvals(A))) > 1.0
    one = np.sort_complex(np.linalg.eigvals(own))
    np.testing.assert_allclose(np.sort_complex(eigenvalues(A))[::60], one, atol=1e-9)
    assert lasting(A) == ()
