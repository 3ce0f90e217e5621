"""Attacks as points: choices without neighbours, and a vector of numbers that CMA-ES can move."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from tailgate.core import Array, Kind
from tailgate.core.kinds import AIRED, EFFECTS
from tailgate.core.threat import Brief, receivers
from tailgate.ensemble.battery import Decider
from tailgate.ensemble.space import TRIGGERS, Space

STEEP, INNER = 3.0, 1e-3  # shares are logistic: their steepness, and the least share of a range


class Choice(Protocol):
    """The choices of an attack that have no neighbours."""

    @property
    def kinds(self) -> frozenset[Kind]:
        """The kinds that it may send."""

    @property
    def sort(self) -> tuple[object, ...]:
        """The choices that set attacks apart: of each sort one begins a run."""

    @property
    def wires(self) -> int:
        """Place in `Space.wires`."""

    @property
    def agent(self) -> int | None:
        """None: all that are granted."""

    @property
    def trigger(self) -> int:
        """Place in `Space.triggers`."""


class Point(NamedTuple):
    """An attack: its choices, and its numbers before they are brought into their ranges."""

    choice: Any  # a Choice
    vector: Array


class Numbers(Protocol):
    """The numbers of B attacks."""

    @property
    def decider(self) -> Decider:
        """The attack that plays them, another one in each row."""

    def __getitem__(self, place: int, /) -> Any:
        """Return a field, which has B first."""

    def take(self, places: Array) -> Numbers:
        """Return the attacks at these places."""

    def remembered(self) -> object:
        """Return the memory of the attacks at the start of their episodes."""


class Memory(NamedTuple):
    """The attacks of B episodes and what they remember; every leaf has B first."""

    numbers: Any  # of the attacks
    opened: Array  # (B,) bool: the trigger has fired
    elapsed: Array  # (B,) int64: steps since it first fired
    lead_speed: Array  # (B, N) at the last look; -inf before the first


def at_rest(numbers: object, batch: int, agents: int) -> Memory:
    """Return the memory of attacks at the start of their episodes."""
    count = np.zeros(batch, np.int64)
    return Memory(numbers, count > 0, count, np.full((batch, agents), -np.inf))


@dataclass(frozen=True)
class Points:
    """Attacks of one form that a threat model grants in a scenario."""

    space: Space  # of scripts in the same place

    @property
    def brief(self) -> Brief:
        """The grant of the attacker."""
        return self.space.brief

    @property
    def wires(self) -> tuple[str, ...]:
        """The wires of an agent."""
        return self.brief.model.wires

    def granted(self, kinds: tuple[Kind, ...]) -> tuple[Kind, ...]:
        """Return those that are granted, and have a receiver; none if none of them has a value, or nobody drives."""
        heard = bool(receivers(self.brief).any())
        out = [kind for kind in kinds if kind.name.lower() in self.brief.threat.kinds and (heard or kind not in AIRED)]
        return tuple(out) if any(EFFECTS[kind].valued for kind in out) and self.space.road else ()

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of the attacks; empty: there are none."""
        raise TypeError(f"{type(self).__name__} must define kinds")

    def aim(self, rng: np.random.Generator) -> tuple[int, int | None, int]:
        """Draw wires, agent and trigger of a choice."""
        space = self.space
        wires, agent = int(rng.integers(len(space.wires))), space.agents[int(rng.integers(len(space.agents)))]
        return wires, agent, int(rng.integers(len(space.triggers)))

    def target(self, choice: Choice) -> Array:
        """Return the wires (N, w) bool of a choice."""
        brief, names = self.brief, self.space.wires[choice.wires]
        target = brief.granted & np.array([not names or name in names for name in self.wires])
        if choice.kinds & set(AIRED):
            target = target & receivers(brief) if (target & receivers(brief)).any() else receivers(brief)
        if choice.agent is not None:
            target = target & (np.arange(len(target)) == choice.agent)[:, None]
        return np.asarray(target)

    def opening(self, choice: Choice, when: float) -> tuple[Any, Any, Any]:
        """Return trigger, threshold and first step of a choice; `when` is a share of their range."""
        genes = np.array([(choice.trigger + 0.5) / len(self.space.triggers)]), np.array([when])
        trigger, threshold, start = (part[0] for part in self.space.opening(*genes))
        return trigger, threshold, start

    def words(self, choice: Choice, when: float) -> list[str]:
        """Return the parts of a text that say where and when."""
        out, hit = [], np.asarray(self.target(choice).any(axis=0))
        if (hit != (receivers(self.brief) if choice.kinds & set(AIRED) else self.brief.granted).any(axis=0)).any():
            out.append(f"targets=[{','.join(name for name, on in zip(self.wires, hit, strict=True) if on)}]")
        if choice.agent is not None:
            out.append(f"agents=[{choice.agent}]")
        trigger, threshold, start = self.opening(choice, when)
        name = TRIGGERS[int(trigger)]
        return [*out, f"start_step={start}" if name == "time" else f"trigger={name},threshold={threshold!s}"]

    def drawn(self, rng: np.random.Generator) -> Point:
        """Return an attack at random."""
        raise TypeError(f"{type(self).__name__} must define drawn()")

    def numbers(self, points: list[Point]) -> Numbers:
        """Return the numbers of attacks."""
        raise TypeError(f"{type(self).__name__} must define numbers()")

    def text(self, point: Point) -> str:
        """Return the text of one attack, as on the command line."""
        raise TypeError(f"{type(self).__name__} must define text()")


def shares_of(vector: Array) -> list[float]:
    """Return shares in (0, 1) of numbers."""
    out: list[float] = (1.0 / (1.0 + np.exp(-STEEP * vector))).tolist()
    return out


def vector_of(shares: Array) -> Array:
    """Return the numbers of shares in [0, 1]."""
    inner = np.clip(shares, INNER, 1.0 - INNER)
    return np.asarray(np.log(inner / (1.0 - inner)) / STEEP)
