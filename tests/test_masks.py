"""Masks: an action is open where the channel accepts it in at least one step of the decision, and illegal where it does in none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tailgate
from tailgate.base.errors import InputError
from tailgate.core import Kind, Received
from tailgate.core.channel import Channel
from tailgate.core.scenario import load_scenario
from tailgate.core.threat import Brief, ThreatModel
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv

from .engines import same

LIMITS = [
    {"budget": 9, "duration": 3, "cooldown": 2, "onset": 1, "end": 75},
    {"budget": 40, "duration": 6, "cooldown": 4, "onset": 14, "end": 133},
    {"budget": None, "duration": 5, "cooldown": 23, "onset": 8, "end": None},
    {"budget": 15, "duration": None, "cooldown": 0, "onset": 33, "end": 90},
]
SEATS = {
    "car": {"scenario": "gusty-stop-and-go-v0", "defence": "kf", "value": -9.0},
    "platoon": {"scenario": "platoon-gusty-v0", "defence": "dkf", "per_sensor": True, "action": "ramp"},
    "radar": {"scenario": "radar-following-v0", "defence": "cra", "action": "timing", "kind": "echo_delay"},
}
MODEL = load_scenario("stop-and-go-v0").brief().model


@pytest.mark.long
@settings(max_examples=60)
@given(
    onset=st.integers(1, 6), more=st.none() | st.integers(0, 20), budget=st.none() | st.integers(0, 9), duration=st.none() | st.integers(1, 4),
    cooldown=st.integers(0, 9), history=st.lists(st.booleans(), max_size=25),
)  # fmt: skip
def test_one_of_the_next_steps_is_open_where_the_channel_accepts_in_one(onset, more, budget, duration, cooldown, history):
    """After any history, for every number of steps: as the channel itself says when it is asked in all of them."""
    threat = ThreatModel(onset=onset, end=None if more is None else onset + more, budget=budget, duration=duration, cooldown=cooldown)
    channel, brief = Channel(), Brief(MODEL, threat, 24)
    plan = channel.prepare(brief)
    y, u = np.zeros((1, 1, 4)), np.zeros((1, 1, 1))
    received = Received(y[..., :2], np.ones((1, 1, 2), bool), np.zeros((1, 1)))
    ask, rest = (brief.command(np.array([on]), Kind.FDI, brief.granted, 1.0) for on in (True, False))

    def step(state, command, k):
        return channel.actuate(plan, channel.apply(plan, state, y, received, command, np.array([k]))[0], u)[0]

    state = channel.start(plan, y, u)
    for k, on in enumerate(history, 1):
        held, accepted = state, False
        for steps in range(1, 13):
            before, held = held.used, step(held, ask, k + steps - 1)
            accepted |= bool(held.used > before)
            said = channel.open(plan, np.array([k]), channel.budget_left(plan, state), state.burst, state.cooldown, steps)
            assert said.tolist() == [accepted], (k, steps)
        state = step(state, ask if on else rest, k)


@pytest.mark.thin(40)
@pytest.mark.parametrize("limits", LIMITS, ids=range(len(LIMITS)))
@pytest.mark.parametrize("interval", [1, 2, 7, 20])
@pytest.mark.parametrize("seat", SEATS)
def test_an_action_is_illegal_exactly_where_its_mask_is_closed(seat, interval, limits):
    """In random play, in both engines alike; an open one costs budget and a closed one none."""
    arguments = SEATS[seat] | {"interval": interval, "threat": limits, "illegal_penalty": 0.3}
    fast, plain = (AdversaryVectorEnv(12, engine=engine, **arguments) for engine in ("traced", "plain"))
    same(fast.reset(seed=2)[1], plain.reset(seed=2)[1])
    rng, opened, closed = np.random.default_rng(1), 0, 0
    for _ in range(min(140, max(20, 280 // interval))):
        mask, fast_mask, over, used = plain.action_masks(), fast.action_masks(), plain.over.copy(), plain.state.channel.used
        actions = rng.integers(0, mask.shape[1], 12)
        *results, info = plain.step(actions)
        for one, two in zip(fast.step(actions), (*results, info), strict=True):
            same(one, two)
        here = mask[np.arange(12), actions]
        assert mask[:, 0].all() and np.array_equal(mask, fast_mask) and np.array_equal(info["illegal"], ~here & ~over)
        cost = (plain.state.channel.used > used)[~over]
        assert np.array_equal(cost, (here & (actions != 0))[~over])
        opened, closed = opened + np.count_nonzero(cost), closed + np.count_nonzero(info["illegal"])
    assert opened >= 12 and (closed > 15 or (interval == 20 and limits["budget"] is None))


@pytest.mark.long
def test_a_collision_within_a_decision_makes_it_not_illegal():
    """A pause that would have been over in it leaves the action open, though the episode ends before."""
    seen = 0
    for seed in range(40):
        env = AdversaryVectorEnv(8, scenario="gusty-stop-and-go-v0", defence="kf", value=-9.0, interval=20, threat={"duration": 20, "cooldown": 18})
        env.reset(seed=8 * seed)
        while not env.over.any():
            mask = env.action_masks()
            *_, ended, _, info = env.step(np.full(8, 1 + [m.name for m in env.seat.action.modes[1:]].index("fdi-")))
            assert np.array_equal(info["illegal"], ~mask[:, 1])
        seen += np.count_nonzero(ended)
    assert seen


@pytest.mark.parametrize("interval", [1, 20])
def test_a_decision_that_is_refused_throughout_costs_the_penalty_once(interval):
    """Whatever its length; one that is accepted in part costs nothing."""
    paid = {}
    for penalty in (0.0, 0.25):
        env = tailgate.envs.gym.gymnasium_env.AdversaryEnv(interval=interval, illegal_penalty=penalty, threat={"onset": 5, "budget": 3, "kinds": ["fdi"]})
        env.reset(seed=0)
        paid[penalty] = [(reward, info["illegal"]) for reward, info in ((out[1], out[4]) for out in (env.step(1) for _ in range(12)))]
    for (without, illegal), (with_it, again) in zip(*paid.values(), strict=True):
        assert illegal == again and with_it == pytest.approx(without - 0.25 * illegal, abs=1e-12)
    assert [illegal for _, illegal in paid[0.0]] == ([True] * 4 + [False] * 3 + [True] * 5 if interval == 1 else [False] + [True] * 11)


def test_an_authenticated_wire_is_no_target():
    """It takes no forged value, and no recorded one that is older than its key allows; every action that is open is accepted."""
    limits = {"kinds": ["fdi", "dos_jam", "dropout", "delay"], "fdi_bound": 3.0, "onset": 1, "memory": 9, "key_interval": 3}
    arguments = {"scenario": "gusty-stop-and-go-v0", "defence": "kf", "value": 2.0, "action": "mode", "steps": 5}
    env = AdversaryVectorEnv(8, engine="plain", threat=limits | {"authenticated": ["position"]}, **arguments)
    env.reset(seed=0)
    for mode in env.seat.action.modes[1:]:
        assert mode.target[0, :2].tolist() == [mode.name == "dropout", True], mode.name
    _, _, _, _, info = env.step(np.arange(8) % env.single_action_space.n)
    assert not info["illegal"].any()
    with pytest.raises(InputError, match="authenticated"):
        AdversaryVectorEnv(1, threat=limits | {"kinds": ["fdi"], "authenticated": ["position", "velocity"]}, **arguments)
