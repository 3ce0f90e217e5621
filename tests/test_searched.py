"""The standard ensemble on boards: what it finds is played, asked for before a rank, held by the board, and counted by member."""

import dataclasses
import json
import lzma
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from tailgate.base.errors import InputError
from tailgate.board import searched
from tailgate.board.check import SCORED
from tailgate.board.damage import damaged, reach_of
from tailgate.board.files import board_in, load, read_board, save
from tailgate.board.run import board_of, files_of_rows
from tailgate.board.score import score
from tailgate.cli import board as command
from tailgate.cli import main
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_suite
from tailgate.core.veil import secret
from tailgate.ensemble import networks, search, standard
from tailgate.ensemble.battery import Played
from tailgate.ensemble.search import Arena
from tailgate.estimators import Kalman
from tailgate.evaluation.cells import Cell, run
from tailgate.evaluation.rows import read_rows
from tailgate.training.adaptive import SIZES, plan_of

from .commands import ran
from .conftest import shrink_ensemble

ROOT = Path(__file__).parents[1]

TEXT = """about: s
progress: 0.5
measures: true
scenarios: [braking.yaml, heavy.yaml]
robustness: [heavy.yaml]
doses: [4, 9]
defences: [none, chi2_kf, stand_still]
attacks: [none, 'noise_jam:start_step=10']
seeds: 8
threat: {delay_bound: 60.0}
adaptive: {ensemble: quick, doses: [4]}
"""


def _run(*arguments: str) -> None:
    assert ran(command, "run", *arguments, "--no-replays", "--workers", "1") == 0


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a suite's file and its board, made once."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        shrink_ensemble(patch)
        patch.chdir(folder)
        patch.setattr(networks, "zoo_names", lambda: ["radar-following-kf-0"])
        for name in ("braking", "heavy"):  # files with the first 60 s of published scenarios
            data = yaml.safe_load((ROOT / "configs" / "scenarios" / f"radar-{name}-v0.yaml").read_text()) | {"horizon": 60}
            data["threat_model"]["end"] = 55
            if name == "braking":
                data["manoeuvre"]["onset"] = [15.0, 30.0]
            Path(f"{name}.yaml").write_text(yaml.safe_dump(data))
        Path("small-v1.yaml").write_text(TEXT)
        _run("small-v1.yaml", "--out", "out", "--train")
    return folder


