"""Adapter for filters that are one object per episode (filterpy, Stone Soup): plays them at their own speed."""

import copy
import dataclasses
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Estimate, Mode, Model, Prior, Received
from tailgate.core.draws import Draws


class EpisodeFilter(Protocol):
    """The filter of one episode that `per_episode` adapts."""

    def reset(self, model: Model, prior: Prior) -> None:
        """Begin an episode of one agent: model.C (1, q, n), prior.mean (n,), prior.cov (n, n)."""

    def step(self, y: Array, valid: Array, u: Array) -> tuple[Array, float]:
        """Return the estimate x (n,) and the score after y (q,), valid (q,) bool and the known input u (inputs,) since the last step."""


@runtime_checkable
class Recalling(EpisodeFilter, Protocol):
    """A filter that can return its memory: one object then plays every episode, and a state is plain numbers.

    Any other is copied whole in every step, so that states stay independent of each other.
    """

    def memory(self) -> tuple[Array, ...]:
        """Return everything that a step changes and needs, as float arrays of fixed shapes."""

    def recall(self, memory: tuple[Array, ...]) -> None:
        """Go on from a memory; the arrays are the filter's own."""


class EpisodePlan(NamedTuple):
    models: tuple[Model, ...]  # model of each agent alone
    players: tuple[Recalling, ...]  # one for each agent; empty where every episode has its own


class EpisodeState(NamedTuple):
    """Either is empty."""

    filters: Array | None  # (B, N) of objects
    memory: tuple[Array, ...]  # (B, N, ...) each


class EpisodeByEpisode:
    """A defence that plays one episode and agent after the other. A subclass makes the filter."""

    untraced = "it plays one episode after the other"  # why the engine leaves it to the plain loop

    def make(self) -> EpisodeFilter:
        """Return a filter, before its first reset."""
        raise TypeError(f"{type(self).__name__} must define make()")

    def prepare(self, model: Model) -> EpisodePlan:
        assert model.gap is not None and model.speed is not None
        rows = [slice(i, i + 1) for i in range(model.agents)]
        models = tuple(
            dataclasses.replace(model, C=model.C[i], R=model.R[i], graph=np.eye(1, dtype=bool), gap=model.gap[i], speed=model.speed[i])
            for i in rows
        )
        made = [self.make() for _ in models]
        return EpisodePlan(models, tuple(player for player in made if isinstance(player, Recalling)))

    def start(self, plan: EpisodePlan, prior: Prior) -> EpisodeState:
        batch, agents, _ = prior.mean.shape
        filters, memory = np.empty((batch, agents), object), _Memory(batch, agents)
        for b, i in np.ndindex(batch, agents):
            played = plan.players[i] if plan.players else self.make()
            played.reset(plan.models[i], Prior(_own(prior.mean[b, i]), _own(prior.cov[b, i])))
            filters[b, i] = played
            if isinstance(played, Recalling):
                memory.put(b, i, played.memory())
        return EpisodeState(None if plan.players else filters, memory.arrays)

    def step(
        self, plan: EpisodePlan, state: EpisodeState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[EpisodeState, Estimate]:
        batch, agents = received.y.shape[:2]
        x, score = num.zeros((batch, agents, plan.models[0].states)), np.zeros((batch, agents))
        filters, memory = np.empty((batch, agents), object), _Memory(batch, agents)
        for b, i in np.ndindex(batch, agents):
            played: EpisodeFilter
            if state.filters is not None:
                copied: EpisodeFilter = copy.deepcopy(state.filters[b, i], _shared(plan.models[i]))  # type: ignore[assignment]
                played = copied
            else:
                played = plan.players[i]
                played.recall(tuple(_own(array[b, i]) for array in state.memory))
            filters[b, i] = played
            x[b, i], score[b, i] = played.step(_own(received.y[b, i]), _own(received.valid[b, i]), _own(known_u[b, i]))
            if state.filters is None:
                memory.put(b, i, plan.players[i].memory())
        quiet = np.zeros_like(score, bool)
        state = EpisodeState(None if state.filters is None else filters, memory.arrays)
        return state, Estimate(x, score, quiet, num.full(score.shape, Mode.NORMAL, np.int8), ~quiet)


class _Memory:
    """Collects the memories of B episodes and N agents."""

    def __init__(self, batch: int, agents: int) -> None:
        self.shape = (batch, agents)
        self.arrays: tuple[Array, ...] = ()

    def put(self, b: int, i: int, memory: tuple[Array, ...]) -> None:
        if not self.arrays:
            self.arrays = tuple(num.zeros((*self.shape, *part.shape)) for part in memory)
        for array, part in zip(self.arrays, memory, strict=True):
            array[b, i] = part


def _own(x: Array) -> Array:
    """Return a copy in one layout whatever the batch: a library may add up in the order of the memory."""
    return np.array(x, order="C")


def _shared(model: Model) -> dict[int, Any]:
    """Return the objects that copies of a filter share: the model, and its read-only matrices."""
    parts = (model, model.A, model.B, model.c, model.C, model.Q, model.R)
    return {id(part): part for part in parts}


@dataclass(frozen=True)
class PerEpisode(EpisodeByEpisode):
    """A defence that keeps one object for every episode and agent: of a class, or of a function without arguments, module:name."""

    factory: str

    def __post_init__(self) -> None:
        factory_of(self.factory)

    def make(self) -> EpisodeFilter:
        made: EpisodeFilter = factory_of(self.factory)()
        return made


def factory_of(name: str) -> Callable[[], Any]:
    """Return the class or function that module:name names. Raise InputError where it names nothing to call."""
    module, _, path = name.partition(":")
    try:
        found: object = importlib.import_module(module)
        for part in path.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError("per_episode", name, f"module:name of a class or function that can be imported ({error})") from None
    if not callable(found):
        raise InputError("per_episode", name, "a class or a function")
    return found


def per_episode(factory: Callable[[], EpisodeFilter] | str) -> PerEpisode:
    """Return a defence from a filter that knows one episode only: its class, a function that makes one, or module:name of either.

    Raises InputError for a function without a name in a module, such as a lambda: no row or card could name it.
    """
    if isinstance(factory, str):
        return PerEpisode(factory)
    name = f"{getattr(factory, '__module__', None)}:{getattr(factory, '__qualname__', '')}"
    try:
        if factory_of(name) is factory:
            return PerEpisode(name)
    except InputError:
        pass
    raise InputError("per_episode", factory, "a class or a function with a name in its module, or module:name; no lambda, no partial")
