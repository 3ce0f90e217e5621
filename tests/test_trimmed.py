"""Trimmed consensus: modes, who knows them, what is learned of neighbours and what is left out."""

import dataclasses

import numpy as np
import pytest

from tailgate.base.errors import NotApplicable
from tailgate.core import Prior
from tailgate.envs.plants.sensor_network import NoControl, SensorNetwork
from tailgate.estimators import TrimmedFilter
from tailgate.estimators.distributed.trimmed import clusters, detects, lessons, split, trimmed_mean
from tailgate.estimators.filters.kalman import steady_state

from .distributed import RNG, error, model_of, place_of, play


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


@pytest.mark.long
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
