"""Cooperative adaptive cruise control: the laws, as matrices, and the controller that runs them on the estimates (thesis 6.2).

A string has a leader 0 and followers 1 .. F. Its state, shared by every plant, filter and law of a platoon, is

    X = [c_0 v_0 a_0 | d_1 v_1 a_1 f_1 | ... | d_F v_F a_F f_F]                                         (6.8)-(6.11)

with the leader's position c_0, each follower's gap d_i to the car ahead, speeds, accelerations, and one state f_i of each controller. Every
law is linear in X and in the V2V fields. So the same matrices drive the cars and make the model of the closed loop:

    u = K X + k0          tau_f f' = -f + G X + g0 + V v2v,      v2v_i = [a_{i-1}, a_0, u_{i-1}]
"""

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Estimate, Mode, Model, Probability, param
from tailgate.core.quantities import Accel, Gain, Headway, Length, check_order
from tailgate.core.registry import register
from tailgate.envs.controllers.adaptive_cruise import WIDEN_FACTOR, limited, obeyed

V2V = ("predecessor_acceleration", "leader_acceleration", "predecessor_command")
PER_CAR = 4  # states of a follower


class Column:
    """Indices of a string's states in X: `gap(i)`, `controller(i)` of followers i >= 1, `speed(i)`, `accel(i)` of every car."""

    @staticmethod
    def gap(i: int) -> int:
        return 3 + PER_CAR * (i - 1)

    @staticmethod
    def speed(i: int) -> int:
        return 1 if i == 0 else 4 + PER_CAR * (i - 1)

    @staticmethod
    def accel(i: int) -> int:
        return 2 if i == 0 else 5 + PER_CAR * (i - 1)

    @staticmethod
    def controller(i: int) -> int:
        return 6 + PER_CAR * (i - 1)


class Gains(NamedTuple):
    """A law for N = F + 1 cars; row i is car i's, the leader's rows are zero."""

    K: Array  # (N, n)
    k0: Array  # (N,)
    G: Array  # (N, n)
    g0: Array  # (N,)
    V: Array  # (N, 3)
    tau_f: float  # [s]


def no_gains(cars: int, tau_f: float) -> Gains:
    """Return gains of zero for `cars` cars, to be filled in."""
    n = 3 + PER_CAR * (cars - 1)
    return Gains(np.zeros((cars, n)), np.zeros(cars), np.zeros((cars, n)), np.zeros(cars), np.zeros((cars, 3)), tau_f)


class Tuned(NamedTuple):
    """Gains, and the share of itself that f keeps in a step, exp(-dt / tau_f)."""

    gains: Gains
    keep: float


class LawPlan(NamedTuple):
    normal: Tuned
    wide: Tuned  # Mode.WIDEN
    local: Tuned  # Mode.ACC
    parts: tuple[Gains, Gains]  # what the error's gain adds to `normal`, and what that of its rate does


class LawState(NamedTuple):
    f: Array  # (B, N) the controllers' state; 0 at the leader


