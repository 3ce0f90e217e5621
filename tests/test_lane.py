"""Lane keeping: the bicycle model against its closed forms, the closed loop, the lane as a road, and what is refused."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.signal import cont2discrete

from tailgate.base.errors import InputError
from tailgate.core import Estimate, draws
from tailgate.core.registry import Spec, make
from tailgate.core.scenario import load_scenario
from tailgate.envs.controllers.lane_lqr import LaneLqr, regulator
from tailgate.envs.controllers.lane_stanley import LaneStanley, arctangent
from tailgate.envs.curves import Curves
from tailgate.envs.plants.lane_keeping import LaneKeeping, bicycle
from tailgate.play.metrics import measure
from tailgate.play.trace import rollout
from tailgate.trust.properties import built_in

from .engines import as_plain, loop_of, trace_as_plain

NAME, R, BIAS = "lane-keeping-v0", 500.0, 0.4
QUIET = {"process_var": (0.0,) * 4, "initial_sd": (0.0,) * 4}
SURE = (1e-9, 1e-9, 1e-9)


def quiet(value=0.0, **threat):
    """The scenario without noise, which its defence is still told: a straight road, or one with a bend that does not end."""
    return dataclasses.replace(
        load_scenario(NAME), horizon=299, truth={"plant": QUIET, "sensor": {"noise_sd": SURE}},
        manoeuvre=make("manoeuvre", "bend", value=value, begin=0.0),
    ).with_threat(**threat)


def play(place, defence="kf", attack="none", seeds=1):
    guard = Spec("defence", defence)
    return rollout(place.loop(guard.make(), guard.entry.uses), Spec("attack", attack).make(), draws.keys("tune", range(seeds)))


@pytest.mark.parametrize("speed", [5.0, 20.0, 40.0])
@pytest.mark.parametrize("dt", [0.01, 0.05, 0.2])
def test_a_step_is_the_exact_one(speed, dt):
    plant = LaneKeeping(lane_speed=speed, dt=dt)
    A, B = bicycle(plant.mass, plant.inertia, plant.front, plant.rear, plant.front_stiffness, plant.rear_stiffness, speed)
    wanted = cont2discrete((A, B, np.eye(4), np.zeros((4, 2))), dt)
    for mine, theirs in zip(plant.dynamics(), wanted[:2], strict=True):
        assert np.abs(mine - theirs).max() < 1e-10 * max(1.0, np.abs(theirs).max())


def test_rajamanis_matrix_at_20_metres_a_second():
    """Entries of (2.45), worked out by hand from the parameters."""
    A, B = bicycle(1573.0, 2873.0, 1.1, 1.58, 80_000.0, 80_000.0, 20.0)
    assert A[1] == pytest.approx([0.0, -320_000 / 31_460, 320_000 / 1573, 160_000 * 0.48 / 31_460])
    assert A[3] == pytest.approx([0.0, 160_000 * 0.48 / 57_460, -160_000 * 0.48 / 2873, -160_000 * (1.21 + 2.4964) / 57_460])
    assert B[:, 0] == pytest.approx([0.0, 160_000 / 1573, 0.0, 176_000 / 2873])
    assert B[:, 1] == pytest.approx([0.0, 20 * (160_000 * 0.48 / 31_460 - 20), 0.0, -160_000 * (1.21 + 2.4964) / 2873])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_steady_bend_has_the_closed_form(sign):
    """The middle of the lane, Rajamani's heading error and the steering angle of Ackermann plus understeer."""
    plant, trace = load_scenario(NAME).plant, play(quiet(sign / R))
    length, v = plant.front + plant.rear, plant.lane_speed
    heading = (-plant.rear + plant.front * plant.mass * v * v / (2.0 * plant.rear_stiffness * length)) * sign / R
    steer = plant.rear / (2.0 * plant.front_stiffness) - plant.front / (2.0 * plant.rear_stiffness)
    steer = (length + plant.mass * v * v / length * steer) * sign / R
    last = trace.truth[-1, 0, 0]
    assert abs(last[2] / heading - 1.0) < 1e-4 and abs(trace.control[-1, 0, 0, 0] / steer - 1.0) < 1e-4
    assert np.abs(last[[0, 1, 3]]).max() < 1e-5


@pytest.mark.long
@pytest.mark.parametrize("bias", [BIAS, -BIAS])
def test_a_bias_on_the_offset_moves_the_car_the_other_way(bias):
    """It settles at -b: the estimate believes in the middle of the lane."""
    trace = play(quiet(budget=None, onset=1, end=None), attack=f"fdi:value={bias},targets=[lane_offset]")
    assert trace.truth[-1, 0, 0, 0] == pytest.approx(-bias, abs=1e-4)
    assert trace.estimate[-1, 0, 0, 0] == pytest.approx(0.0, abs=1e-4)


