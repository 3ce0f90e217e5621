"""Code for nodes of several instructions: loops, routines, tables, and matrices that all episodes share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tailgate.engine.graph import Body, Node
from tailgate.engine.instructions import scalar
from tailgate.engine.operations import BOOL, FLOAT
from tailgate.engine.passes import rounds, schedule

if TYPE_CHECKING:
    from tailgate.engine.layout import Column
    from tailgate.engine.llvm import Emitter

ROWS = 10  # rows of a matrix that are summed at once


def loop(e: Emitter, node: Node) -> None:
    """Emit a loop that runs until no lane continues."""
    body: Body = node.attr
    begin = [e.value(a) for a in node.args[: len(body.carried)]]
    for captured in {a.id: a for inner in (*body.nodes, *body.after) for a in (*inner.args, inner) if a.fixed}.values():
        e.value(captured)
    again, out = e.label("again"), e.label("out")
    before, outer, count = e.block, dict(e.names), f"%count{node.id}"
    e.line(f"br label %{again}")
    e.begin(again)
    heads = []
    for one, first in zip(body.carried, begin, strict=True):
        e.count += 1
        e.names[one.id] = f"%v{e.count}"
        heads.append((len(e.lines), one, first))
        e.lines.append("")
    e.lines.append("")
    going = [e.names[one.id] for one in body.carried[: len(body.going)]]
    mask = going[0]
    for other in going[1:]:
        mask = e.set(f"or <{e.lanes} x i1> {mask}, {other}")
    more = e.set(f"icmp slt i64 {count}, {body.most}")
    go, inside = e.set(f"and i1 {e.any_lane(mask)}, {more}"), e.label("round")
    e.line(f"br i1 {go}, label %{inside}, label %{out}")
    e.begin(inside)
    e.emit(rounds(body), {})
    for at, one, first in heads:
        new = e.value(body.after[body.carried.index(one)])
        e.lines[at] = f"  {e.names[one.id]} = phi {e.vector(one.dtype)} [{first}, %{before}], [{new}, %{e.block}]"
    e.lines[heads[-1][0] + 1] = f"  {count} = phi i64 [0, %{before}], [{count}n, %{e.block}]"
    e.line(f"{count}n = add i64 {count}, 1")
    e.line(f"br label %{again}")
    carried = {one.id: e.names[one.id] for one in body.carried}
    e.names = outer
    for i, one in enumerate(body.carried):
        e.names[node.id, str(i)] = carried[one.id]
    e.begin(out)


def call(e: Emitter, node: Node) -> None:
    """Emit a call of a routine; the first call also writes the routine."""
    routine = node.attr
    kinds = [e.vector(one.dtype) for one in routine.outputs]
    result = f"{{ {', '.join(kinds)} }}"
    if routine not in e.routines:
        e.routines[routine] = name = f"@{routine.name}{len(e.routines)}"
        inner = e.fresh()
        inner.names = {one.id: f"%a{i}" for i, one in enumerate(routine.inputs)}
        inner.begin("entry")
        inner.emit([item for item in schedule(routine.outputs) if not isinstance(item, Node) or item.op != "input"], {})
        whole = "poison"
        for i, (one, kind) in enumerate(zip(routine.outputs, kinds, strict=True)):
            whole = inner.set(f"insertvalue {result} {whole}, {kind} {inner.value(one)}, {i}")
        inner.line(f"ret {result} {whole}")
        given = ", ".join(f"{inner.vector(one.dtype)} %a{i}" for i, one in enumerate(routine.inputs))
        e.texts.append("\n".join([f"define internal fastcc {result} {name}({given}) noinline #0 {{", *inner.lines, "}"]))
    given = ", ".join(f"{e.vector(a.dtype)} {e.value(a)}" for a in node.args)
    held = e.set(f"call fastcc {result} {e.routines[routine]}({given})")
    for i in range(len(kinds)):
        e.names[node.id, str(i)] = e.set(f"extractvalue {result} {held}, {i}")


def gather(e: Emitter, node: Node) -> str:
    """Emit the lookup of one number of a table per lane."""
    table = e.table(node.attr)
    index, out, name = e.value(node.args[0]), "poison", "i8" if node.dtype == BOOL else scalar(node.dtype)
    for lane in range(e.lanes):
        at = e.set(f"shl i64 {e.set(f'extractelement <{e.lanes} x i64> {index}, i32 {lane}')}, 3")
        held = e.set(f"load {name}, ptr {e.address(table, at)}, align 8")
        if node.dtype == BOOL:
            held = e.set(f"icmp ne i8 {held}, 0")
        out = e.set(f"insertelement {e.vector(node.dtype)} {out}, {scalar(node.dtype)} {held}, i32 {lane}")
    return out


def matvec(e: Emitter, node: Node) -> None:
    """Emit a shared matrix times a vector per episode, by a function.

    For a dense matrix the function loops over columns, for a sparse one over the nonzero numbers.
    """
    (matrix, there, tables), (p, q), room = node.attr, node.attr.nodes.shape, e.room(node)
    x, base = e.together(node.args[:q]), node.args[q:]
    begin = e.splat(base[0].attr) if base[0].op == "const" and all(one is base[0] for one in base) else ""
    under = "" if begin else f", ptr {e.together(base)}"
    key = (begin, p, q) if there is None else (begin, "sparse")
    if key not in e.routines:
        e.routines[key] = f"@matvec{len(e.routines)}"
        e.texts.append((_sparse_text if there is not None else _dense_text)(e, e.routines[key], begin, p, q))
    if there is None:
        e.line(f"call fastcc void {e.routines[key]}(ptr {e.table(tuple(matrix.T.flat))}, ptr {x}, ptr {room}{under})")
    else:
        held, columns, last = (e.table(part) for part in (list(matrix[there]), *tables))
        e.line(f"call fastcc void {e.routines[key]}(ptr {held}, ptr {columns}, ptr {last}, i64 {8 * p}, ptr {x}, ptr {room}{under})")
    e.names[node.id] = room


def _dense_text(outer: Emitter, name: str, begin: str, p: int, q: int) -> str:
    e, kind, size = outer.fresh(), outer.vector(FLOAT), 8 * outer.lanes
    e.begin("entry")
    for first in range(0, p, ROWS):
        rows = range(first, min(first + ROWS, p))
        under = [begin or e.set(f"load {kind}, ptr {e.address('%base', size * i)}, align {size}") for i in rows]
        before, again, done = e.block, e.label("again"), e.label("done")
        e.line(f"br label %{again}")
        e.begin(again)
        k, totals = f"%k{first}", [f"%total{i}" for i in rows]
        e.line(f"{k} = phi i64 [0, %{before}], [{k}n, %{again}]")
        for total, at_first in zip(totals, under, strict=True):
            e.line(f"{total} = phi {kind} [{at_first}, %{before}], [{total}n, %{again}]")
        held = e.set(f"load {kind}, ptr {e.address('%x', e.set(f'mul i64 {k}, {size}'))}, align {size}")
        column = e.address("%table", e.set(f"mul i64 {k}, {8 * p}"))
        for i, total in zip(rows, totals, strict=True):
            product = e.set(f"fmul {kind} {_shared(e, e.address(column, 8 * i))}, {held}")
            e.line(f"{total}n = fadd {kind} {total}, {product}")
        e.line(f"{k}n = add i64 {k}, 1")
        e.line(f"br i1 {e.set(f'icmp slt i64 {k}n, {q}')}, label %{again}, label %{done}")
        e.begin(done)
        for i, total in zip(rows, totals, strict=True):
            e.line(f"store {kind} {total}n, ptr {e.address('%out', size * i)}, align {size}")
    e.line("ret void")
    given = "ptr noalias %table, ptr noalias %x, ptr noalias %out" + ("" if begin else ", ptr noalias %base")
    return "\n".join([f"define internal fastcc void {name}({given}) noinline #0 {{", *e.lines, "}"])


def _shared(e: Emitter, place: str) -> str:
    """Emit the load of one number of a table into all lanes."""
    kind = e.vector(FLOAT)
    one = e.set(f"load double, ptr {place}, align 8")
    first = e.set(f"insertelement {kind} poison, double {one}, i32 0")
    return e.set(f"shufflevector {kind} {first}, {kind} poison, <{e.lanes} x i32> zeroinitializer")


def _sparse_text(outer: Emitter, name: str, begin: str, *_: int) -> str:
    """Return the text of a product row by row; entries of `columns` and `last` are offsets in bytes."""
    e, kind, size = outer.fresh(), outer.vector(FLOAT), 8 * outer.lanes
    e.begin("entry")
    e.line("br label %row")
    e.begin("row")
    e.line("%i = phi i64 [0, %entry], [%next, %done]")
    e.line("%first = phi i64 [0, %entry], [%end, %done]")
    e.line(f"%place = mul i64 %i, {outer.lanes}")
    under = begin or e.set(f"load {kind}, ptr {e.address('%base', '%place')}, align {size}")
    e.line(f"%end = load i64, ptr {e.address('%last', '%i')}, align 8")
    e.line("br label %test")
    e.begin("test")
    e.line("%at = phi i64 [%first, %row], [%following, %entry_of_row]")
    e.line(f"%total = phi {kind} [{under}, %row], [%sum, %entry_of_row]")
    e.line(f"br i1 {e.set('icmp slt i64 %at, %end')}, label %entry_of_row, label %done")
    e.begin("entry_of_row")
    column = e.set(f"load i64, ptr {e.address('%columns', '%at')}, align 8")
    held = e.set(f"load {kind}, ptr {e.address('%x', e.set(f'mul i64 {column}, {outer.lanes}'))}, align {size}")
    product = e.set(f"fmul {kind} {_shared(e, e.address('%table', '%at'))}, {held}")
    e.line(f"%sum = fadd {kind} %total, {product}")
    e.line("%following = add i64 %at, 8")
    e.line("br label %test")
    e.begin("done")
    e.line(f"store {kind} %total, ptr {e.address('%out', '%place')}, align {size}")
    e.line("%next = add i64 %i, 8")
    e.line(f"br i1 {e.set('icmp slt i64 %next, %rows')}, label %row, label %left")
    e.begin("left")
    e.line("ret void")
    given = "ptr noalias %table, ptr noalias %columns, ptr noalias %last, i64 %rows, ptr noalias %x, ptr noalias %out"
    given += "" if begin else ", ptr noalias %base"
    return "\n".join([f"define internal fastcc void {name}({given}) noinline #0 {{", *e.lines, "}"])


def demand(e: Emitter, names: Sequence[str]) -> None:
    """Emit code that records if one of these conditions fails in some lane."""
    held = names[0]
    for name in names[1:]:
        held = e.set(f"and <{e.lanes} x i1> {held}, {name}")
    bad = e.any_lane(e.set(f"xor <{e.lanes} x i1> {held}, splat (i1 true)"))
    before, now = e.set("load i64, ptr %broken, align 8"), e.set(f"zext i1 {bad} to i64")
    e.line(f"store i64 {e.set(f'or i64 {before}, {now}')}, ptr %broken, align 8")


def store_columns(e: Emitter, nodes: Sequence[Node], place: Column) -> None:
    """Emit the store of several columns of one array, as whole rows."""
    dtype, lanes, stored = nodes[0].dtype, e.lanes, e.stored(nodes[0].dtype)
    base = e.row(place, dtype)
    for begin in range(0, len(nodes), lanes):
        names = [e.value(node) for node in nodes[begin : begin + lanes]]
        if dtype == BOOL:
            names = [e.set(f"zext <{lanes} x i1> {name} to {stored}") for name in names]
        for lane, name in enumerate(turned(e, names + ["poison"] * (lanes - len(names)), stored)):
            there = e.address(base, (lane * place.columns + place.column + begin) * dtype.itemsize)
            kind = f"<{len(names)} x {stored.split(' x ')[1]}"
            if len(names) < lanes:
                chosen = ", ".join(f"i32 {i}" for i in range(len(names)))
                name = e.set(f"shufflevector {stored} {name}, {stored} poison, <{len(names)} x i32> <{chosen}>")
            e.line(f"store {kind} {name}, ptr {there}, align {dtype.itemsize}")


def turned(e: Emitter, rows: list[str], kind: str) -> list[str]:
    """Emit the transposition of as many vectors as there are lanes."""
    n, half = e.lanes, e.lanes // 2
    low = ", ".join(f"i32 {i + side * n}" for i in range(half) for side in (0, 1))
    high = ", ".join(f"i32 {half + i + side * n}" for i in range(half) for side in (0, 1))
    for _ in range(n.bit_length() - 1):
        pairs = [(rows[i], rows[i + half]) for i in range(half)]
        rows = [
            e.set(f"shufflevector {kind} {a}, {kind} {b}, <{n} x i32> <{mask}>") for a, b in pairs for mask in (low, high)
        ]  # fmt: skip
    return rows
