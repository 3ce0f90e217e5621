"""A traced loop that takes each step's command from a plain attack.

One program serves all attacks on a defence in a scenario. `tailgate.play.rollouts` traces the attack too.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.pytree import duplicate, leaves, rebuilt
from tailgate.core import Array, Attack, Command, Kind, View, WhiteBox, draws, no_command
from tailgate.core.draws import Keys, Role
from tailgate.core.loop import Loop, LoopState
from tailgate.engine.agreement import ROWS, TRIED, Untraced, check_open, compared, raised, same
from tailgate.engine.cards import device
from tailgate.engine.parameters import lifted
from tailgate.engine.program import program_class
from tailgate.engine.remembered import Remembered
from tailgate.engine.tracing import traced
from tailgate.play.trace import Recorder, signals_of


class Seen(NamedTuple):
    """The arrays that an attacker sees; those of a white box, its state and known input, are separate."""

    view: View
    box: tuple[object, Array] | None


class Commanded:
    """The program of a loop that takes commands; tracing raises whatever the loop's parts raise."""

    def __init__(self, loop: Loop) -> None:
        check_open(loop)
        self.loop = loop
        self.values: list[Array] | None = None  # of the parameters, if they differ from the traced ones
        begun = _first(loop)
        self.rebuilt = rebuilt(_seen(loop, begun))
        self.program = program_class(device())(traced(self._traced, {"loop": begun}, _nothing(loop, 1)._asdict()))
        self.programs = (self.program,)
        results = list(self.program.trace.results)
        self.names = [name for name in results if name.startswith("seen.")]  # in the order of the leaves
        self.signals = [(name.partition(".")[2], name) for name in results if name.startswith("signals.")]

    def of(self, loop: Loop, values: list[Array]) -> Commanded:
        """Return the same program for a loop with other parameters."""
        out = copy.copy(self)
        out.loop, out.values = loop, values
        return out

    def _traced(self, held: dict[str, LoopState], given: dict[str, Array]) -> tuple[dict[str, LoopState], dict[str, Array]]:
        loop = lifted(held["loop"].k, self.loop)
        state, frame = loop.advance(held["loop"], Command(**given))
        return {"loop": state}, leaves({"signals": signals_of(frame), "ended": state.ended, "seen": _seen(loop, state)})

    def play(self, attack: Attack, keys: Keys, terminate: bool) -> tuple[Array, dict[str, Array], dict[str, Array]]:
        """Play episodes; return lengths (B,), signals (K, B, ...) and the road before the first step, as `Trace` holds them."""
        loop, batch = self.loop, len(keys.key)
        begun = loop.start(keys)
        plan = attack.prepare(loop.brief)
        memory = attack.start(plan, batch, keys.at(Role.ATTACK, np.zeros(batch, np.int64)))
        recorder, view, ended, steps = Recorder(loop, begun), loop.sense(begun), begun.ended, Steps(self, begun)
        for _ in range(loop.horizon):
            live = ~ended if terminate else np.ones(batch, bool)
            if not live.any():
                break
            memory, command = attack.decide(plan, memory, view, keys.at(Role.ATTACK, view.k))
            signals, ended, view = steps.play(command)
            recorder.put(signals, live)
        trace = recorder.trace()
        return trace.length, trace.signals, trace.first


class Steps:
    """The steps of a commanded loop, from a state of the plain loop on."""

    def __init__(self, commanded: Commanded, begun: LoopState) -> None:
        self.of, self.k = commanded, begun.k
        self.state = commanded.program.rows(len(begun.k))
        self.state.put({"loop": begun})
        self._call = commanded.program.call(self.state, values=commanded.values)

    def play(self, command: Command) -> tuple[dict[str, Array], Array, View]:
        """Play one step under a command; return its signals, who has ended (B,), and the attacker's view after it."""
        for name, leaf in zip(Command._fields, command, strict=True):
            self._call.arguments[name][...] = leaf
        self._call.begin()
        self._call.play(1)
        self._call.sheet.flags.writeable = False  # attacks read it
        results = self._call.results()
        if self._call.broken and not results["demands"].all():
            raise self.of.program.broken(results["demands"], self.k)
        self.k = results["seen.view.k"]
        signals = {name: results[full] for name, full in self.of.signals}
        return signals, results["ended"], _view(self.of.loop, self.of.rebuilt(results[name] for name in self.of.names))


def _first(loop: Loop) -> LoopState:
    """Return the first state of an episode, as an example."""
    return loop.start(draws.keys("tune", [0]))


def _nothing(loop: Loop, batch: int) -> Command:
    return no_command(batch, loop.model.agents, len(loop.model.wires))


def _seen(loop: Loop, state: LoopState) -> Seen:
    """Return the arrays that an attacker sees."""
    return _parted(loop.sense(state))


def _parted(view: View) -> Seen:
    box = view.defence
    return Seen(view._replace(defence=None), None if box is None else (box.state, box.known_u))


def _view(loop: Loop, seen: Seen) -> View:
    if seen.box is None:
        return seen.view
    state, known_u = seen.box
    return seen.view._replace(defence=WhiteBox(loop.defence, loop.shown, duplicate(state), known_u))


_made: Remembered[Commanded] = Remembered()


def commanded(loop: Loop) -> Commanded | Untraced:
    """Return the program of a loop that takes commands, if it equals the plain loop; else the reason why there is none."""
    return _made.proved(
        (loop, device()),
        lambda: (begun := _first(loop), _seen(loop, begun)),
        lambda: check_open(loop).advance(_first(loop), _nothing(loop, 1)),
        lambda: Commanded(loop),
        lambda found, values: found.of(loop, values),
        _difference,
    )


def _difference(made: Commanded) -> str:
    """Play some steps under random commands in both engines; return the first difference, or nothing."""
    return compared(lambda rows: _compared(made, rows))


def _compared(made: Commanded, rows: list[int]) -> str | tuple[InputError, int]:
    loop, chance = made.loop, np.random.default_rng(0)
    one = _nothing(loop, 1).target.shape[1:]
    kinds = [Kind[name.upper()] for name in loop.threat.kinds] or [Kind.NONE]
    state = loop.start(draws.keys("tune", rows))
    steps = Steps(made, state)
    for step in range(min(TRIED, loop.horizon)):
        drawn = (chance.random(ROWS), chance.choice(kinds, ROWS), chance.random((ROWS, *one)), chance.uniform(-2.0, 2.0, (ROWS, *one)))
        on, which, aim, value = (x[rows] for x in drawn)  # an episode does the same without the others
        kind = np.where(on < 0.5, which, 0).astype(np.int8)
        command = Command(kind, loop.brief.granted & (kind != 0)[:, None, None] & (aim < 0.5), value)
        found, got = raised(lambda: loop.advance(state, command)), raised(lambda: steps.play(command))  # noqa: B023
        if isinstance(found, InputError):
            return (found, step) if str(found) == str(got) else f"step {step + 1}: {found}"
        if isinstance(got, InputError):
            return f"step {step + 1}: {got}"
        state, frame = found
        wanted = leaves(state) | leaves({"signals": signals_of(frame), "seen": _seen(loop, state)})
        signals, _, view = got
        held = {name: steps.state.get_leaf(f"loop.{name}") for name in leaves(state)}
        held |= leaves({"signals": signals, "seen": _parted(view)})
        for name, leaf in wanted.items():
            if not same(held[name], leaf):
                return f"{name}, step {step + 1}"
    return ""
