"""The baselines of a learner: the best scripted attack, chosen on separate seeds."""

from __future__ import annotations

from typing import Any

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array
from tailgate.core.scenario import Suite
from tailgate.evaluation.cells import cells_of, run

BATCH = 512  # episodes in a batch


def outcomes(rows: list[dict[str, Any]], outcome: str) -> Array:
    """Return the outcomes (episodes,) of rows; raise InputError if a row was not played or lacks the outcome."""
    bad = next((row for row in rows if row["status"] != "ok"), None)
    if bad is not None:
        raise InputError(f"attack {bad['attack']}", bad["status"], f"an attack that can be played here ({bad['reason']})")
    if any(row[outcome] is None for row in rows):
        raise InputError("config.outcome", outcome, "a metric that every episode has")
    return np.array([row[outcome] for row in rows], np.float64)


def best_of(suite: Suite, threat: dict[str, Any], outcome: str, purpose: str, workers: int) -> str | None:
    """Return the suite's attack with the largest mean outcome against its one defence, on seeds of `purpose`; None without attacks."""
    if len(suite.attacks) < 2:
        return next(iter(suite.attacks), None)
    rows = run(cells_of(suite, batch=BATCH, purpose=purpose, threat=threat), workers=workers)
    played = [attack for attack in suite.attacks if not left_out([r for r in rows if r["attack"] == attack])]
    return max(played, key=lambda attack: float(outcomes([r for r in rows if r["attack"] == attack], outcome).mean()), default=None)


def left_out(rows: list[dict[str, Any]]) -> str:
    """Return why the rows of an attack count for no comparison: it cannot be played here, or every command is refused; else nothing."""
    done = [row for row in rows if row["status"] == "ok"]
    if any(row["refused_commands"] for row in done) and not any(row["attack_steps"] for row in done):
        return "each of its commands is refused: the threat model does not grant them"
    return next((str(row["reason"]) for row in rows if row["status"] == "skipped"), "")
