"""Table 7.1 by reachability, and the automata drawn."""

from itertools import pairwise

import pytest

from tailgate.trust.automata import Atom, load_network, network_of
from tailgate.trust.taint import influences, one_hop, paths, signals, table

SIGNALS = ["obs_detect!", "obs_clear!", "obs_detect?", "signal_break!", "obs_clear?", "signal_acc!", "signal_break?", "signal_acc?"]


@pytest.fixture(scope="module")
def net():
    return load_network("reactive-braking")


def test_table_7_1(net):
    """One hop gives the thesis's two, reachability all eight."""
    rows = table(net)
    assert [row.sync for row in rows] == SIGNALS == signals(net)
    assert {row.sync for row in rows if row.one_hop} == {"obs_detect!", "obs_detect?"} and all(row.transitive for row in rows)
    assert next(row.path for row in rows if row.sync == "signal_acc!") == ("clk_p", "obs_clear!", "obs_clear?", "Update", "signal_acc!")


def test_a_limit_as_a_guard_is_one_hop(net):
    """Read as a guard, clk_p <= 4 makes obs_clear untrusted as well."""
    literal = net.with_edge("monitor", "warning", "safe", guard=(Atom("clk_p", "<=", 4.0),))
    assert one_hop(literal) == {"obs_detect!", "obs_detect?", "obs_clear!", "obs_clear?"}


def test_what_nothing_leads_to_is_trusted(net):
    """Without sensor state nothing is untrusted; a component of its own is not reached."""
    import dataclasses

    assert not any(row.one_hop or row.transitive for row in table(dataclasses.replace(net, sensor=())))
    alone = network_of({
        "name": "two", "sensor": ["c"], "components": [
            {"name": "one", "initial": "a", "clocks": ["c"], "variables": {"x": 0}, "locations": {"a": {}, "b": {}},
             "edges": [{"source": "a", "target": "b", "guard": [["c", ">", 1]], "assign": {"x": 1}}]},
            {"name": "two", "initial": "a", "locations": {"a": {}}, "edges": [{"source": "a", "target": "a", "sync": "free!"}]},
            {"name": "three", "initial": "a", "locations": {"a": {}}, "edges": [{"source": "a", "target": "a", "sync": "told!", "guard": [["x", "=", 1]]}]},
        ],
    })  # fmt: skip
    found = {row.sync: row for row in table(alone)}
    assert not found["free!"].transitive and found["free!"].path == ()
    assert found["told!"].transitive and not found["told!"].one_hop and found["told!"].path == ("c", "a to b", "x", "told!")


def test_influences_are_those_of_the_declaration(net):
    """A chain steps only from cause to effect, and is as short as any."""
    follows, reached = influences(net), paths(net)
    assert all(b in follows[a] for chain in reached.values() for a, b in pairwise(chain))
    assert all(len(reached[b]) <= len(reached[a]) + 1 for a in reached for b in follows.get(a, []))


def test_the_automata_drawn(net):
    """Every location is a box, every edge an arrow with its words, and what is untrusted says so."""
    pytest.importorskip("matplotlib")
    from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

    from tailgate.base.plots import png
    from tailgate.trust.automata_figures import automata_figure

    figure = automata_figure(net, one_hop(net))
    for ax, component in zip(figure.axes, net.components, strict=True):
        assert sum(isinstance(p, FancyBboxPatch) for p in ax.patches) == len(component.locations)
        assert sum(isinstance(p, FancyArrowPatch) for p in ax.patches) == len(component.edges)
        words = [text.get_text() for text in ax.texts]
        for place in component.locations:
            assert any(text.split("\n")[0] == place.name for text in words)
        for edge in component.edges:
            assert any(edge.sync in text.split("\n") and ("(untrusted)" in text) == (edge.sync in one_hop(net)) for text in words)
    assert png(figure)[:4] == b"\x89PNG"
