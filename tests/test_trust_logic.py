"""Temporal logic over sampled traces: both semantics against their definitions, and the text of formulas."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tailgate.base.errors import InputError
from tailgate.trust.formula import parse
from tailgate.trust.logic import (
    TINY,
    Always,
    And,
    Atom,
    Eventually,
    Formula,
    Interval,
    Not,
    Or,
    Samples,
    Until,
    along,
    holds,
    response,
    robustness,
)

DT = 0.1


def _worth(f: Formula, values: dict[str, list[float]], k: int, n: int, exact: bool) -> Any:
    """The definition, quantifier by quantifier, on one episode of n samples; `exact`: boolean, else robustness."""
    top, bottom = (True, False) if exact else (math.inf, -math.inf)
    most, least = (any, all) if exact else (lambda x: max([bottom, *x]), lambda x: min([top, *x]))
    if isinstance(f, Atom):
        margin = f.constant + sum(factor * values[name][k] for name, factor in f.terms)
        true = margin > 0 if f.strict else margin >= 0
        return true if exact else margin or (TINY if true else -TINY)
    if isinstance(f, Not):
        inner = _worth(f.of, values, k, n, exact)
        return not inner if exact else -inner
    if isinstance(f, And | Or):
        return (least if isinstance(f, And) else most)([_worth(part, values, k, n, exact) for part in f.of])
    window = [j for j in range(k, n) if f.within.first - 1e-9 <= (j - k) * DT <= f.within.last + 1e-9]
    if isinstance(f, Until):
        return most([least([_worth(f.right, values, j, n, exact), *(_worth(f.left, values, i, n, exact) for i in range(k, j))]) for j in window])
    return (most if isinstance(f, Eventually) else least)([_worth(f.of, values, j, n, exact) for j in window])


def _intervals() -> st.SearchStrategy[Interval]:
    return st.tuples(st.integers(0, 4), st.integers(0, 9) | st.none()).map(lambda x: Interval(x[0] * DT, math.inf if x[1] is None else (x[0] + x[1]) * DT))


def _formulas() -> st.SearchStrategy[Formula]:
    number = st.sampled_from([-2.0, -1.0, -0.5, 0.5, 1.0, 3.0])
    term = st.tuples(st.sampled_from(["x", "y"]), number)
    atoms = st.builds(Atom, st.lists(term, min_size=1, max_size=2, unique_by=lambda t: t[0]).map(tuple), st.integers(-3, 3).map(float), st.booleans())
    return st.recursive(
        atoms | st.sampled_from([And(), Or()]),
        lambda inner: st.one_of(
            inner.map(Not), st.lists(inner, min_size=2, max_size=3).map(lambda x: And(tuple(x))), st.lists(inner, min_size=2, max_size=3).map(lambda x: Or(tuple(x))),
            st.builds(Eventually, inner, _intervals()), st.builds(Always, inner, _intervals()), st.builds(Until, inner, inner, _intervals()),
        ), max_leaves=6,
    )  # fmt: skip


@st.composite
def _episodes(draw: st.DrawFn) -> Samples:
    lengths = draw(st.lists(st.integers(1, 30), min_size=1, max_size=3))
    size = max(lengths)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    values = {name: rng.integers(-4, 5, (size, len(lengths))).astype(float) for name in "xy"}
    return Samples(DT, np.array(lengths), values, 13)  # a horizon in which windows of three nested operators begin


def _depth(f: Formula) -> int:
    return (not isinstance(f, Atom | And | Or | Not)) + max((_depth(part) for part in f.parts), default=0)


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(_formulas().filter(lambda f: _depth(f) <= 3), _episodes())
def test_both_semantics_keep_to_their_definitions_and_agree_in_sign(formula: Formula, episodes: Samples) -> None:
    """A window, a cut or an operator that is off by one sample would show against the definition."""
    found, worth = holds(formula, episodes), robustness(formula, episodes)
    for b, n in enumerate(episodes.length):
        values = {name: list(value[:, b]) for name, value in episodes.values.items()}
        assert found[b] == _worth(formula, values, 0, n, True)
        assert worth[b] == _worth(formula, values, 0, n, False)
    assert (found == (worth > 0.0)).all() and not (worth == 0.0).any()
    assert (holds(Not(formula), episodes) == ~found).all()


@settings(max_examples=60, deadline=None)
@given(_formulas().filter(lambda f: _depth(f) <= 3), _episodes())
def test_an_episode_is_judged_by_its_own_samples(formula: Formula, episodes: Samples) -> None:
    """Companions in the batch, and what stands behind an episode's end, would change its verdict."""
    for b in range(len(episodes.length)):
        alone = {name: np.where(episodes.live[:, b : b + 1], value[:, b : b + 1], 99.0) for name, value in episodes.values.items()}
        one = Samples(DT, episodes.length[b : b + 1], {name: value[: episodes.length[b]] for name, value in alone.items()}, episodes.horizon)
        assert holds(formula, one)[0] == holds(formula, episodes)[b]
        assert robustness(formula, one)[0] == robustness(formula, episodes)[b]


