"""Python's operators in traced code. On two of Python's numbers, as parameters are, they do what Python does; else what numpy does.

A traced number of Python's has its type in `weak`. The sum of two is a number again; `np.add` of them is a number of numpy's.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from tailgate.engine.graph import Node
from tailgate.engine.operations import BOOL, COMPARISONS, FLOAT, INT, SMALL

if TYPE_CHECKING:
    from tailgate.engine.array import Traced

T = TypeVar("T")
Operator = Callable[..., Any]
_PAIRS: dict[str, tuple[Operator, np.ufunc]] = {
    "add": (operator.add, np.add), "sub": (operator.sub, np.subtract), "mul": (operator.mul, np.multiply),
    "truediv": (operator.truediv, np.true_divide), "floordiv": (operator.floordiv, np.floor_divide), "mod": (operator.mod, np.remainder),
    "and": (operator.and_, np.bitwise_and), "or": (operator.or_, np.bitwise_or), "xor": (operator.xor, np.bitwise_xor),
    "lshift": (operator.lshift, np.left_shift), "rshift": (operator.rshift, np.right_shift), "matmul": (operator.matmul, np.matmul),
}  # fmt: skip
_COMPARISONS: dict[str, tuple[Operator, np.ufunc]] = {
    "lt": (operator.lt, np.less), "le": (operator.le, np.less_equal), "gt": (operator.gt, np.greater),
    "ge": (operator.ge, np.greater_equal), "eq": (operator.eq, np.equal), "ne": (operator.ne, np.not_equal),
}  # fmt: skip
_SINGLES: dict[str, tuple[Operator, np.ufunc]] = {
    "neg": (operator.neg, np.negative), "abs": (operator.abs, np.absolute), "invert": (operator.invert, np.invert),
    "pos": (operator.pos, np.positive),
}  # fmt: skip
_OF_NODES: dict[Operator, str] = {
    operator.add: "add", operator.sub: "sub", operator.mul: "mul", operator.truediv: "div", operator.neg: "neg", operator.abs: "abs",
    operator.lt: "lt", operator.le: "le", operator.gt: "gt", operator.ge: "ge", operator.eq: "eq", operator.ne: "ne",
}  # fmt: skip


def with_operators(kind: type[T]) -> type[T]:
    """Define Python's operators of a class of arrays, also reflected and in place."""

    def straight(operate: Operator, ufunc: np.ufunc) -> Operator:
        return lambda self, other: ufunc(self, other) if self.weak is None else operated(operate, ufunc, self, other)

    def reflected(operate: Operator, ufunc: np.ufunc) -> Operator:
        return lambda self, other: ufunc(other, self) if self.weak is None else operated(operate, ufunc, other, self)

    def in_place(operate: Operator, ufunc: np.ufunc) -> Operator:
        def changed(self: Any, other: Any) -> Any:
            return ufunc(self, other, out=(self,)) if self.ndim else operate(self, other)  # a number cannot be written to

        return changed

    def single(operate: Operator, ufunc: np.ufunc) -> Operator:
        return lambda self: ufunc(self) if self.weak is None else operated(operate, ufunc, self)

    for name, (operate, ufunc) in _PAIRS.items():
        setattr(kind, f"__{name}__", straight(operate, ufunc))
        setattr(kind, f"__r{name}__", reflected(operate, ufunc))
        setattr(kind, f"__i{name}__", in_place(operate, ufunc))
    for name, (operate, ufunc) in _COMPARISONS.items():
        setattr(kind, f"__{name}__", straight(operate, ufunc))
    for name, (operate, ufunc) in _SINGLES.items():
        setattr(kind, f"__{name}__", single(operate, ufunc))
    return kind


def operated(operate: Operator, ufunc: np.ufunc, *parts: Any) -> Any:
    """Return what an operator makes of operands, of which one at least is a traced number."""
    kinds = [_kind(part) for part in parts]
    if None not in kinds:
        return _of_numbers(operate, parts, kinds)
    if any(isinstance(part, (list, tuple, str)) for part in parts):  # n * [0.0] is a longer list
        return operate(*(python_number(part) if kind else part for part, kind in zip(parts, kinds, strict=True)))
    return ufunc(*parts)


def python_number(x: Any) -> Any:
    """Return the number that a traced number holds; the code depends on it."""
    return x.values().item() if hasattr(x, "weak") else x


def _kind(x: Any) -> type | None:
    kind: type | None = getattr(x, "weak", None)
    return kind or (type(x) if type(x) in (bool, int, float) else None)


def _of_numbers(operate: Operator, parts: tuple[Any, ...], kinds: list[Any]) -> Traced:
    from tailgate.engine.array import elementwise, lifted, typed

    graph = next(part.graph for part in parts if hasattr(part, "weak"))
    name, whole = _OF_NODES.get(operate, ""), float not in kinds
    arrays = [lifted(graph, part) for part in parts]
    if operate is operator.pos and kinds != [bool]:
        return arrays[0]
    if name == "div" and not arrays[1].nonzero_places():
        raise ZeroDivisionError("division by zero")
    if not name or (whole and any(_large(a) or (name == "mul" and _made(a)) for a in arrays)):  # Python's whole numbers have no end
        return lifted(graph, operate(*map(python_number, arrays)))
    dtype = INT if whole and name != "div" else FLOAT
    made = elementwise(graph, _on_nodes(graph, name), [typed(graph, a, dtype) for a in arrays], BOOL if name in COMPARISONS else dtype)
    made.weak = bool if name in COMPARISONS else int if dtype == INT else float
    return made


def _on_nodes(graph: Any, name: str) -> Callable[..., Node]:
    def on_nodes(*nodes: Node) -> Node:
        found: Node = graph.binary(name, *nodes) if len(nodes) == 2 else graph.unary(name, *nodes)
        return found

    return on_nodes


def _made(x: Traced) -> bool:
    """Return True for the result of an operation: a product of products may leave 64 bits."""
    return x.nodes.item().op not in ("const", "uniform")


def _large(x: Traced) -> bool:
    """Return True for a whole number in the code, and no parameter, of which few products leave 64 bits."""
    return x.nodes.item().op == "const" and abs(int(x.nodes.item().attr)) >= SMALL
