"""The formulas of the defences against sparse attacks, each against a direct computation: a change of one of them fails here."""

import dataclasses

import numpy as np
import pytest
from scipy import linalg, stats

import tailgate
from tailgate.base.errors import InputError
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.estimators.sparse_attacks.bank import expected, statistic
from tailgate.estimators.sparse_attacks.kf_bank import KalmanBank, block_threshold, quantile, tail_of
from tailgate.estimators.sparse_attacks.l0_robust import bounds_of
from tailgate.estimators.sparse_attacks.minimax import Minimax
from tailgate.estimators.sparse_attacks.observer_bank import ObserverBank
from tailgate.estimators.sparse_attacks.subsets import without
from tailgate.estimators.sparse_attacks.window import window_plan
from tailgate.play.trace import rollout
from tests.readings import dense, play_readings, simulated

RNG = np.random.default_rng(12)
WINDOWED = ["l1_decoder", "etpg", "etpl", "l0_robust", "observer_bank:kind=gramian", "observer_bank", "kf_bank", "minimax", "bernoulli"]


def _with_inputs(linear_model, rows):
    """A model and readings of which one sensor lies, both with inputs and a constant too, the inputs, and what they do to the state."""
    plain = dense(linear_model, RNG, n=3, q=7, Q=1e-4, R=0.01)
    driven = dataclasses.replace(plain, B=RNG.normal(size=(3, 2)), c=RNG.normal(size=3))
    _, ys = simulated(plain, 12, rows, RNG)
    ys[:, :, 2] += 40.0
    u, xi, moved = RNG.normal(size=(12, 2)), np.zeros(3), []
    for row in u:
        xi = plain.A @ xi + driven.B @ row + driven.c
        moved.append(xi)
    return (plain, ys), (driven, ys + (np.array(moved) @ plain.C[0].T)[:, None]), u, moved


@pytest.mark.thin(3)
@pytest.mark.parametrize("text", WINDOWED)
def test_known_inputs_are_taken_out(linear_model, text):
    """With inputs and a constant every estimate is that without them plus what they do to the state: by superposition."""
    (plain, ys), (driven, shifted), u, moved = _with_inputs(linear_model, 4)
    defence = Spec("defence", text).make()
    _, without_input = play_readings(defence, plain, ys)
    _, with_input = play_readings(defence, driven, shifted, u=u)
    for k, ((_, one), (_, other)) in enumerate(zip(without_input, with_input, strict=True)):
        np.testing.assert_allclose(other.x, one.x + moved[k], atol=2e-6, err_msg=f"step {k}")
        np.testing.assert_allclose(other.score, one.score, rtol=1e-6, atol=1e-6)


def test_the_observer_of_etpl_goes_on_with_the_known_input(linear_model):
    """After three steps of the iteration in each period its own state is that without input plus what the inputs did."""
    (plain, ys), (driven, shifted), u, moved = _with_inputs(linear_model, 1)
    defence = tailgate.make_defence("etpl", rounds=3)
    plan, one = play_readings(defence, plain, ys)
    _, other = play_readings(defence, driven, shifted, u=u)
    for k in range(3, 12):
        off = plan.own.back[0] @ (other[k][0].own.x - one[k][0].own.x)[0, 0]
        np.testing.assert_allclose(off, moved[k - 2], rtol=0.05, atol=0.05)


def test_bounds_of_honest_errors_grow_with_the_process_noise(linear_model):
    """D_i(t) = sigmas sqrt(R_ii + sum_{j<t} c_i A^j Q A^j' c_i'), over the noise."""
    model = dense(linear_model, RNG, n=2, q=3, Q=0.3, R=2.0)
    A, C, Q, R = model.A, model.C[0], model.Q, model.R[0]
    power, spread = np.eye(2), np.zeros((2, 2))
    found = bounds_of(window_plan(model, 5), model, 4.0)[0]
    for t in range(5):
        np.testing.assert_allclose(found[:, t], 4.0 * np.sqrt((np.diag(R) + np.diag(C @ spread @ C.T)) / np.diag(R)))
        spread, power = spread + power @ Q @ power.T, A @ power


def test_the_score_of_l0_robust_is_above_its_bounds_where_it_alarms(linear_model):
    """The least squares may be outside of the bounds where another state is inside: no alarm, and no score above them."""
    model = dense(linear_model, np.random.default_rng(1), n=1, q=3, Q=0.2)
    _, ys = simulated(model, 8, 60, RNG)
    ys[6:, ::2, 1] += 40.0
    _, out = play_readings(tailgate.make_defence("l0_robust", sigmas=2.0, window=3), model, ys)
    scores, alarms = (np.array([getattr(estimate, name)[:, 0] for _, estimate in out[2:]]) for name in ("score", "alarm"))
    assert ((scores > 2.0) == alarms).all() and 0.1 < alarms.mean() < 0.9 and (scores == 2.0).any()


