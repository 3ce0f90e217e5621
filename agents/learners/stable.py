"""The common part of the learners from Stable-Baselines3 and sb3-contrib: seeds, curve, checkpoints, export (extra: train).

A checkpoint is one safetensors file that holds everything the next update depends on: networks, optimisers, replay buffer and memory of
recurrent networks. It also holds the environments with their episodes in flight, and the random generators. An interrupted run that resumes
gives the policy of an uninterrupted one. Reading it executes nothing.
"""

from __future__ import annotations

import hashlib
import json
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

try:
    import torch
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.save_util import recursive_getattr
except ImportError as error:
    raise ImportError("torch or Stable-Baselines3 is missing: pip install 'tailgate[train]'") from error
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from scipy.special import ndtri

from tailgate.agents.learners.exploring import Explorer
from tailgate.agents.learners.learning import (
    CONTINUOUS,
    DISCRETE,
    SEED_STRIDE,
    BatchConfig,
    Progress,
    check_action,
    header_of,
    open_checkpoint,
    write_checkpoint,
)  # fmt: skip
from tailgate.agents.policy.network_policy import save_policy
from tailgate.base.errors import InputError
from tailgate.base.sizes import Episodes, Passes, Rows, Width
from tailgate.core import Array, Positive, PositiveCount, Probability, param
from tailgate.core.neural import Network
from tailgate.core.schema import canonical
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.sb3 import BatchVecEnv

# torch's words for a distribution whose parameters are not finite, for probabilities that are not, and for a step beyond single precision
SPOILT = ("found invalid values", "probability tensor contains", "without overflow")
COUNTERS = ("_n_updates", "_n_calls", "_episode_num")  # counters of the algorithms, where they have them


