"""Attacks on messages: losses in bursts by Gilbert and Elliott's channel, and falsified accelerations."""

import dataclasses

import numpy as np
import pytest

import tailgate
from tailgate.agents.scripts.burst_loss import BurstLoss, groups
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Kind
from tailgate.core.draws import keys
from tailgate.core.scenario import load_scenario
from tailgate.envs.controllers.cacc import V2V
from tailgate.play.trace import rollout


def place_of(horizon=450, **threat):
    return dataclasses.replace(load_scenario("platoon-v2v-v0").with_threat(**({"onset": 1} | threat)), horizon=horizon)


def play(attack, seeds=range(8), place=None, defence="none", **options):
    place = place or place_of()
    return rollout(place.loop(tailgate.make_defence(defence)), attack, keys("train", list(seeds)), **options)


def lost(trace):
    """(K, B, followers, senders) bool: the messages that were lost."""
    return trace.target[:, :, 1:, 3:5]


def runs(series):
    """Lengths of the complete runs of True in (K,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], series.astype(int), [0]])))
    return [b - a for a, b in edges.reshape(-1, 2) if a > 0 and b < len(series)]


@pytest.mark.long
def test_bursts_have_the_chains_statistics():
    """Gilbert's channel (all lost in the bad state): the share of losses is fail / (fail + recover), a burst lasts 1 / recover steps."""
    trace = play(BurstLoss(fail=0.03, recover=0.15), range(64), terminate=False)
    gone = lost(trace)
    assert gone.mean() == pytest.approx(0.03 / 0.18, abs=0.01)
    np.testing.assert_allclose(gone.mean(axis=(0, 1)), 0.03 / 0.18, atol=0.03)  # every car and sender
    assert gone[0].mean() == pytest.approx(0.03 / 0.18, abs=0.05)  # from the first step on: it starts in its steady state
    spans = [n for b in range(64) for i in range(4) for s in range(2) for n in runs(gone[:, b, i, s])]
    assert np.mean(spans) == pytest.approx(1.0 / 0.15, rel=0.05)
    assert np.mean(np.array(spans) == 1) == pytest.approx(0.15, abs=0.02)  # geometric


@pytest.mark.long
def test_losses_in_both_states():
    """Elliott's channel: the share of losses is the states' mean, and losses of neighbouring steps go together as the states do."""
    trace = play(BurstLoss(fail=0.05, recover=0.05, loss_good=0.1, loss_bad=0.7), range(64), terminate=False)
    gone = lost(trace).astype(float)
    assert gone.mean() == pytest.approx(0.4, abs=0.015)
    together = np.mean((gone[1:] - 0.4) * (gone[:-1] - 0.4))
    assert together == pytest.approx(0.25 * 0.6**2 * 0.9, rel=0.1)  # var of the states' loss rates times 1 - fail - recover


def test_the_fields_of_one_sender_come_in_one_message():
    """The predecessor's acceleration and command are lost together, the leader's acceleration and other cars' messages by themselves."""
    trace = play(BurstLoss(fail=0.1, recover=0.1), range(64), terminate=False)
    np.testing.assert_array_equal(trace.target[..., 3], trace.target[..., 5])
    gone = lost(trace).reshape(-1, 8).astype(float)
    link = np.corrcoef(gone.T) - np.eye(8)
    assert np.abs(link).max() < 0.15
    assert groups(place_of().brief()).tolist() == [0, 1, 2, 3, 4, 3, 5]


def test_a_receiver_keeps_its_last_value():
    """What arrives of a lost message is what arrived before; what is not lost arrives as sent; sensors are untouched."""
    trace = play(BurstLoss(fail=0.1, recover=0.1), terminate=False)
    sent, came, gone = trace.clean[..., 3:], trace.wires[..., 3:], trace.target[..., 3:6]
    np.testing.assert_array_equal(came[1:], np.where(gone[1:], came[:-1], sent[1:]))
    np.testing.assert_array_equal(trace.wires[..., :3], trace.clean[..., :3])
    assert gone.any() and not trace.target[..., :3].any() and not trace.refused.any()
    assert set(np.unique(trace.kind)) == {Kind.NONE, Kind.DROPOUT}


