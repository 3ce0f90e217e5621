"""The other distributed defences: the law of each, and that all run on a network, on weak sensing and on a platoon, or say why not."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from scipy import stats

import tailgate
from tailgate.core import Innovation, Prior, Received
from tailgate.draws import keys
from tailgate.envs.network import LinearSensors, NoControl, SensorNetwork
from tailgate.errors import InputError, NotApplicable
from tailgate.estimators import (
    AcceptAll,
    ChiSquare,
    ConsensusFilter,
    DisagreementFilter,
    DistributedKalmanFilter,
    Kalman,
    SaturatedFilter,
    Score,
    TailChiSquare,
    TrimmedFilter,
    TrustFilter,
    compose,
)
from tailgate.estimators.disagreement import disagreement
from tailgate.estimators.distributed import neighbours
from tailgate.estimators.kalman import steady_state
from tailgate.estimators.trimmed import clusters, detects, lessons, split, trimmed_mean
from tailgate.registry import Spec
from tailgate.scenario import load_scenario
from tailgate.trace import rollout

RNG = np.random.default_rng(23)
NAMES = ("chi2_dkf", "consensus_kf", "disagreement_dkf", "dkf_oracle", "saturated_dkf", "trimmed_consensus", "trust_dkf")


@cache
def place_of(name):
    """A scenario cut short, its attacked agents open to a jammer of any strength from step 5 on."""
    place = load_scenario("thesis-ch5-v0" if name == "weak" else name)
    if name == "weak":  # three modes, each seen by three or four of ten agents
        plant = dataclasses.replace(place.plant, system="modal", graph="complete", states=6)
        place = dataclasses.replace(place, plant=plant, sensor=dataclasses.replace(place.sensor, pattern="modes", sensors=2))
    threat = {"kinds": ("dos_jam", "dropout", "fdi"), "jam_range": (-1e6, 1e6), "fdi_bound": 1e6, "onset": 5, "end": None}
    return dataclasses.replace(place, horizon=30).with_threat(**threat)


@cache
def loop_of(place, defence, uses):
    """The loop, prepared once for all tests."""
    made = Spec("defence", defence).make() if isinstance(defence, str) else defence
    return (place_of(place) if isinstance(place, str) else place).loop(made, uses)


def play(place, defence, attack="none", seeds=4, uses=("measurements", "truth"), **options):
    rival = tailgate.make_attack(attack, **options)
    held = keys("train", range(seeds) if isinstance(seeds, int) else seeds)
    return rollout(loop_of(place, defence, uses), rival, held, terminate=False)


def error(trace, agents=slice(None), after=5):
    """(B,) the largest 2-norm of an estimate's error."""
    return np.linalg.norm((trace.estimate - trace.truth)[after:][:, :, agents], axis=-1).max(axis=(0, 2))


def model_of(name):
    return place_of(name).brief().model


def random_state(model, rows=4, spread=1.0):
    """A prior with random means, and readings near them."""
    shape = (rows, model.agents, model.states)
    prior = Prior(spread * RNG.normal(size=shape), np.broadcast_to(np.eye(model.states), (*shape, model.states)))
    y = 3.0 * RNG.normal(size=(rows, *model.C.shape[:2]))
    return prior, Received(y, np.ones(y.shape, bool), np.zeros(y.shape[:2]))


@pytest.mark.parametrize("place", ["thesis-ch5-v0", "weak", "platoon-braking-v0"])
@pytest.mark.parametrize("defence", NAMES)
def test_they_stay_finite_and_their_rows_do_not_depend_on_the_batch(defence, place):
    """Jammed up to a million and with readings lost, estimates and scores are finite; each row has its bits in every batch."""
    if (defence, place) == ("trimmed_consensus", "platoon-braking-v0"):
        with pytest.raises(NotApplicable, match="mode 1: agents 1, 2, 3, 4"):
            play(place, defence)
        defence = "trimmed_consensus:faulty=0"
    place = dataclasses.replace(place_of(place), horizon=12)
    for attack, options in (("dos_jam", {"low": -1e6, "high": 1e6, "chance": 0.6}), ("dropout", {"probability": 0.4})):
        whole = play(place, defence, attack, 5, **options)
        assert np.isfinite(whole.estimate).all() and np.isfinite(whole.score).all() and whole.kind.any()
        known = [whole.trace_hash(i) for i in range(5)]
        some = play(place, defence, attack, [3, 40], **options)
        alone = play(place, defence, attack, [4], **options)
        assert [some.trace_hash(0), alone.trace_hash(0)] == [known[3], known[4]]


