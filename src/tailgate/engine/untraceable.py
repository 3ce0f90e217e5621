"""The error for code that cannot be traced: its line, the reason, and what to write instead."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

_HERE = str(Path(__file__).parent)
_NOBODYS = ("numpy", "contextlib", "functools")
_OURS = ("tailgate.num", "tailgate.engine.hints", "tailgate.core.draws")  # callers of these matter: their line is the one to change


traces = threading.local()  # `refused`: what the innermost trace of this thread refused, also where the code caught it


class Untraceable(TypeError):
    """Code whose control flow or result types depend on the numbers of several episodes; `place` is its file and line."""

    def __init__(self, what: str, instead: str) -> None:
        self.what, self.instead, self.place = what, instead, caller()
        super().__init__(f"{self.place}: {what}; {instead}")
        if (refused := getattr(traces, "refused", None)) is not None:
            refused.append(self)


def caller() -> str:
    """Return the file and line of the code that called the engine."""
    frame = sys._getframe(1)
    while frame.f_back is not None:
        code, module = frame.f_code, str(frame.f_globals.get("__name__", ""))
        if not code.co_filename.startswith(_HERE) and module.split(".")[0] not in _NOBODYS and module not in _OURS:
            break
        frame = frame.f_back
    return f"{frame.f_code.co_filename}:{frame.f_lineno}"
