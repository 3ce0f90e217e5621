"""The places of words in a picture: next to what they name, clear of each other, of the cars and of the marks.

The first to ask has the choice, so that the important ask first; a word without a place is left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

Spots = Iterable[tuple[float, float]]  # left and top, in the order of preference


class Box(NamedTuple):
    """A rectangle [px]; the top is above the bottom: y0 < y1."""

    x0: float
    y0: float
    x1: float
    y1: float

    def meets(self, other: Box) -> bool:
        """Return if they have an area in common."""
        return self.x0 < other.x1 and other.x0 < self.x1 and self.y0 < other.y1 and other.y0 < self.y1

    def grown(self, by: float) -> Box:
        """Return the box with `by` px more on each side."""
        return Box(self.x0 - by, self.y0 - by, self.x1 + by, self.y1 + by)


class Places:
    """The room for words, and what of it is taken."""

    def __init__(self, room: Box) -> None:
        self.room = room
        self.taken: list[Box] = []

    def take(self, *boxes: Box) -> None:
        """Mark a box as taken: nothing is placed there any more."""
        self.taken += boxes

    def find(self, width: float, height: float, spots: Spots, own: Box | None = None) -> Box | None:
        """Return and take the first free box of this size; None where there is none. own: taken, but not against this one."""
        room = self.room
        for left, top in spots:
            left = max(room.x0, min(left, room.x1 - width))
            box = Box(left, top, left + width, top + height)
            inside = box.x1 <= room.x1 and room.y0 <= box.y0 and box.y1 <= room.y1
            if inside and not any(box.meets(other) for other in self.taken if other != own):
                self.taken.append(box)
                return box
        return None


def around(thing: Box, width: float, height: float, reach: float, up: bool = False) -> Iterator[tuple[float, float]]:
    """Return boxes below and above a thing (`up`: above first), then at its sides, then up to `reach` px away from it."""
    middle = (thing.x0 + thing.x1 - width) / 2
    sides = (thing.y0 - height, thing.y1) if up else (thing.y1, thing.y0 - height)
    for top in sides:
        for left in (middle, thing.x1 - width, thing.x0):
            yield left, top
    level = (thing.y0 + thing.y1 - height) / 2
    yield thing.x0 - width, level
    yield thing.x1, level
    for off in range(4, int(reach) + 1, 4):
        for top in sides:
            yield middle, top + (off if top >= thing.y1 else -off)


def near(thing: Box, width: float, height: float, reach: float) -> list[tuple[float, float]]:
    """Return boxes within `reach` px of a thing's middle, the nearest first."""
    x, y = (thing.x0 + thing.x1 - width) / 2, (thing.y0 + thing.y1 - height) / 2
    steps = range(-int(reach), int(reach) + 1, 4)
    return sorted(((x + dx, y + dy) for dx in steps for dy in steps), key=lambda at: (at[0] - x) ** 2 + (at[1] - y) ** 2)


def along(x0: float, x1: float, y: float, width: float, height: float) -> Iterator[tuple[float, float]]:
    """Return boxes on a line from x0 to x1, from its middle to its ends, then above, below, and beyond its ends."""
    spare, middle = x1 - x0 - width, (x0 + x1 - width) / 2
    if spare >= 0.0:
        for part in (0.0, 0.25, -0.25, 0.5, -0.5):
            yield middle + part * spare, y - height / 2
    for top in (y - height - 4.0, y + 4.0):
        yield middle, top
    yield x1 + 6.0, y - height / 2
    yield x0 - 6.0 - width, y - height / 2
