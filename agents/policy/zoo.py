"""The zoo: trained policies that come with the package, played like any other policy file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar

from tailgate.agents.policy.network_policy import PolicyAttack, PolicyPlan, PolicyState, load_policy
from tailgate.base.errors import InputError, NotApplicable, unknown
from tailgate.core import Command, View, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.core.threat import Brief

FOLDER = Path(str(files("tailgate.agents").joinpath("policies")))


def zoo_names() -> list[str]:
    """Return names of the packaged policies."""
    return sorted(path.stem for path in FOLDER.glob("*.json"))


def zoo_path(name: str) -> Path:
    """Return the JSON file of a packaged policy. Raise InputError for any other name, so that a name never is a path."""
    known = zoo_names()
    if name not in known:
        raise unknown("zoo.name", name, known)
    return FOLDER / f"{name}.json"


def zoo_card(name: str) -> dict[str, Any]:
    """Return JSON data of a packaged policy: how it was made, its actions, and its results on report seeds."""
    path = zoo_path(name)
    header, _ = load_policy(path)
    record = header.training
    config = record.get("config", {})
    if not isinstance(config, dict):
        raise InputError(f"zoo {name}.training.config", config, "a mapping of fields")
    return {
        "name": name, "summary": record.get("summary", ""), "scenario": config.get("scenario"), "defence": config.get("defence"),
        "learner": record.get("learner"), "seed": record.get("seed"), "decisions": record.get("steps"),
        "knowledge": header.knowledge, "threat": record.get("threat_model"), "measured": record.get("measured"),
        "sha256": header.sha256, "environment": record.get("environment"), "curve": record.get("curve"),
    }  # fmt: skip


@register("attack", "zoo")
@dataclass(frozen=True)
class ZooAttack:
    """A trained policy that comes with the package; `tailgate list zoo` shows them."""

    learned: ClassVar[bool] = True
    name: str = param("car-following-chi2_kf-0", "name of the packaged policy")
    stochastic: bool = param(False, "draw actions from the policy instead of taking the likeliest")

    def __post_init__(self) -> None:
        zoo_path(self.name)

    @property
    def sources(self) -> list[Path]:
        """The policy's file, which holds the digest of the tensors: a row records its digest."""
        return [zoo_path(self.name)]

    @cached_property
    def policy(self) -> PolicyAttack:
        """The same policy as a file."""
        return PolicyAttack(zoo_path(self.name), self.stochastic)

    @property
    def knowledge(self) -> str:
        """The knowledge that the policy was trained with."""
        return self.policy.knowledge

    @property
    def sees_measurement(self) -> bool:
        return self.policy.sees_measurement

    def prepare(self, brief: Brief) -> PolicyPlan:
        _ = self.policy.knowledge  # reads the files: what is damaged is an error, and no pairing without meaning
        try:
            return self.policy.prepare(brief)
        except InputError as error:
            raise NotApplicable(f"zoo {self.name}: {error.field}", error.value, error.expected) from None

    def start(self, plan: PolicyPlan, batch: int, draws: Draws) -> PolicyState:
        return self.policy.start(plan, batch, draws)

    def decide(self, plan: PolicyPlan, state: PolicyState, view: View, draws: Draws) -> tuple[PolicyState, Command]:
        return self.policy.decide(plan, state, view, draws)
