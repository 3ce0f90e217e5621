"""Worker processes: spawned, never forked, and none outlives its parent.

Each worker has a pipe to its parent; workers share no thread, queue or lock.
A killed worker therefore loses its own job only, and the parent never waits for it.
Within `hired`, jobs go to other hands, such as a cluster's.
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
from collections.abc import Callable, Generator, Iterator, Sequence
from contextvars import ContextVar
from multiprocessing import connection, resource_tracker
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

from tailgate.base import own_modules, sizes
from tailgate.base.errors import InputError, Killed

R = TypeVar("R")
UNGUARDED = 86  # exit status of a worker whose main module starts workers itself
ENDING = 5.0  # [s] for an idle worker to end before it is killed
THREADS = "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"  # of numpy; the first counts
_SIGNALS = {signal.SIGINT, signal.SIGTERM}
_crews: weakref.WeakSet[Crew] = weakref.WeakSet()
_hired: ContextVar[Callable[[int], Hands] | None] = ContextVar("hired", default=None)  # who takes jobs in place of local workers
_line: connection.Connection | None = None  # in a worker: the pipe to its parent


class Remote(Exception):
    """The traceback of an error in a worker, as text; it is the cause of the error that the parent raises."""


class Answer(NamedTuple):
    """A message from a worker about a job. said: a message before the end; failed: an error; died: the process is gone."""

    job: int
    word: Literal["said", "done", "failed", "died"]
    value: Any = None


class Hands(Protocol):
    """A context manager that takes jobs and answers them in any order; an error within the block ends them all."""

    def __enter__(self) -> Hands:
        """Begin."""

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End."""

    @property
    def busy(self) -> Sequence[object]:
        """The jobs that are not answered yet."""

    @property
    def free(self) -> bool:
        """If another job can be given."""

    def give(self, job: int, function: Callable[..., object], *arguments: object) -> None:
        """Give a job by its number."""

    def wait(self) -> list[Answer]:
        """Return answers; wait for the first one."""


class _Worker:
    """A process and the parent's end of its pipe."""

    def __init__(self) -> None:
        if getattr(multiprocessing.current_process(), "_inheriting", False):  # a worker that is importing its main module
            os._exit(UNGUARDED)
        self.pipe, theirs = multiprocessing.Pipe()
        self.job: int | None = None
        # a daemon, so that an idle worker does not delay the parent's exit
        self.process = multiprocessing.get_context("spawn").Process(
            target=_serve, args=(theirs, list(sys.path), bool(own_modules.folders())), daemon=True
        )
        resource_tracker.ensure_running()  # started later, it would unblock the signals
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)  # inherited: a terminal's interrupt reaches the parent only
        try:
            with _environment():
                self.process.start()
        finally:
            theirs.close()
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def check_guarded(self) -> None:
        """Raise InputError if the process, which is gone, came to a main module that starts workers itself."""
        self.process.join(ENDING)
        if self.process.exitcode == UNGUARDED:
            wanted = 'a script that starts its work below `if __name__ == "__main__":`, since each worker imports it'
            raise InputError("workers", "a script whose main module starts workers itself", wanted) from None

    def end(self, seconds: float) -> None:
        """Close the pipe, which ends an idle worker; kill a worker that still runs after `seconds`."""
        self.pipe.close()
        self.process.join(seconds)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(ENDING)


@contextlib.contextmanager
def _environment() -> Iterator[None]:
    """Let processes that start here import nothing from the working directory by themselves, and multiply matrices in one thread.

    The user may say how many threads: with more, workers would wait for each other.
    """
    changes = {"PYTHONSAFEPATH": "1"} | ({} if any(name in os.environ for name in THREADS) else {THREADS[0]: "1"})
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


class Crew:
    """A context manager of up to `most` worker processes, started as jobs come; none is left after the block."""

    def __init__(self, most: int) -> None:
        self.most, self.workers = sizes.check("workers", most), list[_Worker]()
        _crews.add(self)

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:  # an interrupt does not wait for running jobs
            self.kill()
        for worker in self.workers:
            worker.end(ENDING)
        self.workers.clear()

    def kill(self) -> None:
        """Kill all workers at once."""
        for worker in list(self.workers):
            with contextlib.suppress(ValueError, AttributeError):  # not started, or already removed
                worker.process.kill()

    @property
    def busy(self) -> list[_Worker]:
        return [worker for worker in self.workers if worker.job is not None]

    @property
    def free(self) -> bool:
        return len(self.busy) < self.most

    def give(self, job: int, function: Callable[..., object], *arguments: object) -> None:
        """Let a free worker call function(*arguments), as job number `job`."""
        idle = next((worker for worker in self.workers if worker.job is None), None)
        if idle is None:
            self.workers.append(idle := _Worker())
        idle.job = job
        with contextlib.suppress(BrokenPipeError):  # it has died: `wait` reports that
            idle.pipe.send((function, arguments))

    def wait(self) -> list[Answer]:
        """Wait until at least one message arrives; return all that have arrived."""
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
                worker.check_guarded()
                worker.end(0.0)
                found.append(Answer(job, "died"))
                continue
            if word != "said":
                worker.job = None
            found.append(answer(job, word, value))
        return found


