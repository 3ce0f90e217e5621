"""Code for operations on buffers, and the placement of buffers in memory."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tailgate.engine.buffers import is_pick as is_pick
from tailgate.engine.buffers import steps
from tailgate.engine.graph import Node, Source, Sweep
from tailgate.engine.operations import FLOAT
from tailgate.engine.passes import Branch, Item, rounds
from tailgate.engine.untraceable import Untraceable

if TYPE_CHECKING:
    from tailgate.engine.llvm import Emitter

ROOM = 64_000_000  # [bytes] for all buffers
LINE = 64  # bytes of a cache line
CHUNK = 16  # numbers of a row that are kept in registers
MERGED = 3  # most readers of a buffer that is computed where it is read
LIGHT, HEAVY = 4, 100  # most operations of a sweep that is merged into several readers, or into one


@contextlib.contextmanager
def counted(e: Emitter, count: int) -> Iterator[str]:
    """Emit a loop over the numbers below a count, within the block."""
    if count == 1:
        yield "0"
        return
    before, head, again, out = e.block, e.label("each"), e.label("next"), e.label("end")
    index = f"%{head}i"
    e.line(f"br label %{head}")
    e.begin(head)
    e.line(f"{index} = phi i64 [0, %{before}], [{index}n, %{again}]")
    yield index
    e.line(f"br label %{again}")
    e.begin(again)
    e.line(f"{index}n = add i64 {index}, 1")
    e.line(f"br i1 {e.set(f'icmp ult i64 {index}n, {count}')}, label %{head}, label %{out}")
    e.begin(out)


def element(e: Emitter, base: str, index: str, size: int, offset: int = 0) -> str:
    """Return the address of a number of a buffer."""
    at = index if index == "0" else e.set(f"mul i64 {index}, {size}")
    there = base if at == "0" else e.address(base, at)
    return e.address(there, offset * size) if offset else there


def _index(e: Emitter, numbers: Sequence[str], strides: Sequence[int]) -> str:
    """Emit the sum of indices times their strides."""
    out = "0"
    for number, stride in zip(numbers, strides, strict=True):
        if stride and number != "0":
            part = number if stride == 1 else e.set(f"mul i64 {number}, {stride}")
            out = part if out == "0" else e.set(f"add i64 {out}, {part}")
    return out


def sweep(e: Emitter, node: Node) -> None:
    """Emit a sweep: its body in a loop per axis."""
    body: Sweep = node.attr
    size = node.dtype.itemsize * e.lanes
    tables: dict[int, str] = {}
    _prepare(e, body, tables)
    room, outer = e.room(node), dict(e.names)
    with contextlib.ExitStack() as loops:
        numbers = [loops.enter_context(counted(e, n)) for n in body.shape]
        _round(e, body, numbers, tables, {})
        base = element(e, room, _index(e, numbers, steps((*body.shape, len(body.after)))[:-1]), size)
        for i, result in enumerate(body.after):
            e.to_memory(e.address(base, i * size) if i else base, node.dtype, e.value(result), size)
    e.names = outer
    e.names[node.id] = room


def _prepare(e: Emitter, body: Sweep, tables: dict[int, str]) -> None:
    """Emit names for all that no round changes."""
    for fixed in {a.id: a for inner in (*body.nodes, *body.after) for a in (*inner.args, inner) if a.fixed}.values():
        e.value(fixed)
    for source in body.sources:
        if isinstance(source.held, tuple):
            tables[id(source.held)] = e.table(source.held)
        elif source.held.id in e.merged:
            _prepare(e, source.held.attr, tables)


def _round(e: Emitter, body: Sweep, numbers: Sequence[str], tables: dict[int, str], made: dict[Any, str]) -> None:
    """Emit one round of a sweep, with the sweeps that are merged into it."""
    at: dict[Any, str] = {}
    found: dict[int | tuple[int, str], str] = {}
    for one, source in zip(body.carried, body.sources, strict=True):
        if source.strides not in at:
            at[source.strides] = _index(e, numbers, source.strides)
        index = at[source.strides]
        if isinstance(source.held, tuple) or source.held.id not in e.merged:
            found[one.id] = _read(e, source, index, one, tables.get(id(source.held), ""))
            continue
        inner: Sweep = source.held.attr
        key = source.held.id, index, source.offset
        if key not in made:
            place = numbers
            if not alike(inner, body, source):
                place = [index if not source.offset else e.set(f"add i64 {index}, {source.offset}")]
            _round(e, inner, place, tables, made)
            made[key] = e.value(inner.after[0])
        found[one.id] = made[key]
    e.names.update(found)
    e.emit(rounds(body), {})


def alike(inner: Sweep, outer: Sweep, source: Source) -> bool:
    """Return True if each round of `outer` reads the result of the same round of `inner`."""
    return inner.shape == outer.shape and source.offset == 0 and source.strides == steps(inner.shape)


def merged(items: Sequence[Item], kept: Iterable[Node]) -> set[int]:
    """Return the sweeps that need no buffer, because their readers compute their numbers."""
    uses: dict[int, int] = {}
    sizes: dict[int, int] = {}

    def used(node: Node, times: int) -> None:
        uses[node.id] = uses.get(node.id, 0) + times

    nodes = {node.id: node for item in items for node in inside(item)}
    within = {inner.id: node.id for node in nodes.values() if node.op in ("loop", "sweep") for inner in node.attr.nodes}
    results = [after for node in nodes.values() if node.op in ("loop", "sweep") for after in node.attr.after]
    for node in (*kept, *results):
        used(node.args[0] if is_pick(node) else node, MERGED + 1)
    for node in nodes.values():
        for a in node.args:
            if a.size and node.op not in ("sweep", "pick"):
                used(a, MERGED + 1)
            elif is_pick(a):
                used(a.args[0], MERGED + 1)
        if node.op == "sweep":
            for source in node.attr.sources:
                if isinstance(source.held, Node) and source.held.op == "sweep":
                    inner: Sweep = source.held.attr
                    once = all(stride or n == 1 for stride, n in zip(source.strides, node.attr.shape, strict=True))
                    once = once and within.get(source.held.id) == within.get(node.id)
                    fits = len(inner.after) == 1 and (len(inner.shape) == 1 or alike(inner, node.attr, source))
                    used(source.held, 1 if once and fits else MERGED + 1)
    out = set()
    for i, node in sorted(nodes.items()):
        if node.op == "sweep" and 0 < uses.get(i, 0) <= MERGED:
            sizes[i] = len(node.attr.nodes) + sum(sizes.get(a.id, 0) for a in node.args)
            if sizes[i] <= (LIGHT if uses[i] > 1 else HEAVY):
                out.add(i)
            else:
                sizes[i] = 0
    return out


def pack(e: Emitter, node: Node) -> None:
    """Emit pieces, one after the other."""
    room, size, at = e.room(node), node.dtype.itemsize * e.lanes, 0
    for source, shape in node.attr:
        if isinstance(source, Node):
            e.to_memory(element(e, room, "0", size, at), node.dtype, e.value(source), size)
            at += 1
            continue
        table = e.table(source.held) if isinstance(source.held, tuple) else ""
        with contextlib.ExitStack() as loops:
            numbers = [loops.enter_context(counted(e, n)) for n in shape]
            held = _read(e, source, _index(e, numbers, source.strides), node, table)
            to = element(e, room, _index(e, numbers, steps(shape)), size, at)
            e.to_memory(to, node.dtype, held, size)
        at += int(np.prod(shape))
    e.names[node.id] = room


def _read(e: Emitter, source: Source, index: str, like: Node, table: str) -> str:
    """Emit the load of a number of a source; `table` is the address of a table of fixed nodes."""
    if isinstance(source.held, Node):
        size = like.dtype.itemsize * e.lanes
        return e.from_memory(element(e, e.value(source.held), index, size, source.offset), like.dtype, size)
    return e.uniform(element(e, table, index, 8, source.offset), like.dtype)


def copy(e: Emitter, source: str, target: str, node: Node, count: int) -> None:
    """Emit a copy of `count` numbers of a buffer's type from one place to another."""
    size = node.dtype.itemsize * e.lanes
    with counted(e, count) as i:
        held = e.from_memory(element(e, source, i, size), node.dtype, size)
        e.to_memory(element(e, target, i, size), node.dtype, held, size)


