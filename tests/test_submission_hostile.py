"""A hostile submission costs its own rows or gains nothing: the others are played, the reason names it, nothing is left running."""

import os
import re
import shutil
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from tailgate.core.scenario import Suite
from tailgate.evaluation.cells import Cell, run_cell
from tailgate.evaluation.rounds import seeds_of
from tailgate.evaluation.rows import read_rows
from tailgate.sandbox import Limits, play_mixed, play_submission
from tailgate.sandbox.mixed import Submission
from tailgate.sandbox.sandbox import sandbox_of
from tailgate.sandbox.source import staged

LIMITS = Limits(memory=2 * 2**30, start_time=30.0, silence=3.0, output=2**16, file_size=2**20, processes=4)
BOUND = 60.0  # [s] for everything of one test, on a machine that does other things beside
SCENARIO = """
plant: {{name: car_following, dt: {dt}, process_var: [1.0e-4, 4.0e-4, 2.5e-3]}}
sensor: {{name: odometry, noise_var: [1.0, 1.0]}}
controller: {{name: acc}}
manoeuvre: {{name: stop_and_go}}
horizon: 20
threat_model: {{kinds: [fdi], fdi_bound: 50.0, onset: 5}}
"""
HOSTILE = '''
import ctypes, os, signal, subprocess, sys, time
from dataclasses import dataclass
import numpy as np
from tailgate.core import Estimate, Mode
from tailgate.core.draws import Draws, Role, keys
from tailgate.estimators import Kalman

class Big(int):
    pass

@dataclass(frozen=True)
class Hostile(Kalman):
    """Misbehaves in the sixth step, where a step is 0.05 s."""

    how: str = "none"

    def prepare(self, model):
        return model, super().prepare(model)

    def start(self, plan, prior):
        return super().start(plan[1], prior)

    def step(self, plan, state, received, known_u, draws):
        model, inner = plan
        kept = received.y.copy()
        if model.dt < 0.08 and draws.step.max() == 6:
            out = getattr(self, self.how)(model, inner, state, received, known_u, draws)
            if out is not None:
                return out
        assert (received.y == kept).all()
        return super().step(inner, state, received, known_u, draws)

    def estimate(self, inner, state, received, known_u, draws, **changes):
        state, estimate = super().step(inner, state, received, known_u, draws)
        return state, estimate._replace(**{k: f(getattr(estimate, k)) for k, f in changes.items()})

    def loop(self, model, *rest):
        while True:
            pass

    def sleep(self, model, *rest):
        time.sleep(1e6)

    def allocate(self, model, *rest):
        np.ones(100 * 2**30 // 8)

    def share(self, model, *rest):
        import mmap
        held = np.frombuffer(mmap.mmap(-1, 3 * 2**29), np.uint8)
        held[:] = 1
        time.sleep(1e6)

    def fail(self, model, *rest):
        raise ZeroDivisionError("on purpose")

    def hole(self, model, inner, state, received, known_u, draws):
        off = received.y[:, 0, 0] > 40.0  # those rows only to which something large was added
        def spoil(x):
            x = x.copy()
            x[off] = np.nan
            return x
        return self.estimate(inner, state, received, known_u, draws, x=spoil)

    def shape(self, model, *rest):
        return self.estimate(*rest, x=lambda x: x[:-1])

    def objects(self, model, *rest):
        return self.estimate(*rest, mode=lambda m: np.array([[Big(0)]] * len(m), object))

    def number(self, model, *rest):
        return self.estimate(*rest, score=lambda s: Big(3))

    def outside(self, model, *rest):
        return self.estimate(*rest, mode=lambda m: np.full(m.shape, 256, np.int64))

    def write(self, model, inner, state, received, *rest):
        for array in (received.y, received.valid, rest[0], rest[1].key):
            try:
                array.flags.writeable = True
                array[...] = 0
            except ValueError:
                continue
            raise AssertionError("an input could be written")
        received.y[...] = 0.0

    def scribble(self, model, inner, state, received, known_u, draws):
        folder = sys.argv[1]
        for name in ("in", "out"):
            with open(folder + "/" + name, "r+b") as file:
                file.write(bytes(4096))
            os.truncate(folder + "/" + name, 0)

    def chatter(self, model, *rest):
        while True:
            sys.stdout.write("x" * 65536)

    def leave(self, model, *rest):
        print("goodbye", flush=True)
        os._exit(3)

    def kill(self, model, *rest):
        os.kill(os.getpid(), signal.SIGSEGV)

    def fork(self, model, *rest):
        for _ in range(2):
            if os.fork() == 0:
                time.sleep(1e6)
        os._exit(0)

    def bomb(self, model, *rest):
        end = time.monotonic() + 30.0
        while time.monotonic() < end:
            if os.fork() == 0:
                time.sleep(1e6)
            time.sleep(0.01)

    def escape(self, model, *rest):
        subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1e6)"], start_new_session=True, stdin=0, stdout=2)
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                os.closerange(0, 256)
                time.sleep(1e6)
            os._exit(0)

    def answer(self, model, *rest):
        for fd in range(3, 64):
            try:
                os.write(fd, b'{"id": 9, "ok": {"a": 1}}\\\\n' * 3)
            except OSError:
                pass

    def fill(self, model, *rest):
        with open("large", "wb") as file:
            file.write(bytes(2**22))

    def flood(self, model, *rest):
        for i in range(64):
            with open(f"small{i}", "wb") as file:
                file.write(bytes(2**16))

class Median(Kalman):
    """Takes the batch's median away: a common attack would be gone."""

    def step(self, plan, state, received, known_u, draws):
        common = np.median(received.y - received.y[:1], axis=0)
        return super().step(plan, state, received._replace(y=received.y - 1e-3 * common), known_u, draws)

class Seeker(Kalman):
    """Tries public seeds until one explains the first sample, and takes that seed's noise away."""

    def prepare(self, model):
        return model, super().prepare(model)

    def start(self, plan, prior):
        self.__dict__["world"] = None
        self.__dict__["mean"] = prior.mean
        return super().start(plan[1], prior)

    def step(self, plan, state, received, known_u, draws):
        model, inner = plan
        noise = lambda key: Draws(key, draws.episode, draws.step, int(Role.SENSOR)).normal((1, 2))
        if self.__dict__["world"] is None:
            x = (model.A * self.mean).sum(axis=-1) + (model.B * known_u).sum(axis=-1)
            tries = [keys("report", [s] * len(x)).key[:, 0] for s in range(64)]
            off = [np.abs(received.y - noise(key) - x[:, None, :2]).max(axis=(1, 2)) for key in tries]
            best = np.argmin(off, axis=0)
            self.__dict__["found"] = np.min(off, axis=0) < 0.1
            self.__dict__["world"] = np.array([tries[b][i] for i, b in enumerate(best)])
        state, estimate = super().step(inner, state, received, known_u, draws)
        exact = estimate.x.copy()
        exact[..., :2] = received.y - noise(self.world)
        return state, estimate._replace(x=np.where(self.found[:, None, None], exact, estimate.x))
'''


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two scenarios that differ in their step, and the hostile module on the path."""
    for name, dt in (("good", 0.1), ("bad", 0.05)):
        (tmp_path / f"{name}.yaml").write_text(SCENARIO.format(dt=dt), encoding="utf-8")
    (tmp_path / "hostile.py").write_text(HOSTILE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def _left(world: Path) -> set[int]:
    """Every process that was started for a submission of this test: their scratch directory is their home, or their sandbox has its files."""
    signs = (("environ", f"HOME={world}/tailgate-scratch-"), ("mountinfo", f"{world}/tailgate-"), ("cmdline", f"{world}/tailgate-"))
    found = set()
    for name in filter(str.isdigit, os.listdir("/proc")):
        for file, sign in signs:
            with suppress(OSError):
                found |= {int(name)} if sign.encode() in Path(f"/proc/{name}/{file}").read_bytes() else set()
    return found


def _cells(world: Path, scenario: str, attacks: tuple[str, ...], seeds: int) -> list[Cell]:
    return [Cell("hostile", str(world / f"{scenario}.yaml"), 10, "hostile", attack, seeds) for attack in attacks]


def _play(
    world: Path, text: str, scenario: str, attacks: tuple[str, ...], seeds: int = 3, limits: Limits = LIMITS, played: list[int] | None = None,
    sandbox: str = "",
) -> list[dict[str, Any]]:  # fmt: skip
    with staged(text) as source:
        submission = Submission(source, {"uses": ("measurements",), "version": 1, "reference": ""}, limits, sandbox_of(sandbox))
        return play_mixed(_cells(world, scenario, attacks, seeds), submission, played)


FDI = "fdi:start_step=6,value=50"


def _hostile(world: Path, how: str, *, others: bool, sandbox: str = "", **limits: Any) -> list[dict[str, Any]]:
    """The rows of the scenario in which it is hostile, checked for everything that has to hold whatever it does."""
    began = time.monotonic()
    text, kept = f"hostile:Hostile:how={how}", Limits(**{**LIMITS.__dict__, **limits})
    rows = _play(world, text, "bad", ("none", FDI), limits=kept, sandbox=sandbox)
    assert len(rows) == 6
    assert not _left(world), "something is left running"
    assert not list(world.glob("tailgate-*"))
    if others:
        (other,) = _play(world, text, "good", ("none",), seeds=1, sandbox=sandbox)
        assert other["status"] == "ok", other["reason"]
    assert time.monotonic() - began < BOUND
    return rows


@pytest.mark.thin(5)
@pytest.mark.parametrize(
    ("how", "reason", "limits"),
    [
        ("loop", "silence: no answer for 1 s", {"silence": 1.0}),
        ("allocate", "MemoryError: Unable to allocate 100. GiB", {}),
        ("fail", "ZeroDivisionError: on purpose", {}),
        ("shape", "InputError: defence output x: got 'float64 (5, 1, 3)'; expected an array of shape (6, 1, 3), kind 'f'", {}),
        ("objects", "InputError: defence output mode: got 'object (6, 1)'; expected an array", {}),
        ("write", "ValueError: assignment destination is read-only", {}),
        ("chatter", "output: more than 65536 bytes printed; printed last: xxx", {}),
        ("leave", "the process ended with exit code 3; printed last: goodbye", {}),
        ("fork", "the process ended with exit code 0", {}),
    ],
)
def test_what_ends_a_process_costs_its_scenario_and_no_other(world: Path, how: str, reason: str, limits: dict[str, Any]) -> None:
    """Each of these ends the scenario's batch with a reason that names it; the other scenario is played."""
    rows = _hostile(world, how, others=True, **limits)
    assert {(row["status"], row["reason"][: len(reason)]) for row in rows} == {("error", reason)}


