"""Decoders of windows: where they recover, and what bounds their errors. The Bernoulli filter and the watermark."""

import dataclasses

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.core.draws import keys
from tailgate.core.scenario import load_scenario
from tailgate.estimators.filters.bernoulli import Bernoulli
from tailgate.estimators.sparse_attacks.l0_robust import RobustDecoder, explanation, feasible
from tailgate.estimators.sparse_attacks.l1_decoder import L1Decoder
from tailgate.estimators.sparse_attacks.projected import Etpg, Etpl, orthonormal
from tailgate.estimators.sparse_attacks.window import centred
from tailgate.play.trace import rollout
from tailgate.thesis import bounds
from tests.readings import dense, play_readings, simulated
from tests.windows import projected, solve, window

RNG = np.random.default_rng(47)


@pytest.mark.long
def test_the_optimality_conditions_hold():
    """|sum_i O_i' u_i| is as small as the residuals that are 0 allow."""
    for _ in range(50):
        O, _, Y, _ = window(RNG, 2, 5, 10.0)
        Y = Y + RNG.normal(size=Y.shape)
        x = solve(O, Y)
        r = Y[0, 0] - O[0] @ x
        u = r / np.linalg.norm(r, axis=1, keepdims=True)
        assert np.linalg.norm(np.einsum("itn,it->n", O[0], u)) < 1e-6


def test_the_median():
    """A = C = 1 and the readings 1, 1.2, 1.1, 50, -80: 1.1, whichever r."""
    for norm in (1, 2):
        x = solve(np.ones((1, 5, 1, 1)), np.array([1.0, 1.2, 1.1, 50.0, -80.0]).reshape(1, 1, 5, 1), norm)
        assert x[0] == pytest.approx(1.1, abs=1e-7)


@pytest.mark.thin(4)
@pytest.mark.parametrize("s, least", [(0, 40), (1, 40), (2, 40), (3, 36)])
def test_noise_free_recovery(s, least):
    """Seven sensors of three states, 100 randn on s of them: exact, for s = 3 in most cases; the relaxation may fail. A million times the attack changes nothing."""
    exact = 0
    for _ in range(40):
        O, x, Y, K = window(RNG, s, 6, 100.0)
        right = np.max(np.abs(solve(O, Y) - x)) < 1e-6
        exact += right
        if s and right:
            larger = Y.copy()
            larger[0, 0, K] += 1e6 * (Y[0, 0, K] - (O[0] @ x)[K])
            np.testing.assert_allclose(solve(O, larger), x, atol=1e-4)  # of 1e8
    assert exact >= least


def test_rows_over_their_noise_let_accurate_sensors_outvote_the_others():
    """Two accurate sensors of seven lie alike: rows as they are read recover, rows over the noise follow the liars."""
    model = load_scenario("redundant-two-v0").brief().model
    sd = np.sqrt(np.diag(model.R[0]))
    y = np.zeros((20, 1, 7)) + np.isin(model.sensors, ("lidar", "radar_long")) * -30.0
    errors = [abs(play_readings(L1Decoder(s=2, rows=rows, window=5), model, y)[1][-1][1].x[0, 0, 0]) for rows in ("readings", "sigmas")]
    assert sd.min() == 0.1 and errors[0] < 1e-6 and errors[1] > 29.0


def test_projected_gradient_recovers_state_and_support():
    """s = 1, T = 4, noise-free, 10 randn: right in 10 of 10, where the exact search agrees."""
    for _ in range(10):
        O, x, Y, K = window(RNG, 1, 4, 10.0)
        plan, _, found, ours = projected(O, Y, 1, 1e-14)
        assert np.flatnonzero(found.E[0, 0].any(axis=1)).tolist() == K.tolist() and found.energy[0, 0] <= 1e-14
        np.testing.assert_allclose(ours, x, atol=1e-5)
        exact = explanation(O[0], Y[0, 0], np.full(Y.shape[2:], 1e-6), np.ones(Y.shape[2:], bool), 1)
        assert exact.attacked == tuple(K.tolist())
        np.testing.assert_allclose(ours, exact.x, atol=1e-5)
        np.testing.assert_allclose(np.einsum("qti,qtj->ij", plan.O[0], plan.O[0]), np.eye(3), atol=1e-12)


