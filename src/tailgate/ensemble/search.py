"""The search for the scripts that do most harm: generations of genomes, each raced on common episodes.

All scripts of a generation meet the same episodes. Those that do well meet more, and the best of all generations meet fresh ones each
time, so that luck is not believed. The same seed finds the same scripts, whatever the number of processes and the engine.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Attack, draws
from tailgate.core.draws import Keys, Role
from tailgate.core.loop import Loop
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.engine.agreement import ROWS, Untraced
from tailgate.ensemble.battery import Decider, Episodes, Played, Scripts, battery_of, played_plainly, remembered
from tailgate.ensemble.feedbacks import Feedbacks
from tailgate.ensemble.ghosts import Ghosts
from tailgate.ensemble.points import Numbers
from tailgate.ensemble.programs import Programs
from tailgate.ensemble.segments import Lines
from tailgate.ensemble.space import Sequence, Space, road_of
from tailgate.evaluation.cells import Cell
from tailgate.play.metrics import METRICS
from tailgate.play.trace import rollout

GRADED = 0.1  # weight of the graded score: it says which of two harmless scripts comes nearer to harm
CLOSE, SHAPED = 6.0, 3.0  # gap that is near to a collision [m]; weight of being near in what a learner is paid
FIRST, MORE = 16, 48  # episodes of every script of a generation, and more of its best
PROMISING, KEPT = 8, 48  # one script in PROMISING meets more episodes; scripts that are kept
EACH = 8  # scripts of a family that are kept, at most: others may come from behind
FRESH = 0.25  # share of a generation that is drawn at random
CHANGED, STEP = 0.3, 0.08  # probability that a gene is changed, and by how much (standard deviation)
FINALISTS, FINAL = 8, 512  # scripts of the last stage, and its episodes
TRIED, LISTED = 128, 4  # select episodes of every attack that is not searched; those that are played on as many as the finalists
AT_ONCE = 4096  # episodes of one agent side by side


@dataclass(frozen=True)
class Effort:
    """The size of a search of scripts: scripts in a generation, for a system of one agent, and generations."""

    scripts: int
    generations: int

    def sizes(self, agents: int) -> tuple[int, int, int]:
        """Return, for a system of this size: scripts in a generation, those that meet more episodes, and those that are kept."""
        count, kept = max(self.scripts // agents, 64), max(KEPT // agents, EACH)
        return count, max(count // PROMISING, kept), kept

    def episodes(self, agents: int) -> int:
        """Return the episodes that a search plays."""
        count, more, kept = self.sizes(agents)
        return self.generations * (count * FIRST + (more + kept) * MORE)


Tell = Callable[[int, int, str, float], None]  # generation, their count, the best attack so far, and its mean score


class Found(NamedTuple):
    """An attack with the share of damaged episodes and the mean score in the last stage."""

    attack: str
    damage: float
    score: float
    episodes: int


@dataclass(frozen=True)
class Arena:
    """The place of a search: a defence in a scenario at a dose, under a suite's threat model."""

    suite: str
    scenario: str
    dose: int | None
    defence: str
    threat: dict[str, Any]
    bound: float | None  # error that counts as damage where nobody drives
    progress: float | None = None  # share of its clean distance below which a car counts as damaged; None: never

    @cached_property
    def name(self) -> str:
        """The name of the scenario, which its rows carry; `scenario` may be a file."""
        return load_scenario(self.scenario).name

    def cell(self, attack: str) -> Cell:
        """Return the cell of an attack here."""
        return Cell(self.suite, self.scenario, self.dose, self.defence, attack, 1, threat=self.threat)

    def seat(self, knowledge: str, attack: Attack | None = None) -> Loop:
        """Return the loop for attacks of this knowledge, or for one that says itself what it has to see."""
        if attack is None and knowledge in self._seats:
            return self._seats[knowledge]
        defence = Spec("defence", self.defence)
        none: Attack = Spec("attack", "none").make()
        loop = self.cell("none").place(none if attack is None else attack, knowledge).loop(defence.make(), defence.entry.uses)
        if attack is None:
            self._seats[knowledge] = loop
        return loop

    @cached_property
    def _seats(self) -> dict[str, Loop]:
        return {}

    @cached_property
    def loop(self) -> Loop:
        """The loop, with an attacker who knows what the road shows."""
        return self.seat("black")

    @cached_property
    def traced(self) -> bool:
        """If the engine traces the defence."""
        none: Attack = Spec("attack", "none").make()
        return not isinstance(battery_of(self.loop, none, none.prepare(self.loop.brief), None), Untraced)

    @cached_property
    def space(self) -> Space:
        """The scripts that are granted here."""
        none = Spec("attack", "none").make()
        return Space(self.loop.brief, road_of(rollout(self.loop, none, draws.keys("tune", range(FIRST)))))

    @cached_property
    def programs(self) -> Programs:
        """The programs of two phases that are granted here."""
        return Programs(Space(self.space.brief, self.space.road, phase=True))

    @cached_property
    def feedbacks(self) -> Feedbacks:
        """The values that follow the road that are granted here."""
        return Feedbacks(self.space)

    @cached_property
    def segments(self) -> Lines:
        """The lies in segments that are granted here."""
        return Lines(self.space)

    @cached_property
    def ghosts(self) -> Ghosts:
        """The ghosts that are granted here."""
        return Ghosts(self.space)

    @cached_property
    def start(self) -> float:
        """The mean smallest gap at the start of an episode [m]; infinite where nobody drives."""
        scene = self.loop.plant.scene(self.loop.plan.plant, self.loop.start(draws.keys("tune", range(FIRST))).plant)
        return float(np.mean(np.min(np.where(self.loop.model.followers, scene.gap, np.inf), axis=1)))

    @cached_property
    def _reached(self) -> dict[tuple[str, int, int], Array]:
        return {}

    def reach(self, purpose: str, first: int, episodes: int) -> Array | None:
        """Return the distances (episodes,) of the clean runs that episodes are judged by [m]; None where lost progress does not count."""
        if self.progress is None or not self.loop.model.followers.any():
            return None
        at = purpose, first, episodes
        if at not in self._reached:
            none: Attack = Spec("attack", "none").make()
            plan, keys = none.prepare(self.loop.brief), draws.keys(purpose, range(first, first + episodes))
            battery = battery_of(self.loop, none, plan, None)
            clean = played_plainly(self.loop, none, plan, keys, None) if isinstance(battery, Untraced) else battery.play(keys, None)
            self._reached[at] = clean.moved
        return self._reached[at]

    def harm(self, played: Played, reach: Array | None = None) -> tuple[Array, Array]:
        """Return damage (B,) bool, and how near (B,) each episode came to it, in [0, 1].

        Parameters
        ----------
        reach
            Distances (B,) of the clean runs, where lost progress counts (`reach`).

        Raises
        ------
        InputError
            If nobody drives and no bound says which error is damage.
        """
        if self.loop.model.followers.any():
            stalled, slowed = self._stalled(played, reach)
            return played.ended | np.isneginf(played.gap) | stalled, np.maximum(np.clip(1.0 - played.gap / self.start, 0.0, 1.0), slowed)
        if self.bound is None:
            raise InputError("suite: bound", None, f"an error that counts as damage: nobody drives in {self.scenario}")
        return played.ended | (played.error > self.bound), np.clip(played.error / self.bound, 0.0, 1.0)

    def _stalled(self, played: Played, reach: Array | None) -> tuple[Array, Array]:
        """Return if episodes (B,) lost too much progress, and how near (B,) each came to that, in [0, 1]."""
        if reach is None or self.progress is None:
            return np.zeros(len(played.gap), bool), np.zeros(len(played.gap))
        lost = 1.0 - played.moved / np.maximum(reach, 1e-9)
        return played.moved < self.progress * reach, np.clip(lost / (1.0 - self.progress), 0.0, 1.0)

    def scores(self, scripts: Sequence | Numbers, first: int, episodes: int) -> Array:
        """Return the sum of scores (scripts,) of each script over the same episodes, from number `first` on."""
        loop, agents, total = self.loop, self.loop.model.agents, len(scripts[-1])
        keys = draws.keys("tune", range(first, first + episodes))
        each, reach = max(AT_ONCE // (agents * episodes), 1), self.reach("tune", first, episodes)
        attack, few = at_start(scripts.take(np.arange(ROWS) % total), agents)
        battery = battery_of(loop, attack, loop.brief, few)
        out = []
        for begin in range(0, total, each):
            some = np.arange(begin, min(begin + each, total))
            many = Keys(np.tile(keys.key, (len(some), 1)), np.tile(keys[1], len(some)))
            _, memory = at_start(scripts.take(np.repeat(some, episodes)), agents)
            if isinstance(battery, Untraced):
                played = played_plainly(loop, attack, loop.brief, many, memory)
            else:
                played = battery.play(many, memory)
            judged = self.score(played, None if reach is None else np.tile(reach, len(some)))
            out.append(judged.reshape(len(some), episodes).sum(axis=1))
        return np.concatenate(out)

    def speed(self) -> float:
        """Return the episodes of scripts that this machine plays in a second, of one process."""
        scripts = self.space.scripts(np.zeros((ROWS, self.space.genes)))
        self.scores(scripts, 0, FIRST)  # compiles
        begun = time.perf_counter()
        self.scores(scripts, 0, FIRST)
        return ROWS * FIRST / (time.perf_counter() - begun)

    def score(self, played: Played, reach: Array | None = None) -> Array:
        """Return the score (B,) of episodes: 1 for damage, and a little for coming near to it."""
        damage, near = self.harm(played, reach)
        return np.asarray(damage + GRADED * near)

    def payment(self, played: Played, reach: Array | None = None) -> Array:
        """Return what a learner is paid (B,) for episodes: its score, and more the nearer each came to damage.

        Damage alone says little of a small change of a policy; a gap that shrinks says it before there is a collision.
        """
        damage, near = self.harm(played, reach)
        if self.loop.model.followers.any():
            near = np.maximum(np.exp(-np.maximum(played.gap, 0.0) / CLOSE), self._stalled(played, reach)[1])
        return np.asarray(damage + SHAPED * near)

    def outcome(self, text: str, purpose: str, first: int, episodes: int) -> tuple[Played, Array | None]:
        """Return the outcome of an attack (episodes,), as `evaluate` plays it, and the distances that it is judged by (`reach`)."""
        spec = Spec("attack", text)
        attack = spec.make()
        loop, keys = self.seat(spec.entry.knowledge, attack), draws.keys(purpose, range(first, first + episodes))
        played = _whole(loop, attack, keys) or _stepwise(loop, attack, keys)
        return played, self.reach(purpose, first, episodes)

    def confirmed(self, text: str, purpose: str, first: int, episodes: int) -> tuple[float, float]:
        """Return the share of damaged episodes and the mean score of an attack, as `evaluate` plays it."""
        outcome = self.outcome(text, purpose, first, episodes)
        return float(np.mean(self.harm(*outcome)[0])), float(np.mean(self.score(*outcome)))

    def promising(self, texts: Iterable[str], count: int = LISTED) -> list[str]:
        """Return the attacks that did most harm on some select episodes; those without a meaning here are left out."""
        tried = {}
        for text in dict.fromkeys(texts):
            spec = Spec("attack", text)
            try:
                attack = spec.make()
                attack.prepare(self.seat(spec.entry.knowledge, attack).brief)
            except NotApplicable:
                continue
            try:
                tried[text] = self.confirmed(text, "select", 0, min(TRIED, FINAL))[1]
            except NotApplicable as error:  # some attacks find out only when they look at the defence; its own errors end the search
                if not error.field.startswith("attack "):
                    raise
        return sorted(tried, key=lambda one: -tried[one])[:count]

    def best(self, texts: Iterable[str]) -> list[Found]:
        """Return attacks after the last stage, on select episodes that they all meet, the most harmful first."""
        found = [Found(text, *self.confirmed(text, "select", 0, FINAL), FINAL) for text in dict.fromkeys(texts)]
        return sorted(found, key=lambda one: -one.score)


def at_start(scripts: Sequence | Numbers, agents: int) -> tuple[Decider, object]:
    """Return the attack that plays scripts, and its memory at the start of their episodes."""
    if isinstance(scripts, Sequence):
        return Scripts(len(scripts.phases) > 1), remembered(scripts, agents)
    return scripts.decider, scripts.remembered()


def _whole(loop: Loop, attack: Attack, keys: Keys) -> Played | None:
    """Return the outcome of whole episodes in one program; None where the engine does not trace the attack, or a demand is broken."""
    plan = attack.prepare(loop.brief)

    def memory(keys: Keys) -> object:
        return attack.start(plan, len(keys.key), keys.at(Role.ATTACK, np.zeros(len(keys.key), np.int64)))

    battery = battery_of(loop, attack, plan, memory(draws.keys("tune", range(ROWS))))
    if isinstance(battery, Untraced):
        return None
    episodes = Episodes(battery, keys, memory(keys))
    played = episodes.play(battery.values)
    if episodes.broken:
        return None
    first = loop.plant.scene(loop.plan.plant, loop.start(keys).plant).gap  # which the metric counts too
    return played._replace(gap=np.minimum(played.gap, np.min(np.where(loop.model.followers, first, np.inf), axis=1)))


def _stepwise(loop: Loop, attack: Attack, keys: Keys) -> Played:
    """Return the outcome of episodes from their trace."""
    trace = rollout(loop, attack, keys)
    gap = METRICS["min_gap"](trace) if loop.model.followers.any() else np.full(len(keys.key), np.inf)
    return Played(METRICS["crashed"](trace) > 0, gap, *(METRICS[name](trace) for name in ("max_error", "distance_travelled")))


class Meaningless(NotApplicable):
    """A member of the ensemble has nothing to do under a threat model, whatever the defence does."""


class Pool(NamedTuple):
    """The best scripts so far: genomes (P, genes), sums of scores (P,), and episodes (P,)."""

    genomes: Array
    total: Array
    episodes: Array

    @property
    def mean(self) -> Array:
        """The mean score of each."""
        return np.asarray(self.total / self.episodes)

    def kept(self, leads: list[int], families: int, most: int) -> Pool:
        """Return the best attacks, at most EACH of the same families and `most` in all."""
        order = np.argsort(-self.mean, kind="stable")
        family = np.minimum((self.genomes[order][:, leads] * families).astype(int), families - 1)
        rank = np.array([np.count_nonzero((family[:i] == one).all(axis=1)) for i, one in enumerate(family)])
        return Pool(*(part[order[rank < EACH][:most]] for part in self))


def _children(pool: Pool, count: int, leads: list[int], rng: np.random.Generator) -> Array:
    """Return genomes (count, genes): crossings of two of the pool, the better ones more often, with some genes changed."""
    size = len(pool.genomes)
    mother, father = (np.minimum((rng.random(count) ** 2 * size).astype(int), size - 1) for _ in range(2))
    cross = rng.random((count, pool.genomes.shape[1])) < 0.3
    cross &= (pool.genomes[mother][:, leads] == pool.genomes[father][:, leads]).all(axis=1)[:, None]
    out = np.where(cross, pool.genomes[father], pool.genomes[mother])
    changed = rng.random(out.shape) < CHANGED
    small = out + STEP * rng.standard_normal(out.shape)
    jump = rng.random(out.shape)
    new = np.where(rng.random(out.shape) < 0.25, jump, np.abs(np.mod(small + 1.0, 2.0) - 1.0))  # reflected at 0 and 1
    changed[:, leads] = False
    return np.asarray(np.clip(np.where(changed, new, out), 0.0, np.nextafter(1.0, 0.0)))


def search(
    arena: Arena, space: Space | Programs, effort: Effort, seed: int = 0, *, first: Array | None = None, tell: Tell | None = None
) -> Array:  # fmt: skip
    """Search the attacks of a space that do most harm.

    Parameters
    ----------
    arena
        The defence, and where it is attacked.
    space
        Scripts or programs.
    seed
        The same seed finds the same attacks.
    first
        Genomes (P, genes) that join the first generation.
    tell
        Called after each generation with its number, their count, the best attack so far and its mean score.

    Returns
    -------
    Array
        Genomes (P, genes), the most harmful first. Empty where the threat model grants none.
    """
    leads, families, genes = list(space.leads), len(space.families), space.genes
    if not families:
        return np.zeros((0, genes))
    rng = np.random.default_rng([seed, zlib.crc32(f"{arena.name}/{arena.dose}/{arena.defence}".encode()), genes])
    count, more, most = effort.sizes(arena.loop.model.agents)
    pool, episode = Pool(np.zeros((0, genes)), np.zeros(0), np.zeros(0)), 0
    for generation in range(effort.generations):
        fresh = rng.random((count if not generation else int(FRESH * count), genes))
        for place, lead in enumerate(leads):  # every family alike, and every pair
            fresh[:, lead] = (np.arange(len(fresh)) // families**place % families + 0.5) / families
        others = _children(pool, count - len(fresh), leads, rng) if generation else np.zeros((0, genes)) if first is None else first
        genomes = np.concatenate([fresh, others])
        total = arena.scores(space.scripts(genomes), episode, FIRST)
        best = np.argsort(-total, kind="stable")[:more]
        joined = np.concatenate([pool.genomes, genomes[best]])
        again = arena.scores(space.scripts(joined), episode + FIRST, MORE)
        sums = np.concatenate([pool.total, total[best]]) + again
        pool = Pool(joined, sums, np.concatenate([pool.episodes, np.full(len(best), FIRST)]) + MORE).kept(leads, families, most)
        episode += FIRST + MORE
        if tell is not None:
            tell(generation + 1, effort.generations, space.label(pool.genomes[0]), float(pool.mean[0]))
    return pool.genomes
