"""Operations on pytrees: nested NamedTuples and mappings whose leaves are arrays (B, ...), or None."""

import copy
from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
T = TypeVar("T")


def map_leaves(function: Callable[..., object], tree: T, *others: Any) -> T:
    """Return the tree with `function` applied to its leaves and to the same leaves of `others`."""
    out: Any = None
    if isinstance(tree, dict):
        out = {key: map_leaves(function, branch, *(other[key] for other in others)) for key, branch in tree.items()}
    elif isinstance(tree, tuple):
        parts = [map_leaves(function, *branches) for branches in zip(tree, *others, strict=True)]
        out = type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    elif tree is not None:
        out = function(tree, *others)
    return cast(T, out)


def rebuilt(like: object) -> Callable[[Iterator[Any]], Any]:
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


def put_rows(tree: T, rows: Array, fresh: T) -> T:
    """Return a copy of the tree whose `rows` (R,) hold the leaves (R, ...) of `fresh`."""

    def put(leaf: Array, new: Array) -> Array:
        out = leaf.copy(order="K")
        out[rows] = new
        return out

    return map_leaves(put, tree, fresh)


def frozen(tree: T) -> T:
    """Return the tree with read-only views of its leaves."""

    def lock(leaf: Array) -> Array:
        out = leaf.view()
        out.flags.writeable = False
        return out

    return map_leaves(lock, tree)


def duplicate(tree: T) -> T:
    """Return a deep copy, including objects inside arrays."""
    return map_leaves(lambda leaf: copy.deepcopy(leaf) if leaf.dtype == object else leaf.copy(order="K"), tree)


def leaves(tree: object, prefix: str = "") -> dict[str, Array]:
    """Return the leaves by dotted name."""
    if tree is None:
        return {}
    if isinstance(tree, (tuple, dict)):
        names = tree if isinstance(tree, dict) else getattr(tree, "_fields", range(len(tree)))
        out: dict[str, Array] = {}
        for name, branch in zip(names, tree.values() if isinstance(tree, dict) else tree, strict=True):
            out |= leaves(branch, f"{prefix}{name}.")
        return out
    return {prefix[:-1]: cast(Array, tree)}


def with_leaves(tree: T, values: dict[str, Array]) -> T:
    """Return the tree with its leaves replaced by name, as `leaves` names them; their memory layout is kept."""
    names = iter(leaves(tree))

    def put(leaf: Array) -> Array:
        out = leaf.copy(order="K")
        out[...] = values[next(names)]
        return out

    return map_leaves(put, tree)


def widened(mask: Array, leaf: Array) -> Array:
    """Return a mask (B, ...) with axes of length one behind it, as many as the leaf has more."""
    return mask.reshape(*mask.shape, *(1,) * (leaf.ndim - mask.ndim))


def lock(plan: T) -> T:
    """Make every array of a plan read-only, in place, because all episodes share it; return the plan."""
    if isinstance(plan, np.ndarray):
        plan.flags.writeable = False
    elif isinstance(plan, (tuple, list)):
        for part in plan:
            lock(part)
    elif isinstance(plan, dict):
        lock(list(plan.values()))
    return plan
