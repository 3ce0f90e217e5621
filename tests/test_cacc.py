"""Laws of cooperative cruise control: their matrices drive as their formulas say, with messages and without, and they are stable."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import tailgate
from tailgate.base.errors import InputError
from tailgate.core import Estimate, Mode
from tailgate.core.draws import keys
from tailgate.core.registry import make
from tailgate.core.scenario import load_scenario
from tailgate.envs.controllers.adaptive_cruise import BRAKE_ACCEL, STOP_ACCEL, WIDEN_FACTOR
from tailgate.envs.controllers.cacc import PER_CAR, V2V, Column, FeedForward
from tailgate.envs.plants.platoon import Platoon, PlatoonSensors, hears
from tailgate.play.trace import rollout
from tailgate.thesis.string_stability import growth, transfer

TOPOLOGIES = ("predecessor_leader", "predecessor", "bidirectional", "two_predecessor")
LAWS = {"cacc": {}, "ploeg_cacc": {}, "consensus_cacc": {"leader": "estimated"}}
RNG = np.random.default_rng(11)


def law_of(name, **changes):
    return make("controller", name, **(LAWS[name] | {"accel_min": None, "accel_max": None} | changes))


def prepared(law, topology="predecessor_leader", **plant):
    model = Platoon(topology=topology, **plant).model(PlatoonSensors(), law)
    return law.prepare(model), model


def act(law, plan, X, f, v2v=None, mode=Mode.NORMAL):
    """u (N,) and the next f (N,) of one row of beliefs X (N, n)."""
    cars = len(f)
    quiet = np.zeros((1, cars), bool)
    estimate = Estimate(X[None], np.zeros((1, cars)), quiet, np.full((1, cars), mode, np.int8), ~quiet)
    state = law.start(plan, 1)._replace(f=np.array(f, float)[None])
    state, u = law.step(plan, state, estimate, np.zeros((1, cars, 3)) if v2v is None else v2v[None], np.zeros((1, cars, 0)))
    return u[0, :, 0], state.f[0]


def beliefs(cars=5):
    """What five cars believe, each something else."""
    return RNG.normal(size=(cars, 3 + PER_CAR * (cars - 1))) * 3.0 + 20.0, np.concatenate([[0.0], RNG.normal(size=cars - 1)])


def test_the_thesis_law_car_by_car():
    """u_i of (6.5), (6.6) from each car's own belief and its own f, and f' of (6.7) from the messages, integrated exactly."""
    law = law_of("cacc", kp=0.4, kd=0.9, weights=(0.7, 0.2))
    plan, model = prepared(law)
    X, f = beliefs()
    v2v = RNG.normal(size=(5, 3))
    u, after = act(law, plan, X, f, v2v)
    assert u[0] == 0.0 and after[0] == 0.0
    for i in range(1, 5):
        d, v, a, ahead = (X[i, place] for place in (Column.gap(i), Column.speed(i), Column.accel(i), Column.speed(i - 1)))
        assert u[i] == pytest.approx(0.4 * (d - 5.0 - 3.0 * v) + 0.9 * (ahead - v - 3.0 * a) + f[i], abs=1e-12)
        fed = 0.7 * v2v[i, 0] + 0.2 * v2v[i, 1]
        want = solve_ivp(lambda t, y, fed=fed: (fed - y) / 3.0, (0.0, model.dt), [f[i]], rtol=1e-12, atol=1e-14).y[0, -1]
        assert after[i] == pytest.approx(want, abs=1e-12)


def test_ploegs_law_car_by_car():
    """u_i is the own f; f follows kp e + kd e' and the predecessor's command with the headway as its lag."""
    law = law_of("ploeg_cacc", headway=2.0)
    plan, model = prepared(law, "predecessor")
    X, f = beliefs()
    v2v = RNG.normal(size=(5, 3))
    u, after = act(law, plan, X, f, v2v)
    np.testing.assert_array_equal(u, f)
    keep = np.exp(-model.dt / 2.0)
    for i in range(1, 5):
        d, v, a, ahead = (X[i, place] for place in (Column.gap(i), Column.speed(i), Column.accel(i), Column.speed(i - 1)))
        fed = law.kp * (d - 5.0 - 2.0 * v) + law.kd * (ahead - v - 2.0 * a) + v2v[i, 2]
        assert after[i] == pytest.approx(keep * f[i] + (1.0 - keep) * fed, abs=1e-12)


@pytest.mark.parametrize("topology", TOPOLOGIES)
def test_the_consensus_law_car_by_car(topology):
    """u_i from the positions of the cars that i hears, which are sums of gaps in either direction, and from the leader's speed."""
    law = law_of("consensus_cacc", b=0.9, k=0.3)
    plan, _ = prepared(law, topology)
    X, f = beliefs()
    u, _ = act(law, plan, X, f)
    graph = hears(topology, 5)
    for i in range(1, 5):
        position = -np.concatenate([[0.0], np.cumsum(X[i, Column.gap(1) :: PER_CAR])])
        v0, v = X[i, 1], X[i, Column.speed(i)]
        near = [j for j in range(5) if graph[i, j] and j != i]
        errors = [position[i] - position[j] - (j - i) * (5.0 + 3.0 * v0) for j in near]
        assert u[i] == pytest.approx(-0.9 * (v - v0) - 0.3 * np.mean(errors), abs=1e-10)
    assert not plan.normal.gains.V.any()


