# ruff: noqa: E501 - tables
"""Malformed input: every reader meets thousands of inputs that were made of valid files, and has to end each well.

    python benchmarks/fuzz.py                                    # 10 000 inputs for each reader
    python benchmarks/fuzz.py --reader policy --inputs 500 --seed 3
    python benchmarks/fuzz.py --reader policy --show 1234        # one input, and what came of it

An input ends well in success or in one InputError of one line, within 5 s and 1 GB more memory, with nothing written, moved or changed.
Readers run in a worker process with limits; some inputs that were refused are given to real command lines too.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from fuzz_inputs import mutated
from fuzz_readers import Reader, readers

SECONDS, MEMORY = 5.0, 1 << 30  # of processor time, and bytes, that an input may take
PATIENCE = 60.0  # [s] of the clock, after which a worker is ended
LONGEST = 2000  # characters of an error, at most
COMMANDS = 5  # real command lines for a reader that has one


class Late(BaseException):
    """An input took too long."""


def input_of(reader: Reader, valid: list[bytes], seed: int, number: int) -> bytes:
    """One input, which depends on the seed, the reader's name and the number alone. The first ones are the valid files."""
    if number < len(valid):
        return valid[number]
    rng = random.Random(f"{seed}/{reader.name}/{number}")
    return mutated(rng.choice(valid), reader.form, rng)


def met(reader: Reader, folder: Path, content: bytes) -> str:
    """`accepted`, `refused`, or what is wrong."""
    from tailgate.base.errors import InputError

    (folder / reader.file).write_bytes(content)
    reader_made = {"p.json", "README.md", "runs", "quickstart-tune"}  # what the call itself puts there

    def state() -> set[tuple[str, int]]:
        return {(entry.name, entry.stat().st_size) for entry in os.scandir(folder) if entry.name not in reader_made}

    before, answer = state(), "accepted"
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        reader.read(folder)
    except InputError as error:
        signal.setitimer(signal.ITIMER_PROF, 0)
        said = str(error)
        answer = "refused"
        if "\n" in said or len(said) > LONGEST or not all(ch.isprintable() for ch in said):
            answer = "error of more than a line"
    except Late:
        answer = "slow"
    except MemoryError:
        answer = "memory"
    except Exception as error:
        signal.setitimer(signal.ITIMER_PROF, 0)
        answer = f"{type(error).__name__}{_place(error)}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return answer if state() == before else "wrote a file"


def _place(error: BaseException) -> str:
    """The last line of the package on the way to an error."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "tailgate" in f.filename and "fuzz" not in Path(f.filename).name]
    return f" in {Path(frames[-1].filename).name}, {frames[-1].name}" if frames else ""


def _late(*_: Any) -> None:
    raise Late


def _work(line: Any, name: str, seed: int, numbers: range, valid: list[bytes]) -> None:
    """Read the inputs of one reader, in a separate process that announces each before it reads it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGPROF, _late)
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    reader = readers()[name]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        os.chdir(folder)
        reader.beside(folder)
        with suppress(Exception):
            met(reader, folder, valid[0])  # loads what the reader needs
        _fence(True)
        for number in numbers:
            _fence(False)
            content = input_of(reader, valid, seed, number)
            _fence(True)
            line.send((number, None))
            answer = met(reader, folder, content)
            line.send((number, answer))


def _fence(on: bool) -> None:
    """Limit what the process may hold to so much more than it does now."""
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY if on else hard, hard))


def _valid(line: Any, name: str) -> None:
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    line.send(list(readers()[name].valid()))


