"""Episodes whose random numbers come from other keys in each step: what splitting plays.

A state depends on the keys up to its step alone. So two episodes with the same keys up to a step are one episode until then. No state has
to be kept: a branch is played from the start again, to the same bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tailgate.core import Array, Attack
from tailgate.core.draws import Keys, Role, first_episodes
from tailgate.core.loop import Loop, LoopState
from tailgate.engine.agreement import Untraced
from tailgate.falsify.claim import Invariant
from tailgate.play.commanded import Steps, commanded
from tailgate.play.trace import Recorder, Trace, signals_of


def played(loop: Loop, attack: Attack, keys: Array, plain: bool = False) -> Trace:
    """Play an episode in each row, with the keys (K, B, 3) of each step; a collision ends it.

    `plain` selects the plain loop, with the same bits.
    """
    program = None if plain else commanded(loop)
    state = loop.start(_keys(keys[0]))
    plan = attack.prepare(loop.brief)
    memory = attack.start(plan, keys.shape[1], state.keys.at(Role.ATTACK, np.zeros(keys.shape[1], np.int64)))
    recorder, view, ended = Recorder(loop, state), loop.sense(state), state.ended
    steps = None if program is None or isinstance(program, Untraced) else Steps(program, state)
    for k in range(loop.horizon):
        live = ~ended
        if not live.any():
            break
        now = _keys(keys[k])
        memory, command = attack.decide(plan, memory, view, now.at(Role.ATTACK, view.k))
        if steps is None:
            state, frame = loop.advance(_with_keys(state, now), command)
            signals, ended, view = signals_of(frame), state.ended, loop.sense(state)
        else:
            if k and not np.array_equal(keys[k], keys[k - 1]):
                steps.state.put_leaf("loop.keys.key", keys[k])
            signals, ended, view = steps.play(command)
        recorder.put(signals, live)
    return recorder.trace()


def _keys(key: Array) -> Keys:
    return Keys(key, first_episodes("report", len(key)))


def _with_keys(state: LoopState, keys: Keys) -> LoopState:
    return state._replace(keys=keys)


def as_data(keys: Array) -> list[list[int | str]]:
    """Return the keys (K, 3) of a path as JSON data: the steps at which they change, and the keys from there on, in hexadecimal."""
    changes = [0, *(np.flatnonzero(np.any(keys[1:] != keys[:-1], axis=1)) + 1).tolist()]
    return [[k, *(f"{int(part):016x}" for part in keys[k])] for k in changes]


def from_data(data: list[list[Any]], steps: int) -> Array:
    """Return the keys (K, 1, 3) of a path that `as_data` wrote."""
    out = np.zeros((steps, 1, 3), np.uint64)
    for k, *parts in data:
        out[k:, 0] = [int(part, 16) for part in parts]
    return out


class Branches:
    """Episodes of a loop under an attack as a process for splitting: the margins of an invariant, step by step."""

    def __init__(self, loop: Loop, attack: Attack, invariant: Invariant, at_once: int) -> None:
        self.loop, self.attack, self.invariant, self.at_once = loop, attack, invariant, at_once

    def __call__(self, keys: Array) -> Array:
        """Return margins (K, B) of keys (K, B, 3)."""
        parts = [keys[:, first : first + self.at_once] for first in range(0, keys.shape[1], self.at_once)]
        return np.concatenate([self.invariant.margins(played(self.loop, self.attack, part), self.loop.horizon) for part in parts], axis=1)