@pytest.fixture
def made(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """A copy of the suite's file, and the folder of its board, relative to the working directory."""
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return Path("small-v1.yaml"), Path("out/small-v1")


@pytest.mark.long
def test_one_command_searches_before_it_ranks(made: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Who passes the gates is attacked at the plan's dose; what was found is played at all doses, and once more nothing is."""
    file, folder = made
    data = json.loads((folder / "board.json").read_text())
    assert {e["defence"]: e["status"] for e in data["entries"]} == {"none": "unranked", "chi2_kf": "ranked", "stand_still": "unranked"}
    (line,) = data["searches"]
    cell, light = line["cells"]
    assert (line["defence"], line["budget"], cell["dose"], light["dose"]) == ("chi2_kf", "quick", 4, 4)
    assert [one["member"] for one in cell["members"]] == [one["member"] for one in light["members"]] == [one.name for one in standard.MEMBERS]
    assert {one["member"] for one in light["members"] if one["why"] == standard.ELSEWHERE} == {"networks", "grey networks", "gradient"}
    found = [one["attack"] for one in cell["members"] if one["attack"]]
    for one in (one for one in cell["members"] if one["attack"]):  # the best of those that know as much
        assert one["damage"] == max(m["damage"] for m in cell["members"] if m["knowledge"] == one["knowledge"] and m["damage"] is not None)
    there = [one["attack"] for one in light["members"] if one["attack"]]
    for attack in {*found, *there}:
        mine = [c for c in data["cells"] if c["attack"] == attack]
        places = {"heavy", *(["braking"] if attack in found else [])}
        wanted = {(place, "chi2_kf", dose) for place in places for dose in (4, 9)}
        assert {(c["scenario"], c["defence"], c["dose"]) for c in mine} >= wanted and all(c["n"] == 8 for c in mine)
    trained = {a["attack"]: a["trained_on"] for a in data["attacks"]}
    assert trained == {"noise_jam:start_step=10": None} | dict.fromkeys([*found, *there], "chi2_kf")
    found = [*dict.fromkeys([*found, *there])]
    in_files = [Path(attack.partition("path=")[2]) for attack in found if "path=" in attack]
    assert in_files and all(path.is_file() and path.parent == folder / "attacked" / "found" for path in in_files)
    page = Path("out/page/index.html").read_text()
    assert "Attacks that were searched" in page and f"was played: {len(found)} attacks" in page
    assert all(f"<th scope=\"row\">{member.name}</th>" in page for member in standard.MEMBERS)
    before = {path: path.read_bytes() for path in Path("out").glob("**/*") if path.is_file()}
    monkeypatch.setattr(standard, "search", lambda *_: pytest.fail("searched again"))
    _run(str(file), "--out", "out", "--train")
    assert {path: path.read_bytes() for path in Path("out").glob("**/*") if path.is_file()} == before


@pytest.mark.long
def test_a_rank_asks_for_the_searches(made: tuple[Path, Path]) -> None:
    """Each lack has its reason; a board holds what its statuses need, and entries that stay keep their searches."""
    file, folder = made
    suite, data = load_suite(str(file)), json.loads((folder / "board.json").read_text())
    rows = [row for path in files_of_rows(folder) for row in read_rows(path)]
    again = score(rows, suite, searches=data["searches"])
    assert [[e[k] for k in SCORED] for e in again["entries"]] == [[e[k] for k in SCORED] for e in data["entries"]]
    (line,) = data["searches"]
    attack = next(one["attack"] for one in line["cells"][0]["members"] if one["attack"])

    def why(searches: list[dict[str, object]], some: list[dict[str, object]] = rows) -> str:
        (entry,) = (e for e in score(some, suite, searches=searches)["entries"] if e["defence"] == "chi2_kf")
        assert entry["status"] == "unattacked" and entry["rank"] is None
        return str(entry["why"])

    assert why([]) == "the standard ensemble (budget quick) has not attacked this defence"
    assert why([line | {"budget": "standard"}]) == "the ensemble attacked another budget: standard, not quick"
    assert why([line | {"digest": "abc"}]) == "the ensemble attacked another digest: abc, not none"
    assert why([line | {"seed": 7}]) == "the ensemble attacked another seed: 7, not none"
    empty = [cell | {"members": []} for cell in line["cells"]]
    assert why([line | {"cells": empty}]) == "the search on braking at dose 4 is not whole: no member scripts"
    idle = [cell | {"members": [one | {"attack": None} for one in cell["members"]]} for cell in line["cells"]]
    assert why([line | {"cells": idle}]).endswith("not whole: no attack of a black box")
    fewer = [cell | {"members": [one for one in cell["members"] if one["member"] not in ("feedback", "segments")]} for cell in line["cells"]]
    assert why([line | {"cells": fewer}]) == "the search on braking at dose 4 is not whole: no member feedback"
    cut = [cell | {"members": [one for one in cell["members"] if one["member"] != "segments"]} for cell in line["cells"]]
    for name, cells in (("standard-v1", fewer), ("standard-v2", cut)):
        older = score(rows, suite, searches=[line | {"cells": cells, "ensemble": name}])["entries"]
        assert next(e["rank"] for e in older if e["defence"] == "chi2_kf") is not None
    assert why([line | {"cells": fewer, "ensemble": "standard-v2"}]) == "the search on braking at dose 4 is not whole: no member feedback"
    assert why([line | {"ensemble": "standard-v0"}]) == f"the ensemble attacked another ensemble: standard-v0, not {standard.NAME}"
    left = [cell | {"members": [one | {"damage": None, "attack": None, "why": standard.ELSEWHERE} for one in cell["members"]]} for cell in line["cells"]]
    assert why([line | {"cells": left}]).endswith("not whole: scripts did not search")
    assert why([line | {"cells": []}]) == "the ensemble has not attacked it on braking at dose 4"
    for place in ("braking", "heavy"):
        left = [row for row in rows if (row["attack"], row["scenario"]) != (attack, place)]
        assert why([line], left) == f"what the ensemble found was not played on {place}: {attack}"
    assert score([r for r in rows if r["defence"] != "chi2_kf"], suite, board=data)["searches"] == data["searches"]
    stale = data | {"searches": [line | {"version": 99}]}
    assert score(rows, suite, board=stale, searches=[line])["searches"] == [line]  # an entry that is made of rows takes their search
    read_board(data)
    (folder / "attacked" / "chi2_kf.search.json").rename(folder / "chi2_kf.search.json")  # where a submission's --out may put it
    assert searched.searches_in(folder) == [line]
    (folder / "chi2_kf.search.json").rename(folder / "attacked" / "chi2_kf.search.json")
    (folder / "attacked" / "chi2_kf.search.json").write_text(json.dumps(line | {"cells": 3}))
    with pytest.raises(InputError, match=r"chi2_kf\.search\.json: cells.*list"):
        board_of(suite, folder)
    line["cells"][0]["members"][0]["attack"] = "evil_attack:Evil"
    (folder / "attacked" / "chi2_kf.search.json").write_text(json.dumps(line))
    with pytest.raises(InputError, match="evil_attack"):
        board_of(suite, folder)


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        ("{ensemble: huge}", "ensemble: got 'huge'"), ("{ensemble: quick, doses: [5]}", r"doses: got 5; expected one of the suite's doses \[4, 9\]"),
        ("{config: radar}", "at least one learner, or an ensemble"),
    ],
)  # fmt: skip
def test_plans_that_cannot_be_kept_are_refused(plan: str, words: str, tmp_path: Path) -> None:
    text = TEXT.replace("braking.yaml", "radar-braking-v0").replace("heavy.yaml", "radar-heavy-v0")
    (tmp_path / "s.yaml").write_text(text.replace("{ensemble: quick, doses: [4]}", plan))
    with pytest.raises(InputError, match=words):
        load_suite(str(tmp_path / "s.yaml"))


