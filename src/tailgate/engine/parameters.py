"""Parameters as numbers that all episodes share, so that other values need no other code.

Plans, components and models are copied with their floats traced. Code that asks for a value, as in a Python branch, depends on that value
only.
Objects that differ only in such numbers have the same `key`.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import enum
import functools
import hashlib
import types
import weakref
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from tailgate.base.own_modules import editable, files_of
from tailgate.base.sources import own
from tailgate.engine.array import Traced
from tailgate.engine.buffers import boxed
from tailgate.engine.graph import Graph, Node, ordered
from tailgate.engine.operations import FLOAT, SMALL, Array

T = TypeVar("T")
MANY = 100  # numbers of a list that are compared by their bytes
LARGE = 20_000  # numbers of an array that is used as it is, because code usually reads few of them
_caches: weakref.WeakSet[Any] = weakref.WeakSet()  # of somebody's functions that traced code calls
_PLAIN = (type(None), str, bytes, int, complex, enum.Enum, np.generic, np.dtype, type, types.BuiltinFunctionType, np.ufunc, PurePath)


def lifted(like: Array, held: T) -> T:
    """Copy dataclasses, tuples, lists, mappings and closures with numbers traced in the graph of `like`."""
    assert isinstance(like, Traced)
    return cast(T, _Reader(like.graph).visit(held))


class Snapshot(NamedTuple):
    """The content of objects at a time."""

    code: tuple[Any, ...]
    values: list[bytes]
    objects: list[tuple[Any, dict[str, Any]]]  # those that may change, with their attributes

    def changed(self, now: Snapshot) -> str:
        """Return which object has changed since, by its class and attribute, or that a global has; empty if none."""
        for (one, before), (_, after) in zip(self.objects, now.objects, strict=False):
            for name in after:
                if before.get(name) != after[name]:
                    return f"{type(one).__name__}.{name}"
        return "" if self[:2] == now[:2] else "a global"


class Parameters:
    """The parameters of objects: equal `key`s share code, whatever their `values`. The key of mutable objects is None."""

    def __init__(self, held: object) -> None:
        reader = _Reader(None)
        reader.visit(held)
        self.values = reader.values
        self._classes = reader.classes
        self.kept = reader.kept  # objects known by their id must live as long as the key
        self.code = tuple(reader.key)
        self.key = None if reader.changeable else self.code

    @property
    def sources(self) -> str:
        """A hash of the files that define the classes and functions, of Tailgate and of others."""
        digest = hashlib.sha256(f"{own()}/{np.__version__}".encode())
        for file in sorted({file for one in self._classes if not str(one.__module__).startswith("tailgate.") for file in files_of(one)}):
            digest.update(file.read_bytes())
        return digest.hexdigest()

    def snapshot(self) -> Snapshot:
        """Return what the objects and the code that they name hold now."""
        held = [(one, {name: _value(part, set()) for name, part in vars(one).items()}) for one in self._objects]
        return Snapshot(self.code, [leaf.tobytes() for leaf in self.values], held)

    @property
    def _objects(self) -> list[Any]:
        return [one for one in self.kept if hasattr(one, "__dict__") and not isinstance(one, types.FunctionType)]

    @contextlib.contextmanager
    def restored(self) -> Iterator[None]:
        """Give objects their attributes of before back after a trace, and empty caches that were filled in it: they hold nodes."""
        before, caches = [(one, dict(vars(one))) for one in self._objects], {cache: cache.cache_info().misses for cache in list(_caches)}
        try:
            yield
        finally:
            for one, attributes in before:
                vars(one).clear()
                vars(one).update(attributes)
            for cache, misses in caches.items():
                if cache.cache_info().misses != misses:
                    cache.cache_clear()


class Reading:
    """The numbers of fixed nodes as functions of the parameters. What depends on none of them is computed once."""

    def __init__(self, graph: Graph, nodes: Sequence[Node]) -> None:
        self.graph = graph
        direct, constant = (defaultdict[Any, tuple[list[int], list[Any]]](lambda: ([], [])) for _ in range(2))
        rest: list[tuple[int, Node]] = []
        for i, node in enumerate(nodes):  # a recorded road is a table of 40,000 constants
            if node.op == "const" or _is_parameter(node):
                where, held = constant[node.dtype] if node.op == "const" else direct[node.attr[0]]
                where.append(i)
                held.append(node.attr if node.op == "const" else node.attr[1])
            else:
                rest.append((i, node))
        self._direct = {leaf: (np.array(where), np.array(places)) for leaf, (where, places) in direct.items()}
        order, changing = ordered(node for _, node in rest), set()
        known: dict[int, Any] = {}
        for node in order:
            if node.op == "uniform" or any(a.id in changing for a in node.args):
                changing.add(node.id)
            else:
                known[node.id] = graph.recomputed(node, known)
        self._rest = [(i, node) for i, node in rest if node.id in changing]
        self._order = [node for node in order if node.id in changing]
        read = {a.id for node in self._order for a in node.args}
        self._known = {number: value for number, value in known.items() if number in read}  # not all, which may be many
        self._first = np.zeros(max(1, len(nodes)), np.uint64)
        for dtype, (where, held) in constant.items():
            bits = np.zeros(len(where), np.uint64)
            bits.view(dtype)[:: bits.itemsize // dtype.itemsize] = held
            self._first[where] = bits
        for i, node in rest:
            if node.id in known:
                _write(self._first, i, node, known)

    def bits(self, values: Sequence[Array] | None = None) -> Array:
        """Return each number as 64 bits, for given values of the parameters or for their own."""
        values = self.graph.parameters if values is None else values
        out, known = self._first.copy(), dict(self._known)
        for leaf, (where, places) in self._direct.items():
            out[where] = values[leaf].view(np.uint64)[places]
        for node in self._order:
            if _is_parameter(node):
                known[node.id] = values[node.attr[0]][node.attr[1]]
            else:
                known[node.id] = self.graph.value(node) if node.op == "uniform" else self.graph.recomputed(node, known)
        for i, node in self._rest:
            _write(out, i, node, known)
        return out


def _is_parameter(node: Node) -> bool:
    return node.op == "uniform" and type(node.attr) is tuple


def _write(bits: Array, place: int, node: Node, known: dict[int, Any]) -> None:
    bits[place : place + 1].view(node.dtype)[:1] = known[node.id]


class _Reader:
    """A traversal of objects in a fixed order; with a graph it copies them."""

    def __init__(self, graph: Graph | None) -> None:
        self.graph = graph
        self.key: list[Any] = []
        self.values: list[Array] = [] if graph is None else graph.parameters
        self.kept: list[Any] = []
        self.classes: dict[Any, None] = {}
        self.changeable = False
        self._known: dict[int, tuple[int, Any, Any]] = {}

    def visit(self, held: object) -> Any:
        if type(held) is float or (type(held) is int and abs(held) < SMALL):
            leaf = np.array([held])
            (node,) = self._leaf(leaf)
            return held if self.graph is None else Traced(self.graph, boxed(node), leaf.dtype, None, type(held))
        if isinstance(held, _PLAIN):
            self.key += [type(held), _named(held)]
            return held
        if id(held) in self._known:
            number, _, out = self._known[id(held)]
            self.key.append(("again", number))
            return out
        number = len(self._known)
        self.key += [type(held), _code_of(type(held))]
        self.classes[type(held)] = None
        self._known[id(held)] = number, held, held
        out = self._copied(held, number)
        self._known[id(held)] = number, held, out  # the original stays alive, so that its id is not reused
        return out

    def _leaf(self, values: Array) -> Any:
        """Return the nodes of some numbers."""
        leaf = len(self.values)
        self.values.append(values.ravel())
        self.key += [values.shape, values.dtype.kind]
        if self.graph is None:
            return [None] * values.size
        return [self.graph.uniform((leaf, i), value) for i, value in enumerate(values.flat)]

    def _copied(self, held: object, number: int) -> Any:
        if isinstance(held, np.ndarray):
            return self._array(held)
        if isinstance(held, (tuple, list)):
            self.key.append(len(held))
            parts = [self.visit(part) for part in held]
            return type(held)(*parts) if hasattr(held, "_fields") else type(held)(parts)
        if isinstance(held, dict):
            self.key.append(tuple(held))
            return {key: self.visit(part) for key, part in held.items()}
        if isinstance(held, types.FunctionType):
            return self._function(held)
        if not dataclasses.is_dataclass(held):
            self.kept.append(held)
            self.key.append(id(held))
            self.changeable = self.changeable or not isinstance(held, frozenset)
            return held
        self.changeable = self.changeable or not _frozen(type(held))
        out = copy.copy(held)
        self._known[id(held)] = number, held, out  # before its parts, which may refer to it
        self.key.append(tuple(vars(held)))
        for key, part in vars(held).items():
            object.__setattr__(out, key, self.visit(part))
        return out

    def _array(self, held: Array) -> Any:
        if held.dtype != FLOAT or held.size > LARGE:
            self.key += [held.shape, held.dtype.str, held.tobytes()]
            self.changeable = self.changeable or held.dtype == object
            return held
        made = self._leaf(held)
        if self.graph is None:
            return held
        nodes = np.empty(held.shape, object)
        nodes.ravel()[:] = made
        return Traced(self.graph, nodes, FLOAT, writeable=False)

    def _function(self, held: types.FunctionType) -> Any:
        self.kept.append(held)
        self.key += [held.__code__, id(held.__globals__), read_by(held)]
        self.classes[held] = None
        defaults, named = self.visit(held.__defaults__), self.visit(held.__kwdefaults__)
        parts = [self.visit(cell.cell_contents) for cell in held.__closure__ or ()]
        if self.graph is None or not (parts or defaults or named):
            return held
        cells = tuple(types.CellType(part) for part in parts)
        out = types.FunctionType(held.__code__, held.__globals__, held.__name__, defaults, cells or None)
        out.__kwdefaults__ = named
        return out


def _frozen(kind: type[Any]) -> bool:
    return bool(kind.__dataclass_params__.frozen)


class _Same:
    """An object as part of a key: equal to itself alone, and alive as long as the key."""

    def __init__(self, held: object) -> None:
        self.held = held

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.held is other.held

    def __hash__(self) -> int:
        return id(self.held)


def _named(held: object) -> Any:
    """Return a part of a key of a plain object; numbers of numpy by their bits."""
    if isinstance(held, np.generic):
        return held.dtype.str, held.tobytes()
    return id(held) if isinstance(held, (type, types.BuiltinFunctionType, np.ufunc)) else held


def _code_of(kind: type) -> tuple[Any, ...]:
    """Return the functions of a class and its bases, which may be replaced at run time; of somebody else's class all that these read."""
    functions = tuple(part for base in kind.__mro__ for part in vars(base).values() if isinstance(part, types.FunctionType))
    return functions + tuple(_values_of(base, set()) for base in kind.__mro__ if editable(base.__module__))


