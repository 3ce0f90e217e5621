"""Compiled functions: made by LLVM for this processor, and kept on disk as object code.

The folder of objects is the user's own and nobody else may write to it. An object is named by all that it depends on, and begins with its
own hash: what does not fit is compiled again. Nothing breaks where the folder cannot be written.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import threading
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError

VERSION = b"2"  # of what this module makes of a text
KEPT = 4000  # files in the folder, those that were used last
_lock = threading.RLock()


@cache
def _binding() -> Any:
    """llvmlite, ready for this processor."""
    import llvmlite.binding as binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding


@cache
def processor() -> tuple[str, str]:
    """Its name, and what it can do."""
    binding = _binding()
    return str(binding.get_host_cpu_name()), str(binding.get_host_cpu_features().flatten())


def lanes() -> int:
    """How many float64 a vector of this processor holds."""
    features = processor()[1].split(",")
    return 8 if "+avx512f" in features and "+avx512dq" in features else 4 if "+avx2" in features else 2


def level() -> int:
    """LLVM's level of optimisation: TAILGATE_LLVM, or 1; 2 and 3 take twice the time to compile, for code as fast. No bit depends on it."""
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
    """Where objects are kept: TAILGATE_CACHE, or below the user's cache. None where it is not the user's own."""
    base = os.environ.get("TAILGATE_CACHE") or os.path.join(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "tailgate")
    place = Path(base) / "objects"
    with contextlib.suppress(OSError):
        place.mkdir(parents=True, exist_ok=True, mode=0o700)
        found = place.stat()
        if not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not found.st_mode & 0o022):
            return place
    return None


def _kept(name: str) -> bytes | None:
    place = folder()
    if place is None:
        return None
    with contextlib.suppress(OSError):
        held = (place / name).read_bytes()
        if hashlib.sha256(held[32:]).digest() == held[:32]:
            with contextlib.suppress(OSError):  # a folder that can only be read
                os.utime(place / name)
            return held[32:]
    return None


def _keep(name: str, content: bytes) -> None:
    place = folder()
    if place is None:
        return
    partial = place / f"{name}.{os.getpid()}.{threading.get_ident()}.tmp"
    try:
        partial.write_bytes(hashlib.sha256(content).digest() + content)
        os.replace(partial, place / name)
        for old in sorted(place.iterdir(), key=lambda path: path.stat().st_mtime)[:-KEPT]:
            old.unlink()
    except OSError:
        with contextlib.suppress(OSError):
            partial.unlink()


def _compiled(text: str) -> bytes:
    binding, machine = _binding(), _machine()
    module = binding.parse_assembly(text)
    module.verify()  # no passes: they take most of the time and gain little, since nodes are unique and ordered already
    return bytes(machine.emit_object(module))


def proved(names: Sequence[str]) -> bool:
    """Has code of these objects once been compared with plain code on this machine, and been found equal?"""
    return all(_kept(f"{name}.equal") is not None for name in names)


def prove(names: Sequence[str]) -> None:
    """Remember that it has."""
    for name in names:
        _keep(f"{name}.equal", b"")


class Function:
    """`step` of a text, and `bound`, which has the address of its arguments. Calls release Python's lock."""

    def __init__(self, text: str) -> None:
        with _lock:
            binding = _binding()
            key = "\0".join((text, str(level()), *processor(), binding.llvm_version_info and str(binding.llvm_version_info))).encode()
            name = hashlib.sha256(VERSION + key).hexdigest() + ".o"
            content = _kept(name)
            self.name, self.fresh = name, content is None
            if content is None:
                content = _compiled(text)
                _keep(name, content)
            self._engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _machine())
            self._engine.add_object_file(binding.ObjectFileRef.from_data(content))
            self._engine.finalize_object()
            address = self._engine.get_function_address("step")
        kind = ctypes.CFUNCTYPE(ctypes.c_int64, *(ctypes.c_void_p,) * 5, *(ctypes.c_int64,) * 3)
        self.call = kind(address)
        self.bound = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)(self._engine.get_function_address("bound"))
