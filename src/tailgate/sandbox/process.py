"""The parent's side of a submission's process: it starts the guard, sends requests, limits waiting, and reads raw bytes."""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.version import FOLDER, VERSION
from tailgate.core import Array
from tailgate.core.registry import USES
from tailgate.sandbox.calls import FILTER, program
from tailgate.sandbox.limits import Limits, Lost
from tailgate.sandbox.sandbox import HOME, Sandbox
from tailgate.sandbox.wire import LINE, Outputs, line, pack, printable

_GUARD = Path(__file__).with_name("guard.py")
_ROOT = FOLDER.parent
_ENDING = 30.0  # [s] for the guard to kill everything


class Verbatim:
    """A value known only by its text."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


class Process:
    """One process of a submission. Any failure ends it; `ask` then raises Lost with the reason."""

    def __init__(self, text: str, source: Path | None, limits: Limits, sandbox: Sandbox | None) -> None:
        if sys.platform != "linux":
            raise InputError("submission", sys.platform, "Linux: other systems cannot isolate a submission; use a virtual machine")
        self.limits, self.lost, self.waited, self.number, self.buffer = limits, "", 0.0, 0, b""
        self.granted = limits.start_time
        shared = Path("/dev/shm")
        self.folder = Path(tempfile.mkdtemp(prefix="tailgate-", dir=shared if os.access(shared, os.W_OK) else None))
        self.scratch = Path(tempfile.mkdtemp(prefix="tailgate-scratch-"))
        try:
            self._spawn(sandbox, source)
            self.card = self._load(text, source)
        except BaseException:
            self.close()
            raise

    def _spawn(self, sandbox: Sandbox | None, source: Path | None) -> None:
        self.data, self.out = (os.open(self.folder / name, os.O_RDWR | os.O_CREAT, 0o600) for name in ("in", "out"))
        options = json.dumps({name: asdict(self.limits)[name] for name in ("memory", "cpu", "file_size")})
        module = ["-P", "-B", "-m", "tailgate.sandbox.child", str(self.folder), options]
        home = str(self.scratch) if sandbox is None else HOME
        inside = _environment(home, str(_ROOT))
        outside: dict[str, str] | None = inside
        command, after = [sys.executable, *module], list[str]()
        if sandbox is not None:
            command, after = sandbox.command(module, self.folder, source, inside, self.limits)
            outside = sandbox.outside(inside)
        child_in, self.ask_fd = os.pipe()
        self.answer_fd, child_out = os.pipe()
        job = {
            "command": command, "environment": outside, "scratch": str(self.scratch), "pipes": [child_in, child_out], "after": after,
            "remove": [str(self.scratch), str(self.folder)], "cpu": self.granted, "memory": self.limits.memory,
            "output": self.limits.output, "cpu_limit": self.limits.cpu, "filter": program().hex(), "filter_word": FILTER,
            "processes": self.limits.processes + (0 if sandbox is None else sandbox.processes),
        }  # fmt: skip
        try:
            self.guard = subprocess.Popen(
                [sys.executable, "-I", "-S", str(_GUARD), json.dumps(job)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                pass_fds=(child_in, child_out), start_new_session=True,
            )  # fmt: skip
        finally:
            os.close(child_in)
            os.close(child_out)

    def _load(self, text: str, source: Path | None) -> dict[str, Any]:
        card = self.ask("load", text=text, path=None if source is None else str(source))
        if card.get("tailgate") != VERSION:
            raise InputError("sandbox", card.get("tailgate"), f"an image with tailgate {VERSION}")
        uses, version = card.get("uses"), card.get("version")
        allowed = tuple(use for use in USES if use != "truth")
        if not isinstance(uses, list) or not all(use in allowed for use in uses) or type(version) is not int:
            raise InputError("submission: uses, version", [uses, version], f"some of {', '.join(allowed)}, and a whole number")
        return {"uses": tuple(uses), "version": version, "reference": printable(card.get("reference", ""))}

    def grant(self, seconds: float) -> None:
        """Grant more processor time [s]."""
        self.granted += seconds
        assert self.guard.stdin is not None
        with suppress(BrokenPipeError):
            self.guard.stdin.write(line({"cpu": self.granted}))
            self.guard.stdin.flush()

    def ask(self, op: str, arrays: Mapping[str, Array] | None = None, **rest: object) -> dict[str, Any]:
        """Return the answer to one request; raise Lost, or InputError and NotApplicable as the submission raised them."""
        if self.lost:
            raise Lost(self.lost)
        self.number += 1
        request: dict[str, Any] = {"id": self.number, "op": op, **rest}
        if arrays is not None:
            header, block = pack(arrays)
            if os.pwrite(self.data, block, 0) != len(block):
                raise OSError(f"only a part of {len(block)} bytes could be written to {self.folder}")
            request |= {"arrays": header, "size": len(block)}
        text = line(request)
        if len(text) > LINE:
            raise InputError("submission", f"a request of {len(text)} bytes", f"at most {LINE}: fewer or shorter names")
        try:
            os.write(self.ask_fd, text)
        except BrokenPipeError:
            self.lose(self._report())
        try:
            answer = json.loads(self._line(0.0 if op == "step" else self.limits.start_time))
            if not isinstance(answer, dict) or answer.get("id") != self.number:
                raise ValueError
        except (ValueError, RecursionError):
            self.lose("answer: not the requested line of JSON")
        error, ok = answer.get("error"), answer.get("ok")
        if isinstance(error, dict):
            self._raise({str(key): printable(value) for key, value in error.items()})
        if not isinstance(ok, dict):
            self.lose("answer: neither a result nor an error")
        return dict(ok)

    def _raise(self, error: dict[str, str]) -> None:
        """Raise the child's error here; it ends the process."""
        kind, text = error.get("kind", "Exception"), error.get("text", "")
        self.lost = f"{kind}: {text}"
        self.close()
        if "field" in error:
            cls = NotApplicable if kind == "NotApplicable" else InputError
            raise cls(error["field"], Verbatim(error.get("value", "")), error.get("expected", ""))
        raise Lost(self.lost)

    def _line(self, more: float) -> bytes:
        """Return the child's next line; wait as long as the limits allow, and `more` [s]."""
        assert self.guard.stdout is not None
        began, report = time.monotonic(), self.guard.stdout.fileno()
        allowed = self.limits.silence + self.granted - self.waited  # many slow steps must not add up to days
        wait = min(self.limits.silence + more, allowed)
        while b"\n" not in self.buffer:
            left = wait - (time.monotonic() - began)
            if left <= 0.0:
                spent = self.waited + wait
                self.lose(f"silence: no answer for {wait:g} s" if wait < allowed else f"too slow: {spent:.1f} s of waiting in all")
            ready = _readable([self.answer_fd, report], left)
            if self.answer_fd in ready:
                part = os.read(self.answer_fd, LINE)
                self.buffer += part
                if not part:
                    self.lose(self._report())
                if len(self.buffer) > LINE:
                    self.lose("answer: too long")
            elif ready:
                self.lose(self._report())
        found, _, self.buffer = self.buffer.partition(b"\n")
        if self.buffer:
            self.lose("answer: more than one line")
        self.waited += time.monotonic() - began
        return found

    def _report(self) -> str:
        """Return why the guard ended the process."""
        assert self.guard.stdin is not None and self.guard.stdout is not None
        why, printed = "", ""
        if not _readable([self.guard.stdout.fileno()], 2.0):  # the child closed its pipe but still runs
            why = "it closed its pipe"
        else:
            with suppress(ValueError, KeyError, TypeError):
                found = json.loads(self.guard.stdout.readline())
                why, printed = str(found["why"]), printable(" ".join(found["printed"].split())[-160:])
        return (why or "the guard process ended") + (f"; printed last: {printed}" if printed else "")

    def lose(self, reason: str) -> None:
        """End the process for this reason."""
        self.lost = reason
        self.close()
        raise Lost(reason)

    def make_room(self, outputs: Outputs) -> None:
        """Extend the file `out` to the size of a step's results."""
        if not self.lost and os.fstat(self.out).st_size < outputs.size:
            os.ftruncate(self.out, outputs.size)

    def read(self, outputs: Outputs) -> dict[str, Array]:
        """Read the child's results from the file `out`, as copies of the expected types and shapes."""
        block = os.pread(self.out, outputs.size, 0)
        if len(block) != outputs.size:
            self.lose("answer: the file of results is truncated")
        found = {name: np.array(view, order="K") for name, view in outputs.views(block).items()}
        return found | {name: found[name] != 0 for name in ("alarm", "probe")}

    def close(self) -> None:
        """End every process of the submission and remove its files; return when nothing is left."""
        self.lost = self.lost or "it was closed"
        guard = getattr(self, "guard", None)
        if guard is not None and guard.stdin is not None and not guard.stdin.closed:
            with suppress(BrokenPipeError):
                guard.stdin.close()
            try:
                guard.wait(_ENDING)
            except subprocess.TimeoutExpired:
                guard.kill()
                guard.wait()
            guard.stdout.close()
        for name in ("ask_fd", "answer_fd", "data", "out"):
            if (fd := self.__dict__.pop(name, None)) is not None:
                os.close(fd)
        for path in (self.scratch, self.folder):
            shutil.rmtree(path, ignore_errors=True)

    def __deepcopy__(self, memo: object) -> Process:
        return self  # a process cannot be copied; plans share it

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()


def _readable(files: Sequence[int], seconds: float) -> list[int]:
    """Return the files, by their numbers, that can be read or have ended; wait up to `seconds` for one."""
    poll = select.poll()  # `select.select` knows no file above number 1023
    for fd in files:
        poll.register(fd, select.POLLIN)
    return [fd for fd, _ in poll.poll(1000.0 * min(seconds, 1e6))]  # [ms] in 32 bits; who waits longer asks again


def _environment(home: str, root: str) -> dict[str, str]:
    """Return the environment of a submission's process: one thread per library, a scratch directory as home, no variable of the user."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
    own = {"HOME": home, "TMPDIR": home, "PYTHONPATH": root, "PYTHONHASHSEED": "0", "LANG": "C.UTF-8"}
    return kept | threads | own
