"""Machine code of this processor: LLVM's text of a scheduled graph, in vectors of `lanes` episodes.

Episodes stand in blocks of one vector each. A block's state lies together in memory, so that a step reads and writes a few KiB at fixed
places. Operations are neither reordered nor contracted. A function has five arguments: the state, the numbers that are the same for all
episodes, a table of arrays (address, bytes a step), the first block and the one behind the last, and the steps to play.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tailgate.engine.graph import BOOL, FLOAT, Body, Node
from tailgate.engine.passes import Branch, Item, counted, rounds, schedule

ROWS = 10  # of a matrix that are summed at once
_TYPES = {"f8": "double", "f4": "float", "b1": "i1"} | {f"{kind}{size}": f"i{8 * size}" for kind in "iu" for size in (1, 2, 4, 8)}
_FLOAT_ORDER = {"lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge", "eq": "oeq", "ne": "une"}
_ROUNDED = {"sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "trunc": "trunc", "rint": "rint"}


def code(dtype: np.dtype[Any]) -> str:
    """A type's kind and size."""
    return f"{dtype.kind}{dtype.itemsize}"


def scalar(dtype: np.dtype[Any]) -> str:
    """LLVM's name of a type."""
    return _TYPES[code(dtype)]


@dataclass(frozen=True)
class Held:
    """A number of the state: its place in a block [bytes]."""

    offset: int


@dataclass(frozen=True)
class Column:
    """A number of an array (episodes, columns), or (steps, episodes, columns), of the table."""

    array: int
    column: int
    columns: int


@dataclass
class Layout:
    """Where the function finds and leaves its numbers."""

    inputs: dict[int, Held | Column]  # by node
    outputs: list[tuple[Node, Held | Column]]
    stride: int  # bytes of a block's state
    uniforms: dict[int, int] = field(default_factory=dict)  # node -> its slot
    slots: list[Node] = field(default_factory=list)  # what the table of numbers that all episodes share holds


