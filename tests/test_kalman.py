"""Kalman filtering and the chi-square gate: equality with filterpy, known steady states, and what the theorems bound."""

import math
from functools import partial

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter as Reference
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.linalg import solve_discrete_are

import tailgate
from tailgate.base.errors import InputError
from tailgate.core import Innovation, Model, Prior, Received
from tailgate.core.draws import Role, keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import list_scenarios, load_scenario
from tailgate.estimators import AcceptAll, ChiSquare, GatedKalman, Kalman, KalmanFilter, compose
from tailgate.estimators.filters.kalman import KalmanState, steady_state

RNG = np.random.default_rng(11)
NO_DRAWS = keys("train", [0]).at(Role.DEFENCE, np.zeros(1))


class FilterpyFilter:
    """filterpy's filter as an object of one episode; sensors that were not received are left out."""

    def reset(self, model, prior):
        self.C, self.R = model.C[0], model.R[0]
        self.f = Reference(dim_x=model.states, dim_z=len(self.C), dim_u=model.inputs)
        self.f.F, self.f.B, self.f.Q = model.A, model.B, model.Q
        self.f.x, self.f.P = prior.mean.copy(), prior.cov.copy()

    def step(self, y, valid, u):
        self.f.predict(u=u)
        if valid.any():
            self.f.update(y[valid], R=self.R[np.ix_(valid, valid)], H=self.C[valid])
        return self.f.x.copy(), 0.0


def _received(y, valid=None):
    y = np.asarray(y, float)
    return Received(y, np.ones(y.shape, bool) if valid is None else valid, np.zeros(y.shape[:2]))


def _odometry():
    return load_scenario("stop-and-go-v0").brief().model


def _prior(model, batch, spread=1.0):
    n = model.states
    return Prior(np.zeros((batch, 1, n)), np.broadcast_to(spread * np.eye(n), (batch, 1, n, n)).copy())


def test_kf_equals_filterpy_over_300_steps():
    """Estimate and covariance within 1e-10, with a known input and sensors that drop out."""
    model = _odometry()
    y, u = np.cumsum(RNG.normal(size=(300, 4, 1, 2)), axis=0), RNG.normal(size=(300, 4, 1, 1))
    valid = RNG.uniform(size=(300, 4, 1, 2)) > 0.2
    prior = _prior(model, 4, 2.0)
    defence = Kalman()
    plan = defence.prepare(model)
    state = defence.start(plan, prior)
    references = [FilterpyFilter() for _ in range(4)]
    for b, reference in enumerate(references):
        reference.reset(model, Prior(prior.mean[b, 0], prior.cov[b, 0]))
    for k in range(300):
        state, estimate = defence.step(plan, state, _received(y[k], valid[k]), u[k], NO_DRAWS)
        for b, reference in enumerate(references):
            x, _ = reference.step(y[k, b, 0], valid[k, b, 0], u[k, b, 0])
            np.testing.assert_allclose(estimate.x[b, 0], x, atol=1e-10)
            np.testing.assert_allclose(state.filter.P[b, 0], reference.f.P, atol=1e-10)


@pytest.mark.long
def test_filterpy_plays_through_the_adapter(short, play):
    """per_episode(filterpy) drives the same closed loop as `kf`, row by row, under a dropout of one sensor."""
    attack = tailgate.make_attack("dropout", targets=("velocity",), length=20)
    place = short(horizon=120)
    ours = play(place, "kf", attack, range(3), terminate=False)
    theirs = play(place, tailgate.per_episode(FilterpyFilter), attack, range(3), terminate=False)
    np.testing.assert_allclose(theirs.estimate, ours.estimate, atol=1e-9)
    np.testing.assert_allclose(theirs.gap, ours.gap, atol=1e-9)
    alone = play(place, tailgate.per_episode(FilterpyFilter), attack, [2], terminate=False)
    assert alone.trace_hash(0) == theirs.trace_hash(2)


