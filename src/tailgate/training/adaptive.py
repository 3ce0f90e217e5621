"""Attackers made against one defence, as a suite says: a board ranks a defence after it has met them.

An attack that was made for another defence says little: most published defences fell to the first attack that knew them. (Tramèr et al.,
On Adaptive Attacks to Adversarial Example Defenses, NeurIPS 2020.) So every learner that the suite names is trained on the defence itself.
It has the suite's dose and threat model, black and grey box. Its policies join the attacks of that defence's rows. A suite may ask for the
standard attack ensemble instead (`tailgate.board.searched`).
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from tailgate.agents.learners.learning import LEARNERS, learner_of
from tailgate.agents.learners.learning import Progress as Now
from tailgate.base import sizes
from tailgate.base.errors import InputError, unknown
from tailgate.base.reading import load_json
from tailgate.base.sizes import Seeds
from tailgate.core import PositiveCount, param
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_scenario
from tailgate.core.schema import as_data, build, fields_of
from tailgate.core.threat import KNOWLEDGE
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.observations import ObservationCodec
from tailgate.training import train

Progress = Callable[[str, int, int, str], None]  # label, done, total, figures
SIZES = ("quick", "standard")  # budgets of the standard attack ensemble


@dataclass(frozen=True)
class Adaptive:
    """The field `adaptive` of a suite."""

    config: str = param("", "preset of the training")
    scenarios: tuple[str, ...] = param((), "the suite's scenarios that are trained on; none: the first. One of each kind of system")
    dose: PositiveCount | None = param(None, "attack budget in training [steps]; none: the scenario's own")
    changes: tuple[str, ...] = param((), "key=value changes of the preset, for all learners")
    learners: dict[str, tuple[str, ...]] = field(default_factory=dict, metadata={"doc": "learners, each with its own changes"})
    knowledge: tuple[str, ...] = param(("black", "grey"), "what the attackers know, one training each")
    seeds: Seeds = param(5, "training seeds of each")
    ensemble: str = param("", f"budget of the standard attack ensemble, {' or '.join(SIZES)}; empty: it is not asked for")
    doses: tuple[int, ...] = param((), "the suite's doses that the ensemble searches at; none: those that are shown, or all numbers")

    def searched(self, suite: Suite) -> tuple[int | None, ...]:
        """Return the doses that the ensemble searches at."""
        return self.doses or tuple(dose for dose in suite.doses if dose in suite.shown) or suite.doses


def plan_of(suite: Suite) -> Adaptive:
    """Return what the suite says of training. Raises InputError where it says nothing, or something that does not exist."""
    where = f"suite {suite.name}: adaptive"
    if not suite.adaptive:
        raise InputError(where, None, "a preset and learners: this suite does not say how to attack a defence")
    plan = build(Adaptive, suite.adaptive, where)
    for name in plan.learners:
        if name not in LEARNERS:
            raise unknown(f"{where}.learners", name, LEARNERS)
    for name in plan.knowledge:
        if name not in KNOWLEDGE:
            raise unknown(f"{where}.knowledge", name, KNOWLEDGE)
    if not (plan.learners or plan.ensemble):
        raise InputError(f"{where}.learners", {}, "at least one learner, or an ensemble")
    if plan.ensemble not in ("", *SIZES):
        raise unknown(f"{where}.ensemble", plan.ensemble, SIZES)
    for dose in plan.doses:
        if dose not in suite.doses:
            raise InputError(f"{where}.doses", dose, f"one of the suite's doses {list(suite.doses)}")
    for name in plan.scenarios:
        if name not in suite.scenarios:
            raise unknown(f"{where}.scenarios", name, suite.scenarios)
    return plan


def configs_of(suite: Suite, defence: str, out: Path, *, seeds: int | None = None, extra: tuple[str, ...] = ()) -> list[train.TrainConfig]:
    """Return one training for each scenario that is trained on, learner and knowledge."""
    plan = plan_of(suite)
    if seeds is not None:
        sizes.check("seeds", seeds)
    Spec("defence", defence).refuse_imports("adaptive attack")
    threat = suite.threat | ({} if plan.dose is None else {"budget": plan.dose})
    settings = [f"defence={json.dumps(defence)}", f"out={json.dumps(str(out))}", "tensorboard=false"]
    settings += ["others=[]", "white_box=[]", f"seeds={seeds or plan.seeds}"]
    found = []
    for scenario in plan.scenarios or suite.scenarios[:1]:
        tag = f"-{scenario}" if len(plan.scenarios) > 1 else ""
        for learner, changes in plan.learners.items():
            for knowledge in plan.knowledge:
                name = f"{stem(defence)}-{learner}-{knowledge}{tag}"
                granted = f"threat={json.dumps(threat | {'knowledge': knowledge})}"
                own = [f"name={name}", f"learner={learner}", f"scenario={scenario}", *settings, granted, *plan.changes, *changes, *extra]
                found.append(train.load_config(plan.config, own))
    return found


def check_plan(suite: Suite) -> None:
    """Raise InputError for a plan that no training could begin with. Settings of learners that need torch are left to the training."""
    where = f"suite {suite.name}: adaptive"
    try:
        for config in configs_of(suite, "none", Path("runs")):
            train.environment_of(config)
            build(learner_of("cem").Config, dict(config.cem), "config.cem")
    except InputError as error:
        if error.field.startswith(where):
            raise
        raise InputError(f"{where}: {error.field}", error.value, error.expected) from None


def stem(defence: str) -> str:
    """Return the text of a defence as the beginning of a file's name."""
    return re.sub(r"[^A-Za-z0-9_.=-]+", "_", defence)