def valid_of(name: str) -> list[bytes]:
    """The valid files of a reader. Made in a process of their own: some load learners."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    worker = context.Process(target=_valid, args=(theirs, name))
    worker.start()
    theirs.close()
    try:
        made: list[bytes] = ours.recv()
        return made
    finally:
        worker.join()


def campaign(reader: Reader, inputs: int, seed: int, told: Any = None, valid: list[bytes] | None = None) -> dict[str, Any]:
    """All inputs of one reader: how many ended how, and the number of the first input of each fault."""
    valid = valid_of(reader.name) if valid is None else valid
    context, number, total = multiprocessing.get_context("spawn"), 0, len(valid) + int(inputs / reader.slow)
    counts: Counter[str] = Counter()
    first: dict[str, int] = {}
    refused: list[int] = []
    began = time.monotonic()
    while number < total:
        ours, theirs = context.Pipe(duplex=False)
        worker = context.Process(target=_work, args=(theirs, reader.name, seed, range(number, total), valid))
        worker.start()
        theirs.close()
        at, answer = number, "ended the process"
        try:
            while number < total:
                if not ours.poll(PATIENCE):
                    answer = "slow, in code that takes no signal"
                    raise EOFError
                at, found = ours.recv()
                if found is None:
                    continue
                counts[found] += 1
                first.setdefault(found, at)
                if found == "refused":
                    refused.append(at)
                number = at + 1
                if told is not None and number % 200 == 0:
                    told(number, total, time.monotonic() - began)
        except EOFError:
            counts[answer] += 1
            first.setdefault(answer, at)
            number = at + 1
        worker.kill()
        worker.join()
    faults = {what: {"count": n, "first": first[what]} for what, n in counts.items() if what not in ("accepted", "refused")}
    return {
        "reader": reader.name, "format": reader.form, "inputs": counts.total(), "accepted": counts["accepted"], "refused": counts["refused"],
        "faults": faults, "seconds": round(time.monotonic() - began, 1), "some": refused,
    }  # fmt: skip


def command_line(reader: Reader, content: bytes) -> str:
    """A real command line, given a file that was refused: exit code 2, one line, nothing else written."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        reader.beside(folder)
        (folder / reader.file).write_bytes(content)
        before = sorted(folder.iterdir())
        words = [word.format(reader.file) for word in reader.command]
        try:
            done = subprocess.run(
                [sys.executable, "-m", "tailgate", *words], cwd=folder, capture_output=True, text=True, errors="replace", timeout=60,
                stdin=subprocess.DEVNULL,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return "slow"
        if done.returncode != 2:
            return f"exit code {done.returncode}"
        if done.stderr.count("\n") != 1 or "Traceback" in done.stderr:
            return "error of more than a line"
        return "refused" if sorted(folder.iterdir()) == before else "wrote a file"


def with_commands(report: dict[str, Any], reader: Reader, seed: int, valid: list[bytes], most: int) -> dict[str, Any]:
    """The report, and what real command lines make of some inputs that the reader refused."""
    counts: Counter[str] = Counter()
    some = random.Random(seed).sample(report["some"], min(most, len(report["some"])))
    for number in some if reader.command else ():
        counts[command_line(reader, input_of(reader, valid, seed, number))] += 1
    bad = {what: n for what, n in counts.items() if what != "refused"}
    return {key: value for key, value in report.items() if key != "some"} | {"commands": counts.total(), "command_faults": bad}


def table(reports: list[dict[str, Any]]) -> str:
    """The reports as a Markdown table."""
    lines = ["| reader | format | inputs | accepted | refused | faults | command lines | their faults |", "|---|---|---|---|---|---|---|---|"]
    for held in reports:
        bad = sum(fault["count"] for fault in held["faults"].values())
        cells = (held["reader"], held["format"], held["inputs"], held["accepted"], held["refused"], bad, held["commands"], sum(held["command_faults"].values()))
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main() -> int:
    """Run the campaign; the exit code is 1 where something did not end well."""
    known = readers()
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--reader", action="append", choices=list(known), help="a reader (repeatable; default: all)")
    parser.add_argument("--inputs", type=int, default=10_000, metavar="N", help="inputs for each reader (default 10 000)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="another seed makes other inputs (default 0)")
    parser.add_argument("--commands", type=int, default=COMMANDS, metavar="N", help=f"real command lines, of some readers (default {COMMANDS})")
    parser.add_argument("--json", metavar="FILE", help="write the reports here as JSON")
    parser.add_argument("--show", type=int, metavar="NUMBER", help="print one input of the reader, and what comes of it")
    options = parser.parse_args()
    if options.show is not None:
        return _shown(known[options.reader[0]], options.seed, options.show)
    reports: list[dict[str, Any]] = []
    chosen = options.reader or list(known)
    began = time.monotonic()
    for place, name in enumerate(chosen):

        def told(done: int, total: int, spent: float, name: str = name, place: int = place) -> None:
            left = spent / done * (total - done) if spent else 0.0
            print(f"\r{place + 1}/{len(chosen)} {name}: {done} of {total}, {left:.0f} s left   ", end="", file=sys.stderr, flush=True)

        valid = valid_of(name)
        found = campaign(known[name], options.inputs, options.seed, told, valid)
        reports.append(with_commands(found, known[name], options.seed, valid, options.commands))
        last = reports[-1]
        print(f"\r{place + 1}/{len(chosen)} {name}: {last['inputs']} in {last['seconds']} s{' ' * 30}", file=sys.stderr)
        for what, held in last["faults"].items():
            print(f"    {held['count']} x {what}, first input {held['first']}", file=sys.stderr)
        for what, count in last["command_faults"].items():
            print(f"    command line: {count} x {what}", file=sys.stderr)
        if options.json:
            Path(options.json).write_text(json.dumps({"seed": options.seed, "reports": reports}, indent=1) + "\n", encoding="utf-8")
    print(table(reports))
    print(f"{time.monotonic() - began:.0f} s")
    return int(any(held["faults"] or held["command_faults"] for held in reports))


def _shown(reader: Reader, seed: int, number: int) -> int:
    signal.signal(signal.SIGPROF, _late)
    content = input_of(reader, valid_of(reader.name), seed, number)
    print(f"{len(content)} bytes: {content[:3000]!r}")
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)
        reader.beside(Path(place))
        (Path(place) / reader.file).write_bytes(content)
        _fence(True)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            print(repr(reader.read(Path(place)))[:500])
        except BaseException:
            traceback.print_exc()
        signal.setitimer(signal.ITIMER_PROF, 0)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
