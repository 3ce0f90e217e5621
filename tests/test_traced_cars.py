"""One car that follows another, by wheel sensors or radar: the traced engine plays it as the plain loop does, to the last bit."""

import dataclasses
import subprocess
import sys
import time

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.gymnasium_env import AdversaryEnv, AdversaryVectorEnv
from tailgate.play.commanded import Steps, commanded
from tailgate.play.trace import rollout

from .engines import as_plain, loop_of, same, short, told, trace_as_plain

# Every filter, detector, mitigation, manoeuvre, kind, law and trigger at least once.
CARS = [
    ("stop-and-go-v0", "chi2_kf", "none"),
    ("gusty-stop-and-go-v0", "kf", "fdi:trigger=near,threshold=30,value=-4"),
    ("gusty-stop-and-go-v0", "windowed_chi2_kf", "fdi_gaussian:trigger=near,threshold=40,sd=4"),
    ("gusty-stop-and-go-v0", "windowed_chi2_kf:window=1", "dos_jam:trigger=near,threshold=40"),
    ("stop-and-go-v0", "cusum_kf:latch=4", "fdi_bernoulli:trigger=near,threshold=40,value=-4"),
    ("gusty-stop-and-go-v0", "mewma_kf", "fdi_ramp:trigger=near,threshold=40,rate=-0.5"),
    ("gusty-stop-and-go-v0", "reacquire_kf", "dropout:trigger=closing,threshold=2,probability=0.5"),
    ("gusty-stop-and-go-v0", "reacquire_kf:after=3", "dos_jam:start_step=60"),
    ("braking-v0", "rkf", "dos_jam:trigger=leader_braking,threshold=2,burst=5,pause=7"),
    ("braking-v0", "rkf:unit=sensor", "fdi:start_step=100,value=6,signs=3"),
    ("stop-and-go-v0", "cusum_reacquire_kf", "fdi_then_jam:trigger=near,threshold=35,inject=15"),
    ("car-following-heavy-v0", "brake_kf", "dos_hold:trigger=slow,threshold=5,chance=0.5"),
    ("ornstein-uhlenbeck-v0", "widen_kf", "fdi_uniform:start_step=100,length=50"),
    ("thesis-ch4-v0", "chi2_kf:gain=steady", "dos_hold:fresh=true"),
    ("ch7-v0", "coast", "fdi:trigger=speed,threshold=10"),
    ("gusty-stop-and-go-v0", "always_brake", "program:path=burst_jamming"),
    ("gusty-stop-and-go-v0", "oracle", "fdi_bernoulli:start_step=60,value=-9"),
    ("gusty-stop-and-go-v0", "none", "dropout:start_step=60,probability=0.5"),
    ("gusty-stop-and-go-v0", "chi2_kf_sparse", "fdi:start_step=60,targets=[position],value=-8"),
    ("stop-and-go-v0", "chi2_kf_sparse:eta=4", "fdi_bernoulli:start_step=60,value=-6"),
    ("car-following-noisy-v0", "always_alarm", "fdi_sparse:start_step=70"),
    ("thesis-ch4-v0", "composed:detector=chi2,mitigation=latch", "thesis_times"),
    ("gusty-stop-and-go-v0", "imm", "dropout:trigger=near,threshold=40,probability=0.5"),
    ("stop-and-go-v0", "imm:factors=[1,30,10000],threshold=1", "fdi_bernoulli:trigger=near,threshold=40,value=-4"),
    ("braking-v0", "imm:factors=[2]", "dos_jam:start_step=60"),
    ("gusty-stop-and-go-v0", "safe_state_brake", "fdi_bernoulli:trigger=near,threshold=40,value=-4"),
    ("stop-and-go-v0", "safe_state_brake:when=always,distance=20,lag=0.5,watch=3", "dropout:trigger=near,threshold=40,probability=0.7"),
    ("car-following-heavy-v0", "safe_state:accuracy=[1,0.5],recover=0.3", "fdi_gaussian:trigger=near,threshold=40,sd=4"),
    ("braking-v0", "safe_state_brake:filter=rkf,adds_up=worst", "fdi:start_step=60,value=3"),
    ("stop-and-go-v0", "envelope", "fdi_bernoulli:trigger=near,threshold=40,value=-4"),
    ("car-following-lossy-v0", "envelope:window=1,count=1,mitigation=hold", "dropout:trigger=near,threshold=40,probability=0.5"),
    ("redundant-two-v0", "envelope:path=redundant,window=9,count=2,filter=rkf,mitigation=reacquire", "fdi:start_step=60,value=20"),
]
# The white-box script against each detector's gate, and aimed at one reading or at both.
STEALTH = [
    ("gusty-stop-and-go-v0", "chi2_kf", "stealth:trigger=near,threshold=40"),
    ("gusty-stop-and-go-v0", "kf", "stealth:start_step=50,state_index=2"),
    ("gusty-stop-and-go-v0", "windowed_chi2_kf", "stealth:start_step=30,targets=[position]"),
    ("stop-and-go-v0", "windowed_chi2_kf:window=1", "stealth:start_step=30,targets=[velocity],state_index=1,sign=1"),
    ("stop-and-go-v0", "cusum_reacquire_kf", "stealth:trigger=near,threshold=40,burst=4,pause=3"),
    ("gusty-stop-and-go-v0", "mewma_kf", "stealth:trigger=near,threshold=40,chance=0.7"),
    ("gusty-stop-and-go-v0", "composed:detector=mewma,detector.exact=false", "stealth:start_step=60"),
    ("braking-v0", "rkf", "stealth:start_step=60"),
    ("gusty-stop-and-go-v0", "chi2_kf_sparse", "stealth:start_step=60,gate=25"),
    ("thesis-ch4-v0", "chi2_kf:gain=steady", "stealth"),
    ("car-following-noisy-v0", "always_alarm", "stealth:start_step=70"),
]
# Every filter, detector, mitigation and kind at least once, over the air and on the wires, and a jammer that leaves nothing to read.
ANY = {
    "kinds": ("noise_jam", "echo_delay", "fdi", "dos_jam", "dos_hold", "dos_hold_fresh", "dropout"), "delay_bound": 60.0,
    "jam_power": 100.0, "budget": None, "onset": 5,
}  # fmt: skip
DRIVEN = ANY | {"targets": ("distance", "relative_speed", "acceleration")}
ONE = ANY | {"targets": ("distance",)}
RADARS = [
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


@pytest.mark.thin(33)
@pytest.mark.parametrize(("scenario", "defence", "attack", "threat"), [(*cell, {}) for cell in CARS + STEALTH] + RADARS)
def test_a_trace_is_the_plain_loops_to_the_last_bit(scenario, defence, attack, threat):
    trace_as_plain(*loop_of(scenario, defence, attack, **threat))


@pytest.mark.long
def test_a_run_to_the_horizon_goes_on_after_a_collision():
    """Without an end at a collision the attack goes on as well, to the last bit."""
    loop, rival = loop_of("gusty-stop-and-go-v0", "chi2_kf", "fdi:trigger=near,threshold=30,value=-4", horizon=600)
    keys = draws.keys("report", range(20))
    fast, plain = told(loop, rival, keys, terminate=False), rollout(loop, rival, keys, terminate=False, plain=True)
    crashed = (plain.collided | plain.rear_collided)[:450].any(axis=0)
    assert (plain.kind[450:500, crashed] != 0).any()
    assert [fast.trace_hash(b) for b in range(20)] == [plain.trace_hash(b) for b in range(20)]


ENVIRONMENTS = [
    {"scenario": "stop-and-go-v0", "defence": "chi2_kf", "autoreset": "next_step"},
    {"scenario": "gusty-stop-and-go-v0", "defence": "reacquire_kf", "autoreset": "same_step", "action": "ramp", "reward": "stealth", "frames": 3,
     "threat": {"budget": 50, "cooldown": 3, "duration": 9}},
    {"scenario": "braking-v0", "defence": "rkf", "action": "continuous", "reward": "final", "interval": 7, "knowledge": "grey",
     "threat": {"sees_measurement": True, "targets": ["position", "leader_position", "acceleration"]}},
    {"scenario": "ch7-v0", "defence": "windowed_chi2_kf", "autoreset": "same_step", "action": "increment", "reward": "error",
     "attack_cost": 0.1, "illegal_penalty": 0.2},
    {"scenario": "car-following-heavy-v0", "defence": "brake_kf", "action": "timing", "kind": "dos_jam", "reward": "collision"},
    {"scenario": "stop-and-go-v0", "defence": "imm", "autoreset": "same_step", "reward": "peak"},
    {"scenario": "gusty-stop-and-go-v0", "defence": "safe_state_brake", "autoreset": "next_step", "action": "continuous",
     "threat": {"targets": ["position", "leader_position", "leader_velocity"]}},
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


@pytest.mark.thin(18)
@pytest.mark.parametrize("arguments", ENVIRONMENTS, ids=lambda a: f"{a['scenario']}-{a['defence']}")
def test_an_environment_is_the_plain_one_to_the_last_bit(arguments, tmp_path):
    """Observations, rewards, flags and information, over restarts, a masked reset and what was held."""
    as_plain(arguments, 9, tmp_path)


def test_a_masked_reset_leaves_rows_that_wait_for_their_next_episode_alone(tmp_path):
    """All rows are over at the horizon; the one that is reset begins, the others do so at their next step."""
    text = tmp_path / "short.yaml"
    text.write_text(short("stop-and-go-v0"))
    seen = []
    for engine in ("traced", "plain"):
        env = AdversaryVectorEnv(6, engine=engine, scenario=str(text), defence="kf", autoreset="next_step")
        env.reset(seed=3)
        for _ in range(60):
            *_, over, _ = env.step(np.zeros(6, np.int64))
        assert over.all()
        env.reset(seed=[8, *[None] * 5], options={"reset_mask": np.arange(6) == 0})
        observed, *_, info = env.step(np.zeros(6, np.int64))
        assert info["step"].tolist() == [2, 1, 1, 1, 1, 1]
        seen.append(observed)
    same(*seen)


@pytest.mark.thin(4)
@pytest.mark.parametrize("action", ["mode", "continuous"])
def test_a_single_environment_is_a_batch_of_one(action):
    """The short way through a single environment gives the results, types and errors of the long one."""
    one, two = (AdversaryEnv(engine=engine, action=action, threat={"budget": 30}) for engine in ("traced", "plain"))
    assert [env.batch.engine for env in (one, two)] == ["traced", "plain"]
    rng, over, chosen = np.random.default_rng(3), False, None
    same(*(env.reset(seed=5)[0] for env in (one, two)))
    for _ in range(700):
        if over:
            for env in (one, two):
                with pytest.raises(InputError, match="step: got"):
                    env.step(chosen)
            same(*(env.reset()[0] for env in (one, two)))
            break
        chosen = int(rng.integers(0, 4)) if action == "mode" else rng.uniform(-1, 1, one.batch.seat.action.size).astype(np.float32)
        first, second = one.step(chosen), two.step(chosen)
        same(first[0], second[0])
        assert [type(value) for value in first] == [type(value) for value in second] and first[1:4] == second[1:4]
        assert {k: type(v) for k, v in first[4].items()} == {k: type(v) for k, v in second[4].items()}
        assert all(np.array_equal(value, second[4][key]) for key, value in first[4].items())
        over = first[2] or first[3]
    assert over
    with pytest.raises(InputError, match="actions: got"):
        one.step(99 if action == "mode" else np.full(3, np.nan, np.float32))


def test_what_is_not_finite_is_refused_as_in_the_plain_loop():
    """A measurement of 1e308 makes the score infinite."""
    loop, _ = loop_of("stop-and-go-v0", "kf", "none", onset=1, beyond={"fdi_bound": 1.7e308})
    command = loop.brief.command(np.ones(3, bool), 5, np.array([True, True, False, False, False]), 1.7e308)
    state, said = loop.start(draws.keys("report", range(3))), []
    steps = Steps(commanded(loop), state)
    for play in (lambda: steps.play(command), lambda: loop.advance(state, command)):
        with pytest.raises(InputError, match="defence output score: got 'NaN or infinity in step 1") as caught:
            play()
        said.append(str(caught.value))
    assert said[0] == said[1]


@pytest.mark.long
def test_a_calm_road_does_not_slow_down():
    """Without noise, and after the filter has settled, no number is so small that the processor takes its slow path."""
    place = load_scenario("thesis-ch4-v0")
    data = {"process_var": (0.0, 0.0, 0.0)}
    plant, sensor = dataclasses.replace(place.plant, **data), dataclasses.replace(place.sensor, noise_var=(1e-6, 1e-6))
    loop = dataclasses.replace(place, plant=plant, sensor=sensor, horizon=30_000).loop(Spec("defence", "mewma_kf").make())
    steps, nothing = Steps(commanded(loop), loop.start(draws.keys("report", range(64)))), loop.brief.command(np.zeros(64, bool), 0, np.zeros(5, bool), 0.0)
    took = []
    for _ in range(10):
        started = time.process_time()
        for _ in range(400):
            steps.play(nothing)
        took.append(time.process_time() - started)
    assert min(took[5:]) < 3.0 * min(took[:5])


def test_an_environment_starts_without_scipy_and_torch():
    """Their import takes longer than all the rest; nor are modules of estimators imported that nobody asked for."""
    code = """
import sys
import gymnasium
env = gymnasium.make("tailgate:tailgate/CarFollowing-v0")
env.reset(seed=0)
env.step(0)
print([name for name in ("scipy", "torch", "tailgate.estimators.distributed.lasso", "tailgate.envs.sensors.fmcw_radar") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def test_what_an_environment_returned_stays_as_it_is():
    """Arrays of a step belong to who asked for it: no later step or reset writes into them."""
    for env in (AdversaryEnv(), AdversaryVectorEnv(3), AdversaryVectorEnv(3, autoreset="same_step")):
        single, held = isinstance(env, AdversaryEnv), []
        for t in range(30):
            if t in (0, 7, 8, 19):
                seen, info = env.reset(seed=t if t != 8 else None)
                arrays = [seen, *info.values()]
            else:
                seen, reward, *ends, info = env.step(1 if single else np.ones(3, np.int64))
                arrays = [seen, reward, *ends, *info.values()]
            arrays = [x for x in arrays if isinstance(x, np.ndarray)]
            held.append((arrays, [x.copy() for x in arrays]))
        for arrays, copies in held:
            for x, y in zip(arrays, copies, strict=True):
                np.testing.assert_array_equal(x, y)
