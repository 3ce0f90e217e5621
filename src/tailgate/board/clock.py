"""Step times of defences: step_time.json of a board, which as a pure function of rows says nothing of clocks.

A round is the first 200 steps of an episode, for all its agents, without an attack, in the plain loop. The first round is not counted.
Rounds of all defences are played in turn, so that a busy moment meets them all.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, Generic

from tailgate.base import sizes
from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.provenance import commit, processor
from tailgate.base.version import VERSION
from tailgate.core import Array, Defence, Estimate, Received, draws, no_command
from tailgate.core.draws import Draws
from tailgate.core.loop import Loop
from tailgate.core.nouns import P, S
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_scenario

from .attachments import Clock, StepTime

ROUNDS, MOST = 5, 200  # episodes of each defence that count; steps of an episode that are looked at
Progress = Callable[[int, int], None]


class Timed(Generic[P, S]):
    """A defence that records the time of each of its steps [ns]."""

    def __init__(self, defence: Defence[P, S]) -> None:
        self.defence = defence
        self.taken: list[int] = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "defence":  # of a copy that has no attributes yet
            raise AttributeError(name)
        return getattr(self.defence, name)

    def step(self, plan: P, state: S, received: Received, known_u: Array, draws: Draws) -> tuple[S, Estimate]:
        began = time.perf_counter_ns()
        answer = self.defence.step(plan, state, received, known_u, draws)
        self.taken.append(time.perf_counter_ns() - began)
        return answer


def _round(loop: Loop, timed: Timed, seed: int) -> float:
    """Return the median time of the first steps of a clean episode [us]."""
    timed.taken.clear()
    state, nothing = loop.start(draws.keys("calibrate", [seed])), no_command(1, loop.model.agents, len(loop.model.wires))
    for _ in range(min(loop.horizon, MOST)):
        if state.ended.all():
            break
        state, _ = loop.advance(state, nothing)
    return float(statistics.median(timed.taken)) / 1e3


def measure(suite: Suite, defences: Sequence[str] = (), *, rounds: int = ROUNDS, progress: Progress | None = None) -> Clock:
    """Measure step times of a suite's registered defences in its first scenario. Those that mean nothing there are left out.

    The first round of each loads what the defence needs. Raises InputError for a defence that does not exist, that fails, or that is an
    unregistered class. The same goes for a named one that means nothing there, and if none is left.
    """
    sizes.check("rounds", rounds)
    scenario = load_scenario(suite.scenarios[0])
    seats: dict[str, tuple[Loop, Timed]] = {}
    for text in dict.fromkeys(defences or suite.defences):
        spec = Spec("defence", text)
        spec.refuse_imports("step times")
        timed = Timed(spec.make())
        try:
            loop = scenario.loop(timed, spec.entry.uses)
            _round(loop, timed, 0)
        except NotApplicable:
            if defences:
                raise
            continue
        seats[text] = loop, timed
    if not seats:
        raise InputError("defences", list(suite.defences), f"one that means something in {scenario.name}")
    taken: dict[str, list[float]] = {text: [] for text in seats}
    for seed in range(1, rounds + 1):
        for i, (text, (loop, timed)) in enumerate(seats.items()):
            taken[text].append(_round(loop, timed, seed))
            if progress is not None:
                progress((seed - 1) * len(seats) + i + 1, rounds * len(seats))
    entries = [
        StepTime(defence=text, median=round(statistics.median(us), 1), low=round(min(us), 1), high=round(max(us), 1))
        for text, us in taken.items()
    ]
    model = next(iter(seats.values()))[0].model
    return Clock(
        suite=suite.name, scenario=scenario.name, agents=model.agents, rounds=rounds, processor=processor(),
        version=VERSION, commit=commit(), entries=entries,
    )  # fmt: skip
