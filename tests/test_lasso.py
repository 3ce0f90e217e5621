"""(6.26): optimality over families of problems, the Huber estimator, every sign of the bound, and the centralised references."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize

import tailgate
from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Prior, Received
from tailgate.core.draws import Role, keys
from tailgate.core.registry import Spec, entries
from tailgate.core.scenario import load_scenario
from tailgate.estimators import DistributedKalmanFilter, LassoFilter, LassoKalman
from tailgate.estimators.distributed.centralised import stacked
from tailgate.estimators.distributed.distributed_kalman import fixed_point
from tailgate.estimators.filters.robust import believed, believed_by_cvxpy
from tailgate.play.trace import rollout
from tailgate.thesis import resilience

from .distributed import moves, spd

FAMILIES = (
    "ordinary", "tiny", "huge", "dependent sensors", "blind", "no attack", "boundary", "one sensor", "more sensors than states",
    "ill-conditioned Q", "correlated Sv", "own prices", "far attacks", "nothing new",
)  # fmt: skip
LAMS = (0.1, 5.0)
NO_DRAWS = keys("train", [0]).at(Role.DEFENCE, np.zeros(1))


def _problems(family, lam, count=400):
    """C (P, q, n), R (P, q, q), Q and Q^-1 (P, n, n), r (P, q) and the prices (P, q)."""
    rng = np.random.default_rng([FAMILIES.index(family), LAMS.index(lam)])
    q, n = {"one sensor": (1, 6), "more sensors than states": (14, 5)}.get(family, (3, 10))
    C, price = rng.normal(size=(count, q, n)), np.full((count, q), lam)
    R = np.repeat(np.eye(q)[None], count, axis=0)
    spread = 2.0 if family == "ill-conditioned Q" else 0.5
    Q, Qinv = spd(rng, count, n, -spread, spread)
    r = rng.normal(size=(count, q)) * 10.0 ** rng.uniform(-2, 3, (count, 1))
    if family in ("tiny", "huge"):  # the same problem in other units of the sensors
        unit = {"tiny": 1e-6, "huge": 1e6}[family]
        C, r, R, price = C * unit, r * unit, R * unit * unit, price / unit
    if family == "dependent sensors":
        C[:, 1:] = C[:, :1] * rng.normal(size=(count, q - 1, 1))
    if family == "blind":
        C = 0.0 * C
    if family == "correlated Sv":
        R, _ = spd(rng, count, q, -2, 2)
    if family == "own prices":
        price = price * 10.0 ** rng.uniform(-1, 1, (count, q))
    if family == "far attacks":
        r[:, 0] *= 1e6
    if family in ("no attack", "boundary"):  # r = S p with |p| below or at lam/2
        p = 0.5 * price * rng.uniform(-1.0, 1.0, (count, q))
        if family == "boundary":
            p[:, 0] = 0.5 * price[:, 0]
        r = np.einsum("pql,pl->pq", R + C @ Qinv @ np.swapaxes(C, 1, 2), p)
    return C, R, Q, Qinv, 0.0 * r if family == "nothing new" else r, price


def _solved(C, R, Qinv, r, price, solve=believed):
    """X - xb (P, n) and a (P, q)."""
    S = R + C @ Qinv @ np.swapaxes(C, 1, 2)
    y = solve(r[:, None], S[:, None], price[:, None])[:, 0]
    p = np.linalg.solve(S, y[..., None])[..., 0]
    return np.einsum("pnm,pqm,pq->pn", Qinv, C, p), r - y


def _objective(d, a, C, R, Q, r, price):
    e = r - np.einsum("pqn,pn->pq", C, d) - a
    return np.einsum("pq,pql,pl->p", e, np.linalg.inv(R), e) + np.sum(price * np.abs(a), axis=1) + np.einsum("pn,pnm,pm->p", d, Q, d)


@pytest.mark.parametrize("lam", LAMS)
@pytest.mark.parametrize("family", FAMILIES)
def test_state_and_attack_are_optimal_together(family, lam):
    """In X: Q (X - xb) = C' p with p = Sv^-1 (y - C X - a); in a: |p| <= lam/2, with a's sign where a is not 0. All to 1e-12.

    The measure is max(1, |r|, |Q||X|, lam), in sensors of noise 1. An a below 1e-12 lam S counts as 0.
    """
    C, R, Q, Qinv, r, price = _problems(family, lam)
    d, a = _solved(C, R, Qinv, r, price)
    p = np.linalg.solve(R, (r - np.einsum("pqn,pn->pq", C, d) - a)[..., None])[..., 0]
    slope = np.linalg.norm(np.einsum("pnm,pm->pn", Q, d) - np.einsum("pqn,pq->pn", C, p), axis=1)
    S = np.diagonal(R + C @ Qinv @ np.swapaxes(C, 1, 2), axis1=1, axis2=2)
    some = np.abs(a) > 1e-12 * price * S
    miss = np.where(some, np.abs(p - 0.5 * price * np.sign(a)), np.maximum(np.abs(p) - 0.5 * price, 0.0))
    rounding = 4.0 * np.finfo(float).eps * np.linalg.norm(np.linalg.inv(R), 2, axis=(1, 2)) * np.linalg.norm(r, axis=1)
    units = np.sqrt(R[:, 0, 0]) if family in ("tiny", "huge") else np.ones(len(r))
    scale = np.maximum(max(1.0, lam), np.linalg.norm(Q, 2, axis=(1, 2)) * np.linalg.norm(d, axis=1))
    scale = np.maximum(scale, np.linalg.norm(r, axis=1) / units)
    assert (slope <= 1e-12 * scale + rounding * np.linalg.norm(C, 2, axis=(1, 2))).all()
    assert (np.max(miss, axis=1) * units <= 1e-12 * scale + rounding * units).all()
    found = some.any(axis=1)
    assert not found.any() if family in ("no attack", "boundary", "nothing new") else found.any()
    assert not d.any() if family in ("blind", "nothing new") else d.any()


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
def test_no_objective_is_above_cvxpys(family):
    """(6.26) itself, in X and a: at most cvxpy's (1 + 1e-9), and cvxpy's at most ours and its own tolerance."""
    pytest.importorskip("cvxpy")
    C, R, Q, Qinv, r, price = _problems(family, 5.0, 8)
    ours, theirs = (
        _objective(*_solved(C, R, Qinv, r, price, solve), C, R, Q, r, price) for solve in (believed, believed_by_cvxpy)
    )
    assert (ours <= theirs * (1.0 + 1e-9) + 1e-12).all()
    assert (theirs <= ours * (1.0 + 1e-5) + 1e-9).all()


def _printed(z, C, R, Q, r, price):
    """(6.26) and its slope at z = (X - xb, a+, a-), a = a+ - a-, of one problem."""
    n, q = len(Q), len(r)
    d, plus, minus = z[:n], z[n : n + q], z[n + q :]
    e = r - C @ d - plus + minus
    We = np.linalg.solve(R, e)
    slope = np.concatenate([2.0 * Q @ d - 2.0 * C.T @ We, price - 2.0 * We, price + 2.0 * We])
    return e @ We + price @ (plus + minus) + d @ Q @ d, slope


def test_the_robust_kalman_filters_problem_is_626():
    """A general minimiser of the printed form, over X and a, finds nothing lower, from 0 or from our solution."""
    C, R, Q, Qinv, r, price = _problems("correlated Sv", 5.0, 6)
    d, a = _solved(C, R, Qinv, r, price)
    bounds = [(None, None)] * 10 + [(0.0, None)] * 6
    for k in range(6):
        problem = C[k], R[k], Q[k], r[k], price[k]
        start = np.concatenate([d[k], np.maximum(a[k], 0.0), np.maximum(-a[k], 0.0)])
        ours = _printed(start, *problem)[0]
        far, near = (
            minimize(_printed, z, args=problem, jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": 5000, "ftol": 1e-15}).fun
            for z in (np.zeros(16), start)
        )
        assert ours <= near * (1.0 + 1e-10) and ours <= far * (1.0 + 1e-10) and far <= ours * (1.0 + 1e-3)


@pytest.mark.long
def test_with_independent_noise_it_is_the_huber_estimator():
    """Sv = sigma^2: a = soft(y - C X, lam sigma^2 / 2), and X minimises Huber's loss of y - C X with (X - xb)' Q (X - xb)."""
    for sigma in (0.05, 1.0, 7.0):
        C, R, Q, Qinv, r, price = _problems("more sensors than states", 5.0, 20)
        R = R * sigma * sigma
        d, a = _solved(C, R, Qinv, r, price)
        e, edge = r - np.einsum("pqn,pn->pq", C, d), 0.5 * price * sigma * sigma
        np.testing.assert_allclose(a, np.sign(e) * np.maximum(np.abs(e) - edge, 0.0), rtol=1e-9, atol=1e-11 * np.abs(r).max())
        slope = 2.0 * np.einsum("pnm,pm->pn", Q, d) - 2.0 * np.einsum("pqn,pq->pn", C, np.clip(e, -edge, edge)) / sigma**2
        assert (np.abs(slope) <= 1e-9 * np.abs(Q).max() * np.maximum(1.0, np.abs(d).max(axis=1, keepdims=True))).all()
        assert (np.abs(e) > edge).any() and (np.abs(e) < edge).any()


def test_the_bound_tries_every_sign_and_knows_each_sensors_price():
    """Against all 2^q signs of one agent, with a price per sensor; more sensors than can be tried are an InputError."""
    model, fusion = load_scenario("thesis-ch6-v0").brief().model, None
    fusion, price = fixed_point(model), np.random.default_rng(0).uniform(0.1, 3.0, (5, 3))
    push = fusion.Qinv @ np.swapaxes(model.C, 1, 2)
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1)
    want = np.linalg.norm(push @ (price[..., None] * signs), axis=1).max(axis=1)
    np.testing.assert_allclose(resilience.lasso_bound(model, price, fusion), want, rtol=1e-12)
    wide = stacked(load_scenario("thesis-ch5-v0").brief().model)
    with pytest.raises(InputError, match="140 sensors"):
        resilience.lasso_bound(wide, 1.0, fusion)


@pytest.mark.thin(3)
@pytest.mark.parametrize("gain", ["steady", "varying"])
@pytest.mark.parametrize("attack", ["none", "fdi_gaussian:sd=3,chance=0.5", "dos_hold:chance=0.5"])
def test_a_price_at_infinity_is_the_linear_filter(attack, gain, same_bits):
    """lam = 1e12 gives the estimates and scores of dkf to the last bit; lam = 0.1 does not under attack."""
    place, rival, held = load_scenario("thesis-ch6-v0"), Spec("attack", attack).make(), keys("train", range(4))
    free, linear, dear = (
        rollout(place.loop(d), rival, held) for d in (LassoKalman(1e12, gain=gain), tailgate.make_defence("dkf", gain=gain), LassoKalman(0.1, gain=gain))
    )
    assert same_bits(free.estimate, linear.estimate) and same_bits(free.score, linear.score)
    assert attack == "none" or np.abs(dear.estimate - linear.estimate).max() > 0.5


@pytest.mark.parametrize("unit", ["sensor", "sigma"])
def test_sensors_that_are_not_accepted_leave_the_problem(unit, same_bits):
    """Any subset of the sensors, with correlated noise: the solution of the reduced problem; none at all is the prediction."""
    rng, lam = np.random.default_rng(4), 0.7
    model = dataclasses.replace(load_scenario("thesis-ch6-v0").brief().model, R=spd(rng, 5, 3, -1, 1)[0])
    filter_ = LassoFilter(lam=lam, unit=unit)
    plan, Qinv = filter_.prepare(model), fixed_point(model).Qinv
    r = rng.normal(size=(16, 5, 3)) * 10.0 ** rng.uniform(-1, 3, (16, 5, 1))
    accept = rng.uniform(size=r.shape) < rng.choice([0.3, 0.7, 1.0], size=(16, 5, 1))
    got = moves(filter_, plan, model, r, accept)
    for b, i in np.ndindex(16, 5):
        on = accept[b, i]
        want = np.zeros(model.states)
        if on.any():
            C, R = model.C[i][on][None], model.R[i][on][:, on][None]
            S = R + C @ Qinv[i] @ np.swapaxes(C, 1, 2)
            price = np.full((1, on.sum()), lam) if unit == "sensor" else lam / np.sqrt(np.diagonal(S, axis1=1, axis2=2))
            want = _solved(C, R, Qinv[i][None], r[b, i, on][None], price)[0][0]
        np.testing.assert_allclose(got[b, i], want, rtol=1e-9, atol=1e-10)
        assert same_bits(moves(filter_, plan, model, r[b : b + 1], accept[b : b + 1])[0], got[b])
    assert not got[~accept.any(axis=-1)].any() and (~accept.any(axis=-1)).any()


DISTRIBUTED = ("lasso_dkf", "lasso_dkf:gain=varying", "lasso_dkf:unit=sigma,lam=1", "centralised_lasso", "centralised_kf")


@pytest.mark.thin(9)
@pytest.mark.parametrize("defence", DISTRIBUTED)
@pytest.mark.parametrize("attack", ["fdi_gaussian:sd=3,chance=0.5", "dos_hold:chance=0.5"])
def test_platoon_rows_do_not_depend_on_their_batch(defence, attack, same_rows):
    """trace_hash of each seed is the same alone, among 3 and among 9."""
    loop, rival = dataclasses.replace(load_scenario("thesis-ch6-v0"), horizon=35).loop(Spec("defence", defence).make()), Spec("attack", attack).make()
    same_rows(lambda seeds: rollout(loop, rival, keys("train", seeds)), 9, [4], [8, 0, 3])


@pytest.mark.long
def test_the_thesis_platoon_withstands_what_the_linear_filter_does_not():
    """Own distance of the attacked car, medians of the maximum: below 1 m under hold and injection; the linear filter's above 3 m."""
    place, own = load_scenario("thesis-ch6-v0"), 2
    for attack, linear in (("dos_hold:targets=[distance,velocity],chance=0.5", 5.0), ("fdi_gaussian:targets=[distance,velocity],sd=2.8,chance=0.5", 3.0)):
        worst = {}
        for name in ("lasso_dkf:lam=0.1", "dkf"):
            trace = rollout(place.loop(Spec("defence", name).make()), Spec("attack", attack).make(), keys("train", range(60)))
            worst[name] = np.median(trace.model.error(trace.estimate, trace.truth)[20:, :, own].max(axis=0))
        assert worst["lasso_dkf:lam=0.1"] < 1.0 and worst["dkf"] > linear


