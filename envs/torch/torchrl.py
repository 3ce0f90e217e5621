"""TorchRL's EnvBase over `TensorVecEnv` (extra: torchrl): a batch of environments that TorchRL resets row by row."""

from __future__ import annotations

from typing import Any

import gymnasium
import torch

try:
    from tensordict import TensorDict, TensorDictBase
    from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
    from torchrl.envs import EnvBase
except ImportError as error:
    raise ImportError("TorchRL is missing: pip install 'tailgate[torchrl]'") from error

from tailgate.envs.gym.attacker_mdp import CAR_FOLLOWING, without_autoreset
from tailgate.envs.torch.tensors import Tensor, TensorVecEnv


class TailgateEnv(EnvBase):  # type: ignore[misc]
    """`num_envs` environments: observation, action, reward, done, terminated, truncated, and action_mask where actions are discrete.

    Arguments are those of `TensorVecEnv`, except `autoreset`: TorchRL resets rows itself. Rewards are float32, as TorchRL's losses want.
    """

    def __init__(self, num_envs: int, id: str = CAR_FOLLOWING, *, device: str | None = None, **arguments: Any) -> None:
        without_autoreset(arguments, "nothing: TorchRL resets rows that are done")
        env = TensorVecEnv(num_envs, id, device=device, autoreset="disabled", **arguments)
        super().__init__(device=env.device, batch_size=torch.Size([num_envs]))
        self.env = env
        self._seed: int | None = None
        self._begun = False
        self._actions = 0  # discrete ones
        space, action, rows = env.single_observation_space, env.single_action_space, (num_envs,)
        assert isinstance(space, gymnasium.spaces.Box) and space.shape is not None
        limit = float(space.high.max())
        seen = {"observation": Bounded(-limit, limit, (*rows, *space.shape), self.device, torch.float32)}
        if isinstance(action, gymnasium.spaces.Discrete):
            self._actions = int(action.n)
            seen["action_mask"] = Binary(self._actions, (*rows, self._actions), self.device, torch.bool)
            self.action_spec = Categorical(self._actions, rows, self.device, torch.int64)
        else:
            self.action_spec = Bounded(-1.0, 1.0, (*rows, *action.shape), self.device, torch.float32)  # type: ignore[misc]
        self.observation_spec = Composite(seen, shape=rows, device=self.device)
        self.reward_spec = Unbounded((*rows, 1), self.device, torch.float32)
        ends = {name: Categorical(2, (*rows, 1), self.device, torch.bool) for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(ends, shape=rows, device=self.device)

    def _seen(self, observation: Tensor) -> dict[str, Tensor]:
        return {"observation": observation} | ({"action_mask": self.env.action_masks()} if self._actions else {})

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = None if mask is None or not self._begun or (self._seed is not None and bool(mask.all())) else mask.reshape(self.batch_size)
        observation, _info = self.env.reset(seed=None if mask is not None else self._seed, mask=mask)
        if mask is None:
            self._seed, self._begun = None, True
        ends = torch.zeros((*self.batch_size, 1), dtype=torch.bool, device=self.device)
        found = self._seen(observation) | {"done": ends, "terminated": ends.clone(), "truncated": ends.clone()}
        return TensorDict(found, batch_size=self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, reward, terminated, truncated, _ = self.env.step(tensordict.get("action"))
        ends = {"done": terminated | truncated, "terminated": terminated, "truncated": truncated}
        found = self._seen(observation) | {name: end.clone()[:, None] for name, end in ends.items()}
        found["reward"] = reward.to(torch.float32)[:, None]
        return TensorDict(found, batch_size=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        """Seed the next reset of all rows: row i gets this seed + i."""
        self._seed = seed

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Give back what the environments hold."""
        self.env.close()
        super().close(raise_if_closed=raise_if_closed)
