"""Commands that are interrupted, terminated or killed at random moments: how they end, what is kept, what the next run makes of it.

    python benchmarks/crash_campaign.py [--commands evaluate,train] [--ways interrupt,kill] [--moments 40] [--seed 0] [--out FILE]

Each command is small and plays into a folder of its own. One run in peace says how long it takes and what it makes. Then every moment has
three steps: the command begins, the signal comes at a random time of that span, and the same command goes on to its end.

A moment is good when all of this holds:

* the command ended within 5 s of the signal, and none of its processes is left 5 s later;
* its last words are one line, without a traceback (a killed one says nothing);
* every file of rows that it left can be read, and the next run plays nothing again that was finished;
* the next run makes what the run in peace made.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import hashlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

WITHIN = 5.0  # [s] from the signal to the command's end
HANGS = 30.0  # [s] after which a command that goes on is killed
EARLIEST = 0.15  # [s] before that the interpreter itself begins, and nothing of Tailgate runs
MARKS = ("Traceback", "Exception ignored", "Process Spawn", "Error:", "leaked")
CLOCKED = "second|time grows|times slower"  # names of figures that each run measures with a clock
WAYS = ("interrupt", "twice", "group", "terminate", "kill")
SUITE = "about: s\nscenarios: [thesis-ch4-v0]\ndoses: [5]\ndefences: [none, kf]\nattacks: [none, 'fdi:value=5']\nseeds: 3\n"
SPACE = "cem.step: {range: [0.4, 1.0]}\n"
TINY = "{population: 3, episodes: 2, hidden: [2]}"


@dataclass(frozen=True)
class Job:
    """A small run of a command."""

    words: tuple[str, ...]
    results: tuple[str, ...]  # files that an undisturbed run makes the same each time
    resumed_by: tuple[str, ...] = ()  # further words where a run of this name has begun
    begun: str = ""  # the file that says so
    parallel: bool = True  # takes --workers
    told: bool = False  # its results say how many workers there were: it goes on with as many, as a user has it

    def command(self, workers: int, folder: Path | None = None) -> list[str]:
        """The words after `tailgate`; those that resume it, where the folder says that it began."""
        words = [word.replace("WORKERS", str(workers)) for word in self.words]
        return words + [*self.resumed_by] * bool(folder and self.begun and (folder / self.begun).is_file())


_SOME = ("--scenario", "thesis-ch4-v0", "--defence", "kf", "--defence", "chi2_kf")
_LEARN = ("out=runs", "steps=6000", f"cem={TINY}", "environment.interval=40")
JOBS = {
    "evaluate": Job(
        ("evaluate", *_SOME, "--attack", "none", "--attack", "fdi:value=5", "--attack", "dos_hold", "--seeds", "3", "--workers", "WORKERS",
         "--out", "rows.jsonl"), ("rows.jsonl",),
    ),
    "leaderboard": Job(
        ("leaderboard", "run", "suite.yaml", "--out", "boards", "--unattacked", "--no-replays", "--workers", "WORKERS"),
        ("boards/suite/rows.jsonl.xz", "boards/suite/board.json"),
    ),
    "train": Job(
        ("train", "name=a", *_LEARN, "learner=cem", "seeds=2", "workers=WORKERS", "tensorboard=false", "rivals=[none]", "others=[]",
         "white_box=[]", "episodes=20", "select_episodes=20"),
        ("runs/a/policy-*.safetensors", "runs/a/rows.jsonl", "runs/a/report.json"), ("--resume",), "runs/a/config.json", told=True,
    ),
    "trust": Job(
        ("trust", *_SOME, "--attack", "fdi:value=5", "--attack", "none", "--runs", "20", "--workers", "WORKERS", "--out", "trust"),
        ("trust/cells.jsonl", "trust/trust.json"),
    ),
    "tune": Job(
        ("tune", "--trials", "3", "--episodes", "20", "--learner", "cem", "--space", "space.yaml", "--workers", "WORKERS", "name=t",
         *_LEARN, "steps=1200"), ("runs/t-tune/best.yaml", "runs/t-tune/trials.json"),
    ),
    "selfplay": Job(
        ("selfplay", "name=s", *_LEARN[:1], "steps=600", "environment.interval=40", "rounds=1", "fresh=1", "episodes=20",
         f"attacker={TINY}", f"defender={TINY}"),
        ("runs/s/*.safetensors", "runs/s/report.json"), ("--resume",), "runs/s/config.json", parallel=False,
    ),
    "reproduce": Job(("reproduce", "ch7", "--seeds", "10", "--out", "ch7"), ("ch7/report.json",), parallel=False),
}  # fmt: skip


def prepared(folder: Path) -> Path:
    """A new folder with the files that the commands read."""
    folder.mkdir(parents=True)
    (folder / "suite.yaml").write_text(SUITE)
    (folder / "space.yaml").write_text(SPACE)
    return folder


def made(job: Job, folder: Path) -> dict[str, str]:
    """Hashes of a job's results; what was measured with a clock does not count."""
    found = sorted(path for pattern in job.results for path in folder.glob(pattern))
    texts = {str(path.relative_to(folder)): path.read_bytes() for path in found if not re.search(r"checkpoint", path.name)}
    plain = {name: json.dumps(_timeless(json.loads(held))).encode() if name.endswith(".json") else held for name, held in texts.items()}
    return {name: hashlib.sha256(held).hexdigest()[:12] for name, held in plain.items()}


