"""Tailgate: defences for adaptive cruise control, scored against an adversary that learns when to attack.

`evaluate` plays defences against attacks and returns a row per episode; `make_defence`, `make_attack` and the lists give components.
`plot` draws rows and traces.

Example::

    import gymnasium
    env = gymnasium.make("tailgate:tailgate/CarFollowing-v1", defence="chi2_kf")

    import tailgate
    rows = tailgate.evaluate(scenarios="stop-and-go-v0", defences="chi2_kf", attacks="none", seeds=2)
"""

from importlib import import_module
from typing import Any

from tailgate import moved as moved
from tailgate.base import interrupts as interrupts  # first: the imports below take half a second, in which a user may change his mind
from tailgate.base.errors import InputError
from tailgate.base.lazy import exported
from tailgate.base.version import VERSION as __version__
from tailgate.core.registry import entries, make

__all__ = [
    "InputError", "__version__", "evaluate", "list_attacks", "list_defences", "make_attack", "make_defence", "parallel_env", "per_episode",
]  # fmt: skip


def make_defence(name: str, **params: object) -> Any:
    """Return a registered defence by name; raise InputError for an unknown name or field."""
    return make("defence", name, **params)


def make_attack(name: str, **params: object) -> Any:
    """Return a registered attack by name; raise InputError for an unknown name or field."""
    return make("attack", name, **params)


def list_defences() -> list[str]:
    """Return the names of all defences, plug-ins included."""
    return list(entries("defence"))


def list_attacks() -> list[str]:
    """Return the names of all attacks, plug-ins included."""
    return list(entries("attack"))


_get, _ = exported(__name__, {"estimators": "per_episode", "evaluation.cells": "evaluate", "envs.gym.parallel": "parallel_env"})


def __getattr__(name: str) -> Any:
    return import_module("tailgate.plot") if name == "plot" else _get(name)


def __dir__() -> list[str]:
    """Return the names of the package, with those that are imported on first use: `help(tailgate)` lists them."""
    return sorted({*globals(), "evaluate", "parallel_env", "per_episode", "plot"})


def _register() -> None:
    from tailgate.envs.gym.gymnasium_env import register_all

    register_all()


_register()
