"""All arrays of a batch. The compiled function gets an array of their addresses, which costs less than an argument for each."""

from __future__ import annotations

import numpy as np

from tailgate.core import Array

from . import constants as of
from .rows import COMMON, LANES, RADAR_STATE, ROWS, STATE, WIRES, WORDS
from .script import PLACES

_orders: list[str] = []
_places: list[str] = []


def _order(name: str) -> int:
    _orders.append(name)
    return len(_orders) - 1


def _place(name: str) -> int:
    _places.append(name)
    return len(_places) - 1


# What is to be done, in the order that the kernel asks.
BATCH, TICK = _order("batch"), _order("tick")
LEAST = _order("least")  # record the smallest gaps of an episode, and no rows of its steps
FRESH, STEPS, HOW, TERMINATE, FIRST_STEP, RESTART = (
    _order("fresh"), _order("steps"), _order("how"), _order("terminate"), _order("first_step"), _order("restart"),
)  # fmt: skip
# How long things are that differ.
DEEP, WINDOW, INTENT, TABLE = _order("rows of a block"), _order("window rows"), _order("intent rows"), _order("table length")
COLUMNS, KEPT = _order("recorded columns"), _order("recorded steps")
WHOLE, ASKING, SCRIPT = _order("rows of a desk"), _order("rows of a command"), _order("script length")
MASKED = _order("actions of a mask")
ORDERS = len(_orders)

# Where things are, by the number of their address.
AT_ORDERS, AT_ROWS, AT_WINDOW, AT_INTENT, AT_WORDS = (_place(name) for name in ("orders", "rows", "window", "intent", "words"))
AT_C, AT_TABLE, AT_SCRIPT = _place("c"), _place("table"), _place("script")
AT_ASKED, AT_ACTION = _place("asked"), _place("action")
AT_PAID, AT_COUNT, AT_SEEN, AT_FLAGS, AT_MASK = (_place(name) for name in ("paid", "count", "seen", "flags", "mask"))  # `cockpit.SHEET`
AT_COLUMNS, AT_RECORD = _place("columns"), _place("record")
AT_DESK, AT_DESK_WORDS = _place("desk"), _place("desk words")  # of each thread one: room to work at

FEW = 4  # blocks that stay in the cache with all that a step computes on its way
ASKED = 1 + 2 * WIRES  # rows of a command: kind, targets, values
OBEY, SCRIPTED, SEATED = range(3)  # who decides
SHOW = 2  # of the order to restart: all blocks are written to the sheet, also those in which no episode begins
DESKS = 2  # rooms of ROWS at a desk: for a block that is played, and for episodes that begin
PAID = 2  # rows of numbers of what a decision brought: reward, gap
FLAGS = 6  # and of truth values: terminated, truncated, illegal, collided, rear, allowed


def _lined_up(size: int, dtype: type) -> Array:
    """Zeros of 8 bytes each that begin with a cache line, as a vector that lies in two of them takes twice as long."""
    out: Array = np.zeros(size + 8, dtype)
    first = -(out.ctypes.data // 8) % 8
    return out[first : first + size]


class Memory:
    """The arrays of B episodes; every attribute but the flat ones is a view of them."""

    def __init__(self, batch: int, c: Array, f: Array, table: Array, window: int, intents: int, threads: int) -> None:
        blocks, actions = -(-batch // LANES), int(f[of.ACTIONS])
        kept = COMMON if f[of.CARS] else RADAR_STATE if f[of.AIRED] else STATE
        whole, aimed = ROWS + int(f[of.ROOM]), 2 * int(f[of.WIRED])  # of several agents a command and a script have two numbers a wire
        asking, written = 2 + aimed if f[of.CARS] else ASKED, PLACES + aimed
        deep = whole if blocks <= (1 if f[of.CARS] else FEW) else kept  # many blocks share one place to work at, which stays in the cache
        sizes = {
            AT_ROWS: blocks * deep * LANES, AT_WINDOW: blocks * window * LANES, AT_INTENT: blocks * intents * LANES, AT_C: len(c),
            AT_TABLE: len(table), AT_SCRIPT: written, AT_ASKED: 0 if actions else asking * batch, AT_ACTION: actions * batch,
        }  # fmt: skip
        self.places, self._placed = np.zeros(len(_places), np.uintp), [np.zeros(0)] * len(_places)
        self.whole = np.zeros(ORDERS + len(f), np.int64)
        self.order, self.whole[ORDERS:] = self.whole[:ORDERS], f
        self.order[[BATCH, DEEP, WINDOW, INTENT, TABLE]] = batch, deep, window, intents, len(table)
        self.order[[WHOLE, ASKING, SCRIPT]] = whole, asking, written
        self.floats = _lined_up(sum(sizes.values()), np.float64)
        held, at = {}, 0
        for name, size in sizes.items():
            held[name] = self.floats[at : at + size]
            self.put(name, held[name])
            at += size
        held[AT_C][:], held[AT_TABLE][:] = c, table
        self.rows, self.script = held[AT_ROWS].reshape(blocks, deep * LANES), held[AT_SCRIPT]
        self.window = held[AT_WINDOW].reshape(blocks, window * LANES)
        self.asked, self.action = held[AT_ASKED].reshape(asking, -1), held[AT_ACTION].reshape(-1, max(actions, 1))
        self.flat_words = _lined_up(blocks * WORDS * LANES, np.uint64)
        self.words = self.flat_words.reshape(blocks, WORDS * LANES)
        self.put(AT_ORDERS, self.whole)
        self.put(AT_WORDS, self.flat_words)
        self.put(AT_DESK, _lined_up(threads * (DESKS * whole + window + intents) * LANES, np.float64))
        self.put(AT_DESK_WORDS, _lined_up(threads * WORDS * LANES, np.uint64))

    def put(self, place: int, array: Array) -> None:
        """The compiled function finds this array at this place, and it is kept as long."""
        self._placed[place], self.places[place] = array, array.ctypes.data
