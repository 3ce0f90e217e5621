"""The attacker's seat as a program: what `tailgate.envs.seat.Seat` plays, traced as it stands.

    decide   a decision of every row; rows `again` begin their next episode instead
    begin    the next episode of the rows `again`, or their first

Both leave what is to be seen, and what may be decided next.
"""

from __future__ import annotations

import copy
import dataclasses
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from tailgate import draws, num
from tailgate.agents.observation import ObservationCodec
from tailgate.draws import Keys
from tailgate.engine import objects
from tailgate.engine.agreement import Untraced, check_open, explained, raised, same
from tailgate.engine.operations import Array
from tailgate.engine.parameters import Parameters, Remembered, lifted
from tailgate.engine.program import Call, Program, State, Trace, traced
from tailgate.errors import InputError
from tailgate.tree import leaves, map_leaves

if TYPE_CHECKING:
    from tailgate.envs.seat import Seat


# what a step of a single row tells, in the order of the fused engine
ALONE = ("reward", "damage", "k", "terminated", "truncated", "illegal", "collided", "rear_collided", "allowed")


class SeatPrograms:
    """The programs of a seat. Raises whatever its parts raise while they are traced."""

    def __init__(self, seat: Seat) -> None:
        check_open(seat.loop)
        self.seat, self.loop, self.shown = seat, seat.loop, _shown_once(seat)
        self.values: list[Array] | None = None  # of the parameters, if others than those it was traced with
        start = seat.loop.start(draws.keys("tune", [0]))
        self.example = {"loop": start, "tally": seat.begin(start)}
        for name, leaf in leaves(self.example).items():
            if leaf.dtype == object:
                raise TypeError(f"state {name} holds objects")
        flags = np.zeros(1, bool)
        action = np.zeros(1, np.int64) if seat.action.discrete else np.zeros((1, seat.action.size))
        decide = traced(self._decide, self.example, {"action": action, "over": flags, "again": flags})
        begin = traced(self._begin, self.example, {"again": flags})
        twins = _twins(decide, begin)
        self.decide, self.begin = Program(decide, twins=twins), Program(begin, twins=twins)

    def of(self, seat: Seat, values: list[Array]) -> SeatPrograms:
        """The same programs for a seat of other parameters."""
        out = copy.copy(self)
        out.seat, out.loop, out.values = seat, seat.loop, values
        return out

    def _decide(self, held: Any, given: Any) -> tuple[Any, Any]:
        seat = self._lifted(held)
        loop, tally, outcome, _ = seat.step(held["loop"], held["tally"], given["action"], given["over"])
        state = _renewed(seat, {"loop": loop, "tally": tally}, held["loop"].keys, given["again"])
        return state, outcome._asdict() | _shown(seat, state)

    def _begin(self, held: Any, given: Any) -> tuple[Any, Any]:
        seat = self._lifted(held)
        state = _renewed(seat, held, held["loop"].keys, given["again"])
        return state, _shown(seat, state)

    def _lifted(self, held: Any) -> Seat:
        seat: Seat = lifted(held["loop"].k.graph, self.shown)
        return seat


def _shown_once(seat: Seat) -> Seat:
    """The seat as it is traced: it shows one frame."""
    return dataclasses.replace(seat, observation=ObservationCodec(seat.loop.brief), config={})


def _twins(decide: Trace, begin: Trace) -> dict[str, str]:
    """Leaves of the state that equal others after each decision and each beginning, and these."""
    first: dict[Any, str] = {}
    out = {}
    for name, (here, there) in decide.state.items():
        after = list(decide.large[name][1:]) if name in decide.large else list(there.flat)
        pairs = [begin.large[name]] if name in begin.large else list(zip(*(nodes.flat for nodes in begin.state[name]), strict=True))
        if after and all(new.op in ("select", "blend") and new.args[2] is old for old, new in pairs):
            key = here.shape, tuple(node.id for node in after), tuple((new.args[0].id, new.args[1].id) for _, new in pairs)
            if first.setdefault(key, name) != name:
                out[name] = first[key]
    return out


def _renewed(seat: Seat, state: Any, keys: Keys, again: Any) -> Any:
    """The state with the next episode in the rows `again`."""
    loop = seat.loop.start(Keys(keys.key, keys.episode + np.uint32(1)))
    fresh = {"loop": loop, "tally": seat.begin(loop)}
    return map_leaves(lambda old, new: np.where(again.reshape(len(again), *(1,) * (old.ndim - 1)), new, old), state, fresh)


def _shown(seat: Seat, state: Any) -> dict[str, Any]:
    """What is to be seen of a state, and what may be decided next."""
    view = seat.loop.sense(state["loop"])
    damage = np.min(view.scene.gap, axis=1) if seat.road else state["tally"].error
    shown = {"seen": seat.observation.observe(view), "allowed": view.allowed, "k": view.k, "damage": damage}
    return shown | ({"mask": seat.action.mask(view)} if seat.action.discrete else {})


_made: Remembered[SeatPrograms] = Remembered()


