"""A gate per sensor: who is blamed, how often, and what is then used."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

import tailgate
from tailgate import num
from tailgate.core import Innovation, Prior, Received
from tailgate.core.draws import Role, keys
from tailgate.core.scenario import load_scenario
from tailgate.estimators import GatedKalman, KalmanFilter, SparseChiSquare, SparseGatedKalman

RNG = np.random.default_rng(23)
NO_DRAWS = keys("train", [0]).at(Role.DEFENCE, np.zeros(1))


def _model(linear_model, q):
    return linear_model(np.eye(q), np.eye(q), np.eye(q), np.eye(q))


def _judge(detector, model, r, S):
    plan = detector.prepare(model)
    return plan, detector.step(plan, None, Innovation(r[:, None], np.broadcast_to(S, (len(r), 1, *S.shape[-2:]))))[1]


def _simulate(eta, bias, batch=2000, steps=25):
    """Verdicts (alarm, only sensor 0 blamed, both) of a matched simulation whose sensor 0 is off by `bias`; the honest ones are used."""
    model, filter_, detector = load_scenario("stop-and-go-v0").brief().model, KalmanFilter(), SparseChiSquare(eta)
    plan, gates = filter_.prepare(model), detector.prepare(model)
    state = filter_.start(plan, Prior(np.zeros((batch, 1, 3)), np.broadcast_to(np.eye(3), (batch, 1, 3, 3)).copy()))
    honest = np.broadcast_to([bias == 0.0, True], (batch, 1, 2))
    x, counts = RNG.normal(size=(batch, 3)), np.zeros(3, int)
    for _ in range(steps):
        x = x @ model.A.T + RNG.normal(size=(batch, 3)) * np.sqrt(np.diag(model.Q))
        y = x @ model.C[0].T + RNG.normal(size=(batch, 2)) * np.sqrt(np.diag(model.R[0])) + np.array([bias, 0.0])
        received = Received(y[:, None], np.ones((batch, 1, 2), bool), np.zeros((batch, 1)))
        belief = filter_.predict(plan, state, np.zeros((batch, 1, 1)))
        innovation = filter_.innovation(plan, belief, received)
        _, verdict = detector.step(gates, None, innovation)
        blamed = verdict.suspect[:, 0]
        counts += np.array([verdict.alarm.sum(), (blamed[:, 0] & ~blamed[:, 1]).sum(), blamed.all(axis=1).sum()])
        state = filter_.update(plan, belief, innovation, honest)
    return counts, batch * steps


def _near(count, n, p):
    return abs(count - n * p) < 5 * math.sqrt(n * p * (1 - p))


@pytest.mark.parametrize("eta", [4.0, 7.0])
def test_the_false_alarm_rate_with_two_sensors_is_exp_of_minus_half_eta(eta):
    """The joint test alarms as Algorithm 3 does: Binomial(n, exp(-eta/2)) on clean, matched innovations."""
    counts, n = _simulate(eta, 0.0)
    assert _near(counts[0], n, math.exp(-eta / 2))


@pytest.mark.parametrize("eta", [3.0, 6.0])
def test_one_attacked_sensor_is_dropped_alone_as_often_as_theory_says(eta):
    """Far off, sensor 0 is always blamed, and the honest one passes its own gate with probability 1 - exp(-eta/2); never only that one."""
    counts, n = _simulate(eta, 1e4)
    p = math.exp(-eta / 2)
    assert counts[0] == n and counts[1] + counts[2] == n
    assert _near(counts[1], n, 1 - p)


def test_the_sensor_that_is_left_is_used():
    """The step with sensor 0 attacked is the Kalman step with sensor 1 alone; Algorithm 3 would predict open loop."""
    model = load_scenario("stop-and-go-v0").brief().model
    y = np.array([[[500.0, 1.0]]])
    received = Received(y, np.ones((1, 1, 2), bool), np.zeros((1, 1)))
    alone = received._replace(valid=np.array([[[False, True]]]))
    prior, u = Prior(np.zeros((1, 1, 3)), np.eye(3)[None, None]), np.zeros((1, 1, 1))

    def step(defence, received):
        plan = defence.prepare(model)
        return defence.step(plan, defence.start(plan, prior), received, u, NO_DRAWS)

    (sparse, estimate), (one, _) = step(SparseGatedKalman(), received), step(GatedKalman(), alone)
    np.testing.assert_array_equal(estimate.x, one.filter.x)
    np.testing.assert_array_equal(sparse.filter.P, one.filter.P)
    assert estimate.alarm.all() and estimate.x[0, 0, 1] > 0.1
    _, gated = step(GatedKalman(), received)
    assert gated.x[0, 0, 1] == 0.0 and gated.score == estimate.score


@pytest.mark.parametrize("attack", ["none", "fdi", "dos_jam"])
def test_it_is_algorithm_3_where_every_alarm_blames_all(attack, short, play):
    """Clean, or with both sensors far off, the traces equal chi2_kf's to the last bit."""
    place = short("gusty-stop-and-go-v0", horizon=60)
    options = {"low": 2e3, "high": 3e3} if attack == "dos_jam" else {"value": -2e3} if attack == "fdi" else {}
    place = place.with_threat(fdi_bound=1e4, jam_range=(-1e4, 1e4))
    traces = [play(place, d, tailgate.make_attack(attack, **options), range(8)) for d in (SparseGatedKalman(), GatedKalman())]
    assert [traces[0].trace_hash(i) for i in range(8)] == [traces[1].trace_hash(i) for i in range(8)]
    assert traces[0].alarm.any() == (attack != "none")


