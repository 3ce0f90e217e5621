"""Networks: their random systems and graphs, what each agent sees, who can know the whole state, and who is refused."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

import tailgate
from tailgate import cli
from tailgate.base.errors import InputError
from tailgate.base.plots import write_overview
from tailgate.core import Model
from tailgate.core.draws import keys
from tailgate.core.reach import blind, lasting, reach
from tailgate.core.registry import make
from tailgate.core.scenario import Scenario, list_scenarios, load_scenario
from tailgate.core.threat import ThreatModel
from tailgate.envs import LinearSensors, SensorNetwork
from tailgate.evaluation.attack_free import Bench, count_onsets, most_at_once
from tailgate.evaluation.rows import read_rows
from tailgate.evaluation.summary import summarise
from tailgate.play.metrics import measure
from tailgate.play.trace import WORTH, rollout, worth_tracing

NETWORKS = [name for name in list_scenarios() if isinstance(load_scenario(name).plant, SensorNetwork) and load_scenario(name).plant.agents > 1]
NONE, STILL = make("controller", "none"), make("manoeuvre", "constant", value=0.0)


def network(plant, sensor=None, horizon=60):
    """A scenario around a plant and sensors."""
    return Scenario("mine", SensorNetwork(**plant), LinearSensors(**(sensor or {})), NONE, STILL, horizon, ThreatModel())


def model(plant, sensor=None):
    return network(plant, sensor).brief().model


def alone(held):
    """The agents that their own sensors do not tell the whole state."""
    return blind(held, np.eye(held.agents, dtype=bool))


def edges(graph):
    """The pairs (j, i), i hearing j, of a graph (N, N)."""
    return {(int(j), int(i)) for i, j in zip(*np.nonzero(graph), strict=True) if i != j}


def both(pairs):
    pairs = list(pairs)
    return {*pairs, *((i, j) for j, i in pairs)}


@pytest.mark.parametrize("system", ["gaussian", "modal"])
@pytest.mark.parametrize("states, radius", [(1, 1.0), (2, 0.5), (5, 1.0), (20, 1.0), (20, 0.9), (33, 1.3)])
def test_the_spectral_radius_is_the_stated_one(system, states, radius):
    """The largest |eigenvalue|, by numpy, is `spectral_radius`."""
    A = SensorNetwork(states=states, system=system, spectral_radius=radius).matrix()
    assert np.max(np.abs(np.linalg.eigvals(A))) == pytest.approx(radius, rel=1e-9)


@pytest.mark.parametrize("states", [1, 2, 7, 20])
def test_the_modes_of_a_modal_system_last_equally_long_and_turn_by_different_angles(states):
    """A / radius is orthogonal; its pairs of eigenvalues lie apart on the unit circle, and one alone is 1."""
    A = SensorNetwork(states=states, system="modal", spectral_radius=0.8).matrix() / 0.8
    np.testing.assert_allclose(A @ A.T, np.eye(states), atol=1e-13)
    angles = np.sort(np.abs(np.angle(np.linalg.eigvals(A))))
    pairs = states // 2
    want = np.sort([0.9 * np.pi * (p + 1) / pairs for p in range(pairs) for _ in "ab"] + [0.0] * (states % 2))
    np.testing.assert_allclose(angles, want, atol=1e-7)


def test_random_constants_can_be_drawn_again():
    """The same seeds give the same matrices and graph, other seeds others; agents see different things."""
    one, again = (model({"graph": "random", "system_seed": 3}, {"sensor_seed": 4}) for _ in "ab")
    other = model({"graph": "random", "system_seed": 5}, {"sensor_seed": 6})
    for name in ("A", "C", "graph"):
        np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
        assert not np.array_equal(getattr(one, name), getattr(other, name)), name
    assert len({C.tobytes() for C in one.C}) == 10
    raw = model({}, {}).C.ravel()
    assert abs(raw.mean()) < 5 / np.sqrt(raw.size) and abs(raw.std() - 1.0) < 5 / np.sqrt(2 * raw.size)


def test_the_thesis_network():
    """Figure 5.1: eleven edges that the text gives and 4-9, counted from 1; everybody hears itself; 10 agents, 20 states, 14 sensors."""
    held = load_scenario("thesis-ch5-v0").brief().model
    text = [(1, 3), (1, 4), (1, 8), (2, 9), (3, 8), (5, 6), (5, 7), (6, 8), (7, 8), (8, 10), (9, 10), (4, 9)]
    assert edges(held.graph) == both((i - 1, j - 1) for i, j in text) and held.graph.diagonal().all()
    assert (held.agents, held.states, len(held.sensors)) == (10, 20, 14)
    np.testing.assert_array_equal(held.Q, np.eye(20))
    np.testing.assert_array_equal(held.R, [np.eye(14)] * 10)


@pytest.mark.parametrize(
    "name, want",
    [
        ("path", pairwise(range(6))), ("ring", [*pairwise(range(6)), (5, 0)]), ("star", [(0, i) for i in range(1, 6)]),
        ("complete", [(j, i) for j in range(6) for i in range(j + 1, 6)]),
    ],
)  # fmt: skip
def test_graphs_by_name(name, want):
    """path, ring, star (agent 0 in the middle) and complete have their edges; `directed` lets the second of each pair hear the first."""
    pairs = set(want)
    assert edges(SensorNetwork(agents=6, graph=name).hears()) == both(pairs)
    one_way = edges(SensorNetwork(agents=6, graph=name, directed=True).hears())
    assert one_way == (both(pairs) if name == "complete" else pairs)


@pytest.mark.parametrize("directed", [False, True])
def test_a_random_graph_connects_all(directed):
    """Between a tree (probability 0) and the complete graph (1); what agent 0 knows comes to everybody, and undirected to and from all."""
    for seed in range(20):
        for share in (0.0, 0.2, 1.0):
            graph = SensorNetwork(agents=9, graph="random", edge_probability=share, system_seed=seed, directed=directed).hears()
            known = reach(graph)
            assert known[:, 0].all() and (directed or known.all())
            count = len(edges(graph)) // (1 if directed else 2)
            assert count == {0.0: 8, 1.0: 72 if directed else 36}.get(share, count) and count >= 8
    counts = [len(edges(SensorNetwork(agents=30, graph="random", edge_probability=0.3, system_seed=s).hears())) / 2 for s in range(40)]
    assert abs(np.mean(counts) - (29 + 0.3 * (435 - 29))) < 5 * np.sqrt(0.21 * 435 / 40)


def test_own_edges():
    """A list of pairs stands in for the named graph, one way or both."""
    pairs = ((0, 2), (2, 3))
    assert edges(SensorNetwork(agents=4, edges=pairs).hears()) == both(pairs)
    assert edges(SensorNetwork(agents=4, edges=pairs, directed=True).hears()) == set(pairs)
    assert edges(SensorNetwork(agents=4, edges=()).hears()) == set()


@pytest.mark.parametrize(
    "params, message",
    [
        ({"agents": 3, "edges": [[0, 3]]}, r"edges: got \(0, 3\); expected two different agents, from 0 to 2"),
        ({"agents": 3, "edges": [[1, 1]]}, r"edges: got \(1, 1\)"), ({"edges": [[0, -1]]}, r"edges\.0\.1: got -1"),
        ({"edges": [[0, 1, 2]]}, r"edges\.0"), ({"edges": [[0, 1.5]]}, r"edges\.0\.1: got 1\.5"),
        ({"agents": 7}, r"graph: got 'thesis'; expected another graph: the thesis's has 10 agents, not 7"),
        ({"graph": "tree"}, r"graph: got 'tree'.*'ring'"), ({"agents": 0}, r"agents: got 0"), ({"spectral_radius": -1.0}, r"spectral_radius: got -1"),
        ({"spectral_radius": float("nan")}, r"spectral_radius"), ({"edge_probability": 1.5}, r"edge_probability: got 1\.5"),
    ],
)  # fmt: skip
def test_networks_that_do_not_exist_are_input_errors(params, message):
    """A wrong edge, graph or number names its field."""
    with pytest.raises(InputError, match=rf"plant sensor_network\.{message}"):
        make("plant", "sensor_network", **params).hears()


@pytest.mark.parametrize(
    "sensor, plant, message",
    [
        ({"pattern": "modes"}, {}, r"linear_sensors\.pattern: got 'modes'; expected the plant's system to be modal"),
        ({"pattern": "modes", "modes_seen": 4}, {"system": "modal", "states": 6}, r"modes_seen: got 4; expected at most the 3 modes of 6 states"),
    ],
)  # fmt: skip
def test_sensors_that_do_not_fit_are_input_errors(sensor, plant, message):
    """Modes need a modal system with that many."""
    with pytest.raises(InputError, match=message):
        model(plant, sensor)


def test_parts_of_other_worlds_are_refused():
    """A platoon has no linear sensors, a network no radar, and what is driven needs a controller."""
    platoon, here = load_scenario("platoon-braking-v0"), network({})
    with pytest.raises(InputError, match="linear_sensors: got 'Platoon'; expected the plant sensor_network"):
        platoon.plant.model(here.sensor, platoon.controller)
    with pytest.raises(InputError, match="platoon_sensors: got 'SensorNetwork'"):
        here.plant.model(platoon.sensor, NONE)
    with pytest.raises(InputError, match="controller none"):
        NONE.prepare(platoon.brief().model)
    with pytest.raises(InputError, match="expected a platoon"):
        platoon.controller.prepare(here.brief().model)


@pytest.mark.thin(3)
@pytest.mark.parametrize("agents, states, sensors", [(1, 1, 1), (1, 4, 2), (3, 1, 2), (2, 3, 1), (10, 20, 14), (12, 7, 9)])
def test_networks_of_any_size_run(agents, states, sensors):
    """From one agent with one state to more readings than states: finite, in the declared shapes, and nearer than the prior."""
    place = network({"agents": agents, "states": states, "graph": "complete"}, {"sensors": sensors}, horizon=30)
    trace = rollout(place.loop(tailgate.make_defence("dkf")), tailgate.make_attack("none"), keys("train", range(4)))
    assert trace.truth.shape == trace.estimate.shape == (30, 4, agents, states) and trace.wires.shape == (30, 4, agents, sensors)
    error = place.brief().model.error(trace.estimate, trace.truth)
    assert np.isfinite(trace.estimate).all() and (error[-1] < error[0]).all()


def test_without_noise_the_system_is_its_matrix():
    """Noise variances of 0: x+ = A x and y_i = C_i x; every agent watches the same x. The start is N(0, initial_sd^2)."""
    place = network({"initial_sd": 2.0, "noise_var": 0.0}, {"noise_var": 0.0}, horizon=20)
    held = place.brief().model
    trace = rollout(place.loop(tailgate.make_defence("dkf")), tailgate.make_attack("none"), keys("train", range(300)))
    x = trace.truth[:, :, 0]
    assert (trace.truth == x[:, :, None]).all()
    np.testing.assert_allclose(x[1:], x[:-1] @ held.A.T, atol=1e-12)
    np.testing.assert_allclose(trace.clean, np.einsum("iqn,kbn->kbiq", held.C, x), atol=1e-12)
    start = x[0] @ np.linalg.inv(held.A).T
    assert abs(start.std() - 2.0) < 5 * 2.0 / np.sqrt(2 * start.size) and abs(start.mean()) < 5 * 2.0 / np.sqrt(start.size)


@pytest.mark.long
def test_noise_has_the_stated_variance_and_is_told_apart():
    """noise_var of the plant and of the sensors, independent between states, readings, agents and steps; Q and R are what is told."""
    place = network(
        {"noise_var": 0.04, "process_var": 3.0, "prior_var": 7.0}, {"noise_var": 0.25, "told_var": 2.0, "sensors": 2}, horizon=60
    )
    held = place.brief().model
    np.testing.assert_array_equal(held.Q, 3.0 * np.eye(20))
    np.testing.assert_array_equal(held.R, [2.0 * np.eye(2)] * 10)
    loop = place.loop(tailgate.make_defence("dkf"))
    prior = place.plant.prior(loop.plan.plant, loop.start(keys("train", range(2))).plant, np.zeros((2, 10, 0)), None)
    assert not prior.mean.any() and (prior.cov == 7.0 * np.eye(20)).all()
    trace = rollout(loop, tailgate.make_attack("none"), keys("train", range(100)))
    x = trace.truth[:, :, 0]
    w, v = x[1:] - x[:-1] @ held.A.T, trace.clean - np.einsum("iqn,kbn->kbiq", held.C, x)
    for noise, var in ((w, 0.04), (v, 0.25)):
        n = noise.size
        assert abs(noise.mean()) < 5 * np.sqrt(var / n) and abs(noise.var() / var - 1.0) < 5 * np.sqrt(2 / n)
    pairs = np.corrcoef(v.reshape(len(v) * 100, 20).T) - np.eye(20)
    assert np.max(np.abs(pairs)) < 6 / np.sqrt(len(v) * 100)
    assert abs(np.corrcoef(w[1:].ravel(), w[:-1].ravel())[0, 1]) < 5 / np.sqrt(w.size)


@pytest.mark.long
def test_weak_sensing_needs_the_neighbours():
    """In network-weak-v0 no agent can know the state alone, all can together; a Kalman filter alone fails, a distributed one does not."""
    place = load_scenario("network-weak-v0")
    held = place.brief().model
    assert alone(held) == list(range(10)) and blind(held) == []
    seen = [np.linalg.matrix_rank(C) for C in held.C]
    assert max(seen) < held.states
    last = {}
    for name in ("kf", "dkf"):
        trace = rollout(place.loop(tailgate.make_defence(name)), tailgate.make_attack("none"), keys("train", range(8)))
        last[name] = np.median(held.error(trace.estimate, trace.truth)[-50:], axis=(0, 1))
    assert (last["dkf"] < 1.0).all() and (last["kf"] > 2.0 * last["dkf"]).all()


@pytest.mark.parametrize("modes_seen", [1, 2, 3])
def test_each_agent_sees_the_modes_that_it_is_given(modes_seen):
    """C_i is zero on all modes but i, i + 1, ... (mod 3): eigenvectors of the others are invisible."""
    held = model(
        {"agents": 5, "states": 6, "system": "modal", "graph": "complete"}, {"pattern": "modes", "modes_seen": modes_seen, "sensors": 3}
    )
    values, vectors = np.linalg.eig(held.A)
    order = np.argsort(np.abs(np.angle(values)))  # mode p turns by 0.3 pi (p + 1)
    for i, C in enumerate(held.C):
        shown = np.max(np.abs(C @ vectors[:, order]), axis=0).reshape(3, 2).max(axis=1) > 1e-9
        assert set(np.flatnonzero(shown)) == {(i + step) % 3 for step in range(modes_seen)}


def test_the_undetectable_is_refused_and_its_agents_are_named():
    """A directed chain: agent i hears those before it, so that only from the third on all three modes are known. Decaying modes need nobody."""
    chain = {"agents": 5, "states": 6, "system": "modal", "graph": "path", "directed": True}
    with pytest.raises(InputError, match=r"plant sensor_network: undetectable for agents: got '0, 1'; expected for each agent a state"):
        model(chain, {"pattern": "modes"})
    assert blind(model(chain, {"pattern": "modes", "modes_seen": 3})) == []
    assert blind(model(chain | {"spectral_radius": 0.99}, {"pattern": "modes"})) == []
    with pytest.raises(InputError, match="got '0, 1, 2, 3, 4'"):
        model(chain | {"edges": ()}, {"pattern": "modes"})
    pairs = {"edges": ((0, 1), (1, 2), (3, 4)), "directed": False}
    with pytest.raises(InputError, match="got '3, 4'"):
        model(chain | pairs, {"pattern": "modes"})


def test_a_platoon_of_fifty_cars_is_detectable_with_its_neighbours_and_not_without():
    """Alone, no follower can tell where the leader is; the leader's own position lasts, and nothing else does."""
    place = load_scenario("platoon-braking-v0")
    held = dataclasses.replace(place.plant, followers=49).model(place.sensor, place.controller)
    assert blind(held) == [] and alone(held) == list(range(1, 50))
    (basis,) = lasting(held.A)
    np.testing.assert_allclose(np.abs(basis[:, 0]), np.eye(held.states)[0], atol=1e-9)


