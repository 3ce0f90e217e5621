"""Parts of somebody's own: the package of docs/new-parts.md under entry points, in commands and worker processes; metrics by name."""

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.evaluation.rows import read_rows
from tailgate.evaluation.summary import summarise

PAGE = (Path(__file__).parents[1] / "docs/new-parts.md").read_text(encoding="utf-8")
NAMES = ("pyproject.toml", "drone.py", "drone.yaml")
METRIC = """
import numpy as np
def speed(trace):
    return np.min(np.where(trace.live[:, :, None], trace.signals["speed"], np.inf), axis=(0, 2))

def short(trace):
    return np.zeros(1)

def seed(trace):
    return np.zeros(trace.batch)

def crash(trace):
    return np.zeros(trace.batch)

def crashed(trace):
    return np.zeros(trace.batch)

class Metric:
    pass
"""
Command = Callable[..., str]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the page's package, as an installation leaves it."""
    folder = tmp_path_factory.mktemp("site")
    for name, text in zip(NAMES, re.findall(r"```\w+\n(.*?)```", PAGE, re.DOTALL)[:3], strict=True):
        (folder / name).write_text(text, encoding="utf-8")
    told = folder / "drone-0.1.dist-info"
    told.mkdir()
    (told / "METADATA").write_text("Metadata-Version: 2.1\nName: drone\nVersion: 0.1\n")
    groups = tomllib.loads((folder / "pyproject.toml").read_text())["project"]["entry-points"]
    lines = [line for group, points in groups.items() for line in (f"[{group}]", *(f"{name} = {at}" for name, at in points.items()))]
    (told / "entry_points.txt").write_text("\n".join(lines))
    return folder


@pytest.fixture
def command(installed: Path) -> Command:
    """A function that runs python in that folder."""

    def run(*arguments: str) -> str:
        environment = os.environ | {"PYTHONPATH": str(installed)}
        return subprocess.run([sys.executable, *arguments], check=True, capture_output=True, text=True, cwd=installed, env=environment).stdout

    return run


@pytest.mark.long
def test_the_package_of_the_page_does_what_the_page_says(command: Command) -> None:
    """Two processes know the names; the table comes out."""
    plants = json.loads(command("-m", "tailgate", "list", "plants", "--json"))["plants"]
    assert {"drone", "car_following"} <= {card["name"] for card in plants}
    metrics = json.loads(command("-m", "tailgate", "list", "metrics", "--json"))["metrics"]
    assert {"name": "time_low", "summary": "Time below one metre [s]: a trace to (B,) numbers.", "unit": "-"} in metrics
    line = next(one for one in PAGE.replace("\\\n", "").splitlines() if one.startswith("tailgate evaluate"))
    table = json.loads(command("-m", *line.split(), "--json"))
    for attack in ("dos_jam:start_step=100", "fdi:start_step=100,value=1"):
        mine = {entry["defence"]: entry for entry in table if entry["attack"] == attack}
        cells = [f"{mine[d]['crash']['value']:.0%} ({mine[d]['time_low']['median']:.2f} s)".replace("%", " %") for d in ("kf", "chi2_kf")]
        assert f"| `{attack}` | {' | '.join(cells)} |" in PAGE


def test_an_environment_takes_the_parts(command: Command) -> None:
    """The page's lines; the engine compiles them, and low flight is paid."""
    made = next(block for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "gymnasium.make" in block)
    more = "low = sum(env.step(env.action_space.sample())[1] for _ in range(5)); print(env.unwrapped.engine, low > 0.0)"
    assert command("-c", made + more).split() == ["traced", "True"]


@pytest.fixture
def metrics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "own_metrics.py").write_text(METRIC)
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("own_metrics", None)
    return tmp_path


def _rows(**more: Any) -> list[dict[str, Any]]:
    return tailgate.evaluate(scenarios="stop-and-go-v0", defences="kf", attacks="none", seeds=2, **more)


