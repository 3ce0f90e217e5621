"""The graph of a computation: the numbers of one episode, each computed once.

Equal operations on equal arguments are one node. The numpy functions that define the operations also fold constants.
A folded value therefore has the bits of a computed one. No rewriting changes a bit, except the sign and payload of NaN.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tailgate.engine.folding import identity, is_choice
from tailgate.engine.operations import BOOL, COMMUTATIVE, COMPARISONS, FLOAT, INT, Array, ArrayLike, apply, converted
from tailgate.engine.untraceable import Untraceable

if TYPE_CHECKING:
    from tailgate.engine.routines import Routine

MOST = 45_000  # operations of a graph; larger ones take long to compile as straight code
_FREE = {"const", "uniform", "input", "carried", "pick"}  # nodes that are no operations


class Node:
    """A number: an operation `op` on other nodes; `fixed` if it is the same for all episodes.

    A node with a `size` is a buffer of that many numbers, and a `pick` is one of them.
    """

    __slots__ = ("args", "attr", "dtype", "fixed", "id", "op", "size")

    def __init__(self, id: int, op: str, dtype: np.dtype[Any], args: tuple[Node, ...], attr: Any, fixed: bool, size: int = 0) -> None:
        self.id, self.op, self.dtype, self.args, self.attr, self.fixed, self.size = id, op, dtype, args, attr, fixed, size

    def __repr__(self) -> str:
        args = ", ".join(f"%{a.id}" for a in self.args)
        return f"%{self.id} = {self.op} {self.dtype} ({args}){'' if self.attr is None else f' {self.attr}'}"


@dataclass(eq=False)
class Body:
    """One round of a loop: `nodes` depend on the carried numbers, of which the first `going` decide who continues."""

    carried: list[Node]
    after: list[Node]
    going: list[Node]
    most: int
    nodes: list[Node]


@dataclass(frozen=True)
class Source:
    """The place of a number in each round of a sweep: in a buffer, or in a table of fixed nodes."""

    held: Node | tuple[Node, ...]
    offset: int
    strides: tuple[int, ...]


class Piece(NamedTuple):
    """The numbers of a source for all indices of a shape, or one number."""

    source: Source | Node
    shape: tuple[int, ...] = ()


@dataclass(eq=False)
class Sweep:
    """A body computed for each index of a shape: it maps `carried` numbers, read from their sources, to `after`."""

    shape: tuple[int, ...]
    carried: list[Node]
    sources: list[Source]
    after: list[Node]
    nodes: list[Node]


def dependent(roots: Sequence[Node], sources: Sequence[Node]) -> set[Node]:
    """Return the roots and their arguments that depend on the sources, without the sources."""
    found = set(sources)
    for node in ordered(roots, min((node.id for node in sources), default=0)):
        if any(a in found for a in node.args):
            found.add(node)
    return found - set(sources)


class Matrix(NamedTuple):
    """A matrix (p, q) of fixed nodes, a mask of its structural nonzeros, and tables of their places if it is sparse."""

    nodes: Array
    there: Array | None
    tables: list[list[Node]]


class Graph:
    """Nodes in an order in which each follows its arguments."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.demands: list[tuple[str, str, str, Node]] = []  # field, finding, expectation, and the condition that must hold
        self.operations = 0
        self.parameters: list[Array] = []  # indexed by the first number of a uniform's name, see engine/parameters.py
        self.asked: tuple[dict[int, Node], dict[int, Node]] = {}, {}  # nodes read, and nodes compared with zero
        self.copies: dict[int, Array] = {}  # the nodes of buffers that hold fixed nodes
        self._known: dict[Any, Node] = {}
        self._values: dict[int, Any] = {}  # of fixed nodes
        self._picks: dict[int, Array] = {}  # of buffers

    # -- leaves

    def const(self, value: ArrayLike, dtype: np.dtype[Any]) -> Node:
        """Return a constant; 0.0 and -0.0 differ."""
        held: Any = value
        if not (isinstance(value, np.generic) and value.dtype == dtype):
            with np.errstate(all="ignore"):
                held = converted(np.asarray(value), dtype)[()]
        return self._node("const", dtype, (), held, held.tobytes(), True)

    def input(self, name: Hashable, dtype: np.dtype[Any]) -> Node:
        """Return a number that differs between episodes."""
        return self._node("input", dtype, (), name, name, False)

    def uniform(self, name: Hashable, value: ArrayLike) -> Node:
        """Return a number that all episodes share and that may change between calls: the code does not contain its value."""
        held = value if isinstance(value, np.generic) else np.asarray(value)[()]
        node = self._node("uniform", held.dtype, (), name, name, True)
        self._values[node.id] = held
        return node

    def _node(self, op: str, dtype: np.dtype[Any], args: tuple[Node, ...], attr: object, key: Hashable, fixed: bool, size: int = 0) -> Node:
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
        """Return the present number of a fixed node."""
        if node.op == "const":
            return node.attr
        if node.id not in self._values:
            for part in ordered([node]):
                if part.id not in self._values:
                    self._values[part.id] = self.recomputed(part, self._values)
        return self._values[node.id]

    def recomputed(self, node: Node, values: dict[int, Any]) -> Any:
        """Return the number of a fixed node for these values of its arguments."""
        if node.op == "pack":
            return [x for piece in node.attr for x in packed_values(self, piece, values)]
        return node.attr if node.op == "const" else computed(node, [values[a.id] for a in node.args])

    def ask(self, nodes: Sequence[Node], dtype: np.dtype[Any], nonzero: bool = False) -> Array:
        """Return the numbers of fixed nodes, or whether they are nonzero, and record that the code depends on the answer."""
        out = np.empty(len(nodes), dtype)
        for i, node in enumerate(nodes):
            out[i] = self.value(node)
        self.asked[nonzero].update((node.id, node) for node in nodes if node.op != "const")
        return out != 0 if nonzero else out

    # -- operations on nodes of matching types

    def binary(self, op: str, x: Node, y: Node) -> Node:
        """Return x op y, both of one type."""
        if x.dtype != y.dtype:
            raise TypeError(f"{op} of {x.dtype} and {y.dtype}")
        dtype = BOOL if op in COMPARISONS else x.dtype
        if same := identity(op, x, y):
            return same
        if is_choice(x) and y.op == "const":
            return self.select(x.args[0], *(self.binary(op, one, y) for one in x.args[1:]))
        if is_choice(y) and x.op == "const":
            return self.select(y.args[0], *(self.binary(op, x, one) for one in y.args[1:]))
        if op in COMMUTATIVE and x.id > y.id:
            x, y = y, x
        return self._folded(op, dtype, (x, y))

    def unary(self, op: str, x: Node) -> Node:
        """Return op x."""
        if op == "not" and x.op == "not":
            return x.args[0]
        return self._folded(op, x.dtype, (x,))

    def select(self, where: Node, x: Node, y: Node) -> Node:
        """Return x where `where` is true, else y."""
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
        """Convert x to another type."""
        if is_choice(x) and x.dtype != dtype:
            return self.select(x.args[0], *(self.cast(one, dtype) for one in x.args[1:]))
        return x if x.dtype == dtype else self._folded("cast", dtype, (x,))

    def bits(self, x: Node, dtype: np.dtype[Any]) -> Node:
        """Reinterpret the bits of x as another type of the same size."""
        if x.dtype.itemsize != dtype.itemsize or BOOL in (x.dtype, dtype):
            raise TypeError(f"bits of {x.dtype} as {dtype}")
        if x.dtype == dtype:
            return x
        return x.args[0] if x.op == "bits" and x.args[0].dtype == dtype else self._folded("bits", dtype, (x,))

    # -- routines

    def call(self, routine: Routine, args: Sequence[Node]) -> Node:
        """Return a call of a routine (engine/routines.py); `pick` selects its results."""
        return self._node("call", BOOL, tuple(args), routine, id(routine), all(a.fixed for a in args))

    def pick(self, node: Node, number: int, dtype: np.dtype[Any]) -> Node:
        """Return one of several results."""
        return self._node("pick", dtype, (node,), number, number, node.fixed)

    # -- tables

    def gather(self, table: Sequence[Node], index: Node) -> Node:
        """Return table[index] of fixed nodes of one type; the index is limited to the table."""
        last = self.const(len(table) - 1, INT)
        within = self.binary("min", self.binary("max", self.cast(index, INT), self.const(0, INT)), last)
        if is_choice(within):
            return self.select(within.args[0], *(self.gather(table, one) for one in within.args[1:]))
        found = tuple(table), tuple(node.id for node in table)
        return table[int(within.attr)] if within.op == "const" else self._node("gather", table[0].dtype, (within,), *found, False)

    # -- matrices

    def matvec(self, matrix: Array, x: Sequence[Node], base: Sequence[Node], there: Array | None = None) -> list[Node]:
        """Return base + matrix x for a matrix (p, q) of fixed nodes.

        Sums begin with the base and run over q in ascending order; entries that are not in `there` (p, q) bool are skipped.
        """
        key = tuple(node.id for node in matrix.flat), None if there is None else there.tobytes()
        tables: list[list[Node]] = []
        if there is not None:  # offsets [bytes] of each number's column and of each row's end
            tables = [[self.const(8 * k, INT) for k in part] for part in (np.nonzero(there)[1], np.cumsum(there.sum(axis=1)))]
        return list(self.picks(self._node("matvec", FLOAT, (*x, *base), Matrix(matrix, there, tables), key, False, len(base))))

    # -- buffers

    def picks(self, buffer: Node) -> Array:
        """Return the numbers of a buffer, by place."""
        if buffer.id not in self._picks:
            first, args = len(self.nodes), (buffer,)
            nodes = [Node(first + i, "pick", buffer.dtype, args, i, buffer.fixed) for i in range(buffer.size)]
            self.nodes += nodes
            self._picks[buffer.id] = out = np.empty(buffer.size, object)
            out[:] = nodes
        return self._picks[buffer.id]

    def held(self, name: Hashable, size: int, dtype: np.dtype[Any]) -> Node:
        """Return a buffer that differs between episodes."""
        return self._node("held", dtype, (), name, name, False, size)

    def packed(self, pieces: tuple[Piece, ...], dtype: np.dtype[Any]) -> Node:
        """Return a buffer of these pieces, one after the other."""
        args = [source if isinstance(source, Node) else source.held for source, _ in pieces]
        size = sum(int(np.prod(shape, dtype=int)) for _, shape in pieces)
        nodes = tuple({a.id: a for a in args if isinstance(a, Node)}.values())
        return self._node("pack", dtype, nodes, pieces, pieces, all(a.fixed for a in nodes), size)

    def blend(self, where: Node, x: Node, y: Node) -> Node:
        """Return the buffer x where `where` is true, else the buffer y."""
        if where.op == "const" or x is y:
            return x if x is y or where.attr else y
        return self._node("blend", x.dtype, (where, x, y), None, None, False, x.size)

    def inverses(self, matrices: Node, q: int) -> Node:
        """Return the inverses of symmetric positive definite matrices (., q, q)."""
        return self._node("invert", FLOAT, (matrices,), q, q, matrices.fixed, matrices.size)

    def sweep(self, shape: tuple[int, ...], carried: list[Node], sources: list[Source], after: list[Node]) -> Node:
        """Return a buffer (*shape, len(after)) of what each round makes of the carried numbers."""
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
        """Return the numbers that a loop carries from round to round, with the types of the initial numbers."""
        out = np.empty(begin.shape, object)
        for i, node in enumerate(begin.flat):
            out.flat[i] = self._node("carried", node.dtype, (), None, len(self.nodes), False)
        return out

    def loop(self, begin: list[Node], carried: list[Node], after: list[Node], going: list[Node], most: int) -> list[Node]:
        """Return the final `carried` nodes of a loop that replaces them by `after` in each round, while any of `going` is true."""
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


