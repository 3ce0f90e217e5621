"""What the timing of the attackers is worth that were trained against the entries of a board: timing.json beside it.

    timing advantage = P(damage | own schedule) - P(damage | yoked schedule)

Of each entry a trained attacker is played again, on the board's own episodes, at its own times and at those of its twins
(tailgate.strength.timing): the one that does most damage, at the dose where that is nearest to half of the episodes, since where all come
to damage, or none, no schedule is better than another. Rows cannot tell it: a twin is no attack of the board.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

import tailgate
from tailgate import draws
from tailgate.core import Array
from tailgate.metrics import measure
from tailgate.rounds import numbered
from tailgate.scenario import Suite
from tailgate.schema import read_model
from tailgate.scoring.cells import hits_of, vague
from tailgate.scoring.damage import damaged
from tailgate.stats import paired_difference, proportion
from tailgate.strength.policies import loop_for, trained
from tailgate.strength.timing import TWINS, played, schedules
from tailgate.trace import Trace

from .board_format import LEVELS, read_board
from .check import agree, known, refused

FILE = "timing.json"
NOBODY = "no attacker that was trained against it, and whose file is here, did damage"
Data = dict[str, Any]
Progress = Callable[[int, int], None]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Change = Annotated[float, Field(ge=-1, le=1, allow_inf_nan=False)]


class Shown(BaseModel):
    """A share of damaged episodes with its exact limits, 95 %."""

    model_config = ConfigDict(strict=True)
    value: Share
    low: Share
    high: Share


class Gain(BaseModel):
    """A difference of two of them, of the same episodes, with its limits, 95 %."""

    model_config = ConfigDict(strict=True)
    value: Change
    low: Change
    high: Change


class Timed(BaseModel):
    """A trained attacker of an entry, and its twins."""

    model_config = ConfigDict(strict=True)
    defence: str
    attack: str
    scenario: str
    dose: int | None
    knowledge: str
    own: Shown
    yoked: Shown
    shuffled: Shown
    periodic: Shown
    advantage: Gain  # own over yoked

    @property
    def flagged(self) -> bool:
        """Whether the times of another episode surely do no less: what was learned is not when to attack."""
        return self.advantage.low <= 0.0


class Untimed(BaseModel):
    """An entry of which nothing can be said, and why."""

    model_config = ConfigDict(strict=True)
    defence: str
    why: str


class Timing(BaseModel):
    """A file of timing advantages."""

    model_config = ConfigDict(strict=True)
    format: Literal["tailgate-board-timing-1"] = "tailgate-board-timing-1"
    suite: str
    hash: str
    beacon: str
    episodes: Annotated[int, Field(ge=1)]
    version: str
    entries: list[Timed]
    without: list[Untimed]


def telling(board: Data, defence: str) -> Data | None:
    """The cell to look at of an entry: of the trained attackers that do most damage at each dose, the least knowing and first of equal
    ones, whose files are here, the one whose share of damage is nearest to a half; none where none does damage."""
    lines = (a for a in board["attacks"] if a.get("trained_on") == defence and a["attack"].endswith(".json") and not a.get("withdrawn"))
    own = {line["attack"] for line in lines if not refused("attack", line["attack"])}
    worst: dict[int | None, Data] = {}
    for cell in (c for c in board["cells"] if c["defence"] == defence and c["attack"] in own and c["damage"] and not c["failed"]):
        held = worst.setdefault(cell["dose"], cell)
        if _harmful(cell) > _harmful(held):
            worst[cell["dose"]] = cell
    hurt = [worst[dose] for dose in sorted(worst, key=lambda dose: (dose is None, dose or 0)) if worst[dose]["damage"]["value"] > 0.0]
    return min(hurt, key=lambda cell: abs(cell["damage"]["value"] - 0.5), default=None)


def _harmful(cell: Data) -> tuple[float, int]:
    return cell["damage"]["value"], -LEVELS.index(cell["knowledge"])


def measure_timing(board: Data, suite: Suite, defences: Sequence[str] = (), progress: Progress | None = None) -> Timing:
    """Timing advantages of trained attackers of the board's ranked entries, or of those that are named.

    Raises InputError for a board of another suite or version, and a defence that is not on it. An attacker whose file is not here, or that
    does not do here what the board's cell says, is listed in `without`.
    """
    agree(read_board(board), suite)
    ranked = [entry["defence"] for entry in board["entries"] if entry["rank"]]
    known(defences, [entry["defence"] for entry in board["entries"]])
    beacon, purpose = board["suite"].get("beacon") or "", board["suite"].get("purpose") or "report"
    asked = list(defences) or ranked
    entries: list[Timed] = []
    without: list[Untimed] = []
    for done, defence in enumerate(asked, start=1):
        cell = telling(board, defence)
        found = NOBODY if cell is None else _timed(cell, suite, beacon, purpose)
        if isinstance(found, str):
            without.append(Untimed(defence=defence, why=found))
        else:
            entries.append(found)
        if progress is not None:
            progress(done, len(asked))
    return Timing(
        suite=suite.name, hash=suite.hash, beacon=beacon, episodes=board["suite"]["episodes"], version=tailgate.__version__,
        entries=entries, without=without,
    )  # fmt: skip


def _timed(cell: Data, suite: Suite, beacon: str, purpose: str) -> Timed | str:
    """The figures of a cell's attacker and its twins, or why there are none."""
    if why := refused("defence", cell["defence"]):
        return why
    who = trained(cell["attack"])
    loop = loop_for(who, cell["scenario"], cell["defence"], suite.granted, cell["dose"])
    seeds = sorted(numbered(beacon, suite.name, purpose, 0, cell["n"]))  # as `hits` are told
    keys = draws.keys(purpose, seeds)
    harm = {
        name: played(loop, who.policy, keys, schedule, [lambda trace: _harm(trace, suite)])[0].astype(bool)
        for name, schedule in schedules(loop, who.policy, keys).items()
    }
    if not _same(cell, harm["own"]):
        count = f"{int(harm['own'].sum())} of {cell['n']} episodes"
        return f"{cell['attack']} does damage to {count} here, which is not what the board's cell says"
    shares = {name: Shown(**proportion(int(harm[name].sum()), len(seeds))._asdict()) for name in TWINS}
    gain = paired_difference(harm["own"][None].astype(np.float64), harm["yoked"][None].astype(np.float64), share=True)
    return Timed(
        defence=cell["defence"], attack=cell["attack"], scenario=cell["scenario"], dose=cell["dose"], knowledge=cell["knowledge"],
        advantage=Gain(value=gain.value, low=max(gain.low, -1.0), high=min(gain.high, 1.0)), **shares,
    )  # fmt: skip


def _harm(trace: Trace, suite: Suite) -> Array:
    """(B,) whether an episode is damaged, as rows say it."""
    values = {name: held for name, held in measure(trace).items() if name in ("crashed", "distance_travelled", "max_error")}
    rows = [{name: None if np.isnan(held[i]) else float(held[i]) for name, held in values.items()} for i in range(trace.batch)]
    return np.array([damaged(row, suite) for row in rows], np.float64)


def _same(cell: Data, harm: Array) -> bool:
    if vague(cell):
        return bool(harm.sum() == round(cell["damage"]["value"] * cell["n"]))
    return bool(np.array_equal(hits_of(cell), harm))


def read_timing(path: Path) -> Timing:
    """Raises InputError that names the file and the field for anything else than timing advantages."""
    return read_model(Timing, path, "timing advantages", "leaderboard timing")


def timing_of(board: Path) -> Timing | None:
    """The timing advantages that lie beside a board's file; none where there are none."""
    path = board.parent / FILE
    return read_timing(path) if path.is_file() else None
