"""The attacker's seat in the fused engine: episodes in which a decision is an action, as `tailgate.envs.seat.Seat` plays them."""

from __future__ import annotations

import ctypes
import math
import struct
from itertools import accumulate
from typing import TYPE_CHECKING, Any

import numpy as np

from tailgate.agents.observation import LAST_SCALE, LIMIT, SCALES
from tailgate.core import Array, Kind
from tailgate.draws import Keys

from . import constants as of
from . import rows as at
from . import seat as lane
from .build import Constants, Refused, fuse
from .lanes import NOTHING, PARTIES, Lanes, not_finite, words_of
from .memory import AT_COUNT, AT_FLAGS, AT_MASK, AT_PAID, AT_SEEN, FLAGS, MASKED, PAID, SEATED, SHOW, TICK

if TYPE_CHECKING:
    from tailgate.envs.seat import Seat

_ACTIONS = {"timing": of.DISCRETE, "mode": of.DISCRETE, "ramp": of.RAMPING, "continuous": of.CONTINUOUS, "increment": of.INCREMENT}
_REWARDS = {
    "collision": of.CRASH, "min_gap": of.MIN_GAP, "error": of.ERROR, "peak": of.PEAK, "stealth": of.STEALTH, "final": of.FINAL,
}  # fmt: skip


def fuse_seat(seat: Seat) -> Constants | Refused:
    """The constants of a seat, or why the plain loop plays it."""
    k = fuse(seat.loop)
    if isinstance(k, Refused):
        return k
    c, f, action, paid, threat = k.c, k.f, seat.action, seat.reward, seat.loop.threat
    columns, many = [name for name, _ in seat.observation.columns], f[of.CARS] > 0
    if len(columns) > of.COMPONENTS or (action.discrete and not many and action.size > of.MODES):
        return Refused("too many components or actions")
    f[of.ACTION], f[of.ACTIONS] = _ACTIONS[action.spec.action], 1 if action.discrete else action.size
    f[of.REWARD], f[of.FEATURES] = _REWARDS[paid.reward], len(columns)
    c[of.RATE], c[of.HORIZON], c[of.SEEN_MOST] = action.spec.rate, seat.loop.horizon, LIMIT
    road = not f[of.SENSED]
    if many:
        from . import several  # which a single car does without

        k = k._replace(table=several.modes(seat.loop, k.table, f, action.modes if action.discrete else []))
    elif action.discrete:
        mine = np.array(at.wires_of(len(seat.loop.model.wires)))
        for i, mode in enumerate(action.modes):
            row = of.TABLE + of.MODE_WIDTH * i
            c[[row, row + 1]], c[row + 2 + mine], c[row + 2 + at.WIRES + mine] = (mode.kind, mode.sign), mode.target[0], mode.value
    if not action.discrete and set(action.carried) - {Kind.FDI}:
        return Refused("vectors of values over the air have no lane")
    c[of.REWARD_SCALE], c[of.GAP_SHAPING], c[of.ERROR_SHAPING] = paid.error_scale, paid.gap_shaping, paid.error_shaping
    c[of.GAMMA_PAID], c[of.ILLEGAL], c[of.COST] = paid.gamma, paid.illegal_penalty, paid.attack_cost
    c[of.BUDGET_SHARE], c[of.INTERVAL] = threat.budget or 1.0, action.spec.interval
    if many:
        c[of.BELIEF] = 1.0
    else:
        assert seat.loop.model.gap is not None
        c[of.BELIEF] = seat.loop.model.gap[0, 0]
    if not road:
        c[of.GAP_SHAPING] = 0.0  # nobody is ahead
    scales = SCALES | {"progress": float(seat.loop.horizon)}
    limit = LAST_SCALE if road else np.inf
    most = {wire: min(bound, limit) for wire, bound in zip(seat.loop.model.wires, seat.action.brief.bounds.tolist(), strict=True)}
    most |= {"power": threat.jam_power, "delay": threat.delay_bound}
    quantities: dict[str, tuple[Any, Any]] = lane.QUANTITIES | ({} if f[of.REAR] else lane.ALONE)
    if f[of.AIRED]:
        from . import radar

        quantities = quantities | radar.QUANTITIES
    if not road:
        from . import network_seat

        quantities = network_seat.quantities(seat.loop, f)
    elif many:
        from . import platoon_seat

        quantities = platoon_seat.quantities(columns, f, seat.loop)
        scales |= platoon_seat.scales(seat.loop)
    for j, name in enumerate(columns):
        rows, what = quantities.get(name), name.partition("[")[0]
        if rows is None:
            return Refused(f"the observation's {name} has no lane")
        f[of.SEEN + j], f[of.FROM + j] = rows
        c[of.SEEN_SCALE + j] = most[what[5:]] if what.startswith("last_") else scales.get(name, scales.get(what.removesuffix("0"), 1.0))
    return k


