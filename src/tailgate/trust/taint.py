"""Which signals of a network depend on what sensors say (thesis table 7.1), by reachability in the declaration."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from .automata import Network

Node = tuple[str, ...]  # ("name", clock or variable), ("location", component, location), ("edge", its number)


class Signal(NamedTuple):
    """One row of the table: a channel sent (!) or heard (?)."""

    sync: str
    one_hop: bool  # guarded by sensor state, or heard from such an edge
    transitive: bool
    path: tuple[str, ...]  # the shortest chain from sensor state to it, in words; empty if there is none


def signals(network: Network) -> list[str]:
    """Return every synchronisation once, in the order of the declaration."""
    return list(dict.fromkeys(edge.sync for _, edge in network.edges() if edge.sync))


def influences(network: Network) -> dict[Node, list[Node]]:
    """Return what each name, location and edge has an influence on.

    - a name: the edges whose guard reads it, and those that leave a location whose invariant reads it
    - a location: the edges that leave it
    - an edge: the location that it leads to, what it sets, and those who hear it
    """
    out: dict[Node, list[Node]] = {}

    def add(cause: Node, effect: Node) -> None:
        out.setdefault(cause, []).append(effect)

    edges = network.edges()
    for e, (i, edge) in enumerate(edges):
        component, node = network.components[i], ("edge", str(e))
        for atom in (*edge.guard, *(() if edge.hears else component.location(edge.source).invariant)):
            add(("name", atom.name), node)
        add(("location", component.name, edge.source), node)
        add(node, ("location", component.name, edge.target))
        for name in edge.assign:
            add(node, ("name", name))
        for h, (_, other) in enumerate(edges):
            if edge.sends and other.hears and edge.channel == other.channel:
                add(node, ("edge", str(h)))
    return out


def one_hop(network: Network) -> set[str]:
    """Return signals of edges whose guard reads sensor state, and of those who hear them: the thesis's reading."""
    guarded = [edge for _, edge in network.edges() if any(atom.name in network.sensor for atom in edge.guard)]
    sent = {edge.channel for edge in guarded if edge.sends}
    return {edge.sync for edge in guarded if edge.sync} | {edge.sync for _, edge in network.edges() if edge.hears and edge.channel in sent}


def paths(network: Network) -> dict[Node, tuple[Node, ...]]:
    """Return everything that sensor state has an influence on, with the shortest chain of influences to it (breadth first)."""
    follows = influences(network)
    found: dict[Node, tuple[Node, ...]] = {("name", name): (("name", name),) for name in network.sensor}
    todo = deque(found)
    while todo:
        node = todo.popleft()
        for after in follows.get(node, []):
            if after not in found:
                found[after] = (*found[node], after)
                todo.append(after)
    return found


def table(network: Network) -> list[Signal]:
    """Return table 7.1 by both readings."""
    direct, reached = one_hop(network), paths(network)
    out = []
    for sync in signals(network):
        chains = [
            reached["edge", str(e)] for e, (_, edge) in enumerate(network.edges()) if edge.sync == sync and ("edge", str(e)) in reached
        ]
        shortest = min(chains, key=len, default=())
        out.append(Signal(sync, sync in direct, bool(chains), tuple(_word(network, node) for node in shortest)))
    return out


def _word(network: Network, node: Node) -> str:
    if node[0] != "edge":
        return node[-1]
    edge = network.edges()[int(node[1])][1]
    return edge.sync or f"{edge.source} to {edge.target}"
