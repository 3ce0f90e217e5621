"""What is the same for all episodes of a lane: numbers `c` and choices `f`, each in one flat array, by name.

They are arguments of the compiled functions. Were they constants of them, every scenario would be compiled anew.
"""

from typing import Any

import numpy as np

MODELS = 4  # of several, at most
MOMENTS = 64  # challenges at fixed steps, at most
MODES, COMPONENTS = 64, 128  # discrete actions, and components of an observation, at most
MODE_WIDTH = 12  # of an action in the table: kind, sign, five targets, five values

_numbers: list[str] = []
_choices: list[str] = []


def _number(name: str, width: int = 1) -> int:
    _numbers.extend([name] * width)
    return len(_numbers) - width


def _choice(name: str, width: int = 1) -> int:
    _choices.extend([name] * width)
    return len(_choices) - width


# plant
DT, LOAD = _number("dt"), _number("load")
OWN_A, OWN_B = _number("own_A", 9), _number("own_B", 3)  # of the vehicle itself
PROCESS_SD, SENSOR_SD = _number("process_sd", 3), _number("sensor_sd", 2)
START_SD = _number("start_sd", 3)
START = _number("start", 3)  # x, v, a
LEAD_START, REAR_START = _number("lead_start", 2), _number("rear_start", 2)
WAY_PARAM = _number("way_param", 8)  # of the manoeuvre, see `road.way`
# a car with a radar: its lag, its filter's fourth state, which is the own speed, and what drives it
KEEP, GAIN = _number("keep"), _number("gain")
OWN_INTO, OWN_Q, OWN_PRIOR, OWN_BROAD = _number("own_into", 2), _number("own_Q"), _number("own_prior"), _number("own_broad")
LOWER_TAU, LOWER_GAIN, SAMPLE = _number("lower_tau"), _number("lower_gain"), _number("sample")
# the radar: powers at 1 m over the noise, its samples, its beats, their errors, and what it reports
ECHO, JAMMED, SAMPLES = _number("echo"), _number("jammed"), _number("samples")
PER_METRE, PER_SPEED, LOWEST, HIGHEST = _number("per_metre"), _number("per_speed"), _number("lowest"), _number("highest")
IF_BAND, LEAST_BOUND, WIDEST, REACH = _number("if_band"), _number("least_bound"), _number("widest"), _number("reach", 2)
LISTENED, LOUD, LOUD_SHARE = _number("listened"), _number("loud"), _number("loud_share")  # samples of a challenge; with an attacker
# a challenge: when, what is too loud, and how long it is remembered
USUAL, WATCHED, SUSPICION, QUIET = _number("usual"), _number("watched"), _number("suspicion"), _number("quiet")
TIMES = _number("times", MOMENTS)
# its regression
RIDGE, FADING, SURPRISE, ALLOWANCE = _number("ridge"), _number("fading"), _number("surprise"), _number("allowance")
SAMPLE_WEIGHT = _number("sample_weight", 2)
STRONGEST, LATEST = _number("strongest"), _number("latest")  # what may be radiated: power, delay
# what everyone is told
A, B, C0 = _number("A", 9), _number("B", 3), _number("c", 3)
Q, RNOISE = _number("Q", 9), _number("R", 4)
MEAN, PRIOR = _number("mean", 3), _number("prior", 9)
BROAD = _number("broad", 3)
# controller
HEADWAY, STANDSTILL, GAMMA = _number("headway"), _number("standstill"), _number("gamma")
SET_SPEED, ACCEL_MIN, ACCEL_MAX = _number("set_speed"), _number("accel_min"), _number("accel_max")
# defence
PRICE = _number("price")  # lam of the robust filter
FACTOR = _number("factor")  # of a platoon's correction
THRESHOLD, FEWER = _number("threshold"), _number("fewer")  # of all sensors, and of one that is left
DRIFT, WEIGHT, LIMIT = _number("drift"), _number("weight"), _number("limit")
LATCH, AFTER, LINGER, ASKED = _number("latch"), _number("after"), _number("linger"), _number("asked")  # ASKED: the mode
# threat model
ONSET, LAST, BUDGET, LONGEST, PAUSE = _number("onset"), _number("last"), _number("budget"), _number("longest"), _number("pause")
GRANTED = _number("granted", 10)  # by kind
WIRE = _number("wire", 5)  # whether it may be attacked
BOUND, LOW, HIGH = _number("bound", 5), _number("low", 5), _number("high", 5)
# seat: what is decided, what is paid
RATE, TABLE = _number("rate"), _number("mode", MODE_WIDTH * MODES)  # of a ramp; the discrete actions
INTERVAL = _number("interval")  # steps of a decision
BELIEF = _number("belief")  # how the believed gap depends on the first state
REWARD_SCALE, GAP_SHAPING, ERROR_SHAPING = _number("reward_scale"), _number("gap_shaping"), _number("error_shaping")
GAMMA_PAID, ILLEGAL, COST = _number("gamma_paid"), _number("illegal"), _number("cost")
SEEN_SCALE, SEEN_MOST = _number("seen_scale", COMPONENTS), _number("seen_most")  # of each component of the observation; where it is cut
HORIZON, BUDGET_SHARE = _number("horizon"), _number("budget_share")
# several models of the noise of the readings
MOVES, SHARES = _number("moves", MODELS * MODELS), _number("shares", MODELS)  # from row to column; before the first reading
NOISES = _number("noises", 4 * MODELS)
# safe set: of gap, speed ahead, own speed
ACCURATE, BOX_LO, BOX_HI = _number("accurate", 3), _number("box_lo", 4), _number("box_hi", 4)  # of the box also the own acceleration
OWN_OFF, OWN_WAY, OWN_SPEED = _number("own_off"), _number("own_way"), _number("own_speed")  # bounds of what moves the car otherwise
AHEAD_LO, AHEAD_HI, RECOVER = _number("ahead_lo"), _number("ahead_hi"), _number("recover")  # accelerations of the car ahead; steps
# the brake that acts on it
HARD, HARDER, LAG, RHO, EASED = _number("hard"), _number("harder"), _number("lag"), _number("rho"), _number("eased")
RESPONSE, CLEARANCE, DISTANCE, WATCH = _number("response"), _number("clearance"), _number("distance"), _number("watch")
# a platoon: gaps at the start (mean, sd, to either side), what cars are told of the start, sensors, what f keeps of itself in a step
GAPS, PRIOR_SD, NOISE_SD, FADES = _number("gaps", 3), _number("prior_sd"), _number("noise_sd", 3), _number("fades")
LOSS = _number("loss")  # probability that a reading or a message is lost
STATE_SD, WALK_SD, READ_SD = _number("state_sd"), _number("walk_sd"), _number("read_sd")  # a network: of its start, of a step, of readings
SPREAD = _number("spread")  # the scale of the readings' size, where it is shown
NUMBERS = len(_numbers)