@pytest.mark.thin(5)
@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.long] if name == "network-large-v0" else []) for name in NETWORKS])  # it takes long to plan
def test_metrics_of_a_network(name):
    """The error is the 2-norm of the state's; nothing drives, so that the road's metrics are undefined and nobody crashes."""
    place = dataclasses.replace(load_scenario(name), horizon=30)
    trace = rollout(place.loop(tailgate.make_defence("dkf")), tailgate.make_attack("fdi", value=5.0), keys("train", range(3)))
    got = measure(trace)
    norm = np.linalg.norm(trace.estimate - trace.truth, axis=-1)
    np.testing.assert_allclose(got["max_error"], norm.max(axis=(0, 2)), rtol=1e-12)
    np.testing.assert_allclose(got["rmse_position"], np.sqrt((norm**2).mean(axis=(0, 2))), rtol=1e-12)
    for undefined in ("min_gap", "min_ttc", "impact_speed", "rmse_velocity", "recovery_time", "time_gap_inflation", "distance_travelled",
                      "max_decel", "rms_jerk", "string_gain"):  # fmt: skip
        assert np.isnan(got[undefined]).all(), undefined
    assert not got["crashed"].any() and (trace.length == 30).all()


@pytest.mark.long
@pytest.mark.parametrize("name", NETWORKS)
def test_published_networks(name):
    """Everybody can know the state together; the attacked agents exist and are not all; a clean distributed filter learns the state."""
    place = load_scenario(name)
    held = place.brief().model
    assert blind(held) == [] and 0 < place.brief().granted.any(axis=1).sum() < held.agents
    assert place.threat_model.onset < place.horizon <= 300

    def errors(defence):
        trace = rollout(place.loop(tailgate.make_defence(defence)), tailgate.make_attack("none"), keys("train", range(4)))
        return held.error(trace.estimate, trace.truth)

    error = errors("dkf")
    unknown = errors("coast")[-1] if place.plant.noise_var >= 0.1 else error[0]  # a system that is never at rest is soon lost by who does not read
    assert error[place.threat_model.onset :].max() < 0.6 * unknown.max()


