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
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tailgate.base.errors import InputError
from tailgate.core.draws import Draws
from tailgate.core.kinds import AIRED as AIRED
from tailgate.core.kinds import RADIATED as RADIATED
from tailgate.core.kinds import Kind as Kind
from tailgate.core.kinds import Mode as Mode
from tailgate.core.quantities import Count as Count
from tailgate.core.quantities import Discount as Discount
from tailgate.core.quantities import Finite as Finite
from tailgate.core.quantities import NonNegative as NonNegative
from tailgate.core.quantities import Positive as Positive
from tailgate.core.quantities import PositiveCount as PositiveCount
from tailgate.core.quantities import Probability as Probability

if TYPE_CHECKING:
    from tailgate.core.threat import Brief

Array = NDArray[Any]


def param(default: Any, doc: str, if_any: bool = False) -> Any:
    """A dataclass field with its default, unit and one sentence; with `if_any` its data is written only where it is not empty."""
    return dataclasses.field(default=default, metadata={"doc": doc, "if_any": if_any})


@dataclass(frozen=True, eq=False)
class Model:
    """What is publicly known of the plant: x+ = A x + B u + c + w, y_i = C_i x + v_i, x being one state for all agents.

    A (n, n), B (n, m), c (n,), C (N, q, n), Q = cov w (n, n), R = cov v (N, q, q); graph (N, N) bool, [i, j] when i hears j;
    dt [s]; `sensors` names the q rows of C, `v2v` the fields of the message that a controller hears, `actuators` what an agent commands.
    Row i of `gap` and `speed` (N, n) says how agent i's gap to the vehicle ahead and its own speed depend on x; a row of zeros, the
    default, is an agent without a road. `challenge` is the number of complex samples that a sensor which listens to its own echo takes
    while its probe is muted; 0, the default, is a sensor that does not: noise_jam and echo_delay reach only those that do (`air`).
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
        """Whether the sensors listen to their own echo."""
        return self.challenge > 0

    @property
    def followers(self) -> Array:
        """(N,) bool: the agents that drive behind another vehicle."""
        assert self.gap is not None
        return np.asarray((self.gap != 0.0).any(axis=1))

    def gap_error(self, x: Array, truth: Array) -> Array:
        """(..., N) [m] by how much each agent overestimates its gap, from (..., N, n); 0 without a road."""
        return _rows(self.gap, x, truth)

    def speed_error(self, x: Array, truth: Array) -> Array:
        """(..., N) [m/s] by how much each agent overestimates its speed, from (..., N, n); 0 without a road."""
        return _rows(self.speed, x, truth)

    def error(self, x: Array, truth: Array) -> Array:
        """(..., N) size of an estimate's error: of the gap [m] where some agent follows another, else the 2-norm of the whole state's."""
        if self.followers.any():
            return np.abs(self.gap_error(x, truth))
        total = np.zeros(x.shape[:-1])
        for j in range(x.shape[-1]):  # state by state: of many agents the whole difference is large
            off = x[..., j] - truth[..., j]
            total += off * off
        return np.sqrt(total)


def _rows(rows: Array | None, x: Array, truth: Array) -> Array:
    """(..., N): row i of `rows` (N, n) times the error x - truth (..., N, n) of agent i, in fixed order."""
    assert rows is not None
    out = np.zeros(x.shape[:-1])
    for i, j in zip(*np.nonzero(rows), strict=True):
        out[..., i] += rows[i, j] * (x[..., i, j] - truth[..., i, j])
    return out


class Prior(NamedTuple):
    """What the defence is told before the first measurement: mean (B, N, n) and cov (B, N, n, n)."""

    mean: Array
    cov: Array


class Scene(NamedTuple):
    """The road as anyone beside it sees it, each (B, N). Gap [m] to the car ahead, bumper to bumper; speeds [m/s]."""

    gap: Array  # inf where nobody drives ahead
    speed: Array
    accel: Array
    lead_speed: Array  # of the car ahead; the own speed where there is none
    rear_gap: Array  # to a car behind that is not an agent; inf where there is none
    rear_speed: Array
    position: Array


class Received(NamedTuple):
    """What arrives over the wires in one step, each leaf (B, N, .).

    The loop fills the last three only for a defence whose card declares them in `uses`.
    """

    y: Array  # (B, N, q) sensor readings
    valid: Array  # (B, N, q) bool, False where nothing arrived
    energy: Array  # (B, N) mean power heard while the probe was muted, over that of the receiver's noise; 0 where it was not
    v2v: Array | None = None  # (B, N, p) the message of the car ahead
    odometry: Array | None = None  # (B, N, 2) trusted own odometry: position [m] and speed [m/s]
    attacked: Array | None = None  # (B, N, q) bool, the truth about the attack: the oracle's


class Air(NamedTuple):
    """What an attacker radiates at each receiver in one step."""

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
    defence lets the controller give; infinite where it does not care.
    """

    x: Array
    score: Array
    alarm: Array
    mode: Array
    probe: Array
    limits: Array | None = None


