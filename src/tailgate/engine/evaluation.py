"""Evaluation of a graph by numpy: the reference for every backend."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from tailgate.engine.graph import Body, Graph, Node, Source, Sweep, computed, ordered
from tailgate.engine.operations import Array, apply

Part = Callable[[Node, list[Any]], Any]


def evaluate(graph: Graph, roots: Sequence[Node], inputs: dict[Any, Array]) -> list[Array]:
    """Return the values of the roots by numpy, for inputs (B,) by name."""
    return Evaluation(graph, roots)(inputs)


class Evaluation:
    """The values of some roots of a graph, for inputs (B,) by name; a subclass may replace the operations."""

    def __init__(self, graph: Graph, roots: Sequence[Node]) -> None:
        self.graph, self.roots = graph, list(roots)
        self._order = ordered(roots)
        self._inputs: dict[Any, Any] = {}
        self._fixed: dict[int, Any] = {}
        self._values: dict[int, Any] = {}
        self._depth = 0  # sweeps around the node that is evaluated
        self._routines: dict[int, Evaluation] = {}
        self._steps: dict[int, list[tuple[Node, int, tuple[int, ...], Part]]] = {}  # of lists of nodes
        self._parts: dict[str, Part] = {
            "input": self._given, "held": self._given, "gather": self._gathered, "matvec": self._multiplied, "loop": self._looped,
            "sweep": self._swept, "pack": self._packed, "call": lambda node, args: self.call(node.attr, args),
        }  # fmt: skip

    @property
    def operations(self) -> int:
        """The number of operations."""
        return sum(not node.fixed for node in self._order)

    def __call__(self, inputs: dict[Any, Any], known: Mapping[int, Any] | None = None) -> list[Any]:
        """Return the values of the roots. known: values of nodes that are computed elsewhere, by number."""
        self._inputs, self._values = inputs, {**self._fixed, **(known or {})}
        with np.errstate(all="ignore"):
            self._run(self._order)
        return [self._value(root) for root in self.roots]

    # -- operations; a buffer is an array (size, ..., B), with the axes of the sweeps around it between

    def compute(self, node: Node, args: Sequence[Any]) -> Any:
        """Return the value of an operation for these values of its arguments."""
        if node.op == "pick":
            return args[0][node.attr]
        if node.op == "invert":
            return np.stack(computed(node, [list(args[0])]))
        if node.op == "blend":
            return np.where(args[0], *map(self.aligned, args[1:]))
        return apply(node.op, node.dtype, args)

    def multiply(self, matrix: Array, there: Array | None, x: Any, base: Any) -> Any:
        """Return base + matrix x for a matrix (p, q) and buffers x (q, ...) and base (p, ...), see `Graph.matvec`."""
        return multiplied(matrix, there, x, base)

    def stack(self, columns: Sequence[Any]) -> Any:
        """Return a buffer of numbers that broadcast."""
        return self.aligned(np.stack(np.broadcast_arrays(*columns)))

    def join(self, buffers: Sequence[Any]) -> Any:
        """Return one buffer of several."""
        shape = np.broadcast_shapes(*(x.shape[1:] for x in buffers))
        return np.concatenate([np.broadcast_to(x, (len(x), *shape)) for x in buffers])

    def taken(self, buffer: Any, places: Array) -> Any:
        """Return the numbers of a buffer at some places."""
        return buffer[places]

    def call(self, routine: Any, args: Sequence[Any]) -> list[Any]:
        """Return the results of a routine (engine/routines.py)."""
        inner = self._routines.get(id(routine))
        if inner is None:
            inner = self._routines[id(routine)] = type(self)(routine.graph, routine.outputs)
        return inner(dict(zip((node.attr for node in routine.inputs), args, strict=True)))

    def aligned(self, x: Any) -> Any:
        """Return a buffer with an axis for each sweep around this place."""
        return x.reshape(len(x), *(1,) * (self._depth + 2 - x.ndim), *x.shape[1:])

    # -- nodes

    def _value(self, node: Node) -> Any:
        if node.id not in self._values:  # a fixed one
            value = self.graph.value(node)
            self._values[node.id] = self._fixed[node.id] = np.array(value) if node.size else value
        return self._values[node.id]

    def _run(self, nodes: Sequence[Node]) -> None:
        values = self._values
        if (steps := self._steps.get(id(nodes))) is None:
            steps = self._steps[id(nodes)] = self._stepped(nodes)
        for node, there, args, part in steps:
            values[there] = part(node, [values[a] for a in args])

    def _stepped(self, nodes: Sequence[Node]) -> list[tuple[Node, int, tuple[int, ...], Part]]:
        """Return the nodes that are computed, each with its number, those of its arguments, and what computes it."""
        left = [node for node in nodes if not node.fixed]
        for node in left:
            for argument in node.args:
                if argument.fixed:
                    self._value(argument)  # and keeps it
        return [(node, node.id, tuple(a.id for a in node.args), self._parts.get(node.op, self.compute)) for node in left]

    def _given(self, node: Node, args: list[Any]) -> Any:
        given = self._inputs[node.attr]
        return self.stack(given) if isinstance(given, list) else given

    def _gathered(self, node: Node, args: list[Any]) -> Any:
        return np.array([self._value(entry) for entry in node.attr], node.dtype)[args[0]]

    def _packed(self, node: Node, args: list[Any]) -> Any:
        return self.join([
            self.stack([self._value(source)]) if isinstance(source, Node) else self._read(source, shape) for source, shape in node.attr
        ])  # fmt: skip

    def _read(self, source: Source, shape: tuple[int, ...]) -> Any:
        """Return the numbers of a source for all indices of a shape."""
        places = (np.indices(shape).reshape(len(shape), -1).T @ np.array(source.strides, int) + source.offset).astype(int)
        if isinstance(source.held, Node):
            return self.aligned(self.taken(self._value(source.held), places))
        return self.aligned(np.array([self._value(source.held[place]) for place in places]))

    def _multiplied(self, node: Node, args: list[Any]) -> Any:
        matrix, there, _ = node.attr
        numbers = np.array([self._value(one) for one in matrix.flat]).reshape(matrix.shape)
        return self.multiply(numbers, there, self.stack(args[: matrix.shape[1]]), self.stack(args[matrix.shape[1] :]))

    def _looped(self, node: Node, args: list[Any]) -> list[Any]:
        body: Body = node.attr
        held = args[: len(body.carried)]
        for _ in range(body.most):
            if not any(np.any(one) for one in held[: len(body.going)]):
                break
            self._values.update(zip((one.id for one in body.carried), held, strict=True))
            self._run(body.nodes)
            held = [self._value(one) for one in body.after]
        return held

    def _swept(self, node: Node, args: list[Any]) -> Any:
        """Return the numbers of all rounds; the rounds are independent, and run at once."""
        sweep: Sweep = node.attr
        for one, source in zip(sweep.carried, sweep.sources, strict=True):
            self._values[one.id] = self._read(source, sweep.shape)
        self._depth += 1
        self._run(sweep.nodes)
        made = self.stack([self._value(one) for one in sweep.after])
        self._depth -= 1
        rounds = int(np.prod(sweep.shape, dtype=int))
        return self.spread(made, rounds)

    def spread(self, made: Any, rounds: int) -> Any:
        """Return the results (count, rounds or 1, ...) of a sweep as a buffer, round by round."""
        if made.shape[1] != rounds:
            made = made.repeat(rounds, 1)
        return made.swapaxes(0, 1).reshape(rounds * len(made), *made.shape[2:])


def multiplied(matrix: Array, there: Array | None, x: Array, base: Array) -> Array:
    """Return base (p, ...) + matrix (p, q) x (q, ...), summed over q in ascending order, without the entries that are not in `there`."""
    out = np.array(np.broadcast_to(base, (len(base), *np.broadcast_shapes(base.shape[1:], x.shape[1:]))))
    for k, column in enumerate(matrix.T):
        rows = slice(None) if there is None else there[:, k]
        out[rows] = out[rows] + column[rows].reshape(-1, *(1,) * (out.ndim - 1)) * x[k]
    return out
