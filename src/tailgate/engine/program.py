"""Programs: a function of trees of arrays, traced once, as machine code on blocks of episodes.

The function gets parameters, the state and arguments, and gives the next state and results: trees whose leaves have the episodes first.
Parameters are the same for all episodes. Their values are no part of the code: other values need no other code.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tailgate.engine import objects
from tailgate.engine.array import Traced, lifted
from tailgate.engine.functions import makers
from tailgate.engine.graph import Array, Graph, Node, computed, ordered
from tailgate.engine.llvm import Column, Held, Layout, text_of
from tailgate.engine.passes import LEAST
from tailgate.tree import leaves, map_leaves

ALIGNED = 64  # bytes: a line of the processor's cache
Step = Callable[[Any, Any], tuple[Any, Any]]


@dataclass(eq=False)
class Trace:
    """What a function computes. Nodes are by leaf, in the order of its places."""

    graph: Graph
    state: dict[str, tuple[Array, Array]]  # leaf -> its nodes, and those of the next state
    arguments: dict[str, Array]
    results: dict[str, Array]
    next_state: Any  # the trees, with traced leaves
    result_tree: Any


def traced(function: Step, state: Any, arguments: Any) -> Trace:
    """function(state, arguments) -> (state, results), of trees of arrays (B, ...) as examples of their shapes and types."""
    graph = Graph()
    inside, taken = _inputs(graph, state, "state"), _inputs(graph, arguments, "arguments")
    with makers(graph):
        following, results = function(inside, taken)
        following = map_leaves(lambda leaf, like: lifted(graph, leaf, like.dtype).astype(like.dtype), following, inside)
        results = map_leaves(lambda leaf: lifted(graph, leaf), results)
    before: dict[str, Any] = leaves(inside)
    after: dict[str, Any] = leaves(following)
    for name, leaf in before.items():
        if after[name].shape != leaf.shape:
            raise ValueError(f"state {name}: {after[name].shape} after a step, {leaf.shape} before it")
    held = {name: (leaf.nodes, after[name].nodes) for name, leaf in before.items()}
    args, given = _nodes(taken), map_leaves(_of_each, results)
    return Trace(graph, held, args, _nodes(given), following, results)


def _inputs(graph: Graph, tree: Any, kind: str) -> Any:
    """The tree with an input for each place of each leaf."""
    names = iter(leaves(tree))

    def leaf(x: Array) -> Traced:
        name, nodes = next(names), np.empty((1, *x.shape[1:]), object)
        for place in np.ndindex(*x.shape[1:]):
            nodes[(0, *place)] = graph.input((kind, name, place), x.dtype)
        return Traced(graph, nodes, x.dtype, 0, writeable=False)

    return map_leaves(leaf, tree)


def _nodes(tree: Any) -> dict[str, Array]:
    held: dict[str, Any] = leaves(tree)
    return {name: leaf.nodes for name, leaf in held.items()}


def _of_each(leaf: Traced) -> Traced:
    """A result with the episodes first."""
    return leaf if leaf.ndim and leaf.shape[0] == 1 else Traced(leaf.graph, leaf.nodes[None], leaf.dtype)


class Program:
    """Machine code of a trace."""

    def __init__(self, trace: Trace, lanes: int | None = None, least: int = LEAST) -> None:
        self.trace, self.lanes = trace, lanes or objects.lanes()
        self.places, self.stride = self._places()
        self.arrays = [("arguments", name) for name in trace.arguments] + [("results", name) for name in trace.results]
        layout = Layout({}, [], self.stride)
        for name, (here, there) in trace.state.items():
            at, size = self.places[name], here.flat[0].dtype.itemsize * self.lanes if here.size else 0
            for i, (node, new) in enumerate(zip(here.flat, there.flat, strict=True)):
                layout.inputs[node.id] = Held(at + i * size)
                if new is not node:
                    layout.outputs.append((new, Held(at + i * size)))
        for number, (kind, name) in enumerate(self.arrays):
            nodes = (trace.arguments if kind == "arguments" else trace.results)[name].ravel()
            for column, node in enumerate(nodes):
                if kind == "arguments":
                    layout.inputs[node.id] = Column(number, column, len(nodes))
                else:
                    layout.outputs.append((node, Column(number, column, len(nodes))))
        self.text = text_of(layout, len(self.arrays), self.lanes, least)
        self.function = objects.Function(self.text)
        self._slots = [trace.graph.nodes[i] for i in layout.uniforms]

    def _places(self) -> tuple[dict[str, int], int]:
        """Where each leaf of the state begins in a block, and the bytes of a block: the widest numbers first."""
        sizes = {name: (here.flat[0].dtype.itemsize if here.size else 1, here.size) for name, (here, _) in self.trace.state.items()}
        places, at = {}, 0
        for name in sorted(sizes, key=lambda name: -sizes[name][0]):
            places[name] = at
            at += sizes[name][0] * sizes[name][1] * self.lanes
        return places, -(-max(at, 1) // ALIGNED) * ALIGNED

    def uniforms(self, values: dict[Any, Any] | None = None) -> Array:
        """The numbers that all episodes share, as the code reads them; of parameters with other values by name."""
        graph, known = self.trace.graph, {}
        if values:
            for node in ordered(self._slots):
                if node.op == "uniform":
                    known[node.id] = np.asarray(values.get(node.attr, graph.value(node)), node.dtype)[()]
                else:
                    known[node.id] = node.attr if node.op == "const" else computed(node, [known[a.id] for a in node.args])
        out = np.zeros(max(1, len(self._slots)), np.uint64)
        for i, node in enumerate(self._slots):
            out[i : i + 1].view(node.dtype)[:1] = known[node.id] if values else graph.value(node)
        return out


class Memory:
    """Episodes of a program: their state in blocks, and the arrays of its arguments and results (episodes, columns)."""

    def __init__(self, program: Program, episodes: int, steps: int = 1) -> None:
        self.program, self.episodes, self.steps = program, episodes, steps
        lanes = program.lanes
        self.blocks = -(-episodes // lanes)
        self.state = _aligned((self.blocks, program.stride))
        self.uniforms = program.uniforms()
        self.arrays: dict[tuple[str, str], Array] = {}
        trace = program.trace
        for kind, name in program.arrays:
            nodes = (trace.arguments if kind == "arguments" else trace.results)[name]
            dtype = nodes.flat[0].dtype if nodes.size else np.dtype(float)
            shape = (steps, self.blocks * lanes, nodes.size)
            self.arrays[kind, name] = _aligned(shape, dtype)
        self._table = np.zeros((len(program.arrays), 2), np.int64)
        for i, held in enumerate(self.arrays.values()):
            self._table[i] = held.ctypes.data, held.nbytes // steps if steps > 1 else 0
        self._state, self._shared, self._arrays = (ctypes.c_void_p(a.ctypes.data) for a in (self.state, self.uniforms, self._table))

    def argument(self, name: str) -> Array:
        """(steps, episodes, *shape), to be written to."""
        return self._shaped("arguments", name)

    def result(self, name: str) -> Array:
        """(steps, episodes, *shape)."""
        return self._shaped("results", name)

    def _shaped(self, kind: str, name: str) -> Array:
        held, trace = self.arrays[kind, name], self.program.trace
        shape = (trace.arguments if kind == "arguments" else trace.results)[name].shape[1:]
        return held[:, : self.episodes].reshape(self.steps, self.episodes, *shape)

    def _leaf(self, name: str) -> Array:
        """A leaf of the state, (blocks, places, lanes)."""
        program = self.program
        nodes = program.trace.state[name][0]
        dtype, at = nodes.flat[0].dtype if nodes.size else np.dtype(bool), program.places[name]
        raw = self.state[:, at : at + nodes.size * program.lanes * dtype.itemsize]
        return raw.view(dtype).reshape(self.blocks, nodes.size, program.lanes)

    def put(self, state: Any) -> None:
        """Take over a state, a tree of arrays (episodes, ...). Lanes that no episode has repeat the last one."""
        index = np.minimum(np.arange(self.blocks * self.program.lanes), self.episodes - 1)
        for name, leaf in leaves(state).items():
            rows = np.asarray(leaf).reshape(self.episodes, -1)[index]
            self._leaf(name)[...] = rows.reshape(self.blocks, self.program.lanes, -1).swapaxes(1, 2)

    def get(self, like: Any) -> Any:
        """The state as a tree of arrays (episodes, ...)."""
        names = iter(leaves(like))

        def leaf(old: Array) -> Array:
            held = self._leaf(next(names)).swapaxes(0, 1).reshape(-1, self.blocks * self.program.lanes)[:, : self.episodes]
            return np.moveaxis(np.array(held, order="C").reshape(*old.shape[1:], self.episodes), -1, 0)

        return map_leaves(leaf, like)

    def step(self, steps: int | None = None, first: int = 0, last: int | None = None) -> None:
        """Play steps of the blocks of a range, by default all."""
        end = self.blocks if last is None else last
        self.program.function.call(self._state, self._shared, self._arrays, first, end, self.steps if steps is None else steps)


def _aligned(shape: tuple[int, ...], dtype: Any = np.uint8) -> Array:
    """Zeros, beginning at a cache line."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    raw = np.zeros(size + ALIGNED, np.uint8)
    begin = -raw.ctypes.data % ALIGNED
    out: Array = raw[begin : begin + size].view(dtype).reshape(shape)
    return out


__all__ = ["Memory", "Node", "Program", "Trace", "traced"]
