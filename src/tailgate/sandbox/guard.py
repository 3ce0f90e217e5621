"""The guard process between tailgate and a submission: it starts the submission, watches it, and leaves nothing of it running.

It runs as a plain script with the standard library alone, so that it starts fast.
It is the subreaper of all processes that the submission starts: a process that changes its session or outlives its parent
becomes the guard's child. When tailgate's end of the `life` pipe closes, for any reason, the guard kills all of them
and removes the scratch directories.

Standard input: lines of JSON, {"cpu": seconds granted so far}.
Standard output: one line of JSON at the end, {"why": .., "printed": ..}.
"""

from __future__ import annotations

import ctypes
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from typing import Any

_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER
_KEYCTL = {"x86_64": 250, "aarch64": 219}  # system call
_JOIN_SESSION_KEYRING = 1
TICK = 1.0 / os.sysconf("SC_CLK_TCK")
_LOOK = 0.2  # [s] between checks of the processes
_TAIL = 1000  # [bytes] of the last output
_KILLING = 20.0  # [s] after which the guard gives up


def descendants() -> dict[int, list[str]]:
    """Return every process below this one: its number, and the fields of /proc/PID/stat after the name (state, parent, ...)."""
    stats: dict[int, list[str]] = {}
    for name in os.listdir("/proc"):
        if name.isdigit():
            with suppress(OSError), open(f"/proc/{name}/stat") as file:
                stats[int(name)] = file.read().rpartition(")")[2].split()
    below: dict[int, list[int]] = {}
    for pid, fields in stats.items():
        below.setdefault(int(fields[1]), []).append(pid)
    found, todo = {}, [os.getpid()]
    while todo:
        for pid in below.get(todo.pop(), ()):
            found[pid] = stats[pid]
            todo.append(pid)
    return found


def _memory(pids: list[int], limit: int) -> int:
    """Return the bytes that the processes hold; if the quick sum is above the limit, shared memory counts once."""
    page, quick, exact = os.sysconf("SC_PAGE_SIZE"), 0, 0
    for pid in pids:
        with suppress(OSError, IndexError, ValueError), open(f"/proc/{pid}/statm") as file:
            quick += int(file.read().split()[1]) * page
    if quick <= limit:
        return quick
    for pid in pids:
        with suppress(OSError, IndexError, ValueError), open(f"/proc/{pid}/smaps_rollup") as file:
            exact += 1024 * next(int(text.split()[1]) for text in file if text.startswith("Pss:"))
    return exact


