"""From an action to a command: pure, and used by the environments and by trained policies that play as attacks alike."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Command, Finite, Kind, Positive, PositiveCount, View, param
from tailgate.errors import InputError
from tailgate.threat import Brief, KindName

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
    per_agent: bool = param(False, "mode, ramp: also one mode per single agent")
    interval: PositiveCount = param(1, "steps for which a decision holds: one step of the environment")


class Mode(NamedTuple):
    """One discrete action: its name, kind, target (N, w) bool, value (w,), and direction of a ramp."""

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
        """Indices of the wires that are granted at any agent."""
        return np.flatnonzero(self.brief.granted.any(axis=0))

    @cached_property
    def victims(self) -> Array:
        """Indices of the agents with a granted wire."""
        return np.flatnonzero(self.brief.granted.any(axis=1))

    @cached_property
    def modes(self) -> list[Mode]:
        """Discrete meanings, in the order of the action's number."""
        granted, value = self.brief.granted, self.spec.value
        groups = [("", granted)]
        named = [(":" + self.brief.model.wires[w], np.arange(granted.shape[1]) == w) for w in self.wires] if self.spec.per_sensor else []
        agents = [(f"[{i}]", (np.arange(granted.shape[0]) == i)[:, None]) for i in self.victims] if self.spec.per_agent else []
        if len(named) > 1:
            groups += [(name, granted & mask) for name, mask in named]
        if len(agents) > 1:
            groups += [(tag, granted & mask) for tag, mask in agents]
            groups += [(name + tag, granted & mask & here) for tag, here in agents for name, mask in named if len(named) > 1]
        kinds: tuple[KindName, ...] = (self.spec.kind,) if self.spec.action == "timing" else self.brief.threat.kinds
        bounds, nothing = self.brief.bounds, np.zeros(granted.shape[1])
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
        return len(self.modes) if self.discrete else 1 + len(self.victims) * len(self.wires)

    def decode(self, action: Array, view: View) -> Command:
        """Discrete (B,) int or continuous (B, size) in [-1, 1] to a command."""
        brief = self.brief
        if self.discrete:
            index = np.asarray(action).reshape(-1)
            kinds = np.array([mode.kind for mode in self.modes], np.int8)[index]
            target = np.array([mode.target for mode in self.modes])[index]
            value = np.array([mode.value for mode in self.modes])[index][:, None, :]
            if self.spec.action == "ramp":
                bound, sign = brief.bounds, np.array([mode.sign for mode in self.modes])[index][:, None, None]
                grown = np.clip(view.last.value + self.spec.rate * sign, -bound, bound)
                ramping = ((view.last.kind == Kind.FDI) & (kinds == Kind.FDI))[:, None, None]
                value = np.where(ramping, grown, value)
            return brief.command(index != 0, kinds, target, value)
        action = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        values = action[:, 1:].reshape(len(action), len(self.victims), len(self.wires))
        bound, held = brief.bounds[self.wires], (slice(None), self.victims[:, None], self.wires)
        wide = num.zeros((len(action), *brief.granted.shape))
        if self.spec.action == "increment":
            wide[held] = np.clip(view.last.value[held] + self.spec.rate * values, -bound, bound)
        else:
            wide[held] = bound * values
        return brief.command(action[:, 0] > 0.0, Kind.FDI, brief.granted, wide)

    def mask(self, view: View) -> Array:
        """(B, size) bool of the discrete actions that the channel would accept."""
        out = np.repeat(np.asarray(view.allowed)[:, None], self.size, axis=1)
        out[:, 0] = True
        return out


def action_space(codec: ActionCodec) -> Any:
    """The Gymnasium space of one row's action."""
    from gymnasium import spaces

    if codec.discrete:
        return spaces.Discrete(codec.size)
    return spaces.Box(-1.0, 1.0, (codec.size,), np.float32)
