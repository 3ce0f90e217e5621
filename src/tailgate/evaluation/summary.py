"""The summary of rows: one entry per cell, with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tailgate.evaluation.rows import IF_ANY, KEYS
from tailgate.evaluation.stats import proportion

ENTRY = ("n", "failed", "crash", "refused_all")  # keys of an entry that are no column of a row
FIGURES = ("min_gap", "max_error", "rmse_position", "alarm_onsets", "alarm_rate", "attack_steps", "refused_commands")


def cell_of(row: dict[str, Any]) -> tuple[Any, ...]:
    """Return the part of a row that tells its cell from others."""
    return (*(row[key] for key in KEYS), *(repr(row.get(name)) for name in IF_ANY))


def summarise(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one entry per cell (the columns of rows.KEYS, and of IF_ANY), in order of appearance; of repeated seeds the last row counts.

    crash: share of episodes with a collision in front or behind, with a 95 % Clopper-Pearson interval.
    Other columns are medians with quartiles, those of somebody's own metrics too.
    `failed` counts rows with an error; they and skipped pairings are not in the figures.
    """
    groups: dict[tuple[Any, ...], dict[int, dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(cell_of(row), {})[row["seed"]] = row
    out = []
    for key, by_seed in groups.items():
        members = list(by_seed.values())
        good = [row for row in members if row["status"] == "ok"]
        entry: dict[str, Any] = dict(zip(KEYS, key, strict=False)) | {name: members[0].get(name) for name in IF_ANY}
        entry |= {
            "n": len(good), "failed": sum(r["status"] == "error" for r in members), "learned": bool(members[0].get("learned")),
            "optimal": bool(members[0].get("optimal")), "reason": next((r["reason"] for r in members if r["status"] != "ok"), ""),
        }  # fmt: skip
        # the threat model grants nothing of the attack, so that it is harmless for that reason alone
        entry["refused_all"] = bool(good) and all(r["attack_steps"] == 0 and r["refused_commands"] for r in good)
        if good:
            share = proportion(sum(bool(r["crashed"]) for r in good), len(good))
            entry["crash"] = {"value": share.value, "low": share.low, "high": share.high}
            for name in (*FIGURES, *dict.fromkeys(name for r in good for name in r.get("metrics", ()) if name not in entry)):
                values = np.array([r[name] for r in good if r.get(name) is not None], np.float64)
                if len(values):
                    low, mid, high = np.quantile(values, [0.25, 0.5, 0.75])
                    entry[name] = {"median": float(mid), "q25": float(low), "q75": float(high)}
                else:
                    entry[name] = None
        else:
            entry["crash"] = None
        out.append(entry)
    return out
