"""Rows of a compiled engine as the plain loop's state, which a picture needs: the same episodes, played again when somebody looks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tailgate.core import Array, Frame
from tailgate.core.draws import Keys
from tailgate.core.loop import LoopState
from tailgate.envs.gym.attacker_mdp import Seat

if TYPE_CHECKING:
    from tailgate.envs.gym.batches import PlainEpisodes


class Decided(NamedTuple):
    """A decision of every row: actions (B,) or (B, size), rows (B,) bool that were over, and if those begin their next episode."""

    actions: Array
    over: Array
    restart: bool


class Begun(NamedTuple):
    """Episodes that began in rows (B,) bool at a reset, under keys of as many rows; None: the next of each row."""

    rows: Array
    keys: Keys | None
    reset: bool


class Shadow:
    """The decisions since the last episode but one of each row began, and the rows of the plain loop that were looked at.

    A row that nobody looks at costs the list of its decisions. Two episodes are kept because a picture of an episode that has
    just begun shows how the one before it ended.
    """

    def __init__(self, seat: Seat, keys: Keys) -> None:
        batch = len(keys.key)
        self.seat, self.keys = seat, keys  # keys of the present episodes
        self.events: list[Decided | Begun] = []
        self.dropped = 0  # events that are not kept any more
        self.earlier = keys  # keys of the episodes before those
        self.began, self.before = np.zeros(batch, np.int64), np.zeros(batch, np.int64)  # at which event either began
        self.rows: dict[int, tuple[PlainEpisodes, int]] = {}  # the plain loop of a row, and how many events it has played

    def add(self, event: Decided | Begun) -> None:
        """Note what all rows have just done."""
        self.events.append(event)
        rows = event.rows if isinstance(event, Begun) else event.over if event.restart else None
        if rows is not None and rows.any():
            given = event.keys if isinstance(event, Begun) else None
            self.before, self.began = np.where(rows, self.began, self.before), np.where(rows, self._count, self.began)
            self.earlier = Keys(
                np.where(rows[:, None], self.keys.key, self.earlier.key), np.where(rows, self.keys.episode, self.earlier.episode)
            )
            key, episode = self.keys.key.copy(), np.where(rows, self.keys.episode + np.uint32(1), self.keys.episode)
            if given is not None:
                key[rows], episode[rows] = given.key, given.episode
            self.keys = Keys(key, episode)
        if len(self.events) > 64 + 4 * self.seat.decisions:
            unneeded = int(self.before.min()) - self.dropped
            del self.events[:unneeded]
            self.dropped += unneeded

    @property
    def _count(self) -> int:
        return self.dropped + len(self.events)

    def look(self, row: int, make: Callable[[Seat], PlainEpisodes]) -> tuple[LoopState, Frame | None]:
        """Return the plain loop's state (of a batch of one) and last step of a row; `make` gives a plain loop of the seat."""
        one = slice(row, row + 1)
        plain, played = self.rows.get(row, (None, -1))
        if plain is None or played < self.dropped:
            plain, played = make(self.seat), int(self.before[row])
            plain.begin(Keys(*(leaf[one] for leaf in self.earlier)))
        for event in self.events[played - self.dropped :]:
            if isinstance(event, Decided):
                plain.decide(event.actions[one], event.over[one], event.restart)
            elif event.rows[row]:
                at = int(np.count_nonzero(event.rows[:row]))
                keys = None if event.keys is None else Keys(event.keys.key[at : at + 1], event.keys.episode[at : at + 1])
                plain.again(event.rows[one], keys, event.reset)
            elif event.reset:
                plain.frame = None
        self.rows[row] = plain, self._count
        assert plain.state is not None
        return plain.state, plain.frame
