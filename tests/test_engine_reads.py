"""A program's key has all that somebody's code reads. Writes of the code are put back, or it is not traced."""

import argparse
import copy
import datetime
import functools
import itertools
import operator
import os
import threading
import types
from collections import deque
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.core import param
from tailgate.engine import reads
from tailgate.engine.agreement import ROWS, compared
from tailgate.engine.parameters import Parameters

from .test_strangers_habits import Habit, _played


class Config:
    gain = 2.0


class Child(Config):
    pass


class Slotted:
    __slots__ = ("gain",)

    def __init__(self, gain):
        self.gain = gain


class Method:
    def law(self, x):
        return x * GAIN

    def __call__(self, x):
        return x * GAIN


def tall(x):
    return x * tall.gain


def linear(gain, x):
    return gain * x


CFG, METHOD, SLOTTED, SPACE = Config(), Method(), Slotted(2.0), argparse.Namespace(gain=2.0)
GAIN, NOW, LAWS = 2.0, {}, {"calm": {"gain": 2.0}, "wild": {"gain": 5.0}}
ONE, TWO = functools.partial(linear, 2.0), functools.partial(linear, 2.0)
SETTINGS = types.ModuleType("settings_of_somebody")
SETTINGS.GAIN = 2.0
HOLDER, PROXIED = types.SimpleNamespace(module=SETTINGS), {"gain": 2.0}
PROXY = types.MappingProxyType(PROXIED)
tall.gain = 2.0

READERS: dict[str, tuple[Any, Any]] = {
    "class attribute of a global": (lambda x: x * CFG.gain, lambda m: m.setattr(Config, "gain", 5.0)),
    "inherited attribute": (lambda x: x * Child.gain, lambda m: m.setattr(Config, "gain", 5.0)),
    "method that reads a global": (lambda x: METHOD.law(x), lambda m: m.setitem(globals(), "GAIN", 5.0)),
    "call that reads a global": (lambda x: METHOD(x), lambda m: m.setitem(globals(), "GAIN", 5.0)),
    "slot": (lambda x: x * SLOTTED.gain, lambda m: m.setattr(SLOTTED, "gain", 5.0)),
    "namespace": (lambda x: x * SPACE.gain, lambda m: m.setattr(SPACE, "gain", 5.0)),
    "attribute of a function": (lambda x: tall(x), lambda m: m.setattr(tall, "gain", 5.0)),
    "second partial": (lambda x: ONE(x) + TWO(x), lambda m: m.setitem(globals(), "TWO", functools.partial(linear, 5.0))),
    "name in text": (lambda x: x * getattr(SETTINGS, "GAIN"), lambda m: m.setattr(SETTINGS, "GAIN", 5.0)),  # noqa: B009
    "environment": (lambda x: x * float(os.environ.get("GAIN", "2")), lambda m: m.setenv("GAIN", "5")),
    "module in an attribute": (lambda x: x * HOLDER.module.GAIN, lambda m: m.setattr(SETTINGS, "GAIN", 5.0)),
    "mapping proxy": (lambda x: x * PROXY["gain"], lambda m: m.setitem(PROXIED, "gain", 5.0)),
    "same object": (lambda x: x * NOW["law"]["gain"] * len(LAWS), lambda m: m.setitem(NOW, "law", LAWS["wild"])),
}


@pytest.mark.parametrize("name", READERS)
def test_what_code_reads_is_part_of_its_key(name, monkeypatch):
    monkeypatch.setitem(NOW, "law", LAWS["calm"])
    reader, change = READERS[name]

    @dataclass(frozen=True)
    class Reads(Habit):
        law: Any

    before = Parameters(Reads(reader))
    assert before.key == Parameters(Reads(reader)).key
    change(monkeypatch)
    assert before.code != Parameters(Reads(reader)).code


def test_slots_and_closures_that_hold_themselves_have_parameters():
    """The number of the first object was a constant of the program for the second one."""

    @dataclass(frozen=True, slots=True)
    class Gains(Habit):
        gain: float = param(0.4, "gain")

        def more(self, state, r):
            return self.gain * r[:, :, 0], state

    def recursive(gain):
        def law(x, depth=2):
            return gain * x if not depth else law(x, depth - 1)

        return law

    @dataclass(frozen=True)
    class Recursive(Habit):
        law: Any

        def more(self, state, r):
            return self.law(r[:, :, 0]), state

    for gain in (0.4, 5.0):
        assert _played(Gains(gain), 30) == ""
        assert _played(Recursive(recursive(gain)), 30) == ""


class Writes(Habit):
    """It keeps something in itself, or reads what nobody can look into."""

    def __init__(self, held, law):
        self.held, self.law = held, law

    def more(self, state, r):
        return r[:, :, 0] * (1.0 + 1e-3 * self.law(self)), state


@dataclass
class Sets(Writes):
    held: Any = field(default_factory=set)
    law: Any = None


def late(self):
    self.held.append(len(self.held))
    return float(len(self.held) > 60)


def last(self):
    before, self.held = self.held, np.array([7.0])
    return before[0]


