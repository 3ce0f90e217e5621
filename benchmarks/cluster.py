"""A Ray cluster against local workers: what it costs, what lost workers cost, and how fast the driver is.

    python benchmarks/cluster.py [--episodes 100000] [--tasks 1000000] [--out benchmarks/results]

1. Overhead: tasks that sleep for a second, on four workers, against the time that they would take without any overhead.
2. Loss: a suite is played on four workers. Two workers are killed at random moments, and the driver once; the same command goes on.
   Its rows are compared with those of a local run.
3. Driver: tasks that cost nothing are given to and taken from a cluster that is none. Says how many tasks a second the driver can serve.

Writes cluster.json. Needs `pip install 'tailgate[ray]'`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tailgate.base import sizes
from tailgate.base.cluster import RayCrew, on_ray
from tailgate.base.files import write_atomic
from tailgate.base.pool import each, hired

WORKERS, TASKS, SECOND = 4, 120, 1.0
IN_FLIGHT = 1024  # jobs at a time of the driver's test
SUITE = ["--suite", "quick-v0", "--defence", "kf", "--defence", "chi2_kf", "--defence", "rkf", "--defence", "brake_kf"]


def asleep(number: int) -> int:
    """Do nothing for a second."""
    time.sleep(SECOND)
    return number


def nothing(number: int) -> int:
    """Do nothing."""
    return number


def overhead() -> dict[str, float]:
    """Return how much longer tasks of a second take on a cluster than they would without any overhead."""
    with on_ray(workers=WORKERS):
        list(each(asleep, [(i,) for i in range(WORKERS)], WORKERS))  # processes begin
        begun = time.perf_counter()
        list(each(asleep, [(i,) for i in range(TASKS)], 2 * WORKERS))
        seconds = time.perf_counter() - begun
    ideal = TASKS * SECOND / WORKERS
    return {"tasks": TASKS, "seconds": seconds, "ideal": ideal, "overhead": seconds / ideal - 1.0}


def _workers() -> list[int]:
    """Return the processes of Ray that play cells at this moment."""
    found = []
    for place in Path("/proc").iterdir():
        try:
            if place.name.isdigit() and (place / "cmdline").read_bytes().startswith(b"ray::_done"):
                found.append(int(place.name))
        except OSError:
            continue
    return found


def loss(episodes: int, folder: Path, seed: int) -> dict[str, Any]:
    """Play a suite on a cluster whose workers and driver are killed; return if its rows are those of a local run."""
    cells = 4 * 2 * 10
    words = [sys.executable, "-m", "tailgate", "evaluate", *SUITE, "--seeds", str(max(episodes // cells, 1)), "--json"]
    away, here, rng = folder / "away.jsonl", folder / "here.jsonl", random.Random(seed)
    killed, runs = 0, 0
    while True:
        begun, runs = time.perf_counter(), runs + 1
        run = subprocess.Popen([*words, "--engine", "ray", "--workers", str(WORKERS), "--out", str(away)], stdout=subprocess.DEVNULL)
        next_kill = begun + rng.uniform(10.0, 20.0)
        while run.poll() is None:
            time.sleep(0.2)
            if killed < 2 and time.perf_counter() > next_kill and (found := _workers()):
                os.kill(rng.choice(found), signal.SIGKILL)
                killed, next_kill = killed + 1, time.perf_counter() + rng.uniform(2.0, 6.0)
            elif killed == 2 and runs == 1 and time.perf_counter() > next_kill:
                run.kill()
        if run.returncode == 0:
            break
        if runs > 2:
            raise SystemExit(f"the command ended with {run.returncode}")
    subprocess.run([*words, "--workers", "2", "--out", str(here)], stdout=subprocess.DEVNULL, check=True)
    rows = len(here.read_bytes().splitlines())
    return {"rows": rows, "workers_killed": killed, "driver_killed": runs - 1, "equal": away.read_bytes() == here.read_bytes()}


class Instant:
    """A cluster that is none: it does each task when its result is fetched."""

    exceptions = SimpleNamespace(RayTaskError=KeyError, RayError=OSError)

    def put(self, held: Any) -> Any:
        """Return what is put."""
        return held

    def remote(self, **_: Any) -> Any:
        """Return a function that begins a task."""
        return lambda function: SimpleNamespace(remote=lambda *arguments: _Task(function, arguments))

    def wait(self, tasks: list[Any], num_returns: int, timeout: float | None = None) -> tuple[list[Any], list[Any]]:
        """Return tasks that are done: all."""
        return tasks[:num_returns], []

    def get(self, task: _Task) -> Any:
        """Return a task's result."""
        return task.function(*task.arguments)

    def cancel(self, task: _Task, force: bool) -> None:
        """Do nothing."""


class _Task:
    def __init__(self, function: Any, arguments: tuple[Any, ...]) -> None:
        self.function, self.arguments = function, arguments


def driver(tasks: int) -> dict[str, float]:
    """Return how many tasks a second the driver gives and takes."""
    begun, done = time.process_time(), 0
    with hired(lambda most: RayCrew(Instant(), most)):
        for _ in each(nothing, [(i,) for i in range(tasks)], IN_FLIGHT):
            done += 1
    seconds = time.process_time() - begun
    return {"tasks": done, "seconds": seconds, "tasks_per_second": done / seconds}


def main() -> None:
    """Measure and write the record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100_000, help="of the suite whose workers are killed (default 100000)")
    parser.add_argument("--tasks", type=int, default=1_000_000, help="of the driver's test (default 1000000)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments at which processes are killed")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder of cluster.json")
    options = parser.parse_args()
    sizes.check("episodes", options.episodes)
    options.out.mkdir(parents=True, exist_ok=True)
    scratch = options.out / "cluster-rows"
    scratch.mkdir(exist_ok=True)
    report = {"driver": driver(options.tasks), "overhead": overhead(), "loss": loss(options.episodes, scratch, options.seed)}
    for path in scratch.iterdir():
        path.unlink()
    scratch.rmdir()
    write_atomic(options.out / "cluster.json", json.dumps(report, indent=1).encode() + b"\n")
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
