"""A car with a radar in the fused engine, against the plain loop: the same bits over whole episodes."""

import numpy as np
import pytest

from tailgate import draws
from tailgate.fused import Constants, Refused, fuse
from tailgate.fused.lanes import Lanes
from tailgate.registry import Spec
from tailgate.scenario import load_scenario
from tailgate.trace import nearest, rollout

from .fused import as_plain, loop_of

# Every filter, detector, mitigation and kind at least once, over the air and on the wires, and a jammer that leaves nothing to read.
ANY = {
    "kinds": ("noise_jam", "echo_delay", "fdi", "dos_jam", "dos_hold", "dos_hold_fresh", "dropout"), "delay_bound": 60.0,
    "jam_power": 100.0, "budget": None, "onset": 5,
}  # fmt: skip
DRIVEN = ANY | {"targets": ("distance", "relative_speed", "acceleration")}
ONE = ANY | {"targets": ("distance",)}
CELLS = [
    ("radar-following-v0", "kf", "none", {}),
    ("radar-following-v0", "none", "noise_jam:start_step=30,power=50", ANY),
    ("radar-braking-v0", "chi2_kf:gain=steady", "echo_delay:trigger=leader_braking,threshold=2,delay=15", {}),
    ("radar-heavy-v0", "rkf", "echo_pull_off:trigger=leader_braking,threshold=0.3,rate=6,hop=true", ANY),
    ("radar-heavy-v0", "windowed_chi2_kf", "dos_jam:start_step=40,low=10,high=100,burst=3,pause=4", ANY),
    ("thesis-ch3-v0", "cusum_kf", "echo_delay:start_step=60,delay=6", {}),
    ("thesis-ch3-switched-v0", "mewma_kf", "noise_jam:start_step=60", {}),
    ("thesis-ch3-v0", "kf", "radar_jam:start_step=51", {}),
    ("radar-following-v0", "reacquire_kf:after=3", "noise_jam:start_step=30,power=100,chance=0.7", ANY),
    ("radar-following-v0", "reacquire_kf:after=2", "echo_delay:trigger=near,threshold=60,delay=60,burst=5,pause=5", ANY),
    ("radar-following-v0", "cusum_reacquire_kf", "dos_hold:start_step=50,length=40", ANY),
    ("radar-following-v0", "cusum_reacquire_kf", "dos_hold:start_step=50,fresh=true,targets=[distance]", ANY),
    ("radar-following-v0", "widen_kf", "dropout:start_step=20,probability=0.6", ANY),
    ("radar-following-v0", "brake_kf", "fdi_ramp:start_step=30,rate=0.5,targets=[distance]", ANY),
    ("radar-following-v0", "chi2_kf_sparse", "fdi_gaussian:start_step=20,sd=8,chance=0.5", DRIVEN),
    ("radar-following-v0", "oracle", "fdi_bernoulli:start_step=20,value=9", ANY),
    ("radar-following-v0", "coast", "none", {}),
    ("radar-following-v0", "always_brake", "fdi_uniform:start_step=20", ANY),
    ("radar-following-v0", "always_alarm", "fdi_then_jam:start_step=20,inject=5,value=8", ANY),
    ("radar-following-v0", "rkf:unit=sensor", "actuator_fdi:start_step=20,value=1.0", DRIVEN),
    ("radar-following-v0", "composed:detector=chi2,mitigation=latch", "noise_jam:start_step=20,targets=[distance],power=60", ONE),
    ("radar-following-v0", "chi2_kf", "dos_jam:start_step=20,low=0,high=100", ONE),
    ("radar-following-v0", "cra", "noise_jam:start_step=60", {}),
    ("radar-following-v0", "cra", "dos_jam:start_step=20,low=5,high=100,burst=9,pause=9", ANY),
    ("radar-following-v0", "cra:challenge=fixed,times=[15,50,175]", "echo_delay:trigger=near,threshold=60,delay=60", ANY),
    ("radar-heavy-v0", "cra:probability=0.3,quiet=5,mode=brake", "echo_delay:trigger=near,threshold=60,delay=60,hop=true", ANY),
    ("thesis-ch3-v0", "cra:suspicion=20,watch=none", "noise_jam:start_step=60", {}),
    ("thesis-ch3-switched-v0", "cra:margin=1", "radar_jam:start_step=51", {}),
    ("radar-fast-attacker-v0", "cra", "noise_jam:start_step=60,power=0.1", {}),
    ("radar-braking-v0", "cra:rollback=false,freeze=false", "dropout:start_step=20,probability=0.6", ANY),
    ("radar-braking-v0", "cra:passes=false", "fdi_gaussian:start_step=20,sd=8,chance=0.5", DRIVEN),
    ("radar-following-v0", "cra:filter.window=5,filter.forgetting=0.9,filter.threshold=4", "echo_pull_off:start_step=40,rate=2", ANY),
    ("radar-following-v0", "pycra", "echo_delay:trigger=near,threshold=60,delay=60", ANY),
    ("radar-following-v0", "pycra:challenge=fixed,filter.threshold=none", "dos_hold:start_step=30", ANY),
    ("radar-following-v0", "imm", "noise_jam:start_step=30,power=50", ANY),
    ("radar-braking-v0", "imm:factors=[1,30,10000],threshold=1", "echo_delay:trigger=near,threshold=60,delay=60", ANY),
    ("radar-following-v0", "algorithm2:times=[20,40,60,80,100]", "noise_jam:start_step=30,power=50", ANY),
    ("thesis-ch3-v0", "algorithm2:delta=100", "radar_jam:start_step=51", {}),
    ("radar-braking-v0", "algorithm2:challenge=random,probability=0.3,quiet=3,mode=widen,suspicion=15", "dropout:probability=0.6", ANY),
]


