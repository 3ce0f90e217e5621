"""Calibration: the onsets are those of the metric, the thresholds hold on fresh runs, and the defaults are the recorded ones."""

import dataclasses
import functools
import json
import math
import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import tailgate
from tailgate import cli
from tailgate.base.errors import InputError
from tailgate.core.draws import keys
from tailgate.core.scenario import config_path
from tailgate.core.schema import fields_of
from tailgate.core.score_threshold import Watched
from tailgate.estimators import ChiSquare, Cusum, GateOut, KalmanFilter, Mewma, WindowedChiSquare, compose
from tailgate.evaluation.attack_free import Bench, Count, Crossings, count_onsets
from tailgate.evaluation.calibrate import MIXTURE, calibrate
from tailgate.play import trace
from tailgate.play.metrics import METRICS
from tailgate.play.trace import rollout

RECORDS = json.loads((Path(__file__).parents[1] / "benchmarks/results/calibration.json").read_text(encoding="utf-8"))
ENTRIES = [entry | {"command": record["command"]} for record in RECORDS for entry in record["results"]]
STEPS = 120  # of the episodes here: short ones side by side are quicker than long ones


@pytest.fixture(scope="module")
def roads(tmp_path_factory):
    """Two scenarios of 12 s episodes, as files."""
    out = []
    for name in ("stop-and-go-v0", "ornstein-uhlenbeck-v0"):
        text = config_path("scenarios", name, "scenario").read_text(encoding="utf-8")
        out.append(tmp_path_factory.mktemp("roads") / f"brief-{name}.yaml")
        out[-1].write_text(text.replace("horizon: 600", f"horizon: {STEPS}"), encoding="utf-8")
    return tuple(str(path) for path in out)


@pytest.mark.parametrize("keep", [10**6, 300])
def test_crossings_count_climbs_over_a_level(keep):
    """The level for n climbs is passed n times, and no higher one is: counted step by step on random scores."""
    score = np.random.default_rng(2).exponential(size=(200, 40)).cumsum(axis=0) % 7.0
    before = np.concatenate([np.full((1, 40), -np.inf), score[:-1]])
    crossings = Crossings(keep)
    for part in (slice(0, 15), slice(15, 40)):
        climbed = score[:, part] > before[:, part]
        crossings.add(before[:, part][climbed], score[:, part][climbed])

    def climbs(level):
        return np.count_nonzero((before <= level) & (score > level))

    for wanted in (1, 7, 100):
        level = crossings.level(wanted)
        assert climbs(level) >= wanted and all(climbs(higher) < wanted for higher in np.linspace(level + 1e-3, 7.0, 200))
    assert crossings.level(10**6) is None


def test_onsets_are_those_of_the_metric(short):
    """Counted while the loop runs, they equal `alarm_onsets` of the traces, also of episodes that end early."""
    place = short("thesis-ch4-v0", horizon=150)
    place = dataclasses.replace(place, ends_on_collision=True)
    loop = place.loop(tailgate.make_defence("chi2_kf", eta=4.0))
    held = keys("calibrate", range(40))
    onsets, steps = count_onsets(loop, held)
    trace = rollout(loop, tailgate.make_attack("none"), held)
    np.testing.assert_array_equal(onsets.sum(axis=1), METRICS["alarm_onsets"](trace))
    np.testing.assert_array_equal(steps, trace.length)
    assert steps.sum() < 40 * 150 and onsets.sum(axis=1).min() < onsets.sum(axis=1).max()
    alarm = (trace.alarm.any(axis=2) & trace.live)[:75]
    np.testing.assert_array_equal(onsets[:, 0], (alarm[1:] & ~alarm[:-1]).sum(axis=0) + alarm[0])


@pytest.mark.long
@pytest.mark.parametrize(("defence", "scenario"), [("chi2_kf", "braking-v0"), ("imm", "stop-and-go-v0"), ("cusum_kf", "radar-braking-v0")])
def test_the_plain_loop_finds_the_same_threshold(monkeypatch, defence, scenario):
    """To the last digit, with the same alarms in as many steps."""
    found = []
    for worth in (trace.WORTH, np.inf):
        monkeypatch.setattr(trace, "WORTH", worth)
        found.append(calibrate(defence, 0.02, scenarios=[scenario], onsets=40, most_steps=200_000).as_data())
    assert found[0] == found[1] and found[0]["measured"]["onsets"] > 0