@pytest.mark.long
def test_the_alarm_of_a_group_is_on_while_any_agent_alarms():
    """Calibration counts onsets as the metric does, in hours of the system; how many episodes run side by side changes nothing."""
    place = dataclasses.replace(load_scenario("network-noisy-v0"), horizon=60)
    loop = place.loop(make("defence", "chi2_dkf", eta=8.0, gain="steady"))
    trace = rollout(loop, tailgate.make_attack("none"), keys("calibrate", range(30)))
    onsets, steps = count_onsets(loop, keys("calibrate", range(30)))
    onsets = onsets.sum(axis=1)
    np.testing.assert_array_equal(onsets, measure(trace)["alarm_onsets"])
    any_on = trace.alarm.any(axis=2)
    np.testing.assert_array_equal(onsets, any_on[0] + (any_on[1:] & ~any_on[:-1]).sum(axis=0))
    single = (trace.alarm[1:] & ~trace.alarm[:-1]).sum() + trace.alarm[0].sum()
    assert (steps == 60).all() and 0 < onsets.sum() < single  # agents that alarm together are one alarm
    held = "chi2_dkf:gain=steady"
    whole, parts = (Bench.of(held, ["network-noisy-v0"], batch, None).run(8.0, 0.5, "calibrate", "") for batch in (4096, 4))
    assert whole == parts and whole.seconds == whole.steps == 1800 and whole.onsets > 0
    assert most_at_once(loop.model, 4096) == 3125 and most_at_once(load_scenario("stop-and-go-v0").brief().model, 4096) == 4096


