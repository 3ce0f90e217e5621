"""How strong the learned attacks are: no attack, the best script, learned, yoked and optimal, in every cell of adversaries.yaml.

    python benchmarks/adversaries.py [CELL ...] [--seeds 5] [--episodes 1000] [--out results/adversaries-v0] [--zoo]

Trains each learner of every cell (one process per training seed; finished policies are not trained again), plays them on report seeds,
and writes report.json, report.md and a picture, in which cells that are not named stay as they are. The learner that speaks for a cell is
chosen on select seeds. `--zoo` puts its policies into the package. Best on an otherwise idle machine: training times are recorded.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tailgate import comparison, stats, train
from tailgate.adaptive import train_against
from tailgate.errors import unknown
from tailgate.evaluation import cells_of, run
from tailgate.files import write_atomic
from tailgate.plots import canvas, png
from tailgate.progress import progress
from tailgate.rivals import BATCH, outcomes
from tailgate.rows import read_rows
from tailgate.schema import as_data, read_yaml

HERE = Path(__file__).parent
RISING = 0.05  # of the whole rise of the learning curve, that its last tenth may bring
PARTS = ("a moment to choose", "none to choose", "linear")  # of the record; where there is none, values alone are learned
QUESTIONS = ("no attack", "own yoked schedule", "best scripted attack")


def configured(name: str, cell: dict[str, Any], learner: str, options: argparse.Namespace) -> train.TrainConfig:
    """The configuration of a learner in a cell."""
    own = [f"name={name}-{learner}", f"out={options.runs}", f"seeds={options.seeds}", "tensorboard=false", f"learner={learner}"]
    lists = [f"{key}={json.dumps(cell[key])}" for key in ("rivals", "teacher") if key in cell]
    changes = [f"episodes={options.episodes}", "others=[]", *(cell["set"] or []), *lists, *(cell["learners"][learner] or []), *own]
    return train.load_config(cell["config"], changes)


def minutes(config: train.TrainConfig) -> float:
    """Of processor time for all training seeds, shared by so many processes at a time."""
    seconds = [json.loads((config.directory / f"curve-{seed}.json").read_text())["seconds"] for seed in range(config.seeds)]
    return float(np.sum(seconds) / 60.0 / min(config.workers, config.seeds))


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
        reports[learner] |= {"minutes": minutes(config), "select": chosen[learner], "flags": flags(config, reports[learner], scripts.rows)}
    best = max(reports, key=lambda learner: float(np.mean(chosen[learner])))
    out = {"best": best, "learners": reports}
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
    """A report as the tables show it."""
    values = {item["label"]: item["value"] for item in report["attacks"]}
    learned = [v for k, v in values.items() if k.startswith("learned") and not k.endswith("yoked")]
    yoked = [v for k, v in values.items() if k.endswith("yoked")]
    return {"none": values["no attack"], "script": values[report["best_scripted"]], "learned": learned, "yoked": yoked}


def judged(cells: dict[str, Any]) -> dict[str, dict[str, str]]:
    """A verdict on each question of each cell's chosen learner, corrected after Holm for the cells that are asked it."""
    out: dict[str, dict[str, str]] = {name: {} for name in cells}
    for question in QUESTIONS:
        gains = {}
        for name, cell in cells.items():
            report = cell["learners"][cell["best"]]
            row = line(report)
            others = {"no attack": row["none"], "best scripted attack": row["script"], "own yoked schedule": np.array(row["yoked"])}
            gains[name] = report["advantage"][question], (np.array(row["learned"]) - others[question]).tolist()
        for name, word in corrected(gains).items():
            out[name][question] = word
    for name, word in corrected({name: (cell["champion"]["gain"], []) for name, cell in cells.items()}).items():
        out[name]["champion"] = word
    return out


