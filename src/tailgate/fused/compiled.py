"""Compiled functions that are kept on disk, by the sources of everything that they are made of.

Numba's own key is the file that holds the function alone: after a change of a formula in another file the old code would be loaded again.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from typing import Any

import numba
from numba.core import caching

_OPTIONS: dict[str, Any] = {"error_model": "numpy"}  # no fast-math: the bits are the plain loop's
_INNER: dict[str, Any] = {"no_cfunc_wrapper": True}
_INSIDE = numba.__version__.startswith("0.68.")  # whose inner workings `parts` knows; without them compiling takes three times as long
if _INSIDE:
    from .parts import Part, remembering

    _INNER |= {"no_cpython_wrapper": True, "_nrt": False, "pipeline_class": Part}
phase = numba.njit(**_OPTIONS, **_INNER)  # a loop over the episodes of a block
formula = numba.njit(**_OPTIONS, **_INNER, forceinline=True)  # of one episode, part of the loop that calls it; or a loop over given rows
written_in = numba.njit(**_OPTIONS, inline="always")  # as if its text stood where it is called

_SOURCES = {  # by package, which may lie in folders of their own
    "tailgate.fused": ("",), "tailgate": ("elementwise.py", "kernels.py", "kinds.py", "draws.py"),
    "tailgate.agents": ("reward.py", "scripted.py", "triggers.py", "values.py"),
    "tailgate.estimators": (
        "algorithm2.py", "detectors.py", "imm.py", "kinematic.py", "predictors.py", "reactive_brake.py", "safe_state.py",
    ),
    "tailgate.envs": (
        "vehicle.py", "idm.py", "controllers.py", "manoeuvres.py", "fmcw.py", "radar.py", "radar_car.py", "radar_following.py",
    ),
}  # fmt: skip


@cache
def digest() -> str:
    """Of the sources of the lanes and of the formulas that they share with the plain loop."""
    out = hashlib.blake2b(digest_size=16)
    for package, names in _SOURCES.items():
        for name in names:
            place = files(package).joinpath(name)
            for path in sorted(place.iterdir(), key=lambda path: path.name) if not name else [place]:
                if path.name.endswith(".py"):
                    out.update(path.name.encode() + path.read_bytes())
    return out.hexdigest()


def _by_sources(locator: Any) -> Any:
    return type(locator.__name__, (locator,), {"get_source_stamp": lambda self: digest()})


_LOCATORS = [_by_sources(c) for c in (caching.UserProvidedCacheLocator, caching.InTreeCacheLocator, caching.UserWideCacheLocator)]


class _Implementation(caching.CompileResultCacheImpl):
    _locator_classes = _LOCATORS


class _Cache(caching.FunctionCache):
    _impl_class = _Implementation


def compiled(function: Callable[..., Any]) -> Any:
    """The function, compiled at its first call of a kind; without a place to keep it, in every process anew."""
    out = numba.njit(**_OPTIONS, nogil=True)(function)
    if _INSIDE:
        out._compiler.compile = remembering()(out._compiler.compile)
    with contextlib.suppress(RuntimeError):  # no directory to write to
        out._cache = _Cache(function)  # type: ignore[no-untyped-call]
    return out
