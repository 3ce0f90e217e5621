"""The record of learned attacks as people read it: verdicts, tables and the picture."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from tailgate.base.plots import canvas, png
from tailgate.evaluation import stats
from tailgate.training import comparison

PARTS = ("a moment to choose", "none to choose", "linear")  # of the record; where there is none, values alone are learned
QUESTIONS = ("no attack", "own yoked schedule", "best scripted attack")


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


def marked(name: str, cell: dict[str, Any]) -> str:
    """The name of a cell; with a dagger where it was not played on fresh episodes, against searched scripts."""
    return name if "found" in cell else f"{name} \u2020"


def spread(report: dict[str, Any], values: list[float]) -> str:
    """The median, the least and the largest."""
    low, mid, high = (comparison.shown(report, float(f(values))) for f in (np.min, np.median, np.max))
    return f"{mid} ({low} to {high})"


def markdown(cells: dict[str, Any]) -> str:
    """The record as people read it."""
    out = [
        "# Learned attacks, cell by cell", "",
        "`python results/adversaries-v0/adversaries.py` makes this page. Every figure is of report episodes that no setting was ever",
        "played on (of a cell with a dagger: on the public ones, where earlier settings had been played, and against listed scripts",
        "alone), at equal knowledge, bounds, dose. Learned: the median over training seeds, with the least and the largest, of the",
        "learner that did best on select seeds. The best script is chosen on select seeds, of those that are listed in adversaries.yaml",
        "and those that a search of its templates found on tune seeds. Differences are paired, with 95 % intervals over episodes and",
        "training seeds; each verdict is corrected (Holm) for the cells of its column. *same*: no episode differs, as the attack's",
        "times are the same in all of them. Champion: of all learners and seeds the one policy that did best on select seeds, as the",
        "script was chosen. A learner that ends where what it was shown does, in every episode, is a *copy*, and speaks for a cell only",
        "where no other learned. On the linear scenarios the best attack is computed (*Ceilings*). There is no moment to choose without",
        "a budget, as every step is attacked, nor where the best time is the same in every episode (`moment: false` in",
        "adversaries.yaml; decision 24).", "",
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
        out.append(f"| {' | '.join([marked(name, cell), str(dose), none, script, learned, cell['best'], yoked, *gains])} |")
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
        shown_first = f"`{report['teacher']}`{' (a copy)' if report.get('copies') else ''}" if report["teacher"] else "nothing"
        parts = [
            name, learner, shown_first, f"{report['steps']:,}", spread(report, row["learned"]), best, yoked, f"{value} [{low}, {high}]",
            f"{report['minutes']:.1f}",
        ]  # fmt: skip
        out.append(f"| {' | '.join(parts)} |")
    out += ["", "Training: processor time of the busier of two processes that share the seeds, without the choice of what is shown.", ""]
    out += ["## Ceilings", "", "| cell | learner | computed optimum | its outcome | share that each seed reaches |"]
    out += ["|---|---|---|---|---|"]
    for name, learner, report in learners_of(cells):
        for attack, ceiling in report.get("ceilings", {}).items():
            reached = ", ".join(f"{100 * s['value']:.1f} % [{100 * s['low']:.1f}, {100 * s['high']:.1f}]" for s in ceiling["reached"])
            out.append(f"| {name} | {learner} | `{attack}` | {comparison.shown(report, ceiling['outcome']['value'])} | {reached} |")
    out += ["", "## Scripts that the search found", "", "| cell | scripts |", "|---|---|"]
    out += [f"| {name} | {', '.join(f'`{text}`' for text in cell['found'])} |" for name, cell in cells.items() if cell.get("found")]
    out += ["", "## Policies", "", "The first 16 digits of the SHA-256 of each training seed's weights; report.json has the whole.", ""]
    out += ["| cell | learner | weights |", "|---|---|---|"]
    for name, learner, report in learners_of(cells):
        if "sha256" not in report:
            continue
        out.append(f"| {name} | {learner} | {', '.join(digest[:16] for digest in report['sha256'])} |")
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
