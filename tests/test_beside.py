"""Rows of some defences, scored beside a board that has the others, make the board that all rows make."""

import copy
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.board.cells import digits, hits_of, shared_of
from tailgate.board.check import _scored
from tailgate.board.consistency import sharpened, strays, untold
from tailgate.board.files import read_board
from tailgate.cli import board as command
from tailgate.core.scenario import load_suite
from tailgate.evaluation.attack_list import Admitted
from tailgate.evaluation.cells import cells_of, run
from tailgate.evaluation.paired import settled
from tailgate.evaluation.rows import encode

from .commands import ran
from .scored import BEACON, ROAD, board, cell, entry, suite

Data = dict[str, Any]
GUARDS = ("none", "kf", "rkf", "imm", "safe_state")
POLICY = "runs/a/policy-0.json"


def _rows(*guards: str, own: bool = True, attacks: tuple[str, ...] = ("fdi",)) -> list[Data]:
    """Clean and attacked rows; with a policy that was trained against kf, and one against rkf. Which episodes are hit differs by guard."""
    hits = {"none": [9, 15, 20], "kf": [[1, 4], [2, 5, 7], list(range(0, 20, 2))], "rkf": [0, 1, 2], "imm": [3, [0, 19, 9, 8], 20], "safe_state": 1}
    out = []
    for guard in guards:
        uses = ["measurements", "v2v"] if guard == "safe_state" else ["measurements"]
        out += cell(guard, uses=uses)
        for attack in attacks:
            out += cell(guard, attack, hits[guard], uses=uses)
        if own and guard in ("kf", "rkf"):
            trained = {"defence": guard, "digest": "", "version": 1, "plan": "p", "seed": 0}
            out += cell(guard, POLICY.replace("a", guard), [2, 6, 12], learned=True, trained=trained)
    return out


def _as_read(made: Data) -> Data:
    """As it is on the disk."""
    read_board(held := json.loads(json.dumps(made)))
    return dict(held)


@pytest.mark.parametrize("guards", [("kf",), ("rkf",), ("imm", "rkf"), ("safe_state",), ("kf", "rkf", "imm", "safe_state")], ids=",".join)
def test_rows_beside_a_board_make_what_all_rows_make(guards: tuple[str, ...]) -> None:
    whole = board(_rows(*GUARDS))
    before = _as_read(board(_rows(*(guard for guard in GUARDS if guard not in guards))))
    assert board(_rows("none", *guards), board=before) == whole
    assert board(_rows("none", *guards), board=_as_read(whole)) == whole  # an entry that is there is made again


def test_an_entry_that_meets_more_takes_the_place_of_the_old_one() -> None:
    before = _as_read(board(_rows(*GUARDS, own=False)))
    made = board(_rows("none", "kf"), board=before)
    assert made == board([*_rows("none", "kf"), *_rows("rkf", "imm", "safe_state", own=False)])
    assert [c["attack"] for c in made["cells"] if c["learned"]] == [POLICY.replace("a", "kf")] * 3


def _without_hits(made: Data) -> Data:
    """A board of before cells said which episodes came to damage."""
    held = copy.deepcopy(made)
    for c in held["cells"]:
        del c["hits"]
    return held


