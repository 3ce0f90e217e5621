"""Somebody else's classes and functions, named as module:NAME: how they are imported, and what is said of those that are not there."""

from __future__ import annotations

import difflib
import importlib
import sys
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path

from tailgate.base import own_modules
from tailgate.base.errors import InputError, unknown

SHOWN = 12  # classes that an error names, at most


def with_place(error: Exception) -> str:
    """Return an error of somebody's code in a line: its type, its words, and the last line of that code on the way to it.

    Compiled code is left out, as its files cannot be read.
    """
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        file, package = frame.f_code.co_filename, str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if package != "tailgate" and package not in sys.stdlib_module_names and "site-packages" not in file and Path(file).is_file():
            place = f" ({Path(file).name}, line {line})"
    return f"{type(error).__name__}: {error}{place}"


def class_of(family: str, text: str) -> type:
    """Return the class that the user names as module:Class. Raises InputError that says which of both is not there, and what is."""
    cls = attribute_of(family, text, lambda value: isinstance(value, type), "class")
    if not isinstance(cls, type):
        raise InputError(family, text, "a class")
    return cls


def attribute_of(family: str, text: str, fits: Callable[[object], bool], kind: str) -> object:
    """Return what the user names as module:NAME. Raises InputError that says which of both is not there, and what is.

    fits: if an object of that module is of this kind, a word.
    """
    module, _, name = text.partition(":")
    own_modules.join()
    try:
        held = importlib.import_module(module)
        found = getattr(held, name, None)
    except (ImportError, ValueError, TypeError) as error:  # also an empty or relative module name
        raise InputError(family, text, f"an importable module ({error}){_searched(module, error)}") from None
    except SyntaxError as error:
        raise InputError(family, text, f"a module without syntax errors ({error.msg}, line {error.lineno})") from None
    except SystemExit as error:
        raise InputError(family, text, f"a module that can be imported (it ends the process: {error.code!r})") from None
    except Exception as error:  # whatever its first lines do
        raise InputError(family, text, f"a module that can be imported ({with_place(error)})") from None
    if found is None:
        own = sorted(key for key, value in vars(held).items() if fits(value) and getattr(value, "__module__", "") == module)
        shown = ", ".join(own[:SHOWN]) + (f" and {len(own) - SHOWN} more" if len(own) > SHOWN else "")
        raise InputError(family, text, f"a {kind} that module {module} defines{_near(name, own)}" + (f": {shown}" if own else ""))
    return found


def _searched(module: str, error: Exception) -> str:
    """Return where a module was looked for, and a file there whose name is nearly its name."""
    if not isinstance(error, ModuleNotFoundError) or error.name != module.partition(".")[0]:
        return ""
    folders = [Path(place) for place in sys.path if "site-packages" not in place and Path(place).is_dir()]
    here = next((folder for folder in folders if folder.resolve() == Path.cwd()), None)
    files = [] if here is None else [path.stem for path in here.glob("*.py")]
    where = "the installed packages" if here is None else f"the working directory {Path.cwd()} and the installed packages"
    return f", looked for in {where}{_near(module, files)}"


def _near(name: str, names: Iterable[str]) -> str:
    found = difflib.get_close_matches(name[:100], list(names), n=1)
    return f" (did you mean {found[0]!r}?)" if found else ""


def unregistered(family: str, name: str, known: Iterable[str], imports: bool) -> InputError:
    """Return the error for a name that is not registered. imports: somebody's class may be named as module:Class."""
    error = unknown(family, name, known)
    if imports and name.endswith(".py"):
        return InputError(family, name, f"a class of that file, as {Path(name).stem}:Class")
    if imports and name[:1].isupper() and name.isidentifier():
        return InputError(family, name, f"a class of yours as module:{name}, or {error.expected}")
    if not imports and ":" in name:
        how = f"the name of an entry point of the group tailgate.{family}s, or in Python one that @register({family!r}, NAME) has given"
        return InputError(family, name, f"{how}: a file imports nothing; registered are {', '.join(sorted(known))}")
    return error
