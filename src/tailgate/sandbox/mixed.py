"""Cells of one scenario, played such that a submission sees their rows together, in one batch and a secret order."""

from __future__ import annotations

import dataclasses
import hashlib
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from tailgate.base import sources
from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.version import VERSION
from tailgate.core import Attack, draws
from tailgate.core.registry import Entry, Spec
from tailgate.core.scenario import Scenario
from tailgate.core.schema import canonical
from tailgate.evaluation.cells import Cell, _failed, _head, _played, _why, origin
from tailgate.play.trace import episodes_at_once, rollout
from tailgate.sandbox.isolated import Isolated, IsolatedPlan
from tailgate.sandbox.limits import FEWEST, Limits, Lost
from tailgate.sandbox.sandbox import Sandbox
from tailgate.sandbox.sandboxed import WHITE
from tailgate.sandbox.source import Source
from tailgate.sandbox.table import Seat, order_of, play_together

ROWS = 4096  # most rows of a batch; beyond that a step gains nothing
COMPANIONS = 256  # most rows that the companions test plays again


@dataclass(frozen=True)
class Submission:
    """A submitted class, described without importing it."""

    source: Source
    card: dict[str, Any]  # uses, version, reference
    limits: Limits = field(default_factory=Limits)
    sandbox: Sandbox | None = None

    @property
    def entry(self) -> Entry:
        """The entry of the submission, for the heads of rows."""
        return Entry("defence", self.source.text, object, **{name: self.card[name] for name in ("uses", "version", "reference")})

    def isolated(self) -> Isolated:
        """Return the submission as a defence."""
        return Isolated(self.source.text, self.source.path, self.limits, self.sandbox)


@dataclass(frozen=True, eq=False)
class _Part:
    """A cell with its scenario, attack, head of rows, and what its defence uses."""

    cell: Cell
    place: Scenario
    attack: Attack
    head: dict[str, Any]
    uses: tuple[str, ...]

    def play(self, seeds: Sequence[int], seat: Seat) -> list[dict[str, Any]]:
        """Play some seeds and return their rows, as `evaluation.run_cell` makes them."""
        try:
            keys = draws.keys(self.cell.purpose, seeds)
            return _played(self.head, seeds, rollout(self.place.loop(seat, self.uses), self.attack, keys))
        except Exception as error:  # a component may raise anything; only its own rows are lost
            return self.failed(seeds, error)

    def failed(self, seeds: Sequence[int], error: Exception) -> list[dict[str, Any]]:
        """Return rows with the reason only."""
        reason, status = (str(error), "error") if isinstance(error, Lost) else _why(error)
        return _failed(self.head, seeds, reason, status)


def identity(cell: Cell, submission: Submission, seeds: Sequence[int], place: Scenario) -> str:
    """Return a hash of everything that determines the rows of a submission's cell."""
    data = dataclasses.asdict(cell) | {"seeds": list(seeds), "digest": submission.source.digest, "scenario": place.config_hash}
    data |= {"attack_digest": Spec("attack", cell.attack).digest, "limits": dataclasses.asdict(submission.limits)}
    sandbox = "" if submission.sandbox is None else submission.sandbox.program
    return hashlib.blake2b(f"{VERSION}/{sources.own()}/{sandbox}/{canonical(data)}".encode(), digest_size=12).hexdigest()


def part_of(cell: Cell, submission: Submission, seeds: Sequence[int]) -> _Part:
    """Return a cell with its attack and the head of its rows, without importing anything of the submission."""
    spec, entry = Spec("attack", cell.attack), submission.entry
    attack = spec.make()
    place = cell.place(attack, spec.entry.knowledge)
    head = _head(cell, place, entry, spec.entry, "") | {
        "defence_digest": submission.source.digest, "attack_digest": spec.digest, "trained": origin(cell.attack),
        "cell": identity(cell, submission, seeds, place),
        "submission": {"sandbox": "" if submission.sandbox is None else submission.sandbox.program},
    }  # fmt: skip
    return _Part(cell, place, attack, head, entry.uses)