def test_the_interval_is_exact_poisson():
    """Its ends are the means under which the count is a 2.5 % event; clusters widen it; no onset has no upper end."""
    low, high = Count(12, 36_000.0, 1, 1.0).interval()
    assert stats.poisson.cdf(12, 10.0 / low) == pytest.approx(0.025, rel=1e-9)
    assert stats.poisson.sf(11, 10.0 / high) == pytest.approx(0.025, rel=1e-9)
    wide = Count(12, 36_000.0, 1, 3.0).interval()
    assert wide[0] < low and wide[1] > high and Count(12, 36_000.0, 1, 0.5).interval() == (low, high)
    assert Count(0, 3600.0, 1, 1.0).hours is None and Count(0, 3600.0, 1, 1.0).interval() == (pytest.approx(1 / 3.6889, rel=1e-4), None)


@pytest.mark.parametrize("defence", ["chi2_kf", pytest.param("windowed_chi2_kf", marks=pytest.mark.long), *(pytest.param(name, marks=pytest.mark.long) for name in ("cusum_kf", "mewma_kf"))])
def test_a_calibrated_threshold_holds_on_fresh_runs(defence, roads):
    """For 0.1 h: the mean time between onsets is within 20 % on fresh seeds; for chi2 the threshold is that of theory."""
    done = calibrate(defence, 0.1, scenarios=roads[:1], onsets=200, check=True)
    assert done.settled and abs(done.measured.hours / 0.1 - 1) < 0.03
    assert abs(done.fresh.hours / 0.1 - 1) < 0.2
    assert done.fresh.onsets > 160 and done.measured.steps == done.fresh.steps == 200 * 3600
    if defence == "chi2_kf":  # exp(-eta / 2) a step
        assert done.threshold == pytest.approx(2.0 * math.log(3600.0), abs=0.5)


@pytest.mark.long
def test_a_long_mean_time_is_found_on_fewer_alarms(roads):
    """Where a run would take too many steps it is cut, and the interval says what that leaves; with too few alarms it is refused."""
    done = calibrate("composed:detector=chi2,mitigation=accept_all", 0.2, scenarios=roads[:1], onsets=400, most_steps=180_000)
    assert done.field == "detector.eta" and done.measured.steps == 180_000 and 24 <= done.measured.onsets <= 26
    low, high = done.measured.interval()
    assert low < 0.14 and high > 0.29 and done.threshold == pytest.approx(2.0 * math.log(7200.0), abs=1.2)
    with pytest.raises(InputError, match=r"hours: got 0\.3; expected at most 0\.25 with 180000 steps"):
        calibrate("chi2_kf", 0.3, scenarios=roads[:1], onsets=400, most_steps=180_000)


@pytest.mark.long
def test_results_do_not_depend_on_the_batch_and_seeds_are_not_shared(roads):
    """The same record for batches of 5 and 64, and it is JSON; no two scenarios play the same noise."""
    one, two = (calibrate("chi2_kf", 0.01, scenarios=roads, onsets=4, batch=batch).as_data() for batch in (5, 64))
    assert one == two and json.loads(json.dumps(one)) == one
    assert list(one["seeds"].values()) == [[0, 5], [6, 11]] and one["measured"]["steps"] == 12 * STEPS


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: f"{e['defence']}, {e['wanted_hours']:g} h")
def test_the_record_holds_on_fresh_runs(entry):
    """Each recorded threshold was within 20 % on fresh seeds of the declared mixture, or as near as the number of its alarms tells."""
    measured, fresh, wanted = entry["measured"], entry["fresh"], entry["wanted_hours"]
    assert list(entry["seeds"]) == list(MIXTURE) and (measured["purpose"], fresh["purpose"]) == ("calibrate", "report")
    assert abs(measured["hours"] / wanted - 1) < 0.03
    if wanted <= 1.0:
        assert abs(fresh["hours"] / wanted - 1) < 0.2 and fresh["onsets"] > 300
    else:  # both counts are uncertain: 2.6 deviations of the logarithm of their ratio, 1 % by chance
        assert abs(math.log(fresh["hours"] / wanted)) < 2.6 * math.sqrt(1 / measured["onsets"] + 1 / fresh["onsets"]) < 0.8
    assert entry["settled"] and f"--defence {entry['defence']} " in entry["command"] and "--check" in entry["command"]


