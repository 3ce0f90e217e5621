"""Model checking of the closed loop: properties against metrics, bounds against their definition, resumption, replay, the command line."""

import copy
import dataclasses
import json
import re
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tailgate import cli
from tailgate.base.errors import InputError
from tailgate.board.files import read_board
from tailgate.board.run import board_of
from tailgate.board.words import at_least
from tailgate.cli.board import print_board
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_scenario, load_suite
from tailgate.evaluation.cells import evaluate, run_cell
from tailgate.evaluation.paired import mcnemar
from tailgate.evaluation.rounds import seeds_of
from tailgate.play.metrics import measure
from tailgate.play.trace import rollout
from tailgate.trust import run as trust_run
from tailgate.trust.cells import Job, check_cell, outcome, runs_of, single
from tailgate.trust.false_alarms import false_alarms
from tailgate.trust.properties import Demands, built_in, own
from tailgate.trust.run import check, jobs_of, with_trust
from tailgate.trust.signals import SIGNALS, SafeDistance
from tailgate.trust.statistics import Sequential, Sprt, lower

RAMP = "fdi_ramp:trigger=near,threshold=40,rate=-0.5"
JAM = "dos_jam:trigger=near,threshold=40"
SHORT = """
about: 12 s behind a leader that brakes to a stop.
plant: {name: car_following, gap: 50.0, lead_speed: 20.0, position: 0.0, speed: 20.0, accel: 0.0, process_var: [1.0e-3, 4.0e-3, 2.5e-2]}
sensor: {name: odometry, noise_var: [1.0, 1.0]}
controller: {name: acc}
manoeuvre: {name: braking, onset: [1.0, 3.0]}
horizon: 120
threat_model: {kinds: [dos_jam, fdi], fdi_bound: 50.0, jam_range: [-108.0, 3000.0], onset: 10, end: 100, budget: 12}
"""
HORIZON = 120
N = 24


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("scenario") / "short.yaml"
    path.write_text(SHORT, encoding="utf-8")
    return str(path)


def _suite(short: str, **changes: Any) -> Suite:
    return dataclasses.replace(
        Suite(name="small", scenarios=(short,), doses=(12,), defences=("kf", "chi2_kf"), attacks=("none", JAM, RAMP), seeds=N), **changes
    )


Found = tuple[dict[str, Any], Path]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory, short: str) -> Found:
    folder = tmp_path_factory.mktemp("trust")
    return check(_suite(short), folder=folder), folder


def _rows(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "cells.jsonl").read_text(encoding="utf-8").splitlines()]


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory, short: str) -> Path:
    """The rows of the suite's cells, as a board has them."""
    file = tmp_path_factory.mktemp("rows") / "rows.jsonl"
    evaluate(_suite(short), out=file)
    return file


def test_a_run_counts_as_the_metrics_of_its_episode_say(found: Found, short: str, evaluated: Path) -> None:
    """A property that is off by a step, or of another car, would count other runs than the board does."""
    every = [json.loads(line) for line in evaluated.read_text(encoding="utf-8").splitlines()]
    for job, row in zip(jobs_of(_suite(short), runs=N), _rows(found[1]), strict=True):
        episodes = [e for e in every if (e["defence"], e["attack"]) == (job.cell.defence, job.cell.attack)]
        by_name = {p["name"]: p for p in row["properties"]}
        assert row["n"] == N and by_name["no_collision"]["k"] == sum(e["crashed"] == 0.0 for e in episodes)
        attacked = [e for e in episodes if e["missed_deadline"] is not None]
        assert by_name["detects"]["asked"] == len(attacked)
        assert by_name["detects"]["answered"] == sum(e["missed_deadline"] == 0.0 for e in attacked)
        safe = runs_of(row, "safety")
        assert not any(ok and e["crashed"] for ok, e in zip(safe, episodes, strict=True)) and safe.sum() == row["conjunctions"]["safety"]["k"]