@pytest.mark.long
def test_the_error_falls_at_every_trigger():
    """f after each projection is not above f after the one before: two windows, looked at after every gradient step."""
    triggers = 0
    for _ in range(2):
        O, _, Y, _ = window(RNG, 1, 4, 10.0)
        energies, projections = [], []
        for rounds in range(1, 81):
            found = projected(O, Y, 1, 1e-14, rounds)[2]
            energies.append(found.energy[0, 0])
            projections.append(found.projections[0, 0])
        assert (np.diff(energies) <= 0.0).all() and (np.diff(projections) <= 1).all()
        triggers += projections[-1]
    assert triggers > 10


def test_without_attacked_sensors_etpg_is_least_squares_on_the_window(linear_model):
    model = dense(linear_model, RNG)
    _, ys = simulated(model, 12, 5, RNG)
    for kind in (Etpg, Etpl):
        plan, out = play_readings(kind(s=0, window=4), model, ys)
        O = plan.window.O[0].reshape(-1, 3)
        for k in range(4, 12):
            Y = np.stack([ys[k - 3 : k + 1, :, i] for i in range(7)], axis=1)  # (T, q, B)
            x = np.linalg.lstsq(O, Y.transpose(1, 0, 2).reshape(-1, 5), rcond=None)[0]
            np.testing.assert_allclose(out[k][1].x[:, 0], (plan.window.last @ x).T, atol=1e-8)


def test_the_energy_is_above_eps_where_the_rounds_end_the_iteration(linear_model):
    """A liar of 50: three rounds are not enough in any window, 300 are in all."""
    model = dense(linear_model, RNG, R=1e-4)
    _, ys = simulated(model, 8, 10, RNG)
    ys[..., 2] += 50.0
    for rounds, over in ((3, True), (300, False)):
        defence = Etpg(s=1, window=4, rounds=rounds, eps=0.1)
        plan, out = play_readings(defence, model, ys)
        for state, _ in out[3:]:
            assert ((defence.search(plan, None, centred(plan.window, state.window)).energy > plan.own.eps) == over).all()


def test_the_share_that_the_paper_needs_is_a_bound_on_random_directions():
    O, _, _, _ = window(RNG, 1, 4, 1.0)
    rows, _ = orthonormal(O)
    share = bounds.restricted(rows, 1)[0]
    values = []
    for _ in range(2000):
        x, E = RNG.normal(size=3), np.zeros((7, 4))
        E[RNG.choice(7, 2, replace=False)] = RNG.normal(size=(2, 4))
        values.append(np.sum((rows[0] @ x + E) ** 2) / (x @ x + np.sum(E * E)) / 2.0)
    assert share <= min(values) < share + 0.3
    assert bounds.restricted(rows, 0)[0] == pytest.approx(0.5)


@pytest.mark.thin(2)
@pytest.mark.parametrize("name", ["l1_decoder", "etpg", "etpl", "l0_robust"])
def test_a_decoder_leaves_attacked_sensors_out(name):
    """Two liars of seven with noise: the position's error stays that of an honest window, and nobody else is blamed before."""
    model = load_scenario("redundant-two-v0").brief().model
    xs, ys = simulated(model, 20, 4, RNG)
    ys[5:, :, [4, 6]] += np.array([30.0, -40.0])
    _, out = play_readings(tailgate.make_defence(name, s=2, window=5), model, ys)
    errors = np.array([np.max(np.abs(e.x[:, 0] - x)[:, 0]) for (_, e), x in zip(out, xs, strict=True)])
    assert errors[12:].max() < 3.0 and out[-1][1].alarm.all() and not out[4][1].alarm.any()