@pytest.mark.thin(5)
@pytest.mark.parametrize(
    ("how", "reason", "limits"),
    [
        ("loop", "processor time: ", {"silence": 60.0, "start_time": 2.0, "step_time": 1e-6}),
        ("sleep", "silence: no answer for 1 s", {"silence": 1.0}),
        ("share", "memory: ", {"silence": 30.0, "memory": 2**30}),
        ("number", "InputError: defence output score: got 'Big'; expected an array", {}),
        ("outside", "InputError: defence output mode: got [127]; expected one of", {}),
        ("scribble", "the process was killed by signal 7", {}),
        ("kill", "the process was killed by signal 11", {}),
        ("bomb", "processes: ", {"silence": 20.0}),
        ("answer", "answer: ", {}),
        ("fill", "OSError: [Errno 27] File too large", {}),
    ],
)
def test_the_other_ways_out_are_closed_too(world: Path, how: str, reason: str, limits: dict[str, Any]) -> None:
    """Processor time, shared memory, wrong numbers of the right type, forged answers and large files end the batch, and say so."""
    rows = _hostile(world, how, others=False, **limits)
    assert {(row["status"], row["reason"][: len(reason)]) for row in rows} == {("error", reason)}


def test_a_nan_costs_the_cell_whose_rows_have_it(world: Path) -> None:
    """Of one batch: the attacked rows are lost, the clean ones beside them are played."""
    rows = _hostile(world, "hole", others=True)
    assert [row["status"] for row in rows] == ["ok"] * 3 + ["error"] * 3
    reason = r"InputError: defence output x: got 'NaN or infinity in step \d+, in \d of 3 rows, the first of them row \d'; expected finite numbers"
    assert re.fullmatch(reason, rows[-1]["reason"])


