"""CUDA C of a scheduled graph: one thread an episode, the same graph and the same operations as `tailgate.engine.llvm`.

A block of the state is a warp: its numbers lie lane by lane, so that the threads of a warp read neighbouring addresses.
A branch is a branch, a sweep a loop, a buffer an address; a choice between buffers exchanges addresses.
Code must be compiled without contraction (--fmad=false) and with exact division and square roots, which are the default.

The text has two kernels of the same step, or one of them where ONLY is defined as its number.
`play_step` plays one, with the state in memory; `play_steps` plays several, with the state in variables.
Both take these arguments:

- the state, and the tables of numbers that all episodes share;
- room for buffers, as many pieces as there are warps in flight;
- the first block, the block after the last, the first step, and the number of steps;
- a number that becomes 1 if a demand fails in any lane, including idle lanes;
- by value: the other shared numbers, and the address and bytes per step of each array.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

from tailgate.engine import cuda_parts, sweeps
from tailgate.engine.cuda_parts import HEAD, LANES, TYPES, Type, constant, element, load, operation, saved, shared
from tailgate.engine.graph import Node
from tailgate.engine.instructions import code
from tailgate.engine.layout import Column, Held, Layout, Writer, last_read
from tailgate.engine.passes import Branch, Item, counted, schedule

THREADS = 128  # of a block of the grid
ARGUMENTS = 4000  # bytes of a kernel's arguments; shared numbers that find no room there stand in the tables
INLINED = 4000  # most nodes of routines that are repeated at each use
KERNELS = ("play_step", "play_steps")


class Emitter(Writer):
    """The text of one function."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.lines: list[str] = []
        self.depth = 1
        self.routines: dict[object, str] = {}  # names of routines
        self.texts: list[str] = []  # texts of routines
        self.inline = True  # repeat the code of routines where they are used
        self.places: dict[int, int] = {}  # offsets of buffers in their common room
        self.merged: set[int] = set()  # sweeps that are computed where they are read
        self.scalars: dict[int, int] = {}  # slot of a shared number -> its place among the arguments
        self.names: dict[int | tuple[int, str], str] = {}
        self.count = 0
        self.by_value = 0  # most shared numbers among the arguments
        self.kept = False  # the state is in variables

    def fresh(self) -> Emitter:
        """Return an emitter for another function of the same text."""
        out = Emitter(Layout({}, [], 0))
        out.routines, out.texts, out.inline = self.routines, self.texts, self.inline
        return out

    # -- text

    def line(self, text: str) -> None:
        self.lines.append("  " * self.depth + text)

    @contextlib.contextmanager
    def within(self, head: str) -> Iterator[None]:
        """Emit a block of statements behind a head, such as a loop's."""
        self.line(f"{head} {{")
        self.depth += 1
        yield
        self.depth -= 1
        self.line("}")

    def name(self, kind: str = "v") -> str:
        self.count += 1
        return f"{kind}{self.count}"

    def set(self, dtype: Type, text: str) -> str:
        """Emit a constant variable; return its name."""
        name = self.name()
        self.line(f"const {TYPES[code(dtype)]} {name} = {text};")
        return name

    def pointer(self, text: str) -> str:
        name = self.name("p")
        self.line(f"char* {name} = {text};")
        return name

    # -- values

    def value(self, node: Node) -> str:
        """Return the expression of a node: its variable, or a read of a shared number or a buffer."""
        if node.op == "const":
            return constant(node.attr)
        if sweeps.is_pick(node):
            return load(element(self.value(node.args[0]), "0", node.dtype, node.attr), node.dtype)
        if node.id not in self.names:
            if not node.fixed:
                raise AssertionError(f"{node} is not computed yet")
            if node.id not in self.layout.uniforms:
                self.layout.uniforms[node.id] = len(self.layout.slots)
                self.layout.slots.append(node)
            slot = self.layout.uniforms[node.id]
            if slot not in self.scalars and len(self.scalars) < self.by_value:
                self.scalars[slot] = len(self.scalars)
            held = f"u.at[{self.scalars[slot]}]" if slot in self.scalars else f"__ldg(tables + {slot})"
            self.names[node.id] = shared(held, node.dtype)
        return self.names[node.id]

    def table(self, nodes: Sequence[Node]) -> str:
        """Return the address of consecutive shared numbers."""
        key = tuple(node.id for node in nodes)
        if key not in self.layout.tables:
            self.layout.tables[key] = len(self.layout.slots)
            self.layout.slots.extend(nodes)
        return f"(tables + {self.layout.tables[key]})"

    def room(self, node: Node) -> str:
        """Return the address of this thread's numbers of a buffer."""
        return f"(room{node.dtype.itemsize} + {self.places[node.id]})"

    def input(self, node: Node) -> str:
        place = self.layout.inputs[node.id]
        if isinstance(place, Column):
            return load(self.row(place, node.dtype), node.dtype)
        if self.kept:
            return f"s{place.offset}"
        return load(f"(state{node.dtype.itemsize} + {place.offset})", node.dtype)

    def row(self, place: Column, dtype: Type) -> str:
        """Return the address of this episode's number in an array."""
        size = dtype.itemsize
        return f"(u.array[{place.array}].at + time * u.array[{place.array}].bytes + (row * {place.columns} + {place.column}) * {size})"

    def compute(self, node: Node) -> None:
        if node.id in self.merged:
            return
        if node.op in cuda_parts.EMITTED:
            cuda_parts.EMITTED[node.op](self, node)
        elif node.op == "held":
            place = self.layout.inputs[node.id]
            assert isinstance(place, Held)
            self.names[node.id] = self.pointer(f"state{node.dtype.itemsize} + {place.offset}")
        elif node.op == "blend":
            where, x, y = (self.value(a) for a in node.args)
            self.names[node.id] = self.pointer(f"{where} ? {x} : {y}")
        elif node.op == "pick":
            if not node.args[0].size:
                self.names[node.id] = self.names[node.args[0].id, str(node.attr)]
        else:
            text = self.input(node) if node.op == "input" else operation(node, [self.value(a) for a in node.args])
            self.names[node.id] = self.set(node.dtype, text)

    # -- order

    def branch(self, branch: Branch) -> None:
        mask = self.value(branch.mask)
        decided = {choice.id for choice in branch.decides}
        names = {}
        for choice in branch.choices:
            name = names[choice.id] = self.name("p" if choice.size else "v")
            begin = "0"  # never read
            if choice.id in decided:
                begin = self.names.get((choice.id, "one side")) or self.value(choice.args[3 - branch.side])
            self.line(f"{kind(choice)} {name} = {begin};")
        outer = dict(self.names)
        with self.within(f"if ({'!' if branch.side == 2 else ''}{mask})"):
            self.emit(branch.body, {})
            for choice in branch.choices:
                self.line(f"{names[choice.id]} = {self.value(choice.args[branch.side])};")
        self.names = outer
        for choice in branch.choices:
            self.names[choice.id if choice.id in decided else (choice.id, "one side")] = names[choice.id]

    def store(self, node: Node, place: Held | Column) -> None:
        if isinstance(place, Column):
            self.line(f"{saved(self.row(place, node.dtype), node.dtype)} = {self.value(node)};")
        elif self.kept:
            self.line(f"s{place.offset} = {self.value(node)};")
        else:
            self.line(f"{saved(f'(state{node.dtype.itemsize} + {place.offset})', node.dtype)} = {self.value(node)};")