class StableLearner:
    """One training run of one seed. A subclass makes `model` and exports its policy."""

    name: ClassVar[str]
    actions: ClassVar[tuple[str, ...]] = (*DISCRETE, *CONTINUOUS)
    packages: ClassVar[tuple[str, ...]] = ("torch", "stable-baselines3")
    traits: ClassVar[dict[str, bool]] = {}  # further fields of the policy's header

    def __init__(self, seed: int, gamma: float, config: BatchConfig, environment: dict[str, Any], tensorboard: Path | None = None) -> None:
        torch.set_num_threads(1)  # more threads gain nothing on networks of this size
        config.check()
        if config.envs > SEED_STRIDE:
            raise InputError(f"{self.name}.envs", config.envs, f"at most {SEED_STRIDE}")
        self.seed, self.config, self.gamma = seed, config, gamma
        self.identity = hashlib.blake2b(canonical([config, gamma]).encode(), digest_size=8).hexdigest()
        self.env = BatchVecEnv(config.envs, gamma=gamma, **environment)
        check_action(self.name, self.seat)
        self.model = self.make_model(str(tensorboard) if tensorboard else None)
        if tensorboard is None:
            self.model.set_logger(Logger(folder=None, output_formats=[]))  # `learn` would make one with a temporary folder
        self.env.seed(seed * SEED_STRIDE)  # Stable-Baselines3 has seeded the rows with seed, seed + 1, ...: training seeds would share them
        self.curve: list[dict[str, Any]] = []
        # rows start together and end together: a window of two batches of episodes is steady, one rollout's are not
        self.ended: deque[tuple[bool, float]] = deque(maxlen=2 * config.envs)

    @abstractmethod
    def make_model(self, tensorboard: str | None) -> Any:
        """Return the algorithm of Stable-Baselines3, on `env`."""

    @abstractmethod
    def network(self) -> Network:
        """Return the network that is exported."""

    @property
    @abstractmethod
    def round(self) -> int:
        """Decisions between two reports."""

    def held(self) -> dict[str, Array]:
        """Return arrays that the next update depends on, besides those of every algorithm."""
        return {}

    def restore(self, arrays: dict[str, Array]) -> None:
        """Restore what `held` returned."""

    @property
    def seat(self) -> Seat:
        return self.env.batch.seat

    @property
    def steps(self) -> int:
        """Decisions taken so far."""
        return int(self.model.num_timesteps)

    def learn(self, steps: int, report: Callable[[Progress], None], checkpoint: Path | None = None, every: int = 1_000_000) -> None:
        """Train until `steps` decisions in total; call `report` after each round. Raise InputError when the policy diverges."""
        remaining = steps - self.model.num_timesteps
        if remaining <= 0:
            return
        try:
            self.model.learn(
                remaining, callback=_Reporter(self, report, checkpoint, every), reset_num_timesteps=False, tb_log_name=f"seed{self.seed}",
                progress_bar=False, **self.logging(),
            )  # fmt: skip
        except (ValueError, RuntimeError) as error:
            if self._finite() and not any(words in str(error) for words in SPOILT):
                raise
            raise self._diverged() from None
        if not self._finite():
            raise self._diverged()
        if checkpoint is not None:
            self.save(checkpoint)

    def logging(self) -> dict[str, Any]:
        """Return further arguments of the algorithm's own `learn`."""
        return {}

    def _finite(self) -> bool:
        return all(bool(torch.isfinite(weights).all()) for weights in self.model.policy.parameters())

    def _diverged(self) -> InputError:
        rate = self.config.learning_rate
        return InputError(f"config.{self.name}.learning_rate", rate, "hyper-parameters under which the policy stays finite")

    def export(self, path: Path, training: dict[str, Any]) -> Path:
        """Write the policy as safetensors + JSON."""
        return save_policy(path, self.network(), header_of(self.seat, training) | self.traits)

    def close(self) -> None:
        """Close the environments."""
        self.env.close()

    # -- checkpoints

    def _facts(self) -> dict[str, Any]:
        """Return the facts on which a checkpoint and the run that loads it must agree."""
        form = f"tailgate-{self.name}-checkpoint-3"
        return {"format": form, "seed": self.seed, "card": self.env.batch.card()["hash"], "learner": self.identity}

    def _parts(self) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        """Return modules, optimisers and single tensors of the algorithm, by name."""
        parts, single = self.model._get_torch_save_params()
        every = {name: recursive_getattr(self.model, name) for name in parts}
        optimisers = {name: part for name, part in every.items() if isinstance(part, torch.optim.Optimizer)}
        modules = {name: part for name, part in every.items() if name not in optimisers}
        return modules, optimisers, {name: recursive_getattr(self.model, name) for name in single}

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        model, batch = self.model, self.env.batch
        modules, optimisers, single = self._parts()
        tensors: dict[str, Any] = {f"single/{name}": value.detach().clone() for name, value in single.items()}
        for name, module in modules.items():
            tensors |= {f"net/{name}/{k}": v.contiguous() for k, v in module.state_dict().items()}
        for name, optimiser in optimisers.items():
            for i, state in optimiser.state_dict()["state"].items():
                tensors |= {f"optimiser/{name}/{i}/{k}": v.contiguous() for k, v in state.items()}
        _, words, position, _, _ = np.random.get_state()  # noqa: NPY002 - Stable-Baselines3 shuffles and samples with it
        arrays: dict[str, Any] = {
            **{f"batch.{name}": value for name, value in batch.episodes.held().items()},
            "env.returns": self.env._returns, "env.lengths": self.env._lengths, "env.crashed": self.env._crashed,
            "last_obs": model._last_obs, "last_starts": model._last_episode_starts, "numpy": words,
            **{f"held.{name}": value for name, value in self.held().items()},
        }  # fmt: skip
        for name, array in arrays.items():
            whole = np.array(array, order="C")  # torch has no unsigned integers of 32 and 64 bits: keep their bits
            tensors[name] = torch.from_numpy(whole.view(np.uint8) if whole.dtype.kind == "u" and whole.ndim else whole)
        tensors["torch"] = torch.get_rng_state()
        facts = self._facts() | {
            "steps": model.num_timesteps, "numpy_position": int(position), "curve": self.curve, "ended": list(self.ended),
            "counters": {name: int(getattr(model, name)) for name in COUNTERS if hasattr(model, name)},
        }  # fmt: skip
        write_checkpoint(path, save_tensors, tensors, facts)

    def load(self, path: Path) -> None:
        """Continue from a checkpoint; raise InputError when it is damaged or of another run."""
        tensors, facts = open_checkpoint(path, self._facts(), load_tensors)
        try:
            self.env.reset()
            self._restore_model(tensors, facts)
            self._restore_batch(tensors)
            self.restore({name[5:]: tensor.numpy().copy() for name, tensor in tensors.items() if name.startswith("held.")})
            words, position = tensors["numpy"].numpy().view(np.uint32).reshape(624), int(facts["numpy_position"])
            if not 0 <= position <= len(words):  # numpy takes any, and reads behind its words
                raise ValueError(f"numpy_position {position}")
            np.random.set_state(("MT19937", words, position, 0, 0.0))  # noqa: NPY002 - see save
            torch.set_rng_state(tensors["torch"])
            self.curve = facts["curve"]
            self.ended.extend((bool(crashed), float(reward)) for crashed, reward in facts["ended"])
        except (KeyError, ValueError, RuntimeError, TypeError) as error:
            raise InputError("checkpoint", str(path), f"a checkpoint that fits this configuration ({error})") from None

    def _restore_model(self, tensors: dict[str, Any], facts: dict[str, Any]) -> None:
        modules, optimisers, single = self._parts()
        for name, module in modules.items():
            start = f"net/{name}/"
            module.load_state_dict({k[len(start) :]: v for k, v in tensors.items() if k.startswith(start)})
        for name, optimiser in optimisers.items():
            state: dict[int, dict[str, Any]] = {}
            for key, value in tensors.items():
                if key.startswith(f"optimiser/{name}/"):
                    _, _, index, field = key.split("/")
                    state.setdefault(int(index), {})[field] = value
            optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
        with torch.no_grad():
            for name, value in single.items():
                value.copy_(tensors[f"single/{name}"])
        self.model.num_timesteps = facts["steps"]
        for name, count in facts["counters"].items():
            setattr(self.model, name, count)

    def _restore_batch(self, tensors: dict[str, Any]) -> None:
        batch, model = self.env.batch, self.model

        def restored(name: str, like: Array) -> Array:
            raw: Array = tensors[name].numpy()
            raw = raw.view(like.dtype) if like.dtype.kind == "u" else raw
            return raw.reshape(like.shape).copy()

        batch.episodes.put({name: restored(f"batch.{name}", value) for name, value in batch.episodes.held().items()})
        self.env._returns[:] = tensors["env.returns"].numpy()
        self.env._lengths[:] = tensors["env.lengths"].numpy()
        self.env._crashed[:] = tensors["env.crashed"].numpy()
        model._last_obs = tensors["last_obs"].numpy().copy()
        batch.observed = tensors["last_obs"].numpy().copy()
        model._last_episode_starts = tensors["last_starts"].numpy().copy()