def computed(node: Node, args: Sequence[Any]) -> Any:
    """Return the value of a node for these values of its arguments."""
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
    """Return the roots and all that they need, from node number `first` on, arguments first."""
    seen: dict[int, Node] = {}
    left = list(roots)
    while left:
        node = left.pop()
        if node.id >= first and node.id not in seen:
            seen[node.id] = node
            left.extend(node.args)
    return [seen[i] for i in sorted(seen)]


def packed_values(graph: Graph, piece: Piece, values: dict[int, Any]) -> list[Any]:
    """Return the numbers of a piece of a buffer."""
    source, shape = piece
    if isinstance(source, Node):
        return [values[source.id] if source.id in values else graph.value(source)]
    return [read(graph, source, index, values) for index in np.ndindex(*shape)]


def read(graph: Graph, source: Source, index: Sequence[int], values: dict[int, Any]) -> Any:
    """Return the number of a source at an index."""
    place = source.offset + sum(i * n for i, n in zip(index, source.strides, strict=True))
    node = source.held[place] if isinstance(source.held, tuple) else source.held
    found = values[node.id] if node.id in values else graph.value(node)
    return found[place] if node is source.held else found


def _inverted(numbers: Sequence[Any], q: int) -> list[Any]:
    from tailgate.engine.matrices import inverse

    stack = np.stack(numbers, axis=-1)
    return list(np.moveaxis(inverse(stack.reshape(*stack.shape[:-1], -1, q, q)).reshape(stack.shape), -1, 0))
