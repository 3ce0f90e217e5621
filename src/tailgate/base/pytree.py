"""Operations on pytrees: nested NamedTuples and mappings whose leaves are arrays (B, ...), or None."""

import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def map_leaves(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """Return the tree with `function` applied to its leaves and to the same leaves of `others`."""
    if tree is None:
        return None
    if isinstance(tree, dict):
        return {key: map_leaves(function, branch, *(other[key] for other in others)) for key, branch in tree.items()}
    if isinstance(tree, tuple):
        parts = [map_leaves(function, *branches) for branches in zip(tree, *others, strict=True)]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return function(tree, *others)


def rebuilt(like: Any) -> Callable[[Iterator[Any]], Any]:
    """Return a function that builds a tree shaped as `like` from an iterator of leaves; it is faster than `map_leaves`."""
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
    """Return a copy of the tree whose `rows` (R,) hold the leaves (R, ...) of `fresh`."""

    def put(leaf: Array, new: Array) -> Array:
        out = leaf.copy(order="K")
        out[rows] = new
        return out

    return map_leaves(put, tree, fresh)


def frozen(tree: Any) -> Any:
    """Return the tree with read-only views of its leaves."""

    def lock(leaf: Array) -> Array:
        out = leaf.view()
        out.flags.writeable = False
        return out

    return map_leaves(lock, tree)


def duplicate(tree: Any) -> Any:
    """Return a deep copy, including objects inside arrays."""
    return map_leaves(lambda leaf: copy.deepcopy(leaf) if leaf.dtype == object else leaf.copy(order="K"), tree)


def leaves(tree: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """Return the leaves by dotted name."""
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
    """Return the tree with its leaves replaced by name, as `leaves` names them; their memory layout is kept."""
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
    """Make every array of a plan read-only, in place, because all episodes share it; return the plan."""
    if isinstance(plan, np.ndarray):
        plan.flags.writeable = False
    elif isinstance(plan, (tuple, list)):
        for part in plan:
            lock(part)
    elif isinstance(plan, dict):
        lock(list(plan.values()))
    return plan
