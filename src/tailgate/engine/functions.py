"""numpy's other functions on traced arrays, and its array constructors during tracing."""

from __future__ import annotations

import contextlib
import functools
import inspect
import operator
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import numpy as np

from tailgate.engine import reductions
from tailgate.engine.array import NEW, Traced, chosen, lifted, result_type, shared_batch, stored, typed
from tailgate.engine.buffers import boxed, swept, wide
from tailgate.engine.graph import Graph, Node
from tailgate.engine.objects import compiling
from tailgate.engine.operations import BOOL, Array, ArrayLike, DTypeLike, Shape
from tailgate.engine.operators import python_number
from tailgate.engine.untraceable import Untraceable, traces


def called(graph: Graph, function: Callable[..., object], args: Sequence[Any], options: dict[str, Any]) -> Any:
    """Return the result of a numpy function; arrays that are the same for all episodes go to numpy itself."""
    if mine := _FUNCTIONS.get(function):
        try:
            given = _signature(mine).bind(*args, **options)
        except TypeError as error:
            raise Untraceable(f"np.{function.__name__}: {error}", "give other arguments, or write elementwise functions") from None
        out = given.arguments.pop("out", None)
        made = mine(*given.args, **given.kwargs)
        return made if out is None else _written(made, out)
    held = [x for x in _inside((args, tuple(options.values()))) if isinstance(x, Traced)]
    if all(x.fixed for x in held):
        return function(*_known(args), **{name: _known(x) for name, x in options.items()})
    raise Untraceable(f"np.{function.__name__}", "write it with elementwise functions, num.* or np.where")


def _written(made: Traced, out: ArrayLike) -> Traced:
    if not isinstance(out, Traced):
        raise Untraceable("writing a traced array into one of numpy's", "make it with np.zeros or np.empty in the same function")
    out[...] = made
    return out


_signature = functools.cache(inspect.signature)


def method(name: str) -> Callable[..., Any]:
    """Return a method of numpy's arrays, by the function of that name."""
    if name in _METHODS:
        return cast(Callable[..., Any], getattr(np, name))
    if hasattr(np.ndarray, name):
        raise Untraceable(f"x.{name}", "write it with elementwise functions, num.* or np.where")
    raise AttributeError(f"'numpy.ndarray' object has no attribute '{name}'")


def _inside(x: object) -> Iterator[object]:
    if isinstance(x, (tuple, list)):
        for part in x:
            yield from _inside(part)
    else:
        yield x


def _known(x: object) -> Any:
    if isinstance(x, (tuple, list)):
        return type(x)(_known(part) for part in x)
    return (x.values() if x.weak is None else python_number(x)) if isinstance(x, Traced) else x


# -- several arrays in one


def _joined(arrays: Sequence[Any], join: Callable[[list[Any]], Any]) -> Traced:
    graph = next(a.graph for a in arrays if isinstance(a, Traced))
    parts = [lifted(graph, a) for a in arrays]
    dtype = np.result_type(*(part.dtype for part in parts))
    parts = [typed(graph, part, dtype) for part in parts]
    back = shared_batch(parts)
    nodes = join([part.nodes for part in parts])
    batch = None
    if back is not None:  # find the new place of the episodes' axis by making it two long
        shadows = [np.zeros([2 if i - p.ndim == back else n for i, n in enumerate(p.shape)], np.int8) for p in parts]
        moved = [i for i, (m, n) in enumerate(zip(join(shadows).shape, nodes.shape, strict=True)) if m != n]
        batch = moved[0] if moved else None
        if batch is not None and nodes.shape[batch] != 1:
            raise Untraceable("several rows of one episode", "join along another axis")
    return Traced(graph, nodes, dtype, batch)


def _stack(arrays: Sequence[Any], axis: int = 0) -> Traced:
    return _joined(arrays, lambda parts: np.stack(parts, axis))


def _concatenate(arrays: Sequence[Any], axis: int = 0) -> Traced:
    return _joined(arrays, lambda parts: np.concatenate(parts, axis))


def _column_stack(arrays: Sequence[Any]) -> Traced:
    return _concatenate([a[:, None] if np.ndim(a) == 1 else a for a in arrays], 1)


# -- one array


def _broadcast_to(x: Traced, shape: Shape, subok: bool = False) -> Traced:
    nodes = np.broadcast_to(x.nodes, shape)
    return Traced(x.graph, nodes, x.dtype, None if x.batch is None else nodes.ndim - x.ndim + x.batch, writeable=False)


