"""An episode as CSV, Parquet and SUMO's floating car data: the numbers of the trace, which the field's readers read back."""

import csv
import io
import json
from xml.etree import ElementTree

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.cli import main
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout
from tailgate.roads.export import cars_of, exported, table_of, write_episode
from tailgate.roads.readers import Choice, mapping_of, read

PLACES = {"road-string-v0": "fdi:start_step=105,value=5", "gusty-stop-and-go-v0": "fdi:start_step=60,value=-3", "platoon-gusty-v0": "fdi:start_step=60,value=5",
          "radar-following-v0": "noise_jam:start_step=15"}  # fmt: skip


def _trace(name, steps=150):
    scenario, guard = load_scenario(name), Spec("defence", "chi2_kf")
    loop = scenario.loop(guard.make(), guard.entry.uses)
    object.__setattr__(loop, "horizon", min(steps, scenario.horizon))
    return rollout(loop, Spec("attack", PLACES.get(name, "none")).make(), draws.keys("tune", range(2)))


@pytest.mark.thin(2)
@pytest.mark.parametrize("name", PLACES)
def test_a_table_holds_the_numbers_of_the_trace(name):
    trace = _trace(name)
    cars, table = cars_of(trace, 1), table_of(trace, 1)
    n, model = int(trace.length[1]), trace.model
    assert {len(column) for column in table.values()} == {n + 1} and {f"{car}/gap" for car in cars.names} < set(table)
    i = int(np.argmax(model.followers))
    mine = {key.partition("/")[2]: column for key, column in table.items() if key.startswith(f"agent{i}/")}
    assert np.array_equal(table["t"], model.dt * np.arange(n + 1))
    assert np.array_equal(mine["gap"][1:], trace.signals["gap"][:n, 1, i])
    assert np.array_equal(mine["speed"][1:], trace.signals["speed"][:n, 1, i])
    attacked = (trace.kind[:n, 1] != 0) & trace.target[:n, 1, i].any(axis=1)
    assert np.array_equal(mine["attack"][:n] != "none", attacked) and (trace.kind[:n, 1] != 0).any() and mine["attack"][n] == ""
    assert np.array_equal(mine["alarm"][:n] == 1.0, trace.alarm[:n, 1, i]) and np.isnan(mine["alarm"][n])
    quiet = int(np.argmax(attacked)) or n  # before, the leader's message is honest but for its noise
    off = model.gap_error(trace.estimate[:quiet, 1], trace.truth[:quiet, 1])[:, i]
    assert np.abs(mine["believed_gap"][:quiet] - mine["gap"][:quiet] - off).max() < (1e-9 if "leader_position" not in model.v2v else 1.0)


@pytest.mark.thin(2)
@pytest.mark.parametrize("name", PLACES)
def test_cars_of_a_lane_are_a_car_and_a_gap_apart(name):
    cars = cars_of(_trace(name))
    assert np.nanmax(np.abs(cars.place[:, :-1] - cars.place[:, 1:] - 5.0 - cars.gap[:, 1:])) < 1e-9
    assert cars.names[0] == ("agent0" if name.startswith("platoon") else "leader")


def test_floating_car_data_is_read_back(tmp_path):
    trace = _trace("road-string-v0", 400)
    path = write_episode(trace, tmp_path / "a.xml")
    found = read(str(path), choice=Choice("agent2", "agent1"))[0]
    part = found.segments[0]
    assert found.dt == pytest.approx(0.05) and found.samples == int(trace.length[0]) + 1
    assert np.abs(part.gap[1:] - trace.signals["gap"][:, 0, 2])[part.seen[1:]].max() < 2e-3 and part.seen[:-1].all()  # the last: a collision
    assert np.abs(part.speed[1:] - trace.signals["speed"][:, 0, 2]).max() < 1e-4


@pytest.mark.parametrize("name", ["road-string-v0", "platoon-gusty-v0"])
def test_floating_car_data_has_the_elements_of_sumo(name):
    """The standard library reads the elements and attributes that SUMO's page on FCD output names: a step for each row, each car in it."""
    trace = _trace(name)
    cars, root = cars_of(trace, 1), ElementTree.fromstring(exported(trace, ".xml", 1))
    assert root.tag == "fcd-export" and {step.tag for step in root} == {"timestep"} and len(root) == int(trace.length[1]) + 1
    begin = min(0.0, cars.place.min())
    for k, step in enumerate(root):
        assert step.attrib.keys() == {"time"} and float(step.attrib["time"]) == pytest.approx(k * trace.dt, abs=5e-4)
        assert [(vehicle.tag, vehicle.attrib["id"]) for vehicle in step] == [("vehicle", car) for car in cars.names]
        for i, vehicle in enumerate(step):
            held = dict(vehicle.attrib)
            assert held.keys() == {"id", "x", "y", "angle", "type", "speed", "pos", "lane", "slope", "acceleration"}
            assert held["lane"] == "road_0" and held["type"] == "car" and held["x"] == held["pos"]
            assert [float(held[key]) for key in ("y", "angle", "slope")] == [0.0, 90.0, 0.0]  # along x: 0 is north, clockwise
            assert float(held["pos"]) == pytest.approx(cars.place[k, i] - begin, abs=5.1e-4)
            assert float(held["speed"]) == pytest.approx(cars.speed[k, i], abs=5.1e-5)
            assert float(held["acceleration"]) == pytest.approx(cars.accel[k, i], abs=5.1e-5)
    own = [i for i, car in enumerate(cars.names) if car.startswith("agent")]
    speeds = np.array([[float(step[i].attrib["speed"]) for i in own] for step in root])
    assert np.abs(speeds[1:] - trace.signals["speed"][: len(root) - 1, 1]).max() < 5.1e-5 and speeds.min() > 0.0


