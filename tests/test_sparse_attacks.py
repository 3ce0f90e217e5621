"""Subsets of sensors: which attacks can be corrected, banks of filters, and the minimax filter."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy import stats

import tailgate
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Innovation, Model, Prior, Received
from tailgate.core.draws import Role, keys
from tailgate.core.kinds import Kind
from tailgate.core.reach import sparsity
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.estimators.detectors.sequential import WindowedChiSquare
from tailgate.estimators.sparse_attacks.kf_bank import BlockResidue, KalmanBank, block_threshold
from tailgate.estimators.sparse_attacks.minimax import Minimax
from tailgate.estimators.sparse_attacks.observer_bank import ObserverBank
from tailgate.estimators.sparse_attacks.subsets import correctable, without
from tailgate.play.trace import rollout
from tailgate.thesis import bounds
from tests.readings import dense, play_readings, simulated

RNG = np.random.default_rng(31)


def _scalar(linear_model, q, Q=1.0, R=1.0):
    return linear_model([[1.0]], np.ones((q, 1)), [[Q]], R * np.eye(q))


@pytest.mark.parametrize(
    "scenario, k, s", [("redundant-two-v0", 5, 2), ("stop-and-go-v0", 0, 0), ("network-restless-v0", 13, 6), ("platoon-gusty-v0", -1, -1)]
)
def test_sparse_observability(scenario, k, s):
    """Seven sensors, six of position: any five may go. A speed alone does not observe a position. One of 14 random ones suffices."""
    model = load_scenario(scenario).brief().model
    assert set(sparsity(model).tolist()) == {k} and correctable(model) == s


def test_sparsity_agrees_with_the_rank_of_every_observability_matrix(linear_model):
    """On random models with zeros, the count per mode is what a search over all subsets finds."""
    for _ in range(30):
        A = np.diag(RNG.permutation([1.0, 1.0, 0.7])) if RNG.uniform() < 0.5 else np.diag([0.9, 0.6, 0.3])
        C = RNG.integers(-1, 2, size=(4, 3)).astype(float)
        model = linear_model(A, C, np.eye(3), np.eye(4))

        def seen(rows, A=A, C=C):
            O = np.concatenate([C[list(rows)] @ np.linalg.matrix_power(A, t) for t in range(3)]) if rows else np.zeros((1, 3))
            return np.linalg.matrix_rank(O, tol=1e-9) == 3

        every = [all(seen(rows) for rows in itertools.combinations(range(4), 4 - k)) for k in range(5)]
        assert int(sparsity(model)[0]) == (every.index(False) - 1 if False in every else 4)


@pytest.mark.parametrize("name", ["kf_bank", "observer_bank", "l1_decoder", "etpg", "etpl", "l0_robust"])
def test_two_sensors_admit_no_attacked_one(name):
    """NotApplicable, and it names the largest s."""
    with pytest.raises(NotApplicable, match="at most 0"):
        tailgate.make_defence(name, s=1).prepare(load_scenario("stop-and-go-v0").brief().model)
    with pytest.raises(NotApplicable, match="at most 2"):
        tailgate.make_defence(name, s=3).prepare(load_scenario("redundant-two-v0").brief().model)


def test_too_many_subsets_are_refused(linear_model):
    with pytest.raises(InputError, match="fewer subsets"):
        KalmanBank(s=8).prepare(_scalar(linear_model, 20))
    assert len(without(14, 2)) == 91 and (without(5, 2).sum(axis=1) == 3).all()


@pytest.mark.long
@pytest.mark.parametrize("text", ["kf_bank:s=0", "kf_bank:s=0,sliding=true", "observer_bank:s=0"])
def test_without_attacked_sensors_a_bank_is_the_steady_filter(text):
    """To the last bit, in the loop and under an attack."""
    place = load_scenario("redundant-two-v0")
    known, ours = (
        rollout(place.loop(Spec("defence", name).make()), tailgate.make_attack("fdi"), keys("train", range(4))) for name in ("kf:gain=steady", text)
    )
    for name in known.signals:
        if name not in ("score", "alarm"):
            np.testing.assert_array_equal(ours.signals[name], known.signals[name], err_msg=name)


def test_block_threshold():
    """10 steps of two sensors at alpha 1e-3: a mean of 4.5315 a step."""
    assert block_threshold(1e-3, 1, 10, 2) / 10 == pytest.approx(4.5315, abs=5e-5)
    assert block_threshold(1e-4, 21, 10, 5) == pytest.approx(stats.chi2.isf(1e-4 / 21, 50))


def test_the_bank_believes_the_pair_without_the_liar(linear_model):
    """Three sensors of a scalar, one 50 off: from the first block on the estimate is that of the other two."""
    model = _scalar(linear_model, 3)
    xs, ys = simulated(model, 40, 64, RNG)
    ys[..., 2] += 50.0
    _, out = play_readings(KalmanBank(s=1), model, ys)
    pair = model.C[:, :2], model.R[:, :2, :2]
    two = linear_model(model.A, pair[0][0], model.Q, pair[1][0])
    _, honest = play_readings(tailgate.make_defence("kf", gain="steady"), two, ys[..., :2])
    for k in range(9, 40):
        assert (out[k][0].chosen == 0).all() and not out[k][1].alarm.any()
        np.testing.assert_allclose(out[k][1].x, honest[k][1].x, atol=1e-12)
    liar = np.abs(play_readings(tailgate.make_defence("kf", gain="steady"), model, ys)[1][-1][1].x[:, 0, 0] - xs[-1, :, 0])
    assert liar.min() > 10.0  # the plain filter is dragged along


def test_an_unexplained_block_alarms_and_a_clean_one_seldom(linear_model):
    """All three sensors off by different amounts: no pair agrees. Clean blocks alarm with at most alpha."""
    model = _scalar(linear_model, 3)
    _, ys = simulated(model, 400, 200, RNG)
    _, clean = play_readings(KalmanBank(s=1, alpha=0.05), model, ys)
    share = np.mean([clean[k][1].alarm for k in range(9, 400, 10)])
    assert 0.0 < share <= 0.05
    _, out = play_readings(KalmanBank(s=1), model, ys + np.array([0.0, 50.0, -70.0]))
    assert all(out[k][1].alarm.all() for k in range(9, 12))


def test_the_first_choice_stays_while_it_passes(linear_model):
    model = _scalar(linear_model, 5)
    _, ys = simulated(model, 60, 32, RNG)
    chosen = np.array([state.chosen for state, _ in play_readings(KalmanBank(s=1, choice="first"), model, ys)[1]])
    assert (chosen == chosen[0]).all()
    least = np.array([state.chosen for state, _ in play_readings(KalmanBank(s=1), model, ys)[1]])
    assert (least[-1] != least[0]).any()


def test_block_residue_is_windowed_chi2_at_the_ends_of_blocks(linear_model):
    model = _scalar(linear_model, 2)
    block, window = BlockResidue(threshold=30.0), WindowedChiSquare(30.0, 10)
    plans = block.prepare(model), window.prepare(model)
    states, S = [block.start(plans[0], 8), window.start(plans[1], 8)], np.broadcast_to(np.eye(2), (8, 1, 2, 2))
    alarms = 0
    for k in range(60):
        r = RNG.normal(size=(8, 1, 2)) * 1.3
        states[0], ours = block.step(plans[0], states[0], Innovation(r, S))
        states[1], other = window.step(plans[1], states[1], Innovation(r, S))
        if k % 10 == 9:
            np.testing.assert_allclose(ours.score, other.score)
            np.testing.assert_array_equal(ours.alarm, other.alarm)
            alarms += ours.alarm.sum()
    assert alarms > 0


@pytest.mark.parametrize("index", [0, 1])
def test_the_most_that_a_quiet_block_moves_the_estimate(index):
    """The worst residues move it by `block_bound`, and stay quiet; one percent more alarms; random quiet ones move it less."""
    model = load_scenario("redundant-two-v0").brief().model
    defence = KalmanBank(s=2)
    plan = defence.prepare(model)
    rows = np.flatnonzero(plan.bank.keep[plan.first])
    C, R = model.C[0][rows], model.R[0][np.ix_(rows, rows)]
    steady = bounds.updated(plan.bank.before[0, plan.first], C, R)
    direction = np.eye(3)[index]
    most = bounds.block_bound(model.A, steady, plan.threshold, defence.block, direction)
    worst = bounds.block_residues(model.A, steady, plan.threshold, defence.block, direction)
    quiet = RNG.normal(size=(2000, *worst.shape)) @ np.linalg.cholesky(steady.S).T
    energy = np.einsum("bki,ij,bkj->b", quiet, np.linalg.inv(steady.S), quiet)
    quiet *= np.sqrt(plan.threshold / energy)[:, None, None]

    def moved(residues):
        x = np.zeros(3)
        for r in residues:
            x = model.A @ x + steady.K @ r
        return direction @ x

    assert moved(worst) == pytest.approx(most, rel=1e-9)
    assert max(abs(moved(r)) for r in quiet) < most
    state, x = _against(defence, model, plan, worst * (1 - 1e-9), rows)
    assert abs(direction @ x) == pytest.approx(most, rel=1e-6) and state.chosen[0, 0] == plan.first and not state.alarm.any()
    state, _ = _against(defence, model, plan, worst * 1.01, rows)
    assert state.alarm.all() or state.chosen[0, 0] != plan.first


def _against(defence, model, plan, residues, rows):
    """Play a block whose residues of the first filter are given; the sensors outside of its set are far off."""
    x, ys = np.zeros(3), []
    for r in residues:
        x = model.A @ x
        y = np.full(7, 1e4) * RNG.uniform(1, 2, size=7)
        y[rows] = model.C[0][rows] @ x + r
        x = x + plan.bank.gain[0, :, :, plan.first][:, rows] @ r
        ys.append(y)
    _, out = play_readings(defence, model, np.array(ys)[:, None])
    return out[-1][0], out[-1][0].x[0, 0, :, plan.first]


class _WorstBlock:
    """For one block of `kf_bank`, sends a filter the residues (N, q) that are given. The sensors that this one leaves out are far off."""

    knowledge = "white"

    def __init__(self, residues, begin):
        self.residues, self.begin, self.free = residues, begin, None  # its state without any residue

    def prepare(self, brief):
        return brief

    def start(self, brief, batch, draws):
        return None

    def decide(self, brief, state, view, draws):
        box, j, first = view.defence, int(view.k[0]) - self.begin, view.defence.plan.first
        bank, on = box.plan.bank, np.full(len(view.k), 0 <= j < len(self.residues))
        keep, value = bank.keep[first], np.zeros((len(on), 1, len(brief.model.wires)))
        if on.any():
            driven = box.known_u[:, 0] @ bank.B.T + bank.c
            x, before = box.state.x[:, 0, :, first] @ bank.A.T + driven, box.state.x[:, 0, :, first] if j == 0 else self.free
            self.free = before @ bank.A.T + driven
            y = np.where(keep, x @ bank.C[0].T + self.residues[j], 1e4 * (1.0 + np.arange(7)))
            value[:, 0, :7] = y - view.received.y[:, 0]
        target = np.broadcast_to(np.arange(value.shape[-1]) < 7, value.shape)
        return state, brief.command(on, Kind.FDI, target, value)


@pytest.mark.parametrize("index", [0, 1])
def test_a_played_attack_moves_the_believed_filter_by_the_bound_and_no_further(index):
    """On the road, on all sensors: worst residues are quiet, and move it by `block_bound`. One percent more is rejected."""
    place = load_scenario("redundant-two-v0")
    model, defence, direction = place.brief().model, KalmanBank(s=2), np.eye(3)[index]
    place = place.with_threat(targets=model.sensors, fdi_bound=1e6, knowledge="white", kinds=("fdi",), budget=None, onset=1)
    plan = defence.prepare(model)
    rows = np.flatnonzero(plan.bank.keep[plan.first])
    steady = bounds.updated(plan.bank.before[0, plan.first], model.C[0][rows], model.R[0][np.ix_(rows, rows)])
    most = bounds.block_bound(model.A, steady, plan.threshold, defence.block, direction)
    worst = np.zeros((defence.block, 7))
    worst[:, rows] = bounds.block_residues(model.A, steady, plan.threshold, defence.block, direction)
    for share, quiet in ((1.0 - 1e-9, True), (0.5, True), (1.01, False)):
        attack = _WorstBlock(share * worst, 51)
        trace = rollout(dataclasses.replace(place, horizon=60).loop(defence), attack, keys("train", range(3)))
        assert (trace.kind[50:60] == Kind.FDI).all() and (trace.alarm[59] != quiet).all()
        if quiet:
            moved = (trace.estimate[59, :, 0] - attack.free) @ direction
            np.testing.assert_allclose(np.abs(moved), share * most, rtol=1e-6)
            np.testing.assert_allclose(trace.score[59, :, 0], share * share * plan.threshold, rtol=1e-6)


def test_observers_of_a_static_scalar(linear_model):
    """(0, 0, 9) with one attacked sensor: J* = {1, 2}, pi = 0. (0, .2, .1, 9, 9.1) with two: J* = {1, 2, 3}, x = .1, pi = .1."""
    for y, s, x, pi, kept in (((0.0, 0.0, 9.0), 1, 0.0, 0.0, (0, 1)), ((0.0, 0.2, 0.1, 9.0, 9.1), 2, 0.1, 0.1, (0, 1, 2))):
        model = _scalar(linear_model, len(y))
        defence = ObserverBank(s=s, kind="gramian", window=1)
        plan, out = play_readings(defence, model, np.array(y)[None, None])
        assert out[-1][1].x[0, 0, 0] == pytest.approx(x)
        J = [np.flatnonzero(some).tolist() for some in without(len(y), s)].index(list(kept))
        best = np.mean(np.array(y)[list(kept)])
        S = [np.mean(np.array(y)[list(rows)]) for rows in itertools.combinations(kept, len(y) - 2 * s)]
        assert max(abs(best - one) for one in S) == pytest.approx(pi)
        assert out[-1][1].score[0, 0] == pytest.approx(np.max(np.abs(best - np.array(S)) / plan.spread[0, J]), abs=1e-12)


@pytest.mark.parametrize("kind", ["observer", "gramian"])
def test_an_observer_bank_forgets_how_large_an_attack_is(linear_model, kind):
    """Beyond 100 standard deviations the estimates do not depend on it."""
    model = dense(linear_model, RNG, Q=0.01, R=0.01)
    _, ys = simulated(model, 30, 16, RNG)
    defence = ObserverBank(s=2, kind=kind)
    results = []
    for size in (100.0, 1e4, 1e6):
        attacked = ys.copy()
        attacked[10:, :, [1, 4]] += size * np.array([1.0, -0.7])
        _, out = play_readings(defence, model, attacked)
        results.append(np.array([estimate.x[:, 0] for _, estimate in out[10:]]))
    np.testing.assert_allclose(results[1], results[0], atol=1e-9)
    np.testing.assert_allclose(results[2], results[0], atol=1e-6)


@pytest.mark.long
def test_the_spread_of_two_filters_is_the_difference_of_their_covariances(linear_model):
    """cov(x_J - x_S) = P_S - P_J, on 2000 matched runs."""
    model = dense(linear_model, RNG, n=2, q=4, Q=0.1)
    _, ys = simulated(model, 600, 2000, RNG)
    plan, out = play_readings(ObserverBank(s=1), model, ys)
    state = out[-1][0]
    off = state.most[:, 0, :, :, None] - state.fewer[:, 0][:, :, plan.inside]
    np.testing.assert_allclose(np.sqrt((off**2).sum(axis=1).mean(axis=0)), plan.spread[0], rtol=0.06)


def test_minimax_of_three_is_the_median_and_of_two_the_prior(linear_model):
    """m = 3, l = 1: the gain times the median. m = 2, l = 1: nothing that is measured counts."""
    model = _scalar(linear_model, 3)
    for y in RNG.normal(size=(20, 3)) * 5.0:
        plan, out = play_readings(Minimax(attacked=1), model, y[None, None])
        assert out[0][1].x[0, 0, 0] == pytest.approx(plan.filter_plan.bank.gain[0, 0, 0, 0] * np.median(y), abs=1e-12)
    two = _scalar(linear_model, 2)
    _, out = play_readings(Minimax(attacked=1), two, RNG.normal(size=(20, 3, 2)) * 100.0, mean=np.full((3, 1, 1), 4.0))
    assert all((estimate.x == 4.0).all() for _, estimate in out)


def test_minimax_of_equal_sensors_is_the_trimmed_mean(linear_model):
    model = _scalar(linear_model, 7)
    for y in RNG.normal(size=(20, 7)) * 5.0:
        plan, out = play_readings(Minimax(attacked=2), model, y[None, None])
        gain = plan.filter_plan.bank.gain[0, 0].sum(axis=0)[0]
        assert out[0][1].x[0, 0, 0] == pytest.approx(gain * np.mean(np.sort(y)[2:-2]), abs=1e-12)


def test_an_attack_cannot_pull_minimax_beyond_the_honest_readings(linear_model):
    """To infinity: the estimate moves by no more than the gap of the honest readings."""
    model = _scalar(linear_model, 3)
    honest = np.array([0.3, 1.1])
    out = [play_readings(Minimax(), model, np.array([*honest, wrong])[None, None])[1][0][1].x[0, 0, 0] for wrong in (-1e12, 0.5, 1e12)]
    assert out[0] < out[1] < out[2] and out[2] - out[0] <= honest[1] - honest[0]


def _listener(defence, ys):
    """Estimates (K, B) of an agent without a sensor that hears seven agents, who have one of the readings ys (K, B, 7) each."""
    graph = np.eye(8, dtype=bool)
    graph[7] = True
    C = np.array([1.0] * 7 + [0.0])[:, None, None]
    model = Model(np.eye(1), np.zeros((1, 1)), np.zeros(1), C, np.eye(1), np.ones((8, 1, 1)), graph, 1.0, ("y",))
    plan, batch, out = defence.prepare(model), ys.shape[1], []
    state = defence.start(plan, Prior(np.zeros((batch, 8, 1)), np.ones((batch, 8, 1, 1))))
    for k, row in enumerate(ys):
        y = np.concatenate([row, np.zeros((batch, 1))], axis=1)[..., None]
        draws = keys("train", range(batch)).at(Role.DEFENCE, np.full(batch, k))
        received = Received(y, np.ones(y.shape, bool), np.zeros((batch, 8)))
        state, estimate = defence.step(plan, state, received, np.zeros((batch, 8, 1)), draws)
        out.append(estimate.x[:, 7, 0])
    return np.array(out)


def test_the_worst_case_of_minimax_is_below_those_of_means(linear_model):
    """Mean squared error under the worst of many replacements of two readings of seven: without trimming, consensus has no bound.

    `trimmed_consensus:faulty=0` plays the car with seven sensors, where it is the plain filter, and a listener to seven cars with one each.
    """
    model, means = _scalar(linear_model, 7, Q=1.0), tailgate.make_defence("trimmed_consensus", faulty=0)
    xs, ys = simulated(model, 30, 200, RNG)
    plays = {"minimax": Minimax(attacked=2), "kf": tailgate.make_defence("kf", gain="steady"), "means": means}
    worst = dict.fromkeys([*plays, "listener"], 0.0)
    for size in (-1e3, -5.0, -2.0, 2.0, 5.0, 1e3):
        attacked = ys.copy()
        attacked[..., :2] = xs + size
        found = {name: np.array([e.x[:, 0, 0] for _, e in play_readings(defence, model, attacked)[1]]) for name, defence in plays.items()}
        for name, x in (found | {"listener": _listener(means, attacked)}).items():
            worst[name] = max(worst[name], np.mean((x[5:] - xs[5:, :, 0]) ** 2))
    assert worst["means"] == pytest.approx(worst["kf"]) and worst["minimax"] < 2.0 < 1e4 < min(worst["means"], worst["listener"])
