"""Ctrl-C and SIGTERM: a command ends with one line, at once or within seconds.

The first signal raises KeyboardInterrupt, which unwinds; further signals are ignored.
If unwinding takes longer than GRACE seconds, as in a long call of compiled code, the process exits.
This is safe because a kill at any moment leaves complete files only.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn

GRACE = 3.0  # [s] from a signal to the forced end of the process
WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_CURSOR = b"\x1b[?25h"  # shows the cursor, which a progress bar hides


class Terminated(KeyboardInterrupt):
    """A SIGTERM arrived."""


def _is_command() -> bool:
    """Return True if this process is the tailgate command, so that it may handle all signals."""
    words = sys.orig_argv
    module = words[words.index("-m") + 1 :][:1] if "-m" in words else []
    return module == ["tailgate"] or (not module and any(os.path.basename(word) in ("tailgate", "train.py") for word in words[1:2]))


COMMAND = _is_command()


def _kill_workers() -> None:
    pool = sys.modules.get("tailgate.base.pool")
    if pool is not None:
        pool.kill_all()


def _end(number: int, kept: str, said: bool = False) -> NoReturn:
    """End the process now, without any output of Python."""
    _kill_workers()
    with contextlib.suppress(OSError):  # unbuffered: the interrupted code may hold the lock of the stream
        os.write(2, (_CURSOR if os.isatty(2) else b"") + (b"" if said else f"tailgate: {WORDS[signal.Signals(number)]}; {kept}\n".encode()))
    os._exit(128 + number)


def _heard() -> list[signal.Signals]:
    """Return the signals to handle: not ignored (as a shell does for background jobs), and with a handler that Python can restore."""
    return [number for number in WORDS if signal.getsignal(number) not in (signal.SIG_IGN, None)]


class _Once:
    """Signal handler during imports: ends the process, and ignores a second signal meanwhile."""

    def __init__(self) -> None:
        self.called = False

    def __call__(self, number: int, _: FrameType | None) -> None:
        if not self.called:
            self.called = True
            _end(number, "nothing had started")


def at_start() -> None:
    """Let an interrupt during the imports of the command end it with one line; do nothing elsewhere."""
    answer = _Once()
    for number in _heard() if COMMAND else ():
        signal.signal(number, answer)


class Ending:
    """State of one orderly end: the signal received, and a thread that enforces the time limit."""

    def __init__(self, kept: Callable[[], str]) -> None:
        self.kept, self.number, self.said, self.over = kept, 0, False, threading.Event()

    def handle(self, number: int, _: FrameType | None) -> None:
        if not self.number:
            self.number = number
            raise Terminated if number == signal.SIGTERM else KeyboardInterrupt

    def watch(self, reads: int) -> None:
        """Wait in a thread for signals and end the process after GRACE seconds, even while the main thread runs compiled code.

        `reads` is the file descriptor to which the interpreter writes signal numbers.
        """
        with open(reads, "rb", buffering=0) as pipe:
            while text := pipe.read(64):
                if numbers := [byte for byte in text if byte in WORDS]:
                    if not self.over.wait(GRACE):
                        _end(numbers[0], self.kept(), self.said)
                    return

    def last_words(self, error: BaseException) -> int:
        """Print the last line of the command and return its exit code; error: what ended it."""
        _kill_workers()
        terminated = isinstance(error, Terminated) or self.number == signal.SIGTERM  # Ray raises a plain KeyboardInterrupt for every signal
        number = signal.SIGTERM if terminated else signal.SIGINT
        print(f"tailgate: {WORDS[number]}; {self.kept()}", file=sys.stderr, flush=True)
        self.said = True
        return 128 + number

    def unraisable(self, found: sys.UnraisableHookArgs) -> None:
        """Raise an interrupt again a moment later if it came where Python cannot raise, such as in a destructor."""
        if isinstance(found.exc_value, KeyboardInterrupt) and self.number:
            number, self.number = self.number, 0
            threading.Timer(0.01, signal.raise_signal, (number,)).start()
        else:
            sys.__unraisablehook__(found)


@contextlib.contextmanager
def orderly(kept: Callable[[], str]) -> Iterator[Ending]:
    """End a command on signals as this module describes, within the block.

    `kept` returns the words for the last line: what remains of the work.
    In the command's own process the handlers stay until its end; elsewhere the earlier handlers return.
    """
    ending = Ending(kept)
    if threading.current_thread() is not threading.main_thread():  # only the main thread handles signals
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
                signal.signal(number, signal.SIG_IGN)  # the last line is printed
        else:
            ending.over.set()
            for number, held in before.items():
                signal.signal(number, held)
            sys.unraisablehook = hook
            signal.set_wakeup_fd(wakeup)
            os.close(writes)  # ends the thread


at_start()
