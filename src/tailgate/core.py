"""The nouns. Axes: B episodes, N agents, feature last; n states, m inputs, q sensors per agent, p V2V fields, w = q + p + m wires.

Three things are never mixed:

* parameters: a frozen dataclass; its fields are the defaults (`param` gives each its unit and one sentence);
* plan = prepare(...): constants made once, no batch axis;
* state = start(plan, ...): a NamedTuple (or None) in which EVERY leaf has B first. The loop owns the state.

All quantities are float64 in SI units.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from tailgate.draws import Draws

if TYPE_CHECKING:
    from tailgate.threat import Brief

Array = NDArray[Any]

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]
PositiveCount = Annotated[int, Field(ge=1)]


def param(default: Any, doc: str) -> Any:
    """A dataclass field with its default, unit and one sentence."""
    return dataclasses.field(default=default, metadata={"doc": doc})


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


class Mode(IntEnum):
    """What a defence asks of the controller."""

    NORMAL = 0
    WIDEN = 1  # a longer time headway
    BRAKE = 2  # slow down gently
    STOP = 3  # brake as hard as the vehicle can


@dataclass(frozen=True, eq=False)
class Model:
    """What is publicly known of the plant: x+ = A x + B u + c + w, y_i = C_i x + v_i.

    A (n, n), B (n, m), c (n,), C (N, q, n), Q = cov w (n, n), R = cov v (N, q, q); graph (N, N) bool, [i, j] when i hears j;
    dt [s]; `sensors` names the q rows of C, `v2v` the p fields of the message that a controller hears, `actuators` the m inputs.
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

    def __post_init__(self) -> None:
        for name in ("A", "B", "c", "C", "Q", "R", "graph"):  # public, and nobody's to change: own copies, read-only
            own = np.array(getattr(self, name))
            own.flags.writeable = False
            object.__setattr__(self, name, own)

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


class Prior(NamedTuple):
    """What the defence is told before the first measurement: mean (B, N, n) and cov (B, N, n, n)."""

    mean: Array
    cov: Array


class Scene(NamedTuple):
    """The road as anyone beside it sees it, each (B, N). Gap [m] to the car ahead, bumper to bumper; speeds [m/s]."""

    gap: Array
    speed: Array
    accel: Array
    lead_speed: Array
    rear_gap: Array  # to the car behind; inf where nobody drives behind
    rear_speed: Array
    position: Array


class Received(NamedTuple):
    """What arrives over the wires in one step, each leaf (B, N, .).

    The loop fills the last three only for a defence whose card declares them in `uses`.
    """

    y: Array  # (B, N, q) sensor readings
    valid: Array  # (B, N, q) bool, False where nothing arrived
    energy: Array  # (B, N) energy heard while the own probe was muted
    v2v: Array | None = None  # (B, N, p) the message of the car ahead
    odometry: Array | None = None  # (B, N, .) trusted own odometry
    attacked: Array | None = None  # (B, N, q) bool, the truth about the attack: the oracle's


class Command(NamedTuple):
    """One attack command per episode: kind (B,) int8, target (B, N, w) bool, value (B, N, w)."""

    kind: Array
    target: Array
    value: Array


class Estimate(NamedTuple):
    """All that the loop takes from a defence.

    x (B, N, n), score (B, N) (higher is more suspect), alarm (B, N) bool, mode (B, N) int8 of `Mode`, probe (B, N) bool:
    False mutes the defence's own sensor in the next step.
    """

    x: Array
    score: Array
    alarm: Array
    mode: Array
    probe: Array


class Innovation(NamedTuple):
    """r = y - C x- (B, N, q) and its covariance S (B, N, q, q)."""

    r: Array
    S: Array


class View(NamedTuple):
    """What the threat model lets an attacker see. None where it is not granted."""

    k: Array  # (B,) step, from 1
    progress: Array  # (B,) k / horizon
    scene: Scene
    budget_left: Array  # (B,) attack steps; inf when unlimited
    budget: Array  # (B,) the whole budget; inf when unlimited
    burst: Array  # (B,) steps that the present burst has lasted
    cooldown: Array  # (B,) steps before the next burst may start
    allowed: Array  # (B,) bool: a legal command would be accepted now
    last: Command  # the last command that took effect
    control: Array | None = None  # (B, N, m) grey: the input last commanded
    received: Received | None = None  # the defence's measurement, before this step's attack
    defence: WhiteBox | None = None  # white: the defence object, its plan and its state
    estimate: Estimate | None = None  # white
    truth: Array | None = None  # white: (B, N, n)


