"""Figures that were superseded, beside a board and on its pages."""

import json
from pathlib import Path

import pytest

from tailgate.base.errors import InputError
from tailgate.board.attachments import Attachments, Errata
from tailgate.site.build import build_site

from . import boards

ROOT = Path(__file__).resolve().parents[1]

LINE = {"date": "2026-11-25", "part": "detection", "entries": ["kf"], "what": "Two <b>plants</b> had one threshold.", "moved": "no rank.", "until": "d39bdcd"}
ALL = LINE | {"date": "2026-11-26", "entries": [], "part": "rows", "what": "A seed was met twice."}


def _beside(folder, *lines, **more):
    (folder / "errata.json").write_text(json.dumps({"format": "tailgate-errata-1", "suite": "quick-v0", "errata": [*lines]} | more))
    return folder / "board.json"


def test_they_stand_on_the_board_and_on_the_pages_of_whom_they_are_about(tmp_path):
    """The latest first; text is text; who is not named has only what is of all."""
    beside = Attachments.of(_beside(tmp_path, LINE, ALL))
    assert [one.date for one in beside.superseded()] == ["2026-11-26", "2026-11-25"]
    assert [len(beside.superseded(name)) for name in ("kf", "rkf")] == [2, 1] and Attachments().superseded() == []
    board = boards.make_board("quick-v0")
    build_site([board], tmp_path / "page", replays=False, measured=[beside])
    pages = {path.name: path.read_text(encoding="utf-8") for path in (tmp_path / "page").rglob("*.html")}
    index = pages.pop("index.html")
    assert index.count("A seed was met twice.") == 1 and "Two &lt;b&gt;plants&lt;/b&gt; had one threshold." in index and "figures that were superseded (2)" in index
    named = [name for name, text in pages.items() if "had one threshold" in text]
    assert len(named) == 1 and all("A seed was met twice." in text for text in pages.values())
    build_site([board], tmp_path / "none", replays=False)
    assert "superseded" not in (tmp_path / "none" / "index.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(("change", "field"), [
    ({"date": "25.11.2026"}, "date"), ({"date": "20261125"}, "date"), ({"part": "page"}, "part"), ({"what": ""}, "what"), ({"until": "main"}, "until"),
    ({"entries": "kf"}, "entries"), ({"why": "x"}, "why"),
])  # fmt: skip
def test_a_line_that_is_none_is_named(tmp_path, change, field):
    with pytest.raises(InputError, match=rf"errata.json: errata\.0\.{field}"):
        Errata.of(_beside(tmp_path, LINE | change))


def test_those_of_another_suite_and_what_is_no_file_are_refused(tmp_path):
    beside = Attachments.of(_beside(tmp_path, LINE, suite="radar-v0"))
    with pytest.raises(InputError, match=r"errata: suite.*radar-v0.*quick-v0"):
        build_site([boards.make_board("quick-v0")], tmp_path / "page", replays=False, measured=[beside])
    (tmp_path / "errata.json").write_text("[]")
    with pytest.raises(InputError, match="errata"):
        Errata.of(tmp_path / "board.json")


@pytest.mark.parametrize("path", sorted(ROOT.glob("results/*/errata.json")), ids=lambda path: path.parent.name)
def test_published_errata_are_of_entries_of_their_board_and_in_order(path):
    held = Errata.model_validate_json(path.read_bytes())
    names = {entry["defence"] for entry in json.loads((path.parent / "board.json").read_text())["entries"]}
    assert held.suite == path.parent.name and held.errata and all(names >= {*one.entries} for one in held.errata)
    assert [one.date for one in held.errata] == sorted(one.date for one in held.errata)
