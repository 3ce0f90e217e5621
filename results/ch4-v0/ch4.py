"""Chapter 4 on longer roads than the thesis has: every defence against every attack on minutes of driving.

python results/ch4-v0/ch4.py [--seeds 100] [--out results/ch4-v0]
"""

import argparse
import json
import platform
import time
from pathlib import Path

from rich.console import Console

import tailgate
from tailgate.base.files import write_atomic
from tailgate.base.plots import write_overview
from tailgate.base.progress import cells, progress
from tailgate.core.scenario import load_suite
from tailgate.evaluation.cells import evaluate
from tailgate.evaluation.summary import summarise

SUITES = ("ch4-long-v0", "ch4-actuator-v0")
FILTERPY = ("filterpy_kf", "filterpy_ekf", "filterpy_ukf", "filterpy_hinfinity", "filterpy_imm")
FIELDS = (
    "suite", "scenario", "dose", "defence", "attack", "knowledge", "n", "crash", "min_gap", "rmse_position", "max_error", "alarm_onsets",
)  # fmt: skip
FILTERPY_SEEDS = 8  # one object per episode: slow


def markdown(table, places):
    """Per scenario a matrix: share of collisions, and below it the median of the smallest gap and of the position error."""
    lines = []
    for scenario, dose in places:
        here = [e for e in table if (e["scenario"], e["dose"]) == (scenario, dose)]
        attacks = list(dict.fromkeys(e["attack"] for e in here))
        lines += ["", f"## {scenario}, budget {dose} steps", ""]
        lines += ["In each cell: collisions; smallest gap (median) / position RMSE (median).", ""]
        lines += ["| defence | " + " | ".join(f"`{name}`" for name in attacks) + " |", "|---" * (len(attacks) + 1) + "|"]
        for name in dict.fromkeys(e["defence"] for e in here):
            row = {e["attack"]: e for e in here if e["defence"] == name}
            lines.append(f"| `{name}` | " + " | ".join(cell(row[attack]) for attack in attacks) + " |")
    return lines


def cell(entry):
    if entry["crash"] is None:
        return "not applicable"
    return f"**{100 * entry['crash']['value']:.0f} %**; {entry['min_gap']['median']:.1f} m / {entry['rmse_position']['median']:.2g} m"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", default="results/ch4-v0")
    options = parser.parse_args()
    out, errors = Path(options.out), Console(stderr=True)
    seconds, table = {}, []
    for name in SUITES:
        begun = time.perf_counter()
        with progress(errors) as update:
            rows = evaluate(
                name, seeds=options.seeds, workers=options.workers,
                progress=lambda done, total, name=name, update=update: update(name, done, total, cells(done, total)),
            )  # fmt: skip
        table += summarise(rows)
        seconds[name] = time.perf_counter() - begun
    begun, suite = time.perf_counter(), load_suite(SUITES[0])
    with progress(errors) as update:
        rows = evaluate(
            suite, defences=FILTERPY, scenarios=["stop-and-go-v0"], seeds=FILTERPY_SEEDS, workers=options.workers,
            progress=lambda done, total: update("filterpy", done, total, cells(done, total)),
        )  # fmt: skip
    slow = summarise(rows)
    seconds["filterpy"] = time.perf_counter() - begun
    places = list(dict.fromkeys((e["scenario"], e["dose"]) for e in table))
    text = [
        "# Chapter 4 on minutes of driving", "",
        f"`python results/ch4-v0/ch4.py`: suites {' and '.join(SUITES)}, {options.seeds} report seeds a cell; "
        f"Tailgate {tailgate.__version__}, Python {platform.python_version()}, {options.workers} workers; seconds: "
        + ", ".join(f"{key} {value:.0f}" for key, value in seconds.items()) + ".", "",
        "![position error against smallest gap](rmse-against-gap.png)", "",
        *(f"![{scenario}]({path.name})" for (scenario, _), path in zip(places, write_overview(table, out), strict=False)),
        *markdown(table, places), "", f"# filterpy's filters, {FILTERPY_SEEDS} seeds a cell", *markdown(slow, [("stop-and-go-v0", 50)]),
    ]  # fmt: skip
    write_atomic(out / "long.md", ("\n".join(text) + "\n").encode())
    kept = [{key: entry[key] for key in FIELDS if key in entry} for entry in table + slow]
    write_atomic(out / "long.json", ("[\n" + ",\n".join(json.dumps(entry, allow_nan=False) for entry in kept) + "\n]\n").encode())


if __name__ == "__main__":
    main()
