"""The search for the scripts that do most harm: generations of genomes, each raced on common episodes.

All scripts of a generation meet the same episodes. Those that do well meet more, and the best of all generations meet fresh ones each
time, so that luck is not believed. The same seed finds the same scripts, whatever the number of processes and the engine.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array, draws
from tailgate.core.draws import Keys
from tailgate.core.loop import Loop
from tailgate.core.registry import Spec
from tailgate.engine.agreement import Untraced
from tailgate.ensemble.battery import Played, battery_of, played_plainly
from tailgate.ensemble.space import GENES, Rows, Space, road_of
from tailgate.evaluation.cells import Cell
from tailgate.play.metrics import METRICS
from tailgate.play.trace import rollout

GRADED = 0.1  # weight of the graded score: it says which of two harmless scripts comes nearer to harm
FIRST, MORE = 16, 48  # episodes of every script of a generation, and more of its best
PROMISING, KEPT = 8, 48  # one in so many scripts is played on more; scripts that are kept
EACH = 8  # scripts of a family that are kept, at most: others may come from behind
FRESH = 0.25  # share of a generation that is drawn at random
CHANGED, STEP = 0.3, 0.08  # probability that a gene is changed, and by how much (standard deviation)
FINALISTS, FINAL = 6, 512  # scripts of the last stage, and its episodes
AT_ONCE = 4096  # episodes of one agent side by side


@dataclass(frozen=True)
class Effort:
    """The size of a search: scripts in a generation, for a system of one agent, and generations."""

    scripts: int
    generations: int


EFFORTS = {"quick": Effort(512, 5), "standard": Effort(2048, 12)}


class Found(NamedTuple):
    """A script with the share of damaged episodes and the mean score in the last stage."""

    script: str
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

    def cell(self, attack: str) -> Cell:
        """Return the cell of an attack here."""
        return Cell(self.suite, self.scenario, self.dose, self.defence, attack, 1, threat=self.threat)

    def _loop(self, attack: str) -> Loop:
        spec, defence = Spec("attack", attack), Spec("defence", self.defence)
        return self.cell(attack).place(spec.make(), spec.entry.knowledge).loop(defence.make(), defence.entry.uses)

    @cached_property
    def loop(self) -> Loop:
        """The loop, with an attacker who knows what the road shows."""
        return self._loop("none")

    @cached_property
    def space(self) -> Space:
        """The scripts that are granted here."""
        none = Spec("attack", "none").make()
        return Space(self.loop.brief, road_of(rollout(self.loop, none, draws.keys("tune", range(FIRST)))))

    @cached_property
    def start(self) -> float:
        """The mean smallest gap at the start of an episode [m]; infinite where nobody drives."""
        scene = self.loop.plant.scene(self.loop.plan.plant, self.loop.start(draws.keys("tune", range(FIRST))).plant)
        return float(np.mean(np.min(np.where(self.loop.model.followers, scene.gap, np.inf), axis=1)))

    def harm(self, played: Played) -> tuple[Array, Array]:
        """Return damage (B,) bool, and how near (B,) each episode came to it, in [0, 1].

        Raises
        ------
        InputError
            If nobody drives and no bound says which error is damage.
        """
        if self.loop.model.followers.any():
            return played.ended, np.clip(1.0 - played.gap / self.start, 0.0, 1.0)
        if self.bound is None:
            raise InputError("suite: bound", None, f"an error that counts as damage: nobody drives in {self.scenario}")
        return played.ended | (played.error > self.bound), np.clip(played.error / self.bound, 0.0, 1.0)

    def scores(self, rows: Rows, first: int, episodes: int) -> Array:
        """Return the sum of scores (scripts,) of each script over the same episodes, from number `first` on."""
        scripts, out = len(rows.kind), []
        keys = draws.keys("tune", range(first, first + episodes))
        each = max(AT_ONCE // (self.loop.model.agents * episodes), 1)
        battery = battery_of(self.loop, rows)
        for begin in range(0, scripts, each):
            some = rows.take(np.arange(begin, min(begin + each, scripts)))
            count = len(some.kind)
            many = Keys(np.tile(keys.key, (count, 1)), np.tile(keys[1], count))
            one = some.take(np.repeat(np.arange(count), episodes))
            played = played_plainly(self.loop, many, one) if isinstance(battery, Untraced) else battery.play(many, one)
            damage, near = self.harm(played)
            out.append((damage + GRADED * near).reshape(count, episodes).sum(axis=1))
        return np.concatenate(out)

    def confirmed(self, script: str, purpose: str, first: int, episodes: int) -> tuple[float, float]:
        """Return the share of damaged episodes and the mean score of a script, as `evaluate` plays it."""
        attack, loop = Spec("attack", script).make(), self._loop(script)
        trace = rollout(loop, attack, draws.keys(purpose, range(first, first + episodes)))
        gap = METRICS["min_gap"](trace) if loop.model.followers.any() else np.full(episodes, np.inf)
        damage, near = self.harm(Played(METRICS["crashed"](trace) > 0, gap, METRICS["max_error"](trace)))
        return float(np.mean(damage)), float(np.mean(damage + GRADED * near))


class Pool(NamedTuple):
    """The best scripts so far: genomes (P, genes), sums of scores (P,), and episodes (P,)."""

    genomes: Array
    total: Array
    episodes: Array

    @property
    def mean(self) -> Array:
        """The mean score of each."""
        return np.asarray(self.total / self.episodes)

    def kept(self, families: int) -> Pool:
        """Return the best scripts, at most EACH of a family and KEPT in all."""
        order = np.argsort(-self.mean, kind="stable")
        family = np.minimum((self.genomes[order, GENES.index("family")] * families).astype(int), families - 1)
        rank = np.array([np.count_nonzero(family[:i] == one) for i, one in enumerate(family)])
        return Pool(*(part[order[rank < EACH][:KEPT]] for part in self))


def _children(pool: Pool, count: int, rng: np.random.Generator) -> Array:
    """Return genomes (count, genes): crossings of two of the pool, the better ones more often, with some genes changed."""
    size = len(pool.genomes)
    mother, father = (np.minimum((rng.random(count) ** 2 * size).astype(int), size - 1) for _ in range(2))
    family = GENES.index("family")
    cross = rng.random((count, len(GENES))) < 0.3
    cross &= (pool.genomes[mother, family] == pool.genomes[father, family])[:, None]
    out = np.where(cross, pool.genomes[father], pool.genomes[mother])
    changed = rng.random(out.shape) < CHANGED
    small = out + STEP * rng.standard_normal(out.shape)
    jump = rng.random(out.shape)
    new = np.where(rng.random(out.shape) < 0.25, jump, np.abs(np.mod(small + 1.0, 2.0) - 1.0))  # reflected at 0 and 1
    changed[:, family] = False
    return np.asarray(np.clip(np.where(changed, new, out), 0.0, np.nextafter(1.0, 0.0)))


def search(arena: Arena, effort: Effort, seed: int = 0, tell: Callable[[int, int, str, float], None] | None = None) -> list[Found]:
    """Search the scripts that do most harm; return those of the last stage, the most harmful first.

    Parameters
    ----------
    arena
        The defence, and where it is attacked.
    seed
        The same seed finds the same scripts.
    tell
        Called after each generation with its number, their count, the best script so far and its mean score.

    Returns
    -------
    list of Found
        Their figures come from episodes of their own, played as `evaluate` plays them. Empty where the threat model grants no script.
    """
    space = arena.space
    if not space.families:
        return []
    rng = np.random.default_rng([seed, zlib.crc32(f"{arena.scenario}/{arena.dose}/{arena.defence}".encode())])
    count, families = max(effort.scripts // arena.loop.model.agents, 64), len(space.families)
    pool, family, episode = Pool(np.zeros((0, len(GENES))), np.zeros(0), np.zeros(0)), GENES.index("family"), 0
    for generation in range(effort.generations):
        fresh = rng.random((count if not generation else int(FRESH * count), len(GENES)))
        fresh[:, family] = (np.arange(len(fresh)) % families + 0.5) / families  # every family alike
        genomes = np.concatenate([fresh, _children(pool, count - len(fresh), rng)]) if generation else fresh
        total = arena.scores(space.rows(genomes), episode, FIRST)
        best = np.argsort(-total, kind="stable")[: max(count // PROMISING, KEPT)]
        joined = np.concatenate([pool.genomes, genomes[best]])
        again = arena.scores(space.rows(joined), episode + FIRST, MORE)
        sums = np.concatenate([pool.total, total[best]]) + again
        pool = Pool(joined, sums, np.concatenate([pool.episodes, np.full(len(best), FIRST)]) + MORE).kept(families)
        episode += FIRST + MORE
        if tell is not None:
            tell(generation + 1, effort.generations, space.text(pool.genomes[0]), float(pool.mean[0]))
    scripts = list(dict.fromkeys(space.text(genome) for genome in pool.genomes))[:FINALISTS]
    found = [Found(script, *arena.confirmed(script, "select", 0, FINAL), FINAL) for script in scripts]
    return sorted(found, key=lambda one: -one.score)
