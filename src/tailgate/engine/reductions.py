"""Reductions of traced arrays along axes other than the episodes': sums, products, extremes and their places, accumulations."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, cast

import numpy as np

from tailgate.engine.array import Traced, each, elementwise, lifted, typed
from tailgate.engine.graph import Graph, Node
from tailgate.engine.operations import BOOL, FLOAT, INT, Array, Axis, DTypeLike
from tailgate.engine.untraceable import Untraceable

WIDEST = {"b": np.int64, "i": np.int64, "u": np.uint64}  # of sums of whole numbers
ON_BOOLS = {"add": "or", "mul": "and", "min": "and", "max": "or"}


def any_of(x: Traced, axis: Axis = None, out: Array | None = None, keepdims: bool = False) -> Traced:
    """Return True where any is true."""
    return reduced(typed(x.graph, x, BOOL), "or", axis, keepdims, "write `if num.some(mask):`, or name the axis")


def all_of(x: Traced, axis: Axis = None, out: Array | None = None, keepdims: bool = False) -> Traced:
    """Return True where all are true."""
    return reduced(typed(x.graph, x, BOOL), "and", axis, keepdims, "write `if num.every(mask):`, or name the axis")


def largest(x: Traced, axis: Axis = None, out: Array | None = None, keepdims: bool = False) -> Traced:
    """Return the largest number."""
    return reduced(x, "or" if x.dtype == BOOL else "max", axis, keepdims)


def smallest(x: Traced, axis: Axis = None, out: Array | None = None, keepdims: bool = False) -> Traced:
    """Return the smallest number."""
    return reduced(x, "and" if x.dtype == BOOL else "min", axis, keepdims)


def total(x: Traced, axis: Axis = None, dtype: DTypeLike | None = None, out: Array | None = None, keepdims: bool = False) -> Traced:
    """Sum up to seven numbers along an axis; numpy's order for more depends on their layout in memory."""
    return reduced(summands(x, axis, dtype), "add", axis, keepdims)


def product(x: Traced, axis: Axis = None, dtype: DTypeLike | None = None, out: Array | None = None, keepdims: bool = False) -> Traced:
    """Multiply up to seven numbers along an axis."""
    return reduced(summands(x, axis, dtype), "mul", axis, keepdims)


def mean(x: Traced, axis: Axis = None, dtype: DTypeLike | None = None, out: Array | None = None, keepdims: bool = False) -> Array:
    """Return the mean of up to seven numbers along an axis."""
    count = math.prod(x.shape[a] for a in axes_of(x, axis, "name the axis"))
    return cast(Array, total(x, axis, dtype or (None if x.dtype.kind == "f" else FLOAT), keepdims=keepdims) / count)


def counted(x: Traced, axis: Axis = None, keepdims: bool = False) -> Traced:
    """Count the numbers that are not zero."""
    return total(typed(x.graph, typed(x.graph, x, BOOL), INT), axis, keepdims=keepdims)


def place_of_smallest(x: Traced, axis: int | None = None) -> Traced:
    """Return the index of the smallest number along an axis, the first of several; or of the first NaN."""
    return _place(x, axis, "lt")


def place_of_largest(x: Traced, axis: int | None = None) -> Traced:
    """Return the index of the largest number along an axis, the first of several; or of the first NaN."""
    return _place(x, axis, "gt")


def _place(x: Traced, axis: int | None, op: str) -> Traced:
    if axis is None or (x.batch is not None and axis % x.ndim == x.batch):
        raise Untraceable("the place of one number of all episodes", "name another axis")
    graph, parts = x.graph, [np.take(x.nodes, i, axis) for i in range(x.shape[axis])]
    best, place = parts[0], each(graph, lambda node: graph.const(0, INT), parts[0])
    for i, part in enumerate(parts[1:], 1):
        better = each(graph, lambda p, b: _wins(graph, op, p, b), part, best)
        best = each(graph, graph.select, better, part, best)
        place = each(graph, lambda c, k, i=i: graph.select(c, graph.const(i, INT), k), better, place)
    shadow = x._moved(lambda n: n.take(0, axis))
    return Traced(graph, place, INT, shadow.batch)


def _wins(graph: Graph, op: str, p: Node, b: Node) -> Node:
    better = graph.binary(op, p, b)
    if p.dtype.kind != "f":
        return better
    return graph.binary("or", better, graph.binary("and", graph.binary("ne", p, p), graph.binary("eq", b, b)))