def kind(node: Node) -> str:
    """Return the type of a node's variable."""
    return "char*" if node.size else TYPES[code(node.dtype)]


def text_of(layout: Layout, arrays: int, least: int, blocks: int = 0) -> tuple[str, dict[str, int], int, list[int]]:
    """Return the text of both kernels, its numbers of nodes and branches, the bytes of a warp's buffers, and the slots passed by value.

    With `blocks` the compiler leaves room for that number of blocks on a multiprocessor: fewer registers, more threads.
    """
    items = schedule([node for node, _ in layout.outputs], least)
    e = Emitter(layout)
    e.inline = cuda_parts.repeated(items) <= INLINED
    e.by_value = max(1, (ARGUMENTS - 8 * 8 - 16 * arrays) // 8)
    places, room = _rooms(e, items)
    kernels = [_kernel(e, name, items, places, room, blocks) for name in KERNELS]
    arguments = f"struct Shared {{ u64 at[{max(1, len(e.scalars))}]; Array array[{max(1, arrays)}]; }};"
    parts = [f"#if !defined(ONLY) || ONLY == {i}\n{kernel}\n#endif" for i, kernel in enumerate(kernels)]
    return "\n".join([HEAD, arguments, *e.texts, *parts, ""]), counted(items), room, list(e.scalars)


def only(kernel: str, text: str) -> str:
    """Return a text with one of its kernels."""
    return f"#define ONLY {KERNELS.index(kernel)}\n{text}"


def _rooms(e: Emitter, items: Sequence[Item]) -> tuple[dict[int, int], int]:
    """Return the offset of each buffer in a warp's room, and the room's bytes. Numbers of different types never share a place."""
    outputs = [node for node, _ in e.layout.outputs]
    e.merged = sweeps.merged(items, outputs)
    buffers = [node for item in items for node in sweeps.inside(item) if node.size]
    places: dict[int, int] = {}
    total = 0
    for dtype in dict.fromkeys(node.dtype for node in buffers):
        others = e.merged | {node.id for node in buffers if node.dtype != dtype}
        found, size = sweeps.rooms(items, outputs, LANES, others)
        places |= {i: total + at for i, at in found.items()}
        total += size
    return places, total


def _kernel(outer: Emitter, name: str, items: Sequence[Item], places: dict[int, int], room: int, blocks: int) -> str:
    """Return the text of one kernel."""
    e, layout = outer.fresh(), outer.layout
    e.layout, e.scalars, e.places, e.merged, e.kept = layout, outer.scalars, places, outer.merged, name == KERNELS[1]
    e.by_value = outer.by_value
    e.line(f"const int lane = threadIdx.x & {LANES - 1};")
    e.line("const i64 warps = (i64)gridDim.x * blockDim.x / 32, warp = ((i64)blockIdx.x * blockDim.x + threadIdx.x) / 32;")
    for size in sorted({node.dtype.itemsize for item in items for node in sweeps.inside(item) if node.id in places}):
        e.line(f"char* const room{size} = large + warp * {room} + lane * {size};")
    with e.within("for (i64 block = first + warp; block < last; block += warps)"):
        e.line(f"const i64 row = block * {LANES} + lane;")
        for size in (1, 2, 4, 8):
            e.line(f"char* const state{size} = memory + block * {layout.stride} + lane * {size};")
        held = _state(layout, items)
        if not e.kept:
            _step(e, items)
        else:
            for at, dtype in held.items():
                e.line(f"{TYPES[code(dtype)]} s{at} = {load(f'(state{dtype.itemsize} + {at})', dtype)};")
            with e.within("for (i64 time = begin; time < begin + steps; time++)"):
                _step(e, items)
            for at in dict.fromkeys(place.offset for _, place in layout.outputs if isinstance(place, Held) and place.offset in held):
                e.line(f"{saved(f'(state{held[at].itemsize} + {at})', held[at])} = s{at};")
    given = "char* memory, const u64* __restrict__ tables, char* large, i64 first, i64 last, i64 begin, i64 steps, i64* broken, Shared u"
    bounds = f"{THREADS}, {blocks}" if blocks else f"{THREADS}"
    head = f'extern "C" __global__ void __launch_bounds__({bounds}) {name}({given}) {{'
    return "\n".join([head, *([] if e.kept else ["  const i64 time = begin;"]), *e.lines, "}"])


def _state(layout: Layout, items: Sequence[Item]) -> dict[int, Type]:
    """Return the offset and type of each number of the state that a step reads or writes, without those of buffers."""
    read = [(node, layout.inputs[node.id]) for item in items for node in sweeps.inside(item) if node.op == "input"]
    return {place.offset: node.dtype for node, place in (*read, *layout.outputs) if isinstance(place, Held) and not node.size}


def _step(e: Emitter, items: Sequence[Item]) -> None:
    """Emit one step of one episode."""
    layout = e.layout
    here = {item.id: turn for turn, item in enumerate(items) if not isinstance(item, Branch)}
    here |= {node.id: turn for turn, item in enumerate(items) if isinstance(item, Branch) for node in item.decides}
    late = {place.offset for i, place in layout.inputs.items() if isinstance(place, Held) and i not in here}  # read in a branch, or never
    read = last_read(items, layout)
    waiting: dict[int, list[Held | Column]] = {}
    rest: list[tuple[Node, Held | Column]] = []
    for node, to in layout.outputs:
        soon = node.id in here and not node.size
        if soon and (isinstance(to, Column) or (to.offset not in late and read.get(to.offset, -1) <= here[node.id])):
            waiting.setdefault(node.id, []).append(to)
        else:
            rest.append((node, to))
    outer = dict(e.names)
    e.emit(items, waiting)
    for node, to in rest:
        if not node.size:
            e.store(node, to)
    if layout.demands:
        e.line(f"if (!({' & '.join(e.value(node) for node in layout.demands)})) *broken = 1;")
    for node, to in rest:
        if node.size:  # last: all that reads the place has been emitted
            assert isinstance(to, Held)
            cuda_parts.copy(e, e.value(node), f"(state{node.dtype.itemsize} + {to.offset})", node.dtype, node.size)
    e.names = outer
