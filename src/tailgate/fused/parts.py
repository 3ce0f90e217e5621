"""How compiled functions that are only ever parts of others are made, how a whole of them is, and what an operator means found out once.

All of this is inside of numba, and may be otherwise in another version: `tailgate.fused.compiled` uses it with the one that it is for.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
from collections.abc import Iterator
from typing import Any

from llvmlite import binding as llvm
from numba import _dynfunc  # type: ignore[attr-defined]
from numba.core import codegen, compiler, compiler_machinery, typed_passes
from numba.core.ccallback import _CFuncCompiler  # type: ignore[attr-defined]
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target
from numba.core.types.functions import BaseFunction

_phases: set[str] = set()  # parts that stay functions of their own in machine code


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
        if not state.flags.forceinline:
            _phases.add(state.cr.fndesc.mangled_name)
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


class _WholeLibrary(_PartLibrary):
    """A function with all its parts, optimised together. Only its entry is seen from outside, so that every other argument that is the same
    at all calls, or is not looked at, is left out."""

    def machine_code(self, entry: str) -> bytes:
        """An object file.

        It is loaded as one piece, wherever that is, and so finds its constants by short addresses, for which numba's own code has no use.
        A phase is not written into its callers: code for one choice among many is compiled in half the time, and is as fast.
        """
        self._ensure_finalized()  # type: ignore[no-untyped-call]
        for function in self._final_module.functions:
            if not function.is_declaration and function.name != entry:
                function.linkage = "internal"
                if function.name in _phases:
                    function.add_function_attribute("noinline")
        codegen.CPUCodeLibrary._optimize_final_module(self)  # type: ignore[no-untyped-call]
        options: dict[str, Any] = {"opt": 3}
        self._codegen._customize_tm_options(options)  # type: ignore[attr-defined]
        if options["reloc"] == "static" and os.name == "posix":
            options |= {"reloc": "pic", "codemodel": "default"}
        machine = llvm.Target.from_default_triple().create_target_machine(**options)
        return bytes(machine.emit_object(self._final_module))


class _Whole(compiler.Compiler):
    """The usual passes, into a library of that kind."""

    def define_pipelines(self) -> list[Any]:
        state = self.state
        state.library = _WholeLibrary(state.targetctx.codegen(), state.func_id.func_qualname)  # type: ignore[no-untyped-call]
        return list(super().define_pipelines())  # type: ignore[no-untyped-call]


def whole(function: Any, signature: Any, options: dict[str, Any]) -> tuple[str, bytes]:
    """A function for C, with all its parts: its name there, and an object file."""
    with global_compiler_lock:
        made = _CFuncCompiler(function, cpu_target, options, {}, pipeline_class=_Whole).compile(signature.args, signature.return_type)
        entry = made.fndesc.llvm_cfunc_wrapper_name
        return entry, made.library.machine_code(entry)


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
