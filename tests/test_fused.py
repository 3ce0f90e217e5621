"""The fused engine against the plain loop: the same bits, lane by lane and over a covering set of pairs, over whole episodes."""

import dataclasses
import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from tailgate import draws
from tailgate.envs.faces import AdversaryEnv, AdversaryVectorEnv
from tailgate.errors import InputError
from tailgate.fused import Constants, Refused, compiled, fuse, script
from tailgate.fused.lanes import Lanes
from tailgate.fused.memory import SCRIPTED
from tailgate.fused.rows import ROWS, STATE
from tailgate.registry import Spec
from tailgate.scenario import load_scenario
from tailgate.trace import rollout

from .fused import as_plain, loop_of, same, short

# Every filter, detector, mitigation, manoeuvre, kind, law and trigger at least once.
CELLS = [
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


@pytest.mark.parametrize(("scenario", "defence", "attack"), CELLS + STEALTH)
def test_a_trace_is_the_plain_loops_to_the_last_bit(scenario, defence, attack):
    """Episodes in two blocks, one of them not full: every signal's hash, and the lengths."""
    loop, rival = loop_of(scenario, defence, attack)
    assert isinstance(fuse(loop, rival), Constants)
    keys = draws.keys("report", range(67))
    fused, plain = rollout(loop, rival, keys), rollout(loop, rival, keys, plain=True)
    assert np.array_equal(fused.length, plain.length)
    assert [fused.trace_hash(b) for b in range(67)] == [plain.trace_hash(b) for b in range(67)]
    assert {name: column.dtype for name, column in fused.signals.items()} == {name: column.dtype for name, column in plain.signals.items()}


def test_a_run_to_the_horizon_goes_on_after_a_collision():
    """Without an end at a collision the attack goes on as well, to the last bit."""
    loop, rival = loop_of("gusty-stop-and-go-v0", "chi2_kf", "fdi:trigger=near,threshold=30,value=-4", horizon=600)
    keys = draws.keys("report", range(20))
    fused, plain = (rollout(loop, rival, keys, terminate=False, plain=engine) for engine in (False, True))
    crashed = (plain.collided | plain.rear_collided)[:450].any(axis=0)
    assert (plain.kind[450:500, crashed] != 0).any()
    assert [fused.trace_hash(b) for b in range(20)] == [plain.trace_hash(b) for b in range(20)]


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
]  # fmt: skip


@pytest.mark.parametrize("arguments", ENVIRONMENTS, ids=lambda a: f"{a['scenario']}-{a['defence']}")
def test_an_environment_is_the_plain_one_to_the_last_bit(arguments, tmp_path):
    """Observations, rewards, flags and information, over restarts, a masked reset and what was held."""
    as_plain(arguments, 5, tmp_path)


def test_a_masked_reset_leaves_rows_that_wait_for_their_next_episode_alone(tmp_path):
    """All rows are over at the horizon; the one that is reset begins, the others do so at their next step."""
    text = tmp_path / "short.yaml"
    text.write_text(short("stop-and-go-v0"))
    seen = []
    for engine in ("fused", "plain"):
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


@pytest.mark.parametrize("action", ["mode", "continuous"])
def test_a_single_environment_is_a_batch_of_one(action):
    """The short way through a single environment gives the results, types and errors of the long one."""
    one, two = (AdversaryEnv(engine=engine, action=action, threat={"budget": 30}) for engine in ("fused", "plain"))
    assert [env.batch.engine for env in (one, two)] == ["fused", "plain"]
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


def test_threads_and_blocks_change_no_bit():
    """4200 episodes in one thread, in two, and apart."""
    loop, _ = loop_of("stop-and-go-v0", "chi2_kf", "none", horizon=3)
    constants, keys = fuse(loop), draws.keys("report", range(4200))
    held = []
    for threads in (1, 2):
        lanes = Lanes(loop, constants, keys, threads=threads)
        assert lanes.threads == threads
        lanes.start()
        for _ in range(3):
            lanes.advance(loop.brief.command(np.zeros(4200, bool), 0, np.zeros(5, bool), 0.0))
        held.append(lanes.rows.copy())
    assert np.array_equal(*held)
    alone = Lanes(loop, constants, draws.keys("report", [4111]))
    alone.start()
    for _ in range(3):
        alone.advance(loop.brief.command(np.zeros(1, bool), 0, np.zeros(5, bool), 0.0))
    block, lane = divmod(4111, 64)
    assert np.array_equal(held[0][block].reshape(STATE, 64)[:, lane], alone.rows[0].reshape(ROWS, 64)[:STATE, 0])


