"""Writing so that nothing is ever half written, and what was written survives a crash.

A file is written beside its place, pushed to the disk, and renamed into its place; then the folder is pushed to the disk, or a loss of
power could undo the rename. A process that is killed in between leaves the old file and a temporary one, which `sweep` removes.
"""

import contextlib
import glob
import itertools
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from tailgate.base.errors import InputError

TEMPORARY = ".tmp"  # what a file that is not yet in its place ends in

step: Callable[[str, Path], None] | None = None
"""For tests of faults: called before each write, fsync, rename and remove with that word and the path. None in use."""


def _before(what: str, path: Path) -> None:
    if step is not None:
        step(what, path)


def _sync(folder: Path) -> None:
    """Push a folder's names to the disk."""
    _before("fsync", folder)
    with contextlib.suppress(OSError):  # some network file systems cannot; there the rename itself is all that can be had
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
    """A file to write, which takes the place of `path` in one step when the block ends; after an error nothing has changed.

    Raises InputError when it cannot be written.
    """
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
        os.chmod(name, 0o644)
        _before("rename", path)
        os.replace(name, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            os.unlink(name)
        if isinstance(error, OSError):
            raise InputError(field, str(path), f"a writable path ({error.strerror})") from None
        raise
    _sync(path.parent)


def write_atomic(path: Path, content: bytes, field: str = "out") -> None:
    """Write a file in one step: readers see the old content or the new one. Raises InputError when it cannot be written."""
    with replacing(path, field) as file:
        file.write(content)


def sweep(path: Path) -> None:
    """Remove what a killed writer of `path` left beside it; of a directory, what the writers of any file in it left."""
    folder, name = (path, "*") if path.is_dir() else (path.parent, glob.escape(path.name))
    for left in folder.glob(f".{name}.*{TEMPORARY}"):
        remove(left)


def remove(path: Path) -> None:
    """Remove a file, if it is there."""
    _before("remove", path)
    path.unlink(missing_ok=True)


def _refused(field: str, path: Path, what: str, error: OSError) -> InputError:
    """The error of what cannot be written: it names the file that stands where a directory has to be, if that is why."""
    if files := [str(above) for above in path.parents if os.path.isfile(above)]:
        return InputError(field, files[0], "a writable directory, not a file")
    return InputError(field, str(path), f"a writable {what} ({error.strerror})")


def writable_directory(path: Path, field: str = "out", asked: Path | None = None) -> Path:
    """The directory, made if needed; raises InputError when nothing can be written there. asked: what the user named, if not this."""
    try:
        _make(path)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise _refused(field, asked or path, "path" if asked else "directory", error) from None
    return path


def aside(path: Path | str | None) -> set[str]:
    """What was set aside for a file."""
    return {str(earlier) for earlier in Path(path).parent.glob(f"{Path(path).name}.[0-9]*")} if path else set()


def set_aside(path: Path, field: str = "out") -> Path:
    """Rename a file or directory to name.1, name.2, ...: nothing is lost. Returns the new path."""
    number = next(n for n in itertools.count(1) if not path.with_name(f"{path.name}.{n}").exists())
    _before("rename", path)
    try:
        new = path.rename(path.with_name(f"{path.name}.{number}"))
    except OSError as error:
        raise InputError(field, str(path), f"a writable path ({error.strerror})") from None
    _sync(path.parent)
    return new
