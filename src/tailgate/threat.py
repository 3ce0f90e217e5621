"""The threat model, and the channel: the only place where a command changes a measurement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate.core import Array, Command, Count, Kind, Model, Positive, PositiveCount, Received, no_command, param
from tailgate.errors import InputError, unknown

KindName = Literal["dos_jam", "dos_hold", "dos_hold_fresh", "dropout", "fdi"]
Pair = Annotated[tuple[float, float], Field(min_length=2, max_length=2)]


@dataclass(frozen=True)
class ThreatModel:
    """What an attacker may do and see. A command outside of it has no effect and is counted as refused."""

    kinds: tuple[KindName, ...] = param(("dos_hold", "fdi"), "attack kinds that are granted")
    targets: tuple[str, ...] = param((), "wires that may be attacked; empty: every sensor, no V2V field")
    fdi_bound: Positive = param(50.0, "largest |value| that false data injection may add [unit of the wire]")
    jam_range: Pair = param((-108.0, 108.0), "values that a jammer may leave at the receiver [unit of the wire]")
    budget: Count | None = param(None, "attack steps in an episode (the dose); none: unlimited")
    duration: PositiveCount | None = param(None, "longest burst [steps]; none: unlimited")
    cooldown: Count = param(0, "steps between two bursts")
    onset: PositiveCount = param(1, "first step at which an attack is accepted")
    end: PositiveCount | None = param(None, "last step at which an attack is accepted; none: the horizon")
    knowledge: Literal["black", "grey", "white"] = param("black", "black: the road; grey: + control; white: + defence")
    sees_measurement: bool = param(False, "grants the measurement that the defence receives")

    def __post_init__(self) -> None:
        low, high = self.jam_range
        if not (np.isfinite(low) and np.isfinite(high) and low <= high):
            raise InputError("threat_model.jam_range", self.jam_range, "two finite numbers, low <= high")
        if self.end is not None and self.end < self.onset:
            raise InputError("threat_model.end", self.end, f"a step not before onset ({self.onset})")


@dataclass(frozen=True, eq=False)
class Brief:
    """What an attacker knows before the episode: the public model, the threat model and the horizon [steps]."""

    model: Model
    threat: ThreatModel
    horizon: int

    @property
    def granted(self) -> Array:
        """(q+p,) bool: the wires that may be attacked."""
        wires = self.model.wires
        for name in self.threat.targets:
            if name not in wires:
                raise unknown("threat_model.targets", name, wires)
        names = self.threat.targets or self.model.sensors
        return np.array([w in names for w in wires])

    def command(self, on: Array, kind: Array | Kind, target: Array, value: Array | float) -> Command:
        """A command where `on` (B,) holds, else none. target and value broadcast to (B, N, q+p)."""
        out = no_command(len(on), self.model.agents, len(self.model.wires))
        out.kind[...] = np.where(on, kind, 0)
        out.target[...] = on[:, None, None] & target
        out.value[...] = np.where(out.target, value, 0.0)
        return out


class ChannelPlan(NamedTuple):
    threat: ThreatModel
    granted: Array  # (q+p,) bool
    kinds: Array  # (kinds,) bool
    last_step: int
    sensors: int


class ChannelState(NamedTuple):
    """The channel's memory; every leaf has B first."""

    used: Array  # (B,) attack steps charged
    burst: Array  # (B,) length of the running burst
    cooldown: Array  # (B,) steps before the next burst
    held: Array  # (B, N, q+p) last good sample before the first attack
    fresh: Array  # (B, N, q+p) last good sample of each wire
    last: Command


