"""Runs that are counted without a trace: the same outcomes, in a memory that their number does not add to."""

import dataclasses
import tracemalloc

import numpy as np
import pytest

from tailgate import draws
from tailgate.registry import Spec
from tailgate.scenario import load_scenario, load_suite
from tailgate.trace import nearest, rollout
from tailgate.trust import cells
from tailgate.trust.cells import check_cell
from tailgate.trust.formula import parse
from tailgate.trust.properties import Property, built_in, own
from tailgate.trust.run import check, jobs_of
from tailgate.trust.signals import FLAGS
from tailgate.trust.statistics import Sequential

CRASH = "G (gap > 0 and rear_gap > 0)"
NEAR = "fdi:trigger=near,threshold=30,value=-4"
RUNS = 150  # of two batches and a part


def _job(formulas, *, scenario="gusty-stop-and-go-v0", defence="chi2_kf", attack=NEAR, runs=RUNS, **options):
    suite = dataclasses.replace(load_suite("quick-v0"), scenarios=(scenario,), defences=(defence,), attacks=(attack,))
    (job,) = jobs_of(suite, runs=runs, formulas=formulas, **{"batch": 64} | options)
    return job


def _same_row(job, monkeypatch):
    """The row, counted without a trace, after it was found to be the one from traces."""
    counted = check_cell(job)
    with monkeypatch.context() as patch:
        patch.setattr(cells, "nearest", lambda *_: None)
        traced = check_cell(job)
    assert counted == traced and counted["status"] == "ok"
    return counted


@pytest.mark.parametrize(("scenario", "defence", "attack"), [
    ("gusty-stop-and-go-v0", "chi2_kf", NEAR), ("gusty-stop-and-go-v0", "chi2_kf", "stealth:trigger=near,threshold=40"),
    ("stop-and-go-v0", "safe_state_brake", NEAR), ("stop-and-go-v0", "imm", "none"),
])  # fmt: skip
def test_what_is_counted_is_what_the_traces_say(scenario, defence, attack, monkeypatch):
    """To the last bit of how near the worst run came, and its seed."""
    row = _same_row(_job([CRASH, "G gap > 2", "G (2 * gap >= 1 and rear_gap@0 > 0.5)"], scenario=scenario, defence=defence, attack=attack), monkeypatch)
    assert row["n"] == RUNS
    built = check_cell(_job([], scenario=scenario, defence=defence, attack=attack))["properties"][0]
    assert [row["properties"][0][key] for key in ("k", "n", "least", "seed")] == [built[key] for key in ("k", "n", "least", "seed")]


def test_a_loop_without_lanes_is_counted_from_its_traces():
    """Readings that are lost or late, and an attack that decides step by step."""
    attack, keys = Spec("attack", "none").make(), draws.keys("report", [0])
    assert nearest(load_scenario("car-following-lossy-v0").loop(Spec("defence", "kf").make()), attack, keys) is None
    steps = Spec("attack", "thesis_times").make()
    assert nearest(load_scenario("stop-and-go-v0").loop(Spec("defence", "kf").make()), steps, keys) is None
    row = check_cell(_job([CRASH], scenario="car-following-lossy-v0", defence="kf", attack="none", runs=3))
    assert row["status"] == "ok" and row["properties"][0]["n"] == 3


def test_a_rule_stops_at_the_same_run(monkeypatch):
    """The runs after it are not counted."""
    row = _same_row(_job([CRASH], runs=2000, rule=Sequential(0.2)), monkeypatch)
    assert 0 < row["n"] < 2000 and row["properties"][0]["n"] == row["n"]
    assert sum(bin(byte).count("1") for byte in bytes.fromhex(row["conjunctions"]["trust"]["runs"])) == row["properties"][0]["k"]


def test_only_lower_bounds_on_gaps_are_decided_by_the_smallest():
    """And so is the built-in property, which the formula of the benchmark says in words."""
    place = load_scenario("stop-and-go-v0")
    by_gaps = {p.name: p.by_gaps for p in own(place, [
        CRASH, "G gap@0 >= 3", "G gap < 60", "G 2 * gap + rear_gap > 9", "G[0,20] gap > 1", "F gap > 1", "G (gap > 1 or rear_gap > 1)",
        "G (gap > 1 and speed > 0)", "gap > 1",
    ])}  # fmt: skip
    assert list(by_gaps.values()) == [True, True] + [False] * 7
    first = built_in(place)[0]
    assert first.by_gaps and parse(CRASH, FLAGS) == first.formula
    assert not Property("x", "x", first.formula, trigger=first.formula).by_gaps and not any(p.by_gaps for p in built_in(place)[1:])


def test_gaps_after_a_collision_do_not_count():
    """An episode is over then, although its block goes on."""
    place = load_scenario("gusty-stop-and-go-v0")
    loop, attack, keys = place.loop(Spec("defence", "chi2_kf").make()), Spec("attack", NEAR).make(), draws.keys("report", range(70))
    length, least = nearest(loop, attack, keys)
    trace = rollout(loop, attack, keys)
    assert np.array_equal(length, trace.length) and (length < loop.horizon).any() and (length == loop.horizon).any()
    for name in ("gap", "rear_gap"):
        assert np.array_equal(least[name], np.where(trace.live, trace.signals[name][..., 0], np.inf).min(axis=0))
    longer = rollout(loop, attack, keys, terminate=False)
    assert (longer.gap[..., 0].min(axis=0) < least["gap"]).any()


def test_memory_does_not_grow_with_the_number_of_runs():
    """Four times as many runs: a few bytes for each, whether it holds, and nothing else."""
    peaks = []
    for runs in (10_000, 40_000):
        job = _job([CRASH], attack="none", scenario="braking-v0", runs=runs, batch=500)
        check_cell(_job([CRASH], attack="none", scenario="braking-v0", runs=500, batch=500))  # compiled and loaded
        tracemalloc.start()
        assert check_cell(job)["n"] == runs
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 5 * 30_000, peaks


def test_the_report_of_counted_runs_has_the_bounds_of_traced_ones(monkeypatch):
    """All the way through `check`."""
    suite = dataclasses.replace(load_suite("quick-v0"), scenarios=("gusty-stop-and-go-v0",), defences=("kf", "safe_state_brake"), attacks=("none", NEAR))
    counted = check(suite, runs=40, formulas=[CRASH])
    monkeypatch.setattr(cells, "nearest", lambda *_: None)
    assert check(suite, runs=40, formulas=[CRASH]) == counted
