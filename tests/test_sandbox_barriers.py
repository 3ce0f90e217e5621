"""A stranger's class: no other file of its folder is imported, and in bubblewrap no system call leads out of the sandbox."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tailgate.base.errors import InputError
from tailgate.cli.shared import say, table, tell
from tailgate.core.scenario import Suite
from tailgate.engine import objects
from tailgate.sandbox import Limits, play_submission
from tailgate.sandbox.sandbox import docker, sandbox_of

CLASSES = """
import ctypes, os, platform, signal, socket, time
from tailgate.estimators import Kalman

CALLS = {"x86_64": (248, 249, 250, 319, 29, 272, 165), "aarch64": (217, 218, 219, 279, 194, 97, 40)}
PLACES = ("/x", "/dev/x", "/etc/x", "/tmp/x", "/dev/shm/x", "/scratch/x")

class Honest(Kalman):
    pass

class Trying(Kalman):
    def prepare(self, model):
        written, made, families = [], [], []
        for place in PLACES:
            try:
                open(place, "w").close()
                written.append(place)
            except OSError:
                pass
        for number in CALLS[platform.machine()]:
            made += [number] * (ctypes.CDLL(None).syscall(number, 0, 0, 0, 0, 0) != -1)
        for family in (1, 2, 38, 40):
            try:
                socket.socket(family, 1).close()
                families.append(family)
            except OSError:
                pass
        raise RuntimeError(f"written {written} made {made} sockets {families}")

class Shirking(Kalman):
    def prepare(self, model):
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)
        while True:
            if os.fork() == 0:
                end = time.process_time() + 0.8
                while time.process_time() < end:
                    pass
                os._exit(0)
            try:
                os.wait()
            except ChildProcessError:
                pass
"""
PLANTED = "open({place!r}, 'w').close()\nraise ImportError('planted')\n"
boxed = pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "theirs.py").write_text(CLASSES)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1] / "src"))
    return tmp_path


def reason(name: str, sandbox: str | None, **limits: float) -> str:
    suite = Suite("one", "", ("stop-and-go-v0",), (5,), ("none",), ("fdi",), 2)
    (why,) = {row["reason"] for row in play_submission(f"theirs:{name}", suite, sandbox=sandbox, limits=Limits(**limits))}
    return str(why)


@pytest.mark.parametrize("command", [
    pytest.param(["leaderboard", "submit", "theirs:Honest", "--sandbox", "bwrap"], marks=boxed),
    ["evaluate", "--defence", "theirs:Honest"],
])  # fmt: skip
def test_a_file_in_the_folder_of_the_class_replaces_no_package(command: list[str], folder: Path) -> None:
    """Neither in the command's own process nor in one of its workers: a stranger's folder has more than the class."""
    for name in ("llvmlite", "safetensors", "pickle", "yaml"):
        (folder / f"{name}.py").write_text(PLANTED.format(place=str(folder / f"planted-{name}")))
    (folder / "small.yaml").write_text("scenarios: [stop-and-go-v0, braking-v0]\ndefences: [none]\nattacks: [none]\nseeds: 1\n")
    whole = [sys.executable, "-P", "-m", "tailgate", *command, "--suite", "small.yaml", "--workers", "2"]
    ended = subprocess.run(whole, cwd=folder, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert not list(folder.glob("planted-*"))


@boxed
def test_no_call_leads_out_of_the_sandbox(folder: Path) -> None:
    """Three directories of a limited size can be written; keyrings, anonymous memory, mounts and odd sockets are refused."""
    held = re.search(r"written (.*) made (.*) sockets (.*)", reason("Trying", "bwrap"))
    assert held is not None and held.groups() == ("['/tmp/x', '/dev/shm/x', '/scratch/x']", "[]", "[1, 2]")


def test_the_time_of_children_counts_though_nobody_waits_for_them(folder: Path) -> None:
    assert "processor time" in reason("Shirking", None, start_time=3.0, silence=10.0)


def test_a_sandbox_gets_copies_of_basic_code_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their times and names say nothing of what else is played on this machine."""
    monkeypatch.setenv("TAILGATE_CACHE", str(tmp_path / "cache"))
    place = objects.folder()
    assert place is not None
    for name in ("one.o", f"two{objects.BASIC}"):
        objects.keep(name, b"code")
        os.utime(place / name, (0, 0))
    copied = objects.copied_to(tmp_path / "copied")
    assert [path.name for path in copied.iterdir()] == [f"two{objects.BASIC}"]
    assert (copied / f"two{objects.BASIC}").stat().st_mtime > 0


def test_code_is_not_kept_where_another_user_could_swap_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder that others may write to, above the user's own one, gives no code and takes none."""
    for number, (mode, used) in enumerate(((0o755, True), (0o777, False), (0o1777, True))):
        above = tmp_path / str(number)
        above.mkdir()
        above.chmod(mode)
        monkeypatch.setenv("TAILGATE_CACHE", str(above / "cache"))
        assert (objects.folder() is not None) == used, oct(mode)


def test_the_image_of_a_container_is_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Never an option of the client; and the container's own files are read-only."""
    monkeypatch.setattr(shutil, "which", lambda program: f"/usr/bin/{program}")
    assert sandbox_of("docker:registry:5000/tailgate@sha256:0a") is not None
    for text in ("docker:--privileged", "docker:a b", "docker:A"):
        with pytest.raises(InputError, match="image"):
            sandbox_of(text)
    assert "--read-only" in docker("x", Path("/f"), None, {}, Limits())


def test_somebody_elses_words_do_not_steer_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    say("kf\x1b[2J\nnext", soft_wrap=True)
    tell("kf\x1b]0;title\x07")
    table(["defence"], [["kf\x1b[31m\x9b"]])
    told = capsys.readouterr()
    assert not {"\x1b", "\x07", "\x9b"} & set(told.out + told.err) and "\nnext" in told.out
