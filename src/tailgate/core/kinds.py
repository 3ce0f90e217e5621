"""What a command does to the wires that it targets, and what a defence asks of the controller. The numbers are part of published rows."""

from enum import IntEnum


class Kind(IntEnum):
    """What a command does to the wires that it targets. The number is part of the published rows."""

    NONE = 0
    DOS_JAM = 1  # the receiver reads the jammer's value
    DOS_HOLD = 2  # the receiver reads the last good sample before the first attack (6.18)
    DOS_HOLD_FRESH = 3  # the receiver reads the last good sample before this burst
    DROPOUT = 4  # nothing is received, and the receiver knows it
    FDI = 5  # value is added (4.4)
    DELAY = 6  # the receiver reads what was sent `value` steps ago
    REPLAY = 7  # the receiver reads the last `value` samples before this replay, over and over
    NOISE_JAM = 8  # over the air: noise of `value` watts reaches the receiver
    ECHO_DELAY = 9  # over the air: the receiver's own signal comes back `value` metres too late


AIRED = (Kind.NOISE_JAM, Kind.ECHO_DELAY)  # over the air: one value reaches all that a receiver reads, and changes what it measures
RADIATED = (Kind.DOS_JAM, *AIRED)  # kinds that a receiver which falls silent still hears


class Mode(IntEnum):
    """What a defence asks of the controller."""

    NORMAL = 0
    WIDEN = 1  # a longer time headway
    BRAKE = 2  # slow down gently
    STOP = 3  # brake as hard as the vehicle can
    ACC = 4  # use no message of other vehicles: cooperative cruise control falls back to the own sensors