def corrected(asked_of: dict[str, tuple[dict[str, float], list[float]]]) -> dict[str, str]:
    """A word for each difference, given with that of each training seed, after Holm for all together; `same` where no episode differs."""
    gains = {name: gain for name, (gain, _) in asked_of.items()}
    asked = [name for name, gain in gains.items() if gain["low"] < gain["high"]]
    adjusted = dict(zip(asked, stats.holm([p_value(*asked_of[name]) for name in asked]), strict=True))
    words = {name: "wins" if gain["value"] > 0 else "loses" for name, gain in gains.items()}
    return {name: "same" if name not in adjusted else "undecided" if adjusted[name] >= 0.05 else words[name] for name in gains}


def p_value(gain: dict[str, float], seeds: list[float]) -> float:
    """Two-sided, of a difference of 0: 1 less the level at which its interval, as `stats.paired_difference` makes it, ends there.

    seeds: the difference of each training seed, whose part of the interval is Student's t and has wider tails than that of the episodes.
    """
    from scipy import optimize
    from scipy.stats import norm, t

    size = abs(gain["value"])
    reach = gain["value"] - gain["low"] if gain["value"] > 0 else gain["high"] - gain["value"]
    runs = len(seeds)
    of_seeds = float(np.std(seeds, ddof=1) / np.sqrt(runs)) if runs > 1 else 0.0
    wide = float(t.ppf(0.975, runs - 1)) * of_seeds if runs > 1 else 0.0
    of_episodes = float(np.sqrt(max(reach**2 - wide**2, 0.0)) / norm.ppf(0.975))

    def beyond(log_p: float) -> float:
        half = np.exp(log_p) / 2.0
        return float(np.hypot(norm.isf(half) * of_episodes, t.isf(half, runs - 1) * of_seeds if runs > 1 else 0.0)) - size

    least = -600.0  # of a logarithm: beyond it nothing is told apart
    return 0.0 if beyond(least) < 0.0 else float(np.exp(optimize.brentq(beyond, least, 0.0)))


def part_of(cell: dict[str, Any]) -> str:
    """Of PARTS that of a cell."""
    report = cell["learners"][cell["best"]]
    return PARTS[2 if report.get("ceilings") else 0 if cell["moment"] and report["threat"]["budget"] is not None else 1]


