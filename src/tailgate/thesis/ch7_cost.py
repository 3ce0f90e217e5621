"""The cost of a run of the automata by the number of components and of clocks (thesis 7.3.4)."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator
from typing import NamedTuple

from tailgate.trust.automata import TIME, Atom, Atoms, Component, Network, check, load_network
from tailgate.trust.simulate import simulate

from .ch7_automata import NETWORK
from .claims import Claim, verdict

COPIES = (1, 2, 4)  # of the three automata, side by side
IDLE = (0, 16, 64, 256)  # further clocks, which run and are never read
RUNS, WITHIN, REPEATS = 50, 30.0, 3


class Cost(NamedTuple):
    """The price of a simulated run."""

    moves: float  # of a run, mean
    rate: float  # runs per second of one processor


def copies(network: Network, count: int) -> Network:
    """Return copies of a network side by side, which have nothing but `time` in common."""
    out = Network(f"{network.name}-{count}", tuple(_copy(c, f"_{i}") for i in range(count) for c in network.components))
    check(out)
    return out


def _copy(component: Component, end: str) -> Component:
    places = tuple(
        dataclasses.replace(p, invariant=_atoms(p.invariant, end), rates={clock + end: v for clock, v in p.rates.items()})
        for p in component.locations
    )
    edges = tuple(
        dataclasses.replace(
            e, guard=_atoms(e.guard, end), sync=f"{e.channel}{end}{e.sync[-1]}" if e.sync else "",
            assign={name + end: v for name, v in e.assign.items()},
        )
        for e in component.edges
    )  # fmt: skip
    return dataclasses.replace(
        component, name=component.name + end, clocks=tuple(clock + end for clock in component.clocks),
        variables={name + end: v for name, v in component.variables.items()}, locations=places, edges=edges,
    )  # fmt: skip


def _atoms(atoms: Atoms, end: str) -> Atoms:
    return tuple(Atom(a.name if a.name == TIME else a.name + end, a.op, a.value) for a in atoms)


def idle(network: Network, count: int) -> Network:
    """Return the same network with further clocks in its first component."""
    head, *others = network.components
    head = dataclasses.replace(head, clocks=(*head.clocks, *(f"idle_{i}" for i in range(count))))
    out = dataclasses.replace(network, components=(head, *others))
    check(out)
    return out


def cost(network: Network) -> Cost:
    """Return the fastest of some repeats, in processor time."""
    best, moves = math.inf, 0.0
    for _ in range(REPEATS):
        begin = time.process_time()
        moves = float(simulate(network, range(RUNS), within=WITHIN, queries=[]).steps.mean())
        best = min(best, time.process_time() - begin)
    return Cost(moves, RUNS / max(best, 1e-9))


def parts() -> Iterator[Claim]:
    """Return the claims on the cost of a run."""
    network = load_network(NETWORK)
    many = {count: cost(copies(network, count)) for count in COPIES}
    clocks = {count: cost(idle(network, count)) for count in IDLE}
    power = math.log(many[COPIES[0]].rate / many[COPIES[-1]].rate) / math.log(COPIES[-1] / COPIES[0])
    slower = clocks[IDLE[0]].rate / clocks[IDLE[-1]].rate
    parts, held = len(network.components), len(network.clocks)
    yield Claim(
        "7.3.4-size", "Statistical model checking is scalable to large designs", "scalable",
        {"runs per second, by components": {f"{parts * n}": round(c.rate) for n, c in many.items()},
         "moves of a run": {f"{parts * n}": round(c.moves) for n, c in many.items()}, "time grows with the power": round(power, 2)},
        verdict(power < 3.0, power > 6.0),
        "copies of the three automata side by side, 30 time units, processor time of the machine that ran it: a run has as many times more "
        "moves as there are components, each of which costs about as many times more; the exponentially many states play no part",
    )  # fmt: skip
    yield Claim(
        "7.3.4-clocks", "A large number of digital clocks affects efficiency and scalability", "affected (one clock is used)",
        {"runs per second, by clocks": {f"{held + n}": round(c.rate) for n, c in clocks.items()},
         f"times slower with {held + IDLE[-1]} clocks than with {held}": round(slower, 2)},
        verdict(slower > 1.2, slower < 1.05),
        "clocks that run and are never read, processor time of the machine that ran it: it does, by a little for each, as a run holds one "
        f"number a clock; the automata as described need {held} clocks, not one",
    )  # fmt: skip
