"""Detectors with memory: their recursions, their distributions, and the gate that a white-box attacker aims at."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

import tailgate
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Innovation
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.estimators import ChiSquare, Cusum, GateOut, KalmanFilter, Mewma, NamedParts, WindowedChiSquare, compose
from tailgate.estimators.compose import Score
from tailgate.estimators.detectors.sequential import whiten

RNG = np.random.default_rng(5)
MODEL = load_scenario("stop-and-go-v0").brief().model  # one agent, two sensors
STATEFUL = [WindowedChiSquare(), Cusum(), Cusum(reset=False), Mewma(), Mewma(exact=False), Mewma(reset=False)]


def covariances(batch, q=2):
    a = RNG.normal(size=(batch, 1, q, q))
    return a @ np.swapaxes(a, -1, -2) + 0.5 * np.eye(q)


def innovations(steps, batch):
    """Honest ones: r ~ N(0, S), another S in each step and row."""
    out = []
    for _ in range(steps):
        S = covariances(batch)
        r = (np.linalg.cholesky(S) @ RNG.normal(size=(batch, 1, 2, 1)))[..., 0]
        out.append(Innovation(r, S))
    return out


def of_size(g, batch=1):
    """An innovation with r' S^-1 r = g."""
    r = np.zeros((batch, 1, 2))
    r[..., 0] = np.sqrt(g)
    return Innovation(r, np.broadcast_to(np.eye(2), (batch, 1, 2, 2)))


def feed(detector, sequence):
    """Scores and alarms (K, B) of a sequence of innovations, and the last state."""
    plan = detector.prepare(MODEL)
    state = detector.start(plan, len(sequence[0].r))
    scores, alarms = [], []
    for innovation in sequence:
        state, verdict = detector.step(plan, state, innovation)
        assert (verdict.suspect == verdict.alarm[..., None]).all() and verdict.suspect.shape == innovation.r.shape
        scores.append(verdict.score[:, 0])
        alarms.append(verdict.alarm[:, 0])
    return np.array(scores), np.array(alarms), state


def normalised(sequence):
    return np.array([np.einsum("bi,bij,bj->b", i.r[:, 0], np.linalg.inv(i.S[:, 0]), i.r[:, 0]) for i in sequence])


@pytest.mark.parametrize("window", [1, 2, 7])
def test_the_window_holds_the_last_steps(window):
    """The score is r' S^-1 r summed over the last w steps, fewer at the start."""
    sequence = innovations(20, 6)
    scores, alarms, _ = feed(WindowedChiSquare(threshold=3.0 * window, window=window), sequence)
    g = normalised(sequence)
    want = np.array([g[max(0, k - window + 1) : k + 1].sum(axis=0) for k in range(20)])
    np.testing.assert_allclose(scores, want, rtol=1e-12)
    np.testing.assert_array_equal(alarms, scores > 3.0 * window)
    assert alarms.any() and not alarms.all()


@pytest.mark.parametrize("detector", [WindowedChiSquare(threshold=4.0, window=1), Mewma(threshold=4.0, weight=1.0)])
def test_without_memory_they_are_the_chi_square_detector(detector):
    """A window of one step, and a weight of one, give the score of `chi2`."""
    sequence = innovations(30, 5)
    one, two = feed(detector, sequence), feed(ChiSquare(eta=4.0), sequence)
    np.testing.assert_allclose(one[0], two[0], rtol=1e-12)
    np.testing.assert_array_equal(one[1], two[1])


def test_cusum_by_hand():
    """s = max(0, s + g - b) with b = 1.5 x 2 sensors; after an alarm it starts at zero, or goes on."""
    sizes = [1.0, 5.0, 9.0, 6.0, 0.0, 0.0, 20.0]
    sequence = [of_size(g) for g in sizes]
    scores, alarms, _ = feed(Cusum(threshold=10.0), sequence)
    np.testing.assert_allclose(scores[:, 0], [0.0, 2.0, 8.0, 11.0, 0.0, 0.0, 17.0])
    assert alarms[:, 0].tolist() == [False, False, False, True, False, False, True]
    scores, alarms, _ = feed(Cusum(threshold=10.0, reset=False), sequence)
    np.testing.assert_allclose(scores[:, 0], [0.0, 2.0, 8.0, 11.0, 8.0, 5.0, 22.0])
    assert alarms[:, 0].tolist() == [False, False, False, True, False, False, True]


def test_cusum_never_sees_what_stays_below_its_allowance():
    """g = b for ever is no alarm; g = 1.1 b is one after threshold / (0.1 b) steps."""
    assert not feed(Cusum(threshold=5.0), [of_size(3.0 - 1e-9)] * 500)[1].any()
    _, alarms, _ = feed(Cusum(threshold=5.0), [of_size(3.3)] * 20)
    assert np.flatnonzero(alarms)[0] == 16


