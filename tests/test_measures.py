"""Boards -v1: lost progress is damage; and pointwise worst, severity, availability and the mean gap next to the worst rate."""

import copy
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.board import equal_gap
from tailgate.board.attachments import Attachments, EqualGap
from tailgate.board.cells import hits_of
from tailgate.board.check import check
from tailgate.board.consistency import strays
from tailgate.board.equal_gap import measure_gap
from tailgate.board.files import read_board
from tailgate.board.head import lines
from tailgate.board.measures import VAGUE
from tailgate.board.run import board_of, play
from tailgate.cli import main
from tailgate.core import Array, Mode, Model
from tailgate.core.scenario import Suite, load_suite
from tailgate.core.threat import KNOWLEDGE
from tailgate.estimators import ChiSquare
from tailgate.estimators.compose import Composed
from tailgate.estimators.filters.kalman import KalmanFilter
from tailgate.estimators.parts import Decision, Detector, Filter, Mitigation, Verdict
from tailgate.evaluation.cells import Cell, evaluate, run_cell
from tailgate.evaluation.rows import read_rows
from tailgate.evaluation.stats import limits
from tailgate.site.build import build_site

from .boards import Outline
from .scored import OTHER, ROAD, board, cell, clean, entry, rate, suite

NAMES = ("quick", "car-following", "radar", "platoon", "network")
MEASURED = suite(progress=0.5, measures=True, attacks=("none", "fdi", "dropout"))


def _table() -> list[dict[str, Any]]:
    """Twenty episodes a cell. Of `kf` fdi ends 0 to 3 in collisions and stops 4 and 5; dropout ends 5 to 7 in collisions."""
    rows = [*clean("kf", time_gap_inflation=0.05), *cell("kf", "fdi", 4), *cell("kf", "dropout", [[5, 6, 7]] * 3), *cell("none", "fdi"), *cell("none", "dropout")]
    for row in rows:
        if row["defence"] == "kf":
            if row["attack"] == "fdi":
                row["impact_speed"] = {0: 2.0, 1: 4.0, 2: 9.0}.get(row["number"])  # 3: from behind, without a speed
                row["distance_travelled"] = 600.0 if row["number"] < 4 else 499.0 if row["number"] < 6 else 1000.0
            elif row["attack"] == "dropout":
                row["distance_travelled"] = 500.0  # half of the way: not less
                row["impact_speed"] = 3.0 if row["crashed"] else None
            elif row["attack"] == "none":
                row["time_gap_inflation"] = 0.155
    return rows


def test_the_measures_of_a_table_that_is_known_by_hand() -> None:
    made = board(_table(), MEASURED)
    read_board(made)
    assert made["suite"]["progress"] == 0.5 and made["suite"]["measures"] is True
    found = entry(made, "kf")
    assert rate(found, 20)["undamaged"]["value"] == 0.7 and rate(found, 20)["worst"]["attack"] == "fdi"
    point = next(p for p in found["pointwise"] if (p["dose"], p["knowledge"]) == (20, "black"))
    low, high = limits(np.array([12.0]), np.array([20]), 0.05 / 2)
    assert point["undamaged"] == {"value": 12 / 20, "low": low[0], "high": high[0]}, "0 to 3, 4, 5 and 5, 6, 7 are damaged"
    assert (point["scenario"], point["attacks"], point["reason"]) == (ROAD, 2, "")
    line = next(u for u in found["under_attack"] if u["dose"] == 20)
    assert line["worst"] == {"scenario": ROAD, "attack": "fdi"}
    severity = line["severity"]
    assert {key: severity[key] for key in ("collisions", "measured", "stops", "reason")} == {"collisions": 4, "measured": 3, "stops": 2, "reason": ""}
    assert (severity["mean"], severity["median"], severity["most"]) == (5.0, 4.0, 9.0) and severity["q90"] == pytest.approx(8.0)
    assert line["availability"] == pytest.approx((4 * 0.6 + 2 * 0.499 + 14) / 20)
    assert line["least"] == {"value": 0.5, "scenario": ROAD, "attack": "dropout"}
    assert found["mean_gap"] == {"value": pytest.approx(0.1), "episodes": 20}
    spared = next(u for u in entry(made, "none")["under_attack"] if u["dose"] == 20)
    assert spared["severity"]["mean"] is None and spared["severity"]["reason"] == "no collision" and spared["availability"] == 1.0
    assert strays(made, MEASURED) == []


