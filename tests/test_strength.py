"""Measures of strength: twins of a schedule, monotone curves and critical doses; pictures and commands of all."""

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tailgate import cli
from tailgate.agents.policy.network_policy import Yoked
from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.draws import Role
from tailgate.core.registry import Spec
from tailgate.play.metrics import METRICS
from tailgate.play.trace import MEMORY, Trace, episodes_at_once, rollout
from tailgate.studies.collect import add_run
from tailgate.studies.dose import critical_dose, critical_interval, dose_response, fitted
from tailgate.studies.figures import dose_figure, timing_figure
from tailgate.studies.policies import label, loop_for, trained
from tailgate.studies.timing import periodic, play, shuffled, timing, timing_advantage
from tailgate.studies.transfer import transfer

from . import strong
from .strong import PLACE, THREAT, ZOO
from .strong import always as _always
from .strong import recorded as _recorded

half_place = strong.half_place


@pytest.fixture(scope="module")
def brief_place(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The scenario cut to 32 steps, attacked from step 10 on: a budget of 20 is spent within it."""
    return str(strong.cut(tmp_path_factory.mktemp("scenario"), 32, onset=10))


# -- twins of a schedule


def test_twins_have_as_many_steps_within_the_granted_window() -> None:
    """Shuffled and periodic: each episode's own number of steps, none outside of first..last, where the recorded ones stand at will."""
    rng = np.random.default_rng(0)
    recorded = np.zeros((90, 40), bool)
    recorded[20:61] = rng.random((41, 40)) < rng.random(40)  # from none to all of steps 21..61
    chance = draws.keys("train", range(40)).at(Role.POLICY, np.zeros(40, np.int64))
    for twin in (shuffled(recorded, 21, 61, chance), periodic(recorded, 21, 61)):
        assert np.array_equal(twin.sum(axis=0), recorded.sum(axis=0))
        assert not twin[:20].any() and not twin[61:].any()


@pytest.mark.parametrize(("steps", "gaps"), [(4, {10}), (3, {13, 14}), (40, {1})])
def test_periodic_steps_are_evenly_spread(steps: int, gaps: set[int]) -> None:
    """n of 40 steps lie 40 / n apart, rounded to whole steps."""
    recorded = np.zeros((50, 1), bool)
    recorded[5 : 5 + steps] = True
    at = np.flatnonzero(periodic(recorded, 6, 45)[:, 0])
    assert len(at) == steps and set(np.diff(at)) == gaps


def test_shuffled_steps_fall_evenly_and_do_not_depend_on_companions() -> None:
    """Each of 20 steps is hit in a quarter of 4000 episodes, within a 99.9 % interval; a row is the same alone."""
    recorded = np.zeros((20, 4000), bool)
    recorded[:5] = True
    keys = draws.keys("train", range(4000))
    twin = shuffled(recorded, 1, 20, keys.at(Role.POLICY, np.zeros(4000, np.int64)))
    spread = 3.9 * math.sqrt(0.25 * 0.75 / 4000)  # of the largest of 20
    assert np.abs(twin.mean(axis=1) - 0.25).max() < spread
    alone = draws.keys("train", [17]).at(Role.POLICY, np.zeros(1, np.int64))
    assert np.array_equal(shuffled(recorded[:, :1], 1, 20, alone)[:, 0], twin[:, 17])
    assert not np.array_equal(twin[:, 17], twin[:, 18])


@pytest.mark.long
def test_own_and_yoked_are_those_of_the_timing_advantage(half_place: str) -> None:
    """One definition: play() agrees with policy.timing_advantage on every episode, and all schedules spend the same steps."""
    who = trained(ZOO)
    loop, keys = loop_for(who, half_place, "chi2_kf", THREAT), draws.keys("report", range(24))
    played = play(loop, who.policy, keys, "crashed")
    own, yoked = timing_advantage(loop, who.policy, keys)
    assert np.array_equal(played.outcome["own"], own) and np.array_equal(played.outcome["yoked"], yoked)
    assert own.any()
    assert all((steps <= 20).all() for steps in played.steps.values())


def test_a_policy_without_timing_is_flagged(tmp_path: Path, brief_place: str) -> None:
    """One that attacks in the same steps of every episode equals its yoked twin, and says so; two seeds of it are one entry."""
    texts = [str(_always(tmp_path, f"p{i}", seed=i)) for i in range(2)]
    report = timing(texts, scenario=brief_place, episodes=12)
    (entry,) = report["entries"]
    assert [p["seed"] for p in entry["policies"]] == [0, 1]
    assert entry["advantage"]["yoked"]["value"] == 0.0 and entry["flags"] == ["timing not shown to matter"]
    assert entry["attack_steps"] == {"own": 20.0, "yoked": 20.0, "shuffled": 20.0, "periodic": 20.0}
    assert entry["threat_model"]["budget"] == 20 and entry["defence"] == "chi2_kf"


def test_an_entry_is_of_one_cell(tmp_path: Path, brief_place: str) -> None:
    """Policies of another training threat or action are entries of their own; a dose of one's own is played by all."""
    changed: dict[str, dict[str, Any]] = {"a": {}, "b": {"budget": 10}, "c": {"value": -2.0}}
    texts = [str(_always(tmp_path, name, **changes)) for name, changes in changed.items()]
    assert len(timing(texts, scenario=brief_place, episodes=2)["entries"]) == 3
    entries = timing(texts, scenario=brief_place, episodes=2, dose=5, outcome="rmse_position")["entries"]
    assert {e["threat_model"]["budget"] for e in entries} == {5} and {e["attack_steps"]["own"] for e in entries} == {5.0}
    assert all(e["outcomes"]["own"]["value"] > 0.0 for e in entries)


def test_what_a_file_does_not_say_has_to_be_said(tmp_path: Path, brief_place: str) -> None:
    path = _always(tmp_path, "p")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"training": {}}))
    with pytest.raises(InputError, match="--scenario"):
        timing([str(path)], episodes=2)
    report = timing([str(path)], scenario=brief_place, defence="kf", threat=THREAT, episodes=2)
    assert report["entries"][0]["trained_on"] is None
    with pytest.raises(InputError, match="policy"):
        trained("fdi")
    with pytest.raises(InputError, match="outcome"):
        timing([ZOO], outcome="crash", episodes=2)
    with pytest.raises(InputError, match="at least 2"):
        timing([ZOO], episodes=1)


