"""All arrays of a batch in three: floats, whole numbers, and words for the random numbers, each flat.

An argument costs a compiled function as much as some episodes' step: it is called with few, and finds the rest by the offsets in `o`.
"""

from __future__ import annotations

import numpy as np

from tailgate.core import Array

from . import constants as of
from .rows import LANES, RADAR_STATE, ROWS, STATE, WIRES, WORDS
from .script import PLACES

_orders: list[str] = []


def _order(name: str) -> int:
    _orders.append(name)
    return len(_orders) - 1


# What is to be done, in the order that the kernel asks.
BATCH, TICK = _order("batch"), _order("tick")
LEAST = _order("least")  # record the smallest gaps of an episode, and no rows of its steps
FRESH, STEPS, HOW, TERMINATE, FIRST_STEP, RESTART = (
    _order("fresh"), _order("steps"), _order("how"), _order("terminate"), _order("first_step"), _order("restart"),
)  # fmt: skip
# Where things are in the floats, and how long they are where that differs.
AT_ROWS, AT_WINDOW, AT_INTENT, AT_C, AT_TABLE, AT_SCRIPT, AT_ASKED, AT_ACTION, AT_PAID = (
    _order(name) for name in ("rows", "window", "intent", "c", "table", "script", "asked", "action", "paid")
)
DEEP, WINDOW, INTENT, TABLE = _order("rows of a block"), _order("window rows"), _order("intent rows"), _order("table length")
ORDERS = len(_orders)

FEW = 4  # blocks that stay in the cache with all that a step computes on its way
ASKED = 1 + 2 * WIRES  # rows of a command: kind, targets, values
OBEY, SCRIPTED, SEATED = range(3)  # who decides
PAID = 9  # rows of what a decision brought: reward, terminated, truncated, refused, collided, rear, allowed, k, gap


def _lined_up(size: int, dtype: type) -> Array:
    """Zeros of 8 bytes each that begin with a cache line, as a vector that lies in two of them takes twice as long."""
    out: Array = np.zeros(size + 8, dtype)
    first = -(out.ctypes.data // 8) % 8
    return out[first : first + size]


class Memory:
    """The arrays of B episodes; every attribute but the flat ones is a view of them."""

    def __init__(self, batch: int, c: Array, f: Array, table: Array, window: int, intents: int) -> None:
        blocks = -(-batch // LANES)
        actions = max(int(f[of.ACTIONS]), 1)
        kept = RADAR_STATE if f[of.AIRED] else STATE
        deep = ROWS if blocks <= FEW else kept  # many blocks share one place to work at, which stays in the cache
        sizes = {
            AT_ROWS: blocks * deep * LANES, AT_WINDOW: blocks * window * LANES, AT_INTENT: blocks * intents * LANES, AT_C: len(c),
            AT_TABLE: len(table), AT_SCRIPT: PLACES, AT_ASKED: ASKED * batch, AT_ACTION: actions * batch,
            AT_PAID: PAID * batch,
        }  # fmt: skip
        self.whole = np.zeros(ORDERS + len(f), np.int64)
        self.order = self.whole[:ORDERS]
        self.floats = _lined_up(sum(sizes.values()), np.float64)
        held, at = {}, 0
        for name, size in sizes.items():
            self.order[name], held[name] = at, self.floats[at : at + size]
            at += size
        self.order[[BATCH, DEEP, WINDOW, INTENT, TABLE]] = batch, deep, window, intents, len(table)
        self.whole[ORDERS:] = f
        held[AT_C][:], held[AT_TABLE][:] = c, table
        self.rows, self.script = held[AT_ROWS].reshape(blocks, deep * LANES), held[AT_SCRIPT]
        self.asked, self.action = held[AT_ASKED].reshape(ASKED, batch), held[AT_ACTION].reshape(batch, actions)
        self.paid = held[AT_PAID].reshape(PAID, batch)
        self.flat_words = _lined_up(blocks * WORDS * LANES, np.uint64)
        self.words = self.flat_words.reshape(blocks, WORDS * LANES)