def read_by(function: types.FunctionType) -> tuple[Any, ...]:
    """Return the globals and defaults that somebody else's function reads, and so on: they may change while the process runs."""
    return _read(function, set(), cells=False) if editable(str(function.__module__)) else ()


def _read(function: types.FunctionType, seen: set[int], cells: bool = True) -> tuple[Any, ...]:
    """Return the globals, defaults and cells that a function reads; without `cells`, where these are parameters."""
    if id(function) in seen:
        return ()
    seen.add(id(function))
    codes, names = [function.__code__], list[str]()
    for code in codes:
        names += code.co_names
        codes += [part for part in code.co_consts if isinstance(part, types.CodeType)]
    held = [(name, function.__globals__[name]) for name in dict.fromkeys(names) if name in function.__globals__]
    for name, module in list(held):  # what is read of somebody's module by its name
        if isinstance(module, types.ModuleType) and editable(module.__name__):
            held += [(f"{name}.{part}", vars(module)[part]) for part in dict.fromkeys(names) if part in vars(module)]
    inside = [cell.cell_contents for cell in function.__closure__ or () if cells and _filled(cell)]
    given = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values(), *inside]
    return function.__code__, *((name, _value(value, seen)) for name, value in held), *(_value(value, seen) for value in given)


def _filled(cell: types.CellType) -> bool:
    try:
        return cell.cell_contents is not cell
    except ValueError:
        return False


