"""The working directory as the place of the user's own modules: it joins the path behind all others, and only when one is named.

In front, or from the start, any file there could take the place of a package that is imported later.
"""

from __future__ import annotations

import ast
import functools
import os
import sys
from importlib.machinery import PathFinder
from pathlib import Path

_wanted = False
_INSTALLED = {"site-packages", "dist-packages"}
_PACKAGE = Path(__file__).parents[1]  # rows record its version


def allow() -> None:
    """Let modules that the user names be found in the working directory. Nothing is imported, and the path stays as it is."""
    global _wanted
    _wanted = True


def folders() -> list[str]:
    """Return the working directory where the user's modules may lie there, else nothing."""
    return [os.getcwd()] if _wanted else []


def join() -> None:
    """Put the place of the user's modules on the path: one of them is about to be imported."""
    sys.path += [folder for folder in folders() if folder not in sys.path]


@functools.cache
def editable(module: str) -> bool:
    """Return True for a module that is neither this package's nor installed: a script, a notebook, a file of somebody's."""
    top, file = module.partition(".")[0], getattr(sys.modules.get(module), "__file__", None)
    if top in ("tailgate", "builtins") or (top in sys.stdlib_module_names and module != "__main__"):
        return False
    return file is None or not _INSTALLED & set(Path(file).parts)


@functools.lru_cache(maxsize=256)
def _imported(file: Path, changed: int) -> list[tuple[int, str]]:
    """Return what a file may import: how many folders up it is looked for (0: on the path), and names. `changed`: when it was [ns]."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):
        return []
    out: list[tuple[int, str]] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            out += [(0, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = f"{node.module}." if node.module else ""
            out += [(node.level, base.rstrip("."))] if base else []
            out += [(node.level, f"{base}{alias.name}") for alias in node.names]
    return list(dict.fromkeys(out))


def _found(level: int, name: str, reader: Path) -> Path | None:
    """Return the file of a module that the file `reader` imports, loaded or not; None for what is installed, or no module."""
    if not level and name.partition(".")[0] in {"tailgate", *sys.stdlib_module_names}:
        return None
    above = str(reader.parents[level - 1]) if level else str(reader.parent)
    places: list[str] | None = [above] if level else [*sys.path, *folders(), above]
    for part in name.split("."):
        spec = PathFinder.find_spec(part, places)
        if spec is None:
            return None
        places = list(spec.submodule_search_locations or [])
    file = Path(spec.origin) if spec is not None and spec.origin else None
    return file if file is not None and file.is_file() and not _INSTALLED & set(file.parts) else None


def files_of(value: object) -> list[Path]:
    """Return the files that somebody's class or function comes from, its own first: those of its bases, and what these import."""
    bases = [str(base.__module__) for base in getattr(value, "__mro__", (value,))]
    own = [getattr(sys.modules.get(name), "__file__", None) for i, name in enumerate(bases) if i == 0 or editable(name)]
    found = [file for file in map(Path, filter(None, own)) if file.is_file()]
    for file in found:  # which grows
        if not _INSTALLED & set(file.parts) and _PACKAGE not in file.parents:
            more = (_found(level, name, file) for level, name in _imported(file, file.stat().st_mtime_ns))
            found += [one for one in dict.fromkeys(more) if one is not None and one not in found]
    return list(dict.fromkeys(found[:1] + sorted(found[1:])))
