"""The interacting multiple model filter: equality with filterpy's, its limits, and its odds."""

import dataclasses
import math

import numpy as np
import pytest
from filterpy.kalman import IMMEstimator
from filterpy.kalman import KalmanFilter as Reference
from scipy import stats

import tailgate
from tailgate.base.errors import InputError
from tailgate.core import Innovation, Prior, Received
from tailgate.core.draws import Role, keys
from tailgate.core.scenario import load_scenario
from tailgate.estimators import InteractingModels, Kalman
from tailgate.estimators.filters.imm import ImmState, Modes, log_likelihood, mix, weigh
from tailgate.estimators.filters.kalman import KalmanState

NO_DRAWS = keys("train", [0]).at(Role.DEFENCE, np.zeros(1))


def _received(y, valid=None):
    return Received(y, np.ones(y.shape, bool) if valid is None else valid, np.zeros(y.shape[:2]))


@pytest.mark.long
@pytest.mark.parametrize("factors", [(1.0, 4.0, 900.0), (1.0, 100.0)])
def test_it_equals_filterpys_over_100_steps(factors, linear_model):
    """Estimate, every model's x and P, and the mode probabilities within 1e-9, on random matrices and data with outliers."""
    rng, count = np.random.default_rng(8), len(factors)
    for n, q in ((2, 1), (3, 2)):
        A = rng.normal(size=(n, n))
        A *= 0.95 / np.max(np.abs(np.linalg.eigvals(A)))
        B, C, noise = rng.normal(size=(n, 1)), rng.normal(size=(q, n)), rng.normal(size=(q, q + 2))
        model = linear_model(A, C, 0.1 * np.eye(n), noise @ noise.T, B)
        defence = InteractingModels(factors=factors, leave=0.05, back=0.2)
        plan, prior = defence.prepare(model), Prior(np.zeros((2, 1, n)), np.broadcast_to(np.eye(n), (2, 1, n, n)).copy())
        state, banks = defence.start(plan, prior), []
        for _ in range(2):
            bank = [Reference(dim_x=n, dim_z=q, dim_u=1) for _ in factors]
            for f, factor in zip(bank, factors, strict=True):
                f.F, f.B, f.Q, f.H, f.R, f.x, f.P = A, B, model.Q, C, factor * model.R[0], np.zeros(n), np.eye(n)
            banks.append(IMMEstimator(bank, defence.share(), defence.moves()))
        seen = []
        for _ in range(100):
            y = rng.normal(size=(2, 1, q)) * np.where(rng.uniform(size=(2, 1, 1)) < 0.2, 15.0, 2.0)
            u = rng.normal(size=(2, 1, 1))
            state, estimate = defence.step(plan, state, _received(y), u, NO_DRAWS)
            for b, bank in enumerate(banks):
                bank.predict(u[b, 0])
                bank.update(y[b, 0])
                np.testing.assert_allclose(estimate.x[b, 0], bank.x, rtol=0.0, atol=1e-9)
                np.testing.assert_allclose(state.mu[b, 0], bank.mu, rtol=0.0, atol=1e-9)
                for ours, theirs in zip(state.models, bank.filters, strict=True):
                    np.testing.assert_allclose(ours.x[b, 0], theirs.x, rtol=0.0, atol=1e-9)
                    np.testing.assert_allclose(ours.P[b, 0], theirs.P, rtol=0.0, atol=1e-9)
            seen.append(state.mu[:, 0, 0])
        assert np.min(seen) < 0.1 and np.max(seen) > 0.9 and state.mu.shape == (2, 1, count)


@pytest.mark.thin(2)
@pytest.mark.parametrize("attack", ["none", "fdi", "dos_jam", "dropout"])
def test_one_model_is_the_kalman_filter(attack, short, play, same_bits):
    """With the nominal model alone the estimates are kf's to the last bit, and nothing alarms."""
    alone = play(short(), InteractingModels(factors=(1.0,)), attack, range(6), terminate=False)
    kf = play(short(), Kalman(), attack, range(6), terminate=False)
    assert same_bits(alone.estimate, kf.estimate) and same_bits(alone.gap, kf.gap)
    assert not alone.alarm.any() and not alone.score.any()


