"""`leaderboard export`: a board for a paper."""

import csv
import io
import json
from pathlib import Path

import pytest

from tailgate.board.export import COLUMNS, FORMATS, SPECIAL, TITLE, escaped, exported
from tailgate.board.files import load
from tailgate.board.head import lines
from tailgate.cli import main

FILE = Path(__file__).parents[1] / "results" / "quick-v1" / "board.json.xz"


def _csv(name: str, most: int | None = None) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(exported(load(FILE.parents[1] / name / "board.json.xz"), "csv", most).decode())))


def test_csv_has_the_figures_of_the_head_as_numbers() -> None:
    """For each dose and each knowledge; in the order of the page."""
    rows = [row for row in _csv("radar-v1") if row["knowledge"] == "black" and row["status"] == "ranked"]
    head = lines(load(FILE.parents[1] / "radar-v1/board.json.xz"))
    assert len(rows) == 3 * 14 and set(rows[0]) == set(COLUMNS)
    for k, line in enumerate(head[1:15]):
        own, shown = rows[3 * k : 3 * k + 3], dict(zip(head[0], line, strict=True))
        assert {row["defence"] for row in own} == {shown["defence"]} and {row["class"] for row in own} == {shown["class"]}
        for row in own:
            assert shown[f"undamaged at {row['dose']}"].startswith(f"{100 * float(row['undamaged']):.0f} % (at least ")
            assert 0.0 <= float(row["undamaged_low"]) <= float(row["undamaged"]) and row["worst_attack"]
        middle = own[1]
        none, impact = shown["no attack damages at 4"], shown["impact at 4 [m/s]"]
        assert none.startswith(f"{100 * float(middle['no_attack_damages']):.0f} %") and shown["gap"] == f"{100 * float(middle['mean_gap']):+.1f} %"
        assert impact == (f"{float(middle['impact_mean']):.3g} (90 %: {float(middle['impact_q90']):.3g})" if middle["impact_mean"] else "-")


def test_csv_of_few_defences() -> None:
    assert len({row["defence"] for row in _csv("quick-v1", 3)}) == 3


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