def _values_of(kind: type, seen: set[int]) -> tuple[Any, ...]:
    """Return what the attributes of a class hold."""
    if id(kind) in seen:
        return ()
    seen.add(id(kind))
    return tuple((name, _value(part, seen)) for name, part in vars(kind).items() if not (name.startswith("__") and name.endswith("__")))


def _value(held: object, seen: set[int]) -> Any:
    """Return a part of a key for something that code reads by name."""
    if isinstance(held, (staticmethod, classmethod)):
        held = held.__func__
    if isinstance(held, property):
        return tuple(_value(part, seen) for part in (held.fget, held.fset) if part is not None)
    if isinstance(held, functools.cached_property):
        held = held.func
    if isinstance(held, functools._lru_cache_wrapper):
        _caches.add(held)
        held = held.__wrapped__
    if isinstance(held, functools.partial):
        held = [held.func, held.args, held.keywords]
    if isinstance(held, types.FunctionType):
        return _read(held, seen) if editable(str(held.__module__)) else held.__code__
    if isinstance(held, type):
        return _values_of(held, seen) if editable(held.__module__) else _Same(held)
    if isinstance(held, (tuple, list, dict)):
        if id(held) in seen:  # it may hold itself
            return "again"
        seen.add(id(held))
        if len(held) > MANY and not isinstance(held, dict) and all(type(part) in (int, float) for part in held):
            return type(held), np.asarray(held).dtype.str, np.asarray(held).tobytes()
        parts = held.items() if isinstance(held, dict) else enumerate(held)
        return type(held), *((repr(key), _value(part, seen)) for key, part in parts)
    if isinstance(held, np.ndarray) and held.dtype != object:
        return held.shape, held.dtype.str, held.tobytes()
    if isinstance(held, (set, frozenset)):
        return type(held), *sorted(map(repr, held))
    if isinstance(held, types.SimpleNamespace) or (editable(type(held).__module__) and hasattr(held, "__dict__")):
        if id(held) in seen:
            return "again"
        seen.add(id(held))
        return type(held), *((name, _value(part, seen)) for name, part in vars(held).items())
    if isinstance(held, _PLAIN) or type(held) is float:
        return type(held), repr(held) if isinstance(held, (float, complex)) else _named(held)
    return _Same(held)

