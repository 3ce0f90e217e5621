"""`leaderboard export`: a board for a paper."""

import csv
import io
import json
import re
from pathlib import Path
from typing import Any

import pytest

from tailgate.board.export import COLUMNS, FORMATS, SPECIAL, TITLE, escaped, exported
from tailgate.board.files import load
from tailgate.board.head import lines
from tailgate.cli import main

FILE = Path(__file__).parents[1] / "results" / "quick-v1" / "board.json.xz"


def _csv(board: dict[str, Any], most: int | None = None) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(exported(board, "csv", most).decode())))


@pytest.mark.parametrize("name", ["radar-v1", "quick-v1"])
def test_every_figure_of_the_csv_is_that_of_the_board(name: str) -> None:
    """A line for each defence, dose and knowledge, in the order of the page."""
    board = load(FILE.parents[1] / name / "board.json.xz")
    rows, held = _csv(board), {entry["defence"]: entry for entry in board["entries"]}
    assert list(dict.fromkeys(row["defence"] for row in rows)) == [line[0] for line in lines(board)[1:]]
    assert len(rows) == sum(len(entry["rates"]) for entry in board["entries"]) and tuple(rows[0]) == COLUMNS
    smallest = min(board["suite"]["doses"])
    for row in rows:
        entry = held[row["defence"]]

        def at(part: str, row: dict[str, str] = row, entry: dict[str, Any] = entry) -> dict[str, Any]:
            return next((one for one in entry[part] if (str(one["dose"]), one["knowledge"]) == (row["dose"], row["knowledge"])), {})

        rate, harm, rank = at("rates"), at("under_attack"), entry["rank"] or {"best": None, "worst": None}
        none, hard = at("pointwise")["undamaged"] or {"value": None, "low": None, "high": None}, harm.get("severity", {})
        dose = entry["critical_dose"][row["knowledge"]]
        wanted = {
            "class": entry["class"], "status": entry["status"], "why": entry["why"], "rank_best": rank["best"], "rank_worst": rank["worst"],
            "undamaged": rate["undamaged"]["value"], "undamaged_low": rate["undamaged"]["low"], "attacks": rate["attacks"],
            "worst_scenario": rate["worst"]["scenario"], "worst_attack": rate["worst"]["attack"], "no_attack_damages": none["value"],
            "no_attack_damages_low": none["low"], "no_attack_damages_high": none["high"], "impact_mean": hard.get("mean"),
            "impact_q90": hard.get("q90") if hard.get("measured", 0) >= 10 else None, "impacts": hard.get("measured"), "impact_most": hard.get("most"),
            "distance_kept": harm.get("availability"), "distance_kept_least": (harm.get("least") or {}).get("value"),
            "mean_gap_change": entry["mean_gap"]["value"] if entry["mean_gap"] else None,
        } | {
            f"critical_dose{end}": "above" if dose[key] is None else "below" if 0 < dose[key] <= smallest else dose[key]
            for end, key in (("", "value"), ("_low", "low"), ("_high", "high"))
        }  # fmt: skip
        assert {name: row[name] for name in wanted} == {name: "" if value is None else str(value) for name, value in wanted.items()}
        assert not entry["rank"] or int(row["ranked_in_class"]) == sum(e["rank"] is not None and e["class"] == entry["class"] for e in held.values())
    assert {"below", "above"} <= {row["critical_dose"] for row in rows}


@pytest.mark.long
def test_csv_of_few_defences_and_of_one_without_figures() -> None:
    board = load(FILE)
    assert len({row["defence"] for row in _csv(board, 3)}) == 3
    bare = board | {"entries": [entry | {"rates": []} if entry["defence"] == "none" else entry for entry in board["entries"]]}
    (row,) = [row for row in _csv(bare) if row["defence"] == "none"]
    assert row["status"] == "unranked" and row["why"] and not row["dose"]
    unlimited = json.loads(json.dumps(board).replace('"dose": 12', '"dose": null')) | {"suite": board["suite"] | {"doses": [None], "shown": {}}}
    assert {row["dose"] for row in _csv(unlimited)} == {"none"}


def test_every_column_of_the_csv_is_explained() -> None:
    page = (FILE.parents[2] / "docs/leaderboard-page.md").read_text(encoding="utf-8").partition("## Figures as CSV")[2]
    assert re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \|", page, flags=re.M))) == list(COLUMNS)


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


@pytest.mark.long
@pytest.mark.parametrize(("form", "start"), [("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_pictures_are_vectors_and_repeat(form: str, start: bytes, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    board = json.loads((FILE.parents[1] / "car-following-v0" / "board.json").read_text())
    first = exported(board, form)
    assert first.startswith(start) and first == exported(board, form) and len(first) > 5_000
    assert main(["leaderboard", "export", str(FILE), "--format", form, "--out", str(tmp_path / "a")]) == 0
    assert (tmp_path / "a").read_bytes().startswith(start)


def test_a_picture_says_who_has_no_rank() -> None:
    pytest.importorskip("matplotlib")
    held, text = load(FILE), exported(load(FILE), "svg").decode()
    assert {bool(entry["rank"]) for entry in held["entries"]} == {True, False}
    for entry in held["entries"]:
        assert (f"<!-- {entry['defence']} (no rank) -->" in text) == (not entry["rank"])


def test_another_form_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["leaderboard", "export", str(FILE), "--format", "docx"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "docx" in error and all(form in error for form in FORMATS)


def test_a_published_board_has_a_name(capsysbinary: pytest.CaptureFixture[bytes], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A file of that name comes first; a name that no board has is refused with the names that are there."""
    assert main(["leaderboard", "export", "quick-v1", "--format", "csv"]) == 0
    assert capsysbinary.readouterr().out == exported(load("quick-v1"), "csv") == exported(load(FILE), "csv")
    assert main(["leaderboard", "export", "quick-v7", "--format", "csv"]) == 2
    error = capsysbinary.readouterr().err
    assert b"'quick-v7'" in error and b"quick-v1" in error and error.count(b"\n") == 1
    monkeypatch.chdir(tmp_path)
    (tmp_path / "quick-v1").write_text("{}")
    assert main(["leaderboard", "export", "quick-v1", "--format", "csv"]) == 2
    assert b"format" in capsysbinary.readouterr().err
