"""Packages that import their modules on first use: importing all would take longer than an environment's first step.

The modules of components are found by looking at the folder.
"""

import re
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

_REGISTERED = re.compile(r'^@register\(\s*"(\w+)",\s*"([\w-]+)".*?^class (\w+)', re.MULTILINE | re.DOTALL)


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


@cache
def texts(package: str) -> dict[str, str]:
    """Return the text of every module below a package, by the module's full name."""
    root = Path(str(import_module(package).__file__)).parent
    return {
        ".".join((package, *path.relative_to(root).with_suffix("").parts)): path.read_text("utf-8")
        for path in sorted(root.rglob("*.py"))
        if path.name != "__init__.py"
    }


@cache
def components(package: str) -> dict[tuple[str, str], str]:
    """Return the module that registers each component of a package, by family and name."""
    return {(family, name): module for module, text in texts(package).items() for family, name, _ in _REGISTERED.findall(text)}


@cache
def homes(package: str) -> dict[str, str]:
    """Return the module of each registered class of a package, by the name of the class."""
    return {kind: module for module, text in texts(package).items() for _, _, kind in _REGISTERED.findall(text)}


def discovered(package: str, *others: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package that gives all its registered classes by name.

    others: classes and functions that the package gives too, each defined in one of its modules.
    """

    def module_of(name: str) -> str | None:
        if name in others:
            opens = re.compile(rf"^(?:class|def) {name}\b", re.MULTILINE)
            return next(module for module, text in texts(package).items() if opens.search(text))
        return homes(package).get(name)

    def names() -> list[str]:
        return sorted({*homes(package), *others})

    def get(name: str) -> object:
        if name == "__all__":
            return names()
        home = None if name.startswith("_") else module_of(name)
        if home is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(home), name)
        setattr(sys.modules[package], name, value)
        return value

    return get, names


def loaded(package: str, family: str) -> list[ModuleType]:
    """Import every module below a package that registers a component of a family; others may need more than is installed."""
    return [import_module(module) for module in dict.fromkeys(module for (of, _), module in components(package).items() if of == family)]
