"""A cache for slow functions of models."""

from collections import OrderedDict
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

from tailgate.base.pytree import lock

KEPT = 64  # results per function
T = TypeVar("T")


def remembered(*fields: str) -> Callable[[Callable[[Any], T]], Callable[[Any], T]]:
    """Decorate a function of one argument that depends only on the argument's arrays of these names. Results are read-only."""

    def decorate(function: Callable[[Any], T]) -> Callable[[Any], T]:
        known: OrderedDict[Any, T] = OrderedDict()

        @wraps(function)
        def called(held: Any) -> T:
            arrays = [getattr(held, name) for name in fields]
            key = tuple((array.shape, array.dtype.str, array.tobytes()) for array in arrays)
            if key not in known:
                known[key] = lock(function(held))
                while len(known) > KEPT:
                    known.popitem(last=False)
            return known[key]

        return called

    return decorate
