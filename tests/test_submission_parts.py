"""The parts of playing a submission: data that cannot be written, seeds, copies, orders, sandboxes, and nobody left behind."""

import argparse
import fcntl
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.core import Prior
from tailgate.core.draws import keys
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.evaluation.rounds import seeds_of
from tailgate.play.trace import rollout
from tailgate.sandbox import Isolated, Limits, digest_of, mixed
from tailgate.sandbox.limits import Lost
from tailgate.sandbox.process import _readable
from tailgate.sandbox.sandbox import Sandbox, bwrap, docker, sandbox_of
from tailgate.sandbox.source import staged
from tailgate.sandbox.table import order_of
from tailgate.sandbox.wire import pack, unpack

KALMAN = "tailgate.estimators:Kalman"


def test_an_order_is_a_permutation_that_its_secret_decides() -> None:
    one, other = order_of(b"one", 300), order_of(b"other", 300)
    assert sorted(one.tolist()) == list(range(300)) == sorted(other.tolist())
    assert (one == order_of(b"one", 300)).all() and (one != other).mean() > 0.9


def test_batches_hold_every_row_once_and_different_seeds_first() -> None:
    """600 seeds of three cells in batches of 900: in each, 300 of every cell, and no seed in two cells where the cut allows it."""
    parts: Any = [argparse.Namespace(place=load_scenario("stop-and-go-v0")) for _ in range(3)]
    monkey = pytest.MonkeyPatch()
    monkey.setattr(mixed, "ROWS", 600)
    batches = list(mixed._deal(parts, [0, 1, 2], range(600)))
    monkey.undo()
    assert len(batches) == 3 and all(sum(map(len, batch.values())) == 600 for batch in batches)
    assert sorted((i, seed) for batch in batches for i, some in batch.items() for seed in some) == [(i, s) for i in range(3) for s in range(600)]
    assert all(len({seed for some in batch.values() for seed in some}) == 600 for batch in batches)


def test_an_isolated_defence_plays_in_an_ordinary_loop(short: Callable[..., Scenario], same_tree: Callable[..., list[str]]) -> None:
    """Its traces, and those after new episodes in some rows, are the built-in one's; a state that it has dropped is an error."""
    place = short(horizon=12)
    with Isolated(KALMAN) as guard:
        apart, beside = place.loop(guard), place.loop(tailgate.make_defence("kf"))
        attack = tailgate.make_attack("none")
        one, two = (rollout(loop, attack, keys("train", range(5))) for loop in (apart, beside))
        assert [one.trace_hash(i) for i in range(5)] == [two.trace_hash(i) for i in range(5)]
        states = [loop.start(keys("train", range(5))) for loop in (apart, beside)]
        first = states[0]
        mask = np.array([False, True, False, True, True])
        plan = attack.prepare(apart.brief)
        for step in range(10):
            if step == 2:
                states = [loop.restart(state, mask) for loop, state in zip((apart, beside), states, strict=True)]
            states = [loop.step(state, attack, plan, None)[0] for loop, state in zip((apart, beside), states, strict=True)]
            assert not same_tree(states[0].estimate, states[1].estimate)
        with pytest.raises(InputError, match="one of the 8 most recently used states"):
            apart.step(first, attack, plan, None)


def test_arrays_keep_their_layout_and_cannot_be_written() -> None:
    """Whatever the order of the axes in memory: values, type and strides come back, and nobody can make them writable."""
    arrays = {
        "c": np.arange(24.0).reshape(2, 3, 4), "last": np.moveaxis(np.arange(24).reshape(3, 4, 2), -1, 0), "f": np.asfortranarray(np.eye(3)),
        "flags": np.array([[True], [False]]), "none": np.zeros((2, 1, 0)), "key": np.array([2**64 - 1], np.uint64),
    }  # fmt: skip
    found = unpack(*pack(arrays))
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype and (found[name] == array).all() and found[name].shape == array.shape
        assert array.size == 0 or min(array.shape) == 1 or found[name].strides == array.strides, name
        with pytest.raises(ValueError, match="WRITEABLE"):
            found[name].flags.writeable = True


