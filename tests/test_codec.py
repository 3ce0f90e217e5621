"""Codecs and rewards of every kind of system: what is seen, what a decision means, what is paid; car following as it was published."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tailgate.agents.policy.network_policy import load_policy
from tailgate.base.errors import InputError
from tailgate.core import Kind
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.core.schema import as_data
from tailgate.envs.gym import observations as observation
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.envs.gym.observations import LIMIT, ObservationCodec
from tailgate.envs.gym.rewards import Reward
from tailgate.envs.plants.platoon import Platoon, PlatoonSensors
from tailgate.envs.plants.sensor_network import LinearSensors, NoControl, SensorNetwork

ROOT = Path(__file__).parents[1]
DKF = Spec("defence", "dkf")


def _place(name, **threat):
    return load_scenario(name).with_threat(**({"onset": 2, "end": None} | threat))


def _platoon(cars, **threat):
    place = _place("platoon-braking-v0", **({"targets": ("distance", "velocity")} | threat))
    return dataclasses.replace(place, plant=Platoon(followers=cars - 1, topology="predecessor_leader"), sensor=PlatoonSensors())


def _network(size, **threat):
    place = _place("thesis-ch5-v0", **({"agents": (0, 1)} | threat))
    plant = SensorNetwork(agents=size, states=4, graph="ring")
    return dataclasses.replace(place, plant=plant, sensor=LinearSensors(sensors=3, noise_var=0.5), controller=NoControl())


PLACES = {
    "platoon": lambda **t: _platoon(4, **t), "long platoon": lambda **t: _platoon(9, **t), "network": lambda **t: _network(5, **t),
    "wide network": lambda **t: _network(12, **t),
}  # fmt: skip


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Six agents count as many: systems of 25 take long to prepare."""
    monkeypatch.setattr(observation, "SHOWN", 6)


def _loop(place):
    return place.loop(DKF.make(), DKF.entry.uses)


def _played(loop, steps=12, value=7.0, rows=3):
    """Views of an attacked episode."""
    state = loop.start(keys("train", range(rows)))
    for _ in range(steps):
        view = loop.sense(state)
        yield view
        command = loop.brief.command(np.arange(rows) > 0, Kind.FDI, loop.brief.granted, value)
        state, _ = loop.advance(state, command)


# -- car following as it was


