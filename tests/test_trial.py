"""`leaderboard try`: a class of one's own on a board, attacked and ranked for a look."""

import json
from pathlib import Path

import pytest

from tailgate.board.gates import explained, failure
from tailgate.board.trial import published
from tailgate.cli import main
from tailgate.core.scenario import list_suites, load_suite

SUITE = """about: s
progress: 0.5
measures: true
scenarios: [radar-braking-v0]
doses: [4]
defences: [none, kf, stand_still]
attacks: [none, 'noise_jam:start_step=10', 'noise_jam:trigger=near,threshold=60']
seeds: 8
threat: {delay_bound: 60.0}
adaptive: {ensemble: quick}
"""
CLASS = "from tailgate.estimators import GatedKalman\n\n\nclass Mine(GatedKalman):\n    pass\n"


@pytest.mark.long
def test_from_a_class_to_its_place_on_a_board(
    small_ensemble: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The board keeps its entries; the class is attacked, ranked provisionally, first on the page, and its worst episode is replayed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("suite-v1.yaml").write_text(SUITE)
    Path("tried_defence.py").write_text(CLASS)
    assert main(["leaderboard", "run", "suite-v1.yaml", "--out", "out", "--train", "--no-replays", "--workers", "1"]) == 0
    board = Path("out/suite-v1/board.json")
    before = json.loads(board.read_text())
    words = ["leaderboard", "try", "tried_defence:Mine", "--suite", "suite-v1.yaml", "--board", str(board), "--workers", "1"]
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    entry = json.loads(capsys.readouterr().out)
    assert entry["status"] == "ranked" and entry["why"] == "provisional: tried outside a round" and entry["rank"] is not None
    made_in = next(Path("tried").glob("*/suite-v1"))
    made = json.loads((made_in / "board.json").read_text())
    assert {e["defence"] for e in made["entries"]} == {"none", "kf", "stand_still", "tried_defence:Mine"}
    old = {e["defence"]: e for e in before["entries"]}
    assert all(e["rates"] == old[e["defence"]]["rates"] for e in made["entries"] if e["defence"] in old)
    assert {line["defence"] for line in made["searches"]} == {"kf", "tried_defence:Mine"}
    page = Path(entry["page"]).read_text()
    table = page.partition("<tbody>")[2]
    assert table.index("tried_defence") < table.index("kf") and 'class="own"' in table and "provisional" in table
    assert "tried_defence" in Path(entry["replay"]).read_text()
    files = {path: path.read_bytes() for path in Path("tried").glob("*/**/*") if path.is_file()}
    assert main(words) == 0 and "provisional" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in Path("tried").glob("*/**/*") if path.is_file()} == files  # nothing is played again
    Path("tried_defence.py").write_text(CLASS.replace("    pass", "    eta: float = 3.0"))
    assert main(["leaderboard", "run", "suite-v1.yaml", "--out", str(made_in.parent), "--keep-entries", "--score-only"]) == 2
    assert main([*words, "--json"]) == 0  # the changed class is another one
    assert len(list(Path("tried").glob("*/suite-v1/board.json"))) == 2 and json.loads(capsys.readouterr().out)["defence"] == "tried_defence:Mine"
    assert json.loads(board.read_text()) == before  # the board that it joined stays as it is


@pytest.mark.parametrize(
    ("defence", "words"),
    [("bwrap/some:Class", "without a sandbox"), ("kf", "a class of yours"), ("no_such_defence", "no_such_defence")],
)
def test_what_cannot_be_tried_is_refused(
    defence: str, words: str, small_ensemble: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["leaderboard", "try", defence, "--out", "tried"]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1 and not list(Path("tried").glob("*"))


def test_boards_that_are_shipped_are_of_their_suites() -> None:
    """A suite that changes leaves no old board behind, and a board that changes no old copy."""
    from importlib.resources import files

    shipped = {path.name.removesuffix(".json.xz"): path for path in Path(str(files("tailgate.configs").joinpath("boards"))).glob("*.json.xz")}
    assert {"quick-v1", "car-following-v1", "radar-v1"} <= set(shipped) <= set(list_suites())
    for name, path in shipped.items():
        assert published(load_suite(name)) is not None, name
        assert path.read_bytes() == (Path(__file__).parents[1] / f"results/{name}/board.json.xz").read_bytes(), name


def test_a_class_that_fails_in_every_episode_is_one_error(
    small_ensemble: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It names the line of the class; no page is made. Attacks that the suite does not grant are skipped, and change nothing."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("suite-v1.yaml").write_text(SUITE.replace("[none, 'noise", "[none, 'replay:start_step=10', 'noise"))
    Path("broken_defence.py").write_text(CLASS.replace("    pass", "    def step(self, *arguments):\n        return 1 / 0"))
    assert main(["leaderboard", "try", "broken_defence:Mine", "--suite", "suite-v1.yaml", "--quiet", "--workers", "1"]) == 2
    error = capsys.readouterr().err
    assert "expected a class that plays an episode to its end (ZeroDivisionError" in error and "broken_defence.py, line 6" in error
    assert not list(Path("tried").glob("**/index.html"))


def test_a_class_without_a_rank_is_told_each_gate_that_it_fails() -> None:
    found = [
        {"gate": "gap", "scenario": "a", "value": 0.4, "limit": 0.1, "passed": False},
        {"gate": "false alarms", "scenario": "b", "value": 0.98, "limit": 0.5, "passed": False},
        {"gate": "jerk", "scenario": "a", "value": 1.0, "limit": 1.2, "passed": True},
    ]
    gap, alarms = explained(found)
    assert gap == "gate gap: 0.4 on a, limit 0.1 (by how much the mean gap is longer than that of the undefended car, as a share of it)"
    assert alarms.startswith("gate false alarms: 0.98 on b, limit 0.5 (share of the time") and "tailgate calibrate" in alarms
    assert explained([{"gate": "clean run", "scenario": "a", "value": None, "limit": None, "passed": False}]) == ["gate clean run: no clean run to judge by on a"]
    assert failure(found) == "gate gap: 0.4 on a, limit 0.1, and 1 more"