class Guard:
    """One submission's process and all that it starts."""

    def __init__(self, job: dict[str, Any]) -> None:
        self.job = job
        self.granted = float(job["cpu"])
        self.reaped = 0.0  # [s] processor time of ended processes
        self.status: int | None = None
        self.printed, self.tail = 0, b""
        self.spent: dict[tuple[int, str], float] = {}  # [s] that each process was last seen to have used, by number and start
        given, answers = job["pipes"]
        self.prints, wrote = os.pipe()
        filtering = _filled(bytes.fromhex(job["filter"])) if job["filter_word"] in job["command"] else []
        self.life = sys.stdin.fileno()
        self.listening = [self.life, self.prints]
        # start_new_session: a terminal's signal reaches only the user's process, which then closes the pipe
        self.child = subprocess.Popen(
            [str(filtering[0]) if word == job["filter_word"] else word for word in job["command"]], stdin=given,
            stdout=answers, stderr=wrote, cwd=job["scratch"], env=job["environment"], start_new_session=True, pass_fds=filtering,
        )  # fmt: skip
        for fd in (given, answers, wrote, *filtering):
            os.close(fd)

    def reap(self) -> None:
        """Collect ended processes and their processor time."""
        while True:
            try:
                pid, status, usage = os.wait4(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            self.reaped += usage.ru_utime + usage.ru_stime
            if pid == self.child.pid:
                self.status = status
                self.child.returncode = status  # nobody else waits for it

    def look(self) -> str:
        """Return why the submission must end now, or nothing."""
        found = {pid: fields for pid, fields in descendants().items() if fields[0] != "Z"}
        if len(found) > self.job["processes"]:
            return f"processes: {len(found)} at a time, {self.job['processes']} allowed"
        held = _memory(list(found), self.job["memory"])
        if held > self.job["memory"]:
            return f"memory: {held / 2**30:.2f} GiB held, {self.job['memory'] / 2**30:.2f} GiB allowed"
        # a process that does not wait for its children loses their times: then those that were seen count
        self.spent |= {(pid, fields[19]): TICK * (int(fields[11]) + int(fields[12])) for pid, fields in found.items()}
        waited = self.reaped + sum(TICK * sum(int(ticks) for ticks in fields[11:15]) for fields in found.values())
        used = max(waited, sum(self.spent.values()))
        if used > self.granted:
            return f"processor time: {used:.1f} s used, {self.granted:.1f} s allowed"
        return ""

    def read_output(self) -> str:
        """Read the submission's output; return a reason to end if it is too much."""
        text = os.read(self.prints, 1 << 16)
        if not text:  # no process is left that could print
            self.listening.remove(self.prints)
        self.printed += len(text)
        self.tail = (self.tail + text)[-_TAIL:]
        return f"output: more than {self.job['output']} bytes printed" if self.printed > self.job["output"] else ""

    def watch(self) -> str:
        """Wait for a reason to end and return it; return nothing if tailgate has gone or closes the pipe."""
        buffer, next_look = b"", 0.0
        while True:
            ready, _, _ = select.select(self.listening, [], [], 0.02 if self.status is None else 0.0)
            if self.prints in ready and (why := self.read_output()):
                return why
            if self.life in ready:
                text = os.read(self.life, 1 << 12)
                if not text:
                    return ""
                *lines, buffer = (buffer + text).split(b"\n")
                for entry in lines:
                    self.granted = float(json.loads(entry)["cpu"])
            self.reap()
            if self.status is not None and self.prints not in ready:
                return self.ended(self.status)
            if time.monotonic() >= next_look:
                if why := self.look():
                    return why
                next_look = time.monotonic() + _LOOK

    def ended(self, status: int) -> str:
        """Return how the submission's own process ended."""
        code = os.waitstatus_to_exitcode(status)
        if code == -signal.SIGXCPU or (code == -signal.SIGKILL and self.reaped >= self.job["cpu_limit"]):
            return f"processor time: more than {self.job['cpu_limit']} s in one process"
        return f"the process ended with exit code {code}" if code >= 0 else f"the process was killed by signal {-code}"

    def kill_all(self) -> None:
        """Freeze every descendant until no new one appears, then kill them, so that a forking process cannot escape."""
        end = time.monotonic() + _KILLING
        while time.monotonic() < end:
            frozen: set[int] = set()
            while new := set(descendants()) - frozen:
                for pid in new:
                    _signal(pid, signal.SIGSTOP)
                frozen |= new
            if not frozen:
                return
            for pid in frozen:
                _signal(pid, signal.SIGKILL)
            time.sleep(0.01)
            self.reap()

    def finish(self) -> None:
        self.kill_all()
        if self.job["after"]:  # cleans up after a container's client
            with suppress(OSError, subprocess.SubprocessError):
                subprocess.run(self.job["after"], stdin=subprocess.DEVNULL, capture_output=True, timeout=_KILLING, check=False)
        for path in self.job["remove"]:
            shutil.rmtree(path, ignore_errors=True)


def _filled(content: bytes) -> list[int]:
    """Return the reading end of a pipe that holds these few bytes."""
    reading, writing = os.pipe()
    os.write(writing, content)
    os.close(writing)
    return [reading]


def _signal(pid: int, number: int) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.kill(pid, number)


def main() -> None:
    """Start the submission, watch it, and report its end."""
    job = json.loads(sys.argv[1])
    system = ctypes.CDLL(None, use_errno=True)
    if system.prctl(_SUBREAPER, 1, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_CHILD_SUBREAPER)")
    if number := _KEYCTL.get(os.uname().machine):  # a new session keyring: in the user's one a class would find its notes again
        system.syscall(number, _JOIN_SESSION_KEYRING, None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    try:
        guard = Guard(job)
    except OSError as error:
        print(json.dumps({"why": f"it could not be started: {error}", "printed": ""}), flush=True)
        for path in job["remove"]:
            shutil.rmtree(path, ignore_errors=True)
        return
    why = ""
    try:
        why = guard.watch()
    finally:
        guard.finish()
        with suppress(BrokenPipeError):
            print(json.dumps({"why": why, "printed": guard.tail.decode(errors="replace")}), flush=True)


if __name__ == "__main__":
    main()
