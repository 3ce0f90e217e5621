"""Training: from a configuration to a policy, a comparison on fresh seeds, and a page."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from tailgate import draws
from tailgate.agents.codec import ActionSpec
from tailgate.agents.learning import LEARNERS, Learner, learner_of
from tailgate.agents.reward import Reward
from tailgate.core import Array, Count, PositiveCount, param
from tailgate.errors import InputError, unknown
from tailgate.evaluation import cells_of, run
from tailgate.files import set_aside, writable_directory, write_atomic
from tailgate.metrics import METRICS, UNITS
from tailgate.registry import Spec
from tailgate.scenario import Suite, config_path, load_scenario
from tailgate.schema import as_data, build, canonical, fields_of, override, read_yaml
from tailgate.stats import Interval, paired_difference, proportion

BATCH = 512  # episodes side by side in the comparison
SHARE = "0/1"  # unit of a metric that is yes or no
SELECT_EPISODES = 1024  # that the best rival is chosen on: fewer would choose by chance
Discount = Annotated[float, Field(gt=0, le=1)]


@dataclass(frozen=True)
class TrainConfig:
    """What `train.py` reads. A learner's settings stand below its name, the environment's below `environment`."""

    name: str = param("quickstart", "name of the run; its files go to out/name")
    out: str = param("runs", "directory of the runs")
    scenario: str = param("gusty-stop-and-go-v0", "scenario, by name or YAML file")
    defence: str = param("chi2_kf", "registered defence to attack")
    threat: dict[str, Any] = field(default_factory=dict, metadata={"doc": "changes of the scenario's threat model"})
    environment: dict[str, Any] = field(default_factory=dict, metadata={"doc": "action and reward settings of the environment"})
    learner: str = param("ppo", f"who learns: {'; '.join(f'{name}, {what}' for name, what in LEARNERS.items())}")
    ppo: dict[str, Any] = field(default_factory=dict, metadata={"doc": "hyper-parameters of PPO"})
    cem: dict[str, Any] = field(default_factory=dict, metadata={"doc": "hyper-parameters of the cross-entropy method"})
    gamma: Discount = param(0.995, "discount, of the learner and of the shaping [-]")
    steps: PositiveCount = param(3_000_000, "decisions per training seed, over all environments")
    first_seed: Count = param(0, "first training seed")
    seeds: PositiveCount = param(1, "training seeds, one policy each")
    checkpoint_every: PositiveCount = param(500_000, "decisions between checkpoints")
    tensorboard: bool = param(True, "write TensorBoard event files")
    outcome: str | None = param(None, "metric that is compared, the larger the worse; none: crashed, or rmse_position without a road")
    episodes: PositiveCount = param(400, "fresh episodes per attack in the final comparison")
    workers: PositiveCount = param(2, "processes of the final comparison; change no result")
    rivals: tuple[str, ...] = param((), "scripted attacks of equal knowledge and dose to compare with")
    white_box: tuple[str, ...] = param(("stealth:trigger=near,threshold=40",), "attacks that know more, shown beside the others")
    others: tuple[str, ...] = param(("none", "kf", "oracle"), "further defences that the attacks are played on")

    @property
    def directory(self) -> Path:
        return Path(self.out) / self.name


def load_config(source: str | None, overrides: list[str], resume: bool = False) -> TrainConfig:
    """A preset by name or YAML file (default: quickstart) with `key=value` overrides.

    With `resume` the configuration that the run of this name was started with takes the preset's place.
    """
    path = config_path(".", source or "quickstart", "config")
    config = _checked(override(read_yaml(path, "config"), overrides))
    held = config.directory / "config.json"
    if not resume:
        return config
    if not config.directory.is_dir():
        known = sorted(p.parent.name for p in Path(config.out).glob("*/config.json"))
        raise InputError("resume", config.name, f"the name of a run in {config.out}: {', '.join(known) or 'there is none'}")
    try:
        started = json.loads(held.read_text(encoding="utf-8"))
        del started["class"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError("resume", str(held), f"the configuration of the run ({error})") from None
    return _checked(override(started, overrides))


def _checked(data: dict[str, Any]) -> TrainConfig:
    for key in ("threat", "environment", *LEARNERS):
        if not isinstance(data.get(key, {}), dict):
            raise InputError(f"config.{key}", data[key], "a mapping of fields")
    config = build(TrainConfig, data, "config")
    if Path(config.name).name != config.name:
        raise InputError("config.name", config.name, "the name of a directory, without a separator")
    if config.outcome is not None and config.outcome not in METRICS:
        raise unknown("config.outcome", config.outcome, METRICS)
    for spec in [Spec("defence", config.defence), *(Spec("defence", name) for name in config.others)]:
        spec.refuse_imports("config")
    for spec in (Spec("attack", name) for name in (*config.rivals, *config.white_box)):
        spec.refuse_imports("config")
    return config


def environment_of(config: TrainConfig) -> dict[str, Any]:
    """Arguments of the adversary environment."""
    known = (fields_of(ActionSpec) | fields_of(Reward)).keys() - {"gamma"}
    for key in config.environment:
        if key not in known:  # the scenario, the defence, the threat model and gamma have a field of their own
            raise unknown("config.environment: unknown field", key, known)
    return {"scenario": config.scenario, "defence": config.defence, "threat": dict(config.threat), **config.environment}


def outcome_of(config: TrainConfig) -> str:
    """The metric that the comparison counts."""
    if config.outcome is not None:
        return config.outcome
    return "crashed" if load_scenario(config.scenario).brief().model.followers.any() else "rmse_position"


def _check(config: TrainConfig) -> None:
    """Everything that a run will need, tried before anything is written: a typing error shall not cost an hour."""
    from tailgate.envs.seat import Seat

    Seat.make(**environment_of(config))
    cells_of(_suite(config, (*config.rivals, *config.white_box)), threat=config.threat)


def _suite(config: TrainConfig, attacks: tuple[str, ...]) -> Suite:
    """The final comparison, with these attacks."""
    defences = tuple(dict.fromkeys((config.defence, *config.others)))  # each once
    return Suite(config.name, "", (config.scenario,), (None,), defences, attacks, config.episodes)


@dataclass(frozen=True)
class Verdict:
    """How one trained policy did on the report seeds: the outcome of each episode."""

    seed: int
    policy: Path
    learned: Array
    yoked: Array


def train(config: TrainConfig, progress: Callable[[int, Any], None], resume: bool = False) -> list[Path]:
    """Train one policy per seed; returns their JSON files. `progress(seed, Progress)` is called after each rollout."""
    module = learner_of(config.learner)
    settings = build(module.Config, dict(getattr(config, config.learner)), f"config.{config.learner}")
    settings.check()
    for name in LEARNERS.keys() - {config.learner}:  # a typing error there as well, where that learner is installed
        with contextlib.suppress(ImportError):
            build(learner_of(name).Config, dict(getattr(config, name)), f"config.{name}")
    _check(config)
    if not resume and config.directory.is_dir() and any(config.directory.iterdir()):
        set_aside(config.directory)
    directory = writable_directory(config.directory)
    snapshot = json.dumps(as_data(config), indent=1).encode() + b"\n"
    held = directory / "config.json"
    if resume and held.is_file():
        _same_run(held, config)
    write_atomic(held, snapshot)
    policies = []
    for seed in range(config.first_seed, config.first_seed + config.seeds):
        board = directory / "tensorboard" if config.tensorboard else None
        learner: Learner = module.Learner(seed, config.gamma, settings, environment_of(config), board)
        checkpoint = directory / f"checkpoint-{seed}.safetensors"
        if resume and checkpoint.exists():
            learner.load(checkpoint)
        started = time.perf_counter()
        learner.learn(config.steps, partial(progress, seed), checkpoint, config.checkpoint_every)
        facts = {
            "learner": config.learner, "seed": seed, "steps": learner.steps, "config": as_data(config), config.learner: as_data(settings),
            "environment": learner.seat.card()["hash"], "curve": learner.curve,
        }  # fmt: skip
        policies.append(learner.export(directory / f"policy-{seed}", facts))
        curve = {"curve": learner.curve, "seconds": time.perf_counter() - started}
        write_atomic(directory / f"curve-{seed}.json", json.dumps(curve).encode() + b"\n")
        learner.close()
    return policies


def _same_run(held: Path, config: TrainConfig) -> None:
    """Raise InputError when a run would be resumed with another configuration; only the number of steps may change."""
    now = as_data(config)
    try:
        before = json.loads(held.read_text(encoding="utf-8"))
        changed = [key for key in now if key != "steps" and before.get(key) != now[key]]
    except (OSError, ValueError, AttributeError) as error:
        raise InputError("resume", str(held), f"the configuration of the run ({error})") from None
    if changed:
        raise InputError("resume", ", ".join(changed), f"the configuration in {held}, apart from steps")


def _outcomes(rows: list[dict[str, Any]], outcome: str) -> Array:
    bad = next((row for row in rows if row["status"] != "ok"), None)
    if bad is not None:
        raise InputError(f"attack {bad['attack']}", bad["status"], f"an attack that plays here ({bad['reason']})")
    if any(row[outcome] is None for row in rows):
        raise InputError("config.outcome", outcome, "a metric that every episode has")
    return np.array([row[outcome] for row in rows], np.float64)


def compare(config: TrainConfig, policies: list[Path], progress: Callable[[int, int], None] | None = None) -> dict[str, Any]:
    """Play the policies and the scripted rivals on fresh report seeds; writes rows.jsonl and report.json; returns the report.

    The best rival is chosen on select seeds and reported on report seeds, so that the choice does not favour it; every rival is
    reported as well.
    """
    from tailgate.agents.policy import PolicyAttack, timing_advantage
    threat = dict(config.threat)
    names, outcome = [str(p) for p in policies], outcome_of(config)
    guard = config.defence
    best = next(iter(config.rivals), None)
    if len(config.rivals) > 1:
        choice = Suite(config.name, "", (config.scenario,), (None,), (guard,), config.rivals, SELECT_EPISODES)
        selection = run(cells_of(choice, batch=BATCH, purpose="select", threat=threat), workers=config.workers)
        best = max(config.rivals, key=lambda a: _outcomes([r for r in selection if r["attack"] == a], outcome).mean())

    attacks = tuple(dict.fromkeys(("none", *config.rivals, *config.white_box, *names)))  # each once
    cells = cells_of(_suite(config, attacks), batch=BATCH, threat=threat)
    rows = run(cells, config.directory / "rows.jsonl", config.workers, progress)

    def outcomes(attack: str) -> Array:
        return _outcomes([r for r in rows if r["attack"] == attack and r["defence"] == guard], outcome)

    built, uses = Spec("defence", guard).make(), Spec("defence", guard).entry.uses
    keys = draws.keys("report", range(config.episodes))
    verdicts = []
    for path, seed in zip(policies, range(config.first_seed, config.first_seed + config.seeds), strict=True):
        policy = PolicyAttack(path)
        place = load_scenario(config.scenario).with_threat(**(threat | {"knowledge": policy.knowledge}))
        own, yoked = timing_advantage(place.loop(built, uses), policy, keys, outcome)
        verdicts.append(Verdict(seed, path, own, yoked))
    return _report(config, verdicts, outcomes, best, outcome)


def _report(
    config: TrainConfig, verdicts: list[Verdict], outcomes: Callable[[str], Array], best: str | None, outcome: str
) -> dict[str, Any]:
    learned = np.array([v.learned for v in verdicts])
    yoked = np.array([v.yoked for v in verdicts])
    none = np.broadcast_to(outcomes("none"), learned.shape)

    def mean(x: Array) -> Interval:
        """Of the outcomes (episodes,): of 0 and 1 the exact interval, of others the bootstrap's."""
        return proportion(int(x.sum()), x.size) if UNITS[outcome] == SHARE else paired_difference(x, np.zeros_like(x))

    def difference(other: Array) -> Interval:
        return paired_difference(learned, other, share=UNITS[outcome] == SHARE)

    items = [("no attack", mean(outcomes("none")), "")]
    if best is not None:
        items.append((best, mean(outcomes(best)), "best scripted attack of equal knowledge and dose, chosen on other seeds"))
    items += [(f"learned, seed {v.seed}", mean(v.learned), "") for v in verdicts]
    items += [(f"learned, seed {v.seed}, yoked", mean(v.yoked), "its own values at another episode's times") for v in verdicts]
    items += [(name, mean(outcomes(name)), "white box, and no step of it alarms: knows more, dares less") for name in config.white_box]

    def over(attack: str) -> Interval:
        return difference(np.broadcast_to(outcomes(attack), learned.shape))

    versus = {"no attack": difference(none), "own yoked schedule": difference(yoked)}
    if best is not None:
        versus["best scripted attack"] = over(best)
    report = {
        "name": config.name, "scenario": config.scenario, "defence": config.defence, "episodes": config.episodes, "steps": config.steps,
        "outcome": outcome, "unit": UNITS[outcome],
        "threat": as_data(load_scenario(config.scenario).with_threat(**config.threat).threat_model),
        "config": json.loads(canonical(config)), "policies": [str(v.policy) for v in verdicts], "best_scripted": best,
        "attacks": [{"label": label, **interval._asdict(), "note": note} for label, interval, note in items],
        "advantage": {name: interval._asdict() for name, interval in versus.items()},
        "rivals": {name: {"outcome": mean(outcomes(name))._asdict(), "advantage": over(name)._asdict()} for name in config.rivals},
    }  # fmt: skip
    write_atomic(config.directory / "report.json", json.dumps(report, indent=1, allow_nan=False).encode() + b"\n")
    return report