@pytest.mark.parametrize("topology", TOPOLOGIES)
@pytest.mark.parametrize("name", LAWS)
def test_defaults_are_stable_with_messages_and_without(name, topology):
    """Every eigenvalue of the continuous closed loop has a negative real part at tau = 1.008 s, the leader's integrators aside."""
    for local in (False, True):
        assert growth(Platoon(topology=topology, followers=6), law_of(name), local) < -0.003


@pytest.mark.parametrize("kp, kd", [(0.1, 0.5), (0.3, 0.7), (0.5, 0.2)])
def test_ploegs_loop_is_stable_where_his_condition_holds(kp, kd):
    """kd > kp tau, whatever the headway."""
    for headway in (0.7, 3.0):
        assert (growth(Platoon(), law_of("ploeg_cacc", kp=kp, kd=kd, headway=headway)) < 0.0) == (kd > kp * 1.008)


@pytest.mark.parametrize("b, k", [(0.8, 0.1), (0.5, 0.4), (0.3, 0.4)])
def test_the_consensus_loop_is_stable_where_its_condition_holds(b, k):
    """b > k tau, where each car hears cars ahead only."""
    for topology in ("predecessor_leader", "predecessor", "two_predecessor"):
        assert (growth(Platoon(topology=topology), law_of("consensus_cacc", b=b, k=k)) < 0.0) == (b > k * 1.008)


def test_ploegs_car_passes_on_a_first_order_lag():
    """V_i / V_{i-1} = 1 / (1 + tau_h s) for every car and frequency: the paper's result."""
    w = np.geomspace(1e-2, 1e1, 40)
    V = transfer(Platoon(topology="predecessor"), law_of("ploeg_cacc", headway=2.0), w)
    for i in range(1, 5):
        np.testing.assert_allclose(V[:, i] / V[:, i - 1], 1.0 / (1.0 + 2.0j * w), rtol=1e-9)


@pytest.mark.parametrize("name", LAWS)
def test_without_messages_no_message_counts(name):
    """Mode.ACC: neither the messages nor what was made of them enter the command, and the cars drive on a spacing error all the same."""
    law = law_of(name)
    plan, _ = prepared(law)
    X, f = beliefs()
    quiet, _ = act(law, plan, X, f, mode=Mode.ACC)
    loud, _ = act(law, plan, X, f + 9.0, RNG.normal(size=(5, 3)) * 50.0, Mode.ACC)
    np.testing.assert_array_equal(quiet, loud)
    seen = plan.local.gains.K != 0.0
    for i in range(1, 5):
        own = {Column.gap(i), Column.speed(i), Column.accel(i), Column.speed(i - 1)}
        assert Column.gap(i) in set(np.flatnonzero(seen[i]).tolist()) <= own
        assert plan.local.gains.K[i, Column.gap(i)] > 0.0