class Emitter:
    """The text of one function."""

    def __init__(self, layout: Layout, lanes: int) -> None:
        self.layout, self.lanes = layout, lanes
        self.lines: list[str] = []
        self.declared: set[str] = set()
        self.routines: dict[Any, str] = {}  # their names
        self.texts: list[str] = []  # and texts
        self.rooms: list[str] = []  # on the stack
        self.names: dict[int | tuple[int, str], str] = {}
        self.count = 0
        self.block = "entry"

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

    def splat(self, value: Any) -> str:
        """A constant in all lanes."""
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
        """The name of a node's vector."""
        if node.op == "const":
            return self.splat(node.attr)
        if node.id not in self.names:
            if not node.fixed:
                raise AssertionError(f"{node} is not computed yet")
            if node.id not in self.layout.uniforms:
                self.layout.uniforms[node.id] = len(self.layout.slots)
                self.layout.slots.append(node)
            self.names[node.id] = self.uniform(self.layout.uniforms[node.id], node.dtype)
        return self.names[node.id]

    def uniform(self, place: int, dtype: np.dtype[Any]) -> str:
        """One of the numbers that all episodes share, in all lanes."""
        name = scalar(BOOL) if dtype == BOOL else scalar(dtype)
        stored = "i8" if dtype == BOOL else name
        held = self.set(f"load {stored}, ptr {self.address('%uniforms', 8 * place)}, align 8")
        if dtype == BOOL:
            held = self.set(f"icmp ne i8 {held}, 0")
        first = self.set(f"insertelement {self.vector(dtype)} poison, {name} {held}, i32 0")
        kind = self.vector(dtype)
        return self.set(f"shufflevector {kind} {first}, {kind} poison, <{self.lanes} x i32> zeroinitializer")

    def stored(self, dtype: np.dtype[Any]) -> str:
        """The type of a vector in memory: a byte for each truth value."""
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
        """The address of the block's first episode in an array."""
        step = self.set(f"mul i64 %time, %bytes{place.array}")
        row = self.set(f"mul i64 %block, {self.lanes * place.columns * dtype.itemsize}")
        return self.address(f"%array{place.array}", self.set(f"add i64 {step}, {row}"))

    def compute(self, node: Node) -> None:
        if node.op == "loop":
            self.loop(node)
        elif node.op == "call":
            self.call(node)
        elif node.op == "matvec":
            self.matvec(node)
        elif node.op == "gather":
            self.names[node.id] = self.gather(node)
        elif node.op == "pick":
            self.names[node.id] = self.names[node.args[0].id, str(node.attr)]
        else:
            self.names[node.id] = self.input(node) if node.op == "input" else operation(self, node)

    def call(self, node: Node) -> None:
        """A routine, whose text is written when it is met first."""
        routine = node.attr
        kinds = [self.vector(one.dtype) for one in routine.outputs]
        result = f"{{ {', '.join(kinds)} }}"
        if routine not in self.routines:
            self.routines[routine] = name = f"@{routine.name}{len(self.routines)}"
            inner = Emitter(Layout({}, [], 0), self.lanes)
            inner.routines, inner.texts, inner.declared = self.routines, self.texts, self.declared
            inner.names = {one.id: f"%a{i}" for i, one in enumerate(routine.inputs)}
            inner.begin("entry")
            inner.emit([item for item in schedule(routine.outputs) if not isinstance(item, Node) or item.op != "input"], {})
            whole = "poison"
            for i, (one, kind) in enumerate(zip(routine.outputs, kinds, strict=True)):
                whole = inner.set(f"insertvalue {result} {whole}, {kind} {inner.value(one)}, {i}")
            inner.line(f"ret {result} {whole}")
            given = ", ".join(f"{inner.vector(one.dtype)} %a{i}" for i, one in enumerate(routine.inputs))
            self.texts.append("\n".join([f"define internal fastcc {result} {name}({given}) noinline #0 {{", *inner.lines, "}"]))
        given = ", ".join(f"{self.vector(a.dtype)} {self.value(a)}" for a in node.args)
        held = self.set(f"call fastcc {result} {self.routines[routine]}({given})")
        for i in range(len(kinds)):
            self.names[node.id, str(i)] = self.set(f"extractvalue {result} {held}, {i}")

    def gather(self, node: Node) -> str:
        """A number of a table for each lane."""
        table = self.address("%uniforms", 8 * len(self.layout.slots))
        self.layout.slots.extend(node.attr)
        index, out, name = self.value(node.args[0]), "poison", "i8" if node.dtype == BOOL else scalar(node.dtype)
        for lane in range(self.lanes):
            at = self.set(f"shl i64 {self.set(f'extractelement <{self.lanes} x i64> {index}, i32 {lane}')}, 3")
            held = self.set(f"load {name}, ptr {self.address(table, at)}, align 8")
            if node.dtype == BOOL:
                held = self.set(f"icmp ne i8 {held}, 0")
            out = self.set(f"insertelement {self.vector(node.dtype)} {out}, {scalar(node.dtype)} {held}, i32 {lane}")
        return out

    def buffer(self, names: Sequence[str]) -> str:
        """Room for vectors one behind the other, which hold these."""
        kind, size = self.vector(FLOAT), 8 * self.lanes
        self.count += 1
        room = f"%room{self.count}"
        self.rooms.append(f"  {room} = alloca [{len(names)} x {kind}], align {size}")
        for i, name in enumerate(names):
            self.line(f"store {kind} {name}, ptr {self.address(room, size * i)}, align {size}")
        return room

    def matvec(self, node: Node) -> None:
        """A matrix that all episodes share times a vector of each: a loop over its columns, by a function for each shape."""
        (p, q), kind, size = node.attr.shape, self.vector(FLOAT), 8 * self.lanes
        if (p, q) not in self.routines:
            self.routines[p, q] = f"@matvec_{p}_{q}"
            self.texts.append(self._matvec_text(p, q))
        table = self.address("%uniforms", 8 * len(self.layout.slots))
        self.layout.slots.extend(node.attr.T.flat)
        names = [self.value(a) for a in node.args]
        x, out = self.buffer(names[:q]), self.buffer(names[q:])
        self.line(f"call fastcc void {self.routines[p, q]}(ptr {table}, ptr {x}, ptr {out})")
        for i in range(p):
            self.names[node.id, str(i)] = self.set(f"load {kind}, ptr {self.address(out, size * i)}, align {size}")

    def _matvec_text(self, p: int, q: int) -> str:
        e, kind, size = Emitter(Layout({}, [], 0), self.lanes), self.vector(FLOAT), 8 * self.lanes
        e.begin("entry")
        for first in range(0, p, ROWS):
            rows = range(first, min(first + ROWS, p))
            begin = [e.set(f"load {kind}, ptr {e.address('%out', size * i)}, align {size}") for i in rows]
            before, again, done = e.block, e.label("again"), e.label("done")
            e.line(f"br label %{again}")
            e.begin(again)
            k, totals = f"%k{first}", [f"%total{i}" for i in rows]
            e.line(f"{k} = phi i64 [0, %{before}], [{k}n, %{again}]")
            for name, at_first in zip(totals, begin, strict=True):
                e.line(f"{name} = phi {kind} [{at_first}, %{before}], [{name}n, %{again}]")
            held = e.set(f"load {kind}, ptr {e.address('%x', e.set(f'mul i64 {k}, {size}'))}, align {size}")
            column = e.address("%table", e.set(f"mul i64 {k}, {8 * p}"))
            for i, name in zip(rows, totals, strict=True):
                one = e.set(f"load double, ptr {e.address(column, 8 * i)}, align 8")
                first_lane = e.set(f"insertelement {kind} poison, double {one}, i32 0")
                all_lanes = e.set(f"shufflevector {kind} {first_lane}, {kind} poison, <{self.lanes} x i32> zeroinitializer")
                e.line(f"{name}n = fadd {kind} {name}, {e.set(f'fmul {kind} {all_lanes}, {held}')}")
            e.line(f"{k}n = add i64 {k}, 1")
            e.line(f"br i1 {e.set(f'icmp slt i64 {k}n, {q}')}, label %{again}, label %{done}")
            e.begin(done)
            for i, name in zip(rows, totals, strict=True):
                e.line(f"store {kind} {name}n, ptr {e.address('%out', size * i)}, align {size}")
        e.line("ret void")
        head = f"define internal fastcc void @matvec_{p}_{q}(ptr noalias %table, ptr noalias %x, ptr noalias %out) noinline #0 {{"
        return "\n".join([head, *e.lines, "}"])

    def loop(self, node: Node) -> None:
        """Rounds until no lane goes on."""
        body: Body = node.attr
        begin = [self.value(a) for a in node.args[: len(body.carried)]]
        for captured in {a.id: a for inner in (*body.nodes, *body.after) for a in (*inner.args, inner) if a.fixed}.values():
            self.value(captured)
        again, out = self.label("again"), self.label("out")
        before, outer, count = self.block, dict(self.names), f"%count{node.id}"
        self.line(f"br label %{again}")
        self.begin(again)
        heads = []
        for one, first in zip(body.carried, begin, strict=True):
            self.count += 1
            self.names[one.id] = f"%v{self.count}"
            heads.append((len(self.lines), one, first))
            self.lines.append("")
        self.lines.append("")
        going = [self.names[one.id] for one in body.carried[: len(body.going)]]
        mask = going[0]
        for other in going[1:]:
            mask = self.set(f"or <{self.lanes} x i1> {mask}, {other}")
        more = self.set(f"icmp slt i64 {count}, {body.most}")
        go, inside = self.set(f"and i1 {self.any_lane(mask)}, {more}"), self.label("round")
        self.line(f"br i1 {go}, label %{inside}, label %{out}")
        self.begin(inside)
        self.emit(rounds(body), {})
        for at, one, first in heads:
            new = self.value(body.after[body.carried.index(one)])
            self.lines[at] = f"  {self.names[one.id]} = phi {self.vector(one.dtype)} [{first}, %{before}], [{new}, %{self.block}]"
        self.lines[heads[-1][0] + 1] = f"  {count} = phi i64 [0, %{before}], [{count}n, %{self.block}]"
        self.line(f"{count}n = add i64 {count}, 1")
        self.line(f"br label %{again}")
        carried = {one.id: self.names[one.id] for one in body.carried}
        self.names = outer
        for i, one in enumerate(body.carried):
            self.names[node.id, str(i)] = carried[one.id]
        self.begin(out)

    # -- order

    def emit(self, items: Sequence[Item], stores: dict[int, list[Held | Column]]) -> None:
        """Code of the items. What is stored is stored at once, where nothing reads its place afterwards."""
        for item in items:
            if isinstance(item, Branch):
                self.branch(item)
                done = item.decides
            else:
                self.compute(item)
                done = [item]
            for node in done:
                for place in stores.pop(node.id, ()):
                    self.store(node, place)

    def branch(self, branch: Branch) -> None:
        mask = self.value(branch.mask)
        if branch.side == 2:
            mask = self.set(f"xor <{self.lanes} x i1> {mask}, splat (i1 true)")
        others = {c.id: self._other(c, branch.side) for c in branch.decides}
        inside, after = self.label("in"), self.label("after")
        self.line(f"br i1 {self.any_lane(mask)}, label %{inside}, label %{after}")
        before, outer = self.block, dict(self.names)
        self.begin(inside)
        self.emit(branch.body, {})
        found = {}
        for choice in branch.choices:
            held, kind = self.value(choice.args[branch.side]), self.vector(choice.dtype)
            if choice.id in others:
                held = self.set(f"select <{self.lanes} x i1> {mask}, {kind} {held}, {kind} {others[choice.id]}")
            found[choice.id] = held
        self.line(f"br label %{after}")
        end, self.names = self.block, outer
        self.begin(after)
        for choice in branch.choices:
            skipped = others.get(choice.id, "poison")
            held = self.set(f"phi {self.vector(choice.dtype)} [{found[choice.id]}, %{end}], [{skipped}, %{before}]")
            self.names[choice.id if choice.id in others else (choice.id, "one side")] = held

    def _other(self, choice: Node, side: int) -> str:
        """The side of a choice that this branch does not compute."""
        return self.names.get((choice.id, "one side")) or self.value(choice.args[3 - side])

    def store(self, node: Node, place: Held | Column) -> None:
        if isinstance(place, Held):
            align = node.dtype.itemsize * self.lanes
            self.to_memory(self.address("%state", place.offset), node.dtype, self.value(node), align)
        else:
            self.to_memory(self.row(place, node.dtype), node.dtype, self.value(node), node.dtype.itemsize)

    def store_columns(self, nodes: Sequence[Node], place: Column) -> None:
        """Several columns of one array, as whole rows."""
        dtype, lanes, stored = nodes[0].dtype, self.lanes, self.stored(nodes[0].dtype)
        base = self.row(place, dtype)
        for begin in range(0, len(nodes), lanes):
            names = [self.value(node) for node in nodes[begin : begin + lanes]]
            if dtype == BOOL:
                names = [self.set(f"zext <{lanes} x i1> {name} to {stored}") for name in names]
            for lane, name in enumerate(self.turned(names + ["poison"] * (lanes - len(names)), stored)):
                there = self.address(base, (lane * place.columns + place.column + begin) * dtype.itemsize)
                kind = f"<{len(names)} x {stored.split(' x ')[1]}"
                if len(names) < lanes:
                    chosen = ", ".join(f"i32 {i}" for i in range(len(names)))
                    name = self.set(f"shufflevector {stored} {name}, {stored} poison, <{len(names)} x i32> <{chosen}>")
                self.line(f"store {kind} {name}, ptr {there}, align {dtype.itemsize}")

    def turned(self, rows: list[str], kind: str) -> list[str]:
        """As many vectors as there are lanes, transposed."""
        n, half = self.lanes, self.lanes // 2
        low = ", ".join(f"i32 {i + side * n}" for i in range(half) for side in (0, 1))
        high = ", ".join(f"i32 {half + i + side * n}" for i in range(half) for side in (0, 1))
        for _ in range(n.bit_length() - 1):
            pairs = [(rows[i], rows[i + half]) for i in range(half)]
            rows = [
                self.set(f"shufflevector {kind} {a}, {kind} {b}, <{n} x i32> <{mask}>") for a, b in pairs for mask in (low, high)
            ]  # fmt: skip
        return rows


