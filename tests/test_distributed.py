"""The distributed Kalman filter: its fixed point, its limits, its convergence, and plain numpy implementations of the same equations."""

import dataclasses

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.core import Prior, Received
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.envs.controllers.cacc import no_gains
from tailgate.envs.plants.platoon import Platoon, closed_loop
from tailgate.envs.plants.sampled import zero_order_hold
from tailgate.envs.plants.sensor_network import LinearSensors, NoControl, SensorNetwork
from tailgate.estimators import DistributedKalman, DistributedKalmanFilter, Kalman
from tailgate.estimators.distributed.distributed_kalman import fixed_point, neighbours
from tailgate.play.trace import rollout

RNG = np.random.default_rng(11)
MODAL = {"system": "modal", "graph": "ring"}


def network(seen=None, sensors=3, sensor_seed=0, **plant):
    """The model of a network; with `seen`, each agent sees so many modes of a modal system only."""
    pattern = {} if seen is None else {"pattern": "modes", "modes_seen": seen}
    return SensorNetwork(**plant).model(LinearSensors(sensors=sensors, sensor_seed=sensor_seed, **pattern), NoControl())


MODELS = {
    "thesis network": lambda: load_scenario("thesis-ch5-v0").brief().model,
    "thesis platoon": lambda: load_scenario("thesis-ch6-v0").brief().model,
    "braking platoon": lambda: load_scenario("platoon-braking-v0").brief().model,
    "weak sensing": lambda: network(1, 2, agents=5, states=10, **MODAL),
    "growing": lambda: network(sensors=2, agents=4, states=5, graph="path", spectral_radius=1.3),
    "dying": lambda: network(sensors=1, agents=3, states=4, graph="star", spectral_radius=0.6, directed=True),
}


@pytest.fixture(scope="module", params=MODELS)
def model(request):
    return MODELS[request.param]()


def information(model):
    """(5.5): C_i' Sv_i^-1 C_i, and the weights of N(i), by numpy."""
    near = np.array(model.graph) | np.eye(model.agents, dtype=bool)
    return np.swapaxes(model.C, 1, 2) @ np.linalg.inv(model.R) @ model.C, near / near.sum(axis=1, keepdims=True)


def once(model, P, G, W):
    """One round of (5.5), by numpy."""
    L = np.linalg.inv(model.A @ P @ model.A.T + model.Q)
    return np.linalg.inv(np.einsum("ij,jab->iab", W, L) + G)


def scaled(difference, P):
    """The largest element, in units of its row's and column's standard deviation."""
    size = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    return np.max(np.abs(difference) / (size[:, :, None] * size[:, None, :]))


def test_the_fixed_point_solves_its_equation(model):
    """P_i leaves (5.5) with a relative residual under 1e-12, and is symmetric positive definite."""
    P = fixed_point(model).P
    assert scaled(once(model, P, *information(model)) - P, P) < 1e-12
    np.testing.assert_array_equal(P, np.swapaxes(P, 1, 2))
    assert np.linalg.eigvalsh(P).min() > 0.0


@pytest.mark.parametrize("size", [0.0, 1e6])
def test_the_recursion_itself_comes_to_the_same_limit(model, size):
    """(5.5) iterated from P = 0 and from P = 1e6 I ends at the fixed point (Theorem 5.3.1)."""
    G, W = information(model)
    P = np.repeat(size * np.eye(model.states)[None], model.agents, axis=0)
    wanted = fixed_point(model).P
    for _ in range(3000):
        after = once(model, P, G, W)
        done = scaled(after - P, wanted) < 1e-12
        P = after
        if done:
            break
    assert scaled(P - wanted, wanted) < 1e-8


def test_the_weights_add_up_to_one(model):
    """sum_j W_ij = I with W_ij = Q_i^-1 L_j / d_i: a state on which all agree is left as it is."""
    found, near = fixed_point(model), neighbours(model.graph)
    for i, js in enumerate(near):
        total = sum(found.Qinv[i] @ found.L[j] / len(js) for j in js)
        np.testing.assert_allclose(total, np.eye(model.states), atol=1e-8)
    f = DistributedKalmanFilter(True)
    plan, x = f.prepare(model), RNG.normal(size=(2, 1, model.states))
    same = f.fuse(plan, np.repeat(x, model.agents, axis=1), plan.M[None]).x
    np.testing.assert_allclose(same, np.broadcast_to(x, same.shape), atol=1e-7)


