"""What the timing of a board's trained attackers is worth: played on the board's own episodes, and said on its pages."""

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from tailgate.agents.policy.network_policy import Yoked
from tailgate.base.errors import InputError
from tailgate.board.attachments import Attachments, Gain, Shown, Timed, Timing
from tailgate.board.cells import hits_of
from tailgate.board.timing import measure_timing, telling
from tailgate.cli import main
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario, load_suite
from tailgate.play.trace import Trace, rollout
from tailgate.site.build import build_site

from .boards import make_board

Data = dict[str, Any]
ROOT = Path(__file__).parents[1]
PLACE = ROOT / "results/quick-v0/board.json"
QUICK = load_suite("quick-v0")
MADE = sorted(ROOT.glob("results/*/timing.json"))


@pytest.fixture(autouse=True)
def at_home(monkeypatch: pytest.MonkeyPatch) -> None:
    """A board's paths begin in the root of a clone."""
    monkeypatch.chdir(ROOT)


@pytest.fixture
def board() -> Data:
    held: Data = json.loads(PLACE.read_text())
    return held


@pytest.mark.long
def test_own_and_yoked_are_of_fresh_episodes_in_which_nobody_was_chosen(board: Data) -> None:
    """Written out here, on the episodes after those of the board: who attacked when without an end, moved on by one episode, with values
    that are still the policy's own."""
    made = measure_timing(board, QUICK, ["chi2_kf_sparse"], episodes=60)
    (entry,) = made.entries
    cell = telling(board, "chi2_kf_sparse")
    assert isinstance(cell, dict) and (entry.attack, entry.scenario, entry.dose) == (cell["attack"], cell["scenario"], 12)
    assert entry.board == hits_of(cell).mean() == cell["damage"]["value"] <= entry.most and entry.episodes == 60
    policy = Spec("attack", cell["attack"]).make()
    place = load_scenario(cell["scenario"]).with_threat(**QUICK.granted, budget=12, knowledge=cell["knowledge"])
    loop, keys = place.loop(Spec("defence", "chi2_kf_sparse").make()), draws.keys("report", range(100, 160))
    times = rollout(loop, policy, keys, terminate=False).kind != 0
    moved = np.concatenate([times[:, -1:], times[:, :-1]], axis=1)
    own, twin = (_crashed(rollout(loop, attack, keys)) for attack in (policy, Yoked(policy, moved)))
    assert (entry.own.value, entry.yoked.value) == (own.mean(), twin.mean())
    gain = entry.advantage
    assert gain.value == pytest.approx(own.mean() - twin.mean()) and (gain.only_own, gain.only_yoked) == ((own & ~twin).sum(), (twin & ~own).sum())
    assert gain.p == gain.adjusted == pytest.approx(stats.binomtest(gain.only_own, gain.only_own + gain.only_yoked).pvalue)
    assert entry.verdict == "more" and not entry.outdone and entry.periodic.value < 0.1 and 1 < entry.schedules <= 60


def _crashed(trace: Trace) -> Any:
    return (trace.collided | trace.rear_collided)[np.minimum(trace.length, len(trace.kind)) - 1, np.arange(trace.batch)]


def _timed(own: float, yoked: float, counts: tuple[int, int], high: float, adjusted: float, schedules: int = 40, random: float = 0.0) -> Timed:
    def share(value: float) -> Shown:
        return Shown(value=value, low=max(0.0, value - 0.05), high=min(1.0, value + 0.05))

    gain = Gain(value=own - yoked, low=-1.0, high=high, only_own=counts[0], only_yoked=counts[1], p=adjusted, adjusted=adjusted)
    return Timed(
        defence="kf", attack="a.json", scenario="s", dose=1, knowledge="black", board=0.5, most=0.5, episodes=100, schedules=schedules, own=share(own), yoked=share(yoked),
        shuffled=share(random), periodic=share(0.0), advantage=gain,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("entry", "verdict", "outdone"),
    [(_timed(0.6, 0.3, (40, 10), 0.4, 0.001), "more", False), (_timed(0.3, 0.6, (10, 40), -0.2, 0.001), "equal", False),
     (_timed(0.5, 0.5, (20, 20), 0.08, 1.0), "equal", False), (_timed(0.5, 0.45, (20, 15), 0.2, 1.0), "unknown", False),
     (_timed(1.0, 1.0, (0, 0), 0.02, 1.0), "unknown", False), (_timed(0.02, 0.01, (1, 0), 0.03, 1.0), "unknown", False),
     (_timed(0.5, 0.5, (0, 0), 0.02, 1.0, schedules=1), "unknown", False), (_timed(0.5, 0.5, (20, 20), 0.08, 1.0, random=0.9), "equal", True)],
)  # fmt: skip
def test_there_are_three_verdicts(entry: Timed, verdict: str, outdone: bool) -> None:
    """More by the exact test; equal where an advantage surely stays small; else, saturated or always at the same times, nobody knows."""
    assert (entry.verdict, entry.outdone) == (verdict, outdone)


