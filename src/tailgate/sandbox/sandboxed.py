"""`bwrap/module:Class` as a defence on any command line: somebody else's class, imported in a sandbox and nowhere else.

So it can be trained against, evaluated and replayed like any other. A board takes the rows of
`play_submission` only, in which its episodes are mixed with others in secret.
"""

from __future__ import annotations

import contextlib
import functools
import weakref
from dataclasses import dataclass, field

from tailgate.core import Array, Estimate, Model, Prior, Received
from tailgate.core.draws import Draws
from tailgate.core.registry import Entry
from tailgate.sandbox.isolated import Isolated, IsolatedPlan, Tickets
from tailgate.sandbox.limits import Limits
from tailgate.sandbox.process import Process
from tailgate.sandbox.sandbox import sandbox_of
from tailgate.sandbox.source import staged

WHITE = "a submission's state stays in its own process: white-box attacks cannot look ahead through it, and would tell it who is attacked"


@functools.lru_cache(maxsize=64)
def entry_of(program: str, text: str) -> Entry:
    """The entry of a class, as a process in the sandbox tells it. Raises Lost where that fails."""
    with staged(text) as source, Process(source.text, source.path, Limits(), sandbox_of(program)) as process:
        return Entry("defence", f"{program}/{source.text}", Sandboxed, **process.card)


def digest_of(text: str) -> str:
    """Of the files of a class; nothing is imported."""
    with staged(text) as source:
        return source.digest


@dataclass(frozen=True)
class Sandboxed:
    """A class that somebody else wrote. Each plan has a process of its own, which ends with the plan."""

    program: str
    text: str
    limits: Limits = field(default_factory=Limits)
    opaque = WHITE  # why nobody looks ahead through it

    def prepare(self, model: Model) -> IsolatedPlan:
        """A fresh process in the sandbox with the class imported and its constants made."""
        with contextlib.ExitStack() as stack:
            source = stack.enter_context(staged(self.text))
            plan = Isolated(source.text, source.path, self.limits, sandbox_of(self.program)).prepare(model)
            weakref.finalize(plan, stack.pop_all().close)  # the process ends with the plan, and its files go
        return plan

    def start(self, plan: IsolatedPlan, prior: Prior) -> Tickets:
        """States of B episodes."""
        return self._isolated.start(plan, prior)

    def step(self, plan: IsolatedPlan, state: Tickets, received: Received, known_u: Array, draws: Draws) -> tuple[Tickets, Estimate]:
        """One step of B episodes, its outputs checked."""
        return self._isolated.step(plan, state, received, known_u, draws)

    @property
    def _isolated(self) -> Isolated:
        return Isolated(self.text, None, self.limits)
