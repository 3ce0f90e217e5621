"""A copy of a submission's files, from which it is played, and its digest."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.machinery import PathFinder
from importlib.metadata import entry_points
from pathlib import Path

from tailgate.base import own_modules
from tailgate.base.errors import InputError
from tailgate.core.spec_text import split_text

LARGEST = 2**30  # [bytes] of a submission with its weights
_LEFT_OUT = ("__pycache__", ".git")


@dataclass(frozen=True)
class Source:
    """A submission as module:Class, its digest, and the directory from which it is imported; None for built-in classes."""

    text: str
    digest: str
    path: Path | None


def named(text: str) -> str:
    """Return the text with an entry point's name replaced by its module:Class, without importing it."""
    head, tail = split_text(text)
    if ":" not in head:
        found = list(entry_points(group="tailgate.estimators", name=head))
        if not found:
            raise InputError("submission", text, "module:Class, or the name of an entry point of tailgate.estimators")
        head = found[0].value
    module, _, name = head.partition(":")
    if not all(part.isidentifier() for part in (*module.split("."), name)):
        raise InputError("submission", text, "module:Class")
    return f"{head}:{tail}" if tail else head


def _files(module: str) -> tuple[Path, list[Path], bool]:
    """Return the folder and files of a top-level module, and True if it is a package, without importing it."""
    top = module.partition(".")[0]
    try:  # the path itself stays without the working directory, where a stranger's files may lie
        spec = PathFinder.find_spec(top, own_modules.folders()) or importlib.util.find_spec(top)
    except (ImportError, ValueError):
        spec = None
    if spec is None:
        raise InputError("submission", module, "a module that is found in the working directory or is installed")
    if spec.submodule_search_locations:
        root = Path(next(iter(spec.submodule_search_locations))).resolve()
        every = [path for path in root.rglob("*") if path.is_symlink() or path.is_file()]
        files = [path for path in every if not set(_LEFT_OUT) & set(path.relative_to(root).parts)]
    elif spec.origin is not None and Path(spec.origin).is_file():
        root, files = Path(spec.origin).resolve().parent, [Path(spec.origin).resolve()]
    else:
        raise InputError("submission", module, "a module that is a file or a folder")
    for path in files:
        if path.is_symlink():
            raise InputError("submission", str(path), "a file: links are not followed, so that the played files are the hashed ones")
    if (size := sum(path.stat().st_size for path in files)) > LARGEST:
        raise InputError("submission", f"{size} bytes", f"at most {LARGEST} bytes in {root}")
    return root, files, bool(spec.submodule_search_locations)


def digest_of(module: str) -> str:
    """Return the SHA-256 of names and contents of a module's one file or a package's files, without importing it."""
    root, files, _ = _files(module)
    return _digest(root, files)


def digest_of_file(module: str, path: Path) -> str:
    """Return the digest of a module that consists of the file at this path alone; else empty."""
    with contextlib.suppress(InputError):  # not a valid submission
        root, files, package = _files(module)
        if not package and files == [path.resolve()]:
            return _digest(root, files)
    return ""


def _digest(root: Path, files: list[Path]) -> str:
    out = hashlib.sha256()
    for path in sorted(files):
        name, content = path.relative_to(root).as_posix().encode(), path.read_bytes()
        out.update(b"%d:%s:%d:" % (len(name), name, len(content)) + content)
    return out.hexdigest()


@contextlib.contextmanager
def staged(text: str) -> Iterator[Source]:
    """Copy the submission to a temporary directory, so that exactly the hashed files can be imported.

    Classes of tailgate are imported in place; the version identifies them, as in every row.
    """
    text = named(text)
    module = text.partition(":")[0]
    top = module.partition(".")[0]
    if top == "tailgate":
        yield Source(text, "", None)
        return
    root, files, package = _files(module)
    with tempfile.TemporaryDirectory(prefix="tailgate-source-") as folder:
        base, copies = Path(folder, top) if package else Path(folder), []
        for path in files:
            copies.append(base / path.relative_to(root))
            copies[-1].parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copies[-1])
        yield Source(text, _digest(base, copies), Path(folder))