class _Reporter(BaseCallback):
    """Counts how episodes end, keeps the curve, writes checkpoints."""

    def __init__(self, learner: StableLearner, report: Callable[[Progress], None], checkpoint: Path | None, every: int) -> None:
        super().__init__()
        self.learner, self.report, self.checkpoint, self.every = learner, report, checkpoint, every
        self.saved, self.before = learner.steps, learner.steps

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if info:
                self.learner.ended.append((info["episode"]["crashed"], info["episode"]["r"]))
        return True

    def _on_rollout_start(self) -> None:  # the update of the last rollout is done
        if self.checkpoint is not None and self.num_timesteps - self.saved >= self.every:
            self.saved = self.num_timesteps
            self.learner.save(self.checkpoint)

    def _on_rollout_end(self) -> None:
        due = self.num_timesteps // self.learner.round > self.before // self.learner.round  # several short rollouts make one round
        self.before = self.num_timesteps
        if not due:
            return
        crash = reward = None
        seat = self.learner.seat
        whole = seat.decisions * self.learner.config.envs
        if self.learner.ended and self.num_timesteps > whole:  # until the first horizon only collisions have ended
            crash, reward = (float(np.mean(column)) for column in zip(*self.learner.ended, strict=True))
            crash = crash if seat.road else None
            self.learner.curve.append({"steps": self.num_timesteps, "seed": self.learner.seed, "crash": crash, "reward": reward})
            if crash is not None:
                self.logger.record("attack/crash_rate", crash)
        self.report(Progress(self.num_timesteps, crash, reward))