@pytest.mark.parametrize("exact", [True, False])
def test_mewma_is_that_of_lowry(exact):
    """T2 = z' Sigma_z^-1 z with z = l L^-1 r + (1-l) z and Sigma_z = l/(2-l) [1 - (1-l)^2k] I, or its limit."""
    sequence = innovations(25, 4)
    scores, _, _ = feed(Mewma(threshold=1e9, weight=0.3, exact=exact), sequence)
    z = np.zeros((4, 2))
    for k, innovation in enumerate(sequence, start=1):
        white = np.linalg.solve(np.linalg.cholesky(innovation.S[:, 0]), innovation.r[:, 0, :, None])[..., 0]
        z = 0.3 * white + 0.7 * z
        sigma = 0.3 / 1.7 * ((1.0 - 0.7 ** (2 * k)) if exact else 1.0) * np.eye(2)
        np.testing.assert_allclose(scores[k - 1], np.einsum("bi,ij,bj->b", z, np.linalg.inv(sigma), z), rtol=1e-11)


def test_mewma_starts_again_after_an_alarm():
    """With reset, the steps after an alarm equal a fresh start; without, the average remembers."""
    loud, quiet = [of_size(900.0)], [of_size(1.0)] * 5
    fresh = feed(Mewma(), quiet)[0]
    np.testing.assert_array_equal(feed(Mewma(), loud + quiet)[0][1:], fresh)
    assert (feed(Mewma(reset=False), loud + quiet)[0][1:] > 2 * fresh).all()


@pytest.mark.parametrize("q", [1, 2, 3, 5])
def test_whitening(q):
    """L^-1 r has the length r' S^-1 r, and unit covariance when r has covariance S."""
    S = covariances(4000, q)
    r = RNG.normal(size=(4000, 1, q))
    w = whiten(Innovation(r, S))
    np.testing.assert_allclose((w * w).sum(axis=-1), (r * np.linalg.solve(S, r[..., None])[..., 0]).sum(axis=-1), rtol=1e-9)
    drawn = whiten(Innovation((np.linalg.cholesky(S) @ RNG.normal(size=(4000, 1, q, 1)))[..., 0], S))[:, 0]
    assert np.max(np.abs(drawn.T @ drawn / 4000 - np.eye(q))) < 5 * np.sqrt(2 / 4000)


@pytest.mark.parametrize("detector, freedom", [(WindowedChiSquare(window=10), 20), (Mewma(), 2), (Mewma(exact=False, weight=0.5), 2)])
def test_the_score_of_honest_innovations_is_chi_square(detector, freedom):
    """After its first steps: w q degrees of freedom for the window, q for the MEWMA."""
    never = dataclasses.replace(detector, threshold=1e9)
    scores = feed(never, innovations(30, 3000))[0][-1]
    assert stats.kstest(scores, stats.chi2(freedom).cdf).pvalue > 0.01


def test_a_missing_reading_adds_nothing():
    """r = 0 where nothing arrived: the score of the window keeps, the sum of the CUSUM falls by its allowance."""
    plan = KalmanFilter()
    kf = plan.prepare(MODEL)
    received = tailgate.core.Received(np.full((1, 1, 2), 7.0), np.array([[[False, False]]]), np.zeros((1, 1)))
    prior = tailgate.core.Prior(np.zeros((1, 1, 3)), np.eye(3)[None, None])
    silent = plan.innovation(kf, plan.start(kf, prior), received)
    assert not silent.r.any()
    loud = [of_size(9.0), of_size(5.0), silent, silent]
    np.testing.assert_array_equal(feed(WindowedChiSquare(), loud)[0][:, 0], [9.0, 14.0, 14.0, 14.0])
    np.testing.assert_array_equal(feed(Cusum(), loud)[0][:, 0], [6.0, 8.0, 5.0, 2.0])


@pytest.mark.parametrize("detector", STATEFUL, ids=repr)
def test_the_gate_is_exact(detector):
    """Just below it no innovation raises an alarm, just above it one does (MEWMA: along z); negative: even silence alarms."""
    batch = 400
    quick = dataclasses.replace(detector, threshold=0.4 * detector.threshold)
    plan, state = quick.prepare(MODEL), quick.start(quick.prepare(MODEL), batch)
    shut = 0
    for innovation in innovations(30, batch):
        gate = quick.gate(plan, state)
        assert gate.shape == (batch, 1)
        towards = RNG.normal(size=(batch, 1, 2))
        if isinstance(quick, Mewma):
            half = np.arange(batch) % 2 == 0
            towards[half] = np.where(state.z[half].any(axis=-1, keepdims=True), state.z[half], towards[half])
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        root = np.linalg.cholesky(innovation.S)
        for factor, alarms in ((1 - 1e-9, False), (1 + 1e-9, True)):
            r = (root @ (np.sqrt(np.maximum(gate, 0.0) * factor)[..., None] * towards)[..., None])[..., 0]
            _, verdict = quick.step(plan, state, Innovation(r, innovation.S))
            reached = gate > 1e-6
            if alarms and isinstance(quick, Mewma):
                reached = reached & half[:, None]
            assert (verdict.alarm[reached] == alarms).all()
            assert verdict.alarm[gate < -1e-6].all()
        shut += int((gate < 0).sum())
        state, _ = quick.step(plan, state, innovation)
    assert (shut > 0) == (isinstance(quick, WindowedChiSquare) or not quick.reset)


