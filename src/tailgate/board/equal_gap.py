"""Comparison at equal mean gap: gap.json of a board, as a longer gap makes every attack harder.

An entry may keep a longer mean gap without an attack than the plain Kalman filter. It is then compared with that filter behind a
controller with a longer time headway. The headway is found on the board's clean episodes, so that both keep the same mean gap there.
The filter then meets the black-box attacks of the board that it met, on the board's episodes at the middle dose. Rows do not hold this:
the controller is another one than the scenario's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.version import VERSION
from tailgate.core import Array, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, Suite, name_of
from tailgate.core.schema import fields_of
from tailgate.evaluation.cells import Cell
from tailgate.evaluation.checks import refused
from tailgate.evaluation.rounds import numbered
from tailgate.evaluation.rows import CLEAN
from tailgate.evaluation.stats import limits
from tailgate.play.metrics import METRICS
from tailgate.play.trace import Trace
from tailgate.studies.timing import played

from .attachments import EqualGap, SameGap, Untimed
from .damage import doses_of
from .entry import middle
from .files import agree, known, read_board
from .schema import Data, Limited
from .timing import HARM, harmed

REFERENCE = "kf"
LEAST = 0.01  # a mean gap that is longer by less is as good as equal
MOST = 4.0  # times the headway
CLOSE = 1e-3  # of the factor
Progress = Callable[[int, int], None]


def measure_gap(board: Data, suite: Suite, defences: Sequence[str] = (), *, progress: Progress | None = None) -> EqualGap:
    """Compare the board's ranked entries, or those that are named, with the reference at their mean gap.

    Raises InputError for a board of another suite or version, without measures or the reference, and a defence that is not on it. Entries
    with no longer gap than the reference are listed in `without`.
    """
    agree(read_board(board), suite)
    if not suite.measures:
        raise InputError(f"suite {suite.name}: measures", False, "true: its boards have no mean gaps")
    entries = {entry["defence"]: entry for entry in board["entries"]}
    known([*defences, REFERENCE], list(entries))
    if entries[REFERENCE].get("mean_gap") is None:
        raise InputError(f"board: mean_gap of {REFERENCE}", None, "a number: somebody has to follow another")
    own = float(entries[REFERENCE]["mean_gap"]["value"])
    asked = list(defences) or [name for name, entry in entries.items() if entry["rank"]]
    found: list[SameGap] = []
    without: list[Untimed] = []
    for done, name in enumerate(asked, start=1):
        gap = entries[name].get("mean_gap")
        if gap is None or gap["value"] - own <= LEAST:
            without.append(Untimed(defence=name, why=f"its mean gap is no longer than that of {REFERENCE}"))
        else:
            line = _compared(board, suite, name, float(gap["value"]))
            (without if isinstance(line, Untimed) else found).append(line)  # type: ignore[arg-type]
        if progress is not None:
            progress(done, len(asked))
    beacon = board["suite"].get("beacon") or ""
    return EqualGap(suite=suite.name, hash=suite.hash, beacon=beacon, version=VERSION, entries=found, without=without)


def _compared(board: Data, suite: Suite, defence: str, gap: float) -> SameGap | Untimed:
    """Return the reference at this mean gap against its attacks, or why there is no such figure."""
    dose = doses_of(suite)[middle(suite)]
    pairs = [c for c in board["cells"] if c["defence"] == REFERENCE and c["dose"] == dose and _counts(c, board)]
    if not pairs:
        return Untimed(defence=defence, why=f"no black-box attack that {REFERENCE} met can be played here")
    try:
        factor, kept = _headway(board, suite, gap)
    except NotApplicable as error:
        return Untimed(defence=defence, why=str(error))
    harm = [_harm(board, suite, cell, factor) for cell in pairs]
    worst = int(np.argmax([x.sum() for x in harm]))
    cell, hits, n = pairs[worst], int(harm[worst].sum()), len(harm[worst])
    low = 1.0 - float(limits(np.array([hits]), np.array([n]), board["suite"].get("alpha", 0.05) / len(pairs))[1][0])
    share = Limited(value=(n - hits) / n, low=low)
    return SameGap(
        defence=defence, gap=gap, reference=REFERENCE, factor=factor, kept=kept, dose=dose, undamaged=share, attacks=len(pairs),
        scenario=cell["scenario"], attack=cell["attack"],
    )  # fmt: skip


def _counts(cell: Data, board: Data) -> bool:
    """Return if a whole cell is of a black-box attack that counts, and that can be played here."""
    withdrawn = {attack["attack"] for attack in board["attacks"] if attack.get("withdrawn")}
    counts = cell["knowledge"] == "black" and cell["attack"] not in {CLEAN, *withdrawn} and not cell.get("optimal")
    return counts and cell["damage"] is not None and not refused("attack", cell["attack"])


def _headway(board: Data, suite: Suite, gap: float) -> tuple[float, float]:
    """Return how many times the headway the reference needs for a mean gap, and the mean gap that it then keeps.

    Raises NotApplicable where the controller has no headway, or where the largest one is not enough.
    """
    from scipy.optimize import brentq

    bare = {name: _inflation(board, suite, name, CLEAN, 1.0) for name in suite.nominal}

    def over(factor: float) -> float:
        ratios = [(1.0 + _inflation(board, suite, name, REFERENCE, factor)) / (1.0 + held) for name, held in bare.items()]
        every = np.concatenate(ratios)
        return float(every[np.isfinite(every)].mean() - 1.0)

    if over(MOST) < gap:
        raise NotApplicable("mean gap", gap, f"one that {REFERENCE} keeps with up to {MOST:g} times its headway")
    factor = float(brentq(lambda factor: over(factor) - gap, 1.0, MOST, xtol=CLOSE))
    return factor, over(factor)


def _inflation(board: Data, suite: Suite, scenario: str, defence: str, factor: float) -> Array:
    """Return (n,) the mean gap over that which the scenario's own controller desires, less one; NaN where the undefended car collides."""
    place = Cell(suite.name, scenario, None, defence, CLEAN, 1, threat=suite.granted).place(Spec("attack", CLEAN).make(), "black")
    wanted = place.controller.desired_gap

    def inflation(trace: Trace) -> Array:
        return METRICS["time_gap_inflation"](dataclasses.replace(trace, desired_gap=wanted))

    found, crashed = _play(board, suite, place, defence, CLEAN, factor, [inflation, METRICS["crashed"]])
    return np.where(crashed > 0.0, np.nan, found) if defence == CLEAN else found


