"""numpy's universal functions on traced arrays: types by numpy's rules, one node per number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tailgate.engine.array import Traced, elementwise, lifted, typed
from tailgate.engine.graph import Graph, Node
from tailgate.engine.operations import BOOL, COMPARISONS, DTYPES, Array, ArrayLike, DTypeLike
from tailgate.engine.operators import python_number
from tailgate.engine.reductions import ON_BOOLS, accumulated, by_function
from tailgate.engine.untraceable import Untraceable

_PAIRS: dict[np.ufunc, str] = {
    np.add: "add", np.subtract: "sub", np.multiply: "mul", np.true_divide: "div", np.minimum: "min", np.maximum: "max",
    np.remainder: "rem", np.bitwise_and: "and", np.bitwise_or: "or", np.bitwise_xor: "xor", np.left_shift: "shl", np.right_shift: "shr",
    np.less: "lt", np.less_equal: "le", np.greater: "gt", np.greater_equal: "ge", np.equal: "eq", np.not_equal: "ne",
    np.logical_and: "and", np.logical_or: "or", np.logical_xor: "ne",
}  # fmt: skip
_SINGLES: dict[np.ufunc, str] = {
    np.negative: "neg", np.absolute: "abs", np.fabs: "abs", np.sqrt: "sqrt", np.floor: "floor", np.ceil: "ceil", np.trunc: "trunc",
    np.rint: "rint", np.invert: "not", np.logical_not: "not",
}  # fmt: skip
_LOGICAL = {np.logical_and, np.logical_or, np.logical_xor, np.logical_not}
_LIBRARY = {
    np.exp: "num.exp",
    np.log: "num.log",
    np.tanh: "num.tanh",
    np.matmul: "num.matmul",
    np.power: "products, or num.exp(p * num.log(x))",
}


def called(graph: Graph, ufunc: np.ufunc, method: str, inputs: Sequence[ArrayLike], options: dict[str, Any]) -> Any:
    """Return the result of a universal function."""
    out = options.pop("out", None)
    if any(not isinstance(target, Traced) for target in out or ()):
        raise Untraceable("writing a traced array into one of numpy's", "make it with np.zeros or np.empty in the same function")
    arrays = [lifted(graph, x) for x in inputs]
    if all(a.fixed for a in arrays) and method == "__call__" and not (ufunc in _PAIRS or ufunc in _SINGLES):
        result: Array = lifted(graph, ufunc(*(a.values() if a.weak is None else python_number(a) for a in arrays), **options))
    elif method == "reduce":
        result = by_function(ufunc, _PAIRS.get(ufunc), arrays[0], options)
    elif method == "accumulate":
        result = accumulated(ufunc, _PAIRS.get(ufunc), arrays[0], **options)
    elif method == "__call__" and set(options) <= {"dtype", "casting", "where"}:
        result = _elementwise(graph, ufunc, arrays, options.get("dtype"))
        if options.get("where", True) is not True:
            result = _partly(result, options["where"], out)
    else:
        raise Untraceable(f"np.{ufunc.__name__}.{method} with {', '.join(options) or 'this'}", "write a loop over the axis")
    if out:
        if not np.can_cast(result.dtype, out[0].dtype, "same_kind"):
            raise TypeError(f"cannot cast the result of {ufunc.__name__} from {result.dtype} to {out[0].dtype}")
        out[0][...] = result
        return out[0]
    return result


def _elementwise(graph: Graph, ufunc: np.ufunc, arrays: list[Traced], dtype: DTypeLike | None) -> Array:
    if ufunc in _DERIVED and dtype is None:
        return _DERIVED[ufunc](*arrays)
    op = _PAIRS.get(ufunc) or _SINGLES.get(ufunc)
    if op is None:
        raise Untraceable(f"np.{ufunc.__name__}", f"write {_LIBRARY.get(ufunc, 'it with +, -, *, /, np.sqrt, np.where')}")
    kinds = [BOOL] * len(arrays) if ufunc in _LOGICAL else loop_types(ufunc, arrays)
    if dtype is not None and op in COMPARISONS:
        if np.dtype(dtype) != BOOL:
            raise Untraceable(f"np.{ufunc.__name__} with dtype={np.dtype(dtype)}", "compare without it")
    elif dtype is not None:
        kinds = [np.dtype(dtype)] * len(arrays)
        if not all(np.can_cast(a.dtype, kinds[0], "same_kind") for a in arrays):
            raise TypeError(f"np.{ufunc.__name__} cannot compute with {kinds[0]} without a loss")
    elif len(arrays) > 1 and ufunc not in _LOGICAL and kinds[0].kind in "iu":
        kinds = [_exact(ufunc, op, arrays, kinds[0])] * len(arrays)
    if any(kind not in DTYPES for kind in kinds):
        raise Untraceable(f"np.{ufunc.__name__} of {', '.join(map(str, kinds))}", "use real numbers of 32 or 64 bits")
    arrays = [typed(graph, a, kind) for a, kind in zip(arrays, kinds, strict=True)]
    if op in ("floor", "ceil", "trunc") and kinds[0].kind != "f":
        return arrays[0].copy()
    if kinds[0] == BOOL:
        op = ON_BOOLS.get(op, op)
    if op in ("rem", "shl", "shr"):
        return _by_a_constant(graph, op, arrays, kinds[0])
    if len(arrays) == 1:
        return elementwise(graph, lambda x: graph.unary(op, x), arrays, kinds[0])
    return elementwise(graph, lambda x, y: graph.binary(op, x, y), arrays, BOOL if op in COMPARISONS else kinds[0])


def _exact(ufunc: np.ufunc, op: str, arrays: Sequence[Traced], kind: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type in which narrow whole numbers meet Python's: numpy compares them as they are, and computes with no others."""
    limits = np.iinfo(kind)
    asked = [a for a in arrays if a.weak is int and a.size == 1 and (kind.itemsize < 8 or kind.kind == "u" or a.nodes.item().op == "const")]
    wrong = [a for a in asked if not limits.min <= a.values().item() <= limits.max]  # a parameter is small (SMALL)
    if not wrong:
        return kind
    if op in COMPARISONS and kind.itemsize == 8:
        raise Untraceable(f"a comparison of {kind} with {wrong[0].values().item()}", "use a number that the type holds")
    if op not in COMPARISONS:
        raise OverflowError(f"Python integer {wrong[0].values().item()} out of bounds for {kind}, in np.{ufunc.__name__}")
    return np.dtype(np.int64)


