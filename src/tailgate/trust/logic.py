"""Bounded temporal logic over sampled traces, for a whole batch at once: formulas, and their truth or robustness.

A formula is read at a sample. Atoms compare sums of signals. F, G and U look ahead over a closed interval of seconds, which begins
at that sample. Two semantics: boolean, and the robustness of Fainekos and Pappas (2009) and Donze and Maler (2010): by how
much the signals may change before the truth does. A robustness above 0 means true, one below 0 false.

A window that runs past an episode's end holds the samples that there are. Over none G is true, and F and U are false (the neutral view
of truncated paths, Eisner et al. 2003), so that F is still not G not. `response` asks no later than a deadline before the horizon, which
then cuts no deadline. An episode ends with a collision: answers that were due after it did not come.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array

SLACK = 1e-6  # of a step: 0.6 s is six steps of 0.1 s, whatever 0.6 / 0.1 rounds to
TINY = float(np.finfo(float).tiny)  # the robustness of an atom at its border: above 0 where it holds there, below where it does not
FAR = 1e9  # samples: beyond them lies no episode's end


@dataclass(frozen=True, eq=False)
class Samples:
    """B episodes: named signals (K, B), sampled every dt [s]; episode b has length[b] of the K samples, and at least one.

    horizon: samples of an episode that nothing ends; it counts where all that are there ended before.
    """

    dt: float
    length: Array  # (B,)
    values: dict[str, Array]
    horizon: int = 0

    @property
    def count(self) -> int:
        """K."""
        return max((len(value) for value in self.values.values()), default=int(self.length.max()))

    @property
    def live(self) -> Array:
        """(K, B) bool: the samples that belong to the episode."""
        return np.arange(self.count)[:, None] < self.length


def _number(x: float) -> str:
    """Return the shortest text that is read as x."""
    return str(int(x)) if x.is_integer() and abs(x) < 1e6 else repr(x)


@dataclass(frozen=True)
class Interval:
    """Seconds from the sample on, both ends included; `last` inf: to the end of the episode."""

    first: float = 0.0
    last: float = math.inf

    def __post_init__(self) -> None:
        if not 0.0 <= self.first <= self.last or math.isinf(self.first):
            raise InputError("interval", [self.first, self.last], "two times [s], 0 <= first <= last")

    def steps(self, dt: float) -> tuple[int, int | None]:
        """Return first and last sample, counted from the one that is read; None: to the end.

        Raises InputError if the interval holds no sample.
        """
        if self.first / dt > FAR:
            raise InputError("interval", f"{self}", f"one that begins within {FAR:g} samples")
        low = math.ceil(self.first / dt - SLACK)
        if self.last / dt > FAR:
            return low, None
        high = math.floor(self.last / dt + SLACK)
        if high < low:
            raise InputError("interval", f"{self}", f"one that holds a sample: they are {dt:g} s apart")
        return low, high

    def __str__(self) -> str:
        if self == Interval():
            return ""
        return f"[{_number(self.first)}, {'end' if math.isinf(self.last) else _number(self.last)}]"


@dataclass(frozen=True)
class Formula:
    """Base of all formulas."""

    @property
    def parts(self) -> tuple[Formula, ...]:
        """The formulas that it is made of."""
        return ()

    @property
    def signals(self) -> set[str]:
        """Names of the signals that it reads."""
        return set().union(*(part.signals for part in self.parts))


@dataclass(frozen=True)
class _Several(Formula):
    """Base of what joins formulas by a word."""

    of: tuple[Formula, ...] = ()

    word: ClassVar[str]
    empty: ClassVar[str]  # what it is worth of none

    @property
    def parts(self) -> tuple[Formula, ...]:
        return self.of

    def __str__(self) -> str:
        return f" {self.word} ".join(map(_bracketed, self.of)) if len(self.of) > 1 else f"({self.of[0]})" if self.of else self.empty


@dataclass(frozen=True)
class _Ahead(Formula):
    """Base of what looks ahead at one formula over an interval."""

    of: Formula
    within: Interval = field(default_factory=Interval)

    letter: ClassVar[str]

    @property
    def parts(self) -> tuple[Formula, ...]:
        return (self.of,)

    def __str__(self) -> str:
        return f"{self.letter}{self.within} {_bracketed(self.of)}"


@dataclass(frozen=True)
class Atom(Formula):
    """sum of factor x signal + constant > 0, or >= 0 where not `strict`."""

    terms: tuple[tuple[str, float], ...]
    constant: float = 0.0
    strict: bool = True

    @property
    def signals(self) -> set[str]:
        return {name for name, _ in self.terms}

    def __str__(self) -> str:
        equal = "" if self.strict else "="
        if len(self.terms) == 1 and abs(self.terms[0][1]) == 1.0:
            name, factor = self.terms[0]
            return f"{name} >{equal} {_number(-self.constant)}" if factor > 0.0 else f"{name} <{equal} {_number(self.constant)}"
        shown = [name if factor == 1.0 else f"{_number(factor)} * {name}" for name, factor in self.terms]
        return f"{' + '.join([*shown, *([_number(self.constant)] if self.constant or not shown else [])])} >{equal} 0"


@dataclass(frozen=True)
class Not(Formula):
    """The negation of a formula."""

    of: Formula

    @property
    def parts(self) -> tuple[Formula, ...]:
        return (self.of,)

    def __str__(self) -> str:
        return f"not {_bracketed(self.of)}"


@dataclass(frozen=True)
class And(_Several):
    """All of them; of none, true."""

    word, empty = "and", "true"


@dataclass(frozen=True)
class Or(_Several):
    """One of them at least; of none, false."""

    word, empty = "or", "false"


@dataclass(frozen=True)
class Eventually(_Ahead):
    """F[a,b]: at some sample of the interval."""

    letter = "F"


@dataclass(frozen=True)
class Always(_Ahead):
    """G[a,b]: at every sample of the interval."""

    letter = "G"


@dataclass(frozen=True)
class Until(Formula):
    """left U[a,b] right: right at some sample of the interval, and left at every sample from now until just before it."""

    left: Formula
    right: Formula
    within: Interval = field(default_factory=Interval)

    @property
    def parts(self) -> tuple[Formula, ...]:
        return self.left, self.right

    def __str__(self) -> str:
        return f"{_bracketed(self.left)} U{self.within} {_bracketed(self.right)}"


def _bracketed(formula: Formula) -> str:
    return str(formula) if str(formula) in ("true", "false") else f"({formula})"


def implies(a: Formula, b: Formula) -> Formula:
    """Return the formula: wherever a holds, b does."""
    return Or((Not(a), b))


def response(trigger: Formula, answer: Formula, deadline: float, last: float) -> Formula:
    """Return the formula: whenever the trigger holds, up to `last` [s], the answer comes within the deadline [s], or at once."""
    return Always(implies(trigger, Eventually(answer, Interval(0.0, deadline))), Interval(0.0, last))


class _Algebra(NamedTuple):
    """A semantics: truth and falsehood, the worth of an atom, and of a negation. `and` is the least, `or` the greatest."""

    top: bool | float
    bottom: bool | float
    atom: Callable[[Array, bool], Array]
    negation: Callable[[Array], Array]


_BOOLEAN = _Algebra(True, False, lambda x, strict: x > 0.0 if strict else x >= 0.0, np.logical_not)
_ROBUST = _Algebra(np.inf, -np.inf, lambda x, strict: np.where(x == 0.0, -TINY if strict else TINY, x), np.negative)


def holds(formula: Formula, samples: Samples) -> Array:
    """Return (B,) bool: whether each episode satisfies the formula, read at its first sample. Raises InputError where it cannot be read."""
    return np.asarray(along(formula, samples)[0])


def robustness(formula: Formula, samples: Samples) -> Array:
    """Return (B,) of each episode: above 0 where the formula holds, below where it does not [unit of the atom that decides].

    It is never 0: where an atom is at its border, its truth decides by TINY.
    """
    return np.asarray(robustness_along(formula, samples)[0])


def robustness_along(formula: Formula, samples: Samples) -> Array:
    """Return (K, B): the robustness read at every sample; samples after an episode's end say nothing."""
    _check(formula, samples, 0)
    return _value(formula, samples, _ROBUST)