@pytest.mark.long
def test_many_episodes_are_played_as_memory_allows(monkeypatch: pytest.MonkeyPatch, half_place: str) -> None:
    """The timing advantage of 10 episodes, seven at a time, is that of all at once to the bit: each has the times of the one before it."""
    who = trained(ZOO)
    loop, keys = loop_for(who, half_place, "chi2_kf", THREAT), draws.keys("report", range(10))
    record = rollout(loop, who.policy, keys, terminate=False).kind != 0
    twin = Yoked(who.policy, np.roll(record, 1, axis=1))
    together = [METRICS["min_gap"](rollout(loop, attack, keys)) for attack in (who.policy, twin)]
    sizes: list[int] = []

    def counted(loop: Any, attack: Any, keys: Any, **options: Any) -> Trace:
        sizes.append(len(keys.key))
        return rollout(loop, attack, keys, **options)

    monkeypatch.setattr("tailgate.studies.timing.rollout", counted)
    monkeypatch.setattr("tailgate.play.trace.MEMORY", 7.5 * MEMORY / episodes_at_once(loop.model, loop.horizon, 10**9))
    apart = timing_advantage(loop, who.policy, keys, "min_gap")
    assert sizes == [7, 3] * 3
    assert np.array_equal(apart, together) and not np.array_equal(*apart)
    played = play(loop, who.policy, keys, "min_gap")
    assert np.array_equal([played.outcome["own"], played.outcome["yoked"]], together)


