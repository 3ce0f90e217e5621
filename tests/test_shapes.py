"""Rows of a class whose results have a wrong shape name the class and the shape that is expected."""

from typing import Any

import pytest

import tailgate
from tailgate.core import Command
from tailgate.evaluation.cells import Cell, run_cell

CELL = Cell("custom", "stop-and-go-v0", None, "kf", "fdi", 3)


class Own:
    """A component that answers as a built-in one does, but for one part of its answers."""

    def __init__(self, built: Any, change: Any) -> None:
        self.built, self.change = built, change

    def __getattr__(self, name: str) -> Any:
        return getattr(self.built, name)


class Guard(Own):
    """A defence."""

    def step(self, *given: Any) -> Any:
        state, estimate = self.built.step(*given)
        return state, self.change(estimate)


class Foe(Own):
    """An attack."""

    def decide(self, *given: Any) -> Any:
        state, command = self.built.decide(*given)
        return self.change(state, command)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda e: e._replace(x=e.x[..., :1]), "defence output x: got 'float64 (3, 1, 1)'; expected an array of shape (3, 1, 3)"),
        (lambda e: e._replace(alarm=e.alarm[:, 0]), "defence output alarm: got 'bool (3,)'; expected an array of shape (3, 1)"),
        (lambda e: None, "defence output: got '(KalmanState, NoneType)'; expected a pair (state, Estimate)"),
    ],
)
def test_a_defence(change: Any, words: str) -> None:
    for row in run_cell(CELL, Guard(tailgate.make_defence("kf"), change)):
        assert row["status"] == "error" and words.partition("got '(")[0] in row["reason"] and "(the step of Guard)" in row["reason"]
        assert words.rpartition("expected ")[2] in row["reason"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s, c: (s, c._replace(kind=c.kind[:, None])), "(decide of Foe, kind: got (3, 1); expected an array of shape (3,))"),
        (lambda s, c: (s, c._replace(target=c.target[:2])), "(decide of Foe, target: got (2, 1, 5); expected an array of shape (3, 1, 5))"),
        (lambda s, c: (s, c._replace(value=c.value[0, 0, :2])), "(decide of Foe, value: got (2,); expected an array of shape (3, 1, 5))"),
        (lambda s, c: c, "(decide of Foe: got Command; expected a pair (state, Command))"),
        (lambda s, c: (s, None), "expected a pair (state, Command))"),
    ],
)
def test_an_attack(change: Any, words: str) -> None:
    for row in run_cell(CELL, attack=Foe(tailgate.make_attack("fdi"), change)):
        assert row["status"] == "error" and words in row["reason"]


def test_another_error_keeps_its_words() -> None:
    """And a class whose results fit plays as the built-in one, to the same hashes."""

    def fails(state: Any, command: Command) -> Any:
        raise KeyError("mine")

    (row, *_) = run_cell(CELL, attack=Foe(tailgate.make_attack("fdi"), fails))
    assert row["reason"].startswith("KeyError: 'mine'") and "Foe" not in row["reason"]
    mine, built = run_cell(CELL, attack=Foe(tailgate.make_attack("fdi"), lambda s, c: (s, c))), run_cell(CELL)
    assert [row["trace_hash"] for row in mine] == [row["trace_hash"] for row in built] and built[0]["trace_hash"]
