"""The export to UPPAAL's format: what is declared, and nothing else, in the order of its DTD."""

import re
from xml.etree import ElementTree

import pytest

from tailgate.base.errors import InputError
from tailgate.trust.automata import Atom, Edge, load_network, network_of
from tailgate.trust.uppaal import DTD, ENTRY, RESERVED, document, identifier, names_of, write_uppaal

# The part of flat-1_6.dtd that is written: children of each element, in order.
CHILDREN = {
    "nta": ["declaration", "template+", "system", "queries"], "template": ["name", "location+", "init", "transition*"],
    "location": ["name", "label*", "committed?"], "transition": ["source", "target", "label*"], "queries": ["query*"],
    "query": ["formula", "comment"],
}  # fmt: skip
KINDS = {"location": {"invariant", "exponentialrate"}, "transition": {"guard", "synchronisation", "assignment"}}


@pytest.fixture(scope="module")
def net():
    return load_network("reactive-braking")


@pytest.fixture(scope="module")
def root(net):
    return ElementTree.fromstring(document(net))


def _labels(element):
    return {label.get("kind"): label.text for label in element.findall("label")}


def _atoms(text):
    """Conditions of a label, but for rates: (name, comparison, number)."""
    parts = [part for part in (text or "").split(" && ") if part and "'" not in part]
    out = set()
    for part in parts:
        name, op, number = part.split(" ")
        out.add((name, "=" if op == "==" else op, float(number)))
    return out


def _declared(atoms):
    return {(identifier(a.name), a.op, a.value) for a in atoms}


def test_elements_stand_in_the_order_of_the_dtd(net, root):
    """Another order, or an element that the DTD does not have, is refused by UPPAAL."""
    assert document(net).startswith('<?xml version="1.0" encoding="utf-8"?>\n' + DTD)
    for element in root.iter():
        if element.tag in CHILDREN:
            pattern = "".join(f"(?:{c.rstrip('+*?')} ){c[-1] if c[-1] in '+*?' else ''}" for c in CHILDREN[element.tag])
            assert re.fullmatch(pattern, "".join(f"{child.tag} " for child in element)), element.tag
        if element.tag in KINDS:
            assert set(_labels(element)) <= KINDS[element.tag]
    ids = [location.get("id") for location in root.iter("location")]
    assert len(set(ids)) == len(ids) and {e.get("ref") for e in root.iter() if e.get("ref")} <= set(ids)


def test_the_round_trip(net, root):
    """Locations, invariants, rates, committed marks, edges, guards, signals and assignments are those of the declaration."""
    for component, template in zip(net.components, root.findall("template"), strict=True):
        names = {location.get("id"): location.find("name").text for location in template.findall("location")}
        places = [location for location in template.findall("location") if location.find("name").text != ENTRY]
        assert [names[p.get("id")] for p in places] == [identifier(p.name) for p in component.locations]
        for declared, place in zip(component.locations, places, strict=True):
            labels = _labels(place)
            assert _atoms(labels.get("invariant")) == _declared(declared.invariant)
            assert (place.find("committed") is not None) == declared.committed
            assert ("exponentialrate" in labels) == (not declared.invariant and not declared.committed)
            assert float(labels.get("exponentialrate", declared.rate)) == declared.rate
            assert all(f"{clock}' == " in labels["invariant"] for clock in declared.rates)
        edges = [t for t in template.findall("transition") if names[t.find("source").get("ref")] != ENTRY]
        for edge, transition in zip(component.edges, edges, strict=True):
            labels = _labels(transition)
            assert names[transition.find("source").get("ref")] == identifier(edge.source)
            assert names[transition.find("target").get("ref")] == identifier(edge.target)
            assert _atoms(labels.get("guard")) == _declared(edge.guard) and labels.get("synchronisation", "") == edge.sync
            sets = {part.split(" = ")[0]: part.split(" = ")[1] for part in labels.get("assignment", "").split(", ") if part and "random" not in part}
            assert {name: float(value) for name, value in sets.items()} == {identifier(n): v for n, v in edge.assign.items()}


def test_a_drawn_rate_is_drawn_on_every_entry(root):
    """Also before the first step, by a committed location that leads to the first one."""
    template = root.find("template")
    entry = next(p for p in template.findall("location") if p.find("name").text == ENTRY)
    assert entry.find("committed") is not None and template.find("init").get("ref") == entry.get("id")
    into = [t for t in template.findall("transition") if t.find("target").get("ref") == "c0_0"]
    assert len(into) == 2 and all("rate_clk_p = 1 + random(1)" in _labels(t)["assignment"] for t in into)
    assert "clk_p' == rate_clk_p" in _labels(template.find("location"))["invariant"]


def test_declaration_and_queries(net, root):
    """Everything is declared once, channels as broadcast, and the thesis's three queries are there."""
    text = root.find("declaration").text
    assert "clock time, clk_p, react, press;" in text and "int obs = 0;" in text and "double rate_clk_p" in text
    assert "broadcast chan obs_detect, obs_clear, signal_break, signal_acc;" in text
    assert [q.find("formula").text for q in root.iter("query")] == [
        "Pr[<=1000](<> clk_p > 1)", "Pr[<=1000](<> time < 100 && obs == 1)", "Pr[<=1000](<> time < 500 && apply_break == 1)",
    ]  # fmt: skip
    assert len(re.findall(r"\w+_process = \w+_template\(\);", root.find("system").text)) == len(net.components)