def test_the_cell_that_is_nearest_to_a_half_speaks_for_an_entry() -> None:
    """Of the worst attackers at each dose; not of somebody else's, of one that was taken back, or whose file is not here."""
    here = "results/quick-v0/policies/kf-jump/policy-{}.json"

    def cell(attack: str, dose: int, share: float, knowledge: str = "black") -> Data:
        return {"defence": "kf", "attack": attack, "dose": dose, "scenario": "s", "knowledge": knowledge, "failed": 0, "n": 10, "damage": {"value": share}}

    lines = [{"attack": here.format(i), "trained_on": "kf"} for i in range(2)]
    cells = [cell(here.format(0), 5, 0.2), cell(here.format(1), 5, 0.08), cell(here.format(0), 10, 0.5), cell(here.format(1), 10, 0.9), cell(here.format(0), 20, 1.0)]
    assert telling({"attacks": lines, "cells": cells}, "kf") == cells[0]
    assert telling({"attacks": [lines[0], lines[1] | {"withdrawn": True}], "cells": cells}, "kf") == cells[2]
    assert telling({"attacks": [lines[0] | {"trained_on": "rkf"}, lines[1]], "cells": cells}, "kf") == cells[3]
    gone = [line | {"attack": f"gone/{line['attack']}"} for line in lines]
    assert "not here" in telling({"attacks": gone, "cells": [c | {"attack": f"gone/{c['attack']}"} for c in cells]}, "kf")
    assert "trained against it" in telling({"attacks": [], "cells": cells}, "kf") and "import" in telling({"attacks": lines, "cells": cells}, "never_made:Guard")
    even = [cell(here.format(0), 5, 0.2, "grey"), cell(here.format(1), 5, 0.2)]
    assert telling({"attacks": lines, "cells": even}, "kf") == even[1] and "did damage" in telling({"attacks": lines, "cells": [cell(here.format(0), 5, 0.0)]}, "kf")


@pytest.mark.long
def test_a_cell_that_says_something_else_is_not_believed(board: Data) -> None:
    """Nor is it where it does not say which episodes came to damage; a defence that is not on the board is refused."""
    changed = copy.deepcopy(board)
    cell = telling(changed, "chi2_kf_sparse")
    assert isinstance(cell, dict)
    cell["hits"] = cell["hits"][:-2] + ("00" if cell["hits"][-2:] != "00" else "10")
    made = measure_timing(changed, QUICK, ["chi2_kf_sparse"], episodes=4)
    assert not made.entries and "not what the board's cell says" in made.without[0].why
    cell["hits"] = None
    assert len(measure_timing(changed, QUICK, ["chi2_kf_sparse"], episodes=4).entries) == 1
    cell["damage"]["value"] -= 0.01
    assert not measure_timing(changed, QUICK, ["chi2_kf_sparse"], episodes=4).entries
    for defence in ("dkf", "nobody"):
        with pytest.raises(InputError, match="defence"):
            measure_timing(board, QUICK, [defence])
    with pytest.raises(InputError, match="suite"):
        measure_timing(board, load_suite("radar-v0"))
    with pytest.raises(InputError, match="episodes"):
        measure_timing(board, QUICK, episodes=1)


@pytest.mark.long
def test_an_attacker_that_cannot_be_played_costs_its_own_figures_alone(board: Data) -> None:
    """A file that is no policy, or one of another kind of system."""
    strange = {"rkf": "results/quick-v0/run.json", "cusum_kf": "results/transfer-v0/nothing.json", "mewma_kf": str(next(Path("src/tailgate/agents/policies").glob("platoon-dkf-0.json")))}
    for defence, path in strange.items():
        old = telling(board, defence)["attack"]
        for line in [*board["attacks"], *board["cells"]]:
            line["attack"] = path if line["attack"] == old else line["attack"]
    made = measure_timing(board, QUICK, [*strange, "chi2_kf_sparse"], episodes=4)
    assert [entry.defence for entry in made.entries] == ["cusum_kf", "chi2_kf_sparse"]  # cusum_kf has another one whose file is here
    assert [missing.defence for missing in made.without] == ["rkf", "mewma_kf"] and all(missing.why for missing in made.without)