def test_both_solvers_play_the_same_platoon():
    """cvxpy and the exact solver, under an attack, to the solver's tolerance."""
    pytest.importorskip("cvxpy")
    place, rival = dataclasses.replace(load_scenario("thesis-ch6-v0"), horizon=26), Spec("attack", "fdi_gaussian:sd=3").make()
    exact, solved = (rollout(place.loop(LassoKalman(0.1, solver=s)), rival, keys("train", [1])) for s in ("exact", "cvxpy"))
    np.testing.assert_allclose(solved.estimate, exact.estimate, atol=1e-4)


def test_the_centralised_filter_is_the_kalman_filter_of_all_sensors():
    """On the stacked system: the information form of the update with all C_i, and every agent is told the same."""
    model = load_scenario("thesis-ch6-v0").brief().model
    defence = tailgate.make_defence("centralised_kf")
    plan, rng = defence.prepare(model), np.random.default_rng(0)
    prior = Prior(rng.normal(size=(2, 5, 19)), np.zeros((2, 5, 19, 19)))
    y, u = rng.normal(size=(2, 5, 3)), rng.normal(size=(2, 5, 1))
    received = Received(y, np.ones(y.shape, bool), np.zeros((2, 5)))
    _, estimate = defence.step(plan, defence.start(plan, prior), received, u, NO_DRAWS)
    whole = stacked(model)
    Qinv = fixed_point(whole).Qinv[0]
    C, R = whole.C[0], whole.R[0]
    xb = prior.mean.mean(axis=1) @ model.A.T + u[:, 0] @ model.B.T + model.c
    gain = np.linalg.solve(np.linalg.inv(Qinv) + C.T @ np.linalg.solve(R, C), C.T @ np.linalg.inv(R))
    want = xb + (y.reshape(2, 15) - xb @ C.T) @ gain.T
    np.testing.assert_allclose(estimate.x, np.repeat(want[:, None], 5, axis=1), rtol=1e-9, atol=1e-9)
    assert estimate.score.shape == estimate.alarm.shape == estimate.mode.shape == (2, 5)
    assert C.shape == (15, 19) and np.array_equal(C[6:9], model.C[2]) and np.array_equal(R[6:9, 6:9], model.R[2]) and not R[6:9, :6].any()


