"""Parts of the configurations of a training and of self-play: fields, checks, and the configuration that started a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Iterable, Mapping
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError, said
from tailgate.base.reading import load_json
from tailgate.core.schema import as_data


def mapping(doc: str, if_any: bool = False) -> Any:
    """Return a dataclass field that holds a mapping of fields, empty by default; `if_any`: an empty one leaves no mark in data."""
    return dataclasses.field(default_factory=dict, metadata={"doc": doc} | ({"if_any": True} if if_any else {}))


def check_mappings(data: Mapping[str, object], names: Iterable[str]) -> None:
    """Raise InputError unless each of these fields is a mapping."""
    for name in names:
        if not isinstance(data.get(name, {}), dict):
            raise InputError(f"config.{name}", data[name], "a mapping of fields")


def check_places(data: Iterable[str], known: Container[str], places: Mapping[str, Iterable[str]]) -> None:
    """Raise InputError for a field that belongs below another one: `places` has the fields below each."""
    for key in data:
        found = [f"{place}.{key}" for place, fields in places.items() if key in fields]
        if key not in known and found:
            raise InputError("config: unknown field", key, f"the field with its place: {' or '.join(found)}")


def check_folder(out: str, name: str) -> None:
    """Raise InputError unless the name of a run can be that of its folder, and a policy in it be named as an attack."""
    if not name or name == ".." or Path(name).name != name:
        raise InputError("config.name", name, "the name of a directory, without a separator")
    for field, text in (("config.name", name), ("config.out", out)):
        if not text.isprintable():
            raise InputError(field, text, "characters that can be printed")
        if ":" in text:
            raise InputError(field, text, "no colon: in the name of an attack, parameters follow a colon")


def started_with(held: Path) -> dict[str, Any]:
    """Return the configuration that a run was started with. Raises InputError for a file that is none."""
    try:
        started: dict[str, Any] = load_json(held, strict=False)
        del started["class"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError("resume", str(held), f"the configuration of the run ({said(error)})") from None
    return started


def parameters_of(config: type) -> list[dict[str, Any]]:
    """Return every field of a configuration with default and sentence, for --help."""
    return [
        {"name": f.name, "default": as_data(f.default if f.default is not dataclasses.MISSING else {}), "doc": f.metadata.get("doc", "")}
        for f in dataclasses.fields(config)
    ]
