"""Attacks of the standard ensemble on the first page of a board's site."""

from __future__ import annotations

from tailgate.board import searched
from tailgate.board.schema import Data

from .suite import Suite


def found_for(suite: Suite) -> dict[str, str]:
    """Return the defence that each attack of the ensemble was found against."""
    return searched.found_for(line.model_dump() for line in suite.board.searches)


def members_of(suite: Suite) -> Data | None:
    """Return what each member of the ensemble adds; None where nothing was searched."""
    lines = [line.model_dump() for line in suite.board.searches]
    if not lines:
        return None
    cells = [cell for line in lines for cell in line["cells"]]
    beaten = sum(any((member["damage"] or 0.0) > (cell["listed"] or 0.0) for member in cell["members"]) for cell in cells)
    rows = [row | {"mean": _points(row["damage"]), "points": _points(row["adds"])} for row in searched.worth(lines)]
    return {
        "rows": rows, "cells": len(cells), "defences": len(lines), "attacks": len(found_for(suite)), "beaten": beaten,
        "ensemble": ", ".join(sorted({line["ensemble"] for line in lines})), "budget": lines[0]["budget"],
    }  # fmt: skip


def _points(share: float | None) -> str:
    return "\N{EN DASH}" if share is None else f"{100.0 * share:.1f}"
