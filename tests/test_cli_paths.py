"""Paths, names and streams of commands: what cannot be used is one line before anything is made or moved, and nothing is lost."""

import subprocess
import sys
from pathlib import Path

import pytest

from tailgate.base.errors import InputError
from tailgate.base.files import GENERATOR, write_html
from tailgate.cli import main
from tailgate.cli.command_line import COMMANDS, _parser
from tailgate.cli.examples import EXAMPLES
from tailgate.cli.shared import written_to
from tailgate.training import train


@pytest.mark.parametrize("arguments", [["name="], ["name=.."], ["name=a/b"], ["name=10:30"], ["name=a", "out=2024T10:30"]])
@pytest.mark.parametrize("command", ["train", "selfplay"])
def test_a_run_has_a_folder_that_an_attack_can_be_named_by(command, arguments, tmp_path, monkeypatch, capsys):
    """Nothing of what lies there is moved: an empty name would be the folder of all runs."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "other").mkdir(parents=True)
    assert main([command, "steps=2000", *arguments]) == 2
    told = capsys.readouterr().err
    assert "config." in told and told.count("\n") == 1
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["runs", "runs/other"]


def test_fields_may_come_behind_options(capsys):
    """They are refused by their names alone, not by their place."""
    assert main(["train", "steps=2000", "--config", "gusty", "nosuch=1"]) == 2
    assert "nosuch" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["train", "steps=2000", "--config", "gusty", "nosuch"])
    assert "unrecognized arguments: nosuch" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [
    ["evaluate", "--plot", ""], ["trust", "--out", ""], ["dose-response", "fdi", "--defence", "kf", "--scenario", "stop-and-go-v0", "--doses", "5", "--out", ""],
    ["dose-response", "fdi", "--defence", "kf", "--scenario", "stop-and-go-v0", "--doses", "5", "--outcome", "max_error", "--exceeds", "nan"],
    ["evaluate", "--scenario", "stop-and-go-v0", "--defence", "kf", "--seeds", "1", "--out", "x" * 300],
])  # fmt: skip
def test_a_path_or_number_without_a_meaning_is_one_line(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert told.startswith("tailgate: error: ") and told.count("\n") == 1


@pytest.mark.parametrize("arguments", [
    ["fit", "--out", "x/y.json"], ["fit", "--plot", "x/y.png"], ["detect-log", "asta-braking", "--defence", "kf", "--parquet", "x/y.parquet"],
    ["leaderboard", "verify", "--rows", "none.jsonl", "--out", "x/y.json"], ["leaderboard", "export", "quick-v1", "--format", "csv", "--out", "x/y.csv"],
    *(["replay", "none.jsonl", "--out", "p", *more] for more in (["--video", "x/y.gif"], ["--export", "x/y.csv"], ["--out", "x/y.html"])),
])  # fmt: skip
def test_a_file_that_cannot_be_written_is_said_before_the_work(arguments, tmp_path, monkeypatch, capsys):
    """Here a file takes the place of its folder."""
    monkeypatch.chdir(tmp_path)
    Path("x").write_text("mine")
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert "'x'" in told and "not a file" in told and [path.name for path in tmp_path.iterdir()] == ["x"]


def test_a_page_that_is_not_of_this_package_is_set_aside(tmp_path):
    page = tmp_path / "index.html"
    page.write_text("mine")
    for _ in range(2):
        write_html(page, b"<head>" + GENERATOR)
    assert (tmp_path / "index.html.1").read_text() == "mine" and len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(("stream", "code"), [(">/dev/full", 2), (">&-", 0), ("2>&-", 0)])
def test_a_stream_that_is_full_or_closed_is_no_traceback(stream, code):
    done = subprocess.run(f"{sys.executable} -m tailgate list defences {stream}", shell=True, capture_output=True, text=True, check=False)
    assert done.returncode == code and "Traceback" not in done.stderr and bool(done.stdout) == (stream == "2>&-")


def test_what_was_there_is_set_aside_when_the_work_is_done(tmp_path, capsys):
    out = tmp_path / "mine.json"
    out.write_text("mine")
    with pytest.raises(ZeroDivisionError), written_to(out):
        raise ZeroDivisionError
    assert out.read_text() == "mine"
    with written_to(out):
        assert out.read_text() == "mine"
    assert not out.exists() and (tmp_path / "mine.json.1").read_text() == "mine" and "mine.json.1" in capsys.readouterr().err
    with pytest.raises(InputError, match="not a directory"), written_to(tmp_path):
        pass


@pytest.mark.long
def test_rules_replace_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("rules.json").write_text("mine")
    assert main(["distil", "zoo:name=radar-following-chi2_kf-0", "--leaves", "2", "--episodes", "5"]) == 0
    assert Path("rules.json.1").read_text() == "mine" and "rules.json.1" in capsys.readouterr().err


@pytest.mark.long
def test_every_example_names_what_there_is():
    """The words are those of the command, and the zoo's policies, suites and models exist."""
    from tailgate.agents.policy.zoo import zoo_path

    for words, example in EXAMPLES.items():
        for text in example.split():
            if text.startswith("zoo:name="):
                assert zoo_path(text.removeprefix("zoo:name=")).is_file(), words
    assert main(["cost", *EXAMPLES["cost"].split()]) == 0 and len(COMMANDS) > 20
    parsed = _parser().parse_args(["rare", "kf", "--property", "G[0,60] gap > 2", "--scenario", "gusty-stop-and-go-v0"])
    assert EXAMPLES["rare"] == 'kf --property "G[0,60] gap > 2" --scenario gusty-stop-and-go-v0' and parsed.property


def test_a_run_that_was_moved_goes_on(tmp_path, monkeypatch):
    """Under another name, in another folder, however the folder is written: nothing is trained again."""
    monkeypatch.chdir(tmp_path)
    small = ["cem={population: 8, episodes: 4, hidden: []}", "steps=2000", "rivals=[]", "others=[]", "tensorboard=false", "workers=1"]
    (policy,) = train.train(train.load_config(None, ["name=first", *small]), lambda *_: None)
    before = policy.with_suffix(".safetensors").read_bytes()
    Path("kept").mkdir()
    Path("runs/first").rename("kept/second")
    for out in ("kept", "./kept/", str(tmp_path / "kept")):
        config = train.load_config(None, ["name=second", f"out={out}"], resume=True)
        (policy,) = train.train(config, lambda *_: pytest.fail("trained again"), resume=True)
        assert policy.with_suffix(".safetensors").read_bytes() == before


@pytest.mark.long
def test_an_earlier_run_of_the_name_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = ["cem={population: 8, episodes: 4, hidden: []}", "steps=2000", "episodes=5", "select_episodes=5", "rivals=[]", "others=[]"]
    for _ in range(2):
        assert main(["train", "name=first", "tensorboard=false", "workers=1", *small]) == 0
    assert "runs/first held an earlier run; it is in runs/first.1" in capsys.readouterr().err
