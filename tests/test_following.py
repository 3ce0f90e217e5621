"""Car following: the plant against its continuous model, the closed loop's steady states, the leader's manoeuvres."""

import dataclasses
import functools
import itertools
import math

import numpy as np
import pytest
from scipy.signal import cont2discrete

import tailgate
from tailgate.agents import Inject
from tailgate.base.errors import InputError
from tailgate.core.draws import Role, keys
from tailgate.core.loop import Loop
from tailgate.core.scenario import list_scenarios, load_scenario
from tailgate.core.threat import ThreatModel
from tailgate.envs import AdaptiveCruise, Braking, CarFollowing, Constant, Odometry, OrnsteinUhlenbeck, Profile, StopAndGo
from tailgate.envs.controllers.idm import idm_accel
from tailgate.estimators import Raw
from tailgate.play.metrics import measure
from tailgate.play.trace import rollout

LONG = [(n, d) for n in list_scenarios() for d in ("kf", "chi2_kf") if load_scenario(n).horizon == 600]
LONG += [(n, "chi2_kf") for n in list_scenarios() if load_scenario(n).horizon > 600]
FINE = 4500  # steps of the scenarios with a fine one: 45 s, within which the last leader to brake stands
QUIET = {"process_var": (0.0, 0.0, 0.0), "rear": False}


def prepared(plant):
    """The plan of a plant."""
    return plant.prepare(plant.model(Odometry(), AdaptiveCruise()))


@functools.cache
def _keys(batch):
    return keys("train", range(batch))  # a hash of each: dearer than the step of a plant


def _draws(role, step, batch=1):
    return _keys(batch).at(role, np.full(batch, step))


def _noise_free(manoeuvre=None, horizon=1500, onset=1, **plant):
    """A loop without noise, limits or a set speed."""
    controller = AdaptiveCruise(set_speed=None, accel_min=None, accel_max=None)
    threat = ThreatModel(onset=onset)
    body = CarFollowing(**(QUIET | plant))
    return Loop(body, Odometry((0.0, 0.0)), controller, manoeuvre or Constant(0.0), threat, horizon, Raw())


def _run(loop, attack=None, seeds=(0,)):
    return rollout(loop, attack or tailgate.make_attack("none"), keys("train", list(seeds)))


@pytest.mark.parametrize("dt, tau", [(0.1, 1.008), (0.01, 1.008), (1.0, 0.3), (0.05, 5.0)])
def test_the_plant_is_the_zero_order_hold_of_its_continuous_model(dt, tau):
    """A and B equal scipy's discretisation of x' = v, v' = a, tau a' = u - a."""
    plan = prepared(CarFollowing(dt=dt, tau=tau))
    A = np.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / tau]])
    B = np.array([[0], [0], [1 / tau]])
    want = cont2discrete((A, B, np.eye(3), np.zeros((3, 1))), dt, "zoh")
    np.testing.assert_allclose(plan.A, want[0], atol=1e-13)
    np.testing.assert_allclose(plan.B, want[1], atol=1e-13)


def test_the_state_follows_the_public_model():
    """One step of a moving car is A x + B u."""
    plant = CarFollowing(**QUIET)
    plan = prepared(plant)
    state = plant.start(plan, _draws(Role.PRIOR, 0))
    after = plant.step(plan, state, np.array([[[-1.7]]]), np.array([0.3]), _draws(Role.PROCESS, 1))
    np.testing.assert_allclose(after.ego[0, 0], plan.A @ state.ego[0, 0] + plan.B[:, 0] * -1.7, rtol=1e-15)
    assert after.lead_v[0] == pytest.approx(29.05 + 0.03) and after.lead_x[0] == pytest.approx(87.5 + 0.1 * 29.065)


