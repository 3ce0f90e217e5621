"""Networks of stochastic timed automata as data: components with clocks, locations and edges that speak over broadcast channels.

A YAML file under configs/automata declares one; conditions are triples (clock or variable, comparison, number), so that nothing in it is
an expression. Semantics: `simulate`. After UPPAAL's networks of priced timed automata (David et al., FORMATS 2011; thesis 7.3.3).
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from tailgate.base.errors import InputError, by_name, unknown
from tailgate.core import Finite, NonNegative, Positive, param
from tailgate.core.scenario import config_path
from tailgate.core.schema import build, read_yaml

TIME = "time"  # the clock that everybody reads and nobody sets
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")

Comparison = Literal["<", "<=", "=", ">=", ">"]
Speed = NonNegative | tuple[NonNegative, NonNegative]


class Atom(NamedTuple):
    """One condition: a clock or variable against a number."""

    name: str
    op: Comparison
    value: Finite

    def __str__(self) -> str:
        return f"{self.name} {self.op} {self.value:g}"


Atoms = tuple[Atom, ...]


@dataclass(frozen=True)
class Location:
    """Where a component is. With an invariant it leaves after a uniform delay, without one after an exponential one."""

    name: str
    invariant: Atoms = param((), "upper limits of the component's own clocks: it leaves before one is passed")
    rate: Positive = param(1.0, "rate of the exponential delay where there is no invariant [1/time unit]")
    rates: dict[str, Speed] = dataclasses.field(
        default_factory=dict, metadata={"doc": "how fast own clocks run here, 1 if not named: a number, or [low, high] to draw on entry"}
    )
    committed: bool = param(False, "it is left at once, before anybody else moves")


@dataclass(frozen=True)
class Edge:
    """A step from one location to another."""

    source: str
    target: str
    guard: Atoms = param((), "conditions under which it may be taken")
    sync: str = param("", "channel! sends to all who listen, channel? hears; empty: neither")
    assign: dict[str, Finite] = dataclasses.field(default_factory=dict, metadata={"doc": "clocks and variables that are set"})

    @property
    def channel(self) -> str:
        return self.sync[:-1]

    @property
    def hears(self) -> bool:
        """It waits for another component, and never decides when."""
        return self.sync.endswith("?")

    @property
    def sends(self) -> bool:
        return self.sync.endswith("!")


@dataclass(frozen=True)
class Component:
    """One automaton. Names of clocks and variables are the network's: every component may read them, clocks are set by their own."""

    name: str
    initial: str
    locations: tuple[Location, ...]
    edges: tuple[Edge, ...]
    clocks: tuple[str, ...] = ()
    variables: dict[str, int] = dataclasses.field(default_factory=dict)
    about: str = ""

    def location(self, name: str) -> Location:
        """Raise InputError for a name that does not exist."""
        return by_name(f"component {self.name}: location", name, self.locations)


@dataclass(frozen=True)
class Query:
    """Reachability within a time: <>[<= within] of all conditions at once."""

    name: str
    within: Positive
    holds: Atoms

    def __str__(self) -> str:
        return f"<>[<= {self.within:g}] " + " and ".join(map(str, self.holds))


@dataclass(frozen=True)
class Network:
    """Components side by side, what is asked of them, and which names carry what sensors say."""

    name: str
    components: tuple[Component, ...]
    queries: tuple[Query, ...] = ()
    sensor: tuple[str, ...] = ()
    about: str = ""

    @property
    def clocks(self) -> tuple[str, ...]:
        """All clocks but `time`."""
        return tuple(clock for c in self.components for clock in c.clocks)

    @property
    def variables(self) -> dict[str, int]:
        """All variables with their first values."""
        return {name: value for c in self.components for name, value in c.variables.items()}

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(edge.channel for _, edge in self.edges() if edge.sync))

    def edges(self) -> list[tuple[int, Edge]]:
        """Return every edge with the number of its component."""
        return [(i, edge) for i, c in enumerate(self.components) for edge in c.edges]

    def component(self, name: str) -> Component:
        """Raise InputError for a name that does not exist."""
        return by_name(f"network {self.name}: component", name, self.components)

    def query(self, name: str) -> Query:
        """Raise InputError for a name that does not exist."""
        return by_name(f"network {self.name}: query", name, self.queries)

    def with_location(self, component: str, location: str, **changes: Any) -> Network:
        """Return the same network with other fields of one location."""
        held = self.component(component)
        changed = dataclasses.replace(held.location(location), **changes)
        locations = tuple(changed if one.name == location else one for one in held.locations)
        return self._with(dataclasses.replace(held, locations=locations))

    def with_edge(self, component: str, source: str, target: str, **changes: Any) -> Network:
        """Return the same network with other fields of the edges from one location to another."""
        held = self.component(component)
        edges = tuple(dataclasses.replace(e, **changes) if (e.source, e.target) == (source, target) else e for e in held.edges)
        return self._with(dataclasses.replace(held, edges=edges))

    def _with(self, component: Component) -> Network:
        out = dataclasses.replace(self, components=tuple(component if c.name == component.name else c for c in self.components))
        check(out)
        return out


def load_network(name: str) -> Network:
    """Return a network by its built-in name, or from a YAML file. Raises InputError that names the component and the field."""
    path = config_path("automata", name, "automata")
    return network_of({"name": path.stem} | read_yaml(path, "automata"))


