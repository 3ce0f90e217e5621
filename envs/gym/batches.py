"""The episodes of a batch, in any engine: the same decisions, rewards and observations to the last bit."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from tailgate.base import sizes
from tailgate.base.errors import InputError, unknown
from tailgate.base.pytree import leaves, with_leaves
from tailgate.core import Array, Frame, View
from tailgate.core.draws import Keys, counted
from tailgate.core.loop import LoopState
from tailgate.engine import cards
from tailgate.engine.agreement import Untraced
from tailgate.envs.gym.attacker_mdp import Outcome, Seat, Tally
from tailgate.envs.gym.programs import Rows, SeatPrograms, programs_of
from tailgate.envs.gym.shadow import Begun, Decided, Shadow

ENGINES = ("auto", "traced", "plain")


class Facts(NamedTuple):
    """The part of a step's information that describes the state after it, (B,) each."""

    allowed: Array  # bool
    step: Array  # int64
    damage: Array  # smallest gap [m], or largest error where there is no road


class Episodes(Protocol):
    """B rows of episodes, each with its own seed."""

    engine: str
    device: str

    def check(self, batch: int) -> None:
        """Raise InputError if the device has no memory for these rows."""

    @property
    def number(self) -> Array:
        """(B,) uint32: the episode of each row under its key."""

    def begin(self, keys: Keys) -> None:
        """Begin an episode in every row."""

    def again(self, rows: Array, keys: Keys | None = None, reset: bool = False) -> None:
        """Begin the next episode in `rows` (B,) bool, or that of the keys, of as many rows. reset: the user asked, between two steps."""

    def decide(self, actions: Array, over: Array, restart: bool) -> Outcome:
        """Play one decision; rows that are `over` (B,) bool do not count, and with `restart` begin their next episode instead."""

    def seen(self) -> Array:
        """Return the present observation (B, d) float32, of one frame."""

    def facts(self) -> Facts: ...

    def mask(self) -> Array:
        """Return (B, actions) bool: the discrete actions that the channel would accept in a step of the next decision."""

    def held(self) -> dict[str, Array]:
        """Return all that changes from step to step, by name."""

    def put(self, held: dict[str, Array]) -> None:
        """Restore what `held` returned, of the same number of rows."""

    def drawn(self, row: int) -> tuple[LoopState, Frame | None, int]:
        """Return what a picture of a row shows: a state of the plain loop, its last step (None after a reset), and the row of both."""


def framed(now: Array, before: Array | None, frames: int) -> Array:
    """Return the present frame (B, d) on top of the earlier frames (B, frames d); none before: the first of an episode."""
    return np.tile(now, frames) if before is None else np.concatenate([now, before[:, : -now.shape[1]]], axis=1)


def side_by_side(seat: Seat, engine: str = "auto", drawn: bool = False, threads: int = 1, device: str | None = None) -> Episodes:
    """Choose the engine; auto: traced where it is possible, else plain. `drawn`: pictures may be asked for.

    Of several `threads` each plays 2048 episodes and more. `device`: cpu or cuda; None is that of `cards.playing_on`.
    """
    sizes.check("threads", threads)
    device = cards.device() if device is None else cards.checked(device)
    if engine not in ENGINES:
        raise unknown("engine", engine, ENGINES)
    if device != "cpu":
        cards.card()
        if engine == "plain":
            raise InputError("engine", engine, f"traced or auto with the device {device}: the plain loop plays on cpu")
    if engine == "plain":
        return PlainEpisodes(seat)
    programs = programs_of(seat, device)
    if not isinstance(programs, Untraced):
        return TracedEpisodes(programs, drawn, threads)
    if device != "cpu":
        raise cards.DeviceError("device", device, f"cpu: {programs.why}")
    if engine == "traced":
        raise InputError("engine", engine, f"plain or auto: {programs.why}")
    return PlainEpisodes(seat, programs.why)


