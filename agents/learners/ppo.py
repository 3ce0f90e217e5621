"""Proximal policy optimisation (Schulman et al. 2017) from Stable-Baselines3 on the batched environment (extra: train)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

try:
    import torch
    from stable_baselines3 import PPO
except ImportError as error:
    raise ImportError("torch or Stable-Baselines3 is missing: pip install 'tailgate[train]'") from error

from tailgate.agents.learners.stable import StableLearner, perceptron, rest_first
from tailgate.agents.learners.teacher import Demonstration
from tailgate.base.errors import InputError
from tailgate.base.sizes import Passes, Rows, Width
from tailgate.core import NonNegative, Positive, Probability, param
from tailgate.core.neural import Network
from tailgate.core.registry import register

LOG_STD = -0.5  # log of the standard deviation of the first policy's continuous actions
IMITATION_EPOCHS, IMITATION_BATCH, IMITATION_RATE = 6, 1024, 2e-3
IMITATION_ENTROPY = 0.003  # an exact imitation would explore nothing


@dataclass(frozen=True)
class Config:
    """Hyper-parameters, tuned on training seeds of the preset `gusty`."""

    name: ClassVar[str] = "ppo"

    envs: Rows = param(512, "environments in the batch")
    rollout: Rows = param(64, "steps per environment and update")
    batch_size: Rows = param(4096, "samples per gradient step")
    epochs: Passes = param(10, "passes over a rollout")
    learning_rate: Positive = param(1e-3, "step size of Adam")
    gae_lambda: Probability = param(0.95, "bias against variance of the advantages [-]")
    clip: Positive = param(0.2, "largest change of a probability ratio [-]")
    entropy: NonNegative = param(0.0, "weight of the entropy bonus [-]")
    hidden: tuple[Width, ...] = param((64, 64), "widths of the hidden layers")
    rest: Probability = param(0.1, "initial probability of attacking in a step: a policy that spends its budget at once learns no timing")

    def check(self) -> None:
        """Raise InputError when the fields do not fit each other."""
        samples = self.envs * self.rollout
        if self.batch_size < 2 or samples % self.batch_size:
            raise InputError(f"{self.name}.batch_size", self.batch_size, f"a divisor of envs x rollout ({samples}), and at least 2")


@register("learner", "ppo")
class Learner(StableLearner):
    """One training run of one seed."""

    name = "ppo"
    algorithm: ClassVar[Any] = PPO
    policy: ClassVar[str] = "MlpPolicy"
    config: Config

    def make_model(self, tensorboard: str | None) -> Any:
        config, discrete = self.config, self.seat.action.discrete
        model = self.algorithm(
            self.policy, self.env, learning_rate=config.learning_rate, n_steps=config.rollout, batch_size=config.batch_size,
            n_epochs=config.epochs, gamma=self.gamma, gae_lambda=config.gae_lambda, clip_range=config.clip, ent_coef=config.entropy,
            policy_kwargs={"net_arch": list(config.hidden), **({} if discrete else {"log_std_init": LOG_STD}), **self.architecture()},
            seed=self.seed, device="cpu", tensorboard_log=tensorboard,
        )  # fmt: skip
        rest_first(model.policy.action_net, config.rest, discrete, LOG_STD)
        return model

    def architecture(self) -> dict[str, Any]:
        """Return arguments of this policy alone."""
        return {}

    def imitate(self, shown: Demonstration) -> None:
        """Fit the policy to the shown actions and the critic to their returns (behaviour cloning), by its own optimiser's method."""
        policy = self.model.policy
        size = len(shown.action)
        seen, action = torch.as_tensor(shown.observation), torch.as_tensor(shown.action)
        gained = torch.as_tensor(shown.gained, dtype=torch.float32)
        optimiser = torch.optim.Adam(policy.parameters(), lr=IMITATION_RATE)
        for _ in range(IMITATION_EPOCHS):
            order = torch.randperm(size)
            for first in range(0, size, IMITATION_BATCH):
                batch = order[first : first + IMITATION_BATCH]
                value, likelihood, entropy = policy.evaluate_actions(seen[batch], action[batch])
                loss: Any = torch.mean(-likelihood + 0.5 * (value.flatten() - gained[batch]) ** 2 - IMITATION_ENTROPY * entropy)
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()

    @property
    def round(self) -> int:
        """Each rollout is reported."""
        return self.config.envs * self.config.rollout

    def network(self) -> Network:
        policy = self.model.policy
        log_std = None if self.seat.action.discrete else policy.log_std.detach().numpy().astype(np.float64)
        return Network(*perceptron(policy.mlp_extractor.policy_net, policy.action_net), log_std)
