"""Programs: functions of pytrees of arrays, traced once, as machine code on blocks of episodes.

A function maps parameters, state and arguments to the next state and results; leaves are (episodes, ...).
All episodes share the parameters. The code does not contain their values, so other values need no other code.
"""

from __future__ import annotations

import ctypes
import functools
import math
import operator
import os
import struct
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple, TypeVar

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.pytree import leaves, map_leaves
from tailgate.engine import objects
from tailgate.engine.hints import broken
from tailgate.engine.layout import Column, Held, Layout
from tailgate.engine.llvm import text_of
from tailgate.engine.operations import Array, DTypeLike
from tailgate.engine.parameters import Reading
from tailgate.engine.passes import LEAST
from tailgate.engine.tracing import Trace

_PYTHON = {"f": "d", "b": "?", "i": "q"}  # Python's format of 64-bit numbers and truth values
WORTH = 2048  # episodes per thread
ALIGNED = 64  # bytes of a cache line
T = TypeVar("T")


class Program:
    """The machine code of a trace."""

    def __init__(
        self, trace: Trace, lanes: int | None = None, least: int = LEAST, twins: Mapping[str, str] | None = None, basic: bool = False
    ) -> None:
        """Compile a trace; `twins` maps leaves of the state to others that always equal them and share their place.

        basic: it is a function of `tailgate.num`, whose code processes in a sandbox get too.
        """
        self.basic, self.trace, self.lanes, self._twins = basic, trace, lanes or objects.lanes(), dict(twins or {})
        self.places, self.stride = self._places()
        self.arrays = [("arguments", name) for name in trace.arguments] + [("results", name) for name in trace.results]
        demanded = list(trace.results["demands"].flat) if "demands" in trace.results else []
        layout = Layout({}, [], self.stride, len(trace.arguments), demanded)
        for name, (here, there) in trace.state.items():
            at, size = self.places[name], here.flat[0].dtype.itemsize * self.lanes if here.size else 0
            if name in trace.large:
                layout.inputs[trace.large[name][0].id] = Held(at)
                if trace.large[name][0] is not trace.large[name][1] and name not in self._twins:
                    layout.outputs.append((trace.large[name][1], Held(at)))
                continue
            for i, (node, new) in enumerate(zip(here.flat, there.flat, strict=True)):
                layout.inputs[node.id] = Held(at + i * size)
                if new is not node and name not in self._twins:
                    layout.outputs.append((new, Held(at + i * size)))
        for number, (kind, name) in enumerate(self.arrays):
            nodes = (trace.arguments if kind == "arguments" else trace.results)[name].ravel()
            for column, node in enumerate(nodes):
                if kind == "arguments":
                    layout.inputs[node.id] = Column(number, column, len(nodes))
                else:
                    layout.outputs.append((node, Column(number, column, len(nodes))))
        self.text, self.size, self.room, self.function = self._compiled(layout, least)
        self._reading = Reading(trace.graph, layout.slots)

    def _compiled(self, layout: Layout, least: int) -> tuple[str, dict[str, int], int, objects.Function]:
        """Return the text, its numbers of nodes and branches, the bytes of its buffers, and the machine code."""
        text, size, room = text_of(layout, len(self.arrays), self.lanes, least)
        return text, size, room, objects.Function(text, self.basic)

    def rows(self, episodes: int) -> State:
        """Return a state of some episodes."""
        return State(self, episodes)

    def check(self, field: str, episodes: int, steps: int = 1) -> None:
        """Raise InputError for `field` if the program's device has no memory for these episodes."""

    def call(
        self, state: State, steps: int = 1, values: Sequence[Array] | None = None, threads: int = 1, like: Call | None = None
    ) -> Call:
        """Return calls on a state, see `Call`."""
        return Call(self, state, steps, values, threads, like)

    def _places(self) -> tuple[dict[str, int], int]:
        """Return the offset of each leaf of the state in a block, widest numbers first, and the bytes of a block."""
        sizes = {name: (here.flat[0].dtype.itemsize if here.size else 1, here.size) for name, (here, _) in self.trace.state.items()}
        places, at = {}, 0
        for name in sorted(sizes.keys() - self._twins.keys(), key=lambda name: (-sizes[name][0], list(sizes).index(name))):
            places[name] = at
            at += sizes[name][0] * sizes[name][1] * self.lanes
        places |= {name: places[other] for name, other in self._twins.items()}
        return places, -(-max(at, 1) // ALIGNED) * ALIGNED

    def broken(self, demands: Array, k: Array) -> InputError:
        """Return the error for demands (B, .) that failed in steps k (B,)."""
        first = int(np.flatnonzero(~demands.all(axis=0))[0])
        field, found, wanted, _ = self.trace.graph.demands[first]
        return broken(~demands[:, first], field, found, wanted, k)

    def alone(self, state: State, uniforms: Array) -> None:
        """Run one step of a program without arguments and results on a state."""
        room = aligned((self.room,))
        self.function.call(address(state.memory), address(uniforms), None, address(room), None, 0, state.blocks, 1)

    def uniforms(self, values: Sequence[Array] | None = None) -> Array:
        """Return the shared numbers as the code reads them, for other parameter `values` if given (see engine/parameters.py)."""
        return self._reading.bits(values)


def program_class(device: str) -> type[Program]:
    """Return the class of programs that play on a device."""
    if device == "cpu":
        return Program
    from tailgate.engine.on_device import CudaProgram  # what only a card needs

    return CudaProgram


class State:
    """The state of episodes in blocks of one vector each, for all programs whose states have the same leaves."""

    def __init__(self, program: Program, episodes: int) -> None:
        self.program, self.episodes = program, episodes
        self.blocks = -(-episodes // program.lanes)
        self.memory = aligned((self.blocks, program.stride))

    def _leaf(self, name: str) -> Array:
        """Return a writable view of a leaf (blocks, places, lanes)."""
        program = self.program
        nodes = program.trace.state[name][0]
        dtype, at = nodes.flat[0].dtype if nodes.size else leaves(program.trace.next_state)[name].dtype, program.places[name]
        raw = self.memory[:, at : at + nodes.size * program.lanes * dtype.itemsize]
        return raw.view(dtype).reshape(self.blocks, nodes.size, program.lanes)

    def put(self, tree: object, rows: Array | None = None) -> None:
        """Write those leaves of a tree that the program has, (episodes, ...), or `rows` (R,) of them. Idle lanes repeat the last row."""
        for name, leaf in leaves(tree).items():
            if name in self.program.places:
                self.put_leaf(name, leaf, rows)

    def put_leaf(self, name: str, leaf: Array, rows: Array | None = None) -> None:
        """Write one leaf, as `put` does."""
        lanes, place = self.program.lanes, self._leaf(name)
        if rows is not None:
            place[rows // lanes, :, rows % lanes] = leaf.reshape(len(rows), place.shape[1])
            return
        numbers = np.asarray(leaf).reshape(self.episodes, place.shape[1]).T
        whole = self.episodes // lanes
        place[:whole] = numbers[:, : whole * lanes].reshape(len(numbers), whole, lanes).swapaxes(0, 1)
        if whole < self.blocks:
            place[whole, :, : self.episodes - whole * lanes] = numbers[:, whole * lanes :]
            place[whole, :, self.episodes - whole * lanes :] = numbers[:, -1:]

    def every(self, name: str) -> bool:
        """Return True if a leaf of truth values is true in all episodes."""
        return bool(self._leaf(name).all())

    def get(self, like: T) -> T:
        """Return a copy as a tree of arrays (episodes, ...)."""
        names = iter(leaves(like))
        return map_leaves(lambda old: self.get_leaf(next(names)), like)

    def get_leaf(self, name: str) -> Array:
        """Return a copy of one leaf (episodes, ...), with the episodes contiguous in memory."""
        shape = self.program.trace.state[name][0].shape[1:]
        held = np.array(self._leaf(name).swapaxes(0, 1), order="C").reshape(-1, self.blocks * self.program.lanes)[:, : self.episodes]
        return np.moveaxis(held.reshape(*shape, self.episodes), -1, 0)


class _Place(NamedTuple):
    """The place of an array on a sheet."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    at: int
    strides: tuple[int, ...]


class Call:
    """Calls of a program on a state, with arguments that persist until written, and new results each time.

    Arguments and results are (episodes, ...), or (steps, episodes, ...) for several `steps`.
    `broken` is True if a demand failed. Blocks are independent, so several `threads` may share many episodes.
    `like` is a call whose arguments all steps use.
    """

    def __init__(
        self, program: Program, state: State, steps: int = 1, values: Sequence[Array] | None = None, threads: int = 1,
        like: Call | None = None,
    ) -> None:  # fmt: skip
        self.program, self.state, self.steps, self.broken = program, state, steps, False
        threads = max(1, min(threads, state.episodes // WORTH))
        self._parts = [(state.blocks * i // threads, state.blocks * (i + 1) // threads) for i in range(threads)]
        self.uniforms = program.uniforms(values)
        self._table = np.zeros((len(program.arrays), 2), np.int64)
        self.arguments: dict[str, Array] = {}
        self._views: list[tuple[str, _Place]] = []
        self._singles: list[tuple[list[str], _Place]] = []  # results of one number per episode, together
        self._size = 0  # of the sheet
        rows, trace = state.blocks * program.lanes, program.trace
        singles: dict[np.dtype[Any], list[str]] = {}
        for i, (kind, name) in enumerate(program.arrays):
            nodes = (trace.arguments if kind == "arguments" else trace.results)[name]
            dtype = nodes.flat[0].dtype if nodes.size else np.dtype(float)
            shape = (rows, *nodes.shape[1:])
            self._table[i, 1] = int(np.prod(shape)) * dtype.itemsize
            if kind == "arguments":
                if like is not None:
                    self.arguments[name] = like.arguments[name]
                    self._table[i] = self.arguments[name].ctypes.data, 0
                    continue
                held = aligned((steps, *shape), dtype)
                self._table[i, 0] = held.ctypes.data
                self.arguments[name] = held[:, : state.episodes] if steps > 1 else held[0, : state.episodes]
            elif nodes.ndim == 1 and steps == 1:
                singles.setdefault(dtype, []).append(name)
            else:
                self._views.append((name, self._place((state.episodes, *nodes.shape[1:]), shape, dtype)))
                self._table[i, 0] = self._views[-1][1].at
        for dtype, names in singles.items():
            self._singles.append((names, self._place((len(names), state.episodes), (len(names), rows), dtype)))
            for i, name in enumerate(names):
                self._table[program.arrays.index(("results", name)), 0] = self._singles[-1][1].at + i * rows * dtype.itemsize
        self._first = self._table[:, 0].copy()  # addresses of the first step
        self._rooms = [aligned((program.room,)) for _ in self._parts]
        self._pointers = tuple(ctypes.c_void_p(a.ctypes.data) for a in (state.memory, self.uniforms, self._table))
        self._places = [ctypes.c_void_p(room.ctypes.data) for room in self._rooms]
        self.sheet = np.empty(0, np.uint8)  # the results of the last call
        self._bound = np.empty(0, np.int64)  # arguments of `fixed`

    def _place(self, shown: tuple[int, ...], shape: tuple[int, ...], dtype: np.dtype[Any]) -> _Place:
        """Reserve a place on the sheet for arrays of a shape, one per step, of which `shown` is visible."""
        at, size = self._size, int(np.prod(shape)) * dtype.itemsize
        strides = tuple(int(np.prod(shape[i + 1 :])) * dtype.itemsize for i in range(len(shape)))
        self._size += -(-size * self.steps // ALIGNED) * ALIGNED
        return _Place(shown, dtype, at, strides) if self.steps == 1 else _Place((self.steps, *shown), dtype, at, (size, *strides))

    def __call__(self) -> dict[str, Array]:
        """Play all steps; return the results by name."""
        self.begin()
        self.play(self.steps)
        return self.results()

    def begin(self) -> None:
        """Begin a new sheet, which `play` fills."""
        self.sheet = np.empty(self._size, np.uint8)
        if self.steps > 1:
            self._table[:, 0] = self._first

    def play(self, steps: int) -> None:
        """Play steps into the last sheet; the next call continues there."""
        there = ctypes.addressof(ctypes.c_char.from_buffer(self.sheet)) if self._size else None  # type: ignore[arg-type]
        if len(self._parts) == 1:
            self.broken = self._part(0, there, steps)
        else:
            others = [_pool(len(self._parts) - 1).submit(self._part, i, there, steps) for i in range(1, len(self._parts))]
            self.broken = any([self._part(0, there, steps), *(other.result() for other in others)])
        if self.steps > 1:
            self._table[:, 0] += steps * self._table[:, 1]

    def _part(self, part: int, there: int | None, steps: int) -> bool:
        return bool(self.program.function.call(*self._pointers, self._places[part], there, *self._parts[part], steps))

    def fixed(self) -> Callable[[], int]:
        """Return a function that plays one step and writes to the same sheet each time. Copy results to keep them."""
        self.begin()
        pointers = [pointer.value for pointer in (*self._pointers, self._places[0])]
        self._bound = np.array([*pointers, address(self.sheet), *self._parts[0], 1], np.int64)
        return functools.partial(self.program.function.bound, address(self._bound))

    def numbers(self, names: Sequence[str]) -> Callable[[], tuple[Any, ...]]:
        """Return a function that reads results of one number from the sheet of a single episode, as Python numbers."""
        places: dict[str, tuple[int, str, int]] = {}
        for several, (shape, dtype, at, strides) in self._singles:
            assert shape[1] == 1, "a single episode"
            places |= {name: (at + i * strides[0], _PYTHON[dtype.kind], dtype.itemsize) for i, name in enumerate(several)}
        layout, end = "<", 0
        wanted = sorted(names, key=lambda name: places[name][0])
        for name in wanted:
            at, code, size = places[name]
            layout, end = f"{layout}{at - end}x{code}", at + size
        read, order = struct.Struct(layout).unpack_from, operator.itemgetter(*(wanted.index(name) for name in names))
        return lambda: order(read(self.sheet))  # type: ignore[arg-type]

    def reader(self, name: str, row: int, dtype: DTypeLike | None = None) -> Callable[[], Array]:
        """Return a function that reads one row of a result from the sheet, as another type of the same size."""
        shape, kept, at, strides = dict(self._views)[name]
        return lambda: np.ndarray(shape[1:], dtype or kept, self.sheet, at + row * strides[0], strides[1:])

    def results(self, sheet: Array | None = None) -> dict[str, Array]:
        """Return the results on the sheet, or on an earlier one, by name."""
        out: dict[str, Array] = {}
        sheet = self.sheet if sheet is None else sheet
        for names, (shape, dtype, at, strides) in self._singles:
            out.update(zip(names, np.ndarray(shape, dtype, sheet, at, strides), strict=True))
        for name, (shape, dtype, at, strides) in self._views:
            out[name] = np.ndarray(shape, dtype, sheet, at, strides)
        return out


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of its parent's threads


def address(array: Array) -> int:
    """Return the address of an array's first number."""
    return int(array.__array_interface__["data"][0])


def aligned(shape: tuple[int, ...], dtype: DTypeLike = np.uint8) -> Array:
    """Return zeros that begin at a cache line."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    raw = np.zeros(size + ALIGNED, np.uint8)
    begin = -address(raw) % ALIGNED
    out: Array = raw[begin : begin + size].view(dtype).reshape(shape)
    return out