@settings(max_examples=150, deadline=None)
@given(_formulas())
def test_a_formula_survives_its_text(formula: Formula) -> None:
    """What a report prints would not be what was decided."""
    assert parse(str(formula)) == formula


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("G[0,60] gap > 2", Always(Atom((("gap", 1.0),), -2.0), Interval(0.0, 60.0))),
        ("G gap > 2 and alarm", And((Always(Atom((("gap", 1.0),), -2.0)), Atom((("alarm", 1.0),), -0.5)))),
        ("x > 0 or y > 0 and not x < 1", parse("(x > 0) or ((y > 0) and (not (x < 1)))")),
        ("x > 0 -> y > 0 -> x >= 1", parse("x > 0 -> (y > 0 -> x >= 1)")),
        ("x > 0 U[0.5, end] y@3 > 0", Until(Atom((("x", 1.0),)), Atom((("y@3", 1.0),)), Interval(0.5, math.inf))),
        ("2 * x - y*3 >= -1.5 + x", Atom((("x", 1.0), ("y", -3.0)), 1.5, False)),
        ("F true", Eventually(And())),
        ("alarm", Atom((("alarm", 1.0),), -0.5)),
    ],
)
def test_texts_are_read_as_the_documentation_says(text: str, same: Formula) -> None:
    """Another precedence, sign or default would decide another property than the one that was asked."""
    assert parse(text) == same


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the end"), ("G[0,60]", "the end"), ("gap > ", "the end"), ("gap >> 2", "'>'"), ("1 < gap < 2", "one comparison at a time"),
        ("G[3,1] gap > 0", "first <= last"), ("G[-1,2] gap > 0", "a number"), ("(gap > 0", "')'"), ("gap > 0)", "the end"), ("gap * gap > 1", "a number"),
        ("2 > 1 2", "'2' at character 7"), ("__import__('os')", "at character 11"), ("gap; 1", "a number, a name"), ("and gap > 0", "a signal"), ("G[0,end gap > 0", "']'"), ("x" * 5000, "4000 characters"),
        ("(" * 100 + "x > 0" + ")" * 100, "within each other"), ("not " * 100 + "x > 0", "within each other"), ("gap + 1", "one of >"), ("x > 0 U " * 80 + "y > 0", "within each other"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_in_one_line(text: str, words: str) -> None:
    """A typing mistake would be decided as some other property, or end in a traceback."""
    with pytest.raises(InputError) as error:
        parse(text)
    assert words in str(error.value) and "\n" not in str(error.value)


def _one(*values: float, length: int | None = None) -> Samples:
    return Samples(DT, np.array([length or len(values)]), {"x": np.array(values)[:, None]})


def test_a_deadline_of_0_6_s_is_six_steps_of_0_1_s() -> None:
    """Rounding of 0.6 / 0.1 would make the deadline a step shorter."""
    late = _one(*[-1.0] * 6, 1.0)
    assert holds(parse("F[0,0.6] x > 0"), late) and not holds(parse("F[0,0.5] x > 0"), late) and not holds(parse("F[0.7,end] x > 0"), _one(*[-1.0] * 9))


def test_windows_that_an_end_cuts_hold_what_is_there() -> None:
    """An answer that was due after a collision would count as given, or one after the horizon as missed."""
    threat = _one(1.0, -1.0, -1.0, 1.0, -1.0)
    asked = response(parse("x > 0"), parse("x < 0"), 0.2, 0.2)
    assert holds(asked, threat)[0] and not holds(asked, _one(1.0, -1.0, 1.0))[0]  # over right after the second threat
    assert not holds(response(parse("x > 0"), parse("x < -2"), 0.2, 0.2), threat)[0]
    assert holds(parse("G[0.2,0.4] x > 9"), _one(1.0, 1.0, 1.0, length=2)) and not holds(parse("F[0.2,0.4] x > -9"), _one(1.0, 1.0, 1.0, length=2))


@pytest.mark.parametrize(("text", "words"), [("G[0.5,1] x > 0", "by the last sample"), ("F[0.3,end] F[0.3,end] x > 0", "by the last sample"),
                                            ("G[0.12,0.18] x > 0", "holds a sample"), ("y > 0", "signals that are there")])  # fmt: skip
def test_a_formula_that_says_nothing_of_a_trace_is_refused(text: str, words: str) -> None:
    """A window after the end would make G true of every run without looking at one."""
    with pytest.raises(InputError, match=words):
        holds(parse(text), _one(1.0, 1.0, 1.0, 1.0, 1.0))


def test_infinite_signals_are_compared_but_not_subtracted() -> None:
    """A road without a car behind would fail rear_gap > 0, or a difference that is no number would count as false."""
    both = Samples(DT, np.array([2]), {"x": np.full((2, 1), np.inf), "y": np.full((2, 1), np.inf)})
    assert holds(parse("G x > 0"), both)[0] and robustness(parse("G x > 0"), both)[0] == np.inf
    with pytest.raises(InputError, match="infinite"):
        holds(parse("x - y > 0"), both)


def test_along_reads_a_formula_at_every_sample() -> None:
    """How often an antecedent held would be counted at other samples."""
    assert along(parse("x > 0 and F[0.1,0.1] x < 0"), _one(1.0, -1.0, 1.0, 1.0))[:, 0].tolist() == [True, False, False, False]


def test_what_is_exactly_at_a_border_is_true_or_false() -> None:
    """A car that halts breaks `speed > 0`, and keeps `speed >= 0`: by robustness as by truth."""
    halted = Samples(DT, np.array([2]), {"speed": np.array([[3.0], [0.0]])})
    for text, true in (("G speed > 0", False), ("G speed >= 0", True), ("F speed <= 0", True), ("F speed < 0", False), ("not (G speed > 0)", True)):
        assert holds(parse(text), halted)[0] == true == (robustness(parse(text), halted)[0] > 0.0)