@pytest.mark.long
def test_what_a_board_does_not_know_makes_ranks_wider_and_never_wrong() -> None:
    """Pairs that stay keep what was found of them when all was known; new pairs count as different as numbers of hits allow."""
    hits = {"none": 20, "kf": list(range(13)), "rkf": [0, 19], "imm": [3, 4, 5], "safe_state": 1}

    def rows(*guards: str) -> list[Data]:
        uses = {name: ["measurements", "v2v"] if name == "safe_state" else ["measurements"] for name in guards}
        return [r for g in guards for r in (*cell(g, uses=uses[g]), *cell(g, "fdi", [0, hits[g], 20], uses=uses[g]))]

    whole, before = board(rows(*GUARDS)), _without_hits(_as_read(board(rows("none", "kf", "rkf"))))
    made = board(rows("none", "safe_state"), board=before)
    assert entry(made, "safe_state")["rank"] == {"best": 1, "worst": 1}
    assert [entry(made, name)["rank"] for name in ("kf", "rkf")] == [entry(before, name)["rank"] for name in ("kf", "rkf")]
    assert made["comparisons"] == before["comparisons"] != [] and strays(made, suite()) == []
    made = _as_read(board(rows("none", "imm", "safe_state"), board=before))
    duels = {(d["a"], d["b"]): (d, e) for d, e in zip(made["comparisons"], whole["comparisons"], strict=True)}
    assert {pair: d.get("bound") for pair, (d, _) in duels.items()} == {("imm", "kf"): True, ("imm", "rkf"): True, ("kf", "rkf"): None}
    assert duels["kf", "rkf"][0]["p"] == duels["kf", "rkf"][1]["p"]
    assert all(d["p"] >= e["p"] and d["only_a"] - d["only_b"] == e["only_a"] - e["only_b"] for d, e in duels.values())
    assert any(d["p"] > e["p"] for d, e in duels.values())
    for name in ("kf", "rkf", "imm"):
        wide, rank = entry(made, name)["rank"], entry(whole, name)["rank"]
        assert wide["best"] <= rank["best"] and rank["worst"] <= wide["worst"]
    assert strays(made, suite()) == [] and untold(made, suite()) == ["kf", "rkf"]
    everything = rows(*GUARDS)
    assert list(_scored(made, everything, suite())) == []  # what `check` says once it has played all cells
    narrow = copy.deepcopy(made)
    entry(narrow, "imm")["rank"] = {"best": 3, "worst": 3}
    assert [stray["field"] for stray in _scored(narrow, everything, suite())] == ["rank"]
    told = copy.deepcopy(made)
    for mine, full in zip(told["cells"], whole["cells"], strict=True):
        mine["hits"] = full["hits"]
    assert ("", "comparisons") in {(s["defence"], s["field"]) for s in strays(told, suite())} and untold(told, suite()) == []  # bounds are for cells that do not tell
    sharp = sharpened(told, suite())
    assert sharp["comparisons"] == whole["comparisons"] and strays(sharp, suite()) == [] and entry(sharp, "imm")["rank"] == entry(whole, "imm")["rank"]
    assert board(rows("none", "imm"), board=told)["comparisons"] == whole["comparisons"]
    exact, bound = whole["comparisons"], made["comparisons"]
    assert exact[0]["p"] < bound[0]["p"] < 0.05 and exact[2]["p"] < 0.01 and entry(made, "kf")["rank"] == {"best": 3, "worst": 3}
    lies: list[tuple[int, Data]] = [
        (0, {"p": exact[0]["p"] / 2}), (0, {"p": 1.0}), (0, {"weaker": "imm"}), (0, {"only_a": 17}),  # of a bound
        (2, {"p": 0.0}), (2, {"p": 1e-9}), (2, {"p": 1.0}), (2, {"weaker": "rkf"}), (2, {"only_a": 1000, "only_b": 989}), (2, {"weaker": None}),  # of a pair that stayed
    ]  # fmt: skip
    for at, changes in lies:
        forged = copy.deepcopy(made)
        forged["comparisons"][at] |= changes
        if forged["comparisons"][at]["weaker"]:
            forged["comparisons"], ranks = settled(forged["comparisons"], ["imm", "kf", "rkf"], 0.05)
            for name, rank in ranks.items():
                entry(forged, name)["rank"] = rank
        assert ("", "comparisons") in {(s["defence"], s["field"]) for s in strays(forged, suite())}, changes
        if at == 2:
            assert any(stray["field"] == "comparisons" for stray in _scored(forged, everything, suite()))
            with pytest.raises(InputError, match="comparison of kf and rkf"):
                board(rows("none", "safe_state"), board=forged)
    again = board(rows("none", "kf"), board=before)
    assert again["comparisons"] == before["comparisons"] and entry(again, "kf")["rank"] == entry(before, "kf")["rank"]  # nothing is gained by playing again
    more = board([*rows("none", "kf"), *cell("kf", POLICY, 1, learned=True)], board=before)
    assert more["comparisons"][0]["bound"] and not before["comparisons"][0].get("bound")  # of an entry that met more