def _full_like(
    x: Traced, value: ArrayLike, dtype: DTypeLike | None = None, order: str = "K", subok: bool = True, shape: Shape | None = None
) -> Traced:
    out = made(x.graph, x.shape if shape is None else shape, value, np.dtype(dtype or x.dtype))
    out._batch = x.batch if shape is None and x.batch is not None else NEW
    return out


def _likes(value: ArrayLike) -> Callable[..., Traced]:
    return lambda x, dtype=None, order="K", subok=True, shape=None: _full_like(x, value, dtype, shape=shape)


def _is_in(element: Traced, test_elements: ArrayLike, assume_unique: bool = False, invert: bool = False) -> Array:
    """Return where numbers equal one of a few, such as enumerations."""
    x, found = element, cast(Array, lifted(element.graph, np.zeros(element.shape, bool)))
    held = np.asarray(test_elements)
    to = np.result_type(x.dtype, held.dtype)
    for value in held.ravel().astype(to):
        found = found | (x.astype(to, copy=False) == value)
    return ~found if invert else found


def _tiled(x: Traced, times: int) -> Traced:
    return _concatenate([x] * times, -1)


def _untold(what: str, instead: str) -> Any:
    raise Untraceable(what, f"write {instead}")


def _copyto(target: Traced, source: ArrayLike, casting: str = "same_kind", where: ArrayLike = True) -> None:
    if not np.can_cast(lifted(target.graph, source).dtype, target.dtype, casting):  # type: ignore[arg-type]
        raise TypeError(f"np.copyto cannot cast to {target.dtype} according to the rule {casting!r}")
    target[...] = source if where is True else chosen(where, source, target, target.dtype)


def _choose(condlist: Sequence[Array], choicelist: Sequence[ArrayLike], default: ArrayLike = 0) -> ArrayLike:
    graph = next(x.graph for x in _inside((tuple(condlist), tuple(choicelist), default)) if isinstance(x, Traced))
    to = result_type([lifted(graph, x) for x in (*choicelist, default)])
    out: Array = stored(graph, default, to)
    for condition, choice in zip(reversed(condlist), reversed(choicelist), strict=True):
        if lifted(graph, condition).dtype != BOOL:
            raise TypeError("np.select asks for conditions of type bool")
        out = chosen(condition, choice, out, to)
    return out


def _clipped(
    a: Traced, a_min: ArrayLike | None = None, a_max: ArrayLike | None = None, *, min: ArrayLike | None = None, max: ArrayLike | None = None
) -> Array:  # fmt: skip
    low, high = a_min if min is None else min, a_max if max is None else max
    if a.dtype.kind in "iu":  # numpy drops the limits of Python's that the type cannot pass
        limits, (low, high) = np.iinfo(a.dtype), (python_number(x) if getattr(x, "weak", None) else x for x in (low, high))
        low, high = None if type(low) is int and low <= limits.min else low, None if type(high) is int and high >= limits.max else high
    if low is None:
        return np.positive(a) if high is None else np.minimum(a, high)
    if high is None:
        return np.maximum(a, low)
    kind = result_type([lifted(a.graph, x) for x in (a, low, high)])
    one, least, most = (stored(a.graph, x, kind) for x in (a, low, high))
    if least.ndim or most.ndim:
        return np.minimum(np.maximum(one, least), most)
    above = np.where(least == least, np.where(one < least, least, one), least)  # zeros keep their sign
    return np.where(most == most, np.where(above > most, most, above), most)


def _along(x: Traced, move: Callable[[Array, int], Array], axis: int) -> Traced:
    if x.batch is not None and axis % x.ndim == x.batch:
        raise Untraceable("another order of the episodes", "name another axis")
    return x._moved(lambda a: move(a, axis), copied=True)


