"""Loops until convergence: each row stops by itself; a traced block runs until its last row has stopped."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tailgate.engine.array import Traced, lifted
from tailgate.engine.buffers import swept
from tailgate.engine.graph import Node
from tailgate.engine.operations import Array

Step = Callable[..., tuple[Array, Sequence[Array]]]
LONG = 400  # operations of a function that is written once for all agents


def until(step: Step, state: Sequence[Array], active: Array, most: int) -> list[Array]:
    """Repeat step(*state) -> (continue, new state) in the rows `active` (B, ...) until none continues, at most `most` times.

    State arrays are (B, ...). Rows that have stopped keep their state.
    """
    arrays = [active, *state]
    traced = next((x for x in arrays if isinstance(x, Traced) and not x.fixed), None)
    if traced is None:
        held, going = [x.values() if isinstance(x, Traced) else x for x in state], np.asarray(active)
        for _ in range(most):
            if not going.any():
                break
            going, held = _round(step, held, going)
        return held
    graph = traced.graph
    begin = [lifted(graph, x) for x in arrays]
    carried = [Traced(graph, graph.carried(x.nodes), x.dtype, x.batch) for x in begin]
    going, new = _round(step, carried[1:], carried[0])
    after = [lifted(graph, x) for x in (going, *new)]
    for x, y in zip(begin, after, strict=True):
        if x.shape != y.shape or x.dtype != y.dtype:
            raise TypeError(f"a loop makes {y.dtype} {y.shape} of {x.dtype} {x.shape}")
    before, inside, then = ([node for x in group for node in x.nodes.flat] for group in (begin, carried, after))
    picked = graph.loop(before, inside, then, then[: begin[0].size], most)
    out: list[Array] = []
    at = 0
    for x in begin:
        nodes = np.empty(x.shape, object)
        nodes.ravel()[:] = picked[at : at + x.size]
        at += x.size
        out.append(Traced(graph, nodes, x.dtype, x.batch))
    return out[1:]


def _round(step: Step, state: Sequence[Array], going: Array) -> tuple[Array, list[Array]]:
    further, new = step(*state)
    held = [np.where(_wide(going, old), x, old) for x, old in zip(new, state, strict=True)]
    return going & further, held


def chosen_apart(mask: Traced, x: Array, function: Callable[..., Array], arrays: Sequence[Array]) -> Array:
    """Return x (B, N, ...) where a mask (B, N) is true, else function(*arrays), agent by agent; a long function becomes a loop."""
    graph, agents = mask.graph, mask.shape[1]
    held = [lifted(graph, a) for a in (mask, x, *arrays)]

    def one(mask: Array, x: Array, *arrays: Array) -> Array:
        return np.where(_wide(mask, x), x, function(*arrays))

    before, parts = graph.operations, []
    for i in range(agents):
        parts.append(one(*(a[:, i : i + 1] for a in held)))
        if i == 0 and agents > 1 and graph.operations - before > LONG:
            break
    else:
        return np.concatenate(parts, axis=1)
    graph.operations = before  # discard what was made for the first agent

    def body(*nodes: Array) -> Node:
        given = [Traced(graph, np.reshape(part, (1, 1, *np.shape(part))), a.dtype, 0) for part, a in zip(nodes, held, strict=True)]
        node: Node = lifted(graph, one(*given)).nodes[0, 0]
        return node

    return Traced(graph, swept(graph, body, (1, agents), [a.nodes for a in held], nested=True), held[1].dtype, 0)


def _wide(mask: Array, like: Array) -> Array:
    return mask[(..., *(None,) * (like.ndim - mask.ndim))]
