"""Reasons why code cannot be traced, and the comparison of traced code with the plain loop."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.pytree import leaves, map_leaves
from tailgate.engine.operations import Array
from tailgate.engine.untraceable import Untraceable

if TYPE_CHECKING:
    from tailgate.engine.program import Program

T = TypeVar("T")
S = TypeVar("S")
L = TypeVar("L", bound="Defended")
TRIED, ROWS = 24, 64  # steps and episodes in which new code is compared with the plain loop
FEW, ENOUGH = 8, 2  # episodes that are compared further where others end with an error, and steps that suffice if fewer are left


class Untraced(NamedTuple):
    """The reason why the plain loop runs instead of the engine."""

    why: str


class Defended(Protocol):
    """A loop, as far as it matters here."""

    @property
    def defence(self) -> object:
        """The loop's defence."""


def check_open(loop: L) -> L:
    """Return the loop. Raise TypeError for a defence that runs in another process or declares itself untraceable."""
    defence = loop.defence
    if why := getattr(defence, "opaque", "") or getattr(defence, "untraced", ""):
        raise TypeError(f"the defence {type(defence).__name__} is not traced: {why}")
    return loop


def explained(error: Exception) -> str:
    """Return the text of a failure, with the line of the traced code."""
    if isinstance(error, Untraceable):
        return str(error)
    steps = traceback.extract_tb(error.__traceback__)
    own = [step for step in steps if not step.filename.startswith(str(Path(__file__).parent)) and "/numpy/" not in step.filename]
    place = f"{own[-1].filename}:{own[-1].lineno}: " if own else ""
    return f"{place}{type(error).__name__}: {' '.join(str(error).split())[:300]}"


def raised(play: Callable[[], T]) -> T | InputError:
    """Call `play`; return its result or its InputError."""
    try:
        return play()
    except InputError as error:
        return error


def compared(compare: Callable[[list[int]], str | tuple[InputError, int]]) -> str:
    """Compare two engines on the episodes `rows`; where some end both with an equal error, after a number of steps, go on without them."""
    rows, most = list(range(ROWS)), 0
    while True:
        answer = compare(rows)
        if isinstance(answer, str):
            return answer
        error, steps = answer
        rows, most = [row for i, row in enumerate(rows) if i not in error.rows], max(most, steps)
        if not error.rows or len(rows) < FEW:
            return "" if most >= ENOUGH else f"the errors that end most episodes, such as {error}"


def apart(
    program: Program, begun: S, step: Callable[[S], tuple[S, Mapping[str, Array]]], horizon: int, later: Callable[[S, Array], S]
) -> str:  # fmt: skip
    """Play some steps of a program without arguments, and the same by the plain `step`; return the first difference, or nothing.

    begun: the state of some episodes. step: returns the next state and its results. later: the state some steps (B,) later.
    In the second half of the steps, every other episode goes on at a later step. What begins late, such as an attack, is compared too.
    """
    steps, first = min(TRIED, horizon), begun
    rows = len(next(iter(leaves(begun).values())))
    state = program.rows(rows)
    state.put(begun)
    call = program.call(state, 2)  # the form that plays: several steps, of which each is one
    for number in range(1, steps + 1):
        if number == steps // 2 + 1:
            begun = later(begun, np.linspace(0, horizon - steps, rows).astype(np.int64) * (np.arange(rows) % 2))
            state.put(begun)
        call.begin()
        call.play(1)
        results = {name: value[0] for name, value in call.results().items()}
        found = raised(lambda: step(begun))  # noqa: B023
        if isinstance(found, InputError):
            broken = ~results["demands"].all(axis=1) if "demands" in results else np.zeros(rows, bool)
            if not broken.any():
                return f"step {number}: {found}"
            if found.rows and set(found.rows) != set(np.flatnonzero(broken).tolist()):
                return f"whose numbers break a demand, step {number}"
            kept = np.flatnonzero(~broken)
            if len(kept) < FEW and number > ENOUGH:
                return ""
            if len(kept) < FEW:
                return f"the errors that end most episodes, such as {found}"
            return apart(program, map_leaves(lambda leaf: leaf[kept], first), step, horizon, later)  # noqa: B023
        if "demands" in results and not results["demands"].all():
            return f"a demand, step {number}"
        begun, wanted = found
        got, held = results | {name: state.get_leaf(name) for name in program.places}, leaves(begun) | dict(wanted)
        for name in (*program.places, *wanted):
            if not same(got[name], held[name]):
                return f"{name}, step {number}"
    return ""


def same(got: Array, wanted: Array) -> bool:
    """Return True if both arrays are equal to the bit, except for the sign and payload of NaN."""
    if got.dtype != wanted.dtype or got.shape != wanted.shape or not np.array_equal(got, wanted, equal_nan=got.dtype.kind == "f"):
        return False
    return got.dtype.kind != "f" or bool(((np.signbit(got) == np.signbit(wanted)) | (got != got)).all())
