"""Episodes under injected values, differentiated: a closed loop in the torch form of the engine.

A schedule has a value for each step after a trigger has opened, each agent and each wire. All episodes share it, or each has its own.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from tailgate.agents.scripts.triggers import Trigger, idle
from tailgate.base.pytree import leaves
from tailgate.core import Array, Kind
from tailgate.core.draws import Keys, Role
from tailgate.core.loop import Loop
from tailgate.engine.parameters import lifted
from tailgate.engine.torch_form import TorchForm, tensor, torch
from tailgate.engine.tracing import traced


class Course(NamedTuple):
    """The course of episodes; tensors (K, B) that depend on the schedule, and the steps that count."""

    gap: torch.Tensor  # smallest gap of a car behind another [m]; inf where nobody drives
    error: torch.Tensor  # largest error of an estimate
    live: Array  # (K, B) bool: the episode has not ended before


class Injection:
    """A loop in which an attacker adds the values of a schedule to the wires.

    The budget and the lengths of bursts are left to the schedule: a step whose values are zero is no attack.
    """

    def __init__(self, loop: Loop, trigger: Trigger) -> None:
        threat = dataclasses.replace(loop.threat, budget=None, duration=None, cooldown=0)
        self.loop, self.trigger = dataclasses.replace(loop, threat=threat), trigger
        self._timing = trigger.prepare(self.loop.brief)
        one = self._begun(Keys(np.zeros((1, 3), np.uint64), np.zeros(1, np.uint32)))
        with np.errstate(all="ignore"):
            made = traced(self._step, one, {"value": np.zeros((1, *self.loop.brief.granted.shape))})
        self._form = TorchForm(made, ("gap", "error", "over", "on", "count"))

    @property
    def operations(self) -> int:
        """The operations of a step."""
        return self._form.operations

    def _begun(self, keys: Keys) -> dict[str, Any]:
        state, batch = self.loop.start(keys), len(keys.key)
        held = {"loop": state, "trigger": idle(batch, self.loop.model.agents)}
        return held | {"on": np.zeros(batch, bool), "count": np.zeros(batch, np.int64)} | self._looked(self.loop, held)

    def _looked(self, loop: Loop, held: dict[str, Any]) -> dict[str, Any]:
        """Return the trigger after it has looked at the road, whether it is on (B,), and the place in the schedule (B,)."""
        view, state = loop.sense(held["loop"]), held["loop"]
        trigger, on, count = self.trigger.step(self._timing, held["trigger"], view, state.keys.at(Role.ATTACK, state.k))
        return {"trigger": trigger, "on": on & view.allowed, "count": count}

    def _step(self, held: Any, given: Any) -> tuple[Any, Any]:
        loop, brief = lifted(held["loop"].k, self.loop), self.loop.brief
        over = held["loop"].ended
        state, frame = loop.advance(held["loop"], brief.command(held["on"], Kind.FDI, brief.granted, given["value"]))
        gap = np.min(np.where(loop.model.followers, frame.scene.gap, np.inf), axis=1)
        error = np.max(loop.model.error(frame.estimate.x, frame.truth), axis=1)
        after = self._looked(loop, {"loop": state, "trigger": held["trigger"]})
        made = {"gap": gap, "error": error, "over": over, "on": after["on"], "count": after["count"]}
        return {"loop": state} | after, made

    def play(self, keys: Keys, schedule: torch.Tensor) -> Course:
        """Play episodes under a schedule (T, N, w), or one for each of them (B, T, N, w).

        Returns
        -------
        Course
            With derivatives for the schedule. It ends early when all episodes have.
        """
        begun, batch = self._begun(keys), len(keys.key)
        episodes, on, count = self._form.start(leaves(begun)), begun["on"], begun["count"]
        rows, granted = torch.arange(batch), tensor(self.loop.brief.granted)
        columns: dict[str, list[Any]] = {"gap": [], "error": [], "live": []}
        with single_thread():
            for _ in range(self.loop.horizon):
                place = torch.from_numpy(np.minimum(count, schedule.shape[-3] - 1))
                sent = tensor(on & (count < schedule.shape[-3]))[:, None, None] & granted
                value: Any = np.zeros(sent.shape)
                if sent.any():
                    value = torch.where(sent, schedule[place] if schedule.ndim == 3 else schedule[rows, place], 0.0)
                made = episodes.step({"value": value})
                on, count = made["on"], made["count"]
                columns["live"].append(~made["over"])
                for name in ("gap", "error"):
                    columns[name].append(tensor(made[name]).expand(batch))
                if made["over"].all():
                    break
        return Course(torch.stack(columns["gap"]), torch.stack(columns["error"]), np.stack(columns["live"]))


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Let the library use one thread: its operations here are small, and threads would wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
