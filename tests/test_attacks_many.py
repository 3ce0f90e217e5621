"""Attacks among many agents: who is hit and how often, what a program says of agents, and how far stealth pushes each."""

import dataclasses
import math
from typing import get_args

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Kind
from tailgate.core.kinds import KindName
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario

K = 40
OLD = {"kinds": get_args(KindName)}


@pytest.fixture(scope="module")
def sends(short, play):
    """The trace of a script, or of the attack that a text names, against the distributed filter on the thesis's network."""

    def run(attack, seeds=4, scenario="thesis-ch5-v0", threat=None, horizon=K, **params):
        place = short(scenario, horizon=horizon, **({"onset": 1, "agents": ()} | (threat or {})))
        attack = Spec("attack", attack).make() if not params else tailgate.make_attack(attack, **params)
        return play(place, "dkf", attack, range(seeds), terminate=False)

    return run


def hit(trace):
    """(K, B, N) bool: the agents that were attacked."""
    return trace.target.any(axis=3)


@pytest.mark.thin(2)
@pytest.mark.parametrize("agents", [(4,), (0, 9), (2, 3, 7)])
def test_a_script_hits_the_agents_that_it_names(agents, sends):
    """Those and no others; what all others sent arrives, bit for bit."""
    trace = sends("fdi", agents=agents, value=3.0)
    np.testing.assert_array_equal(hit(trace), np.broadcast_to(np.isin(np.arange(10), agents), (K, 4, 10)))
    others = [i for i in range(10) if i not in agents]
    np.testing.assert_array_equal(trace.wires[:, :, others], trace.clean[:, :, others])
    np.testing.assert_allclose((trace.wires - trace.clean)[:, :, list(agents)], 3.0, atol=1e-9)


def test_an_agent_that_is_not_granted_is_refused(sends):
    """As with wires: nothing arrives changed, and the rows count what was refused."""
    trace = sends("fdi", agents=(1, 3), threat={"agents": (1, 2)})
    assert trace.refused.all() and not trace.kind.any()
    np.testing.assert_array_equal(trace.wires, trace.clean)


@pytest.mark.long
def test_without_agents_a_script_hits_all_that_are_granted(sends):
    """The threat model's, or everybody."""
    assert hit(sends("fdi")).all()
    trace = sends("fdi", threat={"agents": (1, 5)})
    assert hit(trace)[..., [1, 5]].all() and hit(trace).sum() == 2 * K * 4 and not trace.refused.any()


@pytest.mark.long
def test_chance_is_per_step_and_agent_and_independent(sends):
    """The share of hits is `chance` for each agent, and its square for each pair of agents and for each pair of steps."""
    trace = sends("fdi", seeds=150, chance=0.3)
    each = hit(trace)
    n = each[..., 0].size
    assert np.max(np.abs(each.mean(axis=(0, 1)) - 0.3)) < 5 * math.sqrt(0.21 / n)
    pairs = np.corrcoef(each.reshape(-1, 10).T) - np.eye(10)
    assert np.max(np.abs(pairs)) < 5 / math.sqrt(n)
    assert abs(np.corrcoef(each[1:].ravel(), each[:-1].ravel())[0, 1]) < 5 / math.sqrt(10 * n)
    every = trace.target.all(axis=3)
    np.testing.assert_array_equal(every | ~each, True)  # an agent is hit on all of its wires


@pytest.mark.thin(3)
@pytest.mark.parametrize("attack", ["fdi", "fdi_gaussian", "dos_jam", "fdi_ramp", "fdi_uniform"])
def test_chance_thins_an_attack_and_changes_nothing_else(attack, sends):
    """What is sent to those that are hit is what is sent with chance 1, which is the attack without `chance`; 0 sends nothing."""
    plain, one, some, none = (sends(attack, **p) for p in ({"start_step": 3}, {"start_step": 3, "chance": 1.0}, {"start_step": 3, "chance": 0.4}, {"chance": 0.0}))
    assert [plain.trace_hash(i) for i in range(4)] == [one.trace_hash(i) for i in range(4)]
    assert hit(plain)[2:].all() and 0.3 < hit(some)[2:].mean() < 0.5 and not some.refused.any()
    np.testing.assert_array_equal(some.value, np.where(some.target, plain.value, 0.0))
    assert not none.kind.any() and not none.refused.any()


def test_a_step_in_which_nobody_is_hit_costs_nothing(sends):
    """With a budget, exactly so many steps are attacked, each with somebody hit; nothing is asked in vain."""
    trace = sends("fdi", chance=0.1, agents=(0, 1), threat={"budget": 3, "cooldown": 1}, seeds=30)
    np.testing.assert_array_equal(trace.kind != 0, hit(trace).any(axis=2))
    assert (hit(trace).any(axis=2).sum(axis=0) == 3).mean() > 0.8 and not trace.refused.any()


