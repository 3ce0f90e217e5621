"""Derivatives of a trace by machine code: steps forwards, then the same steps backwards with the slopes of a figure.

The graph of a step is differentiated node by node (reverse accumulation, Griewank and Walther 2008). The way forth keeps what the way back
needs. These are the numbers of the state that an argument reaches, and those that none reaches, such as gates and gains.
Comparisons, roundings and conversions to whole numbers have derivative 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from tailgate.engine.buffers import is_pick
from tailgate.engine.graph import Graph, Node, Piece, Source, Sweep, ordered
from tailgate.engine.operations import COMPARISONS, FLOAT, Array
from tailgate.engine.program import Call, Program
from tailgate.engine.tracing import Trace
from tailgate.engine.untraceable import Untraceable

LONGEST = 30_000  # operations of a step, at most: the largest loop within it takes 25 s to compile
FLAT = {"floor", "ceil", "trunc", "rint", "not", "bits", *COMPARISONS}  # operations with derivative 0
Rule = Callable[[Graph, Node, Node], list[Node]]  # from a node and the slope of a figure by it, the slopes by its arguments


def moving(nodes: Sequence[Node], arguments: Sequence[Node], pairs: Sequence[tuple[Node, Node]]) -> set[int]:
    """Return the numbers of the nodes that the arguments reach on a way with derivatives, in this step or in a later one.

    pairs: the nodes of the state, now and next.
    """
    found, before = {node.id for node in arguments}, -1
    while len(found) > before:
        before = len(found)
        for node in nodes:
            through = node.op in ("call", "loop") or (node.dtype == FLOAT and node.op not in FLAT)
            if through and any(a.id in found for a in node.args):
                found.add(node.id)
        found |= {now.id for now, new in pairs if new.id in found}
    return found


class Straight:
    """The numbers that an argument reaches, computed one by one from given numbers: sweeps are unrolled, and only matrices are kept."""

    def __init__(self, graph: Graph, reached: set[int], roots: Sequence[Node]) -> None:
        """Raise Untraceable for operations that have no straight form."""
        self.graph, self._made, self._buffers = graph, dict[int, Node](), dict[int, list[Node]]()
        self.given: dict[Node, Node] = {}  # numbers of the trace, and the inputs that have them
        before = graph.operations
        for node in ordered(roots):
            if node.id not in reached:
                continue
            if node.op == "input":
                self._made[node.id] = self.given[node] = node
            elif node.op == "held":
                self._buffers[node.id] = [self._given(one) for one in graph.picks(node)]
            elif node.size:
                self._buffers[node.id] = self._buffer(node)
            else:
                self._made[node.id] = self._rebuilt(node, [self.number(a) for a in node.args if not a.size])
            if graph.operations - before > LONGEST:
                raise Untraceable(f"a derivative of more than {LONGEST:,} operations", "use PyTorch")

    def number(self, node: Node) -> Node:
        """Return what has the number of a node of the trace."""
        if node.fixed:
            return node
        if node.id in self._made:
            return self._made[node.id]
        if is_pick(node) and node.args[0].id in self._buffers:
            return self._buffers[node.args[0].id][int(node.attr)]
        return self._given(node)

    def _given(self, node: Node) -> Node:
        """Return the input that has a number of the trace."""
        if node not in self.given:
            self.given[node] = self.graph.input(("given", node.id), node.dtype)
        return self.given[node]

    def _rebuilt(self, node: Node, args: list[Node]) -> Node:
        """Return the operation of a node on other arguments."""
        if is_pick(node):
            return self.number(node)
        _check(node)
        return _again(self.graph, node, args)

    def _buffer(self, node: Node) -> list[Node]:
        """Return the numbers of a buffer."""
        if node.op == "matvec":
            return _multiplied(self.graph, node, [self.number(a) for a in node.args])
        if node.op == "pack":
            return [one for piece in node.attr for one in self._piece(piece)]
        if node.op == "blend":
            where, *sides = node.args
            chosen = self.number(where)
            return [self.graph.select(chosen, *map(self.number, pair)) for pair in zip(*map(self.graph.picks, sides), strict=True)]
        if node.op == "sweep":
            return [one for place in np.ndindex(*node.attr.shape) for one in self._round(node.attr, place)]
        raise Untraceable(f"a derivative of {node.op}", "use operations on numbers, or PyTorch")

    def _piece(self, piece: Piece) -> list[Node]:
        if isinstance(piece.source, Node):
            return [self.number(piece.source)]
        return [self._element(piece.source, place) for place in np.ndindex(*piece.shape)]

    def _element(self, source: Source, place: Sequence[int]) -> Node:
        at = source.offset + sum(i * n for i, n in zip(place, source.strides, strict=True))
        return self.number(source.held[at] if isinstance(source.held, tuple) else self.graph.picks(source.held)[at])

    def _round(self, body: Sweep, place: tuple[int, ...]) -> list[Node]:
        """Return the results of one round of a sweep."""
        mine = {one.id: self._element(source, place) for one, source in zip(body.carried, body.sources, strict=True)}
        products: dict[int, list[Node]] = {}

        def found(node: Node) -> Node:
            return mine[node.id] if node.id in mine else self.number(node)

        for node in body.nodes:
            if node.op == "matvec":
                products[node.id] = _multiplied(self.graph, node, [found(a) for a in node.args])
                continue
            if is_pick(node) and node.args[0].id in products:
                mine[node.id] = products[node.args[0].id][int(node.attr)]
                continue
            if node.size or is_pick(node) or node.op in ("loop", "call", "gather"):
                raise Untraceable(f"a derivative of {node.op} in a sweep", "use operations on numbers, or PyTorch")
            mine[node.id] = _again(self.graph, node, [found(a) for a in node.args])
        return [found(node) for node in body.after]


def _again(graph: Graph, node: Node, args: list[Node]) -> Node:
    """Return an operation on other arguments."""
    if node.op == "select":
        return graph.select(args[0], args[1], args[2])
    if node.op == "cast":
        return graph.cast(args[0], node.dtype)
    if node.op == "bits":
        return graph.bits(args[0], node.dtype)
    return graph.unary(node.op, args[0]) if len(args) == 1 else graph.binary(node.op, args[0], args[1])


def _multiplied(graph: Graph, node: Node, args: list[Node]) -> list[Node]:
    """Return the product of a matrix with other arguments, number by number."""
    matrix, there, _ = node.attr
    return graph.matvec(matrix, args[: matrix.shape[1]], args[matrix.shape[1] :], there)


def _check(node: Node) -> None:
    if node.op not in _RULES:
        raise Untraceable(f"a derivative of {node.op}", "use operations on numbers, or PyTorch")


def backwards(graph: Graph, reached: set[int], seeds: Sequence[tuple[Node, Node]], wanted: Sequence[Node]) -> list[Node]:
    """Return the slopes of a figure by the wanted nodes, from its slopes by others.

    Parameters
    ----------
    reached
        Numbers of the nodes to differentiate, see `moving`.
    seeds
        Nodes, each with the slope of the figure by it.

    Raises
    ------
    Untraceable
        For an operation without a rule.
    """
    slopes: dict[int, Node] = {}
    parts: dict[int, dict[int, Node]] = {}  # of buffers, by place
    nothing = graph.const(0.0, FLOAT)

    def gather(node: Node, slope: Node) -> None:
        if node.id in reached and slope is not nothing:
            held = slopes.get(node.id)
            slopes[node.id] = slope if held is None else graph.binary("add", held, slope)

    for node, slope in seeds:
        gather(node, slope)
    for node in reversed(ordered(node for node, _ in seeds)):
        if node.op == "pick" and node.id in slopes:
            parts.setdefault(node.args[0].id, {})[node.attr] = slopes[node.id]
        elif node.op == "matvec" and node.id in parts:
            matrix, there, _ = node.attr
            of_rows = [parts[node.id].get(i, nothing) for i in range(len(matrix))]
            of_columns = graph.matvec(matrix.T, of_rows, [nothing] * matrix.shape[1], None if there is None else there.T)
            for argument, slope in zip(node.args, (*of_columns, *of_rows), strict=True):
                gather(argument, slope)
        elif node.args and node.id in slopes:
            _check(node)
            for argument, slope in zip(node.args, _RULES[node.op](graph, node, slopes[node.id]), strict=True):
                gather(argument, slope)
    return [slopes.get(node.id, nothing) for node in wanted]


def _choice(graph: Graph, first: Node, slope: Node) -> list[Node]:
    """Return the slopes by two arguments of which one is chosen."""
    nothing = graph.const(0.0, FLOAT)
    return [graph.select(first, slope, nothing), graph.select(first, nothing, slope)]


def _select(graph: Graph, node: Node, slope: Node) -> list[Node]:
    return [slope, *_choice(graph, node.args[0], slope)]  # the first is of a mask, and counts for nothing


def _extreme(graph: Graph, node: Node, slope: Node) -> list[Node]:
    x, y = node.args
    first = graph.binary("or", graph.binary("lt" if node.op == "min" else "gt", x, y), graph.binary("ne", x, x))
    return _choice(graph, first, slope)


def _product(graph: Graph, node: Node, slope: Node) -> list[Node]:
    x, y = node.args
    return [graph.binary("mul", slope, y), graph.binary("mul", slope, x)]


def _quotient(graph: Graph, node: Node, slope: Node) -> list[Node]:
    """Where the divisor is 0 the slopes are 0, because such a quotient is never selected."""
    y, nothing = node.args[1], graph.const(0.0, FLOAT)
    zero = graph.binary("eq", y, nothing)
    by_x = graph.binary("div", slope, y)
    by_y = graph.unary("neg", graph.binary("mul", slope, graph.binary("div", node, y)))
    return [graph.select(zero, nothing, by_x), graph.select(zero, nothing, by_y)]


def _root(graph: Graph, node: Node, slope: Node) -> list[Node]:
    nothing = graph.const(0.0, FLOAT)
    half = graph.binary("div", graph.const(0.5, FLOAT), node)
    return [graph.binary("mul", slope, graph.select(graph.binary("eq", node, nothing), nothing, half))]


def _size(graph: Graph, node: Node, slope: Node) -> list[Node]:
    (x,), nothing = node.args, graph.const(0.0, FLOAT)
    falls = graph.select(graph.binary("lt", x, nothing), graph.unary("neg", slope), nothing)
    return [graph.select(graph.binary("gt", x, nothing), slope, falls)]


_RULES: dict[str, Rule] = {
    "add": lambda graph, node, slope: [slope, slope], "sub": lambda graph, node, slope: [slope, graph.unary("neg", slope)],
    "neg": lambda graph, node, slope: [graph.unary("neg", slope)], "mul": _product, "div": _quotient, "min": _extreme, "max": _extreme,
    "abs": _size, "sqrt": _root, "select": _select,
}  # fmt: skip


class Adjoint:
    """The machine code of a trace forwards, and of its derivatives backwards.

    numbers: how many of each step the way forth keeps and the way back takes, together.
    """

    def __init__(self, trace: Trace, results: Sequence[str], figures: Sequence[str]) -> None:
        """Compile both ways.

        Parameters
        ----------
        trace
            Of a function that maps a state and arguments to the next state and results.
        results
            Names of the results that are kept, one number of an episode each.
        figures
            Those of them that have slopes.

        Raises
        ------
        Untraceable
            For an operation without a rule, and for a step that is too large.
        """
        trace, graph = trace.pruned({name: trace.results[name] for name in results}), trace.graph
        asked = {name: nodes.item() for name, nodes in trace.results.items()}
        pairs = [pair for name in trace.state for pair in trace.pairs(name)]
        given = [node for nodes in trace.arguments.values() for node in nodes.flat]
        numbers = [_each(graph, *pair) for pair in pairs]
        reached = moving(ordered([*asked.values(), *(new for several in numbers for _, new in several)]), given, pairs)
        state = [one for (now, _), several in zip(pairs, numbers, strict=True) if now.id in reached for one in several]
        ends = [asked[name] for name in figures if asked[name].id in reached] + [new for _, new in state if new.id in reached]
        straight = Straight(graph, reached, ends)
        before = [(straight.number(now), straight.number(new), graph.input(("slope", now.id), FLOAT)) for now, new in state]
        seeds = {name: graph.input(("slope", name), FLOAT) for name in figures if asked[name].id in reached}
        begun = [*((straight.number(asked[name]), slope) for name, slope in seeds.items()), *((new, slope) for _, new, slope in before)]
        wanted = [*(now for now, *_ in before), *given]
        made = backwards(graph, moving(ordered(node for node, _ in begun), wanted, []), begun, wanted)
        needed, own = {node.id for node in ordered(made)}, {node.id for node in given}
        kept = [(node, place) for node, place in straight.given.items() if place.id in needed and place.id not in own]
        self.results, self._size, kinds = tuple(results), len(before), sorted({node.dtype for node, _ in kept}, key=str)
        self.numbers = 2 * (len(kept) + len(seeds))
        saved, taken = ({f"kept {kind}": _row(pair[i] for pair in kept if pair[0].dtype == kind) for kind in kinds} for i in (0, 1))
        self._forwards = Program(trace.pruned(trace.results | saved))
        parts, out = iter(made[len(before) :]), {}
        for name, held in trace.arguments.items():
            out[name] = np.array([next(parts) for _ in held.flat], object).reshape(held.shape)
        slopes = {"slope": (_row(slope for *_, slope in before), _row(made[: len(before)]))} if before else {}
        taken |= trace.arguments | {f"slope {name}": np.array([slope], object) for name, slope in seeds.items()}
        self._backwards = Program(Trace(graph, slopes, taken, out, None))

    def start(self, held: Mapping[str, Array], steps: int) -> Tape:
        """Return episodes that begin with these leaves (B, ...), by dotted name, for some steps."""
        return Tape(self, held, max(2, steps))


class Tape:
    """Episodes that are played forwards step by step, and then backwards at once."""

    def __init__(self, form: Adjoint, held: Mapping[str, Array], steps: int) -> None:
        self._form, self._steps, self._done = form, steps, 0
        self.episodes = len(next(iter(held.values())))
        state = form._forwards.rows(self.episodes)
        for name in form._forwards.places:
            state.put_leaf(name, held[name])
        self._call = Call(form._forwards, state, steps)
        self._call.begin()
        self.results = self._call.results()  # (steps, B); those of steps to come are not yet written

    def step(self, arguments: Mapping[str, Array]) -> dict[str, Array]:
        """Play a step under arguments (B, ...); return its results (B,)."""
        for name, value in arguments.items():
            self._call.arguments[name][self._done] = value
        self._call.play(1)
        self._done += 1
        return {name: self.results[name][self._done - 1] for name in self._form.results}

    def backwards(self, slopes: Mapping[str, Array]) -> dict[str, Array]:
        """Return the slopes of a figure by the arguments of all steps (K, B, ...), from its slopes (K, B) by results."""
        form, back = self._form, slice(self._done - 1, None, -1)
        state = form._backwards.rows(self.episodes)
        if form._size:
            state.put_leaf("slope", np.zeros((self.episodes, form._size)))
        call = Call(form._backwards, state, self._steps)
        for name, place in call.arguments.items():
            place[: self._done] = self._column(name, slopes)[back]
        call.begin()
        call.play(self._done)
        return {name: column[back] for name, column in call.results().items()}

    def _column(self, name: str, slopes: Mapping[str, Array]) -> Array:
        """Return an argument of the way back, of all steps that were played."""
        for held in (self.results, self._call.arguments):
            if name in held:
                return held[name][: self._done]
        return slopes[name.removeprefix("slope ")]


def _each(graph: Graph, now: Node, new: Node) -> list[tuple[Node, Node]]:
    """Return the numbers of a leaf of the state, now and next, one by one."""
    return list(zip(graph.picks(now), graph.picks(new), strict=True)) if now.size else [(now, new)]


def _row(nodes: Iterable[Node]) -> Array:
    return np.array([[*nodes]], object)
