"""filterpy's filters as defences, and the adapter for filters of one episode."""

import copy
import functools
import subprocess
import sys

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.base.pytree import leaves
from tailgate.core import Model, Prior, Received
from tailgate.core.draws import Role, keys
from tailgate.core.registry import Spec, entry_for, text_of
from tailgate.core.scenario import load_scenario
from tailgate.estimators.filters.filterpy_filters import root

NAMES = ("filterpy_kf", "filterpy_ekf", "filterpy_ukf", "filterpy_hinfinity", "filterpy_imm")
NO_DRAWS = keys("train", [0]).at(Role.DEFENCE, np.zeros(1))


def _feed(defence, model, y, valid, u):
    """Estimates (K, B, N, n) and scores (K, B, N) for readings y (K, B, N, q)."""
    plan, (_, batch, agents, _) = defence.prepare(model), y.shape
    n = model.states
    state = defence.start(plan, Prior(np.ones((batch, agents, n)), np.broadcast_to(2.0 * np.eye(n), (batch, agents, n, n)).copy()))
    out = []
    for k in range(len(y)):
        state, estimate = defence.step(plan, state, Received(y[k], valid[k], np.zeros((batch, agents))), u[k], NO_DRAWS)
        out.append((estimate.x, estimate.score))
    return [np.array(part) for part in zip(*out, strict=True)]


def _data(model, steps=120, batch=2, agents=1):
    rng = np.random.default_rng(6)
    q = len(model.sensors)
    y = 1000.0 + np.cumsum(rng.normal(size=(steps, batch, agents, q)), axis=0)
    return y, rng.uniform(size=y.shape) > 0.25, rng.normal(size=(steps, batch, agents, model.inputs))


def _drifting(linear_model):
    """A model with correlated sensors and a constant drift c."""
    base = load_scenario("stop-and-go-v0").brief().model
    R = np.array([[1.0, 0.5], [0.5, 2.0]])
    model = linear_model(base.A, base.C[0], 10.0 * base.Q, R, base.B)
    return Model(model.A, model.B, np.array([0.3, -0.1, 0.02]), model.C, model.Q, model.R, model.graph, 0.1, model.sensors)


