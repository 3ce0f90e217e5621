"""Base classes of the components that a scenario and a leaderboard put together.

A component is a frozen dataclass; its fields are its parameters. It owes a few methods, which keep nothing between calls:

* `prepare` computes constants once, the plan (no batch axis);
* `start` makes the state of B episodes: a NamedTuple in which every leaf has B first, or None;
* `step`, `decide`, `measure` and the like return the next state. They may write into the state that they were given.

P is the type of the plan, S that of the state. Axes: B episodes, N agents, n states, m actuators, q sensors per agent, p V2V fields, w = q
+ p + m wires. The model's inputs are the actuators, or what a plant tells of itself, as the own speed of a car with a radar. All arrays
are float64 in SI units unless a sentence says otherwise. `draws` are the random numbers of the component's own role: the same seed gives
the same numbers, whatever the batch.
"""

from __future__ import annotations

from typing import Generic, NamedTuple, Protocol, runtime_checkable

from tailgate.core.draws import Draws
from tailgate.core.nouns import Air, Array, Command, Estimate, Model, P, Prior, Received, S, Scene
from tailgate.core.threat import Brief


class Sized(Protocol):
    """The size of a plant, which a sensor needs to know. A sensor that needs more looks for a plant that it knows."""

    @property
    def size(self) -> tuple[int, int]:
        """Numbers of agents N and of states n of the model."""


class Plant(Sized, Protocol[P, S]):
    """The moving part of a scenario: vehicles, a network, or a scalar loop."""

    def prepare(self, model: Model) -> P:
        """Return the plan."""

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        """Return the public model. Where agents do not know each other's commands, it is a model of the closed loop.

        Raises
        ------
        InputError
            If the sensor or the controller does not fit this plant.
        """

    def start(self, plan: P, draws: Draws) -> S:
        """Return the state of B episodes at step 1; B is that of `draws`."""

    def prior(self, plan: P, state: S, held: Array, draws: Draws) -> Prior:
        """Return what the defence knows of a state that `start` made.

        Parameters
        ----------
        held : (B, N, h)
            The part of the model's state that the controllers keep.
        draws
            Those of `start`, whose tags below 16 are taken.

        Returns
        -------
        Prior
            mean (B, N, n) and cov (B, N, n, n).
        """

    def step(self, plan: P, state: S, u: Array, exo: Array, draws: Draws) -> S:
        """Return the state one step later.

        Parameters
        ----------
        u : (B, N, m)
            Commands as the actuators get them.
        exo : (B,)
            Acceleration of the leader [m/s^2], from the manoeuvre.
        """

    def known(self, plan: P, u: Array, exo: Array, state: S) -> Array:
        """Return the input of the model, (B, N, inputs), as far as each agent knows it, in the step with `u` and `exo` to `state`."""

    def truth(self, plan: P, state: S, held: Array) -> Array:
        """Return the model's true state (B, N, n); held (B, N, h) is the part of it that the controllers keep."""

    def scene(self, plan: P, state: S) -> Scene:
        """Return the road as anyone sees it; gaps are infinite where nobody drives."""

    def v2v(self, plan: P, state: S) -> Array:
        """Return the messages (B, N, p) that each agent would hear without an attack."""

    def odometry(self, plan: P, state: S) -> Array:
        """Return trusted position [m] and speed [m/s] (B, N, 2) of each agent; (B, N, 0) where it measures none."""

    def lead_speed_of(self, state: S) -> Array:
        """Return the speed (B,) of the vehicle that the manoeuvre drives [m/s]."""


@runtime_checkable
class Paced(Plant[P, S], Protocol[P, S]):
    """A plant whose cars may begin an episode at any speed."""

    def paced(self, plan: P, state: S, speed: Array) -> S:
        """Return the state that `start` made, with all cars at a speed (B,) [m/s]."""


class Sensor(Protocol[P]):
    """The sensors of every agent."""

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        """Return names of the q readings, C (N, q, n) and the noise covariance R (N, q, q).

        Raises
        ------
        InputError
            If the sensor does not fit this plant.
        """

    def prepare(self, model: Model) -> P:
        """Return the plan."""

    def measure(self, plan: P, truth: Array, probe: Array, draws: Draws) -> Received:
        """Return the readings y (B, N, q) of one step, which of them are valid, and the energy heard by a silent receiver.

        Parameters
        ----------
        truth : (B, N, n)
            The model's true state.
        probe : (B, N) bool
            False where the defence muted its own transmitter.
        """


