"""The one error that a user's input raises."""

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Bad input: names the field, the value and what was expected, in one line."""

    def __init__(self, field: str, value: object, expected: str) -> None:
        shown = " ".join(repr(value).split())
        shown = shown if len(shown) <= 120 else shown[:117] + "..."
        super().__init__(f"{field}: got {shown}; expected {expected}")
        self.field, self.value, self.expected = field, value, expected

    def __reduce__(self) -> tuple[type, tuple[str, object, str]]:
        return type(self), (self.field, self.value, self.expected)


class NotApplicable(InputError):
    """A pairing of components that has no meaning: its rows are skipped, with the reason."""


def unknown(field: str, name: object, known: Iterable[str]) -> InputError:
    """An InputError for a name that does not exist: lists what does, the nearest first."""
    names = sorted(known)
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.5)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    return InputError(field, name, f"one of {', '.join(names) or 'nothing: none is registered'}{hint}")
