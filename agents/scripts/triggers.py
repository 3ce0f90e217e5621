"""Triggers: the times at which an attack is on, the same for scripts and for programs.

A trigger is armed at the start of an episode, or in a program when the phase before has ended. From then on it fires or does not, step by
step. One that latches opens at its first firing and stays open; another is on only while it fires. Both close `window` steps after the
first firing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from pydantic import Field

from tailgate.base.errors import InputError, NotApplicable, unknown
from tailgate.core import Array, Count, NonNegative, Positive, PositiveCount, Probability, View, param
from tailgate.core.draws import Draws
from tailgate.core.schema import build
from tailgate.core.threat import Brief

TAG = 0x4000  # first tag of the draws of triggers; injected values draw below it

Interval = Annotated[tuple[PositiveCount, PositiveCount], Field(min_length=2, max_length=2)]
Share = Annotated[float, Field(gt=0, lt=1)]


class Timing(NamedTuple):
    """The trigger's knowledge of an episode: the first step that is granted, and the length of a step [s]."""

    onset: int
    dt: float
    reach: Array | None = None  # (N, q) bool: the readings that may be attacked, for a trigger that looks at them


class TriggerState(NamedTuple):
    """The memory of any trigger; every leaf has B first."""

    armed: Array  # (B,) int64: steps since the trigger was armed
    opened: Array  # (B,) bool: it has fired
    elapsed: Array  # (B,) int64: steps since it first fired
    burst: Array  # (B,) int8: 1 in a random burst, 0 between two, -1 before the first draw
    lead_speed: Array  # (B, N) the leader's speed at the last look; -inf before the first


def idle(batch: int, agents: int) -> TriggerState:
    """Return the memory of triggers that have just been armed."""
    count = np.zeros(batch, np.int64)
    return TriggerState(count, np.zeros(batch, bool), count.copy(), np.full(batch, -1, np.int8), np.full((batch, agents), -np.inf))


def rearm(state: TriggerState, where: Array) -> TriggerState:
    """Return the memory in which the triggers of the rows `where` (B,) have just been armed; the view of the road is kept."""
    fresh = idle(*state.lead_speed.shape)
    armed, opened, elapsed, burst = (np.where(where, new, old) for new, old in zip(fresh[:4], state[:4], strict=True))
    return TriggerState(armed, opened, elapsed, burst, state.lead_speed)


@dataclass(frozen=True)
class Trigger:
    """On from a step on."""

    start: PositiveCount = param(1, "first step of the episode at which it may fire")
    after: Count = param(0, "steps that it waits after it was armed")
    window: PositiveCount | None = param(None, "steps from the first firing to its end; none: no end")

    @property
    def latches(self) -> bool:
        """True if it stays open after its first firing."""
        return False

    @property
    def ends(self) -> bool:
        """True if it ends by itself."""
        return self.window is not None

    @property
    def sees_measurement(self) -> bool:
        """True if it has to see the readings."""
        return False

    def prepare(self, brief: Brief) -> Timing:
        return Timing(brief.threat.onset, brief.model.dt)

    def step(self, timing: Timing, state: TriggerState, view: View, draws: Draws) -> tuple[TriggerState, Array, Array]:
        """Return the next state, on (B,) bool, and count (B,): steps since the first firing."""
        ready = (view.k >= self.start) & (view.k >= timing.onset) & (state.armed >= self.after)
        burst, hit = self.fires(timing, state, view, ready, draws)
        fired = ready & hit
        opened = state.opened | fired
        on = opened if self.latches else fired
        if self.window is not None:
            on = on & (state.elapsed < self.window)
        after = TriggerState(state.armed + 1, opened, state.elapsed + opened, burst, np.array(view.scene.lead_speed))
        return after, on, state.elapsed

    def fires(self, timing: Timing, state: TriggerState, view: View, ready: Array, draws: Draws) -> tuple[Array, Array]:
        """Return the burst state after this step, and (B,) bool if it fires, in the rows that are `ready`."""
        return state.burst, ready

    def over(self, state: TriggerState, k: Array) -> Array:
        """Return (B,) bool: after step k (B,), the last one played, it will not be on again."""
        never = np.zeros(len(k), bool)
        return never if self.window is None else never | (state.opened & (state.elapsed >= self.window))


