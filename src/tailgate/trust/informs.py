"""Detection at a price in every run: `informs`, the informedness of an alarm (Powers 2011; Youden's J).

    informs = P(alarm | attack) - P(alarm | no attack), at the same steps of the same episodes

The steps are those in which `detects` looks for an alarm: the first attacked one and as many after it as the deadline allows. The run
without the attack is the twin of the attacked one: the same seed, defence and scenario. An alarm that is on by chance is on in both as
often, so that it earns nothing, however often it is on. `detects` stays as it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from tailgate.core import Array, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.evaluation.rows import CLEAN
from tailgate.evaluation.stats import limits
from tailgate.play.trace import Trace, rollout

INFORMS = "informs"
ABOUT = "how much more often the alarm is on within the deadline of an attack than at the same steps without it"

Row = dict[str, Any]


class Informed(NamedTuple):
    """Attacked runs and their twins, (B,) bool each."""

    asked: Array  # an attack began early enough for its deadline
    attacked: Array  # an alarm in time in the attacked run alone
    clean: Array  # an alarm at these steps in the twin alone


def informed(trace: Trace, twin: Array, steps: int, horizon: int) -> Informed:
    """Compare the alarms of attacked runs with those of their twins, at steps that the attacked run has.

    Parameters
    ----------
    trace : Trace
        The attacked runs, B of them.
    twin : Array
        (L, B) bool: the alarms of the twins. Runs that all end early have fewer steps, so that L may differ from that of the trace.
    steps : int
        Steps from the first attacked one to the deadline.
    horizon : int
        Steps of an episode that does not end early. An attack counts that begins early enough for its deadline.
    """
    on = (trace.kind != 0) & trace.live
    began = np.argmax(on, axis=0)
    asked = on.any(axis=0) & (began + steps < horizon)
    since = np.arange(len(on))[:, None] - began
    window = (since >= 0) & (since <= steps) & trace.live
    alarm = (trace.alarm.any(axis=2) & window).any(axis=0)
    both = min(len(twin), len(on))
    idle = (twin[:both] & window[:both]).any(axis=0)
    return Informed(asked, asked & alarm & ~idle, asked & idle & ~alarm)


@lru_cache(maxsize=16)
def twin_alarms(defence: str, scenario: str, purpose: str, seeds: tuple[int, ...]) -> Array:
    """Return (K, B) bool: where any agent's alarm is on in the runs of these seeds without an attack.

    Cells of one defence and scenario share it: neither the dose nor the knowledge of who does not attack changes a run.
    """
    spec = Spec("defence", defence)
    trace = rollout(load_scenario(scenario).loop(spec.make(), spec.entry.uses), Spec("attack", CLEAN).make(), draws.keys(purpose, seeds))
    return np.asarray(trace.alarm.any(axis=2) & trace.live)


def difference(attacked: int, clean: int, n: int, alpha: float) -> dict[str, float]:
    """Return the informedness of n pairs of runs, with limits that hold together with a chance of at least 1 - alpha.

    It is the share of pairs with an alarm in the attacked run alone, less that in the twin alone.
    Each of these two shares has exact limits, at a quarter of alpha a side.
    """
    low, high = limits(np.array([attacked, clean]), np.array([n, n]), alpha / 4.0)
    return {"value": (attacked - clean) / n, "low": max(float(low[0] - high[1]), -1.0), "high": min(float(high[0] - low[1]), 1.0)}


def informedness(rows: Sequence[Row], alpha: float) -> Row | None:
    """Return the property of a defence: the attacked cell of the least lower limit; None where nobody asked for it.

    `earned` is this limit, and 0 for one below it. The limits of all cells hold together.
    """
    held = [(row, found) for row in rows if isinstance(found := row.get(INFORMS), Mapping)]
    asked = [(row, found) for row, found in held if found["asked"]]
    if not held:
        return None
    entry: Row = {"name": INFORMS, "about": ABOUT, "share": None, "antecedent": None, "reason": "" if asked else "no attack began in time"}
    if not asked:
        return entry
    every = [(difference(found["attacked"], found["clean"], found["asked"], alpha / len(asked)), row, found) for row, found in asked]
    share, row, found = min(every, key=lambda item: (item[0]["low"], item[0]["value"]))
    place = {key: row[key] for key in ("scenario", "dose", "attack")}
    counts = {"k": found["attacked"] - found["clean"], "n": found["asked"], "attacked": found["attacked"], "clean": found["clean"]}
    return entry | {"share": share | counts | place, "earned": max(share["low"], 0.0)}
