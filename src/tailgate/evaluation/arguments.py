"""The arguments of `evaluate`: one or several, as names or objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError
from tailgate.base.reading import YAML_ENDS
from tailgate.core.registry import Family, Spec
from tailgate.core.scenario import Scenario, ScenarioLike, list_scenarios, load_scenario
from tailgate.core.schema import canonical


def several(value: object) -> list[Any]:
    """Return a list of the value, which may be a single name, number, mapping or object."""
    return list(value) if isinstance(value, Iterable) and not isinstance(value, str | Mapping) else [value]


def named_scenarios(scenarios: Sequence[ScenarioLike]) -> dict[str, Scenario | None]:
    """Return scenarios by name, with the object where one is given; a file is its own name."""
    out: dict[str, Scenario | None] = {}
    for one in scenarios:
        place = None if isinstance(one, str | Path) else load_scenario(one)
        name = str(one) if place is None else place.name
        before = out.get(name)
        same = place is before if place is None or before is None else place.config_hash == before.config_hash
        if (name in out and not same) or (place is not None and _taken(place)):
            raise InputError("scenarios", name, "a different name for each object, and no built-in scenario's or file's")
        out[name] = place
    return out


def _taken(place: Scenario) -> bool:
    """If a name belongs to a file, or to a built-in scenario that differs in more than its threat model: rows would name another one."""
    if place.name not in list_scenarios():
        return place.name.endswith(YAML_ENDS)
    known = load_scenario(place.name)
    return dataclasses.replace(place, threat_model=known.threat_model).config_hash != known.config_hash


def _equal(family: Family, one: object, other: object) -> bool:
    a, b = (Spec(family, part).make() if isinstance(part, str) else part for part in (one, other))
    return type(a) is type(b) and dataclasses.is_dataclass(a) and canonical(a) == canonical(b)


def distinct(family: Family, members: Iterable[tuple[str, object]]) -> None:
    """Raise InputError where the texts of two different objects are equal: nobody could tell their rows apart."""
    held: dict[str, object] = {}
    for text, one in members:
        if text in held and held[text] is not one and not _equal(family, held[text], one):
            raise InputError(f"{family}s", text, "objects whose text differs: a dataclass's has its fields")
        held[text] = one
