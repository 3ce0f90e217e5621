"""How strong the learned attacks are: no attack, the best script, learned, yoked and optimal, in every cell of adversaries.yaml.

    python benchmarks/adversaries.py [CELL ...] [--seeds 5] [--episodes 1000] [--out results/adversaries-v0] [--zoo]

Trains every cell (one process per training seed; a finished cell is not trained again), plays it on report seeds, and writes report.json,
report.md and a picture. `--zoo` puts the policies into the package. Best on an otherwise idle machine: training times are recorded.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tailgate import comparison, train
from tailgate.errors import unknown
from tailgate.files import write_atomic
from tailgate.plots import canvas, png
from tailgate.progress import progress
from tailgate.rows import read_rows
from tailgate.schema import as_data, read_yaml

HERE = Path(__file__).parent
RISING = 0.05  # of the whole rise of the learning curve, that its last tenth may bring


def configured(name: str, cell: dict[str, Any], options: argparse.Namespace) -> train.TrainConfig:
    """The configuration of a cell."""
    own = [f"name={name}", f"out={options.runs}", f"seeds={options.seeds}", f"episodes={options.episodes}", "tensorboard=false"]
    lists = [f"{key}={json.dumps(cell[key])}" for key in ("rivals", "teacher") if key in cell]
    return train.load_config(cell["config"], [*cell["set"], *lists, *own])


def played(config: train.TrainConfig, console: Console) -> dict[str, Any]:
    """The report of a cell, trained and compared where that is not done yet."""
    report, snapshot = config.directory / "cell.json", config.directory / "config.json"
    begun = snapshot.is_file() and json.loads(snapshot.read_text()) == json.loads(json.dumps(as_data(config)))
    if begun and report.is_file():
        return dict(json.loads(report.read_text()))
    with progress(console) as update:
        started = time.perf_counter()

        def learned(seed: int, now: Any) -> None:
            update(f"{config.name}, seed {seed}", min(now.steps, config.steps), config.steps, train.figures(now))

        policies = train.train(config, learned, resume=begun)
        trained = time.perf_counter()
        done = comparison.compare(config, policies)
    done["minutes"] = {"training": (trained - started) / 60, "comparison": (time.perf_counter() - trained) / 60, "resumed": begun}
    write_atomic(report, json.dumps(done, indent=1).encode() + b"\n")
    return done


def flags(config: train.TrainConfig, report: dict[str, Any]) -> list[str]:
    """What a reader should know before he believes a learned attack (spec of the scores)."""
    out = []
    learned = [item["value"] for item in report["attacks"] if item["label"].startswith("learned") and "yoked" not in item["label"]]
    budget = report["threat"]["budget"]
    names = {str(Path(path)) for path in report["policies"]}
    rows = [row for row in read_rows(config.directory / "rows.jsonl") if row["attack"] in names and row["defence"] == config.defence]
    spent = np.mean([row["attack_steps"] for row in rows if not row["crashed"]] or [np.nan])
    if budget is not None and spent < 0.9 * budget:
        out.append(f"unspent budget: {spent:.1f} of {budget} steps in episodes without a collision")
    for seed in range(config.first_seed, config.first_seed + config.seeds):
        curve = [p["reward"] for p in json.loads((config.directory / f"curve-{seed}.json").read_text())["curve"]]
        tenth = max(len(curve) // 10, 1)
        rise, late = np.mean(curve[-tenth:]) - np.mean(curve[:tenth]), np.mean(curve[-tenth:]) - np.mean(curve[-2 * tenth : -tenth])
        noise = np.std(curve[-2 * tenth :]) / np.sqrt(tenth)
        if len(curve) >= 20 and rise > 0 and late > max(RISING * rise, 3.0 * noise):
            out.append(f"seed {seed} still rises: the last tenth brought {100 * late / rise:.0f} % of the rise")
    if report["advantage"]["own yoked schedule"]["low"] <= 0.0:
        out.append("yoked equals own: no timing was learned, or none is needed")
    row = line(report)
    if report["unit"] == comparison.SHARE and not 0.2 <= row["script"] <= 0.8:
        out.append(f"dose: the best script does {100 * row['script']:.0f} % of the possible damage, which is not within 20 to 80 %")
    if max(learned) - min(learned) > 0.2 * max(abs(np.mean(learned)), 1e-12):
        out.append(f"seeds differ: {min(learned):.3g} to {max(learned):.3g}")
    return out


def line(report: dict[str, Any]) -> dict[str, Any]:
    """A cell as the table shows it."""
    values = {item["label"]: item["value"] for item in report["attacks"]}
    learned = [v for k, v in values.items() if k.startswith("learned") and not k.endswith("yoked")]
    yoked = [v for k, v in values.items() if k.endswith("yoked")]
    return {"none": values["no attack"], "script": values[report["best_scripted"]], "learned": learned, "yoked": yoked}


def verdict(gain: dict[str, float]) -> str:
    return "wins" if gain["low"] > 0 else "loses" if gain["high"] < 0 else "undecided"


def markdown(reports: dict[str, dict[str, Any]], flagged: dict[str, list[str]]) -> str:
    """The record as people read it."""
    out = [
        "# Learned attacks, cell by cell", "",
        "`python benchmarks/adversaries.py` makes this page. Every figure is of fresh report seeds, at equal knowledge, bounds, dose.",
        "Learned: the median over training seeds, with the least and the largest. Differences are paired, with 95 % intervals over",
        "episodes and training seeds. The best script is chosen on select seeds.", "",
        "| cell | dose | no attack | best script | learned | yoked | over no attack | over yoked | over the best script | training [min] |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for name, report in reports.items():
        row = line(report)

        def shown(value: float, report: dict[str, Any] = report) -> str:
            return comparison.shown(report, value)

        def gain(key: str, report: dict[str, Any] = report) -> str:
            g = report["advantage"][key]
            low, value, high = (comparison.shown(report, g[k], "+") for k in ("low", "value", "high"))
            return f"{value} [{low}, {high}] **{verdict(g)}**"

        spread = f"{shown(float(np.median(row['learned'])))} ({shown(min(row['learned']))} to {shown(max(row['learned']))})"
        dose = report["threat"]["budget"] or "unlimited"
        script = f"{shown(row['script'])}: `{report['best_scripted']}`"
        gains = [gain(key) for key in ("no attack", "own yoked schedule", "best scripted attack")]
        minutes = f"{report['minutes']['training']:.1f}"
        yoked = shown(float(np.median(row["yoked"])))
        out.append(f"| {' | '.join([name, str(dose), shown(row['none']), script, spread, yoked, *gains, minutes])} |")
    out += ["", "## Ceilings", "", "| cell | computed optimum | its outcome | share that each seed reaches |", "|---|---|---|---|"]
    for name, report in reports.items():
        for attack, ceiling in report.get("ceilings", {}).items():
            reached = ", ".join(f"{100 * s['value']:.1f} % [{100 * s['low']:.1f}, {100 * s['high']:.1f}]" for s in ceiling["reached"])
            out.append(f"| {name} | `{attack}` | {comparison.shown(report, ceiling['outcome']['value'])} | {reached} |")
    out += ["", "## How each was trained", "", "| cell | learner | shown | decisions | threat model |", "|---|---|---|---|---|"]
    for name, report in reports.items():
        threat = report["threat"]
        kinds = ", ".join(threat["kinds"])
        shown_first = report["teacher"] or "nothing"
        out.append(f"| {name} | {report['learner']} | {shown_first} | {report['steps']:,} | {threat['knowledge']} box; {kinds} |")
    out += ["", "## Flags", ""]
    out += [f"- {name}: {text}" for name, texts in flagged.items() for text in texts] or ["None."]
    return "\n".join(out) + "\n"


def picture(reports: dict[str, dict[str, Any]]) -> bytes:
    """A panel for each cell: no attack, yoked, best script, learned seeds, optimum."""
    columns = 3
    rows = -(-len(reports) // columns)
    figure, axes = canvas(12.0, 1.0 + 1.75 * rows, rows, columns)
    for axis in axes.flat[len(reports) :]:
        axis.axis("off")
    for axis, (name, report) in zip(axes.flat, reports.items(), strict=False):
        row, share = line(report), report["unit"] == comparison.SHARE
        scale = 100.0 if share else 1.0
        kinds = [
            ("no attack", [row["none"]], "x", "#777777"), ("yoked", row["yoked"], "v", "#b26a00"),
            ("best script", [row["script"]], "s", "#1f5fa8"), ("learned", row["learned"], "o", "#b3123b"),
        ]  # fmt: skip
        kinds += [("optimum", [ceiling["outcome"]["value"]], "D", "#1b7837") for ceiling in report.get("ceilings", {}).values()]
        for y, (_, values, marker, colour) in enumerate(kinds):
            axis.plot([scale * v for v in values], [y] * len(values), marker, color=colour, markersize=7, alpha=0.75)
        axis.set_yticks(range(len(kinds)), [kind[0] for kind in kinds])
        axis.set_ylim(-0.6, len(kinds) - 0.4)
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("collisions [%]" if share else report["outcome"], fontsize=8)
        if share:
            axis.set_xlim(-3, 103)
        axis.grid(axis="x", alpha=0.3)
    return png(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cells", nargs="*", metavar="CELL", help="only these")
    parser.add_argument("--seeds", type=int, default=5, help="training seeds (default 5)")
    parser.add_argument("--episodes", type=int, default=1000, help="report episodes per attack (default 1000)")
    parser.add_argument("--runs", default="runs/adversaries", help="where the runs lie")
    parser.add_argument("--out", default="results/adversaries-v0", help="where the record goes")
    parser.add_argument("--zoo", action="store_true", help="put the policies into the package")
    options = parser.parse_args()
    console = Console(stderr=True)
    cells = read_yaml(HERE / "adversaries.yaml", "cells")
    for name in options.cells:
        if name not in cells:
            raise unknown("cell", name, cells)
    reports, flagged = {}, {}
    for name in options.cells or cells:
        config = configured(name, cells[name], options)
        reports[name] = played(config, console)
        flagged[name] = flags(config, reports[name])
        row = line(reports[name])
        console.print(f"{name}: {row}", highlight=False)
        if options.zoo:
            from tailgate.strength.collect import add_run

            add_run(config.directory, name, episodes=options.episodes, replace=True)
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    kept = {name: {k: v for k, v in report.items() if k != "policies"} for name, report in reports.items()}
    write_atomic(out / "report.json", json.dumps({"cells": kept, "flags": flagged}, indent=1).encode() + b"\n")
    write_atomic(out / "report.md", markdown(reports, flagged).encode())
    write_atomic(out / "adversaries.png", picture(reports))


if __name__ == "__main__":
    main()
