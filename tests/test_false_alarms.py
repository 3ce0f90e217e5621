"""False alarms at the thresholds of a detection board, scenario by scenario."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from tailgate.clean import Bench
from tailgate.evaluation import Cell, run_cell
from tailgate.leaderboard.board_format import read_board
from tailgate.leaderboard.site_alarms import drifts_of, table_of, time_text, together_of
from tailgate.leaderboard.site_suite import Suite
from tailgate.scenario import load_suite
from tailgate.scoring.false_alarms import false_alarms, sign_test

spec = importlib.util.spec_from_file_location("boards", Path(__file__).with_name("boards.py"))
boards = importlib.util.module_from_spec(spec)
spec.loader.exec_module(boards)
ROAD = dataclasses.replace(load_suite("car-following-v0"), scenarios=("gusty-stop-and-go-v0", "car-following-noisy-v0"), robustness=("car-following-noisy-v0",))


def _line(defence, scenario, threshold, hours=0.02, **more):
    return {"defence": defence, "scenario": scenario, "attack": "fdi", "hours": hours, "threshold": threshold} | more


def test_they_are_those_of_rows_without_an_attack():
    """Another way: cells with the defence at this threshold, whose metric counts onsets. Of all scenarios of the plant, once for all attacks."""
    told = _line("chi2_kf", "gusty-stop-and-go-v0", 12.0)
    lines = false_alarms(ROAD, [told, told | {"attack": "dos_jam"}], 20, 100_000)
    assert [(line["scenario"], line["hours"], line["threshold"]) for line in lines] == [(name, 0.02, 12.0) for name in ROAD.scenarios]
    for line in lines:
        bench = Bench.of("chi2_kf", [line["scenario"]], 1, None)
        place = bench.places[0]
        count = -(-int(20 * 0.02 * 3600 / place.brief().model.dt) // place.horizon)
        rows = run_cell(Cell(ROAD.name, line["scenario"], None, "chi2_kf", "none", count), bench.at(12.0))
        assert line["onsets"] == sum(row["alarm_onsets"] for row in rows) > 0
        assert line["running"] == pytest.approx(count * place.horizon * place.brief().model.dt / 3600.0, rel=1e-12)
        assert line["mean"] == pytest.approx(line["running"] / line["onsets"]) and line["low"] < line["mean"] < line["high"]
    near, noisy = lines
    assert noisy["onsets"] > 10 * near["onsets"] and 0 < near["first"] < near["onsets"]


def test_a_constant_gain_alarms_while_it_settles():
    """Steady filters of a network that starts from a guess; the time-varying one has no such half."""
    suite = dataclasses.replace(load_suite("network-v0"), scenarios=("network-restless-v0",))
    steady, varying = false_alarms(suite, [_line(name, "network-restless-v0", level, 0.05) for name, level in (("dkf", 31.0), ("kf", 24.0))], 20, 6_000)
    assert steady["onsets"] > 10 and steady["first"] >= 0.9 * steady["onsets"] and steady["p"] < 0.001
    assert varying["onsets"] > 3 and varying["first"] < 0.8 * varying["onsets"]


def test_both_halves_are_compared_episode_by_episode():
    x, y = np.array([3, 1, 1, 1, 1, 0]), np.array([0, 0, 0, 0, 0, 0])
    assert sign_test(x, y) == pytest.approx(2.0 * 0.5**5) == sign_test(y, x)
    assert sign_test(x, x) == 1.0 and sign_test(np.array([9, 0]), np.array([0, 1])) == 1.0


def _suite(alarms):
    board = boards.make_board(scenarios=["calm-v0", "busy-v0", "worn-v0"])
    board["suite"]["scenarios"][2]["robustness"] = True
    base = {"defence": "kf", "hours": 1.0, "threshold": 9.0, "onsets": 20, "running": 20.0, "mean": 1.0, "low": 0.6, "high": 1.6, "first": 10, "p": 1.0}
    board["detection"]["alarms"] = [base | line for line in alarms]
    return Suite(read_board(board), "")


OFTEN = {"scenario": "worn-v0", "onsets": 6500, "mean": 20.0 / 6500, "low": 0.003, "high": 0.0031, "first": 3250}
NONE = {"scenario": "busy-v0", "onsets": 0, "mean": None, "low": 5.4, "high": None, "first": 0}


@pytest.mark.parametrize(("alarms", "said"), [
    ([{"scenario": "calm-v0"}, {"scenario": "busy-v0", "mean": 0.8, "high": 1.2}], []),
    ([{"scenario": "calm-v0"}, OFTEN], ["alarm drift: set to one false alarm in 1 h, it raises one in 11 s on worn-v0"]),
    ([OFTEN | {"scenario": "busy-v0"}, OFTEN | {"mean": 0.002}],
     ["alarm drift: set to one false alarm in 1 h, it raises one in 7.2 s on worn-v0, and on 1 more surely twice as often"]),
    ([NONE], ["alarm drift: set to one false alarm in 1 h, it raises none in 20 h on busy-v0"]),
    ([NONE | {"rarer": True}], []), ([NONE | {"scenario": "worn-v0"}], []), ([OFTEN | {"hours": 10.0}], []), ([OFTEN | {"defence": "cusum_kf"}], []),
    ([{"scenario": "calm-v0", "first": 20, "p": 1e-6}], ["alarm drift: 100% of its false alarms on calm-v0 come in the first half of the drive"]),
    ([{"scenario": "calm-v0", "first": 1, "p": 1e-6}], ["alarm drift: 95% of its false alarms on calm-v0 come in the second half of the drive"]),
    ([{"scenario": "calm-v0", "first": 20, "p": 0.04}, {"scenario": "busy-v0"}], []),
    ([{"scenario": "calm-v0", "first": 15, "p": 1e-6}], []),
])  # fmt: skip
def test_the_flag_says_what_surely_differs(alarms, said):
    """Twice as often as wanted or as rarely, or in one half alone, at the middle of three mean times."""
    assert drifts_of(_suite(alarms), "kf") == said


def test_tables_have_each_scenario_and_mean_time():
    suite = _suite([{"scenario": "calm-v0"}, {"scenario": "calm-v0", "hours": 10.0, "mean": 9.0, "low": 4.0, "high": 30.0}, OFTEN, NONE])
    table = table_of(suite, "kf")
    assert table["hours"] == ["1 h", "10 h"] and [(row["scenario"], row["told"], row["first"]) for row in table["rows"]] == [
        ("calm-v0", True, "50%"), ("worn-v0", False, "50%"), ("busy-v0", True, ""),
    ]  # fmt: skip
    assert [cell["text"] for row in table["rows"] for cell in row["cells"]] == ["1 h", "9 h", "11 s", "\N{EN DASH}", "none in 20 h", "\N{EN DASH}"]
    assert table["rows"][2]["cells"][0]["span"] == "5.4 h or more" and table_of(suite, "cusum_kf") is None
    whole = together_of(suite)
    assert [head["name"] for head in whole["heads"]] == ["calm-v0", "busy-v0", "worn-v0"] and len(whole["rows"]) == 1
    assert [cell["text"] for cell in whole["rows"][0]["cells"]] == ["1 h", "none in 20 h", "11 s"]


@pytest.mark.parametrize(("hours", "text"), [(1.3, "1.3 h"), (1.0, "1 h"), (0.1, "6 min"), (0.07, "4.2 min"), (0.003, "11 s"), (0.0005, "1.8 s"), (5760.0, "5760 h")])
def test_times_have_the_unit_that_fits(hours, text):
    assert time_text(hours) == text