@pytest.mark.parametrize("q", [1, 2, 3])
def test_the_fewest_that_explain_the_alarm_are_blamed(q, linear_model):
    """Against all subsets: what is left passes its gate, one blamed is the best one, and two sensors agree with the rule as written."""
    S = np.eye(q) + 0.4
    r = RNG.normal(size=(3000, q)) * RNG.choice([0.5, 3.0, 9.0], size=(3000, q))
    detector = SparseChiSquare(eta=9.0)
    plan, verdict = _judge(detector, _model(linear_model, q), r, S)
    sizes = set()
    for row, blamed, alarm in zip(r, verdict.suspect[:, 0], verdict.alarm[:, 0], strict=True):
        costs = {}
        for keep in itertools.chain.from_iterable(itertools.combinations(range(q), m) for m in range(q + 1)):
            k = list(keep)
            costs[keep] = float(row[k] @ np.linalg.solve(S[np.ix_(k, k)], row[k])) if k else 0.0
        passing = [keep for keep, g in costs.items() if g <= plan[len(keep)]]
        most = max(len(keep) for keep in passing)
        kept = tuple(np.flatnonzero(~blamed))
        assert kept in passing and alarm == (len(kept) < q)
        if q - most <= 1 or q == 2:
            assert len(kept) == most and costs[kept] == min(costs[k] for k in passing if len(k) == most)
        sizes.add(len(kept))
    assert sizes == set(range(q + 1))


def test_every_gate_has_the_same_tail(linear_model):
    """P(chi-square with m degrees of freedom > eta_m) is the same for every m; with two, eta_1 is that of exp(-eta/2)."""
    plan = SparseChiSquare(eta=11.0).prepare(_model(linear_model, 5))
    np.testing.assert_allclose(stats.chi2.sf(plan[1:], np.arange(1, 6)), stats.chi2.sf(11.0, 5), rtol=1e-9)
    pair = SparseChiSquare(eta=20.0).prepare(_model(linear_model, 2))
    assert stats.chi2.sf(pair[1], 1) == pytest.approx(math.exp(-10.0), rel=1e-9)
    assert (np.diff(SparseChiSquare(eta=1e12).prepare(_model(linear_model, 3))) >= 0.0).all()


def test_a_missing_reading_is_never_blamed_before_the_others():
    """With the velocity lost and the position far off, the position is blamed; the score is its own alone."""
    model, defence = load_scenario("stop-and-go-v0").brief().model, SparseGatedKalman()
    plan = defence.prepare(model)
    state = defence.start(plan, Prior(np.zeros((1, 1, 3)), np.eye(3)[None, None]))
    belief = plan.filter.predict(plan.filter_plan, state.filter, np.zeros((1, 1, 1)))
    received = Received(np.array([[[300.0, np.nan]]]), np.array([[[True, False]]]), np.zeros((1, 1)))
    innovation = plan.filter.innovation(plan.filter_plan, belief, received)
    _, verdict = plan.detector.step(plan.detector_plan, None, innovation)
    np.testing.assert_array_equal(verdict.suspect, [[[True, False]]])
    after, estimate = defence.step(plan, state, received, np.zeros((1, 1, 1)), NO_DRAWS)
    np.testing.assert_array_equal(estimate.x, belief.x)
    np.testing.assert_allclose(after.filter.P, belief.P, rtol=1e-14)


@pytest.mark.parametrize("q", [2, 4])
def test_rows_are_judged_alike_in_every_batch(q, linear_model, same_bits):
    """Score and suspects of a row do not depend on how many others alarm."""
    detector, model = SparseChiSquare(eta=6.0), _model(linear_model, q)
    root = RNG.normal(size=(500, 1, q, q + 1))
    S, r = num.matmul(root, np.swapaxes(root, -1, -2)), 4.0 * RNG.normal(size=(500, 1, q))
    plan = detector.prepare(model)
    _, whole = detector.step(plan, None, Innovation(r, S))
    for part in (slice(0, 1), slice(9, 40), slice(2, None, 7)):
        _, some = detector.step(plan, None, Innovation(r[part], num.batch_last(S[part])))
        assert same_bits(some.score, whole.score[part]) and same_bits(some.suspect, whole.suspect[part])


def test_stealth_stays_under_the_joint_gate(short, play):
    """The gate that a white-box attacker is told is where alarms begin."""
    trace = play(short(horizon=60, fdi_bound=1e4), SparseGatedKalman(eta=8.0), "stealth", range(8), terminate=False)
    on = trace.kind != 0
    assert not trace.alarm[on].any() and np.max(trace.score[on]) > 7.999


def test_one_jammed_sensor_does_not_blind_the_car(short, play):
    """Jamming the velocity for good: chi2_kf drives open loop, the gate per sensor keeps the position."""
    attack = tailgate.make_attack("dos_jam", targets=("velocity",), low=80.0, high=108.0)
    place = short("gusty-stop-and-go-v0", horizon=400)
    error = [
        np.abs(t.estimate - t.truth)[300:, :, 0, 0].mean()
        for t in (play(place, d, attack, range(12), terminate=False) for d in (SparseGatedKalman(), GatedKalman()))
    ]
    assert error[0] < 1.5 and error[1] > 3.0 * error[0]