def test_seeds_are_made_of_beacon_suite_and_purpose() -> None:
    """The same three give the same seeds, a longer list begins with a shorter one, and any other beacon, suite or purpose has other seeds."""
    seeds = seeds_of("beacon of the day", "quick-v0", "report", 1000)
    assert seeds == seeds_of("beacon of the day", "quick-v0", "report", 1000) and seeds[:10] == seeds_of("beacon of the day", "quick-v0", "report", 10)
    assert len(set(seeds)) == 1000 and all(0 <= seed < 2**53 for seed in seeds)
    assert abs(np.mean(seeds) / 2**53 - 0.5) < 3.2905 / np.sqrt(12 * 1000)  # 99.9 % of the mean of 1000 uniforms
    others = [seeds_of("beacon of the dax", "quick-v0", "report", 99), seeds_of("beacon of the day", "radar-v0", "report", 99)]
    others.append(seeds_of("beacon of the day", "quick-v0", "select", 99))
    assert not any(set(seeds) & set(other) for other in others)
    with pytest.raises(InputError, match="at least 16 characters"):
        seeds_of("2026", "quick-v0", "report", 1)


def test_what_is_played_is_a_copy_of_what_was_hashed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file, or a package with all that is in it; nothing beside it; nothing is imported for it; links are refused."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "solo_sub.py").write_text("raise SystemExit('imported')\n")
    (tmp_path / "beside.py").write_text("x = 1\n")
    package = tmp_path / "pack_sub"
    (package / "__pycache__").mkdir(parents=True)
    (package / "__init__.py").write_text("raise SystemExit('imported')\n")
    (package / "weights.bin").write_bytes(b"1234")
    (package / "__pycache__" / "x.pyc").write_bytes(b"none")
    with staged("solo_sub:Thing:gain=2") as source:
        assert source.text == "solo_sub:Thing:gain=2" and source.digest == digest_of("solo_sub") and source.path is not None
        assert [path.name for path in source.path.iterdir()] == ["solo_sub.py"]
    assert not source.path.exists()
    with staged("pack_sub.inner:Thing") as source:
        assert source.path is not None and sorted(p.name for p in source.path.rglob("*")) == ["__init__.py", "pack_sub", "weights.bin"]
        before = source.digest
    assert digest_of("pack_sub.inner") == before
    (package / "weights.bin").write_bytes(b"1235")
    assert digest_of("pack_sub") != before
    (package / "link").symlink_to("/etc/passwd")
    for text, what in (("pack_sub:A", "links are not followed"), ("nowhere_sub:A", "a module that is found"), ("kf", "module:Class"), ("a b:C", "module:Class")):
        with pytest.raises(InputError, match=what), staged(text):
            pass


def test_a_killed_run_leaves_no_process_of_the_submission(tmp_path: Path) -> None:
    """Whoever played it is killed without warning: the guard sees it, ends everything and removes the scratch directory."""
    code = f"""
import os, signal, time
from tailgate.sandbox import Isolated
from tailgate.core.scenario import load_scenario
plan = Isolated({KALMAN!r}).prepare(load_scenario("stop-and-go-v0").brief().model)
print(plan.process.guard.pid, plan.process.scratch, plan.process.folder, flush=True)
time.sleep(1000)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as player:
        assert player.stdout is not None
        guard, *folders = player.stdout.readline().split()
        assert Path(f"/proc/{guard}").exists() and all(Path(folder).is_dir() for folder in folders)
        player.send_signal(signal.SIGKILL)
    end = time.monotonic() + 20.0
    while Path(f"/proc/{guard}").exists() and time.monotonic() < end:
        time.sleep(0.05)
    assert not Path(f"/proc/{guard}").exists() and not any(Path(folder).exists() for folder in folders)


def test_elsewhere_than_on_linux_it_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(InputError, match="expected Linux"):
        Isolated(KALMAN).prepare(load_scenario("stop-and-go-v0").brief().model)
    monkeypatch.undo()


def test_a_sandbox_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    for text, what in (("bwrap", "bwrap is not on the PATH"), ("docker:mine", "docker is not on the PATH"), ("chroot", "bwrap, docker or docker:IMAGE")):
        with pytest.raises(InputError, match=what):
            sandbox_of(text)
    assert sandbox_of(None) is None


def test_sandboxes_have_no_network_and_can_write_to_one_file_only(tmp_path: Path) -> None:
    """bwrap: all namespaces, and one writable bind beside the cache's copy; docker: no network, capabilities or privileges, limited memory."""
    for name in ("in", "out"):
        (tmp_path / name).touch()
    limits, source = Limits(memory=2**30, processes=4), tmp_path / "source"
    line = bwrap(tmp_path, source, limits, tmp_path / "objects")
    assert line[0] == "bwrap" and line[-1] == "--" and "--unshare-all" in line and "--share-net" not in line and "--die-with-parent" in line
    writable = [line[i + 2] for i, word in enumerate(line) if word == "--bind"]
    assert str(tmp_path / "out") in writable and all(path.endswith(("/out", "/__pycache__")) for path in writable)
    readable = [line[i + 2] for i, word in enumerate(line) if word.startswith("--ro-bind")]
    assert {str(tmp_path / "in"), str(source), "/usr"} <= set(readable) and not {"/", "/home", "/root", "/etc"} & set(readable)
    line = docker("name", tmp_path, source, {"HOME": "/scratch", "PATH": "/bin", "OMP_NUM_THREADS": "1"}, limits)
    for flag, value in (("--network", "none"), ("--cap-drop", "ALL"), ("--memory", str(2**30)), ("--user", f"{os.getuid()}:{os.getgid()}"), ("--pull", "never")):
        assert line[line.index(flag) + 1] == value
    assert [line[i + 1].rpartition(":")[2] for i, word in enumerate(line) if word == "--volume"] == ["ro", "rw", "ro"]
    assert "PATH=/bin" not in line and "OMP_NUM_THREADS=1" in line


