"""Assets of a page: style sheets, scripts, templates and embedded data."""

from __future__ import annotations

import base64
import hashlib
import json
from functools import cache, partial
from importlib.resources import files
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup


def asset(package: str, *names: str) -> str:
    """Return the text of a package's files, one after the other."""
    return "".join(files(package).joinpath(name).read_text(encoding="utf-8") for name in names)


@cache
def templates(package: str, trim: bool = True) -> Environment:
    """Return the templates that lie in a package, each compiled once in a process.

    trim: leave out the lines of a template that hold nothing but a statement.
    """
    return Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=trim, lstrip_blocks=trim, loader=FunctionLoader(partial(asset, package))
    )


def inline(package: str, *names: str) -> dict[str, Any]:
    """Return the text of a style sheet or script and its hash; the page's security policy runs nothing else."""
    text = asset(package, *names)
    return {"text": Markup(text), "hash": base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}


def embedded(data: object) -> Markup:
    """Return JSON for a script element, escaped such that it cannot end the element or open another."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for char in "<>&\u2028\u2029":
        text = text.replace(char, f"\\u{ord(char):04x}")
    return Markup(text)