def test_scalar_steady_state_is_the_golden_ratio(linear_model):
    """A = C = Q = R = 1: prediction variance 1.618..., gain 0.618..."""
    model = linear_model(1.0, 1.0, 1.0, 1.0)
    filter_ = KalmanFilter()
    plan = filter_.prepare(model)
    state = filter_.start(plan, _prior(model, 2, 5.0))
    for _ in range(60):
        state = filter_.predict(plan, state, np.zeros((2, 1, 1)))
        innovation = filter_.innovation(plan, state, _received(np.zeros((2, 1, 1))))
        predicted, gain = state.P, filter_.gain(plan, state, innovation)
        state = filter_.update(plan, state, innovation, np.ones((2, 1, 1), bool))
    golden = (1 + math.sqrt(5)) / 2
    np.testing.assert_allclose(predicted, golden, rtol=1e-12)
    np.testing.assert_allclose(gain, golden - 1, rtol=1e-12)


@pytest.mark.thin(3)
@pytest.mark.parametrize("attack", ["none", "fdi", "dos_jam", "dropout", "dos_hold"])
def test_a_gate_at_infinity_is_the_kalman_filter(attack, short, play):
    """chi2_kf with eta = 1e12 equals kf to the last bit of the trace."""
    kf = play(short(), "kf", attack, range(8))
    gated = play(short(), GatedKalman(eta=1e12), attack, range(8))
    assert [kf.trace_hash(i) for i in range(8)] == [gated.trace_hash(i) for i in range(8)]


def test_a_gated_step_is_open_loop():
    """Above eta: alarm, x = x- and P = P-; below: the Kalman update; row by row."""
    model, defence = _odometry(), GatedKalman(eta=9.0)
    plan = defence.prepare(model)
    state = defence.start(plan, _prior(model, 3))
    u = RNG.normal(size=(3, 1, 1))
    predicted = plan.filter.predict(plan.filter_plan, state.filter, u)
    y = predicted.x[..., :2] + np.array([[[1e3, 0.0]], [[0.5, 0.5]], [[0.0, -1e3]]])
    after, estimate = defence.step(plan, state, _received(y), u, NO_DRAWS)
    np.testing.assert_array_equal(estimate.alarm[:, 0], [True, False, True])
    for b in (0, 2):
        np.testing.assert_array_equal(estimate.x[b], predicted.x[b])
        np.testing.assert_allclose(after.filter.P[b], predicted.P[b], rtol=1e-14)
    _, kf = Kalman().step(Kalman().prepare(model), Kalman().start(Kalman().prepare(model), _prior(model, 3)), _received(y), u, NO_DRAWS)
    np.testing.assert_array_equal(estimate.x[1], kf.x[1])
    assert abs(estimate.x[1, 0, 0] - predicted.x[1, 0, 0]) > 0.1


def test_false_alarm_rate_with_two_sensors_is_exp_of_minus_half_eta():
    """On a matched linear simulation the innovations are white and chi-square: alarms are Binomial(n, exp(-eta/2))."""
    eta, batch, steps = 4.0, 2000, 30
    model = _odometry()
    defence = compose(KalmanFilter(), ChiSquare(eta), AcceptAll())
    plan = defence.prepare(model)
    prior = _prior(model, batch)
    state, x = defence.start(plan, prior), RNG.normal(size=(batch, 3))
    alarms, scores = 0, []
    for _ in range(steps):
        u = RNG.normal(size=(batch, 1, 1))
        x = x @ model.A.T + u[:, 0] @ model.B.T + RNG.normal(size=(batch, 3)) * np.sqrt(np.diag(model.Q))
        y = x @ model.C[0].T + RNG.normal(size=(batch, 2)) * np.sqrt(np.diag(model.R[0]))
        state, estimate = defence.step(plan, state, _received(y[:, None]), u, NO_DRAWS)
        alarms += int(estimate.alarm.sum())
        scores.append(estimate.score.ravel())
    rate, n = math.exp(-eta / 2), batch * steps
    assert abs(alarms - n * rate) < 5 * math.sqrt(n * rate * (1 - rate))
    assert stats.kstest(np.concatenate(scores), stats.chi2(2).cdf).pvalue > 1e-4


_VALUES = st.floats(-1.0, 1.0)


