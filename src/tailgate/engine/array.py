"""Traced arrays: numpy's interface over the nodes of a graph.

The episodes' axis has length one; work along the other axes is unrolled, such as a matrix product into products and sums.
Code may read the values of `fixed` arrays, which all episodes share, as in a Python branch; of others only elementwise results.
Types follow numpy's rules: a Python number takes the type of the array that it meets.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from tailgate.engine.buffers import blended, boxed, common_shape, swept, wide
from tailgate.engine.graph import Graph, Node
from tailgate.engine.indices import check_whole, known_index
from tailgate.engine.operations import BOOL, DTYPES, Array, ArrayLike, DTypeLike
from tailgate.engine.operators import operated, python_number, with_operators
from tailgate.engine.untraceable import Untraceable

NEW = -1  # the episodes' axis of a new array, which is not known before something is written to it
_ZERO = np.zeros((), np.int8)
if TYPE_CHECKING:
    _Base = np.ndarray[Any, np.dtype[Any]]
else:
    _Base = object


@with_operators
class Traced(_Base):
    """An array of nodes; `weak`: the type of a Python number, or None."""

    __slots__ = ("_batch", "dtype", "flags", "graph", "nodes", "weak")
    __array_priority__ = 1000.0

    def __init__(
        self, graph: Graph, nodes: Array, dtype: np.dtype[Any], batch: int | None = None, weak: type | None = None, writeable: bool = True
    ) -> None:
        self.graph, self.nodes, self.dtype, self._batch, self.weak = graph, nodes, dtype, batch, weak
        self.flags: Any = SimpleNamespace(writeable=writeable)  # like numpy's flags

    shape = property(lambda self: self.nodes.shape)
    ndim = property(lambda self: self.nodes.ndim)
    size = property(lambda self: self.nodes.size)
    T = property(lambda self: self.transpose())
    __class__ = property(lambda self: self.weak or (np.ndarray if self.ndim else self.dtype.type))  # what `isinstance` asks

    @property
    def batch(self) -> int | None:
        """The index of the episodes' axis, or None; of a new array, which may be written to through views, the first of length one."""
        if self._batch != NEW:
            return self._batch
        if 1 not in self.shape or self.fixed:
            return None
        self._batch = self.shape.index(1)
        return self._batch

    @property
    def strides(self) -> tuple[int, ...]:
        """Strides [bytes] as if the array held its numbers."""
        return tuple(s // self.nodes.itemsize * self.dtype.itemsize for s in self.nodes.strides)

    @property
    def fixed(self) -> bool:
        """True if the array is the same for all episodes."""
        return all(node.fixed for node in self.nodes.flat)

    def values(self) -> Array:
        """Return the numbers of a fixed array."""
        return self.graph.ask(list(self.nodes.flat), self.dtype).reshape(self.shape)

    def nonzero_places(self) -> Array:
        """Return where the numbers of a fixed array are not zero."""
        return self.graph.ask(list(self.nodes.flat), self.dtype, nonzero=True).reshape(self.shape)

    def known(self, what: str, instead: str) -> Array:
        """Return the numbers of a fixed array; raise Untraceable with the advice `instead` if episodes differ."""
        if not self.fixed:
            raise Untraceable(f"{what} of numbers that differ between episodes", instead)
        return self.values()

    def __repr__(self) -> str:
        return f"Traced{self.shape} {self.dtype}{' fixed' if self.fixed else ''}"

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> Array:
        return self.known("a plain array", "use numpy's elementwise functions, num.* or np.where").astype(dtype or self.dtype)

    def __len__(self) -> int:
        return len(self.nodes)

    def __bool__(self) -> bool:
        return bool(self.known("a Python branch", "write np.where, or `if num.some(mask):` around what only those rows need"))

    def __float__(self) -> float:
        return float(self.known("float()", "keep the array"))

    def __int__(self) -> int:
        return int(self.known("int()", "write x.astype(int)"))

    def __index__(self) -> int:
        return operator.index(self.known("an index", "write num.take(x, index)")[()])

    def __round__(self, digits: int | None = None) -> Any:
        return round(self.known("round()", "write np.rint").item(), digits)

    def __hash__(self) -> int:
        if self.weak is None:
            raise TypeError("unhashable type: 'numpy.ndarray'")
        return hash(python_number(self))

    def __str__(self) -> str:
        return repr(self) if self.weak is None else str(python_number(self))

    def __format__(self, form: str) -> str:
        return format(self.known("text", "write no text").item(), form) if form else str(self)

    def __getattr__(self, name: str) -> Any:
        """Return a method of arrays that is a function of numpy's, or one of Python's numbers."""
        from tailgate.engine.functions import method

        if name.startswith("_"):
            raise AttributeError(name)
        if self.weak is not None:
            return getattr(python_number(self), name)
        return functools.partial(method(name), self)

    def item(self) -> Any:
        """Return the only number."""
        return self.known("item()", "keep the array").item()

    def tolist(self) -> Any:
        """Return nested lists of the numbers."""
        return self.known("tolist()", "write a loop over all possible values, and np.where").tolist()

    def __iter__(self) -> Iterator[Any]:
        return (self[i] for i in range(len(self)))

    # -- the same nodes in another shape

    def _moved(self, move: Callable[[Any], Any], copied: bool = False) -> Traced:
        """Return a view after a change of shape; the same change of a longer axis shows where the episodes' axis goes."""
        nodes, batch = move(self.nodes), None
        if not isinstance(nodes, np.ndarray):
            nodes = boxed(nodes)
        if self.batch is not None:
            shape = (*self.shape[: self.batch], 2, *self.shape[self.batch + 1 :])
            there = [i for i, (m, n) in enumerate(zip(move(np.broadcast_to(_ZERO, shape)).shape, nodes.shape, strict=True)) if m != n]
            if not there and not all(node.fixed for node in nodes.flat):
                raise Untraceable("one row out of the batch", "write it for all rows")
            batch = there[0] if there else None
            if there and nodes.shape[there[0]] != 1:
                raise Untraceable("several rows of one episode", "name an axis that is not the episodes'")
        elif self._batch == NEW and not copied:
            batch = NEW
        return Traced(self.graph, nodes, self.dtype, batch, None, copied or self.flags.writeable)

    def transpose(self, *axes: int | Sequence[int]) -> Traced:
        """Permute the axes."""
        return self._moved(lambda a: a.transpose(*axes))

    def reshape(self, *shape: Any, order: str = "C") -> Traced:
        """Change the shape; the episodes' axis stays first or last."""
        if order != "C":
            raise Untraceable(f"a shape in the order {order}", "transpose first")
        new = tuple(shape[0]) if len(shape) == 1 and isinstance(shape[0], (tuple, list)) else shape
        nodes = self.nodes.reshape(new)
        alike = [n for n in nodes.shape if n != 1] == [n for n in self.shape if n != 1]
        writeable = self.flags.writeable and alike  # else numpy's may be a copy, depending on their layout in memory
        if self.batch is None:
            return Traced(self.graph, nodes, self.dtype, None, None, writeable)
        for here, there in ((0, 0), (self.ndim - 1, nodes.ndim - 1)):
            if self.batch == here and nodes.ndim and nodes.shape[there] == 1:
                return Traced(self.graph, nodes, self.dtype, there, None, writeable)
        raise Untraceable("a shape that puts episodes and other axes together", "keep the episodes as the first axis")

    def copy(self, order: str = "K") -> Traced:
        """Copy the array."""
        return Traced(self.graph, self.nodes.copy(), self.dtype, self.batch)

    def __copy__(self) -> Traced:
        return self if self.weak is not None else self.copy()

    def __deepcopy__(self, memo: object) -> Traced:
        return self.__copy__()

    def view(self, dtype: DTypeLike | None = None) -> Traced:
        """Return the same nodes; with another type of the same size, reinterpret their bits."""
        if dtype is None or np.dtype(dtype) == self.dtype:
            return Traced(self.graph, self.nodes, self.dtype, self.batch, None, self.flags.writeable)
        to = np.dtype(dtype)
        out = self.mapped(lambda node: self.graph.bits(node, to), to)
        out.flags.writeable = False  # numpy would write through
        return out

    def astype(self, dtype: DTypeLike, order: str = "K", casting: str = "unsafe", copy: bool = True) -> Traced:
        """Convert to another type."""
        to = np.dtype(dtype)
        if self.dtype.kind == "f" and not self.fixed and (to.kind == "u" or (to.kind == "i" and to.itemsize < 8)):
            raise Untraceable(f"a float as {to}", "write x.astype(np.int64): numpy's answer to other types depends on the machine")
        if to == self.dtype:
            return self.copy() if copy or self.weak is not None else self
        if self.dtype.kind == "f" and to.kind in "iu" and to != np.int64:  # as numpy does it here
            with np.errstate(invalid="ignore"):
                return lifted(self.graph, self.values().astype(to))
        return self.mapped(lambda node: self.graph.cast(node, to), to)

    def mapped(self, function: Callable[[Node], Node], dtype: DTypeLike | None = None) -> Traced:
        """Apply a function to each node."""
        return Traced(self.graph, each(self.graph, function, self.nodes), np.dtype(dtype or self.dtype), self.batch)

    # -- indexing

    def _key(self, key: object) -> tuple[Any, ...]:
        """Return an index of numpy's without traced arrays."""
        return tuple(known_index(part) if isinstance(part, Traced) else part for part in (key if isinstance(key, tuple) else (key,)))

    def __getitem__(self, key: object) -> Traced:
        plain = self._key(key)
        check_whole(self, plain)
        return self._moved(lambda a: a[plain])

    def __setitem__(self, key: object, value: ArrayLike) -> None:
        if not self.flags.writeable:
            raise ValueError("assignment destination is read-only")
        graph = self.graph
        if isinstance(key, Traced) and key.dtype == BOOL and not key.fixed:  # x[mask] = a number
            mask = key.reshape(*key.shape, *(1,) * (self.ndim - key.ndim))
            if np.ndim(value):
                raise Untraceable("an assignment of several numbers to the rows of a mask", "write np.where(mask, x, y) for all rows")
            self.nodes[...] = chosen(mask, stored(graph, value, self.dtype), self, self.dtype).nodes
            return
        plain = self._key(key)
        check_whole(self, plain, written=True)
        cast = stored(graph, value, self.dtype).nodes
        self.nodes[plain] = cast if cast.ndim else cast[()]

    # -- numpy

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: ArrayLike, **options: Any) -> Any:
        from tailgate.engine import ufuncs

        return ufuncs.called(self.graph, ufunc, method, inputs, options)

    def __array_function__(self, function: Callable[..., object], types: object, args: Sequence[Any], options: dict[str, Any]) -> Any:
        from tailgate.engine import functions

        return functions.called(self.graph, function, args, options)

    def __ipow__(self, exponent: float) -> Any:
        if not self.ndim:
            return self**exponent
        self[...] = self**exponent
        return self

    def __rpow__(self, base: ArrayLike) -> Any:
        return np.power(base, self) if self.weak is None else operated(operator.pow, np.power, base, self)

    def __divmod__(self, other: ArrayLike) -> Any:
        return self // other, self % other

    def __rdivmod__(self, other: ArrayLike) -> Any:
        return other // self, other % self

    def __pow__(self, exponent: float) -> Any:
        """Raise to 0.5, 1 or 2; for other exponents numpy calls a library whose bits differ between machines."""
        if self.weak is not None:  # Python's own power, which is another function
            return operated(operator.pow, np.power, self, exponent)
        known = float(exponent)
        if known not in (0.5, 1.0, 2.0):
            raise Untraceable(f"the power {known}", "write products, or num.exp(p * num.log(x))")
        kind = type(exponent) if type(exponent) in (int, float) else getattr(exponent, "weak", None) or np.result_type(exponent)
        if self.dtype == BOOL and kind is int and known == 2.0:
            return np.square(self)
        base = self.astype(np.power.resolve_dtypes((self.dtype, kind, None))[0], copy=False)
        return {0.5: np.sqrt, 1.0: np.positive, 2.0: np.square}[known](base)