def test_process_noise_has_the_stated_variance():
    """Noise of x, v and a over 20000 rows, within five standard errors."""
    var, n = (0.04, 0.09, 0.25), 20_000
    plant = CarFollowing(process_var=var, rear=False)
    plan = prepared(plant)
    state = plant.start(plan, _draws(Role.PRIOR, 0, n))
    noisy = plant.step(plan, state, np.zeros((n, 1, 1)), np.zeros(n), _draws(Role.PROCESS, 1, n)).ego[:, 0]
    residual = noisy - state.ego[0, 0] @ plan.A.T
    np.testing.assert_array_less(np.abs(residual.var(axis=0) / var - 1), 5 * math.sqrt(2 / n))
    np.testing.assert_array_less(np.abs(residual.mean(axis=0)), 5 * np.sqrt(np.array(var) / n))


@pytest.mark.parametrize("speed", [10.0, 29.05])
def test_the_loop_settles_at_the_desired_gap(speed):
    """Behind a leader of constant speed: gap = d_r + h v, speeds equal."""
    trace = _run(_noise_free(lead_speed=speed))
    assert trace.gap[-1, 0, 0] == pytest.approx(5.0 + 3.0 * speed, abs=1e-9)
    assert trace.speed[-1, 0, 0] == pytest.approx(speed, abs=1e-9)


@pytest.mark.parametrize("accel", [-0.108, 0.05])
def test_behind_a_constant_acceleration_the_gap_error_vanishes(accel):
    """dv -> h a_l and gap - d_r - h v_f -> 0 while the leader accelerates."""
    trace = _run(_noise_free(Constant(accel)))
    np.testing.assert_allclose(trace.lead_speed[-1] - trace.speed[-1], 3.0 * accel, atol=1e-6)
    np.testing.assert_allclose(trace.gap[-1], 5.0 + 3.0 * trace.speed[-1], atol=1e-6)


@pytest.mark.parametrize("bias", [-20.0, 7.5])
def test_a_bias_on_the_position_shifts_the_gap_by_itself(bias):
    """The car that believes to be D metres further ahead keeps D metres more."""
    loop = _noise_free(onset=500)
    trace = _run(loop, Inject(targets=("position",), value=bias))
    assert trace.gap[498, 0, 0] == pytest.approx(92.15, abs=1e-4)
    assert trace.gap[-1, 0, 0] == pytest.approx(92.15 + bias, abs=1e-9)


def test_the_set_speed_limits():
    """On a free road the car drives at its set speed."""
    controller = AdaptiveCruise(set_speed=20.0)
    loop = Loop(CarFollowing(**QUIET), Odometry((0.0, 0.0)), controller, Constant(0.0), ThreatModel(), 800, Raw())
    assert _run(loop).speed[-1, 0, 0] == pytest.approx(20.0, abs=1e-9)


def test_a_stopped_car_does_not_roll_back():
    """Under full braking: speed never below zero, position never falls, and the car stands still."""
    plant = CarFollowing(rear=False, process_var=(0.0, 0.0, 0.0), speed=3.0)
    plan = prepared(plant)
    state = plant.start(plan, _draws(Role.PRIOR, 0))
    xs, vs = [state.ego[0, 0, 0]], []
    for k in range(100):
        state = plant.step(plan, state, np.full((1, 1, 1), -5.0), np.zeros(1), _draws(Role.PROCESS, k))
        xs.append(state.ego[0, 0, 0])
        vs.append(state.ego[0, 0, 1])
        assert vs[-1] > 0.0 or state.ego[0, 0, 2] >= 0.0
    assert min(vs) == 0.0 and (np.diff(xs) >= 0.0).all() and xs[-1] == xs[50] and vs[-1] == 0.0


def test_speeds_are_never_negative_with_noise():
    """Ego, leader and the driver behind: v >= 0 through a full stop of every row."""
    trace = _run(load_scenario("braking-v0").loop(tailgate.make_defence("stand_still")), seeds=range(20))
    for name in ("speed", "lead_speed", "rear_speed"):
        assert trace.signals[name].min() == 0.0, name


@pytest.mark.thin(60)
@pytest.mark.parametrize("name, defence", LONG)
def test_nobody_collides_without_an_attack(name, defence):
    """200 clean episodes: neither the car nor the driver behind it."""
    place = load_scenario(name)
    place = dataclasses.replace(place, horizon=min(place.horizon, FINE))
    values = measure(_run(place.loop(tailgate.make_defence(defence)), seeds=range(200)))
    assert values["collided"].sum() == 0.0 and values["rear_collided"].sum() == 0.0
    assert values["min_gap"].min() > 1.0


