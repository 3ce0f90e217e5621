"""Stable-Baselines3's VecEnv over the batched environment (extra: train)."""

from __future__ import annotations

from typing import Any

import numpy as np

try:
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices
except ImportError as error:
    raise ImportError("Stable-Baselines3 is missing: pip install 'tailgate[train]'") from error

from tailgate.base.errors import unknown
from tailgate.core import Array
from tailgate.envs.gym.attacker_mdp import CAR_FOLLOWING, FACES, without_autoreset
from tailgate.envs.gym.gymnasium_env import AdversaryEnv, AdversaryVectorEnv


class BatchVecEnv(VecEnv):
    """One batch as a VecEnv: same-step autoreset, infos filled at episode ends only.

    `episode` has return and length as Monitor writes them, and whether there was a collision (`crashed`). An info that is filled has the
    names that a single environment's info has. id: whose defaults hold for what `arguments` leaves open.
    """

    def __init__(self, num_envs: int, id: str = CAR_FOLLOWING, **arguments: Any) -> None:
        if id not in FACES:
            raise unknown("id", id, FACES)
        without_autoreset(arguments, "nothing: Stable-Baselines3 wants rows that are reset in the same step")
        self.batch = AdversaryVectorEnv(num_envs, autoreset="same_step", **(FACES[id] | arguments))
        super().__init__(num_envs, self.batch.single_observation_space, self.batch.single_action_space)
        self._actions: Array = np.zeros(0)
        self._returns, self._lengths, self._crashed = np.zeros(num_envs), np.zeros(num_envs, np.int64), np.zeros(num_envs, bool)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.batch!r})"

    def reset(self) -> Array:
        options = self._options[0] or None
        self._reset_options()
        observation, _ = self.batch.reset(seed=self._seeds[0], options=options)  # row i: this seed + i, as `seed` sets them
        self._reset_seeds()
        self._returns[:], self._lengths[:], self._crashed[:] = 0.0, 0, False
        return observation

    def step_async(self, actions: Array) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        observation, reward, terminated, truncated, info = self.batch.step(self._actions)
        done = terminated | truncated
        self._returns += reward
        self._lengths += 1
        self._crashed |= info["collided"] | info["rear_collided"]
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done.any():
            final, told = info["final_obs"], info["final_info"]
            for i in np.flatnonzero(done):
                infos[i] = AdversaryEnv.row(told, int(i)) | {
                    "terminal_observation": final[i].copy(), "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                    "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i]), "crashed": bool(self._crashed[i])},
                }  # fmt: skip
            self._returns[done], self._lengths[done], self._crashed[done] = 0.0, 0, False
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        self.batch.close()

    def action_masks(self) -> Array:
        return self.batch.action_masks()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return self._by_row(getattr(self.batch if hasattr(self.batch, attr_name) else self, attr_name), indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        raise AttributeError(f"{attr_name}: the rows of a batch have no separate attributes")

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        return self._by_row(getattr(self.batch, method_name)(*args, **kwargs), indices)

    def _by_row(self, value: Any, indices: VecEnvIndices) -> list[Any]:
        """Return the parts of an array (B, ...), or what all rows share."""
        of_rows = isinstance(value, np.ndarray) and value.shape[:1] == (self.num_envs,)
        return [value[i] if of_rows else value for i in self._get_indices(indices)]

    def get_images(self) -> list[Array]:
        """Return the picture of each row; needs `render_mode="rgb_array"`."""
        return list(self.batch.render() or ())

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))