@dataclass(frozen=True)
class Steps(Trigger):
    """On at the listed steps."""

    at: Annotated[tuple[PositiveCount | Interval, ...], Field(min_length=1)] = param(
        (1,), "steps of the episode, each a number, or a pair [first, last]"
    )

    def __post_init__(self) -> None:
        for item in self.at:
            if not isinstance(item, int) and item[0] > item[1]:
                raise InputError("at", item, "a pair [first, last], first <= last")

    @property
    def steps(self) -> list[int]:
        """The steps, one by one."""
        pairs = [(item, item) if isinstance(item, int) else item for item in self.at]
        return sorted({k for first, last in pairs for k in range(first, last + 1)})

    @property
    def ends(self) -> bool:
        return True

    def fires(self, timing: Timing, state: TriggerState, view: View, ready: Array, draws: Draws) -> tuple[Array, Array]:
        return state.burst, np.asarray(np.isin(view.k, self.steps))

    def over(self, state: TriggerState, k: Array) -> Array:
        return super().over(state, k) | (k >= self.steps[-1])


@dataclass(frozen=True)
class Chance(Trigger):
    """Fires at each step with a probability, independently."""

    probability: Probability = param(0.1, "probability of firing per step [-]")
    latch: bool = param(False, "stay open after the first firing: a random onset")

    @property
    def latches(self) -> bool:
        return self.latch

    def fires(self, timing: Timing, state: TriggerState, view: View, ready: Array, draws: Draws) -> tuple[Array, Array]:
        return state.burst, np.asarray(draws.uniform(tag=TAG) < self.probability)


@dataclass(frozen=True)
class Bursts(Trigger):
    """Random bursts of a two-state Markov chain (Gilbert 1960) with a wanted mean length and a wanted frequency or share of time.

    With steps of dt, a burst of mean D [s] is left with probability dt / D a step. The mean of the pause between two is 1 / f - D for f
    bursts a second, or D (1 - s) / s for a share s. A pause is left with dt over that mean. The first step is drawn from the chain's
    stationary law, so that frequency and share hold on average from the beginning.
    """

    duration: Positive = param(0.5, "mean length of a burst [s]")
    frequency: Positive | None = param(None, "mean number of bursts a second [1/s]; none: `share` decides")
    share: Share | None = param(None, "mean share of the time that lies in bursts [-]; none: `frequency` decides")

    def __post_init__(self) -> None:
        if (self.frequency is None) == (self.share is None):
            raise InputError("frequency", self.frequency, "a frequency or a share, and not both")
        if self.frequency is not None and self.frequency * self.duration >= 1.0:
            raise InputError("frequency", self.frequency, f"less than 1 / duration ({1.0 / self.duration:g} 1/s)")

    def chain(self, dt: float) -> tuple[float, float, float]:
        """Return probabilities per step of entering and of leaving a burst, and the share of time in bursts."""
        share = self.frequency * self.duration if self.frequency is not None else self.share or 0.0
        pause = self.duration * (1.0 - share) / share
        for name, mean in (("duration", self.duration), ("frequency" if self.share is None else "share", pause)):
            if mean < dt * (1.0 - 1e-9):
                raise InputError(f"trigger bursts.{name}", getattr(self, name), f"bursts and pauses that last a step ({dt:g} s) on average")
        return min(dt / pause, 1.0), min(dt / self.duration, 1.0), share

    def prepare(self, brief: Brief) -> Timing:
        self.chain(brief.model.dt)  # fail here where it cannot be met
        return super().prepare(brief)

    def fires(self, timing: Timing, state: TriggerState, view: View, ready: Array, draws: Draws) -> tuple[Array, Array]:
        enter, leave, share = self.chain(timing.dt)
        u = draws.uniform(tag=TAG)
        inside = np.where(state.burst < 0, u < share, np.where(state.burst == 0, u < enter, u >= leave))
        return np.where(ready, inside, state.burst).astype(np.int8), inside


