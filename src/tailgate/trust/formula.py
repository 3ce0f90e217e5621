"""Formulas as text: G[0,60] gap > 2, G (attack -> F[0,0.6] applied <= -2). Times are seconds.

    formula  or [-> formula]                   or    and {or and}               and   until {and until}
    until    prefix [U[a,b] until]             prefix  not prefix | F[a,b] prefix | G[a,b] prefix | (formula) | true | false | atom
    atom     sum > sum, and >=, <, <=; a signal by itself: above 0.5
    sum      terms with + and -; a term is a number, a signal, or both with *

An interval that is left out, or that ends with `end`, runs to the end of the episode. Read by recursive descent: a text runs nothing.
"""

from __future__ import annotations

import math
import re
from collections.abc import Container

from tailgate.base.errors import InputError

from .logic import Always, And, Atom, Eventually, Formula, Interval, Not, Or, Until, implies

LONGEST = 4000  # characters
DEEPEST = 60  # brackets and operators within each other
_TOKEN = re.compile(r"\s*(?:(\d+(?:\.\d*)?(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?)|([A-Za-z_]\w*(?:@\d+)?)|(->|>=|<=|[-+*()\[\],<>]))")
_WORDS = ("and", "or", "not", "true", "false", "end", "F", "G", "U")
Terms = dict[str, float]  # factor of each signal; "" is the constant


def parse(text: str, flags: Container[str] | None = None) -> Formula:
    """Return a formula from its text; `flags` are the signals that may stand by themselves, none given: all.

    Raises InputError that shows where it cannot be read.
    """
    reader = _Reader(text, flags)
    found = reader.formula()
    if reader.token:
        raise reader.error("the end, or and, or, ->, U")
    return found


class _Reader:
    """The tokens of a text, one ahead."""

    def __init__(self, text: str, flags: Container[str] | None) -> None:
        if not isinstance(text, str) or len(text) > LONGEST:
            raise InputError("formula", text, f"a text of at most {LONGEST} characters")
        self.text, self.flags, self.at, self.depth = text, flags, 0, 0
        self.kind, self.token = 0, ""
        self.next()

    def next(self) -> str:
        """Return the token that was ahead; reads the one after it."""
        before = self.token
        found = _TOKEN.match(self.text, self.at)
        if found is None and self.text[self.at :].strip():
            self.token = self.text[self.at :].strip()[0]
            raise self.error("a number, a name, an operator or a bracket")
        self.kind = found.lastindex or 0 if found else 0
        self.token = found[self.kind] if found else ""
        self.start, self.at = (found.start(self.kind), found.end()) if found else (len(self.text), len(self.text))
        return before

    def error(self, wanted: str) -> InputError:
        shown = f"{self.token!r} at character {getattr(self, 'start', self.at) + 1}" if self.token else "the end"
        return InputError("formula", self.text, f"{wanted}, in place of {shown}")

    def take(self, *tokens: str) -> str:
        """Return the token ahead if it is one of these; else nothing, and empty."""
        return self.next() if self.token in tokens else ""

    def need(self, token: str) -> None:
        if not self.take(token):
            raise self.error(repr(token))

    def formula(self) -> Formula:
        self.depth += 1
        if self.depth > DEEPEST:
            raise InputError("formula", self.text, f"at most {DEEPEST} brackets and operators within each other")
        left = self._or()
        out = implies(left, self.formula()) if self.take("->") else left
        self.depth -= 1
        return out

    def _or(self) -> Formula:
        found = [self._and()]
        while self.take("or"):
            found.append(self._and())
        return Or(tuple(found)) if len(found) > 1 else found[0]

    def _and(self) -> Formula:
        found = [self._until()]
        while self.take("and"):
            found.append(self._until())
        return And(tuple(found)) if len(found) > 1 else found[0]

    def _until(self) -> Formula:
        left = self._prefix()
        if not self.take("U"):
            return left
        within = self._interval()
        return Until(left, self._deeper(self._until), within)

    def _deeper(self, read: object) -> Formula:
        self.depth += 1
        if self.depth > DEEPEST:
            raise InputError("formula", self.text, f"at most {DEEPEST} brackets and operators within each other")
        assert callable(read)
        found = read()
        self.depth -= 1
        assert isinstance(found, Formula)
        return found

    def _prefix(self) -> Formula:
        if self.take("not"):
            return Not(self._deeper(self._prefix))
        if word := self.take("F", "G"):
            within = self._interval()
            of = self._deeper(self._prefix)
            return Eventually(of, within) if word == "F" else Always(of, within)
        if self.take("("):
            found = self.formula()
            self.need(")")
            return found
        if word := self.take("true", "false"):
            return And() if word == "true" else Or()
        return self._atom()

    def _interval(self) -> Interval:
        if not self.take("["):
            return Interval()
        first = self._number()
        self.need(",")
        last = math.inf if self.take("end") else self._number()
        self.need("]")
        return Interval(first, last)

    def _number(self) -> float:
        if self.kind != 1:
            raise self.error("a number")
        return self._finite()

    def _finite(self) -> float:
        value = float(self.next())
        if math.isinf(value):
            raise self.error("a number that can be held")
        return value

    def _atom(self) -> Formula:
        left = self._sum()
        sign = self.take(">", ">=", "<", "<=")
        if not sign:
            name = next(iter(left))
            if left != {name: 1.0} or not name or (self.flags is not None and name.partition("@")[0] not in self.flags):
                raise self.error("one of >, >=, <, <=")
            return _compared(left, {"": 0.5}, True)
        right = self._sum()
        if self.token in (">", ">=", "<", "<="):
            raise self.error("one comparison at a time, joined by and")
        return _compared(left, right, len(sign) == 1) if sign[0] == ">" else _compared(right, left, len(sign) == 1)

    def _sum(self) -> Terms:
        out: Terms = {}
        sign = -1.0 if self.take("-") else 1.0
        while True:
            name, factor = self._term()
            out[name] = out.get(name, 0.0) + sign * factor
            word = self.take("+", "-")
            if not word:
                return out
            sign = 1.0 if word == "+" else -1.0

    def _term(self) -> tuple[str, float]:
        factor, name = 1.0, ""
        if sign := self.take("-"):
            factor = -1.0
        if self.kind == 1:
            factor *= self._finite()
            if not self.take("*"):
                return "", factor
        if self.kind != 2 or self.token in _WORDS:
            raise self.error("a signal" if sign or factor != 1.0 else "a signal, a number, not, F, G or (")
        name = self.next()
        if self.take("*"):
            factor *= (-1.0 if self.take("-") else 1.0) * self._number()
        return name, factor


def _compared(more: Terms, less: Terms, strict: bool) -> Atom:
    """Return more > less as an atom."""
    names = dict.fromkeys([*more, *less])
    total = {name: more.get(name, 0.0) - less.get(name, 0.0) for name in names}
    return Atom(tuple((name, factor) for name, factor in total.items() if name), total.get("", 0.0), strict)