@pytest.mark.long
@given(st.lists(_VALUES, min_size=9, max_size=9), st.lists(_VALUES, min_size=2, max_size=2), st.floats(0.5, 40.0))
def test_one_accepted_sample_moves_the_estimate_by_at_most_the_bound(root, direction, eta):
    """|x - x-| <= sqrt(eta lambda_max(P- - P+)) for every innovation within the gate."""
    model, filter_ = _odometry(), KalmanFilter()
    plan = filter_.prepare(model)
    P = np.array(root).reshape(3, 3)
    state = KalmanState(np.zeros((1, 1, 3)), (P @ P.T + 0.01 * np.eye(3))[None, None])
    S = filter_.innovation(plan, state, _received(np.zeros((1, 1, 2)))).S[0, 0]
    r = np.linalg.cholesky(S) @ np.array(direction)
    r *= math.sqrt(eta / max(r @ np.linalg.solve(S, r), eta))
    after = filter_.update(plan, state, Innovation(r[None, None], S[None, None]), np.ones((1, 1, 2), bool))
    bound = math.sqrt(eta * np.linalg.eigvalsh(state.P[0, 0] - after.P[0, 0])[-1])
    assert np.linalg.norm(after.x) <= bound * (1 + 1e-9)


def test_the_jump_bound_is_tight():
    """Some innovation on the gate reaches it: along e, r = sqrt(eta) S K' e / sqrt(e' K S K' e)."""
    model, filter_, eta = _odometry(), KalmanFilter(), 20.0
    plan = filter_.prepare(model)
    state = filter_.predict(plan, filter_.start(plan, _prior(model, 1)), np.zeros((1, 1, 1)))
    innovation = filter_.innovation(plan, state, _received(np.zeros((1, 1, 2))))
    K, S = filter_.gain(plan, state, innovation)[0, 0], innovation.S[0, 0]
    after = filter_.update(plan, state, innovation, np.ones((1, 1, 2), bool))
    gap, vectors = np.linalg.eigh(state.P[0, 0] - after.P[0, 0])
    np.testing.assert_allclose(K @ S @ K.T, state.P[0, 0] - after.P[0, 0], atol=1e-12)
    e = vectors[:, -1]
    r = math.sqrt(eta) * S @ K.T @ e / math.sqrt(e @ K @ S @ K.T @ e)
    moved = filter_.update(plan, state, Innovation(r[None, None], S[None, None]), np.ones((1, 1, 2), bool)).x
    assert r @ np.linalg.solve(S, r) == pytest.approx(eta, rel=1e-12)
    assert np.linalg.norm(moved) == pytest.approx(math.sqrt(eta * gap[-1]), rel=1e-9)


@pytest.mark.parametrize("eta", [4.0, 20.0])
def test_stealth_reaches_the_gate_and_never_alarms(eta, short, play):
    """Every attacked step scores within 1e-6 of the gate from below, and pushes the car's belief backwards."""
    trace = play(short(horizon=90, fdi_bound=1e4), GatedKalman(eta=eta), "stealth", range(16), terminate=False)
    on = trace.kind != 0
    assert on[9:].all() and not on[:9].any()
    score = trace.score[9:, :, 0]
    assert np.max(np.abs(score - eta)) < 1e-6 and score.max() < eta
    assert not trace.alarm[9:].any()
    assert (trace.estimate[-1, :, 0, 0] - trace.truth[-1, :, 0, 0]).max() < -5.0


def test_stealth_that_meets_the_injection_bound_keeps_still_rather_than_alarm(short, play):
    """No attacked step alarms, also where the threat model's bound no longer hides what was injected before."""
    trace = play(short(horizon=90, fdi_bound=10.0), "chi2_kf", "stealth", range(16), terminate=False)
    assert 9.0 < np.max(np.abs(trace.value)) <= 10.0
    assert (trace.kind != 0)[9:20].all() and not trace.alarm[trace.kind != 0].any()