@pytest.mark.long
def test_the_centralised_reference_is_better_than_each_agent_alone():
    """One estimator with 15 sensors: under injection into car 2 its distance error is below the distributed one's, and lam counts."""
    place, own = load_scenario("thesis-ch6-v0"), 2
    rival, worst = Spec("attack", "fdi_gaussian:targets=[distance,velocity],sd=2.8,chance=0.5").make(), {}
    for name in ("lasso_dkf:lam=0.1", "centralised_lasso:lam=0.1", "centralised_kf"):
        trace = rollout(place.loop(Spec("defence", name).make()), rival, keys("train", range(40)))
        worst[name] = np.median(np.abs(trace.model.gap_error(trace.estimate, trace.truth))[20:, :, own].max(axis=0))
    assert worst["centralised_lasso:lam=0.1"] < worst["lasso_dkf:lam=0.1"] < worst["centralised_kf"]
    assert {"redundant", "measurements"} <= set(entries("defence")["centralised_lasso"].uses)


@pytest.mark.long
def test_140_sensors_are_solved_exactly():
    """The stacked network of chapter 5 under its attack: the optimality conditions hold to 1e-11 of lam."""
    model, rng = stacked(load_scenario("thesis-ch5-v0").brief().model), np.random.default_rng(1)
    S = (model.R + model.C @ fixed_point(model).Qinv @ np.swapaxes(model.C, 1, 2))[None]
    r = 0.3 * rng.normal(size=(6, 1, 140))
    r[:, :, :84] += 700.0 * rng.normal(size=(6, 1, 84))
    lam = np.full(r.shape, 5.0)
    y = believed(r, np.broadcast_to(S, (6, *S.shape[1:])), lam)
    slope, out = 2.0 * num.matvec(num.inverse(S), y), y != r
    miss = np.where(out, np.abs(slope - np.sign(r - y) * lam), np.maximum(np.abs(slope) - lam, 0.0))
    assert (miss <= 1e-11 * 5.0).all() and out.sum(axis=-1).min() >= 60 and out.sum(axis=-1).max() < 140


