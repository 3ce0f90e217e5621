"""Tables of commands on a terminal of 80 columns: no name and no heading is broken inside a word."""

import json
import re
import sys

import pytest

from tailgate.cli import main
from tailgate.cli.tables import table

DEFENCES = ("chi2_kf_sparse", "kf", "cusum_kf")
LONG = "fdi_then_jam:trigger=leader_braking,threshold=0.3,inject=15"
ATTACKS = ("none", LONG, "fdi:trigger=near,threshold=40,value=-4")


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Make standard output, which is captured, a plain terminal of 80 columns."""
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(type(sys.stdout), "isatty", lambda _: True)  # the object is another one in the test itself


def columns_of(shown: str) -> list[list[str]]:
    """Return the cells of the lines of a table, by the places at which its rule begins a column."""
    return [[cell.strip() for cell in re.split("[│┃]", line)[1:-1]] for line in shown.splitlines() if re.match("[│┃]", line)]


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize("attacks", [ATTACKS, ATTACKS[:1]])
def test_evaluate_breaks_no_word(attacks: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    """A long attack folds at its commas and colons."""
    line = ["evaluate", "--quiet", "--suite", "quick-v0", "--scenario", "gusty-stop-and-go-v0", "--dose", "40", "--seeds", "20"]
    assert main([*line, *(w for name in DEFENCES for w in ("--defence", name)), *(w for name in attacks for w in ("--attack", name))]) == 0
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    words = {word for text in shown.split() for word in re.split("[│┃,:]", text)}
    for name in (*DEFENCES, "defence", "attack", "collisions", "interval", "median", "onsets", "gusty-stop-and-go-v0"):
        assert name in words
    for attack in attacks:
        assert {part for part in re.split("[,:]", attack)} <= words
    assert ("in every row: knowledge: black; n: 20" in shown) == (len(attacks) > 1)  # which few texts leave room for


@pytest.mark.usefixtures("terminal")
def test_long_texts_that_do_not_fit_are_numbered_and_listed_below(capsys: pytest.CaptureFixture[str]) -> None:
    """Each text once, short ones as they are."""
    long = "trigger_of_a_name_that_is_as_wide_as_the_terminal_itself=leader_braking"
    rows = [(f"defence_{i}", text, "same", "1.00") for i in range(2) for text in (f"fdi:{long},value={i}", "none", f"fdi:{long}")]
    table(("defence", "attack", "knowledge", "collisions"), rows, "a title")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("│")[2].strip() for line in lines if line.startswith("│")] == ["#1", "none", "#2", "#3", "none", "#2"]
    below = re.findall(r"(#\d) fdi:\n?\s*trigger\w+=leader_braking(?:,\n?\s*(value=\d))?", "\n".join(lines))
    assert below == [("#1", "value=0"), ("#2", ""), ("#3", "value=1")] and "same" in lines[5]
    assert max(map(len, lines)) <= 80


@pytest.mark.usefixtures("terminal")
def test_a_table_of_too_many_columns_is_a_list(capsys: pytest.CaptureFixture[str]) -> None:
    heads = tuple(f"heading_number_{i}" for i in range(9))
    table(heads, [[f"value_{i}_of_{k}" for i in range(9)] for k in range(2)], "a title", "and more")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "a title" and lines[-1] == "and more" and max(map(len, lines)) <= 80
    found = [tuple(line.split()) for line in lines if line.startswith("heading")]
    assert found == [(head, f"value_{i}_of_{k}") for k in range(2) for i, head in enumerate(heads)]


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize("family", ["defences", "zoo", "traces"])
def test_names_that_are_listed_stay_whole(family: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", family, "--json"]) == 0
    names = [card["name"] for card in json.loads(capsys.readouterr().out)[family]]
    assert main(["list", family]) == 0
    shown = capsys.readouterr().out
    assert names and set(names) <= set(shown.split()) and "…" not in shown


def test_without_a_terminal_a_table_has_its_lines_in_160_columns(capsys: pytest.CaptureFixture[str]) -> None:
    table(("name", "n"), [("[kf]", "1"), ("cusum_kf, and what it is", "20")], "[red]all[/]", numbers=(1,))
    shown = capsys.readouterr().out
    assert "[red]all[/]" in shown
    (head, _), *_ = columns_of(shown)
    assert head == "name" and columns_of(shown)[1:] == [["[kf]", "1"], ["cusum_kf, and what it is", "20"]]
    assert "│  1 │" in shown
