"""Choices and limits that one formula can use on arrays and, compiled, on single numbers."""

from typing import Any

import numpy as np

from tailgate.jit import compiled_as


def select(where: Any, x: Any, y: Any) -> Any:
    """x where `where` holds, else y, elementwise: of arrays, and of single numbers in compiled code."""
    return np.where(where, x, y)


def clip(x: Any, low: Any, high: Any) -> Any:
    """x within [low, high], elementwise: of arrays, and of single numbers in compiled code."""
    return np.minimum(np.maximum(x, low), high)


@compiled_as(select)
def _select(where, x, y):
    return lambda where, x, y: x if where else y


@compiled_as(clip)
def _clip(x, low, high):
    return lambda x, low, high: np.minimum(np.maximum(x, low), high)
