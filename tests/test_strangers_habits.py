"""Habits of ordinary numpy code, in a defence: what is traced has the bits of the plain loop over a whole episode, and the rest is not traced."""

import copy
import functools
import types
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest

from tailgate import num
from tailgate.core import Estimate, Mode, draws, param
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.engine.agreement import Untraced
from tailgate.engine.parameters import Parameters
from tailgate.play.commanded import commanded
from tailgate.play.trace import rollout

CFG = types.SimpleNamespace(k=2.0)


class State(NamedTuple):
    x: np.ndarray
    ring: np.ndarray
    place: np.ndarray
    small: np.ndarray


class Habit:
    """A filter whose score comes from `more`."""

    uses = ("measurements",)
    narrow: Any = np.uint8

    def prepare(self, model):
        return model

    def start(self, plan, prior):
        batch = len(prior.mean)
        return State(prior.mean, num.zeros((batch, 50)), np.zeros(batch, np.int64), np.zeros((batch, 3), self.narrow))

    def step(self, plan, state, received, known_u, draws):
        x = num.matvec(plan.A, state.x) + num.matvec(plan.B, known_u) + plan.c
        r = np.where(received.valid, received.y - num.matvec(plan.C, x), 0.0)
        x = x + num.matvec(np.swapaxes(plan.C, -1, -2), np.clip(0.2 * r, -0.5, 0.5))
        score, state = self.more(state._replace(x=x), r)
        alarm = score > 1e9
        return state, Estimate(x, score, alarm, num.full(score.shape, Mode.NORMAL, np.int8), ~alarm)

    def more(self, state, r):
        return r[:, :, 0], state


@dataclass(frozen=True)
class Before(Habit):
    """The entry before the first one is the last."""

    def more(self, state, r):
        before = num.pick(state.ring, state.place - 1)
        ring = num.put(state.ring, state.place - 1, r[:, 0, 0])
        table = num.take(np.arange(5.0), -1 - state.place % 5)
        return (r[:, :, 0] - before[:, None]) ** 2 + table[:, None], state._replace(ring=ring, place=num.ring_next(state.place, 50))


@dataclass(frozen=True)
class Votes(Habit):
    """Unsigned counts, whose sum and cumulative sum are wider."""

    def more(self, state, r):
        small = np.minimum(state.small, 250) + np.ones_like(state.small)
        score = (small.sum(axis=-1) > 200) + 2.0 * (np.cumsum(small, axis=-1)[:, -1] > 300)
        return score[:, None] + 0.0 * r[:, :, 0], state._replace(small=small)


@dataclass(frozen=True)
class Counter(Habit):
    """A narrow count against a larger number of Python's."""

    most: int = param(100, "steps")
    narrow = np.int8

    def more(self, state, r):
        old, never = state.small[:, 0] < self.most, state.small[:, 1] == 256
        small = np.minimum(state.small + np.int8(1), np.int8(120))
        return (old + 2.0 * never)[:, None] + 0.0 * r[:, :, 0], state._replace(small=small)


@dataclass(frozen=True)
class View(Habit):
    """A parameter as an index shows a view, to which one may write."""

    which: int = param(0, "sensor")

    def more(self, state, r):
        score = r * 1.0
        one = score[:, :, self.which]
        one += np.where(state.place > 60, 100.0, 0.0)[:, None]
        same = np.asarray(score, dtype=float)
        same[:, :, self.which] += 1.0
        return score[:, :, 0], state._replace(place=state.place + 1)


@dataclass(frozen=True)
class Power(Habit):
    """Python's power of a parameter is not x * x."""

    p: float = param(2.1142068826938814, "gain")

    def more(self, state, r):
        return self.p**2 * r[:, :, 0] + self.p**0.5 + (state.place**2)[:, None] * 1e-9, state._replace(place=state.place + 1)


@dataclass(frozen=True)
class Wide(Habit):
    """Two choices of one large array are two arrays."""

    def more(self, state, r):
        many = num.full((len(r), 130), 1.0) + r[:, :, 0]
        first, late = np.where(many > 1.0, many, 2.0 * many), np.where(many > 1.0, many, 2.0 * many)
        first[:, 0] = 7.0
        return late[:, :1] + 0.0 * r[:, :, 0] + np.sign(state.place - 3)[:, None], state._replace(place=state.place + 1)