def test_a_sliding_bank_judges_the_last_steps(linear_model):
    """The score is the least sum of z' S^-1 z over the last `block` steps of the steady filters, each computed here by itself."""
    model = dense(linear_model, RNG, n=2, q=4, Q=0.1)
    _, ys = simulated(model, 15, 1, RNG)
    _, out = play_readings(KalmanBank(s=1, block=5, sliding=True), model, ys)
    sums = []
    for keep in without(4, 1):
        C, R = model.C[0][keep], model.R[0][np.ix_(keep, keep)]
        P = np.eye(2)
        for _ in range(5000):
            P = model.A @ (P - P @ C.T @ np.linalg.solve(C @ P @ C.T + R, C @ P)) @ model.A.T + model.Q
        S, x, each = C @ P @ C.T + R, np.zeros(2), []
        for y in ys[:, 0]:
            x = model.A @ x
            z = y[keep] - C @ x
            each.append(z @ np.linalg.solve(S, z))
            x = x + P @ C.T @ np.linalg.solve(S, z)
        sums.append(each)
    for k in range(4, 15):
        assert out[k][1].score[0, 0] == pytest.approx(min(sum(each[k - 4 : k + 1]) for each in sums), rel=1e-6)


def test_minimax_of_a_vector_is_halfway_between_its_ends(linear_model):
    """max_J min_{I in J} d_I and min_J max_{I in J} d_I, with every I and J written out."""
    model, between = dense(linear_model, RNG, n=2, q=5, Q=1.0), 0
    for y in RNG.normal(size=(60, 5)) * 5.0:
        plan, out = play_readings(Minimax(attacked=1), model, y[None, None])
        small, gain = without(5, 2), plan.filter_plan.bank.gain[0]
        d = np.array([gain[:, :, i] @ y for i in range(len(small))])
        ends = []
        for outer, inner in ((np.max, np.min), (np.min, np.max)):
            by_liar = [inner([d[i] for i, some in enumerate(small) if not some[liar]], axis=0) for liar in range(5)]
            ends.append(outer(by_liar, axis=0))
        between += bool((np.abs(ends[0] - ends[1]) > 1e-6).any())
        np.testing.assert_allclose(out[0][1].x[0, 0], 0.5 * (ends[0] + ends[1]), atol=1e-12)
    assert between > 5


def test_the_gains_of_minimax_suit_a_vague_prior_only(linear_model):
    """One of three readings lies in the worst way, for one step. Beside a sharp prior it does worse than the prior, half its gain better."""
    worst = {}
    for Q in (1.0, 0.01):
        model = linear_model([[1.0]], np.ones((3, 1)), [[Q]], np.eye(3))
        plan = Minimax(attacked=1).prepare(model).filter_plan
        prior, gain = float(plan.kalman.held[0, 0, 0]), float(plan.bank.gain[0, 0, 0, 0])
        x = RNG.normal(size=40_000) * np.sqrt(prior)
        y = x[:, None] + RNG.normal(size=(len(x), 3))
        errors = np.zeros(len(x))
        for lie in (-1e6, 1e6):
            _, out = play_readings(Minimax(attacked=1), model, np.column_stack([np.full(len(x), lie), y[:, 1:]])[None])
            errors = np.maximum(errors, (out[0][1].x[:, 0, 0] - x) ** 2)
        half = np.max([(0.5 * gain * side - x) ** 2 for side in (y[:, 1:].min(axis=1), y[:, 1:].max(axis=1))], axis=0)
        worst[Q] = errors.mean() / prior, half.mean() / prior
    assert worst[1.0][0] < 0.9 and worst[0.01][0] > 1.1 and worst[0.01][1] > 1.0
    assert worst[0.01][1] < worst[0.01][0]


def test_what_bounds_an_observer_bank(linear_model):
    """|error| <= |error of x_J| + 2 max |error of x_S| over honest sets; three times the largest of x_S alone is no bound."""
    model, beyond = linear_model([[1.0]], np.ones((3, 1)), [[0.1]], np.eye(3)), 0
    xs, ys = simulated(model, 40, 2000, RNG)
    ys[5:, :, 2] += 1000.0
    _, out = play_readings(ObserverBank(s=1), model, ys)
    J = int(np.flatnonzero(~without(3, 1)[:, 2])[0])
    S = np.flatnonzero(~without(3, 2)[:, 2])
    for k in range(10, 40):
        state, estimate = out[k]
        off, large = np.abs(estimate.x[:, 0] - xs[k])[:, 0], np.abs(state.most[:, 0, 0, J] - xs[k][:, 0])
        small = np.abs(state.fewer[:, 0, 0][:, S] - xs[k]).max(axis=1)
        assert (off <= large + 2.0 * small + 1e-9).all()
        beyond += int((off > 3.0 * small).sum())
    assert 0.001 < beyond / (30 * 2000) < 0.01


