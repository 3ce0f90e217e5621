"""The command line: exit codes, one clear error, tables and JSON."""

import importlib
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tailgate import cli
from tailgate.cli.train import _harmless, _print_report
from tailgate.training.train import load_config

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """A function that runs the command in a directory of its own: exit code, output, errors."""
    monkeypatch.chdir(tmp_path)

    def command(*arguments: str) -> tuple[int, str, str]:
        code = cli.main(list(arguments))
        said = capsys.readouterr()
        return code, said.out, said.err

    return command


def test_list_shows_every_component_with_its_parameters(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["list", "--json"]) == 0
    cards = json.loads(capsys.readouterr().out)
    chi2 = next(card for card in cards["defences"] if card["name"] == "chi2_kf")
    assert chi2["parameters"]["eta"]["default"] == 20.0 and "[-]" in chi2["parameters"]["eta"]["doc"]
    assert chi2["summary"] and chi2["reference"] and chi2["uses"] == ["measurements"]
    assert {card["name"] for card in cards["attacks"]} >= {"none", "dos_jam", "fdi", "stealth", "thesis_times", "policy"}
    assert all(card["summary"] for group in cards.values() for card in group)
    assert cli.main(["list", "defences"]) == 0
    table = capsys.readouterr().out
    assert "chi2_kf" in table and "stealth" not in table
    assert cli.main(["list"]) == 0
    counts = capsys.readouterr().out
    assert re.search(rf"defences\W+{len(cards['defences'])}\W+tailgate list defences", counts) and "tailgate list --all" in counts
    assert all(f"tailgate list {group}" in counts for group in cards) and len(counts.splitlines()) < 24
    assert cli.main(["list", "--all"]) == 0
    everything = capsys.readouterr().out
    assert "chi2_kf" in everything and "stealth" in everything and "quick-v0" in everything