def play_mixed(cells: Sequence[Cell], submission: Submission, seeds: Sequence[int] | None = None) -> list[dict[str, Any]]:
    """Play cells of one scenario; return rows in the order of the cells and of `seeds` (default: the cells' seeds).

    All rows of a batch go through one step of the submission's process, in a secret random order.
    Each batch has a fresh order and a fresh process.
    Afterwards the companions test plays some rows again among others; a submission whose rows differ by a bit loses all of them.
    A lost process loses the rows that it had not finished.
    """
    if len({(cell.scenario, cell.first_seed, cell.seeds, cell.purpose, cell.beacon) for cell in cells}) > 1:
        raise InputError("cells", "cells that differ in scenario, seeds, purpose or beacon", "cells of one scenario and the same seeds")
    chosen = list(cells[0].episodes if seeds is None else seeds)
    parts = [part_of(cell, submission, chosen) for cell in cells]
    rows: dict[tuple[int, int], dict[str, Any]] = {}
    fit = []
    for i, part in enumerate(parts):
        if part.place.threat_model.knowledge == "white":
            rows |= _by_seed(i, part.failed(chosen, NotApplicable("attack", part.cell.attack, f"a black or grey box: {WHITE}")))
        else:
            fit.append(i)
    lost: Exception | None = None
    for batch in _deal(parts, fit, chosen):
        if lost is None:
            played, lost = _play(parts, submission, batch)
            rows |= played
        for i, some in batch.items():  # the process failed in this or an earlier batch; later ones would fail too
            if lost is not None and (missing := [seed for seed in some if (i, seed) not in rows]):
                rows |= _by_seed(i, parts[i].failed(missing, lost))
    _test_companions(parts, submission, rows)
    return [rows[i, seed] for i in range(len(parts)) for seed in chosen]


def play_again(cells: Sequence[tuple[Cell, Sequence[int]]], submission: Submission) -> list[list[dict[str, Any]]]:
    """Play some seeds of each cell, all of one scenario, together; return their rows, which `verify` compares with others."""
    parts = [part_of(cell, submission, seeds) for cell, seeds in cells]
    rows, lost = _play(parts, submission, {i: list(seeds) for i, (_, seeds) in enumerate(cells)})
    return [
        [rows[i, seed] if (i, seed) in rows else parts[i].failed([seed], lost or Lost("not played"))[0] for seed in seeds]
        for i, (_, seeds) in enumerate(cells)
    ]  # fmt: skip


def _by_seed(i: int, rows: Sequence[dict[str, Any]]) -> dict[tuple[int, int], dict[str, Any]]:
    return {(i, row["seed"]): row for row in rows}


def _deal(parts: Sequence[_Part], fit: Sequence[int], seeds: Sequence[int]) -> Iterator[dict[int, list[int]]]:
    """Yield batches: the seeds of each cell, with cells in a secret order; if the seeds are split, cells begin with different parts."""
    if not fit:
        return
    place = parts[fit[0]].place
    most = max(FEWEST, episodes_at_once(place.brief().model, place.horizon, ROWS))
    mixed = [fit[i] for i in order_of(secrets.token_bytes(32), len(fit))]
    for begin in range(0, len(mixed), most):
        group = mixed[begin : begin + most]
        size = max(1, most // len(group))
        cuts = [list(seeds[at : at + size]) for at in range(0, len(seeds), size)]
        for turn in range(len(cuts)):
            yield {i: cuts[(turn + k) % len(cuts)] for k, i in enumerate(group)}


def _play(
    parts: Sequence[_Part], submission: Submission, batch: dict[int, list[int]]
) -> tuple[dict[tuple[int, int], dict[str, Any]], Exception | None]:
    """Play a batch; return its rows by cell and seed, and the error of the process as a whole."""
    rows: dict[tuple[int, int], dict[str, Any]] = {}
    with submission.isolated() as defence:
        try:
            plan: IsolatedPlan = defence.prepare(parts[next(iter(batch))].place.brief().model)
        except (Lost, InputError) as error:
            return rows, error
        works = [partial(parts[i].play, seeds) for i, seeds in batch.items()]
        for i, played in zip(batch, play_together(defence, plan, works, secrets.token_bytes(32)), strict=True):
            rows |= _by_seed(i, played)
        return rows, Lost(plan.process.lost) if plan.process.lost else None


def _test_companions(parts: Sequence[_Part], submission: Submission, rows: dict[tuple[int, int], dict[str, Any]]) -> None:
    """Play some rows again among others, in another order; if one differs by a bit, all rows become errors.

    The rows are at most half of all, chosen in secret, with different seeds first.
    Rows of one seed have the same noise, which a submission that compares rows could recognise.
    The process is a fresh one without memory of the first run.
    """
    good = [key for key, row in rows.items() if row["status"] == "ok"]
    if len(good) < 2:
        return
    order = [good[i] for i in order_of(secrets.token_bytes(32), len(good))]
    firsts = list({seed: (i, seed) for i, seed in reversed(order)}.values())
    some = list(dict.fromkeys([*firsts, *order]))[: min(COMPANIONS, len(good) // 2)]
    batch: dict[int, list[int]] = {}
    for i, seed in some:
        batch.setdefault(i, []).append(seed)
    again, lost = _play(parts, submission, batch)
    differ = [key for key in some if again.get(key, {}).get("trace_hash") != rows[key]["trace_hash"]]
    if not differ:
        return
    decided = sum(again.get(key, {}).get("decision_hash") != rows[key]["decision_hash"] for key in differ)
    why = f"batch dependent: {len(differ)} of {len(some)} rows differ among other companions, {decided} of them in a decision"
    failure = Lost(f"companions test: {lost}" if lost is not None else why)
    for i, seed in good:
        (rows[i, seed],) = parts[i].failed([seed], failure)
