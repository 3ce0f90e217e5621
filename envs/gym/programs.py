"""The attacker's decision process as programs, traced from `tailgate.envs.gym.attacker_mdp.Seat`.

    advance  one step of a decision of several steps, except the last
    decide   a decision of every row, or its last step; rows `again` begin their next episode instead
    begin    the next episode of the rows `again`, or their first

The last two return the observation, and what may be decided next.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.pytree import leaves, map_leaves, widened
from tailgate.core import draws
from tailgate.core.draws import Keys
from tailgate.engine.agreement import ROWS, TRIED, Untraced, check_open, compared, raised, same
from tailgate.engine.operations import Array, ArrayLike
from tailgate.engine.parameters import lifted
from tailgate.engine.program import Call, program_class
from tailgate.engine.remembered import Remembered
from tailgate.engine.tracing import Trace, traced

if TYPE_CHECKING:
    from tailgate.core.loop import LoopState
    from tailgate.envs.gym.attacker_mdp import Seat, Sums, Tally


# results of a step of a single row
ALONE = ("reward", "damage", "k", "terminated", "truncated", "illegal", "collided", "rear_collided", "allowed")


class Episodes(NamedTuple):
    """The state of a seat's episodes; `sums` are those of a decision of several steps."""

    loop: LoopState
    tally: Tally
    sums: Sums | None = None


class SeatPrograms:
    """The programs of a seat; tracing raises whatever its parts raise."""

    def __init__(self, seat: Seat, shown: Seat | None = None, device: str = "cpu") -> None:
        check_open(seat.loop)
        self.device = device
        self.seat, self.loop, self.shown = seat, seat.loop, shown or _shown_once(seat)
        self.values: list[Array] | None = None  # of the parameters, if they differ from the traced ones
        self.example = _example(seat)
        for name, leaf in leaves(self.example).items():
            if leaf.dtype == object:
                raise TypeError(f"state {name} holds objects")
        state = _opened(seat, self.example)
        flags = np.zeros(1, bool)
        action = np.zeros(1, np.int64) if seat.action.discrete else np.zeros((1, seat.action.size))
        decide = traced(self._decide, state, {"action": action, "over": flags, "again": flags})
        begin = traced(self._begin, state, {"again": flags})
        traces = [decide, begin]
        if _several(seat):
            traces.append(traced(self._advance, state, {"action": action, "over": flags}))
        twins = _twins(*traces)
        self.programs = tuple(program_class(device)(trace, twins=twins) for trace in traces)
        self.decide, self.begin, *advance = self.programs
        self.advance = advance[0] if advance else None

    @property
    def between(self) -> int:
        """Number of steps of a decision before its last."""
        return self.seat.action.spec.interval - 1

    def of(self, seat: Seat, values: list[Array]) -> SeatPrograms:
        """Return the same programs for a seat with other parameters."""
        out = copy.copy(self)
        out.seat, out.loop, out.values = seat, seat.loop, values
        return out

    def _decide(self, held: Episodes, given: dict[str, Array]) -> tuple[Episodes, dict[str, Array]]:
        seat, over = lifted(held.loop.k, self.shown), given["over"]
        loop, tally, sums, _ = seat.advanced(held.loop, held.tally, held.sums or seat.opened(held.tally), given["action"], over)
        outcome = seat.closed(loop, tally, sums, over)
        state = _renewed(seat, Episodes(loop, tally), held.loop.keys, given["again"])
        return _opened(seat, state), outcome._asdict() | _shown(seat, state)

    def _advance(self, held: Episodes, given: dict[str, Array]) -> tuple[Episodes, dict[str, Array]]:
        assert held.sums is not None
        seat = lifted(held.loop.k, self.shown)
        loop, tally, sums, _ = seat.advanced(held.loop, held.tally, held.sums, given["action"], given["over"])
        return Episodes(loop, tally, sums), {}

    def _begin(self, held: Episodes, given: dict[str, Array]) -> tuple[Episodes, dict[str, Array]]:
        seat = lifted(held.loop.k, self.shown)
        state = _renewed(seat, Episodes(held.loop, held.tally), held.loop.keys, given["again"])
        return _opened(seat, state), _shown(seat, state)


def _opened(seat: Seat, state: Episodes) -> Episodes:
    """Return the state with the sums of the next decision, if a decision has several steps."""
    return state._replace(sums=seat.opened(state.tally)) if _several(seat) else state


def _example(seat: Seat) -> Episodes:
    """Return the first state of an episode."""
    start = seat.loop.start(draws.keys("tune", [0]))
    return Episodes(start, seat.begin(start))


def _several(seat: Seat) -> bool:
    """Return True if a decision has several steps; traced code asks, so that both kinds get separate programs."""
    return bool(seat.action.spec.interval > 1)


