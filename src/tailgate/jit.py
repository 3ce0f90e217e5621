"""What numba compiles, without numba before anything has to be: its import alone takes longer than that of everything else together."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property, update_wrapper
from typing import Any


class Jitted:
    """A function that is compiled at its first call, or with the first compiled code that calls it; to both it is numba's dispatcher."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.py_func, self._options = function, options
        update_wrapper(self, function)

    @cached_property
    def dispatcher(self) -> Any:
        return _numba().njit(**self._options)(self.py_func)

    def __call__(self, *arguments: Any) -> Any:
        return self.dispatcher(*arguments)


def jit(**options: Any) -> Callable[[Callable[..., Any]], Jitted]:
    """Decorator: `numba.njit` with these options. Neither fast-math nor another division than numpy's, unless they say so."""
    return lambda function: Jitted(function, {"error_model": "numpy"} | options)


@cache
def _numba() -> Any:
    """The package, which from now on knows what a `Jitted` is where another one calls it."""
    import numba
    from numba.extending import typeof_impl

    typeof_impl.register(Jitted)(lambda value, context: typeof_impl(value.dispatcher, context))
    return numba
