"""Functions of numbers as machine code for plain code, compiled or loaded at the first call with arguments of a kind."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Hashable, Sequence
from functools import update_wrapper
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from tailgate.base.pytree import leaves, map_leaves
from tailgate.engine.array import Traced
from tailgate.engine.functions import tracing
from tailgate.engine.operations import Array, ArrayLike, DTypeLike
from tailgate.engine.untraceable import Untraceable

if TYPE_CHECKING:
    from tailgate.engine.program import Program
    from tailgate.engine.remembered import Answers

Arguments = tuple[Any, ...]  # arrays, or sequences of arrays
F = TypeVar("F", bound=Callable[..., Any])
ALIGNED = 64  # bytes of a cache line
KEPT, EACH = 256, 8  # constants whose code is found at once, and variants of code of the same shapes


class Code:
    """Machine code of a function from arrays of one type to a tuple of arrays of one type."""

    def __init__(self, function: Callable[..., Sequence[Array]], dtype: DTypeLike, inputs: int) -> None:
        from tailgate.engine.program import Program  # a circular import otherwise
        from tailgate.engine.tracing import traced

        def named(state: None, given: dict[str, Array]) -> tuple[None, dict[str, Array]]:
            return state, {str(i): x for i, x in enumerate(function(*given.values()))}

        trace = traced(named, None, {str(i): np.zeros(1, dtype) for i in range(inputs)})
        program = Program(trace, basic=True)
        self._function, self._lanes, self._size = program.function, program.lanes, program.room
        self._uniforms, self._inputs, self._outputs = program.uniforms(), inputs, len(trace.results)
        (self._dtype,) = {nodes.flat[0].dtype for nodes in trace.results.values()}
        self._at = self._uniforms.ctypes.data

    def __call__(self, given: Array) -> Array:
        """Return (outputs, M) for (inputs, M)."""
        count = given.shape[1]
        blocks = -(-count // self._lanes)
        rows = blocks * self._lanes
        if count < rows or not given.flags.c_contiguous:
            whole = np.empty((self._inputs, rows), given.dtype)
            whole[:, :count], whole[:, count:] = given, given[:, -1:]
            given = whole
        out, room = np.empty((self._outputs, rows), self._dtype), np.empty(self._size + ALIGNED, np.uint8)
        table = np.zeros((self._inputs + self._outputs, 2), np.int64)
        table[: self._inputs, 0] = given.ctypes.data + given.strides[0] * np.arange(self._inputs)
        table[self._inputs :, 0] = out.ctypes.data + out.strides[0] * np.arange(self._outputs)
        place = room.ctypes.data
        place -= place % -ALIGNED
        self._function.call(place, self._at, table.ctypes.data, place, None, 0, blocks, 1)
        return out[:, :count]


class Elementwise:
    """A function of one float for arrays of any shape; traced code and short arrays use its Python source."""

    def __init__(self, function: Callable[[Array], Array], worth: int) -> None:
        self.function: Callable[[Array], Array] = getattr(function, "function", function)  # a routine's own: its code is repeated
        self.worth = worth
        self._code: Code | None = None
        update_wrapper(self, function, updated=())

    def __call__(self, x: ArrayLike) -> Any:
        if isinstance(x, Traced):
            return self.function(x.astype(np.float64, copy=False))
        x = np.asarray(x, np.float64)
        if x.size < self.worth:
            with np.errstate(all="ignore"):
                return self.function(x)[()]
        if self._code is None:
            self._code = Code(lambda x: (self.function(x),), x.dtype, 1)
        order = sorted(range(x.ndim), key=lambda axis: -x.strides[axis])
        turned = x.transpose(order)
        out = self._code(turned.reshape(1, -1))[0].reshape(turned.shape)
        return out.transpose(sorted(range(x.ndim), key=order.__getitem__))


def elementwise(worth: int) -> Callable[[Callable[[Array], Array]], Elementwise]:
    """Decorate a function of one float; from `worth` numbers on, machine code is faster than numpy."""
    return lambda function: Elementwise(function, worth)


class Shaped:
    """A function of arrays (B, ...) and of constants, which computes each of B by itself; see `Elementwise`.

    An array of one row counts for all of B. Arguments may be sequences of arrays.
    Other constants share its code if they give the same answers to the function's queries, such as where they are zero.
    """

    def __init__(self, function: Callable[..., Any], worth: Callable[..., bool], constants: Sequence[str]) -> None:
        self.function, self.worth = function, worth
        names = list(inspect.signature(function).parameters)
        self._fixed = [names.index(name) for name in constants]
        self._found: dict[Hashable, tuple[Program | None, Array]] = {}  # program and uniforms, by shapes and constants
        self._made: dict[Hashable, list[tuple[Answers, Program]]] = {}  # answers and programs, by shapes and the key of constants
        update_wrapper(self, function)

    def __call__(self, *arguments: Array | list[Array]) -> Any:
        if tracing() or not self.worth(*arguments):
            return self.function(*arguments)
        from tailgate.engine.program import State

        constants = tuple(arguments[i] for i in self._fixed)
        given = tuple(tuple(x) if isinstance(x, list) else x for i, x in enumerate(arguments) if i not in self._fixed)
        arrays: dict[str, Array] = leaves(given)
        rows = max(map(len, arrays.values()))
        key = (tuple((name, x.shape[1:], x.dtype) for name, x in arrays.items()), *map(_bits, leaves(constants).values()))
        if key not in self._found:
            _shortened(self._found)
            self._found[key] = self._code(given, constants, key[0])
        program, uniforms = self._found[key]
        if program is None:
            return self.function(*arguments)
        state = State(program, rows)
        for name, x in arrays.items():
            state.put_leaf(f"given.{name}", x if len(x) == rows else np.broadcast_to(x, (rows, *x.shape[1:])))
        program.alone(state, uniforms)
        names = (name for name in program.places if name.partition(".")[0] == "made")
        return map_leaves(lambda _: state.get_leaf(next(names)), program.trace.next_state["made"])

    def _code(self, given: Arguments, constants: Arguments, shapes: Hashable) -> tuple[Program | None, Array]:
        from tailgate.engine.parameters import Parameters, lifted
        from tailgate.engine.program import Program
        from tailgate.engine.remembered import Answers
        from tailgate.engine.tracing import traced

        parameters = Parameters(constants)
        _shortened(self._made)
        several = self._made.setdefault((shapes, parameters.key), [])
        for answers, program in several:
            if answers.fit(parameters.values):
                return program, program.uniforms(parameters.values)

        def arranged(given: Arguments, constants: Arguments) -> Any:
            one, other = iter(given), iter(constants)
            return self.function(*(next(other if i in self._fixed else one) for i in range(len(given) + len(constants))))

        def step(state: dict[str, Any], _: None) -> tuple[dict[str, Any], dict[str, Array]]:
            like = next(iter(leaves(state).values()))
            return {"given": state["given"], "made": arranged(state["given"], lifted(like, constants))}, {}

        example = map_leaves(lambda x: np.array(x[:1]), given)
        with np.errstate(all="ignore"):
            made = map_leaves(np.zeros_like, arranged(example, constants))
        try:
            program = Program(traced(step, {"given": example, "made": made}, None), basic=True)
        except Untraceable:  # too large: numpy computes it
            return None, np.empty(0)
        several[:] = [*several[1 - EACH :], (Answers([program.trace.graph]), program)]
        return program, program.uniforms(parameters.values)


def _shortened(held: dict[Any, Any]) -> None:
    """Remove the oldest entries to make room for one more."""
    while len(held) >= KEPT:
        held.pop(next(iter(held)), None)


def _bits(x: Array) -> tuple[tuple[int, ...], bytes]:
    return x.shape, x.tobytes()


def shaped(worth: Callable[..., bool], *constants: str) -> Callable[[F], F]:
    """Decorate a function of arrays (B, ...).

    `worth` says for which arguments machine code is faster; `constants` names the arguments without B.
    """

    def decorate(function: F) -> F:
        return cast(F, Shaped(function, worth, constants))

    return decorate
