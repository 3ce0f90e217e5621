"""Graphs: every edge and no other is drawn, the same file each time, and places that follow the distances."""

import json

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from matplotlib.patches import Circle, FancyArrowPatch

from tailgate import cli
from tailgate.base.errors import InputError
from tailgate.core.reach import hops
from tailgate.core.scenario import load_scenario
from tailgate.envs import CarFollowing, Platoon, SensorNetwork
from tailgate.envs.plants.sensor_network import THESIS_EDGES
from tailgate.envs.render.graph import draw_graph, edges, graph_figure, layout


def _ring(n, directed=False):
    graph = np.eye(n, dtype=bool) | (np.roll(np.eye(n, dtype=bool), 1, axis=1))
    return graph if directed else graph | graph.T


def _drawn(figure):
    (ax,) = figure.axes
    arrows = [p for p in ax.patches if isinstance(p, FancyArrowPatch)]
    rings = [p for p in ax.patches if isinstance(p, Circle)]
    return arrows, rings, [t.get_text() for t in ax.texts]


def test_the_edges_of_the_thesis_network():
    """Figure 5.1: ten agents, twelve lines that two hear each other by, six of the agents marked."""
    graph = SensorNetwork().hears()
    found = edges(graph)
    assert {(min(a, b), max(a, b)) for a, b, _ in found} == {tuple(sorted(e)) for e in THESIS_EDGES} and len(found) == 12
    assert all(mutual for *_, mutual in found)
    arrows, rings, words = _drawn(graph_figure(graph, attacked=[0, 1, 2, 4, 7, 9]))
    assert len(arrows) == 12 and len(rings) == 10 + 6 and words == [str(i) for i in range(10)]


@pytest.mark.parametrize(
    "topology, wanted",
    [
        ("predecessor_leader", {(0, 1), (1, 2), (2, 3), (0, 2), (0, 3)}), ("predecessor", {(0, 1), (1, 2), (2, 3)}),
        ("two_predecessor", {(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)}),
    ],
)  # fmt: skip
def test_arrows_point_to_who_hears(topology, wanted):
    """Figure 6.2: one-way edges go from the car that sends to the one that hears."""
    found = edges(Platoon(followers=3, topology=topology).hears())
    assert {(a, b) for a, b, mutual in found if not mutual} == wanted and len(found) == len(wanted)
    both = edges(Platoon(followers=3, topology="bidirectional").hears())
    assert all(mutual for *_, mutual in both) and len(both) == 3


def test_hops_are_shortest_paths():
    """A ring of seven: at most three; two parts: infinite."""
    assert hops(_ring(7))[0].tolist() == [0, 1, 2, 3, 3, 2, 1]
    apart = np.eye(4, dtype=bool)
    apart[0, 1] = True
    assert hops(apart)[1].tolist() == [1, 0, np.inf, np.inf]


@pytest.mark.parametrize("graph", [_ring(9), SensorNetwork().hears(), SensorNetwork(agents=24, graph="random", edge_probability=0.05).hears(), np.eye(5, dtype=bool)])
def test_places_follow_the_distances(graph):
    """Neighbours lie near, nobody lies on another, and a second call gives the same places."""
    places, far = layout(graph), hops(graph)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    others = ~np.eye(len(graph), dtype=bool)
    assert np.isfinite(places).all() and apart[others].min() > 0.3
    if (far == 2).any():
        assert np.median(apart[far == 1]) < np.median(apart[far == 2])
    assert np.array_equal(places, layout(graph))


@pytest.mark.long
def test_few_many_and_rows():
    """One and two agents, a hundred on a circle, and a platoon with its leader on the right."""
    for n in (1, 2, 100):
        assert len(_drawn(graph_figure(_ring(n)))[1]) == n
    radius = np.linalg.norm(layout(_ring(100)), axis=1)
    assert radius.min() == pytest.approx(radius.max())
    x, y = layout(_ring(5), row=True).T
    assert (np.diff(x) == -1.0).all() and not y.any()


def test_the_same_graph_gives_the_same_file(tmp_path):
    """png, svg and pdf, from a model and from its plant; another mark gives another picture."""
    place = load_scenario("platoon-braking-v0")
    for form in ("png", "svg", "pdf"):
        one, two = (draw_graph(source, tmp_path / f"{i}.{form}") for i, source in enumerate((place.brief().model, place.plant)))
        assert one.read_bytes() == two.read_bytes()
        assert draw_graph(place.plant, tmp_path / f"m.{form}", [2]).read_bytes() != one.read_bytes()


def test_bad_input_is_named(tmp_path):
    """An ending that is no format, a plant without a graph, labels and agents that do not fit; nothing is written."""
    for call, words in (
        (lambda: draw_graph(SensorNetwork(), tmp_path / "a.gif"), "out.*a.gif.*png"), (lambda: draw_graph(CarFollowing(), tmp_path / "a.png"), "graph.*CarFollowing"),
        (lambda: graph_figure(_ring(3), ["a"]), "labels.*1.*3 agents"), (lambda: graph_figure(_ring(3), attacked=[3]), "attacked.*3.*0 to 2"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            call()
    assert not list(tmp_path.iterdir())


def test_the_command_draws_a_scenario(tmp_path, capsys):
    """tailgate list --graph: the file, and what is in it in words and as JSON."""
    path = tmp_path / "net.png"
    assert cli.main(["list", "--graph", "thesis-ch5-v0", "--out", str(path)]) == 0
    said = capsys.readouterr().out
    assert "10 agents, 12 edges" in said and "0, 1, 2, 4, 7, 9" in said and path.stat().st_size > 5000
    assert cli.main(["list", "--graph", "platoon-braking-v0", "--out", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["attacked"] == [2]
    assert cli.main(["list", "--graph", "braking-v0", "--out", str(path)]) == 0
    for arguments, words in ((["--graph", "nowhere"], "'nowhere'"), (["--out", "x.png"], "--graph SCENARIO"), (["--graph", "thesis-ch5-v0", "--out", "x.doc"], "x.doc")):
        assert cli.main(["list", *arguments]) == 2
        assert words in capsys.readouterr().err
