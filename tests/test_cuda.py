"""The device cuda, with this processor in place of a card: environments, rows, trainings, memory, the code's cache, and what is refused."""

import copy
import pickle
import sys
import threading
from typing import Any

import gymnasium
import numpy as np
import pytest

import tailgate  # noqa: F401 - registers the environments
from tailgate.base.errors import InputError
from tailgate.cli import main
from tailgate.core.scenario import load_suite
from tailgate.engine import cards, on_device
from tailgate.engine.cards import DeviceError, playing_on
from tailgate.engine.tracing import traced
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.batches import side_by_side
from tailgate.envs.gym.gymnasium_env import AdversaryEnv, AdversaryVectorEnv
from tailgate.evaluation.cells import evaluate
from tailgate.trust.run import check

from . import fake_cuda
from .card import HostCard, forget, host_card, needs_compiler
from .engines import same

__all__ = ["host_card"]
FOLLOWING = {"scenario": "gusty-stop-and-go-v0", "defence": "chi2_kf"}
PART = {"scenarios": ["gusty-stop-and-go-v0"], "defences": ["chi2_kf"], "attacks": ["none", "fdi_ramp:start_step=20,rate=0.3"], "seeds": 3}


@pytest.fixture
def nvidia(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A machine with a card: install(**of the driver) returns its driver and its compiler."""

    def install(version: tuple[int, int] = (13, 0), size: int = 1 << 33, **driver: Any) -> Any:
        card = HostCard(size)
        made = fake_cuda.Driver(card, **driver), fake_cuda.Compiler(card, version)
        fake_cuda.install(monkeypatch, *made)
        forget(monkeypatch)
        monkeypatch.setattr(cards, "_found", cards._nvidia)
        cards.card.cache_clear()
        return made

    yield install
    cards.card.cache_clear()


def without_device(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    assert all(row["device"] == "cuda" for row in rows)
    return [{key: value for key, value in row.items() if key != "device"} for row in rows]


# -- the same episodes


@needs_compiler
def test_make_vec_through_the_bindings(nvidia: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every call of NVIDIA's driver and compiler, another thread, and a copy in mid-episode."""
    monkeypatch.setenv("TAILGATE_CACHE", str(tmp_path))
    driver, compiler = nvidia()
    one = gymnasium.make_vec("tailgate:tailgate/CarFollowing-v0", num_envs=40, device="cuda", **FOLLOWING)
    two = gymnasium.make_vec("tailgate:tailgate/CarFollowing-v0", num_envs=40, **FOLLOWING)
    assert (one.unwrapped.device, one.unwrapped.engine, two.unwrapped.device) == ("cuda", "traced", "cpu")
    assert b"--fmad=false" in compiler.options and b"--gpu-architecture=sm_90" in compiler.options
    same(one.reset(seed=5)[0], two.reset(seed=5)[0])
    chance = np.random.default_rng(0)
    for turn in range(12):
        actions = chance.integers(0, 2, 40)
        got: list[Any] = []
        if turn == 5:
            driver.current = None  # as in a thread that has no context yet

            def other() -> None:
                cards.card().stream = 7
                got.append(one.step(actions))  # noqa: B023

            thread = threading.Thread(target=other)
            thread.start()
            thread.join()
        elif turn == 8:
            held = pickle.loads(pickle.dumps(one.unwrapped))
            same(held.step(actions)[0], copy.deepcopy(one.unwrapped).step(actions)[0])
            got.append(one.step(actions))
        else:
            got.append(one.step(actions))
        for first, second in zip(got[0], two.step(actions), strict=True):
            same(*(value if isinstance(value, dict) else np.asarray(value) for value in (first, second)))
    assert driver.streams == {0, 7} and cards.card().stream == 0, "a stream is a thread's own"


@needs_compiler
def test_rows_are_those_of_the_processor(host_card: HostCard, tmp_path: Any, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = evaluate("quick-v0", **PART)
    rows = evaluate("quick-v0", device="cuda", **PART)
    assert without_device(rows) == wanted and {row["status"] for row in rows} == {"ok"} and host_card.launches > 0
    words = ["--scenario", "gusty-stop-and-go-v0", "--defence", "chi2_kf", "--attack", "none", "--seeds", "3", "--json"]
    tables = []
    for device in ("cpu", "cuda"):
        assert main(["evaluate", *words, "--device", device]) == 0
        tables.append(capsys.readouterr().out)
    assert tables[0] == tables[1] and cards.device() == "cpu"


@needs_compiler
def test_trust(host_card: HostCard) -> None:
    suite = load_suite("quick-v0")
    part = suite.__class__(**{**suite.__dict__, "scenarios": ("gusty-stop-and-go-v0",), "defences": ("chi2_kf",), "attacks": ("none",), "doses": (None,)})
    wanted = check(part, runs=4)
    with playing_on("cuda"):
        found = check(part, runs=4)
    assert host_card.launches > 0
    for cell in found["cells"]:
        cell.pop("device", None)
    assert found == wanted


LEARNERS = {"cem": "cem={population: 4, episodes: 2, elite: 0.5}", "ppo": "ppo={envs: 8, rollout: 16, batch_size: 64, epochs: 1}"}


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize("learner", LEARNERS)
def test_a_training_ends_in_the_same_policy(learner: str, host_card: HostCard, tmp_path: Any) -> None:
    from tailgate.training.train import load_config, train

    if learner != "cem":
        pytest.importorskip("stable_baselines3")
    made = {}
    for device in ("cpu", "cuda"):
        words = [f"out={tmp_path / device}", "name=one", f"learner={learner}", "steps=1500", LEARNERS[learner], "seeds=1", "tensorboard=false"]
        before = host_card.launches
        (path,) = train(load_config("gusty", [*words, f"device={device}"]), lambda seed, now: None)
        assert (host_card.launches > before) == (device == "cuda")
        made[device] = path.with_suffix(".safetensors").read_bytes() if path.with_suffix(".safetensors").exists() else path.read_bytes()
    assert made["cpu"] == made["cuda"]


@needs_compiler
def test_a_demand_that_fails(host_card: HostCard) -> None:
    """The card says what the processor says."""
    from tailgate.num import demand

    def step(held: dict[str, Any], _: Any) -> Any:
        x = held["x"] * 2.0
        demand(x < 50.0, "x", "a large number", "less than 50", held["k"])
        return {"x": x, "k": held["k"] + 1}, {"x": x}

    trace = traced(step, {"x": np.ones(1), "k": np.zeros(1, np.int64)}, {})
    program = on_device.CudaProgram(trace)
    rows = program.rows(35)
    rows.put({"x": np.where(np.arange(35) == 33, 7.0, 1.0), "k": np.zeros(35, np.int64)})
    call = program.call(rows)
    broken = []
    for _ in range(4):
        results = call()
        broken.append(call.broken)
        assert results["demands"].all() != call.broken
    assert broken == [False, False, True, True]
    assert "row 33" in str(program.broken(results["demands"], np.arange(35)))


@pytest.mark.long
@needs_compiler
def test_pictures(host_card: HostCard) -> None:
    pytest.importorskip("PIL")
    one = AdversaryVectorEnv(2, device="cuda", render_mode="rgb_array", **FOLLOWING)
    two = AdversaryVectorEnv(2, render_mode="rgb_array", **FOLLOWING)
    pictures = []
    for env in (one, two):
        env.reset(seed=1)
        for _ in range(3):
            env.step(np.ones(2, np.int64))
        pictures.append(env.render())
    assert pictures[0] is not None and pictures[1] is not None and np.array_equal(pictures[0], pictures[1])


# -- memory and the cache


@needs_compiler
def test_memory_is_given_back(host_card: HostCard) -> None:
    seat = Seat.make(**FOLLOWING)
    for _ in range(2):
        env = AdversaryVectorEnv(64, device="cuda", **FOLLOWING)
        env.reset(seed=0)
        env.step(np.zeros(64, np.int64))
        used = host_card.size - host_card.free()
        assert used > 64 * seat.memory / 4
        del env
        assert host_card.free() == host_card.size


@needs_compiler
def test_out_of_memory_says_how_many_rows_fit(host_card: HostCard) -> None:
    host_card.size = 2_000_000
    with pytest.raises(DeviceError, match=r"num_envs: got 100000; expected at most ([\d,]+) rows") as refused:
        AdversaryVectorEnv(100_000, device="cuda", **FOLLOWING)
    fit = int(refused.value.expected.split()[2].replace(",", ""))
    env = AdversaryVectorEnv(fit // 32 * 32, device="cuda", **FOLLOWING)
    env.reset(seed=0)
    del env
    with pytest.raises(DeviceError, match=r"batch: got 2000; expected at most [\d,]+ rows"), playing_on("cuda"):
        evaluate("quick-v0", **(PART | {"seeds": 2000}), batch=2000)


@needs_compiler
def test_code_is_compiled_once(nvidia: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The key is the graph, the card's capability, and the versions of the compiler and of the translation."""
    monkeypatch.setenv("TAILGATE_CACHE", str(tmp_path))

    def compiled(times: float = 2.0, **machine: Any) -> int:
        _, compiler = nvidia(**machine)
        made = on_device.CudaProgram(traced(lambda held, _: ({"x": times * held["x"]}, {}), {"x": np.ones(1)}, {}))
        assert compiler.compiled == 0  # nobody has asked for a kernel
        rows = made.rows(2)
        rows.put({"x": np.ones(2)})
        made.call(rows)()
        return int(compiler.compiled)

    assert compiled() == 1 and compiled() == 0 and compiled(times=3.0) == 1
    assert compiled(capability=(8, 0)) == 1 and compiled(version=(13, 1)) == 1 and compiled() == 0
    monkeypatch.setattr(on_device, "VERSION", "other")
    assert compiled() == 1


@needs_compiler
def test_the_bound_on_registers(host_card: HostCard, monkeypatch: pytest.MonkeyPatch) -> None:
    from tailgate.envs.gym.programs import SeatPrograms

    seat = Seat.make(**FOLLOWING)
    monkeypatch.setenv("TAILGATE_CUDA_BLOCKS", "3")
    assert SeatPrograms(seat, device="cuda").decide.text.count("__launch_bounds__(128, 3)") == 2
    monkeypatch.setenv("TAILGATE_CUDA_BLOCKS", "many")
    with pytest.raises(InputError, match="TAILGATE_CUDA_BLOCKS: got 'many'"):
        SeatPrograms(seat, device="cuda")


def test_an_error_of_the_compiler_has_its_log_and_its_program_is_freed(nvidia: Any) -> None:
    nvidia()
    with pytest.raises(RuntimeError, match=r"compiler: .*line 1: bad"):
        cards.card().compiled("error")
    from cuda.bindings import nvrtc

    assert (nvrtc.compiled, nvrtc.held) == (1, 0)


# -- what is refused


def test_no_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cards, "_found", cards._nvidia)
    monkeypatch.setitem(sys.modules, "cuda", None)
    monkeypatch.delitem(sys.modules, "tailgate.engine.nvidia", raising=False)
    cards.card.cache_clear()
    with pytest.raises(DeviceError, match=r"pip install 'tailgate\[cuda\]'"):
        AdversaryVectorEnv(4, device="cuda", **FOLLOWING)


@pytest.mark.parametrize(
    "machine, why",
    [
        ({"begin": fake_cuda.Code.CUDA_ERROR_NO_DEVICE}, "no NVIDIA card"),
        ({"begin": fake_cuda.Code.CUDA_ERROR_SYSTEM_DRIVER_MISMATCH}, "a driver that starts: CUDA_ERROR_SYSTEM_DRIVER_MISMATCH"),
        ({"version": (14, 0)}, r"a driver of CUDA 14 or later; this one is of CUDA 13\.1: update it"),
        ({"capability": (6, 1)}, r"compute capability 7\.5 to 10\.0; Fake 100 has 6\.1"),
        ({"capability": (12, 0)}, r"Fake 100 has 12\.0"),
    ],
)
def test_machines_that_cannot_play(nvidia: Any, machine: dict[str, Any], why: str, capsys: pytest.CaptureFixture[str]) -> None:
    nvidia(**machine)
    with pytest.raises(DeviceError, match=why):
        evaluate("quick-v0", device="cuda", **PART)
    nvidia(**machine)
    assert main(["evaluate", "--suite", "quick-v0", "--seeds", "2", "--device", "cuda"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_no_driver(nvidia: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    driver, _ = nvidia()

    def missing(flags: int) -> None:
        raise RuntimeError("libcuda.so.1 is not there\nmore")

    monkeypatch.setattr(driver, "cuInit", missing)
    with pytest.raises(DeviceError, match=r"NVIDIA's driver: libcuda\.so\.1 is not there$"):
        cards.card()


@needs_compiler
def test_what_a_card_does_not_play(host_card: HostCard, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="device: got 'gpu'"):
        AdversaryVectorEnv(4, device="gpu", **FOLLOWING)
    with pytest.raises(InputError, match="make_vec"):
        AdversaryEnv(device="cuda", **FOLLOWING)
    with pytest.raises(InputError, match="engine: got 'plain'"):
        AdversaryVectorEnv(4, device="cuda", engine="plain", **FOLLOWING)
    with pytest.raises(InputError, match="workers: got 2"):
        evaluate("quick-v0", device="cuda", workers=2, **PART)
    played: list[Any] = []
    monkeypatch.setattr("tailgate.evaluation.cells.run_cell", played.append)
    with pytest.raises(DeviceError, match="cpu for filterpy_kf"):  # before the other cells are played
        evaluate("quick-v0", device="cuda", out=tmp_path / "rows.jsonl", **(PART | {"defences": ["chi2_kf", "filterpy_kf"]}))
    with pytest.raises(DeviceError, match=r"device: got 'cuda'; expected cpu: .*FilterpyKalman is not traced"):
        AdversaryVectorEnv(4, device="cuda", scenario="gusty-stop-and-go-v0", defence="filterpy_kf")
    assert not played and not (tmp_path / "rows.jsonl").exists()
    with playing_on("cuda"):
        assert side_by_side(Seat.make(**FOLLOWING)).device == "cuda"
        assert gymnasium.make("tailgate:tailgate/CarFollowing-v0", **FOLLOWING).unwrapped.batch.device == "cpu"
