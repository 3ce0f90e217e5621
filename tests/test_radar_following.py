"""The thesis's radar car: its equations, its closed loop, and what undefended runs come to."""

import dataclasses

import numpy as np
import pytest

import tailgate
from tailgate.agents.scripts.scripted import NoAttack
from tailgate.base.errors import InputError
from tailgate.core import Command, Estimate, Kind, Mode, draws
from tailgate.core.draws import Role
from tailgate.core.registry import make
from tailgate.core.scenario import load_scenario
from tailgate.envs import FmcwRadar, IntelligentDriver, RadarCruise, RadarFollowing
from tailgate.play.trace import rollout

PLANT, SENSOR = RadarFollowing(), FmcwRadar()
MODEL = PLANT.model(SENSOR, RadarCruise())
PLAN = PLANT.prepare(MODEL)
QUIET = {"sensor": FmcwRadar(range_sd=1e-9, speed_sd=1e-9)}


def at(step, batch=1):
    return draws.keys("train", range(batch)).at(Role.PROCESS, np.full(batch, step))


def drive(x, v, mode=Mode.NORMAL, controller=None):
    """The command [m/s^2] for an estimate x = [d, dv, ...] and an own speed v [m/s]."""
    controller = RadarCruise() if controller is None else controller
    one = np.zeros((1, 1))
    estimate = Estimate(np.array(x, float)[None, None], one, one > 0, np.full((1, 1), mode, np.int8), one == 0)
    return controller.step(None, None, estimate, np.zeros((1, 1, 0)), np.array([[[0.0, v]]]))[1][0, 0, 0]


@dataclasses.dataclass(frozen=True)
class Late(NoAttack):
    """Answers the radar's echo 6 m too late from a step on."""

    onset: int = 180
    metres: float = 6.0

    def decide(self, plan, state, view, draws):
        return None, plan.command(view.k >= self.onset, Kind.ECHO_DELAY, plan.granted, self.metres)


class VeryHigh(NoAttack):
    """The jammer's values of the design: distance U(180, 250) m, relative speed U(0, 60) m/s, from step 182 on."""

    def decide(self, plan, state, view, draws):
        u = draws.uniform((1, 2))
        value = np.concatenate([180.0 + 70.0 * u[..., :1], 60.0 * u[..., 1:], np.zeros((len(u), 1, 1))], axis=-1)
        return None, plan.command(view.k >= 182, Kind.DOS_JAM, plan.granted, value)


def runs(defence="none", attack=None, seeds=200, scenario="thesis-ch3-v0", **changes):
    place = dataclasses.replace(load_scenario(scenario), **changes)
    attack = tailgate.make_attack("none") if attack is None else attack
    return rollout(place.loop(tailgate.make_defence(defence)), attack, draws.keys("report", range(seeds)))


def test_the_public_model_is_exact():
    """With the leader's acceleration constant and the own speed known, A x + B v_F is the next state, also while the car stops."""
    rng = np.random.default_rng(3)
    state = PLANT.start(PLAN, at(0))
    state = PLANT.step(PLAN, state, np.zeros((1, 1, 1)), np.full(1, -0.1), at(0))
    for k in range(60):
        before = PLANT.truth(PLAN, state, None)[0, 0]
        u = np.full((1, 1, 1), rng.uniform(-5.0, 2.0))
        state = PLANT.step(PLAN, state, u, np.full(1, -0.1), at(k))
        known = PLANT.known(PLAN, u, np.full(1, -0.1), state)[0, 0]
        np.testing.assert_allclose(MODEL.A @ before + MODEL.B @ known, PLANT.truth(PLAN, state, None)[0, 0], atol=1e-9)
    assert known[0] == 0.0  # it did stop