def test_the_gain_is_that_of_riccatis_equation():
    A, B = LaneKeeping().dynamics()
    for weights, effort in (((1.0, 0.0, 1.0, 0.0), 100.0), ((3.0, 0.5, 0.1, 0.2), 1.0)):
        P = solve_discrete_are(A, B[:, :1], np.diag(weights), [[effort]])
        wanted = np.linalg.solve(effort + B[:, :1].T @ P @ B[:, :1], B[:, :1].T @ P @ A)[0]
        assert np.allclose(regulator(A, B[:, 0], np.diag(weights), effort), wanted, rtol=1e-8, atol=0.0)


def test_the_nearer_line_takes_the_place_of_a_car_ahead():
    """The smallest gap is half of the lane less the largest offset, and an episode ends when the car is on a line, to either side."""
    place = load_scenario(NAME)
    for value in (1.0, -1.0):
        trace = play(place, attack=f"fdi:start_step=100,value={value}", seeds=30)
        offset, steps = trace.truth[:, :, 0, 0], np.arange(len(trace.truth))[:, None] < trace.length
        assert np.array_equal(trace.gap[:-1, :, 0][steps[1:]], (place.plant.half_lane - np.abs(offset[1:]))[steps[1:]])
        found = measure(trace)
        assert found["crashed"].all() and not found["rear_collided"].any() and (found["impact_speed"] > 0.2).all()
        before = np.max(np.where(steps, np.abs(offset), 0.0), axis=0)
        assert (found["min_gap"] <= place.plant.half_lane - before + 1e-12).all() and (found["min_gap"] <= 0.0).all()
        ends = offset[trace.length - 1, np.arange(30)]
        assert (np.sign(ends) == -np.sign(value)).all()
    for name in ("max_decel", "string_gain", "recovery_time"):
        assert np.isnan(found[name]).all()


def test_the_loop_is_what_the_model_says():
    """The error of the model's step has the process noise's variance; the readings have the sensors'."""
    place = load_scenario(NAME)
    trace = play(place, seeds=40)
    model = place.brief().model
    bend = (trace.accel[:, :, 0] / 20.0 - np.concatenate([trace.truth[1:, :, 0, 3], trace.truth[-1:, :, 0, 3]])) / 20.0
    inputs = np.stack([trace.applied[1:-1, :, 0, 0], bend[:-2]], axis=-1)
    off = trace.truth[2:, :, 0] - trace.truth[1:-1, :, 0] @ model.A.T - inputs @ model.B.T
    assert off.std(axis=(0, 1)) == pytest.approx(np.sqrt(place.plant.process_var), rel=0.02)
    noise = trace.clean[..., :3] - trace.truth @ model.C[0].T
    assert noise.std(axis=(0, 1, 2)) == pytest.approx(place.sensor.noise_sd, rel=0.02)
    score = trace.score[100:]  # chi-square of three readings: the filter knows the curvature
    assert abs(score.mean() - 3.0) < 0.1


def test_nobody_leaves_the_lane_without_an_attack():
    for name in (NAME, "lane-wet-v0"):
        found = measure(play(load_scenario(name), "chi2_kf", seeds=100))
        assert not found["crashed"].any() and found["min_gap"].min() > 1.2


def test_a_road_winds_to_both_sides_within_its_radius():
    curves, batch, dt = Curves(), 64, 0.05
    keys = draws.keys("tune", range(batch))
    at = [keys.at(2, np.full(batch, k)) for k in range(2000)]
    state, seen = curves.start(curves.prepare(dt), at[0]), []
    for k in range(1, 2000):
        state, bend = curves.accel(dt, state, np.full(batch, k), np.full(batch, 20.0), at[k])
        seen.append(bend)
    seen = np.array(seen)
    assert seen.max() <= 1 / 250 and seen.min() >= -1 / 250 and (seen.max(axis=0) > 0.0).mean() > 0.9 and (seen.min(axis=0) < 0.0).mean() > 0.9
    assert np.abs(np.diff(seen, axis=0)).max() <= dt / (2.0 * 250.0) * (1 + 1e-9)
    assert (np.abs(seen) < 1e-9).mean() > 0.2 and (np.abs(seen) > 1 / 800 - 1e-9).mean() > 0.3