def test_hits_of_rows_count_where_a_defence_stays() -> None:
    """Rows of some cells of it say which episodes were hit, and its comparisons are made of these."""
    rows = [*_rows("none", "imm"), *cell("kf"), *cell("kf", POLICY.replace("a", "kf"), [[19], [18, 19], list(range(8, 20))], learned=True), *cell("kf", "fdi", 0)]
    whole = board([*rows, *cell("rkf"), *cell("rkf", "fdi", [[3], [0, 9, 10], 5])])
    before = _without_hits(_as_read(board([r for r in [*rows, *cell("rkf"), *cell("rkf", "fdi", [[3], [0, 9, 10], 5])] if r["defence"] != "imm"])))
    some = [r for r in rows if r["attack"] != "fdi" or r["defence"] != "kf"]
    made = board([*some, *cell("rkf", "fdi", [[3], [0, 9, 10], 5])], board=before)
    assert made["comparisons"] == whole["comparisons"] and not any(d.get("bound") for d in made["comparisons"])


def test_rows_of_some_cells_only_say_which_episodes_were_hit() -> None:
    whole = board(_rows(*GUARDS))
    before = _without_hits(_as_read(whole))
    before["entries"][1]["why"] = "as it was"
    made = board([*_rows("none"), *cell("kf"), *_rows("rkf", own=False)], board=before)
    assert entry(made, "kf")["why"] == "as it was"
    lacking = [c["defence"] for c in made["cells"] if "hits" not in c]
    assert set(lacking) == {"kf", "rkf", "imm", "safe_state"} and lacking.count("kf") == 6 and lacking.count("rkf") == 3
    held = {(c["defence"], c["attack"], c["dose"]): c for c in whole["cells"]}
    assert all(c == held[c["defence"], c["attack"], c["dose"]] for c in made["cells"] if "hits" in c)


def test_what_is_no_cell_of_the_same_board_is_refused() -> None:
    whole = _as_read(board(_rows(*GUARDS)))
    for guards in (("none",), ("none", "rkf")):  # the rows cover some cells of `none`, or all
        wrong = _rows(*guards)
        wrong[0] = wrong[0] | {"crashed": 1.0}
        for kept in (wrong, [row for row in wrong if (row["defence"], row["attack"]) != ("none", "fdi")]):
            with pytest.raises(InputError, match=r"none, none, dose 10: damage"):
                board(kept, board=whole)
    forged = copy.deepcopy(whole)
    cell_of = next(c for c in forged["cells"] if (c["defence"], c["attack"], c["dose"]) == ("none", "fdi", 10))
    cell_of["hits"] = digits(hits_of(cell_of)[::-1])  # as many, but others
    with pytest.raises(InputError, match=r"none, fdi, dose 10: hits"):
        board(_rows("none", "rkf"), board=forged)
    with pytest.raises(InputError, match="none too"):
        board(_rows("imm"), board=whole)
    with pytest.raises(InputError, match="require_adaptive"):
        board(_rows("none", "kf"), board=whole, require_adaptive=True)
    for field, value in (("hash", "0" * 16), ("purpose", "tune"), ("beacon", "another beacon of sixteen"), ("alpha", 0.1)):
        other = copy.deepcopy(whole)
        other["suite"][field] = value
        with pytest.raises(InputError, match=field):
            board(_rows("none", "kf"), board=other)
    with pytest.raises(InputError, match="seeds"):
        board([row for row in _rows("none", "kf") if row["number"] > 0], board=whole)


def test_a_board_of_another_list_of_attacks_is_refused() -> None:
    """Its entries have not met what joined since."""
    line = Admitted("dropout", "", "black", "2026-11-25")
    rows = _rows("none", "kf", attacks=("fdi", "dropout"))
    with pytest.raises(InputError, match="dropout"):
        board(rows, board=_as_read(board(_rows(*GUARDS))), attacks=[line])
    before = _as_read(board(_rows(*GUARDS, attacks=("fdi", "dropout")), attacks=[line]))
    assert board(rows, board=before, attacks=[line]) == before
    for attack in before["attacks"]:
        if attack["admitted"]:
            attack["admitted"]["digest"] = "aa"
    with pytest.raises(InputError, match="digest of dropout"):
        board(rows, board=before, attacks=[line])