@pytest.mark.thin(3)
@pytest.mark.parametrize("gain", ["steady", "varying"])
@pytest.mark.parametrize("attack", ["none", "dropout", "fdi"])
def test_one_agent_alone_is_a_kalman_filter(gain, attack, short, play):
    """Without neighbours the distributed filter gives the estimates of the Kalman filter of kalman.py."""
    one, two = (play(short("stop-and-go-v0"), made, attack, range(4)) for made in (DistributedKalman(gain=gain), Kalman(gain=gain)))
    np.testing.assert_allclose(one.estimate, two.estimate, atol=1e-8)
    np.testing.assert_allclose(one.score, two.score, rtol=1e-6, atol=1e-8)


def play_filter(model, steady, steps, rows, u=None, loss=0.3):
    """Estimates (K, B, N, n) of the filter on random readings of which some are lost, and what it was given."""
    defence = DistributedKalman(gain="steady" if steady else "varying")
    plan = defence.prepare(model)
    shape = (rows, model.agents, model.states)
    prior = Prior(RNG.normal(size=shape), np.broadcast_to(np.eye(model.states) * 2.0, (*shape, model.states)))
    state, told, out = defence.start(plan, prior), [], []
    draws = keys("train", range(rows)).at(32, np.zeros(rows, np.int64))
    for _ in range(steps):
        y = 3.0 * RNG.normal(size=(rows, *model.C.shape[:2]))
        valid = RNG.uniform(size=y.shape) > loss
        known = RNG.normal(size=(rows, model.agents, model.inputs))
        state, estimate = defence.step(plan, state, Received(y, valid, np.zeros(y.shape[:2])), known, draws)
        told.append((y, valid, known))
        out.append(estimate.x)
    return prior, told, np.array(out), state


def plain(model, prior, told, b, steady):
    """(6.19)-(6.21) and (5.5), (5.7) in plain numpy for one row, with the lost readings taken out of C and Sv."""
    A, near = np.array(model.A), neighbours(model.graph)
    x, P, held = prior.mean[b].copy(), prior.cov[b].copy(), fixed_point(model).P
    out = []
    for y, valid, known in told:
        L = np.linalg.inv(A @ (held if steady else P) @ A.T + model.Q)
        sent = x @ A.T + known[b] @ np.array(model.B).T + model.c
        x, P = np.empty_like(x), np.empty_like(P)
        for i, js in enumerate(near):
            Q = sum(L[j] for j in js) / len(js)
            some = np.flatnonzero(valid[b, i])
            C, R = model.C[i][some], model.R[i][np.ix_(some, some)]
            fused = np.linalg.solve(Q, sum(L[j] @ sent[j] for j in js) / len(js))
            information = Q + C.T @ np.linalg.solve(R, C)
            x[i] = np.linalg.solve(information, Q @ fused + C.T @ np.linalg.solve(R, y[b, i][some]))
            P[i] = np.linalg.inv(information)
        out.append(x.copy())
    return np.array(out), P


@pytest.mark.thin(3)
@pytest.mark.parametrize("steady", [True, False])
def test_it_equals_a_plain_implementation(model, steady):
    """The filter, with lost readings and known inputs, gives what the information form of the same equations gives."""
    prior, told, got, state = play_filter(model, steady, 12, 3)
    for b in range(3):
        want, P = plain(model, prior, told, b, steady)
        np.testing.assert_allclose(got[:, b], want, rtol=1e-6, atol=1e-6 * np.abs(want).max())
        if not steady:
            np.testing.assert_allclose(state.filter.P[b], P, rtol=1e-6, atol=1e-6 * np.abs(P).max())


