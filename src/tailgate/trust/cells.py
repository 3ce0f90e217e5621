"""One cell of model checking: a defence against an attack in a scenario, many seeds, and of each the truth of every property.

Seeds are those of an evaluation: a seed is the same world for every defence, so that their outcomes are paired.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from tailgate import draws
from tailgate.core import Array
from tailgate.evaluation import Cell, _head, _why, cell_id
from tailgate.loop import Loop
from tailgate.registry import Spec
from tailgate.scenario import Scenario, load_scenario
from tailgate.schema import canonical
from tailgate.trace import Trace, episodes_at_once, rollout

from .logic import Eventually, Interval, along, holds, robustness
from .properties import CONJUNCTIONS, Demands, Property, built_in, conjunctions, own
from .signals import SafeDistance, sample
from .statistics import Sequential, Sprt

Row = dict[str, Any]


@dataclass(frozen=True)
class Job:
    """A cell and what is asked of it: a user's formulas, or, of none, the built-in properties. `rule` stops it before its last seed."""

    cell: Cell
    formulas: tuple[str, ...] = ()
    bound: float | None = None
    safe: SafeDistance = field(default_factory=SafeDistance)
    asked: Demands = field(default_factory=Demands)
    rule: Sequential | Sprt | None = None

    @cached_property
    def identity(self) -> str:
        """Of everything that decides the row."""
        known = [[p.name, str(p.formula), str(p.trigger), p.until] for p in self.properties(load_scenario(self.cell.scenario))]
        rest = [known, self.safe, self.rule]
        return hashlib.blake2b(f"{cell_id(self.cell)}/{canonical(rest)}".encode(), digest_size=12).hexdigest()

    def properties(self, place: Scenario) -> tuple[Property, ...]:
        return own(place, self.formulas) if self.formulas else built_in(place, self.bound, self.asked)


class Outcome(NamedTuple):
    """What became of a property in B runs."""

    holds: Array  # (B,) bool
    robustness: Array  # (B,)
    asked: Array  # (B,) bool: its antecedent held at some time; of one without, True
    instants: Array  # (B,) steps at which it held
    steps: Array  # (B,) steps of the run


def outcome(known: Property, trace: Trace, safe: SafeDistance) -> Outcome:
    """A property with a formula, in every run of a trace."""
    assert known.formula is not None
    samples = sample(trace, known.signals, safe)
    asked, instants = np.ones(trace.batch, bool), np.zeros(trace.batch, np.int64)
    if known.trigger is not None:
        asked = holds(Eventually(known.trigger, Interval(0.0, known.until)), samples)
        instants = np.count_nonzero(along(known.trigger, samples) & samples.live, axis=0)
    return Outcome(holds(known.formula, samples), robustness(known.formula, samples), asked, instants, trace.length)


