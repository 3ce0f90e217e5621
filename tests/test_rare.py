"""Rare events: splitting against known probabilities, branches of a loop, its noise, and the likeliest failure."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import norm

from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.draws import Draws, Keys
from tailgate.core.registry import Spec
from tailgate.falsify import branches, rare
from tailgate.falsify.branches import played
from tailgate.falsify.case import Case
from tailgate.falsify.claim import claim_of, invariant_of
from tailgate.falsify.likeliest import likeliest
from tailgate.falsify.noise import NoisyLoop
from tailgate.falsify.rare import Rare, estimate
from tailgate.falsify.splitting import Run, chance_of, plain_episodes, split
from tailgate.play.trace import rollout

ROAD = Case("", "braking-v0", None, "kf", (), "G[0,60] gap > 2.5", "none")
NOISE = Case("", "linear-dos-v0", None, "kf", (), "G error < 3.3", "none")

KEEP, STEPS, LEVEL = 0.9, 50, 12.2


def _walk(keys):
    """Return the margins of x' = 0.9 x + w below a level: an AR(1) process."""
    x, out = np.zeros(keys.shape[1]), np.empty(keys.shape[:2])
    for k in range(len(keys)):
        x = KEEP * x + _normal(keys[k, :, 0], k)
        out[k] = LEVEL - x
    return out


def _normal(key, k):
    return Draws(key, np.zeros(len(key), np.uint32), np.full(len(key), k, np.uint32), 1).normal()


def _exact(points=1200):
    """Return the probability that the walk crosses the level, by Gauss-Legendre integration of the density that has not crossed."""
    z, w = np.polynomial.legendre.leggauss(points)
    low = -20.0
    x, w = 0.5 * (LEVEL - low) * z + 0.5 * (LEVEL + low), 0.5 * (LEVEL - low) * w
    kernel, leaves = norm.pdf(x[:, None] - KEEP * x) * w, norm.sf(LEVEL - KEEP * x) * w
    density, out = norm.pdf(x), norm.sf(LEVEL)
    for _ in range(STEPS - 1):
        out, density = out + float(leaves @ density), kernel @ density
    return out


@pytest.mark.long
def test_a_rare_event_of_a_linear_system_has_its_probability():
    """P is about 1e-6; the interval holds the exact value at a hundredth of the cost of plain episodes."""
    exact = _exact()
    assert 1e-6 < exact < 2e-6
    runs = [split(_walk, STEPS, 200, np.random.default_rng([0, i])) for i in range(10)]
    chance = chance_of(runs, 200)
    assert chance.low < exact < chance.high < 8.0 * exact
    assert 100 * chance.episodes < plain_episodes(chance)
    for one in runs:
        assert one.keys.shape[1] == len(one.margins) and np.array_equal(_walk(one.keys).min(axis=0), one.margins)
        assert (one.margins < 0.0).all()  # the paths that are returned arrive, when played again


@pytest.mark.long
def test_a_frequent_event_is_counted_as_plain_episodes_count_it():
    """A level that a fifth of the paths reach: the mean of many small runs is the share of many paths."""

    def play(keys):
        return _walk(keys) - LEVEL + 4.0

    rng = np.random.default_rng(5)
    share = float((play(np.repeat(rng.integers(0, 2**64, (1, 20_000, 3), np.uint64), STEPS, axis=0)).min(axis=0) < 0.0).mean())
    values = [split(play, STEPS, 16, np.random.default_rng([1, i])).probability for i in range(400)]
    assert abs(np.mean(values) - share) < 4.0 * np.std(values) / math.sqrt(len(values))


def test_a_near_certain_event_has_the_interval_of_plain_episodes():
    """Runs that need no level are shares; equal ones had an interval of no width."""
    sure = [Run(1.0, 0, 8, np.zeros((1, 8, 3), np.uint64), np.ones(8), 8)] * 3
    chance = chance_of(sure, 8)
    assert (chance.probability, chance.high) == (1.0, 1.0) and chance.low == pytest.approx(0.025 ** (1 / 24))
    rng, kept = np.random.default_rng(4), 0
    for _ in range(400):
        counts = rng.binomial(16, 0.97, 8)
        held = chance_of([Run(n / 16, 0, 16, np.zeros((1, 0, 3), np.uint64), np.zeros(0), int(n)) for n in counts], 16)
        kept += held.low <= 0.97 <= held.high
    assert kept > 0.95 * 400 - 3.0 * math.sqrt(0.05 * 0.95 * 400)


def test_runs_that_do_not_arrive_give_an_upper_bound():
    none = [Run(0.0, 5, 100, np.zeros((1, 0, 3), np.uint64), np.zeros(0))] * 4
    chance = chance_of(none, 100)
    assert (chance.probability, chance.low) == (0.0, 0.0) and chance.high == pytest.approx(1.0 - 0.025 ** (1 / 400))
    some = chance_of([*none[:3], none[0]._replace(probability=4e-6)], 100)
    assert some.probability == 1e-6 and some.low == 0.0 and some.high == chance.high
    assert split(lambda keys: np.full(keys.shape[:2], np.inf), 4, 10, np.random.default_rng(0)).probability == 0.0  # all alike


