"""A board that grows, where all that rows can be is in it: two scenarios, every knowledge, optima, failures, errata, classes that change."""

import copy
import dataclasses
import functools
import json
from typing import Any

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.board.consistency import strays
from tailgate.board.files import read_board
from tailgate.evaluation.attack_list import Admitted

from . import scored
from .scored import OTHER, ROAD, board, cell, entry

Data = dict[str, Any]
GUARDS = ("none", "kf", "rkf", "imm", "chi2_kf", "safe_state", "brake_kf")
USES = {"safe_state": ["measurements", "v2v"], "brake_kf": ["measurements", "v2v"]}
SUITE = scored.suite(scenarios=(ROAD, OTHER), robustness=(OTHER,), attacks=("none", "fdi", "dos_jam", "stealth", "ghost"), defences=GUARDS)
LISTED = Admitted("dropout", "", "black", "2026-11-25")
LINES = [LISTED, Admitted("echo", "", "grey", "2026-11-25"), dataclasses.replace(Admitted("echo", "", "grey", "2026-11-25"), erratum="its bound was wrong")]


def _rows(*guards: str, uses: dict[str, list[str]] = USES) -> list[Data]:
    """The rows of each guard do not depend on who else is there; which episodes are hit is drawn, from none to all."""
    out: list[Data] = []
    for guard in guards:
        rng = np.random.default_rng([*guard.encode()])
        known = {"uses": uses.get(guard, ["measurements"])}

        def hits(most: int, rng: np.random.Generator = rng) -> list[list[int]]:
            return [sorted(rng.permutation(20)[: rng.integers(most + 1)].tolist()) for _ in range(3)]

        for place in (ROAD, OTHER):
            where = known | {"scenario": place}
            out += cell(guard, hits=1 if guard == "brake_kf" and place == OTHER else 0, **where)
            out += cell(guard, "fdi", hits(20 if guard in ("kf", "none") else 4), **where)
            out += cell(guard, "dos_jam", hits(8), **where, knowledge="grey")
            out += cell(guard, "ghost", hits(20), **where, knowledge="white", optimal=True)
            out += cell(guard, "dropout", hits(6), **where)
            out += cell(guard, "echo", 20, **where, knowledge="grey")
            skipped = guard == "none" or place == OTHER
            out += [r | ({"status": "skipped", "reason": f"no gate in {guard}"} if skipped else {}) for r in cell(guard, "stealth", hits(5), **where)]
            own = {"defence": guard, "digest": "", "version": 1, "plan": "p", "seed": 0}
            if guard != "none":
                policy = cell(guard, f"runs/{guard}/policy-0.json", hits(10), **where, learned=True, trained=own, attack_digest=f"of {guard}", knowledge="grey" if guard == "imm" else "black")
                out += [r | ({"status": "error", "reason": "it broke"} if guard == "rkf" and r["number"] == 3 and place == ROAD else {}) for r in policy]
    return out


@functools.cache
def _made(*guards: str) -> Data:
    return dict(board(_rows(*guards), SUITE, attacks=LINES))


def _whole(*guards: str) -> Data:
    return copy.deepcopy(_made(*guards))


def _as_read(made: Data) -> Data:
    read_board(held := json.loads(json.dumps(made)))
    return dict(held)


def test_what_is_in_the_board() -> None:
    """Else the tests below would compare less than they say."""
    made = _whole(*GUARDS)
    status = {e["defence"]: e["why"].partition(":")[0] for e in made["entries"]}
    assert status["rkf"] == "incomplete" and status["none"] == "baseline" and status["brake_kf"] == "gate collisions"
    assert [e["defence"] for e in made["entries"] if e["status"] == "ranked"] == ["kf", "imm", "chi2_kf", "safe_state"]
    assert {c["knowledge"] for c in made["cells"]} == {"black", "grey", "white"} and sum(c["failed"] for c in made["cells"]) == 3
    assert {e["class"] for e in made["entries"]} == {"measurements", "measurements + v2v"}
    assert [a["attack"] for a in made["attacks"] if a["withdrawn"]] == ["echo"] and any(e["robustness"] for e in made["entries"])
    assert [a["digest"] for a in made["attacks"] if a["learned"]] == [f"of {guard}" for guard in sorted(GUARDS[1:])]
    assert len({d["p"] for d in made["comparisons"]}) > 2 and strays(_as_read(made), SUITE) == []