@pytest.mark.parametrize("defence", [name for name in NAMES if name != "trimmed_consensus"])
def test_without_attack_and_noise_they_converge(defence):
    """On the thesis's network and under weak sensing the errors vanish, faster or slower."""
    for place, share in (("thesis-ch5-v0", 1e-4), ("weak", 0.25)):
        trace = play(place, defence)
        assert (error(trace, after=29) < share * error(trace, after=0)).all()


# --- the gate ---------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gain", ["steady", "varying"])
def test_a_gate_that_never_shuts_is_no_gate(gain, same_bits):
    """chi2_dkf with an enormous eta has the bits of dkf; with a tiny one it uses no reading."""
    wide = play("thesis-ch5-v0", f"chi2_dkf:eta=1e30,gain={gain}", "fdi", value=50.0)
    assert same_bits(wide.estimate, play("thesis-ch5-v0", f"dkf:gain={gain}", "fdi", value=50.0).estimate)
    shut = play("thesis-ch5-v0", f"chi2_dkf:eta=1e-30,gain={gain}")
    assert shut.alarm[:8].all() and not shut.estimate[:8].any()


def test_a_gate_that_catches_everything_is_an_oracle():
    """Against injections that nobody can miss, chi2_dkf and dkf_oracle equal dkf with these readings lost; dkf itself is far off."""
    big = {"value": 1e4, "chance": 0.5, "agents": (0, 1, 2)}
    lost = play("thesis-ch5-v0", "dkf:gain=varying", "dropout", chance=0.5, agents=(0, 1, 2))
    for defence in ("chi2_dkf", "dkf_oracle"):
        np.testing.assert_allclose(play("thesis-ch5-v0", defence, "fdi", **big).estimate, lost.estimate, atol=1e-10)
    assert (error(play("thesis-ch5-v0", "dkf:gain=varying", "fdi", **big)) > 1000.0).all()


def test_the_oracle_asks_for_the_truth():
    """A loop that grants no truth is refused, and the card says that it is used."""
    with pytest.raises(InputError, match="grants `truth`"):
        play("thesis-ch5-v0", "dkf_oracle", uses=("measurements",))
    assert tailgate.registry.entries("defence")["dkf_oracle"].uses == ("measurements", "truth")


@pytest.mark.parametrize("q", [1, 2, 3, 14])
def test_the_default_gate_has_one_false_alarm_rate(q):
    """chi2_tail alarms above the quantile of chi-square for q sensors; for two at the thesis's 20; eta takes its place."""
    model = dataclasses.replace(model_of("thesis-ch5-v0"), C=np.zeros((10, q, 20)), R=np.repeat(np.eye(q)[None], 10, 0), sensors=tuple(f"y{i}" for i in range(q)))
    detector = TailChiSquare()
    plan = detector.prepare(model)
    assert stats.chi2.sf(plan, q) == pytest.approx(np.exp(-10.0), rel=1e-4) and (q != 2 or plan == pytest.approx(20.0, abs=1e-3))
    r = np.zeros((2, 10, q))
    r[:, :, 0] = np.sqrt(plan) * np.array([0.999, 1.001])[:, None]
    _, verdict = detector.step(plan, None, Innovation(r, np.broadcast_to(np.eye(q), (2, 10, q, q))))
    assert verdict.alarm.tolist() == [[False] * 10, [True] * 10] and detector.gate(plan, None) == plan
    for tail in (0.0, 1.0):
        with pytest.raises(InputError, match="tail"):
            TailChiSquare(tail).prepare(model)