def test_without_the_fields_nothing_is_new() -> None:
    """Boards -v0 stay as they are, to the last byte."""
    made = board(_table(), suite(attacks=("none", "fdi", "dropout")))
    assert not {"progress", "measures"} & set(made["suite"])
    assert all(not {"pointwise", "under_attack", "mean_gap"} & set(one) for one in made["entries"])
    assert rate(entry(made, "kf"), 20)["undamaged"]["value"] == 0.8, "who stops is not damaged there"
    assert len(lines(made)[0]) == len(lines(board(_table(), MEASURED))[0]) - 4


def test_progress_alone_brings_no_columns_and_measures_alone_change_no_damage() -> None:
    stopped = board(_table(), suite(progress=0.5, attacks=("none", "fdi", "dropout")))
    told = board(_table(), suite(measures=True, attacks=("none", "fdi", "dropout")))
    assert rate(entry(stopped, "kf"), 20)["undamaged"]["value"] == 0.7 and "pointwise" not in entry(stopped, "kf")
    assert rate(entry(told, "kf"), 20)["undamaged"]["value"] == 0.8 and entry(told, "kf")["under_attack"][0]["severity"]["stops"] == 0


@pytest.mark.parametrize("lost", ["absent", "failed"])
def test_a_defence_without_clean_runs_takes_no_rank(lost: str) -> None:
    """Its lost progress cannot be told: its cells have no figures, and the gate says why."""
    rows = [row for row in _table() if lost == "failed" or (row["defence"], row["attack"]) != ("kf", "none")]
    for row in rows:
        if (row["defence"], row["attack"], row["number"]) == ("kf", "none", 3):
            row |= {"status": "error", "reason": "boom", "distance_travelled": None}
    made = board(rows, MEASURED)
    found = entry(made, "kf")
    assert found["status"] == "unranked" and found["why"].startswith("gate clean run") and found["rates"] == found["under_attack"] == []
    assert all("clean run" in c["reason"] and c["damage"] is None and c["failed"] == 20 for c in made["cells"] if c["defence"] == "kf" and c["attack"] != "none")
    assert strays(made, MEASURED) == []


def test_cells_that_do_not_say_which_episodes_have_no_pointwise_worst() -> None:
    made = board(_table(), MEASURED)
    for one in made["cells"]:
        one["hits"] = None
    (stray,) = [s for s in strays(made, MEASURED) if (s["defence"], s["field"]) == ("kf", "pointwise")]
    assert {line["reason"] for line in stray["here"]} == {VAGUE} and {line["undamaged"] is None for line in stray["here"]} == {True}


def test_a_wrong_pointwise_worst_is_named() -> None:
    made = board(_table(), MEASURED)
    entry(made, "kf")["pointwise"][0]["undamaged"]["value"] = 0.95
    assert [(s["defence"], s["field"]) for s in strays(made, MEASURED)] == [("kf", "pointwise")]


def test_the_pointwise_worst_is_of_the_worst_scenario_and_never_above_the_rate() -> None:
    rng, where = np.random.default_rng(7), suite(scenarios=(ROAD, OTHER), progress=0.5, measures=True, attacks=("none", "fdi", "dropout"))
    rows = [row for name in (ROAD, OTHER) for row in clean("kf", scenario=name)]
    for name in (ROAD, OTHER):
        for defence in ("kf", "none"):
            for attack in ("fdi", "dropout"):
                rows += cell(defence, attack, [list(map(int, rng.choice(20, size=rng.integers(0, 12), replace=False))) for _ in range(3)], scenario=name)
    made = board(rows, where)
    for defence in ("kf", "none"):
        found = entry(made, defence)
        for point in found["pointwise"]:
            hurt = {name: {r["number"] for r in rows if (r["defence"], r["scenario"], r["dose"]) == (defence, name, point["dose"]) and r["crashed"]} for name in (ROAD, OTHER)}
            assert point["undamaged"]["value"] == pytest.approx(1 - max(map(len, hurt.values())) / 20)
            assert point["undamaged"]["low"] <= point["undamaged"]["value"] <= rate(found, point["dose"])["undamaged"]["value"]
    assert board(rows[::-1], where) == made, "in whatever order rows come"


def test_an_attack_that_joins_later_counts_in_the_measures() -> None:
    """What needs rows of attacks that were met before stays; the new one's is made of its rows and the clean ones."""
    rows = _table()
    first = board([row for row in rows if row["attack"] != "dropout"], replace(MEASURED, attacks=("none", "fdi")))
    late = [row for row in rows if row["attack"] in ("none", "dropout") and row["defence"] == "kf"]
    grown = board(late, replace(MEASURED, attacks=("none", "fdi")), board=first)
    whole = board(rows, replace(MEASURED, attacks=("none", "fdi")))
    for key in ("pointwise", "under_attack", "mean_gap", "rates"):
        assert entry(grown, "kf")[key] == entry(whole, "kf")[key], key


