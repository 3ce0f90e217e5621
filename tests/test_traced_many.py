"""Platoons and networks: the traced engine plays them as the plain loop does, to the last bit."""

import dataclasses

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.base.pytree import leaves
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.gymnasium_env import AdversaryEnv
from tailgate.envs.manoeuvres import Profile
from tailgate.play.commanded import Steps, commanded
from tailgate.play.trace import rollout

from .engines import as_plain, loop_of, same, told, trace_as_plain

# Every topology and law, manoeuvre of a scenario, kind, law of values and trigger at least once; wires of several cars, and all of a car's.
WIRES = ("distance", "velocity", "acceleration", "predecessor_acceleration", "leader_acceleration", "predecessor_command", "command")
ANY = {"onset": 10, "end": 110, "agents": (1, 2, 4), "targets": WIRES}
LEADER = {"onset": 10, "agents": (0, 3)}
READ = ANY | {"kinds": ("dos_jam", "dos_hold", "dos_hold_fresh", "fdi")}  # nothing is missed: covariances are the same in all rows
PLATOONS = [
    ("platoon-braking-v0", "dkf", "none", {}),
    ("platoon-braking-v0", "dkf", "fdi:value=60,targets=[distance]", {"onset": 20}),
    ("platoon-gusty-v0", "dkf", "fdi:signs=3,value=1", ANY),
    ("platoon-gusty-v0", "dkf", "dos_hold:trigger=near,threshold=64", ANY),
    ("platoon-gusty-v0", "dkf", "dos_hold:fresh=true,start_step=40,length=40", LEADER),
    ("platoon-noisy-v0", "dkf", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-noisy-v0", "dkf", "fdi_gaussian:trigger=closing,threshold=0.5,sd=4", ANY),
    ("platoon-heavy-v0", "dkf", "dos_jam:start_step=30,low=-3,high=3,burst=4,pause=3", ANY),
    ("platoon-heavy-v0", "dkf", "fdi_uniform:trigger=leader_braking,threshold=0.1,chance=0.6", ANY),
    ("platoon-stop-and-go-v0", "dkf", "fdi_bernoulli:trigger=slow,threshold=19,value=2", ANY),
    ("platoon-stop-and-go-v0", "dkf", "fdi_ramp:trigger=speed,threshold=20.05,rate=0.3", ANY),
    ("platoon-braking-known-v0", "dkf", "fdi_then_jam:start_step=30,inject=5,value=1", ANY),
    ("platoon-bidirectional-v0", "dkf", "fdi_sparse:start_step=30", ANY),
    ("platoon-two-predecessor-v0", "dkf", "actuator_fdi:start_step=20,value=1.5", ANY),
    ("platoon-20-v0", "dkf", "fdi:start_step=20,value=-20", {}),
    ("platoon-braking-v0", "composed:filter=dkf,detector=score,mitigation=accept_all", "dropout:start_step=30", LEADER),
    ("platoon-gusty-v0", "lasso_dkf", "fdi:start_step=20,value=30", ANY),
    ("platoon-heavy-v0", "lasso_dkf:unit=sigma,lam=1.3", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-20-v0", "lasso_dkf", "dos_hold:start_step=20", {}),
    ("platoon-bidirectional-v0", "norm_resilient", "fdi_gaussian:start_step=20,sd=8", ANY),
    ("platoon-noisy-v0", "norm_resilient:lam=5", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-gusty-v0", "norm_resilient", "fdi_bernoulli:start_step=20,value=50", LEADER),
    ("platoon-stop-and-go-v0", "saturated_dkf", "fdi:start_step=20,value=-50", {"onset": 10}),
    ("platoon-two-predecessor-v0", "saturated_dkf:eta=3,gamma=0.5", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-lossy-v0", "dkf", "fdi:start_step=20,value=30", ANY),
    ("platoon-lossy-v0", "lasso_dkf", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-lossy-v0", "norm_resilient", "dos_hold:start_step=30,fresh=true,burst=3,pause=2", ANY),
    ("platoon-lossy-v0", "saturated_dkf", "dos_hold:start_step=30", {"onset": 10}),
    ("platoon-lossy-v0", "none", "dos_jam:start_step=20", ANY),
    ("platoon-heavy-v0", "none", "dropout:start_step=30,probability=0.5", ANY),
    ("platoon-20-v0", "none", "fdi:start_step=20,value=30", {}),
    ("platoon-gusty-v0", "kf", "fdi:start_step=20,value=30", READ),
    ("platoon-two-predecessor-v0", "composed:filter=kf,detector=chi2,mitigation=accept_all", "dos_jam:start_step=20", READ),
    ("platoon-bidirectional-v0", "consensus_kf", "fdi_gaussian:start_step=20,sd=8", READ),
    ("platoon-noisy-v0", "consensus_kf:eta=4,consensus=0.3", "dos_hold:start_step=20", READ),
    ("platoon-stop-and-go-v0", "consensus_kf:consensus=0", "none", READ),
    ("platoon-gusty-v0", "always_alarm", "none", READ),
    ("platoon-gusty-v0", "always_brake", "fdi:start_step=20,value=30", READ),
    ("platoon-bidirectional-v0", "stand_still", "none", READ),
    ("platoon-gusty-v0", "coast", "fdi:start_step=20,value=-9", READ),
    ("platoon-braking-v0", "composed:filter=lasso,detector=chi2_tail,mitigation=accept_all", "dos_jam:start_step=20", ANY),
]
# Every scenario, filter, kind, law of values and trigger at least once; with two, three and fourteen sensors, and readings that drop out.
RESTLESS, WEAK, NOISY, LARGE, THESIS = (f"{name}-v0" for name in (
    "network-restless", "network-restless-weak", "network-noisy", "network-large", "thesis-ch5",
))  # fmt: skip
HALF = "dropout:probability=0.5"
NETWORKS = [
    (RESTLESS, "dkf", "none", {}),
    (RESTLESS, "dkf", "fdi:value=100,signs=1", {"budget": 40, "cooldown": 3, "duration": 9}),
    (RESTLESS, "dkf", "fdi_gaussian:sd=3", {"agents": (3,)}),
    (RESTLESS, "dkf", "program:path=scattered_bias", {}),
    (RESTLESS, "dkf", "ghost:size=20,grow=20", {}),
    (RESTLESS, "dkf", HALF, {}),
    (WEAK, "dkf", "fdi_gaussian:sd=100,chance=0.9", {}),
    (WEAK, "dkf", "dos_hold:fresh=true,start_step=20,burst=3,pause=2", {}),
    (WEAK, "dkf", HALF, {"agents": (1, 2, 9), "targets": ("y2",)}),
    (NOISY, "dkf", "dos_hold", {}),
    (NOISY, "dkf", "dropout:start_step=30", {}),
    (LARGE, "dkf", "fdi_ramp:rate=0.5,limit=10", {}),
    (LARGE, "dkf", HALF, {}),
    (THESIS, "dkf", "dos_jam:low=-3,high=3", {}),
    ("network-weak-v0", "dkf", "fdi_sparse:start_step=30", {}),
    (RESTLESS, "composed:filter=dkf,detector=chi2,mitigation=accept_all", "fdi:value=5,trigger=slow,threshold=2", {}),
    (RESTLESS, "norm_resilient", "fdi_bernoulli:value=100", {}),
    (RESTLESS, "norm_resilient", HALF, {"agents": (0, 4)}),
    (WEAK, "norm_resilient:lam=5", HALF, {}),
    (LARGE, "norm_resilient", "fdi_then_jam:inject=9,value=20", {}),
    (THESIS, "norm_resilient", "fdi_gaussian:chance=0.9,sd=700", {}),
    (RESTLESS, "lasso_dkf", "fdi:value=6,signs=1", {}),
    (RESTLESS, "lasso_dkf", HALF, {}),
    (WEAK, "lasso_dkf", "fdi_uniform:low=-9,high=9", {}),
    (WEAK, "lasso_dkf:unit=sigma,lam=1.3", HALF, {}),
    (NOISY, "lasso_dkf:lam=0.5", HALF, {}),
    (RESTLESS, "saturated_dkf", "fdi:value=5", {}),
    (WEAK, "saturated_dkf:eta=3,gamma=0.5", HALF, {}),
    (RESTLESS, "kf", "fdi:value=100", {}),
    (NOISY, "kf", "program:path=sudden_bias", {}),
    (WEAK, "consensus_kf", "ghost:size=20", {}),
    (WEAK, "composed:filter=kf,detector=chi2_tail,mitigation=accept_all", "dos_hold", {}),
    (RESTLESS, "consensus_kf", "fdi_ramp:rate=1.0,limit=100", {}),
    (WEAK, "consensus_kf:eta=4,consensus=0.3", "dos_jam", {}),
    (NOISY, "always_alarm", "none", {}),
    (NOISY, "coast", "fdi:value=-9", {}),
    (WEAK, "always_brake", "fdi:value=9,trigger=near", {}),
]


@pytest.mark.thin(86)
@pytest.mark.parametrize(("scenario", "defence", "attack", "threat"), PLATOONS + NETWORKS)
def test_a_trace_is_the_plain_loops_to_the_last_bit(scenario, defence, attack, threat):
    many = {"onset": 10, "end": 80} if scenario in (RESTLESS, WEAK, NOISY, LARGE, THESIS, "network-weak-v0") else {}
    loop, rival = loop_of(scenario, defence, attack, horizon=90 if many else 120, **(many | threat))
    plain = trace_as_plain(loop, rival)
    assert attack == "none" or "near" in attack or (plain.kind != 0).any()


@pytest.mark.thin(3)
@pytest.mark.parametrize("followers", [1, 2, 7])
def test_strings_of_any_length(followers, tmp_path):
    """A single row, and other numbers of states; with a manoeuvre that is a table, and no noise of the sensors."""
    speeds = tmp_path / "speeds.csv"
    speeds.write_text("t,v\n0,20\n3,18\n6,19\n")
    place, guard = load_scenario("platoon-gusty-v0").with_threat(agents=(1,)), Spec("defence", "dkf")
    place = dataclasses.replace(
        place, plant=dataclasses.replace(place.plant, followers=followers), manoeuvre=Profile(speeds), horizon=90,
        sensor=dataclasses.replace(place.sensor, told_sd=(0.1, 0.1, 0.05), noise_sd=(0.0, 0.0, 0.0)),
    )  # fmt: skip
    loop = place.loop(guard.make(), guard.entry.uses)
    rival, keys = Spec("attack", "fdi:start_step=60,value=9").make(), draws.keys("report", [5])
    fast, plain = told(loop, rival, keys), rollout(loop, rival, keys, plain=True)
    assert (plain.kind != 0).any()
    assert fast.trace_hash(0) == plain.trace_hash(0)


@pytest.mark.long
@pytest.mark.parametrize("terminate", [pytest.param(True, marks=pytest.mark.long), False])
def test_whole_episodes_with_collisions_and_beyond_them(terminate):
    """To the horizon, ended by a collision or not."""
    loop, rival = loop_of("platoon-gusty-v0", "dkf", "fdi:start_step=60,value=30,targets=[distance]", horizon=550)
    keys = draws.keys("report", range(20))
    fast, plain = told(loop, rival, keys, terminate), rollout(loop, rival, keys, terminate=terminate, plain=True)
    assert plain.collided.any()
    assert [fast.trace_hash(b) for b in range(20)] == [plain.trace_hash(b) for b in range(20)]


@pytest.mark.thin(12)
@pytest.mark.parametrize(("agents", "states", "sensors", "graph"), [(2, 2, 2, "path"), (7, 5, 3, "star"), (4, 9, 20, "complete")])
@pytest.mark.parametrize("defence", ["dkf", "norm_resilient", "lasso_dkf", "consensus_kf"])
def test_networks_of_any_size(agents, states, sensors, graph, defence):
    """A single row, in a graph with directions; a system that grows, with noise of its own, and readings with noise."""
    place = load_scenario(RESTLESS).with_threat(agents=(1,), onset=5)
    place = dataclasses.replace(
        place, horizon=60, sensor=dataclasses.replace(place.sensor, sensors=sensors, noise_var=0.3),
        plant=dataclasses.replace(
            place.plant, agents=agents, states=states, graph=graph, directed=graph != "star", spectral_radius=1.02, initial_sd=2.0,
        ),
    )  # fmt: skip
    loop, keys = place.loop(Spec("defence", defence).make()), draws.keys("report", [5])
    for attack in ("fdi:value=9", HALF) if defence != "consensus_kf" else ("fdi:value=9",):
        rival = Spec("attack", attack).make()
        fast, plain = told(loop, rival, keys), rollout(loop, rival, keys, plain=True)
        assert (plain.kind != 0).any() and fast.trace_hash(0) == plain.trace_hash(0), attack


ENVIRONMENTS = [
    {"scenario": "platoon-braking-v0", "defence": "dkf", "autoreset": "next_step"},
    {"scenario": "platoon-gusty-v0", "defence": "dkf", "autoreset": "same_step", "action": "ramp", "reward": "stealth", "frames": 3,
     "threat": {"budget": 50, "cooldown": 3, "duration": 9}},
    {"scenario": "platoon-heavy-v0", "defence": "dkf", "action": "continuous", "reward": "final", "interval": 7, "knowledge": "grey",
     "threat": {"sees_measurement": True, "targets": WIRES, "agents": [1, 3]}},
    {"scenario": "platoon-noisy-v0", "defence": "dkf", "autoreset": "same_step", "action": "increment", "reward": "error",
     "attack_cost": 0.1, "illegal_penalty": 0.2, "threat": {"agents": [2, 4]}},
    {"scenario": "platoon-braking-known-v0", "defence": "dkf", "action": "timing", "kind": "dos_jam", "reward": "collision"},
    {"scenario": "platoon-20-v0", "defence": "dkf", "per_sensor": True, "per_agent": True, "autoreset": "same_step"},
    {"scenario": "platoon-braking-v0", "defence": "lasso_dkf", "autoreset": "same_step", "reward": "peak"},
    {"scenario": "platoon-gusty-v0", "defence": "saturated_dkf:eta=2", "autoreset": "next_step", "action": "continuous", "reward": "stealth",
     "threat": {"kinds": ["fdi"], "targets": ["distance", "velocity"]}},
    {"scenario": "platoon-noisy-v0", "defence": "norm_resilient", "interval": 2},
    {"scenario": "platoon-gusty-v0", "defence": "none", "autoreset": "same_step", "interval": 4, "action": "increment"},
    {"scenario": "platoon-gusty-v0", "defence": "kf", "autoreset": "same_step", "threat": {"kinds": ["fdi", "dos_hold"]}, "value": -40.0},
    {"scenario": "platoon-bidirectional-v0", "defence": "consensus_kf", "interval": 7, "threat": {"kinds": ["fdi", "dos_hold"]}, "value": -40.0},
    {"scenario": "platoon-lossy-v0", "defence": "lasso_dkf", "autoreset": "same_step", "threat": {"sees_measurement": True}},
    {"scenario": "platoon-bidirectional-v0", "defence": "dkf", "interval": 3, "per_agent": True, "value": -20.0,
     "threat": {"agents": [0, 1, 4], "sees_measurement": True}},
    {"scenario": THESIS, "defence": "norm_resilient", "action": "continuous", "reward": "error", "error_scale": 30.0,
     "threat": {"kinds": ["fdi"], "fdi_bound": 100.0}},
    {"scenario": RESTLESS, "defence": "dkf", "autoreset": "next_step", "reward": "error", "value": -9.0},
    {"scenario": WEAK, "defence": "dkf", "autoreset": "same_step", "action": "ramp", "reward": "stealth", "frames": 3, "value": 3.0,
     "threat": {"budget": 50, "cooldown": 3, "duration": 9}},
    {"scenario": NOISY, "defence": "dkf:gain=steady", "action": "increment", "reward": "final", "interval": 7, "knowledge": "grey",
     "threat": {"agents": [1, 4], "targets": ["y1", "y3"]}},
    {"scenario": NOISY, "defence": "saturated_dkf:eta=2", "autoreset": "same_step", "reward": "stealth", "per_sensor": True, "per_agent": True,
     "attack_cost": 0.1, "illegal_penalty": 0.2},
    {"scenario": RESTLESS, "defence": "norm_resilient", "autoreset": "same_step", "reward": "peak", "action": "timing", "kind": "dropout"},
    {"scenario": RESTLESS, "defence": "lasso_dkf", "action": "timing", "kind": "dos_hold", "reward": "peak", "interval": 2, "frames": 2,
     "autoreset": "same_step", "threat": {"kinds": ["dos_hold"], "budget": 5, "agents": [1, 7], "sees_measurement": True}},
    {"scenario": NOISY, "defence": "dkf", "reward": "error", "autoreset": "next_step", "threat": {"sees_measurement": True}},
    {"scenario": LARGE, "defence": "lasso_dkf", "interval": 3, "reward": "error", "value": 40.0},
    {"scenario": WEAK, "defence": "kf", "autoreset": "same_step", "reward": "error", "threat": {"kinds": ["fdi", "dos_hold"]}},
    {"scenario": WEAK, "defence": "consensus_kf", "reward": "error", "autoreset": "next_step", "threat": {"kinds": ["fdi"], "agents": [5]}},
]  # fmt: skip


@pytest.mark.thin(28)
@pytest.mark.parametrize("arguments", ENVIRONMENTS, ids=lambda a: f"{a['scenario']}-{a['defence']}")
def test_an_environment_is_the_plain_one_to_the_last_bit(arguments, tmp_path):
    """Observations, rewards, flags and information, over restarts, a masked reset and what was held."""
    as_plain(arguments, 9, tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["platoon-gusty-v0", WEAK])
def test_what_is_not_finite_is_refused_as_in_the_plain_loop(scenario):
    """A measurement of 1e308 makes the score infinite."""
    loop, _ = loop_of(scenario, "dkf", "none", onset=1, beyond={"fdi_bound": 1.7e308})
    command = loop.brief.command(np.ones(3, bool), 5, loop.brief.granted, 1.7e308)
    state, said = loop.start(draws.keys("report", range(3))), []
    steps = Steps(commanded(loop), state)
    for play in (lambda: steps.play(command), lambda: loop.advance(state, command)):
        with pytest.raises(InputError, match="defence output score: got 'NaN or infinity in step 1") as caught:
            play()
        said.append(str(caught.value))
    assert said[0] == said[1]


@pytest.mark.thin(3)
@pytest.mark.parametrize(("scenario", "defence", "threat"), [
    ("platoon-gusty-v0", "dkf", ANY), ("platoon-lossy-v0", "none", ANY), (RESTLESS, "dkf", {"targets": ("y1", "y2", "y9"), "fdi_bound": 60.0}),
])  # fmt: skip
def test_what_an_attacker_sees_and_may_do_is_as_in_the_plain_loop(scenario, defence, threat):
    """Every part of a view, under random commands at any agent, granted or not, with a grey box and the measurement."""
    granted = {"knowledge": "grey", "sees_measurement": True, "budget": 20, "cooldown": 2, "duration": 3, "onset": 2}
    loop, _ = loop_of(scenario, defence, "none", **(threat | granted))
    rng, shape, state, refused = np.random.default_rng(1), loop.brief.granted.shape, loop.start(draws.keys("report", range(70))), []
    steps = Steps(commanded(loop), state)
    for _ in range(40):
        target = rng.random((70, *shape)) < 0.1
        target &= loop.brief.granted | (rng.random((70, 1, 1)) < 0.2)
        command = loop.brief.command(rng.random(70) < 0.7, rng.integers(1, 6, 70), target, rng.uniform(-62.0, 62.0, (70, *shape)))
        signals, _, view = steps.play(command)
        state, frame = loop.advance(state, command)
        refused.append(frame.refused)
        same(leaves(view), leaves(loop.sense(state)))
        assert np.array_equal(signals["refused"], frame.refused)
    assert 0 < np.count_nonzero(refused) < np.size(refused)


@pytest.mark.long
@pytest.mark.parametrize(("scenario", "reward"), [("platoon-gusty-v0", "collision"), (THESIS, "error")])
@pytest.mark.parametrize("action", ["mode", "continuous"])
def test_a_single_environment_is_a_batch_of_one(action, scenario, reward):
    """The short way through a single environment gives the results and types of the long one."""
    one, two = (
        AdversaryEnv(engine=engine, scenario=scenario, defence="lasso_dkf", action=action, value=-30.0, reward=reward) for engine in ("traced", "plain")
    )  # fmt: skip
    assert [env.batch.engine for env in (one, two)] == ["traced", "plain"]
    rng = np.random.default_rng(3)
    same(*(env.reset(seed=5)[0] for env in (one, two)))
    for _ in range(60):  # a car is played to the end
        chosen = int(rng.integers(0, one.batch.seat.action.size)) if action == "mode" else rng.uniform(-1, 1, one.batch.seat.action.size)
        first, second = one.step(chosen), two.step(chosen)
        same(first[0], second[0])
        assert [type(value) for value in first] == [type(value) for value in second] and first[1:4] == second[1:4]
        assert all(np.array_equal(value, second[4][key]) for key, value in first[4].items())


@pytest.mark.long
def test_what_replays_read_is_searched_in_loops():
    """Thirty rings of fifty samples: one by one they would be ten times as many numbers, and take half a minute to compile."""
    program = commanded(loop_of("platoon-v2v-v0", "kf", "replay")[0]).program
    assert program.size["nodes"] < 5000 and program.size["branches"] < 50
