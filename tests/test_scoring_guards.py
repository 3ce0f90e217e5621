"""What a board refuses: rows of another threat model, drafts, other policies under an admitted name, and gates that half of the episodes pass."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from tailgate.base.errors import InputError
from tailgate.board import Admitted, score
from tailgate.board.admission import admit
from tailgate.board.consistency import strays
from tailgate.board.head import lines, title
from tailgate.board.run import OWN, board_of, play
from tailgate.cli import main
from tailgate.core import registry
from tailgate.core.scenario import Suite, load_suite
from tailgate.estimators import Kalman
from tailgate.evaluation.cells import evaluate
from tailgate.evaluation.rows import packed, read_rows
from tailgate.training.adaptive import configs_of, train_against

from .scored import ROAD, board, cell, clean, entry, rate, suite

PLAN = {
    "config": "car-following", "dose": 12, "changes": ["environment.interval=20", "environment.frames=1", "teacher=null"], "seeds": 2,
    "learners": {"cem": ["steps=600", "cem={population: 4, episodes: 5, hidden: []}"]}, "knowledge": ["black"],
}  # fmt: skip
SMALL = Suite("small-v0", "", (ROAD,), (12,), ("none", "kf"), ("none", "fdi:value=-4"), 3, {"kinds": ["fdi"], "fdi_bound": 5.0})


def test_a_knowledge_that_nobody_was_met_with_has_no_figures() -> None:
    """They would be a lower one's: where no attack knows so much, where none can look into the only defence, and where another was met."""
    where, gone = suite(attacks=("none", "fdi", "white")), {"knowledge": "white", "status": "skipped", "reason": "no look"}
    rows = [*clean("a"), *cell("none", "fdi", 20), *cell("a", "fdi", 4)]
    met, blind, trained = {"knowledge": "white"}, [*cell("none", "white", **gone), *cell("a", "white", **gone)], "policies/a.json"
    for others in ([], blind, [*cell("none", "white", 20, **met), *cell("a", "white", **gone)]):
        made = board([*rows, *others], where if others else suite())
        found = entry(made, "a")
        assert {r["knowledge"] for r in found["rates"]} == {"black"} and found["critical_dose"]["white"] is None
        assert {c["knowledge"] for c in made["curves"] if c["defence"] == "a"} == {"black"} and not strays(made, where if others else suite())
    assert rate(entry(made, "none"), 20, "white")["attacks"] == 2
    own = board([*rows, *blind, *cell("a", trained, 9, learned=True, **met)], where)  # trained against it, and on no list
    assert rate(entry(own, "a"), 20, "white")["worst"]["attack"] == trained and rate(entry(own, "a"), 20)["undamaged"]["value"] == 0.8


def test_rows_of_another_threat_model_are_refused(compiled: None) -> None:
    """A weaker attacker under the suite's name: the scenario's hash tells."""
    rows = evaluate(SMALL)
    assert score(rows, SMALL, require_adaptive=False)["suite"]["rows"] == len(rows)
    weaker = evaluate(SMALL, threat={"fdi_bound": 4.0})
    assert {row["suite"] for row in weaker} == {"custom"} and {row["suite"] for row in evaluate(SMALL, threat={})} == {SMALL.name}
    weaker = [row | {"suite": SMALL.name} for row in weaker]
    with pytest.raises(InputError, match=r"config_hash.*own threat model"):
        score(weaker, SMALL)


def test_a_draft_takes_no_rank() -> None:
    """Too few episodes, or seeds of another purpose, are shown and not ranked."""
    rows = [*clean("a"), *cell("none", "fdi"), *cell("a", "fdi")]
    found = entry(score(rows, suite(seeds=100), require_adaptive=True), "a")
    assert (found["status"], found["why"]) == ("unranked", "draft: 20 of 100 episodes")
    tuned = [row | {"purpose": "tune"} for row in rows]
    assert entry(score(tuned, suite(), require_adaptive=True), "a")["why"] == "draft: seeds of the purpose tune"


def test_a_rank_takes_every_training_of_the_plan(tmp_path: Path) -> None:
    """One of two seeds is not enough, a shorter training is none, and with both the defence is ranked."""
    asked = dataclasses.replace(SMALL, adaptive=PLAN)
    rows = evaluate(asked)

    def status(policies: list[Path]) -> tuple[str, str]:
        own = evaluate(asked, defences=["kf"], attacks=[str(path) for path in policies])
        found = entry(score([*rows, *own], asked), "kf")
        return found["status"], found["why"]

    whole = train_against(configs_of(asked, "kf", tmp_path / "whole", extra=("workers=1",)), lambda *_: None)
    short = train_against(configs_of(asked, "kf", tmp_path / "short", extra=("workers=1", "steps=100")), lambda *_: None)
    assert status(whole) == ("ranked", "")
    assert status(whole[:1]) == ("unattacked", "1 of 2 of the suite's own trainings are missing, first cem-black seed 1")
    assert status(short)[0] == "unattacked" and status(short)[1].startswith("2 of 2")


