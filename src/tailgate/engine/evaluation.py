"""Evaluation of a graph by numpy: the reference for every backend."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from tailgate.engine.graph import Body, Graph, Matrix, Node, Sweep, computed, ordered, packed_values, read
from tailgate.engine.operations import Array


def evaluate(graph: Graph, roots: Sequence[Node], inputs: dict[Any, Array]) -> list[Array]:
    """Return the values of the roots by numpy, for inputs (B,) by name."""
    values: dict[int, Any] = {}
    _evaluate(graph, ordered(roots), inputs, values)
    return [values[root.id] for root in roots]


def _evaluate(graph: Graph, nodes: Iterable[Node], inputs: dict[Any, Array], values: dict[int, Any]) -> None:
    for node in nodes:
        args = [graph.value(a) if a.fixed else values[a.id] for a in node.args]
        if node.fixed:
            values[node.id] = graph.value(node)
        elif node.op in ("input", "held"):
            values[node.id] = inputs[node.attr]
        elif node.op == "gather":
            values[node.id] = np.array([graph.value(entry) for entry in node.attr], node.dtype)[args[0]]
        elif node.op == "matvec":
            values[node.id] = _multiplied(graph, node.attr, args)
        elif node.op == "loop":
            values[node.id] = _looped(graph, node.attr, args, values)
        elif node.op == "sweep":
            values[node.id] = _swept(graph, node.attr, values)
        elif node.op == "pack":
            values[node.id] = [x for piece in node.attr for x in packed_values(graph, piece, values)]
        else:
            values[node.id] = computed(node, args)


def _multiplied(graph: Graph, held: Matrix, args: Sequence[Any]) -> list[Any]:
    matrix, there, _ = held
    x, out = args[: matrix.shape[1]], list(args[matrix.shape[1] :])
    for i, k in np.ndindex(*matrix.shape):
        if there is None or there[i, k]:
            out[i] = out[i] + graph.value(matrix.item(i, k)) * x[k]
    return out


def _looped(graph: Graph, body: Body, args: Sequence[Any], values: dict[int, Any]) -> list[Any]:
    held = list(args[: len(body.carried)])
    going = held[: len(body.going)]
    for _ in range(body.most):
        if not any(np.any(one) for one in going):
            break
        inner = values | {node.id: value for node, value in zip(body.carried, held, strict=True)}
        _evaluate(graph, body.nodes, {}, inner)
        held = [graph.value(node) if node.fixed else inner[node.id] for node in body.after]
        going = held[: len(body.going)]
    return held


def _swept(graph: Graph, sweep: Sweep, values: dict[int, Any]) -> list[Any]:
    out = []
    for index in np.ndindex(*sweep.shape):
        inner = dict(values)
        for one, source in zip(sweep.carried, sweep.sources, strict=True):
            inner[one.id] = read(graph, source, index, values)
        _evaluate(graph, sweep.nodes, {}, inner)
        out += [graph.value(node) if node.fixed else inner[node.id] for node in sweep.after]
    return out