def loop_types(ufunc: np.ufunc, arrays: Sequence[Traced]) -> list[np.dtype[Any]]:
    """Return the types in which numpy computes the function."""
    known = all(a.weak for a in arrays)
    given = [a.weak if a.weak in (int, float) and not known else a.dtype for a in arrays]
    kinds = ufunc.resolve_dtypes((*given, *(None,) * ufunc.nout))[: len(arrays)]
    if len(set(kinds)) > 1:
        raise Untraceable(f"np.{ufunc.__name__} of {' and '.join(map(str, kinds))}", "give both one type")
    return list(kinds)


def _by_a_constant(graph: Graph, op: str, arrays: list[Traced], dtype: np.dtype[Any]) -> Array:
    """Return a remainder or a shift by constants; processors disagree on other cases."""
    if dtype.kind == "f":
        raise Untraceable("a remainder of floats", "write x - y * np.floor(x / y)")
    if op == "rem" and not arrays[1].fixed:
        return _remainder(*arrays)
    by = arrays[1].known("a remainder or a shift", "use constants on the right")
    least, most = (1, np.iinfo(dtype).max) if op == "rem" else (0, 8 * dtype.itemsize - 1)
    if by.size and not (least <= by.min() and by.max() <= most):
        raise Untraceable(f"a remainder or a shift by {by.min()}", f"use constants from {least} to {most}")
    return elementwise(graph, lambda x, y: _divided(graph, op, x, y), [arrays[0], lifted(graph, by)], dtype)


def _remainder(x: Traced, y: Traced) -> Array:
    """Return the remainder of whole numbers with the sign of y, and 0 where y is 0."""
    graph, signed = x.graph, y.dtype.kind == "i"
    size = np.where(y < 0, -y, y) if signed else y
    least = np.iinfo(y.dtype).min  # which has no opposite
    parts: list[Any] = [x, np.where((size == 0) | (size == least) if signed else size == 0, 1, size)]
    rest: Array = elementwise(graph, lambda p, q: graph.binary("rem", p, q), parts, x.dtype)
    if signed:
        rest = np.where((y < 0) & (rest != 0), rest + y, rest)
        rest = np.where(y == least, np.where(x > 0, x + y, np.where(x == y, 0, x)), rest)
    return np.where(y == 0, 0, rest)


def _divided(graph: Graph, op: str, x: Node, y: Node) -> Node:
    if op == "rem" and y.op == "const" and int(y.attr) & (int(y.attr) - 1) == 0:
        return graph.binary("and", x, graph.const(int(y.attr) - 1, x.dtype))
    return graph.binary(op, x, y)


def _partly(result: Array, where: ArrayLike, out: Sequence[Array] | None) -> Traced:
    from tailgate.engine.array import chosen

    if not out:
        raise Untraceable("a function with where= and without out=", "write np.where")
    return chosen(where, result, out[0])


def _sign(x: Traced) -> Array:
    x = typed(x.graph, x, loop_types(np.sign, [x])[0])
    found: Array = np.where(x > 0, 1, np.where(x < 0, -1, 0)).astype(x.dtype)
    return np.where((x == 0) | (found != 0), found, x) if x.dtype.kind == "f" else found


def _reciprocal(x: Traced) -> Array:
    if x.dtype.kind != "f":
        raise Untraceable("np.reciprocal of whole numbers", "write 1 // x, or 1.0 / x")
    return 1.0 / x


def _copied_sign(x: Traced, y: Traced) -> Array:
    graph, word, kind = x.graph, np.dtype(np.uint64), loop_types(np.copysign, [x, y])[0]
    x, y = typed(graph, x, np.dtype(float)), typed(graph, y, np.dtype(float))
    sign = np.uint64(1 << 63)
    return ((x.view(word) & ~sign) | (y.view(word) & sign)).view(float).astype(kind)


_DERIVED: dict[np.ufunc, Callable[..., Array]] = {
    np.square: lambda x: np.multiply(*[x.astype(loop_types(np.square, [x])[0], copy=False)] * 2),
    np.positive: lambda x: x.astype(loop_types(np.positive, [x])[0]),
    np.reciprocal: _reciprocal,
    np.isfinite: lambda x: np.absolute(x) < np.inf,
    np.isnan: lambda x: x != x,
    np.isinf: lambda x: np.absolute(x) == np.inf,
    np.sign: _sign,
    np.copysign: _copied_sign,
    np.signbit: lambda x: np.less(typed(x.graph, x, np.dtype(float)).view(np.int64), 0),
}
