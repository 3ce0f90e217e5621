"""Parameters as numbers that all episodes share: other values need no other code.

Plans, components and models are copied with their floats traced. What asks for a value, as a Python branch does, gets it; then the code
depends on it, and on no more.
"""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import numpy as np

from tailgate.engine.array import Traced, boxed
from tailgate.engine.graph import FLOAT, Graph


def lifted(graph: Graph, held: Any, name: str) -> Any:
    """A copy of dataclasses, tuples, lists and mappings in which floats and arrays of floats are traced."""
    return _lifted(graph, held, name, {})


def _lifted(graph: Graph, held: Any, name: str, known: dict[int, Any]) -> Any:
    if type(held) is float:
        return Traced(graph, boxed(graph.uniform(name, held)), FLOAT, None, float)
    if type(held) not in (np.ndarray, tuple, list, dict) and not hasattr(held, "_fields") and not dataclasses.is_dataclass(held):
        return held
    if isinstance(held, type):
        return held
    if id(held) not in known:
        known[id(held)] = held, _copied(graph, held, name, known)  # the first lives on: its number is not given to another
    return known[id(held)][1]


def _copied(graph: Graph, held: Any, name: str, known: dict[int, Any]) -> Any:
    if isinstance(held, np.ndarray):
        if held.dtype != FLOAT:
            return held
        nodes = np.empty(held.shape, object)
        for place in np.ndindex(*held.shape):
            nodes[place] = graph.uniform((name, place), held[place])
        return Traced(graph, nodes, FLOAT, writeable=False)
    if isinstance(held, (tuple, list)):
        parts = [_lifted(graph, part, f"{name}.{i}", known) for i, part in enumerate(held)]
        return type(held)(*parts) if hasattr(held, "_fields") else type(held)(parts)
    if isinstance(held, dict):
        return {key: _lifted(graph, part, f"{name}.{key}", known) for key, part in held.items()}
    out = copy.copy(held)
    known[id(held)] = held, out  # before its parts: one of them may lead back
    for key, part in vars(held).items():
        object.__setattr__(out, key, _lifted(graph, part, f"{name}.{key}", known))
    return out