def test_names_that_uppaal_keeps_for_itself(net, root):
    """`break` is one of its words: the location gets another name; every written name is an identifier that it takes."""
    assert "break" in RESERVED and identifier("break") == "break_" and identifier("safe") == "safe"
    written = [name.text for name in root.iter("name")]
    assert "break_" in written and not set(written) & RESERVED and all(re.fullmatch(r"[A-Za-z_]\w*", name) for name in written)


def test_markup_in_a_text_stays_text(tmp_path):
    """The file is well-formed whatever a sentence holds, and another change shows in it."""
    made = network_of({"name": "m", "about": "a < b & c", "components": [{"name": "one", "initial": "a", "locations": {"a": {"rate": 0.25}}, "clocks": ["c"]}]})
    path = write_uppaal(made, tmp_path / "m.xml")
    assert "a < b & c" in ElementTree.parse(path).getroot().find("declaration").text
    changed = made.with_location("one", "a", invariant=(Atom("c", "<", 2.5),))
    assert "c &lt; 2.5" in document(changed) and "exponentialrate" not in document(changed) and "0.25" in path.read_text()
    assert Edge("a", "a", sync="x!").channel == "x"


def _hostile():
    """Names and texts that mean something to UPPAAL, or that the export would otherwise make twice."""
    place = {"a": {"rates": {"c": [1, 2]}, "invariant": [["c", "<=", 3]]}, "entry_": {}, "int": {}, "int_": {}}
    edges = [{"source": "a", "target": "entry_", "sync": "simulate!"}, {"source": "entry_", "target": "int", "assign": {"rate_c": 7}}]
    first = {"name": "doorA", "clocks": ["c"], "variables": {"rate_c": 5, "abs": 0, "abs_": 0}, "initial": "a", "locations": place, "edges": edges}
    second = {"name": "doora", "initial": "E", "locations": {"E": {}, "control": {}}, "variables": {"doorA_template": 1}}
    return {"name": "m", "about": "one line\nclock x;\r\u2028int y;\\", "components": [first, second], "queries": [{"name": "q", "within": 10, "holds": [["abs", "=", 1], ["abs_", "=", 0]]}]}


def test_no_two_names_become_one():
    """Else a template, a variable or a location is declared twice, or one hides another."""
    made = network_of(_hostile())
    root, names = ElementTree.fromstring(document(made)), names_of(made)
    shared = [*names.shared.values(), *names.rates.values(), *names.templates, *names.processes]
    assert len(set(shared)) == len(shared) and not set(shared) & RESERVED
    assert names.shared["rate_c"] == "rate_c" and names.rates["c"] == "rate_c_" and names.shared["abs_"] == "abs_" and names.shared["abs"] == "abs__"
    for template in root.findall("template"):
        places = [location.find("name").text for location in template.findall("location")]
        assert len(set(places)) == len(places) and not set(places) & (set(shared) | RESERVED)
    first = root.find("template")
    assert [p.find("name").text for p in first.findall("location")] == ["a", "entry_", "int__", "int_", "entry__"]
    assert "c' == rate_c_" in _labels(first.find("location"))["invariant"]
    assert [_labels(t).get("assignment") for t in first.findall("transition")] == ["rate_c_ = 1 + random(1)", None, "rate_c = 7"]
    assert root.find("queries/query/formula").text == "Pr[<=10](<> abs__ == 1 && abs_ == 0)"
    assert names.templates == ("doorA_template_", "doora_template") and root.find("system").text.startswith("doorA_process = doorA_template_();")
    assert {"abs", "A", "E", "simulate", "control", "fabs", "Pr"} <= RESERVED


def test_a_text_of_two_lines_stays_a_comment():
    """What follows the first line would become code."""
    lines = ElementTree.fromstring(document(network_of(_hostile()))).find("declaration").text.split("\n")
    assert lines[0] == "// m: one line clock x; int y;" and lines[1] == "clock time, c;" and len("\n".join(lines).splitlines()) == len(lines)


@pytest.mark.parametrize(("variables", "assign"), [({"n": 32768}, {}), ({"n": -32769}, {}), ({"n": 0}, {"n": 40000})])
def test_an_integer_beyond_those_of_uppaal_is_refused(variables, assign):
    """It would wrap round or stop the run there."""
    edges = [{"source": "a", "target": "a", "assign": {"c": 1e5, **assign}}]
    made = {"name": "m", "components": [{"name": "one", "clocks": ["c"], "variables": variables, "initial": "a", "locations": {"a": {}}, "edges": edges}]}
    with pytest.raises(InputError, match="32767"):
        document(network_of(made))
    made["components"][0] |= {"variables": {"n": 32767}, "edges": [{"source": "a", "target": "a", "assign": {"c": 1e10, "n": -32768}}]}
    assert "c = 10000000000.0, n = -32768" in document(network_of(made))
