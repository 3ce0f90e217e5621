"""Soft actor-critic (Haarnoja et al. 2018) from Stable-Baselines3 (extra: train). Continuous actions only.

The exported policy is the mean action through tanh; the spread that it learned with is left behind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

try:
    from stable_baselines3 import SAC
except ImportError as error:
    raise ImportError("torch or Stable-Baselines3 is missing: pip install 'tailgate[train]'") from error

from tailgate.agents.learners.exploring import Exploring
from tailgate.agents.learners.learning import CONTINUOUS
from tailgate.agents.learners.stable import OffPolicyConfig, OffPolicyLearner, perceptron, rest_first
from tailgate.core import Positive, param
from tailgate.core.neural import Network
from tailgate.core.registry import register


@dataclass(frozen=True)
class Config(OffPolicyConfig):
    """Hyper-parameters of soft actor-critic."""

    name: ClassVar[str] = "sac"

    entropy: Positive = param(0.02, "first weight of the entropy, which is adapted [-]")
    tau: Positive = param(0.01, "share of the critics that their targets take over in a gradient step [-]")


class _SAC(Exploring, SAC):
    """Rests more often than not before it learns."""


@register("learner", "sac")
class Learner(OffPolicyLearner):
    """One training run of one seed."""

    name = "sac"
    actions = CONTINUOUS
    algorithm: ClassVar[Any] = _SAC
    traits: ClassVar[dict[str, bool]] = {"greedy": True}
    config: Config

    def make_model(self, tensorboard: str | None) -> Any:
        model = super().make_model(tensorboard)
        rest_first(model.actor.mu, self.config.attack, discrete=False, log_std=0.0)
        return model

    def arguments(self) -> dict[str, Any]:
        return {"ent_coef": f"auto_{self.config.entropy}", "tau": self.config.tau}

    def network(self) -> Network:
        return Network(*perceptron(self.model.actor.latent_pi, self.model.actor.mu), squashed=True)
