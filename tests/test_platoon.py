"""The string of cars: its model against the laws as they are written, its steady states, who knows and hears what, and when."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import cont2discrete

import tailgate
from tailgate.base.errors import InputError
from tailgate.core.draws import Role, keys
from tailgate.core.registry import make
from tailgate.core.scenario import list_scenarios, load_scenario
from tailgate.envs.controllers.cacc import PER_CAR, Column
from tailgate.envs.plants.platoon import Platoon, PlatoonSensors, closed_loop
from tailgate.envs.plants.sampled import zero_order_hold
from tailgate.envs.vehicle import lag
from tailgate.play.trace import rollout

TOPOLOGIES = ("predecessor_leader", "predecessor", "bidirectional", "two_predecessor")
LAWS = {"cacc": {}, "ploeg_cacc": {}, "consensus_cacc": {"leader": "estimated"}}
PLATOONS = sorted((name for name in list_scenarios() if name.startswith("platoon-")), key=lambda name: name != "platoon-braking-v0")


def law_of(name, **changes):
    return make("controller", name, **(LAWS[name] | changes))


def place_of(name="platoon-braking-v0", law=None, horizon=None, sensor=None, manoeuvre=None, **plant):
    """A published scenario with some of its parts changed."""
    place = load_scenario(name).with_threat(agents=())
    return dataclasses.replace(
        place, plant=dataclasses.replace(place.plant, **plant), controller=law or place.controller, horizon=horizon or place.horizon,
        sensor=sensor or place.sensor, manoeuvre=manoeuvre or place.manoeuvre,
    )  # fmt: skip


def play(place, defence="dkf", attack="none", seeds=range(4), **options):
    return rollout(place.loop(tailgate.make_defence(defence)), tailgate.make_attack(attack), keys("train", list(seeds)), **options)


def parts(X):
    """Leader's c, v, a, and d, v, a, f of the followers, each with the leader's place in front."""
    followers = X[3:].reshape(-1, PER_CAR).T
    d, v, a, f = (np.concatenate([[head], row]) for head, row in zip((0.0, X[1], X[2], 0.0), followers, strict=True))
    return X[0], d, v, a, f


def derivative(name, law, graph, tau, X, ur):
    """X' of the laws as the papers and the thesis write them, car by car."""
    _, d, v, a, f = parts(X)
    cars, h, dr = len(d), law.headway, law.standstill
    u, df = np.zeros(cars), np.zeros(cars)
    u[0] = ur
    for i in range(1, cars):
        e, slope = d[i] - dr - h * v[i], v[i - 1] - v[i] - h * a[i]
        if name == "cacc":
            w1, w0 = law.weights or ((0.5, 0.5) if graph[i, 0] else (1.0, 0.0))
            u[i] = law.kp * e + law.kd * slope + f[i]
            df[i] = (-f[i] + w1 * a[i - 1] + w0 * a[0]) / h
        elif name == "ploeg_cacc":
            u[i] = f[i]
            df[i] = (-f[i] + law.kp * e + law.kd * slope + u[i - 1]) / h
        else:
            position = -np.cumsum(d)
            near = [j for j in range(cars) if j != i and graph[i, j]]
            errors = [position[i] - position[j] + (i - j) * (dr + h * v[0]) for j in near]
            u[i] = -law.b * (v[i] - v[0]) - law.k * np.mean(errors)
            df[i] = -f[i] / h
    dX = np.zeros_like(X)
    dX[:3] = v[0], a[0], (-a[0] + ur) / tau
    dX[3:] = np.stack([v[:-1] - v[1:], a[1:], (-a[1:] + u[1:]) / tau, df[1:]], axis=1).ravel()
    return dX