def shown(report: dict[str, Any], value: float, sign: str = "") -> str:
    """An outcome, or with sign "+" a difference of two, as people read it."""
    if report["unit"] != SHARE:
        return f"{value:{sign}.3g}"
    return f"{round(100 * value) + 0:+d}" if sign else f"{100 * value:.1f} %"


def headline(report: dict[str, Any]) -> dict[str, Any]:
    """The report as the page shows it at its top."""
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
    text = (
        f"An adversary was trained for {report['steps']:,} decisions against {report['defence']} on {report['scenario']}. "
        f"{what} {report['episodes']} fresh episodes{which}: {gains} (paired, 95 %; {speaks})."
    )
    return {"text": text, "items": report["attacks"] if share else []}


def make_page(config: TrainConfig, report: dict[str, Any]) -> Path:
    """The page of a finished run."""
    from tailgate.leaderboard.build import build as build_page
    from tailgate.rows import read_rows

    curve = [
        point for seed in range(config.first_seed, config.first_seed + config.seeds)
        for point in json.loads((config.directory / f"curve-{seed}.json").read_text())["curve"]
    ]  # fmt: skip
    rows = read_rows(config.directory / "rows.jsonl")
    title = f"{config.name}: {config.defence} under attack"
    drawn = curve if all(point["crash"] is not None for point in curve) else None
    return build_page(rows, config.directory / "page", title=title, curve=drawn, headline=headline(report))


def main(arguments: list[str] | None = None) -> int:
    """Entry point of train.py."""
    import sys

    from tailgate.cli import main as command

    return command(["train", *(sys.argv[1:] if arguments is None else arguments)])


def figures(progress: Any) -> str:
    """The curve's latest figures, as a progress bar shows them."""
    text = f"{progress.steps / 1e6:5.2f} M decisions"
    if progress.crash is not None:
        text += f", collisions {100 * progress.crash:4.1f} %"
    return text if progress.reward is None else f"{text}, return {progress.reward:+.2f}"


def parameters() -> list[dict[str, Any]]:
    """Every field of the configuration with default and sentence, for --help."""
    return [
        {"name": f.name, "default": as_data(f.default if f.default is not dataclasses.MISSING else {}), "doc": f.metadata.get("doc", "")}
        for f in dataclasses.fields(TrainConfig)
    ]
