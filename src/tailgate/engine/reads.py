"""The content of all that somebody's code reads by name: globals, attributes, closures. It may change while the process runs.

Tailgate's own code is not looked through, because nobody edits it then.
"""

from __future__ import annotations

import collections
import datetime
import enum
import functools
import logging
import operator
import os
import re
import sys
import types
import weakref
from collections.abc import Iterator
from decimal import Decimal
from fractions import Fraction
from pathlib import PurePath
from typing import Any, TypeVar

import numpy as np

from tailgate.base.own_modules import editable
from tailgate.engine.array import Traced
from tailgate.engine.untraceable import Untraceable

MANY = 100  # numbers of a list that are compared by their bytes
BOXES = (list, dict, set, collections.deque)
PLAIN = (
    type(None), str, bytes, bool, int, float, complex, enum.Enum, np.generic, np.dtype, PurePath,
    datetime.date, datetime.time, datetime.timedelta, Fraction, Decimal,
)  # fmt: skip
CODE = (type, types.BuiltinFunctionType, np.ufunc)
_UNCHANGING = (
    types.BuiltinFunctionType, types.ModuleType, types.MethodDescriptorType, types.WrapperDescriptorType, types.MemberDescriptorType,
    types.GetSetDescriptorType, types.CodeType, types.GenericAlias, np.ufunc, logging.Logger,
    re.Pattern, range, slice, type(Ellipsis), TypeVar,
)  # fmt: skip
_DATA = (*PLAIN, np.ndarray, tuple, list, dict, set, frozenset, os._Environ)
_WRITTEN_BY_PYTHON = {
    "__module__", "__dict__", "__weakref__", "__doc__", "__qualname__", "__annotations__", "__dataclass_fields__", "__dataclass_params__",
    "__match_args__", "__slots__", "__slotnames__", "__hash__", "__parameters__", "__orig_bases__", "__abstractmethods__", "_abc_impl",
}  # fmt: skip
caches: weakref.WeakSet[Any] = weakref.WeakSet()  # of somebody's functions that traced code calls


class Same:
    """An object as part of a key: equal to itself alone, and alive as long as the key."""

    def __init__(self, held: object) -> None:
        self.held = held

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.held is other.held

    def __hash__(self) -> int:
        return id(self.held)


def attributes(held: object) -> dict[str, Any]:
    """Return the attributes of an object, those in slots too."""
    names = [name for kind in type(held).__mro__ for name in _slots(kind)]
    return dict(getattr(held, "__dict__", {})) | {name: getattr(held, name) for name in names if hasattr(held, name)}


def _slots(kind: type) -> Iterator[str]:
    slots = vars(kind).get("__slots__", ())
    for name in (slots,) if isinstance(slots, str) else slots:
        if name not in ("__dict__", "__weakref__"):
            yield f"_{kind.__name__.lstrip('_')}{name}" if name.startswith("__") and not name.endswith("__") else name


