"""Episodes under injected values, differentiated: a closed loop in machine code, forwards and backwards.

A schedule has a value for each step after a trigger has opened, each agent and each wire. All episodes share it, or each has its own.
Where the engine has no rule for an operation of the loop, the torch form plays it, which takes ten times as long or more.
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
from tailgate.engine.adjoint import Adjoint, Tape
from tailgate.engine.parameters import lifted
from tailgate.engine.torch_form import TorchForm, tensor, torch
from tailgate.engine.tracing import Trace, traced
from tailgate.engine.untraceable import Untraceable

RESULTS = "gap", "error", "over", "on", "count"


class Course(NamedTuple):
    """The course of episodes; tensors (K, B) that depend on the schedule, and the steps that count."""

    gap: torch.Tensor  # smallest gap of a car behind another [m]; inf where nobody drives
    error: torch.Tensor  # largest error of an estimate
    live: Array  # (K, B) bool: the episode has not ended before


class Injection:
    """A loop in which an attacker adds the values of a schedule to the wires.

    The budget and the lengths of bursts are left to the schedule: a step whose values are zero is no attack.
    compiled: False leaves all derivatives to PyTorch, which gives the same, slowly.
    """

    def __init__(self, loop: Loop, trigger: Trigger, compiled: bool = True) -> None:
        threat = dataclasses.replace(loop.threat, budget=None, duration=None, cooldown=0)
        self.loop, self.trigger = dataclasses.replace(loop, threat=threat), trigger
        self._timing = trigger.prepare(self.loop.brief)
        one = self._begun(Keys(np.zeros((1, 3), np.uint64), np.zeros(1, np.uint32)))
        with np.errstate(all="ignore"):
            made = traced(self._step, one, {"value": np.zeros((1, *self.loop.brief.granted.shape))})
        self._form = (_compiled(made) if compiled else None) or TorchForm(made, RESULTS)

    @property
    def compiled(self) -> bool:
        """If machine code computes the derivatives."""
        return isinstance(self._form, Adjoint)

    @property
    def numbers(self) -> int:
        """The numbers that derivatives keep of a step, about."""
        return self._form.numbers

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
        if isinstance(self._form, Adjoint):
            gap, error, live = _Injected.apply(schedule, self, keys)  # type: ignore[no-untyped-call]
            return Course(gap, error, live.numpy())
        begun, batch = self._begun(keys), len(keys.key)
        episodes, on, count = self._form.start(leaves(begun)), begun["on"], begun["count"]
        columns: dict[str, list[Any]] = {"gap": [], "error": [], "live": []}
        with single_thread():
            for _ in range(self.loop.horizon):
                sent, place = self.sent(on, count, schedule.shape[-3])
                value: Any = np.zeros(sent.shape)
                if sent.any():
                    value = torch.where(tensor(sent), schedule[place if schedule.ndim == 3 else (np.arange(batch), place)], 0.0)
                made = episodes.step({"value": value})
                on, count = made["on"], made["count"]
                columns["live"].append(~made["over"])
                for name in ("gap", "error"):
                    columns[name].append(tensor(made[name]).expand(batch))
                if made["over"].all():
                    break
        return Course(torch.stack(columns["gap"]), torch.stack(columns["error"]), np.stack(columns["live"]))

    def sent(self, on: Array, count: Array, length: int) -> tuple[Array, Array]:
        """Return which values (B, N, w) of a schedule are sent, and the step (B,) of the schedule."""
        return (on & (count < length))[:, None, None] & self.loop.brief.granted, np.minimum(count, length - 1)

    def taped(self, keys: Keys, schedule: Array) -> tuple[Tape, Array, Array]:
        """Play episodes by machine code; return them with what is sent (K, B, N, w), and the steps of the schedule (K, B)."""
        assert isinstance(self._form, Adjoint)
        begun, rows = self._begun(keys), np.arange(len(keys.key))
        tape, on, count = self._form.start(leaves(begun), self.loop.horizon), begun["on"], begun["count"]
        sends, places = [], []
        for _ in range(self.loop.horizon):
            sent, place = self.sent(on, count, schedule.shape[-3])
            value = np.where(sent, schedule[place if schedule.ndim == 3 else (rows, place)], 0.0) if sent.any() else np.zeros(sent.shape)
            made = tape.step({"value": value})
            on, count = made["on"], made["count"]
            sends.append(sent)
            places.append(place)
            if made["over"].all():
                break
        return tape, np.stack(sends), np.stack(places)


def _compiled(trace: Trace) -> Adjoint | None:
    """Return the derivatives of a trace by machine code, if there is a rule for each of its operations."""
    try:
        return Adjoint(trace, RESULTS, ("gap", "error"))
    except Untraceable:
        return None


class _Injected(torch.autograd.Function):
    """Gaps, errors and live steps (K, B) of episodes under a schedule, with its slopes."""

    @staticmethod
    def forward(ctx: Any, schedule: torch.Tensor, injection: Injection, keys: Keys) -> tuple[torch.Tensor, ...]:
        ctx.shape, ctx.played = schedule.shape, injection.taped(keys, schedule.detach().numpy())
        tape, sends, _ = ctx.played
        gap, error, over = (tape.results[name][: len(sends)] for name in ("gap", "error", "over"))
        live = torch.from_numpy(~over)
        ctx.mark_non_differentiable(live)
        return torch.from_numpy(gap), torch.from_numpy(error), live

    @staticmethod
    def backward(ctx: Any, *slopes: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        tape, sends, places = ctx.played
        found = np.where(sends, tape.backwards({"gap": slopes[0].numpy(), "error": slopes[1].numpy()})["value"], 0.0)
        out, used = np.zeros(ctx.shape), sends.any(axis=(2, 3))
        rows = np.broadcast_to(np.arange(tape.episodes), used.shape)[used]
        np.add.at(out, places[used] if out.ndim == 3 else (rows, places[used]), found[used])
        return torch.from_numpy(out), None, None


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Let the library use one thread: its operations here are small, and threads would wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