@pytest.mark.parametrize("guards", [*((guard,) for guard in GUARDS[1:]), ("kf", "safe_state"), ("rkf", "imm", "chi2_kf", "brake_kf"), GUARDS[1:]], ids=",".join)
@pytest.mark.thin(3)
def test_rows_beside_a_board_make_what_all_rows_make(guards: tuple[str, ...]) -> None:
    whole = _whole(*GUARDS)
    before = _as_read(_whole(*(guard for guard in GUARDS if guard not in guards)))
    assert board(_rows("none", *guards), SUITE, attacks=LINES, board=before) == whole
    assert board(_rows("none", *guards), SUITE, attacks=LINES, board=_as_read(whole)) == whole


@pytest.mark.thin(3)
@pytest.mark.parametrize("guard", ["kf", "safe_state", "brake_kf"])
def test_an_entry_that_changes_its_class(guard: str) -> None:
    """Ranks of the class that it left, and of the one that it joined, are made again."""
    uses = USES | {guard: ["measurements"] if guard in USES else ["measurements", "v2v"]}
    whole = board(_rows(*GUARDS, uses=uses), SUITE, attacks=LINES)
    made = board(_rows("none", guard, uses=uses), SUITE, attacks=LINES, board=_as_read(_whole(*GUARDS)))
    assert made == whole and (made["comparisons"] != _whole(*GUARDS)["comparisons"] or guard == "brake_kf")  # which takes no rank


def _more(*guards: str, hits: int = 20) -> list[Data]:
    """Rows of an attacker that was trained on somebody else, against every guard that is named, in both scenarios."""
    origin = {"defence": "chi2_dkf", "digest": "", "version": 1, "plan": "p", "seed": 0}
    out: list[Data] = []
    for guard in guards:
        rng = np.random.default_rng([7, *guard.encode()])
        for place in (ROAD, OTHER):
            some = [sorted(rng.permutation(20)[: rng.integers(hits + 1)].tolist()) for _ in range(3)]
            rows = cell(guard, "zoo:name=x", some, scenario=place, uses=USES.get(guard, ["measurements"]), learned=True, trained=origin)
            out += [r | {"min_gap": float(r["seed"] % 7), "attack_steps": 2.0} for r in rows]
    return out


def _sorted(made: Data) -> Data:
    return dict(made | {"entries": [e | {"flags": sorted(e["flags"])} for e in made["entries"]]})


@pytest.mark.parametrize("hits", [0, 2, 20])
@pytest.mark.parametrize("guards", [("safe_state",), ("kf", "imm", "brake_kf"), GUARDS], ids=",".join)
@pytest.mark.thin(3)
def test_entries_that_meet_one_attack_more(guards: tuple[str, ...], hits: int) -> None:
    """Its rows alone make what all rows make, whether it does the most or nothing; another entry may join at once."""
    more, before = _more(*guards, hits=hits), _as_read(_whole(*GUARDS))
    whole = board([*_rows(*GUARDS), *more], SUITE, attacks=LINES)
    made = board(more, SUITE, attacks=LINES, board=before)
    assert _sorted(made) == _sorted(whole) and strays(_as_read(made), SUITE) == []
    if hits == 20:
        assert made["entries"] != before["entries"] and any(e["worst_episode"] != b["worst_episode"] for e, b in zip(made["entries"], before["entries"], strict=True))
    less = _as_read(_whole(*(guard for guard in GUARDS if guard != "chi2_kf")))
    both = [*_more(*(guard for guard in guards if guard != "none"), hits=hits), *_rows("none", "chi2_kf"), *(_more("none", hits=hits) if "none" in guards else [])]
    assert _sorted(board(both, SUITE, attacks=LINES, board=less)) == _sorted(whole)


