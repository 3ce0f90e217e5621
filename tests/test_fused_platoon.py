"""Platoons in the fused engine, against the plain loop: the same bits over whole episodes."""

import dataclasses

import numpy as np
import pytest

from tailgate import draws
from tailgate.envs.faces import AdversaryEnv
from tailgate.envs.manoeuvres import Profile
from tailgate.errors import InputError
from tailgate.fused import Constants, Refused, fuse
from tailgate.fused.platoon_play import Platoon
from tailgate.link import Link
from tailgate.registry import Spec
from tailgate.scenario import load_scenario
from tailgate.trace import nearest, rollout
from tailgate.tree import leaves

from .fused import as_plain, in_any_thread, loop_of, same, trace_as_plain

# Every topology and law, manoeuvre of a scenario, kind, law of values and trigger at least once; wires of several cars, and all of a car's.
WIRES = ("distance", "velocity", "acceleration", "predecessor_acceleration", "leader_acceleration", "predecessor_command", "command")
ANY = {"onset": 10, "end": 110, "agents": (1, 2, 4), "targets": WIRES}
LEADER = {"onset": 10, "agents": (0, 3)}
READ = ANY | {"kinds": ("dos_jam", "dos_hold", "dos_hold_fresh", "fdi")}  # nothing is missed: covariances are the same in all rows
CELLS = [
    ("platoon-braking-v0", "dkf", "none", {}),
    ("platoon-braking-v0", "dkf", "fdi:value=60,targets=[distance]", {"onset": 20}),
    ("platoon-gusty-v0", "dkf", "fdi:signs=3,value=1", ANY),
    ("platoon-gusty-v0", "dkf", "dos_hold:trigger=near,threshold=64", ANY),
    ("platoon-gusty-v0", "dkf", "dos_hold:fresh=true,start_step=40,length=40", LEADER),
    ("platoon-noisy-v0", "dkf", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-noisy-v0", "dkf", "fdi_gaussian:trigger=closing,threshold=0.5,sd=4", ANY),
    ("platoon-heavy-v0", "dkf", "dos_jam:start_step=30,low=-3,high=3,burst=4,pause=3", ANY),
    ("platoon-heavy-v0", "dkf", "fdi_uniform:trigger=leader_braking,threshold=0.1,chance=0.6", ANY),
    ("platoon-stop-and-go-v0", "dkf", "fdi_bernoulli:trigger=slow,threshold=19,value=2", ANY),
    ("platoon-stop-and-go-v0", "dkf", "fdi_ramp:trigger=speed,threshold=20.05,rate=0.3", ANY),
    ("platoon-braking-known-v0", "dkf", "fdi_then_jam:start_step=30,inject=5,value=1", ANY),
    ("platoon-bidirectional-v0", "dkf", "fdi_sparse:start_step=30", ANY),
    ("platoon-two-predecessor-v0", "dkf", "actuator_fdi:start_step=20,value=1.5", ANY),
    ("platoon-20-v0", "dkf", "fdi:start_step=20,value=-20", {}),
    ("platoon-braking-v0", "composed:filter=dkf,detector=score,mitigation=accept_all", "dropout:start_step=30", LEADER),
    ("platoon-gusty-v0", "lasso_dkf", "fdi:start_step=20,value=30", ANY),
    ("platoon-heavy-v0", "lasso_dkf:unit=sigma,lam=1.3", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-20-v0", "lasso_dkf", "dos_hold:start_step=20", {}),
    ("platoon-bidirectional-v0", "norm_resilient", "fdi_gaussian:start_step=20,sd=8", ANY),
    ("platoon-noisy-v0", "norm_resilient:lam=5", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-gusty-v0", "norm_resilient", "fdi_bernoulli:start_step=20,value=50", LEADER),
    ("platoon-stop-and-go-v0", "saturated_dkf", "fdi:start_step=20,value=-50", {"onset": 10}),
    ("platoon-two-predecessor-v0", "saturated_dkf:eta=3,gamma=0.5", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-lossy-v0", "dkf", "fdi:start_step=20,value=30", ANY),
    ("platoon-lossy-v0", "lasso_dkf", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-lossy-v0", "norm_resilient", "dos_hold:start_step=30,fresh=true,burst=3,pause=2", ANY),
    ("platoon-lossy-v0", "saturated_dkf", "dos_hold:start_step=30", {"onset": 10}),
    ("platoon-lossy-v0", "none", "dos_jam:start_step=20", ANY),
    ("platoon-heavy-v0", "none", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-20-v0", "none", "fdi:start_step=20,value=30", {}),
    ("platoon-gusty-v0", "kf", "fdi:start_step=20,value=30", READ),
    ("platoon-two-predecessor-v0", "composed:filter=kf,detector=chi2,mitigation=accept_all", "dos_jam:start_step=20", READ),
    ("platoon-bidirectional-v0", "consensus_kf", "fdi_gaussian:start_step=20,sd=8", READ),
    ("platoon-noisy-v0", "consensus_kf:eta=4,consensus=0.3", "dos_hold:start_step=20", READ),
    ("platoon-stop-and-go-v0", "consensus_kf:consensus=0", "none", READ),
    ("platoon-gusty-v0", "always_alarm", "none", READ),
    ("platoon-gusty-v0", "always_brake", "fdi:start_step=20,value=30", READ),
    ("platoon-bidirectional-v0", "stand_still", "none", READ),
    ("platoon-gusty-v0", "coast", "fdi:start_step=20,value=-9", READ),
    ("platoon-braking-v0", "composed:filter=lasso,detector=chi2_tail,mitigation=accept_all", "dos_jam:start_step=20", ANY),
]


@pytest.mark.parametrize(("scenario", "defence", "attack", "threat"), CELLS)
def test_a_trace_is_the_plain_loops_to_the_last_bit(scenario, defence, attack, threat):
    """Episodes in two blocks, one of them not full: every signal's hash, and the lengths."""
    loop, rival = loop_of(scenario, defence, attack, horizon=120, **threat)
    plain = trace_as_plain(loop, rival)
    assert attack == "none" or (plain.kind != 0).any()


@pytest.mark.parametrize("followers", [1, 2, 7])
def test_strings_of_any_length(followers, tmp_path):
    """A single row, and other numbers of states; with a manoeuvre that is a table, and no noise of the sensors."""
    speeds = tmp_path / "speeds.csv"
    speeds.write_text("t,v\n0,20\n3,18\n6,19\n")
    place, guard = load_scenario("platoon-gusty-v0").with_threat(agents=(1,)), Spec("defence", "dkf")
    place = dataclasses.replace(
        place, plant=dataclasses.replace(place.plant, followers=followers), manoeuvre=Profile(speeds), horizon=90,
        sensor=dataclasses.replace(place.sensor, told_sd=(0.1, 0.1, 0.05), noise_sd=(0.0, 0.0, 0.0)),
    )  # fmt: skip
    loop = place.loop(guard.make(), guard.entry.uses)
    rival, keys = Spec("attack", "fdi:start_step=60,value=9").make(), draws.keys("report", [5])
    fused, plain = rollout(loop, rival, keys), rollout(loop, rival, keys, plain=True)
    assert isinstance(fuse(loop, rival), Constants) and (plain.kind != 0).any()
    assert fused.trace_hash(0) == plain.trace_hash(0)


def test_whole_episodes_with_collisions_and_beyond_them():
    """To the horizon, ended by a collision or not."""
    loop, rival = loop_of("platoon-gusty-v0", "dkf", "fdi:start_step=60,value=30,targets=[distance]", horizon=550)
    keys = draws.keys("report", range(20))
    for terminate in (True, False):
        fused, plain = (rollout(loop, rival, keys, terminate=terminate, plain=engine) for engine in (False, True))
        assert plain.collided.any()
        assert [fused.trace_hash(b) for b in range(20)] == [plain.trace_hash(b) for b in range(20)]
    length, gaps = nearest(loop, rival, keys)
    trace = rollout(loop, rival, keys, plain=True)
    assert np.array_equal(length, trace.length) and np.isinf(gaps["rear_gap"]).all()
    assert np.array_equal(gaps["gap"], np.where(trace.live[..., None], trace.gap, np.inf).min(axis=(0, 2)))


ENVIRONMENTS = [
    {"scenario": "platoon-braking-v0", "defence": "dkf", "autoreset": "next_step"},
    {"scenario": "platoon-gusty-v0", "defence": "dkf", "autoreset": "same_step", "action": "ramp", "reward": "stealth", "frames": 3,
     "threat": {"budget": 50, "cooldown": 3, "duration": 9}},
    {"scenario": "platoon-heavy-v0", "defence": "dkf", "action": "continuous", "reward": "final", "interval": 7, "knowledge": "grey",
     "threat": {"sees_measurement": True, "targets": WIRES, "agents": [1, 3]}},
    {"scenario": "platoon-noisy-v0", "defence": "dkf", "autoreset": "same_step", "action": "increment", "reward": "error",
     "attack_cost": 0.1, "illegal_penalty": 0.2, "threat": {"agents": [2, 4]}},
    {"scenario": "platoon-braking-known-v0", "defence": "dkf", "action": "timing", "kind": "dos_jam", "reward": "collision"},
    {"scenario": "platoon-20-v0", "defence": "dkf", "per_sensor": True, "per_agent": True, "autoreset": "same_step"},
    {"scenario": "platoon-braking-v0", "defence": "lasso_dkf", "autoreset": "same_step", "reward": "peak"},
    {"scenario": "platoon-gusty-v0", "defence": "saturated_dkf:eta=2", "autoreset": "next_step", "action": "continuous", "reward": "stealth",
     "threat": {"kinds": ["fdi"], "targets": ["distance", "velocity"]}},
    {"scenario": "platoon-noisy-v0", "defence": "norm_resilient", "interval": 2},
    {"scenario": "platoon-gusty-v0", "defence": "none", "autoreset": "same_step", "interval": 4, "action": "increment"},
    {"scenario": "platoon-gusty-v0", "defence": "kf", "autoreset": "same_step", "threat": {"kinds": ["fdi", "dos_hold"]}, "value": -40.0},
    {"scenario": "platoon-bidirectional-v0", "defence": "consensus_kf", "interval": 7, "threat": {"kinds": ["fdi", "dos_hold"]}, "value": -40.0},
    {"scenario": "platoon-lossy-v0", "defence": "lasso_dkf", "autoreset": "same_step", "threat": {"sees_measurement": True}},
    {"scenario": "platoon-bidirectional-v0", "defence": "dkf", "interval": 3, "per_agent": True, "value": -20.0,
     "threat": {"agents": [0, 1, 4], "sees_measurement": True}},
]  # fmt: skip


@pytest.mark.parametrize("rows", [1, 70])
@pytest.mark.parametrize("arguments", ENVIRONMENTS, ids=lambda a: f"{a['scenario']}-{a['defence']}")
def test_an_environment_is_the_plain_one_to_the_last_bit(arguments, rows, tmp_path):
    """Observations, rewards, flags and information, over restarts, a masked reset and what was held."""
    as_plain(arguments, rows, tmp_path)


def test_threads_and_blocks_change_no_bit():
    """4200 episodes in one thread and in two, and one of them apart."""
    loop, _ = loop_of("platoon-gusty-v0", "dkf", "none", horizon=3, onset=1, agents=(1, 2))
    in_any_thread(Platoon, loop)


def test_what_is_not_finite_is_refused_as_in_the_plain_loop():
    """A measurement of 1e308 makes the estimate infinite."""
    loop, _ = loop_of("platoon-gusty-v0", "dkf", "none", onset=1, beyond={"fdi_bound": 1.7e308})
    lanes = Platoon(loop, fuse(loop), draws.keys("report", range(3)))
    lanes.start()
    command = loop.brief.command(np.ones(3, bool), 5, loop.brief.granted, 1.7e308)
    with pytest.raises(InputError, match="defence output x: got 'NaN or infinity'"):
        for _ in range(5):
            lanes.advance(command)


def test_a_command_beyond_what_is_granted_is_refused():
    """At another car, of another value: as in the plain loop, and alone as beside a legal target."""
    loop, _ = loop_of("platoon-gusty-v0", "dkf", "none", onset=1)
    keys, wires = draws.keys("report", range(4)), len(loop.model.wires)
    command = loop.brief.command(np.ones(4, bool), 5, np.zeros((5, wires), bool), 0.0)
    command.target[0, 2, 0] = command.target[1, 2, 0] = command.target[1, 4, 0] = command.target[2, 3, 1] = command.target[3, 2, 0] = True
    command.value[3, 2, 0] = 61.0
    lanes, state = Platoon(loop, fuse(loop), keys), loop.start(keys)
    lanes.start()
    for _ in range(2):
        lanes.advance(command)
        state, frame = loop.advance(state, command)
        view, seen = lanes.view(), loop.sense(state)
        assert frame.refused.tolist() == [False, True, True, True]
        assert np.array_equal(view.last.kind, seen.last.kind) and np.array_equal(view.last.target, seen.last.target)
        assert np.array_equal(view.scene.gap, seen.scene.gap)


@pytest.mark.parametrize(("scenario", "defence"), [("platoon-gusty-v0", "dkf"), ("platoon-lossy-v0", "none")])
def test_what_an_attacker_sees_is_what_the_plain_loop_shows(scenario, defence):
    """Every part of a view, under random commands at several cars, with a grey box and the measurement."""
    granted = {"knowledge": "grey", "sees_measurement": True, "budget": 20, "cooldown": 2, "duration": 3, "onset": 2}
    loop, _ = loop_of(scenario, defence, "none", **(ANY | granted))
    keys, rng, shape = draws.keys("report", range(70)), np.random.default_rng(1), loop.brief.granted.shape
    lanes, state = Platoon(loop, fuse(loop), keys), loop.start(keys)
    lanes.start()
    for _ in range(40):
        for one, two in zip(leaves(lanes.view()).items(), leaves(loop.sense(state)).items(), strict=True):
            assert one[0] == two[0] and one[1].dtype == two[1].dtype, one[0]
            assert np.array_equal(one[1], two[1]), one[0]
        kind = rng.integers(1, 6, 70)
        target = loop.brief.granted & (rng.random((70, *shape)) < 0.4)
        command = loop.brief.command(rng.random(70) < 0.7, kind, target, rng.uniform(-70.0, 70.0, (70, *shape)))
        lanes.advance(command)
        state, _ = loop.advance(state, command)


@pytest.mark.parametrize("action", ["mode", "continuous"])
def test_a_single_environment_is_a_batch_of_one(action):
    """The short way through a single environment gives the results and types of the long one."""
    one, two = (
        AdversaryEnv(engine=engine, scenario="platoon-gusty-v0", defence="lasso_dkf", action=action, value=-30.0) for engine in ("fused", "plain")
    )  # fmt: skip
    assert [env.batch.engine for env in (one, two)] == ["fused", "plain"]
    rng, over = np.random.default_rng(3), False
    same(*(env.reset(seed=5)[0] for env in (one, two)))
    while not over:
        chosen = int(rng.integers(0, one.batch.seat.action.size)) if action == "mode" else rng.uniform(-1, 1, one.batch.seat.action.size)
        first, second = one.step(chosen), two.step(chosen)
        same(first[0], second[0])
        assert [type(value) for value in first] == [type(value) for value in second] and first[1:4] == second[1:4]
        assert all(np.array_equal(value, second[4][key]) for key, value in first[4].items())
        over = first[2] or first[3]


@pytest.mark.parametrize(("scenario", "defence", "threat", "why"), [
    ("platoon-lossy-v0", "kf", {"kinds": ["fdi"]}, "what is missed"), ("platoon-braking-v0", "dkf:gain=varying", {}, "covariances"),
    ("platoon-gusty-v0", "kf", {}, "what is missed"), ("platoon-20-v0", "consensus_kf", {"kinds": ["fdi"]}, "so many gains"),
    ("platoon-gusty-v0", "consensus_kf:share=true", {"kinds": ["fdi"]}, "shared"),
    ("platoon-braking-v0", "lasso_dkf:solver=cvxpy", {}, "not the exact one"), ("platoon-braking-v0", "centralised_kf", {}, "no lane"),
    ("platoon-braking-v0", "chi2_dkf", {}, "no lane"), ("platoon-braking-v0", "dkf", {"knowledge": "white"}, "white-box"),
    ("platoon-v2v-v0", "dkf", {}, "delay, replay"), ("thesis-ch6-v0", "dkf", {}, "no lane"),
    ("platoon-braking-v0", "composed:filter=dkf,detector=score,mitigation=accept_all,mitigation.mode=brake", {}, "mitigation AcceptAll"),
])  # fmt: skip
def test_what_has_no_lane_is_played_by_the_plain_loop(scenario, defence, threat, why):
    """And says why."""
    pytest.importorskip("cvxpy") if "cvxpy" in defence else None
    guard = Spec("defence", defence)
    found = fuse(load_scenario(scenario).with_threat(**threat).loop(guard.make(), guard.entry.uses))
    assert isinstance(found, Refused) and why in found.why, found


def test_late_readings_and_a_look_ahead_have_no_lane():
    """And the white-box script against many."""
    guard = Spec("defence", "dkf")
    late = dataclasses.replace(load_scenario("platoon-gusty-v0").loop(guard.make(), guard.entry.uses), link=Link(latency=2))
    assert isinstance(found := fuse(late), Refused) and "late" in found.why
    place, guard = load_scenario("platoon-gusty-v0").with_threat(knowledge="white", kinds=("fdi",)), Spec("defence", "dkf")
    found = fuse(place.loop(guard.make()), Spec("attack", "stealth").make())
    assert isinstance(found, Refused) and "stealth" in found.why


def test_a_single_car_needs_no_module_of_platoons():
    """And a platoon compiles nothing of a single car's."""
    import subprocess
    import sys

    code = """
import sys
from tailgate import make_defence
from tailgate.scenario import load_scenario
from tailgate.fused import Constants, fuse
assert isinstance(fuse(load_scenario("stop-and-go-v0").loop(make_defence("kf"))), Constants)
print([name for name in sys.modules if name.startswith("tailgate.fused.platoon_") and name != "tailgate.fused.platoon_rows"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr
