"""Filters that predict a radar's readings: the joint kinematic regression against batch least squares, and those to compare it with."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from tailgate import num
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Mode, Prior, Received
from tailgate.core.draws import keys
from tailgate.core.registry import Spec, make
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout

SD = np.array([0.25, 0.1])
LEAD = (100.0, 29.0576, -0.1082)  # position [m], speed [m/s], acceleration [m/s^2] at t = 0


@pytest.fixture(scope="module")
def model():
    return load_scenario("thesis-ch3-v0").brief().model


def drive(steps, batch, seed=0, lead=LEAD, sd=SD, stops=True):
    """Readings y (K, B, 2) with noise, own speed (K + 1, B) and position, leader's true position and speed (K + 1,), at t = 0, 1, ..., K."""
    rng = np.random.default_rng(seed)
    v = np.clip(28.0 + np.cumsum(rng.normal(0.0, 0.5, (steps + 1, batch)), axis=0), 0.0, 40.0)
    x = np.concatenate([np.zeros((1, batch)), np.cumsum(0.5 * (v[1:] + v[:-1]), axis=0)])
    t = np.arange(steps + 1.0)
    if stops and lead[2] < 0.0:
        t = np.minimum(t, -lead[1] / lead[2])
    xl, vl = lead[0] + lead[1] * t + 0.5 * lead[2] * t * t, lead[1] + lead[2] * t
    y = np.stack([xl[1:, None] - x[1:], vl[1:, None] - v[1:]], axis=-1) + sd * rng.normal(size=(steps, batch, 2))
    return y, v, x, xl, vl


def prior_of(v, lead=LEAD):
    mean = np.zeros((v.shape[1], 1, 4))
    mean[:, 0, 0], mean[:, 0, 1], mean[:, 0, 2], mean[:, 0, 3] = lead[0], lead[1] - v[0], lead[2], v[0]
    return Prior(mean, np.broadcast_to(np.eye(4), (v.shape[1], 1, 4, 4)))


def run(filter_, model, prior, y, v, valid):
    """Every updated state, innovation and prediction of a filter fed with y (K, B, 2), of which `valid` (K, B, 2) arrive."""
    plan = filter_.prepare(model)
    state, out = filter_.start(plan, prior), []
    for k in range(len(y)):
        state = filter_.predict(plan, state, v[k + 1][:, None, None])
        predicted = filter_.estimate(state)
        received = Received(y[k][:, None], valid[k][:, None], np.ones((y.shape[1], 1)))
        innovation = filter_.innovation(plan, state, received)
        state = filter_.update(plan, state, innovation, received.valid)
        out.append((state, innovation, predicted))
    return out


@pytest.mark.parametrize("share", [1.0, 0.3])
@pytest.mark.parametrize("forgetting", [1.0, 0.95])
def test_the_joint_regression_is_weighted_batch_least_squares_with_its_ridge(model, share, forgetting):
    """theta and its covariance equal lstsq on the stacked rows of theta(0), whatever readings are missing; the latest weighs most."""
    y, v, x, *_ = drive(80, 5)
    valid = np.random.default_rng(1).uniform(size=y.shape) < share
    prior, delta = prior_of(v), 1e4
    states = run(make("filter", "joint_rls", delta=delta, forgetting=forgetting, threshold=None), model, prior, y, v, valid)
    for b in range(5):
        centre = np.array([prior.mean[b, 0, 0], LEAD[1], LEAD[2]])
        for k in (2, 6, 20, 80):
            used = valid[:k, b].any(axis=1)
            after = np.cumsum(used[::-1])[::-1] - used  # samples used later
            rows, sides = [np.eye(3) / np.sqrt(delta) * forgetting ** (used.sum() / 2)], [centre / np.sqrt(delta) * forgetting ** (used.sum() / 2)]
            for j in range(k):
                t, w = j + 1.0, forgetting ** ((after[j] + 1) / 2)
                for i, (h, z) in enumerate((([1.0, t, t * t / 2], y[j, b, 0] + x[j + 1, b]), ([0.0, 1.0, t], y[j, b, 1] + v[j + 1, b]))):
                    if valid[j, b, i]:
                        rows.append(w / SD[i] * np.array([h]))
                        sides.append(np.array([w / SD[i] * z]))
            big, side = np.concatenate(rows), np.concatenate(sides)
            theta = np.linalg.lstsq(big, side, rcond=None)[0]
            move = np.array([[1.0, k, k * k / 2], [0.0, 1.0, k], [0.0, 0.0, 1.0]])
            now, P = move @ theta, move @ np.linalg.inv(big.T @ big) @ move.T
            fit = states[k - 1][0].fit
            np.testing.assert_allclose(fit.x[b, 0, :3] + [x[k, b], v[k, b], 0.0], now, rtol=1e-7, atol=1e-6)
            np.testing.assert_allclose(fit.P[b, 0, :3, :3], P, rtol=1e-5, atol=1e-7)
            assert (fit.P[b, 0, 3] == 0.0).all() and fit.x[b, 0, 3] == v[k, b]


