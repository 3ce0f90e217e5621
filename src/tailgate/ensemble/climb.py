"""The search among points: random attacks, then CMA-ES (Hansen and Ostermeier 2001) from the best ones."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tailgate.core import Array
from tailgate.ensemble.evolution import SHORTER
from tailgate.ensemble.points import Choice, Point, Points
from tailgate.ensemble.search import FINALISTS, PROMISING, Arena, Tell

if TYPE_CHECKING:
    from cmaes import CMA

SCREENS = 4, 16  # episodes of every random attack, and of the best ones
EPISODES, FEWEST = 32, 64  # of an attack, and of one that is compared in the end, at least
GROUP, STEP = 16, 0.4  # attacks of a run in a round, and their first spread
BEST = 64  # random attacks among which runs begin
LEAST = 2  # runs, at least


class Stage(NamedTuple):
    """Rounds of the runs that did best so far."""

    runs: int
    rounds: int


@dataclass(frozen=True)
class Climb:
    """The size of a search, for a system of one agent."""

    random: int  # attacks
    stages: tuple[Stage, ...]  # of the runs
    ends: int = 48  # attacks that are compared in the end
    again: int = 256  # episodes of each of them

    def sized(self, agents: int, traced: bool = True) -> Climb:
        """Return the search for a system of this size."""
        part = 1 if traced else SHORTER
        stages = (Stage(max(runs // agents, LEAST), max(rounds // part, 1)) for runs, rounds in self.stages)
        ends, again = max(self.ends // agents, FINALISTS), max(self.again // agents, FEWEST)
        return Climb(max(self.random // (agents * part), BEST), tuple(stages), ends, again)

    @property
    def screened(self) -> tuple[int, ...]:
        """The random attacks that each screen leaves."""
        return tuple(max(self.random // PROMISING**i, BEST) for i in range(1, len(SCREENS) + 1))

    @property
    def episodes(self) -> int:
        """The episodes that the search plays."""
        tried = (self.random, *self.screened), (*SCREENS, EPISODES)
        runs = GROUP * sum(runs * rounds for runs, rounds in self.stages)
        return sum(count * each for count, each in zip(*tried, strict=True)) + EPISODES * runs + self.again * self.ends


class Run(NamedTuple):
    """A distribution of the numbers of attacks that have the same choices."""

    choice: Choice
    method: CMA


class Ended(NamedTuple):
    """An attack, and its mean score; the mean of a run has that of the best attack around it."""

    score: float
    point: Point


def climbed(arena: Arena, space: Points, effort: Climb, seed: int = 0, tell: Tell | None = None) -> list[str]:
    """Search the attacks of a space that do most harm; the same seed finds the same.

    Parameters
    ----------
    space
        The attacks, of the arena's threat model.
    effort
        The size of the search, for a system of one agent.
    tell
        Called after each round with its number, their count, the best attack so far and its mean score.

    Returns
    -------
    list of str
        Attacks as on the command line, the most harmful first. Empty where the threat model grants none.
    """
    effort = effort.sized(arena.loop.model.agents, arena.traced)
    if not space.kinds:
        return []
    rng = np.random.default_rng([seed, zlib.crc32(f"{arena.name}/{arena.dose}/{arena.defence}".encode()), 77])
    game, rounds, done = _Game(arena, space), sum(stage.rounds for stage in effort.stages), 0
    points = [space.drawn(rng) for _ in range(effort.random)]
    for episodes, left in zip(SCREENS, effort.screened, strict=True):
        points = [one.point for one in game.tried(points, episodes)[:left]]
    tried = game.tried(points)
    runs, ends = [_run(point, rng) for point in _apart(tried, effort.stages[0].runs)], tried[: effort.ends]
    for stage in effort.stages:
        best = {one.point.choice: one.score for one in reversed(ends)}
        runs = sorted(runs, key=lambda run: -best.get(run.choice, 0.0))[: stage.runs]
        for _ in range(stage.rounds):
            ends = sorted([*ends, *game.moved(runs)], key=lambda one: -one.score)[: effort.ends]
            done += 1
            if tell is not None:
                tell(done, rounds, space.text(ends[0].point), ends[0].score)
    last = game.tried([one.point for one in ends], effort.again)
    return list(dict.fromkeys(space.text(one.point) for one in last))[:FINALISTS]


@dataclass
class _Game:
    """Plays attacks on episodes that the search has not played before."""

    arena: Arena
    space: Points
    episode: int = 0

    def scores(self, points: list[Point], episodes: int) -> Array:
        """Return the mean score (points,) of each attack over the same episodes."""
        first, self.episode = self.episode, self.episode + episodes
        return self.arena.scores(self.space.numbers(points), first, episodes) / episodes

    def tried(self, points: list[Point], episodes: int = EPISODES) -> list[Ended]:
        """Play attacks; return them with their scores, the most harmful first."""
        ended = [Ended(float(score), point) for score, point in zip(self.scores(points, episodes), points, strict=True)]
        return sorted(ended, key=lambda one: -one.score)

    def moved(self, runs: list[Run]) -> list[Ended]:
        """Play the next attacks of runs on the same episodes, and move; return each run's best, and its mean with the same score."""
        asked = [[run.method.ask() for _ in range(GROUP)] for run in runs]
        points = [Point(run.choice, vector) for run, mine in zip(runs, asked, strict=True) for vector in mine]
        paid, out = self.scores(points, EPISODES).reshape(len(runs), GROUP), []
        for run, mine, score in zip(runs, asked, paid, strict=True):
            run.method.tell([(vector, -float(one)) for vector, one in zip(mine, score, strict=True)])
            top = int(np.argmax(score))
            out += [Ended(float(score[top]), Point(run.choice, vector)) for vector in (mine[top], np.array(run.method.mean))]
        return out


def _apart(ends: list[Ended], count: int) -> list[Point]:
    """Return the best attack of each sort, then those that differ in another choice."""
    sorts: dict[tuple[object, ...], Point] = {}
    choices: dict[Choice, Point] = {}
    for _, point in ends:
        sorts.setdefault(point.choice.sort, point)
        choices.setdefault(point.choice, point)
    return list({point.choice: point for point in [*sorts.values(), *choices.values()]}.values())[:count]


def _run(point: Point, rng: np.random.Generator) -> Run:
    """Return a run that begins at an attack."""
    from cmaes import CMA  # imports scipy's statistics

    return Run(point.choice, CMA(mean=point.vector, sigma=STEP, population_size=GROUP, seed=int(rng.integers(1 << 30))))