def _harm(board: Data, suite: Suite, cell: Data, factor: float) -> Array:
    """Return (n,) bool: the episodes of a cell that come to damage behind a controller with a longer headway."""
    attack = Spec("attack", cell["attack"])
    scenario = next(text for text in suite.scenarios if name_of(text) == cell["scenario"])
    made = Cell(suite.name, scenario, cell["dose"], REFERENCE, cell["attack"], 1, threat=suite.granted)
    place = made.place(attack.make(), attack.entry.knowledge)

    def distances() -> dict[int, float]:
        found = _play(board, suite, place, REFERENCE, CLEAN, factor, [METRICS["distance_travelled"]])[0]
        return dict(enumerate(found.tolist()))

    return harmed(cell, suite, _play(board, suite, place, REFERENCE, cell["attack"], factor, [METRICS[name] for name in HARM]), distances)


def _play(
    board: Data, suite: Suite, place: Scenario, defence: str, attack: str, factor: float, counts: Sequence[Callable[[Trace], Array]]
) -> list[Array]:
    """Play the board's episodes behind a controller with a headway that is longer by a factor, and return metrics (n,) each."""
    controller: Any = place.controller
    if "headway" not in fields_of(type(controller)):
        raise NotApplicable(f"scenario {place.name}: controller", type(controller).__name__, "one with a time headway")
    place = dataclasses.replace(place, controller=dataclasses.replace(controller, headway=factor * controller.headway))
    spec, held = Spec("defence", defence), board["suite"]
    seeds = sorted(numbered(held.get("beacon") or "", suite.name, held.get("purpose") or "report", 0, held["episodes"]))
    keys = draws.keys(held.get("purpose") or "report", seeds)
    return played(place.loop(spec.make(), spec.entry.uses), Spec("attack", attack).make(), keys, None, counts)
