"""Deep Q-learning (Mnih et al. 2015) with returns over several decisions, from Stable-Baselines3 (extra: train). Discrete actions only.

Exploration is epsilon-greedy in each row of the batch, and most random actions do nothing. Epsilon falls with the number of decisions, not
with the length of the run, so that a resumed run explores as an uninterrupted one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

try:
    from stable_baselines3 import DQN
    from stable_baselines3.common.noise import ActionNoise
except ImportError as error:
    raise ImportError("torch or Stable-Baselines3 is missing: pip install 'tailgate[train]'") from error

from tailgate.agents.learners.exploring import Explorer
from tailgate.agents.learners.learning import DISCRETE
from tailgate.agents.learners.stable import OffPolicyConfig, OffPolicyLearner, perceptron
from tailgate.core import Array, Positive, PositiveCount, Probability, param
from tailgate.core.neural import Network
from tailgate.core.registry import register


@dataclass(frozen=True)
class Config(OffPolicyConfig):
    """Hyper-parameters of deep Q-learning."""

    name: ClassVar[str] = "dqn"

    learning_rate: Positive = param(1e-3, "step size of Adam")
    target_every: PositiveCount = param(2_000, "decisions between copies to the target network")
    explore: PositiveCount = param(50_000, "decisions over which epsilon falls from 1 to its last value")
    epsilon: Probability = param(0.05, "last probability of a random action")


class _DQN(DQN):
    """Explores row by row."""

    explorer: Explorer
    explore: int
    epsilon: float

    def _sample_action(self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1) -> tuple[Array, Array]:
        action = self.explorer.actions(n_envs)
        if self.num_timesteps >= learning_starts:
            assert isinstance(self._last_obs, np.ndarray)
            best, _ = self.policy.predict(self._last_obs, deterministic=True)
            action = np.where(self.explorer.rng.random(n_envs) < self._rate, action, best)
        return action, action

    @property
    def _rate(self) -> float:
        return max(self.epsilon, 1.0 - (1.0 - self.epsilon) * self.num_timesteps / self.explore)

    def _on_step(self) -> None:
        super()._on_step()
        self.logger.record("rollout/exploration_rate", self._rate)  # its own schedule is not in use


@register("learner", "dqn")
class Learner(OffPolicyLearner):
    """One training run of one seed."""

    name = "dqn"
    actions = DISCRETE
    algorithm: ClassVar[Any] = _DQN
    traits: ClassVar[dict[str, bool]] = {"greedy": True}
    config: Config

    def make_model(self, tensorboard: str | None) -> Any:
        model = super().make_model(tensorboard)
        model.explore, model.epsilon = self.config.explore, self.config.epsilon
        return model

    def arguments(self) -> dict[str, Any]:
        return {"target_update_interval": self.config.target_every}

    def network(self) -> Network:
        return Network(*perceptron(self.model.q_net.q_net))
