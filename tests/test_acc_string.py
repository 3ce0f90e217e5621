"""Cars with a production-like cruise control: the radar that is late, ISO 15622's limits, and emergency braking as the last layer."""

import dataclasses

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.core import Estimate, Mode, draws
from tailgate.core.registry import Spec, make
from tailgate.core.scenario import load_scenario
from tailgate.envs.controllers import production
from tailgate.envs.controllers.emergency import CYCLES, DECEL, EmergencyBrake
from tailgate.play.metrics import METRICS
from tailgate.play.trace import rollout

ISO = (("slow", 2.0, 4.0, 5.0, 5.0), ("middle", 12.5, 3.0, 4.25, 3.75), ("fast", 30.0, 2.0, 3.5, 2.5))  # speed, acceleration, braking, jerk


def play(name, defence="kf", attack="none", seeds=40, purpose="tune", **changes):
    scenario = dataclasses.replace(load_scenario(name), **changes)
    guard = Spec("defence", defence)
    loop = scenario.loop(guard.make(), guard.entry.uses)
    return loop, rollout(loop, Spec("attack", attack).make(), draws.keys(purpose, range(seeds)))


def estimate(d, dv, ahead=0.0, v=20.0, mode=Mode.NORMAL):
    x = np.array([[[d, dv, ahead, v]]])
    return Estimate(x, np.zeros((1, 1)), np.zeros((1, 1), bool), np.full((1, 1), mode, np.int8), np.ones((1, 1), bool))


def command(law, d, dv, v=20.0, steps=1, mode=Mode.NORMAL, ahead=0.0):
    """The command in steady conditions, after some steps."""
    plan = production.ProductionPlan(0.05, 1, round(law.delay / 0.05))
    state, out = law.start(plan, 1), []
    for _ in range(steps):
        state, u = law.step(plan, state, estimate(d, dv, ahead, v, mode), np.zeros((1, 1, 0)), np.array([[[0.0, v]]]))
        out.append(float(u[0, 0, 0]))
    return out


@pytest.mark.thin(3)
@pytest.mark.parametrize("late", [0, 1, 3])
def test_the_model_makes_up_for_the_latency(late):
    """A reading is what was `late` cycles ago plus noise, and the innovation of a filter that is told so has its variance."""
    scenario = load_scenario("road-string-v0")
    sensor = dataclasses.replace(scenario.sensor, late=late)
    plant = dataclasses.replace(scenario.plant, kept=late, cars=2)
    manoeuvre = make("manoeuvre", "constant", value=0.1)
    loop, trace = play("road-following-v0", seeds=60, sensor=sensor, plant=plant, manoeuvre=manoeuvre, horizon=400)
    truth, sent = trace.truth, trace.clean  # (K, B, N, .)
    off = sent[late:, ..., :2] - truth[: len(truth) - late, ..., :2]
    assert abs(off[..., 0].std() / 0.15 - 1.0) < 0.02 and abs(off[..., 1].std() / 0.1 - 1.0) < 0.02
    assert np.abs(off.mean(axis=(0, 1))).max() < 0.003
    A, B = loop.model.A, loop.model.B
    known = trace.signals["speed"][..., None]
    predicted = truth[:-1] @ A.T + known[: len(truth) - 1] @ B.T
    assert np.abs((truth[1:] - predicted)[20:, ..., [0, 1, 3]]).max() < 0.03  # but for the change of the acceleration ahead
    assert np.abs((truth[1:] - predicted)[20:, ..., 4:]).max(initial=0.0) < 1e-12
    score = trace.score[100:]  # chi-square of two readings
    assert abs(score.mean() - 2.0) < 0.25


def test_each_car_sees_the_one_ahead_of_it():
    _, trace = play("road-string-v0", seeds=10)
    gap, position = trace.signals["gap"], trace.signals["position"]
    assert gap.shape[2] == 5 and np.abs(position[..., :-1] - position[..., 1:] - gap[..., 1:]).max() < 1e-9
    assert np.array_equal(trace.signals["lead_speed"][..., 1:], trace.signals["speed"][..., :-1])
    assert np.abs(trace.truth[1:, ..., 0] - gap[:-1]).max() < 1e-9