class Halts(Mitigation[None, Array]):
    """Brakes gently, and for good, from the first alarm on."""

    def prepare(self, model: Model) -> None:
        return None

    def start(self, plan: None, batch: int) -> Array:
        return np.zeros(batch, bool)

    def step(self, plan: None, state: Array, verdict: Verdict, received: Any) -> tuple[Array, Decision]:
        halted = state | verdict.alarm.any(axis=-1)
        mode = np.where(halted[:, None], Mode.BRAKE, Mode.NORMAL).astype(np.int8)
        return halted, Decision(received.valid & ~verdict.suspect, mode)


@dataclass(frozen=True)
class Halting(Composed):
    """Gated Kalman filter that comes to a stop at its first alarm, and stays there."""

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), ChiSquare(30.0), Halts()


@pytest.mark.long
def test_who_stands_still_under_attack_is_damaged_from_v1_on() -> None:
    """A car that stops behind a leader who drives on would be as good as one that follows."""
    given = Suite("s", "", ("stop-and-go-v0",), (12,), ("halting", "none"), ("none", "fdi:start_step=100,value=-40"), 6, shown={12: "a"})
    rows = []
    for attack in given.attacks:
        job = Cell("s", "stop-and-go-v0", 12, "halting", attack, 6)
        rows += run_cell(job, Halting(), uses=("measurements",)) + run_cell(replace(job, defence="none"))
    halted = [row for row in rows if (row["defence"], row["attack"]) == ("halting", given.attacks[1])]
    assert all(row["status"] == "ok" and not row["crashed"] for row in halted)
    before = entry(board(rows, given), "halting")
    after = entry(board(rows, replace(given, progress=0.5, measures=True)), "halting")
    assert all(gate["passed"] for gate in after["gates"]), "without an attack it drives as the others do"
    assert rate(before, 12)["undamaged"]["value"] == 1.0 and rate(after, 12)["undamaged"]["value"] == 0.0
    (line,) = (u for u in after["under_attack"] if u["knowledge"] == "black")
    assert line["severity"]["stops"] == 6 and line["severity"]["reason"] == "no collision" and line["availability"] < 0.5


@pytest.mark.parametrize("name", NAMES)
def test_a_suite_v1_is_that_of_v0_with_the_measures(name: str) -> None:
    old, new = load_suite(f"{name}-v0"), load_suite(f"{name}-v1")
    assert new.measures and new.progress == (None if name == "network" else 0.5) and old.progress is None and not old.measures
    assert new == replace(old, name=new.name, about=new.about, progress=new.progress, measures=True, adaptive={"ensemble": "quick"}) and new.hash != old.hash


def test_a_suite_that_cannot_count_progress_is_refused(tmp_path: Path) -> None:
    held = "about: s\ndoses: [5]\ndefences: [kf]\n"
    for text, words in (
        ("progress: 0.5\nscenarios: [braking-v0]\nattacks: [fdi]\n", "attacks: .*none among them"),
        ("progress: 0.5\nscenarios: [network-restless-v0]\nattacks: [none]\n", "progress: .*nobody follows another"),
        ("progress: 1.0\nscenarios: [braking-v0]\nattacks: [none]\n", "progress"), ("progress: 0\nscenarios: [braking-v0]\nattacks: [none]\n", "progress"),
        ("measures: 3\nscenarios: [braking-v0]\nattacks: [none]\n", "measures"),
    ):  # fmt: skip
        (tmp_path / "s.yaml").write_text(held + text)
        with pytest.raises(InputError, match=words):
            load_suite(str(tmp_path / "s.yaml"))