@pytest.mark.long
def test_car_following_gives_the_numbers_that_were_recorded():
    """Observation and returns of 400 steps, autoreset included, as they were before other systems had faces."""
    seen = [
        0.11666667, 1.0, 1.0, 0.26, 0.0, 2.1353545, 1.4951109, 1.9366666, -1.3246675, 0.17096491, 0.79802316, 0.21680494, 0.0, 0.0, 0.45570242,
        3.195022, 0.68440306, 0.008523602, 10.0, 1.0, 0.6877734, -0.8881457, 1.0,
    ]  # fmt: skip
    paid = {
        "min_gap": [-0.9313504439752622, -0.8132538962711078], "collision": [-1.9313504439752627, -1.813253896271108],
        "error": [28.179703779901807, 23.888064297737312], "stealth": [-3.9202962200982507, -7.3119357022627085],
    }  # fmt: skip
    for reward, wanted in paid.items():
        env = AdversaryVectorEnv(
            2, scenario="stop-and-go-v0", defence="chi2_kf", knowledge="white", reward=reward, threat={"onset": 2}, value=-6.0
        )
        env.reset(seed=11)
        total = np.zeros(2)
        for k in range(400):
            observation, gained, *_ = env.step(np.array([k // 9 % 7, (k // 5 + 3) % 7]))
            total += gained
        np.testing.assert_allclose(total, wanted, rtol=1e-9)
        np.testing.assert_allclose(observation[0], seen, rtol=3e-7)


@pytest.mark.parametrize("knowledge, sees", [("black", False), ("grey", False), ("white", False), ("black", True)])
@pytest.mark.parametrize("scenario", ["stop-and-go-v0", "thesis-ch4-literal-v0"])
def test_car_following_keeps_its_layout_and_bits(scenario, knowledge, sees, same_bits):
    """The published formula, restated: every component in its order, to the last bit."""
    loop = load_scenario(scenario).with_threat(onset=2, knowledge=knowledge, sees_measurement=sees, budget=9).loop(Spec("defence", "chi2_kf").make())
    codec = ObservationCodec(loop.brief)
    for view in _played(loop):
        scene, last = view.scene, view.last
        gap, speed, lead = scene.gap[:, 0], scene.speed[:, 0], scene.lead_speed[:, 0]
        columns = [view.progress, view.allowed, view.budget_left / view.budget, view.burst / 50.0, view.cooldown / 50.0]
        columns += [gap / 50.0, speed / 15.0, lead / 15.0, (speed - lead) / 5.0, scene.accel[:, 0] / 3.0]
        columns += [scene.rear_gap[:, 0] / 50.0, (scene.rear_speed[:, 0] - speed) / 5.0]
        columns += [last.value[:, 0, w] / min(loop.threat.fdi_bound, 10.0) for w in range(2)]
        if knowledge != "black":
            columns.append(view.control[:, 0, 0] / 3.0)
        if knowledge == "white":
            error = view.estimate.x - view.truth
            columns += [error[:, 0, j] / 5.0 for j in range(3)] + [view.estimate.score[:, 0] / 20.0, view.estimate.alarm[:, 0]]
        if knowledge == "white" or sees:
            columns += [view.received.y[:, 0, 0] - scene.position[:, 0], view.received.y[:, 0, 1] - scene.speed[:, 0]]
        columns.append(last.kind != 0)
        wanted = np.stack([np.clip(column, -LIMIT, LIMIT).astype(np.float32) for column in columns], axis=1)
        assert same_bits(codec.observe(view), wanted)
    assert len(codec.names) == wanted.shape[1] and codec.names[-1] == "attacking"


@pytest.mark.parametrize("number", [0, 1, 2])
def test_the_published_policies_still_fit(number):
    """Names and size of today's observation are those in the policies' files."""
    header, network = load_policy(ROOT / f"results/quickstart-v0/policy-{number}.json")
    place = load_scenario("gusty-stop-and-go-v0").with_threat(kinds=("dos_jam", "fdi"), budget=20, fdi_bound=3.0)
    assert ObservationCodec(place.brief()).names == header.observation
    assert ActionCodec(header.action, place.brief()).size == network.weights[-1].shape[1]


# -- observations of many agents


@pytest.mark.thin(8)
@pytest.mark.parametrize("knowledge, sees", [("black", False), ("grey", False), ("white", False), ("black", True)])
@pytest.mark.parametrize("kind", PLACES)
def test_observations_are_finite_named_and_of_a_sensible_size(kind, knowledge, sees):
    """As many names as values, each once, everything finite and within the limit, whatever the number of agents."""
    loop = _loop(PLACES[kind](knowledge=knowledge, sees_measurement=sees))
    codec = ObservationCodec(loop.brief)
    assert len(set(codec.names)) == len(codec.names) <= 12 * min(loop.model.agents, 6) + 10
    for view in _played(loop):
        with np.errstate(all="raise"):
            seen = codec.observe(view)
        assert seen.shape == (3, len(codec.names)) and seen.dtype == np.float32
        assert np.isfinite(seen).all() and (np.abs(seen) <= LIMIT).all()
    moving = {name for name, column in zip(codec.names, seen.T, strict=True) if len(set(column.tolist())) > 1}
    assert "attacking" in moving


@pytest.mark.parametrize("scenario, sizes", [("linear-stealth-v0", []), ("scalar-hold-v0", ["reading", "moved", "believed"])])
def test_a_white_box_of_one_agent_shows_what_would_surprise(scenario, sizes):
    """y - C (A x + B u + c), with the value sent last on top, in standard deviations; of a closed loop also what is read and believed."""
    place = load_scenario(scenario).with_threat(knowledge="white")
    loop = place.loop(Spec("defence", "kf" if scenario.startswith("linear") else "none").make())
    codec, model = ObservationCodec(loop.brief), loop.model
    assert [name for name in codec.names if name in ("reading", "moved", "believed")] == sizes
    assert not {"innovation_" + model.sensors[0], "moved"} & set(ObservationCodec(place.with_threat(knowledge="black").brief()).names)
    state = loop.start(keys("train", range(5)))
    for _ in range(40):
        view = loop.sense(state)
        seen = dict(zip(codec.names, codec.observe(view).T, strict=True))
        before = view.estimate.x[:, 0] @ model.A.T + view.defence.known_u[:, 0] @ model.B.T + model.c
        sd = np.sqrt(model.C[0, 0] @ model.Q @ model.C[0, 0] + model.R[0, 0, 0])
        off = (view.received.y[:, 0, 0] - before @ model.C[0, 0] + view.last.value[:, 0, 0]) / sd
        np.testing.assert_allclose(seen["innovation_" + model.sensors[0]], np.clip(off, -LIMIT, LIMIT), rtol=1e-5, atol=1e-5)
        if sizes:
            np.testing.assert_allclose(seen["reading"], np.log1p(np.abs(view.received.y[:, 0, 0]) / codec.spread), rtol=1e-5)
        name = loop.threat.kinds[0]
        state, _ = loop.advance(state, ActionCodec(ActionSpec(action="timing", kind=name, value=2.0), loop.brief).decode(np.array([1, 0, 1, 0, 1]), view))


def test_a_platoon_shows_the_road_of_each_car():
    """Followers have gap and closing speed, the leader only its own motion; each value is the scene's, scaled; no car behind is made up."""
    loop = _loop(_platoon(4))
    codec = ObservationCodec(loop.brief)
    *_, view = _played(loop)
    seen = dict(zip(codec.names, codec.observe(view).T, strict=True))
    for i in range(4):
        np.testing.assert_allclose(seen[f"speed[{i}]"], view.scene.speed[:, i] / 15.0, rtol=1e-6)
        if i:
            np.testing.assert_allclose(seen[f"gap[{i}]"], view.scene.gap[:, i] / 50.0, rtol=1e-6)
            np.testing.assert_allclose(seen[f"closing[{i}]"], (view.scene.speed[:, i] - view.scene.speed[:, i - 1]) / 5.0, atol=1e-6)
    assert "gap[0]" not in seen and not any(name.startswith("rear") for name in seen)
    assert {name for name in seen if name.startswith("last")} == {"last_distance[2]", "last_velocity[2]"}
    np.testing.assert_allclose(seen["last_distance[2]"], [0.0, 0.7, 0.7], rtol=1e-6)


def test_a_white_box_sees_errors_and_not_states():
    """Gap and speed error of each car, the norm for each agent of a network; of neither the n states of N agents."""
    road, graph = _loop(_platoon(4, knowledge="white")), _loop(_network(5, knowledge="white"))
    *_, view = _played(road, 30)
    seen = dict(zip(ObservationCodec(road.brief).names, ObservationCodec(road.brief).observe(view).T, strict=True))
    off = view.estimate.x - view.truth
    np.testing.assert_allclose(seen["gap_error[2]"], np.clip(off[:, 2, 7] / 5.0, -10, 10), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(seen["speed_error[3]"], off[:, 3, 12] / 5.0, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(seen["score[1]"], np.clip(view.estimate.score[:, 1] / 20.0, None, 10.0), rtol=1e-6)
    *_, view = _played(graph, 30)
    seen = dict(zip(ObservationCodec(graph.brief).names, ObservationCodec(graph.brief).observe(view).T, strict=True))
    norm = np.sqrt(((view.estimate.x - view.truth) ** 2).sum(axis=2))
    np.testing.assert_allclose(seen["error[1]"], np.log(1.0 + norm[:, 1] / 2.0), rtol=1e-5)  # 4 states, Q = I
    assert sum(name.startswith("error") for name in seen) == 5


def test_noise_is_what_the_reading_is_off():
    """Readings of gap, position and speed are found by C, not by name: their noise in standard deviations; a network's as a norm."""
    loop = _loop(_platoon(4, sees_measurement=True))
    *_, view = _played(loop, 5)
    seen = dict(zip(ObservationCodec(loop.brief).names, ObservationCodec(loop.brief).observe(view).T, strict=True))
    truth = np.stack([view.scene.gap[:, 2], view.scene.speed[:, 2]], axis=1)
    off = (view.received.y[:, 2, :2] - truth) / 0.1
    np.testing.assert_allclose(np.stack([seen["noise_distance[2]"], seen["noise_velocity[2]"]], axis=1), off, rtol=1e-4, atol=1e-5)
    assert not [name for name in seen if name.startswith("noise_acceleration") or name == "noise_distance[0]"]
    loop = _loop(_network(5, knowledge="white"))
    *_, view = _played(loop, 5)
    seen = dict(zip(ObservationCodec(loop.brief).names, ObservationCodec(loop.brief).observe(view).T, strict=True))
    off = view.received.y - np.einsum("nqi,bni->bnq", loop.model.C, view.truth)
    np.testing.assert_allclose(seen["noise[4]"], np.sqrt((off[:, 4] ** 2).sum(axis=1) / 3.0), rtol=1e-5)


def test_of_many_agents_the_nearest_to_the_attacked_are_shown():
    """By hops from an attacked one, ties to the lower number; what all have together stands beside."""
    ring = ObservationCodec(_network(12, agents=(8,), knowledge="white").brief())
    assert ring.shown == [5, 6, 7, 8, 9, 10] and "largest_error" in ring.names
    string = ObservationCodec(_platoon(9, agents=(6,)).brief())
    assert string.shown == [0, 1, 2, 5, 6, 7] and "least_gap" in string.names
    few = ObservationCodec(_platoon(4).brief())
    assert few.shown == [0, 1, 2, 3] and "least_gap" not in few.names
    loop = _loop(_platoon(9, agents=(6,)))
    *_, view = _played(loop, 4)
    seen = dict(zip(string.names, string.observe(view).T, strict=True))
    np.testing.assert_allclose(seen["least_gap"], view.scene.gap.min(axis=1) / 50.0, rtol=1e-6)


@pytest.mark.parametrize("kind", PLACES)
def test_an_observation_has_the_same_bits_in_every_batch(kind, same_bits):
    """A row alone and among others."""
    loop = _loop(PLACES[kind](knowledge="white"))
    codec = ObservationCodec(loop.brief)
    *_, whole = _played(loop, 6)
    state = loop.start(keys("train", [2]))
    for _ in range(5):
        state, _ = loop.advance(state, loop.brief.command(np.ones(1, bool), Kind.FDI, loop.brief.granted, 7.0))
    assert same_bits(codec.observe(loop.sense(state))[0], codec.observe(whole)[2])


# -- actions of many agents


def test_modes_per_agent_and_sensor():
    """All wires, then each wire, each agent, and each wire of each agent; a mode targets granted wires of its agents only."""
    brief = _platoon(5, agents=(1, 3), kinds=("fdi", "dos_hold")).brief()
    codec = ActionCodec(ActionSpec(per_agent=True, per_sensor=True, value=5.0), brief)
    by_name = {mode.name: mode for mode in codec.modes}
    assert len(by_name) == codec.size == 1 + 3 * (1 + 2 + 2 + 4)
    assert by_name["fdi+"].target.sum() == 4 and by_name["fdi-:velocity"].target.sum() == 2
    assert np.argwhere(by_name["dos_hold:velocity[3]"].target).tolist() == [[3, 1]]
    assert np.argwhere(by_name["fdi+[1]"].target).tolist() == [[1, 0], [1, 1]]
    assert not any((mode.target & ~brief.granted).any() for mode in codec.modes)
    plain = ActionCodec(ActionSpec(value=5.0), brief)
    assert [mode.name for mode in plain.modes] == ["none", "fdi+", "fdi-", "dos_hold"]


def test_modes_of_several_sizes():
    """Shares of the value: both signs of each, within the bounds; held readings have no size, and a plain action no mark."""
    codec = ActionCodec(ActionSpec(value=-4.0, shares=(0.25, 1.0)), _platoon(5, kinds=("fdi", "dos_hold")).brief())
    by_name = {mode.name: mode for mode in codec.modes}
    assert list(by_name) == ["none", "fdi+*0.25", "fdi-*0.25", "fdi+", "fdi-", "dos_hold"]
    assert by_name["fdi+*0.25"].value.max() == 1.0 and by_name["fdi-*0.25"].value.min() == -1.0 and by_name["fdi-"].value.min() == -4.0


@pytest.mark.parametrize(("fields", "said"), [
    ({"shares": (0.5, 0.5)}, "each once"), ({"shares": (0.5, 2.0)}, r"\(0, 1\]"),
    ({"shares": (0.5,), "action": "ramp"}, "action mode"), ({"shares": (0.5, 1.0), "action": "continuous"}, "action mode"),
])  # fmt: skip
def test_shares_that_mean_nothing_are_refused(fields, said):
    """None, one twice, more than all of the value, and an action that has sizes of its own."""
    with pytest.raises(InputError, match="shares.*" + said):
        ActionCodec(ActionSpec(value=3.0, **fields), _platoon(5, kinds=("fdi",)).brief())
    with pytest.raises(InputError, match=r"shares.*dos_hold"):  # held readings have no size
        ActionCodec(ActionSpec(shares=(0.5, 1.0)), _platoon(5, kinds=("dos_hold",)).brief())


def test_an_action_without_shares_is_what_it_was():
    """Its data says nothing of them, so that cards, hashes and checkpoints of before hold; one share of all is the same action."""
    assert "shares" not in as_data(ActionSpec()) and as_data(ActionSpec(shares=(0.5,)))["shares"] == [0.5]
    brief = _platoon(5, kinds=("fdi", "dos_hold")).brief()
    one, two = (ActionCodec(ActionSpec(shares=shares), brief).modes for shares in ((), (1.0,)))
    assert [mode.name for mode in one] == [mode.name for mode in two]
    assert all(np.array_equal(a.value, b.value) for a, b in zip(one, two, strict=True))


def test_a_mode_hits_its_agent_in_the_loop():
    """The wires of the chosen agent arrive changed, all others as they were sent."""
    env = AdversaryVectorEnv(2, scenario="platoon-braking-v0", defence="dkf", value=5.0, per_agent=True, engine="plain",
                             threat={"agents": [1, 3], "targets": ["distance"], "kinds": ["fdi"], "onset": 1})  # fmt: skip
    env.reset(seed=0)
    names = [mode.name for mode in env.seat.action.modes]
    env.step(np.array([names.index("fdi+[3]"), names.index("fdi-")]))
    off = env.frame.wires - env.frame.clean
    assert np.argwhere(off[0]).tolist() == [[3, 0]] and off[0, 3, 0] == pytest.approx(5.0)
    assert np.argwhere(off[1]).tolist() == [[1, 0], [3, 0]]


@pytest.mark.parametrize("action", ["continuous", "increment"])
@pytest.mark.parametrize("kind", ["platoon", "network"])
def test_vectors_cover_granted_agents_only(kind, action):
    """One trigger and a value per wire of each granted agent, in their order; nothing else is hit."""
    place = _platoon(5, agents=(1, 3)) if kind == "platoon" else _network(5, agents=(1, 3))
    loop = _loop(place)
    codec = ActionCodec(ActionSpec(action=action, rate=2.0), loop.brief)
    wires = 2 if kind == "platoon" else 3
    assert codec.size == 1 + 2 * wires
    view = loop.sense(loop.start(keys("train", [0])))
    values = np.linspace(-0.9, 0.9, 2 * wires)
    command = codec.decode(np.concatenate([[0.5], values])[None], view)
    assert np.array_equal(command.target[0], loop.brief.granted)
    scale = 2.0 if action == "increment" else loop.threat.fdi_bound
    np.testing.assert_allclose(command.value[0][[1, 3]][:, :wires].ravel(), scale * values)
    assert not codec.decode(np.concatenate([[-0.5], values])[None], view).target.any()


# -- rewards


class _Frame:
    """What a reward reads of a frame."""

    def __init__(self, x, truth, alarm):
        self.estimate = type("E", (), {"x": x, "alarm": alarm})()
        self.truth = truth
        self.collided = self.rear_collided = self.refused = np.zeros(len(x), bool)
        self.command = type("C", (), {"kind": np.zeros(len(x), np.int8)})()


@pytest.mark.parametrize("kind", ["platoon", "network"])
def test_error_pays_the_largest_error_of_an_agent(kind):
    """Over error_scale, capped at 1, per second; stealth costs a second of alarm of anybody."""
    model = PLACES[kind]().brief().model
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(4, model.agents, model.states))
    x = truth + rng.normal(size=truth.shape) * np.array([0.1, 1.0, 3.0, 100.0])[:, None, None]
    alarm = np.zeros((4, model.agents), bool)
    alarm[1, -1] = True
    frame, fall, never = _Frame(x, truth, alarm), np.zeros(4), np.zeros(4, bool)
    off = x - truth
    sizes = np.abs(np.stack([off[:, i, 3 + 4 * (i - 1)] for i in range(1, 4)], axis=1)) if kind == "platoon" else np.sqrt((off**2).sum(axis=2))
    wanted = model.dt * np.minimum(sizes.max(axis=1) / 4.0, 1.0)
    np.testing.assert_allclose(Reward(reward="error", error_scale=4.0)(model, frame, fall, never), wanted)
    np.testing.assert_allclose(Reward(reward="stealth", error_scale=4.0)(model, frame, fall, never), wanted - model.dt * np.array([0, 1, 0, 0]))
    last = np.array([True, False, True, True])
    final = np.where(last, (sizes.max(axis=1) / 4.0) ** 2, 0.0)
    np.testing.assert_allclose(Reward(reward="final", error_scale=4.0)(model, frame, fall, last), final)


def test_without_a_road_potentials_are_zero_and_nothing_collides():
    """Infinite gaps give potential 0; a reward for collisions is refused."""
    model = _network(5).brief().model
    nobody = np.full((3, 5), np.inf)
    assert Reward().potential(nobody, model.gap_error(np.ones((3, 5, 4)), np.zeros((3, 5, 4)))).tolist() == [0.0, 0.0, 0.0]
    for name in ("min_gap", "collision"):
        with pytest.raises(InputError, match=f"reward.*'{name}'.*error, peak, stealth or final"):
            AdversaryVectorEnv(2, scenario="thesis-ch5-v0", defence="dkf", reward=name)
