"""Exploits of an architecture as a Markov chain: closed forms, matrix exponentials, simulation, the PRISM text read back, refused files."""

import json
import math
import re

import numpy as np
import pytest
import yaml
from scipy.linalg import expm, null_space

from tailgate import cli
from tailgate.base.errors import InputError, NotApplicable
from tailgate.evaluation.stats import proportion
from tailgate.trust import ctmc
from tailgate.trust.automata import load_network
from tailgate.trust.ctmc import (
    architecture_of,
    as_network,
    broken,
    chain_of,
    first_time,
    lasting,
    load_architecture,
    long_run,
    play,
    solve,
    transient,
)
from tailgate.trust.prism import model, properties, write_prism


def made(nodes, links=(), through=None, within=0.5):
    last = nodes[-1]["name"]
    data = {
        "name": "test", "kind": "ctmc", "nodes": nodes, "links": [list(pair) for pair in links],
        "messages": [{"name": "m", "through": through or [last]}], "queries": [{"name": "q", "message": "m", "within": within}],
    }  # fmt: skip
    return architecture_of(data)


def node(name, exploit, patch=0.0, entry=False):
    return {"name": name, "exploit": exploit, "patch": patch, "entry": entry}


def test_one_node():
    """2 a year and 8 a year: a fifth of the time, and 1 - 1/e within half a year."""
    one = made([node("a", 2.0, 8.0, True)])
    chain = chain_of(one)
    assert long_run(one, chain, "m") == pytest.approx(0.2, abs=1e-12)
    assert first_time(one, chain, "m", 0.5) == pytest.approx(1.0 - math.exp(-1.0), abs=1e-11) and round(1.0 - math.exp(-1.0), 4) == 0.6321
    for t in (0.01, 0.3, 5.0):  # and at a time, not by it
        assert transient(chain.generator, np.array([1.0, 0.0]), t)[1] == pytest.approx(0.2 * (1.0 - math.exp(-10.0 * t)), abs=1e-11)


@pytest.mark.parametrize(("a", "b"), [(2.0, 5.0), (5.0, 2.0), (1.0, 40.0)])
def test_a_chain_of_two_is_hypoexponential(a, b):
    two = made([node("first", a, entry=True), node("second", b)], [("first", "second")])
    chain = chain_of(two)
    for t in (0.05, 0.5, 2.0):
        wanted = 1.0 - (b * math.exp(-a * t) - a * math.exp(-b * t)) / (b - a)
        assert first_time(two, chain, "m", t) == pytest.approx(wanted, abs=1e-11)
    assert long_run(two, chain, "m") == pytest.approx(1.0)  # nothing is patched
    same = made([node("first", a, entry=True), node("second", a)], [("first", "second")])  # Erlang
    assert first_time(same, chain_of(same), "m", 0.7) == pytest.approx(1.0 - math.exp(-0.7 * a) * (1.0 + 0.7 * a), abs=1e-11)


def test_a_node_without_an_exploited_neighbour_is_safe():
    apart = made([node("a", 2.0, 1.0, True), node("b", 9.0, 1.0)])
    chain = chain_of(apart)
    assert len(chain.exploited) == 2 and first_time(apart, chain, "m", 100.0) == 0.0 and long_run(apart, chain, "m") == 0.0


