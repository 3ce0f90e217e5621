"""The security of an architecture as a continuous-time Markov chain: nodes that are exploited through their neighbours, and patched.

A node is secure or exploited. An exploit takes an exponential time, and needs an entry from outside or an exploited neighbour. A patch
takes an exponential time, and makes the node secure again. A message is broken while any node that it passes through is exploited
(Mundhenk et al., Security Analysis of Automotive Architectures Using Probabilistic Model Checking, DAC 2015).

Up to 10^5 states the chain is solved by uniformisation. A larger one is played as a network of automata (`as_network`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from tailgate.base.errors import InputError, NotApplicable, by_name, unknown
from tailgate.core import Array, NonNegative, Positive, param
from tailgate.core.scenario import config_path
from tailgate.core.schema import build, read_yaml
from tailgate.trust.automata import NAME, Atom, Component, Edge, Location, Network, Query, check, listed

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

FORMAT = "tailgate-ctmc-1"
MOST = 100_000  # states that are solved
TAIL = 1e-12  # probability of the Poisson terms that are left out
DENSE = 1024  # states of a class that are solved by elimination
CLOSE = 1e-9  # share by which the flow out of a state may differ from the flow into it
SURE = 1e-10  # by how much nodes' shares from below and from above may differ, all together
WORK = 4_000_000_000  # entries that the steps of a large chain may touch
LONGEST = 2_000_000  # steps of the uniformised chain
Pair = tuple[str, str]


@dataclass(frozen=True)
class Node:
    """A control unit, a bus or a radio."""

    name: str
    exploit: NonNegative = param(1.0, "rate at which it is exploited while it can be reached [1/unit]")
    patch: NonNegative = param(0.0, "rate at which an exploited one becomes secure again [1/unit]")
    entry: bool = param(False, "it can be reached from outside")


@dataclass(frozen=True)
class Route:
    """A message and the nodes that it passes through."""

    name: str
    through: tuple[str, ...]


@dataclass(frozen=True)
class Asked:
    """A question: the probability that a message was broken by some time, if all is secure at first."""

    name: str
    message: str
    within: Positive


@dataclass(frozen=True)
class Architecture:
    """Nodes, the links between them, messages, and what is asked of them."""

    name: str
    nodes: tuple[Node, ...]
    links: tuple[Pair, ...] = ()
    messages: tuple[Route, ...] = ()
    queries: tuple[Asked, ...] = ()
    kind: Literal["ctmc"] = "ctmc"
    unit: str = param("year", "unit of time")
    about: str = ""

    def neighbours(self, name: str) -> tuple[str, ...]:
        """Return the nodes that a node is linked with."""
        return tuple(b if a == name else a for a, b in self.links if name in (a, b))

    def message(self, name: str) -> Route:
        """Raise InputError for a name that does not exist."""
        return by_name(f"automata {self.name}: message", name, self.messages)


def load_architecture(name: str) -> Architecture:
    """Return an architecture by its built-in name, or from a YAML file with `kind: ctmc`."""
    path = config_path("automata", name, "automata")
    return architecture_of({"name": path.stem} | read_yaml(path, "automata"))


def architecture_of(data: dict[str, Any]) -> Architecture:
    """Return an architecture from data as the YAML file has it, checked as a whole."""
    where = f"automata {data.get('name', '')}".strip()
    if data.get("kind") != "ctmc":
        raise InputError(f"{where}.kind", data.get("kind"), "ctmc; a network of timed automata has no kind, and is simulated")
    for key, one, cls in (("nodes", "node", Node), ("messages", "message", Route), ("queries", "query", Asked)):
        data = data | {key: tuple(build(cls, part, f"{where}: {one} {i}") for i, part in enumerate(listed(data, key, where), start=1))}
    made: Architecture = build(Architecture, data, where)
    _check(made, where)
    return made


def _check(made: Architecture, where: str) -> None:
    for key in ("name", "unit"):
        if not (text := getattr(made, key)).isprintable():  # both go into a line of comment of an exported model
            raise InputError(f"{where}.{key}", text, "text on one line, without control characters")
    if not made.nodes:
        raise InputError(f"{where}.nodes", [], "at least one node")
    parts: dict[str, tuple[Node | Route | Asked, ...]] = {"nodes": made.nodes, "messages": made.messages, "queries": made.queries}
    for key, held in parts.items():
        names = [part.name for part in held]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise InputError(f"{where}.{key}", name, "names of which no two are equal")
            if not NAME.match(name):
                raise InputError(f"{where}.{key}", name, "a letter, then letters, digits and underscores")
    known = [node.name for node in made.nodes]
    for pair in made.links:
        for name in pair:
            if name not in known:
                raise unknown(f"{where}.links", name, known)
        if pair[0] == pair[1]:
            raise InputError(f"{where}.links", list(pair), "two different nodes")
    if not any(node.entry for node in made.nodes):
        raise InputError(f"{where}.nodes", known, "at least one entry from outside")
    for route in made.messages:
        if not route.through:
            raise InputError(f"{where}: message {route.name}.through", [], "at least one node")
        for name in route.through:
            if name not in known:
                raise unknown(f"{where}: message {route.name}.through", name, known)
    for query in made.queries:
        made.message(query.message)


class Chain(NamedTuple):
    """The reachable states, the secure one first: exploited (S, n) bool, and the generator Q (S, S)."""

    exploited: Array
    generator: csr_matrix


def chain_of(made: Architecture, most: int = MOST) -> Chain:
    """Return the chain of all states that can be reached from the secure one.

    Raises
    ------
    NotApplicable
        If there are more than `most`.
    """
    from scipy.sparse import csr_matrix

    names = [node.name for node in made.nodes]
    near = [sum(1 << names.index(other) for other in set(made.neighbours(name))) for name in names]
    place, order, rows, columns, rates = {0: 0}, [0], [], [], []
    for state in order:  # grows while it is read
        for i, node in enumerate(made.nodes):
            on = state >> i & 1
            rate = node.patch if on else node.exploit if node.entry or state & near[i] else 0.0
            if rate == 0.0:
                continue
            after = state ^ 1 << i
            if after not in place:
                if len(order) >= most:
                    raise NotApplicable(f"automata {made.name}", f"more than {most} states", "fewer nodes, or --runs to simulate")
                place[after] = len(order)
                order.append(after)
            rows.append(place[state])
            columns.append(place[after])
            rates.append(rate)
    size = len(order)
    off = csr_matrix((rates, (rows, columns)), shape=(size, size))
    out = np.asarray(off.sum(axis=1)).ravel()
    diagonal = csr_matrix((out, (np.arange(size), np.arange(size))), shape=(size, size))
    states = np.array([[state >> i & 1 for i in range(len(names))] for state in order], bool).reshape(size, len(names))
    return Chain(states, (off - diagonal).tocsr())


def broken(made: Architecture, chain: Chain, message: str) -> Array:
    """Return (S,) bool: the states in which a message is broken."""
    names = [node.name for node in made.nodes]
    return np.asarray(chain.exploited[:, [names.index(name) for name in made.message(message).through]].any(axis=1))


def transient(generator: csr_matrix, start: Array, time: float) -> Array:
    """Return the distribution (S,) at a time, by uniformisation: Poisson's weights of the steps of the uniformised chain.

    The terms that are left out have the probability TAIL together.
    """
    from scipy.stats import poisson

    fastest = float(-generator.diagonal().min(initial=0.0))
    if fastest == 0.0 or time == 0.0:
        return np.array(start, float)
    mean = fastest * time
    last = int(poisson.isf(TAIL / 2.0, mean)) + 1
    if last > LONGEST:
        raise NotApplicable("automata: within", time, f"a time of at most {LONGEST / fastest:.3g}: the fastest rate is {fastest:g}")
    first = max(int(poisson.ppf(TAIL / 2.0, mean)) - 1, 0)
    weights, step = poisson.pmf(np.arange(last + 1), mean), generator.T.tocsr() / fastest
    held, out = np.array(start, float), np.zeros(len(start))
    for k in range(last + 1):
        if k >= first:
            out += weights[k] * held
        held = held + step @ held
    return np.asarray(out)


def first_time(made: Architecture, chain: Chain, message: str, within: float) -> float:
    """Return the probability that a message was broken by a time, from the secure state: the broken states absorb."""
    hit = broken(made, chain, message)
    keep = (~hit).astype(float)
    generator = chain.generator.multiply(keep[:, None]).tocsr()
    start = np.zeros(len(hit))
    start[0] = 1.0
    return float(transient(generator, start, within)[hit].sum())


def lasting(chain: Chain) -> Array:
    """Return the distribution (S,) in the long run, from the secure state.

    From every state all nodes that can be reached may be exploited next, so that one class of states is never left. Up to DENSE states it
    is solved by elimination without a subtraction (Grassmann, Taksar and Heyman, Operations Research 1985). That is exact to a few
    roundings of each state's share, whatever the sizes of the rates. A larger chain is stepped (`_stepped`).

    Raises
    ------
    NotApplicable
        If it does not settle.
    """
    from scipy.sparse.csgraph import breadth_first_order

    rates = chain.generator.copy()
    rates.setdiag(0.0)
    rates.eliminate_zeros()
    worst = int(np.argmax(chain.exploited.sum(axis=1)))
    kept = np.sort(breadth_first_order(rates, worst, return_predecessors=False))
    if len(kept) > DENSE:
        return _stepped(chain, worst)
    inner = rates[kept][:, kept]
    share = _eliminated(inner.toarray())
    out, into = share * np.asarray(inner.sum(axis=1)).ravel(), inner.T @ share
    if not (np.isfinite(share).all() and (np.abs(out - into) <= CLOSE * np.maximum(out, into)).all()):
        raise NotApplicable("automata: nodes: exploit, patch", float(rates.max()), "rates whose ratios stay within the range of a number")
    held = np.zeros(len(chain.exploited))
    held[kept] = share
    return held


def _eliminated(rates: Array) -> Array:
    """Return the stationary distribution (S,) of rates (S, S) with a zero diagonal, all states of one class. `rates` is used up."""
    for n in range(len(rates) - 1, 0, -1):
        rates[:n, n] /= rates[n, :n].sum()
        rates[:n, :n] += rates[:n, n, None] * rates[n, :n]
    share = np.ones(len(rates))
    for n in range(1, len(rates)):
        share[n] = share[:n] @ rates[:n, n]
    return np.asarray(share / share.sum())


def _stepped(chain: Chain, worst: int) -> Array:
    """Return the same by powers of the uniformised chain, from the secure state and from the worst one.

    An exploited node never makes another one safer. What begins secure therefore stays below the long run, and what begins at the worst
    above it, in each node's share. They end when those shares agree to SURE together.
    """
    fastest = float(-chain.generator.diagonal().min())
    held = np.zeros((len(chain.exploited), 2))
    held[0, 0] = held[worst, 1] = 1.0
    step = chain.generator.T.tocsr() / (1.05 * fastest)  # a little slower than the fastest: no state is left for sure, so it has no period
    many, marks = min(LONGEST, WORK // step.nnz), chain.exploited.astype(float)
    for k in range(many):
        held = held + step @ held
        if k % 16 == 0 and np.abs(marks.T @ (held[:, 1] - held[:, 0])).sum() < SURE:
            return np.asarray(held[:, 0] / held[:, 0].sum())
    raise NotApplicable(
        "automata: nodes: exploit, patch", fastest,
        f"rates of one size where there are more than {DENSE} states: the fastest is too fast for the slowest in {many} steps",
    )  # fmt: skip


def long_run(made: Architecture, chain: Chain, message: str, share: Array | None = None) -> float:
    """Return the share of time that a message is broken, in the long run."""
    held = lasting(chain) if share is None else share
    return float(held[broken(made, chain, message)].sum())


def as_network(made: Architecture) -> Network:
    """Return the same process as a network of automata with exponential delays, for as many nodes as anyone likes.

    `x_NODE` is 1 while a node is exploited, `hit_MESSAGE` from the first time on that the message was broken.
    """
    components = []
    for node in made.nodes:
        hits = {f"hit_{route.name}": 1.0 for route in made.messages if node.name in route.through}
        guards: list[tuple[Atom, ...]] = [()] if node.entry else [(Atom(f"x_{other}", "=", 1.0),) for other in made.neighbours(node.name)]
        edges = [Edge(f"secure_{node.name}", f"exploited_{node.name}", guard, assign={f"x_{node.name}": 1.0} | hits) for guard in guards]
        if node.exploit == 0.0:
            edges = []
        if node.patch > 0.0:
            edges.append(Edge(f"exploited_{node.name}", f"secure_{node.name}", assign={f"x_{node.name}": 0.0}))
        places = (
            Location(f"secure_{node.name}", rate=node.exploit or 1.0), Location(f"exploited_{node.name}", rate=node.patch or 1.0),
        )  # fmt: skip
        components.append(Component(node.name, f"secure_{node.name}", places, tuple(edges), variables={f"x_{node.name}": 0}))
    first = components[0]
    hit = {f"hit_{route.name}": 0 for route in made.messages}
    components[0] = Component(first.name, first.initial, first.locations, first.edges, variables=first.variables | hit)
    queries = tuple(Query(query.name, query.within, (Atom(f"hit_{query.message}", "=", 1.0),)) for query in made.queries)
    network = Network(made.name, tuple(components), queries)
    check(network)
    return network


def solve(made: Architecture) -> dict[str, Any]:
    """Return the report: of each message its share of time broken in the long run, of each query its probability."""
    chain = chain_of(made)
    share = lasting(chain)
    return {
        "format": FORMAT, "name": made.name, "unit": made.unit, "method": "uniformisation", "states": len(share),
        "nodes": {node.name: float(share[chain.exploited[:, i]].sum()) for i, node in enumerate(made.nodes)},
        "messages": {route.name: long_run(made, chain, route.name, share) for route in made.messages},
        "queries": [
            {"name": q.name, "message": q.message, "within": q.within, "probability": first_time(made, chain, q.message, q.within)}
            for q in made.queries
        ],
    }  # fmt: skip


def play(made: Architecture, runs: int, level: float = 0.95) -> dict[str, Any]:
    """Return the report of a simulation: each query's share of runs with its exact interval.

    Raises
    ------
    InputError
        Without a query, or with fewer than one run.
    """
    from tailgate.evaluation.stats import proportion
    from tailgate.trust.simulate import simulate

    if runs < 1:
        raise InputError("--runs", runs, "a whole number, at least 1")
    if not made.queries:
        raise InputError(f"automata {made.name}.queries", [], "at least one query to simulate")
    found = simulate(as_network(made), range(runs))
    rows = []
    for query, times in zip(made.queries, found.hit, strict=True):
        share = proportion(int(np.count_nonzero(np.nan_to_num(times, nan=math.inf) <= query.within)), runs, level)
        one = {"name": query.name, "message": query.message, "within": query.within}
        rows.append(one | {"probability": share.value, "low": share.low, "high": share.high})
    return {"format": FORMAT, "name": made.name, "unit": made.unit, "method": "simulation", "runs": runs, "queries": rows}
