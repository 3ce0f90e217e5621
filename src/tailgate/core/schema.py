"""Data to validated parameters: the dataclasses are the only place of types and defaults."""

import dataclasses
import hashlib
import json
import re
import types
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic.errors import PydanticSchemaGenerationError, PydanticUserError

from tailgate.base.errors import InputError, said, unknown, wanted
from tailgate.base.reading import load_yaml, parse_json, parse_yaml, read_bytes

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)
# Hashes of configurations hold the names of classes. A module that has another name than when the hashes were published is listed here.
PUBLISHED = {
    "tailgate.core.lossy_link": "tailgate.link",
    "tailgate.core.scenario": "tailgate.scenario",
    "tailgate.core.threat": "tailgate.threat",
    "tailgate.training.adaptive": "tailgate.adaptive",
    "tailgate.training.selfplay": "tailgate.selfplay",
    "tailgate.training.train": "tailgate.train",
    "tailgate.training.tuning": "tailgate.tuning",
    "tailgate.agents.policy.network_policy": "tailgate.agents.policy",
    "tailgate.envs.controllers.adaptive_cruise": "tailgate.envs.controllers",
    "tailgate.envs.gym.actions": "tailgate.agents.codec",
    "tailgate.envs.gym.attacker_mdp": "tailgate.envs.seat",
    "tailgate.envs.gym.gymnasium_env": "tailgate.envs.faces",
    "tailgate.envs.gym.mixture": "tailgate.agents.mixture",
    "tailgate.envs.gym.observations": "tailgate.agents.observation",
    "tailgate.envs.gym.rewards": "tailgate.agents.reward",
    "tailgate.envs.plants.car_following": "tailgate.envs.following",
    "tailgate.envs.plants.scalar": "tailgate.envs.scalar_loop",
    "tailgate.envs.plants.sensor_network": "tailgate.envs.network",
    "tailgate.envs.plants.thesis_printed": "tailgate.envs.literal",
    "tailgate.envs.sensors.fmcw_radar": "tailgate.envs.radar",
    "tailgate.envs.sensors.odometry": "tailgate.envs.sensors",
    "tailgate.estimators.challenge.challenge_response": "tailgate.estimators.challenge",
    "tailgate.estimators.detectors.sequential": "tailgate.estimators.detectors",
    "tailgate.estimators.distributed.distributed_kalman": "tailgate.estimators.distributed",
    "tailgate.estimators.mitigations.responses": "tailgate.estimators.mitigations",
}
UNIT = re.compile(r"\[([^][]+)\]$")  # how the sentence on a parameter ends
COMPONENTS = re.compile(r"(tailgate\.(?:envs|estimators|agents))\.\w+\.(\w+)")  # hashes leave out which sub-folder a module lies in


def published(kind: type | Callable[..., object]) -> str:
    """Return the name of a class or function that hashes of configurations hold."""
    module = kind.__module__
    if module not in PUBLISHED and (found := COMPONENTS.fullmatch(module)):
        return f"{found[1]}.{found[2]}.{kind.__qualname__}"
    return f"{PUBLISHED.get(module, module)}.{kind.__qualname__}"


def fields_of(cls: type) -> dict[str, Any]:
    """Return the parameters that a user may set: name -> dataclasses.Field."""
    if not dataclasses.is_dataclass(cls):
        return {}
    return {f.name: f for f in dataclasses.fields(cls) if f.init}


@cache
def _adapter(cls: type) -> TypeAdapter[Any]:
    try:
        return TypeAdapter(cls, config=ConfigDict(extra="forbid"))
    except PydanticUserError:  # the class carries its own configuration
        return TypeAdapter(cls)


def build(cls: type[T], data: dict[str, Any], where: str) -> T:
    """Return an instance of dataclass `cls` from `data`; raise InputError that names `where`.field, value and expectation."""
    known = fields_of(cls)
    for key in data:
        if key not in known:
            raise unknown(f"{where}: unknown field", key, known)
    if not known:
        return _made(cls, {}, where)
    for key in _numeric(cls):  # type: ignore[arg-type]
        if (found := _wordy(data.get(key), (key,))) is not None:
            raise InputError(f"{where}.{'.'.join(map(str, found[0]))}", found[1], "a number")
    try:
        adapter = _adapter(cls)  # type: ignore[arg-type]
    except PydanticSchemaGenerationError:  # a plug-in with fields that are not data: its own constructor decides
        return _made(cls, data, where)
    try:
        return adapter.validate_python(data)  # type: ignore[no-any-return]
    except ValidationError as error:
        first = error.errors()[0]
        if isinstance(inner := first.get("ctx", {}).get("error"), InputError):
            raise inner from None
        path = ".".join(str(part) for part in first["loc"]) or cls.__name__
        unit = _unit(known, first["loc"]) if first["type"].startswith(("greater", "less")) else ""
        raise InputError(f"{where}.{path}", first["input"], f"{wanted(first)}{unit}") from None


@cache
def _numeric(cls: type) -> frozenset[str]:
    """Return the fields that hold numbers, or tuples of them, and nothing else but none."""
    try:
        hints = get_type_hints(cls)
    except (NameError, TypeError):  # a plug-in with names that only a type checker knows
        return frozenset()
    return frozenset(name for name in fields_of(cls) if name in hints and _of_numbers(hints[name]))


def _of_numbers(kind: object) -> bool:
    if kind in (int, float):
        return True
    inner = [part for part in get_args(kind) if part not in (types.NoneType, ...)]
    return get_origin(kind) in (tuple, Union, types.UnionType) and bool(inner) and all(map(_of_numbers, inner))