def test_the_filters_are_parts_by_name():
    """`composed` with the filter by name plays as the defence does."""
    place, rival, held = load_scenario("thesis-ch6-v0"), tailgate.make_attack("dos_hold"), keys("train", range(2))
    for filter_, whole in (("lasso,filter.lam=0.1", "lasso_dkf:lam=0.1"), ("norm_resilient", "norm_resilient")):
        text = f"composed:filter={filter_},detector=score,mitigation=accept_all"
        one, two = (rollout(place.loop(Spec("defence", d).make()), rival, held) for d in (text, whole))
        assert [one.trace_hash(k) for k in range(2)] == [two.trace_hash(k) for k in range(2)]


def test_where_no_attack_is_found_every_bit_is_the_linear_filters():
    """Where |2 S^-1 r| <= lam nothing is subtracted; elsewhere something is."""
    model, rng = load_scenario("thesis-ch6-v0").brief().model, np.random.default_rng(9)
    r = rng.normal(size=(50, 5, 3))
    ours, theirs = (moves(f, f.prepare(model), model, r) for f in (LassoFilter(lam=1.0), DistributedKalmanFilter()))
    S = model.R + model.C @ fixed_point(model).Qinv @ np.swapaxes(model.C, 1, 2)
    slope = np.abs(2.0 * np.einsum("nql,bnl->bnq", np.linalg.inv(S), r)).max(axis=-1)
    assert np.array_equal(ours[slope < 1.0 - 1e-9], theirs[slope < 1.0 - 1e-9]) and 0.05 < (slope < 1.0).mean() < 0.95
    assert (ours != theirs).any(axis=-1)[slope > 1.0 + 1e-9].all()