def test_braking_is_asked_where_and_when_the_documentation_says(short: str) -> None:
    """The antecedent, the deadline or the threshold would not be those that are written down."""
    place, safe = load_scenario(short), SafeDistance()
    trace = rollout(place.loop(Spec("defence", "kf").make()), Spec("attack", JAM).make(), draws.keys("report", range(N)))
    (known,) = (p for p in built_in(place) if p.name == "brakes")
    result = outcome(known, trace, safe)
    for b in range(trace.batch):
        n = int(trace.length[b])
        v, lead = trace.speed[:n, b, 0], trace.lead_speed[:n, b, 0]
        distance = np.maximum(0.6 * v + 0.5 * 2.0 * 0.36 + (v + 1.2) ** 2 / 10.0 - lead**2 / 10.0, 0.0)
        threat = (np.cumsum(trace.kind[:n, b] != 0) > 0) & (trace.gap[:n, b, 0] < distance)
        brakes = (trace.applied[:n, b, 0, 0] <= -2.0) | (v <= 0.1) | (trace.gap[:n, b, 0] >= distance)
        asked = [k for k in range(n) if threat[k] and k <= HORIZON - 1 - 6 - 5]
        assert result.asked[b] == bool(asked) and result.instants[b] == threat.sum()
        assert result.holds[b] == all(k == n - 1 or any(brakes[i : i + 6].all() for i in range(k + 1, min(k + 7, n))) for k in asked)
    assert 0 < (result.holds & result.asked).sum() < result.asked.sum()


def test_a_bound_is_the_least_of_its_cells_and_no_part_is_below_the_whole(found: Found, short: str) -> None:
    """Trust would be more than alpha allows, or more than that of one of its properties."""
    report, folder = found
    rows = _rows(folder)
    for entry in report["defences"]:
        mine = [row for row in rows if row["defence"] == entry["defence"]]
        for name in ("trust", "safety"):
            bound = entry[name]["black"]
            assert bound["cells"] == 3 and bound["lower"] == min(lower(r["conjunctions"][name]["k"], N, 0.05 / 3) for r in mine)
            assert bound["attacks"] == [JAM, RAMP] and bound["n"] == N
        assert entry["trust"]["black"]["lower"] <= entry["safety"]["black"]["lower"]
        for row in mine:  # Frechet's bounds hold of the counts themselves
            parts = [p["k"] for p in row["properties"] if p["formula"] is not None]
            assert sum(parts) - N * (len(parts) - 1) <= row["conjunctions"]["trust"]["k"] <= min(parts)
    assert report["defences"][0]["safety"]["black"]["attack"] == JAM and report["defences"][1]["safety"]["black"]["attack"] == RAMP


def test_defences_are_compared_on_the_same_seeds(found: Found, short: str) -> None:
    """A comparison would miss that most of the chance is common to both defences."""
    one = check(_suite(short, attacks=(JAM,)), runs=N)
    (duel,) = (d for d in one["comparisons"] if d["of"] == "safety")
    a, b = (next(e for e in one["defences"] if e["defence"] == duel[side])["safety"]["black"]["k"] for side in ("a", "b"))
    assert duel["only_b"] - duel["only_a"] == a - b != 0
    assert duel["p"] == pytest.approx(mcnemar(duel["only_a"], duel["only_b"]))


@pytest.mark.long
def test_rows_depend_on_nothing_but_their_seeds(found: Found, short: str) -> None:
    """Another batch would give other counts for the same seeds."""
    for job, row in list(zip(jobs_of(_suite(short), runs=N, batch=16), _rows(found[1]), strict=True))[1:3]:
        again = check_cell(job)
        for key in ("n", "properties", "conjunctions", "worst"):
            assert again[key] == row[key]


