"""The robust Kalman filter: optimality of the outliers, the solver as an oracle, what an outlier can do, and the limits in lam."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter as Reference

import tailgate
from tailgate import num
from tailgate.core import Innovation, Prior, Received
from tailgate.core.draws import Role, keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.estimators import Kalman, Outlier, RobustKalman, RobustKalmanFilter
from tailgate.estimators.filters.robust import believed, believed_by_cvxpy

FAMILIES = ("plain", "tiny", "huge", "units", "correlated", "far", "boundary", "none", "one silent")
NO_DRAWS = keys("train", [0]).at(Role.DEFENCE, np.zeros(1))


def _problems(family, q, rows=1500):
    """r, lam (M, 1, q) and S (M, 1, q, q)."""
    rng = np.random.default_rng([FAMILIES.index(family), q])
    root = rng.normal(size=(rows, q, q + 2))
    S, r = root @ np.swapaxes(root, 1, 2), rng.normal(size=(rows, q)) * 10.0 ** rng.uniform(-1, 2, (rows, 1))
    lam = 10.0 ** rng.uniform(-2, 2, (rows, q))
    if family in ("tiny", "huge", "units"):
        unit = {"tiny": np.full((rows, q), 1e-6), "huge": np.full((rows, q), 1e6)}.get(family, 10.0 ** rng.uniform(-4, 4, (rows, q)))
        S, r, lam = S * unit[:, :, None] * unit[:, None], r * unit, lam / unit
    if family == "correlated":
        S = (1.0 - 10.0 ** rng.uniform(-5, -1, (rows, 1, 1))) * np.ones((q, q))
        S[:, range(q), range(q)] = 1.0
    if family == "far":
        r = r * 1e8
    if family == "boundary":
        lam = np.repeat(np.max(np.abs(2.0 * num.matvec(num.inverse(S), r)), axis=1)[:, None], q, axis=1)
    if family == "none":
        r = 0.0 * r
    if family == "one silent":
        r[:, 0] = 0.0
    return r[:, None], S[:, None], lam[:, None]


def _rounding(W, y):
    """Of 2 W y."""
    return 4.0 * np.finfo(float).eps * np.sum(2.0 * np.abs(W * y[..., None, :]), axis=-1)


def _price(r, y, S, lam):
    return num.quadratic(y, num.inverse(S)) + np.sum(lam * np.abs(r - y), axis=-1)


@pytest.mark.parametrize("q", [1, 2, 3, 5])
@pytest.mark.parametrize("family", FAMILIES)
def test_the_outliers_are_optimal(family, q):
    """|2 W (r - z)|_i <= lam_i to 1e-12, with equality and the sign of z_i where z_i is not 0; where it is, r_i keeps every bit."""
    r, S, lam = _problems(family, q)
    y, W = believed(r, S, lam), num.inverse(S)
    slope, out = 2.0 * num.matvec(W, y), y != r
    miss = np.where(out, np.abs(slope - np.sign(r - y) * lam), np.maximum(np.abs(slope) - lam, 0.0))
    assert (miss <= 1e-12 * lam + _rounding(W, y)).all()
    assert out.any() == (family not in ("boundary", "none") and (q, family) != (1, "one silent"))
    assert not out.all() or family == "far"


@pytest.mark.parametrize("q", [1, 2, 3, 5])
@pytest.mark.parametrize("family", FAMILIES)
def test_a_row_is_solved_alike_in_every_batch(family, q, same_bits):
    """The bits of a row do not depend on its companions or on the layout, however long those take."""
    problem = _problems(family, q, 400)
    whole = believed(*problem)
    for part in (slice(0, 1), slice(7, 8), slice(20, 90), slice(3, None, 5), slice(None, None, -1)):
        assert same_bits(believed(*(x[part] for x in problem)), whole[part])
        assert same_bits(believed(*(num.batch_last(x[part]) for x in problem)), whole[part])


@pytest.mark.parametrize("q", [1, 2, 3])
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
def test_no_price_is_above_the_solvers(family, q):
    """The objective is at most cvxpy's (1 + 1e-9), and cvxpy's at most ours and its own tolerance."""
    pytest.importorskip("cvxpy")
    r, S, lam = _problems(family, q, 12)
    ours, theirs = (_price(r, solve(r, S, lam), S, lam) for solve in (believed, believed_by_cvxpy))
    assert (ours <= theirs * (1.0 + 1e-9) + 1e-12).all()
    assert (theirs <= ours * (1.0 + 1e-5) + 1e-9).all()


@pytest.mark.long
def test_cvxpy_gives_the_same_estimates_in_the_loop(short, play):
    """Both solvers drive the same episodes, under an attack and a dropout of one sensor, to the solver's tolerance."""
    pytest.importorskip("cvxpy")
    for attack, options in (("fdi_bernoulli", {"value": -20.0}), ("dropout", {"targets": ("velocity",)})):
        rival = tailgate.make_attack(attack, **options)
        exact, solved = (play(short(horizon=30), RobustKalman(solver=s), rival, range(2), terminate=False) for s in ("exact", "cvxpy"))
        np.testing.assert_allclose(solved.estimate, exact.estimate, atol=1e-5)
        kf = play(short(horizon=30), Kalman(gain="steady"), rival, range(2), terminate=False)
        assert np.max(np.abs(kf.estimate - exact.estimate)) > 1e-2


