"""One cell of model checking: a defence against an attack in a scenario, many seeds, and of each the truth of every property.

Seeds are those of an evaluation: a seed is the same world for every defence, so that their outcomes are paired.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from tailgate.core import Array, Attack, draws
from tailgate.core.loop import Loop
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.core.schema import canonical
from tailgate.evaluation.cells import Cell, _head, _why, cell_id
from tailgate.evaluation.rows import CLEAN
from tailgate.play.trace import Trace, episodes_at_once, rollout

from .false_alarms import DETECTS, false_alarms
from .informs import INFORMS, Informed, informed, twin_alarms
from .logic import Eventually, Interval, along, holds, robustness
from .properties import CONJUNCTIONS, Demands, Property, built_in, conjunctions, own
from .signals import SafeDistance, sample
from .statistics import Rule

Row = dict[str, Any]


@dataclass(frozen=True)
class Job:
    """A cell and what is asked of it: a user's formulas, or, of none, the built-in properties. `rule` stops it before its last seed."""

    cell: Cell
    formulas: tuple[str, ...] = ()
    bound: float | None = None
    safe: SafeDistance = field(default_factory=SafeDistance)
    asked: Demands = field(default_factory=Demands)
    rule: Rule | None = None

    @cached_property
    def identity(self) -> str:
        """A digest of everything that decides the row."""
        known = [[p.name, str(p.formula), str(p.trigger), p.until] for p in self.properties(load_scenario(self.cell.scenario))]
        rest = [known, self.safe, self.rule, *(["false alarms"] if self.cell.attack == CLEAN and not self.formulas else [])]
        return hashlib.blake2b(f"{cell_id(self.cell)}/{canonical(rest)}".encode(), digest_size=12).hexdigest()

    def properties(self, scenario: Scenario) -> tuple[Property, ...]:
        return own(scenario, self.formulas) if self.formulas else built_in(scenario, self.bound, self.asked)


class Outcome(NamedTuple):
    """A property in B runs."""

    holds: Array  # (B,) bool
    robustness: Array  # (B,)
    asked: Array  # (B,) bool: its antecedent held at some time; of one without, True
    instants: Array  # (B,) steps at which it held
    steps: Array  # (B,) steps of the run


def outcome(known: Property, trace: Trace, safe: SafeDistance) -> Outcome:
    """Return a property with a formula, in every run of a trace."""
    assert known.formula is not None
    samples = sample(trace, known.signals, safe)
    asked, instants = np.ones(trace.batch, bool), np.zeros(trace.batch, np.int64)
    if known.trigger is not None:
        asked = holds(Eventually(known.trigger, Interval(0.0, known.until)), samples)
        instants = np.count_nonzero(along(known.trigger, samples) & samples.live, axis=0)
    return Outcome(holds(known.formula, samples), robustness(known.formula, samples), asked, instants, trace.length)


@dataclass
class Tally:
    """A property after n runs, which are not kept."""

    n: int = 0
    k: int = 0  # runs that hold
    asked: int = 0
    answered: int = 0  # of those asked the ones that hold
    instants: int = 0
    steps: int = 0
    least: float = math.inf  # robustness, and the run that has it
    least_run: int = 0
    failing: float = math.inf  # the least of those that fail
    failing_run: int | None = None

    def add(self, found: Outcome) -> None:
        """Add the next runs."""
        worst = np.where(found.holds, np.inf, found.robustness)
        low, lost = int(np.argmin(found.robustness)), int(np.argmin(worst))
        if found.robustness[low] < self.least:
            self.least, self.least_run = float(found.robustness[low]), self.n + low
        if not found.holds.all() and (self.failing_run is None or worst[lost] < self.failing):
            self.failing, self.failing_run = float(worst[lost]), self.n + lost
        self.n, self.k, self.asked = self.n + len(found.holds), self.k + int(found.holds.sum()), self.asked + int(found.asked.sum())
        self.answered += int((found.holds & found.asked).sum())
        self.instants, self.steps = self.instants + int(found.instants.sum()), self.steps + int(found.steps.sum())


