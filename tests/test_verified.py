"""A board says of each entry whether its rows were played again, and with what outcome."""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import pytest

from tailgate.base.errors import InputError
from tailgate.board.files import board_in, load, read_board
from tailgate.board.run import VERIFIED, board_of
from tailgate.cli import verify as command
from tailgate.core.scenario import Suite, list_suites, load_suite
from tailgate.core.schema import as_data
from tailgate.evaluation.cells import cells_of, run
from tailgate.evaluation.rows import encode
from tailgate.site.build import build_site
from tailgate.training.adaptive import asked_of
from tailgate.training.train import TrainConfig, plan_key

from .commands import ran

ROOT = Path(__file__).parents[1]
SUITE = Suite("small", "", ("thesis-ch4-v0",), (5,), ("none", "kf"), ("none", "fdi:value=5"), 4)
BOARDS = sorted(path.parent.name for path in (ROOT / "results").glob("*/board.json*"))


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    return run(cells_of(SUITE))


def _verify(folder: Path, *arguments: str, name: str = "report") -> dict[str, Any]:
    out = folder / VERIFIED / f"{name}.json"
    files = sorted(str(path) for path in folder.glob("*.jsonl"))
    ran(command, "verify", "--rows", *files, "--out", str(out), *arguments)
    held: dict[str, Any] = json.loads(out.read_text())
    return held


def _verified(folder: Path) -> dict[str, Any]:
    board = board_of(SUITE, folder, require_adaptive=False)
    return {entry["defence"]: entry["verified"] for entry in board["entries"]}


def _write(folder: Path, name: str, rows: list[dict[str, Any]]) -> None:
    (folder / name).write_bytes(encode(rows))


@pytest.mark.long
def test_rows_that_come_out_equal_are_said_of_their_entries(rows: list[dict[str, Any]], tmp_path: Path) -> None:
    _write(tmp_path, "rows.jsonl", rows)
    assert _verified(tmp_path) == {"none": None, "kf": None}
    assert _verify(tmp_path)["status"] == "verified"
    all_of = {"rows": 8, "verified": 8, "differs": 0, "unchecked": 0}
    assert _verified(tmp_path) == {"none": all_of, "kf": all_of}
    page = build_site([json.loads((tmp_path / "board.json").read_text())], tmp_path / "page", replays=False)
    assert "rows of 2 of 2 entries replayed without a difference: all 16 rows, all equal" in page.read_text()
    assert "Replayed: all 8 rows were played again and came out equal." in next((page.parent).glob("*/kf.html")).read_text()


def test_files_without_rows_are_an_error(tmp_path: Path) -> None:
    _write(tmp_path, "rows.jsonl", [])
    with pytest.raises(InputError, match="at least one row"):
        _verify(tmp_path)
    assert not (tmp_path / VERIFIED / "report.json").exists()


@pytest.mark.long
def test_a_sample_says_how_many(rows: list[dict[str, Any]], tmp_path: Path) -> None:
    _write(tmp_path, "rows.jsonl", rows)
    _verify(tmp_path, "--sample", "10", "--sample-seed", "1")
    held = _verified(tmp_path)
    assert sum(v["verified"] for v in held.values()) == 10 and {v["rows"] for v in held.values()} == {8}
    page = build_site([json.loads((tmp_path / "board.json").read_text())], tmp_path / "page", replays=False)
    n = held["kf"]["verified"]
    most = round(100 * (1 - 0.05 ** (1 / n)))
    words = f"Replayed: {n} of 8 rows, drawn at random, were played again and came out equal. At most {most}% of them differ, at 95%."
    assert words in next((page.parent).glob("*/kf.html")).read_text()


@pytest.mark.long
def test_one_row_that_differs_is_said_of_its_entry(rows: list[dict[str, Any]], tmp_path: Path) -> None:
    k = next(k for k, row in enumerate(rows) if row["defence"] == "kf")
    _write(tmp_path, "rows.jsonl", [*rows[:k], rows[k] | {"min_gap": 99.0}, *rows[k + 1 :]])
    _verify(tmp_path)
    held = _verified(tmp_path)
    assert held["kf"] == {"rows": 8, "verified": 7, "differs": 1, "unchecked": 0} and held["none"]["verified"] == 8
    board = read_board(json.loads((tmp_path / "board.json").read_text()))
    sound = {entry.defence: entry.verified.sound for entry in board.entries if entry.verified}
    assert sound == {"none": True, "kf": False}
    page = build_site([json.loads((tmp_path / "board.json").read_text())], tmp_path / "page", replays=False)
    assert "rows of 1 of 2 entries replayed without a difference: all 16 rows, 1 of them differ" in page.read_text()
    assert "Replayed: all 8 rows were played again; 1 differ." in next((page.parent).glob("*/kf.html")).read_text()