@dataclass(frozen=True)
class Law:
    """Base of the CACC laws: a subclass gives its `gains`; running them is the same for all.

    `error_gains` and `rate_gains` name the fields that weigh the spacing error and its rate, in which the law has to be linear. A law that
    names none has no gains that an insider could scale.
    """

    error_gains: ClassVar[tuple[str, ...]] = ()
    rate_gains: ClassVar[tuple[str, ...]] = ()

    headway: Headway = param(3.0, "time headway tau_h [s]")
    standstill: Length = param(5.0, "minimum stopping distance d_r [m]")
    accel_min: Accel | None = param(-8.0, "lower limit of the command [m/s^2]; none: unlimited")
    accel_max: Accel | None = param(3.0, "upper limit of the command [m/s^2]; none: unlimited")

    def __post_init__(self) -> None:
        check_order("controller: accel_min, accel_max", (self.accel_min, self.accel_max))

    def gains(self, graph: Array, headway: float, local: bool = False) -> Gains:
        """Return the law's matrices for a graph (N, N), a time headway [s], and without V2V messages where `local`."""
        raise TypeError(f"{type(self).__name__} must define gains()")

    def prepare(self, model: Model) -> LawPlan:
        if model.v2v != V2V:
            raise InputError(f"controller {type(self).__name__}", list(model.v2v), f"a platoon, whose cars send {', '.join(V2V)}")
        each = (
            self.gains(model.graph, self.headway), self.gains(model.graph, WIDEN_FACTOR * self.headway),
            self.gains(model.graph, self.headway, local=True),
        )  # fmt: skip
        normal, wide, local = (Tuned(gains, float(num.exp(-model.dt / gains.tau_f))) for gains in each)
        return LawPlan(normal, wide, local, (self._part(model.graph, self.error_gains), self._part(model.graph, self.rate_gains)))

    def _part(self, graph: Array, names: tuple[str, ...]) -> Gains:
        """Return what the gains `names` add to the law's matrices."""
        none = dict.fromkeys(self.error_gains + self.rate_gains, 0.0)
        one, rest = (replace(self, **fields).gains(graph, self.headway) for fields in (none | {n: getattr(self, n) for n in names}, none))
        return Gains(one.K - rest.K, one.k0 - rest.k0, one.G - rest.G, one.g0 - rest.g0, one.V - rest.V, one.tau_f)

    def start(self, plan: LawPlan, batch: int) -> LawState:
        return LawState(num.zeros((batch, len(plan.normal.gains.k0))))

    def held(self, plan: LawPlan, state: LawState, batch: int) -> Array:
        """Return f of each car, (B, N, 1)."""
        return state.f[..., None]

    def step(self, plan: LawPlan, state: LawState, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[LawState, Array]:
        """Return the commands u (B, N, 1) [m/s^2] for estimate.x (B, N, n), whose row i is car i's estimate, and v2v (B, N, 3)."""
        mode = estimate.mode
        u, f = self._act(plan.normal, estimate.x, state.f, v2v)
        for other, tuned in ((Mode.WIDEN, plan.wide), (Mode.ACC, plan.local)):
            if num.some(mode == other):
                v, g = self._act(tuned, estimate.x, state.f, v2v)
                u, f = np.where(mode == other, v, u), np.where(mode == other, g, f)
        return LawState(f), self._within(obeyed(u, mode))

    def scaled(
        self, plan: LawPlan, state: LawState, estimate: Estimate, v2v: Array, odometry: Array, factors: Array
    ) -> tuple[LawState, Array]:
        """Return what `step` returns in Mode.NORMAL with the gains of error and rate times factors (B, N, 2) [-]."""
        u, f = self._act(plan.normal, estimate.x, state.f, v2v)
        nothing = num.zeros(f.shape)
        for i, part in enumerate(plan.parts):
            v, g = self._act(Tuned(part, plan.normal.keep), estimate.x, nothing, v2v)
            more = factors[..., i] - 1.0
            u, f = u + more * v, f + more * g
        return LawState(f), self._within(u)

    def _within(self, u: Array) -> Array:
        """Return the commands (B, N, 1) within the car's limits."""
        u = limited(u, self.accel_min, self.accel_max)
        u[:, 0] = 0.0  # the manoeuvre drives the leader
        return u[..., None]

    def _act(self, tuned: Tuned, x: Array, f: Array, v2v: Array) -> tuple[Array, Array]:
        """Return u and the next f, each (B, N). A car knows its own f."""
        gains, keep = tuned
        u, g = num.full(f.shape, gains.k0), num.full(f.shape, gains.g0)
        for out, rows in ((u, gains.K), (g, gains.G)):
            for i, j in zip(*np.nonzero(rows), strict=True):
                out[:, i] += rows[i, j] * (f[:, i] if i and j == Column.controller(i) else x[:, i, j])
        for i, j in zip(*np.nonzero(gains.V), strict=True):
            g[:, i] += gains.V[i, j] * v2v[:, i, j]
        return u, keep * f + (1.0 - keep) * g

    def desired_gap(self, speed: Array) -> Array:
        """Return d_r + tau_h v [m] (6.1)."""
        return np.asarray(self.standstill + self.headway * speed)


def spacing(K: Array, i: int, kp: float, kd: float, headway: float) -> None:
    """Add kp (d_i - tau_h v_i) + kd (v_{i-1} - v_i - tau_h a_i) to row i (6.2), (6.3); -kp d_r belongs to the constants."""
    K[i, Column.gap(i)] += kp
    K[i, Column.speed(i)] += -kp * headway - kd
    K[i, Column.speed(i - 1)] += kd
    K[i, Column.accel(i)] += -kd * headway


@register("controller", "cacc", reference="Dutta 2018, (6.5)-(6.7), corrected")
@dataclass(frozen=True)
class FeedForward(Law):
    """The thesis's law: a spacing error's feedback, and the accelerations of predecessor and leader fed forward.

        u_i = kp (d_i - d_r - tau_h v_i) + kd (v_{i-1} - v_i - tau_h a_i) + f_i                           (6.5), (6.6)
        tau_h f_i' = -f_i + w1 a_{i-1} + w0 a_0                                                            (6.7)

    Erratum: (6.7) is printed with w1 = w0 = 1, which feeds a steady acceleration forward twice.
    """

    error_gains: ClassVar[tuple[str, ...]] = ("kp",)
    rate_gains: ClassVar[tuple[str, ...]] = ("kd",)

    kp: Gain = param(0.5, "gain of the spacing error [1/s^2]")
    kd: Gain = param(1.0, "gain of its rate [1/s]")
    weights: tuple[Probability, Probability] | None = param(
        None, "w1, w0: weights of the predecessor's and the leader's acceleration; none: (0.5, 0.5), or (1, 0) without the leader's message"
    )

    def gains(self, graph: Array, headway: float, local: bool = False) -> Gains:
        cars = len(graph)
        out = no_gains(cars, self.headway)
        for i in range(1, cars):
            spacing(out.K, i, self.kp, self.kd, headway)
            out.k0[i] = -self.kp * self.standstill
            if not local:
                out.K[i, Column.controller(i)] = 1.0
                out.V[i, :2] = self._weights(bool(graph[i, 0]))
        return out

    def _weights(self, hears_leader: bool) -> tuple[float, float]:
        if self.weights is None:
            return (0.5, 0.5) if hears_leader else (1.0, 0.0)
        if self.weights[1] and not hears_leader:
            raise InputError("controller cacc.weights", self.weights, "w0 = 0 in a topology in which not everybody hears the leader")
        return self.weights
