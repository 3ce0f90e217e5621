"""The text of a component: `name:key=value,key=value`, with `part.key=value` for a parameter of a part."""

from __future__ import annotations

import re
from typing import Any

MARKS = ",:=[]{}()\"'#"  # characters that mean something in a component's text: a path in it must not hold them


def split_text(text: str) -> tuple[str, str]:
    """Return head and parameters of a component's text: `name` and `key=value,...`, or the text and nothing."""
    found = re.fullmatch(r"(.*?):(\s*[A-Za-z_][\w.]*\s*=.*)", text, re.DOTALL)
    return (found[1], found[2]) if found else (text, "")


def put_in(params: dict[str, Any], key: str, value: object) -> None:
    """Set params[key] to the value; `part.key` goes into the mapping of the part, which may already hold a name."""
    part, dot, inner = key.partition(".")
    held = params.get(part)
    if not dot:
        params[part] = held | {"name": value} if isinstance(held, dict) else value
    else:
        params[part] = {**(held if isinstance(held, dict) else {"name": held} if held is not None else {}), inner: value}


def split_items(text: str) -> list[str]:
    """Split at commas outside of brackets."""
    out, depth, start = [], 0, 0
    for i, ch in enumerate(text):
        depth += (ch in "[({") - (ch in "])}")
        if ch == "," and depth == 0:
            out.append(text[start:i])
            start = i + 1
    return [*out, text[start:]]
