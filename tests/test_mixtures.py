"""Gaussian mixtures of the Bernoulli filter: the exact posterior by all histories of attacks, the reduction, and both engines."""

import itertools

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.registry import make
from tailgate.estimators.filters.bernoulli import Bernoulli
from tailgate.estimators.filters.mixtures import Mixture, mean, reduced
from tailgate.play.rollouts import Rollout, rollout_of
from tailgate.play.trace import Trace

from .engines import loop_of, trace_as_plain
from .readings import play_readings

A, Q, R, SPREAD, DRIFT, BIRTH, SURVIVAL = 0.9, 0.5, 1.0, 10.0, 0.3, 0.1, 0.6
YS = [0.4, 6.0, 5.2, -1.0]


def by_hand(ys):
    """r and the means of both densities after the readings: a scalar Kalman filter for each history of attacks, none left out."""
    found = []
    for history in itertools.product((0, 1), repeat=len(ys) + 1):
        weight = BIRTH if history[0] else 1.0 - BIRTH
        m, V = np.zeros(1 + history[0]), np.diag([1.0, SPREAD**2][: 1 + history[0]])
        for y, before, now in zip(ys, history[:-1], history[1:], strict=True):
            move = SURVIVAL if before else BIRTH
            weight *= move if now else 1.0 - move
            if now and not before:
                m, V = np.array([m[0], 0.0]), np.diag([V[0, 0], SPREAD**2])
            elif not now:
                m, V = m[:1], V[:1, :1]
            F = np.diag([A, 1.0][: len(m)])
            m, V = F @ m, F @ V @ F.T + np.diag([Q, DRIFT**2][: len(m)])
            H = np.ones(len(m))
            S = H @ V @ H + R
            weight *= np.exp(-0.5 * (y - m.sum()) ** 2 / S) / np.sqrt(2.0 * np.pi * S)
            m, V = m + V @ H / S * (y - m.sum()), V - np.outer(V @ H, H @ V) / S
        found.append((history[-1], weight, m[0]))
    sums = [sum(w for last, w, _ in found if last == j) for j in (0, 1)]
    return sums[1] / sum(sums), *(sum(w * m for last, w, m in found if last == j) / sums[j] for j in (0, 1))


def scalar(linear_model, **fields):
    model = linear_model([[A]], [[1.0]], [[Q]], [[R]])
    defence = Bernoulli(birth=BIRTH, survival=SURVIVAL, spread=SPREAD, drift=DRIFT, **fields)
    return play_readings(defence, model, np.array(YS)[:, None, None])[1]


def test_a_mixture_that_is_large_enough_is_exact(linear_model):
    """16 Gaussians hold all histories of 4 steps: r and both means are Bayes' rule."""
    for k, (state, _) in enumerate(scalar(linear_model, components=16, merge=0.0, prune=0.0), start=1):
        r, without, under = by_hand(YS[:k])
        assert state.r[0, 0] == pytest.approx(r, rel=1e-9)
        assert mean(state.without)[0, 0, 0] == pytest.approx(without, rel=1e-9)
        assert mean(state.under)[0, 0, 0] == pytest.approx(under, rel=1e-9)


def test_more_gaussians_are_nearer_to_the_exact_posterior(linear_model):
    """One Gaussian errs most; with the standard merging eight err less."""
    wanted = np.array([by_hand(YS[:k]) for k in range(1, len(YS) + 1)])
    off = []
    for J in (1, 8):
        out = [state for state, _ in scalar(linear_model, components=J)]
        means = [[s.without.x[0, 0, 0], s.under.x[0, 0, 0]] if J == 1 else [mean(s.without)[0, 0, 0], mean(s.under)[0, 0, 0]] for s in out]
        off.append(np.abs(np.column_stack([[s.r[0, 0] for s in out], means]) - wanted).max(axis=0))
    assert (off[1] < off[0]).all(), off


def test_without_births_it_is_the_kalman_filter(linear_model):
    """The estimates of `kf`, to rounding."""
    rng = np.random.default_rng(2)
    model = linear_model([[0.9, 0.1], [0.0, 0.8]], np.eye(2), 0.1 * np.eye(2), np.eye(2))
    ys = rng.normal(size=(30, 5, 2))
    ours, known = (play_readings(d, model, ys)[1] for d in (Bernoulli(birth=0, components=3), make("defence", "kf")))
    for (_, one), (_, other) in zip(ours, known, strict=True):
        np.testing.assert_allclose(one.x, other.x, rtol=1e-12, atol=1e-13)
        assert not one.alarm.any()


def mixture(w, x, P):
    return Mixture(np.array(w)[None, None], np.array(x, float)[None, None, :, None], np.array(P, float)[None, None, :, None, None])


def test_a_reduction_by_hand():
    """0.5 at 0 takes in 0.2 at 1.9 (3.61 <= 4) and leaves 0.3 at 2.1; what is lighter than `prune` goes."""
    out = reduced(mixture([0.2, 0.5, 0.3 - 5e-6, 5e-6], [1.9, 0.0, 2.1, 90.0], [1, 1, 1, 1]), 3, 4.0, 1e-5)
    near = 0.2 * 1.9 / 0.7
    np.testing.assert_allclose(out.x[0, 0, :2, 0], [near, 2.1])
    np.testing.assert_allclose(out.w[0, 0], np.array([0.7, 0.3 - 5e-6, 0.0]) / (1.0 - 5e-6))
    spread = (0.2 * (1.9 - near) ** 2 + 0.5 * near**2) / 0.7
    np.testing.assert_allclose(out.P[0, 0, :2, 0, 0], [1.0 + spread, 1.0])
    one = reduced(mixture([0.2, 0.5, 0.3], [50.0, 0.0, -50.0], [1, 1, 1]), 2, 4.0, 0.0)
    assert one.x[0, 0, :, 0].tolist() == [0.0, -50.0] and one.w[0, 0].tolist() == pytest.approx([0.625, 0.375])


def test_a_row_does_not_depend_on_its_batch(linear_model):
    rng = np.random.default_rng(1)
    model = linear_model([[0.9, 0.1], [0.0, 0.8]], np.eye(2), 0.1 * np.eye(2), np.eye(2))
    ys = rng.normal(size=(20, 9, 2)) * 5.0
    all_of_them, one = (play_readings(Bernoulli(components=3), model, y)[1] for y in (ys, ys[:, 4:5]))
    for (_, many), (_, single) in zip(all_of_them, one, strict=True):
        assert np.array_equal(many.x[4:5], single.x) and np.array_equal(many.score[4:5], single.score)


@pytest.mark.parametrize("J", [0, 33])
def test_a_number_of_gaussians_that_nobody_can_want(J):
    with pytest.raises(InputError, match="components"):
        make("defence", "bernoulli", components=J)


@pytest.mark.long
def test_the_traced_engine_plays_it_to_the_bit():
    """67 episodes of car following, the loop alone and with the attack."""
    loop, rival = loop_of("stop-and-go-v0", "bernoulli:components=3", "fdi:value=-6,start_step=52,targets=[position]", 70)
    plain = trace_as_plain(loop, rival)
    assert plain.alarm.any()
    whole = rollout_of(loop, rival)
    assert isinstance(whole, Rollout), whole
    fast = Trace(loop.model, loop.horizon, *whole.play(draws.keys("report", range(67)), True), loop.controller.desired_gap)
    assert [fast.trace_hash(b) for b in range(67)] == [plain.trace_hash(b) for b in range(67)]