@pytest.mark.parametrize("name", LAWS)
def test_modes(name):
    """WIDEN steers for a longer headway, BRAKE and STOP command what they say, limits hold, and the leader is driven by its manoeuvre."""
    law = law_of(name, accel_min=-8.0, accel_max=3.0)
    plan, model = prepared(law)
    X = np.zeros((5, model.states))
    X[:, 1], X[:, Column.speed(1) :: PER_CAR], X[:, Column.gap(1) :: PER_CAR] = 20.0, 20.0, 5.0 + WIDEN_FACTOR * 3.0 * 20.0
    u, f = act(law, plan, X, np.zeros(5), mode=Mode.WIDEN)
    np.testing.assert_allclose(u, 0.0, atol=1e-12)
    np.testing.assert_allclose(f, 0.0, atol=1e-12)
    big = np.full(5, 100.0)
    assert (act(law, plan, X, big, mode=Mode.BRAKE)[0][1:] <= BRAKE_ACCEL).all()
    assert (act(law, plan, X, big, mode=Mode.STOP)[0][1:] == STOP_ACCEL).all()
    X[:, Column.gap(1) :: PER_CAR] = 1e4
    for belief, limit in ((X, 3.0), (-X, -8.0)):
        u, _ = act(law, plan, belief, np.sign(belief[0, Column.gap(1)]) * big)
        assert (u[1:] == limit).all() and u[0] == 0.0


def test_modes_of_one_car_leave_the_others():
    """A car that falls back changes no bit of another's command."""
    law = law_of("cacc")
    plan, _ = prepared(law)
    X, f = beliefs()
    quiet = np.zeros((1, 5), bool)
    commands = []
    for modes in ([0, 0, 0, 0, 0], [0, 0, Mode.ACC, Mode.WIDEN, 0]):
        estimate = Estimate(X[None], np.zeros((1, 5)), quiet, np.array([modes], np.int8), ~quiet)
        commands.append(law.step(plan, law.start(plan, 1)._replace(f=f[None]), estimate, np.ones((1, 5, 3)), np.zeros((1, 5, 0)))[1][0, :, 0])
    np.testing.assert_array_equal(commands[0][[0, 1, 4]], commands[1][[0, 1, 4]])
    assert (commands[0][[2, 3]] != commands[1][[2, 3]]).all()


def test_weights():
    """Half and half where the leader is heard, all on the predecessor where it is not; the leader's share is refused there."""
    half, alone = (FeedForward().gains(hears(name, 5), 3.0).V for name in ("predecessor_leader", "predecessor"))
    np.testing.assert_array_equal(half[1:, :2], np.full((4, 2), 0.5))
    np.testing.assert_array_equal(alone[1:, :2], [[0.5, 0.5], [1.0, 0.0], [1.0, 0.0], [1.0, 0.0]])  # the first car's predecessor leads
    for topology in ("predecessor", "bidirectional", "two_predecessor"):
        with pytest.raises(InputError, match="weights"):
            FeedForward(weights=(0.5, 0.5)).gains(hears(topology, 5), 3.0)
        FeedForward(weights=(1.0, 0.0)).gains(hears(topology, 5), 3.0)


def test_consensus_with_a_leader_that_is_not_heard():
    """It wants the leader's speed from the leader, unless an estimate is good enough."""
    for topology in ("predecessor", "bidirectional", "two_predecessor"):
        with pytest.raises(InputError, match="estimated"):
            make("controller", "consensus_cacc").gains(hears(topology, 5), 3.0)
    make("controller", "consensus_cacc").gains(hears("predecessor_leader", 5), 3.0)


@pytest.mark.parametrize("name", LAWS)
def test_laws_are_refused_without_a_platoons_messages(name):
    """A law needs the three messages of a platoon."""
    with pytest.raises(InputError, match="predecessor_acceleration"):
        law_of(name).prepare(load_scenario("stop-and-go-v0").brief().model)
    assert load_scenario("platoon-v2v-v0").brief().model.v2v == V2V


@pytest.mark.long
@pytest.mark.parametrize("name", LAWS)
def test_cars_that_fall_back_stop_behind_a_leader_that_brakes(name):
    """A platoon that never uses a message keeps its distance through the braking to a stop."""

    class Deaf(type(tailgate.make_defence("dkf"))):
        def step(self, plan, state, received, known_u, draws):
            state, estimate = super().step(plan, state, received, known_u, draws)
            return state, estimate._replace(mode=np.full_like(estimate.mode, Mode.ACC))

    place = dataclasses.replace(load_scenario("platoon-v2v-v0"), controller=make("controller", name))
    trace = rollout(place.loop(Deaf()), tailgate.make_attack("fdi", value=10.0), keys("train", range(4)))
    assert not trace.collided.any() and trace.gap[:, :, 1:].min() > 2.0
    assert (trace.speed[-1, :, 1] < 1.0).all()
