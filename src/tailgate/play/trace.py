"""A trace: what happened in B episodes, step by step, and its fingerprints."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from tailgate.core import Array, Attack, Frame, Model
from tailgate.core.draws import Keys, Role
from tailgate.core.loop import Loop, LoopState
from tailgate.core.score_threshold import Watched

WORTH, MANY = 20_000, 1_000_000  # steps that justify a traced loop, and a traced attack; tracing takes some tenths of a second
LONG = 300  # steps of an episode that justify a traced loop; the plain loop takes a millisecond per step, even for one row
MEMORY = 1e9  # [bytes] of one trace; more episodes are played in several batches
Player = Callable[[Keys, bool], tuple[Array, dict[str, Array], dict[str, Array]]]  # keys, terminate -> lengths, signals, the road before
_DECISIONS = ("kind", "target", "alarm", "mode", "refused", "collided", "rear_collided")


def signals_of(frame: Frame) -> dict[str, Array]:
    """Return the signals of a step that a trace keeps, (B, ...) each."""
    scene, command, estimate = frame.scene, frame.command, frame.estimate
    return {
        "gap": scene.gap, "speed": scene.speed, "accel": scene.accel, "lead_speed": scene.lead_speed, "rear_gap": scene.rear_gap,
        "rear_speed": scene.rear_speed, "position": scene.position,
        "truth": frame.truth, "estimate": estimate.x, "score": estimate.score, "clean": frame.clean, "wires": frame.wires,
        "valid": frame.received.valid, "energy": frame.received.energy, "probe": estimate.probe,
        "control": frame.control, "applied": frame.applied, "value": command.value,
        "kind": command.kind, "target": command.target, "alarm": estimate.alarm, "mode": estimate.mode, "refused": frame.refused,
        "collided": frame.collided, "rear_collided": frame.rear_collided,
    }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Trace:
    """B episodes.

    `signals` are (K, B, ...); row b is valid for its first length[b] steps, because it ends with a collision.
    Truth, estimate, wires, commands and received values belong to step k, `probe` to the measurement at k + 1.
    The road (gap, speed, ...) belongs to k + 1, after the step. `first` holds the road before the first step.
    """

    model: Model
    horizon: int
    length: Array  # (B,)
    signals: dict[str, Array]
    first: dict[str, Array]
    desired_gap: Callable[[Array], Array]

    @property
    def dt(self) -> float:
        return self.model.dt

    def __getattr__(self, name: str) -> Array:
        try:
            return self.__dict__["signals"][name]  # type: ignore[no-any-return]
        except KeyError:
            raise AttributeError(name) from None

    @property
    def batch(self) -> int:
        return len(self.length)

    @property
    def live(self) -> Array:
        """The steps that belong to each episode, (K, B) bool."""
        return np.arange(len(self.kind))[:, None] < self.length

    def road(self, name: str, row: int = 0) -> Array:
        """Return a road signal of one episode (K + 1, N): before the first step, then after each."""
        n = int(self.length[row])
        return np.concatenate([self.first[name][row : row + 1], self.signals[name][:n, row]])

    def believed_gap(self, row: int = 0) -> Array:
        """Return the gap that each agent of one episode believes (K, N) [m]; in a lane, the room to its nearer line.

        If the state is a position, the believed gap is the leader's position as received, less the estimated position.
        """
        model, n = self.model, int(self.length[row])
        assert model.gap is not None
        estimate = self.estimate[:n, row]
        if model.lane or model.agents > 1 or model.air:
            gap = np.add.accumulate(estimate * model.gap, axis=2)[..., -1]
            return np.asarray(model.lane - np.abs(gap) if model.lane else gap)
        if "leader_position" in model.v2v:
            leader = self.wires[:n, row, :, model.wires.index("leader_position")]
        else:
            leader = (self.road("position", row) + self.road("gap", row))[:-1]
        return np.asarray(leader - estimate[..., 0])

    def _hash(self, row: int, names: list[str]) -> str:
        digest = hashlib.blake2b(digest_size=16)
        n = int(self.length[row])
        digest.update(f"{n}/{self.horizon}/{self.dt!r}".encode())
        for name in names:
            column = np.ascontiguousarray(self.signals[name][:n, row])
            digest.update(f"{name}:{column.dtype.str}:{column.shape}".encode())
            digest.update(column.tobytes())
        return digest.hexdigest()

    def trace_hash(self, row: int) -> str:
        """Return the hash of every signal of one episode, to the last bit."""
        return self._hash(row, sorted(self.signals))

    def decision_hash(self, row: int) -> str:
        """Return the hash of commands, alarms, modes and collisions: the same on every engine and platform."""
        return self._hash(row, sorted(_DECISIONS))


def episodes_at_once(model: Model, horizon: int, most: int) -> int:
    """Return how many episodes, at least one and at most `most`, fit in MEMORY; rows do not depend on it."""
    return int(max(1, min(most, MEMORY // episode_memory(model, horizon))))


def episode_memory(model: Model, horizon: int) -> int:
    """Return the bytes that the signals of an episode take."""
    agents, wires = model.agents, len(model.wires)
    return horizon * (8 * (agents * (model.states + 3 * wires + 9) + model.states) + agents * (2 * wires + 3))


class Recorder:
    """A collector of frames into a Trace. A truth that all agents share is stored once."""

    def __init__(self, loop: Loop, state: LoopState) -> None:
        self.loop = loop
        self.first = loop.plant.scene(loop.plan.plant, state.plant)._asdict()
        self.signals: dict[str, Array] = {}
        self.length = np.zeros(len(state.k), np.int64)
        self.steps = 0

    def put(self, signals: dict[str, Array], live: Array) -> None:
        """Add the result of `signals_of` for a step that belongs to the episodes `live` (B,)."""
        for name, value in signals.items():
            held = self.signals.get(name)
            if name == "truth" and value.strides[1] == 0 and (held is None or held.shape[2] == 1):
                value = value[:, :1]
            if held is None:
                held = self.signals[name] = np.zeros((self.loop.horizon, *value.shape), value.dtype)
            elif held.shape[1:] != value.shape:  # the truth was shared until now
                held = self.signals[name] = np.repeat(held, value.shape[1], axis=2)
            held[self.steps] = value
        self.length += live
        self.steps += 1

    def trace(self) -> Trace:
        signals, loop = {name: value[: self.steps] for name, value in self.signals.items()}, self.loop
        if signals and signals["truth"].shape != signals["estimate"].shape:
            signals["truth"] = np.broadcast_to(signals["truth"], signals["estimate"].shape)
        return Trace(loop.model, loop.horizon, self.length, signals, self.first, loop.controller.desired_gap)


def worth_tracing(loop: Loop, episodes: int) -> bool:
    """Return True if this many episodes justify a traced loop. Agents take longer to trace and much longer to play: three count as one."""
    return loop.horizon >= LONG or episodes * loop.horizon * max(1.0, loop.model.agents / 3.0) >= WORTH


def rollout(loop: Loop, attack: Attack, keys: Keys, *, terminate: bool = True, plain: bool = False) -> Trace:
    """Play one episode per key and return the trace.

    With `terminate` an episode ends at its first collision, else it runs to the horizon.
    Long work is played by a traced loop if it can be traced, and very long work with a traced attack too.
    `plain` selects the plain loop, with the same bits.
    """
    if not plain and isinstance(watch := loop.defence, Watched):
        seen = rollout(loop.bare, attack, keys, terminate=terminate)
        return dataclasses.replace(seen, signals=seen.signals | {"alarm": watch.alarms(seen.score)})
    if not plain and (play := _player(loop, attack, len(keys.key))) is not None:
        return Trace(loop.model, loop.horizon, *play(keys, terminate), loop.controller.desired_gap)
    state = loop.start(keys)
    plan = attack.prepare(loop.brief)
    memory = attack.start(plan, len(keys.key), keys.at(Role.ATTACK, np.zeros(len(keys.key), np.int64)))
    recorder = Recorder(loop, state)
    for _ in range(loop.horizon):
        live = ~state.ended if terminate else np.ones(len(state.k), bool)
        if not live.any():
            break
        state, memory, frame = loop.step(state, attack, plan, memory)
        recorder.put(signals_of(frame), live)
    return recorder.trace()


def _player(loop: Loop, attack: Attack, episodes: int) -> Player | None:
    """Return a function that plays this many episodes faster than the plain loop, or None."""
    from tailgate.engine.agreement import Untraced
    from tailgate.engine.cards import DeviceError, device
    from tailgate.play.commanded import commanded
    from tailgate.play.rollouts import rollout_of

    here = device()
    if (episodes * loop.horizon >= MANY or here != "cpu") and not isinstance(whole := rollout_of(loop, attack), Untraced):
        return whole.play
    if worth_tracing(loop, episodes) or here != "cpu":
        if not isinstance(program := commanded(loop), Untraced):
            return partial(program.play, attack)
        if here != "cpu":
            raise DeviceError("device", here, f"cpu: {program.why}")
    return None
