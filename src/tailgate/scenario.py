"""Scenarios and suites: versioned YAML files, frozen once published."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from tailgate.core import Defence, Positive, PositiveCount, param
from tailgate.errors import InputError, unknown
from tailgate.loop import Loop
from tailgate.registry import Spec, make_from
from tailgate.schema import build, canonical, fields_of, read_yaml
from tailgate.threat import Brief, ThreatModel

_COMPONENTS = ("plant", "sensor", "controller", "manoeuvre")


@dataclass(frozen=True)
class Scenario:
    """plant + sensor + controller + manoeuvre + horizon + threat model."""

    name: str
    plant: Any
    sensor: Any
    controller: Any
    manoeuvre: Any
    horizon: PositiveCount
    threat_model: ThreatModel
    ends_on_collision: bool = True
    about: str = ""

    def loop(self, defence: Defence, uses: tuple[str, ...] = ("measurements",)) -> Loop:
        loop = Loop(
            self.plant, self.sensor, self.controller, self.manoeuvre, self.threat_model, self.horizon, defence, uses,
            self.ends_on_collision,
        )  # fmt: skip
        begins, drives = getattr(self.manoeuvre, "initial_speed", None), getattr(self.plant, "lead_speed", None)
        if begins is not None and drives is not None and abs(begins - drives) > 0.5:
            raise InputError(f"scenario {self.name}: plant.lead_speed", drives, f"the manoeuvre's first speed ({begins} m/s)")
        _ = loop.plan  # refuses what does not fit (unknown targets, a damaged profile) here, not in the first step
        return loop

    def brief(self) -> Brief:
        """What an attacker knows before the episode."""
        return Brief(self.plant.model(self.sensor, self.controller), self.threat_model, self.horizon)

    def with_threat(self, **changes: Any) -> Scenario:
        """The same scenario under a changed threat model."""
        data = dataclasses.asdict(self.threat_model) | changes
        return dataclasses.replace(self, threat_model=build(ThreatModel, data, "threat_model"))

    @property
    def config_hash(self) -> str:
        return hashlib.blake2b(canonical(self).encode(), digest_size=8).hexdigest()


@dataclass(frozen=True)
class Suite:
    """A named, versioned set of scenarios, doses, defences, attacks and seeds."""

    name: str = param("", "name of the suite")
    about: str = param("", "one sentence")
    scenarios: tuple[str, ...] = param((), "scenario names")
    doses: tuple[int | None, ...] = param((None,), "attack budgets [steps]; none: the scenario's own")
    defences: tuple[str, ...] = param((), "defences, as on the command line")
    attacks: tuple[str, ...] = param((), "attacks, as on the command line")
    seeds: PositiveCount = param(100, "episodes per cell")
    threat: dict[str, Any] = dataclasses.field(default_factory=dict, metadata={"doc": "changes of every scenario's threat model"})
    knowledge: str | None = param(None, "knowledge that every attacker is granted; none: the least that each needs")
    shown: dict[int, str] = dataclasses.field(default_factory=dict, metadata={"doc": "doses that a board shows rates at, and why these"})
    bound: Positive | None = param(None, "error above which an episode counts as damaged where nobody can collide [unit of max_error]")
    robustness: tuple[str, ...] = param((), "those scenarios whose plant is not the one that a defence is told")
    held_out: tuple[str, ...] = param((), "attacks, by name, that are kept out of logs for those who learn a detector")


def _builtin(folder: str) -> dict[str, Path]:
    root = Path(str(files("tailgate.configs").joinpath(folder)))
    return {path.stem: path for path in sorted(root.glob("*.yaml"))}


def config_path(folder: str, name: str, where: str) -> Path:
    """A YAML file by its built-in name or its path."""
    if name.endswith((".yaml", ".yml")):
        return Path(name)
    known = _builtin(folder)
    if name not in known:
        raise unknown(where, name, known)
    return known[name]


def list_scenarios() -> list[str]:
    return list(_builtin("scenarios"))


def list_suites() -> list[str]:
    return list(_builtin("suites"))


def load_scenario(name: str) -> Scenario:
    """A scenario by name, or from a YAML file."""
    path = config_path("scenarios", name, "scenario")
    data = read_yaml(path, "scenario")
    where = f"scenario {path.stem}"
    for key in data:
        if key not in fields_of(Scenario):
            raise unknown(f"{where}: unknown field", key, fields_of(Scenario))
    for key in (*_COMPONENTS, "horizon"):
        if key not in data:
            raise InputError(f"{where}.{key}", None, "a value; the field is required")
    manoeuvre = data["manoeuvre"]
    if isinstance(manoeuvre, dict) and isinstance(manoeuvre.get("path"), str):  # relative to the file that names it
        data["manoeuvre"] = manoeuvre | {"path": path.parent / manoeuvre["path"]}
    parts = {key: make_from(key, data[key], f"{where}.{key}") for key in _COMPONENTS}  # type: ignore[arg-type]
    threat = data.get("threat_model", {})
    if not isinstance(threat, dict):
        raise InputError(f"{where}.threat_model", threat, "a mapping of fields")
    rest = {key: data[key] for key in ("horizon", "ends_on_collision", "about") if key in data} | {"name": data.get("name", path.stem)}
    return build(Scenario, parts | rest | {"threat_model": build(ThreatModel, threat, f"{where}.threat_model")}, where)


def load_suite(name: str) -> Suite:
    """A suite by name, or from a YAML file."""
    path = config_path("suites", name, "suite")
    suite = build(Suite, {"name": path.stem} | read_yaml(path, "suite"), f"suite {path.stem}")
    for key in suite.threat:
        if key not in fields_of(ThreatModel):
            raise unknown(f"suite {path.stem}: threat: unknown field", key, fields_of(ThreatModel))
    for text in suite.defences:
        Spec("defence", text).refuse_imports(f"suite {path.stem}")
    for text in suite.attacks:
        Spec("attack", text).refuse_imports(f"suite {path.stem}")
    for name in suite.robustness:
        if name not in suite.scenarios:
            raise unknown(f"suite {path.stem}: robustness", name, suite.scenarios)
    for dose in suite.shown:
        if dose not in suite.doses:
            raise InputError(f"suite {path.stem}: shown", dose, f"one of the doses {list(suite.doses)}")
    for name in suite.held_out:
        _ = Spec("attack", name).entry
    return suite
