"""Safe states as a defence: a filter that gets only readings in the safe set, and a brake that acts on the set (docs/safe-state.md).

The brake assumes the worst of the set: the smallest gap d, the slowest car ahead w, the fastest own speed v and acceleration a. It
overrides the command when the gap is too short to stop behind a car that brakes at `lead_brake`. For a time rho the own car still speeds
up. This is the distance of responsibility-sensitive safety (RSS), with the actuator's lag:

    d < clearance + v rho + a' rho^2 / 2 + stop(v + a' rho, a') - w^2 / (2 b_lead)

It does so while a reading is distrusted or missing, and for `watch` seconds after. A car that was slowed down has a large gap. Its
controller, which may be unsafe by itself, accelerates to close it while the car ahead may stop.

stop(v, a) is the way to a standstill through a first-order lag tau under the constant command -b, with c = a + b:

    v(t) = v - b t + c tau (1 - e),        way(t) = v t - b t^2 / 2 + c tau t - c tau^2 (1 - e),        e = exp(-t / tau)
"""

from dataclasses import dataclass
from typing import Any, Generic, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import NotApplicable
from tailgate.core import Array, Estimate, Mode, Model, NonNegative, Positive, Prior, Received, param
from tailgate.core.draws import Draws
from tailgate.core.nouns import P, S
from tailgate.core.registry import make_from, register
from tailgate.estimators.parts import Filter
from tailgate.estimators.safe_set.safe_state import ACCEL, GAP, LEAD, SPEED, Finding, OwnCommand, SafeSet, SetPlan, SetState

RSS = "S. Shalev-Shwartz, S. Shammah, A. Shashua, On a Formal Model of Safe and Scalable Self-driving Cars, 2017"
LAG = 1.008  # lag of the thesis's vehicles [s]
ROUNDS = 6  # rounds of Newton's method for the time of the stop


def stopping_distance(v: Array, a: Array, brake: float, tau: float) -> Array:
    """Return the way [m] to a standstill from v [m/s] and a [m/s^2] under the command -brake through a lag tau [s], elementwise.

    v(t) is concave and falls from right of its root on, so that Newton's method from there stays right of it.
    """
    c = np.maximum(a + brake, 0.0)
    t = (v + c * tau) / brake
    for _ in range(ROUNDS):
        t = sooner(t, num.exp(-t / tau), v, c, brake, tau)
    return way_until(t, num.exp(-t / tau), v, c, brake, tau)


def sooner(t: Array, e: Array, v: Array, c: Array, brake: float, tau: float) -> Array:
    """Return a step of Newton's method for the time of the stop, elementwise."""
    out: Array = t - (v - brake * t + c * tau * (1.0 - e)) / (c * e - brake)
    return out


def way_until(t: Array, e: Array, v: Array, c: Array, brake: float, tau: float) -> Array:
    """Return way(t), elementwise."""
    out: Array = v * t - 0.5 * brake * t * t + c * tau * t - c * tau * tau * (1.0 - e)
    return out


class SafePlan(NamedTuple, Generic[P, S]):
    filter: Filter[P, S]
    filter_plan: P
    set_plan: SetPlan
    actuators: int
    follows: Array  # (N,) bool
    speeds: tuple[tuple[int, int], ...]  # agents, and the state that is their own speed
    off: float  # by how much the own acceleration may be above the box's [m/s^2]
    lag: float  # tau [s]
    reaction: float  # rho, not shorter than a step [s]
    watch: int  # steps for which the brake stays armed


class SafeMemory(NamedTuple, Generic[S]):
    """Every leaf has B first."""

    filter: S
    set: SetState
    armed: Array  # (B, N) int64: steps for which the brake still acts though nothing is distrusted