@pytest.mark.parametrize(("arguments", "words"), [
    (["leaderboard", "head", "board.json", "--nothing"], "tailgate leaderboard head: error: unrecognized arguments: --nothing"),
    (["train", "--nothing"], "tailgate train: error: unrecognized arguments: --nothing"),
    (["train", "--a\nb"], "tailgate train: error: unrecognized arguments: --a b"),
    (["evaluate", "--defense", "kf"], "tailgate evaluate: error: unrecognized arguments: --defense kf; did you mean --defence?"),
    (["detect-log", "x.csv", "--defense=kf"], "tailgate detect-log: error: the following arguments are required: --defence; did you mean --defence?"),
    (["leaderboard", "run"], "tailgate leaderboard run: error: the following arguments are required: SUITE, --out"),
    (["evaluate", "--budget", "4"], "tailgate evaluate: error: unrecognized arguments: --budget 4; did you mean --dose?"),
])  # fmt: skip
def test_wrong_arguments_are_answered_in_a_line_by_the_command_that_was_asked(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(arguments)
    said = capsys.readouterr().err
    assert said == f"{words} (see {words.partition(':')[0]} --help)\n"


@pytest.mark.parametrize(("arguments", "near"), [(["atack", "kf"], "attack"), (["leaderboard", "tri", "kf"], "try"), (["list", "defenses"], "defences")])
def test_a_wrong_word_is_answered_with_the_nearest(arguments: list[str], near: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(arguments)
    assert f"; did you mean {near}? (see tailgate " in capsys.readouterr().err


def test_a_packed_board_is_named_where_a_plain_one_is_asked_for(run: Run) -> None:
    Path("board.json.xz").touch()
    code, _, errors = run("leaderboard", "page", "board.json", "--out", "page")
    assert code == 2 and "(No such file or directory); board.json.xz is there" in errors and not Path("page").exists()


@pytest.mark.parametrize(("override", "words"), [
    ("learning_rate=0.1", "expected the field with its place: ppo.learning_rate or "), ("budget=3", "the field with its place: threat.budget"),
    ("delay=3", "the field with its place: environment.delay"), ("stepps=3", "did you mean 'steps'?"),
])  # fmt: skip
def test_a_field_of_another_place_is_named_with_it(override: str, words: str, run: Run) -> None:
    pytest.importorskip("stable_baselines3")
    code, _, errors = run("train", "learner=ppo", override)
    assert code == 2 and words in errors and not list(Path().iterdir())


@pytest.mark.parametrize(("arguments", "words"), [
    (["check", "nowhere.json"], "readable board.json (No such file or directory)"), (["check", "."], "(Is a directory)"),
    (["check", "rows.jsonl"], "leaderboard verify`"), (["verify", "--rows", "board.json"], "leaderboard check`"),
])  # fmt: skip
def test_what_is_no_board_or_no_rows_is_named(arguments: list[str], words: str, run: Run) -> None:
    """And what it may be instead."""
    Path("rows.jsonl").write_text('{"seed": 1}\n{"seed": 2}\n')
    Path("board.json").write_text('{\n "format": "board"\n}\n')
    code, _, errors = run("leaderboard", *arguments)
    assert code == 2 and words in errors and "Errno" not in errors


@pytest.mark.parametrize(("name", "words"), [
    ("cut.jsonl", "cut.jsonl, line 2: got '{\"suite\": "), ("damaged.jsonl", "damaged.jsonl, line 2: got '{'"), ("cut.jsonl.xz", "(the file is truncated)"),
])  # fmt: skip
def test_of_a_cut_file_of_rows_is_said_which_and_what_makes_it_whole(name: str, words: str, run: Run) -> None:
    """Not the command that reads it. A board's file is named with its folder, as every suite has one of that name."""
    part = ["evaluate", "--scenario", "gusty-stop-and-go-v0", "--defence", "kf", "--attack", "none", "--seeds", "2"]
    assert run(*part, "--out", "whole.jsonl")[0] == run(*part, "--out", "whole.jsonl.xz")[0] == 0
    first, second = Path("whole.jsonl").read_text().splitlines()
    Path("boards/quick-v0").mkdir(parents=True)
    held = {"cut.jsonl": f"{first}\n{second[:-9]}", "damaged.jsonl": f"{first}\n{{\n{second}\n"}
    content = held[name].encode() if name in held else Path("whole.jsonl.xz").read_bytes()[:-9]
    place = Path("boards/quick-v0", name)
    place.write_bytes(content)
    for command in (
        ["leaderboard", "build", "--rows", str(place), "--out", "page"], ["leaderboard", "verify", "--rows", str(place)],
        ["replay", str(place), "--out", "page"], ["leaderboard", "run", "quick-v0", "--out", "boards", "--score-only"],
    ):  # fmt: skip
        code, _, errors = run(*command)
        assert code == 2 and str(place) in errors and words in errors and "run the command that wrote it again" in errors


def test_evaluate_prints_a_table_or_json_and_writes_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    part = ["evaluate", "--scenario", "gusty-stop-and-go-v0", "--defence", "kf", "--attack", "none", "--seeds", "4"]
    assert cli.main([*part, "--out", "rows.jsonl", "--json"]) == 0
    (entry,) = json.loads(capsys.readouterr().out)
    assert entry["n"] == 4 and entry["crash"]["value"] == 0.0 and entry["crash"]["high"] == pytest.approx(0.6024, abs=1e-4)
    assert len((tmp_path / "rows.jsonl").read_text().splitlines()) == 4
    assert cli.main(part) == 0
    assert "0.0 to 60.2 %" in capsys.readouterr().out
    assert cli.main([*part, "--dose", "none", "--threat", "fdi_bound=2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["dose"] is None
    assert cli.main(["leaderboard", "build", "--rows", "rows.jsonl", "--out", "page"]) == 0
    assert (tmp_path / "page" / "index.html").is_file()


@pytest.mark.parametrize(("more", "words"), [
    ([], "no --dose: the scenario's own budget (unlimited: attacks may last the whole episode)"), (["--dose", "4"], None), (["--suite", "quick-v0"], None),
    (["--threat", "budget=4"], None), (["--json"], None),
])  # fmt: skip
def test_without_a_dose_the_budget_is_explained(more: list[str], words: str | None, run: Run) -> None:
    code, out, _ = run("evaluate", "--scenario", "braking-v0", "--defence", "kf", "--attack", "fdi", "--seeds", "1", *more)
    assert code == 0 and (words in " ".join(out.split()) if words else "no --dose" not in out)


REPORT: dict[str, Any] = {"threat": {"budget": 4}, "outcome": "crashed", "unit": "0/1", "attacks": [], "episodes": 400, "defence": "kf", "scenario": "s", "left_out": {}}


@pytest.mark.parametrize(("gain", "words"), [
    ((0.0, -0.01, 0.01), "+0.0 points, 95 % interval -1.0 to +1.0 (undecided)"), ((0.01, -0.01, 0.03), "(undecided)"), ((0.5, 0.4, 0.6), "(wins)"),
    ((-0.5, -0.6, -0.4), "(loses)"),
])  # fmt: skip
def test_a_verdict_on_a_policy(gain: tuple[float, float, float], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    _print_report(REPORT | {"advantage": {"fdi": dict(zip(("value", "low", "high"), gain, strict=True))}})
    assert words in capsys.readouterr().out


def test_a_policy_that_did_no_damage_is_said_what_to_try(tmp_path: Path) -> None:
    """A teacher where the learner can be shown something, and has none."""
    config, out = load_config(None, [f"out={tmp_path}"]), f"out={tmp_path}"
    assert _harmless(config, 1500) == "this policy did no damage: try more steps than 1,500, or teacher=best"
    assert _harmless(load_config(None, ["rivals=[]", "seeds=2", out]), 7) == "these policies did no damage: try more steps than 7"
    assert _harmless(load_config(None, ["teacher=best", out]), 7) == "this policy did no damage: try more steps than 7"


DEPENDENT = """
from tailgate.estimators import Kalman

class Alone(Kalman):
    pass

class Mean(Kalman):
    def step(self, *arguments):
        state, estimate = super().step(*arguments)
        return state, estimate._replace(x=estimate.x - 0.1 * estimate.x.mean(axis=0))
"""


@pytest.mark.long
@pytest.mark.parametrize("batch", ["256", pytest.param("1", marks=pytest.mark.long)])
def test_a_defence_whose_rows_depend_on_one_another_is_warned_of(batch: str, tmp_path: Path) -> None:
    """Its rows are kept, and the exit code is as it was. With one row at a time they do so only when somebody plays more."""
    (tmp_path / "two.py").write_text(DEPENDENT)
    command = (
        sys.executable, "-m", "tailgate", "evaluate", "--scenario", "gusty-stop-and-go-v0", "--attack", "none", "--defence", "two:Mean",
        "--defence", "two:Alone", "--defence", "kf", "--seeds", "4", "--batch", batch, "--out", "rows.jsonl",
    )  # fmt: skip
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    (warning,) = [line for line in done.stderr.splitlines() if "warning" in line]
    assert done.returncode == 0 and warning.startswith("tailgate: warning: rows of two:Mean depend on one another")
    assert warning.endswith("3 of 3 came out otherwise in another batch") and len((tmp_path / "rows.jsonl").read_text().splitlines()) == 12


def test_a_failing_component_is_exit_code_1_and_its_rows_say_why(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "bad.py").write_text(
        "class Bad:\n    def prepare(self, model):\n        raise RuntimeError('out of order')\n    def start(self): ...\n    def step(self, plan, state, received, known_u, draws): ...\n"
    )
    code, _, said = run(
        "evaluate", "--scenario", "thesis-ch4-v0", "--defence", "kf", "--defence", "bad:Bad", "--attack", "none", "--seeds", "2", "--out", "rows.jsonl"
    )
    assert code == 1, said
    rows = [json.loads(line) for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert [row["status"] for row in rows] == ["ok", "ok", "error", "error"] and "out of order" in rows[-1]["reason"]
    assert "2 of 4 rows failed" in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["evaluate", "--defence", "kff"], ["defence", "kff", "kf"]), (["evaluate", "--suite", "quik-v0"], ["quik-v0", "quick-v0"]),
        (["evaluate", "--seeds", "0"], ["seeds", "0"]), (["evaluate", "--dose", "-4"], ["dose", "-4"]), (["evaluate", "--dose", "x"], ["dose", "x"]),
        (["evaluate", "--threat", "budget"], ["--threat", "budget", "key=value"]), (["evaluate", "--attack", "missing.json"], ["missing.json"]),
        (["evaluate", "--out", "file/rows.jsonl"], ["out: got 'file';", "a writable directory, not a file"]),
        (["leaderboard", "run", "quick-v0", "--out", "file"], ["out: got 'file';", "a writable directory, not a file"]), (["evaluate", "--suite", "bad.yaml"], ["suite bad", "seedz", "seeds"]),
        (["leaderboard", "build", "--rows", "none.jsonl", "--out", "page"], ["rows", "none.jsonl"]),
        (["leaderboard", "build", "--rows", "bad.jsonl", "--out", "page"], ["bad.jsonl", "line 1"]),
        (["leaderboard", "build", "--rows", "file", "--out", "page"], ["rows"]),
        (["train", "--config", "missing"], ["config", "missing", "quickstart"]), (["train", "defence=mine:Mine"], ["mine:Mine", "bwrap/module:Class"]),
        (["leaderboard", "attack", "kf", "--suite", "quick-v0", "--out", "x", "--seeds", "0"], ["seeds", "0"]),
        (["leaderboard", "attack", "kf", "--suite", "quick-v0", "--out", "x", "--episodes", "0"], ["episodes", "0"]),
        (["evaluate", "--defence", "needs:Needs", "--seeds", "1"], ["needs:Needs", "'x'"]),
    ],
)  # fmt: skip
def test_bad_input_is_exit_code_2_and_one_line(run: Run, tmp_path: Path, arguments: list[str], words: list[str]) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "needs.py").write_text("class Needs:\n    def __init__(self, x): ...\n    prepare = start = step = print\n")
    (tmp_path / "bad.jsonl").write_text("{]\n")
    (tmp_path / "bad.yaml").write_text("scenarios: [braking-v0]\nseedz: 3\n")
    before = sorted(p.name for p in tmp_path.rglob("*") if "__pycache__" not in p.parts and p.name != "__pycache__")
    code, _, said = run(*arguments)
    assert code == 2, said
    error = [line for line in said.splitlines() if line.startswith("tailgate: error: ")]
    assert len(error) == 1 and "Traceback" not in said
    assert all(word in error[0] for word in words) and "expected" in error[0]
    assert sorted(p.name for p in tmp_path.rglob("*") if "__pycache__" not in p.parts and p.name != "__pycache__") == before


@pytest.mark.long
def test_a_run_is_compared_also_where_nobody_can_look_into_the_defence(run: Run) -> None:
    """The preset's white-box attack needs an innovation, which `none` has not: it is left out, with the reason. `none` is a name here."""
    code, out, said = run(
        "train", "--config", "gusty", "defence=none", "steps=600", "learner=cem", "cem={population: 4, episodes: 5, hidden: []}", "environment.interval=20",
        "teacher=null", "rivals=[]", "episodes=4", "others=[]", "workers=1", "tensorboard=false", "--json",
    )  # fmt: skip
    assert code == 0, said
    report = json.loads(out)
    (left,) = report["left_out"]
    assert left.startswith("stealth") and "look" in report["left_out"][left] and report["defence"] == "none"


def test_python_runs_the_package_as_the_command(tmp_path: Path) -> None:
    """With two workers, which are spawned: they import the main module anew, and must not run it."""
    command = [sys.executable, "-m", "tailgate", "evaluate", "--scenario", "thesis-ch4-v0", "--defence", "kf", "--attack", "none", "--attack", "fdi", "--seeds", "1", "--workers", "2", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert {row["defence"] for row in json.loads(done.stdout)} == {"kf"}
    refused = subprocess.run([*command[:4], "--suite", "none-v0"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert refused.returncode == 2 and refused.stderr.startswith("tailgate: error: ")


def test_an_unknown_command_explains_itself(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["fly"])
    assert stop.value.code == 2 and "evaluate" in capsys.readouterr().err


@pytest.mark.long
def test_a_file_of_other_rows_is_kept(run: Run, tmp_path: Path) -> None:
    """The same command replaces its own rows; another one sets them aside and says where."""
    part = ["evaluate", "--scenario", "thesis-ch4-v0", "--dose", "none", "--attack", "none", "--seeds", "2", "--out", "rows.jsonl"]
    for defence, kept in (("kf", 0), ("kf", 0), ("chi2_kf", 1), ("kf", 2)):
        code, _, said = run(*part, "--defence", defence)
        assert code == 0, said
        assert len(list(tmp_path.glob("rows.jsonl.*"))) == kept
    assert "rows.jsonl.2" in said and '"kf"' in (tmp_path / "rows.jsonl.1").read_text()


def test_nothing_played_is_exit_code_1(run: Run, tmp_path: Path) -> None:
    """Where no row and no property comes to a figure the reason is the last line; beside others it has a column of its own."""
    place = ["--scenario", "thesis-ch4-v0", "--dose", "none"]
    code, table, said = run("evaluate", *place, "--defence", "none", "--attack", "stealth", "--seeds", "2")
    assert code == 1 and "nothing was played" in said.splitlines()[-1] and "why not" in table
    code, table, _ = run("evaluate", *place, "--defence", "none", "--attack", "stealth", "--attack", "none", "--seeds", "2")
    assert code == 0 and "why not" in table
    code, table, said = run("trust", "--scenario", "thesis-ch5-v0", "--defence", "dkf", "--attack", "none", "--runs", "2", "--property", "gap > 2")
    assert code == 1 and "nothing was decided" in said.splitlines()[-1] and "why not" in table
    (tmp_path / "empty.jsonl").touch()
    code, _, said = run("leaderboard", "build", "--rows", "empty.jsonl", "--out", "page")
    assert code == 2 and "empty.jsonl" in said


@pytest.mark.parametrize(
    ("rule", "field"),
    [(["--width", "2"], "--width"), (["--test", "0"], "--test"), (["--test", "0.04"], "--indifference"), (["--test", "0.9", "--indifference", "0"], "--indifference")],
)
def test_a_rule_that_cannot_be_names_its_option(run: Run, rule: list[str], field: str) -> None:
    code, _, said = run("trust", "--scenario", "ch7-v0", "--defence", "kf", "--attack", "none", *rule)
    assert code == 2 and f"error: {field}: got" in said


def test_a_detector_is_no_defence(run: Run) -> None:
    """Named as a defence, it is refused with the way to use it; an attack that is granted nothing is marked in the table."""
    part = ["evaluate", "--scenario", "thesis-ch4-v0", "--dose", "none", "--attack", "dos_jam", "--seeds", "2", "--threat", "kinds=[fdi]"]
    code, _, said = run(*part, "--defence", "tailgate.estimators:Cusum")
    assert code == 2 and "composed:detector=module:Class" in said
    code, table, said = run(*part, "--defence", "kf")
    assert code == 0 and "refused: the scenario" in " ".join(table.split()) and "no attack took place" in said
    said = run(*part, "--threat=kinds=[fdi, dos_jam]", "--attack=fdi:value=9000", "--attack=fdi:value=50", "--attack=dos_jam:low=-200", "--defence=kf")[2]
    assert "9000: value is cut at fdi_bound, -" in said and "200: low is cut at jam_range, -108 to" in said and "value=50:" not in said


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("def (\n", ["syntax", "line 1"]), ("\nx = nothing\n", ["NameError", "theirs.py, line 2"]),
        ("class Mine:\n    pass\n", ["prepare"]),
    ],
)  # fmt: skip
def test_a_module_that_cannot_be_loaded_is_one_line(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, words: list[str]) -> None:
    """The file of somebody's first defence: what is wrong with it, and where."""
    (tmp_path / "theirs.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "theirs", raising=False)
    importlib.invalidate_caches()
    done, _, said = run("evaluate", "--scenario", "thesis-ch4-v0", "--dose", "none", "--defence", "theirs:Mine", "--attack", "none", "--seeds", "2")
    assert done == 2 and "Traceback" not in said and len(said.strip().splitlines()) == 1 and all(word in said for word in words)


def test_a_place_for_pictures_is_looked_at_before_anything_is_played(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "taken").write_text("")
    monkeypatch.setattr("tailgate.evaluation.cells.evaluate", lambda *_, **__: pytest.fail("episodes were played"))
    code, _, said = run("evaluate", "--suite", "quick-v0", "--plot", "taken")
    assert code == 2 and "plot" in said and "taken" in said


def test_a_key_that_is_there_twice_is_refused(run: Run, tmp_path: Path) -> None:
    """Of two values one would be lost without a word."""
    (tmp_path / "twice.yaml").write_text("scenarios: [thesis-ch4-v0]\nattacks: [none]\ndefences: [kf]\nseeds: 2\nseeds: 3\n")
    code, _, said = run("evaluate", "--suite", "twice.yaml")
    assert code == 2 and "the key 'seeds' appears twice" in said and "line 5" in said


@pytest.mark.parametrize("text", ["{}", "[]", '"board"', "{", '{"format": "tailgate-board-1"}'])
def test_a_head_of_rubbish_is_refused(run: Run, tmp_path: Path, text: str) -> None:
    (tmp_path / "board.json").write_text(text)
    code, _, said = run("leaderboard", "head", "board.json")
    assert code == 2 and "expected" in said and "Traceback" not in said


NOTHING = "nothing of it is kept"


@pytest.mark.parametrize(("arguments", "stopped", "told"), [
    (["evaluate"], "evaluation.cells.evaluate", "nothing is kept: --out FILE would"),
    (["evaluate", "--out", "rows.jsonl"], "evaluation.cells.evaluate", "the same command goes on with the rows of rows.jsonl"),
    (["leaderboard", "run", "quick-v0", "--out", "boards"], "board.run.play", "the same command goes on"),
    (["leaderboard", "attack", "kf", "--suite", "quick-v0", "--out", "x"], "board.attacked.attack", "the same command goes on"),
    (["leaderboard", "submit", "mine:Mine"], "sandbox.play_submission", "nothing is kept: --out FILE would"),
    (["leaderboard", "submit", "mine:Mine", "--out", "rows.jsonl"], "sandbox.play_submission",
     "the same command goes on after the scenarios that are finished"),
    (["leaderboard", "clock", "quick-v0", "--out", "x"], "board.clock.measure", NOTHING),
    (["leaderboard", "admit", "fdi", "--suite", "quick-v0", "--out", "x"], "board.admission.admit", NOTHING),
    (["calibrate", "--defence", "chi2_kf", "--hours", "1"], "evaluation.calibrate.calibrate", NOTHING),
    (["timing", "zoo:name=car-following-chi2_kf-0"], "studies.timing.timing", NOTHING), (["bench"], "bench.run.bench", NOTHING),
    (["transfer", "zoo:name=none"], "studies.transfer.transfer", "nothing is kept: --out DIR would"),
    (["trust", "--out", "x"], "trust.run.check", "the same command goes on"),
    (["dose-response", "fdi", "--defence", "kf", "--scenario", "braking-v0", "--doses", "5"], "studies.dose.dose_response",
     "nothing is kept: --out DIR would"),
    (["log", "--out", "x"], "studies.log.write_log", "the same command goes on"),
    (["tune", "--trials", "1"], "training.tuning.tune", "the same command goes on"),
    (["train", "out=x"], "training.train.train", "what was finished is kept, go on with: tailgate train --resume name=quickstart out=x"),
    (["reproduce", "ch3"], "thesis.whole.chapter", NOTHING),
    (["reproduce"], "thesis.whole.reproduce_whole", "the same command goes on after the chapters that are finished"),
])  # fmt: skip
def test_an_interrupted_command_says_what_is_kept_and_how_to_go_on(
    arguments: list[str], stopped: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    module, _, function = stopped.rpartition(".")
    monkeypatch.setattr(importlib.import_module(f"tailgate.{module}"), function, stop)
    assert cli.main(arguments) == 130
    said = capsys.readouterr().err.strip()
    assert said.endswith(told) and said.splitlines()[-1].startswith("tailgate: interrupted; ")


def test_training_says_nothing_before_it_has_been_checked(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.main(["train", "ppo.envs=0", f"out={tmp_path}"]) == 2
    assert "training against" not in capsys.readouterr().err
    assert cli.main(["train", "learner=cem", "ppo.envs=0", f"out={tmp_path}"]) == 2
    assert not list(tmp_path.iterdir())