def test_equal_models_stay_at_their_prior_odds():
    """Models that do not differ weigh what the Markov chain says, and the estimate is the Kalman filter's."""
    model, rng = load_scenario("stop-and-go-v0").brief().model, np.random.default_rng(2)
    twins, kf = InteractingModels(factors=(1.0, 1.0), leave=0.03, back=0.09), Kalman()
    prior = Prior(np.zeros((3, 1, 3)), np.broadcast_to(np.eye(3), (3, 1, 3, 3)).copy())
    plan, other = twins.prepare(model), kf.prepare(model)
    one, two = twins.start(plan, prior), kf.start(other, prior)
    for _ in range(50):
        y, u = _received(5.0 * rng.normal(size=(3, 1, 2))), rng.normal(size=(3, 1, 1))
        one, ours = twins.step(plan, one, y, u, NO_DRAWS)
        two, theirs = kf.step(other, two, y, u, NO_DRAWS)
        np.testing.assert_allclose(ours.x, theirs.x, atol=1e-11)
        np.testing.assert_allclose(one.mu, np.broadcast_to([0.75, 0.25], one.mu.shape), rtol=1e-12)
        np.testing.assert_allclose(ours.score, math.log(1.0 / 3.0), rtol=1e-12)


def test_the_score_is_the_log_odds_and_alarms_above_one_half():
    """score = log((1 - mu_0) / mu_0), and the alarm is mu_0 < 1/2; moving the threshold moves the alarm."""
    model, defence = load_scenario("stop-and-go-v0").brief().model, InteractingModels(factors=(1.0, 50.0, 500.0))
    plan = defence.prepare(model)
    prior = Prior(np.zeros((400, 1, 3)), np.broadcast_to(np.eye(3), (400, 1, 3, 3)).copy())
    y = np.random.default_rng(5).normal(size=(400, 1, 2)) * 5.0
    state, estimate = defence.step(plan, defence.start(plan, prior), _received(y), np.zeros((400, 1, 1)), NO_DRAWS)
    odds = np.log((1.0 - state.mu[..., 0]) / state.mu[..., 0])
    np.testing.assert_allclose(estimate.score, odds, atol=1e-6)
    np.testing.assert_array_equal(estimate.alarm, state.mu[..., 0] < 0.5)
    assert 0.1 < estimate.alarm.mean() < 0.9
    strict = dataclasses.replace(defence, threshold=3.0)
    _, later = strict.step(plan, strict.start(plan, prior), _received(y), np.zeros((400, 1, 1)), NO_DRAWS)
    np.testing.assert_array_equal(later.alarm, estimate.score > 3.0)


@pytest.mark.parametrize("q", [1, 2, 4])
def test_the_likelihood_is_the_gaussian_density_of_what_was_received(q):
    """log N(r; 0, S) over the valid sensors as in scipy; 0 where nothing was received."""
    rng = np.random.default_rng(q)
    root, valid = rng.normal(size=(40, 1, q, q + 1)), rng.uniform(size=(40, 1, q)) < 0.7
    valid[0] = False
    S, r = root @ np.swapaxes(root, -1, -2), np.where(valid, rng.normal(size=(40, 1, q)), 0.0)
    got = log_likelihood(Innovation(r, S), valid)
    for b in range(40):
        keep = np.flatnonzero(valid[b, 0])
        want = stats.multivariate_normal.logpdf(r[b, 0, keep], cov=S[b, 0][np.ix_(keep, keep)]) if len(keep) else 0.0
        assert got[b, 0] == pytest.approx(want, rel=1e-10, abs=1e-12)


def test_without_any_reading_only_time_passes():
    """Nothing received: the mode probabilities move by the Markov chain alone, whatever the noise of the models."""
    model, defence = load_scenario("stop-and-go-v0").brief().model, InteractingModels(leave=0.2, back=0.3)
    plan = defence.prepare(model)
    prior = Prior(np.zeros((1, 1, 3)), np.eye(3)[None, None])
    state = ImmState(defence.start(plan, prior).models, np.array([[[0.9, 0.1]]]))
    lost = _received(np.full((1, 1, 2), np.nan), np.zeros((1, 1, 2), bool))
    after, _ = defence.step(plan, state, lost, np.zeros((1, 1, 1)), NO_DRAWS)
    np.testing.assert_allclose(after.mu[0, 0], [0.9 * 0.8 + 0.1 * 0.3, 0.9 * 0.2 + 0.1 * 0.7], rtol=1e-12)