def test_all_begin_at_the_leaders_speed_and_gap():
    _, trace = play("road-following-v0", seeds=40)
    speed, lead, gap = (trace.first[name][:, 0] for name in ("speed", "lead_speed", "gap"))
    assert np.ptp(speed) > 2.0 and np.abs(speed - lead).max() < 0.2 and np.abs(gap - 3.5 - 1.2 * speed).max() < 0.2


@pytest.mark.thin(3)
@pytest.mark.parametrize("name", ["road-following-v0", "road-string-v0", "road-us06-v0", "road-aeb-own-v0", "road-aeb-shared-v0"])
def test_nobody_collides_or_brakes_in_an_emergency_without_an_attack(name):
    _, trace = play(name, seeds=60)
    assert not METRICS["collided"](trace).any() and trace.signals["accel"].min() > -DECEL + 0.3


@pytest.mark.parametrize("speed, accel, decel, jerk", [row[1:] for row in ISO], ids=[row[0] for row in ISO])
def test_commands_stay_within_iso_15622(speed, accel, decel, jerk):
    law = make("controller", "acc_production", delay=0.0, set_speed=100.0)
    assert command(law, 500.0, 30.0, speed)[0] == pytest.approx(accel)
    braking = command(law, 1.0, -10.0, speed, steps=80)
    assert braking[0] == pytest.approx(-0.05 * jerk) and braking[-1] == pytest.approx(-decel)
    assert np.diff(braking).min() >= -0.05 * jerk - 1e-12


def test_a_command_takes_effect_after_the_delay():
    law = make("controller", "acc_production", delay=0.3)
    out = command(law, 40.0, 0.0, steps=10)
    assert out[:6] == [0.0] * 6 and out[6] > 0.5


def test_a_car_ahead_that_brakes_hard_counts_before_the_gap_shrinks():
    law = make("controller", "acc_production", delay=0.0)
    calm, hard = (command(law, 3.5 + 24.0, 0.0, steps=60, ahead=ahead)[-1] for ahead in (-1.0, -3.0))
    assert calm == pytest.approx(0.0) and hard < -2.0


@pytest.mark.parametrize("mode, least, most", [(Mode.WIDEN, -3.5, -0.5), (Mode.BRAKE, -2.0, -2.0), (Mode.STOP, -5.0, -5.0)])
def test_modes_of_a_defence_are_obeyed(mode, least, most):
    law = make("controller", "acc_production", delay=0.0)
    assert least <= command(law, 27.5, 0.0, steps=40, mode=mode)[-1] <= most


def test_the_emergency_brake_waits_for_cycles_in_a_row_and_holds():
    rule, one = EmergencyBrake(), np.ones((1, 1))
    state, on = rule.start((1, 1)), []
    for gap, closing in [(5.0, 8.0), (90.0, 0.0), *[(5.0, 8.0)] * CYCLES, (6.0, 1.0), (20.0, -1.0)]:
        state = rule.step(state, gap * one, closing * one, 15.0 * one)
        on.append(bool(state.on[0, 0]))
    assert on == [False] * (2 + CYCLES - 1) + [True, True, False]
    slow = rule.start((1, 1))
    for _ in range(9):
        slow = rule.step(slow, 0.5 * one, 2.0 * one, 2.0 * one)
    assert not slow.on.any()  # below 10 km/h
    assert rule.limited(state._replace(on=one > 0), 1.0 * one)[0, 0] == -DECEL


def test_emergency_braking_avoids_on_its_own_sensor_what_it_cannot_see_on_the_attacked_one():
    attack = "fdi:trigger=near,threshold=25,value=10"
    crashed = {
        name: METRICS["collided"](play(name, "kf", attack, seeds=100)[1]).mean()
        for name in ("road-following-v0", "road-aeb-own-v0", "road-aeb-shared-v0")
    }
    assert crashed["road-aeb-own-v0"] < 0.3 < 0.7 < min(crashed["road-following-v0"], crashed["road-aeb-shared-v0"])
    brakes = play("road-aeb-shared-v0", "kf", "fdi:trigger=near,threshold=25,value=-10", seeds=40)[1]
    assert (brakes.signals["accel"].min(axis=(0, 2)) < -5.5).mean() > 0.5  # and on the attacked one it can be made to brake