@runtime_checkable
class Receiver(Sensor[P], Protocol[P]):
    """A sensor that listens to the echo of its own probe, so that an attacker can reach it over the air."""

    @property
    def challenge(self) -> int:
        """Number of complex samples that it takes while its probe is muted."""

    def disturbed(self, plan: P, truth: Array, probe: Array, draws: Draws, air: Air) -> Received:
        """Return what `measure` returns, under `air`. Where nothing is radiated the two agree to the last bit."""


class Controller(Protocol[P, S]):
    """The driver: commands from an estimate."""

    def prepare(self, model: Model) -> P:
        """Return the plan."""

    def start(self, plan: P, batch: int) -> S:
        """Return the state of B = `batch` episodes."""

    def step(self, plan: P, state: S, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[S, Array]:
        """Return the next state and the commands (B, N, m).

        Parameters
        ----------
        v2v : (B, N, p)
            Messages as they were received, after an attack.
        odometry : (B, N, 2 or 0)
            Trusted own position [m] and speed [m/s].
        """

    def held(self, plan: P, state: S, batch: int) -> Array:
        """Return the part of the model's state that the controllers keep, (B, N, h); (B, N, 0) for most."""

    def desired_gap(self, speed: Array) -> Array:
        """Return the gap [m] that it steers for at a speed [m/s], elementwise."""


@runtime_checkable
class Geared(Controller[P, S], Protocol[P, S]):
    """A controller whose law weighs signals by gains that an insider can scale: those that the model's `gains` names."""

    def scaled(self, plan: P, state: S, estimate: Estimate, v2v: Array, odometry: Array, factors: Array) -> tuple[S, Array]:
        """Return what `step` returns of a law with scaled gains, which obeys no mode. Every leaf of the state has (B, N) first.

        Parameters
        ----------
        factors : (B, N, gains)
            Multiples of the gains, in the order of the model's `gains`; 1 leaves the law as it is.
        """


class Manoeuvre(Protocol[P, S]):
    """The leader's driving."""

    def prepare(self, dt: float) -> P:
        """Return the plan; dt [s] is the length of a step."""

    def start(self, plan: P, draws: Draws) -> S:
        """Return the state of B episodes; B is that of `draws`."""

    def accel(self, plan: P, state: S, k: Array, speed: Array, draws: Draws) -> tuple[S, Array]:
        """Return the next state and the leader's acceleration (B,) [m/s^2] at step k (B,), from its speed (B,) [m/s]."""


@runtime_checkable
class Recording(Manoeuvre[P, S], Protocol[P, S]):
    """A manoeuvre that begins at a speed which differs from episode to episode. It needs a plant that is `Paced`."""

    def first_speed(self, plan: P, state: S) -> Array:
        """Return the leader's speed (B,) [m/s] at the start of the episode."""


class Defence(Protocol[P, S]):
    """A method that turns what is received into an estimate, a score and an alarm.

    A class attribute `uses` names what it reads besides the measurements: odometry, probe, v2v, redundant, leader_input, truth.
    Most defences are a filter, a detector and a mitigation (`tailgate.estimators.compose`).
    """

    def prepare(self, model: Model) -> P:
        """Return the plan for this model. Raise NotApplicable where the method cannot work."""

    def start(self, plan: P, prior: Prior) -> S:
        """Return the state of B episodes from the prior, mean (B, N, n) and cov (B, N, n, n)."""

    def step(self, plan: P, state: S, received: Received, known_u: Array, draws: Draws) -> tuple[S, Estimate]:
        """Return the next state and the estimate of the model's state at this step.

        Parameters
        ----------
        received
            What arrived, after an attack: y (B, N, q), valid (B, N, q) bool, and what `uses` asks for.
        known_u : (B, N, inputs)
            The model's input since the last step; zero where an agent does not know it.
        """


class WhiteBox(NamedTuple, Generic[P, S]):
    """The defence as a white-box attacker holds it. `look` changes nothing; a copy of the state may be stepped, to look ahead."""

    defence: Defence[P, S]
    plan: P
    state: S
    known_u: Array  # (B, N, inputs) the known input since the last step


class View(NamedTuple):
    """The part of an episode that the threat model lets an attacker see. None where it is not granted."""

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


class Attack(Protocol[P, S]):
    """An attacker: a script, a trained policy, or one that is computed."""

    def prepare(self, brief: Brief) -> P:
        """Return the plan from what is public: the model, the threat model and the horizon. Raise NotApplicable where it cannot work."""

    def start(self, plan: P, batch: int, draws: Draws) -> S:
        """Return the state of B = `batch` episodes."""

    def decide(self, plan: P, state: S, view: View, draws: Draws) -> tuple[S, Command]:
        """Return the next state and the command of this step: kind (B,) int8, target (B, N, w) bool, value (B, N, w)."""