@pytest.mark.long
def test_attackers_of_networks_of_two_shapes_play_where_they_fit(tmp_path: Path) -> None:
    """The command trains on both, plays each policy on its own, and the defence is ranked: nothing of the plan is missing."""
    learners = {"cem": ["steps=400", "cem={population: 4, episodes: 1, hidden: []}"]}
    places = ["network-restless-v0", "network-restless-weak-v0"]
    plan = {"config": "network", "scenarios": places, "dose": 5, "knowledge": ["black"], "learners": learners, "seeds": 1}
    made = {
        "about": "Two networks.", "scenarios": places, "doses": [5], "defences": ["dkf"], "attacks": ["none", "fdi:value=5"], "bound": 10.0,
        "threat": {"fdi_bound": 100.0}, "seeds": 2, "adaptive": plan,
    }  # fmt: skip
    (tmp_path / "two-v0.yaml").write_text(yaml.safe_dump(made))
    own, folder = str(tmp_path / "two-v0.yaml"), tmp_path / "boards" / "two-v0"
    assert main(["leaderboard", "attack", "dkf", "--suite", own, "--out", str(folder / "attacked"), "--workers", "1"]) == 0
    assert sorted(path.name for path in (folder / "attacked").glob("*.jsonl")) == [f"dkf-{place}.jsonl" for place in places]
    play(load_suite(own), folder)
    found = entry(board_of(load_suite(own), folder), "dkf")
    assert (found["status"], found["why"]) == ("ranked", "")
    left = (folder / "attacked" / f"dkf-{places[1]}.jsonl").rename(tmp_path / "away.jsonl")
    found = entry(board_of(load_suite(own), folder), "dkf")
    assert found["why"] == f"1 of 2 of the suite's own trainings are missing, first cem-black-{places[1]} seed 0" and left.is_file()


def test_an_admitted_name_stands_for_one_file() -> None:
    """Rows of another policy under the path that was admitted are refused."""
    rows = [*clean("a"), *cell("none", "x.json"), *cell("a", "x.json")]
    line = Admitted("x.json", "0123", "black", "2026-11-22")
    with pytest.raises(InputError, match=r"attack_digest.*0123"):
        score(rows, suite(), attacks=[line], require_adaptive=False)
    same = [row | {"attack_digest": "0123"} if row["attack"] == "x.json" else row for row in rows]
    assert score(same, suite(), attacks=[line], require_adaptive=False)


@pytest.mark.parametrize(
    ("changes", "gate"),
    [({"distance_travelled": 200.0}, "progress"), ({"distance_travelled": 890.0}, "every episode"), ({"rms_jerk": 4.0}, "jerk"), ({"time_gap_inflation": 0.6}, "gap")],
)  # fmt: skip
def test_almost_half_of_the_episodes_cannot_be_ruined(changes: dict[str, float], gate: str) -> None:
    """Nine of twenty: the medians of all gates are as before. Seven episodes of hundred at 89 % of the way are too many."""
    share = 2 if gate == "every episode" else 9
    rows = [*clean("a"), *cell("none", "fdi"), *cell("a", "fdi")]
    for row in rows:
        if row["defence"] == "a" and row["attack"] == "none" and row["number"] < share:
            row |= changes
    found = entry(board(rows), "a")
    assert found["status"] == "unranked" and gate in [g["gate"] for g in found["gates"] if not g["passed"]], found["gates"]


def test_an_interval_holds_what_was_measured() -> None:
    """Also where each resample finds a worse attack than the rows do."""
    rng = np.random.default_rng(0)
    attacks = [f"fdi:value={i}" for i in range(1, 13)]
    rows = [*clean("a", n=100)]
    for text in attacks:
        hits = [rng.choice(100, size=n, replace=False).tolist() for n in (2, 5, 9)]
        rows += cell("none", text, n=100) + cell("a", text, hits, n=100)
    found = entry(board(rows, suite(attacks=("none", *attacks), seeds=100)), "a")["critical_dose"]["black"]
    assert found["value"] is None and found["high"] is None and found["low"] is not None