def _timeless(held: Any) -> Any:
    if isinstance(held, dict):
        return {key: _timeless(value) for key, value in held.items() if not re.search(CLOCKED, key)}
    return [_timeless(value) for value in held] if isinstance(held, list) else held


def finished(folder: Path) -> dict[str, Any]:
    """Pieces that are done, by name, each with what changes when it is done again. Raises where something there cannot be read."""
    from tailgate.evaluation.rows import read_rows

    done: dict[str, Any] = {}
    for path in folder.rglob("*"):
        if path.suffix == ".tmp" or not path.is_file() or "page" in path.parts:
            continue
        if path.parent.name == ".cells.jsonl.parts" or path.name == "cells.jsonl":
            done |= {json.loads(line)["cell"]: None for line in path.read_text().splitlines()}
        elif path.name.endswith((".jsonl", ".jsonl.xz")) and path.name not in ("failures.jsonl", "journal.jsonl"):
            done |= {str(row["cell"]): None for row in read_rows(path)}
        elif path.name.startswith(("policy-", "attacker-", "defender-", "fresh-")) and path.suffix == ".json":
            if path.with_suffix(".safetensors").is_file() and not path.parent.name.startswith("trial-"):
                done[path.name] = path.stat().st_mtime_ns
        elif path.suffix == ".json":
            json.loads(path.read_text())
    for path in folder.rglob("journal.jsonl"):
        lines = [json.loads(line) for line in path.read_bytes().split(b"\n")[:-1]]
        done |= {f"trial {line['trial_id']}": None for line in lines if line.get("op_code") == 6 and line.get("state") == 1}
    return done


def replayed(job: Job, folder: Path, before: dict[str, Any]) -> list[str]:
    """Pieces that were finished before a run and that it did again."""
    log = folder.with_suffix(".played")
    again = {*(log.read_text().split() if log.is_file() else ())} & set(before)
    after = finished(folder)
    return sorted(again) + [name for name, mark in before.items() if mark is not None and after.get(name) != mark]


def _descendants(pid: int) -> set[str]:
    found: set[str] = set()
    todo = [str(pid)]
    while todo:
        with contextlib.suppress(OSError):
            new = Path(f"/proc/{todo[-1]}/task/{todo[-1]}/children").read_text().split()
            found.update(new)
            todo = new + todo[:-1]
            continue
        todo.pop()
    return found