def test_a_metric_is_a_column_in_every_process(metrics: Path, tmp_path: Path) -> None:
    plain, out = _rows(), tmp_path / "rows.jsonl"
    rows = _rows(metrics="own_metrics:speed", out=out, workers=2)
    first = [dict(row) for row in rows]
    assert [row.pop("metrics") for row in rows] == [["speed"]] * 2 and all(row.pop("speed") > 0.0 for row in rows)
    assert [{**row, "cell": ""} for row in rows] == [{**row, "cell": ""} for row in plain]
    (metrics / "own_metrics.py").write_text(METRIC.replace("return np.min(", "return 2.0 * np.min("))
    sys.modules.pop("own_metrics")  # as another process has it
    again = _rows(metrics="own_metrics:speed", out=out)
    assert again[0]["cell"] != rows[0]["cell"] != plain[0]["cell"]  # another file, so that finished cells do not count
    assert again[0]["speed"] == 2.0 * first[0]["speed"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("crashed", "one of your own"), ("nobody", "module:function, or the name of an entry point"), ("own_metrics:sped", "did you mean 'speed'"),
        ("own_metrics:seed", "no column of a row"), ("own_metrics:crash", "no column of a row"), ("own_metrics:crashed", "a name that is not taken"), ("own_metrics:Metric", "a function of a trace"),
        ("nowhere:speed", "an importable module"),
    ],
)  # fmt: skip
def test_what_is_no_metric_is_one_clear_error(metrics: Path, name: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        _rows(metrics=name)


def test_a_metric_is_named_by_a_text() -> None:
    with pytest.raises(InputError, match=r"metric: .*expected text: module:function"):
        _rows(metrics=[len])


def test_two_metrics_have_two_names(metrics: Path) -> None:
    (metrics / "other_metrics.py").write_text(METRIC)
    with pytest.raises(InputError, match=r"metric: got 'speed'; expected .* no other metric"):
        _rows(metrics=["own_metrics:speed", "other_metrics:speed"])
    sys.modules.pop("other_metrics", None)


def test_rows_with_and_without_a_metric_are_summarised_together(metrics: Path, tmp_path: Path) -> None:
    """The figure is that of the rows that have one; a column that is named and is no number is one error."""
    rows = [*_rows(), *tailgate.evaluate(scenarios="stop-and-go-v0", defences="kf", attacks="none", seeds=3, metrics="own_metrics:speed")[2:]]
    (entry,) = summarise(rows)
    assert entry["n"] == 3 and entry["speed"]["median"] == rows[2]["speed"]
    file = tmp_path / "rows.jsonl"
    for wrong in ({"metrics": 3}, {"metrics": ["nope"]}, {"metrics": ["defence"]}):
        file.write_text(json.dumps(rows[0] | wrong) + "\n")
        with pytest.raises(InputError, match="line 1"):
            read_rows(file)


def test_a_metric_of_another_shape_costs_its_rows(metrics: Path) -> None:
    rows = _rows(metrics=["own_metrics:short", "own_metrics:speed"])
    assert {row["status"] for row in rows} == {"error"} and "metric short: got 'float64 (1,)'; expected numbers of shape (2,)" in rows[0]["reason"]
    assert rows[0]["speed"] is None


def test_a_metric_may_be_registered(metrics: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Under the decorator it is a column of what its process plays; asked for by name, it is the same column."""
    from tailgate.play import metrics as module

    monkeypatch.setattr(module, "METRICS", held := dict(module.METRICS))
    monkeypatch.setattr(module, "UNITS", dict(module.UNITS))
    (metrics / "registered.py").write_text(METRIC.replace("def speed", "from tailgate.play.metrics import metric\n\n@metric('m/s')\ndef speed"))
    first = _rows(metrics="registered:speed")
    assert "speed" in held and module.unit_in("speed", None) == "m/s"  # type: ignore[arg-type]
    assert [row["speed"] for row in _rows()] == [row["speed"] for row in _rows(metrics="speed")] == [row["speed"] for row in first]
    sys.modules.pop("registered", None)
