"""Demonstrations for a learner before it learns: the decisions of a scripted attack, and their returns."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any, NamedTuple

import numpy as np

from tailgate.agents.learners.learning import SEED_STRIDE
from tailgate.base.errors import InputError
from tailgate.core import Array, Attack, Command, draws
from tailgate.core.draws import Keys, Role
from tailgate.core.loop import LoopState
from tailgate.engine.agreement import ROWS, apart, check_open
from tailgate.engine.parameters import lifted
from tailgate.engine.program import Program
from tailgate.engine.remembered import Remembered
from tailgate.engine.tracing import traced
from tailgate.envs.gym.actions import ActionCodec
from tailgate.envs.gym.attacker_mdp import Seat, Tally
from tailgate.envs.gym.observations import ObservationCodec
from tailgate.play.trace import worth_tracing

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


class Shown(NamedTuple):
    """The state of demonstrated episodes."""

    loop: LoopState
    tally: Tally
    memory: Any  # of the script


class Showing:
    """The program of a seat's decisions that come nearest to those of a script. Raises whatever its parts raise while they are traced."""

    def __init__(self, seat: Seat, attack: Attack, plan: object) -> None:
        check_open(seat.loop)
        self.seat, self.attack, self.plan = seat, attack, plan
        self.values: list[Array] | None = None  # of the parameters, if they differ from the traced ones
        self.program = Program(traced(self._traced, begun(seat, attack, plan, _ONE), None).pruned(keep=["loop.ended"]))
        self.programs = (self.program,)

    def of(self, seat: Seat, attack: Attack, plan: object, values: list[Array]) -> Showing:
        """Return the same program for parameters of other values."""
        out = copy.copy(self)
        out.seat, out.attack, out.plan, out.values = seat, attack, plan, values
        return out

    def _traced(self, held: Shown, _: None) -> tuple[Shown, dict[str, Array]]:
        return decided(*lifted(held.loop.k, (self.seat, self.attack, self.plan)), held)

    def play(self, keys: Keys) -> dict[str, Array]:
        """Return the results (K, B, ...) of all decisions; raise the error of the first in which a demand fails."""
        state = self.program.rows(len(keys.key))
        state.put(begun(self.seat, self.attack, self.plan, keys))
        call = self.program.call(state, max(2, self.seat.decisions), self.values)
        out = call()
        if call.broken:
            k = int(np.argmin(out["demands"].all(axis=(1, 2))))
            raise self.program.broken(out["demands"][k], np.full(len(keys.key), k + 1))
        return out


def begun(seat: Seat, attack: Attack, plan: Any, keys: Keys) -> Shown:
    """Return the state of episodes that begin."""
    state, batch = seat.loop.start(keys), len(keys.key)
    return Shown(state, seat.begin(state), attack.start(plan, batch, keys.at(Role.ATTACK, np.zeros(batch, np.int64))))


def decided(seat: Seat, attack: Attack, plan: Any, held: Shown) -> tuple[Shown, dict[str, Array]]:
    """Play a decision; return the next state, and what was seen, done and gained in the rows that still play."""
    state, memory = held.loop, held.memory
    over, view, numbers = state.ended, seat.loop.sense(state), state.keys.at(Role.ATTACK, state.k)
    memory, command = attack.decide(plan, memory, view, numbers)
    for _ in range(seat.action.spec.interval - 1):  # the script's clock runs on while a decision holds
        memory, _ = attack.decide(plan, memory, view, numbers)
    action = nearest(seat.action, command)
    state, tally, outcome, _ = seat.step(state, held.tally, action, over)
    return Shown(state, tally, memory), {"seen": seat.observation.observe(view), "action": action, "reward": outcome.reward, "live": ~over}


def demonstrate(seat: Seat, attack: Attack, seed: int, episodes: int) -> Demonstration:
    """Play what comes nearest to a script at each decision, on training episodes of a seed. Discrete actions only."""
    if not seat.action.discrete:
        raise InputError("teacher", seat.action.spec.action, "a discrete action: timing, mode or ramp")
    keys = draws.keys("train", range(seed * SEED_STRIDE + FIRST, seed * SEED_STRIDE + FIRST + episodes))
    one = dataclasses.replace(seat, observation=ObservationCodec(seat.loop.brief), config={})
    played = _played(one, attack, attack.prepare(seat.loop.brief), keys)
    gained, live = played["reward"], played["live"]
    if not played["action"][live].any():
        kinds = ", ".join(sorted({mode.kind.name.lower() for mode in seat.action.modes[1:]}))
        asked = f"a script that attacks in one of {episodes} episodes here, with a kind that an action has: {kinds}"
        raise InputError("teacher", type(attack).__name__, asked)
    for k in range(len(gained) - 2, -1, -1):
        gained[k] += seat.reward.gamma * gained[k + 1]
    latest = np.arange(len(gained))
    seen = [played["seen"][np.maximum(latest - back, 0)] for back in range(seat.observation.frames)]  # the newest frame comes first
    return Demonstration(np.concatenate(seen, axis=-1)[live], played["action"][live], gained[live])


def _played(seat: Seat, attack: Attack, plan: object, keys: Keys) -> dict[str, Array]:
    """Return the results (K, B, ...) of all decisions, by a traced program where it pays: decisions of many steps take long to compile."""
    if seat.action.spec.interval == 1 and worth_tracing(seat.loop, len(keys.key)):
        made = _made.proved(
            (seat, attack, plan), lambda: decided(seat, attack, plan, begun(seat, attack, plan, _ONE)),
            lambda: None,  # the line above has played a step
            lambda: Showing(seat, attack, plan),
            lambda found, values: found.of(seat, attack, plan, values), _difference,
        )  # fmt: skip
        if isinstance(made, Showing):
            return made.play(keys)
    held, out = begun(seat, attack, plan, keys), []
    for _ in range(seat.decisions):
        held, results = decided(seat, attack, plan, held)
        out.append(results)
    return {name: np.array([one[name] for one in out]) for name in out[0]}


_ONE = Keys(np.zeros((1, 3), np.uint64), np.zeros(1, np.uint32))
_made: Remembered[Showing] = Remembered()


def _difference(made: Showing) -> str:
    first = begun(made.seat, made.attack, made.plan, draws.keys("tune", range(ROWS)))

    def later(held: Shown, steps: Array) -> Shown:
        return held._replace(loop=made.seat.loop.later(held.loop, steps))

    return apart(made.program, first, lambda held: decided(made.seat, made.attack, made.plan, held), made.seat.decisions, later)
