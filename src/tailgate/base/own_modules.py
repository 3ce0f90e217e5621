"""The working directory as the place of the user's own modules: it joins the path behind all others, and only when one is named.

In front, or from the start, any file there could take the place of a package that is imported later.
"""

from __future__ import annotations

import ast
import functools
import os
import sys
from pathlib import Path

_wanted = False


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
    return file is None or not {"site-packages", "dist-packages"} & set(Path(file).parts)


@functools.lru_cache(maxsize=256)
def _imported(file: Path, package: str, changed: int) -> list[str]:
    """Return the names of modules that a file may import, and of what may be modules in them. `changed`: when it was [ns]."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):
        return []
    out: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            out += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")
            base = ".".join([*(above[: len(above) + 1 - node.level] if node.level else []), *([node.module] if node.module else [])])
            out += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return out


def files_of(value: object) -> list[Path]:
    """Return the files that somebody's class or function comes from, its own first: those of its bases and of what its module imports."""
    bases = getattr(value, "__mro__", (value,))
    left, seen, found = [str(base.__module__) for base in bases], set[str](), dict[str, Path]()
    for name in left:  # which grows
        module = sys.modules.get(name)
        if module is None or name in seen or not (editable(name) or name == left[0]):
            continue
        seen.add(name)
        if (file := getattr(module, "__file__", None)) and Path(file).is_file():
            found[name] = Path(file)
            left += _imported(found[name], str(module.__package__ or ""), found[name].stat().st_mtime_ns) if editable(name) else []
    return [*list(found.values())[:1], *sorted(list(found.values())[1:])]