def pair_of(answer: Any) -> tuple[Any, Estimate]:
    """What a defence's step has to return; raises InputError for anything else."""
    if not isinstance(answer, tuple) or len(answer) != 2 or not isinstance(answer[1], Estimate):
        got = f"({', '.join(type(part).__name__ for part in answer)})" if type(answer) is tuple else type(answer).__name__
        raise InputError("defence output", got, "a pair (state, Estimate), which its step returns")
    return answer


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
    probed: Array | None = None  # (B, N) bool: the sensor's probe was heard in the step before; None of sensors that send none
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
    received: Received  # after the attack
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
        """One step: known_u (B, N, m) is the model's input since the last step (zero where an agent does not know it)."""


class Attack(Protocol):
    """An attacker's policy, scripted or learned."""

    def prepare(self, brief: Brief) -> Any: ...

    def start(self, plan: Any, batch: int, draws: Draws) -> Any: ...

    def decide(self, plan: Any, state: Any, view: View, draws: Draws) -> tuple[Any, Command]: ...


class Sized(Protocol):
    """What a sensor is told of its plant; one that needs more looks for a plant that it knows."""

    @property
    def size(self) -> tuple[int, int]:
        """How many agents and how many states of the model there are."""


class Plant(Sized, Protocol):
    """What moves. `truth`, `scene`, `v2v` and `lead_speed_of` read the state that start and step return."""

    def prepare(self, model: Model) -> Any: ...

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        """The public model. Where agents do not know each other's commands, it is a model of the closed loop."""

    def start(self, plan: Any, draws: Draws) -> Any: ...

    def prior(self, plan: Any, state: Any, held: Array, draws: Draws) -> Prior:
        """What the defence is told of a state that `start` made; `draws` are those of `start`, whose tags below 16 are taken."""

    def step(self, plan: Any, state: Any, u: Array, exo: Array, draws: Draws) -> Any:
        """u (B, N, m) commands, exo (B,) the manoeuvre's acceleration of the leader [m/s^2]."""

    def known(self, plan: Any, u: Array, exo: Array, state: Any) -> Array:
        """(B, N, model inputs): what each agent knows of the model's input in the step with these commands that led to `state`."""

    def truth(self, plan: Any, state: Any, held: Array) -> Array:
        """(B, N, n) the model's state; `held` (B, N, .) is the part of it that the controllers keep."""

    def scene(self, plan: Any, state: Any) -> Scene: ...

    def v2v(self, plan: Any, state: Any) -> Array: ...

    def odometry(self, plan: Any, state: Any) -> Array:
        """(B, N, 2) position [m] and speed [m/s] as each agent measures them itself, trusted; (B, N, 0) where it has no such thing."""

    def lead_speed_of(self, state: Any) -> Array:
        """(B,) speed of the vehicle that the manoeuvre drives [m/s]."""


class Sensor(Protocol):
    """What measures: truth (B, N, n) to readings; probe (B, N) False where the defence muted its own transmitter."""

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        """Names of the q readings, C (N, q, n) and R (N, q, q). Raises InputError for a plant that it does not fit."""

    def prepare(self, model: Model) -> Any: ...

    def measure(self, plan: Any, truth: Array, probe: Array, draws: Draws) -> Received: ...


@runtime_checkable
class Receiver(Sensor, Protocol):
    """A sensor that listens to the echo of its own probe, so that an attacker can reach it over the air."""

    @property
    def challenge(self) -> int:
        """Complex samples that it takes while its probe is muted."""

    def disturbed(self, plan: Any, truth: Array, probe: Array, draws: Draws, air: Air) -> Received:
        """What `measure` gives under `air`, by the same draws: where nothing is radiated the two agree to the last bit."""


class Controller(Protocol):
    """What drives, on the defence's estimate."""

    def prepare(self, model: Model) -> Any: ...

    def start(self, plan: Any, batch: int) -> Any: ...

    def step(self, plan: Any, state: Any, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[Any, Array]:
        """estimate, messages v2v (B, N, p) as received, and trusted odometry (B, N, 2 or 0) to the commands (B, N, m)."""

    def held(self, plan: Any, state: Any, batch: int) -> Array:
        """(B, N, .) the part of the model's state that the controllers keep; empty (B, N, 0) for most."""

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
        np.zeros((agents, wires, batch), bool).transpose(2, 0, 1),
        np.zeros((agents, wires, batch)).transpose(2, 0, 1),
    )