@pytest.mark.thin(6)
def test_the_varying_gain_settles_at_the_steady_one(model):
    """With all readings, predicted covariances and gains of the time-varying filter come to those of the steady filter."""
    _, _, _, state = play_filter(model, False, 600 if model.dt < 1.0 else 60, 1, loss=-1.0)
    f, found = DistributedKalmanFilter(False), fixed_point(model)
    assert scaled(state.filter.P[0] - found.P, found.P) < 1e-6
    plan = f.prepare(model)
    predicted = f.predict(plan, state.filter, np.zeros((1, model.agents, model.inputs)))
    innovation = f.innovation(plan, predicted, Received(np.zeros((1, *model.C.shape[:2])), np.ones((1, *model.C.shape[:2]), bool), None))
    K = DistributedKalmanFilter(True).prepare(model).K
    np.testing.assert_allclose(f.gain(plan, predicted, innovation)[0], K, rtol=1e-5, atol=1e-6 * np.abs(K).max())


def test_a_covariance_shared_by_all_rows_changes_no_bit(model, same_bits):
    """A row whose companions start from the same prior covariance has the bits that it has beside others."""
    f = DistributedKalmanFilter(False)
    plan, shape = f.prepare(model), (3, model.agents, model.states)
    mean, eye = RNG.normal(size=shape), np.eye(model.states)
    same = np.broadcast_to(eye, (*shape, model.states)).copy()
    other = same.copy()
    other[1:] *= 1.7
    states = [f.start(plan, Prior(mean, cov)) for cov in (same, other)]
    received = Received(RNG.normal(size=(3, *model.C.shape[:2])), np.ones((3, *model.C.shape[:2]), bool), None)
    for lost in (False, True, False):
        received.valid[0, 0, 0] = not lost
        states = [f.predict(plan, s, np.zeros((3, model.agents, model.inputs))) for s in states]
        states = [f.update(plan, s, f.innovation(plan, s, received), received.valid) for s in states]
        assert same_bits(states[0].x[0], states[1].x[0]) and same_bits(states[0].P[0], states[1].P[0])
    assert not same_bits(states[0].x[1], states[1].x[1])


def errors(place, defence, seeds=4, attack="none"):
    """(K, B, N) 2-norm of the errors, and the trace."""
    trace = rollout(place.loop(defence), tailgate.make_attack(attack), keys("train", range(seeds)))
    return np.linalg.norm(trace.estimate - trace.truth, axis=-1), trace


def with_plant(place, sensor=None, horizon=60, **plant):
    """The scenario with another plant and sensor."""
    changed = dataclasses.replace(place, plant=dataclasses.replace(place.plant, **plant), horizon=horizon)
    changed = dataclasses.replace(changed, sensor=dataclasses.replace(place.sensor, **(sensor or {})))
    return changed.with_threat(agents=())


@pytest.mark.thin(4)
@pytest.mark.parametrize("seed", range(5))
def test_without_noise_the_errors_vanish(seed):
    """Theorem 5.3.2 on random systems and graphs; on the way max_i e_i' P_i^-1 e_i never grows (5.12)."""
    agents = 3 + seed
    place = with_plant(
        load_scenario("thesis-ch5-v0"), {"sensors": 2 + seed, "sensor_seed": seed + 3}, 150, system_seed=seed, agents=agents,
        states=4 + 2 * seed, graph="random", directed=seed % 2 == 1, spectral_radius=(0.9, 1.0, 1.05, 1.1, 1.2)[seed],
    )  # fmt: skip
    size, trace = errors(place, DistributedKalman())
    relative = size / np.linalg.norm(trace.truth, axis=-1)
    assert relative[0].max() > 0.05 and relative[-1].max() < 1e-6
    e, weight = trace.estimate - trace.truth, np.linalg.inv(fixed_point(trace.model).P)
    V = np.einsum("kbna,nac,kbnc->kbn", e, weight, e).max(axis=2)
    big = relative.max(axis=2) > 1e-9  # above the rounding
    assert (V[1:][big[1:]] <= V[:-1][big[1:]] * (1.0 + 1e-9)).all()


