"""The journal of a search: an interrupted one goes on behind the last member that was done."""

import json
from pathlib import Path
from typing import Any

import pytest

from tailgate.core.scenario import load_suite
from tailgate.ensemble import members, standard
from tailgate.ensemble.members import MEMBERS, Hunt

from .conftest import shrink_ensemble


@pytest.fixture
def job(monkeypatch: pytest.MonkeyPatch) -> standard.Job:
    shrink_ensemble(monkeypatch)
    return standard.jobs_of(load_suite("radar-v1"), "chi2_kf", ("radar-braking-v0",), (4,), "quick", 0)[0]


def _counted(monkeypatch: pytest.MonkeyPatch, stop: str = "") -> list[str]:
    """Count the members that search; interrupt one."""
    began: list[str] = []

    def wrapped(member: members.Member) -> members.Member:
        def find(hunt: Hunt) -> list[str]:
            began.append(member.name)
            if member.name == stop:
                raise KeyboardInterrupt
            return member.find(hunt)

        return member._replace(find=find)

    monkeypatch.setattr(members, "MEMBERS", tuple(map(wrapped, MEMBERS)))
    return began


def _whole(result: dict[str, Any], folder: Path) -> str:
    return json.dumps(result).replace(str(folder), "FOLDER")


def test_an_interrupted_search_goes_on(job: standard.Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks begin with scripts of the journal; the result is that of a search in one go, and no journal is left."""
    straight = standard.search(job, tmp_path / "one")
    for stop in ("networks", "grey networks", "gradient"):
        _counted(monkeypatch, stop)
        with pytest.raises(KeyboardInterrupt):
            standard.search(job, tmp_path / "two")
    began = _counted(monkeypatch)
    assert _whole(standard.search(job, tmp_path / "two"), tmp_path / "two") == _whole(straight, tmp_path / "one")
    assert began == ["gradient"]
    assert not list(tmp_path.glob("*/searches/*.journal"))


def test_nobody_searches_behind_an_attack_that_damages_every_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those who know as much or more are passed over, with the reason; those who know less are not."""
    from tailgate.ensemble.search import Found

    def finds(name: str, knowledge: str, damage: float) -> members.Member:
        return members.Member(name, knowledge, lambda hunt: [f"{name}/{damage}"])

    class Place:
        def best(self, texts: list[str]) -> list[Found]:
            return [Found(text, float(text.partition("/")[2]), 0.0, 1) for text in texts]

    team = [finds("white", "white", 1.0), finds("some", "black", 0.99), finds("all", "black", 1.0), finds("more", "black", 0.5), finds("grey", "grey", 1.0)]
    monkeypatch.setattr(members, "MEMBERS", tuple(team))
    out = members.harvest(Hunt(Place(), members.BUDGETS["quick"], 0, Path()))  # type: ignore[arg-type]
    assert {one.member: bool(one.found) for one in out} == {"white": True, "some": True, "all": True, "more": False, "grey": False}
    assert out[-1].why == "all: an attack that damages every episode"


@pytest.mark.parametrize("damage", ["", "[]", "{}", '{"members": 3}', "import"])
def test_a_damaged_journal_begins_again(job: standard.Job, damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So does one whose files are gone, or that names code."""
    _counted(monkeypatch, "transfer")
    with pytest.raises(KeyboardInterrupt):
        standard.search(job, tmp_path)
    (path,) = tmp_path.glob("searches/*.journal")
    held = json.loads(path.read_text())
    assert [one["member"] for one in held["members"]] == ["scripts", "programs"]
    if damage == "import":
        held["members"][0]["found"][0]["attack"] = "evil:Attack"
    path.write_text(json.dumps(held) if damage == "import" else damage)
    began = _counted(monkeypatch, "transfer")
    with pytest.raises(KeyboardInterrupt):
        standard.search(job, tmp_path)
    assert began == ["scripts", "programs", "transfer"]
    for file in tmp_path.glob("attacks/**/*.yaml"):
        file.unlink()
    again = _counted(monkeypatch, "transfer")
    with pytest.raises(KeyboardInterrupt):
        standard.search(job, tmp_path)
    assert again == began
