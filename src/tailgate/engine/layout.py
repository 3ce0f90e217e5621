"""Places of a program's numbers in memory, and what writers of code for every processor share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

from tailgate.engine.graph import Node
from tailgate.engine.passes import Branch, Item


@dataclass(frozen=True)
class Held:
    """The place of a number of the state: its offset in a block [bytes]."""

    offset: int


@dataclass(frozen=True)
class Column:
    """The place of a number in an array (episodes, columns), or (steps, episodes, columns), of the table."""

    array: int
    column: int
    columns: int


@dataclass
class Layout:
    """The places from which the function reads its numbers and to which it writes them."""

    inputs: dict[int, Held | Column]  # by node
    outputs: list[tuple[Node, Held | Column]]
    stride: int  # bytes of a block's state
    given: int = 0  # number of argument arrays; the arrays after them are results, on the sheet
    demands: list[Node] = field(default_factory=list)  # conditions that must hold
    uniforms: dict[int, int] = field(default_factory=dict)  # node -> its slot
    slots: list[Node] = field(default_factory=list)  # contents of the table of shared numbers
    tables: dict[tuple[int, ...], int] = field(default_factory=dict)  # consecutive nodes -> the slot of the first


class Writer(ABC):
    """A writer of code: it writes the items of a schedule in their order."""

    @abstractmethod
    def compute(self, node: Node) -> None:
        """Write the code of a node."""

    @abstractmethod
    def branch(self, branch: Branch) -> None:
        """Write the code of a branch."""

    @abstractmethod
    def store(self, node: Node, place: Held | Column) -> None:
        """Write a result to its place."""

    def emit(self, items: Sequence[Item], stores: dict[int, list[Held | Column]]) -> None:
        """Emit the items, and store each result as soon as nothing reads its place afterwards."""
        for item in items:
            if isinstance(item, Branch):
                self.branch(item)
                done = item.decides
            else:
                self.compute(item)
                done = [item]
            for node in done:
                for place in stores.pop(node.id, ()):
                    self.store(node, place)


def last_read(items: Sequence[Item], layout: Layout) -> dict[int, int]:
    """Return the last item that reads each number of the state, by offset."""
    out = {}
    for i, item in enumerate(items):
        if not isinstance(item, Branch) and item.op == "input" and isinstance(place := layout.inputs.get(item.id), Held):
            out[place.offset] = i
    return out