def test_csv_is_read_back(tmp_path):
    trace = _trace("road-following-v0", 400)
    rows = list(csv.DictReader(io.StringIO(exported(trace, ".csv").decode())))
    assert [float(row["agent0/gap"]) for row in rows[1:]] == trace.signals["gap"][:, 0, 0].tolist()
    assert rows[-1]["agent0/received_distance"] == "" and "leader/received_distance" not in rows[0]
    path = write_episode(trace, tmp_path / "one.csv")
    found = read(str(path), choice=Choice(mapping=mapping_of(["t=t", "gap=agent0/gap", "speed=agent0/speed", "lead_speed=leader/speed"])))[0]
    assert np.abs(found.segments[0].gap[1:] - trace.signals["gap"][:, 0, 0]).max() == 0.0


def test_parquet_is_read_back(tmp_path):
    pq = pytest.importorskip("pyarrow.parquet")
    trace = _trace("road-string-v0")
    held = pq.read_table(write_episode(trace, tmp_path / "a.parquet"))
    want = table_of(trace)
    for name in want:
        got = held[name].to_numpy(zero_copy_only=False)
        assert np.array_equal(got, want[name]) if want[name].dtype == object else np.array_equal(got.astype(float), want[name], equal_nan=True)
    assert held["leader/gap"].null_count == len(want["t"])  # nobody drives ahead of it


def test_a_collision_is_in_the_last_row():
    """It comes with the last step; what is read and decided belongs to the steps before."""
    scenario, guard = load_scenario("gusty-stop-and-go-v0"), Spec("defence", "kf")
    attack = Spec("attack", "fdi:trigger=near,threshold=60,value=-20").make()
    trace = rollout(scenario.loop(guard.make(), guard.entry.uses), attack, draws.keys("report", range(20)))
    row = int(np.argmax(trace.length < trace.horizon))
    gap = table_of(trace, row)["agent0/gap"]
    assert trace.signals["collided"][trace.length[row] - 1, row].any() and gap[-1] <= 0.0 < gap[:-1].min()
    assert b'time="%.3f"' % (trace.dt * trace.length[row]) in exported(trace, ".xml", row)


def test_another_car_ahead_has_another_name():
    """As in traffic; nobody jumps, and no acceleration is made of a change of cars."""
    trace = _trace("road-following-v0", 100)
    trace.signals["gap"][40:] -= 20.0
    cars = cars_of(trace)
    assert cars.names == ("leader", "leader1", "agent0")
    assert np.isfinite(cars.place[:, :2]).sum(axis=1).tolist() == [1] * 101 and np.nanmax(np.abs(cars.accel)) < 10.0
    text = exported(trace, ".xml").decode()
    assert text.count('id="leader"') == 41 and text.count('id="leader1"') == 60


def test_an_episode_may_be_one_step():
    trace = _trace("road-following-v0", 1)
    assert len(table_of(trace)["t"]) == 2 and exported(trace, ".csv").count(b"\n") == 3


def test_a_network_has_no_road():
    with pytest.raises(InputError, match="a system without a road"):
        cars_of(_trace("network-noisy-v0", 30))


def test_the_command(tmp_path, capsys):
    rows, out = tmp_path / "rows.jsonl", tmp_path / "page.html"
    assert main(["evaluate", "--scenario", "road-following-v0", "--defence", "kf", "--attack", "fdi:start_step=105,value=10", "--seeds", "2", "--out", str(rows)]) == 0
    capsys.readouterr()
    files = [str(tmp_path / f"a{suffix}") for suffix in (".csv", ".xml")]
    assert main(["replay", str(rows), "--out", str(out), "--json", *(part for file in files for part in ("--export", file))]) == 0
    held = json.loads(capsys.readouterr().out)
    assert held["exports"] == files and held["verdict"] == "same" and all((tmp_path / f"a{suffix}").stat().st_size > 1e4 for suffix in (".csv", ".xml"))
    assert main(["replay", str(rows), "--out", str(out), "--export", "a.txt"]) == 2
    assert "--export: got 'a.txt'; expected a file that ends in .csv, .xml, .parquet" in capsys.readouterr().err
