"""The operations of a graph, by numpy: these functions define their results for every backend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike as ArrayLike
from numpy.typing import DTypeLike as DTypeLike

Array = np.ndarray[Any, Any]
T = TypeVar("T")
Axis = int | Sequence[int] | None
Shape = int | Sequence[int]
Mask = Array | np.bool_  # numpy's reductions return either
SMALL = 2**15  # whole numbers below are parameters: products of a few stay within 64 bits, and Python's have no end
BOOL, FLOAT, INT = np.dtype(bool), np.dtype(np.float64), np.dtype(np.int64)
DTYPES = [np.dtype(name) for name in ("?", "f8", "f4", "i8", "u8", "i4", "u4", "i2", "u2", "i1", "u1")]


def minimum(x: Array, y: Array) -> Array:
    """Return the smaller number, or NaN if either is NaN; of equal numbers, including -0.0 and 0.0, the second."""
    return np.where((x < y) | (x != x), x, y)


def maximum(x: Array, y: Array) -> Array:
    """Return the larger number, as `minimum` returns the smaller."""
    return np.where((x > y) | (x != x), x, y)


def converted(x: Array, dtype: np.dtype[Any]) -> Array:
    """Convert x to another type: NaN and numbers beyond 64 bits become the least integer; narrower types keep the low bits."""
    if x.dtype.kind == "f" and dtype.kind in "iu":
        holds = (x >= -(2.0**63)) & (x < 2.0**63)
        return np.where(holds, np.where(holds, x, 0.0).astype(np.int64), np.iinfo(np.int64).min).astype(dtype)
    return x.astype(dtype)


COMPARISONS = {"lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal}
BINARY: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.true_divide, "min": minimum, "max": maximum,
    "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "shl": np.left_shift, "shr": np.right_shift, "rem": np.remainder,
}  # fmt: skip
UNARY: dict[str, Callable[..., Any]] = {
    "neg": np.negative, "abs": np.absolute, "not": np.invert, "sqrt": np.sqrt, "floor": np.floor, "ceil": np.ceil, "trunc": np.trunc,
    "rint": np.rint,
}  # fmt: skip
COMMUTATIVE = {"add", "mul", "and", "or", "xor", "eq", "ne"}


def apply(op: str, dtype: np.dtype[Any], args: Sequence[Any]) -> Any:
    """Apply an operation to numpy arrays or numbers."""
    if op == "select":
        return np.where(*args)
    if op == "cast":
        return converted(args[0], dtype)
    if op == "bits":
        return args[0].view(dtype)
    return (UNARY.get(op) or BINARY.get(op) or COMPARISONS[op])(*args)