def each(graph: Graph, function: Callable[..., Node], *arrays: Array) -> Array:
    """Apply a function of nodes at each index of the broadcast arrays."""
    shape = common_shape(*arrays)
    if wide(graph, *arrays):
        return swept(graph, function, shape, arrays)
    out = np.empty(shape, object)
    out[...] = np.frompyfunc(function, len(arrays), 1)(*arrays)
    return out


def lifted(graph: Graph, x: ArrayLike, like: np.dtype[Any] | None = None) -> Traced:
    """Return x as a traced array; numbers become constants, and a Python number gets the type `like`."""
    if isinstance(x, Traced):
        if x.graph is not graph:
            raise Untraceable("a number of an earlier trace", "keep what changes in the state that start returns")
        return x
    weak = type(x) if type(x) in (bool, int, float) else None
    held = np.asarray(x, like if weak and like is not None else None)
    if held.dtype == object:
        raise Untraceable(f"an array of {type(held.flat[0]).__name__ if held.size else 'objects'}", "use numbers")
    if held.dtype not in DTYPES:
        raise Untraceable(f"numbers of the type {held.dtype}", "use real numbers of 32 or 64 bits")
    nodes, made = np.empty(held.shape, object), dict[bytes, Node]()
    for i, value in enumerate(held.flat):
        key = value.tobytes()
        nodes.flat[i] = made[key] = made.get(key) or graph.const(value, held.dtype)
    return Traced(graph, nodes, held.dtype, None, weak)


