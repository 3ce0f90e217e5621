"""The whole thesis in one report: what it contains is covered, chapters resume, and the page says everything; chapter 7 by itself."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from tailgate import cli
from tailgate.base.errors import InputError
from tailgate.base.sources import fingerprint
from tailgate.core.scenario import load_scenario
from tailgate.evaluation.stats import proportion
from tailgate.thesis import ch7_automata, ch7_cost, ch7_loop, ch7_ratings, ch7_signals, ch7_trust, ch7_width, whole, whole_theorems
from tailgate.thesis.claims import Claim, Figure, Report, Table
from tailgate.thesis.run import CHAPTERS, flat, read, write
from tailgate.thesis.whole import Item, check_coverage, load_coverage, read_whole, reproduce_whole, write_whole
from tailgate.trust.cells import Outcome

ROOT = Path(__file__).parents[1]
PNG = b"\x89PNG\r\n\x1a\n" + bytes(20)


@pytest.fixture(scope="module")
def chapter_7():
    """Its claims by id: few runs of the automata, and of the loop three seconds of a few episodes."""
    monkey = pytest.MonkeyPatch()
    short = dataclasses.replace(load_scenario(ch7_loop.SCENARIO), horizon=70)
    monkey.setattr(ch7_loop, "load_scenario", lambda name: short)
    few = ("none", ch7_loop.SPOOFED, ch7_loop.RAMPS[2])
    monkey.setattr(ch7_loop, "ATTACKS", {k: ch7_loop.ATTACKS[k].replace("threshold=20", "threshold=28") for k in few})
    monkey.setattr(ch7_loop, "OTHER", few[1])
    monkey.setattr(ch7_loop, "RAMPS", few[2:])
    monkey.setattr(ch7_loop, "DEFENCES", {k: v for k, v in ch7_loop.DEFENCES.items() if k != "chi-square gate"})
    monkey.setattr(ch7_width, "load_scenario", lambda name: short)
    monkey.setattr(ch7_cost, "WITHIN", 5.0)
    monkey.setattr(ch7_automata, "LIMITS", {"Intermediate": (100.0,), "braking": (100.0, 500.0)})
    monkey.setattr(ch7_automata, "_limits", lambda curves: Table("", (), ()))
    runs, report = ch7_automata.play_all(3), Report("ch7", "", {}, drawn=False)
    for parts in (ch7_automata.parts(runs, 3), ch7_signals.parts(), ch7_trust.parts(runs), ch7_loop.parts(8, lambda _: None)):
        report.add(parts)
    for parts in (ch7_ratings.parts(runs, 10), ch7_width.parts(8), ch7_cost.parts()):
        report.add(parts)
    monkey.undo()
    return {claim.id: claim for claim in report.claims}


@pytest.mark.long
def test_chapter_7(chapter_7):
    """What has to come out whatever the seeds."""
    held = {name: claim.holds for name, claim in chapter_7.items()}
    assert held["7.4-interval"] == held["7.4-monitor"] == "yes" and held["7.4-600"] != "no"
    assert held["table-7.1"] == "partly" and held["table-7.1-transitive"] == held["7.4-scenario"] == held["7.3.5-coverage"] == "no"
    assert held["7.4-trust"] == held["7.3.5-confidence"] == "no" and held["7.4-overall"] != "yes"
    assert held["7.4-actuator"] != "yes" and chapter_7["7.4-actuator"].measured["guards"]["of 300"]["share"] == 1.0
    assert chapter_7["7.4-actuator"].measured["invariants"]["of 300"]["share"] == pytest.approx(0.898, abs=0.06)
    assert chapter_7["7.4-interval"].measured["36 of 36"] == "[0.9026, 1.0000]"
    assert chapter_7["7.3.5-coverage"].measured["least coverage"] == pytest.approx(0.936, abs=5e-4)
    assert chapter_7["7.3.2-interval"].measured["alarms without an attack"] == 0
    assert all(claim.why and claim.measured for claim in chapter_7.values())
    assert held["7.4-verified"] == "partly" and held["7.3.5-sum"] == "no" and held["7.4-notified"] == held["7.4-prevented"] == "yes"
    assert "too few runs" in chapter_7["7.4-prevented"].why and "too few runs" not in chapter_7["7.4-monitor"].why
    sized = chapter_7["7.3.2-size"].measured["interval over the same lidar's accuracy"]
    assert sized["x 0.5"]["runs with a false alarm"]["share"] == 1.0 and sized["x 1"]["runs with a false alarm"]["share"] == 0.0
    moves = list(chapter_7["7.3.4-size"].measured["moves of a run"].values())
    assert moves[0] < moves[1] < moves[2]


@pytest.mark.long
def test_a_threat_that_never_came_about_is_not_answered(chapter_7):
    """A property that held because its antecedent did not is no measurement."""
    told = chapter_7["7.4-600-threat"].measured
    none = [said for said in told.values() if said["answered"] is None]
    assert none and all(said["asked"].startswith("0 of") and said["reason"] for said in none) and "not measured" in flat(told)
    held, asked = np.array([True, True, False, False]), np.array([True, False, True, False])
    blank = ch7_loop.Run(*[np.zeros(4)] * 4, None, Outcome(held, np.zeros(4), asked, asked * 1, asked * 1))
    share = ch7_loop.answered(blank)
    assert share.value == 0.5 and share == proportion(1, 2)
    assert ch7_loop.answered(blank._replace(threat=blank.threat._replace(asked=~(asked | ~asked)))) is None


def test_the_number_of_runs_is_no_verdict():
    """Few runs without a failure, and one failure in a hundred, count for the claim; an interval below it counts against it."""
    few, one, half, none = proportion(20, 20), proportion(99, 100), proportion(14, 20), proportion(0, 20)
    assert ch7_trust.judge([few], 0.95) == ("yes", "; too few runs: a 95 % interval has 0.95 inside")
    assert ch7_trust.judge([one], 0.95)[0] == "yes" and ch7_trust.judge([proportion(100, 100)], 0.95) == ("yes", "")
    assert ch7_trust.judge([half], 0.95)[0] == ch7_trust.judge([few, none], 0.95)[0] == "partly"
    assert ch7_trust.judge([none], 0.95) == ("no", "") and "0.5 inside" in ch7_trust.judge([half], 0.95)[1]


@pytest.mark.long
@pytest.mark.parametrize(("chapter", "expected"), [("ch5", {"5.3.2": "yes", "5.3.5": "no"}), ("ch6", {"6.5.1": "yes", "6.5.2": "yes", "6.5.5": "no"})])
def test_theorems_without_a_figure(chapter, expected, monkeypatch):
    """The linear estimators converge; the lemma's bound has lost a transpose, with which it is reached."""
    monkeypatch.setattr(whole_theorems, "RADII", (1.1,))
    added = whole_theorems.chapter_5(10) if chapter == "ch5" else whole_theorems.chapter_6(10)
    claims = {claim.id: claim for claim in added}
    assert {name: claim.holds for name, claim in claims.items()} == expected
    lemma = claims["5.3.5" if chapter == "ch5" else "6.5.5"].measured
    assert lemma["largest norm over the bound as printed"] > 2.0 and lemma["over lam / 2 |Q^-1 A'|"] == pytest.approx(1.0, abs=1e-6)


