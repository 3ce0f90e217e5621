"""Ctrl-C and SIGTERM: one line, within seconds, nothing left; also where Python itself would not listen."""

import importlib.util
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from tailgate.base import interrupts
from tailgate.base.pool import Crew, each
from tailgate.cli import command_line, main

spec = importlib.util.spec_from_file_location("crash_campaign", Path(__file__).parents[1] / "benchmarks" / "crash_campaign.py")
assert spec is not None and spec.loader is not None
campaign = importlib.util.module_from_spec(spec)
sys.modules["crash_campaign"] = campaign
spec.loader.exec_module(campaign)


def _double(value: int) -> int:
    if value == 3:
        raise ValueError("three")
    if value == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    if value == 5:
        time.sleep(60)
    return 2 * value


class Odd(Exception):
    """Cannot be made again from its arguments."""

    def __init__(self, a: int, b: int) -> None:
        super().__init__(f"{a} {b}")


def _odd() -> None:
    raise Odd(1, 2)


def test_jobs_are_done_side_by_side_and_one_that_dies_costs_only_itself() -> None:
    assert dict(each(_double, [(i,) for i in (1, 4, 2)], 2, lambda i: -i)) == {0: 2, 1: -1, 2: 4}
    with pytest.raises(ValueError, match="three") as found:
        list(each(_double, [(3,)], 1))
    assert "in _double" in str(found.value.__cause__)  # where it came up, over there
    with pytest.raises(RuntimeError, match="Odd: 1 2"):
        list(each(_odd, [()], 1))
    with pytest.raises(Exception, match="workers: got 'a process that was killed'"):
        list(each(_double, [(4,)], 1))


def test_a_crew_that_is_left_by_an_error_kills_who_still_works() -> None:
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt), Crew(1) as crew:
        crew.give(0, _double, 5)
        (pid,) = (worker.process.pid for worker in crew.workers)
        raise KeyboardInterrupt
    assert time.monotonic() - begun < 20.0 and not campaign._lives(str(pid))


def _command(code: str) -> subprocess.Popen[str]:
    """The command line with a command that does something else; it says when it has begun."""
    lines = [
        "import sys; sys.orig_argv = [sys.executable, '-m', 'tailgate']", "import ctypes, signal, time, threading", "from tailgate import cli",
        "from tailgate.cli import list as module", f"def run(options):\n    print('begun', flush=True)\n    {code}", "module._list = run",
        "sys.exit(cli.main(['list']))",
    ]  # fmt: skip
    return subprocess.Popen([sys.executable, "-c", "\n".join(lines)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


IGNORED = "class A:\n        def __del__(self): time.sleep(30)\n    a = A(); del a; time.sleep(30)"


@pytest.mark.thin(6)
@pytest.mark.parametrize(
    ("code", "signals", "status", "word"),
    [
        ("time.sleep(30)", [signal.SIGINT], 130, "interrupted"), ("time.sleep(30)", [signal.SIGTERM], 143, "terminated"),
        ("time.sleep(30)", [signal.SIGINT] * 5, 130, "interrupted"), ("time.sleep(30)", [signal.SIGINT, signal.SIGTERM], 130, "interrupted"),
        ("ctypes.CDLL(None).usleep(2**30); ctypes.CDLL(None).sleep(30)", [signal.SIGINT], 130, "interrupted"),
        ("try: time.sleep(30)\n    finally: time.sleep(30)", [signal.SIGINT], 130, "interrupted"), (IGNORED, [signal.SIGINT], 130, "interrupted"),
    ],
    ids=["once", "terminated", "five times", "both", "in compiled code", "a long tidying", "in a destructor"],
)  # fmt: skip
def test_a_command_ends_in_one_line(code: str, signals: list[signal.Signals], status: int, word: str) -> None:
    """Within 5 s, also where the main thread does not come to listen."""
    running = _command(code)
    assert running.stdout is not None and running.stdout.readline() == "begun\n"
    begun = time.monotonic()
    for number in signals:
        running.send_signal(number)
        time.sleep(0.02)
    try:
        _, said = running.communicate(timeout=20.0)
    finally:
        running.kill()
    assert time.monotonic() - begun < interrupts.GRACE + 2.0
    assert (running.returncode, said) == (status, f"tailgate: {word}; nothing of it is kept\n")


@pytest.mark.parametrize("times", [1, 2])
def test_an_interrupt_during_the_imports_is_one_line(times: int) -> None:
    begin = "import sys; sys.orig_argv = [sys.executable, '-m', 'tailgate']; from tailgate import interrupts"
    send = """
import os, signal, threading, time
def send():
    while signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        time.sleep(0.001)  # before Tailgate's first line Python answers
    write = os.write
    def again(stream, text):  # the next one comes in the midst of the answer
        done = write(stream, text)
        if TIMES > 1:
            signal.raise_signal(signal.SIGINT)
        return done
    os.write = again
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=send, daemon=True).start()
from tailgate"""
    code = begin.replace("from tailgate", send.replace("TIMES", str(times))) + "; time.sleep(5)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines() == ["tailgate: interrupted; nothing had started"] and done.returncode == 130


def test_a_library_that_raises_its_own_interrupt_does_not_hide_the_signal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Ray catches what a handler raises, and raises a plain KeyboardInterrupt."""
    monkeypatch.setattr(interrupts, "_kill_workers", lambda: None)
    ending = interrupts.Ending(lambda: "the same command goes on")
    with pytest.raises(interrupts.Terminated):
        ending.handle(signal.SIGTERM, None)
    assert ending.last_words(KeyboardInterrupt()) == 143
    assert capsys.readouterr().err == "tailgate: terminated; the same command goes on\n"


def test_an_import_that_the_signal_broke_is_no_traceback(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A compiled module that was cut off cannot be imported again while the command unwinds."""

    def broken(*_: object) -> Any:
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            raise ImportError('generic_type: type "ObjSense" is already registered!')

    monkeypatch.setattr(command_line._Parser, "parse_args", broken)
    assert main(["list"]) == 130
    assert capsys.readouterr().err == "tailgate: interrupted; nothing of it is kept\n"


def test_elsewhere_handlers_are_put_back(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Called from somebody's program a command leaves its signals as they were, and in another thread they are not touched."""
    before = [signal.getsignal(number) for number in interrupts.WORDS], sys.unraisablehook
    assert main(["list"]) == 0
    codes: list[Any] = []
    thread = threading.Thread(target=lambda: codes.append(main(["list"])))
    thread.start()
    thread.join()
    assert codes == [0] and ([signal.getsignal(number) for number in interrupts.WORDS], sys.unraisablehook) == before
    assert signal.set_wakeup_fd(-1) == -1


def _campaign(tmp_path: Path, names: list[str], ways: list[str], moments: int) -> None:
    lines = list(campaign.campaign(names, ways, moments, int(time.time()), 2, tmp_path))
    assert [line for line in lines if line["failed"]] == []
    assert len(lines) == len(names) * len(ways)


@pytest.mark.long
def test_a_command_that_is_ended_at_a_random_moment_goes_on(tmp_path: Path) -> None:
    _campaign(tmp_path, ["evaluate"], ["group"], 1)


@pytest.mark.long
def test_commands_that_are_ended_at_random_moments_go_on(tmp_path: Path) -> None:
    """A sample of `make crash`."""
    _campaign(tmp_path, ["evaluate", "leaderboard", "train", "trust", "tune"], ["interrupt", "kill"], 2)