@pytest.mark.parametrize("wire", [0, 1])
def test_stealth_on_one_granted_wire(wire, short, play):
    """With one wire alone: no attacked step alarms, each reaches the gate, and the belief is pushed backwards."""
    place = short(horizon=90, fdi_bound=1e4, targets=(("position", "velocity")[wire],))
    trace = play(place, "chi2_kf", "stealth", range(16), terminate=False)
    on = trace.kind != 0
    assert on[9:15].all() and not trace.target[..., 1 - wire].any()
    assert not trace.alarm[on].any() and np.max(np.abs(trace.score[on] - 20.0)) < 1e-6
    assert (trace.estimate[-1, :, 0, 0] - trace.truth[-1, :, 0, 0]).max() < -1.0


@pytest.mark.parametrize("sensor", [0, 1])
def test_partial_acceptance_is_a_filter_with_that_sensor_alone(sensor, linear_model):
    """Accepting one of two correlated sensors equals the model that has only that one."""
    full = _odometry()
    R = np.array([[1.0, 0.6], [0.6, 2.0]])
    both = linear_model(full.A, full.C[0], full.Q, R)
    one = linear_model(full.A, full.C[0][[sensor]], full.Q, R[sensor, sensor])
    P = RNG.normal(size=(5, 1, 3, 3))
    state = KalmanState(RNG.normal(size=(5, 1, 3)), P @ np.swapaxes(P, -1, -2))
    y, accept = RNG.normal(size=(5, 1, 2)), np.broadcast_to(np.arange(2) == sensor, (5, 1, 2))
    after = []
    for model, reading, use in ((both, y, accept), (one, y[..., [sensor]], np.ones((5, 1, 1), bool))):
        filter_ = KalmanFilter()
        plan = filter_.prepare(model)
        after.append(filter_.update(plan, state, filter_.innovation(plan, state, _received(reading)), use))
    np.testing.assert_allclose(after[0].x, after[1].x, atol=1e-12)
    np.testing.assert_allclose(after[0].P, after[1].P, atol=1e-12)


def test_dropout_equals_rejection(same_bits):
    """Nothing received (even NaN on the wire) leaves the state of a rejected measurement, bit for bit, and no alarm."""
    model, defence = _odometry(), GatedKalman(eta=9.0)
    plan = defence.prepare(model)
    state, u = defence.start(plan, _prior(model, 2)), RNG.normal(size=(2, 1, 1))
    lost, quiet = defence.step(plan, state, _received(np.full((2, 1, 2), np.nan), np.zeros((2, 1, 2), bool)), u, NO_DRAWS)
    rejected, loud = defence.step(plan, state, _received(np.full((2, 1, 2), 1e4)), u, NO_DRAWS)
    assert loud.alarm.all() and not quiet.alarm.any()
    assert same_bits(lost.filter.x, rejected.filter.x) and same_bits(lost.filter.P, rejected.filter.P)


@pytest.mark.parametrize("lost", [0, 1])
def test_the_gate_judges_what_was_received(lost):
    """With one sensor dropped out, the score is r^2 / S of the other alone: chi-square with one degree of freedom."""
    model, defence = _odometry(), GatedKalman()
    plan = defence.prepare(model)
    P = np.array([[4.0, 1.5, 0.2], [1.5, 1.0, 0.3], [0.2, 0.3, 0.5]])
    state = defence.start(plan, Prior(np.zeros((1, 1, 3)), P[None, None]))
    valid = (np.arange(2) != lost)[None, None]
    _, estimate = defence.step(plan, state, _received([[[2.0, 2.0]]], valid), np.zeros((1, 1, 1)), NO_DRAWS)
    S = model.C[0] @ (model.A @ P @ model.A.T + model.Q) @ model.C[0].T + model.R[0]
    assert estimate.score[0, 0] == pytest.approx(4.0 / S[1 - lost, 1 - lost], rel=1e-12)


