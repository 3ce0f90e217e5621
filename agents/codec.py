"""From a view to an observation vector, and from an action to a command: pure, and used by the environments and by
trained policies that play as attacks alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Command, Finite, Frame, Kind, NonNegative, Positive, PositiveCount, View, param
from tailgate.errors import InputError
from tailgate.threat import Brief, KindName

LIMIT = 10.0  # observations are clipped to +-LIMIT
ActionName = Literal["timing", "mode", "ramp", "continuous", "increment"]


@dataclass(frozen=True)
class ActionSpec:
    """Which decisions the learner takes.

    timing: {none, attack}, the attack is `kind` with `value`. mode: {none, then one per granted kind, +value and -value for fdi}.
    ramp: as mode, but fdi has three: raise, keep or lower the value injected last by `rate`, from +-`value` at the start of a burst.
    continuous: [trigger, value per wire] in [-1, 1], attack when trigger > 0, values in units of the bound. increment: the same, but
    each value is the change since the value injected last, in units of `rate`.
    """

    action: ActionName = param("mode", "timing, mode, ramp, continuous or increment")
    kind: KindName = param("fdi", "timing: what an attack is")
    value: Finite = param(-4.0, "timing, mode, ramp: bias of fdi, jammer's value of dos_jam [unit of the wire]")
    steps: PositiveCount = param(10, "age of a delay, window of a replay [steps]")
    rate: Positive = param(0.5, "ramp, increment: (largest) change per step [unit of the wire]")
    per_sensor: bool = param(False, "mode, ramp: also one mode per single wire")
    interval: PositiveCount = param(1, "steps for which a decision holds: one step of the environment")


class Mode(NamedTuple):
    """One discrete action: its name, kind, target (w,) bool, value (w,), and direction of a ramp."""

    name: str
    kind: Kind
    target: Array
    value: Array
    sign: int = 0


@dataclass(frozen=True, eq=False)
class ActionCodec:
    """Action spaces and their meaning under one brief."""

    spec: ActionSpec
    brief: Brief

    def __post_init__(self) -> None:
        threat, value = self.brief.threat, self.spec.value
        used = [self.spec.kind] if self.spec.action == "timing" else list(threat.kinds) if self.discrete else ["fdi"]
        for name in used:
            if name not in threat.kinds:
                granted = ", ".join(threat.kinds)
                raise InputError("action", f"{self.spec.action} with {name}", f"a kind that the threat model grants: {granted}")
        if self.discrete and "fdi" in used and abs(value) > threat.fdi_bound:
            raise InputError("value", value, f"at most the threat model's fdi_bound ({threat.fdi_bound}) in size")
        if self.discrete and "dos_jam" in used and not threat.jam_range[0] <= value <= threat.jam_range[1]:
            raise InputError("value", value, f"within the threat model's jam_range {threat.jam_range}")
        if self.discrete and {"delay", "replay"} & set(used) and self.spec.steps > threat.memory:
            raise InputError("steps", self.spec.steps, f"at most the threat model's memory ({threat.memory})")
        if not self.brief.granted.any():
            raise InputError("threat_model.targets", threat.targets, "at least one wire")

    @property
    def discrete(self) -> bool:
        return self.spec.action in ("timing", "mode", "ramp")

    @cached_property
    def wires(self) -> Array:
        """(w,) indices of the granted wires."""
        return np.flatnonzero(self.brief.granted)

    @cached_property
    def modes(self) -> list[Mode]:
        """Discrete meanings, in the order of the action's number."""
        granted, value = self.brief.granted, self.spec.value
        groups = [("", granted)]
        if self.spec.per_sensor and len(self.wires) > 1:
            groups += [(":" + self.brief.model.wires[w], np.arange(len(granted)) == w) for w in self.wires]
        kinds: tuple[KindName, ...] = (self.spec.kind,) if self.spec.action == "timing" else self.brief.threat.kinds
        bounds, nothing = self.brief.bounds, np.zeros(len(granted))
        out = [Mode("none", Kind.NONE, np.zeros_like(granted), nothing)]
        for suffix, target in groups:
            for name in kinds:
                kind = Kind[name.upper()]
                if kind == Kind.FDI and self.spec.action != "timing":
                    signs = {"+": 1, "-": -1} if self.spec.action == "mode" else {"+": 1, "=": 0, "-": -1}
                    out += [Mode(f"fdi{t}{suffix}", kind, target, sign * np.minimum(abs(value), bounds), sign) for t, sign in signs.items()]
                elif kind in (Kind.FDI, Kind.DOS_JAM):  # what is too much for an actuator is cut
                    cut = np.clip(value, -bounds, bounds)
                    sent = cut if kind == Kind.FDI else np.where(self.brief.is_actuator, cut, value)
                    out.append(Mode(name + suffix, kind, target, sent))
                else:
                    old = kind in (Kind.DELAY, Kind.REPLAY)
                    out.append(Mode(name + suffix, kind, target, nothing + self.spec.steps * old))
        return out

    @property
    def size(self) -> int:
        """Number of discrete actions, or length of the continuous vector."""
        return len(self.modes) if self.discrete else 1 + self.brief.model.agents * len(self.wires)

    def decode(self, action: Array, view: View) -> Command:
        """Discrete (B,) int or continuous (B, size) in [-1, 1] to a command."""
        brief = self.brief
        if self.discrete:
            index = np.asarray(action).reshape(-1)
            kinds = np.array([mode.kind for mode in self.modes], np.int8)[index]
            target = np.array([mode.target for mode in self.modes])[index][:, None, :]
            value = np.array([mode.value for mode in self.modes])[index][:, None, :]
            if self.spec.action == "ramp":
                bound, sign = brief.bounds, np.array([mode.sign for mode in self.modes])[index][:, None, None]
                grown = np.clip(view.last.value + self.spec.rate * sign, -bound, bound)
                ramping = ((view.last.kind == Kind.FDI) & (kinds == Kind.FDI))[:, None, None]
                value = np.where(ramping, grown, value)
            return brief.command(index != 0, kinds, target, value)
        action = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        values = action[:, 1:].reshape(len(action), brief.model.agents, len(self.wires))
        bound = brief.bounds[self.wires]
        wide = num.zeros((len(action), brief.model.agents, len(brief.granted)))
        if self.spec.action == "increment":
            wide[..., self.wires] = np.clip(view.last.value[..., self.wires] + self.spec.rate * values, -bound, bound)
        else:
            wide[..., self.wires] = bound * values
        return brief.command(action[:, 0] > 0.0, Kind.FDI, brief.granted, wide)

    def mask(self, view: View) -> Array:
        """(B, size) bool of the discrete actions that the channel would accept."""
        out = np.repeat(np.asarray(view.allowed)[:, None], self.size, axis=1)
        out[:, 0] = True
        return out


