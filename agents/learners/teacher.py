"""Demonstrations for a learner before it learns: the decisions of a scripted attack, and their returns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tailgate.agents.learners.learning import SEED_STRIDE
from tailgate.base.errors import InputError
from tailgate.core import Array, Attack, Command, draws
from tailgate.core.draws import Role
from tailgate.envs.gym.actions import ActionCodec
from tailgate.envs.gym.attacker_mdp import Seat

FIRST = SEED_STRIDE // 2  # number of the first demonstration among the episodes of a training seed


class Demonstration(NamedTuple):
    """D decisions: the observation (D, d), the action (D,), and the discounted return from there on (D,)."""

    observation: Array
    action: Array
    gained: Array


def nearest(codec: ActionCodec, command: Command) -> Array:
    """Return the discrete action (B,) nearest to a command: of its kind, with the fewest other targets, then the nearest values.

    Rest where no action has that kind.
    """
    best, action = np.full(len(command.kind), np.inf), np.zeros(len(command.kind), np.int64)
    for j, mode in enumerate(codec.modes):
        others = np.count_nonzero(command.target ^ mode.target, axis=(1, 2))
        off = np.max(np.where(command.target & mode.target, np.abs(command.value - mode.value), 0.0), axis=(1, 2))
        distance = np.where(command.kind == mode.kind, others + off / (1.0 + off), np.inf)  # values never outweigh a target
        closer = distance < best
        best, action = np.where(closer, distance, best), np.where(closer, j, action)
    return action


def demonstrate(seat: Seat, attack: Attack, seed: int, episodes: int) -> Demonstration:
    """Play what comes nearest to a script at each decision, on training episodes of a seed. Discrete actions only."""
    if not seat.action.discrete:
        raise InputError("teacher", seat.action.spec.action, "a discrete action: timing, mode or ramp")
    loop = seat.loop
    keys = draws.keys("train", range(seed * SEED_STRIDE + FIRST, seed * SEED_STRIDE + FIRST + episodes))
    state, plan = loop.start(keys), attack.prepare(loop.brief)
    memory = attack.start(plan, episodes, keys.at(Role.ATTACK, np.zeros(episodes, np.int64)))
    tally, seen = seat.begin(state), None
    observations, actions, rewards, live = [], [], [], []
    for _ in range(seat.decisions):
        over, view = state.ended.copy(), loop.sense(state)
        seen = seat.observation.observe(view, seen)
        memory, command = attack.decide(plan, memory, view, keys.at(Role.ATTACK, state.k))
        for _ in range(seat.action.spec.interval - 1):  # the script's clock runs on while a decision holds
            memory, _ = attack.decide(plan, memory, view, keys.at(Role.ATTACK, state.k))
        action = nearest(seat.action, command)
        state, tally, outcome, _ = seat.step(state, tally, action, over)
        observations.append(seen)
        actions.append(action)
        rewards.append(outcome.reward)
        live.append(~over)
    gained = np.array(rewards)
    for k in range(len(gained) - 2, -1, -1):
        gained[k] += seat.reward.gamma * gained[k + 1]
    played = np.array(live)
    return Demonstration(np.array(observations)[played], np.array(actions)[played], gained[played])
