"""Numbers of runs and what they say: known values, exact error rates, and simulation."""

import numpy as np
import pytest
from scipy import stats

from tailgate.base.errors import InputError
from tailgate.trust.statistics import Sequential, Sprt, Verdict, interval, lower, okamoto, runs_for


def test_36_of_36_is_the_first_interval_that_is_no_wider_than_a_tenth() -> None:
    """The thesis's [0.9026, 1] after 36 runs would not be reproduced."""
    assert interval(36, 36) == (1.0, pytest.approx(0.9026, abs=5e-5), 1.0)
    assert Sequential(0.1).stop(np.ones(35, bool)) is None
    assert Sequential(0.1).stop(np.ones(50, bool)) == Verdict(36, None) == Sequential(0.1).stop(np.zeros(36, bool))
    assert lower(36, 36, 0.025) == pytest.approx(interval(36, 36).low) and lower(0, 36, 0.05) == 0.0


def test_the_one_sided_limit_is_wrong_as_rarely_as_it_says() -> None:
    """A bound on trust would be wrong more often than alpha."""
    n = 36
    bounds = np.array([lower(k, n, 0.05) for k in range(n + 1)])
    for p in np.linspace(0.01, 0.99, 99):
        assert stats.binom.pmf(np.arange(n + 1), n, p)[bounds > p].sum() <= 0.05 + 1e-12


def test_the_sequential_rule_covers_less_than_it_says() -> None:
    """Its exact coverage, 0.936 at the worst, would not be what looking after every run really gives."""
    rule = Sequential(0.1)
    ways = sum(count * 0.5**n for n, _, count in rule.ends)
    assert ways == pytest.approx(1.0, abs=1e-12)  # it stops with certainty
    worst, at = rule.worst_coverage()
    assert worst == pytest.approx(0.9359, abs=5e-5) and worst <= rule.coverage(np.linspace(0.0, 1.0, 501)).min()
    rng = np.random.default_rng(0)
    for p in (at, 0.97, 0.7):
        runs = 4000
        ended = np.array([(v.runs, outcomes[: v.runs].sum()) for outcomes in rng.random((runs, 402)) < p if (v := rule.stop(outcomes))])
        low, high = _clopper_pearson(ended[:, 1], ended[:, 0], 0.95)
        assert len(ended) == runs and (high - low <= 0.1).all()
        assert np.mean((low <= p) & (p <= high)) == pytest.approx(float(rule.coverage(p)[0]), abs=4.0 * np.sqrt(0.06 / runs))


def _clopper_pearson(k: np.ndarray, n: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    tail = (1.0 - level) / 2.0
    low = np.where(k > 0, stats.beta.ppf(tail, np.maximum(k, 1), n - k + 1), 0.0)
    return low, np.where(k < n, stats.beta.ppf(1.0 - tail, k + 1, np.maximum(n - k, 1)), 1.0)


@pytest.mark.parametrize("test", [Sprt(0.85, 0.9), Sprt(0.9, 0.99, 0.01, 0.05), Sprt(0.5, 0.7, 0.1, 0.2)])
def test_both_errors_of_the_sequential_test_hold(test: Sprt) -> None:
    """A defence would be passed or failed wrongly more often than alpha and beta allow."""
    high, low = test.rates(test.high), test.rates(test.low)
    assert high.accepts + high.rejects == pytest.approx(1.0, abs=1e-9)
    assert 0.3 * test.alpha < high.rejects <= test.alpha and 0.3 * test.beta < low.accepts <= test.beta
    assert test.rates(0.5 * (1.0 + test.high)).rejects < high.rejects and test.rates(0.9 * test.low).accepts < low.accepts


def test_the_exact_rates_of_the_sequential_test_are_those_of_simulated_ones() -> None:
    """The dynamic programme would speak of another rule than the one that stops."""
    test, rng, runs = Sprt(0.7, 0.85, 0.05, 0.1), np.random.default_rng(1), 2000
    for p in (test.low, test.high):
        said = [test.stop(outcomes) for outcomes in rng.random((runs, 1500)) < p]
        assert all(said)
        exact = test.rates(p)
        assert np.mean([v.holds for v in said if v]) == pytest.approx(exact.accepts, abs=4.0 * np.sqrt(0.1 / runs))
        assert np.mean([v.runs for v in said if v]) == pytest.approx(exact.runs, rel=0.1)


def test_runs_for_a_precision() -> None:
    """Three points at 99 % would not be kept whatever comes out, or would cost more runs than they need."""
    n = runs_for(0.03, 0.99)
    assert n == 1876 and okamoto(0.03, 0.01) == 2944
    for runs, kept in ((n, True), (n - 1, False)):
        k = np.arange(runs + 1)
        low, high = _clopper_pearson(k, np.full(runs + 1, runs), 0.99)
        assert (max((k / runs - low).max(), (high - k / runs).max()) <= 0.03) == kept


@pytest.mark.parametrize("wrong", [lambda: Sequential(0.0), lambda: Sprt(0.9, 0.9), lambda: Sprt(0.5, 1.0), lambda: okamoto(0.0, 0.1), lambda: runs_for(1e-4, 0.99)])
def test_numbers_without_a_meaning_are_refused(wrong: object) -> None:
    """A rule that never stops, or a test without an indifference region, would run for ever."""
    with pytest.raises(InputError):
        wrong()  # type: ignore[operator]
