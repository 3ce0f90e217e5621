"""Decoders of windows against solvers that share no code with them, on random problems, degenerate ones among them."""

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import linprog

import tailgate
from tailgate.estimators.sparse_attacks.l0_robust import explanation
from tailgate.estimators.sparse_attacks.l1_decoder import grouped, programmed
from tests import mixed_integer
from tests.mixed_integer import excess, reach, solve_milp
from tests.readings import dense, play_readings
from tests.windows import KINDS, objective, problem, projected, solve, window

RNG = np.random.default_rng(47)
COUNTS = [20, pytest.param(200, marks=pytest.mark.long)]


@pytest.mark.long
@pytest.mark.parametrize("norm", [2, 1])
def test_the_decoder_is_as_good_as_an_interior_point_solver(norm):
    """200 random problems: after 2000 rounds the objective is Clarabel's, to 3e-5 where signs all but balance."""
    cp = pytest.importorskip("cvxpy")
    for trial in range(200):
        O, Y = problem(RNG, trial)
        ours = objective(O, Y, solve(O, Y, norm), norm)
        g, z = grouped(O, Y, np.ones(Y.shape, bool), norm), cp.Variable(O.shape[-1])
        terms = cp.Minimize(sum(cp.norm(g.Y[0, 0, i] - g.O[0, i] @ z, 2) for i in range(g.O.shape[1])))
        cp.Problem(terms).solve(solver=cp.CLARABEL)
        assert ours <= objective(O, Y, z.value, norm) * (1.0 + 3e-5) + 1e-6, trial


@pytest.mark.parametrize("count", [30, pytest.param(200, marks=pytest.mark.long)])
def test_the_linear_program_is_exact(count):
    """Its value is that of the dual program, and in some windows below that of 200 rounds. An open state has no answer."""
    better = 0
    for trial in range(count):
        O, Y = problem(RNG, trial)
        rows, y = O[0].reshape(-1, O.shape[-1]), Y.ravel()
        x = programmed(rows, y)
        assert (x is None) == (np.linalg.matrix_rank(rows) < rows.shape[1]), trial
        if x is None:
            continue
        ours, theirs = np.abs(y - rows @ x).sum(), objective(O, Y, solve(O, Y, 1, 200), 1)
        assert ours <= theirs * (1.0 + 1e-9) + 1e-9, trial
        better += ours < theirs * (1.0 - 1e-6)
        dual = linprog(-y, A_eq=rows.T, b_eq=np.zeros(O.shape[-1]), bounds=(-1.0, 1.0))  # no x is below its value
        assert ours == pytest.approx(-dual.fun, rel=1e-9, abs=1e-9), trial
    assert better > 0
    assert programmed(np.ones((5, 1)), np.array([1.0, 1.2, 1.1, 50.0, -80.0]))[0] == pytest.approx(1.1, abs=1e-12)


def _lies(trial):
    """A window with errors within D and up to two liars of 1.5 to 5 D: random, equal sensors, a blind one, rounded rows, no errors."""
    n, T = (int(count) for count in RNG.integers(1, 4, size=2))
    q, kind = int(RNG.integers(n + 3, 9)), trial % 5
    O, D = RNG.normal(size=(q, T, n)), RNG.uniform(0.05, 0.2, size=(q, T))
    if kind in (3, 4):
        O = np.round(2.0 * O)
    if kind in (1, 3):
        O[1] = O[0]
    if kind == 2:
        O[0], O[1] = O[0, :1], 0.0
    Y = np.zeros((q, T)) if kind == 4 else O @ RNG.normal(size=n) + D * RNG.uniform(-1.0, 1.0, size=(q, T))
    K = RNG.choice(q, RNG.integers(0, 3), replace=False)
    Y[K] += D[K] * RNG.uniform(1.5, 5.0, size=(len(K), T)) * RNG.choice([-1.0, 1.0], size=(len(K), 1))
    return O, Y, D


def _explaining(O, Y, D, size):
    """All sets of `size` sensors without which a state explains the window, by a linear program each."""
    every = combinations(range(len(O)), size)
    left = [(K, ~np.isin(np.arange(len(O)), K)) for K in every]
    return [K for K, some in left if excess(O[some].reshape(-1, O.shape[-1]), Y[some].ravel(), D[some].ravel()) < 1e-7]


@pytest.mark.parametrize("count", COUNTS)
def test_the_search_and_the_mixed_integer_program_blame_as_few(count):
    """Small lies. Both sets explain the window, no smaller one does; where one alone of that size does, both find it."""
    sizes, ties = set(), 0
    for trial in range(count):
        O, Y, D = _lies(trial)
        there = np.ones(Y.shape, bool)
        found, other = explanation(O, Y, D, there, 2), solve_milp(O, Y, D, there)
        explaining = _explaining(O, Y, D, len(other))
        assert found.found and len(found.attacked) == len(other), trial
        assert found.attacked == explaining[0] and other in explaining, trial
        assert not other or not _explaining(O, Y, D, len(other) - 1), trial
        sizes.add(len(other))
        ties += len(explaining) > 1
    assert sizes == {0, 1, 2} and ties > 0