@dataclass(frozen=True, eq=False)
class ObservationCodec:
    """What the learner sees, scaled to about one and clipped."""

    brief: Brief

    @cached_property
    def names(self) -> tuple[str, ...]:
        model, threat = self.brief.model, self.brief.threat
        out = ["progress", "allowed", "budget_left", "burst", "cooldown"]
        for i in range(model.agents):
            tag = "" if model.agents == 1 else f"[{i}]"
            out += [name + tag for name in ("gap", "speed", "lead_speed", "closing", "accel", "rear_gap", "rear_closing")]
            out += [f"last_{model.wires[w]}{tag}" for w in np.flatnonzero(self.brief.granted)]
            if threat.knowledge != "black":
                out += [f"control{j}{tag}" for j in range(model.inputs)]
            if threat.knowledge == "white":
                out += [f"error{j}{tag}" for j in range(model.states)] + ["score" + tag, "alarm" + tag]
            if threat.sees_measurement or threat.knowledge == "white":
                out += [f"noise_{name}{tag}" for name in self._seen]
        return (*out, "attacking")

    @cached_property
    def _seen(self) -> tuple[str, ...]:
        return tuple(name for name in self.brief.model.sensors if name in ("position", "velocity"))

    def observe(self, view: View) -> Array:
        """(B, d) float32, d = len(names)."""
        brief, threat = self.brief, self.brief.threat
        scene, last = view.scene, view.last
        bounded = np.isfinite(view.budget)
        left = np.where(bounded, view.budget_left / np.where(bounded & (view.budget > 0), view.budget, 1.0), 1.0)
        columns: list[Array] = [view.progress, view.allowed, left, view.burst / 50.0, view.cooldown / 50.0]
        for i in range(brief.model.agents):
            gap, speed, lead = scene.gap[:, i], scene.speed[:, i], scene.lead_speed[:, i]
            columns += [gap / 50.0, speed / 15.0, lead / 15.0, (speed - lead) / 5.0, scene.accel[:, i] / 3.0]
            columns += [scene.rear_gap[:, i] / 50.0, (scene.rear_speed[:, i] - speed) / 5.0]
            columns += [last.value[:, i, w] / min(brief.bounds[w], 10.0) for w in np.flatnonzero(brief.granted)]
            if threat.knowledge != "black":
                assert view.control is not None
                columns += [view.control[:, i, j] / 3.0 for j in range(brief.model.inputs)]
            if threat.knowledge == "white":
                assert view.estimate is not None and view.truth is not None
                error = view.estimate.x - view.truth
                columns += [error[:, i, j] / 5.0 for j in range(brief.model.states)]
                columns += [view.estimate.score[:, i] / 20.0, view.estimate.alarm[:, i]]
            if threat.sees_measurement or threat.knowledge == "white":
                assert view.received is not None
                for name in self._seen:
                    sent = view.received.y[:, i, brief.model.sensors.index(name)]
                    columns.append(sent - (scene.position if name == "position" else scene.speed)[:, i])
        columns.append(last.kind != Kind.NONE)
        out = np.empty((len(view.k), len(columns)), np.float32)
        for j, column in enumerate(columns):
            out[:, j] = np.clip(column, -LIMIT, LIMIT)
        return out


