"""What the pages of a board say of detection."""

import json
import re
from pathlib import Path

import pytest

from tailgate.board.files import read_board
from tailgate.board.order import ordered
from tailgate.board.words import at_least, percent
from tailgate.site.index import attacks_of, detection_of, ranked_against
from tailgate.site.suite import Suite

from . import boards
from .boards import entry, make_board

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return boards.make_site(tmp_path_factory.mktemp("site"), boards.crashed_row())


@pytest.fixture(scope="module")
def index(site):
    return boards.Outline(site.read_text(encoding="utf-8"))


def test_detection_is_shown_attack_by_attack(index):
    """At the middle time between false alarms: per attack a row, per defence the share in the scenario where it sees least of it."""
    cases = [c for c in make_board("x")["detection"]["entries"] if c["hours"] == 1]
    lines = [re.sub(r"\s+", " ", text).strip() for _, text in index.lines]
    for attack in dict.fromkeys(c["attack"] for c in cases):
        least = {}
        for c in cases:
            if c["attack"] == attack and c["detected"]:
                least[c["defence"]] = min(least.get(c["defence"], 1.0), c["detected"]["value"])
        shown = [percent(least[g]) if g in least else "\N{EN DASH}" for g in dict.fromkeys(c["defence"] for c in cases)]
        assert any(line.startswith(attack.split(":")[0]) and " ".join(["", *shown]) in line for line in lines)


def test_the_headline_is_the_mean_and_the_least_stands_below(index):
    """Each script and scenario weighs the same; in the made-up board there is one."""
    (case,) = [c for c in make_board()["detection"]["entries"] if c["defence"] == "cusum_kf" and c["hours"] == 1]
    share = percent(case["detected"]["value"])
    rows = [re.sub(r"\s+", " ", text).strip() for _, text in index.lines]
    assert any(row.startswith("cusum_kf") and f"{share} {share}, at least {at_least(case['detected']['low'])}:" in row for row in rows)


def test_a_mean_is_of_all_scripts_and_scenarios():
    """Two scripts, of which one is not seen; one that could not be played does not count."""
    board = make_board()
    told = next(c for c in board["detection"]["entries"] if c["defence"] == "kf" and c["hours"] == 1)
    more = [told | {"attack": f"dropout:trigger=near,threshold={at}", "detected": {"value": v, "low": 0.0, "high": 1.0} if v is not None else None} for at, v in ((40, 0.0), (50, None))]
    board["detection"]["entries"] = [told | {"detected": {"value": 1.0, "low": 0.9, "high": 1.0}}, *more]
    row = detection_of(Suite(read_board(board), ""))["rows"][0]
    assert [(c["text"], c["least"]) for c in row["cells"] if c["least"]] == [("50%", "0%")]


def test_what_is_watched_and_what_is_rarer_is_said(index, site):
    """Beside the defence, and beside the figure that it is of; the entry's page says so too, another's does not."""
    rows = [re.sub(r"\s+", " ", text) for _, text in index.lines if re.match(r"\s*kf\s+watched", text)]
    assert rows and all(re.fullmatch(r"( kf watched)( \d+% \d+%, at least [^%]*%: [^%]*){2} \d+% rarer \d+%, at least [^%]*%: [^%]*", row) for row in rows)
    mine, other = (entry(site, name).read_text(encoding="utf-8") for name in ("kf", "cusum_kf"))
    assert mine.count('<span class="param">rarer</span>') == 1 and "This defence has no threshold" in mine and "This defence has no threshold" not in other


def test_attacks_that_joined_later_are_told_from_those_of_the_suite():
    """Of a board of a suite of the package; of another nobody knows."""
    board = json.loads((ROOT / "results/quick-v0/board.json").read_text(encoding="utf-8"))
    told = {line["name"].full.split(" ")[0]: line["admitted"] for line in attacks_of(Suite(read_board(board), "quick-v0"))}
    assert told["burst_loss"] == "met later, outside the suite" and told["dropout"] == "with the suite" and "p " in told["fdi_ramp"]
    board["suite"]["hash"] = "0"
    assert {line["admitted"] for line in attacks_of(Suite(read_board(board), "quick-v0")) if line["name"].full == "burst_loss"} == {"with the suite"}


@pytest.mark.parametrize(("name", "said"), [
    ("quick-v0", "CEM, black box, 2 training seeds of each (less than the full plan: PPO and CEM, black and grey box, 5 seeds)"),
    ("network-v0", "PPO and CEM, black box, 5 training seeds of each (less than the full plan: PPO and CEM, black and grey box, 5 seeds)"),
    ("thesis-v0", "PPO and CEM, black and grey box, 5 training seeds of each"),
])  # fmt: skip
def test_a_board_says_which_attackers_a_rank_asks_for(name, said):
    """And where that is less than the full plan; of a suite that is not of the package nobody can tell."""
    board = json.loads((ROOT / f"results/{name}/board.json").read_text(encoding="utf-8"))
    assert ranked_against(Suite(read_board(board), name)) == said
    board["suite"]["hash"] = "another"
    assert ranked_against(Suite(read_board(board), name)) == ""


def test_a_class_of_one_s_own_comes_before_sentinels():
    """Who plays a class for development looks for it among the unranked."""
    board = make_board()
    mine = board["entries"][-1]
    mine |= {"status": "unranked", "rank": None, "why": "claimed: played on public seeds"}
    there = [entry.defence for entry in ordered(read_board(board).entries) if entry.status == "unranked"]
    assert there[0] == mine["defence"] and len(there) > 2
