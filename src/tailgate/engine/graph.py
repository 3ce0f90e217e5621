"""The graph of a computation: numbers of one episode, each computed once.

Two nodes of one operation on the same arguments are one node. Operations on constants are folded by the same numpy functions that define
every operation, so that a folded value has the bits of a computed one. No rewriting changes a bit, NaN's sign and payload apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tailgate.engine.operations import BOOL, COMMUTATIVE, COMPARISONS, FLOAT, INT, Array, apply, converted
from tailgate.engine.untraceable import Untraceable

MOST = 45_000  # operations of a graph: what has more takes long to compile, as straight code
_FREE = {"const", "uniform", "input", "carried", "pick"}  # which are none


class Node:
    """A number: an operation `op` on other nodes. `fixed`: it is the same for all episodes.

    A node with a `size` is a buffer of that many numbers. A `pick` is one of them.
    """

    __slots__ = ("args", "attr", "dtype", "fixed", "id", "op", "size")

    def __init__(self, id: int, op: str, dtype: np.dtype[Any], args: tuple[Node, ...], attr: Any, fixed: bool, size: int = 0) -> None:
        self.id, self.op, self.dtype, self.args, self.attr, self.fixed, self.size = id, op, dtype, args, attr, fixed, size

    def __repr__(self) -> str:
        args = ", ".join(f"%{a.id}" for a in self.args)
        return f"%{self.id} = {self.op} {self.dtype} ({args}){'' if self.attr is None else f' {self.attr}'}"


@dataclass(eq=False)
class Body:
    """A round of a loop: `nodes` are those that depend on what is carried. The first that are carried say who goes on."""

    carried: list[Node]
    after: list[Node]
    going: list[Node]
    most: int
    nodes: list[Node]


@dataclass(frozen=True)
class Source:
    """Where a number stands in each round of a sweep: in a buffer, or in a table of fixed nodes."""

    held: Node | tuple[Node, ...]
    offset: int
    strides: tuple[int, ...]


class Piece(NamedTuple):
    """Numbers of a source, by an index of a shape; or one number."""

    source: Source | Node
    shape: tuple[int, ...] = ()


@dataclass(eq=False)
class Sweep:
    """A body that is computed for each index of a shape: `carried` numbers, from their sources, become those of `after`, one by one."""

    shape: tuple[int, ...]
    carried: list[Node]
    sources: list[Source]
    after: list[Node]
    nodes: list[Node]


def dependent(roots: Sequence[Node], sources: Sequence[Node]) -> set[Node]:
    """The roots and what they need, as far as it depends on the sources; without these."""
    found = set(sources)
    for node in ordered(roots, min((node.id for node in sources), default=0)):
        if any(a in found for a in node.args):
            found.add(node)
    return found - set(sources)


class Matrix(NamedTuple):
    """A matrix (p, q) of fixed nodes, what of it counts, and of a sparse one the places of its numbers."""

    nodes: Any
    there: Array | None
    tables: list[list[Node]]


class Graph:
    """Nodes in an order in which each one follows its arguments."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.demands: list[tuple[str, str, str, Node]] = []  # what has to hold: field, what else is found, what is wanted
        self.operations = 0
        self.parameters: list[Array] = []  # by the first number of a uniform's name: see engine/parameters.py
        self.asked: tuple[dict[int, Node], dict[int, Node]] = {}, {}  # whose values code asked for, and if they are zero
        self.copies: dict[int, Array] = {}  # of buffers that hold fixed nodes: these
        self._known: dict[Any, Node] = {}
        self._values: dict[int, Any] = {}  # of fixed nodes
        self._picks: dict[int, Array] = {}  # of buffers

    # -- leaves

    def const(self, value: Any, dtype: np.dtype[Any]) -> Node:
        """A constant. Its sign counts, where it is zero."""
        held = value
        if not (isinstance(value, np.generic) and value.dtype == dtype):
            with np.errstate(all="ignore"):
                held = converted(np.asarray(value), dtype)[()]
        return self._node("const", dtype, (), held, held.tobytes(), True)

    def input(self, name: Any, dtype: np.dtype[Any]) -> Node:
        """A number that each episode brings."""
        return self._node("input", dtype, (), name, name, False)

    def uniform(self, name: Any, value: Any) -> Node:
        """A number that is the same for all episodes and may be another one the next time: the code does not hold its value."""
        node = self._node("uniform", np.asarray(value).dtype, (), name, name, True)
        self._values[node.id] = np.asarray(value)[()]
        return node

    def _node(self, op: str, dtype: np.dtype[Any], args: tuple[Node, ...], attr: Any, key: Any, fixed: bool, size: int = 0) -> Node:
        known = (op, dtype, key, *(a.id for a in args))
        node = self._known.get(known)
        if node is None:
            self.operations += op not in _FREE and not fixed
            if self.operations > MOST:
                raise Untraceable(f"more than {MOST:,} operations", "use num.until, num.take and matrix products of num for what is large")
            node = self._known[known] = Node(len(self.nodes), op, dtype, args, attr, fixed, size)
            self.nodes.append(node)
        return node

    def value(self, node: Node) -> Any:
        """The number that a fixed node is now."""
        if node.op == "const":
            return node.attr
        if node.id not in self._values:
            for part in ordered([node]):
                if part.id not in self._values:
                    self._values[part.id] = self.recomputed(part, self._values)
        return self._values[node.id]

    def recomputed(self, node: Node, values: dict[int, Any]) -> Any:
        """The number that a fixed node is where its arguments have these values."""
        if node.op == "pack":
            return [x for piece in node.attr for x in packed_values(self, piece, values)]
        return node.attr if node.op == "const" else computed(node, [values[a.id] for a in node.args])

    def ask(self, nodes: Sequence[Node], dtype: np.dtype[Any], nonzero: bool = False) -> Array:
        """The numbers of fixed nodes, or where they are not zero: code that asks depends on the answer."""
        out = np.empty(len(nodes), dtype)
        for i, node in enumerate(nodes):
            out[i] = self.value(node)
        self.asked[nonzero].update((node.id, node) for node in nodes if node.op != "const")
        return out != 0 if nonzero else out

    # -- operations: each takes nodes of the types that it asks for

    def binary(self, op: str, x: Node, y: Node) -> Node:
        """x op y of one type."""
        if x.dtype != y.dtype:
            raise TypeError(f"{op} of {x.dtype} and {y.dtype}")
        dtype = BOOL if op in COMPARISONS else x.dtype
        if same := _identity(op, x, y):
            return same
        if op in COMMUTATIVE and x.id > y.id:
            x, y = y, x
        return self._folded(op, dtype, (x, y))

    def unary(self, op: str, x: Node) -> Node:
        """op x."""
        if op == "not" and x.op == "not":
            return x.args[0]
        return self._folded(op, x.dtype, (x,))

    def select(self, where: Node, x: Node, y: Node) -> Node:
        """x where `where` holds, else y."""
        if x.dtype != y.dtype or where.dtype != BOOL:
            raise TypeError(f"a choice by {where.dtype} of {x.dtype} and {y.dtype}")
        if where.op == "const":
            return x if where.attr else y
        if x is y:
            return x
        if where.op == "not":
            where, x, y = where.args[0], y, x
        if x.dtype == BOOL and x.op == y.op == "const":
            return where if x.attr else self.unary("not", where)
        return self._folded("select", x.dtype, (where, x, y))

    def cast(self, x: Node, dtype: np.dtype[Any]) -> Node:
        """x as another type."""
        return x if x.dtype == dtype else self._folded("cast", dtype, (x,))

    def bits(self, x: Node, dtype: np.dtype[Any]) -> Node:
        """The bits of x as those of another type of the same size."""
        if x.dtype.itemsize != dtype.itemsize or BOOL in (x.dtype, dtype):
            raise TypeError(f"bits of {x.dtype} as {dtype}")
        if x.dtype == dtype:
            return x
        return x.args[0] if x.op == "bits" and x.args[0].dtype == dtype else self._folded("bits", dtype, (x,))

    # -- routines

    def call(self, routine: Any, args: Sequence[Node]) -> Node:
        """A call of a routine (engine/routines.py), whose results are picked."""
        return self._node("call", BOOL, tuple(args), routine, id(routine), all(a.fixed for a in args))

    def pick(self, node: Node, number: int, dtype: np.dtype[Any]) -> Node:
        """One of several results."""
        return self._node("pick", dtype, (node,), number, number, node.fixed)

    # -- tables

    def gather(self, table: Sequence[Node], index: Node) -> Node:
        """table[index] of fixed nodes of one type; an index beyond its ends takes the number there."""
        last = self.const(len(table) - 1, INT)
        within = self.binary("min", self.binary("max", self.cast(index, INT), self.const(0, INT)), last)
        return self._node("gather", table[0].dtype, (within,), tuple(table), tuple(node.id for node in table), False)

    # -- matrices

    def matvec(self, matrix: Array, x: Sequence[Node], base: Sequence[Node], there: Array | None = None) -> list[Node]:
        """base + matrix x, of a matrix (p, q) of fixed nodes: sums begin with the base and run over q in ascending order.

        What is not `there` (p, q) bool counts for nothing.
        """
        key = tuple(node.id for node in matrix.flat), None if there is None else there.tobytes()
        tables: list[list[Node]] = []
        if there is not None:  # bytes to the column of each number, and to the end of each row
            tables = [[self.const(8 * k, INT) for k in part] for part in (np.nonzero(there)[1], np.cumsum(there.sum(axis=1)))]
        return list(self.picks(self._node("matvec", FLOAT, (*x, *base), Matrix(matrix, there, tables), key, False, len(base))))

    # -- buffers

    def picks(self, buffer: Node) -> Array:
        """The numbers of a buffer, by their places."""
        if buffer.id not in self._picks:
            out = np.empty(buffer.size, object)
            for i in range(buffer.size):
                out[i] = node = Node(len(self.nodes), "pick", buffer.dtype, (buffer,), i, buffer.fixed)
                self.nodes.append(node)
            self._picks[buffer.id] = out
        return self._picks[buffer.id]

    def held(self, name: Any, size: int, dtype: np.dtype[Any]) -> Node:
        """A buffer that each episode brings."""
        return self._node("held", dtype, (), name, name, False, size)

    def packed(self, pieces: tuple[Piece, ...], dtype: np.dtype[Any]) -> Node:
        """A buffer of these, one behind the other."""
        args = [source if isinstance(source, Node) else source.held for source, _ in pieces]
        size = sum(int(np.prod(shape, dtype=int)) for _, shape in pieces)
        nodes = tuple({a.id: a for a in args if isinstance(a, Node)}.values())
        return self._node("pack", dtype, nodes, pieces, pieces, all(a.fixed for a in nodes), size)

    def blend(self, where: Node, x: Node, y: Node) -> Node:
        """The buffer x where `where` holds, else the buffer y."""
        if where.op == "const" or x is y:
            return x if x is y or where.attr else y
        return self._node("blend", x.dtype, (where, x, y), None, None, False, x.size)

    def inverses(self, matrices: Node, q: int) -> Node:
        """The inverses of symmetric positive definite matrices (., q, q)."""
        return self._node("invert", FLOAT, (matrices,), q, q, matrices.fixed, matrices.size)

    def sweep(self, shape: tuple[int, ...], carried: list[Node], sources: list[Source], after: list[Node]) -> Node:
        """A buffer (*shape, len(after)) of what the carried numbers become in each round."""
        inside = dependent(after, carried)
        used = {a.id for node in inside for a in node.args} | {node.id for node in after}
        kept = [(one, source) for one, source in zip(carried, sources, strict=True) if one.id in used]
        outer = {a.id: a for node in inside for a in node.args} | {node.id: node for node in after}
        mine = {node.id for node in (*inside, *carried)}
        captured = [node for i, node in outer.items() if i not in mine and not node.fixed]
        buffers = {s.held.id: s.held for _, s in kept if isinstance(s.held, Node)}
        body = Sweep(shape, [one for one, _ in kept], [s for _, s in kept], after, sorted(inside, key=lambda node: node.id))
        size = len(after) * int(np.prod(shape, dtype=int))
        return self._node("sweep", after[0].dtype, (*buffers.values(), *captured), body, len(self.nodes), False, size)

    # -- loops

    def carried(self, begin: Array) -> Array:
        """What a loop carries from round to round, of the types of what it begins with."""
        out = np.empty(begin.shape, object)
        for i, node in enumerate(begin.flat):
            out.flat[i] = self._node("carried", node.dtype, (), None, len(self.nodes), False)
        return out

    def loop(self, begin: list[Node], carried: list[Node], after: list[Node], going: list[Node], most: int) -> list[Node]:
        """What `carried` nodes are at last, of those that they become `after` a round, while any of `going` holds."""
        inside = dependent(after, carried)
        mine = {*inside, *carried}
        captured = {a.id: a for node in inside for a in node.args if a not in mine and not a.fixed}
        outer = [node for node in after if node not in mine and not node.fixed]
        args = (*begin, *(captured | {node.id: node for node in outer}).values())
        body = Body(carried, after, going, most, sorted(inside, key=lambda node: node.id))
        node = self._node("loop", BOOL, args, body, len(self.nodes), False)
        return [self.pick(node, i, one.dtype) for i, one in enumerate(begin)]

    def _folded(self, op: str, dtype: np.dtype[Any], args: tuple[Node, ...]) -> Node:
        if all(a.op == "const" for a in args):
            with np.errstate(all="ignore"):
                return self.const(apply(op, dtype, [a.attr for a in args]), dtype)
        return self._node(op, dtype, args, None, None, all(a.fixed for a in args))


