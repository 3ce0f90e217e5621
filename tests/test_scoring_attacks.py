"""The list of admitted attacks: it only grows, and who joins it has beaten the worst."""

import dataclasses
import json
import threading
from pathlib import Path

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.board import admit, read_attacks, score, withdraw
from tailgate.board.admission import against_all
from tailgate.cli import main
from tailgate.core.scenario import load_suite
from tailgate.evaluation.attack_list import Admitted, append, attacks_of, next_level, published, standing
from tailgate.evaluation.paired import mcnemar
from tailgate.evaluation.rows import read_rows

ROOT = Path(__file__).parents[1]
LINE = Admitted("fdi:value=-4", "", "black", "2026-11-22", ({"defence": "kf", "p": 0.01},))


def test_a_line_is_added_and_those_before_it_keep_every_byte(tmp_path) -> None:
    """The file before is the beginning of the file after."""
    path, held = tmp_path / "list" / "attacks.jsonl", b""
    for i in range(4):
        append(path, dataclasses.replace(LINE, attack=f"a{i}"))
        now = path.read_bytes()
        assert now.startswith(held) and now.count(b"\n") == i + 1
        held = now
    lines = read_attacks(path)
    assert [line.attack for line in lines] == ["a0", "a1", "a2", "a3"]
    assert [line.before for line in lines] == ["", *(line.hash for line in lines[:3])]


@pytest.mark.parametrize("damage", ["change", "swap", "take out", "cut", "first"])
def test_a_line_that_is_not_as_it_was_written_is_refused(tmp_path, damage) -> None:
    """Changed, moved, taken out, cut off in its middle: the line is named, and nothing is appended behind it."""
    path = tmp_path / "attacks.jsonl"
    for i in range(3):
        append(path, dataclasses.replace(LINE, attack=f"a{i}"))
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    bad = {
        "change": [lines[0], lines[1], lines[2].replace("0.01", "0.02")], "swap": [lines[0], lines[2], lines[1]], "take out": [lines[0], lines[2]],
        "cut": [*lines[:2], lines[2][:40]], "first": lines[1:],
    }[damage]  # fmt: skip
    path.write_text("".join(bad), encoding="utf-8")
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"attacks.jsonl, line"):
        append(path, LINE)
    assert path.read_bytes() == before