@pytest.mark.parametrize(("scenario", "defence", "threat", "why"), [
    ("platoon-braking-v0", "trust_dkf", {}, "no lane"), ("car-following-lossy-v0", "kf", {}, "lost or late"),
    ("stop-and-go-v0", "kf", {"knowledge": "white"}, "white-box"), ("stop-and-go-v0", "kf", {"kinds": ["delay"]}, "delay"),
    ("stop-and-go-v0", "kf", {"hold_from_onset": True}, "held from the onset"),
    ("stop-and-go-v0", "steered", {}, "no lane"), ("stop-and-go-v0", "imm:factors=[1,2,3,4,5]", {}, "more than 4 models"),
])  # fmt: skip
def test_what_has_no_lane_is_played_by_the_plain_loop(scenario, defence, threat, why):
    """And says why."""
    guard = Spec("defence", defence)
    found = fuse(load_scenario(scenario).with_threat(**threat).loop(guard.make(), guard.entry.uses))
    assert isinstance(found, Refused) and why in found.why
    with pytest.raises(InputError, match="engine: got 'fused'"):
        AdversaryVectorEnv(1, scenario=scenario, defence=defence, threat=threat, engine="fused")
    with pytest.raises(InputError, match="engine"):
        AdversaryVectorEnv(1, engine="quick")


def test_somebody_elses_filter_of_the_same_base_is_not_taken_for_it():
    """A subclass may mean something else: only the exact types have lanes."""
    from tailgate.estimators.chi_square import ChiSquare
    from tailgate.estimators.compose import AcceptAll, compose
    from tailgate.estimators.kalman import KalmanFilter

    class Mine(KalmanFilter):
        pass

    loop = load_scenario("stop-and-go-v0").loop(compose(Mine(), ChiSquare(), AcceptAll()))
    assert isinstance(fuse(loop), Refused)
    assert isinstance(fuse(load_scenario("stop-and-go-v0").loop(compose(KalmanFilter(), ChiSquare(), AcceptAll()))), Constants)


def test_what_is_not_finite_is_refused_as_in_the_plain_loop():
    """A measurement of 1e308 makes the estimate infinite."""
    loop, _ = loop_of("stop-and-go-v0", "kf", "none", onset=1, beyond={"fdi_bound": 1.7e308})
    lanes = Lanes(loop, fuse(loop), draws.keys("report", range(3)))
    lanes.start()
    command = loop.brief.command(np.ones(3, bool), 5, np.array([True, True, False, False, False]), 1.7e308)
    with pytest.raises(InputError, match="defence output x: got 'NaN or infinity'"):
        for _ in range(5):
            lanes.advance(command)


