"""How strong the learned attacks are: no attack, the best script, learned, yoked and optimal, in every cell of adversaries.yaml.

    python results/adversaries-v0/adversaries.py [CELL ...] [--seeds 5] [--episodes 1000] [--first-episode N] [--out DIR] [--zoo]

Searches a cell's scripts on tune seeds, trains each of its learners (one process per training seed; finished policies are not trained
again), plays them on report seeds, and writes report.json, report.md and a picture, in which cells that are not named stay as they are.
Best scripts and the learner that speaks for a cell are chosen on select seeds. `--zoo` puts its policies into the package. Best on
an otherwise idle machine: training times are recorded.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from adversaries_page import learners_of, line, lines, markdown, picture
from rich.console import Console
from script_search import found

from tailgate.base.errors import unknown
from tailgate.base.files import write_atomic
from tailgate.base.progress import progress
from tailgate.core.schema import as_data, read_yaml
from tailgate.evaluation import stats
from tailgate.evaluation.baselines import BATCH, outcomes
from tailgate.evaluation.cells import cells_of, run
from tailgate.evaluation.rows import read_rows
from tailgate.training import comparison, train
from tailgate.training.adaptive import train_against

HERE = Path(__file__).parent
FIRST_EPISODE = 20261124  # of the report: a block that no setting was ever played on
AIM = 10  # minutes of training on two cores
RISING = 0.05  # of the whole rise of the learning curve, that its last tenth may bring


def configured(name: str, cell: dict[str, Any], learner: str, options: argparse.Namespace) -> train.TrainConfig:
    """The configuration of a learner in a cell."""
    own = [f"name={name}-{learner}", f"out={options.runs}", f"seeds={options.seeds}", "tensorboard=false", f"learner={learner}"]
    lists = [f"{key}={json.dumps(cell[key])}" for key in ("rivals", "teacher") if key in cell]
    report = [f"episodes={options.episodes}", f"first_episode={options.first_episode}", "others=[]"]
    changes = [*report, *(cell["set"] or []), *lists, *(cell["learners"][learner] or []), *own]
    return train.load_config(cell["config"], changes)


def with_found(name: str, cell: dict[str, Any], options: argparse.Namespace) -> dict[str, Any]:
    """A cell whose rivals are those that it lists and those that a search of its templates finds, which is done once."""
    if not cell.get("search"):
        return cell
    first = configured(name, cell, next(iter(cell["learners"])), options)
    file, wanted = Path(options.runs) / name / "scripts.json", [cell["search"], train.training_of(as_data(first))]
    if not file.is_file() or (kept := json.loads(file.read_text()))["of"] != wanted:
        kept = {"of": wanted, "found": found(first, cell["search"], cell.get("search_share", 1.0))}
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(file, json.dumps(kept, indent=1).encode() + b"\n")
    return cell | {"rivals": list(dict.fromkeys([*first.rivals, *kept["found"]])), "found": kept["found"]}


def minutes(config: train.TrainConfig) -> float:
    """Processor time of all training seeds, given one after the other to whichever process is free first."""
    busy = [0.0] * config.workers
    for seed in range(config.seeds):
        busy[int(np.argmin(busy))] += json.loads((config.directory / f"curve-{seed}.json").read_text())["seconds"] / 60.0
    return max(busy)


def played(name: str, cell: dict[str, Any], options: argparse.Namespace, console: Console) -> dict[str, Any]:
    """The record of a cell: a report for each learner, and which one speaks for it."""
    configs = {learner: configured(name, cell, learner, options) for learner in cell["learners"]}
    with progress(console) as update:
        policies = {learner: train_against([config], update) for learner, config in configs.items()}
    held = {learner: [json.loads(path.read_text())["sha256"] for path in found] for learner, found in policies.items()}
    file, wanted = Path(options.runs) / name / "cell.json", json.loads(json.dumps([as_data(list(configs.values())), held]))
    if file.is_file() and (kept := json.loads(file.read_text()))["of"] == wanted:
        return dict(kept["cell"])
    first = next(iter(configs.values()))
    everyone = [path for found in policies.values() for path in found]
    with progress(console) as update:
        chosen = {learner: chosen_by(configs[learner], found) for learner, found in policies.items()}
        scripts = comparison.play_scripts(first, everyone, lambda done, of: update(f"{name}: episodes", done, of))
    reports = {}
    for learner, config in configs.items():
        reports[learner] = comparison.compare(config, policies[learner], scripts=scripts)
        reports[learner] |= {
            "minutes": minutes(config), "select": chosen[learner], "sha256": held[learner],
            "copies": copies(config, reports[learner], scripts.rows), "flags": flags(config, reports[learner], scripts.rows),
        }  # fmt: skip
    best = max(reports, key=lambda learner: (not reports[learner]["copies"], float(np.mean(chosen[learner]))))
    out = {"best": best, "found": cell.get("found", []), "learners": reports}
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(file, json.dumps({"of": wanted, "cell": out}, indent=1).encode() + b"\n")
    return out


def champion(name: str, cell: dict[str, Any], record: dict[str, Any], options: argparse.Namespace) -> dict[str, Any]:
    """The one policy of a cell that did best on select seeds, against the script that did: both chosen alike, both on report seeds."""
    configs = {learner: configured(name, cell, learner, options) for learner in cell["learners"]}
    tried = [(learner, i, x) for learner, report in record["learners"].items() for i, x in enumerate(report["select"])]
    learner, seed, _ = max(tried, key=lambda item: item[2])
    config, report = configs[learner], record["learners"][learner]
    rows = [row for row in read_rows(next(iter(configs.values())).directory / "rows.jsonl") if row["defence"] == config.defence]
    counted = train.outcome_of(config)
    own, script = (
        outcomes([row for row in rows if row["attack"] == text], counted)
        for text in (str(config.directory / f"policy-{seed}.json"), report["best_scripted"])
    )
    gain = stats.paired_difference(own, script, share=report["unit"] == comparison.SHARE)
    return {"learner": learner, "seed": seed, "value": float(own.mean()), "gain": gain._asdict()}


def chosen_by(config: train.TrainConfig, policies: list[Path]) -> list[float]:
    """The mean outcome of each policy on the episodes that the best script is chosen on."""
    n = config.select_episodes
    suite = train.Suite("choice", "", (config.scenario,), (None,), (config.defence,), tuple(map(str, policies)), n)
    rows = run(cells_of(suite, batch=BATCH, purpose="select", threat=dict(config.threat)), workers=config.workers)
    counted = train.outcome_of(config)
    return [float(outcomes(rows[i * n : (i + 1) * n], counted).mean()) for i in range(len(policies))]


def copies(config: train.TrainConfig, report: dict[str, Any], rows: list[dict[str, Any]]) -> bool:
    """Whether every seed ends where what it was shown does, in every episode: then it learned nothing of its own."""
    shown, counted = report["teacher"], train.outcome_of(config)
    if shown not in config.rivals:
        return False
    rows = [row for row in rows if row["defence"] == config.defence]
    script, *learned = (outcomes([row for row in rows if row["attack"] == name], counted) for name in (shown, *report["policies"]))
    return all(bool(np.array_equal(own, script)) for own in learned)


def flags(config: train.TrainConfig, report: dict[str, Any], rows: list[dict[str, Any]]) -> list[str]:
    """What a reader should know before he believes a learned attack (spec of the scores)."""
    out = []
    learned = [item["value"] for item in report["attacks"] if item["label"].startswith("learned") and "yoked" not in item["label"]]
    budget = report["threat"]["budget"]
    names = {str(Path(path)) for path in report["policies"]}
    rows = [row for row in rows if row["attack"] in names and row["defence"] == config.defence]
    spent = np.mean([row["attack_steps"] for row in rows if not row["crashed"]] or [np.nan])
    if budget is not None and spent < 0.9 * budget:
        out.append(f"unspent budget: {spent:.1f} of {budget} steps in episodes without a collision")
    for seed in train.seeds_of(config):
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
    if (took := minutes(config)) > AIM:
        out.append(f"{took:.1f} minutes of training, more than the {AIM} that were aimed at")
    if copies(config, report, rows):
        out.append("copies what it was shown: the same outcome in every episode, so that what it gains is the script's")
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cells", nargs="*", metavar="CELL", help="only these")
    parser.add_argument("--seeds", type=int, default=5, help="training seeds (default 5)")
    parser.add_argument("--episodes", type=int, default=1000, help="report episodes per attack (default 1000)")
    parser.add_argument("--first-episode", type=int, default=FIRST_EPISODE, help=f"number of the first (default {FIRST_EPISODE})")
    parser.add_argument("--runs", default="runs/adversaries", help="where the runs lie")
    parser.add_argument("--out", default="results/adversaries-v0", help="where the record goes")
    parser.add_argument("--zoo", action="store_true", help="put the policies into the package")
    options = parser.parse_args()
    console = Console(stderr=True)
    cells = read_yaml(HERE / "adversaries.yaml", "cells")
    for name in options.cells:
        if name not in cells:
            raise unknown("cell", name, cells)
    record = {}
    for name in options.cells or cells:
        cell = with_found(name, cells[name], options)
        record[name] = played(name, cell, options, console)
        record[name]["champion"] = champion(name, cell, record[name], options)
        best = record[name]["best"]
        console.print(f"{name}, {best}: {line(record[name]['learners'][best])}", highlight=False)
        if options.zoo:
            from tailgate.studies.collect import add_run

            add_run(Path(options.runs) / f"{name}-{best}", name, episodes=options.episodes, replace=True)
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    for _, _, report in learners_of(record):
        report.pop("policies", None)
    if (kept := out / "report.json").is_file():  # cells that were not asked for stay as they are
        record = json.loads(kept.read_text()) | record
        record = {name: record[name] for name in cells if name in record}
    for name, cell in record.items():
        cell["moment"] = cells[name].get("moment", True)
    write_atomic(out / "report.json", lines(record).encode())
    write_atomic(out / "report.md", markdown(record).encode())
    write_atomic(out / "adversaries.png", picture(record))


if __name__ == "__main__":
    main()
