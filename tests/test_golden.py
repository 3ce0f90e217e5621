"""A published suite keeps its traces: what moves needs a new version."""

import copy
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tailgate.core import Kind
from tailgate.core.scenario import Suite, list_suites, load_scenario, load_suite
from tailgate.evaluation import golden
from tailgate.evaluation.cells import Cell, run_cell

HELD = golden.read()


# scenarios that differ from another one of their plant, sensor and controller by numbers alone
ALIKE = {f"{suite}-v0/{name}-v0" for suite, names in {
    "car-following": ("car-following-heavy", "car-following-light", "car-following-noisy", "car-following-late"),
    "quick": ("gusty-stop-and-go", "stop-and-go"),
    "ch3": ("thesis-ch3", "thesis-ch3-switched"),
    "ch4-long": ("ornstein-uhlenbeck", "gusty-stop-and-go", "braking"),
    "ch4-actuator": ("braking",),
    "ch5": ("network-weak",),
    "ch6": ("platoon-braking",),
    "highway": ("highway", "highway-cut-in", "highway-braking"),  # a part of one: below
    "lane": ("lane-wet",),
    "network": ("network-restless",),
    "platoon": ("platoon-noisy", "platoon-heavy", "platoon-lossy"),
    "radar": ("radar-heavy",),
    "redundant": ("redundant-two", "redundant-three"),
    "road-aeb": ("road-following", "road-us06", "road-aeb-shared"),
    "thesis": ("thesis-ch3", "thesis-ch3-switched"),
}.items() for name in names}  # fmt: skip


def _alike(name: str) -> bool:
    """Return True for a scenario of a second version of a suite whose first version has it too, and for those of ALIKE."""
    return name in ALIKE or name.replace("-v1/", "-v0/") in {*HELD["scenarios"]} - {name}


def test_scenarios_that_are_alike_have_another_one() -> None:
    """Each kind of plant, sensor and controller has a scenario in every run, but the highway, of which a cell is played."""
    assert set(HELD["scenarios"]) >= ALIKE
    place, played = (lambda name: load_scenario(name.partition("/")[2])), [name for name in HELD["scenarios"] if not _alike(name)]
    kinds = {(type(place(name).plant), type(place(name).sensor), type(place(name).controller)) for name in played}
    for name in ALIKE:
        here = place(name)
        assert (type(here.plant), type(here.sensor), type(here.controller)) in kinds or name.startswith("highway-"), name


def test_a_cell_of_the_highway_has_not_moved() -> None:
    pytest.importorskip("highway_env")
    suite, entry = load_suite("highway-v0"), HELD["scenarios"]["highway-v0/highway-v0"]
    held = entry["cells"][1]
    ((_, loop),) = golden.loops(golden.place_of("highway-v0", suite), (held["defence"],))
    (found,) = golden.cells(loop, held["defence"], [held["attack"]], entry["episodes"])
    assert found["decision"] == held["decision"]
    assert found["trace"] == held["trace"] or not golden.comparable(HELD, entry)


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.long] * _alike(name)) for name in sorted(HELD["scenarios"])])
def test_nothing_moved(name: str) -> None:
    """Decisions on every platform, traces where they were recorded on such a one. Moved on purpose? A new version of suite or scenario."""
    if name.startswith("highway-"):
        pytest.importorskip("highway_env")
    assert golden.check(name, HELD) == []


def test_every_suite_and_every_scenario_of_one_is_recorded_as_it_is() -> None:
    assert golden.moved_suites(HELD) == []
    assert set(HELD["suites"]) == set(list_suites())


