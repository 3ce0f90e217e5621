"""Trainings side by side: what one of them, an interrupt or a kill does to the others, and to what lies in their directories."""

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tailgate import cli
from tailgate.base.errors import InputError, Killed
from tailgate.training import adaptive, train

from . import dying

LONG = 100_000_000


def plan(tmp_path: Path, name: str, *settings: str) -> train.TrainConfig:
    """A run of two seeds and 100 generations, of which each takes some milliseconds."""
    small = ["steps=12000", "cem={population: 3, episodes: 2, hidden: [2]}", "environment.interval=40", "tensorboard=false", "rivals=[none]"]
    return train.load_config(None, [f"name={name}", f"out={tmp_path}", "learner=cem", "seeds=2", "workers=2", *small, *settings])


def weights(paths: list[Path]) -> list[bytes]:
    return [path.with_suffix(".safetensors").read_bytes() for path in paths]


def nobody(*_: object) -> None:
    pass


@pytest.mark.long
@pytest.mark.parametrize("workers", [1, 2])
def test_one_that_fails_is_named_and_cuts_nobody_short(tmp_path: Path, workers: int) -> None:
    """Seed 0 of the first run cannot go on. What runs beside it comes to its end, nothing new begins, and the error says which it is."""
    first, second = plan(tmp_path, "first"), plan(tmp_path, "second")
    train.train(dataclasses.replace(first, steps=600), nobody)
    for left in first.directory.glob("policy-*"):
        left.unlink()
    (first.directory / "checkpoint-0.safetensors").write_bytes(b"damaged")
    with pytest.raises(InputError, match=r"^first, seed 0: checkpoint.*checkpoint-0"):
        train.train_together([(first, True), (second, False)], nobody, workers)
    assert [path.name for path in first.directory.glob("policy-*.json")] == (["policy-1.json"] if workers == 2 else [])
    assert not second.directory.exists()


@pytest.mark.long
def test_an_interrupt_stops_all(tmp_path: Path) -> None:
    """Also while both processes have more to tell than a pipe holds, which nobody reads any more."""
    config = plan(tmp_path, "stopped", f"steps={LONG}", "cem={population: 2, episodes: 1, hidden: [1]}")
    started = time.monotonic()

    def stop(seed: int, now: object) -> None:
        time.sleep(4.0)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train.train(config, stop)
    assert time.monotonic() - started < 60.0 and not multiprocessing.active_children()
    assert (config.directory / "config.json").is_file() and not list(config.directory.glob("policy-*"))


@pytest.mark.long
def test_after_a_kill_the_same_command_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that the system kills: the error says what is kept and how to go on, and the policies come out as in peace."""
    given = plan(tmp_path / "peace", "killed")
    peace = weights(train.train(given, nobody))
    config = dataclasses.replace(given, out=str(tmp_path))
    told = train.train_together

    def kill(runs: object, progress: object, workers: int) -> list[list[Path]]:
        def once(config: train.TrainConfig, seed: int, now: object) -> None:
            for child in multiprocessing.active_children():
                os.kill(child.pid or 0, signal.SIGKILL)

        return told(runs, once, workers)  # type: ignore[arg-type]

    monkeypatch.setattr(train, "train_together", kill)
    words = [f"{key}={value}" for key, value in (("name", "killed"), ("out", tmp_path), ("learner", "cem"), ("seeds", 2), ("workers", 2))]
    words += ["steps=12000", "cem={population: 3, episodes: 2, hidden: [2]}", "environment.interval=40", "tensorboard=false", "rivals=[none]"]
    assert cli.main(["train", *words]) == 2
    said = capsys.readouterr().err
    assert "training: got 'a process that was killed'; expected memory for 2 of them" in said
    assert f"tailgate train --resume name=killed out={tmp_path}" in said
    monkeypatch.undo()
    with pytest.raises(Killed):
        kill([(config, True)], nobody, 2)
    assert weights(train.train(config, nobody, resume=True)) == peace


def test_processes_that_train_end_with_their_parent(tmp_path: Path) -> None:
    """The main process is killed without a word while two seeds of four train: no worker is left, and none begins another seed."""
    settings = [f"steps={LONG}", "seeds=4", "workers=2", "learner=cem", "cem={population: 3, episodes: 2, hidden: [2]}", "tensorboard=false"]
    command = [sys.executable, "-m", "tailgate", "train", "name=orphan", f"out={tmp_path}", "rivals=[none]", "checkpoint_every=100", *settings]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    held = tmp_path / "orphan"
    while running.poll() is None and len(list(held.glob("checkpoint-*.safetensors"))) < 2:
        time.sleep(0.05)
    assert running.poll() is None
    workers = dying.children(running.pid)
    running.send_signal(signal.SIGKILL)
    running.wait()
    left = dying.left(workers)
    for worker in left:
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(worker), signal.SIGKILL)
    assert len(workers) >= 2 and not left
    assert sorted(path.name for path in held.glob("checkpoint-*.safetensors")) == ["checkpoint-0.safetensors", "checkpoint-1.safetensors"]


@pytest.mark.long
@pytest.mark.parametrize("gap", [0.0, 0.05])
def test_two_interrupts_end_a_training_too(tmp_path: Path, gap: float) -> None:
    """Impatient users press twice: the second one cuts short the pool's end, and still nobody waits for workers that wait for work."""
    settings = [f"steps={LONG}", "seeds=2", "workers=2", "learner=cem", "cem={population: 3, episodes: 2, hidden: [2]}", "tensorboard=false"]
    command = [sys.executable, "-m", "tailgate", "train", "name=twice", f"out={tmp_path}", "rivals=[none]", "checkpoint_every=100", *settings]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    while running.poll() is None and len(list(tmp_path.glob("twice/checkpoint-*.safetensors"))) < 2:
        time.sleep(0.05)
    workers = dying.children(running.pid)
    for _ in range(2):
        running.send_signal(signal.SIGINT)
        time.sleep(gap)
    try:
        _, said = running.communicate(timeout=30.0)
    finally:
        running.kill()
    assert running.returncode == 130 and "go on with: tailgate train --resume name=twice" in said
    assert len(workers) >= 2 and not dying.left(workers)


