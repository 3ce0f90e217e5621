"""Replay: the episode of a row is played to the last bit, rows run no code, and the page shows what the trace holds."""

import dataclasses
import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from tailgate import cli
from tailgate.base import files
from tailgate.base.assets import embedded
from tailgate.base.errors import InputError
from tailgate.core import Kind
from tailgate.evaluation.cells import Cell, evaluate, run_cell
from tailgate.evaluation.rows import encode, read_rows
from tailgate.replay.episode import episode_of
from tailgate.replay.page import context_of, render, write_page
from tailgate.replay.replay import Filter, choose, play

from .boards import Outline
from .replays import HOSTILE, SCENARIO

ROOT = Path(__file__).parents[1]
DEFENCES = ("kf", "chi2_kf:eta=9", "always_brake")
ATTACKS = ("none", "dos_jam:start_step=20", "fdi_then_jam:start_step=10,inject=4,value=-1.5", "fdi_gaussian:start_step=5,targets=[position],sd=4")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scenario file and the rows of an evaluation on it."""
    path = tmp_path_factory.mktemp("replay")
    (path / "tiny.yaml").write_text(yaml.safe_dump(SCENARIO))
    evaluate(scenarios=[str(path / "tiny.yaml")], defences=DEFENCES, attacks=ATTACKS, seeds=2, out=path / "rows.jsonl")
    return path


@pytest.fixture(scope="module")
def rows(folder):
    return read_rows(folder / "rows.jsonl")


@pytest.fixture
def pick(rows):
    """A row by its components."""

    def find(defence="kf", attack="none", seed=0):
        return next(r for r in rows if (r["defence"], r["attack"], r["seed"]) == (defence, attack, seed))

    return find


def test_every_row_is_played_again_to_the_last_bit(rows):
    """A batch of one gives the hash and every figure of the row, also in a scenario from a file. One row in three is played."""
    assert len(rows) == 24 and len({row["trace_hash"] for row in rows}) > 12
    for row in rows[::3]:
        replay = play(row)
        assert replay.verdict == "same" and replay.differences == []


@pytest.mark.long
def test_published_scenarios_and_white_box_attacks_are_played_again():
    """From the row alone: what the attack needs to know is in its threat model."""
    for scenario, attack in (("thesis-ch4-v0", "thesis_times"), ("gusty-stop-and-go-v0", "stealth:trigger=near,threshold=40")):
        (row,) = run_cell(Cell("s", scenario, None, "chi2_kf", attack, 1, first_seed=1))
        assert row["scenario_file"] == ""
        assert play(json.loads(json.dumps(row))).verdict == "same"


def test_rows_without_the_new_column_stay_readable(folder, pick):
    """A row from before `scenario_file` needs its file named; one of a published scenario needs nothing."""
    old = {key: value for key, value in pick().items() if key != "scenario_file"}
    (folder / "old.jsonl").write_bytes(encode([old]))
    (row,) = read_rows(folder / "old.jsonl")
    with pytest.raises(InputError, match=r"scenario.*'tiny'.*--scenario FILE"):
        play(row)
    assert play(row, Filter(scenario=str(folder / "tiny.yaml"))).verdict == "same"
    with pytest.raises(InputError, match=r"existing file.*--scenario"):
        play(old | {"scenario_file": "gone/tiny.yaml"})


def test_a_changed_scenario_file_is_noticed(folder, pick):
    """Another configuration under the same name: config_hash tells, and the trace is another one."""
    other = SCENARIO | {"plant": {"name": "car_following", "gap": 21.0}, "name": "tiny"}
    (folder / "other.yaml").write_text(yaml.safe_dump(other))
    replay = play(pick(), Filter(scenario=str(folder / "other.yaml")))
    assert replay.verdict in ("decisions", "different")
    assert {"config_hash", "min_gap"} <= {check.name for check in replay.differences}
    page = render(replay)
    assert "configuration (config_hash)" in page and "The same trace, bit for bit" not in page


@pytest.mark.parametrize(
    "change, verdict",
    [
        ({"trace_hash": "0" * 32}, "decisions"), ({"trace_hash": "0" * 32, "decision_hash": "0" * 32}, "different"),
        ({"trace_hash": None, "decision_hash": None}, "unknown"), ({"version": "0.0.1"}, "same"), ({"min_gap": 1.0}, "figures"),
    ],
)  # fmt: skip
def test_the_verdict_follows_the_hashes(pick, change, verdict):
    """Trace and decision hash decide; another version is said, and is not held against the trace; another figure is."""
    replay = play(pick() | change)
    assert replay.verdict == verdict
    assert [check.name for check in replay.differences] == [name for name in ("version", "min_gap") if name in change]
    text = render(replay)
    assert ("row <b>0.0.1</b>" in text) == ("version" in change)


def test_the_worst_row_is_a_crash_with_the_smallest_gap(rows):
    """A crash comes before any near miss, then the smaller gap; rows that failed are never chosen."""
    low = min(row["min_gap"] for row in rows)
    failed = rows[0] | {"status": "error", "reason": "broken", "crashed": None, "min_gap": None}
    crash, worse = (rows[1] | {"crashed": 1.0, "min_gap": low + gap} for gap in (3.0, 2.0))
    chosen = choose([failed, rows[2] | {"crashed": 0.0}, crash, worse, worse], Filter())
    assert chosen.line == 4 and chosen.matched == 5 and "worst" in chosen.why
    assert choose(rows, Filter(defence="kf", seed=1, attack="none")).matched == 1
    assert choose(rows, Filter(line=7)).row is rows[6]
    assert choose(rows, Filter(dose=30)).matched == 24


def test_filters_that_leave_nothing_say_what_there_is(rows):
    """One clear error for a wrong name, a line that does not exist, a line that does not match, and rows without figures."""
    for wanted, words in (
        (Filter(defence="chi2"), ["defence chi2", "kf", "chi2_kf:eta=9"]), (Filter(line=99), ["--line", "99", "1 to 24"]),
        (Filter(line=1, defence="chi2_kf:eta=9"), ["line 1", "kf", "matches"]), (Filter(dose="none"), ["dose none", "30"]),
    ):  # fmt: skip
        with pytest.raises(InputError) as caught:
            choose(rows, wanted)
        assert all(word in str(caught.value) for word in words)
    for status in ("error", "skipped"):
        lost = rows[0] | {"status": status, "reason": "no gate to pass"}
        for call in (lambda lost=lost: choose([lost], Filter()), lambda lost=lost: play(lost)):
            with pytest.raises(InputError, match=f"{status}: no gate to pass.*was played"):
                call()


@pytest.mark.parametrize("family", ["defence", "attack"])
def test_a_row_imports_nothing_unless_the_user_names_the_class(pick, tmp_path, monkeypatch, family):
    """A stranger's row that names module:Class leaves the module alone; the same name on the command line plays it."""
    base = {"defence": "from tailgate.estimators import Kalman as Base", "attack": "from tailgate.agents.scripts.scripted import NoAttack as Base"}[family]
    (tmp_path / f"evil_{family}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w').close()\n{base}\n\nclass Mine(Base):\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    text = f"evil_{family}:Mine"
    row = pick() | {family: text}
    with pytest.raises(InputError, match=f"must not import code.*--{family} '{text}'"):
        play(row)
    with pytest.raises(InputError):
        play(row, Filter(**{family: "kf"}))
    assert not (tmp_path / "ran").exists() and f"evil_{family}" not in sys.modules
    assert play(row, Filter(**{family: text})).verdict == "same"
    assert (tmp_path / "ran").exists()
    sys.modules.pop(f"evil_{family}")


@pytest.mark.long
def test_a_policy_is_found_again_by_its_content(tmp_path, monkeypatch):
    """The file of a row's policy may have moved: the same content is taken, another file is not."""
    monkeypatch.chdir(tmp_path)
    for suffix in ("json", "safetensors"):
        shutil.copy(ROOT / f"results/quickstart-v0/policy-0.{suffix}", tmp_path)
    shutil.copytree(ROOT / "results/quickstart-v0", tmp_path / "moved")
    cell = Cell("s", "gusty-stop-and-go-v0", 20, "chi2_kf", "policy-0.json", 1, threat={"fdi_bound": 3.0, "kinds": ["dos_jam", "fdi"]})
    (row,) = run_cell(cell)
    assert row["status"] == "ok"
    (tmp_path / "policy-0.json").unlink()
    with pytest.raises(InputError, match=r"policy-0.json.*--attack FILE"):
        play(row)
    assert Filter(attack="moved/policy-0.json").fits(row) and not Filter(attack="moved/policy-1.json").fits(row)
    assert not Filter(attack="moved/policy-0.json:stochastic=true").fits(row)
    replay = play(row | {"attack": str(tmp_path / "moved" / "policy-0.json")})
    assert replay.verdict == play(row, Filter(attack="moved/policy-0.json")).verdict == "same"
    assert str(tmp_path) not in render(replay) and "moved/policy-0" in render(replay)  # no page tells of somebody's folders


def test_a_file_that_changed_and_does_not_play_is_named(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("about: x\nphases:\n  - {kind: fdi, value: 1.0}\n")
    (row,) = evaluate(scenarios=["stop-and-go-v0"], defences=["kf"], attacks=[str(mine)], seeds=1)
    mine.write_text("about: x\nphases:\n  - {kind: replay, value: 20}\n")
    with pytest.raises(InputError, match=r"grants replay; the file of the attack is another one than the row's$"):
        play(row, Filter(attack=row["attack"]))


def test_the_data_of_the_page_are_those_of_the_trace(pick):
    """Every step of every decision, exactly; curves to six digits, with the entry that belongs to the step."""
    replay = play(pick("kf", "fdi_gaussian:start_step=5,targets=[position],sd=4", 1))
    data, trace = episode_of(replay), replay.trace
    n = data["length"]
    assert n == len(trace.kind) and {len(v) for v in data["road"].values()} == {n + 1} == {len(data["desired"])}
    for name in ("alarm", "mode", "refused", "kind", "score", "control"):
        assert len(data[name]) == n
    assert data["kind"] == trace.kind[:, 0].tolist() and data["alarm"] == trace.alarm[:, 0, 0].astype(int).tolist()
    (wire,) = data["wires"]
    assert wire["name"] == "position" and wire["unit"] == "m" and wire["kinds"] == [Kind.FDI]
    assert wire["hit"] == trace.target[:, 0, 0, 0].astype(int).tolist() and wire["value"] == trace.value[:, 0, 0, 0].tolist()
    assert data["left"][0] == 30 and data["left"][-1] == 30 - sum(wire["hit"])
    np.testing.assert_allclose(data["road"]["gap"][1:], trace.gap[:, 0, 0], rtol=1e-5)
    assert data["road"]["gap"][0] == pytest.approx(trace.first["gap"][0, 0], rel=1e-5)
    errors = {one["name"]: one["values"] for one in data["errors"]}
    np.testing.assert_allclose(errors["position"], (trace.estimate - trace.truth)[:, 0, 0, 0], rtol=1e-5)
    gap_at_k = (trace.first["position"] + trace.first["gap"])[0, 0] - trace.truth[0, 0, 0, 0]
    assert data["believed"]["gap"][0] == pytest.approx(gap_at_k - errors["position"][0], rel=1e-4)
    json.dumps(data, allow_nan=False)


def test_the_threshold_is_shown_where_the_defence_has_one(pick, monkeypatch):
    """chi2_kf names its gate and alarms exactly above it; the plain filter has none; a gate without a name is drawn as a curve."""
    gated = episode_of(play(pick("chi2_kf:eta=9", "dos_jam:start_step=20")))
    assert gated["threshold"] == {"name": "eta", "value": 9.0, "rules": True} and gated["gate"] is None and sum(gated["alarm"]) > 0
    assert episode_of(play(pick()))["threshold"] is None
    from tailgate.estimators.detectors.chi_square import ChiSquare, GatedKalman

    monkeypatch.setattr(GatedKalman, "threshold_field", None)
    monkeypatch.setattr(ChiSquare, "threshold_field", None)
    unnamed = episode_of(play(pick("chi2_kf:eta=9", "dos_jam:start_step=20")))
    assert unnamed["threshold"] is None and set(unnamed["gate"]) == {9.0}


def test_attacked_actuators_show_what_was_applied(pick):
    """The applied control is drawn only where it is not the commanded one."""
    assert episode_of(play(pick()))["applied"] is None
    other = episode_of(play(pick("kf", "fdi_then_jam:start_step=10,inject=4,value=-1.5")))
    assert other["applied"] is not None and other["applied"] != other["control"]
    assert {wire["name"] for wire in other["wires"]} == {"position", "velocity", "leader position", "acceleration"}


def test_texts_of_the_row_stay_texts(pick):
    """Whatever a row holds in its free fields, the page has its own two scripts, no other markup, and fetches nothing."""
    row = pick() | {"suite": HOSTILE, "reason": HOSTILE, "cell": HOSTILE, HOSTILE: HOSTILE, "version": HOSTILE, "engine": HOSTILE, "defence_digest": HOSTILE}
    text = render(play(row), HOSTILE)
    outline = Outline(text)
    assert [tag for tag, _ in outline.tags].count("script") == 2 and not any(tag in ("img", "iframe", "object", "form", "base") for tag, _ in outline.tags)
    assert "document.title='owned'" in "".join(outline.words)
    for tag, attrs in outline.tags:
        assert "style" not in attrs and not any(name.startswith("on") or name in ("src", "srcset", "action") for name in attrs)
        assert tag == "link" or "href" not in attrs
    assert "@import" not in text and not re.findall(r"https?://(?!www\.w3\.org/2000/svg)", text)
    blob = str(embedded({"x": HOSTILE}))
    assert not set("<>&\u2028") & set(blob) and json.loads(blob) == {"x": HOSTILE}


def test_a_failed_property_is_said_and_stays_text(pick):
    """What a row of `tailgate trust` says that its run fails; nothing without it; a stranger's words are no markup."""
    assert 'id="failed"' not in render(play(pick()))
    page = render(play(pick() | {"failed": {"property": HOSTILE, "about": "a < b", "formula": "G gap > 2"}}))
    assert "a &lt; b" in page and "<code>G gap &gt; 2</code>" in page and HOSTILE not in page
    assert 'id="failed"' not in render(play(pick() | {"failed": [1]}))


def test_the_page_says_everything_about_the_episode(pick):
    """Every metric with its unit, every parameter of scenario, threat model, defence and attack, and the row's identity."""
    replay = play(pick("chi2_kf:eta=9", "fdi_then_jam:start_step=10,inject=4,value=-1.5"))
    context = context_of(replay, "line 3 of rows.jsonl")
    words = " ".join(" ".join(Outline(render(replay, "line 3 of rows.jsonl")).words).split())
    for name, value, unit, doc, held in context["metrics"]:
        assert f"{name} {value} {unit} {doc}" in words and held == ""
    for part in (replay.place.threat_model, replay.place.plant, replay.place.controller, replay.place.manoeuvre, replay.loop.defence, replay.attack):
        assert all(field.name in words for field in dataclasses.fields(part))
    for text in ("line 3 of rows.jsonl", replay.row["trace_hash"], replay.row["config_hash"], "Short, for tests.", "40 steps of 0.1 s, 4 s in all"):
        assert text in words


def test_size_and_place_of_the_page(tmp_path, pick):
    """600 steps stay below a megabyte; a directory gets index.html, a name its file; the same row gives the same bytes."""
    (row,) = run_cell(Cell("s", "gusty-stop-and-go-v0", 100, "chi2_kf", "fdi_gaussian:start_step=60", 1))
    replay = play(row)
    page = write_page(replay, tmp_path / "new" / "folder")
    assert page == tmp_path / "new" / "folder" / "index.html" and 50_000 < page.stat().st_size < 500_000
    named = write_page(play(row), tmp_path / "deep" / "one.html")
    assert named.read_bytes() == page.read_bytes() and [p.name for p in named.parent.iterdir()] == ["one.html"]


def test_the_command_plays_and_reports(folder, tmp_path, capsys, monkeypatch):
    """Page and figures; exit code 0 for the same trace, 1 for another episode, 2 for bad input."""
    monkeypatch.chdir(tmp_path)
    rows = str(folder / "rows.jsonl")
    assert cli.main(["replay", rows, "--defence", "kf", "--out", "page"]) == 0
    said = capsys.readouterr().out
    assert "of 8 that match" in said and "The same trace, bit for bit" in said and (tmp_path / "page" / "index.html").is_file()
    assert cli.main(["replay", rows, "--line", "2", "--out", "p.html", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["line"] == 2 and report["verdict"] == "same" and report["page"] == "p.html" and report["seed"] == 1
    changed = [read_rows(folder / "rows.jsonl")[0] | {"trace_hash": "0" * 32, "decision_hash": "1" * 32}]
    Path("changed.jsonl").write_bytes(encode(changed))
    assert cli.main(["replay", "changed.jsonl", "--out", "p.html"]) == 1
    assert "NOT the episode of the row" in capsys.readouterr().out
    for arguments, words in (
        (["gone.jsonl"], ["gone.jsonl"]), ([rows, "--dose", "many"], ["--dose", "many"]), ([rows, "--attack", "fdi"], ["attack fdi", "dos_jam"]),
        ([rows, "--video", "x.avi"], ["--video", ".gif"]),
    ):  # fmt: skip
        assert cli.main(["replay", *arguments, "--out", "none.html"]) == 2
        error = capsys.readouterr().err
        assert all(word in error for word in words) and "expected" in error and not Path("none.html").exists()


def test_a_class_is_looked_for_in_the_working_directory_only_when_named(folder, tmp_path, monkeypatch, capsys):
    """The command line plays a row of one's own class from where one works; otherwise that folder is no source of modules."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    Path("mine_here.py").write_text("from tailgate.estimators import Kalman\n\nclass Mine(Kalman):\n    pass\n")
    Path("rows.jsonl").write_bytes(encode([read_rows(folder / "rows.jsonl")[0] | {"defence": "mine_here:Mine"}]))
    assert cli.main(["replay", "rows.jsonl", "--out", "p.html"]) == 2
    assert "--defence 'mine_here:Mine'" in capsys.readouterr().err and "" not in sys.path and not Path("p.html").exists()
    assert cli.main(["replay", "rows.jsonl", "--defence", "mine_here:Mine", "--out", "p.html"]) == 0
    assert "The same trace, bit for bit" in capsys.readouterr().out
    sys.modules.pop("mine_here")


# -- film


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_a_film_has_a_picture_of_every_step(pick, tmp_path, suffix):
    """A frame for the start and each step, as `draw` makes it; the last one is held."""
    image = pytest.importorskip("PIL.Image")
    from tailgate.replay.video import frames, write_video

    replay = play(pick("chi2_kf:eta=9", "dos_jam:start_step=20"))
    path = tmp_path / f"film{suffix}"
    said = write_video(replay, path)
    steps = int(replay.trace.length[0])
    with image.open(path) as film:
        assert film.n_frames == steps + 1 and str(film.n_frames) in said
        for i, picture in enumerate(frames(replay, 20)):
            film.seek(min(20 * i, steps))
            film.load()
            off = np.abs(np.asarray(film.convert("RGB"), int) - picture.astype(int))
            assert off.mean() < 1.5  # 256 colours
        assert film.info["duration"] == 2000
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_pace_of_a_film():
    """Real time at 20 frames a second at most; short episodes show every step; the count is bounded where memory is."""
    from tailgate.replay.video import pace

    assert pace(0.1, 600) == (1, pytest.approx(10.0)) and pace(0.01, 6000) == (5, pytest.approx(20.0))
    assert pace(0.01, 150) == (1, 20.0) and pace(0.01, 6000, 600) == (10, pytest.approx(10.0))


def test_mp4_names_what_it_needs(monkeypatch, tmp_path, folder, capsys):
    """Without the encoder: one line that names the extra, before anything is played."""
    pytest.importorskip("PIL")
    from tailgate.replay import video

    monkeypatch.setattr(video, "find_spec", lambda name: None)
    arguments = ["replay", str(folder / "rows.jsonl"), "--out", str(tmp_path / "p.html"), "--video", str(tmp_path / "film.mp4")]
    assert cli.main(arguments) == 2
    assert "pip install 'tailgate[video]'" in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.long
def test_mp4_is_written(pick, tmp_path, monkeypatch):
    """A file that the decoder reads back: as many frames as pictures, and the last one held. A writer that dies leaves the film of before."""
    decoder = pytest.importorskip("imageio_ffmpeg")
    from tailgate.replay.video import write_video

    replay = play(pick("chi2_kf:eta=9", "dos_jam:start_step=20"))
    write_video(replay, tmp_path / "film.mp4")
    count, _ = decoder.count_frames_and_secs(str(tmp_path / "film.mp4"))
    assert count == int(replay.trace.length[0]) + 1 + 20  # two seconds at 10 frames
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]
    before = (tmp_path / "film.mp4").read_bytes()
    for place in ("write", "fsync", "rename"):
        def die(what, path, place=place):
            if what == place:
                raise KeyboardInterrupt

        monkeypatch.setattr(files, "step", die)
        with pytest.raises(KeyboardInterrupt):
            write_video(play(pick("chi2_kf:eta=9", "none")), tmp_path / "film.mp4")
        assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"] and (tmp_path / "film.mp4").read_bytes() == before