# -- what a record may name


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The mark that somebody's module leaves when it is imported."""
    mark = tmp_path / "ran"
    (tmp_path / "somebodys.py").write_text(f"open({str(mark)!r}, 'w').close()\nclass D: pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "somebodys", raising=False)
    return mark


NAMES = [
    ("defence", "somebodys:D"), ("defence", "composed:detector=somebodys:D"), ("defence", "cra:filter.name=somebodys:D"),
    ("others", ["kf", "somebodys:D"]), ("rivals", ["somebodys:D:value=3"]), ("white_box", ["somebodys:D"]), ("teacher", "somebodys:D"),
]  # fmt: skip


@pytest.mark.parametrize(("field", "value"), NAMES)
def test_a_record_that_names_code_runs_nothing(
    tmp_path: Path, module: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, field: str, value: Any
) -> None:
    """One line that names the file and the field, from every command that reads records, even where another defence is asked for."""
    monkeypatch.setattr("tailgate.studies.collect.FOLDER", tmp_path / "zoo")
    policy = str(_recorded(_always(tmp_path, "policy-0"), **{field: value}))
    for words in (
        ["timing", policy], ["timing", policy, "--defence", "kf"], ["transfer", policy], ["transfer", policy, "--defence", "kf"],
        ["zoo", "add", str(tmp_path), "--name", "x"],
    ):  # fmt: skip
        assert cli.main(words) == 2
        error = capsys.readouterr().err.strip()
        assert "\n" not in error and f"policy-0.json: training.config.{field}" in error and "somebodys:D" in error
        assert not module.exists() and "somebodys" not in sys.modules
    assert Spec("defence", "somebodys:D").entry  # what a command line names is imported: the module would have run
    assert module.exists()


def test_a_scenario_of_a_record_is_a_registered_one(tmp_path: Path, brief_place: str) -> None:
    """A path is the user's to name."""
    path = str(_recorded(_always(tmp_path, "policy-0"), scenario=brief_place))
    for call in (lambda: timing([path], episodes=2), lambda: transfer([path], episodes=2), lambda: add_run(tmp_path, "x", episodes=2)):
        with pytest.raises(InputError, match=r"policy-0: training\.config\.scenario.*brief\.yaml"):
            call()
    assert timing([path], scenario=brief_place, episodes=2)["entries"][0]["scenario"] == brief_place


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"defence": "chi2_kf:eta=" + "[" * 5000}, r"chi2_kf\.eta"), ({"defence": "chi2_kf:eta=2020-13-45"}, r"chi2_kf\.eta.*2020-13-45"),
        ({"threat": {"self": 1}}, r"config\.threat.*'self'"), ({"scenario": "nowhere"}, "nowhere"), ({"scenario": 5}, "--scenario"),
        ({"defence": "nothing"}, "nothing"), ({"defence": ["kf"]}, "--defence"), ({"outcome": "crash"}, "crash"),
    ],
)  # fmt: skip
def test_a_record_that_makes_no_sense_is_one_clear_error(tmp_path: Path, fields: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        timing([str(_recorded(_always(tmp_path, "policy-0"), **fields))], episodes=2)


# -- dose-response


def test_the_critical_dose_of_a_straight_curve_is_where_it_crosses() -> None:
    """By hand: 0, 0.05, 0.25 at doses 0, 10, 20 cross 0.1 at 12.5; a curve that starts above is critical at once, one below never."""
    doses = np.array([0.0, 10.0, 20.0])
    assert critical_dose(doses, np.array([0.0, 0.05, 0.25]), 0.1) == pytest.approx(12.5)
    assert critical_dose(doses, np.array([0.2, 0.2, 0.3]), 0.1) == 0.0
    assert critical_dose(doses, np.array([0.0, 0.1, 0.1]), 0.1) == math.inf


def test_the_curve_is_the_monotone_regression() -> None:
    """Pool adjacent violators by hand: 1, 3, 2 become 1, 2.5, 2.5."""
    assert fitted(np.array([1.0, 3.0, 2.0])) == pytest.approx([1.0, 2.5, 2.5])


@pytest.mark.parametrize("episodes", [20, 150])
def test_the_interval_covers_the_critical_dose(episodes: int) -> None:
    """At 95 % or more, also of few episodes. Where no episode was damaged it is no point."""
    doses, shares = np.array([0.0, 10.0, 20.0]), np.array([0.0, 0.05, 0.25])
    rng, hits = np.random.default_rng(1), 0
    for _ in range(200):
        low, high = critical_interval(doses, (rng.random((3, episodes)) < shares[:, None]).astype(float), 0.1, True)
        hits += low <= 12.5 <= high
    assert hits >= 190
    low, high = critical_interval(doses, np.zeros((3, episodes)), 0.1, True)
    assert low < 20.0 and high == math.inf if episodes == 20 else low == high == math.inf


@pytest.mark.long
def test_dose_response_of_a_scripted_attack(tmp_path: Path) -> None:
    """Dose 0 is no attack, more steps do more, spent steps are the dose; the second call plays nothing again and says the same."""
    attack = "fdi:trigger=near,threshold=40,value=-3"
    played: list[int] = []
    arguments: dict[str, Any] = {"episodes": 40, "threat": THREAT, "rows_file": tmp_path / "rows.jsonl"}
    report = dose_response([attack], ["chi2_kf"], PLACE, [20, 5], **arguments, progress=lambda done, total: played.append(done))
    (curve,) = report["curves"]
    assert report["doses"] == [0, 5, 20] and len(played) == 3
    assert [p["value"] for p in curve["points"]] == sorted(p["value"] for p in curve["points"])
    assert curve["points"][0]["value"] == 0.0 and curve["points"][-1]["value"] > 0.3
    assert curve["attack_steps"][0] == 0.0 and curve["attack_steps"][1] == 5.0
    assert 5.0 < curve["critical_dose"]["low"] <= curve["critical_dose"]["value"] <= curve["critical_dose"]["high"] < 20.0
    assert len((tmp_path / "rows.jsonl").read_text().splitlines()) == 120
    assert dose_figure(report)[:4] == b"\x89PNG"


@pytest.mark.long
def test_a_dose_response_of_an_error_counts_episodes_above_a_bound(tmp_path: Path) -> None:
    """Without a road: the mean has no critical dose until a limit is named, the share above a bound has one of 10 %."""
    arguments: dict[str, Any] = {"episodes": 6, "threat": {"kinds": ["fdi"], "fdi_bound": 100.0}, "rows_file": tmp_path / "rows.jsonl"}
    plain = dose_response(["fdi:value=100"], ["dkf"], "thesis-ch5-v0", [10], **arguments)
    assert plain["outcome"] == "rmse_position" and plain["limit"] is None and "critical_dose" not in plain["curves"][0]
    clean, attacked = (point["value"] for point in plain["curves"][0]["points"])
    assert attacked > clean > 0.0
    shares = dose_response(["fdi:value=100"], ["dkf"], "thesis-ch5-v0", [10], outcome="max_error", exceeds=0.0, **arguments)
    assert shares["unit"] == "0/1" and shares["curves"][0]["critical_dose"]["value"] == 0.0  # every error is above 0
    never = dose_response(["fdi:value=100"], ["dkf"], "thesis-ch5-v0", [10], outcome="max_error", exceeds=1e9, **arguments)
    assert never["curves"][0]["critical_dose"] == {"value": None, "low": None, "high": None}


def test_what_cannot_be_played_is_skipped_with_the_reason(tmp_path: Path) -> None:
    """A policy of another layout, and a defence that an attack has no use of; what is misspelt is an error."""
    other = str(_always(tmp_path, "p", kinds=["fdi"]))
    report = dose_response([other, "none"], ["kf"], PLACE, [5], episodes=2, threat=THREAT)
    assert [("skipped" in c) for c in report["curves"]] == [False, True] and "3 actions" in report["curves"][1]["skipped"]
    for bad in ([0], [], [2.5]):
        with pytest.raises(InputError, match="doses"):
            dose_response(["none"], ["kf"], PLACE, bad, episodes=2)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="yes or no"):
        dose_response(["none"], ["kf"], PLACE, [5], episodes=2, exceeds=1.0)
    for limit in (-1.0, 1.0, float("nan")):
        with pytest.raises(InputError, match="limit"):
            dose_response(["none"], ["kf"], PLACE, [5], episodes=2, limit=limit)
    for few in (0, -3):
        with pytest.raises(InputError, match=rf"episodes: got {few}"):
            dose_response(["none"], ["kf"], PLACE, [5], episodes=few)
        with pytest.raises(InputError, match=rf"episodes: got {few}"):
            transfer([other], episodes=few)


