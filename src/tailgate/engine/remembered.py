"""Programs that are found again: by the key of what they were made of, and by what code asked of its numbers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from tailgate.engine import objects
from tailgate.engine.agreement import Untraced, explained
from tailgate.engine.graph import Graph
from tailgate.engine.parameters import Parameters, Reading

KEPT, EACH = 64, 8  # keys that are remembered, and things of each
_MINUS = np.array([-0.0]).view(np.uint64)[0]
T = TypeVar("T", bound="Programs")


class Programs(Protocol):
    """What is made of some things: programs."""

    @property
    def programs(self) -> Sequence[Any]: ...


class Answers:
    """What code asked while it was traced: it fits parameters that give the same answers."""

    def __init__(self, graphs: Sequence[Graph]) -> None:
        self._asked = [(Reading(graph, list(graph.asked[zero].values())), zero) for graph in graphs for zero in (False, True)]
        self._answers = [self._read(reading, zero) for reading, zero in self._asked]

    def fit(self, values: Sequence[np.ndarray[Any, Any]]) -> bool:
        """Do these parameters give the same answers?"""
        return all(self._read(*asked, values) == answer for asked, answer in zip(self._asked, self._answers, strict=True))

    @staticmethod
    def _read(reading: Reading, nonzero: bool, values: Any = None) -> bytes:
        bits = reading.bits(values)
        return ((bits != 0) & (bits != _MINUS) if nonzero else bits).tobytes()


class Remembered(Generic[T]):
    """Programs of things, by the key of their parameters: the last ones, of each key as many as gave other answers."""

    def __init__(self) -> None:
        self._held: dict[Any, list[tuple[Parameters, Answers, T]]] = {}
        self._lock = threading.Lock()

    def proved(
        self, held: Any, begin: Callable[[], Any], make: Callable[[], T], adopt: Callable[[T, list[Any]], T],
        difference: Callable[[T], str],
    ) -> T | Untraced:  # fmt: skip
        """The programs of things, once they have been found equal to the plain loop on this machine; or why there are none.

        begin: has things compute what they keep, which is among their parameters. adopt: takes programs over for parameters of other
        values. difference: says what differs from the plain loop, or nothing.
        """
        try:
            begin()
            parameters = Parameters(held)
            if found := self._find(parameters):
                return adopt(found, parameters.values)
            made = make()
        except Exception as error:  # whatever somebody's code raises where arrays are not numpy's
            return Untraced(explained(error))
        names = [f"{program.function.name}.{parameters.sources}" for program in made.programs]
        if not objects.proved(names):
            if differs := difference(made):
                return Untraced(f"traced code and the plain loop differ in {differs}")
            objects.prove(names)
        self._keep(parameters, [program.trace.graph for program in made.programs], made)
        return made

    def _find(self, parameters: Parameters) -> T | None:
        """What fits these parameters."""
        with self._lock:
            several = self._held.pop(parameters.key, None) if parameters.key is not None else None
            if several is None:
                return None
            self._held[parameters.key] = several  # the last one that was asked for
        return next((made for _, answers, made in several if answers.fit(parameters.values)), None)

    def _keep(self, parameters: Parameters, graphs: Sequence[Graph], made: T) -> None:
        """Remember what was made of these parameters, and what was asked in its graphs."""
        if parameters.key is None:
            return
        answers = Answers(graphs)
        with self._lock:
            several = self._held.pop(parameters.key, [])
            self._held[parameters.key] = [*several[1 - EACH :], (parameters, answers, made)]
            while len(self._held) > KEPT:
                del self._held[next(iter(self._held))]
