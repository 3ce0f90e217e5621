"""How compiled functions that are only ever parts of others are made, and what an operator means found out once: a third of the time.

All of this is inside of numba, and may be otherwise in another version: `tailgate.fused.compiled` uses it with the one that it is for.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
from collections.abc import Iterator
from typing import Any

from numba import _dynfunc  # type: ignore[attr-defined]
from numba.core import codegen, compiler, compiler_machinery, typed_passes
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


class Part(compiler.Compiler):
    """The usual passes, into a library of that kind."""

    def define_pipelines(self) -> list[Any]:
        state = self.state
        state.library = _PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)  # type: ignore[no-untyped-call]
        state.flags.no_compile = True
        (passes,) = super().define_pipelines()  # type: ignore[no-untyped-call]
        passes.add_pass_after(_MakeKnown, typed_passes.NativeLowering)
        passes.finalize()
        return [passes]


@contextlib.contextmanager
def remembering() -> Iterator[None]:
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
