"""Cells of a suite, their rows and seeds, and what plays them again and compares."""

from tailgate.base.lazy import exported

__getattr__, __all__ = exported(__name__, {"cells": "Cell cells_of evaluate run run_cell"})