def test_nothing_arrives_from_beyond_the_reach():
    scenario = load_scenario("road-following-v0")
    plant = dataclasses.replace(scenario.plant, gap=300.0)
    _, trace = play("road-following-v0", seeds=3, plant=plant, horizon=40)
    assert not trace.valid.any() if hasattr(trace, "valid") else (trace.clean[:, :, 0, :2] == 0.0).all()


def test_a_raw_reading_that_is_late_is_taken_for_the_present():
    _, trace = play("road-following-v0", "none", seeds=5)
    assert np.abs(trace.estimate[..., :2] - trace.clean[..., :2]).max() == 0.0


@pytest.mark.parametrize("part, fields, words", [
    ("sensor", {"late": 2}, r"vehicle_radar\.late: got 2; expected at most what the plant keeps \(1 cycles\)"),
    ("controller", {"delay": 6.0}, r"acc_production\.delay: got 6\.0; expected at most 100 steps"),
    ("plant", {"gap_sd": 1.0}, r"acc_string\.gap: got 3\.5; expected more than 6 gap_sd"),
])  # fmt: skip
def test_bad_fields_are_refused(part, fields, words):
    with pytest.raises(InputError, match=words):
        play("road-following-v0", **{part: dataclasses.replace(getattr(load_scenario("road-following-v0"), part), **fields)})


def test_components_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match="vehicle_radar: got 'CarFollowing'; expected the plant acc_string"):
        make("sensor", "vehicle_radar").matrices(load_scenario("stop-and-go-v0").plant)
    with pytest.raises(InputError, match="acc_production: got '1 agents, 3 states'"):
        make("controller", "acc_production").prepare(load_scenario("stop-and-go-v0").brief().model)


@pytest.mark.long
def test_a_string_is_shown_behind_its_leader(tmp_path):
    """In pictures and on the page of a replay the leader is a car of its own, and the first agent is car 0."""
    pytest.importorskip("pygame")
    from tailgate.envs.gym.gymnasium_env import AdversaryEnv
    from tailgate.envs.render.stage import stage_of
    from tailgate.replay.episode import episode_of
    from tailgate.replay.page import outcome
    from tailgate.replay.replay import Filter, play

    env = AdversaryEnv(scenario="road-string-v0", defence="kf", render_mode="rgb_array", viewer="plain", engine="plain")
    env.reset(seed=0)
    for _ in range(3):
        env.step(0)
    episodes = env.batch if hasattr(env, "batch") else env.episodes
    stage = stage_of(episodes.seat.loop, episodes.state, None, 0)
    assert [car.name for car in stage.cars] == ["leader", *(f"car {i}" for i in range(5))] and stage.cars[0].role == "leader"
    assert [follower.agent for follower in stage.followers] == [0, 1, 2, 3, 4] and [f.car for f in stage.followers] == [1, 2, 3, 4, 5]
    assert env.render().shape[2] == 3

    from tailgate.cli import main
    from tailgate.evaluation.rows import read_rows

    rows = tmp_path / "rows.jsonl"
    attack = "fdi:trigger=near,threshold=25,value=10"
    assert main(["evaluate", "--scenario", "road-string-v0", "--defence", "kf", "--attack", attack, "--seeds", "8", "--out", str(rows)]) == 0
    row = max(read_rows(rows), key=lambda row: row["crashed"])
    replay = play(row, Filter())
    data = episode_of(replay)
    assert len(data["string"]["gap"]) == 5 and len(data["string"]["lead"]) == len(data["string"]["speed"][0])
    assert row["crashed"] == 1.0 and "car 2 hit car 1" in outcome(replay)
