"""PPO whose policy remembers the episode in an LSTM, from sb3-contrib (extra: train).

Policy and critic have an LSTM each; the memory advances once per decision and is blank at the start of an episode. Try `frames` first: an
observation of several decisions is faster to learn on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

try:
    import torch
    from sb3_contrib import RecurrentPPO
    from sb3_contrib.common.recurrent.type_aliases import RNNStates
except ImportError as error:
    raise ImportError("torch or sb3-contrib is missing: pip install 'tailgate[train]'") from error

from tailgate.agents.learners import ppo
from tailgate.base.sizes import Passes, Rows, Width
from tailgate.core import Array, Positive, param
from tailgate.core.neural import Lstm, Network
from tailgate.core.registry import register


@dataclass(frozen=True)
class Config(ppo.Config):
    """Hyper-parameters: those of PPO, on a smaller batch, and the width of the memory."""

    name: ClassVar[str] = "recurrent_ppo"

    envs: Rows = param(256, "environments in the batch")
    rollout: Rows = param(16, "steps per environment and update")
    batch_size: Rows = param(512, "samples per gradient step")
    epochs: Passes = param(6, "passes over a rollout")
    learning_rate: Positive = param(2e-3, "step size of Adam")
    hidden: tuple[Width, ...] = param((32,), "widths of the hidden layers behind the LSTM")
    memory: Width = param(32, "width of the LSTM, of the policy and of the critic")


@register("learner", "recurrent_ppo")
class Learner(ppo.Learner):
    """One training run of one seed."""

    name = "recurrent_ppo"
    packages = ("torch", "stable-baselines3", "sb3-contrib")
    algorithm: ClassVar[Any] = RecurrentPPO
    policy: ClassVar[str] = "MlpLstmPolicy"
    config: Config
    imitate = None  # type: ignore[assignment]  # single decisions train no memory

    def architecture(self) -> dict[str, Any]:
        return {"lstm_hidden_size": self.config.memory}

    def network(self) -> Network:
        plain, lstm = super().network(), self.model.policy.lstm_actor
        weight = torch.cat([lstm.weight_ih_l0, lstm.weight_hh_l0], dim=1).detach().numpy().T.astype(np.float64)
        bias = lstm.bias_ih_l0.detach().numpy().astype(np.float64) + lstm.bias_hh_l0.detach().numpy().astype(np.float64)
        return Network(plain.weights, plain.biases, plain.log_std, Lstm(weight, bias))

    def held(self) -> dict[str, Array]:
        states = self.model._last_lstm_states
        return {f"lstm.{owner}.{i}": part.numpy() for owner in ("pi", "vf") for i, part in enumerate(getattr(states, owner))}

    def restore(self, arrays: dict[str, Array]) -> None:
        pi, vf = ((torch.from_numpy(arrays[f"lstm.{owner}.0"]), torch.from_numpy(arrays[f"lstm.{owner}.1"])) for owner in ("pi", "vf"))
        self.model._last_lstm_states = RNNStates(pi, vf)
