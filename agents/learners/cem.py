"""The cross-entropy method (Rubinstein 1999) on the weights of a small policy: no gradient, no torch.

A generation draws `population` weight vectors from a normal distribution with a diagonal covariance. It plays each of them on the same
`episodes` fresh episodes. Then it moves the distribution to the best of them:

    mean+ = mean + a (mean of the elite - mean)        sd+^2 = variance of the elite + extra^2

where `extra` falls to 0 over the first generations (Szita and Lorincz 2006), so that the search does not narrow too early. Member 0 is the
mean itself. All members of a generation meet the same episodes; only the policy differs.

A search may end in one of several places. So `starts` searches are begun, each for `trial` generations on the same episodes; the one
whose mean did best goes on.

Random numbers are a function of (seed, generation, start), so that a resumed run gives the policy of an uninterrupted one.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors
from threadpoolctl import threadpool_limits

from tailgate.agents.learners.learning import CONTINUOUS, DISCRETE, SEED_STRIDE, Progress, header_of, open_checkpoint, write_checkpoint
from tailgate.agents.learners.teacher import Demonstration
from tailgate.agents.policy.network_policy import save_policy
from tailgate.base.errors import InputError
from tailgate.base.sizes import Passes, Rows, Width
from tailgate.core import Array, NonNegative, Positive, PositiveCount, Probability, draws, param
from tailgate.core.neural import Network
from tailgate.core.registry import register
from tailgate.core.schema import canonical
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.batches import framed, side_by_side

IMITATION_ROUNDS, IMITATION_BATCH, IMITATION_RATE = 400, 4096, 0.03
STILL = 1e-6  # standard deviation below which an observation does not change
FORMAT = "tailgate-cem-checkpoint-2"
Share = Annotated[float, Field(gt=0, le=1)]


@dataclass(frozen=True)
class Config:
    """Hyper-parameters of the cross-entropy method, tuned on training seeds of the preset `gusty`."""

    population: Rows = param(128, "policies in a generation")
    episodes: Rows = param(24, "episodes that each policy of a generation plays, the same for all")
    elite: Share = param(0.125, "share of a generation that the next one is made of [-]")
    step: Share = param(0.7, "how far the mean moves to that of the elite [-]")
    sd: Positive = param(1.0, "standard deviation of the first generation's weights [-]")
    extra: NonNegative = param(0.1, "extra standard deviation of the first generations [-]")
    extra_until: PositiveCount = param(200, "generations until the extra has fallen to 0")
    starts: Passes = param(1, "searches that are begun, of which the best goes on")
    trial: Passes = param(10, "generations that each of several starts is tried for")
    hidden: tuple[Width, ...] = param((16,), "widths of the hidden layers")
    rest: Probability = param(0.5, "bias of the first mean towards rest: the probability of it that a softmax would give")

    @property
    def elites(self) -> int:
        return max(2, round(self.elite * self.population))

    def check(self) -> None:
        """Raise InputError when the fields do not fit each other."""
        if self.elites > self.population:
            raise InputError("cem.population", self.population, "at least 2 policies")


class Shape(NamedTuple):
    """The places of each layer's weights and biases in a weight vector."""

    sizes: tuple[tuple[int, int], ...]

    @property
    def length(self) -> int:
        return sum((i + 1) * o for i, o in self.sizes)

    def layers(self, theta: Array) -> list[tuple[Array, Array]]:
        """Return (..., length) as weights (..., i, o) and biases (..., o)."""
        out, at = [], 0
        for i, o in self.sizes:
            weight = theta[..., at : at + i * o].reshape(*theta.shape[:-1], i, o)
            out.append((weight, theta[..., at + i * o : at + (i + 1) * o]))
            at += (i + 1) * o
        return out


class Trial(NamedTuple):
    """A start after its trial: its number, the distribution, and the gain of its mean in the last third of the generations."""

    start: int
    mean: Array
    sd: Array
    score: float