def _is(node: Node, value: float) -> bool:
    """Is the node this constant? Zeros count by their sign."""
    return node.op == "const" and node.attr == value and bool(np.signbit(node.attr)) == (str(value)[0] == "-")


def _identity(op: str, x: Node, y: Node) -> Node | None:
    """What x op y is without a computation, to the bit."""
    kind = x.dtype.kind
    if kind == "f":
        if (op in ("mul", "div") and _is(y, 1.0)) or (op == "sub" and _is(y, 0.0)) or (op == "add" and _is(y, -0.0)):
            return x
        return y if (op == "mul" and _is(x, 1.0)) or (op == "add" and _is(x, -0.0)) else None
    if kind == "b" and op in ("and", "or"):
        for this, other in ((x, y), (y, x)):
            if this.op == "const":
                return other if bool(this.attr) == (op == "and") else this
    elif kind in "iu" and op in ("add", "or", "xor", "shl", "shr"):
        if y.op == "const" and y.attr == 0:
            return x
        if x.op == "const" and x.attr == 0 and op in ("add", "or", "xor"):
            return y
    return x if x is y and op in ("and", "or", "min", "max") else None


def computed(node: Node, args: Sequence[Any]) -> Any:
    """The value of a node whose arguments have these."""
    if node.op == "call":
        return node.attr.values(list(args))
    if node.op == "pick":
        return args[0][node.attr]
    if node.op in ("matvec", "sweep", "pack"):
        raise AssertionError("this operation needs its graph: use evaluate()")
    if node.op == "invert":
        return _inverted(args[0], node.attr)
    if node.op == "blend":
        return [np.where(args[0], x, y) for x, y in zip(args[1], args[2], strict=True)]
    with np.errstate(all="ignore"):
        return np.asarray(apply(node.op, node.dtype, args))[()]