SENTINELS = {"stand_still": "progress", "always_brake": "progress", "always_alarm": "false alarms", "coast": "collisions"}
SMALL = """about: a part of quick-v1
scenarios: [gusty-stop-and-go-v0]
doses: [12]
shown: {12: a}
defences: [none, kf, brake_kf, stand_still, always_brake, always_alarm, coast]
attacks: [none, "dos_jam:trigger=near,threshold=40", "fdi:start_step=200,value=-4"]
seeds: 8
progress: 0.5
measures: true
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Suite, Path]:
    """A small suite, played and scored."""
    folder = tmp_path_factory.mktemp("small")
    (folder / "small-v1.yaml").write_text(SMALL)
    given = load_suite(str(folder / "small-v1.yaml"))
    play(given, folder / "small-v1")
    board_of(given, folder / "small-v1", require_adaptive=False)
    return given, folder / "small-v1"


def test_sentinels_take_no_rank_and_the_reason_names_their_gate(small: tuple[Suite, Path]) -> None:
    made = json.loads((small[1] / "board.json").read_text())
    for name, gate in SENTINELS.items():
        found = entry(made, name)
        assert found["rank"] is None and found["why"] == f"sentinel: useless by design ({gate})"
        assert any(held["gate"] == gate and not held["passed"] for held in found["gates"]), name
    for found in made["entries"]:
        for point in found["pointwise"]:
            assert point["undamaged"]["value"] <= rate(found, 12, point["knowledge"])["undamaged"]["value"]
        kept = {u["availability"] for u in found["under_attack"]}
        assert all(0.0 <= share <= 1.0 for share in kept) and all(u["least"]["value"] <= u["availability"] for u in found["under_attack"])
    hurt = {e["defence"]: next(u for u in e["under_attack"] if u["knowledge"] == "black")["severity"] for e in made["entries"]}
    assert hurt["kf"]["collisions"] > 0 and hurt["kf"]["mean"] > 0.0 and hurt["kf"]["mean"] <= hurt["kf"]["most"]


@pytest.mark.long
def test_a_board_is_checked_from_its_cells_alone(small: tuple[Suite, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Lost progress needs clean runs that a sample of cells may not hold."""
    given, folder = small
    made = json.loads((folder / "board.json").read_text())
    monkeypatch.setattr("tailgate.board.check.suite_of", lambda board: given)
    some = check(made, sample=5)
    assert some["counts"] == {"equal": 5, "differs": 0, "unchecked": 0} and not some["strays"]
    wrong = copy.deepcopy(made)
    entry(wrong, "kf")["under_attack"][0]["availability"] = 0.123
    off = check(wrong)["strays"]
    assert [(stray["defence"], stray["field"]) for stray in off] == [("kf", "under_attack")]


@pytest.mark.long
def test_a_page_has_the_columns_of_a_board_that_has_the_figures(small: tuple[Suite, Path], tmp_path: Path) -> None:
    made = json.loads((small[1] / "board.json").read_text())
    text = build_site([made], tmp_path, replays=False).read_text(encoding="utf-8")
    heads, *rows = Outline(text).rows("cells ranks")
    assert all(words in heads for words in ("No attack damages at 12", "Impact at 12 [m/s]", "Distance kept at 12", "Gap without an attack"))
    assert "a bound with hindsight" in text and "less than 50% of the distance without an attack" in text
    kf = next(row for row in rows if row.startswith("kf "))
    line = next(u for u in entry(made, "kf")["under_attack"] if u["knowledge"] == "black")
    assert f"{line['severity']['mean']:.3g} 90%: {line['severity']['q90']:.3g}" in kf
    page = (tmp_path / "small-v1" / "kf.html").read_text(encoding="utf-8")
    assert "Hindsight, severity and availability" in page and f"<td>{line['severity']['collisions']}</td>" in re.sub(r"\s+", " ", page)
    bare = copy.deepcopy(made)
    del bare["suite"]["measures"], bare["suite"]["progress"]
    without = build_site([bare], tmp_path / "bare", replays=False).read_text(encoding="utf-8")
    assert "No attack damages" not in without and "Distance kept" not in without
    for found in bare["entries"]:  # somebody's board without a road: only the first column
        found["under_attack"], found["mean_gap"] = [], None
    bare["suite"]["measures"] = True
    network = Outline(build_site([bare], tmp_path / "network", replays=False).read_text(encoding="utf-8")).rows("cells ranks")[0]
    assert "No attack damages" in network and "Impact" not in network and "Gap" not in network


def test_at_its_own_headway_the_reference_is_the_entry_of_the_board(small: tuple[Suite, Path]) -> None:
    """Else the comparison would be of two different things: the same episodes, attacks and damage, but for the headway."""
    given, made = small[0], json.loads((small[1] / "board.json").read_text())
    cells = [c for c in made["cells"] if c["defence"] == "kf" and c["attack"] != "none"]
    for held in cells:
        assert equal_gap._harm(made, given, held, 1.0).tolist() == hits_of(held).astype(bool).tolist(), held["attack"]
    assert sum(int(hits_of(held).sum()) for held in cells) > 0


