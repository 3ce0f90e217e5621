"""Style sheets, scripts and templates that lie beside this module."""

from __future__ import annotations

import base64
import hashlib
from importlib.resources import files
from typing import Any

from markupsafe import Markup


def asset(name: str) -> str:
    return files("tailgate.leaderboard").joinpath(name).read_text(encoding="utf-8")


def inline(name: str) -> dict[str, Any]:
    """A style sheet or script as it stands in the page, and its hash: the page's policy lets nothing else run."""
    text = asset(name)
    return {"text": Markup(text), "hash": base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}
