"""Hostile surroundings: full disks, planted links, devices as results, damaged checkpoints, classes that end the process."""

import errno
import io
import os
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import load, save

from tailgate import cli
from tailgate.agents.learners.learning import open_checkpoint, write_checkpoint
from tailgate.base.errors import InputError, NotWritable
from tailgate.base.files import write_atomic
from tailgate.base.locks import alone, lock_of
from tailgate.base.progress import progress
from tailgate.core.foreign import attribute_of
from tailgate.evaluation.resume import Parts
from tailgate.trust import run as trust_run


def test_a_full_disk_still_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process number is a courtesy; without it the command spun forever."""

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with alone(tmp_path / "rows.jsonl"):
        assert lock_of(tmp_path / "rows.jsonl").is_file()


@pytest.mark.parametrize("planted", ["link", "second name"])
def test_a_planted_lock_names_no_file_of_mine(tmp_path: Path, planted: str) -> None:
    mine = tmp_path / "mine"
    mine.write_text("keep me")
    make = os.symlink if planted == "link" else os.link
    make(mine, lock_of(tmp_path / "rows.jsonl"))
    with pytest.raises(InputError, match="no link"), alone(tmp_path / "rows.jsonl"):
        pass
    assert mine.read_text() == "keep me"


def test_a_planted_folder_of_parts_is_refused(tmp_path: Path) -> None:
    (tmp_path / "dir").mkdir()
    (tmp_path / ".rows.jsonl.parts").symlink_to(tmp_path / "dir")
    with pytest.raises(InputError, match="no link"):
        Parts(tmp_path / "rows.jsonl").__enter__()


def test_a_linked_folder_has_the_lock_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert lock_of(tmp_path / "link") == lock_of(tmp_path / "real")
    assert lock_of(tmp_path / "link" / "rows.jsonl") == lock_of(tmp_path / "real" / "rows.jsonl")


def test_a_pipe_is_replaced_by_no_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="regular file"):
        write_atomic(pipe, b"rows")
    assert cli.main(["evaluate", "--seeds", "1", "--out", str(pipe)]) == cli.EXIT_INPUT
    assert "--out" in capsys.readouterr().err and stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_flipped_bit_of_a_checkpoint_is_found(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    write_checkpoint(path, save, {"mean": np.arange(5.0)}, {"format": 1})
    tensors, facts = open_checkpoint(path, {"format": 1}, load)
    assert tensors["mean"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0] and facts == {"format": 1}
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="checkpoint"):
        open_checkpoint(path, {"format": 1}, load)


def test_a_disk_that_is_full_costs_no_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The values that were tried are not to blame."""
    tuning = pytest.importorskip("tailgate.training.tuning")
    search = tuning.make_search("gusty", [f"out={tmp_path}", "name=s", "learner=cem"], 1, episodes=8)
    search.directory.mkdir(parents=True)

    def full(*_: object) -> Any:
        raise NotWritable("out", "checkpoint", "a writable path (No space left on device)")

    monkeypatch.setattr(tuning, "train", full)
    with pytest.raises(NotWritable):
        tuning._trial(search, 0, None)


def test_a_damaged_result_of_trust_is_set_aside(tmp_path: Path) -> None:
    rows = tmp_path / trust_run.ROWS
    rows.write_text("my notes of a year\n")
    assert trust_run._damaged(rows)
    rows.write_text("")
    assert not trust_run._damaged(rows)


def test_a_module_that_ends_the_process_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ends_at_once.py").write_text("import sys\nsys.exit(0)\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(InputError, match="it ends the process"):
        attribute_of("defence", "ends_at_once:Mine", lambda value: True, "class")


def test_progress_that_nobody_can_read_ends_no_run() -> None:

    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    with progress(Console(file=Full())) as update:
        for done in range(11):
            update("playing", done, 10)


def test_a_name_with_escape_codes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["train", 'name="x\\e]0;pwn"']) == cli.EXIT_INPUT
    assert "\x1b" not in capsys.readouterr().err and not list(tmp_path.iterdir())
