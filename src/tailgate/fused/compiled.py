"""Compiled functions that are kept on disk, by the sources of everything that they are made of.

Numba's own key is the file that holds the function alone: after a change of a formula in another file the old code would be loaded again.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import hashlib
from collections.abc import Callable, Iterator
from functools import cache
from importlib.resources import files
from typing import Any

import numba
from numba import _dynfunc  # type: ignore[attr-defined]
from numba.core import caching, codegen, compiler, compiler_machinery, typed_passes
from numba.core.types.functions import BaseFunction


class _PartLibrary(codegen.CPUCodeLibrary):
    """Code that is only ever a part of other code: optimised there, and never turned into machine code by itself.

    Numba would do both for each function that another one calls, and again for all of them in each that calls those.
    """

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._finalized = True

    def _finalize_specific(self) -> None:
        pass


@compiler_machinery.register_pass(mutates_CFG=False, analysis_only=False)  # type: ignore[no-untyped-call]
class _MakeKnown(compiler_machinery.LoweringPass):
    """Lets other compiled code call a part; Python's call raises TypeError."""

    _name = "make_known"

    def __init__(self) -> None:
        compiler_machinery.LoweringPass.__init__(self)  # type: ignore[no-untyped-call]

    def run_pass(self, state: Any) -> bool:
        refuse = ctypes.cast(ctypes.pythonapi.PyErr_BadArgument, ctypes.c_void_p).value
        entry = _dynfunc.make_function(state.cr.fndesc.lookup_module(), state.func_id.func_name, "", refuse, state.cr.env, ())
        state.targetctx.insert_user_function(entry, state.cr.fndesc, [state.library])
        state.cr = state.cr._replace(cfunc=entry)
        return True


class _Part(compiler.Compiler):
    """The usual passes, into a library of that kind."""

    def define_pipelines(self) -> list[Any]:
        state = self.state
        state.library = _PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)  # type: ignore[no-untyped-call]
        state.flags.no_compile = True
        (passes,) = super().define_pipelines()  # type: ignore[no-untyped-call]
        passes.add_pass_after(_MakeKnown, typed_passes.NativeLowering)
        passes.finalize()
        return [passes]


_OPTIONS: dict[str, Any] = {"error_model": "numpy"}  # no fast-math: the bits are the plain loop's
_INNER: dict[str, Any] = {"no_cfunc_wrapper": True, "no_cpython_wrapper": True, "_nrt": False, "pipeline_class": _Part}
phase = numba.njit(**_OPTIONS, **_INNER)  # a loop over the episodes of a block
formula = numba.njit(**_OPTIONS, **_INNER, forceinline=True)  # of one episode, part of the loop that calls it; or a loop over given rows

_SOURCES = {  # by package, which may lie in folders of their own
    "tailgate.fused": ("",), "tailgate": ("elementwise.py", "kernels.py", "kinds.py", "draws.py"),
    "tailgate.agents": ("reward.py", "scripted.py", "triggers.py"),
    "tailgate.estimators": ("detectors.py", "imm.py", "reactive_brake.py", "safe_state.py"),
    "tailgate.envs": ("vehicle.py", "idm.py", "controllers.py", "manoeuvres.py"),
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


def _by_sources(locator: Any) -> Any:
    return type(locator.__name__, (locator,), {"get_source_stamp": lambda self: digest()})


_LOCATORS = [_by_sources(c) for c in (caching.UserProvidedCacheLocator, caching.InTreeCacheLocator, caching.UserWideCacheLocator)]


class _Implementation(caching.CompileResultCacheImpl):
    _locator_classes = _LOCATORS


class _Cache(caching.FunctionCache):
    _impl_class = _Implementation


@contextlib.contextmanager
def _remembering() -> Iterator[None]:
    """While this compiles, what an operator or a function of numpy makes of some types is found out once, and not at every place.

    Nor is garbage looked for among what will be needed to the end.

    Compilers take turns by numba's own lock, so nobody else's code is compiled meanwhile.
    """
    resolve, known = BaseFunction.get_call_type, {}

    def remembered(self: Any, context: Any, args: Any, kws: Any) -> Any:
        key = (self.typing_key, args)
        if kws or key not in known:
            found = resolve(self, context, args, kws)
            if kws or found is None:
                return found
            known[key] = found, self._impl_keys[found.args]
        found, implementation = known[key]
        self._impl_keys[found.args] = implementation
        return found

    BaseFunction.get_call_type, collects = remembered, gc.isenabled()  # type: ignore[method-assign]
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()
        BaseFunction.get_call_type = resolve  # type: ignore[method-assign]


def compiled(function: Callable[..., Any]) -> Any:
    """The function, compiled at its first call of a kind; without a place to keep it, in every process anew."""
    out = numba.njit(**_OPTIONS, nogil=True)(function)
    out._compiler.compile = _remembering()(out._compiler.compile)
    with contextlib.suppress(RuntimeError):  # no directory to write to
        out._cache = _Cache(function)  # type: ignore[no-untyped-call]
    return out