def test_the_minimiser_is_one():
    """No point beside it is lower."""
    rng = np.random.default_rng(1)
    Q, A, a = np.diag([1.0, 2.0, 5.0]), rng.standard_normal((3, 3)), 1e3 * rng.standard_normal(3)
    x = whole_theorems.minimiser(Q, A, a)
    cost = lambda z: z @ Q @ z + np.linalg.norm(A @ z - a)  # noqa: E731
    assert all(cost(x + 1e-3 * step) > cost(x) for step in rng.standard_normal((50, 3)))


def recorded(*chapters):
    """Ids of the claims in the recorded reports."""
    return {c["id"] for n in chapters for c in json.loads((ROOT / f"results/reproduction/ch{n}/report.json").read_text())["claims"]}


def test_the_list_names_every_recorded_claim_and_no_other():
    check_coverage(load_coverage(), recorded(3, 4, 5, 6, 7))


@pytest.mark.long
def test_the_list_names_every_claim_and_no_other(chapter_7):
    """Ids are those of the recorded chapters 3 to 6, and of chapter 7 as it runs."""
    check_coverage(load_coverage(), recorded(3, 4, 5, 6) | set(chapter_7))


def test_the_list_has_everything_that_is_numbered():
    """Figures, tables, theorems, lemmas and algorithms of chapters 3 to 7, as the thesis's own lists have them."""
    items = " ".join(item.item for item in load_coverage())
    numbered = {"Figure": {3: 3, 4: 6, 5: 4, 6: 5, 7: 2}, "Table": {7: 1}}
    wanted = [f"{kind} {chapter}.{i}" for kind, counts in numbered.items() for chapter, count in counts.items() for i in range(1, count + 1)]
    wanted += [f"Theorem {section}.{i}" for section, count in (("4.5", 3), ("5.3", 4), ("6.5", 4)) for i in range(1, count + 1)]
    wanted += ["Lemma 4.5.4", "Lemma 5.3.5", "Lemma 6.5.5", "Algorithm 1", "Algorithm 2", "Algorithm 3"]
    assert [name for name in wanted if name not in items] == []
    names = [item.item for item in load_coverage()]
    assert len(set(names)) == len(names)