def test_who_joins_meets_what_all_others_have_met() -> None:
    """An attack on no list that every entry met is asked of the newcomer, who would be ranked beside them for having met less; policies that
    were trained against one of them are not."""
    more = ("fdi", "dropout")
    before = _as_read(board(_rows("none", "kf", "rkf", attacks=more)))
    spared = board(_rows("none", "imm"), board=before)
    assert entry(spared, "imm")["status"] == "unranked" and "dropout" in entry(spared, "imm")["why"] and "not played" in entry(spared, "imm")["why"]
    assert [entry(spared, g)["rates"] for g in ("kf", "rkf")] == [entry(before, g)["rates"] for g in ("kf", "rkf")]
    made = board(_rows("none", "imm", attacks=more), board=before)
    assert [a["attack"] for a in made["attacks"] if a.pop("shared", False)] == ["dropout"]
    assert made == board(_rows("none", "kf", "rkf", "imm", attacks=more))
    again = board(_rows("none", "imm"), board=_as_read(spared))  # who was spared does not end the rule, for himself or for the next
    assert entry(again, "imm")["status"] == "unranked" == entry(board(_rows("none", "safe_state"), board=_as_read(again)), "safe_state")["status"]
    everything = [*_rows("none", "kf", "rkf", attacks=more), *_rows("imm")]
    assert strays(again, suite()) == [] == list(_scored(again, everything, suite()))
    late = _as_read(board([*_rows("none", "imm"), *cell("imm", "dropout", 1)], board=_as_read(again)))
    assert entry(late, "imm")["status"] == "ranked" and shared_of(late) == more[::-1]
    some = _as_read(board([*_rows("none", "kf", "rkf"), *cell("kf", "dropout", 1)]))  # which only one has met
    assert entry(board(_rows("none", "imm"), board=some), "imm")["status"] == "ranked"
    assert shared_of(before) == more[::-1] and shared_of(some) == ("fdi",)


def test_an_attack_whose_file_became_another_one_is_refused() -> None:
    """Entries that stay have met the old one; what only the newcomer meets has the digest of its rows."""
    def rows(digest: str, *guards: str) -> list[Data]:
        return [r for g in guards for r in (*cell(g), *cell(g, "fdi", 1, attack_digest=digest))]

    before = _as_read(board(rows("a" * 16, "none", "kf")))
    new = [*rows("a" * 16, "none"), *cell("rkf"), *cell("rkf", POLICY, 1, attack_digest="c" * 16, learned=True)]
    made = board([*new, *cell("rkf", "fdi", 1, attack_digest="a" * 16)], board=before)
    assert {a["attack"]: a["digest"] for a in made["attacks"]} == {"fdi": "a" * 16, POLICY: "c" * 16}
    with pytest.raises(InputError, match="rows of fdi: attack_digest"):
        board(rows("b" * 16, "none", "kf", "rkf")[-len(cell("kf")) * 2 :] + cell("none"), board=before)


def test_an_attack_that_begins_to_count_against_the_others_is_refused() -> None:
    """It was left out for everybody; a new entry can be attacked by it, so that the others lack figures."""
    where = suite(attacks=("none", "fdi", "stealth"))

    def left_out(*guards: str) -> list[Data]:
        return [r | {"status": "skipped", "reason": "no gate"} for guard in guards for r in cell(guard, "stealth")]

    before = _as_read(board([*_rows("none", "kf"), *left_out("none", "kf")], where))
    assert entry(before, "kf")["status"] == "ranked"
    rows = [*_rows("none", "imm"), *left_out("none"), *cell("imm", "stealth", 0)]
    assert entry(board([*_rows("none", "kf", "imm"), *left_out("none", "kf"), *cell("imm", "stealth", 0)], where), "kf")["status"] == "unranked"
    with pytest.raises(InputError, match=r"stealth on .*play the whole suite"):
        board(rows, where, board=before)


