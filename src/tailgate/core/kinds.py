"""Kinds of attack: what a command does to the wires that it targets; and modes, what a defence asks of the controller.

The numbers are part of published rows. A new kind is a member of `Kind`, its name in `KindName`, and a class with its effect.
"""

from __future__ import annotations

from enum import IntEnum
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.pytree import Array

FAINTEST = 1e-12  # power [W] or delay [m] that a command over the air has at least
KindName = Literal["dos_jam", "dos_hold", "dos_hold_fresh", "dropout", "fdi", "delay", "replay", "noise_jam", "echo_delay", "insider"]


class Kind(IntEnum):
    """A kind of attack."""

    NONE = 0
    DOS_JAM = 1
    DOS_HOLD = 2
    DOS_HOLD_FRESH = 3
    DROPOUT = 4
    FDI = 5
    DELAY = 6
    REPLAY = 7
    NOISE_JAM = 8
    ECHO_DELAY = 9
    INSIDER = 10


class Limits(NamedTuple):
    """The bounds that a threat model sets to the values of commands."""

    fdi: Array  # (w,) largest |value| that is added to a wire [unit of the wire]
    low: Array  # (w,) smallest value of a jammer
    high: Array  # (w,) largest value of a jammer
    memory: int  # longest delay, and longest window that is replayed [steps]
    power: float  # largest power of noise [W]
    delay: float  # largest extra range of a late echo [m]
    gain: float  # largest |factor| on a gain of a car's own law [-]


class Memory(NamedTuple):
    """The channel's memory of some wires: held, fresh (B, N, .); history, tape (B, N, ., recorded), two rings."""

    held: Array  # last good sample before the first attack, or before the onset
    fresh: Array  # last good sample of each wire
    history: Array  # samples sent in the last steps
    tape: Array  # the history as it was when the running replay began


class Recording(NamedTuple):
    """The rings of the channel's memory: how many samples they hold, and where they stand."""

    size: int
    taped: Array  # (B, 1, 1) samples recorded so far
    anchor: Array  # (B, 1, 1) samples recorded before the running replay began
    played: Array  # (B, 1, 1) steps that the running replay has lasted


class Effect:
    """Base class of an effect. A subclass says what its kind does to a reading, and which values a threat model grants."""

    kind: ClassVar[Kind]
    valued: ClassVar[bool] = False  # a command carries a value
    over_air: ClassVar[bool] = False  # one value reaches all that a receiver reads, and changes what it measures
    radiated: ClassVar[bool] = False  # a receiver that falls silent still hears it
    recorded: ClassVar[bool] = False  # needs what was sent before
    inside: ClassVar[bool] = False  # alters the law that reads the wire; the wire itself arrives as it was sent
    code: ClassVar[str]  # words for pages: a short name, a name, what a receiver notices, the unit of the value (empty: that of the wire)
    title: ClassVar[str]
    does: ClassVar[str]
    unit: ClassVar[str] = ""

    def clip(self, limits: Limits, value: Array) -> Array:
        """Return the values (B, N, w) that the threat model grants, nearest to `value`."""
        return np.zeros_like(value)

    def grants(self, limits: Limits, value: Array) -> Array:
        """Return (B, N, w) bool: the threat model grants the value."""
        return np.asarray(value == self.clip(limits, value))

    def reads(self, sent: Array, value: Array, memory: Memory, recording: Recording) -> Array:
        """Return what the receiver reads (B, N, w) in place of `sent` (B, N, w). Other kinds change the measurement or the law."""
        raise TypeError(f"{type(self).__name__} must define reads()")


class DosJam(Effect):
    """The receiver reads the jammer's value."""

    kind = Kind.DOS_JAM
    valued = radiated = True
    code, title, does = "JAM", "DoS jam", "the receiver reads the jammer's value"

    def clip(self, limits: Limits, value: Array) -> Array:
        return np.clip(value, limits.low, limits.high)

    def reads(self, sent: Array, value: Array, memory: Memory, recording: Recording) -> Array:
        return value


class DosHold(Effect):
    """The receiver reads the last good sample before the first attack (6.18)."""

    kind = Kind.DOS_HOLD
    code, title, does = "HOLD", "DoS hold", "the receiver is stuck at the last reading before the first attack"

    def reads(self, sent: Array, value: Array, memory: Memory, recording: Recording) -> Array:
        return memory.held