def test_a_container_s_client_finds_its_engine_and_nobody_reads_our_variables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the engine listens stands in DOCKER_HOST, or below HOME: the client inherits them. The guard's arguments, which all users of
    a machine can read, have none of ours; a submission gets its own, one by one."""
    (tmp_path / "docker").write_text("#!/bin/sh\nenv > \"$MY_TRACE\"; tr '\\0' ' ' < /proc/$PPID/cmdline >> \"$MY_TRACE\"\n")
    (tmp_path / "docker").chmod(0o755)
    for name, value in {"PATH": f"{tmp_path}:{os.environ['PATH']}", "DOCKER_HOST": "unix:///mine.sock", "MY_TRACE": str(tmp_path / "seen"), "MY_TOKEN": "hunter2"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(Lost):
        _ = Isolated(KALMAN, sandbox=Sandbox("docker")).card
    variables, _, arguments = (tmp_path / "seen").read_text().rpartition("\n")
    assert "DOCKER_HOST=unix:///mine.sock" in variables and "MY_TOKEN=hunter2" in variables and f"HOME={os.environ.get('HOME')}" in variables
    assert "guard.py" in arguments and "hunter2" not in arguments and "mine.sock" not in arguments
    given = {"HOME": "/scratch"}
    assert Sandbox("bwrap").outside(given) == given


def test_a_wrong_parameter_is_told_and_a_prior_may_be_a_view() -> None:
    """A wrong parameter of the class is the user's error, and is told as one."""
    with pytest.raises(InputError, match="unknown field"), Isolated(f"{KALMAN}:nonsense=1") as guard:
        guard.prepare(load_scenario("stop-and-go-v0").brief().model)
    with Isolated(KALMAN) as guard:
        plan = guard.prepare(load_scenario("stop-and-go-v0").brief().model)
        state = guard.start(plan, Prior(np.zeros((2, 1, 3)), np.broadcast_to(np.eye(3), (2, 1, 3, 3))))
        assert state.row.tolist() == [0, 1]


def test_a_process_is_heard_at_a_file_of_a_high_number() -> None:
    """`select` refuses file 1024 and above, and a wait of weeks is more than 32 bits of milliseconds."""
    held = resource.getrlimit(resource.RLIMIT_NOFILE)
    if held[1] != resource.RLIM_INFINITY and held[1] < 2000:
        pytest.skip("no file may have such a number")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(held[0], 2000), held[1]))
    read, write = os.pipe()
    high = fcntl.fcntl(read, fcntl.F_DUPFD, 1500)
    try:
        assert _readable([high], 0.0) == []
        os.write(write, b"x")
        assert _readable([high], 1e9) == [high]
    finally:
        for fd in (read, write, high):
            os.close(fd)
        resource.setrlimit(resource.RLIMIT_NOFILE, held)
