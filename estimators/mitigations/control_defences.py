"""Control defences: mitigations that bound the command, whatever filter and messages say (docs/platoon.md).

`input_clip` and `sliding_mode` compute a command from a car's own three sensors, its gap d, speed v and acceleration a, as they were
received. The gap's rate is that of a gap smoothed with the time constant T, exact where the rate is constant:

    s = h (d - g) / dt          g+ = g + h (d - g)          h = 1 - exp(-dt / T)                       (g = d at the first reading)

They protect from false messages and wrong neighbours, not from false readings of the own sensors.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Finite, Model, NonNegative, Positive, Received, param
from tailgate.core.quantities import Headway
from tailgate.core.registry import register
from tailgate.estimators.compose import Gate, GateOut, M, ModeName, ReactionPlan, X, quiet
from tailgate.estimators.parts import Decision, Verdict

OWN = ("distance", "velocity", "acceleration")
STEPS = 100_000  # longest impulse response that is added up
DECAYED = 1e-15  # where it ends


def require_string(model: Model, name: str) -> None:
    """Raise NotApplicable unless the model is of cars that follow each other and send messages."""
    if not (model.followers.any() and model.agents > 1 and model.v2v):
        raise NotApplicable(f"mitigation {name}", f"{model.agents} agents", "a string of cars that follow each other and send messages")


@dataclass(frozen=True, kw_only=True)
class Choice(Gate[M, X]):
    """Base class: uses all readings, or with `gate` those that are not suspected."""

    gate: bool = param(False, "ignore the suspected sensors, as gate_out does")

    def gated(self, state: Array | None, verdict: Verdict, received: Received) -> tuple[Array | None, Decision]:
        return super().gated(state, verdict, received) if self.gate else (state, Decision(received.valid, quiet(verdict)))


@register("mitigation", "acc_fallback")
@dataclass(frozen=True, kw_only=True)
class AccFallback(Choice[Array], GateOut):
    """Uses no messages while alarmed and for some time after: the cars' controllers fall back to their own sensors and estimates."""

    mode: ModeName = param("acc", "what is asked of the controller while alarmed: normal, widen, brake, stop or acc")

    def prepare(self, model: Model) -> ReactionPlan:
        require_string(model, "acc_fallback")
        return super().prepare(model)


class LocalPlan(NamedTuple):
    """Constants of a car's own loop."""

    follows: Array  # (N,) bool
    place: tuple[int, ...]  # indices of distance, velocity and acceleration among the sensors
    smooth: float  # h
    dt: float
    bound: float = np.inf  # [m/s^2]


class LocalState(NamedTuple):
    shut: Array | None  # (B, N, q) steps that the gate stays shut
    y: Array  # (B, N, 3) the last readings of the own sensors
    known: Array  # (B, N, 3) bool: there is one
    g: Array  # (B, N) smoothed gap
    left: Array  # (B, N) int64: steps that the reaction to an alarm still lasts