def operation(e: Emitter, node: Node) -> str:
    """An operation of two or fewer arguments, a choice, or a change of type."""
    op, dtype, lanes = node.op, node.dtype, e.lanes
    args = [e.value(a) for a in node.args]
    of = node.args[0].dtype
    kind, result = e.vector(of), e.vector(dtype)
    floats = of.kind == "f"
    if op == "select":
        return e.set(f"select {kind} {args[0]}, {result} {args[1]}, {result} {args[2]}")
    if op == "bits":
        return args[0] if scalar(of) == scalar(dtype) else e.set(f"bitcast {kind} {args[0]} to {result}")
    if op == "cast":
        return cast(e, args[0], of, dtype)
    if op in _FLOAT_ORDER:
        if floats:
            return e.set(f"fcmp {_FLOAT_ORDER[op]} {kind} {args[0]}, {args[1]}")
        order = op if op in ("eq", "ne") else ("s" if of.kind == "i" else "u") + op
        return e.set(f"icmp {order} {kind} {args[0]}, {args[1]}")
    if op in ("min", "max"):
        return smaller(e, node, args, "lt" if op == "min" else "gt")
    if op in ("add", "sub", "mul"):
        return e.set(f"{'f' if floats else ''}{op} {kind} {args[0]}, {args[1]}")
    if op in ("and", "or", "xor", "shl"):
        return e.set(f"{op} {kind} {args[0]}, {args[1]}")
    if op == "div":
        return e.set(f"fdiv {kind} {args[0]}, {args[1]}")
    if op == "shr":
        return e.set(f"{'ashr' if of.kind == 'i' else 'lshr'} {kind} {args[0]}, {args[1]}")
    if op == "rem":
        return remainder(e, kind, args, of.kind == "i")
    if op == "neg":
        return e.set(f"fneg {kind} {args[0]}" if floats else f"sub {kind} zeroinitializer, {args[0]}")
    if op == "not":
        return e.set(f"xor {kind} {args[0]}, splat ({scalar(of)} {'true' if of == BOOL else -1})")
    if op == "abs" and not floats:
        return e.set(f"select <{lanes} x i1> {e.set(f'icmp slt {kind} {args[0]}, zeroinitializer')}, {kind} "
                     f"{e.set(f'sub {kind} zeroinitializer, {args[0]}')}, {kind} {args[0]}") if of.kind == "i" else args[0]  # fmt: skip
    name = f"@llvm.{_ROUNDED.get(op, 'fabs')}.v{lanes}f{8 * of.itemsize}"
    e.declared.add(f"declare {kind} {name}({kind})")
    return e.set(f"call {kind} {name}({kind} {args[0]})")


