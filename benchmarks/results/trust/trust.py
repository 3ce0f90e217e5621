"""The record of model checking: exact error rates of the rules, and P(no collision) of every defence against every attack of quick-v0.

    python benchmarks/results/trust/trust.py [--precision 0.03] [--confidence 0.99] [--workers 2] [--out FILE]
    python benchmarks/results/trust/trust.py --collisions --precision 0.01 --folder runs/collisions [--out FILE]

With --collisions nothing but P(no collision) is asked, for which runs are counted without a trace: a finer record in less time.
Each probability is known to within the precision at the confidence, whatever it is: the number of runs of a cell is fixed beforehand.
Finished cells are kept in --folder, so that an interrupted record goes on.
"""

import dataclasses
import json
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tailgate.base.progress import cells, progress
from tailgate.bench.study import arguments, made_by, write_record
from tailgate.core.scenario import load_suite
from tailgate.trust.run import check
from tailgate.trust.statistics import Sequential, Sprt, interval, okamoto, runs_for

SUITE = "quick-v0"
LITERAL = "G[0,59.3] (gap < 20 -> F[0,0.6] applied <= -2)"  # the thesis's query, as printed
OURS = "G[0,59.3] (margin < 0 -> F[0,0.6] applied <= -2)"
NO_COLLISION = "G (gap > 0 and rear_gap > 0)"  # the built-in property, alone


def simulated(rule: Sequential, p: float, runs: int, seed: int = 0) -> float:
    """Share of simulated sequences whose interval, at the run at which the rule stops, holds p."""
    outcomes = np.random.default_rng(seed).random((runs, rule.ends[-1][0])) < p
    held = {}
    hits = 0
    for sequence in outcomes:
        verdict = rule.stop(sequence)
        assert verdict is not None
        at = int(sequence[: verdict.runs].sum()), verdict.runs
        if at not in held:
            held[at] = interval(*at, rule.level)
        hits += held[at].low <= p <= held[at].high
    return hits / runs


def rules(runs: int) -> dict[str, Any]:
    """What the rules that stop early are worth, exactly and by simulation."""
    rule = Sequential(0.1)
    worst, at = rule.worst_coverage()
    test = Sprt(0.85, 0.9, 0.05, 0.05)
    rng = np.random.default_rng(1)
    said = {p: [test.stop(outcomes) for outcomes in rng.random((runs // 4, 4000)) < p] for p in (test.low, test.high)}
    return {
        "36 of 36": interval(36, 36)._asdict(), "stops at": rule.stop(np.ones(50, bool)).runs,  # type: ignore[union-attr]
        "sequential": {
            "width": rule.width, "level": rule.level, "worst_coverage": worst, "at": at, "simulated": simulated(rule, at, runs),
            "sequences": runs,
        },
        "sprt": {
            "low": test.low, "high": test.high, "alpha": test.alpha, "beta": test.beta,
            "rejects_at_high": test.rates(test.high).rejects, "accepts_at_low": test.rates(test.low).accepts,
            "mean_runs": {str(p): test.rates(p).runs for p in (0.8, test.low, 0.875, test.high, 0.95)},
            "simulated": {
                "rejects_at_high": float(np.mean([v is not None and v.holds is False for v in said[test.high]])),
                "accepts_at_low": float(np.mean([v is not None and v.holds is True for v in said[test.low]])), "sequences": runs // 4,
            },
        },
    }  # fmt: skip


def processor_seconds() -> float:
    """Of this process and of those that it has waited for."""
    return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))


def main() -> None:
    parser = arguments(__file__, __doc__)
    parser.add_argument("--precision", type=float, default=0.03, help="how far a share may be off")
    parser.add_argument("--confidence", type=float, default=0.99, help="how surely")
    parser.add_argument("--collisions", action="store_true", help="P(no collision) alone, counted without traces")
    parser.add_argument("--runs", type=int, help="runs of a cell instead, for a try")
    parser.add_argument("--defence", action="append", help="only this defence (repeatable), for a try")
    parser.add_argument("--sequences", type=int, default=40_000, help="simulated sequences of a rule")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("runs/trust"), help="rows of cells and failing runs")
    options = parser.parse_args()
    if options.collisions and options.out == parser.get_default("out"):
        options.out = options.out.with_name("collisions.json")
    runs = options.runs or runs_for(options.precision, options.confidence)
    found: dict[str, Any] = {}
    if not options.collisions:
        found = {"rules": rules(options.sequences)}
        print(json.dumps(found["rules"], indent=1))
    suite = load_suite(SUITE)
    if options.defence:
        suite = dataclasses.replace(suite, defences=tuple(options.defence))
    check(dataclasses.replace(suite, defences=("kf",), attacks=("none",)), runs=1)  # what compiles, compiles here, once
    started, used = time.perf_counter(), processor_seconds()
    with progress(Console(stderr=True)) as update:
        report = check(
            suite, runs=runs, formulas=[NO_COLLISION] if options.collisions else [], workers=options.workers, folder=options.folder,
            progress=lambda done, total: update(SUITE, done, total, cells(done, total)),
        )  # fmt: skip
    seconds = {"wall": round(time.perf_counter() - started, 1), "processor": round(processor_seconds() - used, 1)}
    table = []
    for cell in report["cells"]:
        row = {key: cell[key] for key in ("defence", "attack", "scenario", "n", "reason")}
        share = next((p["share"] for p in cell["properties"] if p["name"] in ("no_collision", NO_COLLISION)), None)
        if share is not None:
            at = interval(share["k"], share["n"], options.confidence)
            row |= {"k": share["k"], "value": at.value, "low": at.low, "high": at.high}
            if not options.collisions:
                row["others"] = {p["name"]: {"share": p["share"], "antecedent": p["antecedent"]} for p in cell["properties"] if p["share"]}
        table.append(row)
    reach = max(max(row["value"] - row["low"], row["high"] - row["value"]) for row in table if "k" in row)
    bound = okamoto(options.precision, 1.0 - options.confidence)
    print(f"{len(table)} cells of {runs} runs (Okamoto's bound: {bound}), ends within {reach:.4f} of their shares, {seconds}")
    if not options.collisions:
        clean = dataclasses.replace(suite, attacks=("none",))
        literal = check(clean, runs=min(runs, 200), formulas=[LITERAL, OURS], workers=options.workers)
        found["clean"] = [
            {"defence": c["defence"], "scenario": c["scenario"], **{p["name"]: p["share"] for p in c["properties"]}}
            for c in literal["cells"]
        ]  # fmt: skip
    found |= {
        "suite": SUITE, "runs": runs, "confidence": options.confidence, "reach": reach, "seconds": seconds, "cells": table,
        "bounds": [{key: entry[key] for key in ("defence", "trust", "safety", "why") if key in entry} for entry in report["defences"]],
        "workers": options.workers, **made_by("numpy"),
    }  # fmt: skip
    write_record(options.out, found, by_lines=True)


if __name__ == "__main__":
    main()
