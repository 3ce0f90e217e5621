"""A network as a UPPAAL SMC model (XML, DTD flat-1_6), with its queries. What it means there: docs/automata.md."""

from __future__ import annotations

import math
from collections.abc import Container
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from tailgate.base.errors import InputError
from tailgate.base.files import write_atomic

from .automata import TIME, Atom, Component, Edge, Location, Network, Query, Speed

DTD = "<!DOCTYPE nta PUBLIC '-//Uppaal Team//DTD Flat System 1.6//EN' 'http://www.it.uu.se/research/group/darts/uppaal/flat-1_6.dtd'>"
ENTRY = "entry_"  # a committed location before the first one, where that one draws clock rates
WORDS = (
    "chan clock bool int double string commit committed const urgent broadcast init initial process state guard sync assign system trans "
    "deadlock and or xor not imply true false for forall exists foreach while do if else return typedef struct rate before_update "
    "after_update meta priority progress scalar select void default switch case continue break enum hybrid sum inf sup bounds "
    "simulation invariant location branchpoint template import dynamic spawn exit numOf gantt IO assert "
    "A E M R U W Pr simulate control control_t acontrol strategy under sat consistency refinement specification implementation "
    "minE maxE minPr maxPr minexp maxexp loadStrategy saveStrategy min max query probability"
)
FUNCTIONS = (
    "abs fabs fmod fma fmax fmin fdim fint exp exp2 expm1 ln log log10 log2 log1p pow sqrt cbrt hypot sin cos tan asin acos atan atan2 "
    "sinh cosh tanh asinh acosh atanh erf erfc tgamma lgamma ceil floor trunc round ldexp ilogb logb nextafter copysign signbit "
    "isfinite isinf isnan isnormal isunordered random random_arcsine random_beta random_gamma random_normal random_poisson random_tri "
    "random_weibull"
)
RESERVED = frozenset((WORDS + " " + FUNCTIONS).split())  # names that mean something to UPPAAL
INT = 32767  # largest value of its integers, which begin at -INT - 1
LITERAL = 2**31 - 1  # largest whole number that may be written without a point
SPREAD = 160  # between locations of the drawing


class Names(NamedTuple):
    """The identifier of everything that is written. Those that are shared are distinct, and no location has one of them."""

    shared: dict[str, str]  # of clocks, variables and channels
    rates: dict[str, str]  # by clock: the variable that holds the rate which was drawn
    templates: tuple[str, ...]  # by component
    processes: tuple[str, ...]
    locations: tuple[dict[str, str], ...]  # of locations, by component
    entries: tuple[str, ...]


def identifier(name: str, taken: Container[str] = ()) -> str:
    """Return a name as UPPAAL takes it: its own words, and what is taken, get an underscore."""
    while name in RESERVED or name in taken:
        name += "_"
    return name


def _named(wanted: list[str], taken: set[str]) -> dict[str, str]:
    """Return identifiers in the order of the names; they become taken. A name that need not change stays, whatever comes before it."""
    kept = [name for name in wanted if name not in RESERVED and name not in taken]
    taken.update(kept)
    out = {}
    for name in wanted:
        out[name] = name if name in kept else identifier(name, taken)
        taken.add(out[name])
    return out


def names_of(network: Network) -> Names:
    """Return identifiers of UPPAAL for all names of a network, no two alike in a scope."""
    taken: set[str] = set()
    shared = _named([TIME, *network.clocks, *network.variables, *network.channels], taken)
    drawn = dict.fromkeys(clock for c in network.components for location in c.locations for clock in draws_of(location))
    rates = {clock: _named([f"rate_{clock}"], taken)[f"rate_{clock}"] for clock in drawn}
    parts = [c.name for c in network.components]
    templates = tuple(_named([f"{name}_template" for name in parts], taken).values())
    processes = tuple(_named([f"{name}_process" for name in parts], taken).values())
    locations, entries = [], []
    for component in network.components:
        local = set(taken)  # a location's name would hide a shared one
        locations.append(_named([location.name for location in component.locations], local))
        entries.append(identifier(ENTRY, local))
    return Names(shared, rates, templates, processes, tuple(locations), tuple(entries))


def number(value: float) -> str:
    """Return a number as UPPAAL reads it: whole ones without a point."""
    return str(int(value)) if value == int(value) and abs(value) <= LITERAL else repr(float(value))


def whole(where: str, value: float) -> str:
    """Return a value of an integer variable. Raises InputError for one that UPPAAL's integers do not hold."""
    if not -INT - 1 <= value <= INT:
        raise InputError(where, value, f"from {-INT - 1} to {INT}, as UPPAAL's integers are")
    return str(int(value))


def condition(atoms: tuple[Atom, ...], names: Names) -> str:
    """Return a guard, an invariant or a state formula."""
    return " && ".join(f"{names.shared[a.name]} {'==' if a.op == '=' else a.op} {number(a.value)}" for a in atoms)


def formula(query: Query, names: Names) -> str:
    """Return a query in UPPAAL's language."""
    return f"Pr[<={number(query.within)}](<> {condition(query.holds, names)})"


def draws_of(location: Location) -> dict[str, tuple[float, float]]:
    """Return clocks whose rate is drawn on entry."""
    return {clock: speed for clock, speed in location.rates.items() if isinstance(speed, tuple)}


