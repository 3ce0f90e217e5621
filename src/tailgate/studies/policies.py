"""Trained policies as measurements need them: where each was trained, and where it is played."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tailgate.agents.policy.network_policy import Header, PolicyAttack, load_policy
from tailgate.agents.policy.zoo import ZooAttack
from tailgate.base.errors import InputError, unknown
from tailgate.core import Array
from tailgate.core.loop import Loop
from tailgate.core.registry import Family, Spec
from tailgate.core.scenario import list_scenarios
from tailgate.core.schema import canonical, fields_of
from tailgate.core.threat import ThreatModel
from tailgate.evaluation.cells import Cell
from tailgate.evaluation.stats import Interval, paired_difference, proportion
from tailgate.play.metrics import UNITS, check_outcome
from tailgate.training.comparison import SHARE
from tailgate.training.train import TrainConfig, outcome_of, plan_key

LEAST = 4  # points of the last quarter of a learning curve, below which nothing is said of it
BATCH = 256  # episodes side by side; changes no result
NAMED: tuple[tuple[Family, str], ...] = (  # what a record names, one or a list of each
    ("defence", "defence"), ("defence", "others"), ("attack", "rivals"), ("attack", "white_box"), ("attack", "teacher"),
)  # fmt: skip


class Trained(NamedTuple):
    """A policy, and the cell that it was trained in as its file says: fields are None where the file has no record."""

    text: str  # as an attack on the command line
    policy: PolicyAttack
    header: Header
    learner: str
    seed: int | None
    scenario: str | None
    defence: str | None
    threat: dict[str, Any]
    outcome: str | None

    @property
    def name(self) -> str:
        """The zoo's name, or the last folder and the name of the file."""
        path = self.policy.path
        return path.stem if self.text.startswith("zoo:") else "/".join((*path.parts[-2:-1], path.stem))


def is_policy(text: str) -> bool:
    """Return whether an attack's text names a policy: a file, or one of the zoo."""
    spec = Spec("attack", text)
    return not spec.imports and spec.entry.cls in (PolicyAttack, ZooAttack)


def misfit(cell: Cell) -> str:
    """Return why the policy of a cell cannot be played there (other observations or actions), or nothing."""
    spec = Spec("attack", cell.attack)
    policy = spec.make()
    try:
        policy.prepare(cell.place(policy, spec.entry.knowledge).brief())
    except InputError as error:
        return str(error)
    return ""


def trained(text: str) -> Trained:
    """Return a policy by its JSON file or its name in the zoo, `zoo:name=NAME`. Raises InputError for any other attack."""
    if not is_policy(text):
        raise InputError("policy", text, "the JSON file of an exported policy, or zoo:name=NAME")
    made = Spec("attack", text).make()
    policy = made.policy if isinstance(made, ZooAttack) else made
    header, _ = load_policy(policy.path)
    record = header.training
    config = record.get("config", {})
    config = config if isinstance(config, dict) else {}
    where = f"policy {policy.path.name}: training.config"
    for family, key in NAMED:
        _harmless(family, config.get(key), f"{where}.{key}")
    threat, seed = config.get("threat", {}), record.get("seed")
    threat = dict(threat) if isinstance(threat, dict) else {}
    for key in threat:
        if key not in fields_of(ThreatModel):
            raise unknown(f"{where}.threat: unknown field", key, fields_of(ThreatModel))
    return Trained(
        text, policy, header, str(record.get("learner", "unknown")), seed if isinstance(seed, int) else None,
        _text(config.get("scenario")), _text(config.get("defence")), threat, _text(config.get("outcome")),
    )  # fmt: skip


def distinct(texts: Sequence[str]) -> list[Trained]:
    """Return the policies, each once: a copy of one under another name is no training seed more."""
    out: dict[str, Trained] = {}
    for text in texts:
        who = trained(text)
        out.setdefault(canonical([who.header.sha256, who.header.action, who.seed, who.scenario, who.defence, who.threat]), who)
    return list(out.values())


def origin_of(text: str) -> dict[str, Any] | None:
    """Return what a trained policy says of its training: against which defence (digest, version), by which plan, and the training seed."""
    if not is_policy(text):
        return None
    who = trained(text)
    config, digest = who.header.training.get("config"), who.header.training.get("defence_digest", "")
    version = who.header.training.get("defence_version")
    if who.defence is None or not isinstance(config, dict) or not isinstance(digest, str):
        return None
    return {
        "defence": Spec("defence", who.defence).target, "digest": digest, "plan": plan_key(config), "seed": who.seed,
        "rising": rising(who.header.training.get("curve")),
        **({"version": version} if isinstance(version, int) else {}),  # not recorded by those that met the first version
    }  # fmt: skip