@pytest.mark.thin(2)
@pytest.mark.parametrize(("defence", "attack"), [("kf", "fdi:value=0.5"), ("chi2_kf", "stealth"), ("rkf", "dos_hold"), ("imm", "dos_jam")])
def test_the_compiled_loop_has_the_bits_of_the_plain_one(defence, attack):
    trace_as_plain(*loop_of(NAME, defence, attack))


@pytest.mark.thin(2)
@pytest.mark.parametrize("knowledge", ["black", "white"])
def test_the_compiled_environment_has_the_bits_of_the_plain_one(tmp_path, knowledge):
    as_plain({"scenario": NAME, "defence": "chi2_kf", "knowledge": knowledge, "value": 0.5}, 70, tmp_path)


@pytest.mark.long
def test_the_observation_is_of_the_lane():
    from tailgate.envs.gym.gymnasium_env import AdversaryEnv

    env = AdversaryEnv(scenario=NAME, defence="kf", knowledge="white", value=0.5)
    names = env.card()["observation"]
    seen, _ = env.reset(seed=3)
    for _ in range(80):
        seen, *_ = env.step(0)
    model = env.batch.seat.loop.model
    values = dict(zip(names, seen, strict=True))
    assert values["gap"] == pytest.approx(1.0 - abs(values["offset"]), abs=1e-6) and {"curvature", "lateral_accel", "rate"} <= set(names)
    assert "speed" not in values and model.lane == 1.75


@pytest.mark.long
def test_a_reward_counts_half_of_the_lane_as_its_whole_range():
    """Driving a car off the lane earns the fall of the whole gap, and 1 for leaving it."""
    from tailgate.envs.gym.gymnasium_env import AdversaryEnv

    env = AdversaryEnv(scenario=NAME, defence="kf", action="timing", kind="fdi", value=1.0, gap_shaping=0.0, error_shaping=0.0, threat={"budget": None})
    env.reset(seed=0)
    total, over = 0.0, False
    while not over:
        _, reward, over, late, _ = env.step(1)
        total += reward
        assert not late
    assert total == pytest.approx(2.0, abs=0.1)


def test_braking_and_safe_distances_have_no_meaning():
    found = {p.name: p for p in built_in(load_scenario(NAME))}
    assert found["no_collision"].formula is not None and found["brakes"].formula is None and "does not brake" in found["brakes"].reason


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: {"plant": dataclasses.replace(s.plant, half_lane=2.0)}, r"lane_lqr.margin.*1\.75.*half_lane \(2 m\)"),
        (lambda s: {"manoeuvre": make("manoeuvre", "stop_and_go")}, r"manoeuvre.*StopAndGo.*curves or bend"),
        (lambda s: {"controller": make("controller", "acc")}, r"controller acc.*car-following"),
        (lambda s: {"sensor": make("sensor", "odometry")}, r"sensor odometry.*LaneKeeping"),
    ],
)
def test_parts_that_do_not_fit_are_refused(change, words):
    place = load_scenario(NAME)
    with pytest.raises(InputError, match=words):
        play(dataclasses.replace(place, **change(place)))


def test_numbers_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match=r"half_lane.*0\.5.*6 times"):
        LaneKeeping(half_lane=0.5)
    with pytest.raises(InputError, match=r"lane_speed.*grows at most 1\.5"):
        LaneKeeping(lane_speed=60.0, rear_stiffness=8000.0, dt=0.5)
    with pytest.raises(InputError, match=r"curves.radius.*smaller first"):
        Curves(radius=(500.0, 300.0))
    with pytest.raises(InputError, match=r"lane_lqr.weights.*settles"):
        regulator(np.diag([1.2, 1.0, 1.0, 1.0]), np.array([0.0, 1.0, 0.0, 0.0]), np.eye(4), 1.0)
    with pytest.raises(InputError, match=r"manoeuvre.*Curves.*drives the leader"):
        place = load_scenario("gusty-stop-and-go-v0")
        play(dataclasses.replace(place, manoeuvre=Curves()))
    assert LaneLqr().desired_gap(np.zeros(2)).tolist() == [1.75, 1.75]


# -- Stanley's law


def stanley(**changes):
    place = load_scenario(NAME)
    return dataclasses.replace(place, controller=LaneStanley(**changes))


def test_the_arctangent_is_numpys():
    x = np.concatenate([np.linspace(-3.0, 3.0, 6001), [-1e6, -50.0, 1e-12, 1e6]])
    np.testing.assert_allclose(arctangent(x), np.arctan(x), rtol=1e-15, atol=0.0)
    assert arctangent(np.zeros(1))[0] == 0.0