AIRED = _choice("aired")  # a car with a radar
CHALLENGED, PRINTED = _choice("challenged"), _choice("printed")  # with the regression of which algorithm
FIXED, SAMPLED = _choice("fixed"), _choice("sampled")  # how many times; steps whose samples are kept
PASSES, STOPS, FREEZES, ROLLS_BACK = _choice("passes"), _choice("stops"), _choice("freezes"), _choice("rolls_back")
WAY, REACTION, REAR = _choice("way"), _choice("reaction"), _choice("rear")
UNIFORM_NOISE = _choice("uniform_noise")
RAW, STEADY, ROBUST, PER_SIGMA = _choice("raw"), _choice("steady"), _choice("robust"), _choice("per_sigma")
MODELED, BOXED, BRAKES, ALWAYS_ARMED = _choice("modeled"), _choice("boxed"), _choice("brakes"), _choice("always_armed")
DETECTOR, WINDOW, RESET, EXACT = _choice("detector"), _choice("window"), _choice("reset"), _choice("exact")
MITIGATION, MODED = _choice("mitigation"), _choice("moded")
ENDS, ACTUATED = _choice("ends"), _choice("actuated")
ACTION, ACTIONS, REWARD, FEATURES = _choice("action"), _choice("actions"), _choice("reward"), _choice("features")
SEEN, FROM = _choice("seen", COMPONENTS), _choice("from", COMPONENTS)  # the two rows of each component of the observation
# a platoon: how many; rows that a desk has on top; the length of a car's record; where things begin in `window`, in `s` and in `table`
CARS, STATES, INPUT_KNOWN = _choice("cars"), _choice("states"), _choice("input_known")
MISSES, IN_MISSES, THERE = _choice("misses"), _choice("who misses"), _choice("there")  # cars that may miss a reading; what was not lost
ROOM, CAR = _choice("room"), _choice("car")
HUNTED = _choice("hunted")
WORKS, AIMS, TRUTHS, FUSED = _choice("works"), _choice("aims"), _choice("truths"), _choice("fused")
SENDS, FORE, DEALT = _choice("sends"), _choice("fore"), _choice("dealt")
IN_A, IN_B, IN_C, IN_L, IN_MERGE, IN_HEARD = (_choice(name) for name in ("A", "B", "c", "L", "merge", "heard"))  # prediction and fusion
IN_READS, IN_W, IN_K, IN_SOME = (_choice(name) for name in ("reads", "W", "K", "some"))  # C, S^-1, gain; both where readings are missing
IN_LAW, IN_FEED, IN_BIAS, IN_V, IN_LED = (_choice(name) for name in ("law", "feed", "bias", "V", "led"))  # K, G, k0 and g0, V of the law
ALONE, STEPPED, PULLED = _choice("alone"), _choice("stepped"), _choice("pulled")  # no fusion; gains of so many steps; consensus
STEP_WIDE, IN_HEARS = _choice("step wide"), _choice("hears")  # how far apart the gains of two steps are; who reads whose sensors
ESTIMATOR, SHAPE, IN_SHAPE = _choice("estimator"), _choice("shape"), _choice("in shape")  # and what is made of an innovation before
WIRED, IN_WIRES, IN_MODES, PROFILED = (_choice(name) for name in ("wired", "wires", "modes", "profiled"))  # wires that may be attacked
# a network, which is no road: readings of an agent; where things begin, and the matrices of plant and sensors
SENSED, SENTS, BELIEFS = _choice("sensed"), _choice("sents"), _choice("beliefs")
ARRIVALS, VALIDS, RESIDUES, TAKEN = (_choice(name) for name in ("arrivals", "valids", "residues", "taken"))
SCORES, ALARMS, ABSENT, ASIDE = (_choice(name) for name in ("scores", "alarms", "absent", "aside"))
IN_OWN, IN_MEASURE, IN_SOME_WIDE = (_choice(name) for name in ("own", "measure", "some wide"))
SIZES = _choice("sizes")  # of what each agent reads, where that is shown
CHOICES = len(_choices)