def test_the_window_bank_has_the_covariance_of_least_squares(linear_model):
    """After an exact window without process noise: cov(x_J - x) is that of 4000 runs; a subset's estimate is numpy's least squares."""
    model = dense(linear_model, RNG, n=2, q=4, Q=0.0, R=0.5)
    model = dataclasses.replace(model, Q=np.zeros((2, 2)))
    xs, ys = simulated(dataclasses.replace(model, Q=np.zeros((2, 2))), 6, 4000, RNG)
    plan, out = play_readings(ObserverBank(s=1, kind="gramian", window=4), dataclasses.replace(model, Q=1e-12 * np.eye(2)), ys)
    x = out[-1][1].x[:, 0]
    keeps, rows = without(4, 1), np.stack([model.C[0] @ np.linalg.matrix_power(model.A, t) for t in range(4)])
    fits = []
    for keep in keeps:
        O, Y = rows[:, keep].reshape(-1, 2), ys[2:, :, keep].transpose(1, 0, 2).reshape(4000, -1)
        fits.append(np.linalg.lstsq(O, Y.T, rcond=None)[0].T @ np.linalg.matrix_power(model.A, 3).T)
    assert (np.min([np.abs(x - fit).max(axis=1) for fit in fits], axis=0) < 1e-8).all()
    for k, fit in enumerate(fits):
        np.testing.assert_allclose(np.cov((fit - xs[-1]).T), plan.most.after[0, k], rtol=0.12, atol=0.02)


@pytest.mark.parametrize("text", [text for text in WINDOWED if text not in ("minimax", "bernoulli")])
def test_silent_sensors_are_no_zeros(linear_model, text):
    """Two of five sensors fall silent, then all of them; the state is 1000, and stays so."""
    model = linear_model([[1.0]], np.ones((5, 1)), [[1e-6]], 1e-4 * np.eye(5))
    ys, valid = np.full((20, 1, 5), 1000.0), np.ones((20, 1, 5), bool)
    valid[8:, :, 2:4] = valid[12:] = False
    ys[~valid] = 0.0
    _, out = play_readings(Spec("defence", f"{text}{',' if ':' in text else ':'}s=1").make(), model, ys, np.full((1, 1, 1), 1000.0), valid)
    assert all(estimate.x[0, 0, 0] == pytest.approx(1000.0, abs=0.1) for _, estimate in out[7:])


@pytest.mark.parametrize("rate", [0.3, 0.7])
def test_lost_readings_leave_the_filter_of_the_others(linear_model, rate):
    """Each reading is lost with a probability: the banks without attacked sensors, and minimax, are the steady filter; D is the marginal's."""
    model = dense(linear_model, RNG, n=2, q=4, Q=0.5, R=0.01)
    _, ys = simulated(model, 40, 16, RNG)
    valid = RNG.random(ys.shape) > rate
    _, known = play_readings(tailgate.make_defence("kf", gain="steady"), model, ys, valid=valid)
    for text in ("kf_bank:s=0,block=1", "observer_bank:s=0", "minimax:attacked=0"):
        _, out = play_readings(Spec("defence", text).make(), model, ys, valid=valid)
        for (_, ours), (_, theirs) in zip(out, known, strict=True):
            np.testing.assert_allclose(ours.x, theirs.x, rtol=1e-9, atol=1e-9, err_msg=text)
    bank = KalmanBank(s=1, block=1).prepare(model).bank
    z, some = RNG.normal(size=(16, 1, 4, 4)), valid[:16].reshape(16, -1, 4)[:, :1]
    g = statistic(bank, expected(bank, np.where(some[..., None], z, 0.0), some))
    for k, keep in enumerate(bank.keep):
        S = model.C[0] @ bank.before[0, k] @ model.C[0].T + model.R[0]
        for b in range(16):
            O = keep & some[b, 0]
            assert g[b, 0, k] == pytest.approx(z[b, 0, O, k] @ np.linalg.inv(S[np.ix_(O, O)]) @ z[b, 0, O, k], rel=1e-8, abs=1e-12)


def test_a_block_with_lost_readings_alarms_as_seldom(linear_model):
    """The quantile is scipy's to a hundredth, and a settled bank that loses half of its readings alarms in about alpha of the blocks."""
    for degrees in (3, 10, 50):
        h = block_threshold(1e-3, 1, 1, degrees)
        count = np.arange(1.0, degrees + 1)
        np.testing.assert_allclose(quantile(count, tail_of(h, degrees)), stats.chi2.isf(1e-3, count), rtol=0.03)
    model = linear_model([[1.0]], np.ones((4, 1)), [[1e-6]], np.eye(4))
    _, ys = simulated(model, 400, 400, RNG)
    valid = RNG.random(ys.shape) > 0.5
    _, out = play_readings(KalmanBank(s=0, alpha=0.02), model, ys, valid=valid)
    assert 0.012 < np.mean([out[k][1].alarm for k in range(99, 400, 10)]) < 0.03


