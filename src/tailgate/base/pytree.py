"""Walks over states: nested NamedTuples and mappings whose leaves are arrays with B first, or None."""

import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def map_leaves(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """The tree with `function` applied to its leaves, several trees of one shape side by side."""
    if tree is None:
        return None
    if isinstance(tree, dict):
        return {key: map_leaves(function, branch, *(other[key] for other in others)) for key, branch in tree.items()}
    if isinstance(tree, tuple):
        parts = [map_leaves(function, *branches) for branches in zip(tree, *others, strict=True)]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return function(tree, *others)


def rebuilt(like: Any) -> Callable[[Iterator[Any]], Any]:
    """Return a function that builds a tree shaped as `like` from an iterator of leaves, in less time than `map_leaves` takes."""
    if like is None:
        return lambda leaves: None
    if isinstance(like, dict):
        branches = [(key, rebuilt(branch)) for key, branch in like.items()]
        return lambda leaves: {key: make(leaves) for key, make in branches}
    if isinstance(like, tuple):
        parts, kind = [rebuilt(branch) for branch in like], getattr(type(like), "_make", tuple)
        return lambda leaves: kind([make(leaves) for make in parts])
    return next


def put_rows(tree: Any, rows: Array, fresh: Any) -> Any:
    """A copy of the tree with `rows` (R,) replaced by the leaves of `fresh`, which have R rows."""

    def put(leaf: Array, new: Array) -> Array:
        out = leaf.copy(order="K")
        out[rows] = new
        return out

    return map_leaves(put, tree, fresh)


def frozen(tree: Any) -> Any:
    """The tree with read-only views of its leaves: what others are shown of a state."""

    def lock(leaf: Array) -> Array:
        out = leaf.view()
        out.flags.writeable = False
        return out

    return map_leaves(lock, tree)


def duplicate(tree: Any) -> Any:
    """A copy that shares nothing, objects inside of arrays included."""
    return map_leaves(lambda leaf: copy.deepcopy(leaf) if leaf.dtype == object else leaf.copy(order="K"), tree)


def leaves(tree: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """Every leaf by its dotted name."""
    if tree is None:
        return {}
    if isinstance(tree, (tuple, dict)):
        names = tree if isinstance(tree, dict) else getattr(tree, "_fields", range(len(tree)))
        out: dict[str, np.ndarray] = {}
        for name, branch in zip(names, tree.values() if isinstance(tree, dict) else tree, strict=True):
            out |= leaves(branch, f"{prefix}{name}.")
        return out
    return {prefix[:-1]: tree}


def with_leaves(tree: Any, values: dict[str, np.ndarray], prefix: str = "") -> Any:
    """The tree with its leaves replaced by name, as `leaves` names them; their memory layout is kept."""
    if tree is None:
        return None
    if isinstance(tree, tuple):
        names = getattr(tree, "_fields", range(len(tree)))
        parts = [with_leaves(branch, values, f"{prefix}{name}.") for name, branch in zip(names, tree, strict=True)]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    out = tree.copy(order="K")
    out[...] = values[prefix[:-1]]
    return out


def lock(plan: Any) -> Any:
    """The plan with every array in it made read-only, in place: constants are shared by all episodes, and by whoever looks."""
    if isinstance(plan, np.ndarray):
        plan.flags.writeable = False
    elif isinstance(plan, (tuple, list)):
        for part in plan:
            lock(part)
    elif isinstance(plan, dict):
        lock(list(plan.values()))
    return plan