@pytest.mark.parametrize("name", ["l1_decoder", "etpg", "l0_robust"])
def test_missing_readings_drop_their_rows(linear_model, name):
    """A sensor that never arrives, whatever its value, is as one that does not exist."""
    model = dense(linear_model, RNG, R=1e-4)
    _, ys = simulated(model, 10, 4, RNG)
    valid = np.ones(ys.shape, bool)
    valid[..., 2] = False
    lost = ys + np.where(valid, 0.0, 1e9)
    defence = tailgate.make_defence(name, s=1, window=4)
    _, one = play_readings(defence, model, ys, valid=valid)
    _, two = play_readings(defence, model, lost, valid=valid)
    np.testing.assert_array_equal(one[-1][1].x, two[-1][1].x)
    assert np.max(np.abs(one[-1][1].x - play_readings(defence, model, ys)[1][-1][1].x)) > 1e-9


def test_the_fewest_sensors_that_explain():
    """y = (.05, -.05, 9), D = .1: the third, and x = 0."""
    O, D, there = np.ones((3, 1, 1)), np.full((3, 1), 0.1), np.ones((3, 1), bool)
    found = explanation(O, np.array([[0.05], [-0.05], [9.0]]), D, there, 1)
    assert found.attacked == (2,) and abs(found.x[0]) <= 0.05 and found.found


def test_feasible_is_what_a_grid_finds():
    """On one state the intervals meet, or do not."""
    for _ in range(200):
        Y, D = RNG.normal(size=4), RNG.uniform(0.2, 1.5, size=4)
        x = feasible(np.ones((4, 1)), Y, D)
        low, high = np.max(Y - D), np.min(Y + D)
        assert (x is not None) == (low <= high) and (x is None or low - 1e-9 <= x[0] <= high + 1e-9)


@pytest.mark.long
@pytest.mark.parametrize("centre", ["least_squares", "chebyshev"])
def test_honest_errors_within_their_bounds_never_alarm_and_move_the_estimate_by_less_than_the_bound(centre):
    """1000 draws: nobody is blamed, and |error| <= l0_bound."""
    O, _, _, _ = window(RNG, 0, 4, 0.0)
    D, there, farthest = np.full((7, 4), 0.1), np.ones((7, 4), bool), 0.0
    bound = bounds.l0_bound(O[0], D, 2)
    for _ in range(1000):
        x = RNG.normal(size=3)
        found = explanation(O[0], O[0] @ x + 0.1 * RNG.choice([-1.0, 1.0], size=(7, 4)), D, there, 2, centre)
        assert found.attacked == () and found.found
        farthest = max(farthest, float(np.linalg.norm(found.x - x)))
    assert 0.0 < farthest <= bound < np.inf


def test_the_bound_is_reached_by_two_explanations():
    """q equal sensors of a static scalar: readings 0 are explained by x = D and by x = -D. With fewer than 2s + 1 sensors there is no bound."""
    O, D = np.ones((5, 1, 1)), np.full((5, 1), 0.1)
    assert bounds.l0_bound(O, D, 2) == pytest.approx(0.2)
    for x in (0.1, -0.1):
        assert (np.abs(O[:, :, 0] * x) <= D + 1e-12).all()
    assert bounds.l0_bound(O[:4], D[:4], 2) == np.inf


@pytest.mark.long
def test_the_played_robust_decoder_keeps_its_bound():
    """On the road, under false data on two sensors, with errors inside of D: the position's error is below the bound."""
    place = load_scenario("redundant-two-v0")
    defence = RobustDecoder(s=2, window=5)
    plan = defence.prepare(place.brief().model)
    trace = rollout(place.loop(defence), tailgate.make_attack("fdi", trigger="near", threshold=40, value=-30), keys("train", range(4)))
    bound = bounds.l0_bound(plan.window.O[0], plan.own.D[0], 2)
    off = np.linalg.norm(trace.estimate[10:, :, 0] - trace.truth[10:, :, 0], axis=-1)
    assert np.nanmax(off[trace.live[10:]]) < np.linalg.norm(plan.window.last, 2) * bound


