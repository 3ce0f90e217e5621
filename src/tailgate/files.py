"""Writing so that nothing is ever half written."""

import contextlib
import itertools
import os
import tempfile
from pathlib import Path

from tailgate.errors import InputError


def write_atomic(path: Path, content: bytes, field: str = "out") -> None:
    """Write a file in one step: readers see the old content or the new one. Raises InputError when it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise InputError(field, str(path), f"a writable path ({error.strerror})") from None
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(name, 0o644)
        os.replace(name, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise InputError(field, str(path), f"a writable path ({error.strerror})") from None


def writable_directory(path: Path, field: str = "out") -> Path:
    """The directory, made if needed; raises InputError when nothing can be written there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise InputError(field, str(path), f"a writable directory ({error.strerror})") from None
    return path


def set_aside(path: Path, field: str = "out") -> Path:
    """Rename a file or directory to name.1, name.2, ...: nothing is lost. Returns the new path."""
    number = next(n for n in itertools.count(1) if not path.with_name(f"{path.name}.{n}").exists())
    try:
        return path.rename(path.with_name(f"{path.name}.{number}"))
    except OSError as error:
        raise InputError(field, str(path), f"a writable path ({error.strerror})") from None
