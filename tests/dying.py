"""A job that is done again and again, in processes of its own that each die at a later call of the hook, until one comes to the end.

Run as `python dying.py JOB FOLDER EVERY`: a process dies at every EVERY-th call. Prints the first call at which none died, and the exit code.
"""

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from tailgate.base import files
from tailgate.board.run import board_of, play
from tailgate.board.run_record import Record
from tailgate.core.scenario import Suite, load_suite
from tailgate.evaluation.cells import cells_of, run

SUITE = Suite("small", "", ("thesis-ch4-v0",), (5,), ("kf",), ("none", "fdi:value=5"), 3)
FILE = "about: s\nscenarios: [thesis-ch4-v0]\ndoses: [5]\ndefences: [none, kf]\nattacks: [none, 'fdi:value=5']\nseeds: 3\n"
NAME = "small-v0.yaml"  # of the suite's file, beside the folders


def rows(folder: Path) -> None:
    run(cells_of(SUITE), folder / "rows.jsonl")


def board(folder: Path) -> None:
    suite = load_suite(str(folder.parent / NAME))
    record = Record(suite, folder, 1)
    play(suite, folder, progress=record.counting(lambda *now: None))
    record.finish(board_of(suite, folder, require_adaptive=False)["suite"]["rows"])


JOBS: dict[str, Callable[[Path], None]] = {"rows": rows, "board": board}


def lives(pid: str) -> bool:
    """Whether a process runs: one that ended and whom nobody asked for its exit code does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()


def left(pids: list[str], seconds: float = 20.0) -> list[str]:
    """Those of the processes that still run when so much time has passed."""
    until = time.monotonic() + seconds
    while time.monotonic() < until and any(lives(pid) for pid in pids):
        time.sleep(0.05)
    return [pid for pid in pids if lives(pid)]


def _die(job: Callable[[Path], None], folder: Path, at: int) -> None:
    signal.alarm(60)
    seen: list[str] = []

    def step(what: str, path: Path) -> None:
        seen.append(what)
        if len(seen) == at:
            os._exit(9)

    files.step = step
    job(folder)
    os._exit(0)


def main(name: str, folder: Path, every: int) -> None:
    (folder / "whole").mkdir()
    JOBS[name](folder / "whole")  # what is traced and compiled, children have from their parent
    for at in range(1, 500, every):
        (folder / str(at)).mkdir()
        if not (child := os.fork()):  # of one parent that has no thread
            _die(JOBS[name], folder / str(at), at)
        if (code := os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])) != 9:
            print(at, code)
            return


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))
