"""Compiled functions: LLVM compiles them for this processor, and a folder caches their object code.

Only the user may write to the folder. The name of an object is a hash of all that it depends on; the file begins with its own hash.
A file that does not match is compiled again. A folder that cannot be written does no harm.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import shutil
import stat
import threading
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError

VERSION = b"2"  # of this module's translation
KEPT = 4000  # most recently used files in the folder
BASIC = ".basic.o"  # how the names of the code of `tailgate.num` end
compiling = threading.RLock()


@cache
def _binding() -> Any:
    """Return llvmlite, initialised for this processor."""
    import llvmlite.binding as binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding


@cache
def processor() -> tuple[str, str]:
    """Return the processor's name and features."""
    binding = _binding()
    return str(binding.get_host_cpu_name()), str(binding.get_host_cpu_features().flatten())


def lanes() -> int:
    """Return how many float64 numbers a vector of this processor holds."""
    features = processor()[1].split(",")
    return 8 if "+avx512f" in features and "+avx512dq" in features else 4 if "+avx2" in features else 2


def level() -> int:
    """Return LLVM's optimisation level: TAILGATE_LLVM, or 1. Levels 2 and 3 compile twice as long for equally fast code; no bit changes."""
    asked = os.environ.get("TAILGATE_LLVM", "1")
    if asked not in ("0", "1", "2", "3"):
        raise InputError("TAILGATE_LLVM", asked, "0, 1, 2 or 3")
    return int(asked)


def _machine() -> Any:
    binding = _binding()
    name, features = processor()
    target = binding.Target.from_default_triple()
    return target.create_target_machine(cpu=name, features=features, opt=level())


def folder() -> Path | None:
    """Return the folder of objects: TAILGATE_CACHE, or below the user's cache; None if others may write to it."""
    with contextlib.suppress(OSError, RuntimeError):  # RuntimeError: this user has no home
        base = os.environ.get("TAILGATE_CACHE") or os.path.join(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "tailgate")
        place = Path(base) / "objects"
        for missing in (*reversed([above for above in place.parents if not above.exists()]), place):
            missing.mkdir(exist_ok=True, mode=0o700)  # whatever the umask lets others do
        if not hasattr(os, "getuid") or _safe(str(place.resolve())):
            return place
    return None


def _safe(place: str) -> bool:
    """Return whether a folder is the user's alone, and no other user may put another one in its place."""
    found = os.stat(place)
    own = found.st_uid == os.getuid() and not found.st_mode & 0o022
    above = [os.stat(folder) for folder in Path(place).parents]
    return own and all(
        one.st_uid in (0, os.getuid()) and (not one.st_mode & 0o022 or bool(one.st_mode & stat.S_ISVTX)) for one in above
    )


def copied_to(place: Path) -> Path:
    """Make a folder with copies of the code of basic functions: the originals' times would tell a sandbox what else is played here."""
    place.mkdir()
    if (source := folder()) is not None:
        for path in source.glob(f"*{BASIC}"):
            with contextlib.suppress(OSError):  # removed meanwhile
                shutil.copyfile(path, place / path.name)
    return place


def kept(name: str) -> bytes | None:
    """Return the content of an object in the folder, or None."""
    place = folder()
    if place is None:
        return None
    with contextlib.suppress(OSError):
        held = (place / name).read_bytes()
        if hashlib.sha256(held[32:]).digest() == held[:32]:
            with contextlib.suppress(OSError):  # a read-only folder
                os.utime(place / name)
            return held[32:]
    return None


def keep(name: str, content: bytes) -> None:
    """Write an object to the folder, if there is one."""
    place = folder()
    if place is None:
        return
    partial = place / f"{name}.{os.getpid()}.{threading.get_ident()}.tmp"
    try:
        partial.write_bytes(hashlib.sha256(content).digest() + content)
        os.replace(partial, place / name)
        if len(os.listdir(place)) > KEPT + KEPT // 8:  # now and then, as their times take 13 us each
            for old in sorted(place.iterdir(), key=lambda path: path.stat().st_mtime)[:-KEPT]:
                old.unlink()
    except OSError:
        with contextlib.suppress(OSError):
            partial.unlink()


def _compiled(text: str) -> bytes:
    binding, machine = _binding(), _machine()
    module = binding.parse_assembly(text)
    module.verify()  # without passes, which cost most of the time and gain little: nodes are unique and ordered already
    return bytes(machine.emit_object(module))


def proved(names: Sequence[str]) -> bool:
    """Return True if code of these objects has been found equal to plain code on this machine."""
    return all(kept(f"{name}.equal") is not None for name in names)


def prove(names: Sequence[str]) -> None:
    """Record that code of these objects equals plain code."""
    for name in names:
        keep(f"{name}.equal", b"")


class Function:
    """The compiled functions `step`, and `bound`, which takes the address of its arguments. Calls release Python's lock."""

    def __init__(self, text: str, basic: bool = False) -> None:
        with compiling:
            binding = _binding()
            key = "\0".join((text, str(level()), *processor(), binding.llvm_version_info and str(binding.llvm_version_info))).encode()
            name = hashlib.sha256(VERSION + key).hexdigest() + (BASIC if basic else ".o")
            content = kept(name)
            self.name, self.fresh = name, content is None
            if content is None:
                content = _compiled(text)
                keep(name, content)
            self._engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _machine())
            self._engine.add_object_file(binding.ObjectFileRef.from_data(content))
            self._engine.finalize_object()
            address = self._engine.get_function_address("step")
        kind = ctypes.CFUNCTYPE(ctypes.c_int64, *(ctypes.c_void_p,) * 5, *(ctypes.c_int64,) * 3)
        self.call = kind(address)
        self.bound = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)(self._engine.get_function_address("bound"))
