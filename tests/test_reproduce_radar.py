"""Chapter 3: the measured figures of the design on seeds of their own, verdicts that can go both ways, and the pictures."""

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from tailgate.base.plots import png
from tailgate.core import draws
from tailgate.core.registry import Spec, make
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout
from tailgate.thesis import CHAPTERS, ch3_cases, ch3_figures, ch3_limits, ch3_radar
from tailgate.thesis.ch3_cases import ATTACKS, DETECTED, OURS, SCENARIOS, Run
from tailgate.thesis.claims import Report

LEVEL, SEEDS = 0.999, 60


def interval(values):
    """A 99.9 % interval of the median, from the order statistics."""
    values, n = np.sort(values), len(values)
    low = int(stats.binom.ppf((1.0 - LEVEL) / 2.0, n, 0.5))
    return values[max(low - 1, 0)], values[min(n - low, n - 1)]


def run(name, number, case, guard, **changes):
    """Episodes on seeds that follow from a test's name."""
    first = int.from_bytes(name.encode()[:64], "little") % 1_000_000_007
    spec, place = Spec("defence", guard), dataclasses.replace(load_scenario(SCENARIOS[number]), **changes)
    attack = Spec("attack", ATTACKS.get(case, "none")).make()
    return Run.of(rollout(place.loop(spec.make(), spec.entry.uses), attack, draws.keys("report", range(first, first + SEEDS))))


@pytest.fixture(scope="module")
def runs():
    guards = ("none", OURS, "algorithm2")
    return {
        (number, case, guard): run("test_chapter_3", number, case, guard)
        for number in SCENARIOS for case in ("clean", *ATTACKS) for guard in (guards if case in ATTACKS else guards[1:2])
    }  # fmt: skip


@pytest.mark.long
def test_the_figures_of_the_design(runs):
    """Scenario (i): none and literal collide in every run (jammed: 189 s, delayed: 269 s), joint RLS in none: 0.14 m, a last gap of 5.03 m."""
    for guard in ("none", "algorithm2"):
        assert all(runs["i", case, guard].collided.all() for case in ATTACKS)
    for case, second in (("DoS", 189), ("delay", 269)):
        low, high = interval(runs["i", case, "none"].trace.length + 1)  # step k ends at k + 1
        assert low <= second <= high
        ours = runs["i", case, OURS]
        assert not ours.collided.any()
        low, high = interval(ours.error)
        assert low - 0.005 <= 0.14 <= high + 0.005 < 0.3
        low, high = interval(ours.trace.gap[-1, :, 0])
        assert low - 0.005 <= 5.03 <= high + 0.005


@pytest.mark.long
@pytest.mark.parametrize(("at", "figure"), [(60.0, 0.3), (100.0, 0.8)])
def test_scenario_ii_with_the_reset(at, figure):
    """The design: 0.3 and 0.8 m for a change at 60 and 100 s, as it rounds them; without the reset hundreds of metres."""
    place = make("manoeuvre", "switched", at=at)
    low, high = interval(run(f"test_switch_{at:g}", "ii", "DoS", OURS, manoeuvre=place).error)
    assert low - 0.05 <= figure <= high + 0.05
    lost = run(f"test_switch_{at:g}", "ii", "DoS", OURS + ",filter.threshold=none", manoeuvre=place).error
    assert np.nanmedian(lost) > 100.0


def test_detection_is_at_182_in_every_run(runs):
    """Both attacks, both scenarios; and no alarm without an attack."""
    for number in SCENARIOS:
        for case in ATTACKS:
            np.testing.assert_array_equal(runs[number, case, OURS].alarm, DETECTED)
        assert np.isnan(runs[number, "clean", OURS].alarm).all()
    assert ch3_cases._detection(runs).holds == "yes"
    claim = ch3_cases._false_alarms(runs)
    assert claim.holds == "yes" and claim.measured["of challenges"] == 6 * 4 * SEEDS