@pytest.mark.long
def test_etpg_alarms_as_seldom_as_it_says_without_process_noise(linear_model):
    """The threshold is that of chi-square with q T - n degrees of freedom; process noise adds to the sum, and is in no threshold."""
    defence = tailgate.make_defence("etpg", window=5, alpha=0.1)
    rates = []
    for Q in (1e-12, 0.3):
        model = dense(linear_model, np.random.default_rng(3), n=2, q=4, Q=Q)
        _, ys = simulated(model, 5, 4000, RNG)
        plan, out = play_readings(defence, model, ys)
        assert plan.own.threshold == pytest.approx(stats.chi2.isf(0.1, 4 * 5 - 2))
        rates.append(float(out[-1][1].alarm.mean()))
    assert 0.08 < rates[0] < 0.12 < 0.3 < rates[1]


def test_a_watermark_marks_actuators_only():
    """In a lane the curvature is a known input and no actuator. The replay that looks like the road shows with the watermark."""
    place = load_scenario("lane-keeping-v0").with_threat(kinds=("replay",), budget=None, targets=("lane_offset", "lane_heading", "yaw_rate"))
    held, shares = keys("report", range(40)), []
    for sd in (0.0, 0.01):
        loop = place.loop(Spec("defence", f"watermark:sd={sd}").make())
        played = rollout(loop, Spec("attack", "replay:start_step=200,length=50,window=50").make(), held)
        shares.append(played.alarm[205:249].any(axis=0).mean())
    assert shares[0] < 0.5 and shares[1] > 0.9


@pytest.mark.long
def test_a_watermark_is_a_part_of_the_command_and_known_to_the_filter():
    """The watermark's variance adds to that of the command; the clean score stays as it is; sd = 0 gives the plain filter."""
    place = load_scenario("stop-and-go-v0").with_threat(kinds=("replay",), knowledge="black")
    plain = tailgate.make_defence("composed", detector="windowed_chi2", mitigation="accept_all")
    known, quiet, loud = (
        rollout(place.loop(d), tailgate.make_attack("none"), keys("train", range(50)))
        for d in (plain, tailgate.make_defence("watermark", sd=0.0), tailgate.make_defence("watermark", sd=0.3))
    )
    np.testing.assert_array_equal(quiet.control, known.control)
    added = loud.control - known.control
    assert np.std(added[1:3]) == pytest.approx(0.3, rel=0.3)
    assert loud.score[loud.live].mean() == pytest.approx(known.score[known.live].mean(), rel=0.02)


@pytest.mark.long
def test_the_price_of_a_watermark_is_that_of_a_simulation():
    """The mean of x'Wx + u'Vu under the optimal feedback on a Kalman filter's estimate, with a watermark less without, in 8000 loops."""
    A, B = np.array([[1.0, 0.1], [0.0, 0.95]]), np.array([[0.0], [0.4]])
    C, Q, R, W, V, Qu = np.array([[1.0, 0.0]]), 0.05 * np.eye(2), np.array([[0.5]]), np.diag([1.0, 0.2]), np.array([[0.3]]), np.array([[0.7]])
    S, P = linalg.solve_discrete_are(A, B, W, V), linalg.solve_discrete_are(A.T, C.T, Q, R)
    L, K = -np.linalg.solve(V + B.T @ S @ B, B.T @ S @ A), P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    cost, rng = [], np.random.default_rng(5)
    for sd in (0.0, np.sqrt(Qu[0, 0])):
        x, belief, total = np.zeros((8000, 2)), np.zeros((8000, 2)), 0.0
        for k in range(400):
            y = x @ C.T + rng.normal(size=(8000, 1)) * np.sqrt(R[0, 0])
            belief = belief + (y - belief @ C.T) @ K.T
            u = belief @ L.T + sd * rng.normal(size=(8000, 1))
            total += (k >= 100) * float(np.mean(np.einsum("bi,ij,bj->b", x, W, x) + V[0, 0] * u[:, 0] ** 2))
            x = x @ A.T + u @ B.T + rng.normal(size=x.shape) * np.sqrt(0.05)
            belief = belief @ A.T + u @ B.T
        cost.append(total / 300)
    assert cost[1] - cost[0] == pytest.approx(float(np.trace((V + B.T @ S @ B) @ Qu)), rel=0.03)


def test_a_mixture_of_nothing_is_refused():
    with pytest.raises(InputError, match=r"defence bernoulli.prune: got 1.0; expected below 1 / \(2 components\), 0.125"):
        Spec("defence", "bernoulli:components=4,prune=1").make()