@pytest.mark.parametrize(
    "attack, threat, message",
    [
        ("delay:agents=[3]", OLD | {"agents": (1, 2)}, r"attack delay: threat_model\.targets.*of agents 3"),
        ("fdi:agents=[10]", {}, r"attack agents: got 10; expected an agent's number, from 0 to 9"),
        ("actuator_fdi", {}, "actuator_fdi: got 'no actuator'"), ("covert", {}, "one agent"), ("zero_dynamics", {}, "one agent"),
        ("stealth:state_index=20", {"knowledge": "white"}, r"stealth\.state_index: got 20"), ("program:path=burst_jamming", {}, r"last a step \(1 s\)"),
    ],
)  # fmt: skip
def test_what_has_no_meaning_here_is_not_applicable(attack, threat, message, sends):
    """Agents that do not exist or are not granted, no actuators, an input that nobody has: the rows are skipped, and say why."""
    with pytest.raises(NotApplicable, match=message):
        sends(attack, threat=threat)


def test_agents_that_are_no_numbers_are_input_errors():
    """A negative or broken number names the field of the attack."""
    for agents in ([-1], [0.5], ["two"]):
        with pytest.raises(InputError, match=r"attack fdi\.agents\.0"):
            tailgate.make_attack("fdi", agents=agents)


def test_old_samples_of_each_agent(sends):
    """delay, replay and both holds on two cars, with and without `chance`: each reads its own past."""
    rows = dict(scenario="platoon-braking-v0", agents=(1, 3), start_step=20)
    sensors = slice(0, 3)
    trace = sends("delay", age=7, threat=OLD, **rows)
    np.testing.assert_array_equal(trace.wires[19:, :, [1, 3], sensors], trace.clean[12:-7, :, [1, 3], sensors])
    trace = sends("delay", age=7, chance=0.5, threat=OLD, **rows)
    on = hit(trace)[19:]
    assert on[..., [1, 3]].any() and not on[..., [1, 3]].all()
    old = np.where(on[..., None], trace.clean[12:-7, ..., sensors], trace.clean[19:, ..., sensors])
    np.testing.assert_array_equal(trace.wires[19:, ..., sensors], old)
    trace = sends("replay", window=5, length=10, threat=OLD, **rows)
    tape = trace.clean[14:19, :, [1, 3], sensors]
    np.testing.assert_array_equal(trace.wires[19:29, :, [1, 3], sensors], np.concatenate([tape, tape]))
    trace = sends("dos_hold", chance=0.5, threat=OLD, **rows)
    first = np.argmax(hit(trace).any(axis=2), axis=0)  # the first hit on anybody fixes what is held of all
    for b in range(4):
        for i in (1, 3):
            on = hit(trace)[:, b, i]
            np.testing.assert_array_equal(trace.wires[on, b, i, sensors], np.broadcast_to(trace.clean[first[b] - 1, b, i, sensors], (on.sum(), 3)))


def test_an_actuator_of_one_car(sends):
    """Its command is falsified on the way, and no other car's."""
    trace = sends("actuator_fdi", value=-1.0, agents=(2,), scenario="platoon-braking-v0", threat={"targets": ("command",)})
    np.testing.assert_allclose((trace.applied - trace.control)[:, 0, :, 0], np.broadcast_to([0.0, 0.0, -1.0, 0.0, 0.0], (K, 5)), atol=1e-12)


