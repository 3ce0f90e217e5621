"""The contract of tests/test_contract.py on other plants: every defence and attack runs on a network, a platoon and a radar car, or says why not."""

import dataclasses
from functools import cache, partial
from typing import get_args

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import NotApplicable
from tailgate.base.pytree import leaves
from tailgate.core import Kind, Mode
from tailgate.core.draws import Keys, Role, keys
from tailgate.core.kinds import KindName
from tailgate.core.registry import entries
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.mixture import Mixture
from tailgate.estimators import EpisodeByEpisode
from tailgate.play.trace import rollout

MANY = ("network-weak-v0", "platoon-braking-v0")
PLACES = (*MANY, "radar-following-v0")
DEFENCES = tailgate.list_defences()
ATTACKS = [name for name in tailgate.list_attacks() if name not in ("policy", "rules")]  # which need a file
STEPS, ONSET = 12, 4


@cache
def place_of(name):
    """A scenario cut short, in which the attacker of the attacked agents may touch every wire in every way, and sees everything."""
    place = load_scenario(name)
    threat = {"onset": ONSET, "kinds": get_args(KindName), "knowledge": "white", "targets": place.brief().model.wires}
    return dataclasses.replace(place, horizon=STEPS).with_threat(**threat)


@cache
def loop_of(name, defence):
    """The loop, prepared once for all tests: what it plays changes nothing of it. Skips the test where the pair has no meaning."""
    try:
        return place_of(name).loop(tailgate.make_defence(defence), entries("defence")[defence].uses)
    except NotApplicable as error:
        pytest.skip(str(error))


def play(loop, attack, seeds):
    attack = tailgate.make_attack(attack) if isinstance(attack, str) else attack
    return rollout(loop, attack, keys("train", list(seeds)), terminate=False)


def slow(defence):
    """Whether every episode and agent is played by itself."""
    return isinstance(tailgate.make_defence(defence), EpisodeByEpisode)


each = pytest.mark.parametrize("defence, place", [(d, p) for p in PLACES for d in DEFENCES])


@pytest.mark.thin(38)
@each
def test_a_defence_runs_and_its_rows_do_not_depend_on_their_batch(defence, place, same_rows):
    """Finite arrays of the declared shapes, and the same trace_hash in batches of 1, 3 and 16, while readings are falsified and lost."""
    loop = loop_of(place, defence)
    model, sensors = loop.model, loop.model.sensors
    count = 3 if slow(defence) else 16
    falsified, lost = (
        tailgate.make_attack("fdi_gaussian", sd=20.0, chance=0.5, targets=sensors),
        tailgate.make_attack("dropout", probability=0.5, targets=sensors),
    )
    mix = Mixture((falsified, lost))  # by its own draws seeds 0 and 5 are falsified, 1 to 4 lost
    whole = same_rows(partial(play, loop, mix), count, [2, 0, 77][: 2 if slow(defence) else 3], [1])
    assert whole.estimate.shape == whole.truth.shape == (STEPS, count, model.agents, model.states)
    assert whole.score.shape == whole.alarm.shape == whole.mode.shape == (STEPS, count, model.agents)
    assert whole.alarm.dtype == bool and set(np.unique(whole.mode)) <= {int(m) for m in Mode}
    assert all(np.isfinite(whole.signals[name]).all() for name in ("estimate", "score", "control", "wires", "value"))
    assert (whole.kind[ONSET - 1 :, 0] == Kind.FDI).any() and (whole.kind[ONSET - 1 :, 1] == Kind.DROPOUT).any()


@pytest.mark.thin(10)
@each
def test_a_restarted_row_is_a_fresh_one(defence, place, same_tree):
    """Restarted rows equal fresh rows of the next episode and play on like them; the others keep every bit; every leaf has B first."""
    loop, batch = loop_of(place, defence), 2 if slow(defence) else 3
    rival = tailgate.make_attack("fdi_gaussian", targets=loop.model.sensors)
    state = loop.start(keys("train", range(batch)))
    plan = rival.prepare(loop.brief)
    memory = rival.start(plan, batch, state.keys.at(Role.ATTACK, np.zeros(batch, np.int64)))
    for _ in range(5):
        state, memory, _ = loop.step(state, rival, plan, memory)
    assert all(len(leaf) == batch for leaf in leaves(state).values())
    after = loop.restart(state, np.arange(batch) == 1)
    fresh = loop.start(Keys(state.keys.key[1:2], state.keys.episode[1:2] + np.uint32(1)))
    assert same_tree(after, fresh, [1]) == [] and same_tree(state, fresh, [1]) != []
    kept = leaves(state)
    assert all(np.array_equal(leaf[0], kept[name][0], equal_nan=True) for name, leaf in leaves(after).items())
    nothing = tailgate.make_attack("none")
    for _ in range(3):
        after, _, ours = loop.step(after, nothing, loop.brief, None)
        fresh, _, theirs = loop.step(fresh, nothing, loop.brief, None)
        np.testing.assert_array_equal(ours.estimate.x[1], theirs.estimate.x[0])
        np.testing.assert_array_equal(ours.wires[1], theirs.wires[0])