def network_of(data: dict[str, Any]) -> Network:
    """Return a network from data as the YAML file has it, checked as a whole."""
    where = f"automata {data.get('name', '')}".strip()
    if "kind" in data:
        raise InputError(f"{where}.kind", data["kind"], "no kind: this is read as timed automata; tailgate trust --automata reads ctmc")
    components = tuple(_component(held, f"{where}: component {i}") for i, held in enumerate(listed(data, "components", where), start=1))
    queries = tuple(build(Query, held, f"{where}: query {i}") for i, held in enumerate(listed(data, "queries", where), start=1))
    network = build(Network, data | {"components": components, "queries": queries}, where)
    check(network)
    return network


def listed(data: dict[str, Any], key: str, where: str) -> list[dict[str, Any]]:
    """Return the mappings under a key, none where it is missing. Raise InputError for anything else."""
    held = data.get(key, [])
    if not isinstance(held, list) or not all(isinstance(part, dict) for part in held):
        raise InputError(f"{where}.{key}", held, "a list of mappings")
    return held


def _component(data: dict[str, Any], where: str) -> Component:
    where = f"{where} ({data['name']})" if isinstance(data.get("name"), str) else where
    given = data.get("locations", {})
    if not isinstance(given, dict) or not all(isinstance(held, dict) for held in given.values()):
        raise InputError(f"{where}.locations", given, "a mapping of names to fields")
    locations = tuple(build(Location, {"name": name} | held, f"{where}, location {name}") for name, held in given.items())
    edges = tuple(build(Edge, held, f"{where}, edge {i}") for i, held in enumerate(listed(data, "edges", where), start=1))
    return build(Component, data | {"locations": locations, "edges": edges}, where)


def check(network: Network) -> None:
    """Raise InputError where names do not fit together or a condition has no meaning."""
    where = f"automata {network.name}"
    if not network.components:
        raise InputError(f"{where}.components", [], "at least one component")
    _distinct(f"{where}: components", [c.name for c in network.components])
    _distinct(f"{where}: queries", [q.name for q in network.queries])
    shared = [TIME, *network.clocks, *network.variables, *network.channels]
    _distinct(f"{where}: clocks, variables and channels", shared)
    known = {TIME, *network.clocks, *network.variables}
    for name in network.sensor:
        _known(f"{where}.sensor", name, known)
    for query in network.queries:
        _atoms(f"{where}: query {query.name}.holds", query.holds, known)
        if not query.holds:
            raise InputError(f"{where}: query {query.name}.holds", [], "at least one condition")
    sent = {edge.channel for _, edge in network.edges() if edge.sends}
    for component in network.components:
        here = f"{where}: component {component.name}"
        names = [location.name for location in component.locations]
        _distinct(f"{here}: locations", names, shared)
        _known(f"{here}.initial", component.initial, names)
        for location in component.locations:
            _check_location(f"{here}, location {location.name}", location, component)
        for i, edge in enumerate(component.edges, start=1):
            _check_edge(f"{here}, edge {i}", edge, component, known, sent, network.variables)


def _check_location(where: str, location: Location, component: Component) -> None:
    _atoms(f"{where}.invariant", location.invariant, component.clocks)
    for atom in location.invariant:
        if atom.op not in ("<", "<="):
            raise InputError(f"{where}.invariant", str(atom), "upper limits (< or <=) only")
    if location.committed and location.invariant:
        raise InputError(f"{where}.invariant", [str(a) for a in location.invariant], "none, as a committed location is left at once")
    for clock, speed in location.rates.items():
        _known(f"{where}.rates", clock, component.clocks)
        if isinstance(speed, tuple) and speed[0] > speed[1]:
            raise InputError(f"{where}.rates.{clock}", list(speed), "[low, high]")


def _check_edge(where: str, edge: Edge, component: Component, known: Iterable[str], sent: Iterable[str], variables: dict[str, int]) -> None:
    names = [location.name for location in component.locations]
    _known(f"{where}.source", edge.source, names)
    _known(f"{where}.target", edge.target, names)
    _atoms(f"{where}.guard", edge.guard, known)
    if edge.sync and not (edge.sync[-1] in "!?" and NAME.match(edge.channel)):
        raise InputError(f"{where}.sync", edge.sync, "channel! or channel?")
    if edge.hears:
        _known(f"{where}.sync", edge.channel, sent)
    for name, value in edge.assign.items():
        _known(f"{where}.assign", name, [*component.clocks, *variables])
        if name in variables and value != int(value):
            raise InputError(f"{where}.assign.{name}", value, "a whole number, as it is a variable")


def _atoms(where: str, atoms: Atoms, known: Iterable[str]) -> None:
    for atom in atoms:
        _known(where, atom.name, known)


def _known(where: str, name: str, known: Iterable[str]) -> None:
    if name not in known:
        raise unknown(where, name, known)


def _distinct(where: str, names: list[str], others: Iterable[str] = ()) -> None:
    taken = set(others)
    for name in names:
        if name in taken:
            raise InputError(where, name, "names of which no two are equal")
        if not NAME.match(name):
            raise InputError(where, name, "a letter, then letters, digits and underscores")
        taken.add(name)
