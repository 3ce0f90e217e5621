"""Evaluation of a graph by numpy: the reference for every backend."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from tailgate.engine.graph import Body, Graph, Matrix, Node, Sweep, computed, ordered, packed_values, read
from tailgate.engine.operations import Array


def evaluate(graph: Graph, roots: Sequence[Node], inputs: dict[Any, Array]) -> list[Array]:
    """Return the values of the roots by numpy, for inputs (B,) by name."""
    return Evaluation(graph, roots)(inputs)


class Evaluation:
    """The values of some roots of a graph, for inputs (B,) by name; a subclass may replace the operations."""

    def __init__(self, graph: Graph, roots: Sequence[Node]) -> None:
        self.graph, self.roots = graph, list(roots)
        self._order = ordered(roots)
        self._inputs: dict[Any, Any] = {}
        self._values: dict[int, Any] = {}
        self._depth = 0  # sweeps around the node that is evaluated

    def __call__(self, inputs: dict[Any, Any]) -> list[Any]:
        """Return the values of the roots."""
        self._inputs, self._values = inputs, {}
        self._run(self._order)
        return [self._value(root) for root in self.roots]

    # -- operations

    def compute(self, node: Node, args: Sequence[Any]) -> Any:
        """Return the value of an operation for these values of its arguments."""
        return computed(node, args)

    def multiply(self, matrix: Array, there: Array | None, x: Sequence[Any], base: Sequence[Any]) -> list[Any]:
        """Return base + matrix x for a matrix (p, q) and numbers x (q) and base (p) of each episode, see `Graph.matvec`."""
        return list(multiplied(matrix, there, stacked(x, self._depth), stacked(base, self._depth)))

    def stack(self, columns: Sequence[Any]) -> Any:
        """Return the numbers of several rounds, the rounds first."""
        return stacked(columns, self._depth)

    # -- nodes

    def _value(self, node: Node) -> Any:
        return self.graph.value(node) if node.fixed else self._values[node.id]

    def _run(self, nodes: Iterable[Node]) -> None:
        for node in nodes:
            if not node.fixed:
                self._values[node.id] = self._of(node)

    def _of(self, node: Node) -> Any:
        if node.op in ("input", "held"):
            return self._inputs[node.attr]
        args = [self._value(a) for a in node.args]
        if node.op == "gather":
            return np.array([self.graph.value(entry) for entry in node.attr], node.dtype)[args[0]]
        if node.op == "matvec":
            return self._multiplied(node.attr, args)
        if node.op == "loop":
            return self._looped(node.attr, args)
        if node.op == "sweep":
            return self._swept(node.attr)
        if node.op == "pack":
            return [x for piece in node.attr for x in packed_values(self.graph, piece, self._values)]
        return self.compute(node, args)

    def _multiplied(self, held: Matrix, args: Sequence[Any]) -> list[Any]:
        matrix, there, _ = held
        numbers = np.array([self.graph.value(node) for node in matrix.flat]).reshape(matrix.shape)
        return self.multiply(numbers, there, args[: matrix.shape[1]], args[matrix.shape[1] :])

    def _looped(self, body: Body, args: Sequence[Any]) -> list[Any]:
        held = list(args[: len(body.carried)])
        for _ in range(body.most):
            if not any(np.any(one) for one in held[: len(body.going)]):
                break
            self._values.update(zip((node.id for node in body.carried), held, strict=True))
            self._run(body.nodes)
            held = [self._value(node) for node in body.after]
        return held

    def _swept(self, sweep: Sweep) -> list[Any]:
        """Return the numbers of all rounds; the rounds are independent, and run at once."""
        rounds = list(np.ndindex(*sweep.shape))
        for one, source in zip(sweep.carried, sweep.sources, strict=True):
            self._values[one.id] = self.stack([read(self.graph, source, index, self._values) for index in rounds])
        self._depth += 1
        self._run(sweep.nodes)
        made = [self._value(node) for node in sweep.after]
        self._depth -= 1
        return [x[i] if x.ndim == self._depth + 2 else x for i in range(len(rounds)) for x in made]


def stacked(columns: Sequence[Any], depth: int) -> Array:
    """Return numbers that broadcast, one array each, as (columns, ..., B) with `depth` axes of rounds between."""
    shape = np.broadcast_shapes(*(np.shape(x) for x in columns))
    held = np.stack([np.broadcast_to(x, shape) for x in columns])
    return held.reshape(len(columns), *(1,) * (depth + 1 - len(shape)), *shape)


def multiplied(matrix: Array, there: Array | None, x: Array, base: Array) -> Array:
    """Return base (p, ...) + matrix (p, q) x (q, ...), summed over q in ascending order, without the entries that are not in `there`."""
    out = np.array(np.broadcast_to(base, (len(base), *np.broadcast_shapes(base.shape[1:], x.shape[1:]))))
    for k, column in enumerate(matrix.T):
        rows = slice(None) if there is None else there[:, k]
        out[rows] = out[rows] + column[rows].reshape(-1, *(1,) * (out.ndim - 1)) * x[k]
    return out
