"""A network as a UPPAAL SMC model (XML, DTD flat-1_6), with its queries. What it means there: docs/automata.md."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

from tailgate.files import write_atomic

from .automata import TIME, Atom, Component, Edge, Location, Network, Query, Speed

DTD = "<!DOCTYPE nta PUBLIC '-//Uppaal Team//DTD Flat System 1.6//EN' 'http://www.it.uu.se/research/group/darts/uppaal/flat-1_6.dtd'>"
ENTRY = "entry_"  # a committed location before the first one, where that one draws clock rates
WORDS = (
    "chan clock bool int double string commit committed const urgent broadcast init initial process state guard sync assign system trans "
    "deadlock and or not imply true false for forall exists while do if else return typedef struct rate before_update after_update meta "
    "priority progress scalar select void default switch case continue break enum random hybrid sum inf sup bounds simulation"
)
RESERVED = frozenset(WORDS.split())  # names that mean something to UPPAAL
SPREAD = 160  # between locations of the drawing


def identifier(name: str) -> str:
    """A name as UPPAAL takes it: its own words get an underscore."""
    return f"{name}_" if name in RESERVED else name


def number(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(float(value))


def condition(atoms: tuple[Atom, ...]) -> str:
    """A guard, an invariant or a state formula."""
    return " && ".join(f"{identifier(a.name)} {'==' if a.op == '=' else a.op} {number(a.value)}" for a in atoms)


def formula(query: Query) -> str:
    return f"Pr[<={number(query.within)}](<> {condition(query.holds)})"


def rate_name(clock: str) -> str:
    """The variable that holds the rate which was drawn for a clock."""
    return f"rate_{clock}"


def draws_of(place: Location) -> dict[str, tuple[float, float]]:
    """Clocks whose rate is drawn on entry."""
    return {clock: speed for clock, speed in place.rates.items() if isinstance(speed, tuple)}


def invariant(place: Location) -> str:
    """Limits, and the rates of clocks that do not run at 1."""
    rates = [f"{identifier(clock)}' == {_speed(clock, speed)}" for clock, speed in place.rates.items()]
    return " && ".join([*([condition(place.invariant)] if place.invariant else []), *rates])


def _speed(clock: str, speed: Speed) -> str:
    return rate_name(clock) if isinstance(speed, tuple) else number(speed)


def assignment(edge: Edge, component: Component) -> str:
    """What is set, and what is drawn for the location that is entered."""
    sets = [f"{identifier(name)} = {number(value)}" for name, value in edge.assign.items()]
    return ", ".join([*sets, *_drawn(component.location(edge.target))])


def _drawn(place: Location) -> list[str]:
    return [f"{rate_name(clock)} = {number(low)} + random({number(high - low)})" for clock, (low, high) in draws_of(place).items()]


def declaration(network: Network) -> str:
    """Clocks, variables and broadcast channels, all of them global."""
    clocks = ", ".join(map(identifier, (TIME, *network.clocks)))
    lines = [f"// {network.name}: {network.about}".rstrip(": "), f"clock {clocks};"]
    lines += [f"int {identifier(name)} = {value};" for name, value in network.variables.items()]
    drawn = dict.fromkeys(clock for c in network.components for place in c.locations for clock in draws_of(place))
    lines += [f"double {rate_name(clock)} = 1.0;" for clock in drawn]
    lines += [f"broadcast chan {', '.join(map(identifier, network.channels))};"] if network.channels else []
    return "\n".join(lines)


def element(network: Network) -> ElementTree.Element:
    """The whole document, elements in the order of the DTD."""
    root = ElementTree.Element("nta")
    _text(root, "declaration", declaration(network))
    for i, component in enumerate(network.components):
        root.append(_template(component, f"c{i}"))
    names = [identifier(c.name) for c in network.components]
    system = [f"{name}_process = {_template_name(c)}();" for name, c in zip(names, network.components, strict=True)]
    _text(root, "system", "\n".join([*system, f"system {', '.join(f'{name}_process' for name in names)};"]))
    queries = ElementTree.SubElement(root, "queries")
    for query in network.queries:
        held = ElementTree.SubElement(queries, "query")
        _text(held, "formula", formula(query))
        _text(held, "comment", query.name)
    return root


def _template_name(component: Component) -> str:
    return f"{component.name.capitalize()}_template"


def _template(component: Component, prefix: str) -> ElementTree.Element:
    out = ElementTree.Element("template")
    _text(out, "name", _template_name(component))
    ids = {place.name: f"{prefix}_{j}" for j, place in enumerate(component.locations)}
    first, count = component.location(component.initial), len(component.locations)
    entry = f"{prefix}_{ENTRY}" if draws_of(first) else ""
    for j, place in enumerate(component.locations):
        turn = 2.0 * math.pi * j / count
        x, y = round(SPREAD * math.sin(turn)), round(-SPREAD * math.cos(turn))
        held = _place(out, ids[place.name], identifier(place.name), x, y)
        if place.rates or place.invariant:
            _text(held, "label", invariant(place), kind="invariant")
        if not place.invariant and not place.committed:
            _text(held, "label", number(place.rate), kind="exponentialrate")
        if place.committed:
            ElementTree.SubElement(held, "committed")
    if entry:
        ElementTree.SubElement(_place(out, entry, ENTRY, -2 * SPREAD, -2 * SPREAD), "committed")
    ElementTree.SubElement(out, "init", ref=entry or ids[component.initial])
    if entry:
        _transition(out, entry, ids[first.name], {"assignment": ", ".join(_drawn(first))})
    for edge in component.edges:
        sync = f"{identifier(edge.channel)}{edge.sync[-1]}" if edge.sync else ""
        labels = {"guard": condition(edge.guard), "synchronisation": sync, "assignment": assignment(edge, component)}
        _transition(out, ids[edge.source], ids[edge.target], labels)
    return out


def _place(parent: ElementTree.Element, identity: str, name: str, x: int, y: int) -> ElementTree.Element:
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
    """The XML file's text."""
    root = element(network)
    ElementTree.indent(root, "  ")
    return f'<?xml version="1.0" encoding="utf-8"?>\n{DTD}\n{ElementTree.tostring(root, encoding="unicode")}\n'


def write_uppaal(network: Network, path: Path) -> Path:
    """Writes the model; returns its path. Raises InputError when it cannot be written."""
    write_atomic(path, document(network).encode())
    return path