@dataclass
class Found:
    """A cell so far: a tally of each property, and for each conjunction whether a run satisfies it, one byte a run."""

    tallies: dict[str, Tally]
    together: dict[str, tuple[str, ...]]  # names of the conjunctions and of what they are made of
    runs: dict[str, list[Array]]
    alarms: int | None = None  # false ones, of clean runs in which detection is asked for
    informed: dict[str, int] | None = None  # pairs of an attacked run and its twin, where detection is asked for

    def add(self, outcomes: dict[str, Outcome], alarms: Array | None, pairs: Informed | None) -> None:
        """Add the next runs."""
        if alarms is not None:
            self.alarms = (self.alarms or 0) + int(alarms.sum())
        if pairs is not None:
            self.informed = {name: (self.informed or {}).get(name, 0) + int(found.sum()) for name, found in pairs._asdict().items()}
        for name, of in outcomes.items():
            self.tallies[name].add(of)
        for name, members in self.together.items():
            self.runs[name].append(np.all([outcomes[member].holds for member in members], axis=0))

    def of(self, conjunction: str) -> Array:
        """Return (n,) bool: the runs that keep to a conjunction."""
        return np.concatenate([np.zeros(0, bool), *self.runs[conjunction]])


def check_cell(job: Job) -> Row:
    """Return the row of a cell. What a component raises costs this row, with the reason."""
    cell, defence, attack = job.cell, Spec("defence", job.cell.defence), Spec("attack", job.cell.attack).make()
    scenario = cell.place(attack, Spec("attack", cell.attack).entry.knowledge)
    try:
        known = job.properties(scenario)
        loop = scenario.loop(defence.make(), defence.entry.uses)
        found = _played(job, loop, attack, [p for p in known if p.formula is not None])
    except Exception as error:
        reason, status = _why(error)
        return failed(job, reason, status)
    return _blank(job, scenario) | _summary(job, known, found)


def failed(job: Job, reason: str, status: str = "error") -> Row:
    """Return the row of a cell that could not be played."""
    spec = Spec("attack", job.cell.attack)
    return _blank(job, job.cell.place(spec.make(), spec.entry.knowledge)) | {"status": status, "reason": " ".join(reason.split())[:500]}


def _blank(job: Job, scenario: Scenario) -> Row:
    """Return a row of which nothing was played."""
    cell, defence, spec = job.cell, Spec("defence", job.cell.defence), Spec("attack", job.cell.attack)
    return _head(cell, scenario, defence.entry, spec.entry, cell_id(cell)) | {
        "cell": job.identity, "first_seed": cell.first_seed, "dt": scenario.brief().model.dt, "horizon": scenario.horizon,
        "status": "ok", "reason": "", "n": 0, "properties": [], "conjunctions": {}, "verdict": None, "worst": None,
        "alarms": None, INFORMS: None,
    }  # fmt: skip


def _played(job: Job, loop: Loop, attack: Attack, known: Sequence[Property]) -> Found:
    """Return the outcome of each property in the order of the seeds, up to where the rule stops."""
    cell, episodes = job.cell, job.cell.episodes
    size = episodes_at_once(loop.model, loop.horizon, cell.batch if job.rule is None else min(cell.batch, 64))
    together = {name: members for name, members in conjunctions(known, job.formulas).items() if members}
    found = Found({p.name: Tally() for p in known}, together, {name: [] for name in together})
    for start in range(0, cell.seeds, size):
        outcomes, alarms, pairs = _outcomes(job, loop, attack, known, tuple(episodes[start : start + size]))
        verdict = None
        if job.rule is not None and together:
            trust = np.all([outcomes[name].holds for name in together["trust"]], axis=0)
            verdict = job.rule.stop(np.concatenate([found.of("trust"), trust]))
        if verdict is not None:
            outcomes = {name: Outcome(*(x[: verdict.runs - start] for x in of)) for name, of in outcomes.items()}
            alarms = None if alarms is None else alarms[: verdict.runs - start]
            pairs = None if pairs is None else Informed(*(x[: verdict.runs - start] for x in pairs))
        found.add(outcomes, alarms, pairs)
        if verdict is not None:
            break
    return found