def test_the_driver_behind_reacts_after_its_reaction_time():
    """Intelligent Driver Model with a delay: nothing for 1 s, then the acceleration decided 1 s before."""
    plant = CarFollowing(process_var=(0.0, 0.0, 0.0))
    plan = prepared(plant)
    state, decided = plant.start(plan, _draws(Role.PRIOR, 0)), []
    speeds = [state.behind.v[0]]
    for k in range(30):
        decided.append(idm_accel(state.ego[0, 0, 0] - state.behind.x, state.behind.v, state.ego[:, 0, 1])[0])
        state = plant.step(plan, state, np.full((1, 1, 1), -2.0), np.zeros(1), _draws(Role.PROCESS, k))
        speeds.append(state.behind.v[0])
    made = np.diff(speeds) / 0.1
    assert plan.behind.reaction == 10 and not made[:10].any()
    np.testing.assert_allclose(made[10:], decided[:20], atol=1e-12)


def test_idm_equilibrium_and_limits():
    """At the equilibrium gap (s0 + v T) / sqrt(1 - (v/v0)^4) the acceleration is 0; it is cut to [-8, 1.4]."""
    v = np.array([5.0, 20.0, 30.0])
    gap = (2.0 + 1.5 * v) / np.sqrt(1 - (v / 33.3) ** 4)
    np.testing.assert_allclose(idm_accel(gap, v, v), 0.0, atol=1e-12)
    assert idm_accel(np.array([-5.0]), np.array([30.0]), np.array([0.0]))[0] == -8.0
    assert idm_accel(np.array([1e9]), np.array([0.0]), np.array([0.0]))[0] == pytest.approx(1.4)


def _lead(manoeuvre, steps, batch, speed=29.05, dt=0.1):
    """Leader speeds (steps + 1, batch) and the manoeuvre's states, as the plant integrates them."""
    plan = manoeuvre.prepare(dt)
    state = manoeuvre.start(plan, _draws(Role.MANOEUVRE, 2**32 - 1, batch))
    speeds, states = [np.full(batch, speed)], [state]
    for k in range(steps):
        state, accel = manoeuvre.accel(plan, state, np.full(batch, k), speeds[-1], _draws(Role.MANOEUVRE, k, batch))
        speeds.append(np.maximum(0.0, speeds[-1] + accel * dt))
        states.append(state)
    return np.array(speeds), states


def test_braking_starts_within_its_span_and_ends_at_a_stop():
    """Onsets fill [25, 35] s; the deceleration is 4 m/s^2 until the leader stands."""
    speeds, _ = _lead(Braking(), 450, 500)
    moving = np.diff(speeds, axis=0) / 0.1
    onset = 0.1 * np.argmax(moving < 0, axis=0)
    assert onset.min() >= 25.0 - 1e-9 and onset.max() <= 35.1 and onset.min() < 25.5 and onset.max() > 34.5
    assert moving.min() == pytest.approx(-4.0) and np.abs(speeds[-1]).max() < 1e-12
    assert (speeds[:250] == 29.05).all()


def test_stop_and_go_keeps_its_phases():
    """Cruise, brake, dwell, accelerate, in this order, each within its bounds of time, speed and acceleration."""
    drive = StopAndGo(cruise=(2.0, 5.0), dwell=(1.0, 2.0), low_speed=3.0)
    speeds, states = _lead(drive, 600, 60)
    phases = np.array([s.phase for s in states])
    accel = np.diff(speeds, axis=0) / 0.1
    assert set(np.unique((phases[1:] - phases[:-1]) % 4)) == {0, 1}
    assert speeds.min() == pytest.approx(3.0) and speeds.max() == pytest.approx(29.05)
    bounds = {0: (0.0, 0.0), 1: (-3.0, 0.0), 2: (0.0, 0.0), 3: (0.0, 1.5)}
    for phase, (low, high) in bounds.items():
        made = accel[phases[1:] == phase]
        assert made.min() >= low - 1e-9 and made.max() <= high + 1e-9
    assert speeds[1:][phases[1:] == 2] == pytest.approx(3.0) and speeds[1:][phases[1:] == 0] == pytest.approx(29.05)
    lasted = {0: [], 2: []}
    for row in phases.T:
        edges = np.flatnonzero(np.diff(row)) + 1
        for start, end in itertools.pairwise(edges):
            lasted.get(int(row[start]), []).append(0.1 * (end - start))
    assert min(lasted[0]) >= 2.0 - 1e-9 and max(lasted[0]) <= 5.1 + 1e-9 and max(lasted[0]) - min(lasted[0]) > 2.0
    assert min(lasted[2]) >= 1.0 - 1e-9 and max(lasted[2]) <= 2.1 + 1e-9


