"""Locks: only one command at a time writes to a place.

The kernel holds the lock, on a hidden file next to the place.
The lock ends with its process, and a leftover file blocks nobody.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
import threading
from collections.abc import Iterator
from pathlib import Path

from tailgate.base.errors import InputError
from tailgate.base.files import writable_directory

SUFFIX = ".lock"
_held: dict[tuple[str, int], int] = {}  # by place and thread: nesting depth, because one command may run others


def lock_of(place: Path) -> Path:
    """Return the lock file of a place; it is next to the place, because a directory may be renamed."""
    folder = os.path.isdir(place)  # a link to a folder is the folder
    place = Path(os.path.realpath(place)) if folder else Path(os.path.realpath(Path(place).parent)) / Path(place).name
    return place.with_name(f".{place.name}{SUFFIX}")


@contextlib.contextmanager
def alone(place: Path, field: str = "out") -> Iterator[None]:
    """Exclude other tailgate processes from a file or directory within the block; raise InputError if one holds it."""
    key = str(lock_of(place)), threading.get_ident()
    if not _held.get(key):
        handle = _taken(place, field)
    _held[key] = _held.get(key, 0) + 1
    try:
        yield
    finally:
        _held[key] -= 1
        if not _held[key]:
            del _held[key]
            _let_go(place, handle)


def _taken(place: Path, field: str) -> int | None:
    """Return a file handle that holds the lock, or None if the file system has no locks."""
    path = lock_of(place)
    while True:
        try:
            handle = _opened(path, field)
        except FileNotFoundError:
            writable_directory(path.parent, field, place)
            continue
        except OSError:
            if not place.is_dir():
                writable_directory(path.parent, field, place)  # raises the reason
            handle = os.open(place, os.O_RDONLY | os.O_CLOEXEC)  # its parent folder is not writable: lock the directory itself
            path = place
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                who = "" if path == place else os.pread(handle, 20, 0).decode(errors="replace").strip()
                os.close(handle)
                who = f"; process {who} does" if who else ""
                raise InputError(field, str(place), f"a place that no other command writes to now{who}") from None
            os.close(handle)
            return None
        if path == place:
            return handle
        there = 0
        with contextlib.suppress(OSError):
            there = os.stat(path, follow_symlinks=False).st_ino
        if there == os.fstat(handle).st_ino:
            with contextlib.suppress(OSError):  # a full disk, or the file of another user: nobody learns who holds it then
                os.ftruncate(handle, 0)
                os.pwrite(handle, f"{os.getpid()}\n".encode(), 0)
            return handle
        os.close(handle)  # the last holder has just removed it


def _opened(path: Path, field: str) -> int:
    """Open a lock file, also one that another user has left; raise InputError for a link, which could name any file."""
    for flags in (os.O_RDWR | os.O_CREAT, os.O_RDONLY):
        try:
            handle = os.open(path, flags | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        except PermissionError:
            if flags == os.O_RDONLY:
                raise
            continue
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise InputError(field, str(path), "a file that is no link") from None
            raise
        found = os.fstat(handle)
        if stat.S_ISREG(found.st_mode) and found.st_nlink <= 1:
            return handle
        os.close(handle)
        raise InputError(field, str(path), "a file with one name, no link")
    raise AssertionError("one of both is opened, or raises")


def _let_go(place: Path, handle: int | None) -> None:
    if handle is None:
        return
    with contextlib.suppress(OSError):
        if os.stat(lock_of(place)).st_ino == os.fstat(handle).st_ino:
            os.unlink(lock_of(place))
    os.close(handle)
