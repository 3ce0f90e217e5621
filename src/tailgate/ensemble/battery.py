"""Many scripts at once: each row of a batch plays a script of its own, in one program.

The engine traces the loop with scripts whose numbers are part of the state. So it compiles once, and plays whatever script comes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tailgate.base.pytree import leaves
from tailgate.core import Array, Command, View
from tailgate.core.draws import Draws, Keys
from tailgate.core.kinds import EFFECTS
from tailgate.core.loop import Loop
from tailgate.core.threat import Brief
from tailgate.engine.agreement import ROWS, TRIED, Untraced, check_open, raised, same
from tailgate.engine.parameters import lifted
from tailgate.engine.program import Call, Program, State, traced
from tailgate.engine.remembered import Remembered
from tailgate.ensemble.space import TRIGGERS, Rows

STEPS = 32  # between two looks whether an episode is left
NEAR, FAST, SLOW, CLOSING, BRAKING = (TRIGGERS.index(name) for name in ("near", "speed", "slow", "closing", "leader_braking"))


class Memory(NamedTuple):
    """The scripts and what they remember; every leaf has B first."""

    rows: Rows
    opened: Array  # (B,) bool: the trigger has fired
    elapsed: Array  # (B,) int64: steps since it first fired
    lead_speed: Array  # (B, N) at the last look; -inf before the first


class Played(NamedTuple):
    """The outcome of episodes (B,) so far."""

    ended: Array  # a collision
    gap: Array  # smallest gap of a car behind another [m]; inf where nobody drives
    error: Array  # largest error of an estimate


class Scripts:
    """An attack that plays a script of its own in each row."""

    def prepare(self, brief: Brief) -> Brief:
        """Return the brief."""
        return brief

    def decide(self, plan: Brief, memory: Memory, view: View, draws: Draws) -> tuple[Memory, Command]:
        """Return the next memory and the commands: what `tailgate.agents.scripts` sends under the same numbers."""
        rows, scene, level = memory.rows, view.scene, memory.rows.threshold[:, None]
        trigger = rows.trigger[:, None]
        holds = np.where(trigger == NEAR, scene.gap < level, trigger == 0)
        holds = np.where(trigger == FAST, scene.speed > level, holds)
        holds = np.where(trigger == SLOW, scene.speed < level, holds)
        holds = np.where(trigger == CLOSING, scene.speed - scene.lead_speed > level, holds)
        holds = np.where(trigger == BRAKING, (memory.lead_speed - scene.lead_speed) / plan.model.dt > level, holds)
        ready = (view.k >= rows.start) & (view.k >= plan.threat.onset)
        opened = memory.opened | (ready & holds.any(axis=1))
        count = memory.elapsed
        on = opened & view.allowed & (count % (rows.burst + rows.pause) < rows.burst)
        if view.probed is not None:
            on = on & (view.probed.any(axis=1) | ~rows.hop)
        kind = np.where(count < rows.switch, rows.kind, rows.then)
        raw = (rows.base + rows.rate * (count + 1))[:, None, None]
        value, limits = np.zeros(rows.target.shape), plan.limits
        for number, effect in EFFECTS.items():
            if effect.valued and np.any(_granted(plan) == number):
                value = np.where((kind == number)[:, None, None], effect.clip(limits, raw + np.zeros(rows.target.shape)), value)
        after = Memory(rows, opened, memory.elapsed + opened, np.array(scene.lead_speed))
        target = on[:, None, None] & rows.target
        hit = target.any(axis=(1, 2))
        return after, Command(np.where(hit, kind, 0).astype(np.int8), target, np.where(target, value, 0.0))


def _granted(plan: Brief) -> Array:
    """Return the numbers of the kinds that are granted."""
    from tailgate.core.kinds import Kind

    return np.array([int(Kind[name.upper()]) for name in plan.threat.kinds])


class Battery:
    """The program of a loop under scripts. Raises whatever its parts raise while they are traced."""

    def __init__(self, loop: Loop, like: Rows) -> None:
        check_open(loop)
        self.loop, self.values = loop, None
        one = begun(loop, Keys(np.zeros((1, 3), np.uint64), np.zeros(1, np.uint32)), like.take(np.zeros(1, np.int64)))
        self.program = Program(traced(self._traced, one, {}))

    @property
    def programs(self) -> tuple[Program, ...]:
        """The one program."""
        return (self.program,)

    def of(self, loop: Loop, values: list[Array]) -> Battery:
        """Return the same program for a loop of other parameters."""
        out = Battery.__new__(Battery)
        out.loop, out.values, out.program = loop, values, self.program  # type: ignore[assignment]
        return out

    def _traced(self, held: Any, given: Any) -> tuple[Any, Any]:
        return step(lifted(held["loop"].k, self.loop), held)

    def play(self, keys: Keys, rows: Rows) -> Played:
        """Play an episode in each row."""
        state = State(self.program, len(keys.key))
        state.put(begun(self.loop, keys, rows))
        call = Call(self.program, state, max(2, self.loop.horizon), self.values)
        call.begin()
        done = 0
        while done < self.loop.horizon and not state.get_leaf("loop.ended").all():
            call.play(min(STEPS, self.loop.horizon - done))
            done += STEPS
        return Played(*(state.get_leaf(name) for name in ("loop.ended", "gap", "error")))


def begun(loop: Loop, keys: Keys, rows: Rows) -> dict[str, Any]:
    """Return the state of episodes that begin."""
    batch, agents = len(keys.key), loop.model.agents
    memory = Memory(rows, np.zeros(batch, bool), np.zeros(batch, np.int64), np.full((batch, agents), -np.inf))
    return {"loop": loop.start(keys), "memory": memory, "gap": np.full(batch, np.inf), "error": np.zeros(batch)}


def step(loop: Loop, held: Any) -> tuple[Any, Any]:
    """Return the state one step later; an episode that has ended changes no more."""
    over = held["loop"].ended
    state, memory, frame = loop.step(held["loop"], Scripts(), loop.brief, held["memory"])  # type: ignore[arg-type]
    gap = np.min(np.where(loop.model.followers, frame.scene.gap, np.inf), axis=1)
    error = np.max(loop.model.error(frame.estimate.x, frame.truth), axis=1)
    gap = np.where(over, held["gap"], np.minimum(held["gap"], gap))
    error = np.where(over, held["error"], np.maximum(held["error"], error))
    return {"loop": state, "memory": memory, "gap": gap, "error": error}, {}


def played_plainly(loop: Loop, keys: Keys, rows: Rows) -> Played:
    """Play what `Battery.play` plays, in the plain loop: for defences that are not traced."""
    held = begun(loop, keys, rows)
    for _ in range(loop.horizon):
        if held["loop"].ended.all():
            break
        held, _ = step(loop, held)
    return Played(held["loop"].ended, held["gap"], held["error"])


_made: Remembered[Battery] = Remembered()


def battery_of(loop: Loop, rows: Rows) -> Battery | Untraced:
    """Return the program of a loop under scripts, once it has been found equal to the plain loop; or why there is none."""
    few = rows.take(np.arange(ROWS) % len(rows.kind))
    return _made.proved(
        loop, lambda: begun(loop, _keys(1), rows.take(np.zeros(1, np.int64))), lambda: Battery(loop, rows),
        lambda found, values: found.of(loop, values), lambda made: _difference(made, few),
    )  # fmt: skip


def _keys(batch: int) -> Keys:
    from tailgate.core import draws

    return draws.keys("tune", range(batch))


def _difference(made: Battery, rows: Rows) -> str:
    """Play some steps in both engines; return the first difference, or nothing."""
    plain = begun(made.loop, _keys(ROWS), rows)
    state = State(made.program, ROWS)
    state.put(plain)
    call = Call(made.program, state)
    for number in range(min(TRIED, made.loop.horizon)):
        results, found = call(), raised(lambda: step(made.loop, plain))  # noqa: B023
        if isinstance(found, str):
            return "" if not results["demands"].all() else f"step {number + 1}: {found}"
        plain = found[0]
        for name, leaf in leaves(plain).items():
            if not same(state.get_leaf(name), leaf):
                return f"{name}, step {number + 1}"
    return ""
