"""The hybrid Bernoulli filter (Forti, Battistelli, Chisci and Sinopoli 2016; thesis, [28]).

It asks: is there an attack, and how large is it?

r is the probability that an attack exists; p0(x) the density without it, p1(x, a) the joint one with it. Each is a single Gaussian: where
two meet, they are merged to one of the same mean and covariance. With birth p_b and survival p_s:

    predict    r- = (1-r) p_b + r p_s
               p0- ~ (1-r)(1-p_b) p0 + r (1-p_s) p1(x)            through (A, Q)
               p1- ~ (1-r) p_b p0 N(a; 0, Sa) + r p_s p1          through (A, Q) and a+ = a + wa
    update     y = C x + v without, y = C x + G a + v with an attack: a Kalman step each, with likelihoods L0 and L1
               r = r- L1 / ((1-r-) L0 + r- L1)
"""

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import unknown
from tailgate.core import Array, Estimate, Finite, Mode, Model, NonNegative, Positive, Prior, Probability, Received, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.estimators.filters.imm import LEAST, log_likelihood, merged
from tailgate.estimators.filters.kalman import KalmanFilter, KalmanPlan, KalmanState

NEVER = -1e3  # log odds where no attack can exist


class BernoulliPlan(NamedTuple):
    without: KalmanPlan
    under: KalmanPlan  # of (x, a)
    fresh: Array  # (g, g) Sa
    states: int


class BernoulliState(NamedTuple):
    r: Array  # (B, N)
    without: KalmanState
    under: KalmanState


@register(
    "defence", "bernoulli",
    reference="N. Forti, G. Battistelli, L. Chisci, B. Sinopoli, A Bayesian Approach to Joint Attack Detection and Resilient State "
    "Estimation, 2016",
)  # fmt: skip
@dataclass(frozen=True)
class Bernoulli:
    """Kalman filters with and without a signal on the sensors, and the probability that there is one; it believes the likelier."""

    threshold_field: ClassVar[str] = "threshold"
    birth: Probability = param(0.01, "p_b, probability a step that an attack begins [-]")
    survival: Probability = param(0.9, "p_s, probability a step that an attack goes on [-]")
    spread: Positive = param(62.0, "standard deviation of what a new attack adds; that of a uniform value in +-108 [unit of the sensor]")
    drift: NonNegative = param(1.0, "standard deviation of its change in a step [unit of the sensor]")
    attacked: tuple[str, ...] = param((), "sensors that an attack may add to; empty: all")
    estimate: Literal["likelier", "mean"] = param(
        "likelier", "likelier: the mean with an attack where r > 1/2, else without; mean: both, weighed by r"
    )
    threshold: Finite = param(0.0, "alarm above these log odds of an attack; 0: probability 1/2 [-]")

    def prepare(self, model: Model) -> BernoulliPlan:
        for name in self.attacked:
            if name not in model.sensors:
                raise unknown("defence bernoulli.attacked", name, model.sensors)
        kalman, n, q = KalmanFilter().prepare(model), model.states, len(model.sensors)
        G = np.eye(q)[:, [i for i, name in enumerate(model.sensors) if name in (self.attacked or model.sensors)]]
        g = G.shape[1]
        A, Q = np.eye(n + g), self.drift * self.drift * np.eye(n + g)
        A[:n, :n], Q[:n] = model.A, 0.0
        Q[:n, :n] = model.Q
        B, c = np.concatenate([model.B, np.zeros((g, model.inputs))]), np.concatenate([model.c, np.zeros(g)])
        C = np.concatenate([model.C, np.repeat(G[None], model.agents, axis=0)], axis=2)
        under = KalmanPlan(A, B, c, C, Q, model.R, np.ones(n + g))
        return BernoulliPlan(kalman, under, self.spread * self.spread * np.eye(g), n)

    def start(self, plan: BernoulliPlan, prior: Prior) -> BernoulliState:
        without = KalmanState(prior.mean, prior.cov)
        return BernoulliState(num.full(prior.mean.shape[:2], self.birth), without, self._born(plan, without))

    def _born(self, plan: BernoulliPlan, held: KalmanState) -> KalmanState:
        """Return p0 N(a; 0, Sa)."""
        n, g = plan.states, len(plan.fresh)
        assert held.P is not None
        x = num.zeros((*held.x.shape[:2], n + g))
        x[..., :n] = held.x
        P = num.zeros((*held.x.shape[:2], n + g, n + g))
        P[..., :n, :n] = held.P
        P[..., n:, n:] = plan.fresh
        return KalmanState(x, P)

    def step(
        self, plan: BernoulliPlan, state: BernoulliState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[BernoulliState, Estimate]:
        kf, n, r = KalmanFilter(), plan.states, state.r
        assert state.under.P is not None
        marginal = KalmanState(state.under.x[..., :n], state.under.P[..., :n, :n])
        without = merged([state.without, marginal], [(1.0 - r) * (1.0 - self.birth), r * (1.0 - self.survival)])
        under = merged([self._born(plan, state.without), state.under], [(1.0 - r) * self.birth, r * self.survival])
        r = (1.0 - r) * self.birth + r * self.survival
        beliefs, logs = [], []
        for own, held in ((plan.without, without), (plan.under, under)):
            belief = kf.predict(own, held, known_u)
            innovation = kf.innovation(own, belief, received)
            logs.append(log_likelihood(innovation, received.valid))
            beliefs.append(kf.update(own, belief, innovation, received.valid))
        odds = num.log(np.maximum(r, LEAST)) - num.log(np.maximum(1.0 - r, LEAST)) + logs[1] - logs[0]
        odds = np.where(r > 0.0, odds, NEVER)
        small = num.exp(-np.abs(odds))
        r = np.where(r > 0.0, np.where(odds > 0.0, 1.0, small) / (1.0 + small), 0.0)
        share = np.where(r > 0.5, 1.0, 0.0) if self.estimate == "likelier" else r
        x = (1.0 - share)[..., None] * beliefs[0].x + share[..., None] * beliefs[1].x[..., :n]
        alarm = odds > self.threshold
        estimate = Estimate(x, odds, alarm, num.full(odds.shape, Mode.NORMAL, np.int8), np.ones_like(alarm))
        return BernoulliState(r, *beliefs), estimate