@pytest.mark.parametrize("defence", ["rkf", "norm_resilient"])
def test_a_missing_cvxpy_names_its_extra(defence, monkeypatch):
    """Asking for the solver without the package is an ImportError with the command that installs it."""
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(ImportError, match=r"tailgate\[cvxpy\]"):
        tailgate.make_defence(defence, solver="cvxpy")
    tailgate.make_defence(defence)


@pytest.mark.parametrize("attack", ["none", "fdi", "dos_jam", "dropout"])
def test_a_price_at_infinity_is_the_steady_kalman_filter(attack, short, play, same_bits):
    """lam = 1e12 gives the estimates, scores and gaps of kf:gain=steady to the last bit."""
    robust = play(short(), RobustKalman(lam=1e12), attack, range(8), terminate=False)
    steady = play(short(), Kalman(gain="steady"), attack, range(8), terminate=False)
    for name in ("estimate", "score", "gap", "control"):
        assert same_bits(robust.signals[name], steady.signals[name]), name


def test_without_outliers_it_is_filterpys_steady_state_filter():
    """With filterpy's predict_steadystate and update_steadystate, and its own gain after 2000 steps: estimates within 1e-9."""
    model, rng = load_scenario("gusty-stop-and-go-v0").brief().model, np.random.default_rng(9)
    theirs = Reference(dim_x=3, dim_z=2, dim_u=1)
    theirs.F, theirs.B, theirs.Q, theirs.H, theirs.R = model.A, model.B, model.Q, model.C[0], model.R[0]
    theirs.x, theirs.P = np.zeros(3), np.eye(3)
    for _ in range(2000):
        theirs.predict()
        theirs.update(np.zeros(2))
    theirs.x = np.zeros(3)
    ours = RobustKalman(lam=1e6)
    plan = ours.prepare(model)
    state = ours.start(plan, Prior(np.zeros((1, 1, 3)), np.eye(3)[None, None]))
    for _ in range(200):
        y, u = 10.0 * rng.normal(size=2), rng.normal(size=1)
        theirs.predict_steadystate(u)
        theirs.update_steadystate(y)
        state, estimate = ours.step(plan, state, Received(y[None, None], np.ones((1, 1, 2), bool), np.zeros((1, 1))), u[None, None], NO_DRAWS)
        np.testing.assert_allclose(estimate.x[0, 0], theirs.x, rtol=0.0, atol=1e-9)


