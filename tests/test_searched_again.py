"""The second search of a published board: which figures can fall."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import searched_again


def _rate(value: float, knowledge: str = "black") -> dict[str, Any]:
    return {"knowledge": knowledge, "dose": 4, "undamaged": {"value": value}, "worst": {"scenario": "braking", "attack": "own"}}


def test_ranked_figures_that_leave_more_than_a_tenth_undamaged_can_fall() -> None:
    entries = [
        {"defence": "kf", "rank": {"best": 1}, "rates": [_rate(0.7), _rate(0.1), _rate(0.7, "white")]},
        {"defence": "coast", "rank": None, "rates": [_rate(1.0)]},
    ]
    (figure,) = searched_again.figures("board", {"entries": entries})
    assert (figure.defence, figure.dose, figure.scenario, round(figure.published, 3)) == ("kf", 4, "braking", 0.3)
