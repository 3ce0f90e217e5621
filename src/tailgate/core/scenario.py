"""Scenarios and suites: versioned YAML files, frozen once published."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

from tailgate.base.errors import InputError, unknown
from tailgate.base.reading import YAML_ENDS
from tailgate.base.sizes import Episodes
from tailgate.core import Defence, Paced, Positive, Recording, param
from tailgate.core.loop import Loop
from tailgate.core.lossy_link import Link
from tailgate.core.quantities import Fraction, Horizon
from tailgate.core.registry import Spec, make_from
from tailgate.core.schema import build, digest, fields_of, read_yaml
from tailgate.core.threat import Brief, ThreatModel

T = TypeVar("T")
LINK = ("loss", "latency")
WORDS = ("about", "shown")  # of a suite: what is read, not played; of `shown` the doses count
_COMPONENTS = ("plant", "sensor", "controller", "manoeuvre")


@dataclass(frozen=True)
class Scenario:
    """plant + sensor + controller + manoeuvre + horizon + threat model.

    `truth` holds the differences from the `plant` and `sensor` that everyone knows: changed fields of either, `load`, and `loss` and
    `latency` of readings. `load` is the mass over the nominal one, which divides a commanded acceleration.
    """

    name: str
    plant: Any  # a Plant, and so on; readers know the class of what they load
    sensor: Any
    controller: Any
    manoeuvre: Any
    horizon: Horizon
    threat_model: ThreatModel
    ends_on_collision: bool = True
    about: str = ""
    truth: dict[str, Any] = dataclasses.field(default_factory=dict, hash=False, metadata={"if_any": True})

    def loop(self, defence: Defence, uses: tuple[str, ...] = ("measurements",)) -> Loop:
        where = f"scenario {self.name}: truth"
        plant, sensor = (_changed(getattr(self, part), self.truth.get(part, {}), f"{where}.{part}") for part in ("plant", "sensor"))
        told = self.plant.model(self.sensor, self.controller) if self.truth else None
        loop = Loop(
            plant, sensor, self.controller, self.manoeuvre, self.threat_model, self.horizon, defence, uses, self.ends_on_collision, told,
            self.truth.get("load", 1.0), build(Link, {key: self.truth[key] for key in LINK if key in self.truth}, where),
        )  # fmt: skip
        begins, drives = getattr(self.manoeuvre, "initial_speed", None), getattr(self.plant, "lead_speed", None)
        if begins is not None and drives is not None and abs(begins - drives) > 0.5:
            raise InputError(f"scenario {self.name}: plant.lead_speed", drives, f"the manoeuvre's first speed ({begins} m/s)")
        if isinstance(self.manoeuvre, Recording) and not isinstance(self.plant, Paced):
            wanted = "one whose cars may begin at any speed, as acc_string"
            raise InputError(f"scenario {self.name}: plant", type(self.plant).__name__, wanted)
        if getattr(self.manoeuvre, "curved", False) != (loop.model.lane > 0.0):
            wanted = "curves or bend: the plant keeps a lane" if loop.model.lane else "one that drives the leader: the plant keeps no lane"
            raise InputError(f"scenario {self.name}: manoeuvre", type(self.manoeuvre).__name__, wanted)
        if not loop.link.perfect and loop.model.air:
            raise InputError(where, self.truth, "no loss or latency: a radar is read where it hears")
        if told is not None and told.C.shape != plant.model(sensor, self.controller).C.shape:
            raise InputError(where, self.truth, "changes that keep the number of agents, states and sensors")
        _ = loop.plan  # refuses what does not fit (unknown targets, a damaged profile) here, not in the first step
        return loop

    def brief(self) -> Brief:
        """Return the attacker's knowledge before the episode."""
        return Brief(self.plant.model(self.sensor, self.controller), self.threat_model, self.horizon)

    def with_threat(self, **changes: object) -> Scenario:
        """Return the same scenario under a changed threat model."""
        data = dataclasses.asdict(self.threat_model) | changes
        return dataclasses.replace(self, threat_model=build(ThreatModel, data, "threat_model"))

    def __repr__(self) -> str:
        parts = ", ".join(type(part).__name__ for part in (self.plant, self.sensor, self.controller, self.manoeuvre))
        return f"<Scenario {self.name}: {parts}, {self.horizon} steps>"

    @property
    def config_hash(self) -> str:
        return digest(self)