WRITERS: dict[str, tuple[Any, str]] = {
    "random numbers": (lambda: Writes(np.random.default_rng(0), lambda self: self.held.normal()), "reads Generator"),
    "an iterator": (lambda: Writes(itertools.count(), lambda self: next(self.held) > 40), "reads count"),
    "a lock": (lambda: Writes(threading.Lock(), lambda self: self.held.locked()), "reads lock"),
    "a set": (lambda: Sets(set(), lambda self: self.held.add(len(self.held)) or len(self.held) > 40), "a step writes to"),
    "a deque": (lambda: Writes(deque(), late), "a step writes to Writes.held"),
    "a slot": (lambda: Writes(Slotted(0.0), lambda self: setattr(self.held, "gain", self.held.gain + 1) or self.held.gain > 40), "a step writes to"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRITERS)
def test_what_changes_in_an_object_is_not_traced_and_is_put_back(name):
    make, why = WRITERS[name]
    defence = make()
    before = seen(defence.held)
    assert why in _made_why(defence)
    assert seen(defence.held) == before


def seen(held: Any) -> Any:
    if isinstance(held, np.random.Generator):
        return str(held.bit_generator.state)
    if isinstance(held, itertools.count):
        return repr(held)
    return reads.Read().value(held)


class Late(Habit):
    """It makes a generator at its first step, counts in an array of no dimensions, and fills a table that it closes."""

    def __init__(self):
        self.count, self.table, self.chance = np.zeros(()), np.zeros(3), None

    def more(self, state, r):
        self.count += 1
        self.chance = self.chance or np.random.default_rng(0)
        if self.table.flags.writeable:
            self.table[:] = 1.0
            self.table.flags.writeable = False
        return r[:, :, 0] * self.table[0], state


def test_what_appears_in_the_first_step_is_put_back_too():
    defence = Late()
    assert "reads Generator" in _made_why(defence)
    assert defence.count == 0 and defence.chance is None and defence.table.tolist() == [0.0] * 3


def remembers(x):
    remembers.last = x * 1.0
    return remembers.last


class Memo:
    last = None


@dataclass(frozen=True)
class Refused(Habit):
    """It calls a law, and then a function that is not traced."""

    law: Any

    def more(self, state, r):
        return np.median(self.law(r[:, :, 0]), axis=0)[None] + r[:, :, 0], state


@pytest.mark.parametrize("place", ["class", "function", "cell"])
def test_nodes_stay_nowhere(place):
    """The plain loop would go on with them."""
    kept = None

    def in_a_cell(x):
        nonlocal kept
        kept = x * 1.0
        return kept

    def in_a_class(x):
        Memo.last = x * 1.0
        return Memo.last

    law = {"class": in_a_class, "function": remembers, "cell": in_a_cell}[place]

    assert "np.median" in _made_why(Refused(law))
    held = {"class": Memo.last, "function": getattr(remembers, "last", None), "cell": kept}[place]
    assert held is None or type(held) is np.ndarray


def test_what_others_write_meanwhile_stays(monkeypatch):
    """A trace takes a second; only what holds its nodes is put back."""
    monkeypatch.setitem(NOW, "law", LAWS["calm"])

    def law(x):
        NOW["other"] = 3
        globals()["GAIN"] = 7.0
        return x * GAIN

    monkeypatch.setitem(globals(), "GAIN", 2.0)

    assert "np.median" in _made_why(Refused(law))
    assert GAIN == 7.0 and NOW["other"] == 3


@pytest.mark.parametrize("held", [{(0, 1), (1, 2)}, datetime.timedelta(1), Fraction(1, 3), operator.itemgetter(1)], ids=str)
def test_constants_of_any_kind_are_read(held):
    read = reads.Read()
    assert read.value(held) == reads.Read().value(copy.deepcopy(held)) and not read.unknown


def _made_why(defence):
    """Return why a defence is not traced, without playing it any further."""
    from tailgate.core.scenario import load_scenario
    from tailgate.play.commanded import commanded

    return commanded(load_scenario("braking-v0").loop(defence)).why


def test_a_refusal_counts_where_the_code_catches_it():
    @dataclass(frozen=True)
    class Catches(Habit):
        def more(self, state, r):
            try:
                peak = float(np.max(np.abs(r)))
            except TypeError:
                peak = 0.0
            return r[:, :, 0] + 1e-3 * peak, state

    assert "one number of all episodes" in _made_why(Catches())


def test_episodes_that_end_with_an_error_do_not_end_the_comparison():
    asked: list[int] = []

    def compare(rows):
        asked.append(len(rows))
        if 5 in rows:
            error = InputError("score", "NaN", "a number")
            error.rows = tuple(i for i, row in enumerate(rows) if row in (5, 9))
            return error, 0
        return "score, step 3"

    assert compared(compare) == "score, step 3" and asked == [ROWS, ROWS - 2]
    whole = InputError("score", "NaN", "a number")
    whole.rows = tuple(range(60))
    assert "the errors that end most episodes" in compared(lambda rows: (whole, 1)) and compared(lambda rows: (whole, 2)) == ""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_process_that_is_forked_during_a_trace_has_numpy_itself():
    from tailgate.engine.functions import makers
    from tailgate.engine.graph import Graph

    inside, go = threading.Event(), threading.Event()

    def hold():
        with makers(Graph()):
            inside.set()
            go.wait(0.3)

    thread = threading.Thread(target=hold)
    thread.start()
    inside.wait()
    child = os.fork()
    if not child:
        os._exit(0 if type(np.zeros(2)) is np.ndarray and np.zeros.__module__ == "numpy" else 1)
    thread.join()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
