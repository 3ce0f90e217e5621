"""What numba compiles, without numba before anything has to be: its import alone takes longer than that of everything else together."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property, update_wrapper
from typing import Any

_waiting: list[Callable[[Any], None]] = []  # what numba is told once it is there


class Jitted:
    """A function that is compiled at its first call, or with the first compiled code that calls it; to both it is numba's dispatcher."""

    def __init__(self, function: Callable[..., Any], options: Callable[[], dict[str, Any]]) -> None:
        self.py_func, self._options = function, options
        update_wrapper(self, function)

    @cached_property
    def dispatcher(self) -> Any:
        return numba().njit(**self._options())(self.py_func)

    def __call__(self, *arguments: Any) -> Any:
        return self.dispatcher(*arguments)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.dispatcher, name)


def jit(**options: Any) -> Callable[[Callable[..., Any]], Jitted]:
    """Decorator: `numba.njit` with these options. Neither fast-math nor another division than numpy's, unless they say so."""
    return lambda function: Jitted(function, lambda: {"error_model": "numpy"} | options)


def compiled_as(function: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: what a plain function is where compiled code calls it, as `numba.extending.overload` takes it."""

    def wait(implementation: Callable[..., Any]) -> Callable[..., Any]:
        when_there(lambda held: held.extending.overload(function, jit_options={"forceinline": True})(implementation))
        return implementation

    return wait


def compilable(function: Callable[..., Any]) -> None:
    """Compiled code may call this plain function."""
    when_there(lambda held: held.extending.register_jitable(forceinline=True)(function))


def when_there(tell: Callable[[Any], None]) -> None:
    """What numba is told before anything is compiled."""
    if numba.cache_info().currsize:
        tell(numba())
    else:
        _waiting.append(tell)


@cache
def numba() -> Any:
    """The package, which from now on knows what stands here."""
    import numba as held
    from numba.extending import typeof_impl

    typeof_impl.register(Jitted)(lambda value, context: typeof_impl(value.dispatcher, context))
    for tell in _waiting:
        tell(held)
    _waiting.clear()
    return held