def _changed(part: T, changes: object, where: str) -> T:
    """Return a component with other values of some fields."""
    if not isinstance(changes, dict):
        raise InputError(where, changes, "a mapping of fields")
    for key in changes:
        if key not in fields_of(type(part)):
            raise unknown(f"{where}: unknown field", key, fields_of(type(part)))
    held = {name: getattr(part, name) for name in fields_of(type(part))}
    return build(type(part), held | changes, where) if changes else part


NAME = 200  # characters of a file's name that is looked for
ScenarioLike = str | Path | Mapping[str, Any] | Scenario  # what names a scenario, or is one


def _check_truth(truth: dict[str, Any], where: str) -> None:
    for key in truth:
        if key not in ("plant", "sensor", "load", *LINK):
            raise unknown(f"{where}: unknown field", key, ("plant", "sensor", "load", *LINK))
    load = truth.get("load", 1.0)
    if isinstance(load, bool) or not isinstance(load, int | float) or not 0.1 <= load <= 10.0:
        raise InputError(f"{where}.load", load, "the mass over the nominal one, 0.1 to 10")


@dataclass(frozen=True)
class Suite:
    """A named, versioned set of scenarios, doses, defences, attacks and seeds."""

    name: str = param("", "name of the suite")
    about: str = param("", "one sentence")
    scenarios: tuple[str, ...] = param((), "scenario names")
    doses: tuple[int | None, ...] = param((None,), "attack budgets [steps]; none: the scenario's own")
    defences: tuple[str, ...] = param((), "defences, as on the command line")
    attacks: tuple[str, ...] = param((), "attacks, as on the command line")
    seeds: Episodes = param(100, "episodes per cell")
    threat: dict[str, Any] = dataclasses.field(default_factory=dict, metadata={"doc": "changes of every scenario's threat model"})
    knowledge: str | None = param(None, "knowledge that every attacker is granted; none: the least that each needs")
    shown: dict[int, str] = dataclasses.field(default_factory=dict, metadata={"doc": "doses that a board shows rates at, and why these"})
    bound: Positive | None = param(None, "error above which an episode counts as damaged where nobody can collide [unit of max_error]")
    robustness: tuple[str, ...] = param((), "those scenarios whose plant is not the one that a defence assumes")
    adaptive: dict[str, Any] = dataclasses.field(default_factory=dict, metadata={"doc": "how attackers are trained against a defence"})
    held_out: tuple[str, ...] = param((), "attacks, by name, that are kept out of logs for those who learn a detector")
    progress: Fraction | None = param(None, "share of its clean distance below which an attacked car counts as damaged; none: never")
    measures: bool = param(False, "a board has more than the worst rate: pointwise worst, severity, availability, mean gap")

    @property
    def hash(self) -> str:
        """The hash of everything that is played; fields at their defaults leave no mark, so that a new field moves no old suite."""
        blank = Suite()
        held = {
            f.name: getattr(self, f.name) for f in dataclasses.fields(self)
            if f.name not in WORDS and getattr(self, f.name) != getattr(blank, f.name)
        }  # fmt: skip
        return digest(held | {"shown": sorted(self.shown)})

    @property
    def nominal(self) -> tuple[str, ...]:
        """Scenarios whose plant is the public model's; all of them where none is."""
        return tuple(name for name in self.scenarios if name not in self.robustness) or self.scenarios

    @property
    def middle_dose(self) -> int | None:
        """The middle one of the doses that are shown, or of all; none where none is a number."""
        doses = sorted(dose for dose in (self.shown or self.doses) if dose is not None)
        return doses[len(doses) // 2] if doses else None

    @property
    def granted(self) -> dict[str, Any]:
        """Changes of every scenario's threat model, what the suite grants to know among them."""
        return self.threat | ({} if self.knowledge is None else {"knowledge": self.knowledge})


def _builtin(folder: str) -> dict[str, Path]:
    root = Path(str(files("tailgate.configs").joinpath(folder)))
    return {path.stem: path for path in sorted(root.glob("*.yaml"))}


def config_path(folder: str, name: str, where: str) -> Path:
    """Return the path of a YAML file from its built-in name or its path."""
    if name.endswith(YAML_ENDS):
        return Path(name)
    known = _builtin(folder)
    if name not in known and len(name) < NAME and Path(name).is_file():
        raise InputError(where, name, f"a file that ends with {' or '.join(YAML_ENDS)}, or one of {', '.join(known)}")
    if name not in known:
        raise unknown(where, name, known)
    return known[name]


def list_scenarios() -> list[str]:
    """Return the names of the scenarios that come with the package."""
    return list(_builtin("scenarios"))


def list_suites() -> list[str]:
    """Return the names of the suites that come with the package."""
    return list(_builtin("suites"))


def load_scenario(source: ScenarioLike) -> Scenario:
    """Return a scenario.

    Parameters
    ----------
    source
        A name, a YAML file, or the fields as a mapping; files and mappings may name another scenario as their `base` and contain only what
        changes. A scenario is returned as it is.

    Raises
    ------
    InputError
        For anything else, and for fields that make no scenario.
    """
    if isinstance(source, Scenario):
        return source
    if isinstance(source, Mapping):
        named = source.get("name", "custom")
        return _made(_checked(dict(source), Path(), f"scenario {named}"), Path(f"{named}.yaml"))
    if not isinstance(source, str | Path):
        raise InputError("scenario", source, "a name, a YAML file, a mapping of fields, or an object")
    path = config_path("scenarios", str(source), "scenario")
    return _made(_read_scenario(path, f"scenario {path.stem}"), path)


@functools.lru_cache(maxsize=256)
def name_of(scenario: str) -> str:
    """Return the name of a suite's scenario, as rows and boards have it: that of a file is not its path."""
    return load_scenario(scenario).name


def _made(data: dict[str, Any], path: Path) -> Scenario:
    """Return the scenario of some fields, as they stand in a file of that path."""
    where = f"scenario {path.stem}"
    if (base := data.pop("base", None)) is not None:
        data = _rebased(base, data, path, f"{where}.base")
    for key in (*_COMPONENTS, "horizon"):
        if key not in data:
            raise InputError(f"{where}.{key}", None, "a value; the field is required")
    parts = {key: make_from(key, data[key], f"{where}.{key}") for key in _COMPONENTS}  # type: ignore[arg-type]
    threat = data.get("threat_model", {})
    if not isinstance(threat, dict):
        raise InputError(f"{where}.threat_model", threat, "a mapping of fields")
    rest: dict[str, Any] = {key: data[key] for key in ("horizon", "ends_on_collision", "about", "truth") if key in data}
    rest |= {"name": data.get("name", path.stem), "threat_model": build(ThreatModel, threat, f"{where}.threat_model")}
    scenario = build(Scenario, parts | rest, where)
    _check_truth(scenario.truth, f"{where}.truth")
    told, dt = scenario.truth.get("plant"), getattr(scenario.plant, "dt", None)
    if isinstance(told, dict) and told.get("dt", dt) != dt:
        raise InputError(f"{where}.truth.plant.dt", told["dt"], f"{dt}, as clock and manoeuvre have it")
    return scenario


def _read_scenario(path: Path, where: str) -> dict[str, Any]:
    """Return the fields of a scenario's file."""
    return _checked(read_yaml(path, "scenario"), path.parent, where)


def _checked(data: dict[str, Any], folder: Path, where: str) -> dict[str, Any]:
    """Return the fields of a scenario; the path of a recording begins at the folder."""
    for key in data:
        if key not in (*fields_of(Scenario), "base"):
            raise unknown(f"{where}: unknown field", key, [*fields_of(Scenario), "base"])
    manoeuvre = data.get("manoeuvre")
    if isinstance(manoeuvre, dict) and isinstance(manoeuvre.get("path"), str):
        data["manoeuvre"] = manoeuvre | {"path": folder / manoeuvre["path"]}
    return data


def _rebased(base: object, changes: dict[str, Any], path: Path, where: str) -> dict[str, Any]:
    """Return the fields of a base with changes. A mapping without a `name` changes fields of the base's; everything else replaces it."""
    if not isinstance(base, str):
        raise InputError(where, base, "the name or the file of a scenario")
    file = path.parent / base if base.endswith(YAML_ENDS) else base
    out = _read_scenario(config_path("scenarios", str(file), where), where)
    if "base" in out:  # one level, so that nobody looks for a field in many files
        raise InputError(where, base, "a scenario that has no base")
    out.pop("name", None)
    for key, new in changes.items():
        old = {"name": held} if isinstance(held := out.get(key), str) and key in _COMPONENTS else held
        out[key] = old | new if isinstance(old, dict) and isinstance(new, dict) and "name" not in new else new
    return out


def load_suite(name: str) -> Suite:
    """Return a suite by name, or from a YAML file, whose components are checked at once: a typing error must not show hours later."""
    path = config_path("suites", name, "suite")
    suite = _read_suite(path)
    if name.endswith(YAML_ENDS):
        try:
            _look_through(suite)
        except InputError as error:
            raise InputError(f"suite {name}: {error.field.removeprefix(f'suite {suite.name}: ')}", error.value, error.expected) from None
    return suite


def _look_through(suite: Suite) -> None:
    """Raise InputError for a component that does not exist, and for attackers that cannot be trained."""
    held: dict[str, str] = {}
    for name in suite.scenarios:
        scenario = load_scenario(name)
        if (other := held.setdefault(scenario.name, name)) != name:
            raise InputError(f"suite {suite.name}: scenarios", name, f"another name than {scenario.name}, which is that of {other}")
        if suite.progress is not None and not scenario.brief().model.followers.any():
            raise InputError(f"suite {suite.name}: progress", suite.progress, f"none: nobody follows another in {name}")
    for spec in (*(Spec("defence", text) for text in suite.defences), *(Spec("attack", text) for text in suite.attacks)):
        if not spec.sandboxed:
            spec.make()
    for text in suite.held_out:
        _ = Spec("attack", text).entry
    if suite.adaptive:
        from tailgate.training.adaptive import check_plan

        check_plan(suite)


def _read_suite(path: Path) -> Suite:
    """Return the suite of a file, its own fields checked."""
    suite = build(Suite, {"name": path.stem} | read_yaml(path, "suite"), f"suite {path.stem}")
    for key in suite.threat:
        if key not in fields_of(ThreatModel):
            raise unknown(f"suite {path.stem}: threat: unknown field", key, fields_of(ThreatModel))
    for text in suite.defences:
        Spec("defence", text).refuse_imports(f"suite {path.stem}")
    for text in (*suite.attacks, *suite.held_out):
        Spec("attack", text).refuse_imports(f"suite {path.stem}")
    if suite.progress is not None and "none" not in suite.attacks:
        raise InputError(f"suite {path.stem}: attacks", list(suite.attacks), "none among them, as progress compares with clean runs")
    for name in suite.robustness:
        if name not in suite.scenarios:
            raise unknown(f"suite {path.stem}: robustness", name, suite.scenarios)
    for dose in suite.shown:
        if dose not in suite.doses:
            raise InputError(f"suite {path.stem}: shown", dose, f"one of the doses {list(suite.doses)}")
    return suite