def fitting(suite: Suite, config: train.TrainConfig) -> tuple[str, ...]:
    """Return the suite's scenarios that show an attacker what the training's does, and let it do as much: where its policies play."""
    spec = build(ActionSpec, {k: v for k, v in config.environment.items() if k in fields_of(ActionSpec)}, "environment")

    def seat(name: str) -> tuple[tuple[str, ...], int]:
        brief = load_scenario(name).with_threat(**config.threat).brief()
        return ObservationCodec(brief, config.environment.get("frames", 1)).names, ActionCodec(spec, brief).size

    own = seat(config.scenario)
    return tuple(name for name in suite.scenarios if name == config.scenario or seat(name) == own)


class Asked(NamedTuple):
    """A training that a suite asks for against each defence."""

    name: str
    plan: str  # hash of the training, for any defence
    seed: int
    scenarios: tuple[str, ...]  # where the policy has to play


def asked_of(suite: Suite) -> list[Asked]:
    """Return every training that the suite asks for against each defence."""
    out = []
    for config in configs_of(suite, "none", Path("runs")):
        name, key, where = config.name.removeprefix("none-"), train.plan_key(as_data(config)), fitting(suite, config)
        out += [Asked(name, key, seed, where) for seed in train.training_seeds(config)]
    return out


def policies_of(config: train.TrainConfig) -> list[Path]:
    """Return where a training's policies are once it is done."""
    return [config.directory / f"policy-{seed}.json" for seed in train.training_seeds(config)]


def as_begun(config: train.TrainConfig, held: Path) -> train.TrainConfig:
    """Return a configuration with the horizon of the run that a file holds, so that all its policies are trained alike."""
    try:
        before = load_json(held, strict=False)
        return dataclasses.replace(config, horizon_ends=bool(before.get("horizon_ends", train.LATER["horizon_ends"])))
    except (OSError, ValueError, AttributeError):
        return config


def train_against(configs: list[train.TrainConfig], progress: Progress) -> list[Path]:
    """Return the policies of all trainings, in their order. A finished one is not trained again, and one that was interrupted goes on."""
    runs = []
    for config in configs:
        held = config.directory / "config.json"
        begun = as_begun(config, held)
        again = held.is_file() and train.is_training(begun, held)
        config = begun if again else config
        if not (again and all(path.is_file() and path.with_suffix(".safetensors").is_file() for path in policies_of(config))):
            runs.append((config, again))

    def learned(config: train.TrainConfig, seed: int, now: Now) -> None:
        progress(f"{config.name}, seed {seed}", min(now.steps, config.steps), config.steps, train.figures(now))

    train.train_together(runs, learned, max((config.workers for config in configs), default=1))
    return [path for config in configs for path in policies_of(config)]
