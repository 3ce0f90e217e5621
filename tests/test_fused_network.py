"""Networks in the fused engine, against the plain loop: the same bits over whole episodes."""

import dataclasses
from importlib.resources import files

import numpy as np
import pytest

from tailgate import draws
from tailgate.envs.faces import AdversaryEnv
from tailgate.errors import InputError
from tailgate.fused import Constants, Refused, fuse
from tailgate.fused.network_play import Network
from tailgate.link import Link
from tailgate.registry import Spec
from tailgate.scenario import load_scenario
from tailgate.trace import nearest, rollout
from tailgate.tree import leaves

from .fused import as_plain, in_any_thread, loop_of, same, trace_as_plain

# Every scenario, filter, kind, law of values and trigger at least once; with two, three and fourteen sensors, and readings that drop out.
RESTLESS, WEAK, NOISY, LARGE, THESIS = (f"{name}-v0" for name in (
    "network-restless", "network-restless-weak", "network-noisy", "network-large", "thesis-ch5",
))  # fmt: skip
HALF = "dropout:probability=0.5"
CELLS = [
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


@pytest.mark.parametrize(("scenario", "defence", "attack", "threat"), CELLS)
def test_a_trace_is_the_plain_loops_to_the_last_bit(scenario, defence, attack, threat):
    """Episodes in two blocks, one of them not full: every signal's hash, and the lengths."""
    loop, rival = loop_of(scenario, defence, attack, horizon=90, **({"onset": 10, "end": 80} | threat))
    plain = trace_as_plain(loop, rival)
    assert attack == "none" or "near" in attack or (plain.kind != 0).any()


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
        assert isinstance(fuse(loop, rival), Constants)
        fused, plain = rollout(loop, rival, keys), rollout(loop, rival, keys, plain=True)
        assert (plain.kind != 0).any() and fused.trace_hash(0) == plain.trace_hash(0), attack


def test_without_a_road_there_is_no_gap():
    """Which only the plain loop says."""
    loop, rival = loop_of(WEAK, "dkf", "fdi:value=5", horizon=20)
    assert nearest(loop, rival, draws.keys("report", range(3))) is None


ENVIRONMENTS = [
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


@pytest.mark.parametrize("rows", [1, 70])
@pytest.mark.parametrize("arguments", ENVIRONMENTS, ids=lambda a: f"{a['scenario']}-{a['defence']}")
def test_an_environment_is_the_plain_one_to_the_last_bit(arguments, rows, tmp_path):
    """Observations, rewards, flags and information, over restarts, a masked reset and what was held."""
    as_plain(arguments, rows, tmp_path)


def test_threads_and_blocks_change_no_bit():
    """4200 episodes in one thread and in two, and one of them apart."""
    loop, _ = loop_of(WEAK, "norm_resilient", "none", horizon=3, onset=1)
    in_any_thread(Network, loop)


def test_what_is_not_finite_is_refused_as_in_the_plain_loop():
    """A measurement of 1e308 makes the estimate infinite."""
    loop, _ = loop_of(WEAK, "dkf", "none", onset=1, beyond={"fdi_bound": 1.7e308})
    lanes = Network(loop, fuse(loop), draws.keys("report", range(3)))
    lanes.start()
    command = loop.brief.command(np.ones(3, bool), 5, loop.brief.granted, 1.7e308)
    with pytest.raises(InputError, match="defence output x: got 'NaN or infinity'"):
        for _ in range(5):
            lanes.advance(command)


def test_what_an_attacker_sees_and_may_do_is_as_in_the_plain_loop():
    """Every part of a view, under random commands at any agent, granted or not, with a grey box and the measurement."""
    granted = {"knowledge": "grey", "sees_measurement": True, "budget": 20, "cooldown": 2, "duration": 3, "onset": 2, "fdi_bound": 60.0}
    loop, _ = loop_of(RESTLESS, "dkf", "none", targets=("y1", "y2", "y9"), **granted)
    keys, rng, shape = draws.keys("report", range(70)), np.random.default_rng(1), loop.brief.granted.shape
    lanes, state, refused = Network(loop, fuse(loop), keys), loop.start(keys), []
    lanes.start()
    for t in range(40):
        for one, two in zip(leaves(lanes.view()).items(), leaves(loop.sense(state)).items(), strict=True):
            assert one[0] == two[0] and one[1].dtype == two[1].dtype, one[0]
            assert np.array_equal(one[1], two[1]), one[0]
        target = rng.random((70, *shape)) < 0.1
        target &= loop.brief.granted | (rng.random((70, 1, 1)) < 0.2)
        command = loop.brief.command(rng.random(70) < 0.7, rng.integers(1, 6, 70), target, rng.uniform(-62.0, 62.0, (70, *shape)))
        lanes.advance(command)
        state, frame = loop.advance(state, command)
        refused.append(frame.refused)
        assert np.array_equal(lanes.row(np.uint64(0)) - 1.0, np.full(70, t + 1.0))
    assert 0 < np.count_nonzero(refused) < np.size(refused)


@pytest.mark.parametrize("action", ["mode", "continuous"])
def test_a_single_environment_is_a_batch_of_one(action):
    """The short way through a single environment gives the results and types of the long one."""
    one, two = (
        AdversaryEnv(engine=engine, scenario=THESIS, defence="lasso_dkf", action=action, reward="error", value=-30.0)
        for engine in ("fused", "plain")
    )  # fmt: skip
    assert [env.batch.engine for env in (one, two)] == ["fused", "plain"]
    rng, over = np.random.default_rng(3), False
    same(*(env.reset(seed=5)[0] for env in (one, two)))
    while not over:
        chosen = int(rng.integers(0, one.batch.seat.action.size)) if action == "mode" else rng.uniform(-1, 1, one.batch.seat.action.size)
        first, second = one.step(chosen), two.step(chosen)
        same(first[0], second[0])
        assert [type(value) for value in first] == [type(value) for value in second] and first[1:4] == second[1:4]
        assert first[4].keys() == second[4].keys() and all(np.array_equal(value, second[4][key]) for key, value in first[4].items())
        over = first[2] or first[3]


@pytest.mark.parametrize(("scenario", "defence", "threat", "why"), [
    (RESTLESS, "kf", {}, "what is missed"), (LARGE, "consensus_kf", {"kinds": ["fdi"]}, "so many gains"),
    (WEAK, "consensus_kf:share=true", {"kinds": ["fdi"]}, "shared"), (WEAK, "dkf:gain=varying", {}, "covariances"),
    (WEAK, "lasso_dkf:solver=cvxpy", {}, "not the exact one"), (WEAK, "centralised_kf", {}, "no lane"), (WEAK, "chi2_dkf", {}, "no lane"),
    (WEAK, "disagreement_dkf", {}, "no lane"), (WEAK, "trust_dkf", {}, "no lane"),
    (WEAK, "dkf", {"knowledge": "white"}, "white-box"), (WEAK, "dkf", {"kinds": ["replay"]}, "delay, replay"),
])  # fmt: skip
def test_what_has_no_lane_is_played_by_the_plain_loop(scenario, defence, threat, why):
    """And says why."""
    pytest.importorskip("cvxpy") if "cvxpy" in defence else None
    guard = Spec("defence", defence)
    found = fuse(load_scenario(scenario).with_threat(**threat).loop(guard.make(), guard.entry.uses))
    assert isinstance(found, Refused) and why in found.why, found


def test_lost_readings_and_a_look_ahead_have_no_lane():
    """The link of the scenario; the white-box script."""
    guard, place = Spec("defence", "dkf"), load_scenario(WEAK)
    lossy = dataclasses.replace(place.loop(guard.make()), link=Link(loss=0.1))
    assert isinstance(found := fuse(lossy), Refused) and "lost" in found.why
    found = fuse(place.with_threat(knowledge="white").loop(guard.make()), Spec("attack", "stealth").make())
    assert isinstance(found, Refused) and "stealth" in found.why


def test_an_attack_that_drops_nothing_leaves_gains_that_are_the_same_in_all_rows(tmp_path):
    """What is granted beyond that does not matter; what drops readings, or may, does."""
    program = tmp_path / "program.yaml"
    program.write_text(files("tailgate.configs").joinpath("attacks/sudden_hold.yaml").read_text().replace("dos_hold", "dropout"))
    known = "fdi", "dos_hold", "ghost:size=20", "fdi_sparse", "program:path=sudden_hold"
    for attack, wanted in [(name, Constants) for name in known] + [(name, Refused) for name in ("dropout", f"program:path={program}")]:
        loop, rival = loop_of(WEAK, "kf", attack)
        assert isinstance(fuse(loop, rival), wanted), attack


def test_nobody_who_drives_needs_a_module_of_networks():
    """Neither a car nor a platoon; and a car none of those that both share."""
    import subprocess
    import sys

    code = """
import sys
from tailgate import make_defence
from tailgate.scenario import load_scenario
from tailgate.fused import Constants, fuse
for place, defence in (("stop-and-go-v0", "kf"), ("platoon-gusty-v0", "dkf")):
    assert isinstance(fuse(load_scenario(place).loop(make_defence(defence))), Constants)
    print([name for name in sys.modules if name.startswith(("tailgate.fused.network", "tailgate.fused.several")[: 1 + (place[0] == "s")])])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["[]", "[]"], done.stdout + done.stderr