def blend(e: Emitter, node: Node, mask: str, x: str, y: str) -> str:
    """Emit the buffer x in the lanes of a mask, and y in the others."""
    room, kind, size = e.room(node), e.vector(node.dtype), node.dtype.itemsize * e.lanes
    with counted(e, node.size) as i:
        one, other = (e.from_memory(element(e, place, i, size), node.dtype, size) for place in (x, y))
        held = e.set(f"select <{e.lanes} x i1> {mask}, {kind} {one}, {kind} {other}")
        e.to_memory(element(e, room, i, size), node.dtype, held, size)
    return room


def invert(e: Emitter, node: Node) -> None:
    """Emit the inverses of matrices in a new buffer."""
    q, room = node.attr, e.room(node)
    copy(e, e.value(node.args[0]), room, node, node.size)
    if ("invert", q) not in e.routines:
        e.routines["invert", q] = f"@invert_{q}"
        e.texts.append(_invert_text(e, q))
    with counted(e, node.size // (q * q)) as i:
        e.line(f"call fastcc void @invert_{q}(ptr {element(e, room, i, 8 * e.lanes * q * q)})")
    e.names[node.id] = room


def _invert_text(outer: Emitter, q: int) -> str:
    """Return the text of the inverse, element by element as in `matrices.inverse`."""
    e, kind, size = outer.fresh(), outer.vector(FLOAT), 8 * outer.lanes
    e.begin("entry")

    def read(there: str) -> str:
        return e.set(f"load {kind}, ptr {there}, align {size}")

    def write(name: str, there: str) -> None:
        e.line(f"store {kind} {name}, ptr {there}, align {size}")

    with counted(e, q) as p:
        row = element(e, "%a", p, size * q)
        pivot = element(e, row, p, size)
        scale = e.set(f"fdiv {kind} splat (double 1.0), {read(pivot)}")
        write("splat (double 1.0)", pivot)
        with counted(e, q) as j:
            there = element(e, row, j, size)
            write(e.set(f"fmul {kind} {read(there)}, {scale}"), there)
        for first in range(0, q, CHUNK):
            columns = range(first, min(first + CHUNK, q))
            held = [read(element(e, row, "0", size, j)) for j in columns]
            with counted(e, q) as i:
                other, after = e.label("other"), e.label("after")
                e.line(f"br i1 {e.set(f'icmp eq i64 {i}, {p}')}, label %{after}, label %{other}")
                e.begin(other)
                line = element(e, "%a", i, size * q)
                factor = element(e, "%f", i, size)
                if first == 0:
                    there = element(e, line, p, size)
                    write(read(there), factor)
                    write("zeroinitializer", there)
                f = read(factor)
                for column, name in zip(columns, held, strict=True):
                    there = element(e, line, "0", size, column)
                    write(e.set(f"fsub {kind} {read(there)}, {e.set(f'fmul {kind} {f}, {name}')}"), there)
                e.line(f"br label %{after}")
                e.begin(after)
    e.line("ret void")
    room = f"  %f = alloca [{q} x {kind}], align {size}"
    head = f"define internal fastcc void @invert_{q}(ptr noalias %a) noinline #0 {{"
    return "\n".join([head, e.lines[0], room, *e.lines[1:], "}"])


def fetch(e: Emitter, stride: int) -> None:
    """Emit a prefetch of the next block's state."""
    e.declared.add("declare void @llvm.prefetch.p0(ptr, i32, i32, i32)")
    following = e.address("%state", stride)
    with counted(e, stride // LINE) as i:
        e.line(f"call void @llvm.prefetch.p0(ptr {element(e, following, i, LINE)}, i32 1, i32 3, i32 1)")


# -- placement


def rooms(items: Sequence[Item], kept: Iterable[Node], lanes: int, none: Collection[int] = ()) -> tuple[dict[int, int], int]:
    """Return the offset [bytes] of each buffer, and the total size; a place is reused after its last reader.

    Buffers in `none` have no place.
    """
    turn: dict[int, int] = {}
    nodes: dict[int, Node] = {}
    for i, item in enumerate(items):
        for node in inside(item):
            nodes[node.id], turn[node.id] = node, i
    last = {i: turn[i] for i in nodes}
    for node in kept:
        if node.id in last:
            last[node.id] = len(items)
    for node in sorted(nodes.values(), key=lambda node: -node.id):
        through = node.op in ("pick", "blend") or node.id in none  # these read the buffer later
        until = last[node.id] if through else turn[node.id]
        for a in node.args:
            if a.id in last:
                last[a.id] = max(last[a.id], until)
    out: dict[int, int] = {}
    busy: list[tuple[int, int, int]] = []  # begin, end, last reader
    total = 0
    for node in sorted((n for n in nodes.values() if n.size and n.op != "held" and n.id not in none), key=lambda node: turn[node.id]):
        size, at = -(-node.size * node.dtype.itemsize * lanes // 64) * 64, 0
        busy = [one for one in busy if one[2] >= turn[node.id]]
        for begin, end, _ in sorted(busy):
            if at + size <= begin:
                break
            at = max(at, end)
        out[node.id] = at
        busy.append((at, at + size, last[node.id]))
        total = max(total, at + size)
    if total > ROOM:
        raise Untraceable(f"arrays of {total / 1e6:.1f} MB in a step", "use smaller ones")
    return out, total


def inside(item: Item) -> Iterator[Node]:
    """Yield the nodes of an item, with those inside it."""
    if isinstance(item, Branch):
        yield from item.decides
        for inner in item.body:
            yield from inside(inner)
    else:
        yield item
        if item.op in ("loop", "sweep"):
            for inner in item.attr.nodes:
                yield from inside(inner)