@pytest.mark.parametrize("name", ["chi2_dkf", "consensus_kf", "disagreement_dkf", "saturated_dkf", "trust_dkf"])
def test_a_threshold_can_be_calibrated(name):
    """`with_threshold` turns the alarm's threshold of each defence that alarms, and nothing else."""
    held = tailgate.make_defence(name)
    turned = held.with_threshold(33.0)
    assert turned.parts()[1] == ChiSquare(33.0) and held.parts()[1] == TailChiSquare() and turned.parts()[0] == held.parts()[0]


def test_a_steady_gate_stays_locked_where_the_varying_one_opens_again():
    """The leader stops at once, which no linear model foresees: its gate shuts, and with the steady gain for good."""
    place = dataclasses.replace(load_scenario("platoon-braking-v0"), horizon=480)
    shut = {gain: play(place, f"chi2_dkf:gain={gain}", seeds=1).alarm[:, 0, 0] for gain in ("steady", "varying")}
    assert shut["varying"].any() and not shut["varying"][-50:].any() and shut["steady"][-50:].all()


# --- saturated innovations ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gain", ["steady", "varying"])
def test_without_a_limit_saturation_is_the_plain_filter(gain, same_bits):
    """saturated_dkf with an enormous gamma has the bits of dkf under attack; with the default it has not."""
    plain = play("thesis-ch5-v0", f"dkf:gain={gain}", "fdi", value=50.0).estimate
    assert same_bits(play("thesis-ch5-v0", f"saturated_dkf:gamma=1e9,gain={gain}", "fdi", value=50.0).estimate, plain)
    assert not same_bits(play("thesis-ch5-v0", f"saturated_dkf:gain={gain}", "fdi", value=50.0).estimate, plain)


def test_a_saturated_step_is_bounded_and_keeps_its_direction():
    """A step moves the estimate by at most gamma sqrt(q lambda_max(K S K')), which is reached; below gamma it is the linear step."""
    model, gamma, linear = model_of("thesis-ch5-v0"), 0.7, DistributedKalmanFilter(True)
    f = SaturatedFilter(gamma)
    plan = f.prepare(model)
    prior, received = random_state(model, 1)
    state = f.predict(plan, f.start(plan, prior), np.zeros((1, 10, 0)))
    S, K = f.innovation(plan, state, received).S[0], plan.K
    q, everything = model.C.shape[1], np.ones((1, 10, model.C.shape[1]), bool)
    values, vectors = np.linalg.eigh(np.linalg.cholesky(S).transpose(0, 2, 1) @ np.swapaxes(K, 1, 2) @ K @ np.linalg.cholesky(S))
    bound, worst = gamma * np.sqrt(q * values[:, -1]), (np.linalg.cholesky(S) @ vectors[:, :, -1:])[..., 0]
    for size in (1e-3, 1.0, 1e6):
        for r in (size * RNG.normal(size=(10, q)), size * worst):
            move = f.update(plan, state, Innovation(r[None], S[None]), everything).x[0] - state.x[0]
            whole = linear.update(plan, state, Innovation(r[None], S[None]), everything).x[0] - state.x[0]
            length = np.sqrt(np.einsum("is,ist,it->i", r, np.linalg.inv(S), r) / q)
            np.testing.assert_allclose(move, whole * np.minimum(1.0, gamma / length)[:, None], rtol=1e-9, atol=1e-12)
            assert (np.linalg.norm(move, axis=1) <= bound * (1.0 + 1e-9)).all()
    np.testing.assert_allclose(np.linalg.norm(move, axis=1), bound, rtol=1e-9)


