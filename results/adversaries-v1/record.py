"""Learned attacks against searched scripts: the standard ensemble in every cell of record.yaml, with five seeds.

    python results/adversaries-v1/record.py [--suite NAME ...] [--seeds 5] [--episodes 2000] [--workers 2] [--out runs/record]

In each cell every seed searches anew: scripts, programs and networks, black box. Each seed's best network meets the best script or
program of all seeds, chosen on select episodes, on fresh report episodes. The champion is the network of all seeds that did best on
select episodes. A test is McNemar's on the same episodes, one-sided, corrected by Holm over all tests of the record. The same command
goes on after an interrupt. Writes report.json and report.md next to this file. With --suite the cells of other suites stay as reported;
the correction is over all.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tailgate.base import sizes
from tailgate.base.errors import NotApplicable
from tailgate.base.files import write_atomic
from tailgate.base.locks import alone
from tailgate.base.pool import each
from tailgate.base.progress import progress
from tailgate.base.reading import load_json
from tailgate.core import Array
from tailgate.core.scenario import load_suite
from tailgate.core.schema import read_yaml
from tailgate.ensemble.members import BUDGETS, Hunt, harvest
from tailgate.ensemble.search import Arena
from tailgate.ensemble.standard import Job
from tailgate.evaluation.stats import holm, proportion

HERE = Path(__file__).parent
FIRST = 20261128  # of the report episodes: no search and no suite has met them
SCRIPTS, LEARNED = ("scripts", "programs"), "networks"
LEVEL = 0.05


def searched(job: Job, folder: Path) -> dict[str, Any]:
    """Search once; return the best script or program, the best network, and the processor time."""
    begun = time.process_time()
    hunt = Hunt(job.arena, BUDGETS[job.budget], job.seed, folder / "attacks" / job.name, only=(*SCRIPTS, LEARNED))
    found = {one.member: one.found[0]._asdict() for one in harvest(hunt) if one.found}
    script = max((found[name] for name in SCRIPTS if name in found), key=lambda one: one["score"], default=None)
    return {"script": script, "learned": found.get(LEARNED), "seconds": time.process_time() - begun}


def hits(arena: Arena, text: str, episodes: int) -> Array:
    """Return which report episodes (episodes,) an attack damages."""
    return arena.harm(*arena.outcome(text, "report", FIRST, episodes))[0]


def more(a: Array, b: Array) -> float:
    """Return p of the null hypothesis that a damages no more than b: McNemar's exact test, one-sided."""
    from scipy.stats import binomtest

    only_a, only_b = int(np.sum(a & ~b)), int(np.sum(b & ~a))
    return float(binomtest(only_a, only_a + only_b, alternative="greater").pvalue) if only_a + only_b else 1.0


def compared(arena: Arena, runs: list[dict[str, Any]], episodes: int) -> dict[str, Any]:
    """Return a cell's line: the best script of all seeds, and each seed's network against it."""
    scripts = [run["script"] for run in runs if run["script"]]
    if not scripts or not all(run["learned"] for run in runs):
        raise NotApplicable("defence", arena.defence, "one against which scripts and networks were found")
    script = max(scripts, key=lambda one: one["score"])
    base, out = hits(arena, script["attack"], episodes), []
    for held in (run["learned"] for run in runs):
        mine = hits(arena, held["attack"], episodes)
        share = proportion(int(mine.sum()), episodes)
        figures = {"share": share.value, "low": share.low, "high": share.high, "score": held["score"]}
        out.append(figures | {"p": more(mine, base), "less": more(base, mine)})
    share = proportion(int(base.sum()), episodes)
    return {
        "scenario": arena.name, "dose": arena.dose, "defence": arena.defence, "script": script["attack"],
        "seconds": sum(run["seconds"] for run in runs),
        "scripts": {"share": share.value, "low": share.low, "high": share.high}, "seeds": out,
        "champion": max(range(len(out)), key=lambda i: out[i]["score"]),
    }  # fmt: skip


def verdicts(cells: list[dict[str, Any]]) -> None:
    """Add to each seed of each cell if it wins, loses, or neither, corrected over all tests in both directions."""
    tests = [(seed, side) for cell in cells for seed in cell["seeds"] for side in ("p", "less")]
    for (seed, side), p in zip(tests, holm([seed[side] for seed, side in tests]), strict=True):
        seed[f"adjusted_{side}"] = p
    for cell in cells:
        for seed in cell["seeds"]:
            seed["verdict"] = "wins" if seed["adjusted_p"] < LEVEL else "loses" if seed["adjusted_less"] < LEVEL else "undecided"