@pytest.mark.long
def test_a_run_is_set_aside_when_its_turn_comes(tmp_path: Path) -> None:
    """Two runs are there, and another training is asked for and stopped at once: the second one's directory is as it was."""
    configs = [plan(tmp_path, name, "seeds=1", "steps=600") for name in ("first", "second")]
    train.train_together([(config, False) for config in configs], nobody, 1)
    held = {path: path.read_bytes() for path in configs[1].directory.iterdir()}

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    other = [dataclasses.replace(config, gamma=0.5) for config in configs]
    with pytest.raises(KeyboardInterrupt):
        train.train_together([(config, False) for config in other], stop, 1)
    assert {path: path.read_bytes() for path in configs[1].directory.iterdir()} == held and not (tmp_path / "second.1").exists()
    assert (tmp_path / "first.1" / "policy-0.json").is_file()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.json")}
    with pytest.raises(InputError, match=r"resume: got 'gamma=0.7'"):  # what is wrong with the second is known before the first is touched
        train.train_together([(dataclasses.replace(configs[0], steps=700), False), (dataclasses.replace(configs[1], gamma=0.7), True)], stop, 1)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.json")} == before


@pytest.mark.long
def test_a_suites_trainings_go_to_the_workers_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All seeds of all learners that are not there yet are one list for as many workers as are asked for."""
    configs = [plan(tmp_path, name, "seeds=3", "steps=1200") for name in ("first", "second")]
    train.train(dataclasses.replace(configs[0], seeds=1), nobody)
    (configs[0].directory / "config.json").write_bytes(b"{}")
    monkeypatch.setattr(adaptive.train, "same_run", nobody)
    monkeypatch.setattr(adaptive.train, "training_of", lambda config: "")
    seen: list[tuple[list[str], int]] = []

    def take(trainings: list[train.Training], begin: object, progress: object, workers: int) -> list[Path]:
        seen.append(([str(training) for training in trainings], workers))
        return [training.config.directory / f"policy-{training.seed}.json" for training in trainings]

    monkeypatch.setattr(train, "train_all", take)
    policies = adaptive.train_against(configs, nobody)
    assert [str(path.relative_to(tmp_path)) for path in policies] == [f"{name}/policy-{seed}.json" for name in ("first", "second") for seed in range(3)]
    assert seen == [(["first, seed 1", "first, seed 2", "second, seed 0", "second, seed 1", "second, seed 2"], 2)]


def test_learners_that_ask_the_same_are_shown_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The best script is chosen once for the learners of one knowledge, and again for another one."""
    shown = ["teacher=best", "rivals=[fdi, 'fdi:value=-2']", "select_episodes=2"]
    configs = [plan(tmp_path, name, *shown, f"threat.knowledge={level}") for name, level in (("a", "black"), ("b", "black"), ("c", "grey"))]
    asked: list[str] = []

    def best_of(suite: object, threat: dict[str, str], *_: object) -> str:
        asked.append(threat["knowledge"])
        return f"fdi:value={len(asked)}"

    monkeypatch.setattr(train, "best_of", best_of)
    monkeypatch.setattr(train, "train_all", lambda trainings, *_: [f"{t.config.name} {t.teacher}" for t in trainings])
    found = train.train_together([(config, False) for config in configs], nobody, 1)
    assert asked == ["black", "grey"] and found == [["a fdi:value=1"] * 2, ["b fdi:value=1"] * 2, ["c fdi:value=2"] * 2]
