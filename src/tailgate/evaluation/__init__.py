"""Cells of a suite, their rows and seeds, and what plays them again and compares."""

from tailgate.base.lazy import exported

__getattr__, __all__ = exported(__name__, {"cells": "Cell ENGINE cell_id cells_of evaluate failed_rows origin run run_cell"})