# manoeuvres, detectors, mitigations
CONSTANT, PULSE, SWITCHED, SINE, BRAKING, STOP_AND_GO, RANDOM, PROFILE = range(8)
SCORE_ONLY, CHI2, WINDOWED, CUSUM, MEWMA, ALWAYS, SPARSE = range(7)
ACCEPT_ALL, GATE_OUT, REACQUIRE, ACCEPT_FIRST, ALWAYS_MODE, ACCEPT_HONEST = range(6)
LINEAR, LASSO, SATURATED, NORM, READ = range(5)  # how a platoon's cars estimate
DISCRETE, RAMPING, CONTINUOUS, INCREMENT = range(4)  # actions
CRASH, MIN_GAP, ERROR, PEAK, STEALTH, FINAL = range(6)  # rewards


def blank() -> tuple[np.ndarray, np.ndarray]:
    """Arrays for `c` and `f`, all zero."""
    return np.zeros(NUMBERS), np.zeros(CHOICES, np.int64)


def put(c: np.ndarray, at: int, values: Any) -> None:
    """Values of any shape, row by row, into `c` from `at` on."""
    flat = np.asarray(values, np.float64).ravel()
    c[at : at + len(flat)] = flat


class Table:
    """Numbers one after the other; whole ones by their bits."""

    def __init__(self, first: np.ndarray) -> None:
        self.parts, self.size = [first], len(first)

    def add(self, values: Any) -> int:
        """-> where they begin."""
        flat = np.array(values).ravel()
        flat = flat.astype(np.float64) if flat.dtype.kind == "f" else flat.astype(np.int64).view(np.float64)
        self.parts.append(flat)
        self.size += len(flat)
        return self.size - len(flat)

    def listed(self, matrix: np.ndarray, place: np.ndarray) -> int:
        """What is not zero of a matrix, row after row: how many, where the values of each row begin, the values, and the place of each."""
        rows, columns = np.nonzero(matrix)
        first = self.size + 1 + len(matrix) + 1
        starts = first + np.searchsorted(rows, np.arange(len(matrix) + 1))
        at = self.add([len(rows)])
        self.add(starts)
        self.add(matrix[rows, columns].astype(np.float64))
        places = np.broadcast_to(place, matrix.shape)[rows, columns]
        self.add(places.astype(np.int64))
        return at