@pytest.mark.thin(3)
@pytest.mark.parametrize("dt", [0.1, 1.0])
@pytest.mark.parametrize("topology", TOPOLOGIES)
@pytest.mark.parametrize("name", LAWS)
def test_the_model_is_the_string_under_the_law_as_it_is_written(name, topology, dt):
    """A step of the public model equals a fine integration of (6.4) with the published law, from any state and leader's input."""
    plant, law = Platoon(topology=topology, dt=dt), law_of(name)
    model = plant.model(PlatoonSensors(), law)
    rng = np.random.default_rng(3)
    for ur in (0.0, -4.0):
        X = rng.normal(size=model.states) * 5.0 + 20.0
        fine = solve_ivp(lambda t, x, ur=ur: derivative(name, law, model.graph, plant.tau, x, ur), (0.0, dt), X, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(model.A @ X + model.B[:, 0] * ur + model.c, fine.y[:, -1], atol=1e-7)


@pytest.mark.parametrize("name", LAWS)
def test_the_hold_is_exact(name):
    """Ad, Bd and cd equal scipy's matrix exponential, the constant being an input that is 1."""
    A, B, c = closed_loop(law_of(name).gains(Platoon().hears(), 3.0), 1.008)
    for dt in (0.01, 0.1, 1.0, 5.0):
        Ad, inputs = zero_order_hold(A, np.stack([B, c], axis=1), dt)
        Bd, cd = inputs.T
        want = cont2discrete((A, np.stack([B, c], axis=1), np.eye(len(A)), np.zeros((len(A), 2))), dt, "zoh")
        np.testing.assert_allclose(Ad, expm(A * dt), rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(np.stack([Bd, cd], axis=1), want[1], rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("dt, tau", [(0.1, 1.008), (1.0, 0.3)])
def test_a_car_is_the_hold_of_a_lag(dt, tau):
    """A and B of one vehicle equal scipy's discretisation."""
    A = np.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / tau]])
    want = cont2discrete((A, np.array([[0], [0], [1 / tau]]), np.eye(3), np.zeros((3, 1))), dt, "zoh")
    np.testing.assert_allclose(lag(dt, tau)[0], want[0], atol=1e-13)
    np.testing.assert_allclose(lag(dt, tau)[1], want[1], atol=1e-13)


@pytest.mark.parametrize("topology", TOPOLOGIES)
@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("speed", [0.0, 20.0])
def test_the_desired_gap_is_a_fixed_point(name, topology, speed):
    """With every gap at d_r + tau_h v and no acceleration, the model moves nothing but the leader's position."""
    plant, law = Platoon(topology=topology), law_of(name)
    model = plant.model(PlatoonSensors(), law)
    X = np.zeros(model.states)
    X[1], X[Column.speed(1) :: PER_CAR], X[Column.gap(1) :: PER_CAR] = speed, speed, law.desired_gap(np.array(speed))
    after = model.A @ X + model.c
    np.testing.assert_allclose(after[1:], X[1:], atol=1e-11)
    assert after[0] == pytest.approx(speed * model.dt)


@pytest.mark.thin(4)
@pytest.mark.parametrize(
    "name, topology", [("cacc", "predecessor_leader"), ("ploeg_cacc", "predecessor"), ("consensus_cacc", "bidirectional"), ("consensus_cacc", "two_predecessor")]
)
def test_cars_settle_at_the_desired_gap_from_perfect_estimates(name, topology):
    """Without noise, attack and manoeuvre, gaps that start anywhere come to d_r + tau_h v, and the speeds to the leader's."""
    still = PlatoonSensors(noise_sd=(0.0, 0.0, 0.0), told_sd=(0.1, 0.1, 0.05))
    steady = make("manoeuvre", "constant", value=0.0)
    place = place_of(law=law_of(name), horizon=500, sensor=still, manoeuvre=steady, topology=topology, followers=2, gap_range=6.0, dt=0.2)
    trace = play(place, seeds=range(2))
    assert np.abs(trace.first["gap"][:, 1:] - 65.0).max() > 3.0
    np.testing.assert_allclose(trace.gap[-1][:, 1:], 65.0, atol=0.5)
    np.testing.assert_allclose(trace.speed[-1], 20.0, atol=0.02)


@pytest.mark.long
def test_everybody_stops_behind_a_leader_that_stops_and_nobody_rolls_back():
    """After the braking the first cars stand d_r apart, no speed is ever negative, no position ever falls."""
    trace = play(place_of(horizon=800), seeds=range(8))
    assert not trace.collided.any()
    assert (trace.speed >= 0.0).all() and (np.diff(trace.position, axis=0) >= 0.0).all()
    assert (trace.speed[-1][:, :3] < 0.05).all()
    np.testing.assert_allclose(trace.gap[-1][:, 1:3], 5.0, atol=0.4)


def test_topologies():
    """Who hears whom among five cars, as drawn in the thesis's figure 6.2 and in the literature."""
    ahead = {i: {i - 1} for i in range(1, 5)}
    want = {
        "predecessor_leader": {i: {0, i - 1} for i in range(1, 5)}, "predecessor": ahead,
        "two_predecessor": {i: {i - 1, max(i - 2, 0)} for i in range(1, 5)}, "bidirectional": {i: ahead[i] | {i + 1} - {5} for i in range(1, 5)},
    }  # fmt: skip
    for name, heard in want.items():
        graph = Platoon(topology=name).hears()
        first = {1} if name == "bidirectional" else set()
        assert [set(np.flatnonzero(row).tolist()) for row in graph] == [{0} | first, *(heard[i] | {i} for i in range(1, 5))], name