def test_processes_that_change_their_session_are_dead_afterwards(world: Path) -> None:
    """A child in a session of its own, and a daemon of it: the rows are good, and nobody is left."""
    rows = _hostile(world, "escape", others=True)
    assert {row["status"] for row in rows} == {"ok"}


@pytest.mark.thin(7)
@pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")
@pytest.mark.parametrize(
    ("how", "reason", "limits"),
    [
        ("allocate", "MemoryError: Unable to allocate 100. GiB", {}), ("escape", "", {}), ("bomb", "processes: ", {"silence": 20.0}),
        ("fill", "OSError: [Errno 27] File too large", {}), ("flood", "OSError: [Errno 28] No space left on device", {}),
        ("leave", "the process ended with exit code 3; printed last: goodbye", {}), ("loop", "silence: no answer for 3 s", {}),
    ],
)  # fmt: skip
def test_in_a_sandbox_it_ends_in_the_same_way(world: Path, how: str, reason: str, limits: dict[str, Any]) -> None:
    """Strangers' code is played in bubblewrap: limits, guard and reasons hold there too, many small files fill the scratch directory alone."""
    rows = _hostile(world, how, others=True, sandbox="bwrap", **limits)
    assert {(row["status"], row["reason"][: len(reason)]) for row in rows} == {("error" if reason else "ok", reason)}
    assert {row["submission"]["sandbox"] for row in rows} == {"bwrap"}


