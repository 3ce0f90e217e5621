"""Runs that are counted, in a memory that their number does not add to."""

import dataclasses
import tracemalloc

import pytest

from tailgate.core.scenario import load_suite
from tailgate.trust.cells import check_cell
from tailgate.trust.run import jobs_of
from tailgate.trust.statistics import Sequential

CRASH = "G (gap > 0 and rear_gap > 0)"
NEAR = "fdi:trigger=near,threshold=30,value=-4"
RUNS = 150  # of two batches and a part


def _job(formulas, *, scenario="gusty-stop-and-go-v0", defence="chi2_kf", attack=NEAR, runs=RUNS, **options):
    suite = dataclasses.replace(load_suite("quick-v0"), scenarios=(scenario,), defences=(defence,), attacks=(attack,))
    (job,) = jobs_of(suite, runs=runs, formulas=formulas, **{"batch": 64} | options)
    return job


def test_a_rule_stops_within_a_batch():
    """The runs after it are not counted."""
    row = check_cell(_job([CRASH], runs=2000, rule=Sequential(0.2)))
    assert 0 < row["n"] < 2000 and row["properties"][0]["n"] == row["n"]
    assert sum(bin(byte).count("1") for byte in bytes.fromhex(row["conjunctions"]["trust"]["runs"])) == row["properties"][0]["k"]


@pytest.mark.long
def test_memory_does_not_grow_with_the_number_of_runs():
    """Three times as many runs: a few bytes for each, whether it holds, and no trace."""
    peaks = []
    for runs in (192, 576):
        job = _job([CRASH], attack="none", scenario="braking-v0", runs=runs, batch=64)
        check_cell(_job([CRASH], attack="none", scenario="braking-v0", runs=64, batch=64))  # compiled and loaded
        tracemalloc.start()
        assert check_cell(job)["n"] == runs
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 200_000, peaks  # bytes; the trace of a run takes 200,000
