"""From a view to an observation vector: pure, and used by the environments and by trained policies that play as attacks alike."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple, TypeVar

import numpy as np

from tailgate import num
from tailgate.core import AIRED, Array, Kind, Model, View
from tailgate.core.reach import hops
from tailgate.core.threat import Brief, receivers

LIMIT = 10.0  # observations are clipped to +-LIMIT
FRAMES = 64  # decisions that an observation shows, at most
SHOWN = 24  # agents with separate components in an observation, at most
RADIATED = {Kind.NOISE_JAM: ("power", "jam_power"), Kind.ECHO_DELAY: ("delay", "delay_bound")}  # their component, and their bound
SCALES = {  # what is about 1: steps, metres, metres per second, metres per second squared
    "burst": 50.0, "cooldown": 50.0, "gap": 50.0, "speed": 15.0, "lead_speed": 15.0, "closing": 5.0, "accel": 3.0, "rear_gap": 50.0,
    "rear_closing": 5.0, "control": 3.0,
}  # fmt: skip
LANE_SCALES = {"rate": 0.5, "curvature": 4e-3, "accel": 3.0, "control": 0.03}  # [m/s], [1/m], [m/s^2], [rad]
LANE_ERRORS = (0.5, 0.5, 0.05, 0.05)  # offset and its rate [m, m/s], heading and its rate [rad, rad/s]
LAST_SCALE = 10.0  # of the value sent last, where its bound is larger [unit of the wire]
T = TypeVar("T")


class Sight(NamedTuple):
    """A view, and results of it that all agents share, each (B, N); None where it is not granted."""

    view: View
    gap_error: Array | None = None
    speed_error: Array | None = None
    error: Array | None = None  # the state's, 2-norm
    noise: Array | None = None  # the readings', 2-norm
    reading: Array | None = None


def spread(model: Model) -> float:
    """Return the standard deviation of all that moves the state in a step, from the public model."""
    return math.sqrt(sum(model.Q.diagonal().tolist()))


Column = tuple[str, Callable[[Sight], Array]]  # a component of the observation: its name, and its values (B,)


@dataclass(frozen=True, eq=False)
class ObservationCodec:
    """The learner's observation, scaled to about one and clipped.

    A road shows gaps, speeds and accelerations of the cars; without one there is nothing to see from outside. Of many agents the SHOWN
    that are nearest to the attacked ones have separate components, tagged with their number; all count in the smallest gap.

    With several `frames` the observation also shows what was seen at the last decisions, the newest first; `@1` is that of one before.
    """

    brief: Brief
    frames: int = 1

    def __getstate__(self) -> dict[str, Any]:
        return {name: held for name, held in self.__dict__.items() if name != "columns"}  # functions, which a copy makes again

    @property
    def names(self) -> tuple[str, ...]:
        now = [name for name, _ in self.columns]
        return tuple(name if age == 0 else f"{name}@{age}" for age in range(self.frames) for name in now)

    @cached_property
    def alone(self) -> bool:
        """One car that follows another: the layout of the published policies."""
        return self.brief.model.agents == 1 and bool(self.brief.model.followers[0])

    @cached_property
    def victims(self) -> list[int]:
        return [int(i) for i in np.flatnonzero(self.brief.granted.any(axis=1))]

    @cached_property
    def shown(self) -> list[int]:
        """The agents with separate components: all, or of many those with the fewest hops to an attacked one."""
        model = self.brief.model
        if model.agents <= SHOWN:
            return list(range(model.agents))
        far = hops(model.graph)[self.victims].min(axis=0, initial=np.inf)
        return sorted(np.argsort(far, kind="stable")[:SHOWN].tolist())

    @cached_property
    def spread(self) -> float:
        """The distance that the state goes unforeseen in a step, by the public model: the scale of a state's error."""
        return spread(self.brief.model)

    @cached_property
    def columns(self) -> tuple[Column, ...]:
        """Every component in its order."""
        out: list[Column] = [
            ("progress", lambda s: s.view.progress), ("allowed", lambda s: s.view.allowed), ("budget_left", _left),
            ("burst", lambda s: s.view.burst / SCALES["burst"]), ("cooldown", lambda s: s.view.cooldown / SCALES["cooldown"]),
        ]  # fmt: skip
        for i in self.shown:
            tag = "" if self.brief.model.agents == 1 else f"[{i}]"
            parts = self._road(i) + self._commands(i) + self._errors(i) + self._noise(i)
            out += [(name + tag, column) for name, column in parts]
        if len(self.shown) < self.brief.model.agents:
            out += self._all()
        out.append(("attacking", lambda s: s.view.last.kind != Kind.NONE))
        return tuple(out)

    def _road(self, i: int) -> list[Column]:
        """Return what anyone near the road sees of car i."""
        model = self.brief.model
        if model.lane:
            return _in_lane(i, model.lane)
        speed: list[Column] = [("speed", lambda s: s.view.scene.speed[:, i] / SCALES["speed"])]
        accel: list[Column] = [("accel", lambda s: s.view.scene.accel[:, i] / SCALES["accel"])]
        if not model.followers[i]:
            return speed + accel if model.speed is not None and model.speed[i].any() else []
        gap: list[Column] = [("gap", lambda s: s.view.scene.gap[:, i] / SCALES["gap"])]
        closing: list[Column] = [("closing", lambda s: (s.view.scene.speed[:, i] - s.view.scene.lead_speed[:, i]) / SCALES["closing"])]
        if not self.alone:  # the car ahead and the one behind have separate components
            return gap + speed + closing + accel
        lead: list[Column] = [("lead_speed", lambda s: s.view.scene.lead_speed[:, i] / SCALES["lead_speed"])]
        rear: list[Column] = [
            ("rear_gap", lambda s: s.view.scene.rear_gap[:, i] / SCALES["rear_gap"]),
            ("rear_closing", lambda s: (s.view.scene.rear_speed[:, i] - s.view.scene.speed[:, i]) / SCALES["rear_closing"]),
        ]
        return gap + speed + lead + closing + accel + rear

    def _commands(self, i: int) -> list[Column]:
        """Return the attacker's last command to agent i, and (grey) the agent's own last command."""
        model, bounds = self.brief.model, self.brief.bounds
        scale = np.minimum(bounds, LAST_SCALE) if model.followers.any() else bounds
        kinds = {Kind[name.upper()] for name in self.brief.threat.kinds}
        radiated = [kind for kind in AIRED if kind in kinds and receivers(self.brief)[i].any()]
        out: list[Column] = []
        if not radiated or kinds - set(AIRED):
            of = _last_wire if radiated else _last
            out += [(f"last_{model.wires[w]}", of(i, w, float(scale[w]))) for w in np.flatnonzero(self.brief.granted[i]).tolist()]
        for kind in radiated:
            name, bound = RADIATED[kind]
            out.append((f"last_{name}", _radiated(i, kind, getattr(self.brief.threat, bound))))
        if model.air:
            out.append(("probed", lambda s: _given(s.view.probed)[:, i]))
        if len(self.victims) > 1 and i in self.victims:
            out.append(("attacked", lambda s: np.any(s.view.last.target[:, i], axis=1)))
        if self.brief.threat.knowledge != "black" and (model.followers[i] or not model.followers.any()):
            size = LANE_SCALES["control"] if model.lane else SCALES["control"]
            out += [(f"control{j}", _control(i, j, size)) for j in range(len(model.actuators))]
        return out

    def _errors(self, i: int) -> list[Column]:
        """Return (white) the error of agent i, and the outputs of its defence."""
        model = self.brief.model
        if self.brief.threat.knowledge != "white":
            return []
        if self.alone:
            sizes = LANE_ERRORS if model.lane else (5.0,) * model.states
            out: list[Column] = [(f"error{j}", _state_error(i, j, sizes[j])) for j in range(model.states)]
        elif model.followers.any():
            out = [("gap_error", lambda s: _given(s.gap_error)[:, i] / 5.0)] if model.followers[i] else []
            out.append(("speed_error", lambda s: _given(s.speed_error)[:, i] / 5.0))
        else:
            out = [("error", lambda s: num.log(1.0 + _given(s.error)[:, i] / self.spread))]
            out += self._foreseen() if model.agents == 1 else []
        score: Column = ("score", lambda s: _given(s.view.estimate).score[:, i] / 20.0)
        return [*out, score, ("alarm", lambda s: _given(s.view.estimate).alarm[:, i])]

    def _foreseen(self) -> list[Column]:
        """Return (white, one agent) how far the reading would surprise the model; of a closed loop also reading, belief, difference.

        The surprise is y - C (A x + B u + c) with the value sent last on top, in the standard deviations of a step. The defence's
        innovation would be near that, were the value sent again.
        """
        model, q = self.brief.model, range(len(self.brief.model.sensors))
        C = model.C[0]
        sd = [math.sqrt(float(num.dot(C[j], num.matvec(model.Q, C[j]))) + float(model.R[0, j, j])) for j in q]

        def surprise(s: Sight, j: int) -> Array:
            before, u = _given(s.view.estimate).x, _given(s.view.defence).known_u
            x = num.matvec(model.A, before) + num.matvec(model.B, u) + model.c
            off = _given(s.view.received).y[:, 0, j] - num.matvec(model.C, x)[:, 0, j]
            return np.asarray((off + s.view.last.value[:, 0, j]) / sd[j])

        def sizes(s: Sight) -> dict[str, Array]:
            y, believed = _given(s.view.received).y, num.matvec(model.C, _given(s.view.estimate).x)
            return {"reading": y, "moved": y - believed, "believed": believed}

        def size(s: Sight, name: str) -> Array:
            value = sizes(s)[name][:, 0]
            return np.asarray(num.log(1.0 + np.sqrt(num.dot(value, value)) / self.spread))

        out: list[Column] = [(f"innovation_{model.sensors[j]}", partial(surprise, j=j)) for j in q]
        return out + [(name, partial(size, name=name)) for name in ("reading", "moved", "believed") if model.inputs]

    def _noise(self, i: int) -> list[Column]:
        """Return (granted measurement) the errors of agent i's readings of gap and speed; without a road sizes only."""
        model, threat = self.brief.model, self.brief.threat
        if not (threat.sees_measurement or threat.knowledge == "white"):
            return []
        if not model.followers.any():
            known = threat.knowledge == "white"
            off: Column = ("noise", lambda s: _given(s.noise)[:, i] / math.sqrt(sum(model.R[i].diagonal().tolist())))
            return [off] if known else [("reading", lambda s: num.log(1.0 + _given(s.reading)[:, i] / self.spread))]
        sd = [1.0 if self.alone and not model.lane else math.sqrt(model.R[i, j, j]) for j in range(len(model.sensors))]
        read = {j: truth for j in range(len(model.sensors)) if (truth := self._read(i, j))}
        out: list[Column] = [(f"noise_{model.sensors[j]}", _off(i, j, truth, sd[j])) for j, truth in read.items()]
        if model.air:
            out.append(("silent", lambda s: ~np.any(_given(s.view.received).valid[:, i], axis=1)))
        return out

    def _read(self, i: int, j: int) -> str:
        """Return the part of the scene that sensor j of agent i reads: gap, speed, position or relative speed; empty for any other."""
        model = self.brief.model
        if model.air and model.sensors[j] == "relative_speed":
            return "relative_speed"
        assert model.gap is not None and model.speed is not None
        if model.lane:
            return "offset" if np.array_equal(-model.gap[i], model.C[i, j]) else ""
        rows = {"gap": model.gap[i], "position": -model.gap[i], "speed": model.speed[i]}
        return next((name for name, row in rows.items() if row.any() and np.array_equal(row, model.C[i, j])), "")

    def _all(self) -> list[Column]:
        """Return components of all agents together, where not every one is shown."""
        road, white = bool(self.brief.model.followers.any()), self.brief.threat.knowledge == "white"
        out: list[Column] = [("least_gap", lambda s: np.min(s.view.scene.gap, axis=1) / 50.0)] if road else []
        if white and road:
            out.append(("largest_error", lambda s: np.max(np.abs(_given(s.gap_error)), axis=1) / 5.0))
        elif white:
            out.append(("largest_error", lambda s: num.log(1.0 + np.max(_given(s.error), axis=1) / self.spread)))
        return out

    def observe(self, view: View, before: Array | None = None) -> Array:
        """Return (B, d) float32, d = len(names); `before` (B, d) is the last decision's observation, none at the first of an episode."""
        sight, width = self._sight(view), len(self.columns)
        out = np.empty((len(view.k), width * self.frames), np.float32)
        for j, (_, column) in enumerate(self.columns):
            out[:, j] = np.clip(column(sight), -LIMIT, LIMIT)
        if self.frames > 1:
            out[:, width:] = np.tile(out[:, :width], self.frames - 1) if before is None else before[:, :-width]
        return out

    def _sight(self, view: View) -> Sight:
        model, threat = self.brief.model, self.brief.threat
        sight, road, white = Sight(view), bool(model.followers.any()), threat.knowledge == "white"
        if self.alone:
            return sight
        if white:
            x, truth = _given(view.estimate).x, _given(view.truth)
            if road:
                sight = sight._replace(gap_error=model.gap_error(x, truth), speed_error=model.speed_error(x, truth))
            else:
                off = _given(view.received).y - num.apply(model.C, truth)
                sight = sight._replace(error=model.error(x, truth), noise=np.sqrt(num.dot(off, off)))
        elif threat.sees_measurement and not road:
            y = _given(view.received).y
            sight = sight._replace(reading=np.sqrt(num.dot(y, y)))
        return sight


