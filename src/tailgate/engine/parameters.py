"""Parameters as numbers that all episodes share, so that other values need no other code.

Plans, components and models are copied with their floats traced. Code that asks for a value, as in a Python branch, depends on that value
only.
Objects that differ only in such numbers have the same `key`.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import hashlib
import types
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from tailgate.base.own_modules import editable, files_of
from tailgate.base.sources import own
from tailgate.engine.array import Traced
from tailgate.engine.buffers import boxed
from tailgate.engine.graph import Graph, Node, ordered
from tailgate.engine.operations import FLOAT, SMALL, Array
from tailgate.engine.reads import BOXES, CODE, PLAIN, Read, Same, attributes, caches, filled, plain, refuse_nodes, stable

T = TypeVar("T")
LARGE = 20_000  # numbers of an array that is used as it is, because code usually reads few of them


def lifted(like: Array, held: T) -> T:
    """Copy dataclasses, tuples, lists, mappings and closures with numbers traced in the graph of `like`."""
    assert isinstance(like, Traced)
    return cast(T, _Reader(like.graph).visit(held))


class Snapshot(NamedTuple):
    """The content of objects at a time."""

    code: tuple[Any, ...]
    values: list[bytes]
    objects: list[tuple[Any, dict[str, Any]]]  # those that may change, with the contents of their attributes

    def changed(self, now: Snapshot) -> str:
        """Return which object has changed since, by its class and attribute, or that a container or a global has; empty if none."""
        for (one, before), (_, after) in zip(self.objects, now.objects, strict=False):
            for name in after:
                if before.get(name) != after[name]:
                    return f"{type(one).__name__}.{name}"
        return "" if self[:2] == now[:2] else "a container or a global"


class Contents(NamedTuple):
    """The content of objects, containers and globals at a time."""

    boxes: list[tuple[Any, Any]]
    rooms: list[tuple[dict[str, Any], str, Any]]

    def put_back(self, nodes: bool = False) -> None:
        """Write it back; with `nodes` only where traced arrays are now, as others may write to globals meanwhile."""
        for box, content in self.boxes:
            if not nodes or _has_nodes(_content(box)):
                with contextlib.suppress(Exception):  # whatever somebody's class does to who writes to it
                    _set_back(box, content)
        for room, name, value in self.rooms:
            if nodes and _has_nodes(room.get(name)):
                room[name] = value


def _set_back(box: Any, content: Any) -> None:
    """Give a container, an array, an object, also a frozen one, or a class its content back."""
    if isinstance(box, np.ndarray):
        if box.shape == content.shape and box.tobytes() != content.tobytes():
            held, box.flags.writeable = box.flags.writeable, True
            box[...] = content
            box.flags.writeable = held
    elif isinstance(box, list):
        box[:] = content
    elif isinstance(box, BOXES):
        box.clear()
        fill: Any = box.extend if isinstance(box, deque) else box.update  # type: ignore[union-attr]
        fill(content)
    else:
        write, erase = (type.__setattr__, type.__delattr__) if isinstance(box, type) else (object.__setattr__, object.__delattr__)
        now = _content(box)
        for name in now.keys() - content.keys():
            erase(box, name)
        for name, value in content.items():
            if now.get(name, content) is not value:
                write(box, name, value)


def _content(box: Any) -> Any:
    if isinstance(box, np.ndarray):
        return box.copy()
    if isinstance(box, types.CellType):
        return {"cell_contents": box.cell_contents} if filled(box) else {}
    if isinstance(box, type):
        return {name: part for name, part in vars(box).items() if not name.startswith("__")}
    return copy.copy(box) if isinstance(box, BOXES) else attributes(box)


def _has_nodes(held: Any, depth: int = 4) -> bool:
    """Return True if traced arrays are in a container or are the thing itself."""
    if isinstance(held, (Traced, Node)):
        return True
    if not depth or not isinstance(held, (*BOXES, tuple)):
        return isinstance(held, np.ndarray) and held.dtype == object and any(isinstance(part, (Traced, Node)) for part in held.flat)
    return any(_has_nodes(part, depth - 1) for part in (held.values() if isinstance(held, dict) else held))


class Parameters:
    """The parameters of objects: equal `key`s share code, whatever their `values`. The key of mutable objects is None."""

    def __init__(self, held: object) -> None:
        reader = _Reader(None)
        reader.visit(held)
        self.values = reader.values
        self._classes = reader.classes
        self.kept = reader.kept  # objects known by their id must live as long as the key
        self._read = reader.read
        self.code = tuple(reader.key)
        self.key = None if reader.changeable else self.code

    @property
    def sources(self) -> str:
        """A hash of the files that define the classes and functions, of Tailgate and of others."""
        digest = hashlib.sha256(f"{own()}/{np.__version__}".encode())
        for file in sorted({file for one in self._classes if not str(one.__module__).startswith("tailgate.") for file in files_of(one)}):
            digest.update(file.read_bytes())
        return digest.hexdigest()

    @property
    def unknown(self) -> str:
        """The classes of objects that somebody's code reads and no key can tell apart; empty if there are none."""
        return ", ".join(sorted({type(one).__name__ for one in self._read.unknown}))

    @property
    def told(self) -> str:
        """A hash of all that is no number, the same in other processes; empty for objects of Tailgate's own."""
        if not any(editable(str(one.__module__)) for one in self._classes):
            return ""
        return hashlib.sha256(repr(stable(self.code)).encode()).hexdigest()

    def snapshot(self) -> Snapshot:
        """Return what the objects and the code that they name hold now."""
        held = [(one, {name: Read().value(part) for name, part in attributes(one).items()}) for one in self._objects]
        return Snapshot(self.code, [leaf.tobytes() for leaf in self.values], held)

    @property
    def _objects(self) -> list[Any]:
        return [one for one in self.kept if attributes(one) and not isinstance(one, types.FunctionType)]

    @contextlib.contextmanager
    def restored(self) -> Iterator[None]:
        """Put back what was written in a trace to objects, containers and globals, and empty caches that were filled: they hold nodes."""
        before, misses = self.contents(), {cache: cache.cache_info().misses for cache in list(caches)}
        try:
            yield
        finally:
            before.put_back(nodes=True)
            for cache, count in misses.items():
                if cache.cache_info().misses != count:
                    cache.cache_clear()

    def contents(self) -> Contents:
        """Return a shallow copy of what code may write to."""
        boxes = [*self._objects, *self._read.boxes.values()]
        return Contents([(box, _content(box)) for box in boxes], [(room, name, room[name]) for room, name in self._read.rooms])

    def own_contents(self) -> Contents:
        """Return the same of objects that no global names: others may write to those."""
        boxes = [*self._objects, *(box for number, box in self._read.boxes.items() if number in self._read.own)]
        return Contents([(box, _content(box)) for box in boxes], [])


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
        self.read = Read()
        self.changeable = False
        self._owned = False  # by an object of somebody else's class
        self._known: dict[int, tuple[int, Any, Any]] = {}

    def visit(self, held: object) -> Any:
        if type(held) is float or (type(held) is int and abs(held) < SMALL):
            leaf = np.array([held])
            (node,) = self._leaf(leaf)
            return held if self.graph is None else Traced(self.graph, boxed(node), leaf.dtype, None, type(held))
        refuse_nodes(held)
        if isinstance(held, PLAIN) or (isinstance(held, CODE) and not editable(str(held.__module__))):
            self.key += [type(held), plain(held)]
            return held
        if id(held) in self._known:
            number, _, out = self._known[id(held)]
            self.key.append(("again", number))
            return out
        number = len(self._known)
        self.key += [type(held), self.read.kind(type(held))]
        self.classes[type(held)] = None
        self._known[id(held)] = number, held, held
        outer, self._owned = self._owned, self._owned or editable(str((held if isinstance(held, type) else type(held)).__module__))
        out = self._copied(held, number)
        self._owned = outer
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
            return self._function(held, number)
        if not dataclasses.is_dataclass(held) or isinstance(held, type):
            self.kept.append(held)
            self.key += [Same(held), self.read.value(held) if self._owned else None]
            self.changeable = self.changeable or not isinstance(held, (frozenset, type))
            return held
        self.changeable = self.changeable or not _frozen(type(held))
        if self._owned:
            self.read.box(held)
        out = copy.copy(held)
        self._known[id(held)] = number, held, out  # before its parts, which may refer to it
        fields = attributes(held)
        self.key.append(tuple(fields))
        for key, part in fields.items():
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

    def _function(self, held: types.FunctionType, number: int) -> Any:
        self.kept.append(held)
        self.key += [held.__code__, Same(held.__globals__), self.read.function(held, cells=False)]
        self.classes[held] = None
        closure = [cell for cell in held.__closure__ or () if filled(cell)]
        copies = {id(cell): types.CellType() for cell in closure}
        out = held
        if self.graph is not None and (closure or held.__defaults__ or held.__kwdefaults__):
            cells = tuple(copies.get(id(cell), cell) for cell in held.__closure__ or ())
            out = types.FunctionType(held.__code__, held.__globals__, held.__name__, None, cells or None)
            vars(out).update(vars(held))
            self._known[id(held)] = number, held, out  # before its parts, among which it may be itself
        defaults, named = self.visit(held.__defaults__), self.visit(held.__kwdefaults__)
        parts = [self.visit(cell.cell_contents) for cell in closure]
        if out is not held:
            out.__defaults__, out.__kwdefaults__ = defaults, named
            for cell, part in zip(closure, parts, strict=True):
                copies[id(cell)].cell_contents = part
        return out


def _frozen(kind: type[Any]) -> bool:
    return bool(kind.__dataclass_params__.frozen)
