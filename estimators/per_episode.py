"""Adapter for filters that are one object per episode (filterpy, Stone Soup): plays them at their own speed."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from tailgate import num
from tailgate.core import Array, Estimate, Mode, Model, Prior, Received
from tailgate.draws import Draws


class EpisodeFilter(Protocol):
    """What `per_episode` adapts."""

    def reset(self, model: Model, prior: Prior) -> None:
        """A new episode: prior.mean (n,), prior.cov (n, n)."""

    def step(self, y: Array, valid: Array, u: Array) -> tuple[Array, float]:
        """Readings y (q,), valid (q,) bool, known input u (m,) since the last step -> estimate x (n,), score."""


class EpisodeState(NamedTuple):
    filters: Array  # (B, N) of objects


@dataclass(frozen=True)
class PerEpisode:
    """A defence that keeps one object of `factory` for every episode and agent."""

    factory: Callable[[], EpisodeFilter]

    def prepare(self, model: Model) -> Model:
        return model

    def start(self, plan: Model, prior: Prior) -> EpisodeState:
        batch, agents, _ = prior.mean.shape
        filters = np.empty((batch, agents), object)
        for b in range(batch):
            for i in range(agents):
                filters[b, i] = self.factory()
                filters[b, i].reset(plan, Prior(prior.mean[b, i].copy(), prior.cov[b, i].copy()))
        return EpisodeState(filters)

    def step(
        self, plan: Model, state: EpisodeState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[EpisodeState, Estimate]:
        batch, agents = state.filters.shape
        x, score = num.zeros((batch, agents, plan.states)), np.zeros((batch, agents))
        for b in range(batch):
            for i in range(agents):
                x[b, i], score[b, i] = state.filters[b, i].step(
                    received.y[b, i].copy(), received.valid[b, i].copy(), known_u[b, i].copy()
                )
        quiet = np.zeros_like(score, bool)
        return state, Estimate(x, score, quiet, num.full(score.shape, Mode.NORMAL, np.int8), ~quiet)


def per_episode(factory: Callable[[], EpisodeFilter]) -> PerEpisode:
    """A defence from a filter class that knows one episode only."""
    return PerEpisode(factory)