def _lives(pid: str) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def begin(words: list[str], folder: Path, said_in: str = ".said") -> subprocess.Popen[bytes]:
    """A command as a user begins it, the leader of a process group; what it says goes to a file next to the folder."""
    with open(folder.with_suffix(said_in), "wb") as said:
        command = [sys.executable, "-m", "tailgate", *words]
        quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
        return subprocess.Popen(command, cwd=folder, stderr=said, start_new_session=True, **quiet)


def go_on(words: list[str], folder: Path) -> int:
    """The command in a fork of this process, which has done the imports, with a list of what it plays; its exit code."""
    child = os.fork()
    if not child:
        code = 70
        try:
            _play(words, folder)
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        except Exception:
            traceback.print_exc()
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _play(words: list[str], folder: Path) -> None:
    from tailgate import cli
    from tailgate.evaluation import cells as evaluation
    from tailgate.trust import run as trust

    os.setsid()
    said = os.open(folder.with_suffix(".again"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(said, 1)
    os.dup2(said, 2)
    os.chdir(folder)
    log = folder.with_suffix(".played")

    def listed(play: Callable[..., Any], name: Callable[[Any], str]) -> Callable[..., Any]:
        def run(job: Any, *rest: Any, **named: Any) -> Any:
            with log.open("a") as file:
                file.write(f"{name(job)}\n")
            return play(job, *rest, **named)

        return run

    evaluation.run_cell = listed(evaluation.run_cell, evaluation.cell_id)
    trust.check_cell = listed(trust.check_cell, lambda job: job.identity)
    raise SystemExit(cli.main(words))


def send(running: subprocess.Popen[bytes], way: str) -> None:
    """The signals of a way to end a command."""
    number = {"terminate": signal.SIGTERM, "kill": signal.SIGKILL}.get(way, signal.SIGINT)
    with contextlib.suppress(ProcessLookupError):
        if way == "group":
            os.killpg(running.pid, number)  # as a terminal does
        else:
            running.send_signal(number)
        if way == "twice":
            time.sleep(random.choice((0.0, 0.05, 0.5)))
            running.send_signal(number)


def moment(job: Job, folder: Path, way: str, delay: float, workers: int, peace: dict[str, str]) -> dict[str, Any]:
    """Begin, end by a signal, go on: what was wrong, and figures."""
    prepared(folder)
    wrong: list[str] = []
    running = begin(job.command(workers), folder)
    time.sleep(delay)
    below = _descendants(running.pid)
    send(running, way)
    sent = time.monotonic()
    try:
        code = running.wait(HANGS)
    except subprocess.TimeoutExpired:
        wrong.append("hangs")
        os.killpg(running.pid, signal.SIGKILL)
        code = running.wait()
    took = time.monotonic() - sent
    if took > WITHIN and "hangs" not in wrong:
        wrong.append("slow")
    while (left := [pid for pid in below if _lives(pid)]) and time.monotonic() - sent < took + WITHIN:
        time.sleep(0.02)
    if left:
        wrong.append("a process is left")
        for pid in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)
    said = folder.with_suffix(".said").read_text(errors="replace")
    if way != "kill" and code != 0:  # one that was done before the signal came says nothing of it
        if any(mark in said for mark in MARKS):
            wrong.append("a traceback")
        elif len(re.findall(r"^tailgate: (?:interrupted|terminated)", said, re.M)) != 1:
            wrong.append("not one line")
    try:
        before = finished(folder)
    except Exception as error:
        wrong.append(f"unreadable: {error}"[:200])
        before = {}
    folder.with_suffix(".played").unlink(missing_ok=True)
    again = begin(job.command(workers, folder), folder, ".again").wait() if job.told else go_on(job.command(1, folder), folder)
    if again:
        wrong.append(f"the next run ends with {again}")
    elif other := sorted(name for name, _ in made(job, folder).items() ^ peace.items()):
        wrong.append(f"the next run makes something else: {' '.join(dict.fromkeys(other))}")
    elif lost := replayed(job, folder, before):
        wrong.append(f"done again: {len(lost)}")
    if wrong and not any("traceback" in text for text in wrong):
        said = folder.with_suffix(".again").read_text(errors="replace") if again and job.told else said
    return {"delay": round(delay, 3), "code": code, "seconds": round(took, 2), "kept": len(before), "wrong": wrong,
            "said": said[-1500:] if wrong else ""}  # fmt: skip


def campaign(
    names: list[str], ways: list[str], moments: int, seed: int, workers: int, folder: Path, told: Callable[[str], None] = print
) -> Iterator[dict[str, Any]]:
    """A line for each command and way: how many moments, what went wrong how often, the longest end [s]."""
    chance = random.Random(seed)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in the background of a shell, which the commands would inherit
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for name in names:
        job = JOBS[name]
        begin(job.command(workers), prepared(folder / f"{name}-warm")).wait()  # compiled code is in its cache afterwards
        peace = prepared(folder / f"{name}-peace")
        begun = time.monotonic()
        running = begin(job.command(workers), peace)
        if code := running.wait():
            raise SystemExit(f"{name} by itself ends with {code}: {peace.with_suffix('.said').read_text()}")
        span, held = time.monotonic() - begun, made(job, peace)
        for way in ways:
            if way == "group" and not job.parallel:
                continue
            tried: list[dict[str, Any]] = []
            with contextlib.suppress(KeyboardInterrupt):  # the figures of what was tried follow
                for i in range(moments):
                    tried.append(moment(job, folder / f"{name}-{way}-{i}", way, chance.uniform(EARLIEST, span), workers, held))
                    print(f"{name} {way} {i + 1}/{moments} {tried[-1]['wrong'] or ''}", file=sys.stderr, flush=True)
            if not tried:
                return
            wrong = collections.Counter(text.split(":")[0] for one in tried for text in one["wrong"])
            line = {
                "command": name, "way": way, "moments": len(tried), "span": round(span, 2),
                "ended before": sum(not one["code"] for one in tried),
                "kept": sum(one["kept"] > 0 for one in tried), "longest": max(one["seconds"] for one in tried),
                "failed": sum(bool(one["wrong"]) for one in tried),
                "wrong": dict(wrong), "failures": [one for one in tried if one["wrong"]],
            }  # fmt: skip
            figures = f"{len(tried)} moments in {span:.1f} s, {line['failed']} failed, longest end {line['longest']} s"
            told(f"{name:<12} {way:<10} {figures} {dict(wrong) or ''}")
            yield line
            if len(tried) < moments:
                return


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--commands", default=",".join(JOBS), help=f"of {', '.join(JOBS)} (default: all)")
    parser.add_argument("--ways", default=",".join(WAYS), help=f"of {', '.join(WAYS)} (default: all)")
    parser.add_argument("--moments", type=int, default=20, help="of each command and way (default 20)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default 0)")
    parser.add_argument("--workers", type=int, default=2, help="of the commands that are ended (default 2)")
    parser.add_argument("--out", help="write the table here as JSON")
    options = parser.parse_args()
    from tailgate.training import tuning  # noqa: F401 - before the forks

    names, ways = options.commands.split(","), options.ways.split(",")
    for given, known in ((names, [*JOBS]), (ways, [*WAYS])):
        if away := [word for word in given if word not in known]:
            parser.error(f"{away[0]}: one of {', '.join(known)}")
    with tempfile.TemporaryDirectory(prefix="crash-") as place:
        lines = list(campaign(names, ways, options.moments, options.seed, options.workers, Path(place)))
    if options.out:
        Path(options.out).write_text(json.dumps({"seed": options.seed, "within": WITHIN, "lines": lines}, indent=1) + "\n")
    raise SystemExit(any(line["failed"] for line in lines))


if __name__ == "__main__":
    main()