@pytest.mark.thin(3)
@pytest.mark.parametrize("detector", STATEFUL, ids=repr)
def test_stealth_is_as_loud_as_it_can_be_and_never_alarms(detector, short, play):
    """The white-box attack on the gate keeps the score just below the threshold; under MEWMA once it has turned z to where it pushes."""
    defence = compose(KalmanFilter(), detector, GateOut())
    place = short(horizon=90, fdi_bound=1e4, onset=20)
    trace = play(place, defence, "stealth", range(16), terminate=False)
    attacked = trace.kind != 0
    assert attacked[19:].all() and not trace.alarm[attacked].any()
    settled = trace.score[70 if isinstance(detector, Mewma) else 19 :, :, 0]
    assert (settled >= (1.0 - 1e-6) * detector.threshold).all() and (settled <= detector.threshold).all()


LASTING = [(20.0, ChiSquare(20.0)), (6.0, WindowedChiSquare(60.0, window=10)), (3.0, Cusum(30.0)), (20.0 / 9.0, Mewma(20.0, weight=0.2))]


@pytest.mark.parametrize("size, detector", LASTING)
def test_what_a_lasting_stealth_attack_may_spend_a_step(size, detector):
    """eta, h / w, b and h l / (2 - l): a lasting innovation of this size raises no alarm, a little more does (docs/detectors.md)."""
    for factor, alarms in ((1 - 1e-6, False), (1.2, True)):
        assert feed(detector, [of_size(size * factor)] * 300)[1].any() == alarms


LINE = "composed:filter=kf,detector=cusum,detector.threshold=30,mitigation=reacquire,mitigation.after=10"


def test_parts_on_the_command_line():
    """Names and their parameters make the parts; what they do not name keeps its default."""
    made = Spec("defence", LINE).make()
    kf, detector, mitigation = made.parts()
    assert isinstance(kf, KalmanFilter) and detector == Cusum(threshold=30.0)
    assert (mitigation.after, mitigation.latch, mitigation.mode) == (10, 0, "normal")
    assert Spec("defence", "composed:mitigation=accept_all,mitigation.mode=brake").make().parts()[2].mode == "brake"


BAD = [
    ("detector=cusm", "detector: got", "did you mean 'cusum'"), ("detector=cusum,detector.treshold=3", "detector cusum", "'threshold'"),
    ("detector=cusum,detector.threshold=-3", "detector cusum.threshold", "greater than 0"),
    ("detector=cusum,detector.drift=1", "detector cusum.drift", "greater than 1"),
    ("detector=windowed_chi2,detector.window=0", "windowed_chi2.window", "greater than or equal to 1"),
    ("detector=mewma,detector.weight=1.5", "mewma.weight", "less than or equal to 1"), ("filter.x=3", "filter kf", "'x'"),
    ("mitigation=reacquire,mitigation.after=0", "reacquire.after", "greater than or equal to 1"),
    ("mitigation=gate_out,mitigation.mode=flee", "gate_out.mode", "'widen'"), ("mitigation.linger=-1", "gate_out.linger", "greater"),
]  # fmt: skip


@pytest.mark.parametrize("parameters, field, expected", BAD)
def test_errors_name_the_field(parameters, field, expected):
    """A wrong part, field or value is one InputError that says which and what was expected."""
    with pytest.raises(InputError) as caught:
        Spec("defence", f"composed:{parameters}").make()
    assert field in str(caught.value) and expected in str(caught.value)


def test_with_threshold():
    """The threshold of a defence, or of its detector, is set; everything else stays."""
    assert tailgate.make_defence("cusum_kf", latch=3).with_threshold(7.0) == tailgate.make_defence("cusum_kf", latch=3, threshold=7.0)
    made = Spec("defence", LINE).make().with_threshold(7.0)
    assert isinstance(made, NamedParts) and made.parts()[1] == Cusum(threshold=7.0) and made.parts()[2].after == 10
    assert tailgate.make_defence("composed").with_threshold(7.0).parts()[1] == ChiSquare(eta=7.0)
    parts = compose(KalmanFilter(), Mewma(weight=0.5), GateOut()).with_threshold(7.0).parts()
    assert parts == (KalmanFilter(), Mewma(threshold=7.0, weight=0.5), GateOut())
    for none in (tailgate.make_defence("kf"), compose(KalmanFilter(), Score(), GateOut())):
        with pytest.raises(NotApplicable, match="threshold"):
            none.with_threshold(7.0)