def test_a_long_gap_in_the_readings_leaves_the_covariance_positive(model):
    """The first reading after 60 steps without any meets a variance of 1e11 m^2: nothing is lost to rounding."""
    y, v, *_ = drive(90, 3)
    valid = np.zeros(y.shape, bool)
    valid[60::7] = True
    for state, innovation, _ in run(make("filter", "joint_rls"), model, prior_of(v), y, v, valid):
        assert (np.linalg.eigvalsh(state.fit.P[:, 0, :3, :3]) > 0.0).all() and (innovation.S.diagonal(axis1=-2, axis2=-1) > 0.0).all()


def test_the_predicted_deviation_is_that_of_many_episodes(model):
    """600 episodes, 100 readings each, then none: error over predicted deviation, of d and dv, is a standard normal at every horizon."""
    y, v, x, xl, vl = drive(160, 600, seed=3)
    valid = np.zeros(y.shape, bool)
    valid[:100] = True
    out = run(make("filter", "joint_rls", threshold=None), model, prior_of(v), y, v, valid)
    spread, (low, high) = [], stats.chi2.ppf([0.0005, 0.9995], 600)
    for k in (100, 105, 120, 160):
        _, innovation, predicted = out[k - 1]
        truth = np.stack([xl[k] - x[k], vl[k] - v[k]], axis=-1)
        variance = innovation.S[:, 0].diagonal(axis1=-2, axis2=-1) - SD**2
        z = (predicted[:, 0, :2] - truth) / np.sqrt(variance)
        assert (low < (z * z).sum(axis=0)).all() and ((z * z).sum(axis=0) < high).all(), k
        assert (np.abs(z.mean(axis=0)) < 3.29 / np.sqrt(600)).all()
        spread.append(variance[0, 0])
    assert spread[-1] > 10.0 * spread[0]  # the last comparison is of a prediction that has lost precision


def test_the_predicted_leader_stops_and_does_not_roll_back(model):
    """Frozen after 120 readings, the prediction stands from 268.55 s on where the true leader stands."""
    y, v, x, xl, vl = drive(320, 4, sd=1e-6 * SD)
    valid = np.zeros(y.shape, bool)
    valid[:120] = True
    out = run(make("filter", "joint_rls"), model, prior_of(v), y, v, valid)
    assert vl[268] > 0.0 and abs(vl[269]) < 1e-12
    for k in (260, 268, 269, 300, 320):
        d, dv, a, own = np.moveaxis(out[k - 1][2][:, 0], -1, 0)
        np.testing.assert_allclose(d, xl[k] - x[k], atol=0.1)
        np.testing.assert_allclose(dv + own, vl[k], atol=1e-3)
        assert (a == 0.0).all() == (k >= 269)


def test_the_speed_of_a_standing_leader_says_nothing_about_the_stop(model):
    """After the stop, S of dv is the sensor's alone, its gain is zero, and the standstill's position goes on being learned."""
    y, v, x, xl, _ = drive(330, 30, seed=5)
    valid = np.ones(y.shape, bool)
    filter_ = make("filter", "joint_rls")
    plan, out = filter_.prepare(model), run(filter_, model, prior_of(v), y, v, valid)
    state, innovation, _ = out[320]
    assert (innovation.S[:, 0, 1] == [0.0, SD[1] ** 2]).all()
    assert (filter_.gain(plan, state, innovation)[:, 0, :, 1] == 0.0).all()
    error = [np.sqrt(np.mean((out[k][2][:, 0, 0] - (xl[k + 1] - x[k + 1])) ** 2)) for k in (271, 329)]
    assert error[1] < 0.1 and error[1] < error[0]


def test_a_leader_that_stands_from_the_start_stays(model):
    """Noise on a standing leader is not taken for one that came to a stop long ago, or that drives backwards."""
    lead = (60.0, 0.0, 0.0)
    y, v, x, *_ = drive(120, 200, seed=6, lead=lead)
    valid = np.zeros(y.shape, bool)
    valid[:60] = True
    predicted = run(make("filter", "joint_rls"), model, prior_of(v, lead), y, v, valid)[-1][2]
    error = predicted[:, 0, 0] - (60.0 - x[-1])
    assert error.min() > -3.0 and np.median(np.abs(error)) < 0.5 and (predicted[:, 0, 1] + v[-1] >= 0.0).all()


