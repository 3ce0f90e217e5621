"""Worker processes: spawned, never forked, and none outlives its parent.

Each has a pipe to its parent, and there is no thread, queue or lock that they share: one that is killed, at whatever moment, takes its
job with it and nothing else, and the parent never waits for what a dead one began to say.
"""

from __future__ import annotations

import contextlib
import copy
import multiprocessing
import os
import signal
import sys
import threading
import traceback
import weakref
from collections import deque
from collections.abc import Callable, Generator, Sequence
from multiprocessing import connection, resource_tracker
from typing import Any, Literal, NamedTuple, TypeVar

from tailgate.base import sizes
from tailgate.base.errors import Killed

R = TypeVar("R")
ENDING = 5.0  # [s] that an idle worker may take to end, before it is killed
_SIGNALS = {signal.SIGINT, signal.SIGTERM}
_crews: weakref.WeakSet[Crew] = weakref.WeakSet()
_line: Any = None  # in a worker: the pipe to its parent


class Remote(Exception):
    """The traceback in a worker, as text: the cause of an error that came from there."""


class Answer(NamedTuple):
    """What a worker says of a job. said: something in between; failed: an error; died: its process is no more."""

    job: int
    word: Literal["said", "done", "failed", "died"]
    value: Any = None


class _Worker:
    """A process and our end of its pipe."""

    def __init__(self) -> None:
        self.pipe, theirs = multiprocessing.Pipe()
        self.job: int | None = None
        # a daemon: no exit of an interpreter waits for one that waits for work
        self.process = multiprocessing.get_context("spawn").Process(target=_serve, args=(theirs, list(sys.path)), daemon=True)
        resource_tracker.ensure_running()  # it would let the signals through again
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)  # inherited: a terminal's interrupt is for us alone
        try:
            self.process.start()
        finally:
            theirs.close()
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def end(self, seconds: float) -> None:
        """Close the pipe, upon which an idle one ends; kill one that still runs after these seconds."""
        self.pipe.close()
        self.process.join(seconds)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(ENDING)


class Crew:
    """As many processes as there are jobs at a time, and at most so many; within `with`, after which none is left."""

    def __init__(self, most: int) -> None:
        self.most, self.workers = sizes.check("workers", most), list[_Worker]()
        _crews.add(self)

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:  # an interrupt does not wait for what is still to play
            self.kill()
        for worker in self.workers:
            worker.end(ENDING)
        self.workers.clear()

    def kill(self) -> None:
        """End all of them at once, whatever they do."""
        for worker in list(self.workers):
            with contextlib.suppress(ValueError, AttributeError):  # one that has not begun, or was cleared away
                worker.process.kill()

    @property
    def busy(self) -> list[_Worker]:
        return [worker for worker in self.workers if worker.job is not None]

    @property
    def free(self) -> bool:
        return len(self.busy) < self.most

    def give(self, job: int, function: Callable[..., Any], *arguments: Any) -> None:
        """Have a free one call function(*arguments), as the job of this number."""
        idle = next((worker for worker in self.workers if worker.job is None), None)
        if idle is None:
            self.workers.append(idle := _Worker())
        idle.job = job
        with contextlib.suppress(BrokenPipeError):  # it has died: `wait` finds that
            idle.pipe.send((function, arguments))

    def wait(self) -> list[Answer]:
        """What has come in, as soon as there is something."""
        found = []
        held = {worker.pipe: worker for worker in self.busy}
        for pipe in connection.wait(list(held)):
            worker = held[pipe]  # type: ignore[index]
            job = worker.job
            assert job is not None
            try:
                word, value = worker.pipe.recv()
            except (EOFError, ConnectionError):
                self.workers.remove(worker)
                worker.end(0.0)
                found.append(Answer(job, "died"))
                continue
            if word == "failed":
                value, text = value
                value.__cause__ = Remote(f"\n{text}")
            if word != "said":
                worker.job = None
            found.append(Answer(job, word, value))
        return found


def each(
    function: Callable[..., R], jobs: Sequence[tuple[Any, ...]], workers: int, died: Callable[[int], R] | None = None
) -> Generator[tuple[int, R]]:
    """(number, function(*job)) of each job, as they are done, by so many workers; an error of one ends all.

    A job whose process dies is done once more, by itself: memory may have been short for several. Where that dies too,
    died(number), or, without that, Killed is raised.
    """
    lost = []
    with Crew(workers) as crew:
        waiting = deque(enumerate(jobs))
        while waiting or crew.busy:
            while waiting and crew.free:
                number, job = waiting.popleft()
                crew.give(number, function, *job)
            for answer in crew.wait():
                if answer.word == "failed":
                    raise answer.value
                if answer.word == "died":
                    lost.append(answer.job)
                else:
                    yield answer.job, answer.value
    for number in sorted(lost):
        with Crew(1) as crew:
            crew.give(number, function, *jobs[number])
            (answer,) = crew.wait()
        if answer.word == "failed":
            raise answer.value
        if answer.word == "died" and died is None:
            raise Killed("workers", "a process that was killed", f"memory for {workers} of them, or fewer; what was finished is kept")
        yield number, died(number) if died is not None and answer.word == "died" else answer.value


def kill_all() -> None:
    """End every worker of this process at once: it is about to end itself."""
    for crew in list(_crews):
        crew.kill()


def say(value: Any) -> None:
    """In a worker: tell the parent something of the job in hand."""
    _line.send(("said", value))


def _serve(pipe: connection.Connection, path: list[str]) -> None:
    """What a worker does: one job after another, until its parent closes the pipe."""
    global _line
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    sys.path[:] = path  # a submission's module is found where the parent found it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _line = pipe
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            _answer(pipe)


def _answer(pipe: connection.Connection) -> None:
    try:
        function, arguments = pipe.recv()
    except (EOFError, ConnectionError):
        raise
    except Exception as error:  # such as a class that is not found here
        pipe.send(("failed", _portable(error)))
        return
    try:
        answer = connection._ForkingPickler.dumps(("done", function(*arguments)))  # type: ignore[attr-defined]
    except Exception as error:
        answer = connection._ForkingPickler.dumps(("failed", _portable(error)))  # type: ignore[attr-defined]
    pipe.send_bytes(answer)


def _portable(error: Exception) -> tuple[Exception, str]:
    """An error as it can cross to another process, and its traceback."""
    text = "".join(traceback.format_exception(error))
    try:
        connection._ForkingPickler.dumps(copy.copy(error))  # type: ignore[attr-defined] # some cannot be made again from what they hold
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    return error, text


def _end_with_parent() -> None:
    """A parent that is killed tells nobody: its workers would play on for nobody."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
