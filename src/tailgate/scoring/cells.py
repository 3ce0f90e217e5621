"""The cells of a board: what became of the episodes of one scenario, dose, defence and attack."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from typing import Any

from tailgate.scenario import Suite
from tailgate.stats import proportion

from .damage import Row, Table, damaged

share = functools.cache(proportion)  # a board has few different counts


def figures(rows: Sequence[Row], suite: Suite) -> dict[str, Any]:
    """Of the rows of a cell: how many were played and failed, why, the share that came to damage, and two fingerprints."""
    rows = sorted(rows, key=lambda row: int(row["seed"]))  # a round's seeds are not played in ascending order
    good = [damaged(row, suite) for row in rows if row["status"] == "ok"]
    return {
        "n": len(good), "failed": sum(row["status"] == "error" for row in rows),
        "reason": next((row["reason"] for row in rows if row["status"] != "ok"), ""),
        "damage": share(sum(good), len(good))._asdict() if good else None,
        "decisions": _fingerprint(rows, "decision_hash"), "trace": _fingerprint(rows, "trace_hash"),
    }  # fmt: skip


def _fingerprint(rows: Sequence[Row], name: str) -> str:
    """Of one hash of every row of a cell. That of decisions is the same on every platform, that of traces on one."""
    told = "\n".join(f"{row['seed']} {row['status']} {row.get(name) or ''}" for row in rows)
    return hashlib.blake2b(told.encode(), digest_size=8).hexdigest()


def cells_of(table: Table) -> list[dict[str, Any]]:
    """Every cell that has rows, in the order of the suite, clean runs first."""
    columns = [column.attack for column in table.columns]
    order = sorted(table.cells, key=lambda key: (
        list(table.scenarios).index(key.scenario), key.slot, table.defences.index(key.defence),
        columns.index(key.column.attack) if key.column.attack in columns else -1, key.column.knowledge,
    ))  # fmt: skip
    out = []
    for key in order:
        rows = table.cells[key]
        out.append({
            "scenario": key.scenario, "dose": table.doses[key.slot], "defence": key.defence, "attack": key.column.attack,
            "knowledge": key.column.knowledge, "learned": bool(rows[0].get("learned")), "optimal": bool(rows[0].get("optimal")),
        } | figures(rows, table.suite))  # fmt: skip
    return out
