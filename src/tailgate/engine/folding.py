"""Operations that change nothing, and choices among constants: found while a graph is made."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tailgate.engine.graph import Node

CHOSEN = 9  # nodes of a choice that is carried through operations


def is_choice(node: Node) -> bool:
    """Return True for a choice among few constant whole numbers, such as kinds of an attack: what depends on it alone is one too."""
    left, seen = [node], 0
    while left:
        one = left.pop()
        seen += 1
        if one.op not in ("select", "const") or one.dtype.kind not in "iu" or seen > CHOSEN:
            return False
        left.extend(one.args[1:])
    return seen > 1


def _is(node: Node, value: float) -> bool:
    """Return True if the node is this constant; 0.0 and -0.0 differ."""
    return node.op == "const" and node.attr == value and bool(np.signbit(node.attr)) == (str(value)[0] == "-")


def identity(op: str, x: Node, y: Node) -> Node | None:
    """Return x op y if it needs no computation and keeps every bit; else None."""
    kind = x.dtype.kind
    if kind == "f":
        if (op in ("mul", "div") and _is(y, 1.0)) or (op == "sub" and _is(y, 0.0)) or (op == "add" and _is(y, -0.0)):
            return x
        return y if (op == "mul" and _is(x, 1.0)) or (op == "add" and _is(x, -0.0)) else None
    if kind == "b" and op in ("and", "or"):
        for this, other in ((x, y), (y, x)):
            if this.op == "const":
                return other if bool(this.attr) == (op == "and") else this
    elif kind in "iu" and op in ("add", "or", "xor", "shl", "shr"):
        if y.op == "const" and y.attr == 0:
            return x
        if x.op == "const" and x.attr == 0 and op in ("add", "or", "xor"):
            return y
    return x if x is y and op in ("and", "or", "min", "max") else None
