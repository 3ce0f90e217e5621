"""False alarms at the thresholds of a detection board, scenario by scenario."""

import dataclasses

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.board import false_alarms as module
from tailgate.board.false_alarms import FIRST, Drives, dispersion, false_alarms
from tailgate.board.files import read_board
from tailgate.core.scenario import load_scenario, load_suite
from tailgate.evaluation.attack_free import Bench
from tailgate.evaluation.cells import Cell, run_cell
from tailgate.site.alarms import drifts_of, table_of, time_text, together_of
from tailgate.site.suite import Suite

from . import boards

ROAD = dataclasses.replace(load_suite("car-following-v0"), scenarios=("gusty-stop-and-go-v0", "car-following-noisy-v0"), robustness=("car-following-noisy-v0",))


def _line(defence, scenario, threshold, hours=0.02, **more):
    return {"defence": defence, "scenario": scenario, "attack": "fdi", "hours": hours, "threshold": threshold} | more


def _others(line, first, count, beacon="", purpose="report"):
    """Another way: cells with the defence at this threshold, whose metric counts onsets."""
    made = Bench.of(line["defence"], [line["scenario"]], 1, None).at(line["threshold"])
    cell = Cell(ROAD.name, line["scenario"], None, line["defence"], "none", count, purpose=purpose, first_seed=first, beacon=beacon)
    return [row["alarm_onsets"] for row in run_cell(cell, made)]


