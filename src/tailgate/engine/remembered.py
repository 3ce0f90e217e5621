"""Cached programs, found by the key of their parameters, the form of their state and the answers that the code asked for."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np

from tailgate.base.pytree import leaves
from tailgate.engine import objects
from tailgate.engine.agreement import Untraced, explained
from tailgate.engine.graph import Graph
from tailgate.engine.operations import Array
from tailgate.engine.parameters import Contents, Parameters, Reading, Snapshot

if TYPE_CHECKING:
    from tailgate.engine.program import Program

KEPT, EACH = 64, 8  # keys that are cached, and variants per key
_MINUS = np.array([-0.0]).view(np.uint64)[0]
T = TypeVar("T", bound="Programs")


class Programs(Protocol):
    """A group of programs, such as those of one loop."""

    @property
    def programs(self) -> Sequence[Program]: ...


class Answers:
    """The answers that code asked for while it was traced; it fits parameters that give the same answers."""

    def __init__(self, graphs: Sequence[Graph]) -> None:
        self._asked = [(Reading(graph, list(graph.asked[zero].values())), zero) for graph in graphs for zero in (False, True)]
        self._answers = [self._read(reading, zero) for reading, zero in self._asked]

    def fit(self, values: Sequence[Array]) -> bool:
        """Return True if these parameters give the same answers."""
        return all(self._read(*asked, values) == answer for asked, answer in zip(self._asked, self._answers, strict=True))

    @property
    def told(self) -> str:
        """A hash of the answers."""
        return hashlib.sha256(b"/".join(self._answers)).hexdigest()

    @staticmethod
    def _read(reading: Reading, nonzero: bool, values: Sequence[Array] | None = None) -> bytes:
        bits = reading.bits(values)
        return ((bits != 0) & (bits != _MINUS) if nonzero else bits).tobytes()


class Remembered(Generic[T]):
    """A cache of programs by the key of their parameters and the form of their state, with several variants per key for other answers."""

    def __init__(self) -> None:
        self._held: dict[Any, list[tuple[Parameters, Answers, T]]] = {}
        self._lock = threading.Lock()

    def proved(
        self, held: object, begin: Callable[[], object], play: Callable[[], object], make: Callable[[], T],
        adopt: Callable[[T, list[Array]], T], difference: Callable[[T], str],
    ) -> T | Untraced:  # fmt: skip
        """Return programs that equal the plain loop on this machine, or the reason why there are none.

        Parameters
        ----------
        held : the objects whose parameters the programs use
        begin : returns the first state, and lets the objects compute what they cache, because that is among their parameters
        play : plays a step plainly, so that what code remembers of it is numbers and no nodes
        make : traces and compiles the programs
        adopt : adapts cached programs to other parameter values
        difference : names what differs from the plain loop; empty if nothing does
        """
        contents: Contents | None = None
        try:
            form = _form(begin())
            for played in (False, True):  # a step may fill caches, which then are parameters too
                if played:
                    with np.errstate(all="ignore"):
                        play()
                parameters = Parameters(held)
                contents = contents or parameters.own_contents()
                if parameters.unknown:
                    contents.put_back()
                    return Untraced(f"somebody's code reads {parameters.unknown}: keep what changes in the state that start returns")
                key = None if parameters.key is None else (form, parameters.key)
                if found := self._find(key, parameters):
                    return adopt(found, parameters.values)
            first = parameters.snapshot()
            with parameters.restored():
                made = make()
            answers = Answers([program.trace.graph for program in made.programs])
            told = parameters.told and parameters.told + answers.told
            names = [f"{program.function.name}.{parameters.sources}{told}" for program in made.programs]
            if not objects.proved(names):
                if why := _apart(held, first, begin, play, lambda: difference(made)):
                    _put_back(contents)
                    return Untraced(why)
                objects.prove(names)
        except Exception as error:  # a plug-in may raise anything when arrays are not numpy's
            _put_back(contents)
            return Untraced(explained(error))
        self._keep(key, parameters, answers, made)
        return made

    def _find(self, key: object, parameters: Parameters) -> T | None:
        """Return cached programs that fit these parameters."""
        with self._lock:
            several = self._held.pop(key, None) if key is not None else None
            if several is None:
                return None
            self._held[key] = several  # now the most recently used
        return next((made for _, answers, made in several if answers.fit(parameters.values)), None)

    def _keep(self, key: object, parameters: Parameters, answers: Answers, made: T) -> None:
        """Cache the programs of these parameters, with the answers that their graphs asked for."""
        if key is None:
            return
        with self._lock:
            several = self._held.pop(key, [])
            self._held[key] = [*several[1 - EACH :], (parameters, answers, made)]
            while len(self._held) > KEPT:
                del self._held[next(iter(self._held))]


def _put_back(contents: Contents | None) -> None:
    """Let the plain loop begin with the objects as they were."""
    if contents is not None:
        contents.put_back()


def _apart(held: object, first: Snapshot, begin: Callable[[], object], play: Callable[[], object], difference: Callable[[], str]) -> str:
    """Return why traced code must not play: how it differs from the plain loop, or what a step writes to; empty if it may."""
    if differs := difference():
        return f"traced code and the plain loop differ in {differs}"
    if first.changed(Parameters(held).snapshot()):  # once, as a cache that is filled, or in every step?
        begin()
        before = Parameters(held).snapshot()
        for steps in (play, difference):  # one step and several: what is written last differs
            with np.errstate(all="ignore"):
                steps()
            if wrote := before.changed(Parameters(held).snapshot()):
                return f"a step writes to {wrote}: keep what changes in the state that start returns"
    return ""


def _form(state: object) -> tuple[Any, ...]:
    """Return the name, the shape of a row and the type of each leaf; code may ask for a leaf instead of a parameter."""
    return tuple((name, leaf.shape[1:], leaf.dtype.str) for name, leaf in leaves(state).items())