def along(formula: Formula, samples: Samples) -> Array:
    """Return (K, B) bool: the formula read at every sample; samples after an episode's end say nothing."""
    _check(formula, samples, 0)
    return _value(formula, samples, _BOOLEAN)


def _check(formula: Formula, samples: Samples, start: int) -> None:
    """Raise InputError for signals that are not there, and windows that begin after the last sample: what they say is no property.

    The horizon counts, not the episodes: a window behind the end of an episode is empty, whatever others play along.
    """
    if isinstance(formula, Atom) and (missing := formula.signals - set(samples.values)):
        raise InputError("formula", sorted(missing), f"signals that are there: {', '.join(sorted(samples.values))}")
    window, most = getattr(formula, "within", None), max(samples.count, samples.horizon)
    if window is not None:
        start += window.steps(samples.dt)[0]
        if start >= most:
            raise InputError("formula", str(formula), f"windows that begin by the last sample, {(most - 1) * samples.dt:g} s")
    for part in formula.parts:
        _check(part, samples, start)


def _value(formula: Formula, samples: Samples, algebra: _Algebra) -> Array:
    """Return (K, B) at every sample."""
    shape = samples.count, len(samples.length)
    if isinstance(formula, Atom):
        return algebra.atom(_margin(formula, samples), formula.strict)
    parts = [_value(part, samples, algebra) for part in formula.parts]
    if isinstance(formula, Not):
        return algebra.negation(parts[0])
    if isinstance(formula, And | Or):
        greatest, empty = isinstance(formula, Or), algebra.bottom if isinstance(formula, Or) else algebra.top
        out = np.full(shape, empty)
        for part in parts:
            out = np.maximum(out, part) if greatest else np.minimum(out, part)
        return out
    if isinstance(formula, Eventually | Always):
        greatest = isinstance(formula, Eventually)
        empty = algebra.bottom if greatest else algebra.top
        first, last = _ends(formula.within, samples)
        known = np.where(samples.live, parts[0], empty)
        return _shifted(_window(known, last - first + 1, np.maximum if greatest else np.minimum, empty), first, empty)
    assert isinstance(formula, Until)
    first, last = _ends(formula.within, samples)
    left, right = np.where(samples.live, parts[0], algebra.top), np.where(samples.live, parts[1], algebra.bottom)
    later = _shifted(_until(left, right, last - first + 1, algebra), first, algebra.bottom)
    return np.minimum(_window(left, first, np.minimum, algebra.top), later) if first else later