@pytest.mark.parametrize("name", [name for name in list_scenarios() if load_scenario(name).plant.size[0] == 1])
def test_the_steady_state_of_every_scenario_solves_the_riccati_equation(name):
    """P- agrees with scipy's to 1e-11, and one step of the filter gives it back to 1e-14. Networks: tests/test_distributed.py."""
    model = load_scenario(name).brief().model
    A, C, Q, R = model.A, model.C[0], model.Q, model.R[0]
    P = steady_state(model)[0]
    np.testing.assert_allclose(P, solve_discrete_are(A.T, C.T, Q, R), rtol=1e-11, atol=1e-16)
    K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    np.testing.assert_allclose(A @ (P - K @ C @ P) @ A.T + Q, P, rtol=1e-13, atol=1e-18)


def test_the_steady_state_of_random_models():
    """P- agrees with scipy's for stable, marginal and unstable plants, each agent with its own sensors."""
    rng = np.random.default_rng(4)
    for _ in range(15):
        n, q = rng.integers(1, 7), rng.integers(1, 4)
        A = rng.normal(size=(n, n))
        A *= rng.choice([0.5, 1.0, 1.3]) / np.max(np.abs(np.linalg.eigvals(A)))
        C, root, noise = rng.normal(size=(2, q, n)), rng.normal(size=(n, n + 1)), rng.normal(size=(2, q, q + 1))
        Q, R = root @ root.T * 10.0 ** rng.integers(-3, 3), noise @ np.swapaxes(noise, 1, 2) + 0.1 * np.eye(q)
        model = Model(A, np.zeros((n, 1)), np.zeros(n), C, Q, R, np.eye(2, dtype=bool), 1.0, tuple(f"y{i}" for i in range(q)))
        for i, P in enumerate(steady_state(model)):
            want = solve_discrete_are(A.T, C[i].T, Q, R[i])
            np.testing.assert_allclose(P, want, atol=1e-8 * np.max(np.abs(want)))


@pytest.mark.parametrize(
    "A, C, Q",
    [
        ([[1.0, 0.1], [0.0, 1.0]], [[0.0, 1.0]], np.eye(2)),  # nobody sees the position
        ([[1.2]], [[0.0]], 1.0),
        ([[1.0]], [[1.0]], 0.0),  # the gain dies out, and never settles
    ],
)
def test_no_steady_state_is_one_clear_error(A, C, Q, linear_model):
    """A pair that is not detectable, or a lasting mode without noise, is an InputError that says so."""
    model = linear_model(A, C, Q, 1.0)
    for prepare in (KalmanFilter(steady=True).prepare, Kalman(gain="steady").prepare, tailgate.make_defence("rkf").prepare):
        with pytest.raises(InputError, match="detectable"):
            prepare(model)
    KalmanFilter().prepare(model)


def test_a_stable_mode_that_nobody_sees_has_a_steady_state(linear_model):
    """Detectable is enough: 1 / (1 - 0.9^2), unseen."""
    assert steady_state(linear_model(0.9, 0.0, 1.0, 1.0))[0, 0, 0] == pytest.approx(1.0 / 0.19, rel=1e-12)


@pytest.mark.long
def test_the_time_varying_filter_settles_at_the_steady_one():
    """From its golden-ratio gain on, the steady filter's estimates are the varying one's: 1.618 and 0.618 for A = C = Q = R = 1."""
    model = load_scenario("thesis-ch4-v0").brief().model
    held, varying = KalmanFilter(steady=True), KalmanFilter()
    plan, other = held.prepare(model), varying.prepare(model)
    one, two = held.start(plan, _prior(model, 2)), varying.start(other, _prior(model, 2))
    for _ in range(1500):
        y, u = _received(RNG.normal(size=(2, 1, 2))), RNG.normal(size=(2, 1, 1))
        one, two = held.predict(plan, one, u), varying.predict(other, two, u)
        ours, theirs = held.innovation(plan, one, y), varying.innovation(other, two, y)
        gains = held.gain(plan, one, ours), varying.gain(other, two, theirs)
        settled = two.P
        one, two = (f.update(p, s, i, y.valid) for f, p, s, i in ((held, plan, one, ours), (varying, other, two, theirs)))
    np.testing.assert_allclose(plan.held[0], settled[0, 0], rtol=1e-9)
    np.testing.assert_allclose(ours.S, theirs.S, rtol=1e-9)
    np.testing.assert_allclose(gains[0], gains[1], rtol=1e-9)
    np.testing.assert_allclose(one.x, two.x, atol=1e-8)
    assert gains[0][0, 0, 0, 0] == pytest.approx(0.618, abs=2e-3) and plan.held[0, 0, 0] == pytest.approx(1.618, abs=5e-3)


