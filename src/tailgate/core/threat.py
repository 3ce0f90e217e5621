"""The threat model: the actions and the view that an attacker is granted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import Field

from tailgate.base.errors import InputError, unknown
from tailgate.core.kinds import EFFECTS, Kind, KindName, Limits
from tailgate.core.nouns import Array, Command, Model, no_command, param
from tailgate.core.quantities import Bound, Bounded, Count, PositiveCount, Time, check_order

Knowledge = Literal["black", "grey", "white"]
KNOWLEDGE: tuple[Knowledge, ...] = get_args(Knowledge)  # each sees what the one before it sees, and more
MOST_GAIN = 1e9  # of an unbounded insider
Span = Annotated[int, Field(ge=1, le=10_000)]
Pair = Annotated[tuple[Bounded, Bounded], Field(min_length=2, max_length=2)]


@dataclass(frozen=True)
class ThreatModel:
    """The actions and the view that an attacker is granted. A command outside of it has no effect and is counted as refused."""

    kinds: tuple[KindName, ...] = param(("dos_hold", "fdi"), "attack kinds that are granted")
    targets: tuple[str, ...] = param((), "wires that may be attacked; empty: every sensor, no V2V field and no actuator")
    agents: tuple[Count, ...] = param((), "agents that may be attacked, by number from 0; empty: all")
    fdi_bound: Bound = param(50.0, "largest |value| that false data injection may add to a sensor or V2V field [unit of the wire]")
    actuator_bound: Bound = param(2.0, "largest |value| that may be added to, or jammed onto, an actuator, its limits aside [m/s^2]")
    jam_range: Pair = param((-108.0, 108.0), "values that a jammer may leave at the receiver [unit of the wire]")
    jam_power: Bound = param(0.1, "largest power of a jammer's noise, and that with which dos_jam is radiated [W]")
    delay_bound: Bound = param(20.0, "largest extra range of an echo that is answered too late [m]")
    reaction: Time | None = param(None, "time until a radiating attacker notices a challenge and falls silent [s]; none: never")
    memory: Span = param(50, "longest delay, and longest window that is replayed, at most 10 000 [steps]")
    budget: Count | None = param(None, "attack steps in an episode (the dose); none: unlimited")
    duration: PositiveCount | None = param(None, "longest burst [steps]; none: unlimited")
    cooldown: Count = param(0, "steps between two bursts")
    onset: PositiveCount = param(1, "first step at which an attack is accepted")
    end: PositiveCount | None = param(None, "last step at which an attack is accepted; none: the horizon")
    knowledge: Knowledge = param("black", "black: the road; grey: + control; white: + defence")
    sees_measurement: bool = param(False, "grants the measurement that the defence receives; of a radar it shows which step is muted")
    hold_from_onset: bool = param(False, "dos_hold keeps the last good sample before onset (6.18), not before the first hit", if_any=True)

    authenticated: tuple[str, ...] = param((), "wires whose values carry a tag: they may be held or lost, not forged", if_any=True)
    gain_bound: Bound | None = param(None, "largest |factor| that an insider may put on a gain of a car's law; none: 1e9 [-]", if_any=True)
    key_interval: Count = param(0, "age up to which an authenticated value is accepted again, until its key is known [steps]", if_any=True)

    def __post_init__(self) -> None:
        check_order("threat_model.jam_range", self.jam_range)
        if self.end is not None and self.end < self.onset:
            raise InputError("threat_model.end", self.end, f"a step not before onset ({self.onset})")


@dataclass(frozen=True, eq=False)
class Brief:
    """The attacker's knowledge before the episode: the public model, the threat model and the horizon [steps]."""

    model: Model
    threat: ThreatModel
    horizon: int

    @property
    def granted(self) -> Array:
        """(N, w) bool: the wires that may be attacked, of each agent."""
        wires, agents = self.model.wires, self.model.agents
        for name in self.threat.targets:
            if name not in wires:
                raise unknown("threat_model.targets", name, wires)
        for i in self.threat.agents:
            if i >= agents:
                raise InputError("threat_model.agents", i, f"an agent's number, from 0 to {agents - 1}")
        names, some = self.threat.targets or self.model.sensors, self.threat.agents or range(agents)
        return np.asarray(np.isin(np.arange(agents), list(some))[:, None] & np.array([w in names for w in wires]))

    @property
    def sealed(self) -> Array:
        """(w,) bool: the wires whose values are authenticated."""
        wires = self.model.wires
        for name in self.threat.authenticated:
            if name not in wires:
                raise unknown("threat_model.authenticated", name, wires)
        return np.array([name in self.threat.authenticated for name in wires], bool)

    @property
    def geared(self) -> Array:
        """(N, w) bool: the wires whose signal an agent's own law weighs by a gain that an insider can scale."""
        model = self.model
        return np.asarray(model.followers[:, None] & np.array([name in model.gains for name in model.wires], bool))

    @property
    def is_actuator(self) -> Array:
        """(w,) bool: the wires that lead to actuators."""
        model = self.model
        return np.arange(len(model.wires)) >= len(model.sensors) + len(model.v2v)

    @property
    def bounds(self) -> Array:
        """(w,) largest |value| that false data injection may add to each wire [unit of the wire]."""
        return np.where(self.is_actuator, self.threat.actuator_bound, self.threat.fdi_bound)

    @property
    def limits(self) -> Limits:
        """The bounds of the values of commands."""
        threat, strongest = self.threat, self.threat.actuator_bound
        low, high = (np.where(self.is_actuator, sign * strongest, end) for sign, end in zip((-1.0, 1.0), threat.jam_range, strict=True))
        return Limits(self.bounds, low, high, threat.memory, threat.jam_power, threat.delay_bound, threat.gain_bound or MOST_GAIN)

    def command(self, on: Array, kind: Array | Kind, target: Array, value: Array | float) -> Command:
        """Return a command where `on` (B,) holds, else none. target and value broadcast to (B, N, w)."""
        out = no_command(len(on), self.model.agents, len(self.model.wires))
        out.kind[...] = np.where(on, kind, 0)
        out.target[...] = on[:, None, None] & target
        out.value[...] = np.where(out.target, value, 0.0)
        return out


def receivers(brief: Brief) -> Array:
    """Return the granted sensors that listen to their own echo, (N, w) bool: attacks over the air reach them."""
    return np.asarray(brief.granted & brief.model.air & (np.arange(brief.granted.shape[1]) < len(brief.model.sensors)))


def fit(brief: Brief, kind: Kind, value: Array) -> Array:
    """Clip values (B, N, w) to the bounds of their kind; round ages and windows to whole steps."""
    return EFFECTS[int(kind)].clip(brief.limits, value)