@pytest.mark.parametrize("attack, share", [(BurstLoss(fail=0.0, recover=1.0), 0.0), (BurstLoss(fail=1.0, recover=0.0), 1.0)])
def test_channels_that_never_change(attack, share):
    """One that never fails loses nothing, one that never recovers everything."""
    assert lost(play(attack, place=place_of(40), terminate=False)).mean() == share


def test_the_chain_runs_while_the_window_is_closed():
    """A window that opens later shows the same channel from then on."""
    always, later = (play(BurstLoss(start_step=start), place=place_of(60), terminate=False) for start in (1, 31))
    assert not lost(later)[:30].any()
    np.testing.assert_array_equal(lost(later)[30:], lost(always)[30:])


def test_targets_and_agents():
    """Named wires and agents only; without targets, messages where they are granted, and else the sensors."""
    some = BurstLoss(fail=0.5, recover=0.5, targets=("leader_acceleration",), agents=(2,))
    hit = play(some, place=place_of(40), terminate=False).target.any(axis=(0, 1))
    assert np.argwhere(hit).tolist() == [[2, 4]]
    both = place_of(40, targets=("distance", *V2V))
    assert np.flatnonzero(play(BurstLoss(fail=0.5), place=both, terminate=False).target.any(axis=(0, 1, 2))).tolist() == [3, 4, 5]
    alone = place_of(40, targets=("distance", "velocity"))
    trace = play(BurstLoss(fail=0.5), place=alone, terminate=False)
    assert np.flatnonzero(trace.target.any(axis=(0, 1, 2))).tolist() == [0, 1]
    assert (trace.target[..., 0] != trace.target[..., 1]).any()  # sensors have a channel each


def test_what_is_not_granted():
    """Without the kind, or for a wire that is not granted, it does not apply; a chain without transitions has no steady state."""
    with pytest.raises(NotApplicable, match="dropout"):
        BurstLoss().prepare(place_of(kinds=("fdi",)).brief())
    with pytest.raises(NotApplicable, match="distance"):
        BurstLoss(targets=("distance",)).prepare(place_of().brief())
    with pytest.raises(InputError, match="recover"):
        BurstLoss(fail=0.0, recover=0.0)


def test_falsified_accelerations_reach_the_controllers_and_no_sensor():
    """fdi on a message adds its value to what arrives; f follows w1 times it; the bound is the threat model's."""
    place = place_of(100)
    loop = place.loop(tailgate.make_defence("dkf"))
    states = []
    for attack in ("none", "fdi"):
        rival = tailgate.make_attack(attack, **({} if attack == "none" else {"value": 4.0, "targets": ("predecessor_acceleration",)}))
        state, plan = loop.start(keys("train", range(3))), rival.prepare(loop.brief)
        memory = rival.start(plan, 3, state.keys.at(16, np.zeros(3, np.int64)))
        state, memory, frame = loop.step(state, rival, plan, memory)
        states.append((state, frame))
    (quiet, _), (lied, frame) = states
    np.testing.assert_array_equal(frame.wires[..., :3], frame.clean[..., :3])
    np.testing.assert_allclose(frame.wires[:, :, 3] - frame.clean[:, :, 3], 4.0)
    np.testing.assert_allclose((lied.controller.f - quiet.controller.f)[:, 1:], 0.5 * 4.0 * (1.0 - np.exp(-0.1 / 3.0)), rtol=1e-9)
    bounded = play(tailgate.make_attack("fdi", value=40.0, targets=("leader_acceleration",)), place=place_of(20), terminate=False)
    assert np.abs(bounded.wires - bounded.clean).max() == pytest.approx(10.0)


@pytest.mark.long
def test_falsified_accelerations_collide_and_lost_ones_do_not():
    """A bias of 10 m/s^2 takes the cars out of their gaps when they stop; at a headway of 3 s lost messages, even for seconds, do not."""
    lie = tailgate.make_attack("fdi", value=10.0, targets=("predecessor_acceleration",))
    ramp = tailgate.make_attack("fdi_ramp", rate=0.05, limit=10.0, targets=("predecessor_acceleration",))
    for attack in (lie, ramp):
        assert play(attack, defence="dkf").collided.any(axis=0).all()
    for attack in (BurstLoss(), BurstLoss(fail=0.05, recover=0.02)):
        assert not play(attack, defence="dkf").collided.any()
