"""Machine code for this processor: LLVM's text of a scheduled graph, in vectors of `lanes` episodes.

A block is one vector of episodes. Its state is contiguous in memory, so that a step reads and writes a few KiB at fixed places.
Operations are neither reordered nor contracted. The function takes these arguments:

- the state, and the numbers that all episodes share;
- a table of arrays: address, or offset on the sheet of results, and bytes per step;
- room for buffers, and the sheet of results;
- the first block, the block after the last, and the number of steps.

It returns nonzero if a demand of the code fails in any lane, including idle lanes.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tailgate.engine import blocks, sweeps
from tailgate.engine.collection import uncollected
from tailgate.engine.graph import Node
from tailgate.engine.instructions import operation, scalar
from tailgate.engine.layout import Column, Held, Layout, Writer, last_read
from tailgate.engine.operations import BOOL, FLOAT
from tailgate.engine.passes import Branch, Item, counted, schedule
from tailgate.engine.routines import bound


class Emitter(Writer):
    """The text of one function."""

    def __init__(self, layout: Layout, lanes: int) -> None:
        self.layout, self.lanes = layout, lanes
        self.lines: list[str] = []
        self.declared: set[str] = set()
        self.routines: dict[Any, str] = {}  # names of routines
        self.texts: list[str] = []  # texts of routines
        self.rooms: list[str] = []  # allocations on the stack
        self.places: dict[int, int] = {}  # offsets of buffers in their common room
        self.merged: set[int] = set()  # sweeps that are computed where they are read
        self.names: dict[int | tuple[int, str], str] = {}
        self.count = 0
        self.block = "entry"

    def fresh(self) -> Emitter:
        """Return an emitter for another function of the same module."""
        out = Emitter(Layout({}, [], 0), self.lanes)
        out.routines, out.texts, out.declared = self.routines, self.texts, self.declared
        return out

    # -- text

    def line(self, text: str) -> None:
        self.lines.append(f"  {text}")

    def set(self, text: str) -> str:
        self.count += 1
        self.line(f"%v{self.count} = {text}")
        return f"%v{self.count}"

    def label(self, name: str) -> str:
        self.count += 1
        return f"{name}{self.count}"

    def begin(self, label: str) -> None:
        self.lines.append(f"{label}:")
        self.block = label

    def vector(self, dtype: np.dtype[Any]) -> str:
        return f"<{self.lanes} x {scalar(dtype)}>"

    def splat(self, value: np.generic) -> str:
        """Return a constant in all lanes."""
        kind, name = value.dtype.kind, scalar(value.dtype)
        if kind == "f":
            text = f"0x{struct.unpack('<Q', struct.pack('<d', float(value)))[0]:016X}"
        else:
            text = str(bool(value)).lower() if kind == "b" else str(int(value))
        return f"splat ({name} {text})"

    def address(self, base: str, offset: int | str) -> str:
        return self.set(f"getelementptr i8, ptr {base}, i64 {offset}")

    def any_lane(self, mask: str) -> str:
        bits = self.set(f"bitcast <{self.lanes} x i1> {mask} to i{self.lanes}")
        return self.set(f"icmp ne i{self.lanes} {bits}, 0")

    # -- values

    def value(self, node: Node) -> str:
        """Return the name of a node's vector."""
        if node.op == "const":
            return self.splat(node.attr)
        if sweeps.is_pick(node):
            size = node.dtype.itemsize * self.lanes
            return self.from_memory(sweeps.element(self, self.value(node.args[0]), "0", size, node.attr), node.dtype, size)
        if node.id not in self.names:
            if not node.fixed:
                raise AssertionError(f"{node} is not computed yet")
            if node.id not in self.layout.uniforms:
                self.layout.uniforms[node.id] = len(self.layout.slots)
                self.layout.slots.append(node)
            self.names[node.id] = self.uniform(self.address("%uniforms", 8 * self.layout.uniforms[node.id]), node.dtype)
        return self.names[node.id]

    def table(self, nodes: Sequence[Node]) -> str:
        """Return the address of consecutive shared numbers."""
        key = tuple(node.id for node in nodes)
        if key not in self.layout.tables:
            self.layout.tables[key] = len(self.layout.slots)
            self.layout.slots.extend(nodes)
        return self.address("%uniforms", 8 * self.layout.tables[key])

    def room(self, node: Node) -> str:
        """Return the address of a buffer."""
        return self.address("%large", self.places[node.id])

    def kind(self, node: Node) -> str:
        """Return the LLVM type of a node's name."""
        return "ptr" if node.size else self.vector(node.dtype)

    def uniform(self, place: str, dtype: np.dtype[Any]) -> str:
        """Load a shared number from an address into all lanes."""
        name = scalar(BOOL) if dtype == BOOL else scalar(dtype)
        stored = "i8" if dtype == BOOL else name
        held = self.set(f"load {stored}, ptr {place}, align 8")
        if dtype == BOOL:
            held = self.set(f"icmp ne i8 {held}, 0")
        first = self.set(f"insertelement {self.vector(dtype)} poison, {name} {held}, i32 0")
        kind = self.vector(dtype)
        return self.set(f"shufflevector {kind} {first}, {kind} poison, <{self.lanes} x i32> zeroinitializer")

    def stored(self, dtype: np.dtype[Any]) -> str:
        """Return the type of a vector in memory: one byte per truth value."""
        return f"<{self.lanes} x {'i8' if dtype == BOOL else scalar(dtype)}>"

    def from_memory(self, address: str, dtype: np.dtype[Any], align: int) -> str:
        held = self.set(f"load {self.stored(dtype)}, ptr {address}, align {align}")
        return self.set(f"icmp ne {self.stored(dtype)} {held}, zeroinitializer") if dtype == BOOL else held

    def to_memory(self, address: str, dtype: np.dtype[Any], name: str, align: int) -> None:
        if dtype == BOOL:
            name = self.set(f"zext <{self.lanes} x i1> {name} to <{self.lanes} x i8>")
        self.line(f"store {self.stored(dtype)} {name}, ptr {address}, align {align}")

    def input(self, node: Node) -> str:
        place, size = self.layout.inputs[node.id], node.dtype.itemsize
        if isinstance(place, Held):
            return self.from_memory(self.address("%state", place.offset), node.dtype, size * self.lanes)
        base = self.row(place, node.dtype)
        if place.columns == 1:
            return self.from_memory(base, node.dtype, size)
        out = "poison"
        for lane in range(self.lanes):
            there = self.address(base, (lane * place.columns + place.column) * size)
            name = "i8" if node.dtype == BOOL else scalar(node.dtype)
            held = self.set(f"load {name}, ptr {there}, align {size}")
            if node.dtype == BOOL:
                held, name = self.set(f"icmp ne i8 {held}, 0"), "i1"
            out = self.set(f"insertelement {self.vector(node.dtype)} {out}, {name} {held}, i32 {lane}")
        return out

    def row(self, place: Column, dtype: np.dtype[Any]) -> str:
        """Return the address of the block's first episode in an array."""
        step = self.set(f"mul i64 %time, %bytes{place.array}")
        row = self.set(f"mul i64 %block, {self.lanes * place.columns * dtype.itemsize}")
        return self.address(f"%array{place.array}", self.set(f"add i64 {step}, {row}"))

    def compute(self, node: Node) -> None:
        if node.id in self.merged:
            return
        if node.op in ("loop", "call", "matvec"):
            getattr(blocks, node.op)(self, node)
        elif node.op in ("sweep", "pack", "invert"):
            getattr(sweeps, node.op)(self, node)
        elif node.op == "blend":
            self.names[node.id] = sweeps.blend(self, node, *(self.value(a) for a in node.args))
        elif node.op == "held":
            place = self.layout.inputs[node.id]
            assert isinstance(place, Held)
            self.names[node.id] = self.address("%state", place.offset)
        elif node.op == "gather":
            self.names[node.id] = blocks.gather(self, node)
        elif node.op == "pick":
            if not node.args[0].size:
                self.names[node.id] = self.names[node.args[0].id, str(node.attr)]
        else:
            self.names[node.id] = self.input(node) if node.op == "input" else operation(self, node)

    def together(self, nodes: Sequence[Node]) -> str:
        """Return the address of contiguous vectors: their own place, or a copy on the stack."""
        kind, size, first = self.vector(FLOAT), 8 * self.lanes, nodes[0]
        if all(sweeps.is_pick(node) and node.args == first.args and node.attr == first.attr + i for i, node in enumerate(nodes)):
            return sweeps.element(self, self.value(first.args[0]), "0", size, first.attr)
        self.count += 1
        room = f"%room{self.count}"
        self.rooms.append(f"  {room} = alloca [{len(nodes)} x {kind}], align {size}")
        for i, node in enumerate(nodes):
            self.line(f"store {kind} {self.value(node)}, ptr {self.address(room, size * i)}, align {size}")
        return room

    # -- order

    def branch(self, branch: Branch) -> None:
        mask = self.value(branch.mask)
        if branch.side == 2:
            mask = self.set(f"xor <{self.lanes} x i1> {mask}, splat (i1 true)")
        others = {c.id: self._other(c, branch.side) for c in branch.decides}
        instead = {c.id: self.room(c) if c.size else "poison" for c in branch.choices if c.id not in others}  # never read, but an address
        inside, after = self.label("in"), self.label("after")
        self.line(f"br i1 {self.any_lane(mask)}, label %{inside}, label %{after}")
        before, outer = self.block, dict(self.names)
        self.begin(inside)
        self.emit(branch.body, {})
        found = {}
        for choice in branch.choices:
            held, kind = self.value(choice.args[branch.side]), self.kind(choice)
            if choice.id in others and choice.size:
                held = sweeps.blend(self, choice, mask, held, others[choice.id])
            elif choice.id in others:
                held = self.set(f"select <{self.lanes} x i1> {mask}, {kind} {held}, {kind} {others[choice.id]}")
            found[choice.id] = held
        self.line(f"br label %{after}")
        end, self.names = self.block, outer
        self.begin(after)
        for choice in branch.choices:
            skipped = others.get(choice.id) or instead[choice.id]
            held = self.set(f"phi {self.kind(choice)} [{found[choice.id]}, %{end}], [{skipped}, %{before}]")
            self.names[choice.id if choice.id in others else (choice.id, "one side")] = held

    def _other(self, choice: Node, side: int) -> str:
        """Return the side of a choice that this branch does not compute."""
        return self.names.get((choice.id, "one side")) or self.value(choice.args[3 - side])

    def store(self, node: Node, place: Held | Column) -> None:
        if isinstance(place, Held):
            align = node.dtype.itemsize * self.lanes
            self.to_memory(self.address("%state", place.offset), node.dtype, self.value(node), align)
        else:
            self.to_memory(self.row(place, node.dtype), node.dtype, self.value(node), node.dtype.itemsize)