def invariant(location: Location, names: Names) -> str:
    """Return limits, and the rates of clocks that do not run at 1."""
    rates = [f"{names.shared[clock]}' == {_speed(clock, speed, names)}" for clock, speed in location.rates.items()]
    return " && ".join([*([condition(location.invariant, names)] if location.invariant else []), *rates])


def _speed(clock: str, speed: Speed, names: Names) -> str:
    return names.rates[clock] if isinstance(speed, tuple) else number(speed)


def assignment(edge: Edge, component: Component, names: Names) -> str:
    """Return what is set, and what is drawn for the location that is entered."""
    sets = []
    for name, value in edge.assign.items():
        text = number(value) if name in component.clocks else whole(f"component {component.name}: assign.{name}", value)
        sets.append(f"{names.shared[name]} = {text}")
    return ", ".join([*sets, *_drawn(component.location(edge.target), names)])


def _drawn(location: Location, names: Names) -> list[str]:
    return [f"{names.rates[clock]} = {number(low)} + random({number(high - low)})" for clock, (low, high) in draws_of(location).items()]


def declaration(network: Network, names: Names) -> str:
    """Return clocks, variables and broadcast channels, all of them global."""
    shared = names.shared
    lines = ["// " + " ".join(f"{network.name}: {network.about}".split()).rstrip(": \\")]  # one line, whatever the text holds
    lines += [f"clock {', '.join(shared[name] for name in (TIME, *network.clocks))};"]
    lines += [f"int {shared[name]} = {whole(f'variable {name}', value)};" for name, value in network.variables.items()]
    lines += [f"double {name} = 1.0;" for name in names.rates.values()]
    lines += [f"broadcast chan {', '.join(shared[name] for name in network.channels)};"] if network.channels else []
    return "\n".join(lines)


def element(network: Network) -> ElementTree.Element:
    """Return the whole document, elements in the order of the DTD. Raises InputError for a value that UPPAAL's integers do not hold."""
    root, names = ElementTree.Element("nta"), names_of(network)
    _text(root, "declaration", declaration(network, names))
    for i in range(len(network.components)):
        root.append(_template(network, i, names))
    system = [f"{process} = {template}();" for process, template in zip(names.processes, names.templates, strict=True)]
    _text(root, "system", "\n".join([*system, f"system {', '.join(names.processes)};"]))
    queries = ElementTree.SubElement(root, "queries")
    for query in network.queries:
        held = ElementTree.SubElement(queries, "query")
        _text(held, "formula", formula(query, names))
        _text(held, "comment", query.name)
    return root


def _template(network: Network, which: int, names: Names) -> ElementTree.Element:
    component, prefix, locations = network.components[which], f"c{which}", names.locations[which]
    out = ElementTree.Element("template")
    _text(out, "name", names.templates[which])
    ids = {location.name: f"{prefix}_{j}" for j, location in enumerate(component.locations)}
    first, count = component.location(component.initial), len(component.locations)
    entry = f"{prefix}_{ENTRY}" if draws_of(first) else ""
    for j, location in enumerate(component.locations):
        turn = 2.0 * math.pi * j / count
        x, y = round(SPREAD * math.sin(turn)), round(-SPREAD * math.cos(turn))
        held = _location(out, ids[location.name], locations[location.name], x, y)
        if location.rates or location.invariant:
            _text(held, "label", invariant(location, names), kind="invariant")
        if not location.invariant and not location.committed:
            _text(held, "label", number(location.rate), kind="exponentialrate")
        if location.committed:
            ElementTree.SubElement(held, "committed")
    if entry:
        ElementTree.SubElement(_location(out, entry, names.entries[which], -2 * SPREAD, -2 * SPREAD), "committed")
    ElementTree.SubElement(out, "init", ref=entry or ids[component.initial])
    if entry:
        _transition(out, entry, ids[first.name], {"assignment": ", ".join(_drawn(first, names))})
    for edge in component.edges:
        sync = f"{names.shared[edge.channel]}{edge.sync[-1]}" if edge.sync else ""
        labels = {"guard": condition(edge.guard, names), "synchronisation": sync, "assignment": assignment(edge, component, names)}
        _transition(out, ids[edge.source], ids[edge.target], labels)
    return out


def _location(parent: ElementTree.Element, identity: str, name: str, x: int, y: int) -> ElementTree.Element:
    out = ElementTree.SubElement(parent, "location", id=identity, x=str(x), y=str(y))
    _text(out, "name", name)
    return out


def _transition(parent: ElementTree.Element, source: str, target: str, labels: dict[str, str]) -> None:
    out = ElementTree.SubElement(parent, "transition")
    ElementTree.SubElement(out, "source", ref=source)
    ElementTree.SubElement(out, "target", ref=target)
    for kind, text in labels.items():
        if text:
            _text(out, "label", text, kind=kind)


def _text(parent: ElementTree.Element, tag: str, text: str, **attributes: str) -> None:
    ElementTree.SubElement(parent, tag, attributes).text = text


def document(network: Network) -> str:
    """Return the XML file's text."""
    root = element(network)
    ElementTree.indent(root, "  ")
    return f'<?xml version="1.0" encoding="utf-8"?>\n{DTD}\n{ElementTree.tostring(root, encoding="unicode")}\n'


def write_uppaal(network: Network, path: Path) -> Path:
    """Write the model; returns its path. Raises InputError when it cannot be written, or holds an integer beyond UPPAAL's."""
    write_atomic(path, document(network).encode())
    return path
