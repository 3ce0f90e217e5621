"""Car following behind an FMCW radar: the case study of thesis chapter 3, in steps of T = 1 s.

    alpha = exp(-T/TL)
    a_F+ = alpha a_F + (1 - alpha) KL a_des        v_F+ = max(0, v_F + a_F+ T)        x+ = x + (v + v+) T/2        (3.14)
    v_L+ = max(0, v_L + a_L T)                                                                                    (3.15)-(3.17)

A defence estimates x = [d, dv, a_L, v_F]: gap [m], dv = v_L - v_F (positive: opening) [m/s], the leader's acceleration [m/s^2] and the
own speed [m/s]. Trusted odometry gives the own speed as the model's known input:

    d+ = d + T (dv + dv+)/2        dv+ = dv + T a_L - (v_F+ - v_F)        a_L+ = a_L + w        v_F+ = input
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.core import Array, Controller, Model, Prior, Scene, Sensor, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Gap, Lag, PositiveGain, Speed, Step, Time, Variance
from tailgate.core.registry import register
from tailgate.envs.controllers.idm import Behind, BehindState
from tailgate.envs.controllers.radar_car import STATES, radar_model
from tailgate.envs.vehicle import check_reaction, roll

Quadruple = Annotated[tuple[Variance, Variance, Variance, Variance], Field(min_length=4, max_length=4)]


class RadarPlan(NamedTuple):
    alpha: float
    behind: Behind | None


class RadarState(NamedTuple):
    """Every leaf has B first, (B,); `own` (B, 1, 3) = [x, v, a] of the follower."""

    lead_x: Array
    lead_v: Array
    lead_a: Array  # over the last step
    own: Array
    behind: BehindState | None


def lagged(a: Array, u: Array, keep: float, gain: float) -> Array:
    """Return the acceleration [m/s^2] one step later, under the command u, elementwise."""
    out: Array = keep * a + gain * u
    return out


@register("plant", "radar_following", reference="Dutta 2018, section 3.5.1; (3.12)-(3.17)")
@dataclass(frozen=True)
class RadarFollowing:
    """A leader, and an ACC follower that sees it by radar and knows its own motion."""

    dt: Step = param(1.0, "step T [s]")
    tau: Lag = param(1.008, "time constant TL of the lower-level controller [s]")
    gain: PositiveGain = param(1.0, "gain KL of the lower-level controller [-]")
    gap: Gap = param(100.0, "initial gap [m]")
    lead_speed: Speed = param(29.0576, "leader's initial speed [m/s]; 65 mph")
    speed: Speed = param(29.95168, "follower's initial speed [m/s]; 67 mph")
    process_var: Quadruple = param(
        (1e-3, 1e-3, 1e-5, 1e-6), "process noise variance a step that the defence assumes, of d, dv, a_L and v_F; the plant has none"
    )
    prior_var: Quadruple = param((1.0, 1.0, 0.25, 1e-6), "variance of the prior that the defence assumes")
    rear: bool = param(False, "a human-like driver follows behind")
    rear_reaction: Time = param(1.0, "reaction time of the driver behind [s]")

    def __post_init__(self) -> None:
        check_reaction("plant radar_following.rear_reaction", self.rear_reaction, self.dt)

    @property
    def size(self) -> tuple[int, int]:
        return 1, STATES

    def prepare(self, model: Model) -> RadarPlan:
        behind = Behind(self.dt, round(self.rear_reaction / self.dt)) if self.rear else None
        return RadarPlan(float(num.exp(-self.dt / self.tau)), behind)

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        return radar_model(self, sensor, self.dt, self.process_var)

    def start(self, plan: RadarPlan, draws: Draws) -> RadarState:
        batch = len(draws.key)
        own = num.full((batch, 1, 3), np.array([0.0, self.speed, 0.0]))
        behind = plan.behind.start(own[:, 0, 0], self.speed) if plan.behind else None
        return RadarState(np.full(batch, self.gap), np.full(batch, self.lead_speed), np.zeros(batch), own, behind)

    def prior(self, plan: RadarPlan, state: RadarState, held: Array, draws: Draws) -> Prior:
        return Prior(self.truth(plan, state, held), num.full((len(state.lead_x), 1, STATES, STATES), np.diag(self.prior_var)))

    def step(self, plan: RadarPlan, state: RadarState, u: Array, exo: Array, draws: Draws) -> RadarState:
        x, v, a = (state.own[:, 0, i] for i in range(3))
        a = lagged(a, u[:, 0, 0], plan.alpha, (1.0 - plan.alpha) * self.gain)
        own = num.stack([part[:, None] for part in (*roll(x, v, a, self.dt), a)])
        lead_x, lead_v = roll(state.lead_x, state.lead_v, exo, self.dt)
        behind = plan.behind.step(state.behind, x, v) if plan.behind and state.behind else None
        return RadarState(lead_x, lead_v, (lead_v - state.lead_v) / self.dt, own, behind)

    def known(self, plan: RadarPlan, u: Array, exo: Array, state: RadarState) -> Array:
        """Return the own speed, by odometry."""
        return state.own[..., 1:2]

    def truth(self, plan: RadarPlan, state: RadarState, held: Array) -> Array:
        x, v = state.own[:, 0, 0], state.own[:, 0, 1]
        return num.stack([(state.lead_x - x)[:, None], (state.lead_v - v)[:, None], state.lead_a[:, None], v[:, None]])

    def lead_speed_of(self, state: RadarState) -> Array:
        return state.lead_v

    def scene(self, plan: RadarPlan, state: RadarState) -> Scene:
        x, v, a = (state.own[..., i] for i in range(3))
        rear = state.behind
        rear_gap, rear_v = (np.full_like(x, np.inf), v) if rear is None else (x - rear.x[:, None], rear.v[:, None])
        return Scene(state.lead_x[:, None] - x, v, a, state.lead_v[:, None], rear_gap, rear_v, x)

    def v2v(self, plan: RadarPlan, state: RadarState) -> Array:
        return np.zeros((len(state.lead_x), 1, 0))

    def odometry(self, plan: RadarPlan, state: RadarState) -> Array:
        return state.own[..., :2]