def test_attacks_that_are_left_out_keep_their_reason() -> None:
    skipped = [r | {"status": "skipped", "reason": f"no gate on {r['defence']}"} for g in ("none", "kf", "rkf") for r in cell(g, "stealth")]
    where = suite(attacks=("none", "fdi", "stealth"))
    before = _as_read(board([*_rows("none", "kf"), *(r for r in skipped if r["defence"] != "rkf")], where))
    made = board([*_rows("none", "rkf"), *(r for r in skipped if r["defence"] != "kf")], where, board=before)
    assert made == board([*_rows("none", "kf", "rkf"), *skipped], where)
    assert next(a["note"] for a in made["attacks"] if a["attack"] == "stealth") == f"left out on {ROAD}: no gate on kf"


@pytest.mark.parametrize("n", [1, 7, 8, 9, 100])
def test_digits_and_back(n: int) -> None:
    rng = np.random.default_rng(n)
    for _ in range(20):
        hits = rng.integers(2, size=n).astype(bool)
        made = {"n": n, "hits": digits(list(hits)), "damage": {"value": hits.mean()}}
        assert np.array_equal(hits_of(made), hits)
        assert hits_of(made | {"hits": None}).sum() == hits.sum()
    assert digits([True, *[False] * 8, True]) == "8040"


def test_ranks_and_comparisons_follow_from_the_cells() -> None:
    """Nobody has to play anything to see that they do."""
    made, held = _as_read(board(_rows(*GUARDS))), suite()
    assert made["suite"]["beacon"] == BEACON and strays(made, held) == []
    entry(made, "kf")["rank"] = {"best": 1, "worst": 1}
    made["comparisons"][0]["only_a"] += 1
    assert [(s["defence"], s["field"]) for s in strays(made, held)] == [("", "comparisons"), ("kf", "rank")]
    entry(made, "none")["rank"] = {"best": 1, "worst": 1}
    entry(made, "imm")["class"] = "measurements + odometry"
    assert {("none", "rank"), ("imm", "class")} <= {(s["defence"], s["field"]) for s in strays(made, held)}
    made = _as_read(board(_rows(*GUARDS)))
    for c in made["cells"]:
        c["hits"] = None
    assert strays(made, held) == [] and set(untold(made, held)) <= {"kf", "rkf", "imm", "safe_state"} != set()


def test_hits_that_are_not_of_the_cell() -> None:
    made = _as_read(board(_rows(*GUARDS)))
    changed = copy.deepcopy(made)
    changed["cells"][-1]["hits"] = "0" * len(changed["cells"][-1]["hits"])
    assert any(s["field"].endswith("damage") for s in strays(changed, suite()))
    for value in ("ff", "zz", "ff" * 9, 7, "00000f"):
        changed["cells"][0]["hits"] = value
        with pytest.raises(InputError, match=r"cells\[0\]\.hits"):
            read_board(changed)


TEXT = "about: s\nscenarios: [thesis-ch4-v0]\ndoses: [5]\ndefences: [none, kf, chi2_kf]\nattacks: [none, 'fdi:value=5']\nseeds: 4\n"


def _run(*arguments: str) -> None:
    assert ran(command, "run", *arguments, "--no-replays", "--unattacked", "--workers", "1") == 0