def test_a_reset_is_least_squares_on_the_last_samples(model):
    """At the first reset after a change of the acceleration the fit equals lstsq on the last 8 samples; a missing one does not count."""
    y, v, x, *_ = drive(60, 20, seed=7)
    t = np.arange(61.0)
    late = np.maximum(t - 30.0, 0.0)
    y[..., 0] += (0.5 * 0.5 * late**2)[1:, None]
    y[..., 1] += (0.5 * late)[1:, None]
    valid = np.random.default_rng(8).uniform(size=y.shape[:2])[..., None] < np.array([0.9, 0.9])
    filter_, window = make("filter", "joint_rls"), 8
    out = run(filter_, model, prior_of(v), y, v, valid)
    for b in range(20):
        k = next(k for k in range(30, 60) if out[k][0].age[b, 0] < out[k - 1][0].age[b, 0])  # its readings are those of t = k + 1
        assert 31 <= k + 1 <= 45 and (out[k][0].sums[b] == 0.0).all() and out[k][0].age[b, 0] == window - 1
        rows, sides = [], []
        for j in range(k - window + 1, k + 1):
            s = float(j - k)
            for i, h in enumerate(([1.0, s, s * s / 2], [0.0, 1.0, s])):
                if valid[j, b, i]:
                    rows.append(np.array(h) / SD[i])
                    sides.append((y[j, b, i] + (x[j + 1, b] - x[k + 1, b] if i == 0 else v[j + 1, b])) / SD[i])
        theta = np.linalg.lstsq(np.array(rows), np.array(sides), rcond=None)[0]
        fit = out[k][0].fit
        np.testing.assert_allclose(fit.x[b, 0, :3] + [0.0, v[k + 1, b], 0.0], theta, atol=1e-3)  # the ridge's weight is 1e-4
    last = np.stack([out[-1][0].fit.x[:, 0, 0], out[-1][0].fit.x[:, 0, 2]])
    np.testing.assert_allclose(last[0], y[-1, :, 0], atol=1.5)
    np.testing.assert_allclose(last[1], LEAD[2] + 0.5, atol=0.1)


@pytest.mark.long
def test_a_steady_leader_is_rarely_taken_for_one_that_changed(model):
    """Four CUSUMs with drift 1/2 and threshold 10 run for 141 000 samples each on average (Siegmund): of 60 000 steps, at most 7 resets."""
    y, v, *_ = drive(200, 300, seed=9)
    out = run(make("filter", "joint_rls"), model, prior_of(v), y, v, np.ones(y.shape, bool))
    ages = np.array([state.age[:, 0] for state, *_ in out])
    assert np.count_nonzero(np.diff(ages, axis=0) < 0.0) <= stats.poisson.ppf(0.999, 4 * 300 * 200 / 141_000)
    early = run(make("filter", "joint_rls", threshold=3.0), model, prior_of(v), y, v, np.ones(y.shape, bool))
    assert np.count_nonzero(np.diff([state.age[:, 0] for state, *_ in early], axis=0) < 0.0) > 100  # the count can rise


def test_the_last_reading_is_held(model):
    """hold_last gives the last reading that was used, whatever is missing; the own speed follows odometry."""
    y, v, *_ = drive(40, 3)
    valid = np.ones(y.shape, bool)
    valid[10:20], valid[5, 1, 0] = False, False
    out = run(make("filter", "hold_last"), model, prior_of(v), y, v, valid)
    x = np.array([state.x[:, 0] for state, *_ in out])
    np.testing.assert_allclose(x[valid.all(axis=-1)][:, :2], y[valid.all(axis=-1)], atol=1e-12)
    np.testing.assert_allclose(x[10:20, :, :2], np.broadcast_to(y[9], (10, 3, 2)), atol=1e-12)
    assert x[5, 1, 0] == x[4, 1, 0] and (x[..., 3] == v[1:]).all() and (x[..., 2] == LEAD[2]).all()
    np.testing.assert_array_equal(out[0][1].S[0, 0], np.diag(2.0 * SD**2))


def test_the_autoregression_learns_what_its_readings_obey(model):
    """Of a sine, y(k) = 2 cos(w) y(k-1) - y(k-2), order 2 learns the coefficients and goes on by itself for 30 steps."""
    _, v, *_ = drive(230, 2)
    k = np.arange(1.0, 231.0)
    y = np.stack([3.0 * np.sin(0.3 * k), 2.0 * np.cos(0.2 * k + 1.0)], axis=-1)[:, None].repeat(2, axis=1)
    valid = np.ones(y.shape, bool)
    valid[200:] = False
    out = run(make("filter", "autoregressive", order=2, delta=1e6), model, prior_of(v), y, v, valid)
    np.testing.assert_allclose(out[199][0].past.w[0, 0], [[2 * np.cos(0.3), -1.0], [2 * np.cos(0.2), -1.0]], atol=1e-5)
    np.testing.assert_allclose(np.array([p[:, 0, :2] for *_, p in out[200:]]), y[200:], atol=1e-2)