def rising(curve: object) -> bool:
    """Return if a learning curve still rose when training ended.

    The slope of the line through its last quarter exceeds two standard errors, and its rise a twentieth of all that was learned.
    """
    rewards = [point.get("reward") for point in curve if isinstance(point, dict)] if isinstance(curve, list) else []
    y = np.array([x for x in rewards if isinstance(x, int | float)], np.float64)
    last = y[-(len(y) // 4) :] if len(y) >= 4 * LEAST else y[:0]
    if not len(last) or not np.isfinite(y).all():
        return False
    k = np.arange(len(last)) - 0.5 * (len(last) - 1)
    slope = float(k @ last / (k @ k))
    left = last - last.mean() - slope * k
    error = float(np.sqrt(left @ left / (len(last) - 2) / (k @ k)))
    return slope > 2.0 * error and slope * (len(last) - 1) > 0.05 * float(np.ptp(y))


def _harmless(family: Family, held: object, where: str) -> None:
    """Raise InputError when a component that a record names would have to be imported: only a command line names code."""
    for text in held if isinstance(held, list) else [held]:
        try:
            if isinstance(text, str):
                Spec(family, text).refuse_imports(where)
        except InputError:
            raise InputError(where, text, f"a registered {family}") from None
        except (ValueError, RecursionError) as error:  # what a YAML reader trips over
            raise InputError(where, text, f"a component's text ({type(error).__name__})") from None


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


def scenario_of(who: Trained, named: str | None = None) -> str:
    """Return the scenario that the user names, or else that of the training: a registered one, as a record shall not choose a file."""
    if named:
        return named
    found = _required(who.scenario, "scenario", who)
    if found not in list_scenarios():
        raise unknown(f"policy {who.name}: training.config.scenario, without --scenario", found, list_scenarios())
    return found


def defence_of(who: Trained, named: str | None = None) -> str:
    """Return the defence that the user names, or else that of the training."""
    return named or _required(who.defence, "defence", who)


def _required(value: str | None, option: str, who: Trained) -> str:
    if value is None:
        raise InputError(f"policy {who.name}", f"no record of its {option}", f"--{option}")
    return value


def outcome_for(outcome: str | None, scenario: str) -> str:
    """Return the metric that is counted: the one asked for, else crashed, or rmse_position where there is no road."""
    if outcome is not None:
        check_outcome("outcome", outcome)
    return outcome_of(TrainConfig(scenario=scenario, outcome=outcome))


def loop_for(who: Trained, scenario: str, defence: str, threat: dict[str, Any], dose: int | None = None) -> Loop:
    """Return the loop that a policy is played in, with the knowledge that it was trained with."""
    cell = Cell("", scenario, dose, defence, who.text, 1, threat=threat)
    spec = Spec("defence", defence)
    loop = cell.place(who.policy, who.header.knowledge).loop(spec.make(), spec.entry.uses)
    who.policy.prepare(loop.brief)  # refuses a policy of another layout here
    return loop


def mean(x: Array, outcome: str) -> Interval:
    """Return mean of outcomes (training seeds, episodes): the exact interval of shares of one policy, else over episodes and seeds."""
    if UNITS[outcome] != SHARE:
        return paired_difference(x, np.zeros_like(x))
    if len(x) == 1:
        return proportion(int(x.sum()), x.size)
    found = paired_difference(x, np.zeros_like(x), share=True)
    return Interval(found.value, max(found.low, 0.0), min(found.high, 1.0))


def is_share(outcome: str) -> bool:
    """Return whether a metric is yes or no, so that its mean is a share."""
    return UNITS[outcome] == SHARE


def shown(value: float, share: bool, sign: str = "") -> str:
    """Return an outcome, or with sign "+" a difference of two, as people read it."""
    if not share:
        return f"{value:{sign}.3g}"
    return f"{100 * value:{sign}.1f} {'points' if sign else '%'}"


def between(interval: dict[str, float], share: bool, sign: str = "") -> str:
    """Return an interval as people read it, without its unit."""
    scale, digits = (100.0, ".1f") if share else (1.0, ".3g")
    return f"{scale * interval['low'] + 0.0:{sign}{digits}} to {scale * interval['high'] + 0.0:{sign}{digits}}"


def label(text: str, width: int = 30) -> str:
    """Return a component's text over several lines that break at commas and blanks only, never inside a word."""
    return textwrap.fill(text.replace(",", ", "), width, break_long_words=False, break_on_hyphens=False)


def write_report(directory: Path, name: str, report: dict[str, Any], picture: bytes | None, form: str = "png") -> list[Path]:
    """Write NAME.json and the picture NAME.png, or that of another form; returns their paths."""
    from tailgate.base.files import writable_directory, write_atomic, write_json

    writable_directory(directory)
    out = [directory / f"{name}.json"]
    write_json(out[0], report)
    if picture is not None:
        out.append(directory / f"{name}.{form}")
        write_atomic(out[1], picture)
    return out
