"""Replays of platoons and networks: the data of every agent, whom the page looks at, and the page in a browser."""

import json

import numpy as np
import pytest
import yaml

from tailgate import cli
from tailgate.base.errors import InputError
from tailgate.evaluation.cells import Cell, run_cell
from tailgate.evaluation.rows import encode
from tailgate.replay import episode
from tailgate.replay.episode import episode_of, shown, watched
from tailgate.replay.page import context_of, outcome, render, write_page
from tailgate.replay.replay import Filter, choose, play

from .replays import text_of, to

THREAT = {"kinds": ["dos_jam", "dos_hold", "fdi"], "onset": 3}
PLATOON = {
    "about": "Short.", "plant": {"name": "platoon", "followers": 3, "gap": 30.0}, "sensor": "platoon_sensors", "controller": "cacc", "horizon": 60,
    "manoeuvre": {"name": "braking", "onset": [0.0, 1.0]}, "threat_model": THREAT | {"targets": ["distance", "velocity"], "agents": [1, 2], "budget": 30},
}  # fmt: skip
NETWORK = {
    "about": "Short.", "plant": {"name": "sensor_network", "agents": 5, "states": 4, "graph": "ring"}, "sensor": {"name": "linear_sensors", "sensors": 6},
    "controller": "none", "manoeuvre": {"name": "constant", "value": 0.0}, "horizon": 40, "threat_model": THREAT | {"agents": [1, 3, 4], "fdi_bound": 900.0},
}  # fmt: skip
CELLS = {
    "platoon": ("platoon", "chi2_dkf", "fdi:start_step=10,agents=[2],value=20"), "crash": ("platoon", "dkf", "fdi:start_step=5,value=60"),
    "quiet": ("platoon", "lasso_dkf", "none"), "network": ("network", "chi2_dkf", "fdi_gaussian:start_step=9,sd=300"),
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("many")
    for name, data in (("platoon", PLATOON), ("network", NETWORK)):
        (path / f"{name}.yaml").write_text(yaml.safe_dump(data))
    return path


@pytest.fixture(scope="module")
def rows(folder):
    return {name: run_cell(Cell("s", str(folder / f"{scenario}.yaml"), None, *texts, 1, first_seed=2))[0] for name, (scenario, *texts) in CELLS.items()}


@pytest.fixture(scope="module")
def replays(rows):
    return {name: play(row) for name, row in rows.items()}


def test_many_agents_are_played_again_to_the_last_bit(replays):
    """The trace of the row, in every system."""
    assert [replay.row["status"] for replay in replays.values()] == ["ok"] * 4
    assert all(replay.verdict == "same" and replay.differences == [] for replay in replays.values())


def test_the_data_of_a_platoon_are_those_of_the_trace(replays):
    """Each car's road, belief, errors, score, alarm and command; the leader has no gap, and is not driven."""
    replay = replays["platoon"]
    data, trace = episode_of(replay), replay.trace
    n = data["length"]
    assert set(data["agents"]) == {0, 1, 2, 3} and data["agent"] == 2 and data["noun"] == "car"
    for i in range(1, 4):
        car = data["agents"][i]
        np.testing.assert_allclose(car["road"]["gap"][1:], trace.gap[:, 0, i], rtol=1e-5)
        np.testing.assert_allclose(data["string"]["gap"][i], car["road"]["gap"])
        np.testing.assert_allclose(car["believed"]["gap"], trace.estimate[:, 0, i, 3 + 4 * (i - 1)], rtol=1e-5)
        np.testing.assert_allclose(car["believed"]["speed"], trace.estimate[:, 0, i, 4 * i], rtol=1e-5)
        errors = {one["name"]: one["values"] for one in car["errors"]}
        np.testing.assert_allclose(errors["gap-error"], (trace.estimate - trace.truth)[:, 0, i, 3 + 4 * (i - 1)], rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(data["sizes"][i], np.abs(errors["gap-error"]), rtol=1e-5)
        assert car["alarm"] == trace.alarm[:, 0, i].astype(int).tolist() and len(car["control"]) == n
        assert [row[i] for row in data["alarms"]] == car["alarm"]
    leader = data["agents"][0]
    assert leader["road"] is None and leader["control"] is None and [one["name"] for one in leader["errors"]] == ["speed-error"]
    assert data["string"]["gap"][0] == [None] * (n + 1)
    assert [wire["name"] for wire in data["wires"]] == ["distance of car 2", "velocity of car 2"] and data["wires"][0]["unit"] == "m"
    assert [row[2] for row in data["attacked"]] == data["wires"][0]["hit"] and not any(row[1] for row in data["attacked"])
    json.dumps(data, allow_nan=False)


def test_the_gate_is_each_agents_own(replays):
    """A gate without a declared number is drawn for each agent; what alarms lies above it."""
    data = episode_of(replays["platoon"])
    car = data["agents"][2]
    assert car["threshold"] is None and len(car["gate"]) == data["length"] and sum(car["alarm"]) > 0
    assert all(score > gate for score, gate, alarm in zip(car["score"], car["gate"], car["alarm"], strict=True) if alarm)


def test_the_data_of_a_network_have_no_road(replays):
    """Errors of all agents as norms, the graph with its places, no gap, no command; of many wires one lane for each agent."""
    replay = replays["network"]
    data, trace = episode_of(replay), replay.trace
    norm = np.sqrt(((trace.estimate - trace.truth)[:, 0] ** 2).sum(axis=2))
    for i in range(5):
        np.testing.assert_allclose(data["graph"]["error"][i], norm[:, i], rtol=1e-5)
        assert data["agents"][i]["road"] is None and data["agents"][i]["control"] is None and data["agents"][i]["errors"] == []
    assert len(data["graph"]["edges"]) == 5 and np.ptp(data["graph"]["places"], axis=0).tolist() == [1.0, 1.0]
    assert [wire["name"] for wire in data["wires"]] == [f"6 readings of agent {i}" for i in (1, 3, 4)]
    assert all(wire["value"] is None and sum(wire["hit"]) for wire in data["wires"])
    json.dumps(data, allow_nan=False)


def test_the_norm_of_a_networks_error_has_no_unit_of_length(replays):
    """Metres of a gap on a road; without one the states have any unit."""
    units = {name: {metric: unit for metric, _, unit, *_ in context_of(replays[name], "")["metrics"]} for name in ("platoon", "network")}
    for metric in ("rmse position", "max error", "final error"):
        assert units["platoon"][metric] == "m" and units["network"][metric] == "-"


def test_whom_the_page_looks_at(replays):
    """The agent that is asked for; else the attacked one; else the first that follows another; a number that does not exist is refused."""
    assert watched(replays["platoon"]) == 2 and watched(replays["quiet"]) == 1 and watched(replays["platoon"], 3) == 3
    assert watched(replays["crash"]) == 1 and watched(replays["network"]) == 1  # of equals the first
    for wrong in (-1, 4):
        with pytest.raises(InputError, match=f"--agent.*{wrong}.*0 to 3"):
            watched(replays["platoon"], wrong)


def test_of_very_many_agents_those_near_the_chosen_one_have_curves(replays, monkeypatch):
    """The picture has all, the plots a few; lanes are shared."""
    monkeypatch.setattr(episode, "SHOWN", 2)
    assert shown(replays["network"], 3) == [2, 3]
    data = episode_of(replays["network"], 3)
    assert set(data["agents"]) == set(data["sizes"]) == {2, 3} and len(data["graph"]["error"]) == 5
    assert [wire["name"] for wire in data["wires"]] == ["18 readings of 3 agents"]


def test_the_outcome_says_who(replays):
    """Which car hit which; without a road the largest error, whose and when."""
    words = outcome(replays["crash"])
    trace = replays["crash"].trace
    car = int(np.argmin(trace.gap[trace.length[0] - 1, 0]))
    assert f"car {car} hit " in words and "closing at" in words
    assert outcome(replays["quiet"]).startswith("No collision; the smallest gap was")
    size = replays["network"].loop.model.error(replays["network"].trace.estimate[:, 0], replays["network"].trace.truth[:, 0])
    assert f"was {size.max():.4g}, of agent {np.argmax(size.max(axis=0))}" in outcome(replays["network"])


def test_the_worst_row_of_a_network_has_the_largest_error(rows):
    """Without a road nobody collides: the error decides."""
    few, many = rows["network"] | {"max_error": 3.0}, rows["network"] | {"max_error": 50.0}
    assert choose([few, many, few], Filter()).line == 2


@pytest.mark.long
def test_the_command_takes_an_agent(folder, rows, tmp_path, capsys):
    """--agent chooses; one that does not exist is bad input, and nothing is written."""
    path = tmp_path / "rows.jsonl"
    path.write_bytes(encode([rows["platoon"]]))
    assert cli.main(["replay", str(path), "--agent", "3", "--out", str(tmp_path / "p.html")]) == 0
    assert '"agent":3' in (tmp_path / "p.html").read_text(encoding="utf-8")
    capsys.readouterr()
    assert cli.main(["replay", str(path), "--agent", "4", "--out", str(tmp_path / "q.html")]) == 2
    assert "--agent" in capsys.readouterr().err and not (tmp_path / "q.html").exists()


def test_the_page_has_a_choice_only_where_there_is_one(replays):
    """A menu of agents for many, none for one car; the words of the page name what it shows."""
    many = render(replays["network"])
    assert '<select id="agent"' in many and "The graph of the agents" in many
    (row,) = run_cell(Cell("s", "thesis-ch4-v0", None, "kf", "none", 1))
    assert '<select id="agent"' not in render(play(row))


@pytest.mark.long
@pytest.mark.parametrize("name", ["platoon", "network"])
def test_a_film_of_many_agents(replays, tmp_path, name):
    """A picture of the start and every step."""
    image = pytest.importorskip("PIL.Image")
    from tailgate.replay.video import write_video

    write_video(replays[name], tmp_path / "film.gif")
    with image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == int(replays[name].trace.length[0]) + 1


# -- in a browser


@pytest.fixture(scope="module")
def pages(tmp_path_factory, replays):
    where = tmp_path_factory.mktemp("pages")
    return {name: write_page(replay, where / f"{name}.html") for name, replay in replays.items()}


@pytest.fixture
def tab(load, pages):
    """Loads a page at a width; logs are empty before."""
    return lambda name, width=1280: load(pages[name], width)


def _look(tab, agent):
    tab.execute_script("const s = document.getElementById('agent'); s.value = arguments[0]; s.dispatchEvent(new Event('change'))", agent)


@pytest.mark.thin(3)
@pytest.mark.page
@pytest.mark.parametrize("width", [360, 1280])
@pytest.mark.parametrize("name", list(CELLS))
def test_the_page_is_quiet_and_nothing_is_cut(tab, pages, name, width, asked):
    """No message, no request, no sideways scrolling, at the start, in the middle and at the end, whoever is looked at."""
    page = tab(name, width)
    last = int(page.find_element("id", "slider").get_attribute("max"))
    for agent in [o.get_attribute("value") for o in page.find_elements("css selector", "#agent option")]:
        _look(page, agent)
        for step in (0, last // 2, last):
            to(page, step)
    wide, room = page.execute_script("return [document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    assert wide <= room <= width and page.get_log("browser") == []
    assert asked() == {pages[name].as_uri()}
    texts = page.execute_script("""
        return [...document.querySelectorAll('.plot')].map((plot) => {
          const svg = plot.querySelector(':scope > svg'), box = svg.getBoundingClientRect();
          return [plot.id, box.left, box.right, [...svg.querySelectorAll('text')].map((t) => [t.textContent, t.getBoundingClientRect().left, t.getBoundingClientRect().right])];
        })""")
    assert len({plot for plot, *_ in texts}) == len(texts)
    for plot, left, right, words in texts:
        assert [w for w, x0, x1 in words if x0 < left - 1 or x1 > right + 1] == [], plot


@pytest.mark.page
def test_the_picture_and_the_words_follow_the_slider(tab):
    """The canvas changes with the step and with the car that is looked at; attack and alarm name their cars; values are the trace's."""
    page = tab("platoon")
    shot = "return document.getElementById('road').toDataURL()"
    start = page.execute_script(shot)
    to(page, 30)
    assert page.execute_script(shot) != start and "distance of car 2 +20 m" in text_of(page, "attack")
    assert "ALARM" in text_of(page, "alarm") and "car 2" in text_of(page, "alarm")
    data = page.execute_script("return JSON.parse(document.getElementById('episode').textContent)")
    values = [o.text for o in page.find_elements("css selector", "#plot-gaps output")]
    assert [float(v) for v in values] == pytest.approx([data["string"]["gap"][i][30] for i in (1, 2, 3)], abs=0.051)
    mine = page.find_element("css selector", "#plot-gap output").text
    assert float(mine) == pytest.approx(data["string"]["gap"][2][30], abs=0.051)
    before = page.execute_script(shot)
    _look(page, "3")
    assert float(page.find_element("css selector", "#plot-gap output").text) == pytest.approx(data["string"]["gap"][3][30], abs=0.051)
    assert page.execute_script(shot) != before and len(page.find_elements("css selector", "#plot-gap")) == 1
    spoken = page.find_element("id", "slider").get_attribute("aria-valuetext")
    assert "smallest gap" in spoken and "alarm" in spoken
    _look(page, "0")
    assert not page.find_elements("css selector", "#plot-gap") and page.find_elements("css selector", "#plot-speed-error")


@pytest.mark.long
@pytest.mark.page
def test_a_network_shows_the_errors_of_all(tab):
    """One curve for each agent on a logarithmic axis, the largest error to jump to, lanes for each attacked agent, and no road."""
    page = tab("network")
    assert len(page.find_elements("css selector", "#plot-sizes .curve")) == 5
    ids = [plot.get_attribute("id") for plot in page.find_elements("css selector", ".plot")]
    assert ids == ["plot-sizes", "plot-attack", "plot-score"]
    buttons = {b.text.split(",")[0]: b for b in page.find_elements("css selector", "#jumps button")}
    data = page.execute_script("return JSON.parse(document.getElementById('episode').textContent)")
    page.execute_script("arguments[0].click()", buttons["Largest error"])
    step = 1 + int(np.argmax(np.max(np.array(data["graph"]["error"]), axis=0)))
    assert int(page.find_element("id", "slider").get_attribute("value")) == step
    assert "largest error" in page.find_element("id", "slider").get_attribute("aria-valuetext")
    lanes = page.execute_script("return [...document.querySelectorAll('#plot-attack .lanename')].map((t) => t.textContent)")
    assert lanes == [f"6 readings of agent {i}: FDI" for i in (1, 3, 4)]
    shot = "return document.getElementById('road').toDataURL()"
    before = page.execute_script(shot)
    _look(page, "4")
    assert page.execute_script(shot) != before
