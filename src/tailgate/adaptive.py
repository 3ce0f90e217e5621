"""Attackers trained against one defence, as a suite says: what a defence has to stand before a board ranks it.

An attack that was made for another defence says little: most published defences fell to the first attack that knew them (Tramèr et al.,
On Adaptive Attacks to Adversarial Example Defenses, NeurIPS 2020). So every learner that the suite names is trained on the defence itself,
at the suite's dose and within its threat model, black and grey box, and its policies join the attacks of that defence's rows.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tailgate import train
from tailgate.agents.learning import LEARNERS
from tailgate.core import PositiveCount, param
from tailgate.errors import InputError, unknown
from tailgate.registry import Spec
from tailgate.scenario import Suite
from tailgate.schema import as_data, build
from tailgate.threat import KNOWLEDGE

Progress = Callable[[str, int, int, str], None]  # label, done, total, figures


@dataclass(frozen=True)
class Adaptive:
    """The field `adaptive` of a suite."""

    config: str = param("", "preset of the training")
    dose: PositiveCount | None = param(None, "attack budget in training [steps]; none: the scenario's own")
    changes: tuple[str, ...] = param((), "key=value changes of the preset, for all learners")
    learners: dict[str, tuple[str, ...]] = field(default_factory=dict, metadata={"doc": "learners, each with its own changes"})
    knowledge: tuple[str, ...] = param(("black", "grey"), "what the attackers know, one training each")
    seeds: PositiveCount = param(5, "training seeds of each")


def plan_of(suite: Suite) -> Adaptive:
    """What the suite says of training. Raises InputError where it says nothing, or something that does not exist."""
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
    if not plan.learners:
        raise InputError(f"{where}.learners", {}, "at least one learner")
    return plan


def configs_of(suite: Suite, defence: str, out: Path, *, seeds: int | None = None, extra: tuple[str, ...] = ()) -> list[train.TrainConfig]:
    """One training for each learner and knowledge, on the first of the suite's scenarios."""
    plan = plan_of(suite)
    Spec("defence", defence).refuse_imports("adaptive attack")
    threat = suite.threat | ({} if plan.dose is None else {"budget": plan.dose})
    settings = [f"scenario={suite.scenarios[0]}", f"defence={json.dumps(defence)}", f"out={json.dumps(str(out))}", "tensorboard=false"]
    settings += ["others=[]", "white_box=[]", f"seeds={seeds or plan.seeds}"]
    found = []
    for learner, changes in plan.learners.items():
        for knowledge in plan.knowledge:
            name = re.sub(r"[^A-Za-z0-9_.=-]+", "_", f"{defence}-{learner}-{knowledge}")
            granted = f"threat={json.dumps(threat | {'knowledge': knowledge})}"
            own = [f"name={name}", f"learner={learner}", *settings, granted, *plan.changes, *changes, *extra]
            found.append(train.load_config(plan.config, own))
    return found


def asked_of(suite: Suite) -> list[tuple[str, str, int]]:
    """(name, plan, seed) of every training that the suite asks for against each defence."""
    configs = configs_of(suite, "none", Path("runs"))
    return [
        (config.name.removeprefix("none-"), train.plan_key(as_data(config)), seed)
        for config in configs for seed in range(config.first_seed, config.first_seed + config.seeds)
    ]  # fmt: skip


def train_against(configs: list[train.TrainConfig], progress: Progress) -> list[Path]:
    """The policies of all trainings. A finished one is not trained again, and one that was interrupted goes on."""
    out = []
    for config in configs:
        held = config.directory / "config.json"
        again = held.is_file() and train.training_of(json.loads(held.read_text(encoding="utf-8"))) == train.training_of(as_data(config))
        policies = [config.directory / f"policy-{seed}.json" for seed in range(config.first_seed, config.first_seed + config.seeds)]
        if not (again and all(path.is_file() for path in policies)):

            def learned(seed: int, now: Any, config: train.TrainConfig = config) -> None:
                progress(f"{config.name}, seed {seed}", min(now.steps, config.steps), config.steps, train.figures(now))

            policies = train.train(config, learned, resume=again)
        out += policies
    return out