def drawn(rng, size):
    names = [f"n{i}" for i in range(size)]
    nodes = [node(name, float(rng.uniform(0.2, 6.0)), float(rng.uniform(0.2, 6.0)), i == 0 or rng.random() < 0.2) for i, name in enumerate(names)]
    links = [(names[i], names[int(rng.integers(i))]) for i in range(1, size)]
    links += [(names[i], names[j]) for i in range(size) for j in range(i) if rng.random() < 0.15]
    return made(nodes, links, through=[names[-1], names[size // 2]], within=0.8)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.thin(3)
def test_drawn_architectures_against_dense_matrices(seed):
    """The exponential of the whole generator, built here from the definition, and its null space."""
    rng = np.random.default_rng(seed)
    one = drawn(rng, int(rng.integers(2, 8)))
    names, chain = [n.name for n in one.nodes], chain_of(one)
    Q = np.zeros((2 ** len(names),) * 2)
    for state in range(len(Q)):
        for i, n in enumerate(one.nodes):
            reached = n.entry or any(state >> names.index(other) & 1 for other in one.neighbours(n.name))
            rate = n.patch if state >> i & 1 else n.exploit * reached
            Q[state, state ^ 1 << i] += rate
            Q[state, state] -= rate
    code = chain.exploited @ (1 << np.arange(len(names)))
    assert np.allclose(chain.generator.toarray(), Q[np.ix_(code, code)])
    hit = np.array([any(state >> names.index(name) & 1 for name in one.messages[0].through) for state in range(len(Q))])
    assert np.array_equal(broken(one, chain, "m"), hit[code])
    absorbing = np.where(hit[:, None], 0.0, Q)
    for t in (0.1, 0.8, 3.0):
        assert first_time(one, chain, "m", t) == pytest.approx(expm(absorbing * t)[0, hit].sum(), abs=1e-10)
    kept = null_space(Q[np.ix_(code, code)].T)
    assert kept.shape[1] == 1
    wanted = kept[:, 0] / kept[:, 0].sum()
    assert np.abs(lasting(chain) - wanted).max() < 1e-9
    assert long_run(one, chain, "m") == pytest.approx(wanted[hit[code]].sum(), abs=1e-9)


@pytest.mark.parametrize(
    ("slow", "fast"), [((1e-9, 1e-9), (1e5, 1e5)), ((1.0, 1e-9), (1e6, 1.0)), ((1e-4, 1e-4), (1e-2, 1e3)), ((1e-12, 3e-12), (1e7, 2e7)), ((5.0, 0.0), (1e8, 1.0))],
)  # fmt: skip
def test_rates_of_different_sizes(slow, fast):
    """Entries do not know of each other, so each has its own share; a linked node is slowed by the part of time that it can be reached."""
    one = made([node("a", *slow, entry=True), node("b", *fast, entry=True)], through=["a"], within=1e-4)
    report = solve(one)
    for name, (exploit, patch) in (("a", slow), ("b", fast)):
        assert report["nodes"][name] == pytest.approx(exploit / (exploit + patch), rel=1e-13)
    linked = made([node("a", *slow, entry=True), node("b", *fast)], [("a", "b")], through=["b"], within=1e-4)
    (e, p), (f, q) = slow, fast
    # by hand: b holds where it was exploited while a was, and is patched either way; balance of b given a on and a off
    both = e / (e + p) * f * (e + q) / ((e + q) * (f + q) + p * q)
    alone = both * p / (e + q)
    assert solve(linked)["messages"]["m"] == pytest.approx(both + alone, rel=1e-12)


def test_a_chain_that_is_stepped_lies_between_its_ends(monkeypatch):
    """The same shares as by elimination; with rates of different sizes it is refused, and says of which field."""
    one = drawn(np.random.default_rng(7), 7)
    chain = chain_of(one)
    exact = lasting(chain)
    monkeypatch.setattr(ctmc, "DENSE", 1)
    assert np.abs(lasting(chain) - exact).sum() < 1e-9
    monkeypatch.setattr(ctmc, "LONGEST", 2000)
    apart = chain_of(made([node("a", 1e-9, 1e-9, True), node("b", 1e5, 1e5, True)]))
    with pytest.raises(NotApplicable, match=r"nodes: exploit, patch: got 100000.*one size"):
        lasting(apart)


@pytest.mark.parametrize("seed", range(4))
def test_the_automata_are_the_same_process(seed):
    """Shares of simulated runs hold the solved probability, each in an interval of 99.9 %."""
    one = drawn(np.random.default_rng(100 + seed), 5)
    exact, found = first_time(one, chain_of(one), "m", 0.8), play(one, 3000)["queries"][0]
    share = proportion(round(3000 * found["probability"]), 3000, 0.999)
    assert share.low <= exact <= share.high


def read_back(text):
    """A reader of the exported text alone: rates of every state's moves, as PRISM defines a rate without synchronisation."""
    modules = re.findall(r"module m_(\w+)\n  (\w+) : \[0\.\.1\] init 0;\n(.*?)endmodule", text, flags=re.S)
    names, moves = [name for _, name, _ in modules], []
    for _, name, body in modules:
        for guard, rate, target, value in re.findall(r"\[\] (.*?) -> ([\d.e+-]+) : \((\w+)'=([01])\);", body):
            assert target == name
            moves.append((guard, float(rate), name, int(value)))

    def rates(state):
        out = {}
        for guard, rate, name, value in moves:
            logic = re.sub(r"(\w+)=([01])", lambda m: str(state[m[1]] == int(m[2])), guard).replace("|", " or ").replace("&", " and ")
            assert re.fullmatch(r"(True|False|false|and|or|[() ])+", logic)
            if _holds(logic.replace("false", "False")):
                out[name, value] = out.get((name, value), 0.0) + rate
        return out

    return names, rates


def _holds(logic):
    """Decide a formula of True, False, and, or and brackets, one `and` at the top at most."""
    return all(any(part.strip(" ()") == "True" for part in side.split(" or ")) for side in logic.split(" and "))


@pytest.mark.parametrize("seed", range(6))
def test_the_text_for_prism_has_the_generator_of_the_chain(seed):
    one = drawn(np.random.default_rng(50 + seed), 6)
    names, rates = read_back(model(one))
    chain = chain_of(one)
    Q, code = chain.generator.toarray(), {tuple(row): i for i, row in enumerate(chain.exploited.astype(int).tolist())}
    assert names == [n.name for n in one.nodes] and model(one).startswith("ctmc\n")
    for state, i in code.items():
        found = np.zeros(len(code))
        for (name, value), rate in rates(dict(zip(names, state, strict=True))).items():
            after = list(state)
            after[names.index(name)] = value
            found[code[tuple(after)]] += rate
        assert np.allclose(np.delete(Q[i], i), np.delete(found, i)) and Q[i, i] == pytest.approx(-found.sum())
    assert 'label "m" = ' in model(one) and properties(one) == 'S=? [ "m" ]\nP=? [ F<=0.8 "m" ]\n'


def test_words_of_prism_are_no_names(tmp_path):
    one = made([node("module", 1.0, entry=True), node("module_", 1.0), node("F", 1.0)], [("module", "module_"), ("module_", "F")])
    names, _ = read_back(model(one))
    assert names == ["module_", "module__", "F_"] and "F_=0 & (module__=1)" in model(one)
    first, second = write_prism(one, tmp_path / "a.prism")
    assert (first.name, second.name) == ("a.prism", "a.props") and first.read_text() == model(one) and second.read_text() == properties(one)


@pytest.mark.long
def test_a_large_chain_is_solved_and_a_larger_one_is_played(monkeypatch):
    """Sixteen nodes that nothing links: each is by itself, in 65 536 states; with a lower limit the message says what to do."""
    nodes = [node(f"n{i}", 1.0 + i / 10, 3.0, True) for i in range(16)]
    one = made(nodes, through=["n3", "n7"])
    chain = chain_of(one)
    assert len(chain.exploited) == 65_536
    assert first_time(one, chain, "m", 0.5) == pytest.approx(1.0 - math.exp(-0.5 * (1.3 + 1.7)), abs=1e-9)
    with pytest.raises(NotApplicable, match=r"more than 1000 states.*--runs"):
        chain_of(one, 1000)
    found = play(one, 2000)["queries"][0]
    assert found["low"] - 0.02 <= 1.0 - math.exp(-1.5) <= found["high"] + 0.02
    monkeypatch.setattr(ctmc, "LONGEST", 100)
    with pytest.raises(NotApplicable, match=r"within.*at most"):
        transient(chain.generator, lasting_of(chain), 1e6)


def lasting_of(chain):
    start = np.zeros(len(chain.exploited))
    start[0] = 1.0
    return start


def test_the_built_in_one():
    report = solve(load_architecture("telematics"))
    assert report["states"] == 128 and report["nodes"]["telematics"] == pytest.approx(0.2) and report["nodes"]["infotainment"] == pytest.approx(0.5)
    assert report["messages"]["brake_command"] > report["nodes"]["chassis_bus"] > report["nodes"]["brake"]
    by_name = {q["name"]: q["probability"] for q in report["queries"]}
    assert by_name["call_in_a_year"] == pytest.approx(1.0 - math.exp(-2.0)) and 0.34 < by_name["brake_in_a_year"] < 0.35
    network = as_network(load_architecture("telematics"))
    assert len(network.components) == 7 and len(network.queries) == 2


GOOD = {"kind": "ctmc", "nodes": [node("a", 1.0, 1.0, True), node("b", 1.0)], "links": [["a", "b"]], "messages": [{"name": "m", "through": ["b"]}]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"kind": "dtmc"}, r"kind: got 'dtmc'.*ctmc"), ({"nodes": []}, r"nodes.*at least one node"), ({"nodes": [node("a", 1.0)]}, "entry from outside|links"),
        ({"links": [["a", "c"]]}, r"links.*'c'"), ({"links": [["a", "a"]]}, "two different"), ({"nodes": [*GOOD["nodes"], node("a", 2.0)]}, "no two are equal"),
        ({"nodes": [node("a", -1.0, entry=True)]}, r"node 1.*exploit"), ({"messages": [{"name": "m", "through": []}]}, "at least one node"),
        ({"messages": [{"name": "m", "through": ["x"]}]}, r"message m.through.*'x'"), ({"queries": [{"name": "q", "message": "z", "within": 1.0}]}, r"message.*'z'"),
        ({"queries": [{"name": "q", "message": "m", "within": 0.0}]}, "within"), ({"nodes": [node("1a", 1.0, entry=True)]}, "a letter"),
        ({"unit": "year\nendmodule"}, r"unit.*one line"), ({"name": "a\rb"}, r"name.*one line"), ({"nodes": "a"}, "a list of mappings"), ({"speed": 1}, "speed"),
    ],
)  # fmt: skip
def test_a_file_that_does_not_fit_is_refused(tmp_path, change, words):
    path = tmp_path / "x.yaml"
    path.write_text(yaml.safe_dump(GOOD | change))
    with pytest.raises(InputError, match=words):
        load_architecture(str(path))


def test_the_command(tmp_path, capsys):
    assert cli.main(["trust", "--automata", "telematics", "--json", "--prism", str(tmp_path / "t.prism")]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["method"] == "uniformisation" and (tmp_path / "t.props").is_file()
    assert cli.main(["trust", "--automata", "telematics", "--runs", "50"]) == 0 and "50 runs" in capsys.readouterr().out
    assert cli.main(["trust", "--automata", "telematics", "--runs", "0"]) == 2 and "--runs" in capsys.readouterr().err
    assert cli.main(["trust", "--automata", "reactive-braking"]) == 2 and "kind" in capsys.readouterr().err
    assert cli.main(["trust", "--automata", "telematics", "--prism", str(tmp_path / "t.props")]) == 2
    with pytest.raises(InputError, match="kind"):
        load_network("telematics")