def smaller(e: Emitter, node: Node, args: Sequence[str], order: str) -> str:
    """min and max, as `graph.minimum` defines them."""
    x, y = node.args
    kind, lanes = e.vector(x.dtype), e.lanes
    if x.dtype.kind == "f":
        if y.op == "const" and y.attr == y.attr:
            first = e.set(f"fcmp u{order} {kind} {args[0]}, {args[1]}")
        else:
            first = e.set(f"fcmp o{order} {kind} {args[0]}, {args[1]}")
            if not (x.op == "const" and x.attr == x.attr):
                first = e.set(f"or <{lanes} x i1> {first}, {e.set(f'fcmp uno {kind} {args[0]}, {args[0]}')}")
    else:
        first = e.set(f"icmp {'s' if x.dtype.kind == 'i' else 'u'}{order} {kind} {args[0]}, {args[1]}")
    return e.set(f"select <{lanes} x i1> {first}, {kind} {args[0]}, {kind} {args[1]}")


def remainder(e: Emitter, kind: str, args: Sequence[str], signed: bool) -> str:
    """The remainder by a positive constant, which is never negative."""
    if not signed:
        return e.set(f"urem {kind} {args[0]}, {args[1]}")
    rest = e.set(f"srem {kind} {args[0]}, {args[1]}")
    below = e.set(f"icmp slt {kind} {rest}, zeroinitializer")
    return e.set(f"select <{e.lanes} x i1> {below}, {kind} {e.set(f'add {kind} {rest}, {args[1]}')}, {kind} {rest}")