def test_poles_of_the_discrete_loop():
    """The design has 0.746 and 0.374 +- 0.598i, for the car in spacing mode behind a leader at constant speed."""
    alpha, c, T, h, g = np.exp(-1.0 / 1.008), 1.008 / 3.0, 1.0, 3.0, 0.9
    # states: gap error d - d0 - h v_F, own speed, own acceleration; v_F' = v_F + a' T; d' = d - T (v_F + v_F')/2 (leader at rest in its frame)
    from_u = 1.0 - alpha
    row_a = np.array([from_u * c * g, from_u * c * (-1.0 - g * h), alpha])  # of [d, v, a], u = c (-v + g (d - h v))
    row_v = np.array([0.0, 1.0, 0.0]) + T * row_a
    row_d = np.array([1.0, -T / 2, 0.0]) - T / 2 * row_v
    poles = np.sort_complex(np.linalg.eigvals(np.array([row_d, row_v, row_a])))
    np.testing.assert_allclose(poles, [0.374 - 0.598j, 0.374 + 0.598j, 0.746], atol=6e-4)
    plant, controller = PLANT, RadarCruise(accel_min=-99.0, accel_max=99.0)  # the code's loop, by finite differences at v = 20
    base = np.array([5.0 + 3.0 * 20.0, 20.0, 0.0])

    def step(s):
        state = plant.start(PLAN, at(0))._replace(lead_x=np.array([s[0]]), lead_v=np.array([20.0]), own=np.array([[[0.0, s[1], s[2]]]]))
        u = drive([s[0], 20.0 - s[1], 0.0, s[1]], s[1], controller=controller)
        after = plant.step(PLAN, state, np.full((1, 1, 1), u), np.zeros(1), at(0))
        return np.array([after.lead_x[0] - after.own[0, 0, 0], after.own[0, 0, 1], after.own[0, 0, 2]])

    jacobian = np.array([(step(base + 1e-4 * e) - step(base - 1e-4 * e)) / 2e-4 for e in np.eye(3)]).T
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(jacobian)), poles, atol=1e-6)


def test_a_braking_leader_leaves_a_constant_lag():
    """At a constant a_L the gap error goes to 0 (millimetres) and dv to tau_h a_L."""
    trace = runs(seeds=1, **QUIET)
    k = 150
    gap, v, lead = (trace.signals[name][k, 0, 0] for name in ("gap", "speed", "lead_speed"))
    assert abs(gap - 5.0 - 3.0 * v) < 5e-3
    assert lead - v == pytest.approx(3.0 * -0.1082, abs=2e-3)


def test_the_attack_free_end_of_scenario_i():
    """It ends at a gap of 5.0 m; the leader stops in the step of 268.55 s."""
    trace = runs(seeds=1, **QUIET)
    assert trace.gap[-1, 0, 0] == pytest.approx(5.0, abs=0.05) and not trace.collided.any()
    lead = trace.lead_speed[:, 0, 0]  # entry i belongs to the time i + 2
    assert lead[266] > 0.0 and lead[267] == 0.0 and pytest.approx(268.55, abs=0.01) == 29.0576 / 0.1082


def test_a_late_echo_shifts_the_gap_by_itself():
    """A constant delay of D metres settles at a gap that is D shorter."""
    for metres in (2.0, 6.0):
        attacked = runs(seeds=1, attack=Late(120, metres), **QUIET)
        clean = runs(seeds=1, **QUIET)
        assert clean.gap[200, 0, 0] - attacked.gap[200, 0, 0] == pytest.approx(metres, abs=0.02)


def test_undefended_runs():
    """The design's figures on 200 seeds: the jammer's high values collide in every run (median 189 s), the late echo at 269 s."""
    jammed = runs(attack=VeryHigh())
    assert jammed.collided.any(axis=0).all() and np.median(jammed.length) + 1 == 189
    late = runs(attack=Late())
    assert late.collided.any(axis=0).all() and np.median(late.length) + 1 == 269


def test_modes_of_the_cruise_control():
    """Speed mode beyond d0 + tau_h v_set, spacing mode below, v_set as a limit in both, the command's limits, and what a defence asks for."""
    v = 20.0
    assert drive([200.0, 50.0, 0, v], v) == 2.0  # far away, slow: as fast as it may
    assert drive([200.0, -50.0, 0, v], 29.95168 - 0.5) == pytest.approx(0.5)  # far away: the set speed, whatever the leader does
    at_rest = 5.0 + 3.0 * v
    assert drive([at_rest, 0.0, 0, v], v) == 0.0
    assert drive([at_rest + 1.0, -0.5, 0, v], v) == pytest.approx(1.008 / 3.0 * (-0.5 + 0.9))
    assert drive([at_rest, 99.0, 0, 29.9], 29.9) <= 29.95168 - 29.9 + 1e-12
    assert drive([1.0, -20.0, 0, v], v) == -5.0
    assert drive([at_rest, 0.0, 0, v], v, Mode.STOP) == -5.0 and drive([at_rest, 0.0, 0, v], v, Mode.BRAKE) == -2.0
    assert drive([5.0 + 4.5 * v, 0.0, 0, v], v, Mode.WIDEN) == pytest.approx(0.0, abs=1e-12)


