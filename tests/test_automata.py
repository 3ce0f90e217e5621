"""Stochastic timed automata: the declaration, and runs of small networks against what is known of them in closed form."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from tailgate.base.errors import InputError
from tailgate.evaluation.stats import proportion
from tailgate.thesis.ch7_automata import as_guards, closed_form
from tailgate.trust.automata import Atom, Query, load_network, network_of
from tailgate.trust.ctmc import load_architecture, solve
from tailgate.trust.simulate import simulate

LEVEL = 0.999
N = 3000


def component(name, locations, edges, **rest):
    return {"name": name, "initial": next(iter(locations)), "locations": locations, "edges": edges, **rest}


def network(*components, **rest):
    return network_of({"name": "small", "components": list(components), **rest})


def reach(name, value=1, op="=", within=1000.0):
    return Query("goal", within, (Atom(name, op, float(value)),))


def once(name="x", location=None, guard=(), **rest):
    """A component that sets `name` to 1 when it leaves its first location."""
    edge = {"source": "a", "target": "b", "guard": list(guard), "assign": {name: 1}}
    return component(f"of_{name}", {"a": location or {}, "b": {}}, [edge], variables={name: 0}, **rest)


def times(net, name="x", count=N, first=0):
    return simulate(net, range(first, first + count), queries=[reach(name)]).hit[0]


def agrees(successes, expected, count=N):
    interval = proportion(int(successes), count, LEVEL)
    return interval.low <= expected <= interval.high


def test_the_case_study_reads_as_it_is_meant():
    """Three components with the locations, limits and signals of section 7.4."""
    net = load_network("reactive-braking")
    places = {c.name: [p.name for p in c.locations] for c in net.components}
    assert places == {
        "monitor": ["safe", "warning"], "controller": ["Initial", "Intermediate", "Command", "Update"],
        "actuator": ["max_velocity", "braking", "break", "stop", "acc"],
    }  # fmt: skip
    assert net.component("monitor").location("safe").rates == {"clk_p": (1.0, 2.0)}
    assert [str(q) for q in net.queries] == [
        "<>[<= 1000] clk_p > 1", "<>[<= 1000] time < 100 and obs = 1", "<>[<= 1000] time < 500 and apply_break = 1",
    ]  # fmt: skip
    assert net.component("controller").location("Update").committed and len(net.edges()) == 11


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"guard": [["y", ">", 1]]}, "guard"), ({"guard": [["c", "!=", 1]]}, "guard"), ({"guard": [["c", ">", float("inf")]]}, "guard"),
        ({"sync": "go"}, "sync"), ({"sync": "gone?"}, "sync"), ({"target": "c"}, "target"), ({"assign": {"x": 0.5}}, "assign"),
        ({"assign": {"time": 0}}, "assign"), ({"when": 1}, "when"),
    ],
)  # fmt: skip
def test_an_edge_that_has_no_meaning_is_refused(change, named):
    """One error that names the field."""
    edge = {"source": "a", "target": "b"} | change
    with pytest.raises(InputError, match=named):
        network(component("one", {"a": {}, "b": {}}, [edge], clocks=["c"], variables={"x": 0}))


@pytest.mark.parametrize(
    "place", [{"invariant": [["c", ">=", 1]]}, {"invariant": [["time", "<", 1]]}, {"committed": True, "invariant": [["c", "<", 1]]},
              {"rate": 0}, {"rates": {"c": [2, 1]}}, {"rates": {"c": -1}}, {"rates": {"d": 1}}],
)  # fmt: skip
def test_a_location_that_has_no_meaning_is_refused(place):
    """Invariants are upper limits of own clocks, rates are not negative."""
    with pytest.raises(InputError, match="location a"):
        network(component("one", {"a": place, "b": {}}, [], clocks=["c"]))


def test_names_that_clash_are_refused():
    """Clocks, variables and channels share one name space, as in UPPAAL."""
    with pytest.raises(InputError, match="no two are equal"):
        network(component("one", {"a": {}}, [], clocks=["c"], variables={"c": 0}))
    with pytest.raises(InputError, match="no two are equal"):
        network(component("one", {"a": {}}, []), component("one", {"a": {}}, []))
    with pytest.raises(InputError, match="at least one"):
        network()


def test_two_exponentials_race():
    """Rate 3 beats rate 1 in three quarters of the runs."""
    net = network(
        component("fast", {"a": {"rate": 3.0}, "b": {}}, [{"source": "a", "target": "b", "guard": [["won", "=", 0]], "assign": {"won": 1}}], variables={"won": 0}),
        component("slow", {"a": {"rate": 1.0}, "b": {}}, [{"source": "a", "target": "b", "guard": [["won", "=", 0]], "assign": {"won": 2}}]),
    )
    hit = simulate(net, range(N), queries=[reach("won", 0, ">")], stop=True)
    first = simulate(net, range(N), queries=[reach("won", 1), reach("won", 0, ">")], within=60.0)
    assert agrees(np.isfinite(first.hit[0]).sum(), 0.75)
    assert stats.kstest(hit.hit[0], stats.expon(scale=0.25).cdf).pvalue > 1 - LEVEL


def test_two_uniforms_race():
    """U(0, 2) is before U(0, 1) in a quarter of the runs."""
    edges = [{"source": "a", "target": "b", "guard": [["won", "=", 0]], "assign": {"won": who}} for who in (1, 2)]
    net = network(
        component("long", {"a": {"invariant": [["c", "<=", 2]]}, "b": {}, "over": {}}, [edges[0], {"source": "a", "target": "over", "guard": [["won", "=", 2]]}], clocks=["c"], variables={"won": 0}),
        component("short", {"a": {"invariant": [["d", "<=", 1]]}, "b": {}, "over": {}}, [edges[1], {"source": "a", "target": "over", "guard": [["won", "=", 1]]}], clocks=["d"]),
    )
    assert agrees(np.isfinite(simulate(net, range(N), queries=[reach("won", 1)], within=5.0).hit[0]).sum(), 0.25)


@pytest.mark.parametrize(
    ("place", "guard", "law"),
    [
        ({"rate": 0.5}, [], stats.expon(scale=2.0)),
        ({"rate": 0.5}, [["c", ">", 10]], stats.expon(loc=10.0, scale=2.0)),
        ({"invariant": [["c", "<=", 4]]}, [], stats.uniform(0.0, 4.0)),
        ({"invariant": [["c", "<", 4]]}, [["c", ">=", 1]], stats.uniform(1.0, 3.0)),
        ({"invariant": [["c", "<=", 4]], "rates": {"c": 2}}, [["c", ">", 1]], stats.uniform(0.5, 1.5)),
        ({"invariant": [["c", "<=", 4]], "rates": {"c": 0}, "rate": 0.5}, [], stats.expon(scale=2.0)),  # a limit that is never met
    ],
)  # fmt: skip
def test_a_sojourn_has_its_law(place, guard, law):
    """Exponential from the earliest moment on without an end, uniform between both with one, at the clock's own rate."""
    hit = times(network(once(location=place, guard=guard, clocks=["c"])))
    assert stats.kstest(hit, law.cdf).pvalue > 1 - LEVEL