def accumulated(ufunc: np.ufunc, op: str | None, x: Traced, axis: int = 0, dtype: DTypeLike | None = None) -> Traced:
    """Return what a function of two makes of the numbers up to each place along an axis."""
    if op not in ("add", "mul", "min", "max", "and", "or") or (dtype is not None and op not in ("add", "mul")):
        raise Untraceable(f"np.{ufunc.__name__}.accumulate{'' if dtype is None else ' with dtype='}", "write a loop over the axis")
    if op in ("add", "mul"):
        x = typed(x.graph, x, np.dtype(dtype or WIDEST.get(x.dtype.kind, x.dtype)))
    elif ufunc in (np.logical_and, np.logical_or):
        x = typed(x.graph, x, BOOL)
    if x.batch == axis % x.ndim:
        raise Untraceable("an accumulation over the episodes", "name another axis")
    op = ON_BOOLS.get(op, op) if x.dtype == BOOL else op
    nodes = np.empty(x.shape, object)
    there, source = np.moveaxis(nodes, axis, 0), np.moveaxis(x.nodes, axis, 0)
    for i in range(len(source)):
        there[i] = source[i] if i == 0 else each(x.graph, lambda p, q: x.graph.binary(op, p, q), there[i - 1], source[i])
    return Traced(x.graph, nodes, x.dtype, x.batch)


def by_function(ufunc: np.ufunc, op: str | None, x: Traced, options: dict[str, Any]) -> Traced:
    """Return `ufunc.reduce`."""
    axis, dtype = options.get("axis", 0), options.get("dtype")
    strange = set(options) - {"axis", "keepdims", "dtype"} or (dtype is not None and op not in ("add", "mul"))
    if op not in ("add", "mul", "min", "max", "and", "or") or strange:
        raise Untraceable(f"np.{ufunc.__name__}.reduce{' with ' + ', '.join(options) if strange else ''}", "write a loop over the axis")
    if ufunc in (np.logical_and, np.logical_or):
        x = typed(x.graph, x, BOOL)
    elif op in ("add", "mul"):
        x = summands(x, axis, dtype)
    return reduced(x, ON_BOOLS.get(op, op) if x.dtype == BOOL else op, axis, options.get("keepdims", False))


def axes_of(x: Traced, axis: Axis, instead: str) -> list[int]:
    """Return the axes that a reduction names; raise Untraceable if the episodes' axis is among them."""
    if axis is None:
        if x.fixed or (x.batch is None and x.ndim == 0):
            return list(range(x.ndim))
        raise Untraceable("one number of all episodes", instead)
    axes = sorted(a % x.ndim for a in ((axis,) if isinstance(axis, (int, np.integer)) else axis))
    if x.batch in axes:
        raise Untraceable("a sum, a product or a choice over the episodes", instead)
    return axes


def summands(x: Traced, axis: Axis, dtype: DTypeLike | None = None) -> Traced:
    """Return x in the type of its sum; raise Untraceable if it is too long to sum in a fixed order."""
    axes = axes_of(x, axis, "name the axis")
    long = math.prod(x.shape[a] for a in axes)
    to = np.dtype(dtype or WIDEST.get(x.dtype.kind, x.dtype))
    if to.kind == "f" and (long > 7 or sum(x.shape[a] > 1 for a in axes) > 1):
        what = f"a sum of {long} numbers" if long > 7 else "a sum over several axes"
        raise Untraceable(what, "write num.dot, or a loop: numpy's order of them depends on their place in memory")
    return typed(x.graph, x, to)


def reduced(x: Traced, op: str, axis: Axis, keepdims: bool, instead: str = "name an axis that is not the episodes'") -> Traced:
    """Reduce axes of x by an operation, in ascending order."""
    out = x
    for a in reversed(axes_of(x, axis, instead)):
        parts = [out._moved(partial(np.take, indices=i, axis=a)) for i in range(out.shape[a])]
        if not parts and op not in ("and", "or", "add"):
            raise ValueError(f"zero-size array to reduction operation {op} which has no identity")
        if parts:
            held = parts[0]
            for part in parts[1:]:
                held = elementwise(x.graph, lambda p, q: x.graph.binary(op, p, q), [held, part], x.dtype)
        else:
            shape = tuple(n for i, n in enumerate(out.shape) if i != a)
            held = lifted(x.graph, np.full(shape, op == "and", x.dtype))
        out = held
    if keepdims:
        for a in axes_of(x, axis, instead):
            out = out._moved(partial(np.expand_dims, axis=a))
    if op == "add" and x.dtype.kind == "f":
        zero = x.graph.const(0.0, x.dtype)
        out = out.mapped(lambda node: x.graph.binary("add", node, zero))  # numpy begins with 0.0: no sum is -0.0
    return out[()] if out.ndim else out