def test_the_mixed_integer_program_finds_large_lies_and_lost_readings():
    """Two liars of 30; then as many readings are lost as leave it, and the liars' own are among them."""
    for _ in range(10):
        O, _, Y, K = window(RNG, 2, 4, 30.0)
        Y = Y[0, 0] + RNG.uniform(-0.1, 0.1, size=Y.shape[2:])
        D, there = np.full(Y.shape, 0.1), np.ones(Y.shape, bool)
        assert explanation(O[0], Y, D, there, 2).attacked == solve_milp(O[0], Y, D, there) == tuple(K.tolist())
        there[K[0]] = there[:, 0] = False
        assert explanation(O[0], Y, D, there, 2).attacked == solve_milp(O[0], Y, D, there) == (K[1],)


def test_the_mixed_integer_program_checks_its_set(monkeypatch):
    """A slack of HiGHS times a constant of 1e6 once blamed sensor 2, which explains nothing. Even such constants are corrected now."""
    O = np.array([[[-2.0, -1.0]], [[1.0, -1.0]], [[2.0, 0.0]], [[-1.0, 2.0]]])
    Y, D, there = np.array([[5.0], [0.0], [0.0], [0.0]]), np.full((4, 1), 0.1), np.ones((4, 1), bool)
    assert _explaining(O, Y, D, 1) == [(0,)]
    assert solve_milp(O, Y, D, there) == explanation(O, Y, D, there, 1).attacked == (0,)
    monkeypatch.setattr(mixed_integer, "reach", lambda rows, *rest: np.full(len(rows), 1e6))
    for trial in range(10):
        O, Y, D = _lies(trial)
        there = np.ones(Y.shape, bool)
        assert len(solve_milp(O, Y, D, there)) == len(explanation(O, Y, D, there, 2).attacked), trial


def test_the_constants_of_the_program_are_reached():
    """One state and two sensors: x is at an end of the other's interval. A window with too many corners is refused."""
    found = reach(np.array([[1.0], [2.0]]), np.array([3.0, 0.0]), np.array([0.1, 0.2]), np.array([0, 1]))
    np.testing.assert_allclose(found, [3.1 - 0.1, 6.2 - 0.2])
    assert reach(np.ones((1, 1)), np.array([3.0]), np.array([0.1]), np.array([0])) == pytest.approx(2.9)
    with pytest.raises(AssertionError, match="a shorter window"):
        reach(np.ones((100, 3)), np.zeros(100), np.ones(100), np.arange(100))


def _fits(O, Y, s):
    """Least squares without each set of s sensors: sum of squares, set and state, the best first."""
    out = []
    for K in combinations(range(len(O)), s):
        left = ~np.isin(np.arange(len(O)), K)
        rows, y = O[left].reshape(-1, O.shape[-1]), Y[left].ravel()
        x = np.linalg.lstsq(rows, y, rcond=None)[0]
        out.append((float(np.sum((y - rows @ x) ** 2)), K, x))
    return sorted(out, key=lambda fit: fit[0])


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("s, share", [(0, 1.0), (1, 0.9)])
def test_projected_gradients_against_every_subset(s, share, count):
    """The energy that is left is never below the least of all subsets, and without liars it is that. With one it is so in 165 of 175."""
    least, tried = 0, 0
    for trial in range(count):
        O, Y = problem(RNG, trial)
        if trial % KINDS == 7 or len(O[0]) < 2 * s + 1:
            continue
        _, _, found, x = projected(O, Y, s, 1e-14, 300)
        best, tiny = _fits(O[0], Y[0, 0], s)[0], 1e-9 * (1.0 + np.sum(Y * Y))
        assert found.energy[0, 0] >= best[0] - tiny, trial
        least += found.energy[0, 0] <= best[0] * (1.0 + 1e-6) + tiny
        tried += 1
        if s == 0:
            np.testing.assert_allclose(x, best[2], atol=1e-7 * (1.0 + np.abs(best[2]).max()))
    assert least >= share * tried


@pytest.mark.parametrize("count", COUNTS)
def test_etpg_is_least_squares_without_the_sensors_that_it_blames(linear_model, count):
    """Played windows, some with a liar, equal sensors, a blind one or no readings but 0: numpy's least squares on all, or without one."""
    alarms, best = 0, 0
    for trial in range(count // 5):
        model = dense(linear_model, RNG, n=int(RNG.integers(1, 4)), R=0.01)
        C, kind = model.C[0].copy(), trial % 4
        if kind == 1:
            C[1] = C[0]
        if kind == 2:
            C[0] = 0.0
        model = linear_model(model.A, C, model.Q, model.R[0])
        T = int(RNG.integers(3, 6))
        O = np.stack([C @ np.linalg.matrix_power(model.A, t) for t in range(T)], axis=1)
        Y = np.einsum("qtn,bn->bqt", O, RNG.normal(size=(5, len(model.A)))) + 0.1 * RNG.normal(size=(5, 7, T))
        Y = np.zeros_like(Y) if kind == 3 else Y
        Y[2:, 3] += 5.0 * RNG.normal(size=(3, T))
        _, out = play_readings(tailgate.make_defence("etpg", s=1, window=T, rounds=300), model, Y.transpose(2, 0, 1))
        last = np.linalg.matrix_power(model.A, T - 1)
        for b in range(5):
            fits = _fits(O, Y[b], 1 if out[-1][1].alarm[b, 0] else 0)
            off = [np.max(np.abs(out[-1][1].x[b, 0] - last @ x)) for _, _, x in fits]
            assert min(off) < 1e-7, (trial, b)
            alarms += len(fits) > 1
            best += len(fits) > 1 and off[0] < 1e-7
    assert alarms >= count // 2 and best >= 0.9 * alarms