def shared_batch(arrays: Sequence[Traced]) -> int | None:
    """Return the episodes' axis that several arrays share when broadcast, counted from the last (-1)."""
    found = {a.batch - a.ndim for a in arrays if a.batch is not None}
    if len(found) > 1:
        raise Untraceable("episodes against another axis", "give each array the episodes as its first axis, with None where one is missing")
    return found.pop() if found else None


def elementwise(graph: Graph, function: Callable[..., Node], arrays: Sequence[Traced], dtype: np.dtype[Any]) -> Traced:
    """Apply a function of nodes at each index of several arrays."""
    shared_batch(arrays)
    nodes = each(graph, function, *(a.nodes for a in arrays))
    return _of_all(graph, nodes, arrays, dtype)


def _of_all(graph: Graph, nodes: Array, arrays: Sequence[Traced], dtype: np.dtype[Any]) -> Traced:
    """Wrap nodes computed from several arrays in a traced array."""
    back = shared_batch(arrays)
    if back is not None and nodes.shape[back] != 1:
        raise Untraceable("the axis of the episodes against a longer one", "give each array the episodes as its first axis")
    return Traced(graph, nodes, dtype, None if back is None else nodes.ndim + back)


def typed(graph: Graph, x: Traced, dtype: np.dtype[Any]) -> Traced:
    """Convert x to a type."""
    return x if x.dtype == dtype else x.mapped(lambda node: graph.cast(node, dtype), dtype)