def test_saturation_counts_the_readings_that_are_used():
    """The length is that of the accepted sensors alone: an agent with one sensor left is cut at |r| = gamma sigma."""
    model, f = model_of("thesis-ch5-v0"), SaturatedFilter(1.0)
    plan = f.prepare(model)
    prior, received = random_state(model, 1)
    state = f.predict(plan, f.start(plan, prior), np.zeros((1, 10, 0)))
    S, accept = f.innovation(plan, state, received).S, np.zeros((1, 10, model.C.shape[1]), bool)
    accept[..., 3] = True
    r = np.full(accept.shape, 50.0)
    got = f.update(plan, state, Innovation(r, S), accept).x
    want = state.x + plan.cross[:, 3] / np.sqrt(S[..., 3, 3])[..., None]
    np.testing.assert_allclose(got, want, rtol=1e-9)


# --- neighbours who disagree --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("centre", ["own", "median"])
def test_who_never_disagrees_is_fused_as_ever(centre, same_bits):
    """disagreement_dkf with an enormous threshold has the bits of chi2_dkf."""
    for place, value in (("thesis-ch5-v0", 3.0), ("platoon-braking-v0", 2.0)):
        one = play(place, f"disagreement_dkf:threshold=1e30,centre={centre}", "fdi", value=value)
        assert same_bits(one.estimate, play(place, "chi2_dkf", "fdi", value=value).estimate)


def fused(plan, x, use, i):
    """xb_i and Q_i^-1 of the members `use` of N(i) with weights, in plain numpy."""
    L = np.array(plan.L)
    Q = sum(w * L[j] for j, w in use.items()) / sum(use.values())
    return np.linalg.solve(Q, sum(w * L[j] @ x[j] for j, w in use.items()) / sum(use.values())), np.linalg.inv(Q)


@pytest.mark.parametrize("centre", ["own", "median"])
def test_an_outlier_is_left_out(centre):
    """Who is far from the centre leaves the fusion of those who hear it, which then is that of the others; nobody else's changes a bit."""
    model, f = model_of("thesis-ch5-v0"), DisagreementFilter(3.0, centre, steady=True)
    plan = f.prepare(model)
    x = 0.1 * RNG.normal(size=(2, 10, 20))
    x[1, 7, 4] += 100.0
    got, linear = f.fuse(plan, x, plan.M[None], f.weights(plan, x, plan.M[None])), f.fuse(plan, x, plan.M[None])
    np.testing.assert_array_equal(got.x[0], linear.x[0])
    for i, near in enumerate(neighbours(model.graph)):
        if 7 not in near:
            np.testing.assert_array_equal(got.x[1, i], linear.x[1, i])
            continue
        wrong_alone = i == 7 and centre == "own"  # it leaves out all the others
        want, V = fused(plan, x[1], {j: 1.0 for j in near if (j == 7) == wrong_alone}, i)
        np.testing.assert_allclose(got.x[1, i], want, atol=1e-9)
        np.testing.assert_allclose(got.P[1, i], V, atol=1e-9)


def test_disagreement_is_in_sigma_of_the_difference():
    """z_ij = max_k |x_j - c_i| / sqrt(M_i + M_j), for own and for median; where all are off, an agent keeps its own."""
    model, x = model_of("platoon-braking-v0"), RNG.normal(size=(3, 5, 19))
    M = np.array(DistributedKalmanFilter(True).prepare(model).M)
    near, sd = neighbours(model.graph), np.sqrt(np.diagonal(M, axis1=1, axis2=2))
    for centre in ("own", "median"):
        z, want = disagreement(near, x, M[None], centre), np.zeros((3, 5, 5))
        for i, js in enumerate(near):
            middle = x[:, i] if centre == "own" else np.median(x[:, js], axis=1)
            for j in js:
                want[:, i, j] = np.max(np.abs(x[:, j] - middle) / np.hypot(sd[i], sd[j]), axis=1)
        np.testing.assert_allclose(z, want, rtol=1e-12)
    f = DisagreementFilter(1e-9, "median", steady=True)
    np.testing.assert_array_equal(f.weights(f.prepare(model), x, M[None])[:, 1], np.broadcast_to(np.eye(5)[1], (3, 5)))