@pytest.mark.parametrize("topology", TOPOLOGIES)
@pytest.mark.thin(2)
def test_messages_carry_what_their_names_say(topology):
    """Accelerations of predecessor and leader at this step, what drove the predecessor in the last; 0 from a leader that is not heard."""
    trace = play(place_of(topology=topology, horizon=400), "none", seeds=range(3), terminate=False)
    graph = Platoon(topology=topology).hears()
    sent, accel, applied = trace.clean[..., 3:], trace.truth[:, :, 0, [Column.accel(i) for i in range(5)]], trace.applied[..., 0]
    np.testing.assert_array_equal(sent[:, :, 1:, 0], accel[:, :, :-1])
    np.testing.assert_array_equal(sent[:, :, 1:, 1], accel[:, :, :1] * graph[1:, 0])
    np.testing.assert_array_equal(sent[1:, :, 2:, 2], applied[:-1, :, 1:-1])
    assert (sent[:, :, 0] == 0.0).all() and np.abs(sent[:, :, 1, 2]).max() == 4.0  # the leader's command too


def test_truth_holds_what_the_road_and_the_controllers_have():
    """Gaps, speeds and f of the model's state are those of scene and controllers; the state is the same for all cars."""
    loop = place_of().loop(tailgate.make_defence("dkf"))
    state = loop.start(keys("train", range(3)))
    nothing = tailgate.make_attack("none")
    plan = nothing.prepare(loop.brief)
    for _ in range(300):
        state, _, _ = loop.step(state, nothing, plan, None)
    truth, scene = loop._truth(state.plant, state.controller), loop.plant.scene(loop.plan.plant, state.plant)
    assert (truth == truth[:, :1]).all() and np.abs(state.controller.f).max() > 0.1
    np.testing.assert_array_equal(truth[:, 0, Column.gap(1) :: PER_CAR], scene.gap[:, 1:])
    np.testing.assert_array_equal(truth[:, 0, Column.speed(1) :: PER_CAR], scene.speed[:, 1:])
    np.testing.assert_array_equal(truth[:, 0, Column.controller(1) :: PER_CAR], state.controller.f[:, 1:])
    assert np.isinf(scene.gap[:, 0]).all() and (scene.lead_speed[:, 1:] == scene.speed[:, :-1]).all()


def test_the_prior_is_the_truth_with_its_own_error_for_each_car():
    """What the cars are told has the stated spread about the truth, differs from car to car, and its stated covariance."""
    plant = Platoon(initial_sd=0.1, prior_var=0.04)
    model = plant.model(PlatoonSensors(), law_of("cacc"))
    draws = keys("train", range(400)).at(Role.PRIOR, np.zeros(400, np.int64))
    plan = plant.prepare(model)
    state, held = plant.start(plan, draws), np.zeros((400, 5, 1))
    error = plant.prior(plan, state, held, draws).mean - plant.truth(plan, state, held)
    assert error.std() == pytest.approx(0.1, rel=0.02) and abs(error.mean()) < 0.002
    together = np.corrcoef(error[:, 1].ravel(), error[:, 2].ravel())[0, 1]
    assert abs(together) < 0.05
    np.testing.assert_array_equal(plant.prior(plan, state, held, draws).cov[7, 3], 0.04 * np.eye(model.states))


@pytest.mark.parametrize("told", [False, True])
def test_who_knows_the_leaders_command(told):
    """The leader always, its followers where the scenario says so."""
    plant = Platoon(leader_input_known=told)
    known = plant.known(None, np.ones((2, 5, 1)), np.array([-4.0, 1.0]), None)
    assert known.shape == (2, 5, 1)
    np.testing.assert_array_equal(known[:, 0, 0], [-4.0, 1.0])
    np.testing.assert_array_equal(known[:, 1:, 0], np.outer([-4.0, 1.0], np.full(4, float(told))))


def test_the_leaders_command_is_known_at_the_right_step():
    """From the true state, on the noise-free linear platoon: no error in any step where the command is known, one that lasts where it is not."""
    errors = []
    for told in (True, False):
        trace = play(place_of("thesis-ch6-v0", leader_input_known=told, initial_sd=0.0), seeds=range(2))
        errors.append(np.abs(trace.estimate - trace.truth).max(axis=(1, 2, 3)))
    assert errors[0].max() < 1e-11
    assert errors[1][:17].max() < 1e-11 and errors[1][18:30].min() > 0.01  # k = 19 is the first to see the input of 18 s


