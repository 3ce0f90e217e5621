"""Worker processes: spawned, never forked, and none outlives its parent."""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any


class _Worker(SpawnProcess):
    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self.daemon = True  # a second interrupt can cut short a pool's end: the interpreter's would wait for idle workers for ever


class _Context(SpawnContext):
    """Spawned, as a fork after compiled parallel code can hang."""

    Process = _Worker


def abandon(pool: ProcessPoolExecutor) -> None:
    """End the workers at once."""
    workers = list((pool._processes or {}).values())  # a shutdown forgets them
    pool.shutdown(wait=False, cancel_futures=True)
    for process in workers:
        process.terminate()


def processes(workers: int, then: Callable[..., None] | None = None, *given: Any) -> ProcessPoolExecutor:
    """A pool of so many workers, which import from where this process does; each begins with then(*given), where there is something."""
    return ProcessPoolExecutor(workers, mp_context=_Context(), initializer=_begin, initargs=(list(sys.path), then, given))


def _begin(path: list[str], then: Callable[..., None] | None, given: tuple[Any, ...]) -> None:
    """What a worker does first."""
    sys.path[:] = path  # a submission's module is found where the parent found it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if then is not None:
        then(*given)


def _end_with_parent() -> None:
    """A parent that is killed tells nobody: its workers would wait for the next cell for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