# --- trust --------------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gain", ["steady", "varying"])
def test_equal_trust_is_the_plain_filter(gain, same_bits):
    """trust_dkf whose threshold nobody passes has the bits of dkf, under attack too."""
    trusting = play("platoon-braking-v0", f"trust_dkf:threshold=1e30,gain={gain}", "fdi", value=20.0)
    assert same_bits(trusting.estimate, play("platoon-braking-v0", f"dkf:gain={gain}", "fdi", value=20.0).estimate)


def test_trust_is_lost_at_once_and_regained_slowly():
    """T = (threshold / z)^2 where that is less, else it closes the share `rate` of what is missing; the weights of the fusion are T."""
    model = model_of("thesis-ch5-v0")
    f = TrustFilter(2.0, 0.25, 0.1, steady=True)
    plan = f.prepare(model)
    state = f.start(plan, Prior(np.zeros((1, 10, 20)), np.zeros((1, 10, 20, 20))))
    sent = np.zeros((1, 10, 20))
    sent[0, 7, 4] = 2.0 * 1.6 * np.sqrt(plan.M[7, 4, 4] + plan.M[9, 4, 4])  # 1.6 times the threshold of agent 9, which hears 7
    told = state._replace(x=sent @ np.linalg.inv(model.A).T)
    first = f.predict(plan, told, np.zeros((1, 10, 0)))
    assert first.trust[0, 9, 7] == pytest.approx(1.6**-2) and first.trust[0, 9, 9] == first.trust[0, 9, 8] == 1.0
    want, V = fused(plan, sent[0], {7: 1.6**-2, 8: 1.0, 9: 1.0}, 9)
    np.testing.assert_allclose(first.x[0, 9], want, atol=1e-8)
    np.testing.assert_allclose(first.P[0, 9], V, atol=1e-8)
    after = first._replace(x=np.zeros_like(sent), P=None)
    for k in (1, 2):
        after = f.predict(plan, after, np.zeros((1, 10, 0)))._replace(P=None)
        assert after.trust[0, 9, 7] == pytest.approx(1.0 - (1.0 - 1.6**-2) * 0.75**k)


def test_who_has_little_trust_is_disregarded():
    """Below the cutoff a neighbour's weight is nothing: the fusion is that of a graph without this edge."""
    model, sent = model_of("thesis-ch5-v0"), 0.01 * RNG.normal(size=(1, 10, 20))
    sent[0, 7, 4] += 1e4
    f = TrustFilter(2.0, 0.25, 0.3, steady=True)
    plan = f.prepare(model)
    state = f.start(plan, Prior(sent @ np.linalg.inv(model.A).T, np.zeros((1, 10, 20, 20))))
    got = f.predict(plan, state, np.zeros((1, 10, 0)))
    want, _ = fused(plan, sent[0], {8: 1.0, 9: 1.0}, 9)
    np.testing.assert_allclose(got.x[0, 9], want, atol=1e-8)


@pytest.mark.parametrize("defence", ["trust_dkf", "disagreement_dkf:eta=1e30"])
def test_the_neighbours_of_an_attacked_agent_are_spared(defence):
    """Agent 7 alone is attacked, without any gate: the error of the others is a thousandth of that with the plain filter."""
    others = [i for i in range(10) if i != 7]
    attack = {"sd": 500.0, "agents": (7,), "chance": 0.8, "start_step": 15}
    plain, spared = (error(play("thesis-ch5-v0", d, "fdi_gaussian", **attack), others, 15) for d in ("dkf:gain=varying", defence))
    assert (plain > 10.0).all() and (spared < 1e-3 * plain).all()


# --- Kalman consensus ---------------------------------------------------------------------------------------------------------------------------


def test_without_consensus_everybody_is_a_kalman_filter():
    """consensus_kf with gain 0 gives the estimates of kf, under attack and with readings lost; with the default it does not."""
    for place in ("thesis-ch5-v0", "platoon-braking-v0", "weak"):
        for attack, options in (("fdi", {"value": 5.0}), ("dropout", {"probability": 0.5})):
            own = play(place, Kalman(), attack, 2, **options).estimate
            got = play(place, "consensus_kf:consensus=0", attack, 2, **options).estimate
            np.testing.assert_allclose(got, own, rtol=1e-7, atol=1e-7)
            assert np.abs(play(place, "consensus_kf", attack, 2, **options).estimate - own).max() > 1e-3