@functools.lru_cache
def window(count):
    return np.ones(count) / count


@dataclass(frozen=True)
class Cached(Habit):
    """A constant that a function remembers."""

    def more(self, state, r):
        return r[:, :, 0] * window(4)[0], state


class Lazy(Habit):
    """A constant that an object remembers; it is no dataclass."""

    w = None

    def more(self, state, r):
        if self.w is None:
            self.w = np.ones(4) / 4.0
        return r[:, :, 0] * self.w[0], state


class Counts(Habit):
    """It keeps its step in itself, which machine code cannot know."""

    def start(self, plan, prior):
        self.k = 0
        return super().start(plan, prior)

    def more(self, state, r):
        self.k += 1
        return r[:, :, 0] * (1.0 if self.k <= 100 else 0.5), state


@dataclass(frozen=True)
class Sums(Habit):
    """A sum of ten numbers is not traced; the constant of the function that was called before has to stay a constant."""

    def more(self, state, r):
        return (np.concatenate([state.ring[:, :9], r[:, 0, :1]], axis=1) * window(10)).sum(axis=-1)[:, None] + 0.0 * r[:, :, 0], state


@dataclass(frozen=True)
class Contiguous(Habit):
    """If it is a copy depends on the place in memory."""

    def more(self, state, r):
        d = r[:, :, 0] - 0.5
        c = np.ascontiguousarray(d)
        c[(state.place > 60)[:, None]] = 0.0
        return d, state._replace(place=state.place + 1)


def _played(defence, steps=200):
    """Play a defence; return why it is not traced, and assert that it plays as the plain loop does."""
    loop = load_scenario("braking-v0").loop(defence)
    object.__setattr__(loop, "horizon", steps)
    attack, keys = Spec("attack", "none").make(), draws.keys("tune", range(3))
    made = commanded(loop)
    fast = rollout(loop, attack, keys) if isinstance(made, Untraced) else None
    if fast is None:
        length, signals, _ = made.play(attack, keys, True)
        names, got = list(signals), signals
        assert length.tolist() == [steps] * 3
    else:
        names, got = list(fast.signals), fast.signals
    plain = rollout(loop, attack, keys, plain=True).signals
    for name in names:
        assert np.array_equal(got[name], plain[name], equal_nan=got[name].dtype.kind == "f"), name
    return made.why if isinstance(made, Untraced) else ""


@pytest.mark.parametrize("defence", [Before(), Votes(), Counter(), View(), Power(), Wide(), Cached(), Lazy()], ids=lambda one: type(one).__name__)
def test_what_is_traced_has_the_bits_of_numpy(defence):
    assert _played(defence) == ""
    if isinstance(defence, (Counter, View, Power)):  # a program for one number is not that for another one
        other = {"most": 200, "which": 1, "p": 3.3}
        assert _played(type(defence)(**{key: value for key, value in other.items() if hasattr(defence, key)})) == ""


@pytest.mark.parametrize(("defence", "why"), [
    (Counts(), "a step writes to Counts.k"), (Sums(), "a sum of 10 numbers"), (Contiguous(), "read-only"),
])  # fmt: skip
def test_what_is_not_traced_says_why_and_plays(defence, why):
    assert why in _played(defence)
    assert type(window(10)) is np.ndarray


def test_what_a_function_closes_over_is_part_of_the_program(monkeypatch):
    """Its cells, and attributes of a global; else the program of before would play."""

    def law(gain):
        return lambda x: gain * x

    @dataclass(frozen=True)
    class Closed(Habit):
        def more(self, state, r):
            return LAW["now"](r[:, :, 0]) * CFG.k, state

    for gain, k in ((2.0, 2.0), (3.0, 2.0), (3.0, 5.0)):
        monkeypatch.setitem(LAW, "now", law(gain))
        monkeypatch.setattr(CFG, "k", k)
        assert _played(Closed(), 40) == ""


LAW: dict[str, Any] = {}


TABLE: dict[int, np.ndarray] = {}