@lru_cache(maxsize=16)
def _keys(purpose: str, seeds: tuple[int, ...]) -> draws.Keys:
    """Return the keys of runs that every cell plays: their digests take longer than some steps."""
    return draws.keys(purpose, seeds)


def _outcomes(
    job: Job, loop: Loop, attack: Attack, known: Sequence[Property], seeds: tuple[int, ...]
) -> tuple[dict[str, Outcome], Array | None, Informed | None]:
    """Play the runs of these seeds: outcomes, false alarms of clean ones, and attacked ones against their twins."""
    cell, steps = job.cell, job.asked.detection
    trace = rollout(loop, attack, _keys(cell.purpose, seeds))
    out, alarms, pairs = {p.name: outcome(p, trace, job.safe) for p in known}, None, None
    if any(p.name == DETECTS for p in known):
        if cell.attack == CLEAN:
            alarms = false_alarms(trace, steps)
        else:
            pairs = informed(trace, twin_alarms(cell.defence, cell.scenario, cell.purpose, seeds), steps, loop.horizon)
    return out, alarms, pairs


def _summary(job: Job, known: Sequence[Property], found: Found) -> Row:
    n = max((tally.n for tally in found.tallies.values()), default=0)
    together: dict[str, Any] = {}
    for name, members in found.together.items():
        runs = found.of(name)
        together[name] = {"of": list(members), "k": int(runs.sum()), "runs": np.packbits(runs).tobytes().hex()}
    verdict = job.rule.stop(found.of("trust")) if job.rule is not None and together else None
    return {
        "n": n, "properties": [_property(p, found.tallies.get(p.name), job.cell.episodes) for p in known], "conjunctions": together,
        "verdict": None if verdict is None else verdict.holds, "worst": _worst(known, found, job.cell.episodes),
        "alarms": None if found.alarms is None else {"count": found.alarms, "steps": found.tallies[DETECTS].steps},
        INFORMS: found.informed,
    }  # fmt: skip


def _property(known: Property, found: Tally | None, seeds: Sequence[int]) -> Row:
    """Return a property as data: k of n runs satisfy it.

    Its antecedent held in `asked` of them, of which `answered` satisfy it, at a share `instants` of steps.
    """
    out: Row = {"name": known.name, "about": known.about, "reason": known.reason, "formula": None}
    if found is None:
        return out
    conditional = known.trigger is not None
    return out | {
        "formula": str(known.formula), "k": found.k, "n": found.n,
        "asked": found.asked if conditional else None,
        "answered": found.answered if conditional else None,
        "instants": found.instants / found.steps if conditional else None,
        "least": _finite(found.least), "seed": seeds[found.least_run],
    }  # fmt: skip


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _worst(known: Sequence[Property], found: Found, seeds: Sequence[int]) -> Row | None:
    """Return the run that fails the first of the properties that any run fails, by the most; those of safety come first."""
    for p in sorted(known, key=lambda p: p.name not in CONJUNCTIONS["safety"]):
        of = found.tallies.get(p.name)
        if of is not None and of.failing_run is not None:
            return {"property": p.name, "run": of.failing_run, "seed": seeds[of.failing_run], "robustness": _finite(of.failing)}
    return None


def _bits(text: str, n: int) -> Array:
    return np.unpackbits(np.frombuffer(bytes.fromhex(text), np.uint8), count=n).astype(bool)


def runs_of(row: Row, conjunction: str) -> Array:
    """Return (n,) bool: the runs of a row, by seed, in which a conjunction holds."""
    return _bits(row["conjunctions"][conjunction]["runs"], row["n"])


def single(job: Job, run: int) -> Cell:
    """Return the cell of one run of a job, by its number. Its trace is the one that was checked: rows are independent."""
    return replace(job.cell, first_seed=job.cell.first_seed + run, seeds=1)