@pytest.fixture
def write(tmp_path):
    """A program from YAML text."""

    def make(text):
        (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
        return str(tmp_path / "mine.yaml")

    return make


def test_phases_have_agents_of_their_own(sends, write):
    """First these, then those, then all that are granted."""
    text = "phases:\n  - {kind: fdi, value: 2, agents: [1, 4], length: 5}\n  - {kind: dropout, agents: [0], length: 5}\n  - {kind: fdi, value: -1}\n"
    trace = sends(write(text), threat={"agents": (0, 1, 4, 6)})
    for span, agents, kind in ((slice(0, 5), [1, 4], Kind.FDI), (slice(5, 10), [0], Kind.DROPOUT), (slice(10, K), [0, 1, 4, 6], Kind.FDI)):
        np.testing.assert_array_equal(hit(trace)[span], np.broadcast_to(np.isin(np.arange(10), agents), hit(trace)[span].shape))
        assert (trace.kind[span] == kind).all()
    assert not trace.refused.any()


def test_wires_of_different_agents_are_hit_by_themselves(sends, write):
    """`probability` of a phase is per step, agent and wire."""
    trace = sends(write("phases: [{kind: fdi, value: 2, agents: [1, 4], probability: 0.3}]"), seeds=40)
    each = trace.target[:, :, [1, 4], :14].reshape(-1, 28)
    assert np.max(np.abs(each.mean(axis=0) - 0.3)) < 5 * math.sqrt(0.21 / len(each))
    assert np.max(np.abs(np.corrcoef(each.T) - np.eye(28))) < 5 / math.sqrt(len(each))


@pytest.mark.parametrize(
    "phase, error, message",
    [
        ("{kind: fdi, value: 1, agents: [12]}", NotApplicable, r"program mine\.yaml, phase 1\.agents: got 12; .*from 0 to 9"),
        ("{kind: fdi, value: 1, agents: [3]}", NotApplicable, r"phase 1: threat_model\.targets.*of agents 3"),
        ("{kind: fdi, value: 1, agents: [-3]}", InputError, r"phase 1\.agents\.0: got -3"),
        ("{kind: fdi, value: 1, agents: two}", InputError, r"phase 1\.agents: got 'two'"),
    ],
)  # fmt: skip
def test_agents_of_a_phase_are_checked(phase, error, message, sends, write):
    """Program, phase and field are named."""
    with pytest.raises(error, match=message):
        sends(write(f"phases: [{phase}]"), threat={"agents": (0, 1)})


def pushed(trace, index):
    """(K, B, N) the error of what stealth pushes: the gap or the speed of a car, else a state."""
    model = trace.model
    if model.followers.any():
        return model.speed_error(trace.estimate, trace.truth) if index else -model.gap_error(trace.estimate, trace.truth)
    return (trace.estimate - trace.truth)[..., index]


GUARDS = ["chi2_dkf", "chi2_dkf:gain=steady", "chi2_kf", "composed:filter=dkf,detector=cusum", "composed:filter=dkf,detector=mewma"]


@pytest.mark.parametrize("defence", GUARDS)
@pytest.mark.parametrize("scenario, index, least", [("platoon-braking-v0", 0, 0.5), ("platoon-braking-v0", 1, 0.3), ("thesis-ch5-v0", 3, 0.5)])
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.thin(20)
def test_stealth_pushes_each_agent_up_to_its_own_gate(defence, scenario, index, least, sign, short, play):
    """Every attacked agent is moved in the wanted sense by more than noise would, and never alarms in an attacked step."""
    agents = (1, 3) if scenario == "platoon-braking-v0" else (0, 4, 7)
    place = short(scenario, horizon=30, onset=10, agents=agents, knowledge="white", fdi_bound=1e4)
    spec, attack = Spec("defence", defence), tailgate.make_attack("stealth", state_index=index, sign=sign)
    trace = play(place, spec.make(), attack, range(6), terminate=False)
    on = hit(trace)
    assert on[9:][..., agents].mean() > 0.5 and not np.delete(on, agents, axis=2).any()
    assert not (trace.alarm & on).any() and not trace.refused.any()
    assert (sign * pushed(trace, index)[-1][:, agents]).min() > least


def test_stealth_reaches_the_gate(short, play):
    """The score of an attacked agent is the threshold of its gate, unless a bound is in the way; the test above is no accident."""
    place = short("platoon-braking-v0", horizon=30, onset=10, agents=(1, 3), knowledge="white", fdi_bound=1e4)
    trace = play(place, Spec("defence", "chi2_dkf:eta=20").make(), tailgate.make_attack("stealth"), range(6), terminate=False)
    score = trace.score[hit(trace)]
    assert score.max() <= 20.0 and np.median(score) == pytest.approx(20.0, rel=1e-6)


def test_stealth_leaves_alone_whom_it_cannot_hide(short, play):
    """Where the speed alone is falsified and an honest gap would alarm, that agent is not touched, and the others still are."""
    place = short("platoon-braking-v0", horizon=40, onset=5, agents=(1, 3), knowledge="white")
    blind = tailgate.make_attack("stealth", targets=("velocity",), state_index=1, sign=1)
    trace = play(place, Spec("defence", "chi2_dkf:eta=6").make(), blind, range(12), terminate=False)
    on = hit(trace)[4:][..., [1, 3]]
    assert not (trace.alarm & hit(trace)).any() and (on[..., 0] != on[..., 1]).any() and on.all(axis=2).any()


@pytest.mark.parametrize(
    "params, threat, message",
    [
        ({"agents": (0,)}, {"agents": ()}, "stealth: agents.*an agent that follows another"),
        ({"state_index": 2}, {}, r"stealth\.state_index: got 2.*0 or 1"), ({"targets": ("acceleration_command",)}, {}, "targets"),
        ({"targets": ("predecessor_command",)}, {"targets": ("predecessor_command",)}, r"stealth: targets.*a sensor"),
    ],
)  # fmt: skip
def test_stealth_says_what_it_needs(params, threat, message, short):
    """The leader has no gap, cars have two states that are pushed, and without a sensor there is nothing to falsify."""
    place = short("platoon-braking-v0", knowledge="white", **threat)
    with pytest.raises(InputError, match=message):
        tailgate.make_attack("stealth", **params).prepare(place.brief())


def test_thesis_times_draws_one_value_for_each_wire(short, play):
    """Each agent and wire gets its own uniform value, on one agent as on ten."""
    for name in ("thesis-ch4-v0", "thesis-ch5-v0"):
        place = dataclasses.replace(load_scenario(name), horizon=12).with_threat(onset=1)
        trace = play(place, "kf", tailgate.make_attack("thesis_times"), range(3), terminate=False)
        values = trace.value[4][trace.target[4]]
        assert trace.kind[4].all() and len(set(values.tolist())) == values.size and not trace.refused.any()