class Channel:
    """Applies commands to the wires and enforces the threat model, for scripts and learned policies alike."""

    def prepare(self, brief: Brief) -> ChannelPlan:
        kinds = np.zeros(len(Kind), bool)
        for name in brief.threat.kinds:
            kinds[Kind[name.upper()]] = True
        last = brief.horizon if brief.threat.end is None else min(brief.threat.end, brief.horizon)
        return ChannelPlan(brief.threat, brief.granted, kinds, last, len(brief.model.sensors))

    def start(self, plan: ChannelPlan, expected: Array) -> ChannelState:
        """expected (B, N, q+p): what the wires would read at the prior, held if an attack comes first."""
        batch, agents, wires = expected.shape
        count = np.zeros(batch, np.int64)
        return ChannelState(
            count, count.copy(), count.copy(), expected.copy(order="K"), expected.copy(order="K"),
            no_command(batch, agents, wires),
        )  # fmt: skip

    def budget_left(self, plan: ChannelPlan, state: ChannelState) -> Array:
        if plan.threat.budget is None:
            return np.full(len(state.used), np.inf)
        return np.asarray(plan.threat.budget - state.used, np.float64)

    def allowed(self, plan: ChannelPlan, state: ChannelState, k: Array) -> Array:
        """(B,) bool: a command of a granted kind, target and value would be accepted at step k (B,)."""
        ok = (k >= plan.threat.onset) & (k <= plan.last_step) & (state.cooldown == 0)
        if plan.threat.budget is not None:
            ok &= state.used < plan.threat.budget
        if plan.threat.duration is not None:
            ok &= state.burst < plan.threat.duration
        return np.asarray(ok)

    def apply(
        self, plan: ChannelPlan, state: ChannelState, sent: Array, received: Received, command: Command, k: Array
    ) -> tuple[ChannelState, Received, Array, Array]:
        """-> state, received, wires (B, N, q+p) as they arrived, refused (B,) bool.

        `sent` (B, N, q+p) holds the sensor readings and the V2V message before the attack.
        """
        threat, kind = plan.threat, command.kind
        wanted = (kind != Kind.NONE) & command.target.any(axis=(1, 2))
        low, high = threat.jam_range
        jam = (kind == Kind.DOS_JAM)[:, None, None]
        fdi = (kind == Kind.FDI)[:, None, None]
        with np.errstate(invalid="ignore"):
            value_ok = np.where(jam, (command.value >= low) & (command.value <= high), True)
            value_ok &= np.where(fdi, np.abs(command.value) <= threat.fdi_bound, True)
        known = (kind >= 0) & (kind < len(plan.kinds))
        legal = known & plan.kinds[np.where(known, kind, 0)]
        legal &= ~(command.target & ~(plan.granted & value_ok)).any(axis=(1, 2))
        charged = wanted & legal & self.allowed(plan, state, k)
        refused = ((kind != Kind.NONE) | command.target.any(axis=(1, 2))) & ~charged

        hit = command.target & charged[:, None, None]
        first = charged & (state.used == 0)
        held = np.where(first[:, None, None], state.fresh, state.held)
        kind3 = kind[:, None, None]
        wires = np.where(hit & jam, command.value, sent)
        wires = np.where(hit & fdi, sent + command.value, wires)
        wires = np.where(hit & (kind3 == Kind.DOS_HOLD), held, wires)
        wires = np.where(hit & (kind3 == Kind.DOS_HOLD_FRESH), state.fresh, wires)
        lost = hit & (kind3 == Kind.DROPOUT)
        wires = np.where(lost, state.fresh, wires)  # a receiver that hears nothing keeps its last value

        q = plan.sensors
        out = received._replace(
            y=wires[..., :q],
            valid=received.valid & ~lost[..., :q],
            v2v=wires[..., q:],
            attacked=hit[..., :q],
        )
        ended = (state.burst > 0) & ~charged
        # the step that ends a burst is itself the first of the pause
        cooldown = np.where(ended, max(threat.cooldown - 1, 0), np.maximum(state.cooldown - 1, 0))
        last = Command(
            np.where(charged, kind, 0).astype(np.int8), hit, np.where(hit & (jam | fdi), command.value, 0.0)
        )
        fresh = np.where(hit, state.fresh, sent)
        state = ChannelState(
            state.used + charged, np.where(charged, state.burst + 1, 0), cooldown, held, fresh, last
        )
        return state, out, wires, refused