class Remembers(Habit):
    """It keeps constants in its mapping, in a mapping of its module, and in its class. Its sum is not traced."""

    w = None

    def __init__(self):
        self.table: dict[int, np.ndarray] = {}

    def more(self, state, r):
        for table in (self.table, TABLE):
            if 10 not in table:
                table[10] = np.ones(10) / 10.0
        if Remembers.w is None:
            Remembers.w = np.ones(10)
        ring = np.concatenate([state.ring[:, :9], r[:, 0, :1]], axis=1) * self.table[10] * TABLE[10] * Remembers.w
        return ring.sum(axis=-1)[:, None] + 0.0 * r[:, :, 0], state


def test_what_code_remembers_of_a_trace_does_not_break_the_plain_loop():
    assert "a sum of 10 numbers" in _played(Remembers(), 40)


def test_a_constant_is_computed_once_however_often_its_code_is_traced():
    window.cache_clear()
    for _ in range(3):
        assert _played(Cached(), 40) == ""
    assert window.cache_info().misses == 1


def test_numbers_of_a_closure_are_parameters():
    def law(gain):
        return lambda x: gain * x

    first, second = (Parameters(law(gain)) for gain in (2.0, 3.0))
    assert first.key == second.key and first.values != second.values


def test_a_narrow_index_may_point_into_a_large_table():
    """A mode into 200 entries."""

    @dataclass(frozen=True)
    class Table(Habit):
        narrow = np.int8

        def more(self, state, r):
            return num.take(np.linspace(1.0, 2.0, 200), state.small[:, 0])[:, None] + 0.0 * r[:, :, 0], state._replace(small=state.small + np.int8(1))

    assert _played(Table(), 60) == ""


@dataclass(frozen=True)
class Rings(Habit):
    """A ring of narrow numbers keeps its type, a remainder its sign, and whole numbers of Python have no end."""

    n: int = param(3_000_000, "number")

    def more(self, state, r):
        i = state.place - 100
        score = (i % 7) + (i % np.where(i % 2 == 0, 3, -5)) + self.n * self.n * self.n * 1e-20
        return score[:, None] + 0.0 * r[:, :, 0], state._replace(small=num.put(state.small, state.place % 3, state.place + 200), place=state.place + 1)


@dataclass(frozen=True)
class Aliases(Habit):
    """Numbers cannot be written to, arrays can: in place, and where they are copied."""

    p: float = param(0.5, "gain")

    def more(self, state, r):
        gain = self.p
        gain += 1.0
        z = np.where(np.abs(r) > 1e3, r, 0.0) + r
        w = z
        w **= 2
        other = copy.deepcopy(z)
        other[:, :, 0] = 7.0
        return z[:, :, 0] * self.p + gain + np.isin(state.place, [3, 5])[:, None], state._replace(place=state.place + 1)


@pytest.mark.parametrize("defence", [Rings(), Rings(5), Aliases(), Aliases(2.0)], ids=str)
def test_more_habits_have_the_bits_of_numpy(defence):
    assert _played(defence) == ""


@pytest.mark.parametrize(("code", "why"), [
    (lambda x: x[::-1], "another order"), (lambda x: x[:1] * 1.0, "some of the episodes"), (lambda x: x.reshape(len(x), -1, order="F"), "the order F"),
    (lambda x: (x > 0) * 1 < 2**63, "use a number"),
])  # fmt: skip
def test_a_refusal_names_the_reason(code, why):
    @dataclass(frozen=True)
    class Odd(Habit):
        def more(self, state, r):
            code(r[:, :, 0])
            return r[:, :, 0], state

    assert why in commanded(load_scenario("braking-v0").loop(Odd())).why


@dataclass(frozen=True)
class Prepared(Habit):
    """It caches numbers that only a step asks for."""

    gain: float = param(2.0, "gain")

    @functools.cached_property
    def table(self):
        return np.arange(3.0) * self.gain

    def more(self, state, r):
        return r[:, :, 0] * self.table[1], state


def test_an_equal_object_that_has_cached_nothing_yet_finds_the_program():
    for gain in (2.0, 2.0, 3.0):
        assert _played(Prepared(gain), 40) == ""
