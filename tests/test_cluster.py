"""Jobs on a Ray cluster of two processes on this machine: the same results as of local workers, lost ones are played again."""

import contextlib
import json
import os
import sys
from pathlib import Path

import pytest

from tailgate import cli
from tailgate.base import cluster, pool, sources
from tailgate.base.errors import InputError
from tailgate.base.pool import each


@pytest.fixture(scope="module")
def on_ray():
    pytest.importorskip("ray")
    with cluster.on_ray(workers=2):
        yield


def squared(number):
    if number < 0:
        raise InputError("number", number, "one that is not negative")
    return number * number


def killed_at_first(folder, times):
    """Die as often as that, as a node does that is lost; then say how often."""
    path = Path(folder) / "tries"
    tries = len(path.read_text()) if path.is_file() else 0
    path.write_text("x" * (tries + 1))
    if tries < times:
        os._exit(1)
    return tries


def test_jobs_are_answered_with_their_numbers(on_ray):
    assert sorted(each(squared, [(i,) for i in range(7)], 3)) == [(i, i * i) for i in range(7)]


def test_an_error_comes_back_as_it_was_with_the_traceback_of_the_node(on_ray):
    with pytest.raises(InputError, match="number: got -1; expected one that is not negative") as found:
        list(each(squared, [(3,), (-1,)], 2))
    assert "in squared" in str(found.value.__cause__)


@pytest.mark.long
def test_a_lost_job_is_given_again(on_ray, tmp_path):
    assert list(each(killed_at_first, [(str(tmp_path), cluster.RETRIES)], 2)) == [(0, cluster.RETRIES)]


@pytest.mark.long
def test_a_job_that_kills_every_worker_costs_itself_only(on_ray, tmp_path):
    (tmp_path / "other").mkdir()
    jobs = [(str(tmp_path), 10_000), (str(tmp_path / "other"), 0)]
    assert dict(each(killed_at_first, jobs, 2, lambda number: "died")) == {0: "died", 1: 0}


def test_another_version_on_a_node_is_refused(on_ray, monkeypatch):
    monkeypatch.setattr(sources, "own", lambda: "another")
    with pytest.raises(InputError, match="the same version of tailgate on every node"):
        list(each(squared, [(1,)], 2))


def test_an_unfinished_round_leaves_no_job(on_ray):
    with cluster.RayCrew(sys.modules["ray"], 2) as crew:
        crew.give(0, squared, 2)
        assert len(crew.busy) == 1 and crew.free
    assert not crew.busy


def test_rows_are_those_of_local_workers(on_ray, tmp_path):
    """The whole way of a suite's cells: rows arrive as they end, and are equal."""
    words = ["evaluate", "--suite", "quick-v0", "--scenario", "gusty-stop-and-go-v0", "--defence", "kf", "--defence", "chi2_kf",
             "--attack", "none", "--attack", "fdi:trigger=near,threshold=40,value=-4", "--seeds", "3", "--json"]  # fmt: skip
    assert cli.main([*words, "--out", str(tmp_path / "away.jsonl")]) == 0
    with pool.hired(pool.Crew):
        assert cli.main([*words, "--out", str(tmp_path / "here.jsonl")]) == 0
    assert (tmp_path / "away.jsonl").read_bytes() == (tmp_path / "here.jsonl").read_bytes()


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "files"),
    [
        (["trust", "--scenario", "gusty-stop-and-go-v0", "--defence", "kf", "--attack", "none", "--attack", "fdi", "--runs", "20"],
         ["cells.jsonl", "trust.json"]),
        (["leaderboard", "run", "quick-v0", "--defence", "kf", "--defence", "chi2_kf"], ["quick-v0/board.json"]),
        (["attack", "kf", "--suite", "radar-v0", "--scenario", "radar-braking-v0", "--dose", "2", "--budget", "quick", "--episodes", "20"],
         ["attacks.txt"]),
    ],
    ids=["trust", "leaderboard", "attack"],
)  # fmt: skip
def test_other_commands_write_what_local_workers_write(on_ray, tmp_path, words, files):
    for place in ("away", "here"):
        with pool.hired(pool.Crew) if place == "here" else contextlib.nullcontext():
            assert cli.main([*words, "--workers", "2", "--out", str(tmp_path / "out")]) == 0  # one path: `attack` writes it into its results
        (tmp_path / "out").rename(tmp_path / place)
    for name in files:
        assert (tmp_path / "away" / name).read_bytes() == (tmp_path / "here" / name).read_bytes(), name


@pytest.mark.long
def test_a_tuning_tries_what_a_local_one_tries(on_ray, tmp_path, capsys):
    words = ["tune", "--trials", "2", "--episodes", "20", "--json", "learner=cem", "cem.population=8", "steps=2000"]
    assert cli.main([*words, f"out={tmp_path / 'away'}"]) == 0
    away = json.loads(capsys.readouterr().out)
    with pool.hired(pool.Crew):
        assert cli.main([*words, f"out={tmp_path / 'here'}"]) == 0
    here = json.loads(capsys.readouterr().out)
    tried = [[(trial["parameters"], trial["value"]) for trial in report["trials"]] for report in (away, here)]
    assert tried[0] == tried[1] and len(tried[0]) == 2


@pytest.mark.long
def test_two_killed_workers_and_a_killed_driver_cost_no_row(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    import cluster as campaign

    found = campaign.loss(200_000, tmp_path, 0)
    assert found["equal"] and (found["workers_killed"], found["driver_killed"]) == (2, 1)


def test_without_ray_one_line_says_which_extra(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert cli.main(["evaluate", "--engine", "ray", "--seeds", "1"]) == 2
    assert capsys.readouterr().err.strip() == "tailgate: error: a cluster needs Ray: pip install 'tailgate[ray]'"


def test_an_address_asks_for_the_engine(capsys):
    assert cli.main(["evaluate", "--address", "head:6379"]) == 2
    assert "--address: got 'head:6379'; expected --engine ray" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("localhost:1", "HOST:PORT of a Ray cluster that answers"), ("nowhere.invalid:6379", "HOST:PORT of a Ray cluster that answers"),
        ("nowhere", "HOST:PORT, for example"), ("head:99999", "HOST:PORT, for example"), ("head:", "HOST:PORT, for example"),
    ],
)  # fmt: skip
def test_a_cluster_that_does_not_answer_is_one_clear_error(address, expected, capsys):
    pytest.importorskip("ray")
    assert cli.main(["evaluate", "--engine", "ray", "--address", address, "--seeds", "1"]) == 2
    error = capsys.readouterr().err
    assert f"--address: got '{address}'; expected {expected}" in error and error.count("\n") == 1