class PlainEpisodes:
    """The plain loop, which plays everything."""

    engine, device = "plain", "cpu"

    def __init__(self, seat: Seat, why: str = "") -> None:
        self.seat, self.why = seat, why  # the second: why no other engine plays, where somebody asked
        self.state: LoopState | None = None
        self.tally: Tally | None = None
        self.frame: Frame | None = None  # the last step
        self._looked: tuple[LoopState, View] | None = None  # the last state that was looked at, and what was seen

    def check(self, batch: int) -> None: ...

    @property
    def number(self) -> Array:
        return counted(self._state.keys.episode)

    def begin(self, keys: Keys) -> None:
        self.state = self.seat.loop.start(keys)
        self.tally, self.frame = self.seat.begin(self.state), None

    def again(self, rows: Array, keys: Keys | None = None, reset: bool = False) -> None:
        if reset:
            self.frame = None
        state, loop = self._state, self.seat.loop
        self.state = loop.restart(state, rows) if keys is None else loop.reseed(state, np.flatnonzero(rows), keys)
        fresh, held = self.seat.begin(self.state), self.tally
        assert held is not None
        self.tally = Tally(*(np.where(rows, new, old) for new, old in zip(fresh, held, strict=True)))

    def decide(self, actions: Array, over: Array, restart: bool) -> Outcome:
        assert self.tally is not None
        self.state, self.tally, outcome, self.frame = self.seat.step(self._state, self.tally, actions, over)
        if restart and over.any():
            self.again(over)
        return outcome

    def seen(self) -> Array:
        return self.seat.observation.observe(self._view)[:, : len(self.seat.observation.columns)]

    def facts(self) -> Facts:
        view, tally = self._view, self.tally
        assert tally is not None
        return Facts(view.allowed.copy(), view.k.copy(), np.min(view.scene.gap, axis=1) if self.seat.road else tally.error.copy())

    def mask(self) -> Array:
        return self.seat.action.mask(self._view)

    def held(self) -> dict[str, Array]:
        assert self.tally is not None
        return {f"loop.{k}": v for k, v in leaves(self._state).items()} | {f"tally.{k}": v for k, v in self.tally._asdict().items()}

    def put(self, held: dict[str, Array]) -> None:
        assert self.tally is not None
        self.state = with_leaves(self._state, {k[5:]: v for k, v in held.items() if k.startswith("loop.")})
        self.tally = Tally(*(held[f"tally.{name}"] for name in self.tally._fields))

    def drawn(self, row: int) -> tuple[LoopState, Frame | None, int]:
        return self._state, self.frame, row

    def __getstate__(self) -> dict[str, Any]:
        if why := getattr(self.seat.loop.defence, "opaque", ""):
            raise InputError("copy", type(self.seat.loop.defence).__name__, f"a defence that can be copied in mid-episode: {why}")
        return self.__dict__ | {"_looked": None}

    @property
    def _state(self) -> LoopState:
        assert self.state is not None
        return self.state

    @property
    def _view(self) -> View:
        if self._looked is None or self._looked[0] is not self._state:  # observation, information and mask are of one look
            self._looked = self._state, self.seat.loop.sense(self._state)
        return self._looked[1]


class TracedEpisodes:
    """The traced engine, on the plain loop's own state.

    Where pictures may be `drawn` it notes what was decided, so that the plain loop can play a row again.
    """

    engine = "traced"

    def __init__(self, programs: SeatPrograms, drawn: bool = False, threads: int = 1) -> None:
        self.programs, self._drawn, self._threads = programs, drawn, threads
        self.device = programs.device
        self.rows: Rows | None = None
        self.shadow: Shadow | None = None

    def check(self, batch: int) -> None:
        for program in self.programs.programs:
            program.check("num_envs", batch)

    @property
    def number(self) -> Array:
        return counted(self._rows.state.get_leaf("loop.keys.episode"))

    def begin(self, keys: Keys) -> None:
        self.rows = Rows(self.programs, len(keys.key), self._threads)
        self.rows.begin(np.ones(len(keys.key), bool), keys)
        self.shadow = Shadow(self.programs.seat, keys) if self._drawn else None

    def again(self, rows: Array, keys: Keys | None = None, reset: bool = False) -> None:
        self._rows.begin(rows, keys)
        if self.shadow is not None:
            self.shadow.add(Begun(rows, keys, reset))
        elif self._drawn and rows.all():
            held = self._rows.state.get_leaf
            self.shadow = Shadow(self.programs.seat, Keys(held("loop.keys.key"), held("loop.keys.episode")))

    def decide(self, actions: Array, over: Array, restart: bool) -> Outcome:
        self._rows.decide(actions, over, over & restart)
        if self.shadow is not None:
            self.shadow.add(Decided(actions.copy(), over, restart))
        brought = self._rows.brought
        return Outcome(*(brought[name] for name in Outcome._fields))

    def decide_alone(self, action: ArrayLike) -> tuple[Any, ...]:
        return self._rows.decide_alone(action)

    def again_alone(self) -> tuple[Any, ...]:
        return self._rows.again_alone()

    def seen(self) -> Array:
        return self._rows.brought["seen"]

    def facts(self) -> Facts:
        brought = self._rows.brought
        return Facts(brought["allowed"], brought["k"], brought["damage"])

    def mask(self) -> Array:
        return self._rows.brought["mask"]

    def held(self) -> dict[str, Array]:
        return self._rows.held()

    def put(self, held: dict[str, Array]) -> None:
        self._rows.put(held)
        self.shadow = None  # the earlier decisions are not known

    def drawn(self, row: int) -> tuple[LoopState, Frame | None, int]:
        if self.shadow is None:
            raise InputError("render", "restored episodes", "reset() first")
        return *self.shadow.look(row, PlainEpisodes), 0

    def __getstate__(self) -> dict[str, Any]:
        held = None if self.rows is None else (self.rows.batch, self.rows.held(), self.rows.brought)
        named = {"seat": self.programs.seat, "drawn": self._drawn, "threads": self._threads, "device": self.device}
        return named | {"held": held, "shadow": self.shadow}

    def __setstate__(self, state: dict[str, Any]) -> None:
        programs = programs_of(state["seat"], state["device"])
        if not isinstance(programs, SeatPrograms):
            raise InputError("engine", "a copy of a traced environment", f"what was traced before: {programs.why}")
        self.__init__(programs, state["drawn"], state["threads"])  # type: ignore[misc]
        if state["held"] is not None:
            batch, held, brought = state["held"]
            self.rows = Rows(self.programs, batch, self._threads)
            self.rows.put(held)
            self.rows.brought = brought
        self.shadow = state["shadow"]

    @property
    def _rows(self) -> Rows:
        assert self.rows is not None
        return self.rows