def test_the_default_price_is_the_tuned_one():
    """The record of benchmarks/results/tune_rkf/tune_rkf.py, made with other lam's, names the default."""
    record = json.loads((Path(__file__).parents[1] / "benchmarks/results/tune_rkf/tune_rkf.json").read_text(encoding="utf-8"))
    assert RobustKalman().lam == pytest.approx(record["default"]["lam_sqrt_S"], abs=0.05) and RobustKalman().unit == "sigma"
    scores = [[row["score"] for row in record["settings"][name]["grid"]] for name in ("gusty-stop-and-go-v0", "stop-and-go-v0")]
    best = int(np.argmin(np.prod(scores, axis=0)))
    assert 0 < best < len(scores[0]) - 1
    assert record["settings"]["stop-and-go-v0"]["grid"][best]["lam_sqrt_R"] == record["default"]["lam_sqrt_R"]


def _step(filter_, model, r, valid=None):
    """x - x- (n,) after one innovation r of one row, the plan and the innovation."""
    plan = filter_.prepare(model)
    n, q = model.states, len(model.sensors)
    prior = Prior(np.zeros((1, 1, n)), np.eye(n)[None, None])
    belief = filter_.predict(plan, filter_.start(plan, prior), np.zeros((1, 1, model.inputs)))
    valid = np.ones((1, 1, q), bool) if valid is None else valid
    y = np.where(valid, num.matvec(model.C, belief.x) + r, np.nan)
    innovation = filter_.innovation(plan, belief, Received(y, valid, np.zeros((1, 1))))
    return (filter_.update(plan, belief, innovation, valid).x - belief.x)[0, 0], plan, innovation


@pytest.mark.parametrize("size", [1e2, 1e4, 1e8])
def test_an_outlier_of_any_size_moves_the_estimate_by_a_bounded_amount(size):
    """x - x- = P- C' W (r - z) and |W (r - z)| <= lam / 2: no more than |P- C'| lam / 2, which large outliers on all sensors reach."""
    model = load_scenario("thesis-ch4-v0").brief().model
    moved, plan, innovation = _step(RobustKalmanFilter(lam=3.0), model, np.array([[[size, size]]]))
    price = RobustKalmanFilter(lam=3.0).price(innovation.S)[0, 0]
    bound = np.abs(plan.held[0] @ model.C[0].T) @ price / 2.0
    np.testing.assert_allclose(moved, bound, rtol=1e-6)


@pytest.mark.parametrize("sensor", [0, 1])
@pytest.mark.parametrize("r", [0.3, -40.0])
def test_a_reading_that_is_missing_does_not_count(sensor, r):
    """With one sensor left, its innovation is clipped at lam S_jj / 2 and weighs P- C_j' / S_jj, whatever stands on the other wire."""
    model, lam = load_scenario("thesis-ch4-v0").brief().model, 1.5
    valid = (np.arange(2) == sensor)[None, None]
    moved, plan, _ = _step(RobustKalmanFilter(lam=lam, unit="sensor"), model, np.full((1, 1, 2), r), valid)
    P, C = plan.held[0], model.C[0][sensor]
    S = C @ P @ C + model.R[0, sensor, sensor]
    np.testing.assert_allclose(moved, P @ C / S * np.clip(r, -lam * S / 2, lam * S / 2), rtol=1e-12)


def test_lam_in_sigma_is_the_same_at_every_noise_level(linear_model):
    """Q, R and the innovation in other units: the outliers scale with them; in 1/unit of the sensor they do not."""
    base = load_scenario("thesis-ch4-v0").brief().model
    r, moved = np.array([[[9.0, -2.0]]]), {}
    for unit in ("sigma", "sensor"):
        for k in (1.0, 4.3):
            model = linear_model(base.A, base.C[0], base.Q * k * k, base.R[0] * k * k)
            moved[unit, k] = _step(RobustKalmanFilter(lam=2.0, unit=unit), model, r * k)[0] / k
    np.testing.assert_allclose(moved["sigma", 4.3], moved["sigma", 1.0], rtol=1e-9)
    assert np.max(np.abs(moved["sensor", 4.3] - moved["sensor", 1.0])) > 0.1


