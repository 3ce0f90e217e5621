"""Traces: functions of pytrees of arrays as graphs, with an input and a result for each number of each leaf."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from tailgate.base.pytree import leaves, map_leaves
from tailgate.engine.array import Traced, lifted
from tailgate.engine.buffers import WIDE, buffer_of, copied
from tailgate.engine.collection import uncollected
from tailgate.engine.functions import makers
from tailgate.engine.graph import Graph, Node, ordered
from tailgate.engine.operations import Array

S = TypeVar("S")
G = TypeVar("G")
T = TypeVar("T")


@dataclass(eq=False)
class Trace:
    """The computation of a function, as nodes by leaf. The result `demands` (B, .) holds the conditions of the code."""

    graph: Graph
    state: dict[str, tuple[Array, Array]]  # leaf -> its nodes, and those of the next state
    arguments: dict[str, Array]
    results: dict[str, Array]
    next_state: Any  # the tree, with traced leaves
    large: dict[str, tuple[Node, Node]] = field(default_factory=dict)  # of leaves that are buffers: now and next

    def pairs(self, name: str) -> list[tuple[Node, Node]]:
        """Return the nodes of a leaf, now and next: a buffer, or numbers."""
        return [self.large[name]] if name in self.large else list(zip(*(nodes.flat for nodes in self.state[name]), strict=True))

    def pruned(self, results: Mapping[str, Array] | None = None, keep: Iterable[str] = ()) -> Trace:
        """Return a trace of these results, with only those leaves of the state that they need or that are to `keep`."""
        results = self.results if results is None else results
        home = {now.id: name for name in self.state for now, _ in self.pairs(name)}
        needed, known = set(keep), None
        while needed != known:
            known = set(needed)
            asked = [new for name in known for _, new in self.pairs(name)] + [node for nodes in results.values() for node in nodes.flat]
            needed |= {home[node.id] for node in ordered(asked) if node.id in home}
        state = {name: held for name, held in self.state.items() if name in needed}
        large = {name: held for name, held in self.large.items() if name in needed}
        return replace(self, state=state, results=dict(results), large=large)


@uncollected()
def traced(function: Callable[[S, G], tuple[S, Mapping[str, Array]]], state: S, arguments: G) -> Trace:
    """Trace function(state, arguments) -> (state, results), with trees of example arrays (B, ...)."""
    graph = Graph()
    inside, taken = _inputs(graph, state, "state"), _inputs(graph, arguments, "arguments")
    with makers(graph):
        following, made = function(inside, taken)
        following = map_leaves(lambda leaf, like: lifted(graph, leaf, like.dtype).astype(like.dtype), following, inside)
        results = {name: lifted(graph, leaf) for name, leaf in made.items()}
    before, after = _nodes(inside), _nodes(following)
    for name, leaf in before.items():
        if after[name].shape != leaf.shape:
            raise ValueError(f"state {name}: {after[name].shape} after a step, {leaf.shape} before it")
    held = {name: (leaf, after[name]) for name, leaf in before.items()}
    large = {}
    for name, (here, there) in held.items():
        if here.size >= WIDE:
            place: Node = here.flat[0].args[0]
            large[name] = place, _own(graph, place, buffer_of(graph, there))
    if graph.demands:
        results = results | {"demands": Traced(graph, np.array([[node for *_, node in graph.demands]], object), np.dtype(bool), 0)}
    args, given = _nodes(taken), {name: _of_each(leaf) for name, leaf in results.items()}
    return Trace(graph, held, args, _nodes(given), following, large)


def _own(graph: Graph, place: Node, new: Node) -> Node:
    """Return the next numbers of a place in the state, copied if they may alias another place that is written too."""

    def borrowed(node: Node) -> bool:
        return (node.op == "held" and node is not place) or (node.op == "blend" and any(borrowed(a) for a in node.args[1:]))

    return copied(graph, new) if borrowed(new) else new


def _inputs(graph: Graph, tree: T, kind: str) -> T:
    """Return the tree with an input for each number of each leaf."""
    names = iter(leaves(tree))

    def leaf(x: Array) -> Traced:
        name, nodes = next(names), np.empty((1, *x.shape[1:]), object)
        if kind == "state" and nodes.size >= WIDE:
            held = graph.picks(graph.held((kind, name), nodes.size, x.dtype)).reshape(nodes.shape)
            return Traced(graph, held, x.dtype, 0, writeable=False)
        for place in np.ndindex(*x.shape[1:]):
            nodes[(0, *place)] = graph.input((kind, name, place), x.dtype)
        return Traced(graph, nodes, x.dtype, 0, writeable=False)

    return map_leaves(leaf, tree)


def _nodes(tree: object) -> dict[str, Array]:
    return {name: leaf.nodes for name, leaf in leaves(tree).items() if isinstance(leaf, Traced)}


def _of_each(leaf: Traced) -> Traced:
    """Return a result with the episodes first."""
    return leaf if leaf.ndim and leaf.shape[0] == 1 else Traced(leaf.graph, leaf.nodes[None], leaf.dtype)