def test_the_golden_ratio_is_the_steady_state_of_the_scalar_case(linear_model):
    """A = C = Q = R = 1: P- = (1 + sqrt 5) / 2 and K = P- - 1, to the last digit but one."""
    P = steady_state(linear_model(1.0, 1.0, 1.0, 1.0))[0, 0, 0]
    np.testing.assert_allclose([P, P / (P + 1.0)], [(math.sqrt(5) + 1) / 2, (math.sqrt(5) - 1) / 2], rtol=4e-16)


@pytest.mark.parametrize("sensor", [0, 1])
def test_a_steady_filter_without_one_sensor_uses_the_other_alone_at_the_same_covariance(sensor):
    """x = x- + P- C_j' r_j / S_jj, whether the other is missing or not accepted; S does not widen."""
    model, filter_ = _odometry(), KalmanFilter(steady=True)
    plan = filter_.prepare(model)
    belief = filter_.predict(plan, filter_.start(plan, _prior(model, 1)), np.zeros((1, 1, 1)))
    r, only = np.array([[[1.5, -2.0]]]), (np.arange(2) == sensor)[None, None]
    P, C = plan.held[0], model.C[0][sensor]
    want = P @ C * r[0, 0, sensor] / (C @ P @ C + model.R[0, sensor, sensor])
    y = belief.x[..., :2] + r
    for valid, accept in ((only, only), (np.ones_like(only), only)):
        innovation = filter_.innovation(plan, belief, _received(np.where(valid, y, np.nan), valid))
        after = filter_.update(plan, belief, innovation, accept)
        np.testing.assert_allclose(after.x[0, 0] - belief.x[0, 0], want, rtol=1e-12)
        assert after.P is None


def test_a_shut_gate_widens_only_with_a_varying_gain(short, play):
    """Under a lasting jump the score of the open-loop filter falls as S grows; with the steady gain it does not."""
    attack = tailgate.make_attack("fdi", targets=("position",), value=40.0)
    place = short("gusty-stop-and-go-v0", horizon=400)
    late = [play(place, GatedKalman(gain=gain), attack, range(6), terminate=False).score[350:].mean() for gain in ("varying", "steady")]
    assert late[0] < 20.0 < 1000.0 < late[1]


def test_a_steady_filter_may_forget_for_one_step(short, play):
    """Re-acquiring ends the lock-out with a steady gain too, and its rows do not depend on their batch."""
    attack = tailgate.make_attack("fdi", value=40.0, length=30)
    defences = [Spec("defence", f"composed:filter=kf,filter.steady=true,mitigation={m}").make() for m in ("reacquire", "gate_out")]
    place = short("gusty-stop-and-go-v0", horizon=90)
    traces = [play(place, d, attack, range(9), terminate=False) for d in defences]
    error = [np.abs(t.estimate - t.truth)[-1, :, 0, 0] for t in traces]
    assert np.median(error[0]) < 3.0 and np.isfinite(error[0]).all()
    assert not np.array_equal(traces[0].estimate, traces[1].estimate)
    alone = play(place, defences[0], attack, [5], terminate=False)
    assert alone.trace_hash(0) == traces[0].trace_hash(5)


@pytest.mark.parametrize("defence", [Kalman(gain="steady"), GatedKalman(gain="steady")])
def test_rows_of_a_steady_filter_do_not_depend_on_their_batch(defence, short, play, same_rows):
    """trace_hash is the same alone and among 16, where some rows lose a sensor and others do not."""
    place = short(jam_range=(-1e3, 1e3))
    for attack in ("dropout", "fdi_bernoulli"):
        rival = tailgate.make_attack(attack, trigger="closing", threshold=1.0, targets=("velocity",))
        same_rows(partial(play, place, defence, rival), 16, [0], [15])
