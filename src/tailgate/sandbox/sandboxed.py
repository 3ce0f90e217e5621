"""The defence `bwrap/module:Class`: a submitted class that is imported only in a sandbox, on any command line.

It can be trained against, evaluated and replayed like any other defence.
A board takes only the rows of `play_submission`, which mixes its episodes with others in secret.
"""

from __future__ import annotations

import contextlib
import functools
import weakref
from dataclasses import dataclass, field

from tailgate.base.errors import InputError
from tailgate.core import Array, Estimate, Model, Prior, Received
from tailgate.core.draws import Draws
from tailgate.core.registry import Entry
from tailgate.sandbox.isolated import Isolated, IsolatedPlan, Tickets
from tailgate.sandbox.limits import Limits, Lost
from tailgate.sandbox.process import Process
from tailgate.sandbox.sandbox import sandbox_of
from tailgate.sandbox.source import staged

WHITE = "a submission's state stays in its own process: white-box attacks cannot look ahead through it, and would tell it who is attacked"


@functools.lru_cache(maxsize=64)
def entry_of(program: str, text: str) -> Entry:
    """Return the entry of a class from a process in the sandbox; raise InputError if that fails."""
    try:
        with staged(text) as source, Process(source.text, source.path, Limits(), sandbox_of(program)) as process:
            return Entry("defence", f"{program}/{source.text}", Sandboxed, **process.card)
    except Lost as why:
        raise InputError("defence", f"{program}/{text}", f"a class that its process can load and make ({why})") from None


def digest_of(text: str) -> str:
    """Return the digest of a class's files, without importing them."""
    with staged(text) as source:
        return source.digest


@dataclass(frozen=True)
class Sandboxed:
    """A submitted class. Each plan has a separate process, which ends with the plan."""

    program: str
    text: str
    limits: Limits = field(default_factory=Limits)
    opaque = WHITE  # why attacks cannot look ahead through it

    def prepare(self, model: Model) -> IsolatedPlan:
        """Start a process in the sandbox, import the class, and prepare its constants."""
        with contextlib.ExitStack() as stack:
            source = stack.enter_context(staged(self.text))
            plan = Isolated(source.text, source.path, self.limits, sandbox_of(self.program)).prepare(model)
            weakref.finalize(plan, stack.pop_all().close)  # ends the process and removes its files with the plan
        return plan

    def start(self, plan: IsolatedPlan, prior: Prior) -> Tickets:
        """Start B episodes."""
        return self._isolated.start(plan, prior)

    def step(self, plan: IsolatedPlan, state: Tickets, received: Received, known_u: Array, draws: Draws) -> tuple[Tickets, Estimate]:
        """Play one step of B episodes and check its outputs."""
        return self._isolated.step(plan, state, received, known_u, draws)

    @property
    def _isolated(self) -> Isolated:
        return Isolated(self.text, None, self.limits)
