"""The first results of a defence and of an attack that failed: which one has a wrong shape. Nothing here is played unless a cell fails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Attack
from tailgate.core.draws import Keys, Role
from tailgate.core.loop import Loop
from tailgate.core.nouns import Command

OUTPUT = "defence output"  # with which the loop's own errors on a defence's result begin


def culprit(error: Exception, loop: Loop, attack: Attack, keys: Keys) -> str:
    """Return which class's result has a wrong shape, and the shape that is expected; empty where the error has another cause.

    Parameters
    ----------
    error
        That the episodes of these keys raised.
    loop, attack, keys
        As they were played.
    """
    if isinstance(error, InputError):
        return f"the step of {_name(loop.defence)}" if error.field.startswith(OUTPUT) and error.row is None else ""
    try:
        state = loop.start(keys)
        plan, batch = attack.prepare(loop.brief), len(state.k)
        memory = attack.start(plan, batch, keys.at(Role.ATTACK, np.zeros(batch, np.int64)))
        answer: Any = attack.decide(plan, memory, loop.sense(state), keys.at(Role.ATTACK, state.k))
    except Exception:  # the error itself says where
        return ""
    return _wrong(f"decide of {_name(attack)}", answer, batch, (loop.model.agents, len(loop.model.wires)))


def _wrong(what: str, answer: Any, batch: int, wires: tuple[int, int]) -> str:
    """Return what is wrong with the result of an attack; empty where nothing is."""
    if not isinstance(answer, tuple) or len(answer) != 2 or not isinstance(answer[1], Command):
        got = f"({', '.join(type(part).__name__ for part in answer)})" if type(answer) is tuple else type(answer).__name__
        return f"{what}: got {got}; expected a pair (state, Command)"
    shapes: dict[str, Sequence[int]] = {"kind": (batch,), "target": (batch, *wires), "value": (batch, *wires)}
    for name, shape in shapes.items():
        got = np.shape(getattr(answer[1], name))
        if got != shape:
            return f"{what}, {name}: got {got}; expected an array of shape {shape}"
    return ""


def _name(component: object) -> str:
    return type(component).__name__