@dataclass(frozen=True, kw_only=True)
class OwnSensors(Choice[LocalState, LocalPlan]):
    """Base of the control defences that compute a command from a car's own sensors: a subclass's `bounds` makes limits of it."""

    headway: Headway = param(3.0, "time headway tau_h of the own law, best the controller's [s]")
    standstill: NonNegative = param(5.0, "minimum stopping distance d_r of the own law, best the controller's [m]")
    lag: Positive = param(1.008, "actuator lag tau that is reckoned with [s]")
    smoothing: Positive = param(0.5, "time constant T of the gap's rate [s]")
    accel_min: Finite = param(-8.0, "least command of the own law [m/s^2]")
    accel_max: Finite = param(3.0, "largest command of the own law [m/s^2]")

    def bounds(self, plan: LocalPlan, y: Array, rate: Array, on: Array) -> tuple[Array, Array]:
        """Return the least and the largest command (B, N) for own readings y (B, N, 3) and the gap's rate; `on` (B, N): an alarm lasts."""
        raise TypeError(f"{type(self).__name__} must define bounds()")

    def constants(self, model: Model) -> LocalPlan:
        name = f"mitigation {type(self).__name__}"
        require_string(model, type(self).__name__)
        missing = [sensor for sensor in OWN if sensor not in model.sensors]
        if missing or model.actuators != ("command",):
            raise NotApplicable(name, list(model.sensors), f"cars that measure {', '.join(OWN)} and command an acceleration")
        if self.accel_min > self.accel_max:
            raise InputError(f"{name}.accel_min", self.accel_min, f"at most accel_max ({self.accel_max})")
        return LocalPlan(model.followers, tuple(model.sensors.index(sensor) for sensor in OWN), self.smooth(model.dt), model.dt)

    def smooth(self, dt: float) -> float:
        """Return the share h of a new reading in the smoothed gap."""
        return 1.0 - float(num.exp(-dt / self.smoothing))

    def begin(self, plan: ReactionPlan[LocalPlan], batch: int) -> LocalState:
        shape = (batch, plan.agents)
        own = num.zeros((*shape, len(OWN)))
        return LocalState(self.gates(plan, batch), own, own != 0.0, num.zeros(shape), num.zeros(shape, np.int64))

    def choose(
        self, plan: ReactionPlan[LocalPlan], state: LocalState | None, verdict: Verdict, received: Received
    ) -> tuple[LocalState, Decision]:
        loop = plan.own
        assert state is not None and loop is not None
        shut, decision = self.gated(state.shut, verdict, received)
        place = list(loop.place)
        heard = received.valid[..., place]
        y, known = np.where(heard, received.y[..., place], state.y), state.known | heard
        g = np.where(state.known[..., 0], state.g, y[..., 0])
        rate = (y[..., 0] - g) * (loop.smooth / loop.dt)
        left = np.where(verdict.alarm, plan.linger + 1, np.maximum(state.left - 1, 0))
        low, high = self.bounds(loop, y, rate, left > 0)
        sure = loop.follows & known.all(axis=-1)
        limits = num.zeros((*low.shape, 1, 2))
        limits[..., 0, 0], limits[..., 0, 1] = np.where(sure, low, -np.inf), np.where(sure, high, np.inf)
        g = g + loop.smooth * (y[..., 0] - g)
        return LocalState(shut, y, known, g, left), decision._replace(limits=limits)

    def within(self, u: Array) -> Array:
        """Return the command cut at the own law's limits."""
        return np.asarray(np.minimum(np.maximum(u, self.accel_min), self.accel_max))


class Reach(NamedTuple):
    """An ellipsoid z' Q^-1 z <= 1 that holds every state that z+ = A z + b w, |w| <= 1, reaches from within it, and its half-width."""

    Q: Array
    width: float  # along the first state


def reachable(A: Array, b: Array) -> Reach:
    """Return the ellipsoid of this kind that is narrowest along the first state, for a stable A (n, n) and b (n,).

    V = z' P z satisfies V+ <= a V + (1 - a) w^2 for all z, w where P^-1 = Q solves the linear matrix inequality

        [ a Q   0   Q A' ;  0   1 - a   b' ;  A Q   b   Q ] >= 0,     that is     Q >= A Q A' / a + b b' / (1 - a)

    Every solution is at least that of the equation, which is therefore the best whatever is minimised; no solver is needed. a is found by
    golden section.
    """
    radius = num.spectral_radius(A)
    if radius >= 1.0:
        raise InputError("mitigation input_clip", radius, "gains that make a car's own loop stable")

    def solved(a: float) -> Array:
        Q, F = b[:, None] * b / (1.0 - a), A / np.sqrt(a)
        for _ in range(64):  # Q + F Q F' + F^2 Q F'^2 + ..., doubled
            Q, F = Q + num.product(num.product(F, Q), F.T), num.product(F, F)
            if np.max(np.abs(F)) < DECAYED:
                break
        return Q

    ratio, low, high = (5.0**0.5 - 1.0) / 2.0, 1e-3, 1.0 - 1e-3  # shares of the way from radius^2 to 1
    for _ in range(60):
        left, right = high - ratio * (high - low), low + ratio * (high - low)
        if solved(_between(radius, left))[0, 0] < solved(_between(radius, right))[0, 0]:
            high = right
        else:
            low = left
    Q = solved(_between(radius, 0.5 * (low + high)))
    return Reach(Q, float(np.sqrt(Q[0, 0])))