def cast(e: Emitter, x: str, of: np.dtype[Any], to: np.dtype[Any]) -> str:
    """x as another type, as `graph.converted` defines it."""
    kind, result, lanes = e.vector(of), e.vector(to), e.lanes
    if of == BOOL:
        if to.kind == "f":
            return e.set(f"select {kind} {x}, {result} {e.splat(np.ones((), to)[()])}, {result} zeroinitializer")
        return e.set(f"zext {kind} {x} to {result}")
    if to == BOOL:
        return e.set(f"{'fcmp une' if of.kind == 'f' else 'icmp ne'} {kind} {x}, zeroinitializer")
    if of.kind == to.kind == "f":
        return e.set(f"{'fptrunc' if to.itemsize < of.itemsize else 'fpext'} {kind} {x} to {result}")
    if of.kind == "f":
        if of.itemsize < 8:
            x, kind = e.set(f"fpext {kind} {x} to <{lanes} x double>"), f"<{lanes} x double>"
        lower = e.set(f"fcmp oge {kind} {x}, splat (double 0xC3E0000000000000)")
        upper = e.set(f"fcmp olt {kind} {x}, splat (double 0x43E0000000000000)")
        holds = e.set(f"and <{lanes} x i1> {lower}, {upper}")
        inside = e.set(f"select <{lanes} x i1> {holds}, {kind} {x}, {kind} zeroinitializer")
        whole = e.set(f"fptosi {kind} {inside} to <{lanes} x i64>")
        held = e.set(f"select <{lanes} x i1> {holds}, <{lanes} x i64> {whole}, <{lanes} x i64> splat (i64 -9223372036854775808)")
        return held if to.itemsize == 8 else e.set(f"trunc <{lanes} x i64> {held} to {result}")
    if to.kind == "f":
        return e.set(f"{'si' if of.kind == 'i' else 'ui'}tofp {kind} {x} to {result}")
    if of.itemsize == to.itemsize:
        return x
    how = "trunc" if of.itemsize > to.itemsize else "sext" if of.kind == "i" else "zext"
    return e.set(f"{how} {kind} {x} to {result}")