DEFAULTS = {entry["defence"]: entry["threshold"] for entry in ENTRIES if entry["wanted_hours"] == 1.0}
DETECTORS = [(WindowedChiSquare(), "windowed_chi2_kf"), (Cusum(), "cusum_kf"), (Mewma(), "mewma_kf")]


def test_defaults_are_the_recorded_thresholds():
    """Named defences and their detectors alarm once in an hour by default; chi2_kf keeps the thesis's gate."""
    named = ["windowed_chi2_kf", "cusum_kf", "mewma_kf", "reacquire_kf", "cusum_reacquire_kf", "widen_kf", "brake_kf"]
    for name in named:
        made = tailgate.make_defence(name)
        assert getattr(made, made.threshold_field) == DEFAULTS[name], name
    for detector, name in DETECTORS:
        assert detector.threshold == DEFAULTS[name], name
    assert tailgate.make_defence("chi2_kf").eta == 20.0 and DEFAULTS["chi2_kf"] == pytest.approx(2 * math.log(36_000.0), abs=0.5)


BAD = [
    ({"hours": 0.0}, "hours"), ({"hours": -1.0}, "hours"), ({"hours": math.nan}, "hours"), ({"hours": math.inf}, "hours"),
    ({"hours": 1e-6}, "score does not rise that often"), ({"onsets": 0}, "onsets"), ({"most_steps": 0}, "steps"), ({"batch": 0}, "batch"),
    ({"scenarios": ("stop-and-go",)}, "stop-and-go-v0"), ({"scenarios": ()}, "at least one"),
    ({"scenarios": ("braking-v0", "braking-v0")}, "each scenario once"),
    ({"defence": "cusum_fk"}, "cusum_kf"), ({"defence": "cusum_kf:threshold=0"}, "greater than 0"),
]  # fmt: skip


@pytest.mark.parametrize("changes, expected", BAD)
def test_bad_input(changes, expected, roads):
    """One InputError that names the field, before anything long is played."""
    arguments = {"defence": "chi2_kf", "hours": 0.01, "scenarios": roads, "onsets": 5} | changes
    with pytest.raises(InputError, match=expected):
        calibrate(arguments.pop("defence"), arguments.pop("hours"), **arguments)


@pytest.mark.parametrize("defence", ["none", "always_alarm"])
def test_a_score_that_does_not_move(defence, roads):
    """There is nothing that a threshold could be held against."""
    with pytest.raises(InputError, match="score does not move"):
        calibrate(defence, 0.01, scenarios=roads, onsets=5)


@pytest.mark.long
def test_a_score_that_jumps_gets_the_threshold_that_alarms_more_rarely():
    """A leader that uses all the acceleration it may puts a safe set's reading on its very edge, once in each run, whatever the threshold below."""
    found = calibrate("safe_state", 0.1, scenarios=["stop-and-go-v0"], onsets=100, most_steps=120_000)
    assert not found.settled and 0.9999 < found.threshold <= 1.0 and found.measured.onsets == 0 and found.field == ""
    bench = Bench.of("safe_state", ["stop-and-go-v0"], 4096, None)
    assert bench.run(found.threshold - 2e-7, 2.0, "calibrate", "").onsets == sum(map(len, bench.seeds(2.0)))


@pytest.mark.long
def test_a_climb_in_each_of_very_many_runs_is_not_taken_for_a_score_that_stands_still(monkeypatch):
    """Only the highest climbs are kept, and those of a safe set are then all alike."""
    monkeypatch.setattr(Crossings, "__init__", lambda self, keep, begin=Crossings.__init__: begin(self, 100))
    found = calibrate("safe_state", 0.1, scenarios=["stop-and-go-v0"], onsets=100, most_steps=120_000)
    assert found.measured.onsets == 0 and found.threshold <= 1.0


