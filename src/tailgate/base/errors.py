"""The errors that bad input raises."""

import difflib
import inspect
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from typing import Any, ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class InputError(ValueError):
    """Bad input: one line names the field, the value and the expectation.

    `rows` are the indices of the episodes in the batch that the error is about; `row` is the first, or None.
    """

    rows: tuple[int, ...] = ()

    @property
    def row(self) -> int | None:
        """The first of the rows."""
        return self.rows[0] if self.rows else None

    @row.setter
    def row(self, row: int | None) -> None:
        self.rows = () if row is None else (row,)

    def __init__(self, field: str, value: object, expected: str) -> None:
        shown = " ".join(repr(value).split())
        shown = _cut(shown, 120)
        super().__init__(one_line(f"{_cut(field, 300)}: got {shown}; expected {_cut(expected, 1500)}"))
        self.field, self.value, self.expected = field, value, expected

    def __reduce__(self) -> tuple[type, tuple[str, object, str]]:
        return type(self), (self.field, self.value, self.expected)


class UnknownArgument(InputError, TypeError):
    """An argument that a constructor does not know.

    It is a TypeError too, because callers such as TorchRL look for the words of one.
    Gymnasium raises it again as `type(error)(text)`, so the constructor also takes one text.
    """

    def __init__(self, name: str, known: Iterable[str] | None = None, hint: str = "", where: str = "environment argument") -> None:
        self.known, self.hint, self.where = None if known is None else sorted(known), hint, where
        if self.known is None:
            ValueError.__init__(self, name)
            self.field, self.value, self.expected = "argument", None, ""
            return
        expected = f"{hint}{_among(name, self.known)} (unexpected keyword argument '{name}')"
        super().__init__(where, name, expected)

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (self.args[0],) if self.known is None else (self.value, self.known, self.hint, self.where)


def known_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function with an error for a keyword that it does not know: it suggests the nearest, and lists them all."""
    known = inspect.signature(function).parameters

    @wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> R:
        for name in named:
            if name not in known:
                raise UnknownArgument(name, known, where=f"argument of {function.__name__}")
        return function(*args, **named)

    return call


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."


def one_line(text: str) -> str:
    """Return the text in one line, with control characters written out, safe for a terminal."""
    return text if text.isprintable() else "".join(ch if ch.isprintable() else " " if ch.isspace() else repr(ch)[1:-1] for ch in text)


class NotWritable(InputError):
    """A place that cannot be written to, such as on a full disk: the input is to blame for nothing."""


class Killed(InputError):
    """A worker process was killed from outside: finished work is kept, and the same command can continue from it."""


class NotApplicable(InputError):
    """A pairing of components that has no meaning: the caller skips its rows and reports the reason."""


def said(error: Exception) -> str:
    """Return the words of an error; an OSError gives its reason alone, because the caller names the file."""
    return getattr(error, "strerror", None) or str(error)


def wanted(found: Mapping[str, Any]) -> str:
    """Return the expectation in plain words, from the first error of a validator."""
    if found["type"] == "missing":
        return "a value: it is missing"
    if found["type"] == "tuple_type":
        return "a list, such as [a, b]"
    text = str(found["msg"])
    return (text[0].lower() + text[1:]).removeprefix("input should be ")


def unknown(field: str, name: object, known: Iterable[str]) -> InputError:
    """Return an InputError for an unknown name: it suggests the nearest known name and lists them all."""
    return InputError(field, name, _among(name, sorted(known)))


class Named(Protocol):
    """A part of something, with a name."""

    @property
    def name(self) -> str: ...


N = TypeVar("N", bound=Named)


def by_name(field: str, name: str, parts: Iterable[N]) -> N:
    """Return the part of this name; raise the InputError of `unknown` if there is none."""
    held = {part.name: part for part in parts}
    if name not in held:
        raise unknown(field, name, held)
    return held[name]


def _among(name: object, names: list[str]) -> str:
    near = difflib.get_close_matches(str(name)[:100], names, n=1, cutoff=0.5)
    head = f"one of these (did you mean {near[0]!r}?):" if near else "one of"
    return f"{head} {', '.join(names)}" if names else "no name: none exists"