@pytest.mark.long
def test_the_command_writes_the_file_and_the_pages_show_it(board: Data, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "quick-v0"
    folder.mkdir()
    ranked = ["rkf", "chi2_kf_sparse", "safe_state_brake"]
    for entry in board["entries"]:
        entry["rank"] = entry["rank"] if entry["defence"] in ranked else None
    (folder / "board.json").write_text(json.dumps(board))
    assert main(["leaderboard", "timing", "quick-v0", "--out", str(tmp_path), "--defence", "rkf", "--episodes", "20"]) == 0
    assert not (folder / "timing.json").exists() and "undecided" in capsys.readouterr().out
    assert main(["leaderboard", "timing", "quick-v0", "--out", str(tmp_path), "--json", "--episodes", "60"]) == 0
    held = json.loads(capsys.readouterr().out)
    made = Timing.read(folder / "timing.json")
    assert made == Timing.model_validate_json(json.dumps(held)) and [e.defence for e in made.entries] == ranked[:2] and made.without[0].defence == ranked[2]
    assert main(["leaderboard", "page", str(folder / "board.json"), "--out", str(tmp_path / "page"), "--no-replays"]) == 0
    pages = {name: (tmp_path / f"page/quick-v0/{name}.html").read_text() for name in (*ranked, "kf")}
    gain = made.entries[1].advantage
    assert f"<b>+{100 * gain.value:.0f} points</b>" in pages["chi2_kf_sparse"] and "At its own times it surely does more" in pages["chi2_kf_sparse"]
    assert "undecided" in pages["rkf"] and 'id="timing"' not in pages["kf"] and "No attacker that was trained against it did damage" in pages["safe_state_brake"]
    assert "yoked equals own" not in (tmp_path / "page/index.html").read_text()
    held["entries"][1]["advantage"] |= {"adjusted": 1.0, "high": 0.05}
    held["entries"][1]["shuffled"] |= {"low": 0.95, "value": 0.96, "high": 0.97}
    (folder / "timing.json").write_text(json.dumps(held))
    page = ["leaderboard", "page", str(folder / "board.json"), "--out", str(tmp_path / "page"), "--no-replays"]
    assert main(page) == 0
    for name in ("index", "quick-v0/chi2_kf_sparse"):
        text = (tmp_path / f"page/{name}.html").read_text()
        assert "yoked equals own" in text and "outdone by its twins" in text
    held["entries"][1]["board"] = 0.5  # what was measured of another board's attacker is not shown beside this one
    (folder / "timing.json").write_text(json.dumps(held))
    assert main(page) == 0 and 'id="timing"' not in (tmp_path / "page/quick-v0/chi2_kf_sparse.html").read_text()


def test_what_is_no_timing_of_the_board_is_refused(board: Data, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="timing advantages: suite"):
        build_site([make_board()], tmp_path / "page", measured=[Attachments(timing=Timing.read(ROOT / "results/quick-v0/timing.json"))])
    mine = json.loads(PLACE.read_text())
    for change in ({"hash": "0"}, {"beacon": "0123456789abcdef"}):
        with pytest.raises(InputError, match=f"timing advantages: {next(iter(change))}"):
            build_site([mine | {"suite": mine["suite"] | change}], tmp_path / "page", measured=[Attachments(timing=Timing.read(ROOT / "results/quick-v0/timing.json"))])
    shutil.copy(PLACE, tmp_path / "board.json")
    for text in ("{", "{}", json.dumps({"format": "tailgate-step-time-1"})):
        (tmp_path / "timing.json").write_text(text)
        with pytest.raises(InputError, match=r"timing advantages.*timing\.json"):
            Timing.read(tmp_path / "timing.json")
        assert main(["leaderboard", "page", str(tmp_path / "board.json"), "--out", str(tmp_path / "page")]) == 2 and not (tmp_path / "page").exists()


@pytest.mark.parametrize("path", MADE, ids=lambda path: path.parent.name)
def test_published_timings_are_of_their_boards(path: Path) -> None:
    """Every ranked entry is there once, its attacker's cell says the same share of damage, and it is the one that would be looked at today."""
    made, held = Timing.read(path), json.loads(path.with_name("board.json").read_text())
    assert made.suite == held["suite"]["name"] == path.parent.name and made.hash == held["suite"]["hash"]
    assert sorted(entry.defence for entry in [*made.entries, *made.without]) == sorted(e["defence"] for e in held["entries"] if e["rank"])
    for entry in made.entries:
        cell = telling(held, entry.defence)
        assert isinstance(cell, dict) and all(cell[key] == getattr(entry, key) for key in ("attack", "scenario", "dose", "knowledge"))
        gain = entry.advantage
        assert cell["damage"]["value"] == entry.board <= entry.most and gain.value == pytest.approx(entry.own.value - entry.yoked.value)
        assert gain.value == pytest.approx((gain.only_own - gain.only_yoked) / entry.episodes) and gain.low <= gain.value <= gain.high


@pytest.mark.long
@pytest.mark.parametrize(("suite", "defence"), [("radar-v0", "chi2_kf_sparse"), ("thesis-v0", "cra:probability=0.3,quiet=5")])
def test_a_published_timing_comes_out_again(suite: str, defence: str) -> None:
    path = ROOT / f"results/{suite}/board.json"
    (again,) = measure_timing(json.loads(path.read_text()), load_suite(suite), [defence]).entries
    (told,) = (entry for entry in Timing.read(path.with_name("timing.json")).entries if entry.defence == defence)
    assert again.model_dump(exclude={"advantage": {"adjusted"}}) == told.model_dump(exclude={"advantage": {"adjusted"}})


def test_every_board_is_published_with_it() -> None:
    assert len(MADE) == len([*ROOT.glob("results/*/board.json")])