def test_the_outlier_detector_alarms_exactly_where_the_filter_finds_one():
    """Alarm where |2 W r|_i > lam_i for some i; the sensors with z_i != 0 are blamed; the score is r' W r."""
    rng, detector = np.random.default_rng(3), Outlier(lam=2.5)
    model = load_scenario("thesis-ch4-v0").brief().model
    plan, S = detector.prepare(model), np.broadcast_to([[2.0, 0.7], [0.7, 1.0]], (4000, 1, 2, 2))
    r = rng.normal(size=(4000, 1, 2)) * 2.0
    _, verdict = detector.step(plan, None, Innovation(r, S))
    W, lam = np.linalg.inv(S[0, 0]), detector.price(S)
    np.testing.assert_array_equal(verdict.alarm, (np.abs(2.0 * r @ W) > lam).any(axis=-1))
    np.testing.assert_array_equal(verdict.alarm, verdict.suspect.any(axis=-1))
    np.testing.assert_allclose(verdict.score, np.einsum("bni,ij,bnj->bn", r, W, r), rtol=1e-12)
    assert 0.2 < verdict.alarm.mean() < 0.9 and (verdict.suspect[..., 0] != verdict.suspect[..., 1]).any()


def test_the_gate_of_the_outlier_detector_is_the_largest_that_is_safe():
    """On the ellipsoid r' S^-1 r = gate nothing alarms; a hair above it, one direction does."""
    detector, model = Outlier(lam=2.5), load_scenario("thesis-ch4-v0").brief().model
    plan = detector.prepare(model)
    filter_ = RobustKalmanFilter()
    S = _step(filter_, model, np.zeros((1, 1, 2)))[2].S[0, 0]
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ np.linalg.cholesky(S).T
    worst = np.argmin(detector.price(S) ** 2 / np.diag(np.linalg.inv(S)))
    ring = np.concatenate([ring, [S @ np.linalg.inv(S)[worst] / np.sqrt(np.linalg.inv(S)[worst, worst])]])
    alarms = []
    for factor in (1.0, 1.0 + 1e-9):
        r = ring * np.sqrt(factor * plan[0] / np.sum(ring @ np.linalg.inv(S) * ring, axis=1))[:, None]
        alarms.append(detector.step(plan, None, Innovation(r[:, None], np.broadcast_to(S, (len(r), 1, 2, 2))))[1].alarm)
    assert not alarms[0].any() and alarms[1].any()


def test_stealth_under_the_outlier_gate_never_alarms(short, play):
    """A white-box attacker who keeps inside of the gate is believed whole, and pushes the belief backwards."""
    trace = play(short(horizon=90, fdi_bound=1e4), RobustKalman(lam=4.0, eta=None), "stealth", range(16), terminate=False)
    attacked = trace.kind != 0
    assert attacked[9:].mean() > 0.5 and not trace.alarm[attacked].any() and trace.alarm[~attacked].any()
    assert (trace.estimate[-1, :, 0, 0] - trace.truth[-1, :, 0, 0]).max() < -2.0


def test_the_parts_are_registered_and_combine(short, play):
    """`composed` with the filter by name and its parameters plays as the defence does."""
    text = "composed:filter=rkf,filter.lam=2.0,filter.unit=sensor,detector=chi2,mitigation=accept_all"
    one = play(short(), Spec("defence", text).make(), "fdi", range(4))
    two = play(short(), Spec("defence", "rkf:lam=2.0,unit=sensor").make(), "fdi", range(4))
    assert [one.trace_hash(i) for i in range(4)] == [two.trace_hash(i) for i in range(4)]
    blamed = play(short(), Spec("defence", "composed:filter=kf,detector=outlier,mitigation=gate_out").make(), "fdi", range(4))
    assert blamed.alarm.any() and np.isfinite(blamed.estimate).all()


def test_the_alarm_threshold_can_be_moved():
    """A board that calibrates alarms sets eta, also where every outlier was an alarm."""
    assert RobustKalman(eta=None).with_threshold(7.0) == RobustKalman(eta=7.0)