@register("defence", "safe_state", reference="Dutta 2018, section 7.3.2: set-membership safe states", uses=("measurements", "v2v"))
@dataclass(frozen=True)
class SafeState(SafeSet):
    """Filter that uses only readings in the safe set: intervals of what the sensors' accuracy and the dynamics allow; never brakes."""

    filter: object = param("kf", "filter: a name, or a mapping with name and parameters")

    def __post_init__(self) -> None:
        super().__post_init__()
        self._filter()  # a wrong name shall fail here

    def _filter(self) -> Filter:
        data = {"name": "kf", **self.filter} if isinstance(self.filter, dict) else self.filter
        made: Filter = make_from("filter", data, "defence safe_state.filter")
        return made

    def prepare(self, model: Model) -> SafePlan:
        f, limits = self._filter(), self.limits_of(model)
        off, tau = (limits.road.off, limits.road.lag) if isinstance(limits.road, OwnCommand) else (0.0, LAG)
        assert model.speed is not None
        speeds = tuple((i, j) for i, j in zip(*np.nonzero(model.speed), strict=True))
        return SafePlan(f, f.prepare(model), limits, len(model.actuators), model.followers, speeds, off, tau, 0.0, 0)

    def start(self, plan: SafePlan, prior: Prior) -> SafeMemory:
        held = self.widest(plan.set_plan, len(prior.mean))
        return SafeMemory(plan.filter.start(plan.filter_plan, prior), held, num.zeros(held.lo.shape[:2], np.int64))

    def step(self, plan: SafePlan, state: SafeMemory, received: Received, known_u: Array, draws: Draws) -> tuple[SafeMemory, Estimate]:
        held, found = self.enclose(plan.set_plan, state.set, received, known_u)
        belief = plan.filter.predict(plan.filter_plan, state.filter, known_u)
        innovation = plan.filter.innovation(plan.filter_plan, belief, received)
        belief = plan.filter.update(plan.filter_plan, belief, innovation, received.valid & found.trusted[..., plan.set_plan.columns])
        belief = self._inside(plan, belief, found)
        mode = num.full(found.alarm.shape, Mode.NORMAL, np.int8)
        estimate = Estimate(plan.filter.estimate(belief), found.score, found.alarm, mode, np.ones_like(found.alarm))
        armed, limits = self.limits(plan, found, state.armed)
        return SafeMemory(belief, held, armed), estimate._replace(limits=limits)

    def _inside(self, plan: SafePlan, belief: Any, found: Finding) -> Any:
        """Return a filter's state with the own speeds in the set: a linear filter would let a hard brake reverse a stopped car."""
        x = getattr(belief, "x", None)
        if x is None:
            return belief
        x = x.copy(order="K")
        for i, j in plan.speeds:
            x[:, i, j] = np.minimum(np.maximum(x[:, i, j], found.box.lo[:, i, SPEED]), found.box.hi[:, i, SPEED])
        return belief._replace(x=x)

    def limits(self, plan: SafePlan, found: Finding, armed: Array) -> tuple[Array, Array | None]:
        """Return `armed` for the next step, and the least and largest command (B, N, m, 2); None where the controller is not limited."""
        return armed, None


@register(
    "defence", "safe_state_brake", reference=f"Dutta 2018, section 7.3: safe states and a reactive controller; {RSS}",
    uses=("measurements", "v2v"),
)  # fmt: skip
@dataclass(frozen=True)
class SafeStateBrake(SafeState):
    """Readings outside the safe set are ignored, and the car brakes while the worst case of the set is unsafe."""

    brake: Positive = param(5.0, "own deceleration when it brakes [m/s^2]")
    lead_brake: Positive = param(8.0, "hardest deceleration of the car ahead that is reckoned with [m/s^2]")
    lag: Positive | None = param(None, "actuator lag tau that is reckoned with; none: the model's where it shows one, else 1.008 [s]")
    response: NonNegative = param(3.0, "largest acceleration that is commanded before the brake acts [m/s^2]")
    reaction: NonNegative = param(0.1, "time before the brake acts; at least a step [s]")
    clearance: NonNegative = param(0.5, "gap that is left when both stand [m]")
    distance: NonNegative = param(0.0, "also brake below this gap while a reading is distrusted or missing; the thesis's is 20 [m]")
    watch: NonNegative = param(30.0, "time after an alarm, or a brake while a reading was missing, in which it acts without one [s]")
    when: Literal["alarmed", "always"] = param(
        "alarmed", "alarmed: only while a reading is distrusted or missing, and for `watch`; always: whenever the worst case is unsafe"
    )

    def prepare(self, model: Model) -> SafePlan:
        if len(model.actuators) != 1:
            raise NotApplicable("defence safe_state_brake: actuators", list(model.actuators), "cars that command an acceleration")
        plan = super().prepare(model)
        return plan._replace(reaction=max(self.reaction, model.dt), lag=self.lag or plan.lag, watch=round(self.watch / model.dt))

    def needed(self, plan: SafePlan, found: Finding) -> Array:
        """Return the smallest safe gap (B, N) [m] for the worst of the box."""
        worst, rho = found.worst, plan.reaction
        v, a, w = worst.hi[..., SPEED], worst.hi[..., ACCEL] + plan.off, np.maximum(worst.lo[..., LEAD], 0.0)
        a = a + (1.0 - float(num.exp(-rho / plan.lag))) * np.maximum(self.response - a, 0.0)  # while it does not brake yet
        fast = np.maximum(v + np.maximum(a, 0.0) * rho, 0.0)
        ahead = w * w / (2.0 * max(self.lead_brake, self.brake))  # the formula takes the end of the braking for the closest
        return np.asarray(self.clearance + 0.5 * rho * (v + fast) + stopping_distance(fast, a, self.brake, plan.lag) - ahead)

    def limits(self, plan: SafePlan, found: Finding, armed: Array) -> tuple[Array, Array]:
        gap = found.worst.lo[..., GAP]
        short, near = gap < self.needed(plan, found), found.missing & (gap < self.distance)
        some = found.missing | (armed > 0) if self.when == "alarmed" else np.ones_like(found.missing)
        unsafe = plan.follows & ((some & short) | near)
        out = num.full((*unsafe.shape, plan.actuators, 2), np.array([-np.inf, np.inf]))
        out[..., 1] = np.where(unsafe, -self.brake, np.inf)[..., None]
        caused = found.alarm | (unsafe & found.missing)  # a brake that nothing asked for ends far from where the controller drives
        return np.where(caused, plan.watch, np.maximum(armed - 1, 0)), out
