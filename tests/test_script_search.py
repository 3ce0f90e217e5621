"""Scripts that the record of learned attacks searches for."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.training import train

sys.path.insert(0, str(Path(__file__).parents[1] / "results/adversaries-v0"))
import script_search

CONFIG = ["defence=kf", "threat.kinds=[fdi]", "workers=1"]


def test_a_template_is_filled_within_its_ranges() -> None:
    rng = np.random.default_rng(0)
    drawn = [script_search.drawn("fdi:start_step={20..23},value={-2.5..0.0},sensors={a|b}", rng) for _ in range(200)]
    fields = [dict(part.split("=") for part in text.removeprefix("fdi:").split(",")) for text in drawn]
    assert {item["start_step"] for item in fields} == {"20", "21", "22", "23"}
    assert {item["sensors"] for item in fields} == {"a", "b"}
    assert all(-2.5 <= float(item["value"]) <= 0.0 for item in fields) and len({item["value"] for item in fields}) > 100


@pytest.mark.long
def test_the_search_finds_the_moment_that_a_table_of_all_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a plain filter a bias is worth something only within a range of gaps."""
    config = train.load_config("car-following", [*CONFIG, "threat.fdi_bound=5.0", "threat.budget=18"])
    template = "fdi:trigger=near,threshold={20..90},value=-5"
    found = script_search.found(config, [template], 0.25)
    assert found == script_search.found(config, [template], 0.25) and len(found) == script_search.JOIN
    everything = [f"fdi:trigger=near,threshold={gap},value=-5" for gap in range(20, 91, 10)]
    assert script_search.ranked(config, [*everything, found[0]], 128).index(found[0]) < 3


@pytest.mark.parametrize("hole", ["{}", "{3}", "{a..b}", "{5..1}"])
def test_a_range_that_is_none_is_one_clear_error(hole: str) -> None:
    with pytest.raises(InputError, match="search"):
        script_search.drawn(f"fdi:value={hole}", np.random.default_rng(0))