def test_every_scenario_has_two_defences_and_three_attacks() -> None:
    """One of them none. Those of a scenario that grants one kind of attack may be of one kind, else they are of two.

    In the quiet road scene nobody brakes, so that of the suite's scripts one alone takes effect.
    """
    for name, entry in HELD["scenarios"].items():
        pairs = [(cell["defence"], cell["attack"]) for cell in entry["cells"]]
        defences, attacks = ({pair[i] for pair in pairs} for i in (0, 1))
        count = 2 if name == "highway-v0/highway-v0" else 3
        assert len(pairs) == len(set(pairs)) == 2 * count and len(defences) == 2 and len(attacks) == count and "none" in attacks, name
        by_defence = [[cell["trace"] for cell in entry["cells"] if cell["defence"] == defence] for defence in defences]
        assert all(len(set(traces)) == count for traces in by_defence), name  # each attack takes effect


@pytest.mark.long
def test_a_fingerprint_is_of_the_rows_of_a_board() -> None:
    """Played in one batch with other attacks, the episodes have the hashes of rows that are played by themselves."""
    name = "thesis-ch6-v0"
    entry = HELD["scenarios"][f"ch6-v0/{name}"]
    suite = load_suite("ch6-v0")
    for cell in entry["cells"][1:5:3]:  # of both defences
        dose = suite.doses[len(suite.doses) // 2]
        rows = run_cell(Cell("s", name, dose, cell["defence"], cell["attack"], 16, "report", 0, 5, suite.threat))
        assert golden._all(row["decision_hash"] for row in rows) == cell["decision"]
        if golden.comparable(HELD, entry):
            assert golden._all(row["trace_hash"] for row in rows) == cell["trace"]


@pytest.mark.long
def test_what_moved_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A decision anywhere, a trace only on the platform that it was recorded on; the scenario, the defence and the attack are said."""
    name = "ch6-v0/thesis-ch6-v0"
    held: dict[str, Any] = copy.deepcopy(HELD)
    held["platform"] = golden.this_platform()
    one, two = held["scenarios"][name]["cells"][1:3]
    one["decision"], two["trace"] = "0" * 32, "0" * 32
    found = [line for line in golden.check(name, held) if "moved" in line]
    assert any(f"{name}, {one['defence']} against {one['attack']}: decisions" in line for line in found)
    assert any(f"{name}, {two['defence']} against {two['attack']}: the trace moved, its decisions did not" in line for line in found)
    held["scenarios"][name]["instructions"] = "another processor's"  # of a plant that another library moves
    assert [line for line in golden.check(name, held) if "moved" in line] == [line for line in found if "decisions (" in line]
    del held["scenarios"][name]["instructions"]
    monkeypatch.setattr(golden, "this_platform", lambda: "another")
    assert [line for line in golden.check(name, held) if "moved" in line] == [line for line in found if "decisions (" in line]


def test_a_changed_suite_or_scenario_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seeds, doses and threat count; words that explain do not."""
    real = load_suite
    name = "ch6-v0"
    monkeypatch.setattr(golden, "load_suite", lambda asked: dataclasses.replace(real(asked), seeds=7, threat={"fdi_bound": 3.0}))
    assert f"suite {name} has changed under its name: it needs a new version" in golden.moved_suites(HELD)
    assert any("ch6-v0/thesis-ch6-v0 has changed" in line and "new version" in line for line in golden.check("ch6-v0/thesis-ch6-v0", HELD))
    suite = Suite("s", "one", ("braking-v0",), (5, 10), ("kf",), ("none",), 9, shown={5: "a"})
    assert suite.hash == dataclasses.replace(suite, about="two", shown={5: "b"}).hash
    for change in ({"seeds": 8}, {"doses": (5,)}, {"shown": {10: "a"}}, {"bound": 1.0}, {"held_out": ("fdi",)}, {"threat": {"budget": 1}}, {"attacks": ("fdi",)}):
        assert suite.hash != dataclasses.replace(suite, **change).hash, change


def test_the_attacks_that_are_recorded_take_effect() -> None:
    """The two beside none are the first of the suite, of different sorts, that a black-box attacker may use here and that do something."""
    suite = Suite("s", "", ("thesis-ch4-v0",), (None,), ("kf",), ("stealth", "fdi:start_step=149", "fdi:start_step=1000", "fdi:value=1", "delay", "dropout"), 16)
    entry = golden.record("thesis-ch4-v0", suite)
    assert [(cell["defence"], cell["attack"]) for cell in entry["cells"]] == [
        (defence, attack) for defence in ("kf", "none") for attack in ("none", "fdi:start_step=149", "dropout")
    ]
    (loop,) = [loop for _, loop in golden.loops(golden.place_of("thesis-ch4-v0", suite), ("kf",))]
    kind = golden.play(loop, ["none", "dropout"]).kind
    assert not kind[:, :16].any() and (kind[:, 16:] == Kind.DROPOUT).all()


def test_the_command_says_what_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    held = copy.deepcopy(HELD)
    held["scenarios"]["ch5-v0/thesis-ch5-v0"]["cells"][0]["decision"] = "0" * 32
    path = tmp_path / "golden.json"
    path.write_text(json.dumps(held))
    monkeypatch.setattr(golden, "FILE", path)
    assert golden.main(["--check", "--scenario", "thesis-ch5-v0"]) == 1
    assert "thesis-ch5-v0" in capsys.readouterr().out
    assert golden.main(["--check", "--scenario", "thesis-ch5-v9"]) == 2
    path.write_text("{}")
    assert golden.main(["--check"]) == 2


def test_no_more_episodes_are_recorded_than_a_board_has_and_few_of_a_slow_plant() -> None:
    """16, those of a small suite, two of a road scene; an entry says so where it is another number."""
    road, scene = (golden.place_of(name, load_suite(suite)) for name, suite in (("braking-v0", "car-following-v0"), ("highway-v0", "highway-v0")))
    assert [golden.episodes_of(place, Suite(seeds=n)) for place, n in ((road, 100), (road, 5), (scene, 100), (scene, 1))] == [16, 5, 2, 1]
    assert HELD["scenarios"]["highway-v0/highway-v0"]["episodes"] == 2 and "episodes" not in HELD["scenarios"]["car-following-v0/braking-v0"]


def test_a_new_suite_is_recorded_beside_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """--write --suite writes this suite and its scenarios, and leaves every other entry as it was; another platform's file is refused."""
    held = copy.deepcopy(HELD)
    del held["suites"]["ch6-v0"], held["scenarios"]["ch6-v0/thesis-ch6-v0"]
    path = tmp_path / "golden.json"
    path.write_text(json.dumps(held | {"platform": golden.this_platform()}))
    monkeypatch.setattr(golden, "FILE", path)
    monkeypatch.setattr(golden, "record", lambda name, suite: {"cells": [name, suite.name]})
    assert golden.main(["--write", "--suite", "ch6-v0"]) == 0
    after = golden.read()
    assert after["suites"] == HELD["suites"] and list(after["scenarios"]) == sorted(HELD["scenarios"])
    new = {key: {"cells": [key.partition("/")[2], "ch6-v0"]} for key in HELD["scenarios"] if key.startswith("ch6-v0/")}
    assert len(new) == 2 and after["scenarios"] == held["scenarios"] | new
    path.write_text(json.dumps(held | {"platform": "another"}))
    assert golden.main(["--write", "--suite", "ch6-v0"]) == golden.main(["--write", "--suite", "ch6"]) == golden.main(["--check", "--suite", "ch6-v0"]) == 2
    assert "another" in capsys.readouterr().err


def test_what_cannot_be_played_here_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Without highway-env a check leaves the road scene out with a word, and nothing has moved."""
    monkeypatch.setitem(sys.modules, "highway_env", None)
    monkeypatch.setitem(sys.modules, "highway_env.road.lane", None)
    monkeypatch.delitem(sys.modules, "tailgate.envs.plants.highway_scene", raising=False)
    assert golden.main(["--check", "--scenario", "highway-v0"]) == 0
    said = capsys.readouterr().out
    assert "highway-v0 is not played" in said and "tailgate[highway]" in said and "nothing moved" in said
