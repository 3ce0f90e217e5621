"""Attacks of the published boards that later defences meet: what the package has, and where it is played."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from tailgate.base.reading import load_json
from tailgate.board.files import published
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_suite
from tailgate.ensemble.members import BUDGETS, Hunt, harvest
from tailgate.ensemble.networks import starts_of
from tailgate.ensemble.published import FOLDER, found_against_others, packed
from tailgate.ensemble.search import Arena

RESULTS = Path(__file__).parents[1] / "results"
NAMES = sorted(path.name.removesuffix(".json.xz") for path in FOLDER.glob("*.json.xz"))
LEARNED = "radar-braking-v0-4-black-8d34b11df87567ce"  # a policy that was learned against chi2_kf


def braking(defence: str, suite: str = "radar-v1") -> Arena:
    held = load_suite("radar-v1")
    return Arena(suite, "radar-braking-v0", 4, defence, dict(held.granted), held.bound, held.progress)


@pytest.mark.parametrize("name", NAMES)
def test_each_file_is_what_the_boards_searches_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(RESULTS.parent)
    assert load_json(FOLDER / f"{name}.json.xz") == packed(load_json(RESULTS / name / "board.json.xz"), Path())


def test_every_board_of_the_package_has_one() -> None:
    assert published().keys() <= set(NAMES)


def test_attacks_come_with_their_files_and_can_be_made(tmp_path: Path) -> None:
    found = found_against_others(braking("reacquire_kf"), tmp_path)
    assert len(found) == len(set(found)) > 10 and all(Spec("attack", text).make() for text in found)
    assert f"policy:path={tmp_path / LEARNED}.json" in found and (tmp_path / f"{LEARNED}.safetensors").is_file()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert found_against_others(braking("reacquire_kf"), tmp_path) == found
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before


def test_a_defence_does_not_meet_what_was_found_against_itself(tmp_path: Path) -> None:
    for variant in ("chi2_kf", "chi2_kf:alpha=0.02"):
        assert not [text for text in found_against_others(braking(variant), tmp_path) if LEARNED in text]


def test_a_suite_without_a_board_has_none(tmp_path: Path) -> None:
    assert found_against_others(braking("reacquire_kf", "platoon-v0"), tmp_path) == [] and not list(tmp_path.iterdir())


def test_another_grant_under_the_same_name_meets_none(tmp_path: Path) -> None:
    """Its policies were trained with other actions: to prepare one is an error."""
    place = braking("reacquire_kf")
    other = dataclasses.replace(place, threat=place.threat | {"delay_bound": 10.0})
    assert found_against_others(place, tmp_path) and found_against_others(other, tmp_path) == []


def test_what_was_transferred_is_not_packed_again() -> None:
    member = {"knowledge": "black", "attack": "fdi:value=1"}
    cell = {"scenario": "road", "dose": 4, "members": [member | {"member": name} for name in ("transfer", "scripts", "white box")]}
    cell["members"][2] |= {"knowledge": "white"}
    board = {"suite": {"name": "quick-v1"}, "searches": [{"defence": "kf", "cells": [cell]}]}
    assert [line["attack"] for line in packed(board, Path())["attacks"]] == ["fdi:value=1"]


def test_transfer_finds_the_policy_that_was_learned_against_another(tmp_path: Path) -> None:
    place = braking("reacquire_kf")
    (held,) = harvest(Hunt(place, BUDGETS["quick"], 0, tmp_path, only=("transfer",)))
    best = held.found[0]
    assert LEARNED in best.attack and best.damage > 0.8
    starts = starts_of(place, "black", [], 0, ("none",), [one.attack for one in held.found])
    assert starts[0].name == f"published {LEARNED}"
