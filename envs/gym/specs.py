"""Checks of an environment's arguments, in one place; and specs of Gymnasium that write objects as text."""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.envs.registration import EnvSpec

from tailgate.base.errors import InputError, unknown
from tailgate.core import Array
from tailgate.core.registry import Family, Spec, entry_for, text_of
from tailgate.core.schema import as_data

if TYPE_CHECKING:
    from tailgate.envs.gym.attacker_mdp import Seat

ROUNDING = 1e-6  # by which a vector may leave [-1, 1]: float32 that was scaled is off by as much
_FAMILIES: dict[str, Family] = {"defence": "defence", "attack": "attack"}  # arguments that may be objects


def in_box(actions: Array) -> bool:
    """Return True if all values are numbers in [-1, 1], rounding aside: NaN and infinity are not."""
    return actions.dtype.kind in "fiu" and bool((np.abs(actions) <= 1.0 + ROUNDING).all())


def check_options(options: object, known: Iterable[str] = (), ignored: Iterable[str] = ()) -> None:
    """Raise InputError for options of reset() that nobody reads. ignored: those that are taken and mean nothing."""
    if options is None:
        return
    if not isinstance(options, Mapping):
        raise InputError("options", options, "a mapping, or None")
    names, silent = tuple(known), tuple(ignored)
    for key in options:
        if key not in names and key not in silent:
            where = "options: unknown key"
            raise unknown(where, key, names) if names else InputError(where, key, "no options: reset takes none")


def shown(environment: object, spec: EnvSpec | None, seat: Seat) -> str:
    """Return the text that shows an environment: its id or, where it has none, its scenario and its defence."""
    place = spec.id if spec else f"{seat.config['scenario']['name']}, {seat.config['defence']['spec']}"
    return f"{type(environment).__name__}({place})"


def limit_of(name: str, given: int | None) -> int:
    """Return the argument of this name: decisions of an episode at most, 0 where there is no limit.

    Raise InputError for any other value.
    """
    if given is not None and (not isinstance(given, (int, np.integer)) or isinstance(given, bool) or given < 1):
        raise InputError(name, given, "a whole number of decisions not below 1, or None")
    return int(given or 0)


def named(family: Family, value: object, imports: bool = True) -> str:
    """Return the text from which another process makes the same object. Raise InputError where there is none."""
    cls, why = type(value), "its parameters are no plain data"
    try:
        if "<locals>" in cls.__qualname__ or cls.__module__ == "__main__":
            why = "its class lies in no module"
        else:
            shown = value
            if dataclasses.is_dataclass(value) and not isinstance(value, type):
                paths = {f.name: str(held) for f in dataclasses.fields(value) if isinstance(held := getattr(value, f.name), Path)}
                shown = dataclasses.replace(value, **paths) if paths else value
            spec = Spec(family, text_of(entry_for(family, cls), shown))
            if spec.imports and not imports:
                why = "its class is no registered one"
            elif (made := spec.make()) == value or not (getattr(made, "__dict__", {}) or getattr(value, "__dict__", {})):
                return spec.text
    except (InputError, TypeError, ValueError):
        pass
    wanted = "a text such as 'chi2_kf:eta=15'" if family == "defence" else "a text such as 'fdi:value=-10'"
    raise InputError(f"spec: {family}", value, f"{wanted}: this object cannot be written as JSON, as {why}")


class TextSpec(EnvSpec):
    """A spec whose JSON writes defences, attacks and menus as text; its own arguments stay the objects that they are."""

    def to_json(self) -> str:
        imports = "Defender" not in self.id  # a defender's environment names a registered defence
        kwargs = {key: _plain(key, value, imports) for key, value in self.kwargs.items()}
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(EnvSpec) if f.init and f.name != "kwargs"}
        return EnvSpec(**plain, kwargs=kwargs).to_json()


def _plain(key: str, value: object, imports: bool) -> Any:
    """Return an argument as JSON data."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if _is_plain(value):
        return value
    if key in _FAMILIES:
        if isinstance(value, list | tuple):
            return [held if isinstance(held, str) else named(_FAMILIES[key], held, imports) for held in value]
        return named(_FAMILIES[key], value, imports)
    if key == "menu" and dataclasses.is_dataclass(value):
        return {name: held for name, held in as_data(value).items() if name != "class"}
    raise InputError(f"spec: {key}", value, "numbers, text, lists and mappings of them: anything else cannot be written as JSON")


def _is_plain(value: object) -> bool:
    try:
        json.dumps(value)
    except (TypeError, ValueError):
        return False
    return True


class Specified:
    """Base of environments: the spec that Gymnasium's `make` sets gets their horizon, and can be written as JSON or explains why not."""

    horizon: int  # decisions of an episode that nothing ends early
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        return self._spec

    @spec.setter
    def spec(self, given: EnvSpec | None) -> None:
        if given is not None and not isinstance(given, TextSpec) and not all(map(_is_plain, given.kwargs.values())):
            kept = {f.name: getattr(given, f.name) for f in dataclasses.fields(EnvSpec) if f.init}
            given = TextSpec(**kept)
        if given is not None and (given.max_episode_steps is None or given.max_episode_steps > self.horizon):
            given = copy.copy(given)
            given.max_episode_steps = self.horizon
        self._spec = given
