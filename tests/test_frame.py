"""Rows in a notebook."""

import copy
import csv
import io
import json
import sys
from pathlib import Path

import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.board.export import COLUMNS, exported
from tailgate.board.files import load, read_board
from tailgate.board.frame import BoardData
from tailgate.board.head import lines
from tailgate.evaluation.frame import SHOWN, Rows

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def rows():
    return tailgate.evaluate(
        scenarios=["stop-and-go-v0"], defences=["kf", "chi2_kf"], attacks=["none", "fdi:trigger=near,threshold=40,value=-4"], seeds=3
    )


def test_a_row_for_each_episode(rows):
    """An evaluation stays a list, and is a DataFrame with the metrics of the rows."""
    pytest.importorskip("pandas")
    frame = rows.to_pandas()
    assert isinstance(rows, list) and len(frame) == len(rows) == 12
    assert frame["min_gap"].tolist() == [row["min_gap"] for row in rows] and frame["threat_model"][0] == rows[0]["threat_model"]
    assert frame.groupby("defence")["crashed"].mean().to_dict() == {
        name: sum(row["crashed"] for row in rows if row["defence"] == name) / 6 for name in ("kf", "chi2_kf")
    }


def test_a_line_for_each_cell(rows):
    pytest.importorskip("pandas")
    frame, entries = rows.to_pandas(cells=True), rows.summary()
    assert len(frame) == 4 and frame["crash.high"].tolist() == [entry["crash"]["high"] for entry in entries]


def test_a_notebook_shows_cells(rows):
    """Names of others are text there; of many cells some are shown, and how many there are beyond."""
    page = rows._repr_html_()
    assert page.count("<tr>") == 5 and "0.0% (0.0% to 70.8%)" in page and "12 episodes in 4 cells" in repr(rows)
    many = Rows(row | {"attack": f"<b>{i}"} for i in range(SHOWN + 2) for row in rows[:1])
    assert "&lt;b&gt;0" in many._repr_html_() and "<b>" not in many._repr_html_() and "and 2 more cells" in many._repr_html_()


def test_rows_that_did_not_play_say_why(rows):
    skipped = Rows(row | {"status": "skipped", "reason": "no radar here", "min_gap": None} for row in rows[:3])
    assert "no radar here" in skipped._repr_html_()


def test_without_pandas_one_line_says_which_extra(rows, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"pip install 'tailgate\[pandas\]'"):
        rows.to_pandas()


def test_a_board_is_a_frame_with_the_columns_of_the_csv():
    """The same figures: numbers as numbers, none where the CSV has none."""
    pandas = pytest.importorskip("pandas")
    board = load("quick-v1")
    frame, rows = board.to_pandas(), list(csv.DictReader(io.StringIO(exported(board, "csv").decode())))
    assert tuple(frame.columns) == COLUMNS and len(frame) == len(rows)
    for name in COLUMNS:
        assert [None if pandas.isna(x) or x == "" else str(x) for x in frame[name]] == [row[name] or None for row in rows], name
    for name in ("rank_best", "undamaged", "undamaged_low", "attacks"):
        assert pandas.api.types.is_numeric_dtype(frame[name])
    assert isinstance(board, dict) and board == json.loads(json.dumps(board))


def test_a_notebook_shows_the_head_of_a_board():
    board = load("quick-v1")
    page, head = board._repr_html_(), lines(board)
    assert page.count("<tr>") == len(head) and "<th>defence</th>" in page and all(f"<td>{line[0]}</td>" in page for line in head[1:])
    assert repr(board) == "Board quick-v1 of 20 defences and 604 cells; a mapping, .to_pandas()"
    wild = BoardData(json.loads(json.dumps(board).replace('"always_brake"', '"<b>brake"')))
    assert "&lt;b&gt;brake" in wild._repr_html_() and "<b>" not in wild._repr_html_()


def test_a_board_without_pandas_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"pip install 'tailgate\[pandas\]'"):
        load("quick-v1").to_pandas()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda b: b["cells"].append(b["cells"][0]), "a cell that is there once"), (lambda b: b["cells"][0]["damage"].update(value=7.5), "from 0 to 1"),
        (lambda b: b["cells"][0]["damage"].update(low=0.9, value=0.5, high=0.4), "from 0 to 1"), (lambda b: b["entries"][0].update(rank=None), "exactly if ranked"),
        (lambda b: next(e for e in b["entries"] if e["rank"])["rank"].update(best=9, worst=1), "the best place first"),
        (lambda b: next(e for e in b["entries"] if e["rank"])["gates"][0].update(passed=False), "gates that a ranked entry passes"),
        (lambda b: next(c for c in b["cells"] if c.get("hits") and c["damage"]["value"] > 0.0).update(hits="0" * 26), "as its hits say"),
    ],
)  # fmt: skip
def test_a_board_that_contradicts_itself_is_refused(change, words):
    board = copy.deepcopy(load(ROOT / "results" / "quick-v1" / "board.json.xz"))
    board["entries"].sort(key=lambda entry: entry["rank"] is None)
    change(board)
    with pytest.raises(InputError, match=words):
        read_board(board)