def test_a_report_on_other_rows_counts_for_nothing(rows: list[dict[str, Any]], tmp_path: Path) -> None:
    """Rows that were made anew after the report, and rows of a file that no report has looked into."""
    _write(tmp_path, "rows.jsonl", rows)
    _verify(tmp_path)
    more = run(cells_of(dataclasses.replace(SUITE, attacks=("dropout",))))
    _write(tmp_path, "more.jsonl", [row for row in more if row["defence"] == "kf"])
    held = _verified(tmp_path)
    assert held["kf"] is None and held["none"]["verified"] == 8
    _verify(tmp_path, name="both")
    assert _verified(tmp_path)["kf"] == {"rows": 12, "verified": 12, "differs": 0, "unchecked": 0}
    _write(tmp_path, "rows.jsonl", rows[::-1])
    assert list(_verified(tmp_path).values()) == [None, None]


@pytest.mark.parametrize(
    ("text", "words"),
    [("{", "report"), ("[]", "report"), ('{"format": "other", "files": []}', "format"),
     ('{"format": "tailgate-verify-1", "files": [{"file": "a", "entries": [{"defence": "kf", "verified": -1, "differs": 0, "unchecked": 0}]}]}', "verified")],
)  # fmt: skip
def test_a_report_that_is_none_is_named(rows: list[dict[str, Any]], tmp_path: Path, text: str, words: str) -> None:
    _write(tmp_path, "rows.jsonl", rows)
    (tmp_path / VERIFIED).mkdir()
    (tmp_path / VERIFIED / "report.json").write_text(text)
    with pytest.raises(InputError, match=words):
        board_of(SUITE, tmp_path, require_adaptive=False)


@functools.cache
def _published(name: str) -> Any:
    return load(board_in(ROOT / f"results/{name}"))


@pytest.mark.thin(15)
@pytest.mark.parametrize("name", BOARDS)
def test_a_published_board_is_of_the_suite_that_is_here(name: str) -> None:
    """A suite that changed leaves its board behind until its rows are played again."""
    assert name in list_suites()
    board = _published(name)
    assert board["suite"]["hash"] == load_suite(name).hash
    for entry in read_board(board).entries:
        again = entry.checked
        assert (entry.verified and entry.verified.sound) or (again and again.equal > 0 == again.differs), entry.defence


@pytest.mark.parametrize("name", BOARDS)
def test_no_figure_of_a_published_board_rests_on_a_policy_that_is_not_here(name: str) -> None:
    """The worst of rates, critical doses and robustness rows, and worst episodes, can be played by whoever clones."""
    board = _published(name)
    named = set()
    for entry in board["entries"]:
        worst = [*entry["rates"], *(dose for dose in entry["critical_dose"].values() if dose), *entry["robustness"]]
        named |= {one["worst"]["attack"] for one in worst} | ({entry["worst_episode"]["attack"]} if entry["worst_episode"] else set())
    files = [attack.partition("path=")[2] or attack for attack in named if attack.endswith((".json", ".yaml"))]
    assert named and all((ROOT / file).is_file() for file in files)


# Plans of before whose policies count on: those of radar-v0 answered late by 60 m (decision 30).
EARLIER = {"radar-v0": {"1ea5def9aee4fb47", "20e6fc0e71aa5875", "49a9e01c935738ac", "7ea5b769dc8e2028"}}


@pytest.mark.parametrize("name", [name for name in BOARDS if (ROOT / f"results/{name}/attacked/policies").is_dir()])
def test_published_attackers_are_those_that_the_suite_asks_for(name: str) -> None:
    """A change of the fields of a training, or of a suite's plan, would leave every defence unattacked; those of an earlier plan are told."""
    asked = {(want.plan, want.seed) for want in asked_of(load_suite(name))}
    found = sorted((ROOT / f"results/{name}/attacked/policies").glob("*/policy-*.json"))
    met = set()
    for path in found:
        training = json.loads(path.read_text(encoding="utf-8"))["training"]
        plan = plan_key(training["config"])
        assert (plan, training["seed"]) in asked or plan in EARLIER.get(name, ()), path
        met.add(plan)
    assert met & {plan for plan, _ in asked}


def test_a_field_at_its_default_leaves_no_mark_on_a_plan() -> None:
    config = as_data(TrainConfig())
    before = {key: value for key, value in config.items() if key != "demonstrations"}
    assert plan_key(config) == plan_key(before) != plan_key(config | {"demonstrations": 32})


def test_rows_of_another_round_make_no_board(rows: list[dict[str, Any]], tmp_path: Path) -> None:
    beacon = "a beacon of sixteen letters or more"
    _write(tmp_path, "rows.jsonl", rows)
    with pytest.raises(InputError, match="public seeds"):
        board_of(SUITE, tmp_path, beacon=beacon, require_adaptive=False)
    _write(tmp_path, "rows.jsonl", run(cells_of(SUITE, beacon=beacon)))
    with pytest.raises(InputError, match="that of the rows, a beacon"):
        board_of(SUITE, tmp_path, beacon="another beacon of such a length", require_adaptive=False)
    assert board_of(SUITE, tmp_path, beacon=beacon, require_adaptive=False)["suite"]["beacon"] == beacon
    assert board_of(SUITE, tmp_path, require_adaptive=False)["suite"]["beacon"] == beacon  # not asked for: the rows' own
