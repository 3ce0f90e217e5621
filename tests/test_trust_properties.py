"""Properties of trust: the meaning of each on every kind of plant."""

import dataclasses

import numpy as np
import pytest

from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario, load_suite
from tailgate.evaluation.cells import run_cell
from tailgate.play.trace import rollout
from tailgate.trust.logic import Samples, holds
from tailgate.trust.properties import Demands, built_in, own
from tailgate.trust.run import check, jobs_of
from tailgate.trust.signals import SafeDistance, sample


def test_the_safe_distance_is_one_to_stop_in() -> None:
    """A car that keeps it would hit one that brakes at its hardest, or could have driven closer."""
    v, lead, safe, dt = 25.0, 20.0, SafeDistance(), 1e-4
    gap = float(safe.of(np.array([v]), np.array([lead]))[0])
    t = np.arange(0.0, 12.0, dt)
    own = np.where(t < safe.response, v + safe.accel * t, np.maximum(v + safe.accel * safe.response - safe.brake * (t - safe.response), 0.0))
    ahead = np.maximum(lead - safe.lead_brake * t, 0.0)
    assert np.min(gap + np.cumsum(ahead - own) * dt) == pytest.approx(0.0, abs=0.02)
    assert safe.of(np.array([5.0]), np.array([30.0]))[0] == 0.0


@pytest.mark.parametrize(
    ("scenario", "bound", "reasons"),
    [
        ("radar-following-v0", None, {"brakes": "a step of 1 s is too coarse", "error": "cars"}),
        ("thesis-ch5-v0", None, {"no_collision": "nobody drives", "brakes": "nobody drives", "error": "no bound"}),
        ("thesis-ch5-v0", 10.0, {"no_collision": "nobody drives", "brakes": "nobody drives"}),
        ("platoon-gusty-v0", None, {"error": "cars"}),
    ],
)
def test_a_property_without_a_meaning_says_why(scenario: str, bound: float | None, reasons: dict[str, str]) -> None:
    """A step of a second would time a deadline of 0.6 s, or a network would be asked about collisions."""
    found = {p.name: p for p in built_in(load_scenario(scenario), bound)}
    assert {name for name, p in found.items() if p.formula is None} == set(reasons)
    assert all(words in found[name].reason for name, words in reasons.items())


def test_every_car_of_a_platoon_is_asked_for_itself() -> None:
    """A car that brakes would answer for another one that is too close."""
    place = load_scenario("platoon-gusty-v0")
    (brakes,) = (p for p in built_in(place, None, Demands(deadline=0.5)) if p.name == "brakes")
    followers = np.flatnonzero(place.brief().model.followers)
    assert {f"margin@{i}" for i in followers} | {f"applied@{i}" for i in followers} <= brakes.signals
    quiet = {name: np.full((20, 1), 1.0 if name == "attacked" else 5.0) for name in brakes.signals}
    for braking, answered in ((followers[1], False), (followers[0], True)):
        near = quiet | {f"margin@{followers[0]}": np.full((20, 1), -1.0), f"applied@{braking}": np.full((20, 1), -3.0)}
        assert brakes.formula is not None and holds(brakes.formula, Samples(0.1, np.array([20]), near))[0] == answered
    place = dataclasses.replace(place, horizon=20)
    trace = rollout(place.loop(Spec("defence", "none").make()), Spec("attack", "none").make(), draws.keys("report", range(2)))
    held = sample(trace, ["gap", "gap@2", "time"], SafeDistance())
    assert (held.values["gap@2"] == trace.gap[:, :, 2]).all() and (held.values["gap"] <= held.values["gap@2"]).all()
    assert held.values["time"][0, 0] == pytest.approx(place.brief().model.dt)


@pytest.mark.long
def test_a_network_is_asked_about_its_error() -> None:
    """The suite's bound would not be what decides."""
    suite = dataclasses.replace(load_suite("network-v0"), scenarios=("thesis-ch5-v0",), doses=(5,), defences=("dkf",), attacks=("none", "fdi:value=100"))
    (entry,) = check(suite, runs=6)["defences"]
    share = {p["name"]: p["share"] for p in entry["properties"]}
    bad = run_cell(jobs_of(suite, runs=6)[1].cell)
    assert share["error"]["k"] == sum(row["max_error"] <= suite.bound for row in bad) < 6 and entry["safety"]["black"]["of"] == ["error"]


def test_a_signal_that_a_scenario_has_not_is_a_reason() -> None:
    """A formula about gaps would stop a suite that also holds a network."""
    (known,) = own(load_scenario("thesis-ch5-v0"), ["G gap > 0"])
    assert known.formula is None and "follows another" in known.reason
