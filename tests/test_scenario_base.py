"""Scenarios: a base with changes, a mapping, an object."""

import dataclasses
import json
from pathlib import Path

import gymnasium
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.core.scenario import load_scenario


def _made(folder: Path, name: str, text: str) -> str:
    (folder / f"{name}.yaml").write_text(text)
    return str(folder / f"{name}.yaml")


def test_single_fields_change_and_the_rest_stays(tmp_path: Path) -> None:
    """Fields of a part and of the threat model change one by one; the result is that of a file that is written out."""
    base = load_scenario("gusty-stop-and-go-v0")
    closer = load_scenario(_made(tmp_path, "closer", "base: gusty-stop-and-go-v0\ncontroller: {headway: 2.0}\nthreat_model: {fdi_bound: 3.0}"))
    whole = load_scenario(_made(tmp_path, "whole", """
plant: {name: car_following, dt: 0.1, process_var: [1.0e-3, 4.0e-3, 2.5e-2]}
sensor: {name: odometry, noise_var: [1.0, 1.0]}
controller: {name: acc, headway: 2.0}
manoeuvre: {name: stop_and_go}
horizon: 600
threat_model: {kinds: [dos_jam, dos_hold, dos_hold_fresh, dropout, fdi], fdi_bound: 3.0, jam_range: [-108.0, 3000.0], onset: 50, end: 500}
"""))
    same = {"name": "x", "about": "y"}
    assert dataclasses.replace(closer, **same).config_hash == dataclasses.replace(whole, **same).config_hash
    assert closer.config_hash != base.config_hash
    assert (closer.name, closer.about) == ("closer", base.about) and repr(closer) == "<Scenario closer: CarFollowing, Odometry, AdaptiveCruise, StopAndGo, 600 steps>"
    assert closer.plant == base.plant and closer.manoeuvre == base.manoeuvre and closer.threat_model.kinds == base.threat_model.kinds


def test_another_name_replaces_the_part(tmp_path: Path) -> None:
    """Nothing of the base's part is left, whose fields the other may not know; numbers and lists replace too."""
    made = load_scenario(_made(tmp_path, "m", "base: stop-and-go-v0\nmanoeuvre: {name: constant, value: 0.0}\nhorizon: 20\nthreat_model: {kinds: [fdi]}"))
    assert type(made.manoeuvre).__name__ == "Constant" and made.horizon == 20 and made.threat_model.kinds == ("fdi",)


def test_a_base_is_looked_for_next_to_the_file(tmp_path: Path) -> None:
    """So is a recording that the base names, next to the base."""
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "lead.csv").write_text("t,v\n0,20\n10,20\n15,5\n")
    _made(tmp_path / "there", "base", """
plant: {name: car_following, dt: 0.1, lead_speed: 20.0, speed: 20.0, gap: 65.0}
sensor: {name: odometry}
controller: acc
manoeuvre: {name: profile, path: lead.csv}
horizon: 100
""")
    made = load_scenario(_made(tmp_path, "mine", "base: there/base.yaml\ncontroller: {headway: 2.0}"))
    assert made.controller.headway == 2.0 and made.manoeuvre.path == tmp_path / "there" / "lead.csv"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("base: gusty", r"scenario m\.base: got 'gusty'; expected one of .*"), ("base: 3", r"m\.base: got 3; expected the name or the file"),
        ("base: [a]", r"m\.base"), ("base: nobody.yaml", r"nobody\.yaml"), ("base: n.yaml", "a scenario that has no base"),
        ("base: m.yaml", "a scenario that has no base"), ("base: stop-and-go-v0\ncontroller: {headwai: 2.0}", "headwai"),
        ("base: stop-and-go-v0\nthreat_model: 3", r"m\.threat_model: got 3"), ("bases: stop-and-go-v0", "did you mean 'base'"),
    ],
)  # fmt: skip
def test_what_is_no_base_is_one_clear_error(tmp_path: Path, text: str, words: str) -> None:
    _made(tmp_path, "n", "base: stop-and-go-v0")
    with pytest.raises(InputError, match=words):
        load_scenario(_made(tmp_path, "m", text))


FIELDS = {"base": "gusty-stop-and-go-v0", "controller": {"headway": 2.0}, "horizon": 80}


def test_a_scenario_is_a_mapping_an_object_or_a_path_too(tmp_path: Path) -> None:
    """Environments and `evaluate` take each, and play the same episodes."""
    file = Path(_made(tmp_path, "custom", json.dumps(FIELDS)))
    forms = [FIELDS, load_scenario(FIELDS), file, str(file)]
    rows = [tailgate.evaluate(scenarios=form, defences="kf", attacks="fdi:start_step=10,value=-3", seeds=2) for form in forms]
    assert len({row["trace_hash"] for some in rows for row in some[:1]}) == 1 and len({row["config_hash"] for some in rows for row in some}) == 1
    assert [some[0]["scenario"] for some in rows] == ["custom"] * 4 and [bool(some[0]["scenario_file"]) for some in rows] == [False, False, True, True]
    both = tailgate.evaluate(scenarios=[FIELDS, "thesis-ch4-v0"], defences="kf", attacks="none", seeds=1, workers=2)
    assert [row["scenario"] for row in both] == ["custom", "thesis-ch4-v0"] and both[0]["status"] == "ok"
    seen = []
    for form in forms:
        env = gymnasium.make("tailgate:tailgate/CarFollowing-v1", scenario=form, value=-3.0)
        seen.append(env.reset(seed=0)[0].tolist())
        if form is FIELDS:
            assert json.loads(env.spec.to_json())["kwargs"]["scenario"] == FIELDS
    assert seen == [seen[0]] * 4
    as_dict = tailgate.parallel_env(scenario=FIELDS, value=-3.0)
    assert as_dict.reset(seed=0)[0]


def test_a_file_of_another_ending_is_no_scenario(tmp_path: Path) -> None:
    (tmp_path / "drive.csv").write_text("t,v\n")
    with pytest.raises(InputError, match=r"expected a file that ends with \.yaml"):
        load_scenario(str(tmp_path / "drive.csv"))
    with pytest.raises(InputError, match="expected one of"):
        load_scenario("a" * 5000)


def test_two_scenarios_of_one_name_are_refused() -> None:
    """So are an object under a built-in scenario's name with other content, and under a file's."""
    taken = [FIELDS, FIELDS | {"horizon": 60}], FIELDS | {"name": "stop-and-go-v0"}, FIELDS | {"name": "x.yaml"}
    for wrong in taken:
        with pytest.raises(InputError, match=r"scenarios: got '.*'; expected a different name for each object"):
            tailgate.evaluate(scenarios=wrong, defences="kf", attacks="none", seeds=1)
    built_in = load_scenario("stop-and-go-v0").with_threat(budget=5)
    (row,) = tailgate.evaluate(scenarios=[built_in, built_in], defences="kf", attacks="none", seeds=1)
    assert (row["scenario"], row["dose"]) == ("stop-and-go-v0", 5)


@pytest.mark.parametrize("value", [3, None, ["a"], {"horizon": 3}, {"base": "nobody"}, {"headway": 2}])
def test_what_is_no_scenario_is_one_clear_error(value: object) -> None:
    with pytest.raises(InputError, match="scenario"):
        load_scenario(value)  # type: ignore[arg-type]


def test_a_headway_in_milliseconds_is_refused() -> None:
    with pytest.raises(InputError, match=r"controller acc.headway: got 1500.0; expected less than or equal to 60 \[s\]"):
        load_scenario({"base": "stop-and-go-v0", "controller": {"headway": 1500.0}})
