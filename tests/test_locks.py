"""One command at a time writes to a place: the second says so in a line, and moves nothing; one that was killed blocks nobody."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tailgate import cli
from tailgate.base.errors import InputError
from tailgate.base.locks import alone, lock_of
from tailgate.training import train

TINY = ["learner=cem", "steps=600", "seeds=1", "cem={population: 3, episodes: 2, hidden: [2]}", "environment.interval=40", "tensorboard=false", "rivals=[none]"]
SOME = ["--scenario", "thesis-ch4-v0", "--defence", "kf", "--attack", "none"]
COMMANDS = {
    "evaluate": (["evaluate", *SOME, "--seeds", "1", "--out", "PLACE"], "rows.jsonl"),
    "trust": (["trust", *SOME, "--runs", "1", "--out", "PLACE"], "trust"),
    "train": (["train", "name=a", "out=runs", *TINY], "runs/a"),
    "resume": (["train", "--resume", "name=a", "out=runs"], "runs/a"),
    "tune": (["tune", "--trials", "1", "name=a", "out=runs", "--learner", "cem"], "runs/a-tune"),
    "selfplay": (["selfplay", "name=a", "out=runs"], "runs/a"),
    "chapter": (["reproduce", "ch7", "--seeds", "10", "--out", "PLACE"], "ch7"),
    "thesis": (["reproduce", "--seeds", "10", "--out", "PLACE"], "thesis"),
    "leaderboard": (["leaderboard", "run", "quick-v0", "--out", "boards"], "boards/quick-v0"),
    "log": (["log", "--suite", "quick-v0", "--out", "PLACE"], "log"),
}


@contextlib.contextmanager
def somebody(place: Path) -> Iterator[None]:
    """Somebody else writes there meanwhile: another thread, for whom the lock is another one as well."""
    begun, done = threading.Event(), threading.Event()

    def hold() -> None:
        with alone(place):
            begun.set()
            done.wait(60)

    thread = threading.Thread(target=hold)
    thread.start()
    assert begun.wait(10)
    try:
        yield
    finally:
        done.set()
        thread.join()


@pytest.mark.thin(2)
@pytest.mark.parametrize("name", COMMANDS)
def test_a_second_command_is_refused_before_anything_moves(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words, where = COMMANDS[name]
    place = Path(where)
    if place.suffix or name == "log":
        place.parent.mkdir(parents=True, exist_ok=True)
    else:
        place.mkdir(parents=True)
        (place / "kept").write_text("a result")
    if name == "resume":
        train.train(train.load_config(None, ["name=a", "out=given", *TINY]), lambda *_: None)
        Path("given/a/config.json").write_text(Path("given/a/config.json").read_text().replace('"given"', '"runs"'))
        Path("given/a/config.json").rename("runs/a/config.json")
    with somebody(place):
        before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
        capsys.readouterr()
        assert cli.main([word.replace("PLACE", where) for word in words]) == 2
        said = capsys.readouterr().err.splitlines()[-1]
        assert {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")} == before
    assert said.startswith(f"tailgate: error: out: got '{where}'; expected a place that no other command writes to now")
    assert said.endswith(f"process {os.getpid()} does")


def test_a_command_may_consist_of_others_and_leaves_no_file(tmp_path: Path) -> None:
    place = tmp_path / "deep" / "place"
    with alone(place):
        with alone(place):
            pass
        assert lock_of(place).is_file()
    assert os.listdir(place.parent) == []
    with somebody(place):
        pass


def test_one_that_was_killed_blocks_nobody(tmp_path: Path) -> None:
    place = tmp_path / "place"
    code = f"import time; from pathlib import Path; from tailgate.base.locks import alone\nwith alone(Path({str(place)!r})): print(flush=True); time.sleep(60)"
    running = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert running.stdout is not None and running.stdout.readline()
    with pytest.raises(InputError, match=f"process {running.pid} does"), alone(place):
        pass
    running.send_signal(signal.SIGKILL)
    running.wait()
    with alone(place):
        assert lock_of(place).read_text() == f"{os.getpid()}\n"
    assert not lock_of(place).exists()
