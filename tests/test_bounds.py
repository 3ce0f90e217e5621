"""What the gate bounds: every bound is reached, and none is passed."""

import numpy as np
import pytest
from scipy import stats

from tailgate.core.scenario import load_scenario
from tailgate.estimators import AcceptAll, ChiSquare, GatedKalman, KalmanFilter, compose
from tailgate.thesis import bounds, probe

ETA = 20.0
MODELS = {
    "walk": lambda linear_model: linear_model(1.0, 1.0, 1.0, 1.0),
    "car": lambda _: load_scenario("thesis-ch4-v0").brief().model,
    "long": lambda _: load_scenario("stop-and-go-v0").brief().model,
    "random": lambda linear_model: _random(linear_model),
}


def _random(linear_model):
    rng = np.random.default_rng(7)
    A = rng.normal(size=(4, 4))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    L, M = rng.normal(size=(4, 4)), rng.normal(size=(2, 2))
    return linear_model(A, rng.normal(size=(2, 4)), L @ L.T + np.eye(4), M @ M.T + np.eye(2))


@pytest.fixture(params=MODELS)
def model(request, linear_model):
    return MODELS[request.param](linear_model)


def feed(model, innovations, P=None, eta=ETA):
    """One run of the gated filter from covariance P, at rest if not given: estimates (K, n) and alarms (K,)."""
    P = bounds.steady_state(model).after if P is None else P
    fed = probe.feed(GatedKalman(eta=eta), model, P, innovations=np.asarray(innovations)[:, None])
    return fed.x[:, 0], fed.alarm[:, 0]


def test_steady_state_of_the_random_walk_is_the_golden_ratio(linear_model):
    """Q = R = 1: P- = 1.618, K = 0.618."""
    rest = bounds.steady_state(linear_model(1.0, 1.0, 1.0, 1.0))
    golden = (1 + np.sqrt(5)) / 2
    assert rest.before[0, 0] == pytest.approx(golden, rel=1e-12) and rest.K[0, 0] == pytest.approx(golden - 1, rel=1e-12)


def test_k_s_k_is_what_a_sample_takes_from_the_covariance(model):
    """K S K' = P- - P+."""
    rest = bounds.steady_state(model)
    np.testing.assert_allclose(rest.K @ rest.S @ rest.K.T, rest.before - rest.after, rtol=1e-9, atol=1e-12)


def test_the_largest_accepted_jump_is_reached_and_not_passed(model):
    """c = sqrt(eta lambda_max(P- - P+)) to 1e-6: the worst innovation on the gate makes it, 20 000 others do not pass it."""
    rest = bounds.steady_state(model)
    c = bounds.accepted_jump(rest.before, rest.after, ETA)
    direction = np.linalg.eigh(rest.before - rest.after)[1][:, -1]
    worst = bounds.stealth_innovations(model.A, [rest], ETA * (1 - 1e-9), direction)
    x, alarm = feed(model, worst)
    assert not alarm.any() and np.linalg.norm(x[0]) == pytest.approx(c, rel=1e-6)
    r = np.random.default_rng(1).multivariate_normal(np.zeros(len(rest.S)), rest.S, 20_000)
    r *= np.sqrt(ETA / np.einsum("ki,ij,kj->k", r, np.linalg.inv(rest.S), r))[:, None]  # on the gate
    assert np.linalg.norm(r @ rest.K.T, axis=1).max() <= c * (1 + 1e-9)


def test_the_jump_grows_while_the_gate_is_shut(model):
    """Rejected samples leave P- to grow, and c with it: Theorem 4.5.3's constant is not one number (stable models level off)."""
    x, alarm = feed(model, np.full((5, len(model.R[0])), 1e6))
    assert alarm.all() and not x.any()
    P, seen = bounds.steady_state(model).after, []
    for _ in range(6):
        step = bounds.updated(model.A @ P @ model.A.T + model.Q, model.C[0], model.R[0])
        seen.append(bounds.accepted_jump(step.before, step.after, ETA))
        P = step.before
    assert (np.diff(seen) > 0).all()