@pytest.mark.long
def test_pictures_and_tables_of_a_network(tmp_path, capsys):
    """Without a road the state's error is drawn and printed, not gaps or collisions; a road beside it keeps its own."""
    rows, places = tmp_path / "rows.jsonl", ["--scenario", "network-weak-v0", "--scenario", "thesis-ch4-v0"]
    command = ["evaluate", *places, "--defence", "dkf", "--attack", "fdi", "--seeds", "2", "--dose", "none", "--out", str(rows)]
    assert cli.main([*command, "--plot", str(tmp_path / "both")]) == 0
    scatter, network, road = "rmse-against-gap.png", "network-weak-v0-unlimited.png", "thesis-ch4-v0-unlimited.png"
    assert {path.name for path in (tmp_path / "both").iterdir()} == {network, road, scatter}
    one, two = capsys.readouterr().out.split("thesis-ch4-v0, budget")
    assert "RMS error" in one and "collisions" not in one and "[m]" not in one
    assert "RMS error" not in two and "collisions" in two
    table = summarise(read_rows(rows))
    assert [path.name for path in write_overview(table[:1], tmp_path / "alone")] == [network]


@pytest.mark.parametrize("name", list_scenarios())
def test_no_actuator_is_granted_unless_it_is_named(name):
    """Without `targets` a threat model grants sensors alone, and no two wires share a name."""
    brief = load_scenario(name).with_threat(targets=()).brief()
    assert not brief.granted[:, brief.is_actuator].any() and len(set(brief.model.wires)) == len(brief.model.wires)
    with pytest.raises(InputError, match="no two are equal"):
        dataclasses.replace(brief.model, actuators=(brief.model.sensors[0],))


def test_close_eigenvalues_are_told_apart():
    """A lasting mode that nobody sees is found beside another one that is almost as fast."""
    one = np.eye(1)
    for gap in (5e-5, 1e-2):
        model = Model(
            A=np.diag([1.0, 1.0 + gap]), B=np.zeros((2, 0)), c=np.zeros(2), C=np.array([[[1.0, 0.0]]]), Q=np.eye(2), R=one[None],
            graph=np.eye(1, dtype=bool), dt=1.0, sensors=("y",),
        )
        assert blind(model) == [0]
        assert blind(dataclasses.replace(model, C=np.array([[[1.0, 1.0]]]))) == []


def test_of_a_network_fewer_episodes_are_worth_a_traced_loop():
    """Three agents count as one car."""
    for name, agents in (("thesis-ch5-v0", 10), ("thesis-ch4-v0", 1)):
        loop = load_scenario(name).loop(make("defence", "kf"))
        assert loop.model.agents == agents
        enough = int(np.ceil(WORTH / (loop.horizon * max(1.0, agents / 3.0))))
        assert worth_tracing(loop, enough) and not worth_tracing(loop, enough - 1)
