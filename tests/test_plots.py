"""Pictures of an evaluation: their files, and that what is drawn is what was measured."""

import io

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from PIL import Image

from tailgate import cli
from tailgate.base.plots import matrix_figure, png, scatter_figure, write_overview


def entry(defence, attack, rmse, gap, crash, scenario="s", dose=5):
    error, least = (None if v is None else {"median": v, "q25": v, "q75": v} for v in (rmse, gap))
    return {
        "scenario": scenario, "dose": dose, "defence": defence, "attack": attack, "rmse_position": error, "min_gap": least,
        "crash": None if crash is None else {"value": crash, "low": 0.0, "high": 1.0},
    }  # fmt: skip


TABLE = [entry("a", "x", 0.5, 10.0, 0.0), entry("a", "y", 3.0, -0.5, 1.0), entry("b", "x", 0.6, 12.0, 0.1), entry("b", "y", None, None, None)]


def shown(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


@pytest.mark.long
def test_one_picture_a_place_and_one_scatter(tmp_path):
    """A file per scenario and dose; a name that is no file name is made one; skipped cells stay empty."""
    table = [*TABLE, entry("a", "x", 1.0, 9.0, 0.0, "../odd name", None)]
    names = [path.name for path in write_overview(table, tmp_path / "new")]
    assert names == ["s-5.png", "..-odd-name-unlimited.png", "rmse-against-gap.png"]
    assert sorted(names) == sorted(p.name for p in (tmp_path / "new").iterdir())
    for path in (tmp_path / "new").iterdir():
        assert min(Image.open(path).size) > 200


def test_the_pictures_show_the_figures():
    """Another number gives another picture, the same table the same bytes."""
    good = [e for e in TABLE if e["crash"]]
    other = [entry("a", "x", 0.5, 10.0, 0.9), *good[1:]]
    for draw in (lambda table: png(matrix_figure(table, "t")), lambda table: png(scatter_figure(table))):
        assert draw(good) == draw(good)
        one, two = shown(draw(good)), shown(draw(other))
        assert one.shape != two.shape or (one != two).any()


@pytest.mark.long
@pytest.mark.thin(2)  # the other form: test_export_board
@pytest.mark.parametrize("form, start", [("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_vectors_repeat(form, start, tmp_path):
    first, again = ([path.read_bytes() for path in write_overview(TABLE, tmp_path / name, form)] for name in "ab")
    assert first == again and len(first) == 2 and all(content.startswith(start) for content in first)
    assert {path.suffix for path in (tmp_path / "a").iterdir()} == {f".{form}"}


@pytest.mark.long
def test_the_command_draws(tmp_path, capsys):
    """tailgate evaluate --plot DIR names what it wrote; a directory that cannot be written is one clear error."""
    run = ["evaluate", "--scenario", "thesis-ch4-v0", "--defence", "kf", "--attack", "none", "--attack", "fdi", "--seeds", "4", "--dose", "none"]
    assert cli.main([*run, "--plot", str(tmp_path / "p")]) == 0
    assert str(tmp_path / "p" / "rmse-against-gap.png") in capsys.readouterr().err
    assert cli.main([*run, "--plot", str(tmp_path / "p"), "--picture", "svg"]) == 0
    assert str(tmp_path / "p" / "rmse-against-gap.svg") in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert cli.main([*run, "--plot", str(tmp_path / "file")]) == 2
    assert "plot" in capsys.readouterr().err