class Read:
    """The content of what code reads, as parts of a key.

    Attributes
    ----------
    unknown : objects whose content cannot be read, such as a generator of random numbers
    boxes : by id, what code may write to: containers, arrays, cells, and objects, classes and functions with attributes
    own : ids of those boxes that no global names
    rooms : globals that are read, each a namespace and a name
    """

    def __init__(self) -> None:
        self.unknown: list[Any] = []
        self.boxes: dict[int, Any] = {}
        self.own: set[int] = set()
        self._named = 0  # how many names of globals lead to what is read now
        self.rooms: list[tuple[dict[str, Any], str]] = []
        self._seen: dict[int, tuple[int, Any]] = {}  # the objects stay alive, so that no id is used again

    def _again(self, held: object) -> tuple[str, int] | None:
        """Return the number of an object that was read before; None for a new one."""
        if id(held) in self._seen:
            return "again", self._seen[id(held)][0]
        self._seen[id(held)] = len(self._seen), held
        return None

    def box(self, held: Any) -> None:
        """Note something that code may write to."""
        self.boxes[id(held)] = held
        if not self._named:
            self.own.add(id(held))

    def function(self, function: types.FunctionType, cells: bool = True) -> tuple[Any, ...]:
        """Return the code of a function, and what it reads if it is somebody's; without `cells` if these are parameters."""
        if not editable(str(function.__module__)):
            return (function.__code__,)
        if again := self._again(function):
            return again
        codes, names = [function.__code__], list[str]()
        for code in codes:
            names += [*code.co_names, *(text for text in code.co_consts if isinstance(text, str) and text.isidentifier())]
            codes += [part for part in code.co_consts if isinstance(part, types.CodeType)]
        names, room = list(dict.fromkeys(names)), function.__globals__
        held = [(name, room[name]) for name in names if name in room]
        self.rooms += [(room, name) for name, _ in held]
        held += [(name, sys.modules[name]) for name in names if name not in room and name in sys.modules]
        walked: list[types.ModuleType] = []
        for name, module in held:  # which grows
            if isinstance(module, types.ModuleType) and module not in walked:
                walked.append(module)
                held += [(f"{name}.{part}", vars(module)[part]) for part in names if self._of_interest(module, part)]
        self.box(function)
        for cell in function.__closure__ or ():
            self.box(cell)
        given = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()]
        inside = [cell.cell_contents for cell in function.__closure__ or () if cells and filled(cell)]
        self._named += 1
        read = [(name, self.value(value)) for name, value in held]
        self._named -= 1
        read += [(name, self.value(value)) for name, value in vars(function).items()]
        return function.__code__, *read, *map(self.value, (*given, *inside))

    @staticmethod
    def _of_interest(module: types.ModuleType, name: str) -> bool:
        """Return True for what code may read of a module; of an installed one, for its data."""
        held = vars(module).get(name)
        return name in vars(module) and (editable(module.__name__) or isinstance(held, _DATA))

    def kind(self, kind: type) -> tuple[Any, ...]:
        """Return the functions of a class and its bases, and of somebody's class all that these and its attributes hold."""
        if again := self._again(kind):
            return again
        functions = tuple(part for base in kind.__mro__ for part in vars(base).values() if isinstance(part, types.FunctionType))
        theirs = [base for base in kind.__mro__ if editable(base.__module__)]
        own = [part for base in theirs for part in vars(base).items()]
        for base in theirs:
            self.box(base)
        return *functions, *((name, self.value(part)) for name, part in own if name not in _WRITTEN_BY_PYTHON)

    def value(self, held: Any) -> Any:
        """Return the content of an object."""
        refuse_nodes(held)
        if isinstance(held, (staticmethod, classmethod)):
            held = held.__func__
        if isinstance(held, property):
            return tuple(self.value(part) for part in (held.fget, held.fset))
        if isinstance(held, functools.cached_property):
            held = held.func
        if isinstance(held, functools._lru_cache_wrapper):
            caches.add(held)
            held = held.__wrapped__
        if isinstance(held, functools.partial):
            return "partial", self.value(held.func), self.value(held.args), self.value(held.keywords)
        if isinstance(held, types.MethodType):
            return "method", self.value(held.__self__), self.value(held.__func__)
        if isinstance(held, (operator.itemgetter, operator.attrgetter, operator.methodcaller)):
            return type(held), repr(held)
        if isinstance(held, types.MappingProxyType):
            held = dict(held)
        if isinstance(held, types.ModuleType) and editable(held.__name__):  # an attribute: nobody tells which names are read
            data = [(name, part) for name, part in vars(held).items() if isinstance(part, _DATA) and not name.startswith("__")]
            return self._again(held) or tuple((name, self.value(part)) for name, part in data)
        if isinstance(held, types.FunctionType):
            return self.function(held)
        if isinstance(held, type):
            return self.kind(held) if editable(held.__module__) else Same(held)
        if isinstance(held, PLAIN):
            return type(held), repr(held) if isinstance(held, (float, complex)) else plain(held)
        if isinstance(held, np.ndarray) and held.dtype != object:
            self.box(held)
            return held.shape, held.dtype.str, held.tobytes()
        if (isinstance(held, _UNCHANGING) and not _bound(held)) or _descriptor(held):
            return Same(held)
        return self._again(held) or self._content(held)

    def _content(self, held: Any) -> Any:
        if isinstance(held, BOXES):
            self.box(held)
        if isinstance(held, (tuple, list, dict, collections.deque)):
            if len(held) > MANY and not isinstance(held, dict) and all(type(part) in (int, float) for part in held):
                return type(held), np.asarray(held).dtype.str, np.asarray(held).tobytes()
            parts = held.items() if isinstance(held, dict) else enumerate(held)
            return type(held), *((type(key), repr(key), self.value(part)) for key, part in parts)
        if isinstance(held, (set, frozenset)) and all(map(_simple, held)):
            return type(held), *sorted((type(part).__name__, repr(part)) for part in held)
        if isinstance(held, os._Environ):
            return "environ", *sorted(held.items())
        if isinstance(held, types.SimpleNamespace) or _plain_python(held):
            self.box(held)
            return type(held), self.kind(type(held)), *((name, self.value(part)) for name, part in attributes(held).items())
        self.unknown.append(held)
        return Same(held)


def stable(part: Any) -> Any:
    """Return a part of a key as text that is the same in another process."""
    if isinstance(part, (tuple, list)):
        return tuple(map(stable, part))
    if isinstance(part, Same):
        part = part.held
    if isinstance(part, PLAIN):
        return repr(part)
    return getattr(part, "__qualname__", None) or getattr(part, "co_name", None) or type(part).__qualname__


def plain(held: object) -> Any:
    """Return a part of a key of a plain object; numbers of numpy by their bits."""
    if isinstance(held, np.generic):
        return held.dtype.str, held.tobytes()
    return Same(held) if isinstance(held, CODE) else held


def refuse_nodes(held: object) -> None:
    """Raise Untraceable for a traced array."""
    if isinstance(held, Traced):
        raise Untraceable("a number that an earlier trace has left in an object", "keep what changes in the state that start returns")


def filled(cell: types.CellType) -> bool:
    """Return True if a cell of a closure holds something."""
    try:
        return cell.cell_contents is not cell
    except ValueError:
        return False


def _bound(held: object) -> bool:
    """Return True for a function of C that belongs to an object, such as `rng.normal`."""
    return not isinstance(getattr(held, "__self__", None), (type(None), types.ModuleType, type))


def _descriptor(held: object) -> bool:
    """Return True for what C makes of a class's body, such as the fields of a named tuple."""
    return hasattr(type(held), "__get__") and type(held).__module__ in ("builtins", "_collections", "functools")


def _simple(held: object) -> bool:
    """Return True for what its text tells wholly."""
    return isinstance(held, PLAIN) or (isinstance(held, (tuple, frozenset)) and all(map(_simple, held)))


def _plain_python(held: object) -> bool:
    """Return True for an object that is no more than its attributes; one of C may hold more."""
    kind = type(held)
    if editable(kind.__module__) and object in kind.__bases__:
        return True
    if kind.__reduce__ is not object.__reduce__ or kind.__reduce_ex__ is not object.__reduce_ex__:
        return False
    try:
        object.__reduce_ex__(held, 2)
    except TypeError:
        return False
    return True