def _played(seat: Seat) -> object:
    """Play a step in the plain loop."""
    check_open(seat.loop)
    start, action = _example(seat), np.zeros(1, np.int64) if seat.action.discrete else np.zeros((1, seat.action.size))
    return seat.advanced(start.loop, start.tally, seat.opened(start.tally), action, np.zeros(1, bool))


def _shown_once(seat: Seat) -> Seat:
    """Return the seat as it is traced: it shows one frame."""
    return dataclasses.replace(seat, observation=type(seat.observation)(seat.loop.brief), config={})


def _twins(decide: Trace, begin: Trace, *others: Trace) -> dict[str, str]:
    """Return the leaves of the state that equal others after each decision and each beginning, by those others."""
    first: dict[Any, str] = {}
    out = {}
    for name, (here, _) in decide.state.items():
        pairs = [begin.large[name]] if name in begin.large else list(zip(*(nodes.flat for nodes in begin.state[name]), strict=True))
        if here.size and all(new.op in ("select", "blend") and new.args[2] is old for old, new in pairs):
            key = (
                here.shape,
                *(_after(trace, name) for trace in (decide, *others)),
                tuple((new.args[0].id, new.args[1].id) for _, new in pairs),
            )
            if first.setdefault(key, name) != name:
                out[name] = first[key]
    return out


def _after(trace: Trace, name: str) -> tuple[int, ...]:
    """Return the node numbers of a leaf in the next state."""
    return (trace.large[name][1].id,) if name in trace.large else tuple(node.id for node in trace.state[name][1].flat)


def _renewed(seat: Seat, state: Episodes, keys: Keys, again: Array) -> Episodes:
    """Return the state with the next episode in the rows `again`."""
    loop = seat.loop.start(Keys(keys.key, keys.episode + np.uint32(1)))
    fresh = Episodes(loop, seat.begin(loop))
    return map_leaves(lambda old, new: np.where(widened(again, old), new, old), state, fresh)


def _shown(seat: Seat, state: Episodes) -> dict[str, Array]:
    """Return the observation of a state, and what may be decided next."""
    view = seat.loop.sense(state.loop)
    damage = np.min(view.scene.gap, axis=1) if seat.road else state.tally.error
    shown = {"seen": seat.observation.observe(view), "allowed": view.allowed, "k": view.k, "damage": damage}
    return shown | ({"mask": seat.action.mask(view)} if seat.action.discrete else {})


_made: Remembered[SeatPrograms] = Remembered()


def programs_of(seat: Seat, device: str = "cpu") -> SeatPrograms | Untraced:
    """Return the programs of a seat on a device, if they equal the plain loop on this machine; else the reason why there are none."""
    shown = _shown_once(seat)
    return _made.proved(
        (shown, device),
        lambda: (begun := _example(shown), _shown(shown, begun)),
        lambda: _played(shown),
        lambda: SeatPrograms(seat, shown, device),
        lambda found, values: found.of(seat, values),
        difference,
    )


def difference(programs: SeatPrograms, steps: int = TRIED) -> str:
    """Play some decisions with resets in both engines; return the first difference, or nothing."""
    return compared(lambda rows: _compared(programs, rows, steps))


