"""The search for the script that does most harm: a sampler proposes, and those that do well on a few episodes are played on more.

Scores are means over common episodes: all scripts of a stage meet the same ones. Stages play fresh episodes, so that luck in one is not
believed in the next. The same seed finds the same scripts, on any machine and with any number of processes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, draws
from tailgate.core.registry import Spec
from tailgate.ensemble.space import Family, Road, Space
from tailgate.evaluation.cells import Cell
from tailgate.play.metrics import METRICS
from tailgate.play.trace import Trace, episodes_at_once, rollout

GRADED = 0.1  # weight of the graded score: it says which of two harmless scripts comes nearer to harm
FIRST, SECOND = 32, 128  # episodes of every script, and of one that does well on these
PROMISING = 0.15  # share of the scripts so far that a script must be among to be played on more
FINALISTS, FINAL = 8, 512  # scripts of the last stage, and its episodes
SHARE = 0.4  # of the trials: scripts of a family that are drawn at random before the sampler learns


@dataclass(frozen=True)
class Budget:
    """The size of a search."""

    trials: int  # scripts of each family, in each scenario at each dose


BUDGETS = {"quick": Budget(60), "standard": Budget(300)}


class Found(NamedTuple):
    """A script, and the share of damaged episodes among those of the last stage that it was played on."""

    script: str
    damage: float
    score: float
    episodes: int


class Harm(NamedTuple):
    """The harm (B,) of episodes: damage is 0 or 1; graded lies in [0, 1], and is higher the nearer an episode came to damage."""

    damage: Array
    graded: Array

    @property
    def score(self) -> float:
        """The mean of both, damage first."""
        return float(np.mean(self.damage) + GRADED * np.mean(self.graded))


def harm_of(trace: Trace, bound: float | None) -> Harm:
    """Return the harm of a trace: a collision on a road; without one, an error above `bound`.

    Raises
    ------
    InputError
        If nobody drives and no bound says which error is damage.
    """
    if trace.model.followers.any():
        crashed = METRICS["crashed"](trace)
        gap, start = METRICS["min_gap"](trace), np.min(trace.first["gap"][:, trace.model.followers], axis=1)
        return Harm(crashed, np.clip(1.0 - gap / np.maximum(start, 1.0), 0.0, 1.0))
    if bound is None:
        raise InputError("suite: bound", None, "an error that counts as damage: nobody drives in this scenario")
    error = METRICS["max_error"](trace)
    return Harm((error > bound).astype(float), np.clip(error / bound, 0.0, 1.0))


@dataclass(frozen=True)
class Arena:
    """The place of a search: a defence in a scenario at a dose, under a suite's threat model."""

    suite: str
    scenario: str
    dose: int | None
    defence: str
    threat: dict[str, Any]
    bound: float | None

    def cell(self, attack: str) -> Cell:
        """Return the cell of an attack here."""
        return Cell(self.suite, self.scenario, self.dose, self.defence, attack, 1, threat=self.threat)

    def play(self, attack: str, purpose: str, first: int, count: int) -> Harm:
        """Return the harm of an attack in `count` episodes from number `first` on."""
        spec, defence = Spec("attack", attack), Spec("defence", self.defence)
        made = spec.make()
        loop = self.cell(attack).place(made, spec.entry.knowledge).loop(defence.make(), defence.entry.uses)
        size, parts = episodes_at_once(loop.model, loop.horizon, 256), []
        for start in range(first, first + count, size):
            keys = draws.keys(purpose, range(start, min(start + size, first + count)))
            parts.append(harm_of(rollout(loop, made, keys), self.bound))
        return Harm(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def space(self) -> Space:
        """Return the scripts that are granted here."""
        none = Spec("attack", "none")
        place, defence = self.cell("none").place(none.make(), none.entry.knowledge), Spec("defence", self.defence)
        loop = place.loop(defence.make(), defence.entry.uses)
        return Space(place.brief(), Road.of(rollout(loop, none.make(), draws.keys("tune", range(FIRST)))))


def search(arena: Arena, family: Family, budget: Budget, seed: int = 0, tell: Callable[[int, str, float], None] | None = None) -> list[Found]:
    """Search a family of scripts; return those of the last stage, the most harmful first.

    Parameters
    ----------
    tell : called with trials done, best script so far and its score
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    space = arena.space()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=max(int(SHARE * budget.trials), 1), multivariate=True, group=True)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    scores: dict[str, float] = {}
    for done in range(budget.trials):
        trial = study.ask()
        script = space.script(trial, family)
        try:
            score = scores.get(script)
            if score is None:
                score = arena.play(script, "tune", 0, FIRST).score
                held = sorted(scores.values())
                if len(held) < 4 or score >= held[-max(int(PROMISING * len(held)), 1)]:
                    score = arena.play(script, "tune", FIRST, SECOND).score
            scores[script] = score
            study.tell(trial, score)
        except NotApplicable:
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
        if tell is not None and scores:
            best = max(scores, key=lambda text: scores[text])
            tell(done + 1, best, scores[best])
    final = sorted(scores, key=lambda text: -scores[text])[:FINALISTS]
    held = [(script, arena.play(script, "select", 0, FINAL)) for script in final]
    found = [Found(script, float(np.mean(harm.damage)), harm.score, FINAL) for script, harm in held]
    return sorted(found, key=lambda one: -one.score)