SHEET = {  # what a decision brought, (B,) of each: number, information; the observation; truth values; what the channel would accept
    AT_PAID: np.float64, AT_COUNT: np.int64, AT_SEEN: np.float32, AT_FLAGS: np.bool_, AT_MASK: np.int8,
}  # fmt: skip


class Cockpit(Lanes):
    """B episodes of a seat, and what the last decision brought, in arrays that are new with each.

    paid (PAID, B), count (B,): the step. seen (B, features) float32. flags (FLAGS, B) bool. mask (B, actions) int8, none of actions that
    are not discrete.
    """

    def __init__(self, seat: Seat, constants: Constants, keys: Keys, threads: int = 1) -> None:
        super().__init__(seat.loop, constants, keys, threads=threads)
        self.seat = seat
        self.interval, batch, features = seat.action.spec.interval, self.batch, int(constants.f[of.FEATURES])
        actions = seat.action.size if seat.action.discrete else 0
        self.memory.order[MASKED] = actions
        shapes: tuple[tuple[int, ...], ...] = (PAID, batch), (batch,), (batch, features), (FLAGS, batch), (batch, actions)
        parts = [(shape, np.dtype(kind)) for shape, kind in zip(shapes, SHEET.values(), strict=True)]
        *self._starts, self._size = accumulate((math.prod(shape) * kind.itemsize for shape, kind in parts), initial=0)
        self._parts = list(zip(parts, self._starts, strict=True))
        self._sheet: Any = NOTHING
        # of a single row
        self._enter, self._alone, self._anew = self.play.entry, (0, self.interval, SEATED, 0, 0, 0), (0, 0, SEATED, 0, 0, 1)
        self._action, self._single = memoryview(self.memory.action[0]), seat.action.discrete
        self._whole = ctypes.c_void_p(self._places), ctypes.c_int64(0), ctypes.c_int64(1), ctypes.c_int64(0)  # arguments, made once
        self._told = struct.Struct(f"=ddq{4 * features}x6?").unpack_from

    def _turn(self) -> None:
        """A new sheet for what the compiled function tells."""
        self._sheet = self.paid = self.count = self.seen = self.flags = self.mask = NOTHING  # the last goes, where nobody else holds it
        self._sheet = np.empty(self._size, np.uint8)
        first, buffer = ctypes.addressof(ctypes.c_char.from_buffer(self._sheet)), memoryview(self._sheet)
        self.memory.places[AT_PAID : AT_MASK + 1] = [first + start for start in self._starts]
        self.paid, self.count, self.seen, self.flags, self.mask = (np.ndarray(*part, buffer, at) for part, at in self._parts)

    def run(self, how: int, steps: int, *arguments: Any, **orders: Any) -> int:
        before = None if steps else self._sheet
        self._turn()
        if before is not None:  # no decision: it brought nothing, and rows in blocks where nothing begins are seen as they were
            self._sheet[:] = before if len(before) else 0
            self.paid[0], self.flags[:-1] = 0.0, False
        self._shared, self._asked = True, ()
        return super().run(how, steps, *arguments, **orders)

    def begin(self) -> None:
        """All episodes begin."""
        self.run(SEATED, 0, fresh=True)

    def decide(self, actions: Array, restart: bool = False) -> None:
        """One decision of each row, (B,) or (B, size); with `restart`, rows that were over begin their next episode instead."""
        self.memory.action[...] = actions if actions.ndim == 2 else actions[:, None]
        self.run(SEATED, self.interval, restart=restart)

    def decide_alone(self, action: Any) -> tuple[Any, ...]:
        """The decision of a single row; -> the numbers of its sheet in their order, its observation and its mask.

        As `decide`, with nothing on the way that a batch would hide.
        """
        if self._single:
            self._action[0] = action
        else:
            self.memory.action[0] = action
        return self._play_alone(self._alone)

    def again_alone(self) -> tuple[Any, ...]:
        """The next episode of a single row; -> as `decide_alone`, of a decision that brought nothing."""
        self.rows[0, at.OVER] = 1.0
        _, gap, step, _, _, _, _, _, *rest = self._play_alone(self._anew)
        return 0.0, gap, step, False, False, False, False, False, *rest

    def _play_alone(self, orders: tuple[int, ...]) -> tuple[Any, ...]:
        if self._shared:  # the last sheet is its reader's; from now on there is one, of which copies are given
            self._turn()
            self._row, self._allowed, self._shared = self.seen[0], self.mask[0], False
        if self._asked is not orders:
            self.order(orders)
        if self._enter(*self._whole) < 0:
            raise not_finite()
        return *self._told(self._sheet), self._row.copy(), self._allowed.copy()

    def __reduce__(self) -> tuple[Any, ...]:
        return _copied, (self.seat, self.constants, self.keys, self.threads, self.held())

    @property
    def present_keys(self) -> Keys:
        """What the present episodes draw by."""
        return Keys(np.stack([self.word(name) for name in PARTIES], axis=1), self.word(at.EPISODE).astype(np.uint32))

    def end(self, where: Array) -> None:
        """End the episodes of the rows `where` (B,) bool: with `restart` their next decision begins another."""
        self.set_row(at.OVER, np.where(where, 1.0, self.row(at.OVER)))

    def reseed(self, where: Array, keys: Keys | None = None, show: bool = False) -> None:
        """Begin episodes in the rows `where` (B,) bool: the next of their own, or those of the given keys of as many rows.

        With `show` the sheet is written for all rows; else the others' part is copied from the last sheet, which a caller may hold.
        """
        if keys is not None:
            for name, value in words_of(keys):
                held = self.word(name).copy()
                held[where] = value.astype(np.uint64) - np.uint64(name == at.EPISODE)  # a restart counts one further
                self.set_word(name, held)
        over = self.row(at.OVER).copy()  # of the others, which begin when they are asked to
        self.set_row(at.OVER, where)
        self.run(SEATED, 0, restart=SHOW if show else True)
        self.set_row(at.OVER, np.where(where, 0.0, over))

    def held(self) -> dict[str, Array]:
        """Everything that changes, by name: copies."""
        memory = self.memory
        return {
            "floats": memory.floats.copy(),
            "words": memory.flat_words.view(np.int64).copy(),
            "tick": memory.order[TICK : TICK + 1].copy(),
            "sheet": self._sheet.copy(),
        }

    def put(self, held: dict[str, Array]) -> None:
        """What `held` gave."""
        self._turn()
        self._sheet[:], self._shared = held["sheet"], True
        self.memory.floats[:], self.memory.order[TICK] = held["floats"], held["tick"][0]
        self.memory.flat_words.view(np.int64)[:] = held["words"]


def _copied(seat: Seat, constants: Constants, keys: Keys, threads: int, held: dict[str, Array]) -> Cockpit:
    """Make what `Cockpit.__reduce__` describes: a copy that goes on from where the original was."""
    made = Cockpit(seat, constants, keys, threads)
    made.put(held)
    return made
