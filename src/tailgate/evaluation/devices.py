"""Cells on a card: what cannot be played there is refused before anything is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tailgate.base.errors import InputError, NotApplicable
from tailgate.core.registry import Spec
from tailgate.engine.agreement import Untraced
from tailgate.engine.cards import DeviceError, device, playing_on

if TYPE_CHECKING:
    from tailgate.core.loop import Loop
    from tailgate.evaluation.cells import Cell


def check_cells(cells: Sequence[Cell], workers: int = 1) -> None:
    """Raise InputError for a cell that this device cannot play: its code is not traced, or several processes were asked for."""
    here = device()
    if here == "cpu":
        return
    if workers > 1:
        raise InputError("workers", workers, f"1 with the device {here}: one process plays on a card")
    known: set[tuple[str, str, str]] = set()
    for cell in cells:
        attack = Spec("attack", cell.attack)
        made = attack.make()
        place = cell.place(made, attack.entry.knowledge)
        key = (cell.scenario, cell.defence, place.threat_model.knowledge)
        if key in known:
            continue
        known.add(key)
        if why := _opaque(cell, made):
            raise DeviceError("device", here, f"cpu for {cell.defence} in {cell.scenario}: {why}")


def untraced(loop: Loop) -> str:
    """Return why a loop cannot be traced, or nothing. This processor's code is made in little time, and of the same trace."""
    from tailgate.play.commanded import commanded

    with playing_on("cpu"):
        found = commanded(loop)
    return found.why if isinstance(found, Untraced) else ""


def _opaque(cell: Cell, attack: object) -> str:
    """Return why the loop of a cell cannot be traced, or nothing."""
    defence, spec = Spec("defence", cell.defence), Spec("attack", cell.attack)
    try:
        loop = cell.place(attack, spec.entry.knowledge).loop(defence.make(), defence.entry.uses)  # type: ignore[arg-type]
    except (NotApplicable, InputError):
        return ""  # its rows say so
    return untraced(loop)
