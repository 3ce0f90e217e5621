"""Proximal policy optimisation (Schulman et al. 2017) from Stable-Baselines3 on the batched environment (extra: train).

A checkpoint is one safetensors file that holds everything the next update depends on: network, optimiser, environments and
random generators. An interrupted run that resumes gives the policy of an uninterrupted one.
"""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

try:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
except ImportError as error:
    raise ImportError("torch or Stable-Baselines3 is missing: pip install 'tailgate[train]'") from error
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from tailgate.core import NonNegative, Positive, PositiveCount, Probability, param
from tailgate.envs.sb3 import BatchVecEnv
from tailgate.envs.seat import Seat, Tally
from tailgate.errors import InputError
from tailgate.files import write_atomic
from tailgate.schema import canonical
from tailgate.tree import leaves, with_leaves

from .learning import Progress, header_of, open_checkpoint
from .policy import Network, save_policy

FORMAT = "tailgate-ppo-checkpoint-1"
SEED_STRIDE = 1_000_000  # between the rows of two training seeds


@dataclass(frozen=True)
class Config:
    """Hyper-parameters, tuned on training seeds of the quickstart scenario."""

    envs: PositiveCount = param(512, "environments in the batch")
    rollout: PositiveCount = param(64, "steps per environment and update")
    batch_size: PositiveCount = param(4096, "samples per gradient step")
    epochs: PositiveCount = param(10, "passes over a rollout")
    learning_rate: Positive = param(1e-3, "step size of Adam")
    gae_lambda: Probability = param(0.95, "bias against variance of the advantages [-]")
    clip: Positive = param(0.2, "largest change of a probability ratio [-]")
    entropy: NonNegative = param(0.0, "weight of the entropy bonus [-]")
    hidden: tuple[PositiveCount, ...] = param((64, 64), "widths of the hidden layers")
    rest: Probability = param(0.1, "initial probability of attacking in a step: a policy that spends its budget at once learns no timing")

    def check(self) -> None:
        """Raise InputError when the fields do not fit each other."""
        samples = self.envs * self.rollout
        if self.batch_size < 2 or samples % self.batch_size:
            raise InputError("ppo.batch_size", self.batch_size, f"a divisor of envs x rollout ({samples}), and at least 2")
        if self.envs > SEED_STRIDE:
            raise InputError("ppo.envs", self.envs, f"at most {SEED_STRIDE}")