def test_a_list_that_does_not_fit_is_refused():
    """A claim that nobody makes, and one that answers nothing."""
    with pytest.raises(InputError, match="gone"):
        check_coverage([Item("i", "w", ("gone",))], ["there"])
    with pytest.raises(InputError, match="there"):
        check_coverage([Item("i", "w", (), (), "a drawing")], ["there"])


class Chapters:
    """Chapters that are made in no time, and count how often."""

    def __init__(self) -> None:
        self.played: list[str] = []

    def __call__(self, chapter: str, seeds: int, tick: object) -> Report:
        self.played.append(chapter)
        claims = [Claim(f"{chapter}-a", "a < b | c", 1.5, {"one": {"median": 1.0, "q25": 0.5, "q75": 2.0}}, "no", "because")]
        table = Table("numbers", ("a", "b"), (("1|2", "3"),))
        return Report(chapter, f"Chapter {chapter[2:]}: <b>", {"seeds": seeds}, claims, [table], [Figure("figure-x", "a caption", PNG)])


@pytest.fixture
def covered(monkeypatch):
    """A list that fits the chapters of above."""
    items = [Item(f"Figure {c}", "what", (f"{c}-a",), (f"{c}-figure-x",)) for c in CHAPTERS] + [Item("Figure 0", "boxes", why="a drawing")]
    monkeypatch.setattr(whole, "load_coverage", lambda: items)


def test_chapters_resume(tmp_path, covered):
    """A finished chapter is kept; one that was cut off, or of other seeds or sources, is run again."""
    play, said = Chapters(), []
    first = reproduce_whole(20, tmp_path, said.append, play=play)
    assert play.played == list(CHAPTERS) and first.kept == () and any("ch7" in text for text in said)
    again = reproduce_whole(20, tmp_path, play=play)
    assert len(play.played) == 5 and again.kept == tuple(CHAPTERS) and again.claims == first.claims
    assert [r.figures for r in again.reports] == [r.figures for r in first.reports] and again.reports[0].tables == first.reports[0].tables
    (tmp_path / "ch4" / "figure-x.png").unlink()
    (tmp_path / "ch5" / "report.json").write_text("{", encoding="utf-8")
    data = json.loads((tmp_path / "ch6" / "report.json").read_text())
    (tmp_path / "ch6" / "report.json").write_text(json.dumps(data | {"sources": "others"}), encoding="utf-8")
    reproduce_whole(20, tmp_path, play=play)
    assert play.played[5:] == ["ch4", "ch5", "ch6"]
    reproduce_whole(21, tmp_path, play=play)
    assert play.played[8:] == list(CHAPTERS)


def test_a_chapter_by_itself_is_the_whole_ones(tmp_path, covered):
    """What one command finished the other keeps, both ways; a file in place of the folder is refused before anything is played."""
    play = Chapters()
    assert not whole.chapter("ch4", 20, tmp_path / "ch4", play=play)[2]
    assert whole.chapter("ch4", 20, tmp_path / "ch4", play=play)[2] and play.played == ["ch4"]
    assert reproduce_whole(20, tmp_path, play=play).kept == ("ch4",)
    assert whole.chapter("ch5", 20, tmp_path / "ch5", play=play)[2]
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="writable"):
        whole.chapter("ch3", 20, tmp_path / "file", play=play)
    assert play.played == ["ch4", "ch3", "ch5", "ch6", "ch7"]


def test_one_report(tmp_path, covered):
    """Page, text and data hold every claim, table, figure and item; markup is shown, not run; nothing is fetched."""
    page = write_whole(reproduce_whole(20, tmp_path, play=Chapters()), tmp_path).read_text()
    text, data = (tmp_path / "report.md").read_text(), json.loads((tmp_path / "report.json").read_text())
    for chapter in CHAPTERS:
        assert f'id="{chapter}-a"' in page and f'href="#{chapter}-a"' in page and f'id="{chapter}-figure-x"' in page
        assert f"{chapter}-a (no)" in text and f"]({chapter}/figure-x.png)" in text and (tmp_path / chapter / "figure-x.png").is_file()
        assert data["chapters"][chapter]["claims"][0]["id"] == f"{chapter}-a" and chapter in data["seconds"]
    assert "a drawing" in page and "a drawing" in text and data["coverage"][-1]["why"] == "a drawing"
    assert "Chapter 3: <b>" not in page and "1|2".replace("|", "\\|") in text and "run time" in text
    assert "http://" not in page and "https://" not in page and "<script" not in page