@uncollected()
def text_of(layout: Layout, arrays: int, lanes: int, least: int) -> tuple[str, dict[str, int], int]:
    """Return LLVM's text of `step`, its numbers of nodes and branches, and the bytes of its buffers."""
    e = Emitter(layout, lanes)
    e.begin("entry")
    e.lines.append("")
    for i in range(arrays):
        e.line(f"%at{i} = getelementptr i64, ptr %table, i64 {2 * i}")
        if i < layout.given:
            e.line(f"%array{i} = load ptr, ptr %at{i}, align 8")
        else:
            e.line(f"%offset{i} = load i64, ptr %at{i}, align 8")
            e.line(f"%array{i} = getelementptr i8, ptr %sheet, i64 %offset{i}")
        e.line(f"%by{i} = getelementptr i64, ptr %table, i64 {2 * i + 1}")
        e.line(f"%bytes{i} = load i64, ptr %by{i}, align 8")
    with _loop(e, "block", "%first", "%last"):
        e.line(f"%at = mul i64 %block, {layout.stride}")
        e.line("%state = getelementptr i8, ptr %memory, i64 %at")
        sweeps.fetch(e, layout.stride)
        with _loop(e, "time", "0", "%steps"):
            items, room = _step(e, least)
    e.line(f"ret i64 {e.set('load i64, ptr %broken, align 8')}")
    e.rooms += ["  %broken = alloca i64, align 8", "  store i64 0, ptr %broken, align 8"]
    e.lines[1] = "\n".join(e.rooms)
    wide = 64 * lanes
    attributes = f'nounwind "prefer-vector-width"="{max(128, min(512, wide))}" "min-legal-vector-width"="{max(128, min(512, wide))}"'
    head = ("define i64 @step(ptr noalias nocapture %memory, ptr noalias nocapture readonly %uniforms, "
            "ptr noalias nocapture readonly %table, ptr noalias nocapture %large, ptr noalias nocapture %sheet, "
            "i64 %first, i64 %last, i64 %steps) #0 {")  # fmt: skip
    text = "\n".join([*sorted(e.declared), *e.texts, head, *e.lines, "}", bound(), f"attributes #0 = {{ {attributes} }}", ""])
    return text, counted(items), room