def test_bernoulli_without_births_is_the_kalman_filter():
    """To the last bit, under an attack."""
    place = load_scenario("stop-and-go-v0")
    known, ours = (rollout(place.loop(d), tailgate.make_attack("fdi"), keys("train", range(4))) for d in (tailgate.make_defence("kf"), Bernoulli(birth=0)))
    for name in known.signals:
        if name != "score":
            np.testing.assert_array_equal(ours.signals[name], known.signals[name], err_msg=name)


@pytest.mark.parametrize("components", [1, 4])
def test_a_step_of_the_bernoulli_filter(components, linear_model):
    """S0 = 2.618, S1 = 102.618, r- = 0.1: innovations 0, 2, 4, 8 give r = .0174, .0360, .2585, .9996, whatever the number of Gaussians."""
    golden = (1.0 + 5.0**0.5) / 2.0  # P- of A = C = Q = R = 1 at rest: the prior of variance 1 grows to it
    model = linear_model([[1.0]], [[1.0]], [[golden - 1.0]], [[1.0]])
    defence = Bernoulli(birth=0.1, survival=0.1, spread=10.0, drift=0.0, components=components)
    for r, wanted in ((0.0, 0.0174), (2.0, 0.0360), (4.0, 0.2585), (8.0, 0.9996)):
        _, out = play_readings(defence, model, np.full((1, 1, 1), r))
        assert out[0][0].r[0, 0] == pytest.approx(wanted, abs=6e-5)


def test_a_vague_attack_leaves_the_prediction(linear_model):
    """Sa to infinity: with an attack the state is the prediction, and without one the filter's."""
    model = linear_model([[0.9]], [[1.0]], [[1.0]], [[1.0]])
    _, out = play_readings(Bernoulli(spread=1e9), model, np.full((1, 1, 1), 50.0), mean=np.full((1, 1, 1), 10.0))
    assert out[0][0].under.x[0, 0, 0] == pytest.approx(9.0, abs=1e-6)


@pytest.mark.long
def test_bernoulli_on_the_road():
    """Clean: r is seldom above its prior. A lasting bias of 20 on two sensors is found, and its size within 3 standard deviations."""
    place = load_scenario("redundant-two-v0")
    loop = dataclasses.replace(place, horizon=150).loop(Bernoulli())
    clean = rollout(loop, tailgate.make_attack("none"), keys("train", range(200)))
    odds = np.exp(np.minimum(clean.score[clean.live], 50.0))
    assert np.mean(odds / (1.0 + odds)) < 2.0 * 0.01 / (0.01 + 0.1)
    model = place.brief().model
    _, ys = simulated(model, 60, 20, RNG)
    ys[30:, :, [4, 6]] += 20.0
    _, out = play_readings(Bernoulli(attacked=("radar_long", "lidar"), drift=0.1), model, ys)
    state = out[-1][0]
    sd = np.sqrt(state.under.P[:, 0].diagonal(axis1=1, axis2=2)[:, 3:])
    assert out[-1][1].alarm.all() and (np.abs(state.under.x[:, 0, 3:] - 20.0) < 3.0 * sd).all()