def test_a_rate_that_is_drawn_on_entry():
    """The monitor's first alarm is at U(1 / r, 2 / r), r from U(1, 2): between a half and 2, log 8 / 2 in the mean."""
    hit = times(network(once(location={"invariant": [["c", "<=", 2]], "rates": {"c": [1, 2]}}, guard=[["c", ">", 1]], clocks=["c"])))
    assert 0.5 < hit.min() < 0.6 and 1.8 < hit.max() < 2.0
    assert abs(hit.mean() - 1.5 * math.log(2.0)) < 4.0 * hit.std() / math.sqrt(N)


def test_each_open_edge_is_as_likely():
    """Of three edges one is shut: the others take half of the runs each."""
    edges = [{"source": "a", "target": "b", "assign": {"x": i}, "guard": [["c", "<" if i == 3 else ">=", 0]]} for i in (1, 2, 3)]
    taken = simulate(network(component("one", {"a": {}, "b": {}}, edges, clocks=["c"], variables={"x": 0})), range(N), within=50.0, queries=[]).taken
    assert taken.sum() == N and taken[2].sum() == 0 and agrees(taken[0].sum(), 0.5)


def test_equal_delays_are_as_likely():
    """Two that can only move at 5 both come first in half of the runs, and both move."""
    made = [component(f"c{i}", {"a": {"invariant": [[f"k{i}", "<=", 5]]}, "b": {}}, [{"source": "a", "target": "b", "guard": [[f"k{i}", ">=", 5]], "assign": {"last": i}}], clocks=[f"k{i}"], **({"variables": {"last": 0}} if i == 1 else {})) for i in (1, 2)]
    runs = simulate(network(*made), range(N), queries=[reach("last", 0, ">")], within=5.0, stop=False)
    assert (runs.taken == 1).all() and (runs.hit[0] == 5.0).all()
    first = simulate(network(*made), range(N), queries=[reach("last", 2)], within=5.0).steps
    assert agrees((first == 1).sum(), 0.5)


def test_committed_goes_first_and_listeners_never_block():
    """A message reaches everybody whose guard is open, nobody waits for the others, and what is committed passes no time."""
    net = network(
        component("sender", {"a": {"invariant": [["c", "<=", 1]]}, "now": {"committed": True}, "b": {}},
                  [{"source": "a", "target": "now", "sync": "go!", "assign": {"sent": 1}}, {"source": "now", "target": "b", "sync": "done!"}],
                  clocks=["c"], variables={"sent": 0}),
        component("eager", {"a": {}, "b": {}, "late": {}}, [{"source": "a", "target": "b", "sync": "go?", "guard": [["sent", "=", 0]], "assign": {"x": 1}},
                                                            {"source": "b", "target": "late", "assign": {"before": 1}, "guard": [["x", "=", 1]]}],
                  variables={"x": 0, "before": 0}),
        component("deaf", {"a": {}, "b": {}}, [{"source": "a", "target": "b", "sync": "go?", "guard": [["x", "=", 1]]}]),
        component("after", {"a": {}, "b": {}}, [{"source": "a", "target": "b", "sync": "done?", "guard": [["before", "=", 0]], "assign": {"y": 1}}], variables={"y": 0}),
    )  # fmt: skip
    runs = simulate(net, range(200), queries=[reach("sent"), reach("x"), reach("y"), reach("before")], within=100.0)
    assert np.array_equal(runs.hit[0], runs.hit[1]) and np.array_equal(runs.hit[0], runs.hit[2]) and (runs.hit[0] <= 1.0).all()
    assert (runs.hit[3] > runs.hit[2]).all() and (runs.taken[4] == 0).all()