@pytest.mark.parametrize("share", [False, True])
def test_consensus_is_the_papers_equation(share):
    """A step, with sensors refused, against plain numpy in information form."""
    model, eps = model_of("platoon-braking-v0"), 0.6
    f = ConsensusFilter(eps, share)
    plan, (prior, received) = f.prepare(model), random_state(model, 3)
    u, accept = RNG.normal(size=(3, 5, 1)), RNG.uniform(size=received.y.shape) < 0.7
    predicted = f.predict(plan, f.start(plan, prior), u)
    got = f.update(plan, predicted, f.innovation(plan, predicted, received), accept)
    for b in range(3):
        x, M = prior.mean[b] @ model.A.T + u[b] @ model.B.T + model.c, np.stack([model.A @ P @ model.A.T + model.Q for P in prior.cov[b]])
        np.testing.assert_allclose(predicted.x[b], x, rtol=1e-9, atol=1e-9)
        for i, near in enumerate(neighbours(model.graph)):
            S, y = np.linalg.inv(M[i]), np.zeros(19)
            for j in near if share else (i,):
                some = np.flatnonzero(accept[b, j])
                C, weight = model.C[j][some], np.linalg.inv(model.R[j][np.ix_(some, some)])
                S, y = S + C.T @ weight @ C, y + C.T @ weight @ (received.y[b, j][some] - C @ x[i])
            others = [x[j] - x[i] for j in near if j != i] or [0.0 * x[i]]
            want = x[i] + np.linalg.solve(S, y) + eps / (1.0 + np.linalg.norm(M[i])) * M[i] @ np.mean(others, axis=0)
            np.testing.assert_allclose(got.x[b, i], want, rtol=1e-7, atol=1e-7)
            np.testing.assert_allclose(got.P[b, i], np.linalg.inv(S), rtol=1e-7, atol=1e-7)


def test_shared_readings_on_a_complete_graph_are_all_readings():
    """With `share` and everybody in touch, each agent is the Kalman filter of all sensors."""
    place = place_of("weak")
    shared = play(place, "consensus_kf:consensus=0,share=true", "fdi", value=5.0)
    model = shared.model
    x, P = np.zeros((4, 6)), np.eye(6)
    C = model.C.reshape(-1, 6)
    for k in range(30):
        x, P = x @ model.A.T, model.A @ P @ model.A.T + model.Q
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(len(C)))
        x, P = x + (shared.wires[k].reshape(4, -1) - x @ C.T) @ K.T, P - K @ C @ P
        np.testing.assert_allclose(shared.estimate[k], np.repeat(x[:, None], 10, axis=1), rtol=1e-7, atol=1e-7)


def test_growing_modes_that_an_agent_cannot_see_are_refused():
    """Where a mode grows, those who do not see it by themselves are named; with `share` those whose neighbours do not either."""
    network = SensorNetwork(agents=4, states=8, graph="path", system="modal", spectral_radius=1.1)
    model = network.model(LinearSensors(sensors=2, pattern="modes", modes_seen=2), NoControl())
    for share, agents in ((False, [0, 1, 2, 3]), (True, [0, 3])):
        with pytest.raises(NotApplicable) as caught:
            ConsensusFilter(1.0, share).prepare(model)
        assert caught.value.value == agents
    ConsensusFilter(1.0, True).prepare(dataclasses.replace(model, graph=np.ones((4, 4), bool)))