@dataclass(frozen=True)
class Odd:
    """A Kalman filter that tells a function of its score."""

    how: str = "p"

    def __getattr__(self, name):
        return getattr(tailgate.make_defence("kf"), name)

    def step(self, plan, state, received, known_u, draws):
        state, told = tailgate.make_defence("kf").step(plan, state, received, known_u, draws)
        odd = {"p": lambda g: 1.0 - np.exp(-g / 2.0), "negative": lambda g: -1.0 / (1.0 + g), "steps": lambda g: np.floor(g / 8.0) - 3.0}[self.how]
        return state, told._replace(score=odd(told.score))


@functools.cache
def _of_fifty(defence, roads):
    return calibrate(defence, 0.02, scenarios=roads, onsets=50, most_steps=200_000)


@pytest.mark.long
@pytest.mark.parametrize("how", ["p", "negative"])
def test_scores_that_are_crowded_or_negative_have_thresholds(how, roads):
    """With as many digits as it takes: the same alarms as those of the score that they are made of."""
    plain, odd = _of_fifty("kf", roads), _of_fifty(Odd(how), roads)
    assert plain.settled and odd.settled and abs(odd.measured.onsets - plain.measured.onsets) <= 1
    assert odd.threshold == pytest.approx(1.0 - math.exp(-plain.threshold / 2.0) if how == "p" else -1.0 / (1.0 + plain.threshold), rel=1e-3)


@pytest.mark.long
def test_a_negative_score_that_jumps_gets_a_threshold_that_it_can_pass(roads):
    """-3, -2, -1, ...: with -2 it alarms too often, with -1 too rarely."""
    found = calibrate(Odd("steps"), 0.1, scenarios=roads, onsets=20, most_steps=200_000)
    bench = Bench.of(Odd("steps"), roads, 4096, None)
    often, seldom = (bench.run(level, 2.0, "calibrate", "") for level in (-2.1, -1.1))
    assert -2.1 < found.threshold < 0.0 and often.hours and often.hours < 0.05 and found.measured.onsets == (seldom.onsets if found.threshold < -1.0 else 0)


def test_objects_have_thresholds_too(roads):
    """A defence made in Python, and one by name, are set at a threshold and say what the parameter is called."""
    for defence, field in ((compose(KalmanFilter(), Mewma(weight=0.5), GateOut()), "detector.threshold"), ("cusum_kf:drift=2", "threshold")):
        bench = Bench.of(defence, roads, 64, None)
        assert bench.field == field and bench.at(7.0).parts()[1].threshold == 7.0 and bench.text


def test_the_command(roads, capsys):
    """JSON with the command that makes it again, a table for people, progress beside them; bad input is exit code 2."""
    part = ["calibrate", "--defence", "chi2_kf", "--hours", "0.01", "--scenario", roads[0], "--onsets", "20"]
    assert cli.main([*part, "--check", "--json"]) == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    (result,) = record["results"]
    assert shlex.split(record["command"]) == [
        "tailgate", "calibrate", "--defence", "chi2_kf", "--scenario", roads[0], "--hours", "0.01", "--onsets", "20", "--steps", "20000000",
        "--check", "--json",
    ]  # fmt: skip
    assert result["field"] == "eta" and result["fresh"]["purpose"] == "report" and list(result["seeds"].values()) == [[0, 59]]
    assert "closed loop, run 1" in err
    assert cli.main(part) == 0
    assert f"{result['threshold']:g}" in capsys.readouterr().out
    assert cli.main(["calibrate", "--defence", "none", "--hours", "1", "--scenario", roads[0], "--onsets", "20"]) == cli.EXIT_INPUT
    assert "score" in capsys.readouterr().err


@pytest.mark.parametrize("name", tailgate.list_defences())
def test_every_defence_has_a_threshold_or_is_watched(name):
    """What is set is what is named: the defence at a threshold carries it in the field that the table prints, or its score is held against it."""
    bench = Bench(tailgate.make_defence(name), (), name, (), 1, lambda *_: None)
    turned = bench.at(12.5)
    if not bench.field:
        assert turned.defence == bench.defence and turned.threshold == 12.5 if isinstance(turned, Watched) else turned.parts()[1] == ChiSquare(12.5)
        return
    holder = turned if bench.field in fields_of(type(turned)) else turned.parts()[1]
    assert getattr(holder, bench.field.rpartition(".")[2]) == 12.5
