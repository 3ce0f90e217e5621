"""Random runs of a network of stochastic timed automata, many side by side; a run depends on its own seed alone, to the bit.

Semantics: David et al., "Statistical model checking for networks of priced timed automata", FORMATS 2011. Each component draws a delay:

        with an invariant that ends    uniform in [earliest moment at which it can move, end of the invariant]
        without one                    exponential with the rate of its location, from the earliest moment on
        in a committed location        none: it goes before all others

The shortest delay wins, and its component takes one of the edges that are then open to it, each as likely. Every other component that
listens to what it sends moves with it; nobody waits for listeners. If none is open by then, everybody draws again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array, draws
from tailgate.core.draws import Keys, Role

from .automata import TIME, Atoms, Network, Query

STEPS = 100_000  # moves that a run may take
STILL = 1_000  # moves within which time has to pass
SLACK = 1e-9  # by which a clock may miss a limit that it was to meet
_log = np.frompyfunc(math.log, 1, 1)  # one number at a time: the same for every batch


class Runs(NamedTuple):
    """B runs. Times are NaN where what they tell of did not happen."""

    hit: Array  # (Q, B) moment at which each query first held
    time: Array  # (B,) at which the run ended
    steps: Array  # (B,) moves
    taken: Array  # (E, B) how often each edge was taken, in the order of Network.edges()
    location: Array  # (C, B) where each component was at the end: the number of its location


class Plan(NamedTuple):
    """A network as numbers: names to rows, locations to their number within the component."""

    network: Network
    row: dict[str, int]  # of clocks (time first), then variables
    locations: tuple[dict[str, int], ...]
    edges: tuple[Any, ...]  # (component, Edge)


class State(NamedTuple):
    """The A runs that still go on."""

    run: Array  # (A,) which of the B
    value: Array  # (V, A)
    speed: Array  # (V, A) of clocks; 0 for variables
    location: Array  # (C, A)


def prepare(network: Network) -> Plan:
    """Return a network with the rows of its values, the indices of its locations, and its edges."""
    row = {name: i for i, name in enumerate((TIME, *network.clocks, *network.variables))}
    locations = tuple({location.name: i for i, location in enumerate(c.locations)} for c in network.components)
    return Plan(network, row, locations, tuple(network.edges()))


def holds(plan: Plan, atoms: Atoms, value: Array) -> Array:
    """Return (A,) whether all conditions hold at these values (V, A)."""
    out = np.ones(value.shape[1], bool)
    for name, op, limit in atoms:
        over, slack = value[plan.row[name]] - limit, SLACK * max(1.0, abs(limit))
        if op in (">", "<"):
            out &= (over if op == ">" else -over) > slack
        elif op == "=":
            out &= np.abs(over) <= slack
        else:
            out &= (over if op == ">=" else -over) >= -slack
    return out


def window(plan: Plan, atoms: Atoms, value: Array, speed: Array) -> tuple[Array, Array]:
    """Return the delays from now [low, high], (A,) each, in which all conditions hold while nothing but clocks moves; low > high for none.

    An open end counts as belonging to it, but an interval of one point with an open end is none.
    """
    count = value.shape[1]
    low, high = np.zeros(count), np.full(count, np.inf)
    if not atoms:
        return low, high
    open_low, open_high = np.zeros(count, bool), np.zeros(count, bool)
    for atom in atoms:
        x, rate = value[plan.row[atom.name]], speed[plan.row[atom.name]]
        now, moving = holds(plan, (atom,), value), rate > 0.0
        left = np.maximum(atom.value - x, 0.0) / np.where(moving, rate, 1.0)  # until the limit is met
        if atom.op in (">", ">=", "="):
            begin = np.where(now, 0.0, np.where(moving & (x <= atom.value), left, np.inf))
            open_low = np.where(begin > low, atom.op == ">", open_low | ((begin == low) & ~now & (atom.op == ">")))
            low = np.maximum(low, begin)
        if atom.op in ("<", "<=", "="):
            end = np.where(moving, left, np.where(now, np.inf, -np.inf))
            end = np.where(now | (moving & (x <= atom.value) & (atom.op == "=")), end, -np.inf)
            open_high = np.where(end < high, atom.op == "<", open_high | ((end == high) & (atom.op == "<")))
            high = np.minimum(high, end)
    return low, np.where((open_low | open_high) & (high <= low), -np.inf, high)


def simulate(
    network: Network,
    runs: Keys | Sequence[int],
    within: float | None = None,
    queries: Sequence[Query] | None = None,
    *,
    stop: bool = True,
    steps: int = STEPS,
) -> Runs:
    """Return one run per seed (or per row of keys), up to a time.

    queries: what to look for, the network's own if not given; within: how long, as the longest query says if not given. stop: a run ends
    as soon as all of them have held, or no longer can as their time is over. One in which nobody can move any more lasts to the end. Raises
    InputError for a run of more than `steps` moves or a thousand in no time (Zeno). The same goes for a component that may neither stay
    nor go.
    """
    plan, asked = prepare(network), tuple(network.queries if queries is None else queries)
    until = float(within) if within is not None else max((query.within for query in asked), default=math.nan)
    if not 0.0 < until < math.inf:
        raise InputError("within", within, "a time above 0 and finite")
    keys = runs if isinstance(runs, Keys) else draws.keys("report", runs)
    batch = len(keys.episode)
    out = Runs(
        np.full((len(asked), batch), np.nan), np.full(batch, np.nan), np.zeros(batch, np.int64),
        np.zeros((len(plan.edges), batch), np.int64), np.zeros((len(network.components), batch), np.int64),
    )  # fmt: skip
    state, before = _start(plan, keys), np.full(batch, -1.0)
    for step in range(1, steps + 1):
        if not len(state.run):
            return out
        state = _move(plan, state, keys, step, until, asked, stop, out)
        if step % STILL == 0:
            _passes(plan, state, state.value[0] - before[state.run] > SLACK, STILL, until)
            before[state.run] = state.value[0]
    _passes(plan, state, np.zeros(len(state.run), bool), steps, until)
    return out


def _passes(plan: Plan, state: State, good: Array, moves: int, until: float) -> None:
    if not good.all():
        run = int(np.argmin(good))
        words = f"{moves} moves by time {state.value[0, run]:g} ({_words(plan, state.location[:, run])})"
        raise InputError("automata", words, f"a run that gets to time {until:g}")


def _start(plan: Plan, keys: Keys) -> State:
    batch, network = len(keys.episode), plan.network
    value = np.zeros((len(plan.row), batch))
    for name, first in network.variables.items():
        value[plan.row[name]] = first
    speed = np.zeros_like(value)
    speed[: 1 + len(network.clocks)] = 1.0
    location = np.array([[plan.locations[i][c.initial]] for i, c in enumerate(network.components)]) * np.ones((1, batch), np.int64)
    u = keys.at(Role.PROCESS, np.zeros(batch, np.int64)).uniform((len(plan.row),)).T
    _enter(plan, speed, location, np.ones(location.shape, bool), u)
    return State(np.arange(batch), value, speed, location)


def _enter(plan: Plan, speed: Array, location: Array, moved: Array, u: Array) -> None:
    """Set how fast the clocks of components that moved (C, A) run where they are now; u (V, A) draws what is drawn."""
    for i, component in enumerate(plan.network.components):
        for j, where in enumerate(component.locations):
            here = moved[i] & (location[i] == j)
            for clock in component.clocks if here.any() else ():
                row, rate = plan.row[clock], where.rates.get(clock, 1.0)
                low, high = rate if isinstance(rate, tuple) else (rate, rate)
                speed[row, here] = low + (high - low) * u[row, here]


def _move(plan: Plan, state: State, keys: Keys, step: int, until: float, asked: tuple[Query, ...], stop: bool, out: Runs) -> State:
    """Move every run that goes on once; write what ended into `out`."""
    count, parts, edges = len(state.run), len(plan.locations), len(plan.edges)
    own = Keys(keys.key[state.run], keys.episode[state.run])
    u = own.at(Role.PROCESS, np.full(count, step)).uniform((2 * parts + edges + len(plan.row),)).T
    wait, tie, choice, rates = np.split(u, np.cumsum([parts, parts, edges]))
    delay = _delays(plan, state, wait, until)
    shortest, now = delay.min(axis=0), state.value[0]
    over = now + shortest > until
    _look(plan, state, np.minimum(shortest, until - now), asked, out)
    ends = np.full(count, until)
    if stop and asked:
        hit = out.hit[:, state.run]
        last = hit.max(axis=0)  # NaN as long as one has not held
        decided = ~(np.isnan(hit) & (now <= np.array([_expires(query) for query in asked])[:, None])).any(axis=0)
        ends, over = np.where(decided, np.where(np.isnan(last), now, last), until), over | decided
    out.time[state.run[over]], out.location[:, state.run[over]] = ends[over], state.location[:, over]
    go = ~over
    out.steps[state.run[go]] += 1
    state = state._replace(value=state.value + state.speed * np.where(go, shortest, 0.0))
    state = State(*(part[..., go] for part in state))
    return _fire(plan, state, (delay == shortest)[:, go], tie[:, go], choice[:, go], rates[:, go], out)


def _expires(query: Query) -> float:
    """Return the time after which it can no longer begin to hold."""
    return min([query.within, *(atom.value for atom in query.holds if atom.name == TIME and atom.op in ("<", "<="))])


def _look(plan: Plan, state: State, passed: Array, asked: tuple[Query, ...], out: Runs) -> None:
    """Note the moment at which a query first holds, if it does before `passed` (A,) is over."""
    for query, hit in zip(asked, out.hit, strict=True):
        low, high = window(plan, query.holds, state.value, state.speed)
        at = state.value[0] + low
        good = (low <= high) & (low <= passed) & (at <= query.within) & np.isnan(hit[state.run])
        hit[state.run[good]] = at[good]


def _delays(plan: Plan, state: State, u: Array, until: float) -> Array:
    """Return (C, A) what each component draws; infinite for one that waits for others."""
    shape = state.location.shape
    delay, limit, urgent = np.full(shape, np.inf), np.full(shape, np.inf), np.zeros(shape, bool)
    for i, component in enumerate(plan.network.components):
        for j, where in enumerate(component.locations):
            here = np.flatnonzero(state.location[i] == j)
            if not len(here):
                continue
            value, speed = state.value[:, here], state.speed[:, here]
            end = np.where(holds(plan, where.invariant, value), np.maximum(window(plan, where.invariant, value, speed)[1], 0.0), -np.inf)
            early = np.full(len(here), np.inf)
            for _, edge in (e for e in plan.edges if e[0] == i and e[1].source == where.name and not e[1].hears):
                low, high = window(plan, edge.guard + where.invariant, value, speed)
                early = np.minimum(early, np.where(low <= high, low, np.inf))
            can = np.isfinite(early)
            if where.committed:
                can, end, drawn = early <= 0.0, np.zeros(len(here)), np.zeros(len(here))
                urgent[i, here] = True
            else:
                drawn = early - np.asarray(_log(u[i, here]), np.float64) / where.rate
                ends = can & np.isfinite(end)
                drawn[ends] = early[ends] + u[i, here[ends]] * (end[ends] - early[ends])
            delay[i, here] = np.where(can, drawn, np.inf)
            limit[i, here] = np.where(can, np.inf, end)
    if urgent.any():
        delay = np.where(urgent.any(axis=0) & ~urgent, np.inf, delay)
    least = np.minimum(delay.min(axis=0), until - state.value[0])
    stuck = limit.min(axis=0) < least
    if stuck.any():
        run = int(np.argmax(stuck))
        raise InputError(
            "automata", f"time {state.value[0, run]:g} ({_words(plan, state.location[:, run])})",
            f"a way for {plan.network.components[int(limit[:, run].argmin())].name} out of a place where it may not stay",
        )  # fmt: skip
    return delay


def _fire(plan: Plan, state: State, first: Array, tie: Array, choice: Array, rates: Array, out: Runs) -> State:
    """Return the winner's move and its listeners'; `first` (C, A) marks whose delay was the shortest."""
    winner = np.where(first, tie, np.inf).argmin(axis=0)
    open_ = np.array([holds(plan, e.guard, state.value) & (state.location[i] == plan.locations[i][e.source]) for i, e in plan.edges])
    component = np.array([i for i, _ in plan.edges])[:, None]
    hears = np.array([e.hears for _, e in plan.edges])[:, None]
    go = _one_of(open_ & ~hears & (component == winner), choice)
    said = {name: np.zeros(go.shape[1], bool) for name in plan.network.channels}
    for e, (_, edge) in enumerate(plan.edges):
        if edge.sends:
            said[edge.channel] |= go[e]
    heard = np.array([said[e.channel] if e.hears else np.zeros(go.shape[1], bool) for _, e in plan.edges])
    listening = open_ & heard & (component != winner)
    for i in range(len(plan.locations)):
        go |= _one_of(listening & (component == i), choice)
    value, location, speed = state.value.copy(), state.location.copy(), state.speed.copy()
    moved = np.zeros(location.shape, bool)
    for e in sorted(range(len(plan.edges)), key=lambda e: plan.edges[e][1].hears):  # who speaks sets first
        i, edge = plan.edges[e]
        for name, new in edge.assign.items():
            value[plan.row[name], go[e]] = new
        location[i, go[e]] = plan.locations[i][edge.target]
        moved[i] |= go[e]
        out.taken[e, state.run] += go[e]
    _enter(plan, speed, location, moved, rates)
    return State(state.run, value, speed, location)


def _one_of(may: Array, score: Array) -> Array:
    """Return (E, A) at most one of the edges that may be taken in each run, each as likely."""
    best = np.where(may, score, np.inf).argmin(axis=0)
    return np.asarray(may & (np.arange(len(may))[:, None] == best))


def _words(plan: Plan, location: Array) -> str:
    return ", ".join(f"{c.name} in {c.locations[j].name}" for c, j in zip(plan.network.components, location, strict=True))