def test_stanleys_law_by_hand():
    """0.5 m to the left of the middle, turned to the left by 0.01: to the right by the angle of 0.511 m in the way of a second, and by 0.01."""
    x = np.array([[[0.5, 0.0, 0.01, 0.0]]])
    law = LaneStanley(limit=1.0)
    plan, told = law.prepare(load_scenario(NAME).brief().model), Estimate(x, *np.zeros((4, 1, 1)))
    _, delta = law.step(plan, None, told, np.zeros((1, 1, 1)), np.zeros((1, 1, 0)))
    assert delta[0, 0, 0] == pytest.approx(-0.01 - math.atan(0.511 / 20.0), abs=1e-15)


def test_stanleys_law_keeps_the_lane():
    """Without noise it ends in the middle of a bend; on the winding road nobody leaves the lane."""
    place = dataclasses.replace(quiet(1.0 / R), controller=LaneStanley())
    assert abs(play(place).truth[-1, 0, 0, 0]) < 1e-3
    found = measure(play(stanley(), seeds=100))
    assert not found["crashed"].any() and found["min_gap"].min() > 1.2


@pytest.mark.long
def test_a_bias_on_the_offset_moves_a_car_under_stanleys_law_too():
    place = dataclasses.replace(quiet(fdi_bound=1.0, budget=None, end=600, targets=("lane_offset",)), controller=LaneStanley())
    trace = play(place, attack=f"fdi:start_step=60,value={BIAS}")
    assert trace.truth[-1, 0, 0, 0] == pytest.approx(-BIAS, abs=0.02)


@pytest.mark.long
def test_stanleys_law_is_traced_and_fits_its_lane_only():
    loop, rival = loop_of(NAME, "chi2_kf", "fdi:value=0.5")
    place = stanley().with_threat(knowledge="black")
    made = place.loop(loop.defence)
    object.__setattr__(made, "horizon", 200)
    trace_as_plain(made, rival)
    with pytest.raises(InputError, match=r"lane_stanley.margin.*1\.75 m"):
        LaneStanley(margin=2.0).prepare(load_scenario(NAME).brief().model)


def test_a_picture_shows_the_car_and_its_belief():
    pytest.importorskip("PIL")
    from tailgate.envs.gym.gymnasium_env import AdversaryEnv

    env = AdversaryEnv(scenario=NAME, defence="kf", render_mode="rgb_array", action="timing", kind="fdi", value=1.0)
    env.reset(seed=0)
    first = env.render()
    for _ in range(90):
        *_, over, _, _ = env.step(1)
        if over:
            break
    second = env.render()
    assert first.shape == second.shape == (320, 960, 3) and (first != second).mean() > 0.02
    blue = np.argwhere((second == (0, 114, 178)).all(axis=2))
    assert over and abs(blue[:, 0].mean() - 195.0) > 50.0  # the car is at a line, the middle of the lane at row 195


def test_the_page_of_a_replay_has_the_lane(tmp_path):
    from tailgate.evaluation.cells import Cell, run_cell
    from tailgate.replay.episode import episode_of
    from tailgate.replay.page import outcome, write_page
    from tailgate.replay.replay import play as replay

    row = run_cell(Cell("s", NAME, None, "kf", "fdi:value=1,start_step=100", 1))[0]
    held = replay(row)
    lane, trace = episode_of(held)["lane"], held.trace
    assert lane["offset"][:-1] == pytest.approx(trace.truth[:, 0, 0, 0].tolist(), abs=1e-3) and abs(lane["offset"][-1]) >= 1.75
    assert len(lane["curvature"]) == len(lane["offset"]) == len(lane["believed"]) + 1
    assert outcome(held).startswith("The car left its lane at t = ") and "OFF THE LANE" in write_page(held, tmp_path / "a.html").read_text()


@pytest.mark.parametrize("field, value, said", [("speed", 25.0, r"speed: got 25\.0; expected the plant's lane_speed \(20\)"), ("front", 1.4, r"front: got 1\.4; expected the plant's front \(1\.1\)")])
def test_stanleys_law_reckons_with_the_plants_car(field, value, said):
    """Another speed or axle is refused before anything is played, and taken where the plant has it."""
    with pytest.raises(InputError, match=said):
        stanley(**{field: value}).brief()
    plant = {"speed": "lane_speed", "front": "front"}[field]
    place = stanley(**{field: value})
    dataclasses.replace(place, plant=dataclasses.replace(place.plant, **{plant: value})).brief()
