"""Where a lane keeps what: rows of LANES numbers in one flat array, one number for each episode of a block.

A row's name is its offset: `s[K + i]` is the step of episode i. The offsets are literals to the compiler, which so sees that no two rows
overlap, and can take several episodes in one instruction; they are unsigned, as a signed index would be checked for being negative.
Whatever is a whole number or a truth value elsewhere is a float here, exact up to 2^53.
"""

import numpy as np

LANES = 64  # episodes of a block: its rows stay in the processor's cache while they are played
SENSORS, LINKS, WIRES = 2, 4, 5  # position, velocity; + the leader's, by V2V; + the actuator

_names: list[str] = []


def wires_of(count: int) -> list[int]:
    """Which of the WIRES are those of a model with so many: without a leader's message the sensors are the first, the actuator the last."""
    return [*range(count - 1), WIRES - 1]


def _row(name: str, width: int = 1) -> np.uint64:
    first = np.uint64(LANES * len(_names))
    _names.extend([name] + [f"{name}{i}" for i in range(1, width)])
    return first


# The state between two steps, of whatever drives.
K = _row("k")
ENDED = _row("ended")
LEAD_X, LEAD_V = _row("lead_x"), _row("lead_v")
WAY = _row("way", 2)  # the manoeuvre's own
USED, BURST, COOLDOWN = _row("used"), _row("burst"), _row("cooldown")
KIND = _row("kind")  # of the command in force
LENGTH = _row("length")  # steps that the episode has lasted
OPENED, ELAPSED, SEEN = _row("opened"), _row("elapsed"), _row("seen")  # a script's trigger: `tailgate.agents.triggers`
OVER = _row("over")  # of a seat: the row was over before this decision
POTENTIAL, LEAST, PEAK = _row("potential"), _row("least"), _row("peak")  # and what its reward remembers
COMMON = len(_names)
# And of a car that follows another.
EGO = _row("ego", 3)  # x, v, a
REAR_X, REAR_V = _row("rear_x"), _row("rear_v")
X = _row("x", 3)  # the filter's mean, which is the estimate
P = _row("P", 9)  # and its covariance, row by row
SUM = _row("sum", 3)  # what a detector sums up
LEFT = _row("left")  # steps that a mode still lasts
SHUT = _row("shut", SENSORS)  # steps that a gate stays shut
REJECTED = _row("rejected", SENSORS)
U = _row("u")  # commanded last
SENT = _row("sent", LINKS)
HELD, FRESH = _row("held", WIRES), _row("fresh", WIRES)
TARGET, VALUE = _row("target", WIRES), _row("value", WIRES)  # of the command in force
MODE = _row("mode")  # asked of the controller
STATE = len(_names)  # rows of a state: what is kept of an episode between two calls
# What a car with a radar keeps on top.
LEAD_A = _row("lead_a")
OWN, OWN_VAR = _row("own"), _row("own_var")  # the own speed as the filter was told it last, and its variance there
HEARS, ENERGY = _row("hears"), _row("energy")  # of the readings SENT: whether there are any; what a silent radar heard
PROBE, PROBED = _row("probe"), _row("probed")  # whether these readings were taken with a probe, and those before them
RADAR_STATE = len(_names)