@dataclass(frozen=True)
class Condition(Trigger):
    """Base of the triggers that watch the road; one vehicle that meets the condition is enough."""

    latch: bool = param(True, "stay open after the first firing; false: on only while the condition holds")

    @property
    def latches(self) -> bool:
        return self.latch

    def fires(self, timing: Timing, state: TriggerState, view: View, ready: Array, draws: Draws) -> tuple[Array, Array]:
        return state.burst, np.asarray(self.holds(timing, state, view).any(axis=1))

    def holds(self, timing: Timing, state: TriggerState, view: View) -> Array:
        """Return (B, N) bool: the vehicle meets the condition."""
        raise TypeError(f"{type(self).__name__} must define holds()")


@dataclass(frozen=True)
class Near(Condition):
    """Fires when the gap is small."""

    threshold: NonNegative = param(40.0, "gap below [m]")

    def holds(self, timing: Timing, state: TriggerState, view: View) -> Array:
        return np.asarray(view.scene.gap < self.threshold)


@dataclass(frozen=True)
class Closing(Condition):
    """Fires when the follower is faster than the leader."""

    threshold: NonNegative = param(3.0, "closing speed above [m/s]")

    def holds(self, timing: Timing, state: TriggerState, view: View) -> Array:
        return np.asarray(view.scene.speed - view.scene.lead_speed > self.threshold)


@dataclass(frozen=True)
class Fast(Condition):
    """Fires when the follower drives fast."""

    threshold: NonNegative = param(25.0, "speed above [m/s]")

    def holds(self, timing: Timing, state: TriggerState, view: View) -> Array:
        return np.asarray(view.scene.speed > self.threshold)


@dataclass(frozen=True)
class Slow(Condition):
    """Fires when the follower drives slowly."""

    threshold: NonNegative = param(5.0, "speed below [m/s]")

    def holds(self, timing: Timing, state: TriggerState, view: View) -> Array:
        return np.asarray(view.scene.speed < self.threshold)


@dataclass(frozen=True)
class LeaderBraking(Condition):
    """Fires when the leader has braked hard since the last step, as its speed then and now tells."""

    threshold: NonNegative = param(2.0, "deceleration of the leader above [m/s^2]")

    def holds(self, timing: Timing, state: TriggerState, view: View) -> Array:
        return np.asarray((state.lead_speed - view.scene.lead_speed) / timing.dt > self.threshold)


@dataclass(frozen=True)
class Reading(Condition):
    """Fires when a reading that may be attacked is large, before anything is done to it. Only for attackers that see readings."""

    threshold: NonNegative = param(30.0, "size of a reading above [unit of the wire]")
    latest: PositiveCount | None = param(None, "step at which it fires whatever is read; none: it waits for ever")

    @property
    def sees_measurement(self) -> bool:
        return True

    def prepare(self, brief: Brief) -> Timing:
        threat = brief.threat
        if not threat.sees_measurement and threat.knowledge != "white":
            raise NotApplicable("threat_model.sees_measurement", False, "true: the trigger `reading` waits for a reading")
        return super().prepare(brief)._replace(reach=brief.granted[:, : len(brief.model.sensors)])

    def holds(self, timing: Timing, state: TriggerState, view: View) -> Array:
        assert view.received is not None and timing.reach is not None
        large = np.any((np.abs(view.received.y) > self.threshold) & timing.reach, axis=2)
        return np.asarray(large if self.latest is None else large | (view.k >= self.latest)[:, None])


TRIGGERS: dict[str, type[Trigger]] = {
    "time": Trigger, "steps": Steps, "chance": Chance, "bursts": Bursts, "near": Near, "closing": Closing, "speed": Fast, "slow": Slow,
    "leader_braking": LeaderBraking, "reading": Reading,
}  # fmt: skip


T = TypeVar("T")


def part(known: Mapping[str, type[T]], data: object, where: str) -> T:
    """Return one of the `known` classes from data: a name, or a mapping with `name` and parameters; errors name `where` and field."""
    if isinstance(data, str):
        data = {"name": data}
    if not isinstance(data, dict) or "name" not in data:
        raise InputError(where, data, f"a name, or a mapping with a name ({', '.join(known)}) and parameters")
    if not isinstance(data["name"], str) or data["name"] not in known:
        raise unknown(f"{where}.name", data["name"], known)
    params = {str(key): value for key, value in data.items() if key != "name"}
    try:
        return build(known[data["name"]], params, where)
    except InputError as error:
        if error.field.startswith(where):
            raise
        raise InputError(f"{where}.{error.field}", error.value, error.expected) from None