@pytest.mark.parametrize("name", ["filterpy_kf", "filterpy_ekf", "filterpy_ukf", "filterpy_hinfinity"])
def test_on_a_linear_model_they_are_our_kalman_filter(name, linear_model):
    """Estimate within 1e-9 and score within 1e-7 of kf, with drift, input, correlated noise and sensors that drop out (H-infinity: gamma = 0)."""
    model = _drifting(linear_model)
    data = _data(model)
    assert not data[1].all(axis=-1).all() and (~data[1]).all(axis=-1).any()
    options = {"gamma": 0.0} if name == "filterpy_hinfinity" else {}
    x, score = _feed(tailgate.make_defence(name, **options), model, *data)
    want_x, want_score = _feed(tailgate.make_defence("kf"), model, *data)
    np.testing.assert_allclose(x, want_x, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(score, want_score, rtol=1e-7, atol=1e-9)


def test_filterpys_imm_is_ours(linear_model):
    """Estimate within 1e-9 of `imm`, sensors that drop out included."""
    model = _drifting(linear_model)
    y, valid, u = _data(model)
    y[40:60] += 8.0
    y -= 1000.0  # from far off, filterpy's likelihoods all underflow to one floor
    x, _ = _feed(tailgate.make_defence("filterpy_imm"), model, y, valid, u)
    want, odds = _feed(tailgate.make_defence("imm"), model, y, valid, u)
    np.testing.assert_allclose(x, want, rtol=0.0, atol=1e-9)
    assert odds.min() < 0.0 < odds.max()
    with pytest.raises(InputError):
        tailgate.make_defence("filterpy_imm", factors=(1.0,))


def _energy_gain(filter_, model):
    """Largest energy gain of the steady filter from w (in units of Q) and v (R) to the error of C x (R), over all frequencies."""
    A, C, Q, R = model.A, model.C[0], model.Q, model.R[0]
    n, q = A.shape[0], len(C)
    adapter = filter_.make()
    adapter.reset(model, Prior(np.zeros(n), Q.copy()))
    K = np.empty((n, q))
    for i in range(1501):
        adapter.recall((np.zeros(n), adapter.memory()[1]))
        if i < 1500:
            adapter.step(np.zeros(q), np.ones(q, bool), np.zeros(model.inputs))
            continue
        P = adapter.memory()[1]
        for j in range(q):
            adapter.recall((np.zeros(n), P.copy()))
            K[:, j], _ = adapter.step(np.eye(q)[j], np.ones(q, bool), np.zeros(model.inputs))
    J, worst = np.eye(n) - K @ C, 0.0
    weigh = np.linalg.inv(np.linalg.cholesky(R))
    for w in np.geomspace(1e-3, np.pi, 150):
        T = np.linalg.inv(np.exp(1j * w) * np.eye(n) - J @ A)
        H = weigh @ C @ T @ np.hstack([J @ np.linalg.cholesky(Q), -K @ np.linalg.cholesky(R)])
        worst = max(worst, np.linalg.norm(H, 2) ** 2)
    return worst


@pytest.mark.long
@pytest.mark.parametrize("name", ["gusty-stop-and-go-v0", "thesis-ch4-v0"])
def test_h_infinity_keeps_its_bound(name):
    """The worst energy gain from disturbances to the error of C x is below 1/gamma, and below the Kalman filter's."""
    model = load_scenario(name).brief().model
    gains = {g: _energy_gain(tailgate.make_defence("filterpy_hinfinity", gamma=g), model) for g in (0.0, 0.5, 0.9)}
    assert gains[0.9] < gains[0.5] < gains[0.0] and gains[0.5] <= 2.0 and gains[0.9] <= 1.0 / 0.9


def test_h_infinity_cannot_break_down(linear_model):
    """With gamma close to 1 and an uncertain prior its covariance stays positive definite, without sensors as well; 1 is refused."""
    model = _drifting(linear_model)
    adapter = tailgate.make_defence("filterpy_hinfinity", gamma=0.999).make()
    adapter.reset(model, Prior(np.zeros(3), 1e6 * np.eye(3)))
    for k in range(200):
        x, score = adapter.step(np.array([3.0, 1.0]), np.array([k % 3 > 0, k % 5 > 0]), np.zeros(1))
        assert np.linalg.eigvalsh(adapter.memory()[1]).min() > 0.0 and np.isfinite(x).all() and score >= 0.0
    for gamma in (1.0, -0.1):
        with pytest.raises(InputError):
            tailgate.make_defence("filterpy_hinfinity", gamma=gamma)


def test_h_infinity_warns_nobody(recwarn):
    """filterpy's warning about its own class is heeded by the adapter, not passed on."""
    _feed(tailgate.make_defence("filterpy_hinfinity"), load_scenario("stop-and-go-v0").brief().model, *(x[:3] for x in _data(load_scenario("stop-and-go-v0").brief().model)))
    assert not [w for w in recwarn if issubclass(w.category, DeprecationWarning) and "likely incorrect" in str(w.message)]


def test_the_square_root_takes_singular_covariances():
    """U' U = P, upper triangular, for full and for deficient rank; nothing is uncertain: nothing spreads."""
    rng = np.random.default_rng(1)
    for rank in (4, 2, 1):
        half = rng.normal(size=(4, rank))
        P = half @ half.T
        U = root(P)
        np.testing.assert_allclose(U.T @ U, P, atol=1e-6 * np.max(P))
        assert not np.tril(U, -1).any()
    assert not root(np.zeros((3, 3))).any()


def test_each_agent_has_its_own_sensors(linear_model):
    """Two agents with different C and R are played as two models of one agent each."""
    base = load_scenario("stop-and-go-v0").brief().model
    C, R = np.stack([base.C[0], base.C[0][::-1]]), np.stack([base.R[0], 4.0 * base.R[0]])
    both = Model(base.A, base.B, base.c, C, base.Q, R, np.eye(2, dtype=bool), 0.1, base.sensors)
    y, valid, u = _data(both, steps=20, agents=2)
    whole, _ = _feed(tailgate.make_defence("filterpy_kf"), both, y, valid, u)
    for i in (0, 1):
        one = linear_model(base.A, C[i], base.Q, R[i], base.B)
        alone, _ = _feed(tailgate.make_defence("filterpy_kf"), one, y[:, :, [i]], valid[:, :, [i]], u[:, :, [i]])
        np.testing.assert_array_equal(alone[:, :, 0], whole[:, :, i])


@pytest.mark.parametrize("name", NAMES)
def test_a_state_is_plain_numbers(name):
    """Every leaf is a float array with B first, so that a state is copied, cut and stored as any other."""
    loop = load_scenario("stop-and-go-v0").loop(tailgate.make_defence(name))
    state = loop.start(keys("train", range(3)))
    held = leaves(state.defence)
    assert held and all(leaf.dtype == np.float64 and len(leaf) == 3 for leaf in held.values())


class Counter:
    """A filter of one episode that says nothing of what it remembers: the sum of its readings."""

    def reset(self, model, prior):
        self.model, self.total, self.log = model, prior.mean.copy(), []

    def step(self, y, valid, u):
        self.total[: len(y)] += y
        self.log.append(y)
        return self.total, float(len(self.log))


def _steps(defence, plan, state, count, start=0):
    for k in range(start, start + count):
        y = np.full((2, 1, 2), float(k))
        state, estimate = defence.step(plan, state, Received(y, np.ones(y.shape, bool), np.zeros((2, 1))), np.zeros((2, 1, 1)), NO_DRAWS)
    return state, estimate


def test_states_of_objects_are_independent():
    """A step leaves the state that it was given as it was: going on from it twice gives the same, whatever was played between."""
    model, defence = load_scenario("stop-and-go-v0").brief().model, tailgate.per_episode(Counter)
    plan = defence.prepare(model)
    fresh = defence.start(plan, Prior(np.zeros((2, 1, 3)), np.zeros((2, 1, 3, 3))))
    held, _ = _steps(defence, plan, fresh, 3)
    one, first = _steps(defence, plan, held, 4, 3)
    _, second = _steps(defence, plan, copy.copy(held), 4, 3)
    np.testing.assert_array_equal(first.x, second.x)
    np.testing.assert_array_equal(first.score, np.full((2, 1), 7.0))
    assert len(held.filters[0, 0].log) == 3 and len(fresh.filters[0, 0].log) == 0 and len(one.filters[0, 0].log) == 7
    assert one.filters[0, 0].model is fresh.filters[0, 0].model


def test_a_restart_of_some_rows_leaves_the_others_alone(short):
    """After a restart the old state and the new one play on without disturbing each other."""
    loop = short().loop(tailgate.per_episode(Counter))
    nothing = tailgate.make_attack("none")
    plan, state = nothing.prepare(loop.brief), loop.start(keys("train", range(3)))
    for _ in range(4):
        state, _, _ = loop.step(state, nothing, plan, None)
    after = loop.restart(state, np.array([False, True, False]))
    frames = []
    for _ in range(2):  # the second time from the same two states
        a, _, one = loop.step(state, nothing, plan, None)
        _, _, two = loop.step(after, nothing, plan, None)
        loop.step(a, nothing, plan, None)
        frames.append((one.estimate.score.ravel(), two.estimate.score.ravel()))
    np.testing.assert_array_equal(frames[0], frames[1])
    np.testing.assert_array_equal(frames[0], [[5.0, 5.0, 5.0], [5.0, 1.0, 5.0]])


def test_the_package_imports_no_filterpy():
    """Listing the defences needs neither filterpy nor matplotlib."""
    code = "import sys, tailgate; tailgate.list_defences(); print(sorted({'filterpy', 'matplotlib', 'cvxpy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def _made():
    return Counter()


@pytest.mark.parametrize("factory", [Counter, _made, f"{__name__}:Counter", f"{__name__}:_made"])
def test_an_adapted_filter_has_a_name_that_makes_it_again(factory):
    """The text of its rows, which another process reads, gives the same defence."""
    defence = tailgate.per_episode(factory)
    text = text_of(entry_for("defence", type(defence)), defence)
    assert Spec("defence", text).make() == defence and isinstance(defence.make(), Counter)
    assert defence.factory == f"{__name__}:{getattr(factory, '__name__', str(factory).partition(':')[2])}"


@pytest.mark.parametrize("factory", [lambda: Counter(), functools.partial(Counter), Counter().step, "Counter", f"{__name__}:Nobody", f"{__name__}:NO_DRAWS", 3])
def test_an_adapted_filter_without_a_name_is_refused(factory):
    """A lambda, a partial and a bound method have no name in a module; a text must name something to call."""
    with pytest.raises(InputError, match="per_episode: got"):
        tailgate.per_episode(factory)