def joined(parts: Sequence[Outcome]) -> Outcome:
    """The outcomes of runs that were played one after the other."""
    return Outcome(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def check_cell(job: Job) -> Row:
    """The row of a cell. What a component raises costs this row, with the reason."""
    cell, guard, attack = job.cell, Spec("defence", job.cell.defence), Spec("attack", job.cell.attack).make()
    place = cell.place(attack, Spec("attack", cell.attack).entry.knowledge)
    try:
        known = job.properties(place)
        loop = place.loop(guard.make(), guard.entry.uses)
        found = _played(job, loop, attack, [p for p in known if p.formula is not None])
    except Exception as error:
        reason, status = _why(error)
        return failed(job, reason, status)
    return _blank(job, place) | _summary(job, known, found)


def failed(job: Job, reason: str, status: str = "error") -> Row:
    """The row of a cell that could not be played."""
    rival = Spec("attack", job.cell.attack)
    return _blank(job, job.cell.place(rival.make(), rival.entry.knowledge)) | {"status": status, "reason": " ".join(reason.split())[:500]}


def _blank(job: Job, place: Scenario) -> Row:
    """A row of which nothing was played."""
    cell, guard, rival = job.cell, Spec("defence", job.cell.defence), Spec("attack", job.cell.attack)
    return _head(cell, place, guard.entry, rival.entry, cell_id(cell)) | {
        "cell": job.identity, "first_seed": cell.first_seed, "dt": place.brief().model.dt, "horizon": place.horizon,
        "status": "ok", "reason": "", "n": 0, "properties": [], "conjunctions": {}, "verdict": None, "worst": None,
    }  # fmt: skip


def _played(job: Job, loop: Loop, attack: Any, known: Sequence[Property]) -> dict[str, Outcome]:
    """The outcome of each property in the order of the seeds, up to where the rule stops."""
    cell = job.cell
    size = episodes_at_once(loop.model, loop.horizon, cell.batch if job.rule is None else min(cell.batch, 64))
    parts: dict[str, list[Outcome]] = {p.name: [] for p in known}
    for start in range(0, cell.seeds, size):
        trace = rollout(loop, attack, draws.keys(cell.purpose, cell.episodes[start : start + size]))
        for p in known:
            parts[p.name].append(outcome(p, trace, job.safe))
        if job.rule is not None and known:
            found = {name: joined(of) for name, of in parts.items()}
            verdict = job.rule.stop(_all(found, conjunctions(known, job.formulas)["trust"]))
            if verdict is not None:
                return {name: Outcome(*(x[: verdict.runs] for x in of)) for name, of in found.items()}
    return {name: joined(of) for name, of in parts.items()}


def _all(found: dict[str, Outcome], names: Sequence[str]) -> Array:
    """(B,) bool: all these properties hold."""
    return np.asarray(np.all([found[name].holds for name in names], axis=0))


def _summary(job: Job, known: Sequence[Property], found: dict[str, Outcome]) -> Row:
    n = len(next(iter(found.values())).holds) if found else 0
    together: dict[str, Any] = {}
    for name, members in conjunctions(known, job.formulas).items():
        if members:
            runs = _all(found, members)
            together[name] = {"of": list(members), "k": int(runs.sum()), "runs": np.packbits(runs).tobytes().hex()}
    verdict = job.rule.stop(_bits(together["trust"]["runs"], n)) if job.rule is not None and together else None
    return {
        "n": n, "properties": [_property(p, found.get(p.name), job.cell) for p in known], "conjunctions": together,
        "verdict": None if verdict is None else verdict.holds, "worst": _worst(known, found, job.cell),
    }  # fmt: skip


def _property(known: Property, found: Outcome | None, cell: Cell) -> Row:
    """k of n runs satisfy it; its antecedent held in `asked` of them, of which `answered` satisfy it, at a share `instants` of steps."""
    out: Row = {"name": known.name, "about": known.about, "reason": known.reason, "formula": None}
    if found is None:
        return out
    conditional = known.trigger is not None
    least = int(np.argmin(found.robustness))
    return out | {
        "formula": str(known.formula), "k": int(found.holds.sum()), "n": len(found.holds),
        "asked": int(found.asked.sum()) if conditional else None,
        "answered": int((found.holds & found.asked).sum()) if conditional else None,
        "instants": float(found.instants.sum() / found.steps.sum()) if conditional else None,
        "least": _finite(found.robustness[least]), "seed": cell.episodes[least],
    }  # fmt: skip


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _worst(known: Sequence[Property], found: dict[str, Outcome], cell: Cell) -> Row | None:
    """The run that fails the first of the properties that any run fails, by the most; those of safety come first."""
    for p in sorted(known, key=lambda p: p.name not in CONJUNCTIONS["safety"]):
        if p.name in found and not found[p.name].holds.all():
            of = found[p.name]
            i = int(np.argmin(np.where(of.holds, np.inf, of.robustness)))
            return {"property": p.name, "run": i, "seed": cell.episodes[i], "robustness": _finite(of.robustness[i])}
    return None


def _bits(text: str, n: int) -> Array:
    return np.unpackbits(np.frombuffer(bytes.fromhex(text), np.uint8), count=n).astype(bool)


def runs_of(row: Row, conjunction: str) -> Array:
    """(n,) bool: the runs of a row, by seed, in which a conjunction holds."""
    return _bits(row["conjunctions"][conjunction]["runs"], row["n"])


def single(job: Job, run: int) -> Cell:
    """The cell of one run of a job, by its number. Its trace is the one that was checked: a row does not depend on those beside it."""
    return replace(job.cell, first_seed=job.cell.first_seed + run, seeds=1)
