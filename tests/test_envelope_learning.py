"""How invariants are judged: episodes as the unit, all that are tried together, one unit in a difference, no bound on a place."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.core.scenario import load_scenario
from tailgate.estimators.safe_set.envelope import FOLDER, load_envelope
from tailgate.evaluation.stats import limits
from tailgate.studies.envelope import Settings, Signals, joined, learn, sampled, templates
from tailgate.studies.envelope_sources import from_scenarios, played

STEPS = 40


def episodes(values):
    """Samples of episodes (E, steps, signals)."""
    z = values.reshape(-1, values.shape[-1])
    step = np.arange(len(z))
    return sampled(z, np.ones(z.shape, bool), np.zeros((len(z), 0)), step % values.shape[1] == 0, step // values.shape[1])


def uniform(rng, count, signals=2):
    return rng.uniform(0.0, 1.0, (count, STEPS, signals))


@pytest.mark.parametrize("left, kept", [(0, True), (3, True), (12, False)])
def test_episodes_are_counted_and_all_candidates_together(left, kept):
    """The limit of an invariant is that of Clopper and Pearson for its episodes, at 5 % over the number of candidates."""
    rng = np.random.default_rng(0)
    train, other = episodes(uniform(rng, 100)), uniform(rng, 200)
    other[:left, 5:35, 0] = 9.0  # thirty steps of an episode count once
    signals = Signals(("y1", "y2"), (), 0, 0.1)
    settings = Settings(margin=0.1, rate=0.1)
    judged = len(list(templates(signals, train)))
    assert judged == 6
    found = {one.kind: one for one in learn(signals, train, episodes(other), settings) if one.weights in ({"y1": 1.0}, {"y1": 1.0, "last y1": -1.0})}
    _, wanted = limits(np.array(left), np.array(200), 0.05 / judged)
    assert ("reading" in found) == kept == bool(wanted < 0.1)
    if kept:
        assert found["reading"].rates == {"any": pytest.approx(float(wanted), rel=1e-3)}


def test_too_few_episodes_for_all_candidates():
    """They are counted, not their steps."""
    rng = np.random.default_rng(1)
    fewest = math.ceil(math.log(0.05 / 6) / math.log(0.9))
    signals = Signals(("y1", "y2"), (), 0, 0.1)
    train = episodes(uniform(rng, 100))
    with pytest.raises(InputError, match=f"got '{fewest - 1} episodes'; expected at least {fewest} held-out episodes"):
        learn(signals, train, episodes(uniform(rng, fewest - 1)), Settings(0.1, rate=0.1))
    assert learn(signals, train, episodes(uniform(rng, fewest)), Settings(0.1, rate=0.1))
    with pytest.raises(InputError, match="unit: got 'hour'"):
        Settings(unit="hour")


def test_runs_that_are_joined_keep_their_episodes_apart():
    rng = np.random.default_rng(2)
    parts = [episodes(uniform(rng, count)) for count in (3, 4)]
    assert np.unique(joined(parts).episode).tolist() == list(range(7))
    many = played(replace(load_scenario("platoon-braking-v0"), horizon=120), "train", range(2))  # five cars are one episode
    assert np.unique(many.episode, return_counts=True)[1].min() > 80 and len(np.unique(many.episode)) == 2


def test_a_difference_has_one_unit():
    """Two positions, a speed and a number without a unit, all of which move together."""
    rng = np.random.default_rng(3)
    one = rng.uniform(0.0, 10.0, (50, STEPS, 1)) + rng.normal(0.0, 0.01, (50, STEPS, 4))
    for units, wanted in (((), 6), (("m", "m", "m/s", "1"), 1), (("1",) * 4, 0)):
        found = [kind for kind, _ in templates(Signals(("a", "b", "c", "d"), (), 0, 0.1, units), episodes(one))]
        assert found.count("difference") == wanted


@pytest.mark.parametrize("name, units, places", [
    ("stop-and-go-v0", ("m", "m/s", "m", "m/s"), (True, False, True, False)),
    ("redundant-two-v0", ("m",) * 5 + ("m/s", "m", "m", "m/s"), (True,) * 5 + (False, True, True, False)),
    ("platoon-braking-v0", ("m", "m/s") + ("m/s^2",) * 4, (False,) * 6),
    ("thesis-ch5-v0", ("1",) * 14, (False,) * 14),
])  # fmt: skip
def test_units_and_places_of_published_systems(name, units, places):
    found = Signals.of(load_scenario(name).brief().model)
    assert (found.units, found.places) == (units, places)


def test_no_invariant_bounds_a_place():
    """Wherever the road begins, every learned sum is the same; with `positions` it is not."""
    place = replace(load_scenario("redundant-two-v0"), horizon=200)
    signals, samples = Signals.of(place.brief().model), played(place, "train", range(3))
    moved = np.concatenate([signals.places, signals.places, [False] * signals.inputs]).astype(float)
    kinds = []
    for kind, weights in templates(signals, samples):
        assert abs(weights @ moved) <= 1e-12 * np.abs(weights).max(), kind
        kinds.append(kind)
    assert {"reading", "change", "difference", "regression", "component"} == set(kinds)
    assert any(abs(weights @ moved) > 0.5 for _, weights in templates(signals, samples, positions=True))


@pytest.mark.long
def test_a_shipped_file_is_learned_again():
    """By steps and with bounds of places, as it was: the same invariants, to what another LAPACK may change."""
    held = load_envelope(FOLDER / "redundant.json")
    again = from_scenarios(["redundant-two-v0"], 200, 200, Settings(rate=1e-4, unit="step", positions=True))
    assert [(one.kind, sorted(one.bounds)) for one in again.invariants] == [(one.kind, sorted(one.bounds)) for one in held.invariants]
    assert again.made["train"] == held.made["train"] and again.made["dev"] == held.made["dev"]
    for one, other in zip(again.invariants, held.invariants, strict=True):
        largest = max(other.weights, key=lambda name: abs(other.weights[name]))
        sign = 1.0 if one.weights[largest] * other.weights[largest] > 0.0 else -1.0  # of a principal component
        scale = abs(other.weights[largest])
        for name in {*one.weights, *other.weights}:
            assert sign * one.weights.get(name, 0.0) == pytest.approx(other.weights.get(name, 0.0), abs=1e-6 * scale)
        for key, (low, high) in other.bounds.items():
            ends = sorted(sign * end for end in one.bounds[key])
            assert ends == pytest.approx([low, high], abs=1e-3 * (high - low))