def ordered(roots: Iterable[Node], first: int = 0) -> list[Node]:
    """The roots and all that they need, from the node `first` on, arguments first."""
    seen: dict[int, Node] = {}
    left = list(roots)
    while left:
        node = left.pop()
        if node.id >= first and node.id not in seen:
            seen[node.id] = node
            left.extend(node.args)
    return [seen[i] for i in sorted(seen)]


def packed_values(graph: Graph, piece: Piece, values: dict[int, Any]) -> list[Any]:
    source, shape = piece
    if isinstance(source, Node):
        return [values[source.id] if source.id in values else graph.value(source)]
    return [read(graph, source, index, values) for index in np.ndindex(*shape)]


def read(graph: Graph, source: Source, index: Sequence[int], values: dict[int, Any]) -> Any:
    place = source.offset + sum(i * n for i, n in zip(index, source.strides, strict=True))
    node = source.held[place] if isinstance(source.held, tuple) else source.held
    found = values[node.id] if node.id in values else graph.value(node)
    return found[place] if node is source.held else found


def _inverted(numbers: Sequence[Any], q: int) -> list[Any]:
    from tailgate.engine.matrices import inverse

    stack = np.stack(numbers, axis=-1)
    return list(np.moveaxis(inverse(stack.reshape(*stack.shape[:-1], -1, q, q)).reshape(stack.shape), -1, 0))