_FUNCTIONS: dict[Any, Callable[..., Any]] = {
    np.where: chosen,
    np.select: _choose,
    np.stack: _stack,
    np.concatenate: _concatenate,
    np.column_stack: _column_stack,
    np.broadcast_to: _broadcast_to,
    np.full_like: _full_like,
    np.zeros_like: _likes(0),
    np.ones_like: _likes(1),
    np.empty_like: _likes(0),
    np.swapaxes: lambda x, axis1, axis2: x._moved(lambda a: a.swapaxes(axis1, axis2)),
    np.transpose: lambda x, axes=None: x.transpose(axes) if axes is not None else x.transpose(),
    np.moveaxis: lambda x, source, destination: x._moved(lambda a: np.moveaxis(a, source, destination)),
    np.expand_dims: lambda x, axis: x._moved(lambda a: np.expand_dims(a, axis)),
    np.squeeze: lambda x, axis: x._moved(lambda a: a.squeeze(axis)),
    np.reshape: lambda x, shape, order="C": x.reshape(shape, order=order),
    np.ravel: lambda x, order="C": x.reshape(-1, order=order),
    np.diagonal: lambda x, offset=0, axis1=0, axis2=1: x._moved(lambda a: a.diagonal(offset, axis1, axis2)),
    np.tile: lambda x, reps: _untold("np.tile", "np.concatenate") if isinstance(reps, tuple) else _tiled(x, operator.index(reps)),
    np.repeat: lambda x, repeats, axis: x._moved(lambda a: np.repeat(a, repeats, axis), copied=True),
    np.roll: lambda x, shift, axis: _along(x, lambda a, at: np.roll(a, shift, at), axis),
    np.flip: lambda x, axis: _along(x, np.flip, axis),
    np.clip: _clipped,
    np.any: reductions.any_of,
    np.all: reductions.all_of,
    np.max: reductions.largest,
    np.min: reductions.smallest,
    np.amax: reductions.largest,
    np.amin: reductions.smallest,
    np.sum: reductions.total,
    np.prod: reductions.product,
    np.mean: reductions.mean,
    np.count_nonzero: reductions.counted,
    np.argmin: reductions.place_of_smallest,
    np.argmax: reductions.place_of_largest,
    np.isin: _is_in,
    np.cumsum: lambda x, axis: np.add.accumulate(x, axis),
    np.copyto: _copyto,
    np.copy: lambda x, order="K", subok=False: x.copy(),
    np.shape: lambda x: x.shape,
    np.ndim: lambda x: x.ndim,
    np.size: lambda x: x.size,
    np.iscomplexobj: lambda x: False,
    np.isrealobj: lambda x: True,
}
_METHODS = (
    "all", "any", "argmax", "argmin", "clip", "cumsum", "diagonal", "max", "mean", "min", "prod", "ravel", "repeat", "squeeze", "sum",
    "swapaxes",
)  # fmt: skip


# -- tables


def gathered(table: ArrayLike, index: Array) -> Traced:
    """Return table[index] of a table (K, ...) that is the same for all episodes, for a traced index."""
    assert isinstance(index, Traced)
    graph, held = index.graph, lifted(index.graph, table)
    columns = held.nodes.reshape(len(held.nodes), -1).T
    nodes = np.empty((*index.shape, len(columns)), object)
    for place in np.ndindex(*index.shape):
        one: Node = index.nodes.item(place)
        nodes[place] = [graph.gather(list(column), one) for column in columns]
    return Traced(graph, nodes.reshape(*index.shape, *held.shape[1:]), held.dtype, index.batch)


def picked(ring: Traced, place: ArrayLike) -> Array:
    """Return ring[..., place] of a ring (B, ..., L), for places that broadcast to (B, ...); of a large ring it is a loop."""
    graph, lead = ring.graph, ring.shape[:-1]
    if not wide(graph, ring.nodes) or int(np.prod(lead)) == 1:
        return _halved(ring, place, 0, ring.shape[-1])

    def one(nodes: Array, node: Node) -> Node:
        those, here = Traced(graph, nodes[None], ring.dtype, 0), Traced(graph, boxed(node)[None], np.dtype(np.int64), 0)
        found: Node = lifted(graph, _halved(those, here, 0, nodes.size)).nodes[0]
        return found

    places = np.broadcast_to(lifted(graph, place).nodes, lead)
    return Traced(graph, swept(graph, one, lead, [ring.nodes, places]), ring.dtype, ring.batch)


def _halved(ring: Array, place: ArrayLike, first: int, last: int) -> Array:
    """Return ring[..., place] for places from `first` up to `last`, by halves: few selects are left where episodes read one place."""
    if last - first == 1:
        return ring[..., first]
    middle = (first + last) // 2
    return np.where(np.less(place, middle), _halved(ring, place, first, middle), _halved(ring, place, middle, last))


# -- constructors


