"""What cannot be traced: which line says so, why, and what to write in its place."""

from __future__ import annotations

import sys
from pathlib import Path

_HERE = str(Path(__file__).parent)
_NOBODYS = ("numpy", "contextlib", "functools")
_OURS = ("tailgate.num", "tailgate.engine.hints", "tailgate.core.draws")  # what a component calls: its own line is the one to change


class Untraceable(TypeError):
    """Code whose course or result depends on more than one episode's numbers by their types. `place`: file and line of it."""

    def __init__(self, what: str, instead: str) -> None:
        self.what, self.instead, self.place = what, instead, caller()
        super().__init__(f"{self.place}: {what}; {instead}")


def caller() -> str:
    """File and line of the code that called the engine."""
    frame = sys._getframe(1)
    while frame.f_back is not None:
        code, module = frame.f_code, str(frame.f_globals.get("__name__", ""))
        if not code.co_filename.startswith(_HERE) and module.split(".")[0] not in _NOBODYS and module not in _OURS:
            break
        frame = frame.f_back
    return f"{frame.f_code.co_filename}:{frame.f_lineno}"