def _between(radius: float, share: float) -> float:
    return radius * radius + share * (1.0 - radius * radius)


def response(A: Array, b: Array) -> Array:
    """Return the first state after an impulse: (K,) of A^k b, until it has died out."""
    x, out = np.array(b), []
    size = float(np.max(np.abs(b)))
    for _ in range(STEPS):
        out.append(float(x[0]))
        x = num.matvec(A, x)
        if np.max(np.abs(x)) <= DECAYED * size:
            break
    return np.array(out)


def peak(A: Array, b: Array) -> float:
    """Return the largest first state that an input of at most 1 can reach."""
    return float(sum(abs(value) for value in response(A, b).tolist()))


class OwnLoop(NamedTuple):
    """A car under the own law, sampled: z = [gap, speed, acceleration, smoothed gap], z+ = A z + forced delta + ahead p + noisy n + const.

    delta is what is added to the command, p the way [m] of the car ahead in the step, n the sensors' noise.
    """

    A: Array  # (4, 4)
    forced: Array  # (4,)
    ahead: Array  # (4,)
    noisy: Array  # (4, 3)


@register(
    "mitigation", "input_clip",
    reference="S. H. Kafash, J. Giraldo, C. Murguia, A. A. Cardenas, J. Ruths, Constraining Attacker Capabilities Through Actuator "
    "Saturation, 2018",
)  # fmt: skip
@dataclass(frozen=True, kw_only=True)
class InputClip(OwnSensors):
    """Lets the command deviate from that of an own cruise control by so little that the gap stays out of collision.

    The own law is u = kp (d - d_r - tau_h v) + kd (s - tau_h a). The bound is the largest for which the gap keeps `clearance`:

        bound = (d_r - clearance - noise - slack) / width

    `width`: half-width along the gap of the ellipsoid that holds every state reached by a deviation of at most 1 m/s^2.
    `noise`: the most that noise within `sigmas` standard deviations does.
    `slack`: the most that a car ahead with any speed in [0, speed_max] can take of d_r. It is 0 where the gap's response to that speed is
    nowhere negative.

    The bound holds always, alarmed or not. A command below the own law's only widens the gap, so that no bound is needed there. A bound
    on both sides, as in the paper, also follows false readings of the own sensors upwards. Assumptions: docs/platoon.md.
    """

    kp: Positive = param(0.5, "gain of the spacing error of the own law [1/s^2]")
    kd: NonNegative = param(1.0, "gain of its rate [1/s]")
    clearance: NonNegative = param(0.5, "gap that is always kept [m]")
    sigmas: NonNegative = param(3.0, "bound of the own sensors' noise, in standard deviations [-]")
    speed_max: Positive = param(40.0, "highest speed of the car ahead [m/s]")
    sides: Literal["above", "both"] = param("above", "above: the command is bounded from above only; both: on both sides of the own law's")

    def loop(self, dt: float) -> OwnLoop:
        """Return the car's own loop for a step dt [s]."""
        E, smooth = float(num.exp(-dt / self.lag)), self.smooth(dt)
        s1 = self.lag * (1.0 - E)
        A, u = np.eye(4), np.array([-(dt * dt / 2.0 - self.lag * (dt - s1)), dt - s1, 1.0 - E, 0.0])
        A[0, 1], A[0, 2], A[1, 2], A[2, 2] = -dt, -self.lag * (dt - s1), s1, E
        A[3, 0], A[3, 3] = smooth, 1.0 - smooth
        rate = self.kd * smooth / dt
        read = np.array([self.kp + rate, -self.kp * self.headway, -self.kd * self.headway])
        feedback = np.array([*read, -rate])
        noisy = u[:, None] * read
        noisy[3, 0] += smooth
        return OwnLoop(A + u[:, None] * feedback, u, np.array([1.0, 0.0, 0.0, 0.0]), noisy)

    def slack(self, own: OwnLoop, dt: float) -> float:
        """Return how far [m] the gap can fall below d_r behind a car with any speed in [0, speed_max], without noise and deviation."""
        kernel = (dt * response(own.A, own.ahead)).tolist()  # response to the speed ahead; its sum is tau_h
        return self.speed_max * -float(sum(value for value in kernel if value < 0.0))

    def bound(self, model: Model) -> float:
        """Return the largest deviation [m/s^2] from the own law."""
        own = self.loop(model.dt)
        width = reachable(own.A, own.forced).width  # refuses a loop that is not stable
        if self.sides == "above" and (response(own.A, own.forced) > DECAYED).any():
            raise InputError("mitigation input_clip.sides", self.sides, "both: with these gains a command below the own law's overshoots")
        place = [model.sensors.index(sensor) for sensor in OWN]
        sd = np.sqrt(np.max(np.stack([R.diagonal()[place] for R in model.R[model.followers]]), axis=0))
        noise = self.sigmas * sum(peak(own.A, own.noisy[:, s]) * float(sd[s]) for s in range(len(OWN)))
        left = self.standstill - self.clearance - noise - self.slack(own, model.dt)
        if left <= 0.0:
            raise InputError("mitigation input_clip.clearance", self.clearance, f"less: it leaves {left:.2f} m for a deviation")
        return left / width

    def constants(self, model: Model) -> LocalPlan:
        return super().constants(model)._replace(bound=self.bound(model))

    def bounds(self, plan: LocalPlan, y: Array, rate: Array, on: Array) -> tuple[Array, Array]:
        d, v, a = (y[..., s] for s in range(len(OWN)))
        u = self.kp * (d - self.standstill - self.headway * v) + self.kd * (rate - self.headway * a)
        high = self.within(u + plan.bound)
        return self.within(u - plan.bound) if self.sides == "both" else np.full_like(high, -np.inf), high