def test_a_claim_that_no_item_has_stops_the_report(tmp_path, covered):
    """And so does a figure that no chapter draws."""
    done = reproduce_whole(20, tmp_path, play=Chapters())
    with pytest.raises(InputError, match="coverage"):
        write_whole(dataclasses.replace(done, coverage=done.coverage[1:]), tmp_path)
    with pytest.raises(InputError, match="figure-y"):
        write_whole(dataclasses.replace(done, coverage=[*done.coverage, Item("i", "w", (), ("ch3-figure-y",), "x")]), tmp_path)


def test_a_report_is_read_back_as_it_was_written(tmp_path):
    """Claims, tables, figures and settings."""
    report = Chapters()("ch3", 7, None)
    write(report, tmp_path, seeds=7)
    back, data = read(tmp_path)
    assert back == report and data["seeds"] == 7 and read(tmp_path / "nowhere") is None


def test_sources_are_a_hash_of_what_figures_depend_on(tmp_path):
    """A changed, moved or new source changes it, a page does not."""
    (tmp_path / "a.py").write_text("1", encoding="utf-8")
    first = fingerprint(tmp_path)
    (tmp_path / "page.html").write_text("1", encoding="utf-8")
    assert fingerprint(tmp_path) == first
    (tmp_path / "a.py").rename(tmp_path / "b.py")
    moved = fingerprint(tmp_path)
    (tmp_path / "c.yaml").write_text("", encoding="utf-8")
    assert len({first, moved, fingerprint(tmp_path)}) == 3


def test_the_command_without_a_chapter(tmp_path, covered, monkeypatch, capsys):
    """Everything under one folder; progress on standard error, JSON on standard output; a bad number of seeds is one line."""
    monkeypatch.setattr(whole.reproduce_whole, "__defaults__", (*whole.reproduce_whole.__defaults__[:-1], Chapters()))
    assert cli.main(["reproduce", "--seeds", "10", "--out", str(tmp_path / "all"), "--json"]) == 0
    shown = capsys.readouterr()
    assert [claim["id"] for claim in json.loads(shown.out)] == [f"{c}-a" for c in CHAPTERS] and "ch5: " in shown.err
    page = (tmp_path / "all" / "index.html").read_text(encoding="utf-8")
    for verdict in ("yes", "partly", "no"):  # a box for each, which hides its claims
        assert page.count(f'id="show-{verdict}" checked') == 1 and f"body:has(#show-{verdict}:not(:checked)) .claim.{verdict}" in page
    assert cli.main(["reproduce", "--seeds", "9", "--out", str(tmp_path / "few")]) == 2
    assert "seeds" in capsys.readouterr().err and not (tmp_path / "few").exists()


def test_the_published_report_is_read_back():
    """Its Markdown comes out byte for byte; the page has every claim, filters, and the version that measured."""
    published = ROOT / "results/reproduction"
    held = read_whole(published)
    assert whole.markdown(held).encode() == (published / "report.md").read_bytes()
    text = whole.html(held)
    assert all(f'id="{claim.id}"' in text for claim in held.claims) and len(held.claims) == 114
    assert 'id="show-partly"' in text and "<dt>Tailgate</dt><dd>0.1.0</dd>" in text and text.count("data:image/png;base64,") == 23


def test_a_folder_without_a_whole_report_is_refused(tmp_path, covered):
    """No file, another file, a chapter that is gone."""
    with pytest.raises(InputError, match=r"report\.json"):
        read_whole(tmp_path)
    (tmp_path / "report.json").write_text("[]")
    with pytest.raises(InputError, match="a report of all chapters"):
        read_whole(tmp_path)
    made = reproduce_whole(10, tmp_path, play=Chapters())
    write_whole(made, tmp_path)
    assert read_whole(tmp_path) == dataclasses.replace(made, kept=())
    (tmp_path / "ch5/report.json").unlink()
    with pytest.raises(InputError, match="ch5"):
        read_whole(tmp_path)
