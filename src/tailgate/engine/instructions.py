"""LLVM instructions for the simple operations of a graph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tailgate.engine.graph import Node
from tailgate.engine.operations import BOOL

if TYPE_CHECKING:
    from tailgate.engine.llvm import Emitter

_TYPES = {"f8": "double", "f4": "float", "b1": "i1"} | {f"{kind}{size}": f"i{8 * size}" for kind in "iu" for size in (1, 2, 4, 8)}
_FLOAT_ORDER = {"lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge", "eq": "oeq", "ne": "une"}
_ROUNDED = {"sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "trunc": "trunc", "rint": "rint"}


def code(dtype: np.dtype[Any]) -> str:
    """Return a type's kind and size, such as f8."""
    return f"{dtype.kind}{dtype.itemsize}"


def scalar(dtype: np.dtype[Any]) -> str:
    """Return LLVM's name of a type."""
    return _TYPES[code(dtype)]


def operation(e: Emitter, node: Node) -> str:
    """Emit an operation of one or two arguments, a select, or a conversion."""
    op, dtype, lanes = node.op, node.dtype, e.lanes
    args = [e.value(a) for a in node.args]
    of = node.args[0].dtype
    kind, result = e.vector(of), e.vector(dtype)
    floats = of.kind == "f"
    if op == "select":
        return e.set(f"select {kind} {args[0]}, {result} {args[1]}, {result} {args[2]}")
    if op == "bits":
        return args[0] if scalar(of) == scalar(dtype) else e.set(f"bitcast {kind} {args[0]} to {result}")
    if op == "cast":
        return cast(e, args[0], of, dtype)
    if op in _FLOAT_ORDER:
        if floats:
            return e.set(f"fcmp {_FLOAT_ORDER[op]} {kind} {args[0]}, {args[1]}")
        order = op if op in ("eq", "ne") else ("s" if of.kind == "i" else "u") + op
        return e.set(f"icmp {order} {kind} {args[0]}, {args[1]}")
    if op in ("min", "max"):
        return smaller(e, node, args, "lt" if op == "min" else "gt")
    if op in ("add", "sub", "mul"):
        return e.set(f"{'f' if floats else ''}{op} {kind} {args[0]}, {args[1]}")
    if op in ("and", "or", "xor", "shl"):
        return e.set(f"{op} {kind} {args[0]}, {args[1]}")
    if op == "div":
        return e.set(f"fdiv {kind} {args[0]}, {args[1]}")
    if op == "shr":
        return e.set(f"{'ashr' if of.kind == 'i' else 'lshr'} {kind} {args[0]}, {args[1]}")
    if op == "rem":
        return remainder(e, kind, args, of.kind == "i")
    if op == "neg":
        return e.set(f"fneg {kind} {args[0]}" if floats else f"sub {kind} zeroinitializer, {args[0]}")
    if op == "not":
        return e.set(f"xor {kind} {args[0]}, splat ({scalar(of)} {'true' if of == BOOL else -1})")
    if op == "abs" and not floats:
        return e.set(f"select <{lanes} x i1> {e.set(f'icmp slt {kind} {args[0]}, zeroinitializer')}, {kind} "
                     f"{e.set(f'sub {kind} zeroinitializer, {args[0]}')}, {kind} {args[0]}") if of.kind == "i" else args[0]  # fmt: skip
    name = f"@llvm.{_ROUNDED.get(op, 'fabs')}.v{lanes}f{8 * of.itemsize}"
    e.declared.add(f"declare {kind} {name}({kind})")
    return e.set(f"call {kind} {name}({kind} {args[0]})")


def smaller(e: Emitter, node: Node, args: Sequence[str], order: str) -> str:
    """Emit min or max, as `operations.minimum` defines them."""
    x, y = node.args
    kind, lanes = e.vector(x.dtype), e.lanes
    if x.dtype.kind == "f":
        if y.op == "const" and y.attr == y.attr:
            first = e.set(f"fcmp u{order} {kind} {args[0]}, {args[1]}")
        else:
            first = e.set(f"fcmp o{order} {kind} {args[0]}, {args[1]}")
            if not (x.op == "const" and x.attr == x.attr):
                first = e.set(f"or <{lanes} x i1> {first}, {e.set(f'fcmp uno {kind} {args[0]}, {args[0]}')}")
    else:
        first = e.set(f"icmp {'s' if x.dtype.kind == 'i' else 'u'}{order} {kind} {args[0]}, {args[1]}")
    return e.set(f"select <{lanes} x i1> {first}, {kind} {args[0]}, {kind} {args[1]}")


def remainder(e: Emitter, kind: str, args: Sequence[str], signed: bool) -> str:
    """Emit the remainder by a positive constant, which is never negative."""
    if not signed:
        return e.set(f"urem {kind} {args[0]}, {args[1]}")
    rest = e.set(f"srem {kind} {args[0]}, {args[1]}")
    below = e.set(f"icmp slt {kind} {rest}, zeroinitializer")
    return e.set(f"select <{e.lanes} x i1> {below}, {kind} {e.set(f'add {kind} {rest}, {args[1]}')}, {kind} {rest}")


def cast(e: Emitter, x: str, of: np.dtype[Any], to: np.dtype[Any]) -> str:
    """Emit the conversion of x, as `operations.converted` defines it."""
    kind, result, lanes = e.vector(of), e.vector(to), e.lanes
    if of == BOOL:
        if to.kind == "f":
            return e.set(f"select {kind} {x}, {result} {e.splat(to.type(1))}, {result} zeroinitializer")
        return e.set(f"zext {kind} {x} to {result}")
    if to == BOOL:
        return e.set(f"{'fcmp une' if of.kind == 'f' else 'icmp ne'} {kind} {x}, zeroinitializer")
    if of.kind == to.kind == "f":
        return e.set(f"{'fptrunc' if to.itemsize < of.itemsize else 'fpext'} {kind} {x} to {result}")
    if of.kind == "f":
        if of.itemsize < 8:
            x, kind = e.set(f"fpext {kind} {x} to <{lanes} x double>"), f"<{lanes} x double>"
        lower = e.set(f"fcmp oge {kind} {x}, splat (double 0xC3E0000000000000)")
        upper = e.set(f"fcmp olt {kind} {x}, splat (double 0x43E0000000000000)")
        holds = e.set(f"and <{lanes} x i1> {lower}, {upper}")
        inside = e.set(f"select <{lanes} x i1> {holds}, {kind} {x}, {kind} zeroinitializer")
        whole = e.set(f"fptosi {kind} {inside} to <{lanes} x i64>")
        held = e.set(f"select <{lanes} x i1> {holds}, <{lanes} x i64> {whole}, <{lanes} x i64> splat (i64 -9223372036854775808)")
        return held if to.itemsize == 8 else e.set(f"trunc <{lanes} x i64> {held} to {result}")
    if to.kind == "f":
        return e.set(f"{'si' if of.kind == 'i' else 'ui'}tofp {kind} {x} to {result}")
    if of.itemsize == to.itemsize:
        return x
    how = "trunc" if of.itemsize > to.itemsize else "sext" if of.kind == "i" else "zext"
    return e.set(f"{how} {kind} {x} to {result}")