def markdown(cells: list[dict[str, Any]], options: argparse.Namespace) -> str:
    """Return the report as a page."""
    lines = [
        "# Learned attacks against searched scripts", "",
        f"`python results/adversaries-v1/record.py --seeds {options.seeds} --episodes {options.episodes}`: budget quick of the standard",
        f"ensemble, black box, {options.episodes} fresh episodes a cell; 95 % intervals.",
        "The script is the best script or program of all seeds. A network begins at rest, as an imitation of one of these, or as a",
        "published policy. Cells were chosen by hand, before this record, where an attack does damage at some times and none at others.",
        "", "| scenario, defence, dose | best script | learned, each seed | champion | seeds that win / lose | minutes of processor time |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for cell in cells:
        said, best = [seed["verdict"] for seed in cell["seeds"]], cell["seeds"][cell["champion"]]
        lines.append("| " + " | ".join([
            f"`{cell['scenario']}`, `{cell['defence']}`, {cell['dose']}", _percent(cell["scripts"]),
            ", ".join(f"{100 * seed['share']:.1f}" for seed in cell["seeds"]), f"{_percent(best)}, {best['verdict']}",
            f"{said.count('wins')} / {said.count('loses')} of {len(said)}", f"{cell['seconds'] / 60:.1f}",
        ]) + " |")  # fmt: skip
    return "\n".join(lines) + "\n"


def _cell(line: dict[str, Any]) -> tuple[str, int, str]:
    return line["scenario"], line["dose"], line["defence"]


def _percent(held: dict[str, Any]) -> str:
    share, low, high = (100 * held[name] for name in ("share", "low", "high"))
    return f"{share:.1f} % ({low:.1f} to {high:.1f})"


def main() -> None:
    """Search, compare and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", action="append", metavar="NAME", help="only the cells of this suite (repeatable; default: all)")
    parser.add_argument("--seeds", type=int, default=5, help="seeds of the search (default 5)")
    parser.add_argument("--episodes", type=int, default=2000, help="report episodes (default 2000)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2); change no result")
    parser.add_argument("--out", type=Path, default=Path("runs/record"), help="finished searches; the same command goes on")
    parser.add_argument("--report", type=Path, default=HERE, help="folder of report.json and report.md (default: next to this file)")
    options = parser.parse_args()
    for name in ("seeds", "episodes", "workers"):
        sizes.check(name, getattr(options, name))
    jobs: list[Job] = []
    suites = read_yaml(HERE / "record.yaml", "record")["suites"]
    if strange := [name for name in options.suite or () if name not in suites]:
        raise SystemExit(f"record: --suite: got {strange[0]!r}; expected one of {', '.join(suites)}")
    order = [(scenario, dose, defence) for cells in suites.values() for scenario, dose, defence in cells]
    known = {_cell(line): line for line in load_json(options.report / "report.json")} if options.suite else {}
    for name, cells in suites.items():
        if options.suite and name not in options.suite:
            continue
        suite = load_suite(name)
        for scenario, dose, defence in cells:
            arena = Arena(name, scenario, dose, defence, dict(suite.granted), suite.bound, suite.progress)
            jobs += [Job(arena, "quick", seed, ()) for seed in range(options.seeds)]
    options.out.mkdir(parents=True, exist_ok=True)
    with alone(options.out), progress(Console(stderr=True)) as update:
        files = [options.out / f"{job.name}.json" for job in jobs]
        left = [i for i, file in enumerate(files) if not file.is_file()]
        for done, (number, result) in enumerate(each(searched, [(jobs[i], options.out) for i in left], options.workers)):
            write_atomic(files[left[number]], json.dumps(result, indent=1).encode() + b"\n")
            job = jobs[left[number]]
            update("record", done + 1, len(left), f"{job.arena.scenario}, {job.arena.defence}, seed {job.seed}")
        for i in range(0, len(jobs), options.seeds):
            runs = [json.loads(file.read_text()) for file in files[i : i + options.seeds]]
            try:
                line = compared(jobs[i].arena, runs, options.episodes)
                known[_cell(line)] = line
            except NotApplicable as error:
                print(f"{jobs[i].arena.defence}: {error}")
    out = [known[cell] for cell in order if cell in known]
    verdicts(out)
    write_atomic(options.report / "report.json", json.dumps(out, indent=1).encode() + b"\n")
    page = markdown(out, options)
    write_atomic(options.report / "report.md", page.encode())
    print(page)


if __name__ == "__main__":
    main()