def _ends(within: Interval, samples: Samples) -> tuple[int, int]:
    first, last = within.steps(samples.dt)
    most = max(samples.count - 1, first)
    return first, most if last is None else min(last, most)


def _margin(atom: Atom, samples: Samples) -> Array:
    """Return (K, B) what an atom compares with 0."""
    out = np.full((samples.count, len(samples.length)), atom.constant)
    with np.errstate(invalid="ignore"):
        for name, factor in atom.terms:
            if factor:
                out = out + factor * samples.values[name]
    if np.isnan(out[samples.live]).any():
        raise InputError("formula", str(atom), "a comparison that is a number at every sample; two of its signals are infinite")
    return out


def _shifted(x: Array, steps: int, empty: bool | float) -> Array:
    """Return the samples `steps` later."""
    if not steps:
        return x
    out = np.full_like(x, empty)
    out[: max(len(x) - steps, 0)] = x[steps:]
    return out


def _window(x: Array, width: int, of: Callable[[Array, Array], Array], empty: bool | float) -> Array:
    """Apply `of` to `width` samples from each on; by windows of twice the width each time."""
    reach = 1
    while 2 * reach <= width:
        x = of(x, _shifted(x, reach, empty))
        reach *= 2
    return of(x, _shifted(x, width - reach, empty)) if reach < width else x


def _until(left: Array, right: Array, width: int, algebra: _Algebra) -> Array:
    """Return left U right over `width` samples from each on; windows are put together: until(m + n) = until(m) or all(m) and until(n)."""
    out, every, done = np.full_like(right, algebra.bottom), np.full_like(left, algebra.top), 0
    block, whole, size = right, left, 1  # until and all over `size` samples
    while done < width:
        if (width - done) & size:
            out = np.maximum(out, np.minimum(every, _shifted(block, done, algebra.bottom)))
            every = np.minimum(every, _shifted(whole, done, algebra.top))
            done += size
        if done < width:
            block = np.maximum(block, np.minimum(whole, _shifted(block, size, algebra.bottom)))
            whole = np.minimum(whole, _shifted(whole, size, algebra.top))
            size *= 2
    return out
