"""The search for the least robustness: generations that a sampler of Optuna proposes, each played in one batch.

Each generation meets fresh episodes, and a trial is worth its worst one. Each finished generation may be kept; a search that goes on asks
the sampler again, and compares what it proposes with what was kept.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tailgate.base import sizes, sources
from tailgate.base.errors import InputError, unknown
from tailgate.base.files import write_atomic
from tailgate.base.reading import load_json
from tailgate.core import Array
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.core.schema import as_data, digest
from tailgate.falsify.case import Case
from tailgate.training.tuning import optuna

if TYPE_CHECKING:
    from optuna import Study

SAMPLERS = ("tpe", "cmaes")
GENERATION = 32  # trials
EPISODES = 8  # of each trial
RANDOM = 64  # trials before TPE has a model
FAR = 1e9  # a robustness beyond it counts as this: samplers take finite numbers only
Tell = Callable[[int, int, float], None]  # trials done, of how many, the least robustness


@dataclass(frozen=True)
class Search:
    """A search: the sampler, how many trials, and the seed of what it proposes."""

    case: Case
    sampler: str = "tpe"
    trials: int = 1024
    seed: int = 0

    def __post_init__(self) -> None:
        if self.sampler not in SAMPLERS:
            raise unknown("--sampler", self.sampler, SAMPLERS)
        sizes.check("trials", self.trials, "--trials")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or not 0 <= self.seed < 2**32:
            raise InputError("--seed", self.seed, "a whole number from 0 to 4294967295")

    def check(self) -> None:
        """Check all that could fail later.

        Raises
        ------
        InputError
            For anything that does not exist or has no meaning here.
        ImportError
            For a sampler that is not installed.
        """
        self.case.check()
        _study(self)

    @property
    def digest(self) -> str:
        """A digest of all that decides what is found: the components and the code included."""
        one = self.case
        parts = [Spec("defence", one.defence).digest, Spec("attack", one.attack or "none").digest, load_scenario(one.scenario).config_hash]
        return digest([sources.own(), *parts, as_data(one), self.sampler, self.seed, GENERATION, EPISODES])


class Worst(NamedTuple):
    """The trial of the least robustness: its genome (genes,), its episode's seed, and what the search took."""

    genome: Array
    seed: int
    robustness: float
    trials: int
    episodes: int
    violations: int  # episodes that broke the property


def search(job: Search, out: Path | None = None, tell: Tell | None = None) -> Worst:
    """Search the least robustness.

    Parameters
    ----------
    job
        What is searched. The same job finds the same trial.
    out
        Folder of finished generations; an interrupted search goes on there.
    tell
        Called after each generation.

    Raises
    ------
    InputError
        If the folder holds generations of another search.
    ImportError
        Without Optuna (extra `tune`).
    """
    study, names = _study(job), job.case.genes
    distributions = {name: optuna().distributions.FloatDistribution(0.0, 1.0) for name in names}
    worst, violations = (math.inf, np.zeros(len(names)), 0), 0
    for number, first in enumerate(range(0, job.trials, GENERATION)):
        trials = [study.ask(distributions) for _ in range(min(GENERATION, job.trials - first))]
        genomes = np.array([[trial.params[name] for name in names] for trial in trials]).reshape(len(trials), len(names))
        seeds = _seeds(job, number, len(trials))
        path = None if out is None else out / "generations" / f"{number:05d}.json"
        values = _kept(path, job, genomes)
        if values is None:
            values = np.clip(job.case.robustness(genomes, seeds), -FAR, FAR)
            if path is not None:
                data = {"search": job.digest, "genomes": genomes.tolist(), "robustness": values.tolist()}
                write_atomic(path, json.dumps(data).encode() + b"\n")
        for trial, value in zip(trials, values.min(axis=1).tolist(), strict=True):
            study.tell(trial, value)
        row, episode = np.unravel_index(int(np.argmin(values)), values.shape)
        worst = min(worst, (float(values[row, episode]), genomes[row], int(seeds[row, episode])), key=lambda one: one[0])
        violations += int(np.count_nonzero(values < 0.0))
        if tell is not None:
            tell(first + len(trials), job.trials, worst[0])
    return Worst(worst[1], worst[2], worst[0], job.trials, job.trials * EPISODES, violations)


def _seeds(job: Search, generation: int, trials: int) -> Array:
    """Return the seeds (trials, E) of the episodes of a generation.

    Scripts meet the same episodes, so that they can be compared. Starts of the road matter less than the chance that follows, so each
    start meets other episodes.
    """
    if job.case.attack:
        first = generation * GENERATION * EPISODES
        return np.arange(first, first + trials * EPISODES).reshape(trials, EPISODES)
    return np.repeat(np.arange(generation * EPISODES, (generation + 1) * EPISODES)[None], trials, axis=0)


def _study(job: Search) -> Study:
    """Return a study in memory, with the sampler of the search."""
    module = optuna()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", module.exceptions.ExperimentalWarning)
        if job.sampler == "cmaes":
            chosen: Any = module.samplers.CmaEsSampler(seed=job.seed, popsize=GENERATION, warn_independent_sampling=False)
        else:
            chosen = module.samplers.TPESampler(seed=job.seed, multivariate=True, constant_liar=True, n_startup_trials=RANDOM)
        study: Study = module.create_study(sampler=chosen, direction="minimize")
    return study


def _kept(path: Path | None, job: Search, genomes: Array) -> Array | None:
    """Return the robustness (B, E) of a generation that an earlier run finished."""
    if path is None or not path.is_file():
        return None
    try:
        held = load_json(path)
        same = held["search"] == job.digest and held["genomes"] == genomes.tolist()
        values = np.array(held["robustness"], float)
    except (OSError, ValueError, TypeError, KeyError):
        same, values = False, np.zeros(0)
    if not same or values.shape != (len(genomes), EPISODES) or not np.isfinite(values).all():
        raise InputError("--out", str(path), "a generation of this very search; remove it, or give another folder")
    return values