def test_a_run_in_which_nobody_can_move_lasts_to_the_end():
    """Deadlock: no query holds, time goes on."""
    runs = simulate(network(component("one", {"a": {}, "b": {}}, [{"source": "a", "target": "b", "guard": [["x", "=", 1]]}], variables={"x": 0})), [1, 2], queries=[reach("x")], within=7.0)
    assert np.isnan(runs.hit).all() and (runs.time == 7.0).all() and (runs.steps == 0).all()


def test_a_time_that_stands_still_is_an_error(monkeypatch):
    """Zeno: two committed locations, round and round; and too many moves."""
    monkeypatch.setattr("tailgate.trust.simulate.STILL", 100)
    circle = [{"source": "a", "target": "b"}, {"source": "b", "target": "a"}]
    with pytest.raises(InputError, match="100 moves by time 0 "):
        simulate(network(component("one", {"a": {"committed": True}, "b": {"committed": True}}, circle)), [0], within=1.0, queries=[])
    with pytest.raises(InputError, match="20 moves by time"):
        simulate(network(component("one", {"a": {}, "b": {}}, circle)), [0], within=1e6, queries=[], steps=20)


@pytest.mark.parametrize("guard", [["c", ">=", 3], ["c", ">", 2]])
def test_a_place_that_may_neither_be_kept_nor_left_is_an_error(guard):
    """A limit of 2 and no edge that opens by then."""
    with pytest.raises(InputError, match="of_x out of a place"):
        times(network(once(location={"invariant": [["c", "<=", 2]]}, guard=[guard], clocks=["c"])), count=3)


def test_a_run_depends_on_its_seed_alone():
    """The same bits alone, among others, in another order, and again."""
    net = load_network("reactive-braking")
    many = simulate(net, range(30), within=200.0, queries=net.queries, stop=False)
    some = simulate(net, [29, 7], within=200.0, queries=net.queries, stop=False)
    for a, b in zip(many, some, strict=True):
        assert np.array_equal(a[..., [29, 7]], b, equal_nan=True)
    assert not np.array_equal(many.hit[0, :15], many.hit[0, 15:])


@pytest.mark.long
def test_the_three_queries_in_closed_form():
    """1, (100 - 1.04) / 100 and (500 - 51.04) / 500 with limits as invariants; nearly 1 with limits as guards."""
    net, count = load_network("reactive-braking"), 600
    hit = np.isfinite(simulate(net, range(count)).hit).sum(axis=1)
    assert hit[0] == count and agrees(hit[1], closed_form(100.0, 100.0), count) and agrees(hit[2], closed_form(500.0, 500.0, 100.0), count)
    assert closed_form(100.0, 100.0) == pytest.approx(0.9896, abs=1e-4) and closed_form(500.0, 500.0, 100.0) == pytest.approx(0.8979, abs=1e-4)
    assert (np.isfinite(simulate(as_guards(net), range(300)).hit).sum(axis=1) == 300).all()


def test_what_is_asked_for_is_checked():
    """A time has to be given, if no query has one."""
    net = network(once())
    with pytest.raises(InputError, match="within"):
        simulate(net, [0], queries=[])
    with pytest.raises(InputError, match="reactive-braking"):
        load_network("reactive-breaking")
    with pytest.raises(InputError, match="query"):
        load_network("reactive-braking").query("brake")


def test_the_examples_of_the_documentation(tmp_path, capsys, monkeypatch):
    """The declaration loads and is met as often as it can be told; the code runs as it stands, and writes a picture and a file for UPPAAL."""
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    text = (Path(__file__).parents[1] / "docs/automata.md").read_text(encoding="utf-8")
    (yaml, chain), codes = (re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL) for kind in ("yaml", "python"))
    (tmp_path / "door.yaml").write_text(yaml, encoding="utf-8")
    hit = simulate(load_network(str(tmp_path / "door.yaml")), range(300)).hit[0]
    assert np.nanmin(hit) > 0.5 and 0.3 < np.isfinite(hit).mean() < 0.95 and np.nanmax(hit) < 2.0
    (tmp_path / "chain.yaml").write_text(chain, encoding="utf-8")
    assert solve(load_architecture(str(tmp_path / "chain.yaml")))["states"] == 4
    for code in codes:
        exec(code.replace("400", "20"), {})
    assert "<>[<= 1000] time < 100 and obs = 1" in capsys.readouterr().out
    assert (tmp_path / "automata.png").read_bytes().startswith(b"\x89PNG") and "<nta>" in (tmp_path / "reactive-braking.xml").read_text()
