"""From an action to a command: pure, and used by the environments and by trained policies that play as attacks alike."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import AIRED, Array, Command, Finite, Kind, Positive, PositiveCount, View, param
from tailgate.core.channel import Channel, ChannelPlan
from tailgate.core.kinds import EFFECTS, KindName
from tailgate.core.threat import Brief, fit, receivers

ActionName = Literal["timing", "mode", "ramp", "continuous", "increment"]
VECTOR = (Kind.FDI, Kind.ECHO_DELAY, Kind.NOISE_JAM)  # kinds that a vector of values can carry, in the order of the trigger's shares


@dataclass(frozen=True)
class ActionSpec:
    """The decisions that the learner takes.

    timing: {none, attack}, the attack is `kind` with its value. mode: {none, then one per granted kind, +value and -value for fdi}, and
    fdi and echo_delay once for each of `shares`, so that an attacker chooses the size too.
    ramp: as mode, but fdi and echo_delay have three: raise, keep or lower the value sent last by `rate`. A burst starts from +-`value` or
    from `delay`. continuous: [trigger, value per wire] in [-1, 1], attack when trigger > 0, values in units of the bound.
    increment: the same, but each value is the change since the value sent last, in units of `rate`.

    Vectors carry the granted ones of fdi, echo_delay and noise_jam, in this order, which share (0, 1] of the trigger evenly. Both kinds
    over the air read one more value per agent, after those of fdi: -1 is nothing and 1 the bound. An increment changes the delay alone.
    """

    action: ActionName = param("mode", "timing, mode, ramp, continuous or increment")
    kind: KindName = param("fdi", "timing: what an attack is")
    value: Finite = param(-4.0, "timing, mode, ramp: bias of fdi, jammer's value of dos_jam [unit of the wire]")
    power: Positive = param(0.1, "timing, mode, ramp: power of noise_jam [W]")
    delay: Positive = param(6.0, "timing, mode, ramp: extra range of echo_delay [m]")
    shares: tuple[Positive, ...] = param((), "mode: parts of the bias and of `delay` in (0, 1], an action each; none: all", if_any=True)
    steps: PositiveCount = param(10, "age of a delay, window of a replay [steps]")
    rate: Positive = param(0.5, "ramp, increment: (largest) change per step [unit of the wire]")
    per_sensor: bool = param(False, "timing, mode, ramp: also one mode per single wire")
    per_agent: bool = param(False, "timing, mode, ramp: also one mode per single agent")
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
        used: list[str] = [self.spec.kind] if self.spec.action == "timing" else list(threat.kinds)
        if not self.discrete:
            used = [kind.name.lower() for kind in self.carried] or ["fdi"]
        for name in used:
            if name not in threat.kinds:
                granted = ", ".join(threat.kinds)
                raise InputError("action", f"{self.spec.action} with {name}", f"a kind that the threat model grants: {granted}")
        if self.discrete and used and all(EFFECTS[int(Kind[name.upper()])].inside for name in used):
            raise InputError("action", f"{self.spec.action} with {', '.join(used)}", "a kind that a learner can choose: not insider")
        if self.discrete and "fdi" in used and abs(value) > threat.fdi_bound:
            raise InputError("value", value, f"at most the threat model's fdi_bound ({threat.fdi_bound}) in size")
        if self.discrete and "dos_jam" in used and not threat.jam_range[0] <= value <= threat.jam_range[1]:
            raise InputError("value", value, f"within the threat model's jam_range {threat.jam_range}")
        if self.discrete and {"delay", "replay"} & set(used) and self.spec.steps > threat.memory:
            raise InputError("steps", self.spec.steps, f"at most the threat model's memory ({threat.memory})")
        for name, size, most, field in (
            ("noise_jam", self.spec.power, threat.jam_power, "power"), ("echo_delay", self.spec.delay, threat.delay_bound, "delay"),
        ):  # fmt: skip
            if self.discrete and name in used and size > most:
                bound = "jam_power" if name == "noise_jam" else "delay_bound"
                raise InputError(field, size, f"at most the threat model's {bound} ({most})")
            if name in used and not receivers(self.brief).any():
                raise InputError("action", f"{self.spec.action} with {name}", "a granted sensor that listens to its own echo")
        if shares := self.spec.shares:
            if self.spec.action != "mode" or not {"fdi", "echo_delay"} & set(used):
                found = f"{self.spec.action} with {', '.join(used)}"
                raise InputError("shares", list(shares), f"action mode with fdi or echo_delay, not {found}")
            if max(shares) > 1.0 or len(set(shares)) < len(shares):
                raise InputError("shares", list(shares), "numbers in (0, 1], each once")
        if not self.brief.granted.any():
            raise InputError("threat_model.targets", threat.targets, "at least one wire")

    @property
    def discrete(self) -> bool:
        return self.spec.action in ("timing", "mode", "ramp")

    @cached_property
    def carried(self) -> tuple[Kind, ...]:
        """The granted kinds that a vector can carry."""
        return tuple(kind for kind in VECTOR if kind.name.lower() in self.brief.threat.kinds)

    @cached_property
    def channel(self) -> ChannelPlan:
        """The channel's plan under the brief."""
        return Channel().prepare(self.brief)

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
        groups = [("", granted)]  # names of single wires begin with a colon
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
        for suffix, whole in groups:
            for name in kinds:
                kind = Kind[name.upper()]
                if EFFECTS[int(kind)].inside:  # factors on gains are no sizes of a wire
                    continue
                target = whole & self._open(kind, self.spec.steps)
                if not target.any():
                    continue
                if kind in AIRED:
                    out += [] if suffix.startswith(":") else self._aired(kind, suffix, target & receivers(self.brief))
                elif kind == Kind.FDI and self.spec.action != "timing":
                    signs = {"+": 1, "-": -1} if self.spec.action == "mode" else {"+": 1, "=": 0, "-": -1}
                    for share, mark in self._shares:
                        sent = share * np.minimum(abs(value), bounds)
                        out += [Mode(f"fdi{t}{mark}{suffix}", kind, target, sign * sent, sign) for t, sign in signs.items()]
                elif kind in (Kind.FDI, Kind.DOS_JAM):  # too large a value for an actuator is cut
                    cut = np.clip(value, -bounds, bounds)
                    sent = cut if kind == Kind.FDI else np.where(self.brief.is_actuator, cut, value)
                    out.append(Mode(name + suffix, kind, target, sent))
                else:
                    old = kind in (Kind.DELAY, Kind.REPLAY)
                    out.append(Mode(name + suffix, kind, target, nothing + self.spec.steps * old))
        if len(out) == 1 and self.brief.sealed.any():
            sealed = self.brief.threat.authenticated
            raise InputError("threat_model.authenticated", sealed, "a granted wire that a kind of attack can still change")
        return out

    def _open(self, kind: Kind, age: int) -> Array:
        """Return the wires (w,) bool on which the channel accepts a kind: an authenticated one takes no forged or too old value."""
        effect = EFFECTS[int(kind)]
        passes = not effect.valued or effect.over_air or effect.inside or (effect.recorded and age <= self.brief.threat.key_interval)
        return np.ones_like(self.brief.sealed) if passes else ~self.brief.sealed

    def _aired(self, kind: Kind, suffix: str, target: Array) -> list[Mode]:
        """Return the modes of a kind over the air, which reaches all that a receiver reads; none where `target` has no receiver."""
        if not target.any():
            return []
        name = kind.name.lower()
        value = np.full(target.shape[1], self.spec.power if kind == Kind.NOISE_JAM else self.spec.delay)
        if kind == Kind.ECHO_DELAY and self.spec.action == "mode":
            return [Mode(f"{name}{mark}{suffix}", kind, target, share * value) for share, mark in self._shares]
        if kind == Kind.ECHO_DELAY and self.spec.action == "ramp":
            return [Mode(f"{name}{t}{suffix}", kind, target, value, sign) for t, sign in (("+", 1), ("=", 0), ("-", -1))]
        return [Mode(name + suffix, kind, target, value)]

    @cached_property
    def _shares(self) -> list[tuple[float, str]]:
        """Return the shares of a value that may be sent, and how a mode's name shows each: empty for the whole value."""
        return [(share, "" if share == 1.0 else f"*{share!r}") for share in self.spec.shares or (1.0,)]

    @property
    def size(self) -> int:
        """Number of discrete actions, or length of the continuous vector."""
        if self.discrete:
            return len(self.modes)
        radiates = any(kind in AIRED for kind in self.carried)
        return 1 + len(self.victims) * (len(self.wires) * (Kind.FDI in self.carried) + radiates)

    def decode(self, action: Array, view: View) -> Command:
        """Return the command of discrete actions (B,) int, or of continuous ones (B, size) in [-1, 1]."""
        brief = self.brief
        if self.discrete:
            index = np.asarray(action).reshape(-1)
            kinds = num.take(np.array([mode.kind for mode in self.modes], np.int8), index)
            target = num.take(np.array([mode.target for mode in self.modes]), index)
            value = num.take(np.array([mode.value for mode in self.modes]), index)[:, None, :]
            if self.spec.action == "ramp":
                sign = num.take(np.array([mode.sign for mode in self.modes]), index)[:, None, None]
                for kind in set(VECTOR) & {mode.kind for mode in self.modes} - {Kind.NOISE_JAM}:
                    ramping = ((view.last.kind == kind) & (kinds == kind))[:, None, None]
                    value = np.where(ramping, self._changed(kind, view.last.value, sign), value)
            return brief.command(index != 0, kinds, target, value)
        action = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        on, count = action[:, 0] > 0.0, len(self.carried)
        index = np.clip(np.ceil(action[:, 0] * count).astype(np.int64) - 1, 0, count - 1)
        kinds = num.take(np.array(self.carried, np.int8), index)
        value, target = num.zeros((len(action), *brief.granted.shape)), brief.granted
        for kind in self.carried:
            mine = (kinds == kind)[:, None, None]
            value = np.where(mine, self._sent(kind, action[:, 1:], view), value)
            target = np.where(mine, receivers(brief) if kind in AIRED else brief.granted & self._open(kind, 0), target)
        return brief.command(on, kinds, target, value)

    def _changed(self, kind: Kind, last: Array, change: Array) -> Array:
        """Return the value sent last plus a change, within the bounds of the kind."""
        return fit(self.brief, kind, last + self.spec.rate * change)

    def _sent(self, kind: Kind, action: Array, view: View) -> Array:
        """Return the values of `kind` (B, N, w) in a vector (B, size - 1) in [-1, 1]."""
        brief, batch, agents = self.brief, len(action), len(self.victims)
        share = num.zeros((batch, *brief.granted.shape))
        if kind == Kind.FDI:
            per_wire = action[:, : agents * len(self.wires)].reshape(batch, agents, len(self.wires))
            share[:, self.victims[:, None], self.wires] = per_wire
        else:
            share[:, self.victims] = action[:, -agents:, None]
        if self.spec.action == "increment" and kind != Kind.NOISE_JAM:
            return self._changed(kind, np.where((view.last.kind == kind)[:, None, None], view.last.value, 0.0), share)
        if kind == Kind.FDI:
            return np.asarray(brief.bounds * share)
        most = brief.threat.delay_bound if kind == Kind.ECHO_DELAY else brief.threat.jam_power
        return fit(brief, kind, most * (0.5 + 0.5 * share))

    def mask(self, view: View) -> Array:
        """Return (B, size) bool: the discrete actions that the channel would accept in at least one step of the decision that is due."""
        free = Channel().open(self.channel, view.k, view.budget_left, view.burst, view.cooldown, self.spec.interval)
        out = np.repeat(free[:, None], self.size, axis=1)
        out[:, 0] = True
        return out


def action_space(codec: ActionCodec) -> Any:
    """Return the Gymnasium space of one row's action."""
    from gymnasium import spaces

    if codec.discrete:
        return spaces.Discrete(codec.size)
    return spaces.Box(-1.0, 1.0, (codec.size,), np.float32)