@pytest.mark.parametrize(("scenario", "defence", "attack", "threat"), CELLS)
def test_a_trace_is_the_plain_loops_to_the_last_bit(scenario, defence, attack, threat):
    """Episodes in two blocks, one of them not full: every signal's hash, and the lengths."""
    loop, rival = loop_of(scenario, defence, attack, **threat)
    assert isinstance(fuse(loop, rival), Constants)
    keys = draws.keys("report", range(67))
    fused, plain = rollout(loop, rival, keys), rollout(loop, rival, keys, plain=True)
    assert np.array_equal(fused.length, plain.length)
    assert [fused.trace_hash(b) for b in range(67)] == [plain.trace_hash(b) for b in range(67)]
    assert {name: column.dtype for name, column in fused.signals.items()} == {name: column.dtype for name, column in plain.signals.items()}
    assert all(np.array_equal(fused.first[name], plain.first[name]) for name in plain.first)


ENVIRONMENTS = [
    {"scenario": "radar-following-v0", "defence": "chi2_kf", "autoreset": "next_step", "delay": 60.0},
    {"scenario": "radar-braking-v0", "defence": "reacquire_kf", "autoreset": "same_step", "action": "ramp", "reward": "stealth", "frames": 3,
     "threat": {"budget": 50, "cooldown": 3, "duration": 9, "jam_power": 60.0}, "power": 60.0},
    {"scenario": "thesis-ch3-v0", "defence": "rkf", "action": "mode", "reward": "final", "interval": 3, "knowledge": "grey", "value": 100.0,
     "threat": {"sees_measurement": True, "targets": ["distance", "acceleration"]}},
    {"scenario": "radar-heavy-v0", "defence": "cusum_kf", "autoreset": "same_step", "action": "ramp", "reward": "error", "value": 5.0,
     "threat": {"kinds": ["fdi", "echo_delay", "dropout"]}, "attack_cost": 0.1, "illegal_penalty": 0.2, "per_sensor": True},
    {"scenario": "radar-following-v0", "defence": "none", "action": "increment", "reward": "collision", "autoreset": "next_step",
     "threat": {"kinds": ["fdi"], "targets": ["distance", "acceleration"]}},
    {"scenario": "radar-following-v0", "defence": "cra", "autoreset": "same_step", "delay": 60.0, "shares": [0.04, 0.14, 1.0], "knowledge": "grey",
     "threat": {"budget": None, "sees_measurement": True}},
    {"scenario": "radar-braking-v0", "defence": "pycra:suspicion=20", "autoreset": "next_step", "action": "ramp", "interval": 2},
    {"scenario": "radar-following-v0", "defence": "kf", "action": "timing", "kind": "echo_delay", "autoreset": "same_step"},
]  # fmt: skip


