"""Packages that import their modules on first use: importing all would take longer than an environment's first step."""

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any


def exported(package: str, homes: dict[str, str]) -> tuple[Callable[[str], Any], list[str]]:
    """Return a package's `__getattr__` and `__all__`.

    `homes` maps each module to the names that it exports, separated by blanks.
    """
    where = {name: module for module, names in homes.items() for name in names.split()}

    def get(name: str) -> Any:
        if name not in where:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(f"{package}.{where[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return get, sorted(where)
