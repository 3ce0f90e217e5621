"""Packages whose modules are imported when somebody asks for what is in them: all of them take longer than an environment's first step."""

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any


def exported(package: str, homes: dict[str, str]) -> tuple[Callable[[str], Any], list[str]]:
    """A package's `__getattr__` and `__all__`, from its modules and the names, with blanks between, that each gives to the package."""
    where = {name: module for module, names in homes.items() for name in names.split()}

    def get(name: str) -> Any:
        if name not in where:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(f"{package}.{where[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return get, sorted(where)