def text_of(layout: Layout, arrays: int, lanes: int, least: int) -> tuple[str, dict[str, int]]:
    """LLVM's text of `step(state, uniforms, table, first, last, steps)`, and how many nodes and branches it has."""
    e = Emitter(layout, lanes)
    e.begin("entry")
    e.lines.append("")
    for i in range(arrays):
        e.line(f"%at{i} = getelementptr i64, ptr %table, i64 {2 * i}")
        e.line(f"%array{i} = load ptr, ptr %at{i}, align 8")
        e.line(f"%by{i} = getelementptr i64, ptr %table, i64 {2 * i + 1}")
        e.line(f"%bytes{i} = load i64, ptr %by{i}, align 8")
    with _loop(e, "block", "%first", "%last"):
        e.line(f"%at = mul i64 %block, {layout.stride}")
        e.line("%state = getelementptr i8, ptr %memory, i64 %at")
        with _loop(e, "time", "0", "%steps"):
            items = _step(e, least)
    e.line("ret void")
    e.lines[1] = "\n".join(e.rooms)
    wide = 64 * lanes
    attributes = f'nounwind "prefer-vector-width"="{max(128, min(512, wide))}" "min-legal-vector-width"="{max(128, min(512, wide))}"'
    head = ("define void @step(ptr noalias nocapture %memory, ptr noalias nocapture readonly %uniforms, "
            "ptr noalias nocapture readonly %table, i64 %first, i64 %last, i64 %steps) #0 {")  # fmt: skip
    text = "\n".join([*sorted(e.declared), *e.texts, head, *e.lines, "}", f"attributes #0 = {{ {attributes} }}", ""])
    return text, counted(items)


@contextlib.contextmanager
def _loop(e: Emitter, name: str, first: str, last: str) -> Iterator[None]:
    """Code for each number of a range; of none where it is empty."""
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


def _step(e: Emitter, least: int) -> list[Item]:
    """One step of one block."""
    layout = e.layout
    items = schedule([node for node, _ in layout.outputs], least)
    here = {item.id: turn for turn, item in enumerate(items) if not isinstance(item, Branch)}
    here |= {node.id: turn for turn, item in enumerate(items) if isinstance(item, Branch) for node in item.decides}
    late = {place.offset for i, place in layout.inputs.items() if isinstance(place, Held) and i not in here}  # read in a branch, or never
    waiting: dict[int, list[Held | Column]] = {}
    rest: list[tuple[Node, Held | Column]] = []
    rows: dict[int, list[tuple[Column, Node]]] = {}
    read = _last_read(items, layout)
    for node, place in layout.outputs:
        if isinstance(place, Column) and place.columns > 1:
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
        e.store_columns([node for _, node in several], several[0][0])
    return items


def _last_read(items: Sequence[Item], layout: Layout) -> dict[int, int]:
    """By its offset: at which item a number of the state is read."""
    out = {}
    for i, item in enumerate(items):
        if not isinstance(item, Branch) and item.op == "input" and isinstance(place := layout.inputs.get(item.id), Held):
            out[place.offset] = i
    return out