class Learner:
    """One training run of one seed."""

    def __init__(self, seed: int, gamma: float, config: Config, environment: dict[str, Any], tensorboard: Path | None = None) -> None:
        torch.set_num_threads(1)  # more threads gain nothing on networks of this size
        config.check()
        self.seed, self.config = seed, config
        self.identity = hashlib.blake2b(canonical([config, gamma]).encode(), digest_size=8).hexdigest()
        self.env = BatchVecEnv(config.envs, gamma=gamma, **environment)
        extra = {} if self.env.batch.seat.action.discrete else {"log_std_init": -0.5}
        self.model = PPO(
            "MlpPolicy", self.env, learning_rate=config.learning_rate, n_steps=config.rollout, batch_size=config.batch_size,
            n_epochs=config.epochs, gamma=gamma, gae_lambda=config.gae_lambda, clip_range=config.clip, ent_coef=config.entropy,
            policy_kwargs={"net_arch": list(config.hidden), **extra}, seed=seed, device="cpu",
            tensorboard_log=str(tensorboard) if tensorboard else None,
        )  # fmt: skip
        self.env.seed(seed * SEED_STRIDE)  # Stable-Baselines3 has seeded the rows with seed, seed + 1, ...: training seeds would share them
        self.curve: list[dict[str, Any]] = []
        # rows start together and end together: a window of two batches of episodes is steady, one rollout's are not
        self.ended: deque[tuple[bool, float]] = deque(maxlen=2 * config.envs)
        self._rest_first(config.rest)

    def _rest_first(self, probability: float) -> None:
        bias: Any = self.model.policy.action_net.bias
        p = min(max(probability, 1e-6), 1.0 - 1e-6)
        with torch.no_grad():
            if self.env.batch.seat.action.discrete:
                bias[0] = float(np.log((len(bias) - 1) * (1.0 - p) / p))
            else:
                from scipy.stats import norm

                bias[0] = float(norm.ppf(p) * np.exp(-0.5))

    @property
    def seat(self) -> Seat:
        return self.env.batch.seat

    @property
    def steps(self) -> int:
        """Decisions taken so far."""
        return int(self.model.num_timesteps)

    def learn(self, steps: int, report: Callable[[Progress], None], checkpoint: Path | None = None, every: int = 1_000_000) -> None:
        """Train until `steps` decisions in total; calls `report` after each rollout."""
        remaining = steps - self.model.num_timesteps
        if remaining <= 0:
            return
        self.model.learn(
            remaining, callback=_Reporter(self, report, checkpoint, every), reset_num_timesteps=False,
            tb_log_name=f"seed{self.seed}", progress_bar=False,
        )  # fmt: skip
        if checkpoint is not None:
            self.save(checkpoint)

    def export(self, path: Path, training: dict[str, Any]) -> Path:
        """Write the policy as safetensors + JSON."""
        policy: Any = self.model.policy
        seat = self.seat
        layers = [m for m in policy.mlp_extractor.policy_net if isinstance(m, torch.nn.Linear)] + [policy.action_net]
        weights = tuple(layer.weight.detach().numpy().T.astype(np.float64) for layer in layers)
        biases = tuple(layer.bias.detach().numpy().astype(np.float64) for layer in layers)
        log_std = None if seat.action.discrete else policy.log_std.detach().numpy().astype(np.float64)
        return save_policy(path, Network(weights, biases, log_std), header_of(seat, training))

    def close(self) -> None:
        """Close the environments."""
        self.env.close()

    # -- checkpoints

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        model, batch = self.model, self.env.batch
        tensors: dict[str, Any] = {f"policy.{k}": v.contiguous() for k, v in model.policy.state_dict().items()}
        for i, state in model.policy.optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{i}.{k}": v.contiguous() for k, v in state.items()}
        state, tally = batch.state, batch.tally
        assert state is not None and tally is not None
        arrays: dict[str, Any] = {f"loop.{k}": v for k, v in leaves(state).items()}
        _, words, position, _, _ = np.random.get_state()  # noqa: NPY002 - Stable-Baselines3 shuffles with it
        arrays |= {
            **{f"env.{name}": value for name, value in tally._asdict().items()}, "env.returns": self.env._returns,
            "env.lengths": self.env._lengths, "last_obs": model._last_obs, "last_starts": model._last_episode_starts, "numpy": words,
        }  # fmt: skip
        for name, array in arrays.items():
            whole = np.array(array, order="C")  # torch has no unsigned integers of 32 and 64 bits: keep their bits
            tensors[name] = torch.from_numpy(whole.view(np.uint8) if whole.dtype.kind == "u" and whole.ndim else whole)
        tensors["torch"] = torch.get_rng_state()
        facts = {
            "format": FORMAT, "seed": self.seed, "card": batch.card()["hash"], "learner": self.identity, "steps": model.num_timesteps,
            "updates": model._n_updates, "numpy_position": int(position), "curve": self.curve, "ended": list(self.ended),
        }  # fmt: skip
        write_atomic(path, save_tensors(tensors, {"facts": json.dumps(facts)}))

    def load(self, path: Path) -> None:
        """Continue from a checkpoint; raises InputError when it is damaged or of another run."""
        batch, model = self.env.batch, self.model
        wanted = {"format": FORMAT, "seed": self.seed, "card": batch.card()["hash"], "learner": self.identity}
        tensors, facts = open_checkpoint(path, wanted, load_tensors)
        try:
            self.env.reset()
            assert batch.state is not None and batch.tally is not None
            model.policy.load_state_dict({k[7:]: v for k, v in tensors.items() if k.startswith("policy.")})
            adam: dict[int, dict[str, Any]] = {}
            for name, value in tensors.items():
                if name.startswith("adam."):
                    _, index, key = name.split(".")
                    adam.setdefault(int(index), {})[key] = value
            optimiser = model.policy.optimizer
            optimiser.load_state_dict({"state": adam, "param_groups": optimiser.state_dict()["param_groups"]})

            def restored(name: str, like: Any) -> Any:
                raw = tensors[name].numpy()
                return raw.view(like.dtype).reshape(like.shape) if like.dtype.kind == "u" else raw.reshape(like.shape)

            batch.state = with_leaves(batch.state, {k: restored(f"loop.{k}", v) for k, v in leaves(batch.state).items()})
            batch.tally = Tally(*(restored(f"env.{name}", value).copy() for name, value in batch.tally._asdict().items()))
            self.env._returns[:] = tensors["env.returns"].numpy()
            self.env._lengths[:] = tensors["env.lengths"].numpy()
            model._last_obs = tensors["last_obs"].numpy().copy()
            batch.observed = tensors["last_obs"].numpy().copy()
            model._last_episode_starts = tensors["last_starts"].numpy().copy()
            words = tensors["numpy"].numpy().view(np.uint32)
            np.random.set_state(("MT19937", words, facts["numpy_position"], 0, 0.0))  # noqa: NPY002 - see save
            torch.set_rng_state(tensors["torch"])
            model.num_timesteps, model._n_updates = facts["steps"], facts["updates"]
            self.curve = facts["curve"]
            self.ended.extend((bool(crashed), float(reward)) for crashed, reward in facts["ended"])
        except (KeyError, ValueError, RuntimeError, TypeError) as error:
            raise InputError("checkpoint", str(path), f"a checkpoint that fits this configuration ({error})") from None


class _Reporter(BaseCallback):
    """Counts how episodes end, keeps the curve, writes checkpoints."""

    def __init__(self, learner: Learner, report: Callable[[Progress], None], checkpoint: Path | None, every: int) -> None:
        super().__init__()
        self.learner, self.report, self.checkpoint, self.every = learner, report, checkpoint, every
        self.saved = learner.model.num_timesteps

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if info:
                self.learner.ended.append((info["crashed"], info["episode"]["r"]))
        return True

    def _on_rollout_start(self) -> None:  # the update of the last rollout is done
        if self.checkpoint is not None and self.num_timesteps - self.saved >= self.every:
            self.saved = self.num_timesteps
            self.learner.save(self.checkpoint)

    def _on_rollout_end(self) -> None:
        crash = reward = None
        seat = self.learner.env.batch.seat
        whole = seat.decisions * self.learner.config.envs
        if self.learner.ended and self.num_timesteps > whole:  # until the first horizon only collisions have ended
            crash, reward = (float(np.mean(column)) for column in zip(*self.learner.ended, strict=True))
            crash = crash if seat.road else None
            self.learner.curve.append({"steps": self.num_timesteps, "seed": self.learner.seed, "crash": crash, "reward": reward})
            if crash is not None:
                self.logger.record("attack/crash_rate", crash)
        self.report(Progress(self.num_timesteps, crash, reward))