@pytest.mark.parametrize("arguments", ENVIRONMENTS, ids=lambda a: f"{a['scenario']}-{a['defence']}")
def test_an_environment_is_the_plain_one_to_the_last_bit(arguments, tmp_path):
    """Observations, rewards, flags and information, over restarts and a masked reset, in several blocks."""
    as_plain(arguments, 70, tmp_path)


def test_the_smallest_gaps_are_those_of_the_trace():
    """Without a trace, in front and behind."""
    loop, rival = loop_of("radar-following-v0", "cra", "echo_delay:trigger=near,threshold=60,delay=60", horizon=240)
    keys = draws.keys("report", range(67))
    length, gaps = nearest(loop, rival, keys)
    trace = rollout(loop, rival, keys, plain=True)
    assert np.array_equal(length, trace.length) and (length < 240).any()
    for name in ("gap", "rear_gap"):
        least = np.where(trace.live, trace.signals[name][..., 0], np.inf).min(axis=0)
        assert np.array_equal(gaps[name], least)


def test_threads_and_blocks_change_no_bit():
    """4200 episodes in one thread, in two, and apart."""
    loop, _ = loop_of("radar-following-v0", "chi2_kf", "none", horizon=3)
    constants, keys = fuse(loop), draws.keys("report", range(4200))
    command = loop.brief.command(np.ones(4200, bool), 8, np.array([True, True, False]), 0.1)
    held = []
    for threads in (1, 2):
        lanes = Lanes(loop, constants, keys, threads=threads)
        lanes.start()
        for _ in range(3):
            lanes.advance(command)
        held.append(lanes.rows.copy())
    assert np.array_equal(*held)


@pytest.mark.parametrize(("scenario", "defence", "threat", "why"), [
    ("radar-following-v0", "imm:factors=[1,2,3,4,5]", {}, "more than 4 models"), ("radar-following-v0", "kf", {"kinds": ["noise_jam", "replay"]}, "delay and replay"),
    ("radar-following-v0", "kf", {"knowledge": "white"}, "white-box"), ("radar-following-v0", "composed:mitigation=hold", {}, "mitigation Hold"),
    ("radar-following-v0", "cra:filter=hold_last", {}, "filter HoldLast"),
    ("highway-v0", "kf", {}, "no lane"),
])  # fmt: skip
def test_what_has_no_lane_is_played_by_the_plain_loop(scenario, defence, threat, why):
    """And says why."""
    pytest.importorskip("highway_env") if scenario == "highway-v0" else None
    guard = Spec("defence", defence)
    found = fuse(load_scenario(scenario).with_threat(**threat).loop(guard.make(), guard.entry.uses))
    assert isinstance(found, Refused) and why in found.why


def test_a_signal_that_is_simulated_and_a_look_ahead_have_no_lane():
    """The sensor's other path, and the white-box script."""
    import dataclasses

    place, guard = load_scenario("radar-following-v0"), Spec("defence", "kf")
    found = fuse(dataclasses.replace(place, sensor=dataclasses.replace(place.sensor, path="signal")).loop(guard.make()))
    assert isinstance(found, Refused) and "simulated" in found.why
    found = fuse(place.with_threat(knowledge="white", kinds=("fdi",)).loop(guard.make()), Spec("attack", "stealth").make())
    assert isinstance(found, Refused) and "stealth" in found.why