RewardName = Literal["collision", "min_gap", "error", "stealth"]
NEAR = 20.0  # min_gap: a smaller gap than this counts [m]


@dataclass(frozen=True)
class Reward:
    """Reward presets. Scores never use them: they use raw outcomes.

    collision: 1 at a collision in front or behind. min_gap: the same, and the metres by which the smallest gap of the episode falls
    below 20 m, over 20 m: a burst at the right moment earns something long before it makes a collision. error: |position error| / 10 m,
    capped at 1, per second. stealth: error, less one per second of alarm. The shaping terms are potential-based (Ng, Harada, Russell
    1999): they leave the best policy unchanged when `gamma` is the learner's, and may use the truth, which the policy does not see.
    """

    reward: RewardName = param("min_gap", "collision, min_gap, error or stealth")
    gap_shaping: NonNegative = param(0.5, "weight of the closeness of the car ahead as a potential [-]")
    error_shaping: NonNegative = param(1.0, "weight of the believed extra gap, per 10 m and capped at 20 m, as a potential [-]")
    gamma: Positive = param(0.995, "discount in the potential's difference [-]")
    illegal_penalty: NonNegative = param(0.0, "cost of a refused command [-]")
    attack_cost: NonNegative = param(0.0, "cost of a step under attack: what makes waiting for the right moment pay [-]")

    def potential(self, gap: Array, belief: Array | float = 0.0) -> Array:
        """(B,) potential of a gap (B, N) [m] and of what the car believes it has on top of it (B, N) [m]."""
        near = 1.0 - np.clip(np.min(gap, axis=1), 0.0, 100.0) / 100.0
        fooled = np.max(np.clip(belief, 0.0, 20.0) / 10.0 + np.zeros_like(gap), axis=1)
        return np.asarray(self.gap_shaping * near + self.error_shaping * fooled)

    def least(self, gap: Array, before: Array | float = NEAR) -> Array:
        """(B,) smallest gap so far, within [0, NEAR], from a gap (B, N) and the smallest one before [m]."""
        return np.asarray(np.minimum(np.clip(np.min(gap, axis=1), 0.0, NEAR), before))

    def __call__(self, dt: float, frame: Frame, fall: Array) -> Array:
        """(B,) reward of one step of the loop; fall (B,) of the smallest gap [m]."""
        crashed = frame.collided | frame.rear_collided
        out = -self.illegal_penalty * frame.refused - self.attack_cost * (frame.command.kind != Kind.NONE)
        if self.reward in ("collision", "min_gap"):
            out = out + crashed
            if self.reward == "min_gap":
                out = out + fall / NEAR
        else:
            error = np.abs(frame.estimate.x[..., 0] - frame.truth[..., 0])
            out = out + dt * np.minimum(np.max(error, axis=1) / 10.0, 1.0)
            if self.reward == "stealth":
                out = out - dt * frame.estimate.alarm.any(axis=1)
        return np.asarray(out)

    def shaped(self, raw: Array, before: Array, after: Array, terminated: Array) -> Array:
        """(B,) reward of a decision from its raw reward and the potentials (B,) before and after it."""
        return np.asarray(raw + self.gamma * np.where(terminated, 0.0, after) - before)


def action_space(codec: ActionCodec) -> Any:
    """The Gymnasium space of one row's action."""
    from gymnasium import spaces

    if codec.discrete:
        return spaces.Discrete(codec.size)
    return spaces.Box(-1.0, 1.0, (codec.size,), np.float32)