@pytest.mark.parametrize("beacon", ["", "of after the submissions"])
def test_they_are_those_of_rows_without_an_attack(beacon):
    """Of all scenarios of the plant, once for all attacks; of fresh seeds of the round, and of others in each scenario."""
    told = _line("chi2_kf", "gusty-stop-and-go-v0", 12.0)
    lines = false_alarms(ROAD, [told, told | {"attack": "dos_jam"}], 20, 100_000, beacon=beacon)
    assert [(line["scenario"], line["hours"], line["threshold"]) for line in lines] == [(name, 0.02, 12.0) for name in ROAD.scenarios]
    first = FIRST
    for line in lines:
        model = load_scenario(line["scenario"]).brief().model
        horizon = load_scenario(line["scenario"]).horizon
        count = -(-int(20 * 0.02 * 3600 / model.dt) // horizon)
        assert line["onsets"] == sum(_others(line, first, count, beacon)) > 0 and first >= ROAD.seeds
        assert line["running"] == pytest.approx(count * horizon * model.dt / 3600.0, rel=1e-12)
        assert line["mean"] == pytest.approx(line["running"] / line["onsets"]) and line["low"] < line["mean"] < line["high"]
        first += count
    near, noisy = lines
    assert noisy["onsets"] > 10 * near["onsets"] and 0 < near["first"] < near["onsets"]


def test_a_run_is_no_longer_than_asked_and_batches_change_no_figure(monkeypatch):
    told = _line("chi2_kf", "gusty-stop-and-go-v0", 12.0, hours=10.0)
    horizon, dt = load_scenario(told["scenario"]).horizon, load_scenario(told["scenario"]).brief().model.dt
    whole = false_alarms(ROAD, [told], 20, 10 * horizon)
    assert [line["running"] for line in whole] == pytest.approx([10 * horizon * dt / 3600.0] * 2) and whole[1]["onsets"] > 100
    monkeypatch.setattr(module, "BATCH", 6)
    assert false_alarms(ROAD, [told], 20, 10 * horizon) == whole


@pytest.mark.long
def test_a_constant_gain_alarms_while_it_settles():
    """Steady filters of a network that starts from a guess; the time-varying one has no such half."""
    suite = dataclasses.replace(load_suite("network-v0"), scenarios=("network-restless-v0",))
    steady, varying = false_alarms(suite, [_line(name, "network-restless-v0", level, 0.05) for name, level in (("dkf", 31.0), ("kf", 24.0))], 20, 6_000)
    assert steady["onsets"] > 10 and steady["first"] >= 0.9 * steady["onsets"] and steady["early"] > 10 > 10 * steady["late"]
    assert varying["onsets"] > 3 and varying["first"] < 0.8 * varying["onsets"]


def _drives(*halves, steps=10):
    return Drives(np.array(halves), np.broadcast_to(np.array(steps), len(halves)), 10, 0.1)


def test_a_drive_is_of_the_half_that_has_more_of_them():
    """Clusters count once, and what ended before its time has no second half."""
    assert _drives((3, 0), (1, 0), (1, 1), (0, 9), (0, 0)).sides == (2, 1)
    assert _drives((3, 0), (1, 0), (0, 2), steps=[10, 4, 10]).sides == (1, 1)


def test_a_silent_scenario_has_the_clusters_of_the_others():
    """Nothing in twenty drives says less where alarms come ten at a time; of scenarios with other rates only what differs within each counts."""
    silent, clustered = _drives(*[(0, 0)] * 20), _drives((10, 0), *[(0, 0)] * 9)
    assert dispersion([silent]) == 1.0 and dispersion([clustered]) == pytest.approx(9.0) == dispersion([silent, clustered])
    assert dispersion([_drives((1, 0), (1, 0)), _drives((5, 4), (5, 4))]) == 0.0
    alone, beside = module._figures(silent, 1.0), module._figures(silent, 9.0)
    assert beside["dispersion"] == 9.0 and beside["low"] < alone["low"] and alone["onsets"] == 0 and alone["mean"] is None is alone["high"]


def _suite(alarms):
    board = boards.make_board(scenarios=["calm-v0", "busy-v0", "worn-v0"])
    board["suite"]["scenarios"][2]["robustness"] = True
    base = {"defence": "kf", "hours": 1.0, "threshold": 9.0}
    board["detection"]["alarms"] = [base | boards.gave(20, 20.0, early=10, late=10) | line for line in alarms]
    return Suite(read_board(board), "")


CALM, BUSY, WORN = ({"scenario": name} for name in ("calm-v0", "busy-v0", "worn-v0"))
OFTEN = boards.gave(6500, 20.0, first=3250)
NONE = boards.gave(0, 20.0)
NEARLY = boards.gave(54, 20.0, dispersion=1.0)  # limits of 95 % end at 0.493 h, of 98.3 % at 0.52


@pytest.mark.thin(3)
@pytest.mark.parametrize(("alarms", "said"), [
    ([CALM, BUSY | boards.gave(25, 20.0)], []),
    ([CALM, WORN | OFTEN], ["alarm drift: set to one false alarm in 1 h, it raises one in 11 s on worn-v0"]),
    ([BUSY | OFTEN, WORN | boards.gave(10_000, 20.0)],
     ["alarm drift: set to one false alarm in 1 h, it raises one in 7.2 s on worn-v0, and on 1 more surely twice as often"]),
    ([BUSY | NONE], ["alarm drift: set to one false alarm in 1 h, it raises none in 20 h on busy-v0"]),
    ([BUSY | NONE | {"rarer": True}], []), ([WORN | NONE], []), ([WORN | OFTEN | {"hours": 10.0}], []), ([WORN | OFTEN | {"defence": "cusum_kf"}], []),
    ([BUSY | boards.gave(0, 20.0, dispersion=10.0)], []),
    ([WORN | NEARLY], ["alarm drift: set to one false alarm in 1 h, it raises one in 22.2 min on worn-v0"]), ([CALM, BUSY, WORN | NEARLY], []),
    ([CALM | boards.gave(20, 20.0, early=20)], ["alarm drift: its false alarms on calm-v0 come in the first half of the drive, in 20 of 20 drives with more in one half"]),
    ([CALM | boards.gave(25, 20.0, early=1, late=24)], ["alarm drift: its false alarms on calm-v0 come in the second half of the drive, in 24 of 25 drives with more in one half"]),
    ([CALM | boards.gave(20, 20.0, early=13)], ["alarm drift: its false alarms on calm-v0 come in the first half of the drive, in 13 of 13 drives with more in one half"]),
    ([CALM | boards.gave(20, 20.0, early=13), BUSY], []), ([CALM | boards.gave(20, 20.0, early=12)], []), ([CALM | boards.gave(20, 20.0, early=18, late=2)], []),
    ([WORN | boards.gave(20, 20.0, early=20)], []),
])  # fmt: skip
def test_the_flag_says_what_surely_differs(alarms, said):
    """Twice as often as wanted or as rarely, or in one half alone, at the middle of three mean times, for all scenarios of the entry together."""
    assert drifts_of(_suite(alarms), "kf") == said


@pytest.mark.thin(3)
@pytest.mark.parametrize(("change", "field"), [
    ({"defence": "nobody"}, "defence"), ({"scenario": "away-v0"}, "scenario"), ({"onsets": 0}, "mean"), ({"mean": None}, "mean"), ({"low": -1.0}, "low"),
    ({"high": None}, "high"), ({"high": 9.0}, "high"), ({"first": 21}, "first"), ({"early": 11}, "early"), ({"running": 0.0}, "running"),
    ({"dispersion": -1.0}, "dispersion"), ({"dispersion": 4.0}, "low"),
])  # fmt: skip
def test_lines_that_do_not_agree_are_refused(change, field):
    with pytest.raises(InputError, match=rf"detection\.alarms\[1\]\.{field}"):
        _suite([CALM, BUSY | change])


def test_a_line_is_there_once():
    with pytest.raises(InputError, match=r"detection\.alarms\[1\].*kf calm-v0 1.0.*once"):
        _suite([CALM, CALM | OFTEN])


def test_tables_have_each_scenario_and_mean_time():
    suite = _suite([CALM | {"first": 10}, CALM | {"hours": 10.0} | boards.gave(20, 180.0), WORN | OFTEN | {"rarer": True}, BUSY | NONE])
    table = table_of(suite, "kf")
    assert table["hours"] == ["1 h", "10 h"] and [(row["scenario"], row["told"], row["first"]) for row in table["rows"]] == [
        ("calm-v0", True, "50%"), ("worn-v0", False, "50%"), ("busy-v0", True, ""),
    ]  # fmt: skip
    assert [cell["text"] for row in table["rows"] for cell in row["cells"]] == ["1 h", "9 h", "11 s", "\N{EN DASH}", "none in 20 h", "\N{EN DASH}"]
    assert [cell["rarer"] for row in table["rows"] for cell in row["cells"]] == [False, False, True, False, False, False]
    assert table["rows"][2]["cells"][0]["span"] == "5.42 h or more" and table_of(suite, "cusum_kf") is None
    whole = together_of(suite)
    assert [head["name"] for head in whole["heads"]] == ["calm-v0", "busy-v0", "worn-v0"] and len(whole["rows"]) == 1
    assert [cell["text"] for cell in whole["rows"][0]["cells"]] == ["1 h", "none in 20 h", "11 s"]


@pytest.mark.parametrize(("hours", "text"), [(1.3, "1.3 h"), (1.0, "1 h"), (0.1, "6 min"), (0.07, "4.2 min"), (0.003, "11 s"), (0.0005, "1.8 s"), (5760.0, "5760 h")])
def test_times_have_the_unit_that_fits(hours, text):
    assert time_text(hours) == text
