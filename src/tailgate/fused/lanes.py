"""A batch in the fused engine: its arrays, what they mean as the nouns of the plain loop, and its steps."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from tailgate.core import Array, Command, Received, Scene, View
from tailgate.draws import Draws, Keys, Role
from tailgate.envs.following import FollowingState
from tailgate.envs.idm import BehindState
from tailgate.errors import InputError
from tailgate.loop import Loop
from tailgate.threat import Channel

from . import constants as of
from . import rows as at
from .build import Constants
from .compiled import Kernel
from .memory import AT_COLUMNS, AT_RECORD, COLUMNS, FRESH, KEPT, OBEY, RESTART, TICK, Memory
from .rows import LANES, SENSORS, WIRES, wires_of

NOTHING = np.zeros(0, np.uint64)
PARTIES = at.WORLD_KEY, at.ATTACK_KEY, at.DEFENCE_KEY  # in the order of `Keys.key`
WORTH = 2048  # episodes that are worth a thread


def words_of(keys: Keys) -> tuple[tuple[np.uint64, Array], ...]:
    """What the episodes of these keys draw by, and the row of each."""
    return *((name, keys.key[:, i]) for i, name in enumerate(PARTIES)), (at.EPISODE, keys.episode)


class _Spent(NamedTuple):
    """The part of `ChannelState` by which the channel says what is allowed."""

    used: Array
    burst: Array
    cooldown: Array


def _kernel(f: Array) -> Kernel:
    """What plays the plant: of the others nothing is imported."""
    name = "network_kernel" if f[of.SENSED] else "platoon_kernel" if f[of.CARS] else "radar_kernel" if f[of.AIRED] else "kernel"
    run: Kernel = import_module(f"tailgate.fused.{name}").run
    return run


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


class Lanes:
    """B episodes of one loop. The arrays are this object's own, and change with every step."""

    def __init__(self, loop: Loop, constants: Constants, keys: Keys, columns: Array = NOTHING, steps: int = 0, threads: int = 1) -> None:
        """`columns` of every step are kept in `record` (steps, columns, B). Many episodes may share several `threads`."""
        self.threads = max(1, min(threads, len(keys.key) // WORTH))
        self.loop, self.constants, self.batch = loop, constants, len(keys.key)
        self.memory = Memory(self.batch, constants.c, constants.f, constants.table, constants.window, constants.intents, self.threads)
        self.rows, self.record = self.memory.rows, np.zeros((steps, len(columns), self.batch))
        self.aired = bool(constants.f[of.AIRED])
        self.play = _kernel(constants.f)
        self.wires = np.array(wires_of(len(loop.model.wires)))
        self._asked: tuple[int, ...] = ()
        self.memory.put(AT_COLUMNS, columns.astype(np.int64))
        self.memory.put(AT_RECORD, self.record)
        self.memory.order[[COLUMNS, KEPT]] = len(columns), steps
        self._places = self.memory.places.ctypes.data
        self.take(keys)

    def take(self, keys: Keys) -> None:
        """The keys of the episodes that begin next."""
        self.keys = keys
        for word, value in words_of(keys):
            self.set_word(word, value)

    # -- rows by name

    def row(self, name: np.uint64, offset: int = 0) -> Array:
        """(B,) float64: a copy, or a view where all episodes are in one block."""
        first = int(name) + offset * LANES
        return self.rows[:, first : first + LANES].reshape(-1)[: self.batch]

    def stack(self, name: np.uint64, width: int) -> Array:
        """(B, 1, width): rows that follow each other."""
        return self._side_by_side([self.row(name, j) for j in range(width)])

    def of_wires(self, name: np.uint64) -> Array:
        """(B, 1, w): of each wire of the model."""
        return self._side_by_side([self.row(name, j) for j in self.wires])

    @staticmethod
    def _side_by_side(rows: list[Array]) -> Array:
        return np.moveaxis(np.stack(rows), 0, -1)[:, None, :]

    def set_row(self, name: np.uint64, values: Array) -> None:
        """One number for each episode."""
        held = np.zeros(len(self.rows) * LANES)
        held[: self.batch] = values
        self.rows[:, int(name) : int(name) + LANES] = held.reshape(-1, LANES)

    def word(self, name: np.uint64) -> Array:
        """(B,) uint64"""
        return self.memory.words[:, int(name) : int(name) + LANES].reshape(-1)[: self.batch]

    def set_word(self, name: np.uint64, values: Array) -> None:
        """One whole number for each episode."""
        held = np.zeros(len(self.rows) * LANES, np.uint64)
        held[: self.batch] = values
        self.memory.words[:, int(name) : int(name) + LANES] = held.reshape(-1, LANES)

    # -- playing

    def run(self, how: int, steps: int, fresh: bool = False, terminate: bool = False, first_step: int = 0, restart: bool = False) -> int:
        """Steps under whoever decides; -> how many there were. Raises InputError where an estimate is not finite, as the loop does."""
        places, asked = self._places, (fresh, steps, how, terminate, first_step, restart)  # as `memory` orders them
        if asked != self._asked:  # mostly the same again
            self.order(asked)
        if self.threads == 1:
            played = [self.play(places, 0, len(self.rows), 0)]
        else:  # blocks share nothing, so that the order in which they are played does not matter
            edges = [len(self.rows) * part // self.threads for part in range(self.threads + 1)]
            pool = _pool(self.threads - 1)
            others = [pool.submit(self.play, places, edges[part], edges[part + 1], part) for part in range(1, self.threads)]
            played = [self.play(places, 0, edges[1], 0), *(other.result() for other in others)]
            self.memory.order[TICK] += fresh + steps
        if min(played) < 0:
            raise not_finite()
        return int(max(played))

    def order(self, asked: tuple[int, ...]) -> None:
        """What is to be done from now on."""
        self.memory.order[FRESH : RESTART + 1] = self._asked = asked

    def start(self) -> None:
        """All episodes begin, at k = 1, measured."""
        self.run(OBEY, 0, fresh=True)

    def advance(self, command: Command, t: int = 0) -> None:
        """One step under a command, kept at t of the record."""
        asked = self.memory.asked
        asked[0] = command.kind
        asked[1 + self.wires] = np.moveaxis(command.target[:, 0], 0, -1)
        asked[1 + WIRES + self.wires] = np.moveaxis(command.value[:, 0], 0, -1)
        self.run(OBEY, 1, first_step=t)

    @property
    def ended(self) -> Array:
        return np.asarray(self.row(at.ENDED) != 0.0)

    @property
    def k(self) -> Array:
        return self.row(at.K).astype(np.int64)

    def draws(self, role: Role) -> Draws:
        """The draws of a role at each row's own step."""
        return self.keys.at(role, self.k)

    def view(self) -> View:
        """What the threat model lets an attacker see now: `Loop.sense`."""
        threat, plan, k = self.loop.threat, self.loop.plan.channel, self.k
        spent: Any = _Spent(*(self.row(name).astype(np.int64) for name in (at.USED, at.BURST, at.COOLDOWN)))
        left, allowed = Channel().budget_left(plan, spent), Channel().allowed(plan, spent, k)
        budget = np.full(self.batch, np.inf if threat.budget is None else float(threat.budget))
        view = View(k, k / self.loop.horizon, self.scene(), left, budget, spent.burst, spent.cooldown, allowed, self.last())
        if self.aired:
            view = view._replace(probed=self.row(at.PROBED)[:, None] != 0.0)
        if threat.knowledge == "grey":
            view = view._replace(control=self.control())
        if threat.sees_measurement:
            view = view._replace(received=self.received())
        return view

    def last(self) -> Command:
        """The command that was in force in the last step."""
        return Command(self.row(at.KIND).astype(np.int8), self.of_wires(at.TARGET) != 0.0, self.of_wires(at.VALUE))

    def control(self) -> Array:
        """(B, N, 1) what was commanded last."""
        return self.row(at.U)[:, None, None].copy()

    def scene(self) -> Scene:
        """The road now."""
        nothing = np.zeros((self.batch, 0))  # the driver's intents, which nobody sees
        behind = (
            BehindState(self.row(at.REAR_X).copy(), self.row(at.REAR_V).copy(), nothing, nothing) if self.constants.f[of.REAR] else None
        )
        x, v, own = self.row(at.LEAD_X).copy(), self.row(at.LEAD_V).copy(), self.stack(at.EGO, 3)
        state: Any = FollowingState(x, v, own, behind)
        if self.aired:
            from tailgate.envs.radar_following import RadarState

            state = RadarState(x, v, self.row(at.LEAD_A).copy(), own, behind)
        return self.loop.plant.scene(self.loop.plan.plant, state)

    def received(self) -> Received:
        """The readings as they were sent."""
        y = self.stack(at.SENT, SENSORS)
        if not self.aired:
            return Received(y, np.ones(y.shape, bool), np.zeros(y.shape[:2]))
        valid = np.repeat(self.row(at.HEARS)[:, None, None] != 0.0, SENSORS, axis=2)
        return Received(y, valid, self.row(at.ENERGY)[:, None].copy())


def not_finite() -> InputError:
    """What the plain loop says of an estimate that is NaN or infinite."""
    return InputError("defence output x", "NaN or infinity", "finite numbers")