def answer(job: int, word: Literal["said", "done", "failed", "died"], value: Any) -> Answer:
    """Return the answer to a job; an error has the worker's traceback as its cause."""
    if word == "failed":
        value, text = value
        value.__cause__ = Remote(f"\n{text}")
    return Answer(job, word, value)


@contextlib.contextmanager
def hired(hands: Callable[[int], Hands]) -> Iterator[None]:
    """Give jobs to other hands within a block. hands: called with the number of jobs at a time."""
    token = _hired.set(hands)
    try:
        yield
    finally:
        _hired.reset(token)


def crew(most: int) -> Hands:
    """Return who takes up to `most` jobs at a time: local processes, or those that are hired."""
    hands = _hired.get()
    return Crew(most) if hands is None else hands(most)


def apart(workers: int, jobs: int) -> bool:
    """If jobs run in other processes: several in several workers, or any in hired hands."""
    return _hired.get() is not None or min(workers, jobs) > 1


def each(
    function: Callable[..., R], jobs: Sequence[tuple[Any, ...]], workers: int, died: Callable[[int], R] | None = None
) -> Generator[tuple[int, R]]:
    """Run function(*job) for each job in `workers` processes; yield (number, result) as they finish.

    An error in one job ends them all.
    If a worker dies, its job runs once more alone, because memory may have been short for several.
    If it dies again, the result is died(number); without `died`, raise Killed.
    """
    lost = []
    with crew(workers) as hands:
        waiting = deque(enumerate(jobs))
        while waiting or hands.busy:
            while waiting and hands.free:
                number, job = waiting.popleft()
                hands.give(number, function, *job)
            for found in hands.wait():
                if found.word == "failed":
                    raise found.value
                if found.word == "died":
                    lost.append(found.job)
                else:
                    yield found.job, found.value
    for number in sorted(lost):
        with crew(1) as hands:
            hands.give(number, function, *jobs[number])
            (found,) = hands.wait()
        if found.word == "failed":
            raise found.value
        if found.word == "died" and died is None:
            raise Killed("workers", "a process that was killed", f"memory for {workers} of them, or fewer; what was finished is kept")
        yield number, died(number) if died is not None and found.word == "died" else found.value


def kill_all() -> None:
    """Kill all workers of this process, because it is about to end."""
    for crew in list(_crews):
        crew.kill()


def say(value: object) -> None:
    """Send the parent a message about the current job. Call it in a worker only; hired hands have nobody to tell."""
    if _line is not None:
        _line.send(("said", value))


def _serve(pipe: connection.Connection, path: list[str], own: bool) -> None:
    """Run jobs one after another until the parent closes the pipe. own: the user's modules may lie in the working directory."""
    global _line
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    sys.path[:] = path  # the worker finds a module where the parent found it
    if own:
        own_modules.allow()
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
    except Exception as error:  # for example, a class that is not importable here
        pipe.send(("failed", _portable(error)))
        return
    try:
        answer = connection._ForkingPickler.dumps(done(function, arguments))  # type: ignore[attr-defined]
    except Exception as error:  # a result that cannot be sent
        answer = connection._ForkingPickler.dumps(("failed", _portable(error)))  # type: ignore[attr-defined]
    pipe.send_bytes(answer)


def done(function: Callable[..., object], arguments: tuple[object, ...]) -> tuple[str, object]:
    """Do a job; return the word and the value of its answer."""
    try:
        return "done", function(*arguments)
    except Exception as error:
        return "failed", _portable(error)


def _portable(error: Exception) -> tuple[Exception, str]:
    """Return an error that can be pickled for another process, and its traceback."""
    text = "".join(traceback.format_exception(error))
    try:
        connection._ForkingPickler.dumps(copy.copy(error))  # type: ignore[attr-defined] # some cannot be rebuilt
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    return error, text


def _end_with_parent() -> None:
    """Exit when the parent dies: a killed parent cannot stop its workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