@pytest.mark.long
def test_agents_that_see_one_mode_each_know_all_of_them():
    """Weak sensing: (A, C_i) is observable for nobody, yet everybody converges; a Kalman filter of its own does not."""
    place = with_plant(
        load_scenario("thesis-ch5-v0"), {"pattern": "modes", "modes_seen": 1, "sensors": 2}, 200, system="modal", graph="ring", agents=6, states=12
    )
    size, trace = errors(place, DistributedKalman())
    model = trace.model
    for C in model.C:
        powers = [C @ np.linalg.matrix_power(model.A, k) for k in range(model.states)]
        assert np.linalg.matrix_rank(np.concatenate(powers), tol=1e-9) == 2
    assert (size[-1] < 1e-4 * size[0]).all()
    own, _ = errors(place, Kalman())
    assert (own[-1] > 0.5 * np.sqrt(10 / 12) * own[0].min()).all()


def blind_by_hand(model):
    """The agents whose own sensors and those of who reaches them miss an eigenvector that lasts (Popov, Belevitch, Hautus)."""
    heard = np.linalg.matrix_power((np.array(model.graph) | np.eye(model.agents, dtype=bool)).astype(float), model.agents) > 0
    values, vectors = np.linalg.eig(model.A)
    last = vectors[:, np.abs(values) > 1.0 - 1e-6]
    return [i for i in range(model.agents) if (np.abs(model.C[heard[i]].reshape(-1, model.states) @ last).max(axis=0) < 1e-9).any()]


@pytest.mark.long
@pytest.mark.parametrize("gain", ["steady", "varying"])
@pytest.mark.parametrize("directed", [False, True])
def test_who_cannot_know_the_state_is_named(gain, directed):
    """With a sensor missing from everybody who reaches agent i, the model is refused, naming exactly these agents."""
    rng, named = np.random.default_rng(3), set()
    base = network(1, 2, agents=6, states=6, graph="complete", system="modal")
    for _ in range(18):
        graph = np.eye(6, dtype=bool)
        for _ in range(int(rng.integers(3, 16))):
            i, j = rng.choice(6, 2, replace=False)
            graph[i, j] = True
            graph[j, i] |= not directed
        model = dataclasses.replace(base, graph=graph, C=base.C * (rng.uniform(size=(6, 1, 1)) < 0.8))
        wanted = ", ".join(map(str, blind_by_hand(model)))
        named.add(wanted)
        if wanted:
            with pytest.raises(InputError) as caught:
                DistributedKalman(gain=gain).prepare(model)
            assert caught.value.value == wanted and "undetectable for agents" in str(caught.value)
        else:
            DistributedKalman(gain=gain).prepare(model)
    assert "" in named and len(named) > 4


def test_a_chain_is_blind_upstream_only():
    """Who hears nobody knows what it sees itself: in the chain 0 -> 1 -> 2 of agents with a mode each, 0 and 1 are named."""
    chain = {"agents": 3, "states": 6, "system": "modal", "edges": ((0, 1), (1, 2)), "directed": True}
    with pytest.raises(InputError, match="'0, 1'"):
        network(1, 2, **chain)
    network(1, 2, **chain | {"directed": False})


@pytest.mark.parametrize("name", ["thesis-ch6-v0", "platoon-braking-v0"])
def test_the_open_loop_platoon_as_printed_is_refused(name):
    """Without the feedback every gap is an integrator that only those behind can know: all but the last car are named."""
    model = load_scenario(name).brief().model
    A, B, _ = closed_loop(no_gains(model.agents, 3.0), 1.008)
    A, _ = zero_order_hold(A, B[:, None], model.dt)
    with pytest.raises(InputError, match="'0, 1, 2, 3'"):
        DistributedKalman().prepare(dataclasses.replace(model, A=A))
    DistributedKalman().prepare(model)


