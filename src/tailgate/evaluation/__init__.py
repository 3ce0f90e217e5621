"""Cells of a suite, their rows and seeds, and the acts that play them again and compare."""

from importlib import import_module
from typing import Any

__all__ = ["ENGINE", "Cell", "cell_id", "cells_of", "evaluate", "failed_rows", "origin", "run", "run_cell"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'tailgate.evaluation' has no attribute {name!r}")
    return getattr(import_module("tailgate.evaluation.cells"), name)  # late: it takes longer to import than a first step takes
