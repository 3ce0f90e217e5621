"""What the pages of a board say of detection."""

import importlib.util
import re
from pathlib import Path

import pytest

from tailgate.leaderboard.build import percent

spec = importlib.util.spec_from_file_location("boards", Path(__file__).with_name("boards.py"))
boards = importlib.util.module_from_spec(spec)
spec.loader.exec_module(boards)
make_board, entry = boards.make_board, boards.entry


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


def test_what_is_watched_and_what_is_rarer_is_said(index, site):
    """Beside the defence, and beside the figure that it is of; the entry's page says so too, another's does not."""
    rows = [re.sub(r"\s+", " ", text) for _, text in index.lines if re.match(r"\s*kf\s+watched", text)]
    assert rows and all(row.count("rarer") == 1 and row.index("rarer") > row.rindex("%") for row in rows)
    mine, other = (entry(site, name).read_text(encoding="utf-8") for name in ("kf", "cusum_kf"))
    assert mine.count('<span class="param">rarer</span>') == 1 and "no threshold of its own" in mine and "no threshold of its own" not in other
