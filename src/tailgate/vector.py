"""Eight numbers that are one for numba: a vector of the processor where it has one that wide, else two or four.

+ - * / of them are one instruction each, whatever the compiler thinks of the loop around it; lanes do not mix, and nothing is contracted.
Numba's cache of a kernel does not see a change of this file: `tailgate.lanes`, whose kernels are made of it, has to change with it.
"""

import operator
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

WIDTH = 8
_VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)


class _Lanes(types.Type):
    """Eight float64."""


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


def _operation(symbol: Any, name: str) -> None:
    @type_callable(symbol)
    def typed(context: Any) -> Any:
        return lambda x, y: _lanes if x is y is _lanes else None

    @lower_builtin(symbol, _Lanes, _Lanes)
    def lowered(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return getattr(builder, name)(*args)


_lanes = _Lanes("Lanes")
for _symbol, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv")):
    _operation(_symbol, _name)


def _place(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    return builder.bitcast(builder.gep(context.make_array(kind)(context, builder, array).data, [at]), _VECTOR.as_pointer())


def _get(typing: Any, array: Any, at: Any) -> Any:
    """The eight numbers of a flat array from `at` on."""

    def make(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_place(context, builder, signature.args[0], *args), align=8)

    return _lanes(array, types.uintp), make


def _put(typing: Any, array: Any, at: Any, value: Any) -> Any:
    """Writes eight numbers to a flat array from `at` on."""

    def make(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], _place(context, builder, signature.args[0], *args[:2]), align=8)
        return context.get_dummy_value()

    return types.void(array, types.uintp, _lanes), make


def _alike(typing: Any, number: Any) -> Any:
    """One number in all eight lanes."""

    def make(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        nothing, index = ir.Constant(_VECTOR, ir.Undefined), ir.IntType(32)
        first = builder.insert_element(nothing, args[0], ir.Constant(index, 0))
        return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(index, WIDTH), [0] * WIDTH))

    return _lanes(types.float64), make


get: Any = intrinsic(_get)
put: Any = intrinsic(_put)
alike: Any = intrinsic(_alike)