def test_the_likeliest_failure_is_the_nearest():
    """The least noise that lifts an AR(1) process to a level is known: level / sqrt(variance of its last step)."""

    def play(mean, keys, size):
        x, least, noise = np.zeros(len(mean)), np.full(len(mean), np.inf), np.empty(mean.shape)
        for k in range(mean.shape[1]):
            noise[:, k, 0] = mean[:, k, 0] + size * _normal(keys[:, 0], k)
            x = KEEP * x + noise[:, k, 0]
            least = np.minimum(least, LEVEL - x)
        return least, noise

    nearest = LEVEL / math.sqrt(sum(KEEP ** (2 * k) for k in range(STEPS)))
    found = likeliest(play, STEPS, 1, 500, STEPS, np.random.default_rng(0))
    assert found.failed and nearest <= found.distance < 1.02 * nearest
    assert found.log_likelihood == -0.5 * found.distance**2
    assert play(found.mean[None], np.zeros((1, 3), np.uint64), 0.0)[0][0] < 0.0


@pytest.mark.long
@pytest.mark.parametrize("text", ["dropout:chance=0.1", "none"])
def test_a_branch_is_the_same_until_it_leaves(text):
    """Keys that change at a step change nothing before it; the traced loop plays what the plain loop plays."""
    case = Case("", "gusty-stop-and-go-v0", None, "chi2_kf", (), "G gap > 2", text)
    rng = np.random.default_rng(0)
    own = np.repeat(rng.integers(0, 2**64, (1, 3, 3), np.uint64), case.own.horizon, axis=0)
    other = own.copy()
    other[300:] = rng.integers(0, 2**64, (3, 3), np.uint64)
    attack = Spec("attack", text).make()
    a, b, plain = played(case.own, attack, own), played(case.own, attack, other), played(case.own, attack, other, plain=True)
    whole = rollout(case.own, attack, Keys(own[0], np.zeros(3, np.uint32)))
    assert [a.trace_hash(i) for i in range(3)] == [whole.trace_hash(i) for i in range(3)]
    assert [b.trace_hash(i) for i in range(3)] == [plain.trace_hash(i) for i in range(3)]
    assert np.array_equal(a.gap[:300], b.gap[:300]) and (a.gap[300:] != b.gap[300:]).all()


def test_the_noise_of_a_loop_is_its_own():
    """Without a mean the shifted loop plays the plain one, and the noise that it notes is what was drawn."""
    loop, attack = NOISE.own, Spec("attack", "none").make()
    play = NoisyLoop(loop, attack, invariant_of(NOISE.claim), 8)
    keys = np.random.default_rng(1).integers(0, 2**64, (12, 3), np.uint64)
    zero = np.zeros((12, play.steps, play.width))
    margin, noise = play(zero, keys, 1.0)
    trace = rollout(loop, attack, Keys(keys, np.zeros(12, np.uint32)))
    assert np.array_equal(margin, invariant_of(NOISE.claim).margins(trace, loop.horizon).min(axis=0))
    assert abs(noise.mean()) < 0.2 and abs(noise.std() - 1.0) < 0.1
    alone, noise = play(np.ones_like(zero), keys, 0.0)
    assert (noise == 1.0).all() and len(set(alone.tolist())) == 1  # no chance is left


@pytest.mark.long
def test_an_estimate_agrees_with_plain_episodes():
    """The loop under splitting: the share of 20 000 plain episodes lies within the interval."""
    case = dataclasses.replace(NOISE, formula="G[10,60] error < 3")
    report = estimate(Rare(case, 1000, 6))
    plain = rollout(case.own, Spec("attack", "none").make(), draws.keys("report", range(20_000)))
    share = float((case.claim.robustness(plain) < 0.0).mean())
    assert 0.0005 < share < 0.02
    failure = report["failure"]
    again = played(case.own, Spec("attack", "none").make(), branches.from_data(failure["keys"], case.own.horizon), plain=True)
    assert case.claim.robustness(again)[0] == failure["margin"] < 0.0
    assert report["low"] < share < report["high"] and 0.3 * share < report["probability"] < 3.0 * share


@pytest.mark.long
def test_an_estimate_resumes_and_repeats(tmp_path, monkeypatch):
    job = Rare(dataclasses.replace(NOISE, formula="G[10,60] error < 2.5"), 64, 3, 4)
    whole = estimate(job, noise=True)
    estimate(job, tmp_path, noise=True)
    (tmp_path / "runs/001.json").unlink()
    count = []
    monkeypatch.setattr(rare, "split", lambda *given, real=split: count.append(1) or real(*given))
    again = estimate(job, tmp_path, noise=True)
    assert len(count) == 1 and {**whole, "seconds": 0} == {**again, "seconds": 0}
    assert 0.0 < whole["low"] <= whole["probability"] <= whole["high"]
    with pytest.raises(InputError, match=r"--out.*very estimate"):
        estimate(dataclasses.replace(job, seed=9), tmp_path)


def test_a_property_that_is_no_invariant_cannot_be_split():
    for text in ("F gap < 2", "G (attack -> F[0,1] alarm)", "gap > 2"):
        with pytest.raises(InputError, match="G\\[a,b\\] of comparisons"):
            invariant_of(claim_of_road(text))
    trace = rollout(ROAD.own, Spec("attack", "none").make(), draws.keys("tune", range(3)))
    within = invariant_of(claim_of_road("G[10,20] gap > 2"))
    assert np.array_equal(within.margins(trace, 600).min(axis=0), claim_of_road("G[10,20] gap > 2").robustness(trace))


def claim_of_road(text):
    from tailgate.core.scenario import load_scenario

    return claim_of(load_scenario("braking-v0"), text)
