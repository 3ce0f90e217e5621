"""A defence whose class is imported only in another process."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from tailgate.core import Array, Estimate, Model, Prior, Received
from tailgate.core.draws import Draws
from tailgate.core.veil import secret
from tailgate.sandbox.limits import Limits
from tailgate.sandbox.process import Process
from tailgate.sandbox.sandbox import Sandbox
from tailgate.sandbox.wire import Outputs, model_arrays

_AHEAD = 50  # steps per grant of processor time


class Veiled(NamedTuple):
    """Keys as the process gets them, with the original keys."""

    key: Array  # (B,) uint64
    episode: Array  # (B,)
    shown: Array  # (B,) uint64
    veil: bytes


class Tickets(NamedTuple):
    """Numbers of the states that the process keeps, one per row. The process keeps the most recently used ones."""

    row: Array  # (B,) int64


@dataclass(eq=False)
class IsolatedPlan:
    """A process with the model prepared, and its grants."""

    process: Process
    model: Model
    ticket: int = 0
    granted: int = 0  # rows times steps still granted
    veiled: Veiled | None = None


@dataclass(eq=False)
class Isolated:
    """A defence "module:Class:key=value" that runs in a separate process; `prepare` starts one for each plan.

    The state stays in that process, so the loop's state holds only tickets.
    Close it, or use it as a context manager, to end the processes.
    """

    untraced: ClassVar[str] = "another process plays it"  # why the engine uses the plain loop
    text: str
    source: Path | None = None  # directory from which the class is imported, in addition to installed packages
    limits: Limits = field(default_factory=Limits)
    sandbox: Sandbox | None = None
    plans: list[IsolatedPlan] = field(default_factory=list)

    @property
    def card(self) -> dict[str, Any]:
        """The uses, version and reference of the class, from a process that ends at once."""
        with Process(self.text, self.source, self.limits, self.sandbox) as process:
            return process.card

    def prepare(self, model: Model) -> IsolatedPlan:
        """Start a process, import the class, and prepare its constants."""
        plan = IsolatedPlan(Process(self.text, self.source, self.limits, self.sandbox), model)
        self.plans.append(plan)
        arrays, rest = model_arrays(model)
        plan.process.ask("prepare", arrays, rest=rest)
        return plan

    def start(self, plan: IsolatedPlan, prior: Prior) -> Tickets:
        """Start B episodes."""
        batch = len(prior.mean)
        plan.process.ask("start", {"mean": prior.mean, "cov": prior.cov}, ticket=plan.ticket)
        return _tickets(plan, batch)

    def step(
        self, plan: IsolatedPlan, state: Tickets, received: Received, known_u: Array, draws: Draws
    ) -> tuple[Tickets, Estimate]:
        """Play one step; types and shapes are correct, and the loop or the caller checks the numbers.

        The draws hold only the key of the party `defence`: a separate hash that reveals no other party's key.
        """
        batch, model = len(received.y), plan.model
        plan.granted -= batch
        if plan.granted < 0:
            plan.granted += _AHEAD * batch
            plan.process.grant(self.limits.steps(_AHEAD, batch, model.agents))
        arrays = {name: value for name, value in received._asdict().items() if value is not None}
        key, episode = _shown(plan, draws)
        arrays |= {"known_u": known_u, "ticket": state.row, "key": key, "episode": episode, "step": draws.step}
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


def _shown(plan: IsolatedPlan, draws: Draws) -> tuple[Array, Array]:
    """Return the key and number of each episode (B,), as the process may know them."""
    veil = secret()
    if not veil:
        return draws.key, draws.episode
    held = plan.veiled
    if held is None or held.veil != veil or len(held.key) != len(draws.key):
        stale, shown = np.ones(len(draws.key), bool), np.zeros_like(draws.key)
    else:
        stale, shown = (held.key != draws.key) | (held.episode != draws.episode), held.shown.copy()
    for i in np.flatnonzero(stale):
        digest = hashlib.blake2b(f"{int(draws.key[i])}/{int(draws.episode[i])}".encode(), key=veil, digest_size=8).digest()
        shown[i] = int.from_bytes(digest, "little")
    plan.veiled = Veiled(draws.key.copy(), draws.episode.copy(), shown, veil)
    return shown, np.zeros_like(draws.episode)


def _tickets(plan: IsolatedPlan, batch: int) -> Tickets:
    first = plan.ticket
    plan.ticket += batch
    return Tickets(np.arange(first, first + batch))
