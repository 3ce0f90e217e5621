"""Functions of numbers as machine code for plain code: made at the first call with arguments of these kinds, or loaded."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import update_wrapper
from typing import Any

import numpy as np

from tailgate.engine.array import Traced
from tailgate.engine.operations import Array

ALIGNED = 64  # bytes: a line of the processor's cache


class Code:
    """A function of numbers of one type that gives a tuple of numbers of one type, for arrays of them."""

    def __init__(self, function: Callable[..., Any], dtype: Any, inputs: int) -> None:
        from tailgate.engine.program import Program, traced  # which need random numbers, and those this code

        def named(state: Any, given: Any) -> tuple[Any, Any]:
            return state, {str(i): x for i, x in enumerate(function(*given.values()))}

        trace = traced(named, {}, {str(i): np.zeros(1, dtype) for i in range(inputs)})
        program = Program(trace)
        self._function, self._lanes, self._size = program.function, program.lanes, program.room
        self._uniforms, self._inputs, self._outputs = program.uniforms(), inputs, len(trace.results)
        (self._dtype,) = {nodes.flat[0].dtype for nodes in trace.results.values()}
        self._at = self._uniforms.ctypes.data

    def __call__(self, given: Array) -> Array:
        """Return (outputs, M) of (inputs, M)."""
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
    """A function of one float that takes arrays of any shape; traced code and few numbers use its source."""

    def __init__(self, function: Callable[..., Any], worth: int) -> None:
        self.function, self.worth = function, worth
        self._code: Code | None = None
        update_wrapper(self, function)

    def __call__(self, x: Any) -> Any:
        if isinstance(x, Traced):
            return self.function(x)
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


def elementwise(worth: int) -> Callable[[Callable[..., Any]], Elementwise]:
    """Decorator of a function of one float; worth: numbers for which machine code takes less time than numpy."""
    return lambda function: Elementwise(function, worth)


class Shaped:
    """A function of arrays (M, ...) of floats, which computes each of M by itself and gives a tuple of such; see `Elementwise`."""

    def __init__(self, function: Callable[..., Any], worth: Callable[..., bool]) -> None:
        self.function, self.worth = function, worth
        self._made: dict[Any, tuple[Code, list[tuple[int, ...]]]] = {}
        update_wrapper(self, function)

    def __call__(self, *arrays: Any) -> Any:
        if any(isinstance(x, Traced) for x in arrays) or not self.worth(*arrays):
            return self.function(*arrays)
        shapes = tuple(x.shape[1:] for x in arrays)
        if shapes not in self._made:
            self._made[shapes] = self._code(shapes)
        code, results = self._made[shapes]
        held = code(np.concatenate([np.moveaxis(x, 0, -1).reshape(-1, len(x)) for x in arrays]))
        return tuple(np.moveaxis(part.reshape(*shape, -1), -1, 0) for part, shape in zip(_parts(held, results), results, strict=True))

    def _code(self, shapes: Sequence[tuple[int, ...]]) -> tuple[Code, list[tuple[int, ...]]]:
        results: list[tuple[int, ...]] = []

        def flat(*numbers: Any) -> list[Any]:
            given = [np.stack(part, axis=-1).reshape(1, *shape) for part, shape in zip(_parts(numbers, shapes), shapes, strict=True)]
            made = self.function(*given)
            results[:] = [x.shape[1:] for x in made]
            return [x[(slice(None), *place)] for x in made for place in np.ndindex(*x.shape[1:])]

        return Code(flat, np.float64, sum(map(math.prod, shapes))), results


def _parts(held: Any, shapes: Sequence[tuple[int, ...]]) -> list[Any]:
    """What belongs to each shape of numbers one behind the other."""
    ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
    return [held[first:last] for first, last in zip([0, *ends[:-1]], ends, strict=True)]


def shaped(worth: Callable[..., bool]) -> Callable[[Callable[..., Any]], Any]:
    """Decorator of a function of arrays (M, ...) that gives a tuple of them; worth: for which arrays machine code is."""
    return lambda function: Shaped(function, worth)
