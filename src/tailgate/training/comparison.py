"""The comparison of trained policies with scripts on fresh seeds, and its page."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.agents.policy.network_policy import load_policy
from tailgate.base.files import write_json
from tailgate.base.reading import load_json
from tailgate.core import Array, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.core.schema import as_data, canonical
from tailgate.evaluation.baselines import BATCH, best_of
from tailgate.evaluation.baselines import left_out as reason
from tailgate.evaluation.baselines import outcomes as outcomes_of
from tailgate.evaluation.cells import Cell, cell_id, cells_of, run
from tailgate.evaluation.stats import Interval, paired_difference, paired_ratio, proportion
from tailgate.play.metrics import UNITS, unit_in
from tailgate.training.train import TrainConfig, outcome_of, rivals_of, suite_of, training_seeds

ROWS = "rows.jsonl"
SHARE = "0/1"  # unit of a metric that is yes or no


@dataclass(frozen=True)
class Verdict:
    """How one trained policy did on the report seeds: the outcome of each episode."""

    seed: int
    policy: Path
    learned: Array
    yoked: Array


@dataclass(frozen=True)
class Scripts:
    """The best rival, chosen on select seeds, and the rows of everything that was played on report seeds."""

    best: str | None
    rows: list[dict[str, Any]]
    made_of: str  # a hash of everything that decides them


def play_scripts(config: TrainConfig, policies: list[Path], progress: Callable[[int, int], None] | None = None) -> Scripts:
    """Choose the best rival on select seeds, so that the choice does not favour it, and play all, and policies, on fresh report seeds."""
    best = best_of(rivals_of(config), dict(config.threat), outcome_of(config), "select", config.workers)
    rows = run(_cells(config, policies), config.directory / ROWS, config.workers, progress)
    return Scripts(best, rows, _made_of(config, policies))


def _cells(config: TrainConfig, policies: list[Path]) -> list[Cell]:
    """Return what is played on report seeds."""
    attacks = tuple(dict.fromkeys(("none", *config.rivals, *config.white_box, *map(str, policies))))  # each once
    return cells_of(suite_of(config, attacks), batch=BATCH, threat=dict(config.threat), first_seed=config.first_episode)


def _made_of(config: TrainConfig, policies: list[Path]) -> str:
    """Return a hash of everything that decides a comparison: what is played, whatever files it names, and the rows that came of it."""
    parts = [cell_id(cell) for cell in _cells(config, policies)] + [hashlib.sha256((config.directory / ROWS).read_bytes()).hexdigest()]
    return hashlib.blake2b(canonical([parts, config]).encode(), digest_size=16).hexdigest()


def compare(
    config: TrainConfig, policies: list[Path], progress: Callable[[int, int], None] | None = None, scripts: Scripts | None = None
) -> dict[str, Any]:
    """Play the policies and the scripts on fresh report seeds; writes rows.jsonl and report.json; returns the report.

    scripts: what `play_scripts` gave for these policies and rivals: it is not played again.
    """
    from tailgate.agents.policy.network_policy import PolicyAttack
    from tailgate.studies.timing import timing_advantage

    threat, outcome = dict(config.threat), outcome_of(config)
    defence = config.defence
    scripts = scripts or play_scripts(config, policies, progress)
    rows = scripts.rows

    def outcomes(attack: str) -> Array:
        return outcomes_of([r for r in rows if r["attack"] == attack and r["defence"] == defence], outcome)

    # who may not look into a defence has no figures against it, which is no reason to lose the others
    here = [r for r in rows if r["defence"] == defence]
    reasons = {name: reason([r for r in here if r["attack"] == name]) for name in (*config.white_box, *config.rivals)}
    left_out = {name: why for name, why in reasons.items() if why}
    built, uses = Spec("defence", defence).make(), Spec("defence", defence).entry.uses
    keys = draws.keys("report", range(config.first_episode, config.first_episode + config.episodes))
    verdicts = []
    for path, seed in zip(policies, training_seeds(config), strict=True):
        policy = PolicyAttack(path)
        scenario = load_scenario(config.scenario).with_threat(**(threat | {"knowledge": policy.knowledge}))
        own, yoked = timing_advantage(scenario.loop(built, uses), policy, keys, outcome)
        verdicts.append(Verdict(seed, path, own, yoked))
    return _report(config, verdicts, outcomes, scripts, outcome, left_out)


def _report(
    config: TrainConfig, verdicts: list[Verdict], outcomes: Callable[[str], Array], scripts: Scripts, outcome: str, left_out: dict[str, str]
) -> dict[str, Any]:
    best = None if scripts.best in left_out else scripts.best
    white_box, rivals = ([name for name in some if name not in left_out] for some in (config.white_box, config.rivals))
    learned = np.array([v.learned for v in verdicts])
    yoked = np.array([v.yoked for v in verdicts])
    none = np.broadcast_to(outcomes("none"), learned.shape)

    def mean(x: Array) -> Interval:
        """Return the interval of outcomes (episodes,): exact for 0 and 1, by bootstrap for others."""
        return proportion(int(x.sum()), x.size) if UNITS[outcome] == SHARE else paired_difference(x, np.zeros_like(x))

    def difference(other: Array) -> Interval:
        return paired_difference(learned, other, share=UNITS[outcome] == SHARE)

    items = [("no attack", mean(outcomes("none")), "")]
    if best is not None:
        items.append((best, mean(outcomes(best)), "best scripted attack of equal knowledge and dose, chosen on other seeds"))
    items += [(f"learned, seed {v.seed}", mean(v.learned), "") for v in verdicts]
    items += [(f"learned, seed {v.seed}, yoked", mean(v.yoked), "its own values at another episode's times") for v in verdicts]
    items += [(name, mean(outcomes(name)), _note(name)) for name in white_box]

    def over(attack: str) -> Interval:
        return difference(np.broadcast_to(outcomes(attack), learned.shape))

    versus = {"no attack": difference(none), "own yoked schedule": difference(yoked)}
    if best is not None:
        versus["best scripted attack"] = over(best)
    scenario, heads = load_scenario(config.scenario).with_threat(**config.threat), [load_policy(v.policy)[0] for v in verdicts]
    report = {
        "name": config.name, "scenario": config.scenario, "defence": config.defence, "episodes": config.episodes, "steps": config.steps,
        "outcome": outcome, "unit": unit_in(outcome, scenario.brief().model), "learner": config.learner,
        "teacher": heads[0].training.get("teacher"), "decisions": [head.training["steps"] for head in heads],
        "threat": as_data(scenario.threat_model),
        "config": json.loads(canonical(config)), "policies": [str(v.policy) for v in verdicts], "best_scripted": best,
        "made_of": scripts.made_of,
        "attacks": [{"label": label, **interval._asdict(), "note": note} for label, interval, note in items],
        "advantage": {name: interval._asdict() for name, interval in versus.items()},
        "rivals": {name: {"outcome": mean(outcomes(name))._asdict(), "advantage": over(name)._asdict()} for name in rivals},
        "ceilings": {
            name: {"outcome": mean(outcomes(name))._asdict(), "reached": [_reached(v.learned, outcomes(name))._asdict() for v in verdicts]}
            for name in white_box if Spec("attack", name).entry.optimal
        },
        "left_out": left_out,
    }  # fmt: skip
    write_json(config.directory / "report.json", report)
    return report


def finished(config: TrainConfig, policies: list[Path]) -> dict[str, Any] | None:
    """Return the report that `compare` wrote of this comparison and of the rows that are there; None where something is another now."""
    try:
        held: dict[str, Any] = load_json(config.directory / "report.json")
        return held if held["made_of"] == _made_of(config, policies) else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _reached(learned: Array, optimum: Array) -> Interval:
    """Return share of what a computed optimum makes large, the mean square of the outcome, with the bootstrap's interval over episodes."""
    return paired_ratio(learned**2, optimum**2)


