"""Evaluation: the cells of a suite, their rows and seeds, and checks that play them again."""

from tailgate.base.lazy import exported

__getattr__, __all__ = exported(__name__, {"cells": "Cell ENGINE cell_id cells_of evaluate failed_rows origin run run_cell"})
