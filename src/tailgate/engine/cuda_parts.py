"""CUDA C for the operations of a graph, for loops, routines, tables and buffers; see `tailgate.engine.cuda`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tailgate.engine import sweeps
from tailgate.engine.buffers import steps
from tailgate.engine.graph import Body, Node, Source, Sweep
from tailgate.engine.instructions import code
from tailgate.engine.operations import BOOL, FLOAT
from tailgate.engine.passes import Branch, Item, rounds, schedule

if TYPE_CHECKING:
    from tailgate.engine.cuda import Emitter

Type = np.dtype[Any]
LANES = 32  # threads of a warp
TYPES = {
    "f8": "double", "f4": "float", "b1": "bool", "i8": "i64", "u8": "u64", "i4": "int", "u4": "unsigned", "i2": "short",
    "u2": "unsigned short", "i1": "signed char", "u1": "unsigned char",
}  # fmt: skip
_LEAST = {4: "(-2147483647 - 1)", 8: "(-9223372036854775807ll - 1)"}
_COMPARED = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
_BITS = {"and": "&", "or": "|", "xor": "^"}
_WRAPPED = {"add": "+", "sub": "-", "mul": "*", "shl": "<<"}  # in integers without a sign: overflow with a sign is undefined in C
_FUNCTIONS = {"abs": "fabs", "sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "trunc": "trunc", "rint": "rint"}
ROWS = 10  # rows of a matrix that are summed at once

HEAD = """typedef unsigned long long u64;
typedef long long i64;
struct Array { char* at; i64 bytes; };
static __device__ __forceinline__ i64 whole(double x) {
  const bool holds = x >= -0x1p63 && x < 0x1p63;
  return holds ? (i64)x : -9223372036854775807ll - 1;
}"""


def unsigned(dtype: Type) -> str:
    """Return an unsigned type in which integers of a type wrap around."""
    return "u64" if dtype.itemsize == 8 else "unsigned"


def constant(value: np.generic) -> str:
    """Return the literal of a constant."""
    dtype = value.dtype
    if dtype == BOOL:
        return "true" if value else "false"
    if dtype.kind == "f":
        if not np.isfinite(value):
            bits = int(value.view(np.int64 if dtype.itemsize == 8 else np.int32))
            return f"__longlong_as_double({_whole(bits, 8)})" if dtype.itemsize == 8 else f"__int_as_float({_whole(bits, 4)})"
        text = float(value).hex()
        return f"({'' if dtype.itemsize == 8 else '(float)'}{text})"
    if dtype.kind == "u":
        return f"{int(value)}{'ull' if dtype.itemsize == 8 else 'u'}" if dtype.itemsize >= 4 else f"(({TYPES[code(dtype)]}){int(value)})"
    return _whole(int(value), dtype.itemsize) if dtype.itemsize >= 4 else f"(({TYPES[code(dtype)]})({int(value)}))"


def _whole(value: int, size: int) -> str:
    if value == -(2 ** (8 * size - 1)):
        return _LEAST[size]
    return f"({value}{'ll' if size == 8 else ''})"


def shared(bits: str, dtype: Type) -> str:
    """Return a number from its 64 bits in a table."""
    if dtype.kind == "f":
        return f"__longlong_as_double((i64){bits})" if dtype.itemsize == 8 else f"__int_as_float((int){bits})"
    return f"(({bits} & 255) != 0)" if dtype == BOOL else f"(({TYPES[code(dtype)]}){bits})"


def operation(node: Node, args: Sequence[str]) -> str:
    """Return the expression of an operation of one or two arguments, a select, or a conversion."""
    op, dtype, of = node.op, node.dtype, node.args[0].dtype
    floats, name = of.kind == "f", TYPES[code(dtype)]
    x, y = args[0], args[1] if len(args) > 1 else ""
    if op == "select":
        return f"{x} ? {y} : {args[2]}"
    if op == "bits":
        return _reinterpreted(x, of, dtype)
    if op == "cast":
        return _converted(x, of, dtype)
    if op in _COMPARED:
        return f"{x} {_COMPARED[op]} {y}"
    if op in ("min", "max"):
        return f"{_first(node, x, y, '<' if op == 'min' else '>')} ? {x} : {y}"
    if op in _BITS:
        return f"({name})({x} {_BITS[op]} {y})"
    if op in _WRAPPED and not floats:
        wide = unsigned(of)
        return f"({name})(({wide}){x} {_WRAPPED[op]} {'' if op == 'shl' else f'({wide})'}{y})"
    if op in _WRAPPED:
        return f"{x} {_WRAPPED[op]} {y}"
    if op == "div":
        return f"{x} / {y}"
    if op == "shr":
        return f"({name})({x} >> {y})"
    if op == "rem":  # by a positive constant: never negative
        rest = f"({x} % {y})"
        return f"({name})({rest} < 0 ? {rest} + {y} : {rest})" if of.kind == "i" else f"({name}){rest}"
    if op == "neg":
        return f"-{x}" if floats else f"({name})(0 - ({unsigned(of)}){x})"
    if op == "not":
        return f"!{x}" if of == BOOL else f"({name})~{x}"
    if op == "abs" and not floats:
        return f"({name})({x} < 0 ? 0 - ({unsigned(of)}){x} : ({unsigned(of)}){x})" if of.kind == "i" else x
    return f"{_FUNCTIONS[op]}{'' if of.itemsize == 8 else 'f'}({x})"


def _first(node: Node, x: str, y: str, order: str) -> str:
    """Return the condition under which min or max takes its first number, as `operations.minimum` defines it."""
    one, other = node.args
    if one.dtype.kind != "f":
        return f"{x} {order} {y}"
    if other.op == "const" and other.attr == other.attr:
        return f"!({x} {'>=' if order == '<' else '<='} {y})"
    if one.op == "const" and one.attr == one.attr:
        return f"{x} {order} {y}"
    return f"({x} {order} {y} || {x} != {x})"


def _reinterpreted(x: str, of: Type, to: Type) -> str:
    if to.kind == "f":
        return f"__longlong_as_double((i64){x})" if to.itemsize == 8 else f"__int_as_float((int){x})"
    if of.kind == "f":
        x = f"__double_as_longlong({x})" if of.itemsize == 8 else f"__float_as_int({x})"
    return f"({TYPES[code(to)]}){x}"


def _converted(x: str, of: Type, to: Type) -> str:
    """Return a conversion, as `operations.converted` defines it."""
    if to == BOOL:
        return f"{x} != 0"
    if of.kind == "f" and to.kind in "iu":
        return f"({TYPES[code(to)]})whole({x})"
    return f"({TYPES[code(to)]}){x}"


# -- memory


def element(base: str, index: str, dtype: Type, offset: int = 0) -> str:
    """Return the address of a number of a buffer."""
    size = dtype.itemsize * LANES
    at = "" if index == "0" else f" + ({index}) * {size}"
    return f"({base}{at} + {offset * size})" if offset else f"({base}{at})"


def load(address: str, dtype: Type) -> str:
    """Return a read from memory: one byte per truth value."""
    return f"(*(const unsigned char*){address} != 0)" if dtype == BOOL else f"(*(const {TYPES[code(dtype)]}*){address})"


def saved(address: str, dtype: Type) -> str:
    """Return the place in memory that a number is assigned to."""
    return f"*({'unsigned char' if dtype == BOOL else TYPES[code(dtype)]}*){address}"


# -- loops and routines


def loop(e: Emitter, node: Node) -> None:
    """Emit a loop that runs until its episode stops."""
    body: Body = node.attr
    begin = [e.value(a) for a in node.args[: len(body.carried)]]
    outer, held = dict(e.names), [e.name("c") for _ in body.carried]
    for one, name, first in zip(body.carried, held, begin, strict=True):
        e.line(f"{TYPES[code(one.dtype)]} {name} = {first};")
        e.names[one.id] = name
    count = e.name("k")
    going = " | ".join(held[: len(body.going)])
    with e.within(f"for (int {count} = 0; {count} < {body.most} && ({going}); {count}++)"):
        e.emit(rounds(body), {})
        new = [e.set(one.dtype, e.value(one)) for one in body.after]
        for name, value in zip(held, new, strict=True):
            e.line(f"{name} = {value};")
    e.names = outer
    for i, name in enumerate(held):
        e.names[node.id, str(i)] = name


def repeated(items: Sequence[Item]) -> int:
    """Return how many nodes all calls of routines have together."""
    return sum(node.attr.cost for item in items for node in sweeps.inside(item) if node.op == "call")


def call(e: Emitter, node: Node) -> None:
    """Emit a call of a routine; the first call also writes the routine."""
    routine = node.attr
    if routine not in e.routines:
        inner = e.fresh()
        inner.names = {one.id: f"a{i}" for i, one in enumerate(routine.inputs)}
        inner.emit([item for item in schedule(routine.outputs) if isinstance(item, Branch) or item.op != "input"], {})
        results = ", ".join(inner.value(one) for one in routine.outputs)
        e.routines[routine] = name = f"{routine.name}{len(e.routines)}"  # after those that it calls
        fields = " ".join(f"{TYPES[code(one.dtype)]} r{i};" for i, one in enumerate(routine.outputs))
        given = ", ".join(f"const {TYPES[code(one.dtype)]} a{i}" for i, one in enumerate(routine.inputs))
        how = "__forceinline__" if e.inline else "__noinline__"
        head = f"static __device__ {how} Of_{name} {name}({given}) {{"
        e.texts.append("\n".join([f"struct Of_{name} {{ {fields} }};", head, *inner.lines, f"  return {{{results}}};", "}"]))
    name, held = e.routines[routine], e.name("r")
    e.line(f"const Of_{name} {held} = {name}({', '.join(e.value(a) for a in node.args)});")
    for i in range(len(routine.outputs)):
        e.names[node.id, str(i)] = f"{held}.r{i}"


# -- tables and matrices


def gather(e: Emitter, node: Node) -> None:
    """Emit the lookup of a number of a table."""
    place = f"__ldg({e.table(node.attr)} + {e.value(node.args[0])})"
    e.names[node.id] = e.set(node.dtype, shared(place, node.dtype))


def matvec(e: Emitter, node: Node) -> None:
    """Emit a shared matrix times a vector per episode, by a function."""
    (matrix, there, tables), (p, q), room = node.attr, node.attr.nodes.shape, e.room(node)
    x, base = _together(e, node.args[:q]), node.args[q:]
    begin = constant(base[0].attr) if base[0].op == "const" and all(one is base[0] for one in base) else ""
    under = "" if begin else ", {}, {}".format(*_together(e, base))
    key = ("matvec", begin, p, q) if there is None else ("matvec", begin, "sparse")
    if key not in e.routines:
        e.routines[key] = name = f"matvec{len(e.routines)}"
        e.texts.append(_sparse_text(name, begin) if there is not None else _dense_text(name, begin, p, q))
    name, out = e.routines[key], e.pointer(room)
    if there is None:
        given = e.table(tuple(matrix.T.flat))
    else:
        given = f"{', '.join(e.table(part) for part in (list(matrix[there]), *tables))}, {p}"
    e.line(f"{name}({given}, {x[0]}, {x[1]}, (double*){out}{under});")
    e.names[node.id] = out


def _together(e: Emitter, nodes: Sequence[Node]) -> tuple[str, int]:
    """Return the address of numbers and their distance: their own place, or a copy."""
    first = nodes[0]
    if all(sweeps.is_pick(node) and node.args == first.args and node.attr == first.attr + i for i, node in enumerate(nodes)):
        return f"(const double*){element(e.value(first.args[0]), '0', FLOAT, first.attr)}", LANES
    name = e.name("x")
    e.line(f"double {name}[{len(nodes)}] = {{{', '.join(e.value(node) for node in nodes)}}};")
    return name, 1


def _dense_text(name: str, begin: str, p: int, q: int) -> str:
    given = "const u64* __restrict__ table, const double* x, int by, double* out" + ("" if begin else ", const double* base, int step")
    lines = [f"static __device__ __noinline__ void {name}({given}) {{"]
    for first in range(0, p, ROWS):
        rows = range(first, min(first + ROWS, p))
        lines.append("  {")
        lines += [f"    double t{i} = {begin or f'base[{i} * step]'};" for i in rows]
        lines.append(f"    for (int k = 0; k < {q}; k++) {{")
        lines.append(f"      const double f = x[k * by];\n      const u64* column = table + k * {p};")
        lines += [f"      t{i} = t{i} + __longlong_as_double((i64)__ldg(column + {i})) * f;" for i in rows]
        lines += ["    }", *(f"    out[{i * LANES}] = t{i};" for i in rows), "  }"]
    return "\n".join([*lines, "}"])


def _sparse_text(name: str, begin: str) -> str:
    """Return the text of a product row by row; `columns` and `last` are offsets in bytes of numbers."""
    tables = ", ".join(f"const u64* __restrict__ {one}" for one in ("table", "columns", "last"))
    given = f"{tables}, int rows, const double* x, int by, double* out" + ("" if begin else ", const double* base, int step")
    return f"""static __device__ __noinline__ void {name}({given}) {{
  i64 at = 0;
  for (int i = 0; i < rows; i++) {{
    double t = {begin or "base[i * step]"};
    for (const i64 end = (i64)__ldg(last + i) / 8; at < end; at++)
      t = t + __longlong_as_double((i64)__ldg(table + at)) * x[(i64)__ldg(columns + at) / 8 * by];
    out[i * {LANES}] = t;
  }}
}}"""


# -- buffers


@contextlib.contextmanager
def over(e: Emitter, shape: Sequence[int]) -> Iterator[list[str]]:
    """Emit a loop per axis; yield the index of each."""
    with contextlib.ExitStack() as loops:
        numbers = []
        for n in shape:
            numbers.append(e.name("k") if n > 1 else "0")
            if n > 1:
                loops.enter_context(e.within(f"for (int {numbers[-1]} = 0; {numbers[-1]} < {n}; {numbers[-1]}++)"))
        yield numbers


def _index(numbers: Sequence[str], strides: Sequence[int]) -> str:
    """Return the sum of indices times their strides."""
    parts = [f"{i} * {n}" if n != 1 else i for i, n in zip(numbers, strides, strict=True) if n and i != "0"]
    return " + ".join(parts) or "0"


def sweep(e: Emitter, node: Node) -> None:
    """Emit a sweep: its body in a loop per axis."""
    body: Sweep = node.attr
    room, outer = e.pointer(e.room(node)), dict(e.names)
    with over(e, body.shape) as numbers:
        _round(e, body, numbers, {})
        base = _index(numbers, steps((*body.shape, len(body.after)))[:-1])
        for i, result in enumerate(body.after):
            e.line(f"{saved(element(room, base, node.dtype, i), node.dtype)} = {e.value(result)};")
    e.names = outer
    e.names[node.id] = room


def _round(e: Emitter, body: Sweep, numbers: Sequence[str], made: dict[Any, str]) -> None:
    """Emit one round of a sweep, with the sweeps that are merged into it."""
    found: dict[int | tuple[int, str], str] = {}
    for one, source in zip(body.carried, body.sources, strict=True):
        index = _index(numbers, source.strides)
        if isinstance(source.held, tuple) or source.held.id not in e.merged:
            found[one.id] = e.set(one.dtype, _read(e, source, index, one))
            continue
        inner: Sweep = source.held.attr
        key = source.held.id, index, source.offset
        if key not in made:
            place = numbers if sweeps.alike(inner, body, source) else [f"({index} + {source.offset})"]
            _round(e, inner, place, made)
            made[key] = e.value(inner.after[0])
        found[one.id] = made[key]
    e.names.update(found)
    e.emit(rounds(body), {})


def _read(e: Emitter, source: Source, index: str, like: Node) -> str:
    """Return the number of a source."""
    if isinstance(source.held, Node):
        return load(element(e.value(source.held), index, like.dtype, source.offset), like.dtype)
    return shared(f"__ldg({e.table(source.held)} + {source.offset} + {index})", like.dtype)


def pack(e: Emitter, node: Node) -> None:
    """Emit pieces, one after the other."""
    room, at = e.pointer(e.room(node)), 0
    for source, shape in node.attr:
        if isinstance(source, Node):
            e.line(f"{saved(element(room, '0', node.dtype, at), node.dtype)} = {e.value(source)};")
            at += 1
            continue
        with over(e, shape) as numbers:
            held = _read(e, source, _index(numbers, source.strides), node)
            e.line(f"{saved(element(room, _index(numbers, steps(shape)), node.dtype, at), node.dtype)} = {held};")
        at += int(np.prod(shape))
    e.names[node.id] = room


def copy(e: Emitter, source: str, target: str, dtype: Type, count: int) -> None:
    """Emit a copy of `count` numbers from one address to another."""
    with over(e, [count]) as (i,):
        e.line(f"{saved(element(target, i, dtype), dtype)} = {load(element(source, i, dtype), dtype)};")


def invert(e: Emitter, node: Node) -> None:
    """Emit the inverses of matrices in a new buffer."""
    q, room = node.attr, e.pointer(e.room(node))
    copy(e, e.value(node.args[0]), room, node.dtype, node.size)
    if ("invert", q) not in e.routines:
        e.routines["invert", q] = f"invert_{q}"
        e.texts.append(_invert_text(q))
    with over(e, [node.size // (q * q)]) as (i,):
        e.line(f"invert_{q}((double*)({room} + {i} * {8 * LANES * q * q}));")
    e.names[node.id] = room


def _invert_text(q: int) -> str:
    """Return the text of the inverse, element by element as in `matrices.inverse`."""
    return f"""static __device__ __noinline__ void invert_{q}(double* a) {{
  for (int p = 0; p < {q}; p++) {{
    double* row = a + p * {LANES * q};
    const double scale = 1.0 / row[p * {LANES}];
    row[p * {LANES}] = 1.0;
    for (int j = 0; j < {q}; j++) row[j * {LANES}] = row[j * {LANES}] * scale;
    for (int i = 0; i < {q}; i++) if (i != p) {{
      double* other = a + i * {LANES * q};
      const double f = other[p * {LANES}];
      other[p * {LANES}] = 0.0;
      for (int j = 0; j < {q}; j++) other[j * {LANES}] = other[j * {LANES}] - f * row[j * {LANES}];
    }}
  }}
}}"""


EMITTED: dict[str, Callable[[Emitter, Node], None]] = {
    "loop": loop, "call": call, "gather": gather, "matvec": matvec, "sweep": sweep, "pack": pack, "invert": invert,
}  # fmt: skip