@contextlib.contextmanager
def _loop(e: Emitter, name: str, first: str, last: str) -> Iterator[None]:
    """Emit a loop over the numbers from `first` to before `last`, within the block."""
    e.line(f"%{name}_none = icmp sge i64 {first}, {last}")
    e.line(f"br i1 %{name}_none, label %{name}_end, label %{name}_loop")
    before = e.block
    e.begin(f"{name}_loop")
    e.line(f"%{name} = phi i64 [{first}, %{before}], [%{name}_next, %{name}_again]")
    yield
    e.line(f"br label %{name}_again")
    e.begin(f"{name}_again")
    e.line(f"%{name}_next = add i64 %{name}, 1")
    e.line(f"%{name}_more = icmp slt i64 %{name}_next, {last}")
    e.line(f"br i1 %{name}_more, label %{name}_loop, label %{name}_end")
    e.begin(f"{name}_end")


def _step(e: Emitter, least: int) -> tuple[list[Item], int]:
    """Emit one step of one block; return its items and the bytes of its buffers."""
    layout = e.layout
    outputs = [node for node, _ in layout.outputs]
    items = schedule(outputs, least)
    e.merged = sweeps.merged(items, outputs)
    e.places, room = sweeps.rooms(items, outputs, e.lanes, e.merged)
    here = {item.id: turn for turn, item in enumerate(items) if not isinstance(item, Branch)}
    here |= {node.id: turn for turn, item in enumerate(items) if isinstance(item, Branch) for node in item.decides}
    late = {place.offset for i, place in layout.inputs.items() if isinstance(place, Held) and i not in here}  # read in a branch, or never
    waiting: dict[int, list[Held | Column]] = {}
    rest: list[tuple[Node, Held | Column]] = []
    rows: dict[int, list[tuple[Column, Node]]] = {}
    large: list[tuple[Node, Held | Column]] = []
    read = last_read(items, layout)
    for node, place in layout.outputs:
        if node.size:
            large.append((node, place))
        elif isinstance(place, Column) and place.columns > 1:
            rows.setdefault(place.array, []).append((place, node))
        elif node.id in here and isinstance(place, Held) and place.offset not in late and read.get(place.offset, -1) <= here[node.id]:
            waiting.setdefault(node.id, []).append(place)
        else:
            rest.append((node, place))
    e.emit(items, waiting)
    for node, place in rest:
        e.store(node, place)
    for several in rows.values():
        several.sort(key=lambda pair: pair[0].column)
        blocks.store_columns(e, [node for _, node in several], several[0][0])
    if layout.demands:
        blocks.demand(e, [e.value(node) for node in layout.demands])
    for node, place in large:
        assert isinstance(place, Held)
        sweeps.copy(e, e.value(node), e.address("%state", place.offset), node, node.size)
    return items, room
