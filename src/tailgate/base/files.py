"""Atomic writing: no file is ever half written, and a finished file survives a crash.

A writer fills a temporary file, flushes it to the disk, renames it over the target, and flushes the folder.
Without the last flush, a loss of power could undo the rename.
A killed writer leaves the old file and a temporary one, which `sweep` removes.
"""

import contextlib
import glob
import itertools
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from tailgate.base.errors import InputError, NotWritable

_UMASK = os.umask(0o077)  # it can only be read by setting it, which other threads would see later
os.umask(_UMASK)
GENERATOR = b'<meta name="generator" content="Tailgate">'  # in every page
TEMPORARY = ".tmp"  # suffix of temporary files

step: Callable[[str, Path], None] | None = None
"""Hook for tests of faults: called with (word, path) before each write, fsync, rename and remove. None in use."""


def _before(what: str, path: Path) -> None:
    if step is not None:
        step(what, path)


def _sync(folder: Path) -> None:
    """Flush the names in a folder to the disk."""
    _before("fsync", folder)
    with contextlib.suppress(OSError):  # some network file systems cannot flush a folder; the rename must do there
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _make(folder: Path) -> None:
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        _sync(path.parent)


@contextlib.contextmanager
def replacing(path: Path, field: str = "out") -> Iterator[IO[bytes]]:
    """Open a file that replaces `path` in one step when the block ends; after an error, `path` is unchanged.

    Raises
    ------
    InputError
        The path cannot be written; the error names `field`.
    """
    check_regular(path, field)
    try:
        _make(path.parent)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=TEMPORARY)
    except OSError as error:
        raise _refused(field, path, "path", error) from None
    try:
        with os.fdopen(handle, "wb") as file:
            _before("write", path)
            yield file
            file.flush()
            _before("fsync", path)
            os.fsync(file.fileno())
        os.chmod(name, 0o666 & ~_UMASK)
        _before("rename", path)
        os.replace(name, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            os.unlink(name)
        if isinstance(error, OSError):
            raise NotWritable(field, str(path), f"a writable path ({error.strerror})") from None
        raise
    _sync(path.parent)


def check_regular(path: Path, field: str = "out") -> None:
    """Raise InputError for a device or a pipe: a result would replace it by a file."""
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):  # False where a folder may not be searched
        raise InputError(field, str(path), "a regular file, or one that does not exist yet")


def write_atomic(path: Path, content: bytes, field: str = "out") -> None:
    """Write a file in one step: readers see the old content or the new one. Raise InputError if it cannot be written."""
    with replacing(path, field) as file:
        file.write(content)


def write_json(path: Path, data: object, field: str = "out") -> None:
    """Write data as JSON, as `write_atomic` writes. Raise ValueError for NaN and infinity, which JSON does not have."""
    write_atomic(path, json.dumps(data, indent=1, allow_nan=False).encode() + b"\n", field)


def write_html(path: Path, content: bytes, field: str = "out") -> None:
    """Write an HTML page as `write_atomic` writes; a file there that is no page of this package is set aside first."""
    if path.is_file() and GENERATOR not in path.read_bytes():
        set_aside(path, field)
    write_atomic(path, content, field)


def sweep(path: Path) -> None:
    """Remove the temporary files that killed writers of `path` left; for a directory, those of every file in it."""
    folder, name = (path, "*") if path.is_dir() else (path.parent, glob.escape(path.name))
    for left in folder.glob(f".{name}.*{TEMPORARY}"):
        remove(left)


def remove(path: Path) -> None:
    """Remove a file if it exists."""
    _before("remove", path)
    path.unlink(missing_ok=True)


def _refused(field: str, path: Path, what: str, error: OSError) -> InputError:
    """Return the error for a path that cannot be written; it names a file that blocks a directory, if there is one."""
    if files := [str(above) for above in path.parents if os.path.isfile(above)]:
        return NotWritable(field, files[0], "a writable directory, not a file")
    return NotWritable(field, str(path), f"a writable {what} ({error.strerror})")


def writable_directory(path: Path, field: str = "out", asked: Path | None = None) -> Path:
    """Make the directory if needed and return it; raise InputError if it is not writable.

    `asked` is the path that the user named, if it differs.
    """
    try:
        _make(path)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise _refused(field, asked or path, "path" if asked else "directory", error) from None
    return path


def aside(path: Path | str | None) -> set[str]:
    """Return the paths of earlier versions that `set_aside` kept for a file."""
    return {str(earlier) for earlier in Path(path).parent.glob(f"{Path(path).name}.[0-9]*")} if path else set()


def set_aside(path: Path, field: str = "out") -> Path:
    """Rename a file or directory to name.1, name.2, ... so that nothing is lost; return the new path."""
    number = next(n for n in itertools.count(1) if not path.with_name(f"{path.name}.{n}").exists())
    _before("rename", path)
    try:
        new = path.rename(path.with_name(f"{path.name}.{number}"))
    except OSError as error:
        raise InputError(field, str(path), f"a writable path ({error.strerror})") from None
    _sync(path.parent)
    return new
