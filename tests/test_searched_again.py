"""The second search of a published board: which figures can fall, and which attacks of others join."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import searched_again


def _rate(value: float, knowledge: str = "black") -> dict[str, Any]:
    return {"knowledge": knowledge, "dose": 4, "undamaged": {"value": value}, "worst": {"scenario": "braking", "attack": "own"}}


def _line(defence: str, *members: tuple[str, str, str | None], dose: int = 4) -> dict[str, Any]:
    found = [{"member": member, "knowledge": knowledge, "attack": attack} for member, knowledge, attack in members]
    return {"defence": defence, "cells": [{"scenario": "braking", "dose": dose, "members": found}]}


def test_ranked_figures_that_can_fall_meet_what_was_found_against_others() -> None:
    entries = [
        {"defence": "kf", "rank": {"best": 1}, "rates": [_rate(0.7), _rate(0.1), _rate(0.7, "white")]},
        {"defence": "coast", "rank": None, "rates": [_rate(1.0)]},
    ]
    searches = [
        _line("kf", ("scripts", "black", "own")), _line("imm", ("scripts", "black", "theirs"), dose=9),
        _line("rkf", ("networks", "black", "one"), ("gradient", "white", "two"), ("white box", "white", "no"), ("transfer", "black", None)),
    ]  # fmt: skip
    (figure,) = searched_again.figures("board", {"entries": entries, "searches": searches})
    assert (figure.defence, figure.dose, figure.scenario, round(figure.published, 3)) == ("kf", 4, "braking", 0.3)
    assert figure.others == {"braking": ("one", "two")}