@pytest.mark.parametrize("hits", [0, 2, 20])
@pytest.mark.parametrize("guards", [("kf",), ("imm", "chi2_kf"), GUARDS], ids=",".join)
@pytest.mark.thin(3)
def test_what_was_compared_still_bounds_what_met_more(guards: tuple[str, ...], hits: int) -> None:
    """Where cells do not tell which episodes were hit: p is no smaller than of all rows, and hardly larger where the new attack does little."""
    before, more = _as_read(_whole(*GUARDS)), _more(*guards, hits=hits)
    for c in before["cells"]:
        c["hits"] = None
    made, whole = _as_read(board(more, SUITE, attacks=LINES, board=before)), board([*_rows(*GUARDS), *more], SUITE, attacks=LINES)
    pairs = list(zip(made["comparisons"], whole["comparisons"], strict=True))
    assert all(one["p"] >= all_["p"] * (1 - 1e-9) for one, all_ in pairs) and strays(made, SUITE) == []
    if hits == 0:
        assert [one["p"] for one, _ in pairs] == pytest.approx([all_["p"] for _, all_ in pairs])
    for name in ("kf", "imm", "chi2_kf", "safe_state"):
        wide, rank = entry(made, name)["rank"], entry(whole, name)["rank"]
        assert wide["best"] <= rank["best"] and rank["worst"] <= wide["worst"]


def test_an_attack_that_joined_the_list_is_met_by_all() -> None:
    """Whoever has not met it would lack figures; its rows against all entries are enough."""
    rows, late = _rows(*GUARDS), [LISTED]
    before = _as_read(board([row for row in rows if row["attack"] not in ("dropout", "echo")], SUITE))
    new = [row for row in rows if row["attack"] == "dropout"]
    made = board(new, SUITE, attacks=late, board=before)
    assert _sorted(made) == _sorted(board([row for row in rows if row["attack"] != "echo"], SUITE, attacks=late))
    with pytest.raises(InputError, match=r"dropout on .*counts against imm"):
        board([row for row in new if row["defence"] != "imm"], SUITE, attacks=late, board=before)


@pytest.mark.parametrize("hits", [0, 20])
def test_an_attacker_of_ones_own_that_joins(hits: int) -> None:
    """It counts as any other; that others do more than one's own is said of all of one's own. Whose trainings were met is not."""
    more = [row | {"trained": row["trained"] | {"defence": "kf", "plan": "q"}} for row in _more("kf", hits=hits)]
    other = [row | {"attack": "zoo:name=y"} for row in _more("kf", hits=20)]
    before = _as_read(board([*_rows(*GUARDS), *other], SUITE, attacks=LINES))
    made = board(more, SUITE, attacks=LINES, board=before)
    assert _sorted(made) == _sorted(board([*_rows(*GUARDS), *other, *more], SUITE, attacks=LINES))


def test_what_a_defence_has_met_is_not_given_by_the_way() -> None:
    """Half of a cell's doses would be half of an attack."""
    before = _as_read(board([row for row in _rows(*GUARDS) if row["attack"] != "echo"], SUITE, attacks=[LISTED]))
    with pytest.raises(InputError, match=r"rows of kf: got .*all .* cells that the board has"):
        board([row | {"knowledge": "grey", "config_hash": scored.hash_of(row["scenario"], row["dose"], "grey")} for row in cell("kf", "fdi", 3)]
              + cell("kf", "fdi", 3, scenario=OTHER, knowledge="grey"), SUITE, attacks=[LISTED], board=before)  # fmt: skip


def test_an_attack_that_was_taken_back_since_is_refused() -> None:
    """All figures of the others change with it."""
    before = _as_read(_whole(*GUARDS))
    with pytest.raises(InputError, match="dropout"):
        board(_rows("none", "kf"), SUITE, attacks=[*LINES, dataclasses.replace(LISTED, erratum="wrong")], board=before)