def _in_lane(i: int, lane: float) -> list[Column]:
    """Return what anyone near the road sees of car i in a lane of half width `lane` [m]."""
    return [
        ("offset", lambda s: _given(s.view.scene.lane).offset[:, i] / lane),
        ("rate", lambda s: _given(s.view.scene.lane).rate[:, i] / LANE_SCALES["rate"]),
        ("curvature", lambda s: _given(s.view.scene.lane).curvature[:, i] / LANE_SCALES["curvature"]),
        ("lateral_accel", lambda s: s.view.scene.accel[:, i] / LANE_SCALES["accel"]),
        ("gap", lambda s: s.view.scene.gap[:, i] / lane),
    ]


def _given(value: T | None) -> T:
    """Return the grants of the threat model."""
    assert value is not None
    return value


def _left(sight: Sight) -> Array:
    """Return the share of the budget that is left; 1 where it is unlimited."""
    view = sight.view
    bounded = np.isfinite(view.budget)
    return np.where(bounded, view.budget_left / np.where(bounded & (view.budget > 0), view.budget, 1.0), 1.0)


def _last(i: int, w: int, scale: float) -> Callable[[Sight], Array]:
    return lambda s: s.view.last.value[:, i, w] / scale


def _last_wire(i: int, w: int, scale: float) -> Callable[[Sight], Array]:
    """Return what `_last` returns, but 0 where the last command was one over the air."""
    return lambda s: np.where(np.isin(s.view.last.kind, AIRED), 0.0, s.view.last.value[:, i, w] / scale)


def _radiated(i: int, kind: Kind, most: float) -> Callable[[Sight], Array]:
    """Return the power or the delay last sent to agent i, in units of its bound."""
    return lambda s: np.where(s.view.last.kind == kind, np.max(s.view.last.value[:, i], axis=1) / most, 0.0)


def _control(i: int, j: int, scale: float) -> Callable[[Sight], Array]:
    return lambda s: _given(s.view.control)[:, i, j] / scale


def _state_error(i: int, j: int, scale: float) -> Callable[[Sight], Array]:
    return lambda s: (_given(s.view.estimate).x[:, i, j] - _given(s.view.truth)[:, i, j]) / scale


def _off(i: int, j: int, truth: str, sd: float) -> Callable[[Sight], Array]:
    """Return sensor j of agent i less the part `truth` of the scene, in standard deviations; 0 without a reading."""

    def off(s: Sight) -> Array:
        scene, received = s.view.scene, _given(s.view.received)
        true = scene.lead_speed - scene.speed if truth == "relative_speed" else getattr(scene.lane if truth == "offset" else scene, truth)
        return np.where(received.valid[:, i, j], (received.y[:, i, j] - true[:, i]) / sd, 0.0)

    return off