class Search:
    """The method, for any policy: a subclass chooses the game. `lean`: an output of the first mean, and its bias."""

    def __init__(self, seed: int, gamma: float, config: Config, sizes: tuple[int, ...], lean: tuple[int, float]) -> None:
        self.seed, self.config = seed, config
        self.identity = hashlib.blake2b(canonical([config, gamma]).encode(), digest_size=8).hexdigest()
        self.shape = Shape(tuple(itertools.pairwise(sizes)))
        self.mean, self.sd = np.zeros(self.shape.length), np.full(self.shape.length, config.sd)
        self.mean[self.shape.length - sizes[-1] + lean[0]] = lean[1]
        self.generation, self.steps = 0, 0
        self.curve: list[dict[str, Any]] = []
        self.start, self.tried = 0, 0 if config.starts > 1 else 1
        self.best: Trial | None = None
        self._first: Array | None = None

    @property
    def card(self) -> str:
        """Hash of what is played: a checkpoint goes with it."""
        raise TypeError(f"{type(self).__name__} must define card")

    @property
    def road(self) -> bool:
        """True if somebody can collide."""
        raise TypeError(f"{type(self).__name__} must define road")

    def episodes(self, layers: list[tuple[Array, Array]], members: int, keys: draws.Keys) -> tuple[Array, Array]:
        """Return reward and collision, (members x E,) each, of the policies in `layers` (members, ...) on the episodes of `keys`."""
        raise TypeError(f"{type(self).__name__} must define episodes()")

    def learn(self, steps: int, report: Callable[[Progress], None], checkpoint: Path | None = None, every: int = 1_000_000) -> None:
        """Train until at least `steps` decisions in total, and every start has been tried.

        Calls `report` after each generation, and writes a checkpoint: it is small.
        """
        while self.steps < steps or self.tried < self.config.starts:
            now = self._generation()
            if self.tried < self.config.starts and self.generation == self.config.trial:
                self._next()
            report(now)
            if checkpoint is not None:
                self.save(checkpoint)

    @property
    def network(self) -> Network:
        """The policy of the mean."""
        weights, biases = zip(*self.shape.layers(self.mean), strict=True)
        return Network(weights, biases)

    def close(self) -> None:
        """Do nothing: no resource is held."""

    # -- one generation

    def _generation(self) -> Progress:
        config = self.config
        if self.generation == 0 and self.start == 0:
            self._first = self.mean
        rng = np.random.default_rng([self.seed, self.generation, self.start] if self.start else [self.seed, self.generation])
        theta = self.mean + self.sd * rng.standard_normal((config.population, self.shape.length))
        theta[0] = self.mean
        reward, crashed = self._play(theta)
        order = np.argsort(-reward, kind="stable")[: config.elites]
        elite = theta[order]
        left = max(0.0, 1.0 - (self.generation + 1) / config.extra_until)
        self.mean = self.mean + config.step * (elite.mean(axis=0) - self.mean)
        self.sd = np.sqrt(elite.var(axis=0) + (left * config.extra) ** 2)
        self.generation += 1
        crash = float(crashed[0]) if self.road else None
        self.curve.append({"steps": self.steps, "seed": self.seed, "crash": crash, "reward": float(reward[0])})
        return Progress(self.steps, crash, float(reward[0]))

    def _next(self) -> None:
        """End a trial: begin the next start, or go on with the best."""
        assert self._first is not None
        score = float(np.mean([point["reward"] for point in self.curve[-max(self.config.trial // 3, 1) :]]))
        if self.best is None or score > self.best.score:
            self.best = Trial(self.start, self.mean, self.sd, score)
        self.tried += 1
        if self.tried < self.config.starts:
            self.start, self.generation = self.tried, 0
            self.mean, self.sd = self._first, np.full(self.shape.length, self.config.sd)
        else:
            self.start, self.mean, self.sd, _ = self.best

    def _play(self, theta: Array) -> tuple[Array, Array]:
        """Return mean reward and share of collisions, (P,) each, of the weight vectors (P, length) on the generation's episodes."""
        members, episodes = len(theta), self.config.episodes
        first = self.seed * SEED_STRIDE + self.generation * episodes
        keys = draws.keys("train", list(range(first, first + episodes)) * members)
        total, crashed = self.episodes(self.shape.layers(theta), members, keys)
        return total.reshape(members, episodes).mean(axis=1), crashed.reshape(members, episodes).mean(axis=1)

    # -- checkpoints

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        facts = {
            "format": FORMAT, "seed": self.seed, "card": self.card, "learner": self.identity, "steps": self.steps,
            "generation": self.generation, "curve": self.curve, "start": self.start, "tried": self.tried,
        }  # fmt: skip
        tensors = {"mean": self.mean, "sd": self.sd, "first": self.mean if self._first is None else self._first}
        if self.best is not None:
            facts["best"] = [self.best.start, self.best.score]
            tensors |= {"best_mean": self.best.mean, "best_sd": self.best.sd}
        write_checkpoint(path, save_tensors, tensors, facts)

    def load(self, path: Path) -> None:
        """Continue from a checkpoint; raise InputError when it is damaged or of another run."""
        wanted = {"format": FORMAT, "seed": self.seed, "card": self.card, "learner": self.identity}
        tensors, facts = open_checkpoint(path, wanted, load_tensors)
        try:
            held = {name: tensor.reshape(self.mean.shape) for name, tensor in tensors.items()}
            mean, sd, first = held["mean"], held["sd"], held["first"]
            steps, generation, curve = int(facts["steps"]), int(facts["generation"]), list(facts["curve"])
            start, tried = int(facts["start"]), int(facts["tried"])
            number, score = facts.get("best", (0, 0.0))
            best = Trial(int(number), held["best_mean"], held["best_sd"], float(score)) if "best" in facts else None
        except (KeyError, ValueError, TypeError) as error:
            raise InputError("checkpoint", str(path), f"a checkpoint that fits this configuration ({error})") from None
        self.mean, self.sd, self.steps, self.generation, self.curve = mean, sd, steps, generation, curve
        self.start, self.tried, self.best, self._first = start, tried, best, first


def outputs(layers: list[tuple[Array, Array]], observation: Array) -> Array:
    """Return the outputs (P x E, o) of each policy's network, members first, from observations (P, E, d)."""
    x = np.asarray(observation, np.float64)
    for i, (weight, bias) in enumerate(layers):
        x = np.matmul(x, weight) + bias[:, None]
        x = np.tanh(x) if i + 1 < len(layers) else x
    return x.reshape(-1, x.shape[-1])


@register("learner", "cem")
class Learner(Search):
    """One training run of one seed: an attacker in a seat."""

    actions = (*DISCRETE, *CONTINUOUS)
    packages: ClassVar[tuple[str, ...]] = ()

    def __init__(self, seed: int, gamma: float, config: Config, environment: dict[str, Any], tensorboard: Path | None = None) -> None:
        self.seat = Seat.make(gamma=gamma, **environment)
        actions = self.seat.action.size
        sizes = (len(self.seat.observation.names), *config.hidden, actions)
        rest = lean(config.rest, actions) if self.seat.action.discrete else -_inside(config.rest)
        super().__init__(seed, gamma, config, sizes, (0, rest))

    @property
    def card(self) -> str:
        return str(self.seat.card()["hash"])

    @property
    def road(self) -> bool:
        return self.seat.road

    def export(self, path: Path, training: dict[str, Any]) -> Path:
        """Write the policy of the mean as safetensors + JSON."""
        return save_policy(path, self.network, header_of(self.seat, training))

    def imitate(self, shown: Demonstration) -> None:
        """Make the first mean one that decides as shown."""
        self.mean = imitation(self.shape, shown, np.random.default_rng([self.seed, 0, len(shown.action)]))

    def episodes(self, layers: list[tuple[Array, Array]], members: int, keys: draws.Keys) -> tuple[Array, Array]:
        seat, seen = self.seat, None
        play = side_by_side(seat)
        play.begin(keys)
        over = np.zeros(len(keys.key), bool)
        total, crashed, weight = np.zeros(len(keys.key)), np.zeros(len(keys.key), bool), 1.0
        for _ in range(seat.decisions):
            if over.all():
                break
            self.steps += int(np.count_nonzero(~over))
            seen = framed(play.seen(), seen, seat.observation.frames)
            x = outputs(layers, seen.reshape(members, -1, seen.shape[1]))
            action = np.argmax(x, axis=1) if seat.action.discrete else np.clip(x, -1.0, 1.0)
            outcome = play.decide(action, over, restart=False)
            total += weight * outcome.reward
            crashed |= outcome.collided | outcome.rear_collided
            over = over | outcome.terminated
            weight *= seat.reward.gamma
        return total, crashed


def imitation(shape: Shape, shown: Demonstration, rng: np.random.Generator, batch: int = IMITATION_BATCH) -> Array:
    """Return weights (length,) that decide as shown (behaviour cloning: softmax regression through all layers, by Adam).

    Only the largest output counts, so that the scale of the last layer is free. Its root mean square is set to 1: the spread of a first
    generation is then the size of a change relative to it. Each observation is divided by its standard deviation while it learns, so that
    one of small numbers counts as much as the others.
    """
    size = scales(shown.observation)
    theta = rng.standard_normal(shape.length)
    for weight, bias in shape.layers(theta):  # views
        weight /= np.sqrt(len(weight))
        bias[:] = 0.0
    first, second = np.zeros_like(theta), np.zeros_like(theta)
    with threadpool_limits(1, "blas"):  # the order of a sum would follow the number of threads
        for t in range(1, IMITATION_ROUNDS + 1):
            some = rng.integers(0, len(shown.action), batch)
            slope = _slope(shape, theta, shown.observation[some] / size, shown.action[some])
            first, second = 0.9 * first + 0.1 * slope, 0.999 * second + 0.001 * slope**2
            theta -= IMITATION_RATE * (first / (1.0 - 0.9**t)) / (np.sqrt(second / (1.0 - 0.999**t)) + 1e-8)
    shape.layers(theta)[0][0][:] /= size[:, None]
    weight, bias = shape.layers(theta)[-1]
    scale = np.sqrt(np.mean(np.concatenate([weight.ravel(), bias]) ** 2))
    weight /= scale
    bias /= scale
    return theta


def scales(observation: Array) -> Array:
    """Return the standard deviation (d,) of each observation (D, d); 1 for one that does not change."""
    size = np.std(observation.astype(np.float64), axis=0)
    return np.where(size > STILL, size, 1.0)


def _slope(shape: Shape, theta: Array, seen: Array, action: Array) -> Array:
    """Return the gradient (length,) of the mean cross-entropy of the actions (D,) under a softmax of the outputs for seen (D, d)."""
    layers, inputs, out = shape.layers(theta), [seen], np.empty_like(theta)
    for weight, bias in layers[:-1]:
        inputs.append(np.tanh(inputs[-1] @ weight + bias))
    x = inputs[-1] @ layers[-1][0] + layers[-1][1]
    share = np.exp(x - x.max(axis=1, keepdims=True))
    error = share / share.sum(axis=1, keepdims=True)
    error[np.arange(len(action)), action] -= 1.0
    error /= len(action)
    for (weight, bias), (above, _), x in zip(shape.layers(out)[::-1], layers[::-1], inputs[::-1], strict=True):
        weight[:], bias[:] = x.T @ error, error.sum(axis=0)
        error = (error @ above.T) * (1.0 - x**2)
    return out


def lean(probability: float, actions: int) -> float:
    """Return the bias of one of `actions` outputs that gives it this probability in a softmax with all others at 0."""
    p = _inside(probability)
    return float(np.log((actions - 1) * p / (1.0 - p)))


def _inside(probability: float) -> float:
    return min(max(probability, 1e-6), 1.0 - 1e-6)