class DosHoldFresh(Effect):
    """The receiver reads the last good sample before this burst."""

    kind = Kind.DOS_HOLD_FRESH
    code, title, does = "HOLD*", "DoS hold (fresh)", "the receiver is stuck at the last reading before this burst"

    def reads(self, sent: Array, value: Array, memory: Memory, recording: Recording) -> Array:
        """Return the last good sample."""
        return memory.fresh


class Dropout(Effect):
    """Nothing is received, and the receiver knows it; it keeps its last value, as one that holds it does."""

    kind = Kind.DROPOUT
    code, title, does = "DROP", "dropout", "nothing arrives, and the receiver knows it"

    def reads(self, sent: Array, value: Array, memory: Memory, recording: Recording) -> Array:
        """Return the last good sample."""
        return memory.fresh


class FalseData(Effect):
    """The value is added (4.4)."""

    kind = Kind.FDI
    valued = True
    code, title, does = "FDI", "false data injection", "the value is added"

    def clip(self, limits: Limits, value: Array) -> Array:
        return np.clip(value, -limits.fdi, limits.fdi)

    def reads(self, sent: Array, value: Array, memory: Memory, recording: Recording) -> Array:
        return sent + value


class Delay(Effect):
    """The receiver reads what was sent `value` steps ago."""

    kind = Kind.DELAY
    valued = recorded = True
    code, title, does, unit = "DELAY", "delay", "the receiver reads what was sent that many steps ago", "steps"

    def clip(self, limits: Limits, value: Array) -> Array:
        return np.clip(np.floor(value + 0.5), 1.0, float(limits.memory))

    def reads(self, sent: Array, value: Array, memory: Memory, recording: Recording) -> Array:
        return np.asarray(num.pick(memory.history, (recording.taped - value.astype(np.int64)) % recording.size))


class Replay(Delay):
    """The receiver reads the last `value` samples before this replay, over and over."""

    kind = Kind.REPLAY
    code, title, does = "REPLAY", "replay", "the receiver reads the last samples, that many, over and over"

    def reads(self, sent: Array, value: Array, memory: Memory, recording: Recording) -> Array:
        span = value.astype(np.int64)
        return np.asarray(num.pick(memory.tape, (recording.anchor + recording.played % span - span) % recording.size))


class NoiseJam(Effect):
    """Over the air: noise of `value` watts reaches the receiver."""

    kind = Kind.NOISE_JAM
    valued = radiated = over_air = True
    code, title, does, unit = "NOISE", "noise jamming", "noise of that power reaches the receiver over the air", "W"

    def most(self, limits: Limits) -> float:
        """Return the largest value that is granted."""
        return limits.power

    def clip(self, limits: Limits, value: Array) -> Array:
        return np.clip(value, FAINTEST, self.most(limits))

    def grants(self, limits: Limits, value: Array) -> Array:
        return np.asarray((value > 0.0) & (value <= self.most(limits)))


class EchoDelay(NoiseJam):
    """Over the air: the receiver's own signal comes back `value` metres too late."""

    kind = Kind.ECHO_DELAY
    code, title, does, unit = "ECHO", "late echo", "the probe is answered late, so that the car ahead seems that much farther away", "m"

    def most(self, limits: Limits) -> float:
        return limits.delay


class Insider(Effect):
    """The car's own law weighs what it reads with `value` times its gain."""

    kind = Kind.INSIDER
    valued = inside = True
    code, title, does, unit = "LAW", "insider", "the car's own law weighs that signal with so much of its gain", "of the gain"

    def clip(self, limits: Limits, value: Array) -> Array:
        return np.clip(value, -limits.gain, limits.gain)


# by plain numbers: in every comparison with a member of an enumeration numpy looks for array methods of it
EFFECTS: dict[int, Effect] = {
    int(effect.kind): effect()
    for effect in (DosJam, DosHold, DosHoldFresh, Dropout, FalseData, Delay, Replay, NoiseJam, EchoDelay, Insider)
}
AIRED = tuple(Kind(kind) for kind, effect in EFFECTS.items() if effect.over_air)


class Mode(IntEnum):
    """A request of the defence to the controller."""

    NORMAL = 0
    WIDEN = 1  # a longer time headway
    BRAKE = 2  # slow down gently
    STOP = 3  # brake as hard as the vehicle can
    ACC = 4  # use no message of other vehicles: cooperative cruise control falls back to the own sensors