def perceptron(*layers: torch.nn.Module) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return weights (i, o) and biases (o,) in float64 of the linear layers among these modules and the modules inside of them."""
    flat = [m for layer in layers for m in layer.modules() if isinstance(m, torch.nn.Linear)]
    weights = tuple(layer.weight.detach().numpy().T.astype(np.float64) for layer in flat)
    return weights, tuple(layer.bias.detach().numpy().astype(np.float64) for layer in flat)


def rest_first(layer: torch.nn.Linear, probability: float, discrete: bool, log_std: float) -> None:
    """Set the first bias of an output layer so that a fresh policy attacks with this probability in a step."""
    p = min(max(probability, 1e-6), 1.0 - 1e-6)
    with torch.no_grad():
        layer.bias[0] = float(np.log((len(layer.bias) - 1) * (1.0 - p) / p)) if discrete else float(ndtri(p) * np.exp(log_std))


# -- learners with a replay buffer


@dataclass(frozen=True)
class OffPolicyConfig:
    """Hyper-parameters of every learner with a replay buffer."""

    name: ClassVar[str]

    envs: Rows = param(128, "environments in the batch: a step of many costs little more than one of few")
    train_freq: Passes = param(1, "steps per environment between updates")
    gradient_steps: Passes = param(16, "gradient steps per update")
    batch_size: Rows = param(128, "samples per gradient step")
    buffer_size: Episodes = param(300_000, "decisions that the replay buffer holds")
    learning_starts: PositiveCount = param(4_000, "decisions before the first update, taken at random")
    learning_rate: Positive = param(3e-3, "step size of Adam")
    n_steps: Passes = param(5, "decisions whose rewards a target sums up before it relies on the critic")
    hidden: tuple[Width, ...] = param((64, 64), "widths of the hidden layers, of the policy and of the critics")
    attack: Probability = param(0.2, "probability that a random action attacks: one that spends the budget at once shows no timing")

    def check(self) -> None:
        """Raise InputError when the fields do not fit each other."""
        if self.buffer_size < self.envs * (self.n_steps + 1):
            least = self.envs * (self.n_steps + 1)
            raise InputError(f"{self.name}.buffer_size", self.buffer_size, f"at least envs x (n_steps + 1) ({least})")
        if self.batch_size < 2:
            raise InputError(f"{self.name}.batch_size", self.batch_size, "at least 2")


class OffPolicyLearner(StableLearner):
    """A learner with a replay buffer. Every end of an episode is one for good: the observation shows the horizon coming."""

    algorithm: ClassVar[Any]
    config: OffPolicyConfig

    def make_model(self, tensorboard: str | None) -> Any:
        config = self.config
        model = self.algorithm(
            "MlpPolicy", self.env, learning_rate=config.learning_rate, buffer_size=config.buffer_size,
            learning_starts=config.learning_starts, batch_size=config.batch_size, gamma=self.gamma, train_freq=config.train_freq,
            gradient_steps=config.gradient_steps, n_steps=config.n_steps, replay_buffer_kwargs={"handle_timeout_termination": False},
            policy_kwargs={"net_arch": list(config.hidden), "activation_fn": torch.nn.Tanh, **self.architecture()}, seed=self.seed,
            device="cpu", tensorboard_log=tensorboard, **self.arguments(),
        )  # fmt: skip
        model.explorer = Explorer(self.seat.action, config.attack, self.seed)
        return model

    def arguments(self) -> dict[str, Any]:
        """Return arguments of this algorithm alone."""
        return {}

    def architecture(self) -> dict[str, Any]:
        """Return arguments of its policy alone."""
        return {}

    @property
    def round(self) -> int:
        """A batch of whole episodes."""
        return self.config.envs * self.seat.decisions

    def logging(self) -> dict[str, Any]:
        return {"log_interval": self.config.envs}  # episodes: rows end together

    # -- the buffer and the explorer in a checkpoint

    _STORED: ClassVar[tuple[str, ...]] = ("observations", "next_observations", "actions", "rewards", "dones")

    def held(self) -> dict[str, Array]:
        buffer = self.model.replay_buffer
        rows = buffer.buffer_size if buffer.full else buffer.pos
        state = self.model.explorer.rng.bit_generator.state
        out: dict[str, Array] = {f"buffer.{name}": getattr(buffer, name)[:rows] for name in self._STORED}
        out["buffer.place"] = np.array([buffer.pos, buffer.full], np.int64)
        out["explorer"] = np.frombuffer(json.dumps(state).encode(), np.uint8)
        return out

    def restore(self, arrays: dict[str, Array]) -> None:
        buffer = self.model.replay_buffer
        position, full = (int(number) for number in arrays["buffer.place"])
        buffer.pos, buffer.full = position, bool(full)
        for name in self._STORED:
            getattr(buffer, name)[: buffer.buffer_size if full else position] = arrays[f"buffer.{name}"]
        self.model.explorer.rng.bit_generator.state = json.loads(arrays["explorer"].tobytes())
