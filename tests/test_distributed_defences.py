"""The other distributed defences: the law of each, and that all run on a network, on weak sensing and on a platoon, or say why not."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from scipy import stats

import tailgate
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Innovation, Prior
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.envs.plants.sensor_network import LinearSensors, NoControl, SensorNetwork
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
    TrustFilter,
    compose,
)
from tailgate.estimators.distributed.disagreement import disagreement
from tailgate.estimators.distributed.distributed_kalman import neighbours

from .distributed import RNG, error, model_of, place_of, play, random_state

NAMES = ("chi2_dkf", "consensus_kf", "disagreement_dkf", "dkf_oracle", "saturated_dkf", "trimmed_consensus", "trust_dkf")


@pytest.mark.thin(6)
@pytest.mark.parametrize("place", ["thesis-ch5-v0", "weak", "platoon-braking-v0"])
@pytest.mark.parametrize("defence", NAMES)
def test_they_stay_finite_and_their_rows_do_not_depend_on_the_batch(defence, place, same_rows):
    """Jammed up to a million and with readings lost, estimates and scores are finite; each row has its bits in every batch."""
    if (defence, place) == ("trimmed_consensus", "platoon-braking-v0"):
        with pytest.raises(NotApplicable, match="mode 1: agents 1, 2, 3, 4"):
            play(place, defence)
        defence = "trimmed_consensus:faulty=0"
    place = dataclasses.replace(place_of(place), horizon=12)
    for attack, options in (("dos_jam", {"low": -1e6, "high": 1e6, "chance": 0.6}), ("dropout", {"probability": 0.4})):
        whole = same_rows(partial(play, place, defence, attack, **options), 5, [3, 40], [4])
        assert np.isfinite(whole.estimate).all() and np.isfinite(whole.score).all() and whole.kind.any()


@pytest.mark.thin(6)
@pytest.mark.parametrize("defence", [name for name in NAMES if name != "trimmed_consensus"])
def test_without_attack_and_noise_they_converge(defence):
    """On the thesis's network and under weak sensing the errors vanish, faster or slower."""
    for place, share in (("thesis-ch5-v0", 1e-4), ("weak", 0.25)):
        trace = play(place, defence)
        assert (error(trace, after=29) < share * error(trace, after=0)).all()


# --- the gate ---------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("gain", ["varying", "steady"])
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
    assert tailgate.core.registry.entries("defence")["dkf_oracle"].uses == ("measurements", "truth")


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


@pytest.mark.long
def test_a_steady_gate_stays_locked_where_the_varying_one_opens_again():
    """The leader stops at once, which no linear model foresees: its gate shuts, and with the steady gain for good."""
    place = dataclasses.replace(load_scenario("platoon-braking-v0"), horizon=480)
    shut = {gain: play(place, f"chi2_dkf:gain={gain}", seeds=1).alarm[:, 0, 0] for gain in ("steady", "varying")}
    assert shut["varying"].any() and not shut["varying"][-50:].any() and shut["steady"][-50:].all()


# --- saturated innovations ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.thin(2)
@pytest.mark.parametrize("gain", ["varying", "steady"])
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


@pytest.mark.long
@pytest.mark.parametrize("centre", ["median", "own"])
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


@pytest.mark.long
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


@pytest.mark.long
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


# --- parts --------------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_parts_compose():
    """Every filter takes any detector and mitigation, and the named defence is such a composition."""
    for name in ("saturated_dkf", "disagreement_dkf", "trust_dkf", "consensus_kf", "trimmed_consensus", "dkf"):
        made = Spec("defence", f"composed:filter={name},detector=chi2_tail,mitigation=gate_out").make()
        trace = play("weak", made, "fdi", value=1e4)
        assert np.isfinite(trace.estimate).all() and trace.alarm[10:].any()
    same = compose(SaturatedFilter(), Score(), AcceptAll())
    np.testing.assert_array_equal(play("weak", same, "fdi").estimate, play("weak", "saturated_dkf", "fdi").estimate)