def test_watermark_raises_the_statistic_under_replay():
    """A = .9, B = C = Q = R = 1, L = -.5, Qu = .5: S = 2.4839, calA = .161, E g = 1.413; simulated within 3 standard errors."""
    A, L, Qu = 0.9, -0.5, 0.5
    P = max(np.roots([1.0, -A * A, -1.0]))  # P = A^2 P / (P + 1) + 1
    S, K = P + 1.0, P / (P + 1.0)
    assert pytest.approx(2.4839, abs=1e-4) == S
    assert pytest.approx(0.161, abs=5e-4) == (A + L) * (1.0 - K)
    one = np.array([[1.0]])
    wanted = bounds.replay_mean(A * one, one, one, L * one, K * one, S * one, Qu * one)
    assert wanted == pytest.approx(1.413, abs=1e-3)
    assert bounds.replay_mean(1.5 * one, one, one, 0.0 * one, 0.0 * one, S * one, Qu * one) == np.inf
    batch, steps = 4000, 120
    x, xh, u, recorded, means = np.zeros(batch), np.zeros(batch), np.zeros(batch), [], {False: [], True: []}
    for k in range(2 * steps):
        x = A * x + u + RNG.normal(size=batch)
        y = x + RNG.normal(size=batch)
        recorded.append(y)
        replayed = k >= steps
        y = recorded[k - steps] if replayed else y
        before = A * xh + u
        r = y - before
        xh = before + K * r
        u = L * xh + np.sqrt(Qu) * RNG.normal(size=batch)
        if k % steps > 20:
            means[replayed].append(r * r / S)
    for replayed, mean in ((False, 1.0), (True, wanted)):
        held = np.array(means[replayed]).mean(axis=0)
        assert abs(held.mean() - mean) < 4.0 * held.std() / np.sqrt(batch)


def test_the_exact_decoder_plays():
    """In the plain loop, to the error of the iteration or less; and it needs r = 1."""
    place = load_scenario("redundant-two-v0").with_threat(fdi_bound=30.0, onset=1)
    rival, errors = tailgate.make_attack("fdi", start_step=8, value=-30.0), []
    for solver in ("weighted", "program"):
        guard = tailgate.make_defence("l1_decoder", s=2, window=4, norm=1, solver=solver)
        trace = rollout(dataclasses.replace(place, horizon=16).loop(guard), rival, keys("train", [0]))
        assert (trace.kind[7:] != 0).all()
        errors.append(np.abs(trace.estimate[..., 0, 0] - trace.truth[..., 0, 0]))
    np.testing.assert_allclose(errors[0], errors[1], atol=0.3)
    assert not np.array_equal(*errors) and errors[1].max() < 3.0
    with pytest.raises(InputError, match="norm=1"):
        tailgate.make_defence("l1_decoder", solver="program")


def test_the_program_without_all_readings_or_without_an_answer(linear_model, monkeypatch):
    """It runs no rounds. Lost readings have no row; where the rest leaves the state open, or HiGHS stops, the steady filter's estimate stays."""
    from scipy import optimize

    from tailgate.estimators.sparse_attacks import l1_decoder

    monkeypatch.setattr(l1_decoder, "decoded", None)
    model = linear_model([[1.0, 0.1], [0.0, 1.0]], [[1.0, 0.0]] * 5, 1e-6 * np.eye(2), 1e-4 * np.eye(5))
    defence = L1Decoder(s=1, window=4, norm=1, solver="program")
    ys = (3.0 + 0.2 * np.arange(8.0))[:, None, None] * np.ones((1, 1, 5))
    ys[4:, :, 0] = 40.0
    valid = np.ones((8, 1, 5), bool)
    valid[5:, :, 1:3] = False  # one liar of three that are heard, in the newest steps
    _, out = play_readings(defence, model, np.where(valid, ys, 1e9), valid=valid)
    assert out[7][1].x[0, 0] == pytest.approx([4.4, 2.0], abs=1e-9)
    lost = valid.copy()
    lost[5:] = False  # of the last window one step is left: no speed
    _, out = play_readings(defence, model, np.where(lost, ys, 1e9), valid=lost)
    assert np.array_equal(out[7][1].x, out[7][0].window.kalman.x) and not out[7][1].alarm.any() and out[7][1].score[0, 0] == 0.0
    assert not np.array_equal(out[6][1].x, out[6][0].window.kalman.x)  # two steps tell the speed
    monkeypatch.setattr(optimize, "linprog", lambda *args, **rest: type("Answer", (), {"status": 1, "x": np.full(22, 7.0), "message": "limit"}))
    _, out = play_readings(defence, model, ys)
    assert all(np.array_equal(estimate.x, state.window.kalman.x) for state, estimate in out)