def test_a_folder_is_scored_and_half_done_work_is_not(compiled: None, tmp_path: Path) -> None:
    """What lies in hidden folders and among policies counts not; a second run plays nothing again; a compressed file that was cut is refused."""
    file = play(SMALL, tmp_path)
    assert file.name == OWN and (first := board_of(SMALL, tmp_path, require_adaptive=False))["entries"]
    for folder in (".rows.jsonl.xz.parts", "policies"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.jsonl").write_text("{}\n")
    assert board_of(SMALL, tmp_path, require_adaptive=False) == first
    said: list[tuple[str, int, int]] = []
    before = file.read_bytes()
    play(SMALL, tmp_path, progress=lambda *args: said.append(args))
    assert said == [] and file.read_bytes() == before
    some = play(SMALL, tmp_path, defences=["kf"])
    assert some != file and file.read_bytes() == before and {row["defence"] for row in read_rows(some)} == {"none", "kf"}
    file.write_bytes(packed(read_rows(some), file)[:-40])
    with pytest.raises(InputError, match="truncated"):
        read_rows(file)




def test_an_episode_that_came_out_in_two_ways_is_refused() -> None:
    """Else rows that are read last would stand for those before; the same result twice counts once."""
    rows = [*clean("a"), *cell("none", "fdi"), *cell("a", "fdi", 20)]
    assert entry(board([*rows, *cell("a", "fdi", 20)]), "a")["rates"] == entry(board(rows), "a")["rates"]
    with pytest.raises(InputError, match=r"a, fdi \(black\), seed \d+: crashed: got \[1\.0, 0\.0\]"):
        board([*rows, *cell("a", "fdi", 0)])


def test_episodes_of_ones_own_choice_take_no_rank() -> None:
    """Seeds have to be the first ones of the round, or of the suite."""
    rows = [*clean("a"), *cell("none", "fdi"), *cell("a", "fdi")]
    chosen = [row | {"seed": row["seed"] + 1} for row in rows]
    assert "draft: the episodes on stop-and-go-v0 are not the first ones of the beacon" in entry(score(chosen, suite()), "a")["why"]
    assert entry(score(rows, suite()), "a")["status"] == "unattacked"


def test_a_clean_run_without_a_figure_is_named() -> None:
    """A null where a gate needs a number."""
    rows = [*clean("a"), *cell("none", "fdi"), *cell("a", "fdi")]
    for metric in ("time_gap_inflation", "rms_jerk", "alarm_rate", "alarm_onsets"):
        broken = [row | {metric: None} if row["defence"] == "a" and row["attack"] == "none" else row for row in rows]
        with pytest.raises(InputError, match=f"stop-and-go-v0, a, none: {metric}"):
            board(broken)


def test_a_board_says_whether_it_ranks_what_nobody_was_trained_against() -> None:
    """And who is alone in a class has no rank number."""
    rows = [*clean("a"), *cell("none", "fdi"), *cell("a", "fdi")]
    free, strict = board(rows), score(rows, suite())
    assert not free["suite"]["require_adaptive"] and strict["suite"]["require_adaptive"]
    assert "without attackers" in title(free) and "without attackers" not in title(strict)
    assert next(line for line in lines(free) if line[0] == "a")[2] == "alone"


def test_a_plug_in_is_somebody_elses_class(monkeypatch) -> None:
    """A registered name that does not come with the package has to be handed in like any other class."""

    class Mine(Kalman):
        """Somebody's."""

    monkeypatch.setitem(registry._entries["defence"], "mine", registry.entry_of("defence", "mine", Mine))
    rows = [row | {"submission": None} for row in [*clean("kf", "mine"), *(r for d in ("none", "kf", "mine") for r in cell(d, "fdi"))]]
    made = board(rows)
    assert entry(made, "kf")["status"] == "ranked" and entry(made, "mine")["why"] == "claimed: not played by leaderboard submit in a sandbox"
    assert entry(made, "mine")["card"] is None and len(registry.Spec("defence", "mine").digest) == 64


def test_an_attack_that_was_tried_and_refused_counts_where_it_was_played(tmp_path) -> None:
    """It is on no list, but what it did was done; an erratum alone takes that away. Code to import is not tried at all."""
    where = suite(attacks=("none", "fdi"))
    rows = [*clean("a"), *(row for d in ("none", "a") for row in (*cell(d, "fdi"), *cell(d, "jam", 20)))]
    refused = Admitted("jam", "", "black", "2026-11-23", refused=True)
    for lines_, damage in (([], 0.0), ([refused], 0.0), ([dataclasses.replace(refused, refused=False, erratum="wrong")], 1.0)):
        assert rate(entry(score(rows, where, attacks=lines_, require_adaptive=False), "a"), 20)["undamaged"]["value"] == damage
    with pytest.raises(InputError, match="the list of attacks"):
        admit("mine:Mine", SMALL, ["kf"], tmp_path / "attacks.jsonl", "2026-11-23")
