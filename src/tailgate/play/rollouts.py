"""Whole episodes of a loop under an attack as one program: the record of `tailgate.play.trace.rollout`, with the attack traced too."""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np

from tailgate.core import Attack
from tailgate.core.draws import Keys, Role
from tailgate.core.loop import Loop, LoopState
from tailgate.engine.agreement import ROWS, Untraced, apart, check_open
from tailgate.engine.cards import device
from tailgate.engine.operations import Array
from tailgate.engine.parameters import lifted
from tailgate.engine.program import program_class
from tailgate.engine.remembered import Remembered
from tailgate.engine.tracing import traced

STEPS = 32  # between checks if all episodes have ended


class Episodes(NamedTuple):
    """The state of a loop and of its attack."""

    loop: LoopState
    memory: object


class Rollout:
    """The program of a loop under an attack; tracing raises whatever their parts raise."""

    def __init__(self, loop: Loop, attack: Attack, plan: object) -> None:
        check_open(loop)
        self.loop, self.attack, self.plan = loop, attack, plan
        self.values: list[Array] | None = None  # of the parameters, if they differ from the traced ones
        self.program = program_class(device())(traced(self._traced, self.begun(_ONE), None).pruned(keep=["loop.ended"]))
        self.programs = (self.program,)

    def of(self, loop: Loop, attack: Attack, plan: object, values: list[Array]) -> Rollout:
        """Return the same program for a loop and an attack with other parameters."""
        out = copy.copy(self)
        out.loop, out.attack, out.plan, out.values = loop, attack, plan, values
        return out

    def begun(self, keys: Keys) -> Episodes:
        """Return the first state of episodes."""
        return _begun(self.loop, self.attack, self.plan, keys)

    def _traced(self, held: Episodes, _: None) -> tuple[Episodes, dict[str, Array]]:
        loop, attack, plan = lifted(held.loop.k, (self.loop, self.attack, self.plan))
        return _step(loop, attack, plan, held)

    def plain(self, held: Episodes) -> tuple[Episodes, dict[str, Array]]:
        """Play a step of the plain loop; return the next state and its signals."""
        return _step(self.loop, self.attack, self.plan, held)

    def play(self, keys: Keys, terminate: bool) -> tuple[Array, dict[str, Array], dict[str, Array]]:
        """Play episodes; return lengths (B,), signals (K, B, ...) and the road before the first step, as `Trace` holds them."""
        loop, batch, begun = self.loop, len(keys.key), self.begun(keys)
        self.program.check("batch", batch, loop.horizon)
        first = loop.plant.scene(loop.plan.plant, begun.loop.plant)._asdict()
        state = self.program.rows(batch)
        state.put(begun)
        call = self.program.call(state, max(2, loop.horizon), self.values)
        call.begin()
        signals, done = call.results(), 0
        demands, ended = signals.pop("demands"), signals.pop("ended")
        while done < loop.horizon and not (terminate and done and ended[done - 1].all() and state.every("loop.ended")):
            steps = min(STEPS, loop.horizon - done)
            call.play(steps)
            if call.broken:
                self._demand(demands[done : done + steps], ended[done : done + steps], done, terminate)
            done += steps
        length = np.count_nonzero(~ended[:done], axis=0) if terminate else np.full(batch, done)
        steps = int(length.max(initial=0))
        return length.astype(np.int64), {name: value[:steps] for name, value in signals.items()}, first

    def _demand(self, held: Array, ended: Array, first: int, terminate: bool) -> None:
        """Raise the error of the plain loop for the demands of these steps (K, B, .); steps after all episodes ended do not count."""
        for step in np.flatnonzero(~held.all(axis=(1, 2))):
            if terminate and ended[step].all():
                return
            raise self.program.broken(held[step], np.full(held.shape[1], first + step + 1))


def _begun(loop: Loop, attack: Attack, plan: object, keys: Keys) -> Episodes:
    batch = len(keys.key)
    memory = attack.start(plan, batch, keys.at(Role.ATTACK, np.zeros(batch, np.int64)))
    return Episodes(loop.start(keys), memory)


def _step(loop: Loop, attack: Attack, plan: object, held: Episodes) -> tuple[Episodes, dict[str, Array]]:
    from tailgate.play.trace import signals_of

    state, memory, frame = loop.step(held.loop, attack, plan, held.memory)
    return Episodes(state, memory), signals_of(frame) | {"ended": held.loop.ended}


_ONE = Keys(np.zeros((1, 3), np.uint64), np.zeros(1, np.uint32))


_made: Remembered[Rollout] = Remembered()


def rollout_of(loop: Loop, attack: Attack) -> Rollout | Untraced:
    """Return the program of a loop under an attack, if it equals the plain loop on this machine; else the reason why there is none."""
    plan = attack.prepare(loop.brief)
    return _made.proved(
        (loop, attack, plan, device()),
        lambda: _sensed(loop, _begun(loop, attack, plan, _ONE)),
        lambda: _step(check_open(loop), attack, plan, _begun(loop, attack, plan, _ONE)),
        lambda: Rollout(loop, attack, plan),
        lambda found, values: found.of(loop, attack, plan, values),
        _difference,
    )


def _sensed(loop: Loop, begun: Episodes) -> Episodes:
    loop.sense(begun.loop)  # caches what an attacker's view needs
    return begun


def _difference(rollout: Rollout) -> str:
    from tailgate.core import draws

    def later(held: Episodes, steps: Array) -> Episodes:
        return held._replace(loop=rollout.loop.later(held.loop, steps))

    return apart(rollout.program, rollout.begun(draws.keys("tune", range(ROWS))), rollout.plain, rollout.loop.horizon, later)