def _compared(programs: SeatPrograms, some: list[int], steps: int) -> str | tuple[InputError, int]:
    from tailgate.envs.gym.batches import PlainEpisodes

    decisions = max(4, steps // (programs.between + 1))
    chance, size = np.random.default_rng(0), programs.seat.action.size
    batch = len(some)
    keys, everyone = draws.keys("tune", some), np.ones(batch, bool)
    rows, plain = Rows(programs, batch), PlainEpisodes(programs.seat)
    rows.begin(everyone, keys)
    plain.begin(keys)
    for decision in range(decisions):
        over = chance.random(ROWS)[some] < (0.5 if decision == decisions // 2 else 0.02)  # an episode does the same without the others
        actions = (chance.integers(0, size, ROWS) if programs.seat.action.discrete else chance.uniform(-1.0, 1.0, (ROWS, size)))[some]
        broken, outcome = raised(lambda: rows.decide(actions, over, over)), raised(lambda: plain.decide(actions, over, True))  # noqa: B023
        if isinstance(outcome, InputError):
            return (outcome, decision) if str(broken) == str(outcome) else f"decision {decision}: {outcome}"
        if isinstance(broken, InputError):
            return f"decision {decision}: {broken}"
        here, there = rows.held() | rows.brought, plain.held() | outcome._asdict() | {"seen": plain.seen()}
        for name, wanted in there.items():
            if not same(here[name], wanted):
                return f"{name}, decision {decision}"
    return ""


class _Alone(NamedTuple):
    """The calls that play a single row, its action, and readers of its results."""

    call: Call
    advance: Call | None
    play: Callable[[], int]
    action: Array
    numbers: Callable[[], tuple[Any, ...]]
    seen: Array
    mask: Array | None


class Rows:
    """The B rows of a seat's episodes, with the results of the last call (see `SeatPrograms`)."""

    def __init__(self, programs: SeatPrograms, batch: int, threads: int = 1) -> None:
        self.programs, self.batch, self.threads = programs, batch, threads
        self.state = programs.decide.rows(batch)
        self._decide = self._last = programs.decide.call(self.state, values=programs.values, threads=threads)
        self._brought: dict[str, Array] | None = {}
        self._k = 0  # of a single row, after its last decision

    @cached_property
    def _begin(self) -> Call:
        return self.programs.begin.call(self.state, values=self.programs.values, threads=self.threads)

    @cached_property
    def _advance(self) -> Call:
        assert self.programs.advance is not None
        return self.programs.advance.call(self.state, self.programs.between, self.programs.values, self.threads, self._decide)

    @cached_property
    def _alone(self) -> _Alone:
        programs = self.programs
        call = Call(programs.decide, self.state, values=programs.values)
        advance = Call(programs.advance, self.state, programs.between, programs.values, like=call) if programs.advance else None
        play = call.fixed()
        mask = call.reader("mask", 0, np.int8)() if programs.seat.action.discrete else None
        return _Alone(call, advance, play, call.arguments["action"], call.numbers(ALONE), call.reader("seen", 0)(), mask)

    @property
    def brought(self) -> dict[str, Array]:
        """The results of the last call."""
        if self._brought is None:
            self._brought = self._last.results()
        return self._brought

    @brought.setter
    def brought(self, results: dict[str, Array]) -> None:
        self._brought = results

    def decide(self, actions: Array, over: Array, again: Array) -> None:
        """Play one decision of each row: actions (B,) or (B, size), over and again (B,) bool."""
        given = self._decide.arguments
        given["action"][...], given["over"][...], given["again"][...] = actions, over, again
        self._play(self._decide)

    def decide_alone(self, action: ArrayLike) -> tuple[Any, ...]:
        """Play the decision of a single row; return the numbers that ALONE names, its observation and its mask."""
        call, advance, play, given, numbers, seen, mask = self._alone
        given[0] = action
        if advance is not None:
            advance.begin()
            advance.play(advance.steps)
            if advance.broken:
                self._check(advance, self._step)
        if play():
            self._check(call, self._step)
        self._last, self._brought, results = call, None, numbers()
        self._k = results[2]
        return *results, seen.copy(), None if mask is None else mask.copy()

    def _step(self) -> Array:
        """Return the step before the decision of a single row."""
        return np.array([self._k]) if self._last is self._alone.call else self._last.results()["k"]

    def again_alone(self) -> tuple[Any, ...]:
        """Begin the next episode of a single row; return a tuple as `decide_alone` does, without reward."""
        self.begin(np.ones(1, bool))
        new = self.brought
        mask = new["mask"][0].view(np.int8).copy() if "mask" in new else None  # the caller may write to it
        return 0.0, float(new["damage"][0]), int(new["k"][0]), *(False,) * 5, bool(new["allowed"][0]), new["seen"][0], mask

    def _play(self, call: Call) -> None:
        before, sheet = self._last, self._last.sheet
        steps = [self._advance, call] if self.programs.between and call is self._decide else [call]
        for part in steps:
            part.begin()
            part.play(part.steps)
            if part.broken:
                self._check(part, lambda: before.results(sheet)["k"])
        self._last, self._brought = call, None

    def _check(self, call: Call, k: Callable[[], Array]) -> None:
        """Raise the error of a failed demand in a decision from steps k (B,) on; idle lanes do not count."""
        demands = call.results()["demands"].reshape(call.steps, self.batch, -1)
        for step in np.flatnonzero(~demands.all(axis=(1, 2))):
            raise call.program.broken(demands[step], k() + step + (self.programs.between if call.program is self.programs.decide else 0))

    def begin(self, rows: Array, keys: Keys | None = None) -> None:
        """Begin episodes in the rows (B,) bool: the next ones, or those of `keys`, one per row."""
        if keys is not None:
            where, state = np.flatnonzero(rows), self.state
            state.put_leaf("loop.keys.key", keys.key, where)
            state.put_leaf("loop.keys.episode", keys.episode - np.uint32(1), where)
        self._begin.arguments["again"][...] = rows
        self._play(self._begin)

    def held(self) -> dict[str, Array]:
        """Return copies of all that changes from step to step, by name."""
        return {name: self.state.get_leaf(name) for name in leaves(self.programs.example)}

    def put(self, held: dict[str, Array]) -> None:
        """Restore what `held` returned, for the same number of rows."""
        for name in leaves(self.programs.example):
            self.state.put_leaf(name, held[name])
        self.begin(np.zeros(self.batch, bool))
