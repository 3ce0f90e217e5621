"""The nouns. Axes: B episodes, N agents, feature last; n states, m actuators, q sensors per agent, p V2V fields, w = q + p + m wires.

Three things are never mixed:

* parameters: a frozen dataclass; its fields are the defaults (`param` gives each its unit and one sentence);
* plan = prepare(...): constants made once, no batch axis;
* state = start(plan, ...): a NamedTuple (or None) in which EVERY leaf has B first. The loop owns the state.

All quantities are float64 in SI units.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypeVar

from tailgate.base.errors import InputError
from tailgate.core.kinds import AIRED as AIRED
from tailgate.core.kinds import Kind as Kind
from tailgate.core.kinds import Mode as Mode
from tailgate.core.quantities import Count as Count
from tailgate.core.quantities import Discount as Discount
from tailgate.core.quantities import Finite as Finite
from tailgate.core.quantities import NonNegative as NonNegative
from tailgate.core.quantities import Positive as Positive
from tailgate.core.quantities import PositiveCount as PositiveCount
from tailgate.core.quantities import Probability as Probability

Array = NDArray[Any]
P = TypeVar("P", default=Any)  # type of a component's plan
S = TypeVar("S", default=Any)  # type of its state


def param(default: object, doc: str, if_any: bool = False, cut: str = "") -> Any:
    """Return a dataclass field with its default, unit and one sentence; with `if_any` its data is written only where it is not empty.

    `cut` names the bound of the threat model at which a script cuts this value.
    """
    return dataclasses.field(default=default, metadata={"doc": doc, "if_any": if_any, "cut": cut})


@dataclass(frozen=True, eq=False)
class Model:
    """The public model of the plant: x+ = A x + B u + c + w, y_i = C_i x + v_i, where x is one state for all agents.

    A (n, n), B (n, m), c (n,), C (N, q, n), Q = cov w (n, n), R = cov v (N, q, q), dt [s]. graph (N, N) bool is true at [i, j] when i
    hears j. `sensors` names the q rows of C, `v2v` the fields of the message that a controller hears, `actuators` what an agent commands.
    Row i of `gap` and `speed` (N, n): agent i's gap to the vehicle ahead and its own speed as functions of x. A row of zeros, the
    default, is an agent without a road.
    `challenge` is the number of complex samples that a sensor which listens to its own echo takes while its probe is muted.
    0, the default, is a sensor that does not listen: noise_jam and echo_delay reach only those that do (`air`).
    `gains` names the wires whose signal the agents' own laws weigh by a gain that an insider can scale: the error, then its rate.
    `lane` is half of the width of a lane [m] whose nearer line takes the place of the car ahead. 0, the default, is a road with cars.
    """

    A: Array
    B: Array
    c: Array
    C: Array
    Q: Array
    R: Array
    graph: Array
    dt: float
    sensors: tuple[str, ...]
    v2v: tuple[str, ...] = ()
    actuators: tuple[str, ...] = ()
    gap: Array | None = None
    speed: Array | None = None
    challenge: int = 0
    lane: float = 0.0
    gains: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("A", "B", "c", "C", "Q", "R", "graph", "gap", "speed"):  # public, and nobody's to change: own copies, read-only
            held = getattr(self, name)
            own = np.zeros((self.agents, self.states)) if held is None else np.array(held)
            own.flags.writeable = False
            object.__setattr__(self, name, own)
        if len(set(self.wires)) < len(self.wires):  # a threat model grants wires by name
            raise InputError("model: sensors, v2v, actuators", list(self.wires), "names of which no two are equal")

    @property
    def agents(self) -> int:
        return int(self.C.shape[0])

    @property
    def states(self) -> int:
        return int(self.A.shape[0])

    @property
    def inputs(self) -> int:
        return int(self.B.shape[1])

    @property
    def wires(self) -> tuple[str, ...]:
        """Everything that an attacker may touch: the sensors, then the V2V fields, then the actuators."""
        return self.sensors + self.v2v + self.actuators

    @property
    def air(self) -> bool:
        """True if the sensors listen to their own echo."""
        return self.challenge > 0

    @property
    def followers(self) -> Array:
        """(N,) bool: the agents that drive behind another vehicle, or between the lines of a lane."""
        assert self.gap is not None
        return np.asarray((self.gap != 0.0).any(axis=1))

    def gap_error(self, x: Array, truth: Array) -> Array:
        """Return by how much each agent overestimates its gap [m] (..., N), from (..., N, n); 0 without a road."""
        return _rows(self.gap, x, truth)

    def speed_error(self, x: Array, truth: Array) -> Array:
        """Return by how much each agent overestimates its speed [m/s] (..., N), from (..., N, n); 0 without a road."""
        return _rows(self.speed, x, truth)

    def error(self, x: Array, truth: Array) -> Array:
        """Return the size of an estimate's error (..., N): of the gap [m] where an agent follows another, else of the whole state."""
        if self.followers.any():
            return np.abs(self.gap_error(x, truth))
        total = np.zeros(x.shape[:-1])
        for j in range(x.shape[-1]):  # state by state: of many agents the whole difference is large
            off = x[..., j] - truth[..., j]
            total += off * off
        return np.sqrt(total)


