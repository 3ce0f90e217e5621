"""Exploration of the learners with a replay buffer: random actions, most of which do nothing (extra: train)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tailgate.core import Array
from tailgate.envs.gym.actions import ActionCodec

if TYPE_CHECKING:
    from stable_baselines3.common.noise import ActionNoise


class Explorer:
    """Random actions that attack with probability `attack`, independently in each row."""

    def __init__(self, codec: ActionCodec, attack: float, seed: int) -> None:
        self.codec, self.attack, self.rng = codec, attack, np.random.default_rng(seed)

    def actions(self, rows: int) -> Array:
        """Return random actions, (rows,) int64 or (rows, size) float32."""
        attacks = self.rng.random(rows) < self.attack
        if self.codec.discrete:
            return np.where(attacks, self.rng.integers(1, self.codec.size, rows), 0)
        out = self.rng.uniform(-1.0, 1.0, (rows, self.codec.size)).astype(np.float32)
        out[:, 0] = np.where(attacks, 1.0, -1.0) * np.abs(out[:, 0])
        return out


class Exploring:
    """Mixed into an algorithm with a replay buffer: before learning starts its actions are the explorer's."""

    explorer: Explorer

    def _sample_action(self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1) -> tuple[Array, Array]:
        algorithm: Any = super()
        if self.num_timesteps >= learning_starts:  # type: ignore[attr-defined]
            return algorithm._sample_action(learning_starts, action_noise, n_envs)  # type: ignore[no-any-return]
        action = self.explorer.actions(n_envs)
        return action, action
