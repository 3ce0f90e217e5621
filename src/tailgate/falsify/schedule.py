"""Recorded commands, played again at the same steps: for all episodes, or others in each row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tailgate.base.errors import InputError, unknown
from tailgate.core import Array, Command, Kind, View
from tailgate.core.draws import Draws
from tailgate.core.threat import Brief
from tailgate.play.trace import Trace


@dataclass(frozen=True, eq=False)
class Schedule:
    """The commands of every step: kind (K, B) int8, target (K, B, N, w) bool, value (K, B, N, w). As an attack it needs no view."""

    kind: Array
    target: Array
    value: Array

    @property
    def on(self) -> Array:
        """(K, B) bool: the steps with a command."""
        return np.asarray(self.kind != 0)

    @property
    def steps(self) -> Array:
        """(B,) attacked steps."""
        return np.asarray(np.count_nonzero(self.kind, axis=0))

    def take(self, rows: Array) -> Schedule:
        """Return these rows."""
        return Schedule(self.kind[:, rows], self.target[:, rows], self.value[:, rows])

    def masked(self, keep: Array) -> Schedule:
        """Return the schedule with nothing done but where `keep` holds, (K, B) or (K, B, N, w); one row becomes B."""
        wide = keep if keep.ndim == 4 else keep[:, :, None, None]
        target = self.target & wide
        kind = np.where(target.any(axis=(2, 3)), self.kind, 0).astype(np.int8)
        return Schedule(kind, target, np.where(target, self.value, 0.0))

    def scaled(self, factor: Array) -> Schedule:
        """Return the schedule with its values times `factor`, (K, B); one row becomes B."""
        value = self.value * factor[:, :, None, None]
        kind, target = (np.broadcast_to(part, (*value.shape[:2], *part.shape[2:])) for part in (self.kind, self.target))
        return Schedule(kind, target, value)

    def prepare(self, brief: Brief) -> None:
        """Return nothing: the commands are known."""

    def start(self, plan: None, batch: int, draws: Draws) -> None:
        """Return nothing: there is nothing to remember."""

    def decide(self, plan: None, state: None, view: View, draws: Draws) -> tuple[None, Command]:
        """Return the commands of this step."""
        step = int(view.k[0]) - 1
        if step >= len(self.kind):
            return None, Command(np.zeros_like(self.kind[0]), np.zeros_like(self.target[0]), np.zeros_like(self.value[0]))
        return None, Command(self.kind[step].copy(), self.target[step].copy(), self.value[step].copy())

    def as_data(self, wires: tuple[str, ...]) -> list[dict[str, Any]]:
        """Return the commands of the only row as JSON data."""
        out = []
        for k in np.flatnonzero(self.kind[:, 0]).tolist():
            hits = [{"agent": int(i), "wire": wires[j], "value": float(self.value[k, 0, i, j])} for i, j in np.argwhere(self.target[k, 0])]
            out.append({"k": k + 1, "kind": Kind(int(self.kind[k, 0])).name.lower(), "hits": hits})
        return out


def recorded(trace: Trace, horizon: int) -> Schedule:
    """Return the commands that took effect in the only episode of a trace."""
    steps, shape = int(trace.length[0]), trace.target.shape[2:]
    kind, target, value = np.zeros((horizon, 1), np.int8), np.zeros((horizon, 1, *shape), bool), np.zeros((horizon, 1, *shape))
    kind[:steps], target[:steps] = trace.kind[:steps], trace.target[:steps]
    value[:steps] = np.where(target[:steps], trace.value[:steps], 0.0)
    return Schedule(kind, target, value)


def from_data(data: object, brief: Brief, where: str) -> Schedule:
    """Return a schedule of one row from JSON data.

    Raises
    ------
    InputError
        For a step, kind, agent, wire or value that does not exist here.
    """
    wires, agents = brief.model.wires, brief.model.agents
    shape = (brief.horizon, 1, agents, len(wires))
    kind, target, value = np.zeros(shape[:2], np.int8), np.zeros(shape, bool), np.zeros(shape)
    if not isinstance(data, list):
        raise InputError(where, data, "a list of commands")
    for one in data:
        try:
            k, name, hits = one["k"], one["kind"], one["hits"]
            found = [(hit["agent"], hit["wire"], float(hit["value"])) for hit in hits]
        except (KeyError, TypeError, ValueError):
            raise InputError(where, one, "a command with k, kind and hits, each with agent, wire and value") from None
        if type(k) is not int or not 1 <= k <= brief.horizon or kind[k - 1, 0]:
            raise InputError(f"{where}.k", k, f"a step from 1 to {brief.horizon}, each at most once")
        if not isinstance(name, str) or name not in brief.threat.kinds:
            raise unknown(f"{where}.kind", name, brief.threat.kinds)
        kind[k - 1] = Kind[name.upper()]
        for agent, wire, number in found:
            if type(agent) is not int or not 0 <= agent < agents or wire not in wires or not np.isfinite(number):
                raise InputError(f"{where}.hits", [agent, wire, number], f"an agent below {agents}, one of {', '.join(wires)}, a number")
            target[k - 1, 0, agent, wires.index(wire)], value[k - 1, 0, agent, wires.index(wire)] = True, number
    return Schedule(kind, target, value)