def test_ornstein_uhlenbeck_is_stationary():
    """From the first step: standard deviation 0.8 and correlation exp(-t / 3 s), over 20000 rows; |a| is limited."""
    n = 20_000
    speeds, states = _lead(OrnsteinUhlenbeck(), 30, n, speed=25.0)
    a = np.array([s.accel for s in states])
    assert np.max(np.abs(a.std(axis=1) / 0.8 - 1)) < 5 / math.sqrt(2 * n)
    for lag in (1, 10, 30):
        correlation = np.mean(a[0] * a[lag]) / 0.64
        assert correlation == pytest.approx(math.exp(-0.1 * lag / 3.0), abs=5 / math.sqrt(n) * 1.5)
    assert np.abs(np.diff(speeds, axis=0) / 0.1).max() <= 3.0 + 1e-9


def test_a_profile_is_followed_exactly(tmp_path):
    """The leader drives the CSV's speeds, linear between samples and constant after the last."""
    file = tmp_path / "drive.csv"
    file.write_text("t,v\n10,20\n12.05,15.5\n\n14,0\n14.7,3\n")
    speeds, _ = _lead(Profile(file), 80, 2, speed=20.0)
    t = 10.0 + 0.1 * np.arange(81)
    want = np.interp(t, [10, 12.05, 14, 14.7], [20, 15.5, 0, 3])
    np.testing.assert_allclose(speeds, np.stack([want, want], axis=1), atol=1e-12)


@pytest.mark.parametrize(
    "text, words",
    [("0,1\n1,2\n", "header t,v"), ("t,v\n0,1\n1,nan\n", "line 3.*finite"), ("t,v\n0,1\n1,-2\n", "line 3.*not below 0"),
     ("t,v\n0,1\n0,2\n", "line 3.*a time after 0"), ("t,v\n0,1\n2,2\n1,3\n", "line 4.*a time after 2"), ("", "header t,v"),
     ("t,v\n0,1\n", "at least two"), ("t,v\n0,1\n1\n", "line 3.*two numbers"), ("t,v\n0,x\n", "line 2.*two numbers"),
     ("t,v\n0,inf\n", "line 2.*finite")],
)  # fmt: skip
def test_a_bad_profile_is_refused_with_its_line(tmp_path, text, words):
    """Header, numbers, signs and order of a CSV file are checked."""
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=rf"manoeuvre profile\.path.*{words}"):
        Profile(file).prepare(0.1)


def test_a_missing_profile_is_named(tmp_path):
    """A file that does not exist is an InputError with its path."""
    with pytest.raises(InputError, match=r"nowhere\.csv.*readable CSV"):
        Profile(tmp_path / "nowhere.csv").prepare(0.1)


IMPOSSIBLE = [(Braking, {"onset": (9.0, 8.0)}), (StopAndGo, {"cruise": (2.0, 1.0)}), (StopAndGo, {"low_speed": 30.0})]


@pytest.mark.parametrize("cls, bad", IMPOSSIBLE)
def test_impossible_manoeuvres_are_refused(cls, bad):
    """Spans must rise, and the dwell must be slower than the cruise."""
    with pytest.raises(InputError, match=rf"manoeuvre \w+\.{next(iter(bad))}"):
        cls(**bad)