def test_kept_code_is_of_these_sources(monkeypatch, tmp_path):
    """The key on disk changes with a formula in another file."""
    before = compiled.digest()
    for package in compiled._SOURCES:
        (tmp_path / package).mkdir()
        for path in compiled.files(package).iterdir():
            if path.name.endswith(".py"):
                (tmp_path / package / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(compiled, "files", lambda package: tmp_path / package)
    compiled.digest.cache_clear()
    assert compiled.digest() == before
    (tmp_path / "tailgate.envs" / "vehicle.py").write_text("x = 1\n")
    compiled.digest.cache_clear()
    assert compiled.digest() != before
    compiled.digest.cache_clear()


def test_a_part_is_called_by_compiled_code_alone():
    """It has no machine code of its own; Python is told so."""
    from tailgate.fused import kernel

    with pytest.raises(TypeError, match="bad argument"):
        kernel.living(np.zeros(ROWS * 64), np.uint64(64))


@pytest.mark.long
def test_another_version_of_numba_compiles_it_in_its_own_way(tmp_path):
    """Without what is known of this version's inner workings the code is made anew, and plays the same."""
    code = """
import numba
numba.__version__ = "99.0"
from tailgate import draws, make_attack, make_defence
from tailgate.scenario import load_scenario
from tailgate.trace import rollout
loop = load_scenario("stop-and-go-v0").loop(make_defence("chi2_kf"))
one, two = (rollout(loop, make_attack("none"), draws.keys("train", [3]), plain=plain).trace_hash(0) for plain in (False, True))
from tailgate.fused import compiled
assert one == two and not compiled._inside()
"""
    done = subprocess.run([sys.executable, "-c", code], env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_code_is_linked_into_a_process_with_gigabytes_in_it():
    """Small holes in the address space, and nothing else near them: code and data have to be placed together all the same."""
    code = """
import mmap
import numba
from tailgate import draws, make_attack, make_defence
from tailgate.scenario import load_scenario
from tailgate.trace import rollout
holes = [mmap.mmap(-1, 2 * mmap.PAGESIZE) for _ in range(400)]
far = mmap.mmap(-1, 3 << 30)
for hole in holes[::2]:
    hole.close()
loop = load_scenario("stop-and-go-v0").loop(make_defence("chi2_kf"))
one, two = (rollout(loop, make_attack("none"), draws.keys("train", [3]), plain=plain).trace_hash(0) for plain in (False, True))
assert one == two
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_phases_are_vectorised():
    """Packed against single multiplications in what is compiled of the filter's update and of the vehicle's move: a guard, and not a time."""
    import re

    import numba

    from tailgate.fused import kalman, road

    @numba.njit(error_model="numpy")
    def both(s, g, intent, c, f, n):
        kalman.update(s, f, n)
        road.move(s, g, intent, c, f, np.uint64(0), 0, n)

    floats, words = np.zeros(ROWS * 64), np.zeros(4 * 64, np.uint64)
    constants = fuse(load_scenario("stop-and-go-v0").loop(Spec("defence", "kf").make()))
    both(floats, words, np.zeros(640), constants.c, constants.f, np.uint64(64))
    (code,) = both.inspect_asm().values()
    packed, single = len(re.findall(r"\bv?f?n?m?[a-z]*mul[a-z0-9]*pd\b", code)), len(re.findall(r"\bv?mulsd\b", code))
    if not re.search(r"\bv?mul[sp]d\b", code):
        pytest.skip("not an x86 processor")
    assert packed > 0.7 * single and packed > 60


def test_a_calm_road_does_not_slow_down():
    """Without noise, and after the filter has settled, no number is so small that the processor takes its slow path."""
    import time

    place = load_scenario("thesis-ch4-v0")
    data = {"process_var": (0.0, 0.0, 0.0)}
    plant, sensor = dataclasses.replace(place.plant, **data), dataclasses.replace(place.sensor, noise_var=(1e-6, 1e-6))
    loop = dataclasses.replace(place, plant=plant, sensor=sensor, horizon=30_000).loop(Spec("defence", "mewma_kf").make())
    lanes = Lanes(loop, fuse(loop), draws.keys("report", range(64)))
    lanes.memory.script[:] = script.numbers(Spec("attack", "none").make(), None)
    lanes.start()
    took = []
    for _ in range(10):
        started = time.process_time()
        lanes.run(SCRIPTED, 1000)
        took.append(time.process_time() - started)
    assert min(took[5:]) < 3.0 * min(took[:5])


def _kernel_is_kept():
    from tailgate.fused import kernel

    assert kernel.run.entry
    return any((folder / kernel.run._file).is_file() for folder in compiled._folders())


def test_an_environment_starts_without_numba_and_scipy_where_the_code_is_kept():
    """Their import takes longer than all the rest; nor are modules of estimators imported that nobody asked for."""
    if not _kernel_is_kept():
        pytest.skip("no folder to keep machine code in")
    code = """
import sys
import gymnasium
env = gymnasium.make("tailgate:tailgate/CarFollowing-v0")
env.reset(seed=0)
env.step(0)
print([name for name in ("numba", "scipy", "torch", "tailgate.estimators.lasso", "tailgate.envs.radar") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def test_broken_machine_code_counts_as_none(monkeypatch, tmp_path):
    """Half a file, somebody else's, and code that calls what this process does not have: compiled anew, and no crash."""
    from tailgate.fused import kernel

    held = compiled.Kernel(kernel.run.py_func)
    monkeypatch.setattr(compiled, "_folders", lambda: iter([tmp_path]))
    assert held._loaded is None
    for content in (b"", b"junk", b"symbol\njunk", b"symbol digest\njunk", f"symbol {hashlib.blake2b(b'junk').hexdigest()}\njunk".encode()):
        (tmp_path / held._file).write_bytes(content)
        assert held._loaded is None
    if _kernel_is_kept():
        monkeypatch.undo()
        (path, *_) = [path for folder in compiled._folders() if (path := folder / held._file).is_file()]
        head, _, code = path.read_bytes().partition(b"\n")
        monkeypatch.setattr(compiled, "_folders", lambda: iter([tmp_path]))
        for content in (head + b"\n" + code[:-1], b"another_" + head + b"\n" + code):
            (tmp_path / held._file).write_bytes(content)
            assert held._loaded is None


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