@register(
    "mitigation", "sliding_mode",
    reference="I. Sajjad, D. D. Dunn, R. Sharma, R. Gerdes, Attack Mitigation in Adversarial Platooning Using Detection-Based Sliding Mode "
    "Control, 2015",
)  # fmt: skip
@dataclass(frozen=True, kw_only=True)
class SlidingMode(OwnSensors):
    """While alarmed, the command is that of a sliding mode on the own sensors, whatever the controller wants.

        e = d - d_r - tau_h v          sigma = e' + lam e,   e' = s - tau_h a
        u = a + (tau / tau_h) (-a + lam e' + eta sat(sigma / phi))      so that      sigma' = a_{i-1} - eta sat(sigma / phi)

    Behind any car whose |acceleration| stays below eta, |sigma| <= phi holds once reached, but for the lag of s (at most T eta). Then e
    follows with the time constant 1 / lam.
    """

    lam: Positive = param(0.5, "rate at which the spacing error dies out on the surface [1/s]")
    eta: Positive = param(8.0, "switching gain: more than the hardest braking of the car ahead [m/s^2]")
    phi: Positive = param(4.0, "half-width of the boundary layer in which the gain is linear [m/s]")
    when: Literal["alarmed", "always"] = param("alarmed", "alarmed: while alarmed and for `linger` after; always: from the start")

    def bounds(self, plan: LocalPlan, y: Array, rate: Array, on: Array) -> tuple[Array, Array]:
        d, v, a = (y[..., s] for s in range(len(OWN)))
        error, slope = d - self.standstill - self.headway * v, rate - self.headway * a
        sigma = slope + self.lam * error
        reach = self.eta * np.minimum(np.maximum(sigma / self.phi, -1.0), 1.0)
        u = self.within(a + self.lag / self.headway * (self.lam * slope - a + reach))
        if self.when == "always":
            return u, u
        return np.where(on, u, -np.inf), np.where(on, u, np.inf)