# --- trimmed consensus --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["thesis-ch5-v0", "platoon-braking-v0", "weak", "defective", "stable"])
def test_the_modes_split_the_state(name):
    """V and W of all blocks are inverse to each other, each V is invariant under A, and has its eigenvalue; the rest dies out."""
    if name in ("defective", "stable"):
        T = np.linalg.qr(np.random.default_rng(1).normal(size=(6, 6)))[0]
        J = np.diag([1.0, 1.0, -1.05, 0.5, 0.5, 0.2]) if name == "defective" else np.diag([0.9, 0.9, 0.1, -0.5, 0.5, 0.2])
        J[0, 1], J[3, 4] = 1.0, 0.3
        A = T @ J @ T.T
    else:
        A = np.array(model_of(name).A)
    lasting, rest = split(A)
    V, W = (np.concatenate([getattr(b, part) for b in (*lasting, rest)], axis=axis) for part, axis in (("V", 1), ("W", 0)))
    np.testing.assert_allclose(W @ V, np.eye(len(A)), atol=1e-12)
    for block in lasting:
        J = block.W @ A @ block.V
        np.testing.assert_allclose(A @ block.V, block.V @ J, atol=1e-12)
        got = sorted(np.linalg.eigvals(J), key=lambda v: v.imag)
        np.testing.assert_allclose(got[-1], block.eigenvalue, atol=1e-6)
    last = np.abs(np.linalg.eigvals(rest.W @ A @ rest.V))
    assert last.size == 0 or last.max() < 1.0 - 1e-6
    wanted = {"defective": [(-1.05, 1), (1.0, 2)], "stable": []}.get(name)
    assert wanted is None or [(round(v.real, 6), size) for v, size in clusters(A)] == wanted


def test_who_detects_a_mode():
    """A chain x1 -> x0 of an eigenvalue 1 is detected by who sees x0, and not by who sees x1 alone."""
    A = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.5]])
    (block,), _ = split(A)
    assert block.V.shape == (3, 2)
    assert [detects(A, np.array([row]), block) for row in ([1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0])] == [True, False, False]


def test_lessons_are_learned_round_after_round():
    """Who hears 2F + 1 who know learns from these; an agent that comes too late for it is named."""
    graph = np.zeros((7, 7), bool)
    graph[3, [0, 1, 2]] = graph[4, [1, 2, 3]] = graph[5, [0, 4]] = graph[6, [0, 1, 2, 3, 4, 5]] = True
    taught, lost = lessons(graph, [0, 1, 2], 1)
    assert taught == ((3, (0, 1, 2)), (4, (1, 2, 3)), (6, (0, 1, 2))) and lost == [5]
    taught, lost = lessons(graph, [0, 1, 2], 0)
    assert lost == [] and dict(taught)[5] == (0,)


def test_where_everybody_detects_everything_it_is_the_local_filter():
    """On the thesis's network, whose agents see all that lasts, trimmed_consensus is the steady Kalman filter."""
    own = play("thesis-ch5-v0", "kf:gain=steady", "fdi", value=5.0).estimate
    np.testing.assert_allclose(play("thesis-ch5-v0", "trimmed_consensus", "fdi", value=5.0).estimate, own, atol=1e-8)


def weak_case(faulty):
    """The filter, its plan and the mode z0 that agents 0, 3, 6 and 9 see."""
    model = model_of("weak")
    f = TrimmedFilter(faulty)
    lasting, _ = split(model.A)
    (block,) = (b for b in lasting if detects(model.A, model.C[0], b))
    return model, f, f.prepare(model), block


def test_without_trimming_it_averages():
    """F = 0: an agent takes the mean of all who know the mode, mode by mode, in place of what it held; its own modes it keeps."""
    model, f, plan, block = weak_case(0)
    x = RNG.normal(size=(3, 10, 6))
    got = f.predict(plan, f.start(plan, Prior(x, None)), np.zeros((3, 10, 0))).x
    z, after = x @ block.W.T, got @ np.linalg.inv(model.A).T @ block.W.T
    for i in range(10):
        want = z[:, i] if i in (0, 3, 6, 9) else z[:, [0, 3, 6, 9]].mean(axis=1)
        np.testing.assert_allclose(after[:, i], want, atol=1e-10)