@pytest.mark.long
def test_the_command(compiled: None, tmp_path: Path) -> None:
    """A board that is there grows by an entry; without the flag it is one of the rows alone."""
    file, out = tmp_path / "small-v0.yaml", tmp_path / "out"
    file.write_text(TEXT)
    place = out / "small-v0" / "board.json"
    with pytest.raises(InputError, match="keep-entries"):
        _run(str(file), "--out", str(out), "--keep-entries")
    assert not list(out.glob("**/rows*"))  # said before anything is played
    _run(str(file), "--out", str(out))
    whole = json.loads(place.read_text())
    for path in out.glob("small-v0/rows*"):
        path.unlink()
    held = copy.deepcopy(whole)
    held["entries"][1] |= {"verified": {"rows": 8, "verified": 8, "differs": 0, "unchecked": 0}, "checked": {"cells": 2, "equal": 2, "differs": 0, "unchecked": 0}}
    held["entries"][2]["checked"] = held["entries"][1]["checked"]
    place.write_text(json.dumps(held))
    rows = run(cells_of(dataclasses.replace(load_suite(str(file)), defences=("chi2_kf",), attacks=("dropout",))))
    (out / "small-v0" / "more.jsonl").write_bytes(encode(rows))
    _run(str(file), "--out", str(out), "--defence", "chi2_kf", "--keep-entries")
    made = json.loads(place.read_text())
    assert [e["defence"] for e in made["entries"]] == ["none", "kf", "chi2_kf"] and made["entries"][1] == held["entries"][1]
    assert made["entries"][2]["checked"]["cells"] == 3 and made["suite"]["rows"] == whole["suite"]["rows"] + 4
    assert [c["attack"] for c in made["cells"] if c["defence"] == "chi2_kf"] == ["none", "fdi:value=5", "dropout"]
    with pytest.raises(InputError, match="keep-entries too"):
        _run(str(file), "--out", str(out), "--attack", "dos_jam")
    for path in out.glob("small-v0/*rows*"):
        path.unlink()
    _run(str(file), "--out", str(out), "--defence", "kf", "--attack", "dos_jam:start_step=20", "--keep-entries")
    more = json.loads(place.read_text())
    met = {d: [c["attack"] for c in more["cells"] if c["defence"] == d] for d in ("none", "kf", "chi2_kf")}
    assert met["kf"] == ["none", "fdi:value=5", "dos_jam:start_step=20"] and met["chi2_kf"] == ["none", "fdi:value=5", "dropout"]
    assert more["entries"][1]["checked"] == held["entries"][1]["checked"] | {"cells": 3} and more["suite"]["rows"] == made["suite"]["rows"] + 4
    place.write_text(json.dumps(made))
    for path in out.glob("small-v0/*rows*"):
        path.unlink()
    _run(str(file), "--out", str(out), "--defence", "chi2_kf", "--keep-entries")
    _run(str(file), "--out", str(out), "--defence", "chi2_kf", "--score-only")
    assert [e["defence"] for e in json.loads(place.read_text())["entries"]] == ["none", "chi2_kf"]


@pytest.mark.long
def test_the_command_plays_what_all_others_have_met(compiled: None, tmp_path: Path) -> None:
    """Whoever joins by name meets it without being asked; a board that names code to import is refused, and a suite of one's own is not."""
    file, out = tmp_path / "small-v0.yaml", tmp_path / "out"
    file.write_text(TEXT)
    place, late = out / "small-v0" / "board.json", "dos_jam:start_step=20"
    _run(str(file), "--out", str(out), "--defence", "kf")
    for path in out.glob("small-v0/rows*"):
        path.unlink()
    _run(str(file), "--out", str(out), "--attack", late, "--defence", "none", "--defence", "kf", "--keep-entries")
    before = json.loads(place.read_text())
    for path in out.glob("small-v0/rows*"):
        path.unlink()
    _run(str(file), "--out", str(out), "--defence", "chi2_kf", "--keep-entries")
    made = json.loads(place.read_text())
    assert [c["attack"] for c in made["cells"] if c["defence"] == "chi2_kf"] == ["none", "fdi:value=5", late]
    assert [e["defence"] for e in before["entries"]] == ["none", "kf"] and "incomplete" not in made["entries"][2]["why"]
    assert [a["attack"] for a in made["attacks"] if a.get("shared")] == [late]
    for path in out.glob("small-v0/rows*"):
        path.unlink()
    place.write_text(json.dumps(before).replace(late, "never_made:Attack"))
    with pytest.raises(InputError, match="code to import"):
        _run(str(file), "--out", str(out), "--defence", "chi2_kf", "--keep-entries")
    assert not list(out.glob("small-v0/rows*"))