# What a step computes on its way.
SCORE, ALARM = _row("score"), _row("alarm")
WANT_KIND = _row("want_kind")  # the command that was asked for
WANT_TARGET, WANT_VALUE = _row("want_target", WIRES), _row("want_value", WIRES)
REFUSED = _row("refused")
ARRIVED = _row("arrived", LINKS)
VALID = _row("valid", SENSORS)
R = _row("r", SENSORS)  # the innovation
S = _row("S", 4)  # its covariance, row by row
CROSS = _row("cross", 6)  # C P-, of a challenge
SUSPECT = _row("suspect", SENSORS)
ACCEPT = _row("accept", SENSORS)
FORGET = _row("forget")
EXO = _row("exo")  # the leader's acceleration
APPLIED = _row("applied")
DRAW = _row("draw", 4)
TRUTH = _row("truth", 3)
CLEAN = _row("clean", LINKS)
HIT, REAR_HIT = _row("hit"), _row("rear_hit")
ON, DRAWN = _row("on"), _row("drawn", 6)  # of a script
MEAN, COVARIANCE = _row("mean", 3), _row("covariance", 9)  # of a filter that is looked into: as they were
INTO, GATE, PASSES = _row("into", SENSORS), _row("gate"), _row("passes")  # K' e; what raises no alarm; whether it is kept to
SPAN, READ, HEARD = _row("span", 2), _row("read"), _row("heard")  # of a safe set: what is predicted, what is read, and whether it is
PASSED, ACCEL, AHEAD = _row("passed", 2), _row("accel", 2), _row("ahead", 2)  # own way, own acceleration, speed ahead before the step
WAIT, WORST = _row("wait"), _row("worst", 2)  # readings that have still to pass; the interval, and what is read outside of it
SLOWEST, FASTEST = _row("slowest"), _row("fastest")  # the car ahead and the own, at worst
MISSING, MOST = _row("missing"), _row("most")  # a quantity that nobody tells; the largest command
PIVOT = _row("pivot", 2)  # of the elimination of S
TOTAL, TOP, RIVAL, WEIGHT = _row("total"), _row("top"), _row("rival"), _row("weight")  # of models that are weighed
STOP = _row("stop", 4)  # of a stop: speed, acceleration above braking, time, exp(-time / lag)
LIVE, RAW, BEFORE = _row("live"), _row("raw"), _row("before")  # of a seat: this step counts; what it pays; the potential before
EARNED, PART = _row("earned"), _row("part")  # this step's pay, and a part of it
OFF = _row("off")  # of several cars: the largest error of a gap
ANY_REFUSED, ANY_HIT, ANY_REAR = _row("any_refused"), _row("any_hit"), _row("any_rear")
ACCEPTED, OPEN = _row("accepted"), _row("open")  # any step of the decision, and of the next one
LEFT_OVER, ATTACKING, ZERO, INFINITE = _row("left_over"), _row("attacking"), _row("zero"), _row("infinite")  # of an observation
POWER, DELAY = _row("power"), _row("delay")  # radiated at a radar
BEAT, SNR, DEALT = _row("beat", 2), _row("snr"), _row("dealt", 4)  # how it measures: beats, signal over noise, uniforms
UNDER, UNDER_HEARS, UNDER_ENERGY = _row("under", SENSORS), _row("under_hears"), _row("under_energy")  # what it reads under that
LAST_POWER, LAST_DELAY, LAST = _row("last_power"), _row("last_delay"), _row("last", SENSORS)  # of an observation: what was sent last
NOISE, SILENT = _row("noise", SENSORS), _row("silent")  # by how much readings are off, and whether there are none
HEARD = _row("heard_now")  # what it heard in this step
MUTED, BACK, CALM = _row("muted"), _row("back"), _row("calm")  # of a challenge: whether there is one; whether it fails, and passes
FORMER, MOVED, AGE, CUSUM = _row("former"), _row("moved"), _row("age"), _row("cusum", 4)  # of its regression; the speed before, and the way
AT_STOP, HALTED, FORESEEN, CHANGED = _row("at_stop"), _row("halted"), _row("foreseen", SENSORS), _row("changed")
FORMER_VAR, OWN_COV, TOLD = _row("former_var"), _row("own_cov", 3), _row("told")  # of a mixture: of the own speed; what is made of it
ASIDE = _row("aside", 2)  # two numbers that change places
ROWS = len(_names)

# Whole numbers, in an array of their own: what the random numbers are drawn by.
WORLD_KEY, ATTACK_KEY, EPISODE, STEP, DEFENCE_KEY = (np.uint64(LANES * i) for i in range(5))
WORDS = 5