def _note(attack: str) -> str:
    """Return what is said of an attack that is no rival."""
    entry = Spec("attack", attack).entry
    if entry.optimal:
        return f"{entry.knowledge} box, the computed optimum: a ceiling and no rival"
    return "white box, and no step of it alarms: knows more, dares less" if entry.name == "stealth" else f"{entry.knowledge} box"


def shown(report: dict[str, Any], value: float, sign: str = "") -> str:
    """Return an outcome, or with sign "+" a difference of two, as people read it."""
    if report["unit"] != SHARE:
        return f"{value:{sign}.3g}"
    return f"{round(100 * value) + 0:+d}" if sign else f"{100 * value:.1f} %"


def headline(report: dict[str, Any]) -> dict[str, Any]:
    """Return the report as the page shows it at its top."""
    share = report["unit"] == SHARE
    points = " points" if share else ""
    gains = "; ".join(
        f"{shown(report, g['value'], '+')}{points} over {name} [{shown(report, g['low'], '+')}, {shown(report, g['high'], '+')}]"
        for name, g in report["advantage"].items()
    )
    what = "Share of" if share else f"Mean {report['outcome']} of"
    which = {"crashed": " that end in a collision"}.get(report["outcome"], f" with {report['outcome']}" if share else "")
    runs = len(report["policies"])
    speaks = "of this one policy: other training seeds differ" if runs == 1 else f"over {runs} training seeds"
    most = max(report["decisions"])
    text = (
        f"An adversary was trained for {most:,} decisions against {report['defence']} on {report['scenario']}. "
        f"{what} {report['episodes']} fresh episodes{which}: {gains} (paired, 95 %; {speaks})."
    )
    return {"text": text, "items": report["attacks"] if share else []}