def made(graph: Graph, shape: Shape, value: ArrayLike, dtype: np.dtype[Any]) -> Traced:
    """Return a new array filled with a value."""
    size = (int(shape),) if isinstance(shape, (int, np.integer)) else tuple(shape)
    out = Traced(graph, np.empty(size, object), dtype, NEW)
    out.nodes.fill(graph.const(0, dtype))
    out[...] = value
    return out


_LIBRARIES = ("numpy", "scipy", "torch", "filterpy", "cvxpy", "gymnasium", "llvmlite")
_here = threading.local()
_lock = threading.RLock()


def _hold() -> None:
    """Wait for the traces of other threads before a fork: the child would keep their constructors, and locks that nobody releases."""
    _lock.acquire()
    compiling.acquire()  # in the order of a trace that compiles a function on its way


def _go_on() -> None:
    compiling.release()
    _lock.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_hold, after_in_parent=_go_on, after_in_child=_go_on)


def _makers(graph: Graph) -> dict[str, Callable[..., Any]]:
    def filled(value: float) -> Callable[..., Traced]:
        return lambda shape, dtype=float, order="C": made(graph, shape, value, np.dtype(dtype))

    def full(shape: Shape, value: ArrayLike, dtype: DTypeLike | None = None, order: str = "C") -> Traced:
        held = lifted(graph, value)
        return made(graph, shape, value, np.dtype(dtype) if dtype is not None else held.dtype)

    def as_array(x: object, dtype: DTypeLike | None = None, order: str | None = None, copy: bool | None = None) -> Any:
        if isinstance(x, (list, tuple)) and any(isinstance(part, Traced) for part in _inside(x)):
            x = _stack([as_array(part) for part in x])
        if not isinstance(x, Traced):
            return x
        return (x if x.weak is None else x.copy()) if dtype is None else x.astype(dtype, copy=False)

    def contiguous(x: object, dtype: DTypeLike | None = None) -> Any:
        held = as_array(x, dtype)
        if isinstance(held, Traced):  # numpy copies where the numbers do not lie so, which traced code does not know
            held = held.copy()
            held.flags.writeable = False
        return held

    def array(x: object, dtype: DTypeLike | None = None, order: str | None = None, copy: bool = True, ndmin: int = 0) -> Any:
        held = as_array(x, dtype)
        return held.copy() if isinstance(held, Traced) and copy else held

    def errstate(**kinds: Any) -> Any:
        if {"raise", "call"} & set(map(str, kinds.values())):
            raise Untraceable("np.errstate that raises", "write np.where with a condition")
        return contextlib.nullcontext()

    return {
        "zeros": filled(0), "ones": filled(1), "empty": filled(0), "full": full, "asarray": as_array, "ascontiguousarray": contiguous,
        "asanyarray": as_array, "array": array, "errstate": errstate,
    }  # fmt: skip


_CONVERT = ("asarray", "ascontiguousarray", "asanyarray", "array")


@functools.cache
def _plain(module: str) -> bool:
    """Return True for a module whose constructors make plain arrays."""
    return module.split(".")[0] in _LIBRARIES or module.startswith("tailgate.engine.")


def tracing() -> bool:
    """Return True if this thread is tracing."""
    return getattr(_here, "graph", None) is not None


@contextlib.contextmanager
def makers(graph: Graph) -> Iterator[None]:
    """Let `np.zeros` and the other constructors return traced arrays to code that this thread traces, within the block."""

    def wrapped(original: Callable[..., Any], mine: Callable[..., Any], converts: bool) -> Any:
        def maker(*args: Any, **options: Any) -> Any:
            if getattr(_here, "graph", None) is not graph:
                return original(*args, **options)
            if _plain(str(sys._getframe(1).f_globals.get("__name__", ""))):
                return original(*args, **options)
            if converts and not any(isinstance(part, Traced) for part in _inside(args[:1])):
                return original(*args, **options)
            return mine(*args, **options)

        return maker

    with _lock:
        outer, refused = getattr(_here, "graph", None), getattr(traces, "refused", None)
        traces.refused = mine = list[Untraceable]()
        before, _here.graph = {name: getattr(np, name) for name in _makers(graph)}, graph
        try:
            for name, maker in _makers(graph).items():
                setattr(np, name, wrapped(before[name], maker, name in _CONVERT))
            yield
            if mine:  # also where the code went on without it
                raise mine[0]
        finally:
            _here.graph, traces.refused = outer, refused
            for name, original in before.items():
                setattr(np, name, original)

