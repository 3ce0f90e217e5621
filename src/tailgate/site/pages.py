"""The page builder: templates of this room with one style sheet and one script, each page a file that asks for nothing else."""

from __future__ import annotations

import json
from functools import cache

from jinja2 import Environment

from tailgate.base.assets import embedded, inline, templates
from tailgate.base.errors import InputError
from tailgate.board.schema import LEVELS, Data
from tailgate.board.words import breakable, percent

from .suite import dose_text, figure, share_of

HERE = "tailgate.site"
TITLE = "Tailgate leaderboard"


@cache
def _templates() -> Environment:
    made = templates(HERE)
    made.filters |= {"breakable": breakable, "embedded": embedded, "percent": percent, "figure": figure, "dose": dose_text}
    made.globals |= {"css": inline(HERE, "page.css"), "js": inline(HERE, "page.js"), "levels": LEVELS, "share_of": share_of}
    return made


def render(template: str, **values: object) -> bytes:
    """Return a page. A lone surrogate in the values does not stop it."""
    return _templates().get_template(template).render(**values).encode("utf-8", "replace")


def encoded(data: Data, where: str) -> bytes:
    """Return the text of a JSON file. Raises InputError for what is no JSON data."""
    try:
        return (json.dumps(data, indent=1, allow_nan=False) + "\n").encode()
    except (TypeError, ValueError) as error:
        raise InputError(where, type(data).__name__, f"JSON data ({error})") from None
