"""Ctrl-C and SIGTERM: a command ends in one line, at once or a few seconds later, whatever it is doing.

The first signal raises KeyboardInterrupt, which unwinds. Further ones are ignored: nobody cuts the unwinding short. Where it has not come
to its end after GRACE seconds, as in a long call of compiled code, the process ends there: files are written such that a kill at any
moment loses nothing.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

GRACE = 3.0  # [s] between a signal and the end of the process
WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_CURSOR = b"\x1b[?25h"  # shows the cursor again, which a progress bar hides


class Terminated(KeyboardInterrupt):
    """SIGTERM came."""


def _is_command() -> bool:
    """Whether this process is the command line, and so all signals that it gets are for that."""
    words = sys.orig_argv
    module = words[words.index("-m") + 1 :][:1] if "-m" in words else []
    return module == ["tailgate"] or (not module and any(os.path.basename(word) in ("tailgate", "train.py") for word in words[1:2]))


COMMAND = _is_command()


def _kill_workers() -> None:
    pool = sys.modules.get("tailgate.base.pool")
    if pool is not None:
        pool.kill_all()


def _end(number: int, kept: str, said: bool = False) -> NoReturn:
    """End the process now, without a word of Python's."""
    _kill_workers()
    with contextlib.suppress(OSError):  # unbuffered: whoever was interrupted may hold the lock of the stream
        os.write(2, (_CURSOR if os.isatty(2) else b"") + (b"" if said else f"tailgate: {WORDS[signal.Signals(number)]}; {kept}\n".encode()))
    os._exit(128 + number)


def _heard() -> list[signal.Signals]:
    """The signals that are not ignored here, as a shell has it for jobs in the background, and that Python can put back."""
    return [number for number in WORDS if signal.getsignal(number) not in (signal.SIG_IGN, None)]


class _Once:
    """The answer to a signal during the imports: a second one, in the midst of it, adds no line of its own."""

    def __init__(self) -> None:
        self.called = False

    def __call__(self, number: int, _: Any) -> None:
        if not self.called:
            self.called = True
            _end(number, "it had not begun")


def at_start() -> None:
    """An interrupt during the imports of the command line ends it in one line; elsewhere nothing changes."""
    answer = _Once()
    for number in _heard() if COMMAND else ():
        signal.signal(number, answer)


class Ending:
    """What happened so far, and the thread that sees to the end."""

    def __init__(self, kept: Callable[[], str]) -> None:
        self.kept, self.number, self.said, self.over = kept, 0, False, threading.Event()

    def handle(self, number: int, _: Any) -> None:
        if not self.number:
            self.number = number
            raise Terminated if number == signal.SIGTERM else KeyboardInterrupt

    def watch(self, reads: int) -> None:
        """In a thread: told of signals by the interpreter's lowest level, also while the main thread is in compiled code."""
        with open(reads, "rb", buffering=0) as told:
            while text := told.read(64):
                if numbers := [byte for byte in text if byte in WORDS]:
                    if not self.over.wait(GRACE):
                        _end(numbers[0], self.kept(), self.said)
                    return

    def last_words(self, error: KeyboardInterrupt) -> int:
        """Say the one line; returns the exit code."""
        _kill_workers()
        number = signal.SIGTERM if isinstance(error, Terminated) else signal.SIGINT
        print(f"tailgate: {WORDS[number]}; {self.kept()}", file=sys.stderr, flush=True)
        self.said = True
        return 128 + number

    def unraisable(self, found: Any) -> None:
        """An interrupt that came where nothing can be raised, such as in a destructor, is raised again a moment later."""
        if isinstance(found.exc_value, KeyboardInterrupt) and self.number:
            number, self.number = self.number, 0
            threading.Timer(0.01, signal.raise_signal, (number,)).start()
        else:
            sys.__unraisablehook__(found)


@contextlib.contextmanager
def orderly(kept: Callable[[], str]) -> Iterator[Ending]:
    """Within it signals end a command as this module says. kept: what is left of the command, in words, for its last line.

    In the process of the command line this holds to its very end; elsewhere what was there before is put back.
    """
    ending = Ending(kept)
    if threading.current_thread() is not threading.main_thread():  # signals are the main thread's business
        yield ending
        return
    before = {number: signal.getsignal(number) for number in _heard()}
    reads, writes = os.pipe()
    os.set_blocking(writes, False)
    hook, wakeup = sys.unraisablehook, signal.set_wakeup_fd(writes, warn_on_full_buffer=False)
    sys.unraisablehook = ending.unraisable
    threading.Thread(target=ending.watch, args=(reads,), daemon=True).start()
    for number in before:
        signal.signal(number, ending.handle)
    try:
        yield ending
    finally:
        if COMMAND:
            for number in before:
                signal.signal(number, signal.SIG_IGN)  # all is done and said
        else:
            ending.over.set()
            for number, held in before.items():
                signal.signal(number, held)
            sys.unraisablehook = hook
            signal.set_wakeup_fd(wakeup)
            os.close(writes)  # the thread comes to its end


at_start()