def _rows(rows: Array | None, x: Array, truth: Array) -> Array:
    """Return row i of `rows` (N, n) times the error x - truth (..., N, n) of agent i, (..., N), summed in fixed order."""
    assert rows is not None
    out = np.zeros(x.shape[:-1])
    for i, j in zip(*np.nonzero(rows), strict=True):
        out[..., i] += rows[i, j] * (x[..., i, j] - truth[..., i, j])
    return out


class Prior(NamedTuple):
    """The defence's knowledge before the first measurement: mean (B, N, n) and cov (B, N, n, n)."""

    mean: Array
    cov: Array


class Lane(NamedTuple):
    """The place of a car in its lane, each (B, N); left is positive."""

    offset: Array  # of the centre of gravity from the middle [m]
    rate: Array  # of that offset [m/s]
    curvature: Array  # of the road [1/m]


class Scene(NamedTuple):
    """The road as anyone near it sees it, each (B, N). Gap [m] to the car ahead, bumper to bumper; speeds [m/s].

    Where a plant has a `lane`, its nearer line takes the place of the car ahead.
    """

    gap: Array  # inf where nobody drives ahead
    speed: Array
    accel: Array
    lead_speed: Array  # of the car ahead; the own speed where there is none
    rear_gap: Array  # to a car behind that is not an agent; inf where there is none
    rear_speed: Array
    position: Array
    lane: Lane | None = None

    def road(self, row: int, agent: int) -> dict[str, float]:
        """Return the numbers of one agent in one row, by name; those of a lane apart."""
        leaves: dict[str, Array] = {name: leaf for name, leaf in self._asdict().items() if name != "lane"}
        return {name: float(leaf[row, agent]) for name, leaf in leaves.items()}


class Received(NamedTuple):
    """The readings and messages that arrive over the wires in one step, each leaf (B, N, .).

    The loop fills the last three only for a defence whose card declares them in `uses`.
    """

    y: Array  # (B, N, q) sensor readings
    valid: Array  # (B, N, q) bool, False where nothing arrived
    energy: Array  # (B, N) mean power heard while the probe was muted, over that of the receiver's noise; 0 where it was not
    v2v: Array | None = None  # (B, N, p) the message of the car ahead
    odometry: Array | None = None  # (B, N, 2) trusted own odometry: position [m] and speed [m/s]
    attacked: Array | None = None  # (B, N, q) bool, the truth about the attack: the oracle's


class Air(NamedTuple):
    """The noise and delays that an attacker radiates at each receiver in one step."""

    power: Array  # (B, N) noise [W]; 0 for none
    delay: Array  # (B, N) by how much an answered echo is too late, as range [m]; 0 where none is answered
    reaction: float  # time until the attacker hears that a probe is muted, and falls silent [s]; inf when it never does


class Command(NamedTuple):
    """One attack command per episode: kind (B,) int8, target (B, N, w) bool, value (B, N, w)."""

    kind: Array
    target: Array
    value: Array


class Estimate(NamedTuple):
    """All that the loop takes from a defence.

    x (B, N, n), score (B, N) (higher is more suspect), alarm (B, N) bool, mode (B, N) int8 of `Mode`, probe (B, N) bool:
    False mutes the defence's own sensor in the next step. limits (B, N, m, 2), optional: the least and the largest command that the
    defence lets the controller give; infinite where it does not care. offset (B, N, m), optional: what the defence adds to the command.
    """

    x: Array
    score: Array
    alarm: Array
    mode: Array
    probe: Array
    limits: Array | None = None
    offset: Array | None = None


def pair_of(answer: object) -> tuple[Any, Estimate]:
    """Return the pair (state, Estimate) of a defence's step; raise InputError for anything else."""
    if not isinstance(answer, tuple) or len(answer) != 2 or not isinstance(answer[1], Estimate):
        got = f"({', '.join(type(part).__name__ for part in answer)})" if type(answer) is tuple else type(answer).__name__
        raise InputError("defence output", got, "a pair (state, Estimate) as the result of its step")
    return answer[0], answer[1]


class Innovation(NamedTuple):
    """r = y - C x- (B, N, q) and its covariance S (B, N, q, q)."""

    r: Array
    S: Array


class Frame(NamedTuple):
    """One step as a reader of the loop gets it. Estimates belong to time k, `scene` to k + 1."""

    k: Array  # (B,)
    truth: Array  # (B, N, n) at k
    clean: Array  # (B, N, q+p) what was sent
    wires: Array  # (B, N, q+p) what arrived
    command: Command  # what took effect
    refused: Array  # (B,) bool
    estimate: Estimate
    control: Array  # (B, N, m) what the controller commanded
    applied: Array  # (B, N, m) what the actuators got
    scene: Scene
    received: Received  # after the attack
    collided: Array  # (B,) bool
    rear_collided: Array  # (B,) bool


def no_command(batch: int, agents: int, wires: int) -> Command:
    """Return the command that does nothing."""
    return Command(
        np.zeros(batch, np.int8),
        np.zeros((agents, wires, batch), bool).transpose(2, 0, 1),
        np.zeros((agents, wires, batch)).transpose(2, 0, 1),
    )