class WhiteBox(NamedTuple):
    """The defence as a white-box attacker holds it. Its step is pure on the given state: look ahead at will."""

    defence: Defence
    plan: Any
    state: Any
    known_u: Array  # (B, N, m) the known input since the last step


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
    collided: Array  # (B,) bool
    rear_collided: Array  # (B,) bool


class Defence(Protocol):
    """A method that turns what is received into an estimate, a score and an alarm (spec of the loop)."""

    def prepare(self, model: Model) -> Any:
        """Constants of this defence for this model, no batch axis."""

    def start(self, plan: Any, prior: Prior) -> Any:
        """State of B episodes; a NamedTuple whose every leaf has B first, or None."""

    def step(
        self, plan: Any, state: Any, received: Received, known_u: Array, draws: Draws
    ) -> tuple[Any, Estimate]:
        """One step: known_u (B, N, m) is the input commanded since the last step (zero where an agent does not know it)."""


class Attack(Protocol):
    """An attacker's policy, scripted or learned."""

    def prepare(self, brief: Brief) -> Any: ...

    def start(self, plan: Any, batch: int, draws: Draws) -> Any: ...

    def decide(self, plan: Any, state: Any, view: View, draws: Draws) -> tuple[Any, Command]: ...


class Plant(Protocol):
    """What moves. `truth`, `scene`, `v2v` and `lead_speed_of` read the state that start and step return."""

    def prepare(self) -> Any: ...

    def model(self, sensors: tuple[str, ...], C: Array, R: Array) -> Model:
        """The public model, completed with what the sensor says of itself."""

    def prior(self, plan: Any, batch: int) -> Prior: ...

    def start(self, plan: Any, draws: Draws) -> Any: ...

    def step(self, plan: Any, state: Any, u: Array, exo: Array, draws: Draws) -> Any:
        """u (B, N, m) inputs, exo (B,) the manoeuvre's acceleration of the leader [m/s^2]."""

    def truth(self, plan: Any, state: Any) -> Array: ...

    def scene(self, plan: Any, state: Any) -> Scene: ...

    def v2v(self, plan: Any, state: Any) -> Array: ...

    def lead_speed_of(self, state: Any) -> Array:
        """(B,) speed of the vehicle that the manoeuvre drives [m/s]."""


class Sensor(Protocol):
    """What measures: truth (B, N, n) to readings; probe (B, N) False where the defence muted its own transmitter."""

    def matrices(self) -> tuple[tuple[str, ...], Array, Array]:
        """Names of the q readings, C (N, q, n) and R (N, q, q)."""

    def prepare(self, model: Model) -> Any: ...

    def measure(self, plan: Any, truth: Array, probe: Array, draws: Draws) -> Received: ...


class Controller(Protocol):
    """What drives, on the defence's estimate."""

    def prepare(self, model: Model) -> Any: ...

    def start(self, plan: Any, batch: int) -> Any: ...

    def step(self, plan: Any, state: Any, estimate: Estimate, v2v: Array) -> tuple[Any, Array]: ...

    def desired_gap(self, speed: Array) -> Array:
        """The gap [m] that it steers for at a speed [m/s], elementwise."""


class Manoeuvre(Protocol):
    """What the leader does: its acceleration [m/s^2] at each row's step k, given its speed."""

    def prepare(self, dt: float) -> Any: ...

    def start(self, plan: Any, draws: Draws) -> Any: ...

    def accel(self, plan: Any, state: Any, k: Array, speed: Array, draws: Draws) -> tuple[Any, Array]: ...


def no_command(batch: int, agents: int, wires: int) -> Command:
    """The command that does nothing."""
    return Command(
        np.zeros(batch, np.int8),
        np.moveaxis(np.zeros((agents, wires, batch), bool), -1, 0),
        np.moveaxis(np.zeros((agents, wires, batch)), -1, 0),
    )
