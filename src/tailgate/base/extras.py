"""Packages that come with an extra of this one."""

from importlib import import_module
from typing import Any


def optional(module: str, extra: str, why: str) -> Any:
    """Return a module. Raise ImportError that says why it is needed, with the command that installs it, where it is missing."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f"{why}: pip install 'tailgate[{extra}]'") from error