def test_the_intelligent_driver_as_a_controller():
    """Its equilibrium is `desired_gap`; it stops before a wall; on the radar it does not collide without an attack."""
    driver = IntelligentDriver()
    for v in (3.0, 15.0, 25.0):
        gap = float(driver.desired_gap(np.array(v)))
        assert drive([gap, 0.0, 0, v], v, controller=driver) == pytest.approx(0.0, abs=1e-9)
        assert drive([gap, -1.0, 0, v], v, controller=driver) < -0.05
    assert drive([0.5, -20.0, 0, 20.0], 20.0, controller=driver) == -5.0
    trace = runs(seeds=50, controller=driver)
    assert not trace.collided.any() and trace.gap.min() > 3.0


def test_the_driver_behind_and_nobody_behind():
    """With `rear` someone follows and does not run into the car; without, nobody is there."""
    place = load_scenario("thesis-ch3-v0")
    followed = runs(seeds=20, plant=dataclasses.replace(place.plant, rear=True))
    assert np.isfinite(followed.rear_gap).all() and not followed.rear_collided.any()
    assert np.isinf(runs(seeds=1).rear_gap).all()


def test_scenario_ii():
    """The leader slows down until 100 s and speeds up again by 0.012 m/s^2."""
    lead = runs(seeds=1, scenario="thesis-ch3-switched-v0").lead_speed[:, 0, 0]
    np.testing.assert_allclose(np.diff(lead)[:98], -0.1082, atol=1e-9)
    np.testing.assert_allclose(np.diff(lead)[100:], 0.012, atol=1e-9)


def test_no_defence_knows_its_own_speed():
    """`none` takes the state that trusted odometry gives from there, to the last bit."""
    trace = runs(seeds=3)
    np.testing.assert_array_equal(trace.estimate[..., 3], trace.truth[..., 3])


def test_odometry_is_granted_by_name():
    """Only a defence that declares it receives the odometry; it is the own position and speed."""
    seen = []

    class Curious:
        def prepare(self, model):
            return None

        def start(self, plan, prior):
            return None

        def step(self, plan, state, received, known_u, draws):
            seen.append(received.odometry)
            one = np.zeros((len(received.y), 1))
            return None, Estimate(np.zeros((len(one), 1, 4)), one, one > 0, one.astype(np.int8), one == 0)

    place = load_scenario("thesis-ch3-v0")
    for uses, granted in ((("measurements",), False), (("measurements", "odometry"), True)):
        loop = place.loop(Curious(), uses)
        state = loop.start(draws.keys("train", [0]))
        quiet = Command(np.zeros(1, np.int8), np.zeros((1, 1, 3), bool), np.zeros((1, 1, 3)))
        loop.advance(state, quiet)
        assert (seen[-1] is not None) == granted
    np.testing.assert_array_equal(seen[-1], state.plant.own[..., :2])


def test_what_does_not_fit_is_refused():
    """The parts of a radar car go together only."""
    for name in ("acc_radar", "idm"):
        with pytest.raises(InputError, match="radar_following"):
            dataclasses.replace(load_scenario("stop-and-go-v0"), controller=make("controller", name)).loop(tailgate.make_defence("kf"))
    with pytest.raises(InputError, match="radar_following"):
        dataclasses.replace(load_scenario("stop-and-go-v0"), sensor=FmcwRadar()).loop(tailgate.make_defence("kf"))
    with pytest.raises(InputError, match="controller acc"):
        dataclasses.replace(load_scenario("thesis-ch3-v0"), controller=make("controller", "acc")).loop(tailgate.make_defence("kf"))
    with pytest.raises(InputError, match="window"):
        dataclasses.replace(load_scenario("thesis-ch3-v0"), sensor=FmcwRadar(window=5.0)).loop(tailgate.make_defence("kf"))