def test_two_writers_at_once_lose_no_line(tmp_path) -> None:
    """Eight threads, one line each."""
    path = tmp_path / "attacks.jsonl"
    threads = [threading.Thread(target=append, args=(path, dataclasses.replace(LINE, attack=f"a{i}"))) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {line.attack for line in read_attacks(path)} == {f"a{i}" for i in range(8)}


def test_an_erratum_takes_back_and_stays(tmp_path) -> None:
    """The attack counts no longer, its line is still there, and it may come again."""
    path = tmp_path / "attacks.jsonl"
    append(path, LINE)
    withdraw(LINE.attack, path, "2026-11-23", "its bound was not that of the suite")
    assert standing(read_attacks(path)) == {LINE.attack: None} and len(read_attacks(path)) == 2
    with pytest.raises(InputError, match="attack"):
        withdraw(LINE.attack, path, "2026-11-23", "again")
    append(path, LINE)
    assert standing(read_attacks(path))[LINE.attack] is not None
    with pytest.raises(InputError, match="date"):
        append(path, dataclasses.replace(LINE, date="yesterday"))


@pytest.mark.long
def test_a_list_that_was_published_holds_wherever_a_folder_has_none(tmp_path) -> None:
    """For a board, a submission and trust alike; a folder's list goes on from it. A suite that was changed under its name has none."""
    suite, own = load_suite("quick-v0"), tmp_path / "attacks.jsonl"
    ramps = attacks_of(suite)[len(suite.attacks) :]
    assert len(ramps) == 2 and all(text.startswith("fdi_ramp:") for text in ramps) and attacks_of(suite, own) == attacks_of(suite)
    assert attacks_of(dataclasses.replace(suite, seeds=3)) == suite.attacks and published(load_suite("thesis-v0")) is None
    for name in ("quick-v0", "radar-v0"):
        assert published(load_suite(name)).read_bytes() == (ROOT / "results" / name / "attacks.jsonl").read_bytes()
    small = dataclasses.replace(suite, defences=("none", "kf"))
    with pytest.raises(InputError, match="not on the list"):
        admit(ramps[0], suite, ["kf"], own, "2026-11-25")
    line, _ = admit("fdi:start_step=400,value=0.1", suite, ["kf"], own, "2026-11-25", episodes=2)
    held = read_attacks(own)
    assert line is None and len(held) == 5 and held[-1].refused and attacks_of(small, own) == (*small.attacks, *ramps)
    append(own, dataclasses.replace(LINE, attack=ramps[0], erratum="wrong"))
    assert attacks_of(suite, own) == (*suite.attacks, ramps[1])


def test_every_try_costs_the_next_one(tmp_path) -> None:
    """Over any number of tries the levels add up to alpha; an erratum is no try."""
    levels, lines = [], []
    for _ in range(400):
        levels.append(next_level(lines, 0.05))
        lines.append(dataclasses.replace(LINE, refused=True))
    assert levels[:3] == [0.05 / 2, 0.05 / 6, 0.05 / 12] and 0.0498 < sum(levels) < 0.05
    assert next_level([LINE, dataclasses.replace(LINE, erratum="wrong bound")], 0.05) == levels[1]


@pytest.fixture(scope="module")
def part():
    """quick-v0 cut to two defences, a weak attack and ten seeds."""
    return dataclasses.replace(
        load_suite("quick-v0"), scenarios=("gusty-stop-and-go-v0",), doses=(20,), defences=("none", "chi2_kf"), seeds=16,
        attacks=("none", "fdi:start_step=480,value=-0.5"),
    )  # fmt: skip


@pytest.mark.long
def test_an_attack_is_admitted_by_what_it_does_on_select_seeds_and_else_not(part, tmp_path) -> None:
    """A ramp at the right moment beats a small bias at a wrong one, and a small bias that widens the gap does not beat the ramp."""
    path, rows = tmp_path / "attacks.jsonl", tmp_path / "rows.jsonl"
    line, tests = admit("fdi_ramp:trigger=near,threshold=40,rate=-0.5", part, ["chi2_kf"], path, "2026-11-22", rows_file=rows)
    assert line is not None and read_attacks(path) == [line] and {row["purpose"] for row in read_rows(rows)} == {"select"}
    assert tests[0]["adjusted"] <= 0.05 and tests[0]["only_new"] > tests[0]["only_worst"]
    worse, tests = admit("fdi:start_step=100,value=0.5", part, ["chi2_kf"], path, "2026-11-22")
    assert worse is None and tests[0]["worst"]["attack"] == line.attack
    lines = read_attacks(path)
    assert [held.refused for held in lines] == [False, True] and standing(lines)["fdi:start_step=100,value=0.5"] is None
    late, tests = admit("fdi:trigger=near,threshold=20,value=-0.5", part, ["chi2_kf"], path, "2026-11-22", dose=20, episodes=4)
    assert late is None and tests[0]["dose"] == 20
    with pytest.raises(InputError, match=r"dose.*7.*20"):
        admit("fdi:start_step=100,value=0.4", part, ["chi2_kf"], path, "2026-11-22", dose=7)
    assert len(read_attacks(path)) == 3
    with pytest.raises(InputError, match="not on the list"):
        admit(line.attack, part, ["chi2_kf"], path, "2026-11-22")
    with pytest.raises(InputError, match="ceiling"):
        admit("optimal_stealth", part, ["chi2_kf"], path, "2026-11-22")


def test_the_command_says_whom_an_attack_beats(part, tmp_path, capsys, monkeypatch) -> None:
    """Admitted, refused and taken back; each a line of the list."""
    monkeypatch.setattr("tailgate.core.scenario.load_suite", lambda name: part)
    words = ["leaderboard", "admit", "--suite", "quick-v0", "--out", str(tmp_path), "--defence", "chi2_kf", "--workers", "1"]
    assert main([*words, "fdi_ramp:trigger=near,threshold=40,rate=-0.5"]) == 0
    said = capsys.readouterr().out
    assert "admitted" in said and "yes" in said and "fdi:start_step=480" in said
    assert main([*words, "fdi:start_step=100,value=0.5", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["admitted"] is False and told["evidence"][0]["defence"] == "chi2_kf"
    assert main([*words, "fdi:start_step=101,value=0.5,targets=[velocity]"]) == 1
    said = capsys.readouterr().out
    assert "refused" in said and "targets=[velocity] damages no episode" in said and "in 1 of 1 pairs" in said
    (tmp_path / "file").touch()
    assert main([*words[:4], "--out", str(tmp_path / "file"), "fdi:value=1"]) == 2 and "writable directory" in capsys.readouterr().err
    assert main([*words, "fdi_ramp:trigger=near,threshold=40,rate=-0.5", "--erratum", "wrong bound"]) == 0
    assert "taken back" in capsys.readouterr().out and len(read_attacks(tmp_path / "quick-v0" / "attacks.jsonl")) == 4


def test_a_board_asks_every_defence_for_what_was_admitted_and_forgets_what_was_taken_back(part) -> None:
    """Without rows of an admitted attack a defence is incomplete; after an erratum its rows count no more."""
    from tailgate.evaluation.cells import evaluate

    rows = evaluate(dataclasses.replace(part, seeds=10))
    assert {e["defence"]: e["status"] for e in score(rows, part, require_adaptive=False)["entries"]} == {"none": "unranked", "chi2_kf": "ranked"}
    asked = score(rows, part, attacks=[LINE], require_adaptive=False)
    assert "not played" in next(e["why"] for e in asked["entries"] if e["defence"] == "chi2_kf")
    assert next(a for a in asked["attacks"] if a["attack"] == LINE.attack)["admitted"]["date"] == LINE.date
    hit = [row | {"attack": LINE.attack, "crashed": 1.0} for row in rows if row["attack"] != "none"]
    for lines, value in (([LINE], 0.0), ([LINE, dataclasses.replace(LINE, erratum="wrong")], 1.0)):
        made = score([*rows, *hit], part, attacks=lines, require_adaptive=False)
        assert next(e for e in made["entries"] if e["defence"] == "chi2_kf")["rates"][0]["undamaged"]["value"] == value
    assert "erratum" in next(a["note"] for a in made["attacks"] if a["attack"] == LINE.attack)
    assert json.dumps(made, allow_nan=False)


def test_an_attack_has_to_beat_every_listed_one() -> None:
    """Nested in the new one, the listed attack with most damage is beaten surely; another one, which does less, is not."""
    new = np.repeat([1.0, 0.0], [40, 60])
    nested, other = np.repeat([1.0, 0.0], [30, 70]), np.repeat([0.0, 1.0, 0.0], [20, 45, 35])
    assert against_all(new, [nested])[1]["p"] == mcnemar(10, 0) < 0.01
    best, found = against_all(new, [nested, other])
    assert best == 1 and found["p"] == 1.0 and (found["only_new"], found["only_worst"]) == (20, 25)
    assert against_all(new, []) == (None, {"only_new": 40, "only_worst": 0, "p": mcnemar(40, 0)})