@pytest.mark.thin(13)
@each
def test_a_white_box_looks_at_will_and_writes_nothing(defence, place, spoil):
    """Playing ahead with the defence's state, then scribbling over all that a view shows, changes nothing of the episode."""
    held, batch = loop_of(place, defence), 1 if slow(defence) else 2
    loop = dataclasses.replace(held)  # what is shown is spoiled: a copy of its own, of the same plan
    vars(loop).update(model=held.model, plan=held.plan)

    class Vandal(type(tailgate.make_attack("none"))):
        def decide(self, plan, state, view, draws):
            box = view.defence
            if view.k[0] <= STEPS // 2:
                received = view.received._replace(y=view.received.y + 9.0, attacked=np.zeros_like(view.received.valid))
                box.defence.step(box.plan, box.state, received, box.known_u, draws)
            else:
                spoil([box.plan, box.state, view._replace(defence=None)])
            return super().decide(plan, state, view, draws)

    plain, spoiled = (play(loop, attack, range(batch)) for attack in ("none", Vandal()))
    assert [plain.trace_hash(i) for i in range(batch)] == [spoiled.trace_hash(i) for i in range(batch)]


@pytest.mark.parametrize("attack, place", [(a, p) for p in PLACES for a in ATTACKS])
@pytest.mark.thin(14)
def test_an_attack_runs_within_what_is_granted(attack, place):
    """Its rows do not depend on their batch; before the onset, and ever after on the agents not granted, what is sent arrives."""
    loop = loop_of(place, "chi2_dkf")
    rival = tailgate.make_attack(attack)
    try:
        whole = play(loop, rival, range(16))
    except NotApplicable as error:
        pytest.skip(str(error))
    known = [whole.trace_hash(i) for i in range(16)]
    some, alone = play(loop, rival, [2, 0, 77]), play(loop, rival, [1])
    assert [some.trace_hash(0), some.trace_hash(1), alone.trace_hash(0)] == [known[2], known[0], known[1]]
    others = ~loop.brief.granted.any(axis=1)
    assert (0 < others.sum() < len(others)) == (place in MANY)
    np.testing.assert_array_equal(whole.wires[:, :, others], whole.clean[:, :, others])
    np.testing.assert_array_equal(whole.applied[:, :, others], whole.control[:, :, others])
    assert not whole.target[:, :, others].any() and not whole.refused.any()
    clean = play(loop, "none", range(16))
    for name in clean.signals:
        np.testing.assert_array_equal(whole.signals[name][: ONSET - 1], clean.signals[name][: ONSET - 1], err_msg=name)


@pytest.mark.parametrize("place", MANY)
def test_what_has_no_meaning_says_so(place):
    """Who is skipped above is skipped for a reason: no steady state alone, no sensor of a state itself, no input of one's own."""
    here, model = place_of(place), place_of(place).brief().model
    reasons = {}
    for family, names in (("defence", DEFENCES), ("attack", ATTACKS)):
        for name in names:
            try:
                if family == "defence":
                    tailgate.make_defence(name).prepare(model)
                else:
                    tailgate.make_attack(name).prepare(here.brief())
            except NotApplicable as error:
                reasons[name] = str(error)
    assert "agents 1" in reasons["rkf"].replace("agents 0, 1", "agents 1") and "detectable" in reasons["rkf"]
    assert "one agent" in reasons["covert"] and "one agent" in reasons["zero_dynamics"]
    assert ("none" in reasons) == ("actuator_fdi" in reasons) == (place == "network-weak-v0")
    assert not {"kf", "imm", "chi2_kf", "dkf", "chi2_dkf", "filterpy_kf", "oracle", "fdi", "stealth", "replay", "delay"} & set(reasons)