def test_the_polynomial_is_that_of_least_squares(model):
    """The prediction equals np.polyfit through the last readings that arrived, near and far; at first it holds the last reading."""
    y, v, *_ = drive(60, 2, seed=2)
    valid = np.ones(y.shape, bool)
    valid[20:24], valid[50:] = False, False
    out = run(make("filter", "polynomial", degree=2, window=9), model, prior_of(v), y, v, valid)
    for k in (9, 15, 27, 50, 59):  # predicted at t = k + 1 from what arrived before
        used = [j for j in range(k) if valid[j, 0, 0]][-9:]
        for b in range(2):
            wanted = [np.polyval(np.polyfit(np.array(used) - k, y[used, b, i], 2), 0.0) for i in range(2)]
            np.testing.assert_allclose(out[k][2][b, 0, :2], wanted, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(out[1][2][:, 0, :2], y[0], atol=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("name", ["hold_last", "autoregressive", "polynomial", "joint_rls"])
def test_every_predictor_stays_finite_and_composes(name, play):
    """Under readings of 1e6 and through 80 steps without any, in composed defences, each a batch of one as among others."""
    place = load_scenario("thesis-ch3-v0").with_threat(jam_range=(-1e6, 1e6), kinds=("dos_jam", "dropout"))
    place = dataclasses.replace(place, ends_on_collision=False, horizon=120)
    for mitigation in ("accept_all", "reacquire"):
        made = Spec("defence", f"composed:filter={name},detector=chi2,mitigation={mitigation}").make()
        for attack in ("dos_jam:low=-1e6,high=1e6,start_step=20,length=30", "dropout:start_step=30,length=80"):
            trace = play(place, made, Spec("attack", attack).make(), range(6), terminate=False)
            assert np.isfinite(trace.estimate).all() and np.isfinite(trace.score).all()
            assert play(place, made, Spec("attack", attack).make(), [4], terminate=False).trace_hash(0) == trace.trace_hash(4)


@pytest.mark.parametrize("name", ["hold_last", "autoregressive", "polynomial"])
def test_predictors_of_single_readings_serve_other_plants(name, short, play):
    """Behind any detector on car following, where each sensor reads one state."""
    trace = play(short(horizon=100), Spec("defence", f"composed:filter={name},detector=score,mitigation=accept_all").make(), "none", range(4))
    np.testing.assert_allclose(trace.estimate[..., 0, :2], trace.wires[..., 0, :2], atol=1e-12)
    assert (trace.mode == Mode.NORMAL).all()


def test_what_does_not_fit_is_refused(short, linear_model):
    """The joint regression needs a radar's model; predictors need sensors that read one state each."""
    with pytest.raises(NotApplicable, match="trusted odometry"):
        make("filter", "joint_rls").prepare(short().brief().model)
    mixed = linear_model(np.eye(2), [[1.0, 1.0]], np.eye(2), [[1.0]])
    twice = linear_model(np.eye(2), [[1.0, 0.0], [1.0, 0.0]], np.eye(2), np.eye(2))
    for model in (mixed, twice):
        with pytest.raises(NotApplicable, match="one state directly"):
            make("filter", "hold_last").prepare(model)


@pytest.mark.parametrize(
    "name, field, value",
    [
        ("joint_rls", "delta", 0.0), ("joint_rls", "forgetting", 1.1), ("joint_rls", "forgetting", 0.0), ("joint_rls", "threshold", -1.0),
        ("joint_rls", "drift", -0.1), ("joint_rls", "window", 2), ("autoregressive", "order", 0), ("autoregressive", "delta", 0.0),
        ("polynomial", "degree", 5), ("polynomial", "window", 2), ("polynomial", "window", 1),
    ],
)  # fmt: skip
def test_parameters_out_of_range_are_refused(name, field, value):
    """The error names the filter, the field and the value."""
    with pytest.raises(InputError, match=rf"filter {name}\.{field}"):
        make("filter", name, **{field: value})


def test_the_regression_predicts_what_the_world_does(play):
    """In the closed loop of scenario (i) with every reading lost from step 182 on, a noise-free fit is exact to the stop's rounding."""
    place = load_scenario("thesis-ch3-v0").with_threat(kinds=("dropout",))
    place = dataclasses.replace(place, sensor=make("sensor", "fmcw_radar", range_sd=1e-6, speed_sd=1e-6))
    made = Spec("defence", "composed:filter=joint_rls,detector=score,mitigation=accept_all").make()
    trace = rollout(place.loop(made), Spec("attack", "dropout:start_step=182").make(), keys("train", range(3)))
    assert not trace.valid[181:].any() and trace.valid[:181].all()
    error = np.abs(trace.estimate - trace.truth)[..., 0, 0]
    assert error[:267].max() < 0.5 and num.dot(error[-1], np.ones(3)) < 3.0
