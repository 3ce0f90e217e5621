"""Loops until convergence: each row goes on for itself, and a traced block of rows until the last of them has stopped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tailgate.engine.array import Traced, lifted

Step = Callable[..., tuple[Any, Sequence[Any]]]


def until(step: Step, state: Sequence[Any], active: Any, most: int) -> list[Any]:
    """The state (arrays (B, ...)) after step(*state) -> (who goes on, new state), in the rows `active` (B, ...) until none goes on.

    Rows that have stopped keep their state. After `most` rounds all have.
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
    out, at = [], 0
    for x in begin:
        nodes = np.empty(x.shape, object)
        nodes.ravel()[:] = picked[at : at + x.size]
        at += x.size
        out.append(Traced(graph, nodes, x.dtype, x.batch))
    return out[1:]


def _round(step: Step, state: Sequence[Any], going: Any) -> tuple[Any, list[Any]]:
    further, new = step(*state)
    held = [np.where(_wide(going, old), x, old) for x, old in zip(new, state, strict=True)]
    return going & further, held


def _wide(mask: Any, like: Any) -> Any:
    return mask[(..., *(None,) * (like.ndim - mask.ndim))]