def test_a_dose_response_of_nothing_says_so(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    other = str(_always(tmp_path, "p", kinds=["fdi"]))
    assert cli.main(["dose-response", other, "--defence", "kf", "--scenario", PLACE, "--doses", "5", "--episodes", "2"]) == 1
    assert "nothing was played; --threat" in capsys.readouterr().out


def test_a_dose_response_of_means_has_no_critical_dose(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Without a limit: the table has the means, and the report is written."""
    words = ["dose-response", "fdi:start_step=20,value=5", "--defence", "kf", "--scenario", PLACE, "--doses", "5,10", "--episodes", "4"]
    assert cli.main([*words, "--threat", "fdi_bound=10", "--outcome", "max_error", "--out", str(tmp_path)]) == 0
    assert "max_error by dose" in capsys.readouterr().out and (tmp_path / "dose-response.json").is_file()


@pytest.mark.parametrize("outcome", ["min_gap", "distance_travelled"])
@pytest.mark.parametrize("command", ["timing", "transfer", "dose-response", "train"])
def test_an_outcome_is_the_worse_the_larger(command: str, outcome: str, capsys: pytest.CaptureFixture[str]) -> None:
    rest = {"dose-response": ["fdi", "--defence", "kf", "--scenario", PLACE, "--doses", "5"], "train": []}.get(command, [ZOO])
    assert cli.main([command, *rest, *([f"outcome={outcome}"] if command == "train" else ["--outcome", outcome])]) == 2
    assert "a metric where more is worse" in capsys.readouterr().err


# -- pictures and commands


@pytest.mark.parametrize("text", ["fdi:trigger=near,threshold=40,value=-3", "composed:filter=kf,detector=cusum,mitigation=widen"])
def test_long_names_break_at_commas_only(text: str) -> None:
    lines = label(text, 14).split("\n")
    assert len(lines) > 1 and "".join(lines).replace(" ", "") == text
    assert all(line.endswith(",") for line in lines[:-1])


def test_the_commands_write_reports_and_pictures(
    tmp_path: Path, brief_place: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """JSON on standard output equals the file; every command has its picture."""
    monkeypatch.chdir(tmp_path)
    grants = [word for key in ("kinds=[dos_jam,fdi]", "fdi_bound=3") for word in ("--threat", key)]
    policy = str(_always(tmp_path, "p"))
    script = "fdi:trigger=near,threshold=40,value=-3"
    commands = {
        "timing": ["timing", policy, "--scenario", brief_place, "--episodes", "6"],
        "dose-response": ["dose-response", script, "--defence", "kf", "--scenario", brief_place, "--doses", "5,10", "--episodes", "4", *grants],
        "transfer": ["transfer", policy, "--scenario", brief_place, "--defence", "kf", "--episodes", "4"],
    }
    shown = {"timing": "yoked", "dose-response": "critical dose", "transfer": "on kf"}
    for name, words in commands.items():
        assert cli.main([*words, "--out", "out", "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == json.loads((tmp_path / "out" / f"{name}.json").read_text())
        assert (tmp_path / "out" / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
        assert cli.main([*words, "--out", "vectors", "--picture", "pdf"]) == 0
        assert (tmp_path / "vectors" / f"{name}.pdf").read_bytes()[:4] == b"%PDF"
        said = capsys.readouterr().out
        assert not said.startswith("{") and shown[name] in said
    assert cli.main(["dose-response", "none", "--defence", "kf", "--scenario", PLACE, "--doses", "5;10"]) == 2
    assert "--doses" in capsys.readouterr().err


@pytest.mark.long
def test_a_timing_picture_has_a_panel_per_outcome(tmp_path: Path, brief_place: str) -> None:
    policy = str(_always(tmp_path, "p"))
    arguments: dict[str, Any] = {"scenario": brief_place, "episodes": 2}
    entries = [*timing([policy], **arguments)["entries"], *timing([policy], outcome="rmse_position", **arguments)["entries"]]
    assert timing_figure(entries)[:4] == b"\x89PNG" and len({e["unit"] for e in entries}) == 2