@pytest.mark.long
@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("steps", [1, 5, 40])
def test_the_stealth_bound_is_reached_and_not_passed(model, steps, index):
    """N unnoticed steps along one state reach sqrt(eta) sum ||S^1/2 K' A'^j e|| to 1e-6; random and greedy ones stay below."""
    index = min(index, model.states - 1)
    rest = bounds.steady_state(model)
    e = np.eye(model.states)[index]
    reach = bounds.stealth_bound(model.A, [rest] * steps, ETA, e)
    x, alarm = feed(model, bounds.stealth_innovations(model.A, [rest] * steps, ETA * (1 - 1e-9), e))
    assert not alarm.any() and x[-1] @ e == pytest.approx(reach, rel=1e-6)
    greedy = np.repeat(bounds.stealth_innovations(model.A, [rest], ETA * (1 - 1e-9), e), steps, axis=0)
    assert feed(model, greedy)[0][-1] @ e <= reach * (1 + 1e-9)
    rng = np.random.default_rng(index)
    for _ in range(20):
        r = rng.multivariate_normal(np.zeros(len(rest.S)), rest.S, steps)
        r *= np.sqrt(ETA * (1 - 1e-9) / np.einsum("ki,ij,kj->k", r, np.linalg.inv(rest.S), r))[:, None]
        assert abs(feed(model, r)[0][-1] @ e) <= reach * (1 + 1e-9)


def test_the_stealth_bound_with_gains_that_still_change(model):
    """From a wide prior S and K differ from step to step; with those of each step the bound is reached as well."""
    P, filters = 50.0 * np.eye(model.states), []
    start = P.copy()
    for _ in range(12):
        filters.append(bounds.updated(model.A @ P @ model.A.T + model.Q, model.C[0], model.R[0]))
        P = filters[-1].after
    e = np.eye(model.states)[0]
    reach = bounds.stealth_bound(model.A, filters, ETA, e)
    x, alarm = feed(model, bounds.stealth_innovations(model.A, filters, ETA * (1 - 1e-9), e), P=start)
    assert not alarm.any() and x[-1] @ e == pytest.approx(reach, rel=1e-6)


def test_the_closed_loop_map_in_the_place_of_the_predictor_is_wrong(model):
    """With (I - K C) A instead of A the sum is another number, and stealth passes it: a wrong bound."""
    rest, e = bounds.steady_state(model), np.eye(model.states)[0]
    wrong = bounds.stealth_bound((np.eye(model.states) - rest.K @ model.C[0]) @ model.A, [rest] * 40, ETA, e)
    x, alarm = feed(model, bounds.stealth_innovations(model.A, [rest] * 40, ETA * (1 - 1e-9), e))
    assert not alarm.any() and x[-1] @ e > 1.05 * wrong


def test_lemma_4_5_4(model):
    """|r| just over c1 = sqrt(eta lambda_max(S)) always alarms, |r| up to c2 = sqrt(eta lambda_min(S)) never; both are tight."""
    S = bounds.steady_state(model).S
    c1, c2 = bounds.innovation_norms(S, ETA)
    r = np.random.default_rng(3).normal(size=(300, len(S)))
    r /= np.linalg.norm(r, axis=1)[:, None]
    axes = np.linalg.eigh(S)[1].T
    units, rest = np.array([*r, axes[0], axes[-1]]), bounds.steady_state(model).after
    for size, alarmed in ((c1 * (1 + 1e-9), True), (c2 * (1 - 1e-9), False)):
        alarm = probe.feed(GatedKalman(eta=ETA), model, rest, innovations=size * units[None]).alarm
        assert alarm.shape == (1, 302) and (alarm == alarmed).all(), np.flatnonzero(alarm != alarmed)
    assert not feed(model, [c1 * (1 - 1e-9) * axes[-1]])[1].any()
    assert feed(model, [c2 * (1 + 1e-9) * axes[0]])[1].all()


def _lock_out(rest, Q, steps):
    """(n^2 (P- - P+) - S) / Q, while that is positive: about how many honest samples a gate rejects after n stealth steps.

    The displacement is n c, against a gate that opens by Q a step. The one sensor reads the one state.
    """
    gained = (rest.before - rest.after)[0, 0]
    return float((steps * steps * gained - rest.S[0, 0]) / Q[0, 0])


def _reopening(rest, Q, bias):
    """About how many samples with a lasting bias on the sensor of a random walk a gate rejects before eta S has grown to bias^2."""
    return float((bias * bias / ETA - rest.S[0, 0]) / Q[0, 0])