def test_an_interrupted_run_goes_on_where_it_was(found: Found, short: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Finished cells would be played again, or the result would differ from that of a run in peace."""
    played: list[str] = []
    made = {job.identity: row for job, row in zip(jobs_of(_suite(short), runs=N), _rows(found[1]), strict=True)}

    def once(job: Job) -> dict[str, Any]:
        played.append(job.identity)
        if len(played) == 4:
            raise KeyboardInterrupt
        return copy.deepcopy(made[job.identity]) if job.identity in made else check_cell(job)

    monkeypatch.setattr(trust_run, "check_cell", once)
    with pytest.raises(KeyboardInterrupt):
        check(_suite(short), folder=tmp_path)
    damaged = next((tmp_path / ".cells.jsonl.parts").glob("*.json"))
    damaged.write_bytes(damaged.read_bytes()[:40])
    check(_suite(short), folder=tmp_path)
    assert len(played) == 4 + 4 and len(set(played)) == 6
    for name in ("cells.jsonl", "trust.json"):
        ours, theirs = ((folder / name).read_text().replace(str(folder), "") for folder in (tmp_path, found[1]))
        assert ours == theirs
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cells.jsonl", "failures.jsonl", "trust.json"]
    check(_suite(short, defences=("kf",), attacks=("none",)), runs=3, formulas=["G gap > 0"], folder=tmp_path)
    assert (tmp_path / "cells.jsonl.1").is_file()


@pytest.mark.long
def test_a_defence_that_was_not_attacked_has_no_bound(short: str) -> None:
    """It would be trusted for not being attackable, or for a crash."""
    found = check(_suite(short, defences=("none", "chi2_kf"), attacks=("none", JAM, "stealth:trigger=near,threshold=40")), runs=4)
    bare, gated = found["defences"]
    assert bare["safety"]["white"] is None and "stealth" in bare["why"] and bare["safety"]["black"]["lower"] > 0.0
    assert gated["safety"]["white"]["k"] == 0 and gated["safety"]["black"]["attacks"] == [JAM]


def _each(function: Any, jobs: Any, workers: int, died: Any) -> Any:
    """Stands for processes: one that plays chi2_kf dies."""
    for i, (job,) in enumerate(jobs):
        yield i, died(i) if job.cell.defence == "chi2_kf" else function(copy.deepcopy(job))  # what crosses to another process is a copy


def test_a_process_that_dies_costs_its_own_cells(short: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A defence that kills its process would take the rows of others with it, or be trusted."""
    monkeypatch.setattr(trust_run, "each", _each)
    kf, deadly = check(_suite(short, attacks=("none",)), runs=2, workers=2)["defences"]
    assert kf["safety"]["black"]["k"] == 2 and deadly["safety"]["black"] is None and "died" in deadly["why"]


AT_RANDOM = "composed:filter=kf,detector=chi2,detector.eta=1.6,mitigation=accept_all"  # exp(-0.8): 45 % of the steps
SEEN = "fdi:start_step=20,value=-40"


def _detects(entry: dict[str, Any]) -> dict[str, Any]:
    return next(p for p in entry["properties"] if p["name"] == "detects")


@pytest.mark.long
def test_an_alarm_at_random_earns_no_bound_of_detection(short: str) -> None:
    """A class that alarms at everything would be trusted to detect: 45 % of the steps are one in any ten."""
    found = check(_suite(short, defences=("chi2_kf", AT_RANDOM, "always_alarm"), attacks=("none", SEEN)))
    good, *bad = found["defences"]
    (price,) = _detects(good)["false_alarms"]
    assert good["why"] == "" and _detects(good)["share"]["k"] == N and price["alarms"] == 0 and price["hours"] is None and not price["reason"]
    assert good["trust"]["black"] is not None
    for entry, seconds in zip(bad, (0.1 / 0.45, 1.0), strict=True):  # one that stays on counts every ten steps
        (price,) = _detects(entry)["false_alarms"]
        assert 0.9 * seconds < price["hours"] * 3600.0 < 2.5 * seconds
        assert _detects(entry)["share"] is None and set(entry["trust"].values()) == {None}
        assert entry["why"] == _detects(entry)["reason"] == price["reason"] and "detects does not count" in entry["why"] and "limit 360 s" in entry["why"]
        assert entry["safety"]["black"]["lower"] > 0.0, "what is safe does not look at alarms"
    shown = [p for cell in found["cells"] if cell["defence"] == AT_RANDOM for p in cell["properties"] if p["name"] == "detects"]
    assert [p["share"] and p["share"]["value"] for p in shown] == [None, 1.0] and {p["reason"] for p in shown} == {bad[0]["why"]}, "the cells have what was played"
    assert not any(duel["of"] == "trust" and AT_RANDOM in (duel["a"], duel["b"]) for duel in found["comparisons"])


@pytest.mark.long
def test_another_limit_of_false_alarms_can_be_stated(short: str) -> None:
    """A user's own limit would be ignored, or a board would take it for the default."""
    found = check(_suite(short, defences=(AT_RANDOM,), attacks=("none", SEEN)), runs=6, asked=Demands(false_alarms=1e-5))
    assert found["demands"]["false_alarms"] == 1e-5 and _detects(found["defences"][0])["share"]["k"] == 6 and found["defences"][0]["trust"]["black"]


@pytest.mark.long
def test_who_names_no_clean_run_is_judged_by_one_all_the_same(short: str) -> None:
    """A random alarm would count where nobody looked at it without an attack."""
    found = check(_suite(short, defences=("chi2_kf", AT_RANDOM), attacks=(SEEN,)), runs=6)
    good, bad = found["defences"]
    assert _detects(bad)["share"] is None and "without an attack" in bad["why"] and _detects(good)["share"]["k"] == 6
    assert good["trust"]["black"]["cells"] == 1 and [c["attack"] for c in found["cells"]] == [SEEN] * 2, "and is no part of the bound"


@pytest.mark.long
def test_a_detector_is_judged_by_the_vehicle_that_it_knows(short: str, tmp_path: Path) -> None:
    """Every detector alarms where the noise is larger than it knows; where nothing else was played it is judged there."""
    noisy = tmp_path / "noisy.yaml"
    noisy.write_text(SHORT + "truth: {sensor: {noise_var: [9.0, 9.0]}}\n", encoding="utf-8")
    suite = _suite(short, scenarios=(short, str(noisy)), robustness=(str(noisy),), defences=("chi2_kf", AT_RANDOM), attacks=("none", SEEN))
    good, bad = check(suite, runs=8)["defences"]
    known, other = _detects(good)["false_alarms"]
    assert known["hours"] is None and other["hours"] < 0.1 and good["why"] == "" and _detects(good)["share"] and bad["why"]
    (alone,) = check(dataclasses.replace(suite, scenarios=(str(noisy),), defences=("chi2_kf",)), runs=8)["defences"]
    assert "does not count" in alone["why"] and _detects(alone)["share"] is None


def test_an_alarm_that_stays_on_counts_again() -> None:
    """It would be a single false alarm, and find everything."""
    alarm = np.zeros((40, 3, 2), bool)
    alarm[5:30, 0, 1] = alarm[[3, 4, 6, 20], 1, 0] = alarm[6, 1, 1] = True
    alarm[:, 2, 0] = True
    live = np.arange(40)[:, None] < np.array([40, 40, 15])
    assert false_alarms(SimpleNamespace(alarm=alarm, live=live, batch=3), 10).tolist() == [3, 3, 2]


@pytest.mark.long
def test_rules_that_stop_early_give_no_bound(short: str) -> None:
    """A figure of an exploration would be published as one of a fixed number of runs."""
    suite = _suite(short, defences=("kf",), attacks=("none",))
    narrow = check(suite, runs=500, formulas=["G gap > 0"], rule=Sequential(0.1))
    assert narrow["cells"][0]["n"] == 36 and narrow["defences"][0]["trust"]["black"] is None
    settled = check(suite, runs=500, formulas=["G gap < 0"], rule=Sprt(0.85, 0.9))["cells"][0]
    assert settled["verdict"] is False and settled["n"] < 10
    assert check(suite, runs=3, formulas=["G gap > 0"], rule=Sequential(0.1))["cells"][0]["n"] == 3


def test_the_board_takes_the_bounds_of_its_own_suite_alone(found: Found, short: str) -> None:
    """A column would show bounds of other scenarios, other formulas, or of runs that were stopped."""
    report, _ = found
    board = {"suite": {"name": "small", "version": report["version"]}, "entries": [{"defence": "chi2_kf", "card": {}}, {"defence": "other", "card": {}}]}
    filled, mine = with_trust(board, report), report["defences"][1]
    assert filled["entries"][0]["trust"] == {"all": mine["trust"], "safety": mine["safety"], "why": ""} and filled["entries"][1]["trust"] is None
    assert {p["name"]: p["safety"] for p in filled["trust"]["properties"]} == {"no_collision": True, "brakes": True, "detects": False}
    assert filled["trust"]["alpha"] == 0.05 and [a["attack"] for a in filled["trust"]["attacks"]] == ["none", JAM, RAMP]
    json.dumps(filled, allow_nan=False)
    for change in ({"suite": {"name": "custom"}}, {"version": "0"}, {"formulas": ["G gap > 0"]}, {"rule": {"name": "sprt"}}, {"format": "x"}):
        with pytest.raises(InputError, match="trust: "):
            with_trust(board, report | change)
    theirs = board | {"entries": [{"defence": "chi2_kf", "card": None}]}
    assert with_trust(theirs, report)["entries"][0]["trust"] is None, "a class that is not built in sees whole batches here"
    whole = dataclasses.replace(_suite(short), seeds=report["runs"])
    alone = board | {"suite": board["suite"] | {"alpha": 0.05}}
    assert with_trust(alone, report, suite=whole)["trust"]
    for change in ({"purpose": "tune"}, {"alpha": 0.9}, {"demands": {}}, {"unsafe": {}}, {"doses": [5]}, {"attacks": []}, {"scenarios": []}, {"runs": 1}):
        with pytest.raises(InputError, match="trust: "):
            with_trust(alone, report | change, suite=whole)
    for broken in (3, {"format": report["format"]}, report | {"defences": [3]}, report | {"cells": None}):
        with pytest.raises(InputError, match=r"x\.json"):
            with_trust(board, broken, "trust x.json")


def test_a_board_takes_up_the_report_that_lies_beside_its_rows(found: Found, short: str, evaluated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The bounds would be lost between the commands, a table would show an empty column, or a file that was cut would end in a traceback."""
    suite = _suite(short)
    shutil.copy(evaluated, tmp_path / "rows.jsonl")
    bare = board_of(suite, tmp_path)
    print_board(bare)
    words = " ".join(capsys.readouterr().out.split())
    assert "trust" not in words and "public seeds: for development" in words and "trust" not in bare
    shutil.copytree(found[1], tmp_path / "trust")
    board = board_of(suite, tmp_path)
    assert board == with_trust(bare, found[0]) == json.loads((tmp_path / "board.json").read_text()) and read_board(board).trust is not None
    board["suite"]["beacon"] = "[b]1"
    print_board(board)
    words = " ".join(capsys.readouterr().out.split())
    assert "trust" in words and "seeds of the beacon [b]1" in words and at_least(found[0]["defences"][0]["safety"]["black"]["lower"], 1) in words
    for text in ("{", "[]", '{"a": NaN}', json.dumps(found[0] | {"version": "0"})):
        (tmp_path / "trust" / "trust.json").write_text(text)
        with pytest.raises(InputError, match=r"trust\.json"):
            board_of(suite, tmp_path)


def test_the_worst_failing_run_is_replayed_by_the_command_that_is_printed(tmp_path: Path, short: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The page would show another episode than the one that failed."""
    monkeypatch.chdir(tmp_path)
    part = ["--scenario", short, "--dose", "12", "--defence", "chi2_kf", "--attack", RAMP, "--runs", "8", "--out", "out"]
    assert cli.main(["trust", *part]) == 0
    printed = capsys.readouterr().out
    words, command = next(line for line in printed.splitlines() if "tailgate replay" in line).split(": tailgate ")
    assert cli.main([*shlex.split(command), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["verdict"] == "same" and Path(shown["page"]).is_file() and f"seed {shown['seed']}" in words
    assert "fails no_collision" in words and shown["metrics"]["crashed"] == 1.0
    assert shown["failed"] == {"property": "no_collision", "about": "no collision, in front or behind, until the horizon", "formula": "G ((gap > 0) and (rear_gap > 0))"}
    page = Path(shown["page"]).read_text(encoding="utf-8")
    assert "The row says that this run fails no_collision" in page and "G ((gap &gt; 0) and (rear_gap &gt; 0))" in page
    assert cli.main(shlex.split(command)) == 0 and "failed  no_collision: no collision" in " ".join(capsys.readouterr().out.split("\n"))
    assert cli.main(["trust", *part, "--json"]) == 0  # resumes
    assert json.loads(capsys.readouterr().out)["defences"][0]["worst"]["seed"] == shown["seed"]


def test_a_formula_of_ones_own_is_decided(short: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The thesis's query, braking within 600 ms of a gap below 20 m, fails a healthy car that drives slowly; the one here does not."""
    literal, ours = "G[0,11.3] (gap < 20 -> F[0,0.6] applied <= -2)", "G[0,11.3] (margin < 0 -> F[0,0.6] applied <= -2)"
    part = ["trust", "--scenario", short, "--defence", "kf", "--attack", "none", "--runs", "12"]
    assert cli.main([*part, "--property", literal, "--property", ours, "--json"]) == 0
    (entry,) = json.loads(capsys.readouterr().out)["defences"]
    assert [p["share"]["k"] for p in entry["properties"]] == [0, 12]
    assert cli.main([*part, "--property", "G gap > 0", "--width", "0.9"]) == 0
    assert "exploring" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--property", "G[0,60] gap"], "one of >"), (["--property", "G gapp > 0"], "did you mean 'gap'"), (["--property", "G[61,62] gap > 0"], "horizon"),
        (["--unsafe", "brakes=5"], "did you mean 'brake'"), (["--demand", "deadline"], "key=value"), (["--alpha", "0"], "alpha"), (["--runs", "0"], "runs"),
        (["--precision", "2"], "precision"), (["--test", "0.04"], "low"), (["--dose", "x"], "dose"), (["--defence", "kff"], "kff"), (["--workers", "0"], "workers"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_before_anything_is_played(arguments: list[str], words: str, short: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A mistake would cost minutes before it shows, or end in a traceback."""
    assert cli.main(["trust", "--scenario", short, "--attack", "none", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


def test_the_formulas_and_signals_of_the_documentation_are_those_that_are_read(short: str) -> None:
    """Somebody who copies a line of it would get an error, or miss a signal."""
    text = (Path(__file__).parents[1] / "docs" / "trust.md").read_text(encoding="utf-8").split("## A formula of one's own")[1].split("\n## ")[0]
    lines = [re.split(r"\s{3,}", line.strip())[0] for line in text.splitlines() if line.startswith("    ")]
    assert len(lines) == 5 and len(own(dataclasses.replace(load_scenario(short), horizon=600), lines)) == 5
    named = {name for line in text.splitlines() if line.startswith("| `") for name in re.findall(r"`(\w+)`", line.split("|")[1])}
    assert named == set(SIGNALS)


def test_one_episode_is_that_of_its_cell(short: str) -> None:
    """The run that is kept for replay would be another one than was checked."""
    (job,) = jobs_of(_suite(short, defences=("chi2_kf",), attacks=(RAMP,)), runs=8)
    (row,) = run_cell(single(job, 5))
    values = measure(rollout(load_scenario(short).loop(Spec("defence", "chi2_kf").make()), Spec("attack", RAMP).make(), draws.keys("report", range(8))))
    assert row["seed"] == 5 and row["min_gap"] == values["min_gap"][5]


def test_the_round_of_a_beacon_is_checked_on_its_own_seeds() -> None:
    """Every seed of the report is one of the round's, and a report of another round is refused by a board."""
    suite = dataclasses.replace(load_suite("quick-v0"), scenarios=("gusty-stop-and-go-v0",), defences=("kf",), attacks=("none", "dos_jam:trigger=near,threshold=40"))
    found = check(suite, runs=4, beacon="0123456789abcdef")
    seeds = seeds_of("0123456789abcdef", "quick-v0", "report", 4)
    assert found["beacon"] == "0123456789abcdef" and found["defences"][0]["worst"]["seed"] in seeds
    assert {p["seed"] for cell in found["cells"] for p in cell["properties"] if p.get("seed") is not None} <= set(seeds)
    board = {"suite": {"name": "quick-v0", "version": found["version"], "beacon": ""}, "entries": []}
    with pytest.raises(InputError, match="beacon"):
        with_trust(board, found)
    assert with_trust(board | {"suite": board["suite"] | {"beacon": "0123456789abcdef"}}, found)["trust"]["beacon"]
