"""Compiled functions: parts, which only others call, and kernels, whose machine code is kept on disk.

It is kept by the sources of everything that it is made of; numba's own key is the file that holds the function alone. And it is loaded
without numba, which takes longer to import and to set up than an environment's first step.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import threading
from collections.abc import Callable, Iterator
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

from tailgate.errors import InputError
from tailgate.files import remove, write_atomic
from tailgate.jit import Jitted, numba, when_there

_OPTIONS: dict[str, Any] = {"error_model": "numpy"}  # no fast-math: the bits are the plain loop's
_BARE: dict[str, Any] = {"_nrt": False}  # nothing in it owns an array, so that no references are counted
KEPT = 8  # kernels in a folder, at most: of the sources as they were


def _inside() -> bool:
    """Whether this is the numba whose inner workings `parts` knows; without them compiling takes three times as long."""
    return str(numba().__version__).startswith("0.68.")


def _inner() -> dict[str, Any]:
    options = _OPTIONS | {"no_cfunc_wrapper": True}
    if _inside():
        from .parts import Part

        options |= _BARE | {"no_cpython_wrapper": True, "pipeline_class": Part}
    return options


def phase(function: Callable[..., Any]) -> Jitted:
    """A loop over the episodes of a block."""
    return Jitted(function, _inner)


def formula(function: Callable[..., Any]) -> Jitted:
    """Of one episode, part of the loop that calls it; or a loop over given rows."""
    return Jitted(function, lambda: _inner() | {"forceinline": True})


def array_at(place: Any, shape: Any, dtype: Any) -> Any:
    """In compiled code: the array of this shape, a number or several, at a place in memory, which nobody owns."""
    raise TypeError("array_at is for compiled code")


@when_there
def _tell_array_at(numba: Any) -> None:  # numba's own `carray` wants references to be counted
    arrays: Any = import_module("numba.np.arrayobj")
    types = numba.types

    def made(place: Any, shape: Any, dtype: Any) -> Any:
        return types.Array(dtype.dtype, len(shape) if isinstance(shape, types.BaseTuple) else 1, "C")

    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind, (place, shape, _) = signature.return_type, arguments
        given = signature.args[1]
        lengths = arrays.cgutils.unpack_tuple(builder, shape) if isinstance(given, types.BaseTuple) else [shape]
        lengths = [context.cast(builder, one, of, types.intp) for one, of in zip(lengths, given if kind.ndim > 1 else [given], strict=True)]
        size = context.get_constant(types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype)))
        strides = [size]
        for length in lengths[:0:-1]:
            strides.insert(0, builder.mul(strides[0], length))
        array = context.make_array(kind)(context, builder)
        data = builder.bitcast(place, array.data.type)
        arrays.populate_array(array, data=data, shape=lengths, strides=strides, itemsize=size, meminfo=None)
        return array._getvalue()

    numba.extending.type_callable(array_at)(lambda context: made)
    numba.extending.lower_builtin(array_at, types.voidptr, types.Any, types.Any)(lower)


def fetch(array: Any, at: Any) -> None:
    """In compiled code: the line of the cache with this element will be read soon."""
    raise TypeError("fetch is for compiled code")


@when_there
def _tell_fetch(numba: Any) -> None:
    from llvmlite import ir

    types, cgutils = numba.types, numba.core.cgutils
    whole = ir.IntType(32)

    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        place = builder.bitcast(builder.gep(array.data, [arguments[1]]), cgutils.voidptr_t)
        signature = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, whole, whole, whole])
        prefetch = builder.module.declare_intrinsic("llvm.prefetch", [cgutils.voidptr_t], signature)
        builder.call(prefetch, [place, whole(0), whole(2), whole(1)])  # to read, into the second cache, data
        return context.get_dummy_value()

    numba.extending.type_callable(fetch)(lambda context: lambda array, at: types.none)
    numba.extending.lower_builtin(fetch, types.Array, types.Integer)(lower)


def written_in(function: Callable[..., Any]) -> Jitted:
    """As if its text stood where it is called."""
    return Jitted(function, lambda: _OPTIONS | {"inline": "always"})


_SOURCES = {  # by package, which may lie in folders of their own
    "tailgate.fused": ("",),
    "tailgate": ("elementwise.py", "jit.py", "kernels.py", "kinds.py", "draws.py", "lanes.py", "linear.py", "threat.py", "vector.py"),
    "tailgate.agents": ("reward.py", "scripted.py", "triggers.py", "values.py"),
    "tailgate.estimators": (
        "algorithm2.py", "detectors.py", "imm.py", "kinematic.py", "predictors.py", "reactive_brake.py", "robust.py", "safe_state.py",
    ),
    "tailgate.envs": (
        "vehicle.py", "idm.py", "controllers.py", "manoeuvres.py", "fmcw.py", "radar.py", "radar_car.py", "radar_following.py",
    ),
}  # fmt: skip


@cache
def digest() -> str:
    """Of the sources of the lanes and of the formulas that they share with the plain loop."""
    out = hashlib.blake2b(digest_size=16)
    for package, names in _SOURCES.items():
        for name in names:
            place = files(package).joinpath(name)
            for path in sorted(place.iterdir(), key=lambda path: path.name) if not name else [place]:
                if path.name.endswith(".py"):
                    out.update(path.name.encode() + path.read_bytes())
    return out.hexdigest()


def _folders() -> Iterator[Path]:
    """Where machine code may be kept, the first that can be written to."""
    if asked := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(asked) / "tailgate"
    else:
        yield Path(__file__).parent / "__pycache__"
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "tailgate"


class Kernel:
    """A function of `places`, an array of addresses, and of three whole numbers; -> a whole number. Compiled or loaded at its first call.

    It holds no lock of Python's, and owns nothing: what it reads and writes has to live as long as it runs.
    """

    def __init__(self, function: Callable[..., int]) -> None:
        self.py_func, self._lock = function, threading.Lock()

    def __call__(self, places: int, first: int, last: int, part: int) -> int:
        return int(self.entry(places, first, last, part))

    @cached_property
    def entry(self) -> Any:
        """What is called."""
        with self._lock:
            return self._loaded or self._made()

    @property
    def _loaded(self) -> Any:
        """From machine code that is kept; None where none is, or none that is whole and can be linked."""
        for folder in _folders():
            with contextlib.suppress(OSError, ValueError, RuntimeError):
                head, _, code = (folder / self._file).read_bytes().partition(b"\n")
                symbol, whole = head.decode().split()
                if whole == hashlib.blake2b(code).hexdigest():
                    return _linked(symbol, code)
        return None

    def _made(self) -> Any:
        """Compiled, and kept where there is a place to keep it: without one, by every process anew."""
        types = numba().types
        signature = types.int64(types.CPointer(types.voidptr), *[types.int64] * 3)
        if _inside():
            from .parts import remembering, whole

            with remembering():
                symbol, code = whole(self.py_func, signature, _OPTIONS | _BARE)
            entry = _linked(symbol, code)
        else:
            self._owner = made = numba().cfunc(signature, **_OPTIONS)(self.py_func)
            symbol, code, entry = made.native_name, made._library.serialize_using_object_code()[2][0], _callable(made.address)
        for folder in _folders():
            with contextlib.suppress(InputError):
                write_atomic(folder / self._file, f"{symbol} {hashlib.blake2b(code).hexdigest()}\n".encode() + code)
                for old in sorted(folder.glob("kernel-*.o"), key=lambda path: path.stat().st_mtime)[:-KEPT]:
                    remove(old)
                break
        return entry

    @cached_property
    def _file(self) -> str:
        """Named by all that the machine code depends on."""
        from llvmlite import binding as llvm

        settings = sorted((name, value) for name, value in os.environ.items() if name.startswith("NUMBA_") and name != "NUMBA_CACHE_DIR")
        machine = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
        parts = (self.py_func.__module__, digest(), version("numba"), version("llvmlite"), machine, settings)
        return f"kernel-{hashlib.blake2b(repr(parts).encode(), digest_size=16).hexdigest()}.o"


def _callable(address: int) -> Any:
    return ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, *[ctypes.c_int64] * 3)(address)


_RAISING = (  # what numba's entry would call for an exception, of which a kernel has none
    "numba_do_raise", "numba_gil_ensure", "numba_gil_release", "numba_runtime_build_excinfo_struct", "numba_unpickle",
)  # fmt: skip
_linked_so_far: list[Any] = []  # by which linker, and what: both have to live as long as the process


def _linked(symbol: str, code: bytes) -> Any:
    """Machine code, ready to be called. Raises RuntimeError where it needs what this process does not have."""
    from llvmlite import binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    # JITLink takes one block for code and data: the other linker aborts where a process with gigabytes in it puts them far apart
    linker, builder = llvm.create_lljit_compiler(use_jit_link=True, suppress_errors=True), llvm.JITLibraryBuilder()
    for name in _RAISING:
        builder.import_symbol(name, ctypes.cast(ctypes.CDLL(None).abort, ctypes.c_void_p).value)
    library = builder.add_object_img(code).add_current_process().export_symbol(symbol).link(linker, "kernel")
    _linked_so_far.append((linker, library))
    return _callable(library[symbol])