@pytest.mark.parametrize("steps", [3, 5, 8, 12])
def test_lock_out_law(linear_model, steps):
    """After n stealth steps the filter of a random walk (Q = R = 1) rejects n^2 - 2.6 honest samples, to one."""
    model = linear_model(1.0, 1.0, 1.0, 1.0)
    rest = bounds.steady_state(model)
    assert _lock_out(rest, model.Q, steps) == pytest.approx(steps**2 - (3 + np.sqrt(5)) / 2)
    pushed = feed(model, bounds.stealth_innovations(model.A, [rest] * steps, ETA * (1 - 1e-9), np.ones(1)))[0][-1]
    honest = probe.feed(GatedKalman(eta=ETA), model, rest.after, readings=np.zeros((400, 1, 1)), x=pushed[None])  # the truth is 0
    rejected = int(np.argmin(honest.alarm[:, 0]))
    assert rejected == int(np.ceil(_lock_out(rest, model.Q, steps)))


@pytest.mark.parametrize("bias", [30.0, 60.0])
def test_the_gate_opens_again_under_a_lasting_bias(linear_model, bias):
    """Alarms stop after (b^2/eta - S)/Q samples, and then the error is the bias: a silent detector is no healthy one."""
    model = linear_model(1.0, 1.0, 1.0, 1.0)
    rest = bounds.steady_state(model)
    fed = probe.feed(GatedKalman(eta=ETA), model, rest.after, readings=np.full((300, 1, 1), bias))
    alarms, errors = fed.alarm[:, 0], fed.x[:, 0, 0]
    shut = int(np.ceil(_reopening(rest, model.Q, bias)))
    assert alarms[:shut].all() and not alarms[shut + 1 :].any() and abs(alarms.sum() - shut) <= 1
    assert errors[shut - 1] == 0.0 and errors[-1] == pytest.approx(bias, abs=1e-6)


def test_the_gate_of_the_car_opens_again_too(short, play):
    """The same on stop-and-go-v0: a bias of -20 m that lasts is rejected, then believed without an alarm."""
    place = short(horizon=600, onset=20, targets=("position",))
    trace = play(place, "chi2_kf", "fdi", range(20), terminate=False)
    alarm, error = trace.alarm[:, :, 0], trace.estimate[:, :, 0, 0] - trace.truth[:, :, 0, 0]
    assert alarm[19:29].all() and alarm[-50:].mean() < 0.05
    assert np.median(error[-50:]) < -15.0


@pytest.mark.parametrize("eta", [4.0, 9.0])
def test_false_alarm_rate(eta, short, play):
    """A filter that only watches alarms in a share exp(-eta/2) of the clean steps: inside of a 99.9 % interval over 300 000 steps."""
    place = short("thesis-ch4-v0", horizon=150)
    watch = compose(KalmanFilter(), ChiSquare(eta=eta), AcceptAll())
    alarms = play(place, watch, "none", range(2000), terminate=False).alarm[:, :, 0]
    interval = stats.binomtest(int(alarms.sum()), alarms.size).proportion_ci(0.999)
    assert interval.low <= bounds.false_alarm_rate(eta) <= interval.high


def test_a_gate_that_rejects_alarms_more_often_than_that(short, play):
    """Algorithm 3 throws away the samples that would have told it of its error: one false alarm begets the next."""
    place = short("thesis-ch4-v0", horizon=150)
    alarms = play(place, GatedKalman(eta=4.0), "none", range(2000), terminate=False).alarm[:, :, 0]
    assert alarms.mean() > 1.3 * bounds.false_alarm_rate(4.0)


def test_noise_free_runs_never_alarm_and_their_error_falls(model):
    """Theorem 4.5.1: e0' P0^-1 e0 < eta without noise: no alarm, and e' P^-1 e never grows."""
    P0 = 3.0 * np.eye(model.states)
    e = np.random.default_rng(11).normal(size=(200, model.states))
    e *= np.sqrt(ETA * (1 - 1e-9) / np.einsum("ki,ij,kj->k", e, np.linalg.inv(P0), e))[:, None]  # on the edge of what is allowed
    fed = probe.feed(GatedKalman(eta=ETA), model, P0, readings=np.zeros((150, 200, len(model.R[0]))), x=e)
    assert not fed.alarm.any()
    sizes = np.einsum("kbi,kbij,kbj->kb", fed.x, np.linalg.inv(fed.P), fed.x)
    assert (sizes[0] <= ETA).all() and (sizes[1:] <= sizes[:-1] * (1 + 1e-9)).all()
    assert sizes[-1].max() < 0.2 * ETA
