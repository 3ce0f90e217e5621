"""The journal of a search: an interrupted one goes on behind the last member that was done."""

import dataclasses
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
    suite = load_suite("radar-v1")
    return standard.jobs_of(dataclasses.replace(suite, attacks=suite.attacks[:4]), "chi2_kf", ("radar-braking-v0",), (4,), "quick", 0)[0]


FEW = tuple(member for member in MEMBERS if member.name in ("scripts", "programs", "networks", "gradient"))


def _counted(monkeypatch: pytest.MonkeyPatch, stop: str = "", some: tuple[members.Member, ...] = MEMBERS) -> list[str]:
    """Count the members that search; interrupt one."""
    began: list[str] = []

    def wrapped(member: members.Member) -> members.Member:
        def find(hunt: Hunt) -> list[str]:
            began.append(member.name)
            if member.name == stop:
                raise KeyboardInterrupt
            return member.find(hunt)

        return member._replace(find=find)

    monkeypatch.setattr(members, "MEMBERS", tuple(map(wrapped, some)))
    return began


def _whole(result: dict[str, Any], folder: Path) -> str:
    return json.dumps(result).replace(str(folder), "FOLDER")


@pytest.mark.long
def test_an_interrupted_search_goes_on(job: standard.Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks begin with scripts of the journal; the result is that of a search in one go, and no journal is left."""
    _counted(monkeypatch, some=FEW)
    (straight,) = standard.searched([job], tmp_path / "one")
    for stop in ("networks", "gradient"):
        _counted(monkeypatch, stop, FEW)
        with pytest.raises(KeyboardInterrupt):
            standard.search(job, tmp_path / "two")
    began = _counted(monkeypatch, some=FEW)
    with monkeypatch.context() as patch:  # between the last member and the result
        patch.setattr(standard, "_strongest", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            standard.searched([job], tmp_path / "two")
    (result,) = standard.searched([job], tmp_path / "two")
    assert _whole(result, tmp_path / "two") == _whole(straight, tmp_path / "one")
    assert began == ["gradient"]
    assert not list(tmp_path.glob("*/searches/*.journal"))


@pytest.mark.thin(8)
@pytest.mark.parametrize("damage", ["", "[]", '{"members": 3}', "attack: evil:Attack", "attack: nosuch:x=1", "member: x0", "damage: 2.0", "score: null"])
def test_a_damaged_journal_begins_again(job: standard.Job, damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So does one whose files are gone, or that names code."""
    _counted(monkeypatch, "transfer")
    with pytest.raises(KeyboardInterrupt):
        standard.search(job, tmp_path)
    (path,) = tmp_path.glob("searches/*.journal")
    held = json.loads(path.read_text())
    assert [one["member"] for one in held["members"]] == ["scripts", "programs", "feedback", "segments", "ghosts"]
    key, _, value = damage.partition(": ")
    one = held["members"][0]
    if key in one["found"][0]:
        one["found"][0][key] = value if key == "attack" else json.loads(value)
    elif key in one:
        one[key] = value
    else:
        held = None
    path.write_text(json.dumps(held) if held else damage)
    began = _counted(monkeypatch, "transfer")
    with pytest.raises(KeyboardInterrupt):
        standard.search(job, tmp_path)
    assert began == ["scripts", "programs", "feedback", "segments", "ghosts", "transfer"]
    for file in tmp_path.glob("attacks/**/*.yaml"):
        file.unlink()
    again = _counted(monkeypatch, "transfer")
    with pytest.raises(KeyboardInterrupt):
        standard.search(job, tmp_path)
    assert again == began
