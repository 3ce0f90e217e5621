"""The hybrid Bernoulli filter (Forti, Battistelli, Chisci and Sinopoli 2016; thesis, [28]).

It asks: is there an attack, and how large is it?

r is the probability that an attack exists; p0(x) the density without it, p1(x, a) the joint one with it. Each is a mixture of at most J
Gaussians (mixtures.py); with J = 1, where two meet, they are merged to one of the same mean and covariance. With birth p_b and survival
p_s:

    predict    r- = (1-r) p_b + r p_s
               p0- ~ (1-r)(1-p_b) p0 + r (1-p_s) p1(x)            through (A, Q)
               p1- ~ (1-r) p_b p0 N(a; 0, Sa) + r p_s p1          through (A, Q) and a+ = a + wa
    update     y = C x + v without, y = C x + G a + v with an attack: a Kalman step each, with likelihoods L0 and L1
               r = r- L1 / ((1-r-) L0 + r- L1)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError, unknown
from tailgate.core import Array, Estimate, Finite, Mode, Model, NonNegative, Positive, Prior, Probability, Received, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.estimators.filters.imm import LEAST, log_likelihood, merged
from tailgate.estimators.filters.kalman import KalmanFilter, KalmanPlan, KalmanState
from tailgate.estimators.filters.mixtures import Mixture, alone, joined, mean, measured, reduced, spread_out

Components = Annotated[int, Field(ge=1, le=32)]
NEVER = -1e3  # log odds where no attack can exist


class BernoulliPlan(NamedTuple):
    without: KalmanPlan
    under: KalmanPlan  # of (x, a)
    fresh: Array  # (g, g) Sa
    states: int


class BernoulliState(NamedTuple):
    r: Array  # (B, N)
    without: KalmanState | Mixture
    under: KalmanState | Mixture


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
    components: Components = param(1, "J, Gaussians of each density; 1: a single one, whatever it has to cover")
    merge: NonNegative = param(4.0, "of several: squared Mahalanobis distance below which two are merged [-]")
    prune: Probability = param(1e-5, "of several: weight below which one is left out [-]")
    threshold: Finite = param(0.0, "alarm above these log odds of an attack; 0: probability 1/2 [-]")

    def __post_init__(self) -> None:
        if self.components > 1 and self.prune * 2 * self.components >= 1.0:  # one of 2 J weighs at least 1 / (2 J)
            raise InputError("defence bernoulli.prune", self.prune, f"below 1 / (2 components), {0.5 / self.components:g}")

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
        if self.components > 1:
            kalman, under = (spread_out(own, 2 * self.components) for own in (kalman, under))
        return BernoulliPlan(kalman, under, self.spread * self.spread * np.eye(g), n)

    def start(self, plan: BernoulliPlan, prior: Prior) -> BernoulliState:
        without = KalmanState(prior.mean, prior.cov)
        begun = without, self._born(plan, without)
        if self.components > 1:
            begun = tuple(alone(held, self.components) for held in begun)  # type: ignore[assignment]
        return BernoulliState(num.full(prior.mean.shape[:2], self.birth), *begun)

    def _born(self, plan: BernoulliPlan, held: KalmanState) -> KalmanState:
        """Return p0 N(a; 0, Sa), of x (B, N, ..., n)."""
        n, g = plan.states, len(plan.fresh)
        assert held.P is not None
        x = num.zeros((*held.x.shape[:-1], n + g))
        x[..., :n] = held.x
        P = num.zeros((*held.x.shape[:-1], n + g, n + g))
        P[..., :n, :n] = held.P
        P[..., n:, n:] = plan.fresh
        return KalmanState(x, P)

    def step(
        self, plan: BernoulliPlan, state: BernoulliState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[BernoulliState, Estimate]:
        n, r = plan.states, state.r
        share = [(1.0 - r) * (1.0 - self.birth), r * (1.0 - self.survival)], [(1.0 - r) * self.birth, r * self.survival]
        r = (1.0 - r) * self.birth + r * self.survival
        if self.components > 1:
            assert isinstance(state.without, Mixture) and isinstance(state.under, Mixture)
            return self._concluded(plan, r, *self._mixed(plan, state.without, state.under, share, received, known_u))
        kf = KalmanFilter()
        assert isinstance(state.without, KalmanState) and isinstance(state.under, KalmanState) and state.under.P is not None
        marginal = KalmanState(state.under.x[..., :n], state.under.P[..., :n, :n])
        without = merged([state.without, marginal], share[0])
        under = merged([self._born(plan, state.without), state.under], share[1])
        beliefs, logs = [], []
        for own, held in ((plan.without, without), (plan.under, under)):
            belief = kf.predict(own, held, known_u)
            innovation = kf.innovation(own, belief, received)
            logs.append(log_likelihood(innovation, received.valid))
            beliefs.append(kf.update(own, belief, innovation, received.valid))
        return self._concluded(plan, r, beliefs, logs)

    def _mixed(
        self, plan: BernoulliPlan, without: Mixture, under: Mixture, share: Sequence[Sequence[Array]], received: Received, known_u: Array
    ) -> tuple[list[Mixture], list[Array]]:
        """Return both mixtures after the readings, and the logarithms of their likelihoods (B, N)."""
        n = plan.states
        marginal = Mixture(under.w, under.x[..., :n], under.P[..., :n, :n])
        born = self._born(plan, KalmanState(without.x, without.P))
        assert born.P is not None
        fresh = Mixture(without.w, born.x, born.P)
        beliefs, logs = [], []
        for own, held in ((plan.without, joined(without, marginal, *share[0])), (plan.under, joined(fresh, under, *share[1]))):
            belief, log = measured(own, held, received, known_u)
            beliefs.append(reduced(belief, self.components, self.merge, self.prune))
            logs.append(log)
        return beliefs, logs

    def _concluded(
        self, plan: BernoulliPlan, r: Array, beliefs: Sequence[KalmanState | Mixture], logs: Sequence[Array]
    ) -> tuple[BernoulliState, Estimate]:
        """Return state and estimate from r- (B, N), both beliefs, and the logarithms of their likelihoods (B, N)."""
        odds = num.log(np.maximum(r, LEAST)) - num.log(np.maximum(1.0 - r, LEAST)) + logs[1] - logs[0]
        odds = np.where(r > 0.0, odds, NEVER)
        small = num.exp(-np.abs(odds))
        r = np.where(r > 0.0, np.where(odds > 0.0, 1.0, small) / (1.0 + small), 0.0)
        share = np.where(r > 0.5, 1.0, 0.0) if self.estimate == "likelier" else r
        means = [mean(held) if isinstance(held, Mixture) else held.x for held in beliefs]
        x = (1.0 - share)[..., None] * means[0] + share[..., None] * means[1][..., : plan.states]
        alarm = odds > self.threshold
        estimate = Estimate(x, odds, alarm, num.full(odds.shape, Mode.NORMAL, np.int8), np.ones_like(alarm))
        return BernoulliState(r, beliefs[0], beliefs[1]), estimate