@pytest.mark.parametrize("gain", ["steady", "varying"])
def test_the_leaders_input_is_used_where_it_is_known(gain):
    """From the true state and without noise, cars that are told the leader's command make no error; those that are not, do."""
    place = load_scenario("thesis-ch6-v0")
    for known in (True, False):
        changed = dataclasses.replace(place, plant=dataclasses.replace(place.plant, initial_sd=0.0, leader_input_known=known))
        size, _ = errors(changed, DistributedKalman(gain=gain))
        before = np.arange(1, 51) * place.plant.dt < 18.0
        assert size[before].max() < 1e-9
        assert (size.max() < 1e-9) == known
        assert known or size[~before][:, :, 1:].max() > 0.05


def test_a_gate_uses_the_readings_that_are_left(model):
    """An update with some sensors refused is the solution without these rows, whether they were lost or refused; with none it is xb."""
    for steady in (True, False):
        f = DistributedKalmanFilter(steady)
        plan, shape = f.prepare(model), (4, model.agents, model.states)
        prior = Prior(RNG.normal(size=shape), np.broadcast_to(np.eye(model.states), (*shape, model.states)))
        state = f.predict(plan, f.start(plan, prior), np.zeros((4, model.agents, model.inputs)))
        y = RNG.normal(size=(4, *model.C.shape[:2]))
        accept = RNG.uniform(size=y.shape) < 0.5
        accept[0], accept[1, 0] = False, True
        heard = Received(y, np.ones_like(accept), None)
        refused = f.update(plan, state, f.innovation(plan, state, heard), accept).x
        lost = f.update(plan, state, f.innovation(plan, state, heard._replace(valid=accept)), accept).x
        np.testing.assert_array_equal(refused, lost)
        np.testing.assert_array_equal(refused[0], state.x[0])
        V = plan.held if steady else state.P[1]
        for i in range(model.agents):
            some = np.flatnonzero(accept[1, i])
            C, R = model.C[i][some], model.R[i][np.ix_(some, some)]
            K = V[i] @ C.T @ np.linalg.inv(C @ V[i] @ C.T + R)
            want = state.x[1, i] + K @ (y[1, i][some] - C @ state.x[1, i])
            np.testing.assert_allclose(refused[1, i], want, rtol=1e-6, atol=1e-7 * np.abs(want).max())


@dataclasses.dataclass(frozen=True)
class Halting(Platoon):
    """The platoon whose leader knows the input that would have moved a lag as the car moved, its halt included."""

    def step(self, plan, state, u, exo, draws):
        after, keep = super().step(plan, state, u, exo, draws), plan.A[2, 2]
        inputs = after.u.copy()
        inputs[:, 0] = (after.a[:, 0] - keep * state.a[:, 0]) / (1.0 - keep)
        return after._replace(u=inputs)

    def known(self, plan, u, exo, state):
        out = np.zeros(u.shape)
        out[:, 0, 0] = state.u[:, 0]
        return out


@pytest.mark.long
@pytest.mark.parametrize(("name", "command", "fits"), [("lasso_dkf", 4.73, 0.18), ("norm_resilient", 5.27, 0.15), ("chi2_dkf:gain=steady", 21.8, 0.25)])
def test_the_clean_error_of_the_braking_platoon_is_its_leaders_halt(name, command, fits):
    """A lag under -4 m/s^2 and then 0 rolls backwards; no filter that bounds its corrections is slow where the input fits."""
    place, worst = load_scenario("platoon-braking-v0"), []
    halting = Halting(**{f.name: getattr(place.plant, f.name) for f in dataclasses.fields(place.plant)})
    for plant in (place.plant, halting):
        guard = Spec("defence", name)
        trace = rollout(dataclasses.replace(place, plant=plant).loop(guard.make()), tailgate.make_attack("none"), keys("report", range(6)))
        error = np.where(trace.live[..., None], trace.model.error(trace.estimate, trace.truth), 0.0)[place.threat_model.onset - 1 :]
        worst.append(np.median(error.max(axis=(0, 2))))
        own = np.where(trace.live, trace.estimate[:, :, 0, 1] - trace.truth[:, :, 0, 1], 0.0).min(axis=0)
        assert (np.median(own) < -1.0) == (plant is place.plant)
    assert worst == [pytest.approx(command, rel=0.1), pytest.approx(fits, rel=0.25)]
