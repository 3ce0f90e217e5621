"""Many attacks at once, in one compiled program. Each row of a batch has another script or program, or all rows have one policy.

The numbers of scripts are part of the state, and the weights of a policy are parameters of the call. So the engine compiles once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, cast

import numpy as np

from tailgate.base.pytree import map_leaves, widened
from tailgate.core import Array, Attack, Command, View
from tailgate.core.draws import Draws, Keys
from tailgate.core.kinds import EFFECTS, Kind
from tailgate.core.loop import Loop
from tailgate.core.threat import Brief
from tailgate.engine.agreement import ROWS, Untraced, apart, check_open
from tailgate.engine.parameters import lifted
from tailgate.engine.program import Call, Program, State
from tailgate.engine.remembered import Remembered
from tailgate.engine.tracing import traced
from tailgate.ensemble.space import TRIGGERS, Rows, Sequence

OUTCOME = "loop.ended", "gap", "error", "moved"  # of `Played`, in the state
STEPS = 32  # between two looks whether an episode is left
NEAR, FAST, SLOW, CLOSING, BRAKING = (TRIGGERS.index(name) for name in ("near", "speed", "slow", "closing", "leader_braking"))
_ONE = Keys(np.zeros((1, 3), np.uint64), np.zeros(1, np.uint32))


class Memory(NamedTuple):
    """The scripts of B episodes and what they remember; every leaf has B first."""

    scripts: Sequence
    phase: Array  # (B,) int64: the phase that is armed
    attacked: Array  # (B,) int64: attacked steps of this phase
    opened: Array  # (B,) bool: the phase's trigger has fired
    elapsed: Array  # (B,) int64: steps since it first fired
    lead_speed: Array  # (B, N) at the last look; -inf before the first


class Played(NamedTuple):
    """The outcome of episodes (B,) so far."""

    ended: Array  # a collision that ends the episode
    gap: Array  # smallest gap of a car behind another [m]; inf where nobody drives, -inf after a collision that does not end the episode
    error: Array  # largest error of an estimate
    moved: Array  # distance of the car that comes least far [m]; inf where nobody drives


class Decider(Protocol):
    """An attack whose first memory is made elsewhere."""

    def decide(self, plan: Any, memory: Any, view: View, draws: Draws) -> tuple[Any, Command]:
        """Return the next memory and the commands."""


class Opening(Protocol):
    """The numbers of B triggers."""

    @property
    def trigger(self) -> Array:
        """(B,) int64: place in TRIGGERS."""

    @property
    def threshold(self) -> Array:
        """(B,) of the trigger."""

    @property
    def start(self) -> Array:
        """(B,) int64: first step."""


def opens(plan: Brief, view: View, rows: Opening, lead_speed: Array) -> Array:
    """Return (B,) bool: triggers fire in this step. lead_speed: (B, N) at the last look."""
    scene, level, trigger = view.scene, rows.threshold[:, None], rows.trigger[:, None]
    holds = np.where(trigger == NEAR, scene.gap < level, trigger == 0)
    holds = np.where(trigger == FAST, scene.speed > level, holds)
    holds = np.where(trigger == SLOW, scene.speed < level, holds)
    holds = np.where(trigger == CLOSING, scene.speed - scene.lead_speed > level, holds)
    holds = np.where(trigger == BRAKING, (lead_speed - scene.lead_speed) / plan.model.dt > level, holds)
    ready = (view.k >= rows.start) & (view.k >= plan.threat.onset)
    return np.asarray(ready & holds.any(axis=1))


@dataclass(frozen=True)
class Scripts:
    """An attack that plays another script, or another program of two phases, in each row."""

    programs: bool = False  # programs have other code than scripts

    def decide(self, plan: Brief, memory: Memory, view: View, draws: Draws) -> tuple[Memory, Command]:
        """Return the next memory and the commands: what `tailgate.agents.scripts` sends under the same numbers."""
        count = memory.elapsed
        rows = memory.scripts.phases[0]
        if self.programs:
            second = memory.phase == 1
            rows = Rows(*(np.where(widened(second, new), new, old) for old, new in zip(*memory.scripts.phases, strict=True)))
        opened = memory.opened | opens(plan, view, rows, memory.lead_speed)
        on = opened & view.allowed & (count % (rows.burst + rows.pause) < rows.burst)
        if view.probed is not None:
            on = on & (view.probed.any(axis=1) | ~rows.hop)
        kind = np.where(count < rows.switch, rows.kind, rows.then)
        raw = (rows.base + rows.rate * (count + 1))[:, None, None]
        value, granted = np.zeros(rows.target.shape), {int(Kind[name.upper()]) for name in plan.threat.kinds}
        for number, effect in EFFECTS.items():
            if effect.valued and number in granted:
                sent = effect.clip(plan.limits, raw + np.zeros(rows.target.shape))
                value = np.where((kind == number)[:, None, None], sent, value)
        target = on[:, None, None] & rows.target
        hit = target.any(axis=(1, 2))
        command = Command(np.where(hit, kind, 0).astype(np.int8), target, np.where(target, value, 0.0))
        attacked, phase, elapsed = memory.attacked, memory.phase, count + opened
        if self.programs:  # the first phase ends after `length` attacked steps
            attacked = attacked + hit
            over = (attacked >= memory.scripts.length) & (phase == 0)
            phase, opened = phase + over, opened & ~over
            attacked, elapsed = np.where(over, 0, attacked), np.where(over, 0, elapsed)
        return Memory(memory.scripts, phase, attacked, opened, elapsed, np.array(view.scene.lead_speed)), command


def remembered(scripts: Sequence, agents: int) -> Memory:
    """Return the memory of scripts (B,) at the start of their episodes."""
    count = np.zeros(len(scripts.length), np.int64)
    return Memory(scripts, count, count.copy(), count > 0, count.copy(), np.full((len(count), agents), -np.inf))


class Battery:
    """The program of a loop under an attack, of which only the outcome is kept. Raises whatever its parts raise while they are traced."""

    def __init__(self, loop: Loop, attack: Decider, plan: object, like: object) -> None:
        check_open(loop)
        self.loop, self.attack, self.plan, self.values = loop, attack, plan, None
        self.program = Program(traced(self._traced, begun(loop, _ONE, like), {}).pruned(keep=OUTCOME))
        self.programs = (self.program,)

    def of(self, loop: Loop, attack: Decider, plan: object, values: list[Array] | None) -> Battery:
        """Return the same program for parameters of other values."""
        out = Battery.__new__(Battery)
        out.program, out.programs = self.program, self.programs
        out.loop, out.attack, out.plan, out.values = loop, attack, plan, values  # type: ignore[assignment]
        return out

    def _traced(self, held: Any, given: Any) -> tuple[Any, Any]:
        loop, attack, plan = lifted(held["loop"].k, (self.loop, self.attack, self.plan))
        return step(loop, attack, plan, held)

    def play(self, keys: Keys, memory: object) -> Played:
        """Play an episode in each row, from the memory of an attack at its start."""
        return Episodes(self, keys, memory).play(self.values)


class Episodes:
    """Episodes at their start, which can be played again with other parameters. broken: a demand failed in the last play."""

    def __init__(self, battery: Battery, keys: Keys, memory: object) -> None:
        self.battery, self.horizon, self.broken = battery, battery.loop.horizon, False
        self.state = State(battery.program, len(keys.key))
        self.state.put(begun(battery.loop, keys, memory))
        self._first = self.state.memory.copy()
        self._call = Call(battery.program, self.state, max(2, self.horizon), battery.values)

    def play(self, values: list[Array] | None) -> Played:
        """Play all episodes under these parameters of the loop, the attack and its plan; None: those that were traced."""
        state, call, done, self.broken = self.state, self._call, 0, False
        state.memory[...] = self._first
        call.uniforms[...] = self.battery.program.uniforms(values)
        call.begin()
        while done < self.horizon and not state.every("loop.ended"):
            call.play(min(STEPS, self.horizon - done))
            done, self.broken = done + STEPS, self.broken or call.broken
        return Played(*(state.get_leaf(name) for name in OUTCOME))


def begun(loop: Loop, keys: Keys, memory: object) -> dict[str, Any]:
    """Return the state of episodes that begin."""
    batch, state = len(keys.key), loop.start(keys)
    first = loop.plant.scene(loop.plan.plant, state.plant).position
    return {
        "loop": state, "memory": memory, "gap": np.full(batch, np.inf), "error": np.zeros(batch),
        "first": np.array(first, np.float64), "moved": np.full(batch, np.inf),
    }  # fmt: skip


def step(loop: Loop, attack: Decider, plan: object, held: Any) -> tuple[Any, Any]:
    """Return the state one step later; an episode that has ended changes no more."""
    over = held["loop"].ended
    state, memory, frame = loop.step(held["loop"], cast("Attack", attack), plan, held["memory"])
    gap = np.min(np.where(loop.model.followers, frame.scene.gap, np.inf), axis=1)
    if not loop.ends_on_collision:
        gap = np.where(frame.collided | frame.rear_collided, -np.inf, gap)
    error = np.max(loop.model.error(frame.estimate.x, frame.truth), axis=1)
    moved = np.min(np.where(loop.model.followers, frame.scene.position - held["first"], np.inf), axis=1)
    gap = np.where(over, held["gap"], np.minimum(held["gap"], gap))
    error = np.where(over, held["error"], np.maximum(held["error"], error))
    moved = np.where(over, held["moved"], moved)
    return {"loop": state, "memory": memory, "gap": gap, "error": error, "first": held["first"], "moved": moved}, {}


def played_plainly(loop: Loop, attack: Decider, plan: object, keys: Keys, memory: object) -> Played:
    """Play what `Battery.play` plays, in the plain loop: for defences that are not traced."""
    held = begun(loop, keys, memory)
    for _ in range(loop.horizon):
        if held["loop"].ended.all():
            break
        held, _ = step(loop, attack, plan, held)
    return Played(held["loop"].ended, held["gap"], held["error"], held["moved"])


_made: Remembered[Battery] = Remembered()


def battery_of(loop: Loop, attack: Decider, plan: object, few: object) -> Battery | Untraced:
    """Return the program of a loop under an attack, once it has been found equal to the plain loop; or why there is none.

    few: the memory of the attack at the start of ROWS episodes.
    """
    one = map_leaves(lambda leaf: leaf[:1], few)
    return _made.proved(
        (loop, attack, plan), lambda: _sensed(loop, begun(loop, _keys(1), one)),
        lambda: step(check_open(loop), attack, plan, begun(loop, _keys(1), one)), lambda: Battery(loop, attack, plan, one),
        lambda found, values: found.of(loop, attack, plan, values), lambda made: _difference(made, few),
    )  # fmt: skip


def _sensed(loop: Loop, first: dict[str, Any]) -> dict[str, Any]:
    loop.sense(first["loop"])  # caches what an attacker's view needs
    return first


def _keys(batch: int) -> Keys:
    from tailgate.core import draws

    return draws.keys("tune", range(batch))


def _difference(made: Battery, few: object) -> str:
    first = begun(made.loop, _keys(ROWS), few)

    def later(held: dict[str, Any], steps: Array) -> dict[str, Any]:
        return held | {"loop": made.loop.later(held["loop"], steps)}

    return apart(made.program, first, lambda held: step(made.loop, made.attack, made.plan, held), made.loop.horizon, later)