@pytest.mark.long
def test_who_keeps_a_longer_gap_is_compared_at_equal_gap(small: tuple[Suite, Path], tmp_path: Path) -> None:
    given, made = small[0], json.loads((small[1] / "board.json").read_text())
    found = measure_gap(made, given, ["brake_kf", "coast", "stand_still"])
    (line,) = found.entries
    assert line.defence == "coast" and line.gap == entry(made, "coast")["mean_gap"]["value"] > 0.1
    assert 1.0 < line.factor < 4.0 and line.kept == pytest.approx(line.gap, abs=0.005)
    assert line.undamaged.low <= line.undamaged.value and line.undamaged.value >= rate(entry(made, "kf"), 12)["undamaged"]["value"]
    reasons = {one.defence: one.why for one in found.without}
    assert "no longer than that of kf" in reasons["brake_kf"] and "4 times its headway" in reasons["stand_still"]
    assert measure_gap(made, given, ["coast"]).entries == found.entries, "the same figures again"
    path = found.write(tmp_path)
    assert EqualGap.read(path) == found and found.belongs(read_board(made)) == found
    build_site([made], tmp_path / "page", replays=False, measured=[Attachments(gap=found)])
    assert "At equal mean gap" in (tmp_path / "page" / "small-v1" / "coast.html").read_text(encoding="utf-8")
    assert "At equal mean gap" not in (tmp_path / "page" / "small-v1" / "kf.html").read_text(encoding="utf-8")
    entry(made, "coast")["mean_gap"]["value"] = 0.2
    assert found.belongs(read_board(made)).entries == [], "of another gap it says nothing"
    with pytest.raises(InputError, match="measures"):
        measure_gap(made | {"suite": made["suite"] | {"hash": (bare := replace(given, measures=False)).hash}}, bare)
    away = copy.deepcopy(made)
    away["cells"] = [held for held in away["cells"] if held["attack"] == "none"]
    assert "no black-box attack" in measure_gap(away, given, ["coast"]).without[0].why
    with pytest.raises(InputError, match="coat"):
        measure_gap(made, given, ["coat"])


def test_the_terminal_has_the_columns(small: tuple[Suite, Path]) -> None:
    heads, *rows = lines(json.loads((small[1] / "board.json").read_text()))
    assert heads[5:9] == ("no attack damages at 12", "impact at 12 [m/s]", "distance kept at 12", "gap")
    assert all(len(row) == len(heads) for row in rows) and next(row for row in rows if row[0] == "stand_still")[5].startswith("100 %")


def test_evaluate_and_a_score_make_the_board_of_a_suite_v1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the command line: some defences and attacks of quick-v1, few episodes, scored; the same rows by `build`."""
    rows = tmp_path / "quick-v1" / "rows.jsonl"
    given = ["--defence", "kf", "--defence", "brake_kf", "--attack", "none", "--attack", "fdi:start_step=200,value=-4"]
    assert main(["evaluate", "--suite", "quick-v1", *given, "--seeds", "4", "--out", str(rows)]) == 0
    capsys.readouterr()
    assert main(["leaderboard", "run", "quick-v1", "--out", str(tmp_path), "--score-only", "--unattacked", "--no-replays"]) == 0
    shown = capsys.readouterr()
    assert "brake_kf" in shown.out and "hit" not in shown.err
    made = json.loads((tmp_path / "quick-v1" / "board.json").read_text())
    assert made["suite"]["progress"] == 0.5 and {p["attacks"] for e in made["entries"] for p in e["pointwise"]} <= {1}
    assert len(read_rows(rows)) == 2 * 2 * 2 * 4
    assert main(["leaderboard", "build", "--rows", str(rows), "--out", str(tmp_path / "page")]) == 0
    assert Path(capsys.readouterr().out.strip()).is_file()


@pytest.mark.long
def test_a_network_has_the_pointwise_worst_alone() -> None:
    given = replace(load_suite("network-v1"), defences=("kf", "dkf"), attacks=("none", "fdi:value=100"), doses=(5,), shown={5: "a"}, seeds=4, scenarios=("network-restless-v0",))
    made = board(evaluate(given), given)
    for found in made["entries"]:
        assert found["pointwise"] and found["under_attack"] == [] and found["mean_gap"] is None
    assert {point["knowledge"] for point in entry(made, "dkf")["pointwise"]} <= set(KNOWLEDGE)
    assert lines(made)[0][5:7] == ("no attack damages at 5", "why not")
