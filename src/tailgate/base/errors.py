"""The one error that a user's input raises."""

import difflib
from collections.abc import Iterable, Mapping
from typing import Any


class InputError(ValueError):
    """Bad input: names the field, the value and what was expected, in one line. `row`: one of the batch that it is about, if it is."""

    row: int | None = None

    def __init__(self, field: str, value: object, expected: str) -> None:
        shown = " ".join(repr(value).split())
        shown = _cut(shown, 120)
        super().__init__(_line(f"{_cut(field, 300)}: got {shown}; expected {_cut(expected, 1500)}"))
        self.field, self.value, self.expected = field, value, expected

    def __reduce__(self) -> tuple[type, tuple[str, object, str]]:
        return type(self), (self.field, self.value, self.expected)


class UnknownArgument(InputError, TypeError):
    """An argument that a constructor does not know: a TypeError too, whose words callers such as TorchRL look for.

    Gymnasium raises it again as `type(error)(text)`, so one text is also taken.
    """

    def __init__(self, name: str, known: Iterable[str] | None = None) -> None:
        self.known = None if known is None else sorted(known)
        if self.known is None:
            ValueError.__init__(self, name)
            self.field, self.value, self.expected = "argument", None, ""
            return
        expected = f"{_among(name, self.known)} (unexpected keyword argument '{name}')"
        super().__init__("environment argument", name, expected)

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (self.args[0],) if self.known is None else (self.value, self.known)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."


def _line(text: str) -> str:
    """The text as a terminal may show it: in one line, and what would steer it written out."""
    return text if text.isprintable() else "".join(ch if ch.isprintable() else " " if ch.isspace() else repr(ch)[1:-1] for ch in text)


class Killed(InputError):
    """A process was killed from outside: what it had kept is there, and the same work can go on from it."""


class NotApplicable(InputError):
    """A pairing of components that has no meaning: its rows are skipped, with the reason."""


def said(error: Exception) -> str:
    """What an error says: of the operating system's the words alone, as whoever reports it names the file."""
    return getattr(error, "strerror", None) or str(error)


def wanted(found: Mapping[str, Any]) -> str:
    """What was expected, from the first of a validator's errors."""
    if found["type"] == "missing":
        return "a value: it is missing"
    if found["type"] == "tuple_type":
        return "a list, such as [a, b]"
    text = str(found["msg"])
    return (text[0].lower() + text[1:]).removeprefix("input should be ")


def unknown(field: str, name: object, known: Iterable[str]) -> InputError:
    """An InputError for a name that does not exist: says the nearest that does, then all of them, which may be many."""
    return InputError(field, name, _among(name, sorted(known)))


def _among(name: object, names: list[str]) -> str:
    near = difflib.get_close_matches(str(name)[:100], names, n=1, cutoff=0.5)
    head = f"one of these (did you mean {near[0]!r}?):" if near else "one of"
    return f"{head} {', '.join(names)}" if names else "no name: there is none to choose from"