def test_a_loop_at_import_costs_all_rows_in_bounded_time(world: Path, tmp_path: Path) -> None:
    """Every row has the reason; the time is that of one start, whatever the number of scenarios."""
    (world / "stuck.py").write_text("while True:\n    pass\n", encoding="utf-8")
    began = time.monotonic()
    suite = Suite("small", "", (str(world / "good.yaml"), str(world / "bad.yaml")), (10,), (), ("none",), 2)
    rows = play_submission("stuck:Nothing", suite, limits=Limits(start_time=2.0), out=tmp_path / "rows.jsonl")
    assert [(row["status"], row["reason"][:16]) for row in rows] == [("error", "processor time: ")] * 4
    assert read_rows(tmp_path / "rows.jsonl") == rows
    assert not _left(world) and time.monotonic() - began < BOUND


@pytest.mark.long
def test_a_search_for_public_seeds_gains_nothing_on_seeds_from_a_beacon(world: Path) -> None:
    """The fifteen lines know a public episode's noise to the last bit; without the seed they are no better than the filter under them."""

    def errors(text: str, seeds: list[int] | None) -> list[float]:
        rows = _play(world, text, "good", ("none",), seeds=4, played=seeds)
        assert {row["status"] for row in rows} == {"ok"}
        return [row["rmse_position"] for row in rows]

    secret = seeds_of("4f0c1de2a9b85d73", "d" * 64, "report", 4)
    assert max(errors("hostile:Seeker", None)) < 1e-9
    cells = [Cell("hostile", str(world / "good.yaml"), 10, "tailgate.estimators:Kalman", "none", 1, first_seed=seed) for seed in secret]
    filtered = [run_cell(cell)[0]["rmse_position"] for cell in cells]
    assert all(a >= b > 0.05 for a, b in zip(errors("hostile:Seeker", secret), filtered, strict=True))


@pytest.mark.long
def test_a_median_over_the_batch_is_found_out(world: Path) -> None:
    """Rows that depend on their companions become errors, all of them."""
    rows = _play(world, "hostile:Median", "good", ("none", FDI))
    assert {row["status"] for row in rows} == {"error"}
    assert {row["reason"] for row in rows} == {"batch dependent: 3 of 3 rows differ among other companions, 0 of them in a decision"}


def _docker() -> bool:
    """Whether an engine answers and has the image."""
    with suppress(OSError, subprocess.TimeoutExpired):
        return subprocess.run(["docker", "image", "inspect", "tailgate"], capture_output=True, check=False, timeout=10).returncode == 0
    return False


@pytest.mark.skipif(not _docker(), reason="there is no docker with an image `tailgate` (docs/submissions.md)")
@pytest.mark.parametrize("how", ["allocate", "leave"])
def test_a_container_plays_what_bubblewrap_plays_and_ends_what_it_ends(world: Path, how: str) -> None:
    """The same traces; a hostile class costs its own rows."""
    plays = [_play(world, "tailgate.estimators:Kalman", "good", ("none", FDI), sandbox=sandbox) for sandbox in ("", "docker")]
    assert [row["trace_hash"] for row in plays[0]] == [row["trace_hash"] for row in plays[1]] and {row["status"] for row in plays[1]} == {"ok"}
    assert {row["status"] for row in _hostile(world, how, others=True, sandbox="docker")} == {"error"}
