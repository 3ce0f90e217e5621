"""Intervals: known values, repeatability, and coverage by simulation."""

import sys

import numpy as np
import pytest
import scipy.stats

from tailgate.evaluation import stats
from tailgate.evaluation.paired import mcnemar
from tailgate.evaluation.stats import at_least, holm, mean_time, median_limits, paired_difference, paired_ratio, proportion


def test_clopper_pearson_known_values() -> None:
    """36 of 36 gives [0.9026, 1]; 0 of 4 ends at 1 - 0.025^(1/4)."""
    assert proportion(36, 36) == (1.0, pytest.approx(0.9026, abs=1e-4), 1.0)
    assert proportion(0, 4) == (0.0, 0.0, pytest.approx(1 - 0.025**0.25))


@pytest.mark.parametrize("private", [True, False])
def test_limits_have_the_bits_of_scipys_tests(private: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Published boards hold them; also where scipy has not the private names that are fast to import."""
    if not private:
        monkeypatch.setitem(sys.modules, "scipy.special._ufuncs", None)
    for n in (1, 2, 7, 100, 5120):
        for k in range(0, n + 1, max(1, n // 20)):
            wanted = scipy.stats.binomtest(k, n).proportion_ci(0.95, method="exact")
            assert proportion(k, n)[1:] == (wanted.low, wanted.high), (k, n)
            assert at_least(k, n) == scipy.stats.binom.sf(k - 1, n, 0.5)
            assert mcnemar(k, n - k) == scipy.stats.binomtest(k, n).pvalue
    assert mcnemar(0, 0) == 1.0


def test_a_seed_gives_the_same_interval_twice() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random((3, 50)) < 0.6, rng.random((3, 50)) < 0.4
    assert paired_difference(a, b) == paired_difference(a, b)
    assert paired_difference(a, a) == (0.0, 0.0, 0.0)


def test_drawing_many_at_once_gives_the_interval_of_one_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Published intervals would move in their last digit."""
    a, b = np.random.default_rng(1).normal(size=(2, 3, 129))
    many = paired_difference(a, b)
    monkeypatch.setattr(stats, "AT_ONCE", 1)
    assert paired_difference(a, b) == many


def test_pairing_narrows_the_interval() -> None:
    rng = np.random.default_rng(1)
    hard = rng.random(400)
    a, b = hard < 0.5, hard < 0.45
    paired = paired_difference(a, b)
    shuffled = paired_difference(a, rng.permutation(b))
    assert paired.low > 0.0 and (paired.high - paired.low) < 0.5 * (shuffled.high - shuffled.low)


@pytest.mark.thin(4)
@pytest.mark.parametrize(("runs", "spread"), [(1, 0.0), (3, 0.0), (3, 0.1), (5, 0.2)])
def test_coverage_with_few_training_seeds(runs: int, spread: float) -> None:
    """95 % intervals hold the truth in at least 92 % of 300 simulated comparisons, whatever the spread between training seeds."""
    rng = np.random.default_rng(2)
    held = 0
    for i in range(300):
        level = np.clip(0.5 + spread * rng.standard_normal(runs), 0.02, 0.98)
        a = rng.random((runs, 200)) < level[:, None]
        b = np.broadcast_to(rng.random(200) < 0.5, a.shape)
        low, high = paired_difference(a, b, resamples=200, seed=i)[1:]
        held += low <= 0.0 <= high
    assert held >= 0.92 * 300


def test_a_difference_of_shares_is_never_certain():
    """50 equal pairs leave what was not seen: up to 7.1 % of the pairs, at 95 %; many pairs of both kinds are as before."""
    zeros, ones = np.zeros(50), np.ones(50)
    most = 1.0 - 0.025 ** (1 / 50)
    assert proportion(0, 50).high == pytest.approx(most)
    assert paired_difference(zeros, zeros, share=True) == pytest.approx((0.0, -most, most))
    assert paired_difference(ones, zeros, share=True) == pytest.approx((1.0, 1.0 - 2.0 * most, 1.0))
    assert paired_difference(zeros, zeros) == (0.0, 0.0, 0.0)
    a, b = (np.random.default_rng(2).uniform(size=(2, 400)) < np.array([[0.7], [0.4]])).astype(float)
    assert paired_difference(a, b, share=True) == paired_difference(a, b)


def test_a_ratio_of_means():
    """Of a and twice a it is a half without doubt; the interval of two noisy samples holds the true ratio, and a seed gives it twice."""
    a = np.random.default_rng(0).uniform(0.5, 1.5, size=500)
    assert paired_ratio(a, 2.0 * a) == pytest.approx((0.5, 0.5, 0.5))
    held = 0
    for i in range(100):
        rng = np.random.default_rng(i)
        x, y = rng.exponential(3.0, size=300), rng.exponential(4.0, size=300)
        value, low, high = paired_ratio(x, y, resamples=500, seed=i)
        held += low <= 0.75 <= high
        assert low < value < high
    assert held >= 88
    assert paired_ratio(x, y) == paired_ratio(x, y)


def test_holm_rejects_step_by_step() -> None:
    """Adjusted values by hand, in the order given; ties and the cap at 1; never smaller than a smaller one's."""
    assert holm([]) == []
    assert holm([0.03]) == [0.03]
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0]


@pytest.mark.long
def test_the_median_lies_within_its_limits_as_often_as_they_say() -> None:
    """Ranks 40 and 61 of 100 (Conover); five values cannot cover; of a skewed distribution 95 % or more of the intervals hold its median."""
    values = np.random.default_rng(0).permutation(np.arange(1.0, 101.0))
    assert median_limits(values) == (40.0, 61.0) and median_limits(values[:5]) is None
    assert median_limits(values, 0.999)[0] < 40.0 and median_limits(np.full(9, 3.0)) == (3.0, 3.0)
    drawn = np.random.default_rng(1).exponential(size=(2000, 30))
    held = [low <= np.log(2.0) <= high for low, high in map(median_limits, drawn)]
    assert 0.95 <= np.mean(held) <= 0.98


def test_few_events_in_large_clusters_are_one_cluster_at_least():
    """One event is one cluster, however large clusters are elsewhere; without any, clusters are as rare as they are large."""
    assert mean_time(1, 20.0, 300.0) == mean_time(1, 20.0)
    assert mean_time(7, 20.0, 300.0) == pytest.approx([end / 7.0 for end in mean_time(1, 20.0)])
    assert mean_time(0, 20.0, 10.0) == (pytest.approx(mean_time(0, 20.0)[0] / 10.0), None)
    low, high = mean_time(20, 20.0)
    assert low == pytest.approx(0.6475, abs=1e-3) and high == pytest.approx(1.637, abs=1e-3)  # 20 events: 12.22 to 30.89