def test_the_filters_error_dies_out():
    """From a wrong prior the error of every car's estimate falls to 1e-3 of its start, through the manoeuvre, whose input is known."""
    trace = play(place_of("thesis-ch6-v0", horizon=120), seeds=range(4))
    error = np.abs(trace.estimate - trace.truth).max(axis=(2, 3))
    assert (error[0] > 0.1).all() and (error[-1] < 1e-3 * error[0]).all()


@pytest.mark.long
def test_who_is_told_the_command_does_not_lose_the_leader():
    """While the leader brakes, its acceleration is an error of those who are not told its command, and of nobody else."""
    errors = {}
    for name in ("platoon-braking-known-v0", "platoon-braking-v0"):
        trace = play(load_scenario(name), seeds=range(8))
        braking = (trace.truth[:, :, 0, 2] < -0.5) & (trace.truth[:, :, 0, 1] > 2.0)  # where it stops no linear model holds
        errors[name] = (trace.estimate - trace.truth)[braking][..., Column.accel(0)].mean(axis=0)
    assert np.abs(errors["platoon-braking-known-v0"]).max() < 0.02
    assert errors["platoon-braking-v0"][0] < 0.02 < 0.1 < errors["platoon-braking-v0"][1:].min()


@pytest.mark.parametrize("followers", [1, 2, 9])
def test_any_number_of_cars(followers):
    """State, graph and signals have the sizes of the string, and the last car follows."""
    place = place_of(followers=followers, horizon=40)
    model = place.brief().model
    assert model.states == 3 + 4 * followers and model.agents == 1 + followers and model.followers.tolist() == [False] + [True] * followers
    trace = play(place, seeds=range(2))
    assert trace.estimate.shape == (40, 2, 1 + followers, model.states) and np.isfinite(trace.estimate).all()
    assert not trace.collided.any()


@pytest.mark.long
def test_a_hundred_followers(monkeypatch):
    """They run, the first cars drive as in a short string, and the last ones do not notice the braking of the leader before its time."""
    monkeypatch.setattr("tailgate.envs.plants.platoon.require_detectable", lambda model, where: None)  # slow for so many, and not the point here
    brake = make("manoeuvre", "braking", onset=(0.2, 0.2))
    still = PlatoonSensors(noise_sd=(0.0, 0.0, 0.0), told_sd=(0.1, 0.1, 0.05))
    long, short = (
        play(place_of(followers=n, horizon=40, manoeuvre=brake, sensor=still, gap_range=0.0, initial_sd=0.0, topology="predecessor"), "none", seeds=range(2))
        for n in (100, 4)
    )
    assert long.gap.shape == (40, 2, 101) and np.isfinite(long.gap[:, :, 1:]).all()
    np.testing.assert_allclose(long.gap[:, :, 1:4], short.gap[:, :, 1:4], atol=1e-9)
    assert (long.gap[-1, :, 1] < 60.0).all()
    np.testing.assert_allclose(long.speed[-1, :, 60:], 20.0, atol=1e-3)


def test_a_string_that_nobody_can_see_is_refused():
    """Without feedback the closed loop is the open one, whose gaps only their own cars can see: refused, with the cars named."""
    with pytest.raises(InputError, match=r"undetectable for agents.*0, 1, 2, 3"):
        Platoon(topology="predecessor").model(PlatoonSensors(), law_of("cacc", kp=0.0, kd=0.0))


def test_other_controllers_are_refused():
    """A platoon is driven by a law of cooperative cruise control."""
    with pytest.raises(InputError, match="ploeg_cacc"):
        Platoon().model(PlatoonSensors(), make("controller", "acc"))


def test_sensors_need_a_told_noise():
    """Noise-free sensors have no covariance to tell: one has to be given; and they do not fit other plants."""
    with pytest.raises(InputError, match="told_sd"):
        PlatoonSensors(noise_sd=(0.0, 0.0, 0.0)).matrices(Platoon())
    with pytest.raises(InputError, match="platoon_sensors"):
        PlatoonSensors().matrices(make("plant", "sensor_network"))


@pytest.mark.long
@pytest.mark.parametrize("name", PLATOONS)
def test_every_scenario_has_a_manoeuvre_and_is_driven_without_a_collision(name):
    """The leader's speed changes by metres per second after the onset of attacks, and nobody collides without one."""
    trace = play(load_scenario(name), seeds=range(3))
    onset = load_scenario(name).threat_model.onset
    assert np.ptp(trace.speed[onset:, :, 0], axis=0).min() > 3.0
    assert not trace.collided.any() and trace.gap[:, :, 1:].min() > 3.0
