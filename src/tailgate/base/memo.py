"""A cache for slow functions of models."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import wraps
from typing import TypeVar

from tailgate.base.pytree import lock

KEPT = 64  # results per function
M = TypeVar("M")
T = TypeVar("T")


def remembered(*fields: str) -> Callable[[Callable[[M], T]], Callable[[M], T]]:
    """Decorate a function of one argument that depends only on the argument's arrays of these names. Results are read-only."""

    def decorate(function: Callable[[M], T]) -> Callable[[M], T]:
        known: OrderedDict[Hashable, T] = OrderedDict()

        @wraps(function)
        def called(held: M) -> T:
            arrays = [getattr(held, name) for name in fields]
            key = tuple((array.shape, array.dtype.str, array.tobytes()) for array in arrays)
            if key not in known:
                known[key] = lock(function(held))
                while len(known) > KEPT:
                    known.popitem(last=False)
            return known[key]

        return called

    return decorate