def test_trimming_leaves_out_the_extremes():
    """F = 1: of four parents the middle two are averaged, number by number, and a liar cannot leave the range of the others."""
    model, f, plan, block = weak_case(1)
    x = RNG.normal(size=(3, 10, 6))
    x[:, 3] += 1e6 * RNG.normal(size=(3, 6))
    got = f.predict(plan, f.start(plan, Prior(x, None)), np.zeros((3, 10, 0))).x
    z, after = x @ block.W.T, got @ np.linalg.inv(model.A).T @ block.W.T
    ranked, honest = np.sort(z[:, [0, 3, 6, 9]], axis=1), z[:, [0, 6, 9]]
    for i in (1, 2, 4, 5, 7, 8):
        np.testing.assert_allclose(after[:, i], ranked[:, 1:3].mean(axis=1), atol=1e-9)
        assert (after[:, i] >= honest.min(axis=1) - 1e-9).all() and (after[:, i] <= honest.max(axis=1) + 1e-9).all()
    np.testing.assert_array_equal(trimmed_mean(np.array([[[5.0], [1.0], [9.0]]]), 1), [[5.0]])


def test_one_attacked_agent_spoils_nobody_else():
    """Random injections at one agent: with F = 1 the others converge as without, with F = 0, and with dkf, they do not."""
    others = list(range(1, 10))
    attack = {"sd": 500.0, "agents": (0,)}
    clean = error(play("weak", "trimmed_consensus"), others, 25)
    spared = error(play("weak", "trimmed_consensus", "fdi_gaussian", **attack), others, 25)
    assert (spared < 2.0 * clean + 1e-6).all() and (clean < 1e-3).all()
    for defence in ("trimmed_consensus:faulty=0", "dkf"):
        assert (error(play("weak", defence, "fdi_gaussian", **attack), others, 25) > 1.0).all()


def test_a_graph_that_is_too_thin_is_refused():
    """What is missing is said by mode and agent: with a ring, and with more faults than a complete graph of ten bears."""
    place = place_of("weak")
    thin = SensorNetwork(agents=10, states=6, graph="ring", system="modal").model(place.sensor, NoControl())
    with pytest.raises(NotApplicable, match=r"mode .*: agents 0, .* hears 3 or more who know it"):
        TrimmedFilter(1).prepare(thin)
    TrimmedFilter(0).prepare(thin)
    with pytest.raises(NotApplicable, match=r"F = 2"):
        TrimmedFilter(2).prepare(model_of("weak"))


def test_the_local_gain_moves_what_an_agent_detects_and_nothing_else():
    """P- of an agent is that of the Kalman filter of its own modes, and zero in the others."""
    model, _, plan, block = weak_case(1)
    lasting, _ = split(model.A)
    for b in lasting:
        moved = b.W @ plan.held[0] @ b.W.T
        assert (np.abs(moved).max() > 0.1) == (b.eigenvalue == block.eigenvalue)
    A, C, Q = block.W @ model.A @ block.V, model.C[0] @ block.V, block.W @ model.Q @ block.W.T
    part = dataclasses.replace(
        model, A=A, B=np.zeros((2, 0)), c=np.zeros(2), C=C[None], Q=Q, R=model.R[:1], graph=np.eye(1, dtype=bool), gap=None, speed=None
    )
    np.testing.assert_allclose(block.W @ plan.held[0] @ block.W.T, steady_state(part)[0], rtol=1e-9)


def test_the_parts_compose():
    """Every filter takes any detector and mitigation, and the named defence is such a composition."""
    for name in ("saturated_dkf", "disagreement_dkf", "trust_dkf", "consensus_kf", "trimmed_consensus", "dkf"):
        made = Spec("defence", f"composed:filter={name},detector=chi2_tail,mitigation=gate_out").make()
        trace = play("weak", made, "fdi", value=1e4)
        assert np.isfinite(trace.estimate).all() and trace.alarm[10:].any()
    same = compose(SaturatedFilter(), Score(), AcceptAll())
    np.testing.assert_array_equal(play("weak", same, "fdi").estimate, play("weak", "saturated_dkf", "fdi").estimate)
