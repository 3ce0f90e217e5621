"""The list of a configuration's keys in --help."""

from __future__ import annotations

import json
import shutil
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tailgate.training.keys import Key, Place

LONGEST = 140  # characters of a default
BESIDES = 20  # characters of a name that has its sentence on the same line; that of a longer name begins below
LEAST = 60  # columns that a line has, however narrow the terminal


def listed(places: Sequence[Place]) -> str:
    """Return the keys of all places in lines that fit the terminal."""
    width = max(shutil.get_terminal_size().columns - 2, LEAST)
    lines = []
    for place in places:
        head = f"keys below {place.name}: {place.doc}" if place.name else "keys"
        lines += [*_wrapped(f"{head}:", width, "", ""), *(line for key in place.keys for line in _lines(key, width)), ""]
    return "\n".join(lines[:-1])


def _lines(key: Key, width: int) -> list[str]:
    """Return a key with its sentence, the value of a bare command, and the one of a preset that leaves the key out."""
    other = "" if key.used == key.default else f"; in a preset that leaves it out: {_brief(key.default)}"
    text, indent = f"{key.doc} (default: {_brief(key.used)}{other})", " " * (BESIDES + 4)
    if len(key.name) <= BESIDES:
        return _wrapped(text, width, f"  {key.name:<{BESIDES}}  ", indent)
    return [f"  {key.name}", *_wrapped(text, width, indent, indent)]


def _wrapped(text: str, width: int, first: str, others: str) -> list[str]:
    return textwrap.wrap(text, width, initial_indent=first, subsequent_indent=others, break_on_hyphens=False)


def _brief(value: object) -> str:
    """Return a value as JSON; that of a long list or mapping is cut."""
    text = json.dumps(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."