def programs_of(seat: Seat) -> SeatPrograms | Untraced:
    """The programs of a seat, once they have been found equal to the plain loop on this machine; or why there are none."""
    parameters = Parameters(_shown_once(seat))
    if found := _made.find(parameters):
        return found.of(seat, parameters.values)
    try:
        programs = SeatPrograms(seat)
    except Exception as error:  # whatever somebody's code raises where arrays are not numpy's
        return Untraced(explained(error))
    both = (programs.decide, programs.begin)
    names = [f"{program.function.name}.{parameters.sources}" for program in both]
    if not objects.proved(names):
        if differs := difference(programs):
            return Untraced(f"traced code and the plain loop differ in {differs}")
        objects.prove(names)
    _made.keep(parameters, [program.trace.graph for program in both], programs)
    return programs


def difference(programs: SeatPrograms, batch: int = 64, decisions: int = 24) -> str:
    """Play some decisions in both engines, resets among them; -> what differs first, or nothing."""
    from tailgate.envs.batches import PlainEpisodes

    chance, size = np.random.default_rng(0), programs.seat.action.size
    keys, everyone = draws.keys("tune", range(batch)), np.ones(batch, bool)
    rows, plain = Rows(programs, batch), PlainEpisodes(programs.seat)
    rows.begin(everyone, keys)
    plain.begin(keys)
    for decision in range(decisions):
        over = chance.random(batch) < (0.5 if decision == decisions // 2 else 0.02)
        actions = chance.integers(0, size, batch) if programs.seat.action.discrete else chance.uniform(-1.0, 1.0, (batch, size))
        broken, outcome = raised(lambda: rows.decide(actions, over, over)), raised(lambda: plain.decide(actions, over, True))  # noqa: B023
        if isinstance(outcome, str):
            return "" if broken == outcome else f"decision {decision}: {outcome}"
        if isinstance(broken, str):
            return f"decision {decision}: {broken}"
        here, there = rows.held() | rows.brought, plain.held() | outcome._asdict() | {"seen": plain.seen()}
        for name, wanted in there.items():
            if not same(here[name], wanted):
                return f"{name}, decision {decision}"
    return ""


class Rows:
    """B rows of a seat's episodes, and what the last call brought (see `SeatPrograms`)."""

    def __init__(self, programs: SeatPrograms, batch: int, threads: int = 1) -> None:
        self.programs, self.batch, self.threads = programs, batch, threads
        self.state = State(programs.decide, batch)
        self._decide = self._last = Call(programs.decide, self.state, values=programs.values, threads=threads)
        self._brought: dict[str, Array] | None = {}

    @cached_property
    def _begin(self) -> Call:
        return Call(self.programs.begin, self.state, values=self.programs.values, threads=self.threads)

    @cached_property
    def _alone(self) -> tuple[Any, ...]:
        """What reads the sheet of a single row."""
        call, discrete = self._decide, self.programs.seat.action.discrete
        return call.numbers(ALONE), call.reader("seen", 0), call.reader("mask", 0, np.int8) if discrete else lambda: None

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
        """One decision of each row: actions (B,) or (B, size), over and again (B,) bool."""
        given = self._decide.arguments
        given["action"][...], given["over"][...], given["again"][...] = actions, over, again
        self._play(self._decide)

    def decide_alone(self, action: Any) -> tuple[Any, ...]:
        """The decision of a single row; -> what ALONE names, as Python's numbers, its observation and its mask."""
        given = self._decide.arguments
        given["action"][0], given["over"][0], given["again"][0] = action, False, False
        self._play(self._decide)
        numbers, seen, mask = self._alone
        return *numbers(), seen(), mask()

    def again_alone(self) -> tuple[Any, ...]:
        """The next episode of a single row; -> as `decide_alone`, of a decision that brought nothing."""
        self.begin(np.ones(1, bool))
        new = self.brought
        mask = new["mask"][0].view(np.int8) if "mask" in new else None
        return 0.0, float(new["damage"][0]), int(new["k"][0]), *(False,) * 5, bool(new["allowed"][0]), new["seen"][0], mask

    def _play(self, call: Call) -> None:
        before, sheet = self._last, self._last.sheet
        call.begin()
        call.play(1)
        self._last, self._brought = call, None
        if call.broken and not self.brought["demands"].all():  # idle lanes may hold anything
            raise self.broken(self.brought["demands"], before.results(sheet)["k"])

    def broken(self, demands: Array, k: Array) -> InputError:
        """The error of a decision from steps k (B,) on that broke some of its demands (B, .)."""
        known = self.programs.decide.trace.graph.demands
        first = int(np.flatnonzero(~demands.all(axis=0))[0])
        field, found, wanted, _ = known[first]
        return num.broken(~demands[:, first], field, found, wanted, k + first // (len(known) // self.programs.seat.action.spec.interval))

    def begin(self, rows: Array, keys: Keys | None = None) -> None:
        """Begin episodes in the rows (B,) bool: the next of their own, or those of keys, of as many rows."""
        if keys is not None:
            where, state = np.flatnonzero(rows), self.state
            state.put_leaf("loop.keys.key", keys.key, where)
            state.put_leaf("loop.keys.episode", keys.episode - np.uint32(1), where)
        self._begin.arguments["again"][...] = rows
        self._play(self._begin)

    def held(self) -> dict[str, Array]:
        """All that changes from step to step, by name: copies."""
        return {name: self.state.get_leaf(name) for name in leaves(self.programs.example)}

    def put(self, held: dict[str, Array]) -> None:
        """What `held` gave, of the same number of rows."""
        for name in leaves(self.programs.example):
            self.state.put_leaf(name, held[name])
        self.begin(np.zeros(self.batch, bool))
