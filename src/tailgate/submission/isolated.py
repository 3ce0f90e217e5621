"""A defence whose class only another process imports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tailgate.core import Array, Estimate, Model, Prior, Received
from tailgate.draws import Draws
from tailgate.loop import check_estimate
from tailgate.submission.limits import Limits
from tailgate.submission.process import Process
from tailgate.submission.sandbox import Sandbox
from tailgate.submission.wire import Outputs, model_arrays

_AHEAD = 50  # steps whose processor time is granted at once


class Tickets(NamedTuple):
    """What stands for the states that the process keeps: the number of each row's. The process keeps those that were used last."""

    row: Array  # (B,) int64


@dataclass(eq=False)
class IsolatedPlan:
    """A process with the model prepared, and what was granted to it."""

    process: Process
    model: Model
    ticket: int = 0
    granted: int = 0  # rows times steps that are still granted


@dataclass(eq=False)
class Isolated:
    """A defence that stands for "module:Class:key=value" and plays it in a process of its own; `prepare` starts one for each plan.

    State stays in that process, so that the loop's state holds tickets only. Close it, or use it in a `with`, to end the processes.
    """

    text: str
    source: Path | None = None  # directory that the class is imported from, beside what is installed
    limits: Limits = field(default_factory=Limits)
    sandbox: Sandbox | None = None
    plans: list[IsolatedPlan] = field(default_factory=list)

    @property
    def card(self) -> dict[str, Any]:
        """uses, version and reference of the class, asked of a process that ends at once."""
        with Process(self.text, self.source, self.limits, self.sandbox) as process:
            return process.card

    def prepare(self, model: Model) -> IsolatedPlan:
        """A fresh process with the class imported and its constants made."""
        plan = IsolatedPlan(Process(self.text, self.source, self.limits, self.sandbox), model)
        self.plans.append(plan)
        arrays, rest = model_arrays(model)
        plan.process.ask("prepare", arrays, rest=rest)
        return plan

    def start(self, plan: IsolatedPlan, prior: Prior) -> Tickets:
        """States of B episodes."""
        batch = len(prior.mean)
        plan.process.ask("start", {"mean": prior.mean, "cov": prior.cov}, ticket=plan.ticket)
        return _tickets(plan, batch)

    def step(self, plan: IsolatedPlan, state: Tickets, received: Received, known_u: Array, draws: Draws) -> tuple[Tickets, Estimate]:
        """One step of B episodes, its outputs checked."""
        state, estimate = self.step_unchecked(plan, state, received, known_u, draws)
        check_estimate(estimate, plan.model, len(received.y))
        return state, estimate

    def step_unchecked(
        self, plan: IsolatedPlan, state: Tickets, received: Received, known_u: Array, draws: Draws
    ) -> tuple[Tickets, Estimate]:
        """One step; types and shapes are right, numbers may be anything. For who checks row by row, as the mixed batches do.

        The draws hold the key of the party `defence` alone: a hash of its own, which tells nothing of the other parties' keys.
        """
        batch, model = len(received.y), plan.model
        plan.granted -= batch
        if plan.granted < 0:
            plan.granted += _AHEAD * batch
            plan.process.grant(self.limits.steps(_AHEAD, batch, model.agents))
        arrays = {name: value for name, value in received._asdict().items() if value is not None}
        arrays |= {"known_u": known_u, "ticket": state.row, "key": draws.key, "episode": draws.episode, "step": draws.step}
        outputs = Outputs(batch, model.agents, model.states, len(model.actuators))
        plan.process.make_room(outputs)
        answer = plan.process.ask("step", arrays, stream=int(draws.stream), ticket=plan.ticket)
        found = plan.process.read(outputs)
        fields: dict[str, Any] = found if answer.get("limits") is True else found | {"limits": None}
        return _tickets(plan, batch), Estimate(**fields)

    def close(self) -> None:
        """End the processes of all plans."""
        for plan in self.plans:
            plan.process.close()
        self.plans.clear()

    def __enter__(self) -> Isolated:
        return self

    def __exit__(self, *_: Sequence[Any]) -> None:
        self.close()


def _tickets(plan: IsolatedPlan, batch: int) -> Tickets:
    first = plan.ticket
    plan.ticket += batch
    return Tickets(np.arange(first, first + batch))