def test_plans_name_budgets_that_there_are() -> None:
    assert set(SIZES) == set(standard.BUDGETS)
    suite = load_suite("radar-v1")
    assert plan_of(suite).searched(suite) == (2, 4, 9)


@pytest.mark.parametrize("defence", ["brake_kf", "always_brake"])
def test_a_search_counts_lost_progress_as_a_board_does(defence: str) -> None:
    """A car that is made to stand still is damaged in the search that is to find such attacks; without the suite's share it is not."""
    suite = dataclasses.replace(load_suite("quick-v1"), name="test", seeds=32)
    place, dose, attack = "gusty-stop-and-go-v0", 12, "dos_jam:trigger=near,threshold=40"
    arena = Arena("test", place, dose, defence, dict(suite.granted), suite.bound, suite.progress)
    cells = [Cell("test", place, dose, defence, text, 32, "select", threat=suite.granted) for text in ("none", attack)]
    rows = run(cells)
    reach = reach_of(rows[:32])
    share = float(np.mean([damaged(row, suite, reach) for row in rows[32:]]))
    assert arena.confirmed(attack, "select", 0, 32)[0] == share
    crashes = float(np.mean([row["crashed"] for row in rows[32:]]))
    assert dataclasses.replace(arena, progress=None).confirmed(attack, "select", 0, 32)[0] == crashes


def test_lost_progress_raises_the_score_before_it_is_damage() -> None:
    """An episode that is slowed more scores more; half of the clean distance is the suite's limit."""
    arena = Arena("test", "gusty-stop-and-go-v0", 12, "kf", dict(load_suite("quick-v1").granted), None, 0.5)
    moved, far = np.array([100.0, 80.0, 51.0, 49.0]), np.full(4, 100.0)
    played = Played(np.zeros(4, bool), np.full(4, 1e3), np.zeros(4), moved)
    damage, near = arena.harm(played, far)
    assert damage.tolist() == [False, False, False, True] and near.tolist() == pytest.approx([0.0, 0.4, 0.98, 1.0])
    assert arena.harm(played)[0].tolist() == [False] * 4
    assert np.all(np.diff(arena.payment(played, far)) > 0.0)


def test_what_each_member_adds() -> None:
    """A member is compared with the list and with those that know as much or less."""

    def cell(listed: float, **damage: float) -> dict[str, object]:
        known = {"scripts": "black", "networks": "black", "white": "white"}
        return {
            "scenario": "s", "dose": 1, "listed": listed,
            "members": [{"member": m, "knowledge": known[m], "why": "", "damage": x, "attack": None} for m, x in damage.items()],
        }  # fmt: skip

    line = {"cells": [cell(0.2, scripts=0.5, networks=0.4, white=0.9), cell(0.3, scripts=0.3, networks=0.7), cell(0.8, scripts=0.5, white=0.6)]}
    scripts, networks, white = searched.worth([line])
    assert (scripts["cells"], scripts["alone"]) == (3, 1) and scripts["adds"] == pytest.approx(0.1 / 3)
    assert (networks["cells"], networks["alone"]) == (2, 1) and networks["adds"] == pytest.approx(0.2)
    assert (white["cells"], white["alone"]) == (2, 1) and white["adds"] == pytest.approx(0.2) and white["damage"] == pytest.approx(0.75)