def _wordy(value: object, place: tuple[int | str, ...]) -> tuple[tuple[int | str, ...], object] | None:
    """Return place and value of a word or a truth value among numbers: YAML's yes and on, and quoted numbers, which nobody means."""
    if isinstance(value, list | tuple):
        return next((found for i, part in enumerate(value) if (found := _wordy(part, (*place, i))) is not None), None)
    return (place, value) if isinstance(value, bool | str) else None


def _unit(known: dict[str, Any], place: tuple[int | str, ...]) -> str:
    """Return the unit at the end of a parameter's sentence, with a space before it."""
    found = UNIT.search(known[place[0]].metadata.get("doc", "")) if place and place[0] in known else None
    units = found[1].split(", ") if found else [""]
    at = place[1] if len(units) > 1 and len(place) > 1 else 0
    unit = units[at] if isinstance(at, int) and at < len(units) else ""
    return "" if unit in ("", "-") else f" [{unit}]"


def _made(cls: type[T], data: dict[str, Any], where: str) -> T:
    """Return the object that the class's own constructor makes of the data."""
    try:
        return cls(**data)
    except TypeError as error:
        raise InputError(where, data or None, f"parameters that its constructor takes ({error})") from None


def as_data(value: object) -> Any:
    """Return parameters as plain JSON data: the class and every field. Empty fields that are marked `if_any` are left out."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kind = type(value)
        shown = [f.name for f in dataclasses.fields(value) if f.init and (not f.metadata.get("if_any") or getattr(value, f.name))]
        fields = {name: as_data(getattr(value, name)) for name in shown}
        return {"class": published(kind), **fields}
    if isinstance(value, dict):
        return {str(k): as_data(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_data(v) for v in value]
    if isinstance(value, (types.NoneType, bool, int, float, str)):
        return value
    if isinstance(value, np.generic):
        return str(value) if isinstance(value.item(), np.generic) else as_data(value.item())
    if isinstance(value, np.ndarray) and value.dtype == object:
        return as_data(value.tolist())
    if isinstance(value, np.ndarray):
        return {"array": [value.dtype.str, list(value.shape), hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]}
    if isinstance(value, Path):  # what the file says counts, not where it lies
        return f"{value.name}#{hashlib.sha256(value.read_bytes()).hexdigest()[:16]}" if value.is_file() else value.name
    named = value if callable(value) and hasattr(value, "__qualname__") else type(value)  # a repr may hold an address
    return published(named)


def canonical(value: object) -> str:
    """Return JSON text that is the same for the same parameters: the input of hashes."""
    return json.dumps(as_data(value), sort_keys=True, separators=(",", ":"))


def digest(value: object) -> str:
    """Return sixteen hexadecimal digits that are the same for the same parameters."""
    return hashlib.blake2b(canonical(value).encode(), digest_size=8).hexdigest()


def read_model(model: type[M], path: Path, what: str, made_by: str) -> M:
    """Return a model from its JSON file. Raise InputError that names file and field for anything that `made_by` does not write."""
    try:
        content = read_bytes(path)
        parse_json(content)
        return model.model_validate_json(content)
    except OSError as error:
        raise InputError(what, str(path), f"a readable report of {made_by} ({said(error)})") from None
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        if not field:
            raise InputError(what, str(path), f"a report of {made_by}, which is a JSON object") from None
        raise InputError(f"{what} {path}: {field}", first["input"] if first["type"] != "missing" else None, wanted(first)) from None
    except ValueError as error:
        raise InputError(what, str(path), f"a report of {made_by}, which is a JSON object ({error})") from None


def read_yaml(path: Path, where: str) -> dict[str, Any]:
    """Return a mapping from a YAML file, read safely."""
    try:
        data = load_yaml(path)
    except OSError as error:
        raise InputError(where, str(path), f"a readable YAML file ({error.strerror})") from None
    except ValueError as error:
        raise InputError(where, str(path), f"valid YAML ({error})") from None
    if not isinstance(data, dict):
        raise InputError(where, str(path), "a YAML mapping of fields")
    return data


def scalar(text: str) -> Any:
    """Return a command-line value, read as YAML reads a scalar or a flow list ('3', 'true', '[1, 2]', 'none')."""
    if text.lower() in ("none", "null"):
        return None
    try:
        value = parse_yaml(text)
    except ValueError:  # no YAML, or a date
        return text
    if isinstance(value, str):
        try:
            return float(value)  # YAML 1.1 takes 1e5 for text
        except ValueError:
            return value
    return value


def override(data: dict[str, Any], assignments: list[str], cls: type) -> dict[str, Any]:
    """Return `data`, the fields of `cls`, with dotted `key=value` assignments put in. A text field takes its value as text."""
    out: dict[str, Any] = json.loads(json.dumps(data))
    kinds = get_type_hints(cls)
    for text in assignments:
        key, sep, value = text.partition("=")
        if not sep or not key:
            raise InputError("override", text, "key=value, for example steps=100000")
        node = out
        *parents, leaf = key.split(".")
        for name in parents:
            child = node.setdefault(name, {})
            if not isinstance(child, dict):
                raise InputError(f"override {key}", value, f"a field below a mapping; {name} is {child!r}")
            node = child
        held = scalar(value)
        if not isinstance(held, (str, list, dict)) and (kinds.get(key) is str or (kinds.get(key) == str | None and held is not None)):
            held = value.strip("'\"")  # such as nan, 5 or true
        node[leaf] = "none" if leaf == "defence" and held is None else held  # a defence has this name, and always one
    return out
