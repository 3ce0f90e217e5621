"""Programs on a card: the state stays there; arguments and results are copied, or stay there too.

Rows are padded to whole warps. Kernels, memory and copies are those of `tailgate.engine.cards.Card`.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tailgate.base.errors import InputError
from tailgate.engine import objects
from tailgate.engine.cards import Card, DeviceError, Memory, OutOfMemory, card
from tailgate.engine.cuda import KERNELS, THREADS, only, text_of
from tailgate.engine.cuda_parts import LANES
from tailgate.engine.layout import Layout
from tailgate.engine.operations import Array
from tailgate.engine.passes import LEAST
from tailgate.engine.program import Call, Program, State
from tailgate.engine.tracing import Trace

VERSION = "1"  # of this module's translation
SPARE = 0.95  # of the free memory that rows may take
SHARE = 0.5  # of the free memory that buffers may take


def bound() -> int:
    """Return how many blocks of threads a multiprocessor has to hold: TAILGATE_CUDA_BLOCKS, or 0 for no bound. No bit changes."""
    asked = os.environ.get("TAILGATE_CUDA_BLOCKS", "0")
    if asked not in [str(n) for n in range(9)]:
        raise InputError("TAILGATE_CUDA_BLOCKS", asked, "a whole number from 0 to 8")
    return int(asked)


class Code:
    """The kernels of a text, each compiled for a card when it is first asked for, or loaded from the folder of `objects`."""

    def __init__(self, text: str, on: Card) -> None:
        self._text, self._card = text, on
        self._digest = hashlib.sha256("\0".join((VERSION, on.kind, text)).encode()).hexdigest()
        self.name = f"{self._digest}.cubin"
        self._kernels: dict[str, Any] = {}

    def kernel(self, name: str) -> Any:
        """Return a kernel by name."""
        if name not in self._kernels:
            place = f"{self._digest}-{name}.cubin"
            held = objects.kept(place)
            if held is None:
                held = self._card.compiled(only(name, self._text))
                objects.keep(place, held)
            self._kernels |= self._card.loaded(held, [name])
        return self._kernels[name]


class CudaProgram(Program):
    """The kernels of a trace."""

    def __init__(self, trace: Trace, lanes: int | None = None, least: int = LEAST, twins: Mapping[str, str] | None = None) -> None:
        """Compile a trace, see `Program`; the lanes are those of a warp."""
        self.card = card()
        super().__init__(trace, LANES, least, twins)

    def _compiled(self, layout: Layout, least: int) -> tuple[str, dict[str, int], int, Any]:
        text, size, room, self.by_value = text_of(layout, len(self.arrays), least, bound())
        self.code = Code(text, self.card)
        return text, size, room, self.code

    def rows(self, episodes: int) -> DeviceState:
        """Return a state of some episodes."""
        return DeviceState(self, episodes)

    def call(
        self, state: State, steps: int = 1, values: Sequence[Array] | None = None, threads: int = 1, like: Call | None = None
    ) -> DeviceCall:
        """Return calls on a state; the card has its own threads."""
        return DeviceCall(self, state, steps, values, like)

    def bytes_of_row(self, steps: int = 1) -> float:
        """Return the bytes that a row takes on the card: its state, and the arguments and results of some steps."""
        trace = self.trace
        arrays = [nodes for held in (trace.arguments, trace.results) for nodes in held.values()]
        each = sum(int(nodes.size) * int(nodes.flat[0].dtype.itemsize) for nodes in arrays if nodes.size)
        return float(self.stride / LANES + steps * each)

    def check(self, field: str, episodes: int, steps: int = 1) -> None:
        """Raise DeviceError if the card has no memory for these rows."""
        free = SPARE * self.card.free() - self.flights(episodes, KERNELS[steps > 1]) * self.room
        most = max(0, int(free / self.bytes_of_row(steps)))
        if episodes > most:
            wanted = f"at most {most:,} rows, which fit in the free memory of {self.card.name}; play in smaller batches"
            raise DeviceError(field, episodes, wanted)

    def flights(self, episodes: int, kernel: str = KERNELS[0]) -> int:
        """Return how many warps play these episodes: those that run at once where each needs room for buffers, else all."""
        blocks = -(-episodes // LANES)
        if not self.room:
            return blocks
        fit = int(self.card.free() * SHARE / self.room)
        return max(1, min(blocks, fit, self.card.at_once(self.code.kernel(kernel), THREADS)))


class DeviceState(State):
    """A state on a card."""

    def __init__(self, program: CudaProgram, episodes: int) -> None:
        self.program, self.episodes, self.card = program, episodes, program.card
        self.blocks, self.memory = -(-episodes // LANES), np.empty(0, np.uint8)
        self.held = _memory(program, self.blocks * program.stride, episodes)
        self._copied: tuple[int, Array] = 0, np.empty(0)

    def _leaf(self, name: str) -> Array:
        nodes, leaf_at = self.program.trace.state[name][0], self.program.places[name]
        dtype = nodes.flat[0].dtype if nodes.size else np.dtype(float)
        held = np.empty((self.blocks, nodes.size * LANES * dtype.itemsize), np.uint8)
        self._copied = self.held.at + leaf_at, held
        if held.size:
            self.card.fetch_rows(held, self.held.at + leaf_at, self.program.stride)
        return held.view(dtype).reshape(self.blocks, nodes.size, LANES)

    def put_leaf(self, name: str, leaf: Array, rows: Array | None = None) -> None:
        """Write one leaf, as `State.put_leaf` does."""
        super().put_leaf(name, leaf, rows)
        at, held = self._copied
        if held.size:
            self.card.send_rows(at, self.program.stride, held)


class DeviceCall(Call):
    """Calls of a program on a card.

    Results are copied to a sheet in this machine's memory. With a `sheet_at` they stay on the card, and so do arguments that
    have an address in `arguments_at`.
    """

    def __init__(
        self, program: CudaProgram, state: State, steps: int = 1, values: Sequence[Array] | None = None, like: Call | None = None
    ) -> None:
        super().__init__(program, state, steps, values, 1, like)
        assert isinstance(state, DeviceState)
        self.card, self._rows = program.card, state
        self._sent: Array | None = None
        episodes = state.episodes
        self.kernel = KERNELS[steps > 1]
        flights = program.flights(episodes, self.kernel)
        self._grid = -(-flights * LANES // THREADS)
        warps = self._grid * THREADS // LANES
        self._room = _memory(program, warps * program.room, episodes)
        self._tables = _memory(program, self.uniforms.nbytes, episodes)
        self._broken = _memory(program, 8, episodes)
        self._results: Memory | None = None
        self.arguments_at: dict[str, int] = {}
        self.sheet_at = 0
        self._arguments: dict[str, Memory] = like._arguments if isinstance(like, DeviceCall) else self._taken(program, episodes)
        self._by_value = np.zeros(max(1, len(program.by_value)) + 2 * max(1, len(program.arrays)), np.uint64)
        self._begun = 0  # the step of the sheet with which `play` continues

    def _taken(self, program: CudaProgram, episodes: int) -> dict[str, Memory]:
        sizes = {name: self.steps * int(self._table[i, 1]) for i, (kind, name) in enumerate(program.arrays) if kind == "arguments"}
        return {name: _memory(program, size, episodes) for name, size in sizes.items()}

    @property
    def size(self) -> int:
        """The bytes of a sheet."""
        return self._size

    def places(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any], int, tuple[int, ...]]]:
        """Return the shape, type, first byte and strides [bytes] of each result on a sheet."""
        out = {name: (place.shape, place.dtype, place.at, place.strides) for name, place in self._views}
        for names, (shape, dtype, at, strides) in self._singles:
            out |= {name: (shape[1:], dtype, at + i * strides[0], strides[1:]) for i, name in enumerate(names)}
        return out

    def begin(self) -> None:
        """Begin a new sheet, which `play` fills."""
        self._begun = 0
        if not self.sheet_at:
            self.sheet = np.empty(self._size, np.uint8)

    def play(self, steps: int) -> None:
        """Play steps into the last sheet; the next call continues there."""
        self._send()
        on, state, program = self.card, self._rows, self.program
        assert isinstance(program, CudaProgram)
        kernel = program.code.kernel(self.kernel)
        arguments = (state.held.at, self._tables.at, self._room.at, 0, state.blocks, self._begun, steps, self._broken.at, self._by_value)
        on.launch(kernel, self._grid, THREADS, arguments)
        self.broken = self._failed()
        if not self.sheet_at:
            self._fetch(steps)
        self._begun += steps

    def _failed(self) -> bool:
        """Return True if a demand failed in the last launch."""
        if not self.program.trace.graph.demands:
            return False
        found = np.zeros(1, np.int64)
        self.card.fetch(found, self._broken.at)
        if found[0]:
            self.card.send(self._broken.at, np.zeros(1, np.int64))
        return bool(found[0])

    def _send(self) -> None:
        """Copy the arguments and the shared numbers to the card, where they are not there."""
        program, words = self.program, self._by_value
        assert isinstance(program, CudaProgram)
        if self._sent is None or not np.array_equal(self._sent, self.uniforms):
            self._sent = self.uniforms.copy()
            if self._sent.size:
                self.card.send(self._tables.at, self._sent)
        words[: len(program.by_value)] = self.uniforms[program.by_value]
        arrays = words[max(1, len(program.by_value)) :]
        if not self.sheet_at and self._results is None:
            self._results = _memory(program, self._size, self.state.episodes)
        sheet = self.sheet_at or (self._results.at if self._results else 0)
        for i, (kind, name) in enumerate(program.arrays):
            if kind == "results":
                arrays[2 * i], arrays[2 * i + 1] = sheet + int(self._first[i]), int(self._table[i, 1])
                continue
            held = self._arguments[name]
            arrays[2 * i], arrays[2 * i + 1] = self.arguments_at.get(name, held.at), int(self._table[i, 1])
            if name not in self.arguments_at:
                self.card.send(held.at, _whole(int(self._first[i]), held.size))

    def _fetch(self, steps: int) -> None:
        """Copy the results of the last launch to this machine's sheet."""
        assert self._results is not None
        if self.steps == 1:
            self.card.fetch(self.sheet, self._results.at)
            return
        for i, (kind, _) in enumerate(self.program.arrays):
            if kind == "results":
                size = int(self._table[i, 1])
                begin = int(self._first[i]) + self._begun * size
                self.card.fetch(self.sheet[begin : begin + steps * size], self._results.at + begin)


def _memory(program: CudaProgram, size: int, episodes: int) -> Memory:
    """Return memory on the program's card; raise DeviceError if there is none."""
    try:
        return Memory(program.card, size)
    except OutOfMemory:
        program.check("episodes", episodes)
        raise DeviceError("episodes", episodes, f"fewer rows: {program.card.name} has {program.card.free():,} bytes left") from None


def _whole(at: int, size: int) -> Array:
    """Return the memory of this machine at an address."""
    return np.ctypeslib.as_array((ctypes.c_uint8 * size).from_address(at))