@pytest.mark.long
def test_a_packed_board_is_read_and_kept_packed(made: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    """The head of both files is the same; scoring goes on with the packed one; a damaged one is refused in one line."""
    file, folder = made
    plain = folder / "board.json"
    data = load(plain)
    packed = Path(f"{plain}.xz")
    save(data, packed)
    plain.unlink()
    assert board_in(folder) == packed and load(packed) == data and packed.stat().st_size < 20_000
    capsys.readouterr()
    assert main(["leaderboard", "head", str(packed)]) == 0 and "| chi2_kf" in capsys.readouterr().out
    _run(str(file), "--out", "out", "--score-only")
    assert not plain.exists() and load(packed) == data
    packed.write_bytes(packed.read_bytes()[:-20])
    capsys.readouterr()
    assert main(["leaderboard", "head", str(packed)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    packed.write_bytes(lzma.compress(b" " * (80 << 20)))
    assert main(["leaderboard", "head", str(packed)]) == 2


def test_a_round_has_a_search_of_its_own() -> None:
    """Nobody knows the seed of a round before its beacon; an author cannot run the same search at home."""
    one, two = (searched.seed_of(f"a beacon of sixteen letters, number {i}") for i in range(2))
    assert searched.seed_of("") == 0 != one != two != 0


def test_a_class_in_a_sandbox_is_searched_behind_the_veil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It could be weak where it is searched and strong where it is scored, if it knew the keys of the episodes."""
    seen: list[bytes] = []
    monkeypatch.setattr(standard, "_search", lambda *_: seen.append(secret()) or {})
    for text in ("bwrap/mydefence:Mine", "chi2_kf"):
        standard.search(SimpleNamespace(arena=SimpleNamespace(defence=text)), tmp_path)  # type: ignore[arg-type]
    assert seen[0] and not seen[1]


def test_a_gradients_program_competes_with_black_boxes(tmp_path: Path) -> None:
    """It knows the defence while it is looked for and only the road when it is played: a stronger white box does not replace it."""
    def member(name: str, knowledge: str, attack: str, score: float) -> dict[str, Any]:
        return {"member": name, "knowledge": knowledge, "why": "", "found": [{"attack": attack, "damage": score, "score": score}]}

    members = [
        member("scripts", "black", "fdi:value=-1", 0.1), member("white box", "white", "stealth", 0.9), member("gradient", "white", "fdi:value=-2", 0.5),
    ]  # fmt: skip
    cell = searched._cell({"scenario": "road", "dose": 4, "listed": None, "members": members}, tmp_path)
    assert [one["attack"] for one in cell["members"]] == ["fdi:value=-1", "stealth", "fdi:value=-2"]


def test_two_boards_in_a_folder_are_refused(tmp_path: Path) -> None:
    for name in ("board.json", "board.json.xz"):
        save({}, tmp_path / name)
    with pytest.raises(InputError, match="one board in the folder"):
        board_in(tmp_path)


@pytest.mark.thin(4)
@pytest.mark.parametrize(
    ("suite", "place", "attack"),
    [
        ("car-following-v1", "gusty-stop-and-go-v0", "stealth:trigger=near,threshold=18"),
        ("car-following-v1", "gusty-stop-and-go-v0", "zoo:name=car-following-chi2_kf-2"),
        ("platoon-v1", "platoon-gusty-v0", "fdi_gaussian:start_step=3,mean=-3,sd=1"), ("lane-v0", "lane-keeping-v0", "fdi:start_step=200,value=1"),
        ("lane-v0", "lane-keeping-v0", "none"), ("network-v1", "network-restless-v0", "fdi:value=5"),
    ],
)  # fmt: skip
def test_whole_episodes_have_the_outcome_of_their_trace(suite: str, place: str, attack: str) -> None:
    """An attack that the engine traces is played in one program, a white box too; a step at a time says the same."""
    spec, keys = Spec("attack", attack), draws.keys("select", range(16))
    arena = Arena("test", place, 10, "dkf" if "network" in suite else "chi2_kf", dict(load_suite(suite).granted), load_suite(suite).bound)
    loop = arena.seat(spec.entry.knowledge, spec.make())
    whole = search._whole(loop, spec.make(), keys)
    assert whole is not None
    if not loop.model.followers.any():
        whole = whole._replace(moved=np.full(len(whole.moved), np.nan))  # nobody drives
    for name, one, other in zip(Played._fields, whole, search._stepwise(loop, spec.make(), keys), strict=True):
        assert np.array_equal(one, other, equal_nan=True), name


@dataclasses.dataclass(frozen=True)
class Late(Kalman):
    """A filter whose score is no number from step 20 on."""

    def step(self, plan: Any, state: Any, received: Any, known_u: Any, draws: Any) -> Any:
        state, estimate = super().step(plan, state, received, known_u, draws)
        return state, estimate._replace(score=np.where((draws.step >= 20)[:, None], np.inf, estimate.score))


def test_a_defence_whose_numbers_are_refused_is_told_so_by_a_search() -> None:
    """The program plays on behind a demand that failed; the search does not take its outcome."""
    arena = Arena("test", "gusty-stop-and-go-v0", 10, f"{__name__}:Late", dict(load_suite("car-following-v1").granted), None)
    with pytest.raises(InputError, match="defence output score: got 'NaN or infinity in step 20"):
        arena.confirmed("fdi:start_step=3,value=-3", "select", 0, 16)