def learners_of(cells: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    """(cell, learner, report) of all."""
    return [(name, learner, report) for name, cell in cells.items() for learner, report in cell["learners"].items()]


def spread(report: dict[str, Any], values: list[float]) -> str:
    """The median, the least and the largest."""
    low, mid, high = (comparison.shown(report, float(f(values))) for f in (np.min, np.median, np.max))
    return f"{mid} ({low} to {high})"


def markdown(cells: dict[str, Any]) -> str:
    """The record as people read it."""
    out = [
        "# Learned attacks, cell by cell", "",
        "`python benchmarks/adversaries.py` makes this page. Every figure is of fresh report seeds, at equal knowledge, bounds, dose.",
        "Learned: the median over training seeds, with the least and the largest, of the learner that did best on select seeds. The best",
        "script is chosen on select seeds. Differences are paired, with 95 % intervals over episodes and training seeds; each verdict is",
        "corrected (Holm) for the cells of its column. *same*: no episode differs, as the attack's times are the same in all of them.",
        "Champion: of all learners and seeds the one policy that did best on select seeds, as the script was chosen. On the linear",
        "scenarios the best attack is computed (*Ceilings*). There is no moment to choose without a budget, as every step is attacked,",
        "nor where the best time is the same in every episode (`moment: false` in adversaries.yaml says where, and what was measured).", "",
        "| cell | dose | no attack | best script | learned | by | yoked | over no attack | over yoked | over script | champion over it |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    verdicts = judged(cells)
    for name, cell in cells.items():
        report = cell["learners"][cell["best"]]
        row, gains = line(report), []
        for question in QUESTIONS:
            low, value, high = (comparison.shown(report, report["advantage"][question][k], "+") for k in ("low", "value", "high"))
            gains.append(f"{value} [{low}, {high}] **{verdicts[name][question]}**")
        dose = report["threat"]["budget"] or "unlimited"
        script = f"{comparison.shown(report, row['script'])}: `{report['best_scripted']}`"
        yoked = comparison.shown(report, float(np.median(row["yoked"])))
        none, learned = comparison.shown(report, row["none"]), spread(report, row["learned"])
        low, value, high = (comparison.shown(report, cell["champion"]["gain"][k], "+") for k in ("low", "value", "high"))
        gains.append(f"{value} [{low}, {high}] **{verdicts[name]['champion']}**")
        out.append(f"| {' | '.join([name, str(dose), none, script, learned, cell['best'], yoked, *gains])} |")
    thirds = {part: [name for name, cell in cells.items() if part_of(cell) == part] for part in PARTS}
    out += ["", "| wins, same, undecided, loses | " + " | ".join(f"{part} ({len(of)})" for part, of in thirds.items()) + " | all |"]
    out += ["|---|" + "---|" * (len(thirds) + 1)]
    for question in (*QUESTIONS, "champion"):
        what = "champion over the best script" if question == "champion" else f"over {question}"
        counts = []
        for names in (*thirds.values(), list(cells)):
            found = [verdicts[name][question] for name in names]
            counts.append(", ".join(str(found.count(word)) for word in ("wins", "same", "undecided", "loses")))
        out.append(f"| {' | '.join([what, *counts])} |")
    out += [
        "", "## Every learner", "",
        "| cell | learner | shown first | decisions | learned | best on select | yoked | over the best script | training [min] |",
        "|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for name, learner, report in learners_of(cells):
        row, gain = line(report), report["advantage"]["best scripted attack"]
        best = comparison.shown(report, row["learned"][int(np.argmax(report["select"]))])
        low, value, high = (comparison.shown(report, gain[k], "+") for k in ("low", "value", "high"))
        yoked = comparison.shown(report, float(np.median(row["yoked"])))
        shown_first = f"`{report['teacher']}`" if report["teacher"] else "nothing"
        parts = [
            name, learner, shown_first, f"{report['steps']:,}", spread(report, row["learned"]), best, yoked, f"{value} [{low}, {high}]",
            f"{report['minutes']:.1f}",
        ]  # fmt: skip
        out.append(f"| {' | '.join(parts)} |")
    out += ["", "Training: minutes of processor time for all seeds, halved for two processes, without the choice of what is shown.", ""]
    out += ["## Ceilings", "", "| cell | learner | computed optimum | its outcome | share that each seed reaches |"]
    out += ["|---|---|---|---|---|"]
    for name, learner, report in learners_of(cells):
        for attack, ceiling in report.get("ceilings", {}).items():
            reached = ", ".join(f"{100 * s['value']:.1f} % [{100 * s['low']:.1f}, {100 * s['high']:.1f}]" for s in ceiling["reached"])
            out.append(f"| {name} | {learner} | `{attack}` | {comparison.shown(report, ceiling['outcome']['value'])} | {reached} |")
    out += ["", "## Threat models", "", "| cell | knowledge | kinds |", "|---|---|---|"]
    for name, cell in cells.items():
        threat = cell["learners"][cell["best"]]["threat"]
        out.append(f"| {name} | {threat['knowledge']} box | {', '.join(threat['kinds'])} |")
    out += ["", "## Flags", ""]
    out += [f"- {name}, {learner}: {text}" for name, learner, report in learners_of(cells) for text in report["flags"]] or ["None."]
    return "\n".join(out) + "\n"


def picture(cells: dict[str, Any]) -> bytes:
    """A panel for each cell: no attack, yoked, best script, learned seeds of the chosen learner, optimum."""
    columns, reports = 3, {name: cell["learners"][cell["best"]] for name, cell in cells.items()}
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


def lines(record: dict[str, Any]) -> str:
    """JSON, a line for each cell."""
    return "{\n" + ",\n".join(f"{json.dumps(name)}: {json.dumps(cell)}" for name, cell in record.items()) + "\n}\n"


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
    record = {}
    for name in options.cells or cells:
        record[name] = played(name, cells[name], options, console)
        record[name]["champion"] = champion(name, cells[name], record[name], options)
        best = record[name]["best"]
        console.print(f"{name}, {best}: {line(record[name]['learners'][best])}", highlight=False)
        if options.zoo:
            from tailgate.strength.collect import add_run

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