def test_verdicts_can_go_the_other_way(runs):
    """A defence that does nothing in place of ours, and ours in place of nothing, turn the verdicts."""
    assert [claim(runs).holds for claim in (ch3_cases._safety, ch3_cases._recovery, ch3_cases._algorithm1)] == ["partly", "yes", "no"]
    worse = runs | {(n, c, OURS): runs[n, c, "none"] for n in SCENARIOS for c in ATTACKS}
    assert ch3_cases._safety(worse).holds == "no" and ch3_cases._detection(worse).holds == "no" and ch3_cases._false_alarms(worse).holds == "no"
    deaf = runs["i", "delay", OURS]
    silent = Run(dataclasses.replace(deaf.trace, signals=deaf.trace.signals | {"alarm": np.zeros_like(deaf.trace.alarm)}), *deaf[1:])
    assert ch3_cases._false_alarms(runs | {("i", "delay", OURS): silent}).holds == "no"
    harmed = runs | {("ii", "delay", "none"): runs["i", "delay", "none"]}
    assert ch3_cases._safety(harmed).holds == "yes"
    better = runs | {("i", c, "algorithm2"): runs["i", c, OURS] for c in ATTACKS}
    assert ch3_cases._algorithm1(better).holds == "yes"


@pytest.mark.long
def test_the_radars_claims():
    """The signs are wrong as printed, a late echo shifts the distance, and a ratio below 1 alone denies nothing; a link can turn the last."""
    assert ch3_radar._signs().holds == "no" and ch3_radar._late().holds == "yes"
    claim, _, _ = ch3_radar._denial(20)
    shares = {noise: list(by_range.values()) for noise, by_range in claim.measured["readings that are off by more than 5 m"].items()}
    assert claim.holds == "no" and min(shares["follows the chirp"][1:]) > 0.5 and max(shares["fills the band"]) < 0.05


@pytest.mark.long
def test_a_list_that_is_known_loses():
    """With challenges at 15, 50 and 175 s an attack from 51, 100 or 150 s collides in every run; random challenges spare some."""
    claim = ch3_limits._predictable(30)
    for onset in (51, 100, 150):
        cells = claim.measured[f"DoS from {onset} s"]
        assert cells["list 15, 50, 175"] == 1.0 and cells["random, p = 0.3"] < 0.5
    assert claim.holds == "no"


@pytest.mark.long
def test_who_listens_to_the_probe_beats_an_alarm_that_ends_at_once():
    """Hopping collides in nearly every run where one quiet challenge ends the alarm; with several at random times in few."""
    claim = ch3_limits._hopping(30)
    cells = list(claim.measured.values())
    assert claim.holds == "no" and cells[1]["delay, hopping"] > 0.7 and cells[3]["delay, hopping"] < 0.15 and cells[1]["delay"] < 0.1


def test_where_half_are_detected():
    """Interpolated on a logarithmic scale; the nearest end where no half is crossed."""
    reaction = np.array([1e-4, 1e-3, 1e-2])
    assert ch3_limits._half(reaction, np.array([0.0, 0.25, 0.75])) == pytest.approx(10**-2.5, rel=0.05)
    assert ch3_limits._half(reaction, np.array([0.9, 1.0, 1.0])) == 1e-4 and ch3_limits._half(reaction, np.zeros(3)) == 1e-2


@pytest.mark.long
def test_the_pictures(runs):
    """Figures 3.2a to 3.3b and three more, each a picture of some size whose caption says which run it shows."""
    latency = {"p": np.array([0.1, 0.5]), "mean": np.array([9.0, 1.0]), "low": np.array([8.0, 0.9]), "high": np.array([10.0, 1.1])}
    reaction = {"reaction": np.array([1e-6, 1e-3])} | {f"{c}: {what}": np.array([0.0, 1.0]) for c in ATTACKS for what in ("heard", "collided, list", "collided, random")}
    denial = {"fills the band": np.zeros(2), "follows the chirp": np.ones(2)}
    report = Report("ch3", "", {})
    report.add(ch3_figures.cases(runs))
    assert [f.name for f in report.figures] == ["figure-3-2a", "figure-3-2b", "figure-3-3a", "figure-3-3b"]
    assert all(figure.caption.endswith(".") for figure in report.figures)
    others = (ch3_figures.latency(latency), ch3_figures.reaction(reaction), ch3_figures.denial(np.array([10.0, 100.0]), denial))
    for picture in [figure.png for figure in report.figures] + [png(figure) for figure in others]:
        assert min(Image.open(io.BytesIO(picture)).size) > 300


def test_the_chapter_is_known():
    assert "ch3" in CHAPTERS