def stored(graph: Graph, x: ArrayLike, dtype: np.dtype[Any]) -> Traced:
    """Return x in the type of an array that it is written to."""
    held = lifted(graph, x, dtype)
    if held.weak is int and dtype.kind in "iu":
        np.asarray(python_number(held), dtype)  # raises OverflowError
    return held.astype(dtype, copy=False)


def result_type(arrays: Sequence[Traced]) -> np.dtype[Any]:
    """Return numpy's common type of several arrays."""
    return np.result_type(*(a.weak(0) if a.weak else a.dtype for a in arrays))


def chosen(where: ArrayLike, x: ArrayLike, y: ArrayLike, dtype: np.dtype[Any] | None = None) -> Traced:
    """Return x where `where` is true, else y, as np.where does."""
    graph = next(a.graph for a in (where, x, y) if isinstance(a, Traced))
    mask, one, other = lifted(graph, where), lifted(graph, x), lifted(graph, y)
    to = dtype or result_type([one, other])
    arrays = [typed(graph, mask, BOOL), typed(graph, one, to), typed(graph, other, to)]
    if mask.size == 1 and wide(graph, *(a.nodes for a in arrays)):
        shape = np.broadcast_shapes(*(a.shape for a in arrays))
        sides = [np.broadcast_to(a.nodes, shape) for a in arrays[1:]]
        return _of_all(graph, blended(graph, arrays[0].nodes.item(), *sides), arrays, to)
    return elementwise(graph, graph.select, arrays, to)