def test_mixing_keeps_mean_and_spread():
    """The mixture over all models has the same mean and covariance after mixing as before."""
    rng, moves, mu = np.random.default_rng(0), Modes(factors=(1.0, 2.0, 3.0), leave=0.3, back=0.2).moves(), np.array([0.5, 0.2, 0.3])
    roots, x = rng.normal(size=(3, 2, 4)), rng.normal(size=(3, 2))
    P = roots @ np.swapaxes(roots, 1, 2)

    def moments(x, P, mu):
        mean = mu @ x
        return mean, np.einsum("j,jab->ab", mu, P + (x - mean)[:, :, None] * (x - mean)[:, None])

    mixed = mix(ImmState(tuple(KalmanState(x[j][None, None], P[j][None, None]) for j in range(3)), mu[None, None]), moves)
    after = moments(np.array([m.x[0, 0] for m, _ in mixed]), np.array([m.P[0, 0] for m, _ in mixed]), np.array([c[0, 0] for _, c in mixed]))
    for got, want in zip(after, moments(x, P, mu), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-12)
    np.testing.assert_allclose(moves.sum(axis=1), 1.0)
    np.testing.assert_allclose(Modes(factors=(1.0, 2.0, 3.0), leave=0.3, back=0.2).share() @ moves, Modes(factors=(1.0, 2.0, 3.0), leave=0.3, back=0.2).share())


def test_weights_survive_the_extremes():
    """Log weights of -1e12 and 0 give probabilities that sum to one, and finite odds, without a warning."""
    with np.errstate(all="raise"):
        mu, odds = weigh([np.array([[-1e12, 0.0, -3.0]]), np.array([[-2e9, -1e12, -3.0]]), np.array([[-1e12, -1e12, -3.0]])])
    np.testing.assert_allclose(mu.sum(axis=-1), 1.0)
    np.testing.assert_allclose(odds, [[1e12 - 2e9, -1e12, math.log(2.0)]], rtol=1e-12)


@pytest.mark.parametrize("name", ["imm", "filterpy_imm"])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_many_models_survive_wild_readings(name, short, play):
    """Four models under a jammer that leaves up to 1e6 in bursts: finite estimates, and probabilities that stay above 0."""
    attack = tailgate.make_attack("fdi_bernoulli", probability=0.3, value=-1e6)
    place = short(horizon=60, fdi_bound=1e7)
    trace = play(place, tailgate.make_defence(name, factors=(1.0, 30.0, 1e3, 1e5)), attack, range(4), terminate=False)
    assert np.isfinite(trace.estimate).all() and np.isfinite(trace.score).all()


def test_it_distrusts_sensors_that_jump_and_trusts_them_again(short, play):
    """A burst of large errors alarms within two steps, moves the estimate less than kf's, and the alarm ends after it."""
    attack = tailgate.make_attack("fdi_gaussian", sd=30.0, start_step=30, length=20)
    place = short("gusty-stop-and-go-v0", horizon=120)
    imm, kf = (play(place, d, attack, range(24), terminate=False) for d in (InteractingModels(), Kalman()))
    burst = slice(29, 49)
    assert imm.alarm[30:49].mean() > 0.8 and imm.alarm[:29].mean() < 0.02 and imm.alarm[90:].mean() < 0.02
    worst = [np.abs(t.estimate - t.truth)[burst, :, 0, 0].max(axis=0) for t in (imm, kf)]
    assert np.median(worst[0]) < 0.5 * np.median(worst[1])


@pytest.mark.parametrize("field", [{"leave": 0.0}, {"back": 1.0}, {"factors": ()}, {"factors": (1.0, -2.0)}])
def test_impossible_modes_are_refused(field):
    """Probabilities strictly inside (0, 1), at least one model, positive factors."""
    with pytest.raises(InputError):
        tailgate.make_defence("imm", **field)
