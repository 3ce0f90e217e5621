"""Timing advantage of the attackers that were trained against the entries of a board: timing.json.

    timing advantage = P(damage | own schedule) - P(damage | yoked schedule)

For each entry one trained attacker is measured: the most damaging one whose files are here. Its dose is the one where it damages nearest
to half of the board's episodes. Where all come to damage, or none, no schedule is better than another. On the board's episodes it has to
do the damage of the board's cell. It was chosen on them, so it is measured on the next ones of the round. It attacks at its own times,
and at those of its twins (tailgate.studies.timing). Rows do not hold this: a twin is no attack of the board.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tailgate.base import sizes
from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.version import VERSION
from tailgate.core import Array, draws
from tailgate.core.loop import Loop
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite
from tailgate.evaluation.checks import refused
from tailgate.evaluation.paired import mcnemar
from tailgate.evaluation.rounds import numbered
from tailgate.evaluation.rows import CLEAN
from tailgate.evaluation.stats import holm, paired_difference, proportion
from tailgate.play.metrics import METRICS
from tailgate.studies.policies import loop_for, trained
from tailgate.studies.timing import TWINS, played, schedules

from .attachments import Gain, Shown, Timed, Timing, Untimed
from .cells import hits_of, vague
from .damage import damaged
from .files import agree, known, read_board
from .schema import LEVELS, Data

HARM = ("crashed", "distance_travelled", "max_error")  # metrics that damage is decided by
Progress = Callable[[int, int], None]


def telling(board: Data, defence: str) -> Data | str:
    """Return the cell to look at for an entry, or why there is none.

    At each dose the attacker counts that does most damage, the least knowing and first of equal ones, whose file is here. The cell is the
    one whose damaged share is nearest to a half.
    """
    if why := refused("defence", defence):
        return why
    mine = _trained(board, defence)
    if not mine:
        return "no attacker was trained against it"
    away = {cell["attack"] for cell in mine if refused("attack", cell["attack"])}
    worst: dict[int | None, Data] = {}
    for cell in (cell for cell in mine if cell["attack"] not in away):
        held = worst.setdefault(cell["dose"], cell)
        if _harmful(cell) > _harmful(held):
            worst[cell["dose"]] = cell
    if not worst:
        return "the files of its attackers are not here"
    hurt = [worst[dose] for dose in sorted(worst, key=lambda dose: (dose is None, dose or 0)) if worst[dose]["damage"]["value"] > 0.0]
    return min(hurt, key=lambda cell: abs(cell["damage"]["value"] - 0.5), default="no attacker that was trained against it did damage")


def _trained(board: Data, defence: str) -> list[Data]:
    """Return whole cells of the attackers that were trained against an entry."""
    lines = (a for a in board["attacks"] if a.get("trained_on") == defence and a["attack"].endswith(".json") and not a.get("withdrawn"))
    own = {line["attack"] for line in lines}
    return [c for c in board["cells"] if c["defence"] == defence and c["attack"] in own and c["damage"] and not c["failed"]]


def _harmful(cell: Data) -> tuple[float, int]:
    return cell["damage"]["value"], -LEVELS.index(cell["knowledge"])


def measure_timing(
    board: Data, suite: Suite, defences: Sequence[str] = (), *, episodes: int | None = None, progress: Progress | None = None
) -> Timing:
    """Measure timing advantages of trained attackers of the board's ranked entries, or of those that are named.

    episodes: fresh ones for each schedule (default: four times as many as a cell of the board has). Raises InputError for a board of
    another suite or version, and a defence that is not on it. An attacker that cannot be played here, or does not do here what the board's
    cell says, is listed in `without`.
    """
    agree(read_board(board), suite)
    if episodes is not None and episodes < 2:
        raise InputError("episodes", episodes, "at least 2: the schedule of another episode is needed")
    sizes.check("episodes", 2 if episodes is None else episodes)
    ranked = [entry["defence"] for entry in board["entries"] if entry["rank"]]
    known(defences, [entry["defence"] for entry in board["entries"]])
    asked, entries, without = list(defences) or ranked, [], []
    for done, defence in enumerate(asked, start=1):
        cell = telling(board, defence)
        try:
            found = cell if isinstance(cell, str) else _timed(cell, board, suite, episodes)
        except (InputError, NotApplicable) as error:
            found = str(error)
        if isinstance(found, str):
            without.append(Untimed(defence=defence, why=found))
        else:
            entries.append(found)
        if progress is not None:
            progress(done, len(asked))
    for entry, p in zip(entries, holm([entry.advantage.p for entry in entries]), strict=True):
        entry.advantage.adjusted = p
    return Timing(
        suite=suite.name, hash=suite.hash, beacon=board["suite"].get("beacon") or "", version=VERSION, entries=entries,
        without=without,
    )  # fmt: skip


def _timed(cell: Data, board: Data, suite: Suite, episodes: int | None) -> Timed | str:
    """Return the figures of a cell's attacker and its twins, or why there are none."""
    who, n = trained(cell["attack"]), cell["n"]
    loop = loop_for(who, cell["scenario"], cell["defence"], suite.granted, cell["dose"])
    beacon, purpose = board["suite"].get("beacon") or "", board["suite"].get("purpose") or "report"

    def harm(keys: draws.Keys, schedule: Array | None) -> Array:
        return harmed(cell, suite, played(loop, who.policy, keys, schedule, [METRICS[name] for name in HARM]), lambda: _reach(loop, keys))

    here = harm(draws.keys(purpose, sorted(numbered(beacon, suite.name, purpose, 0, n))), None)  # in the order of `hits`
    if not _same(cell, here):
        return f"{cell['attack']} does damage to {int(here.sum())} of {n} episodes here, which is not what the board's cell says"
    keys = draws.keys(purpose, numbered(beacon, suite.name, purpose, n, max(2, 4 * n if episodes is None else episodes)))
    times = schedules(loop, who.policy, keys)
    found = {name: harm(keys, schedule) for name, schedule in times.items()}
    own, yoked, total = found["own"], found["yoked"], len(keys.key)
    shares = {name: Shown(**proportion(int(found[name].sum()), total)._asdict()) for name in TWINS}
    gain = paired_difference(own[None].astype(float), yoked[None].astype(float), share=True)
    counts = int((own & ~yoked).sum()), int((yoked & ~own).sum())
    most = max(other["damage"]["value"] for other in _trained(board, cell["defence"]) if other["dose"] == cell["dose"])
    return Timed(
        defence=cell["defence"], attack=cell["attack"], scenario=cell["scenario"], dose=cell["dose"], knowledge=cell["knowledge"],
        board=cell["damage"]["value"], most=most, episodes=total, schedules=len(np.unique(np.asarray(times["yoked"]), axis=1).T), **shares,
        advantage=Gain(
            value=gain.value, low=max(gain.low, -1.0), high=min(gain.high, 1.0), p=mcnemar(*counts),
            only_own=counts[0], only_yoked=counts[1],
        ),
    )  # fmt: skip


def harmed(cell: Data, suite: Suite, found: Sequence[Array], clean: Callable[[], dict[int, float]]) -> Array:
    """Return (B,) bool: the damaged episodes, as rows say it. found: the metrics of HARM, (B,) each; clean: distances of clean runs."""
    values = dict(zip(HARM, found, strict=True))
    head = {key: cell[key] for key in ("scenario", "defence", "attack")}
    rows = [
        head | {"seed": i} | {name: None if np.isnan(held[i]) else float(held[i]) for name, held in values.items()}
        for i in range(len(found[0]))
    ]
    reach = None if suite.progress is None else clean()
    return np.array([damaged(row, suite, reach) for row in rows], bool)


def _reach(loop: Loop, keys: draws.Keys) -> dict[int, float]:
    """Return the distance [m] of the clean run of each key, by its number."""
    distance = played(loop, Spec("attack", CLEAN).make(), keys, None, [METRICS["distance_travelled"]])[0]
    return dict(enumerate(distance.tolist()))


def _same(cell: Data, harm: Array) -> bool:
    if vague(cell):
        return bool(harm.sum() == round(cell["damage"]["value"] * cell["n"]))
    return bool(np.array_equal(hits_of(cell), harm))
