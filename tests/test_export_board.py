"""`leaderboard export`: a board for a paper."""

import csv
import io
import json
from pathlib import Path

import pytest

from tailgate.board.export import FORMATS, SPECIAL, TITLE, escaped, exported
from tailgate.board.files import load
from tailgate.board.head import lines
from tailgate.cli import main

FILE = Path(__file__).parents[1] / "results" / "quick-v1" / "board.json.xz"


def test_csv_has_the_head_cell_for_cell() -> None:
    board = load(FILE)
    rows = list(csv.reader(io.StringIO(exported(board, "csv").decode())))
    assert rows == [list(line) for line in lines(board)]
    assert len(list(csv.reader(io.StringIO(exported(board, "csv", 3).decode())))) == 4


def test_latex_is_a_table_without_a_bare_special_character() -> None:
    """Every row has as many cells as the table has columns; percent signs would comment out the rest."""
    text = exported(load(FILE), "latex", 14).decode()
    body = text.partition(r"\toprule")[2].partition(r"\bottomrule")[0]
    columns = text.partition(r"\begin{tabular}{")[2].partition("}")[0]
    rows = [row for row in body.replace(r"\midrule", "").split(r"\\") if row.strip()]
    assert len(rows) == 15 and all(row.replace(r"\&", "").count("&") == len(columns) - 1 for row in rows)
    assert r"mewma\_kf" in text and r"\%" in text
    assert escaped("<= 2, 1 < 2") == r"$\leq$ 2, 1 \textless{} 2" and r"\label{tab:tailgate-quick-v1}" in text and "critical" not in text
    bare = escaped("".join(SPECIAL))
    assert all(f"\\{c}" in bare for c in "&%$#_{}") and "\\textbackslash{}" in bare


def test_bibtex_names_the_board_and_its_version() -> None:
    text = exported(load(FILE), "bibtex").decode()
    assert text.startswith("@misc{tailgate-quick-v1,") and load(FILE)["suite"]["hash"] in text and "@phdthesis{dutta-2018," in text
    assert text.count("{") == text.count("}") and TITLE in text and TITLE in (FILE.parents[2] / "CITATION.cff").read_text()


@pytest.mark.thin(2)
@pytest.mark.parametrize(("form", "start"), [("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_pictures_are_vectors_and_repeat(form: str, start: bytes, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    board = json.loads((FILE.parents[1] / "car-following-v0" / "board.json").read_text())
    first = exported(board, form)
    assert first.startswith(start) and first == exported(board, form) and len(first) > 5_000
    assert main(["leaderboard", "export", str(FILE), "--format", form, "--out", str(tmp_path / "a")]) == 0
    assert (tmp_path / "a").read_bytes().startswith(start)


def test_another_form_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["leaderboard", "export", str(FILE), "--format", "docx"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "docx" in error and all(form in error for form in FORMATS)
