"""The loop: the arrows between the nouns, pure on its state.

    each k:  plant -> sensors -> [the attack's command] -> channel -> defence -> controller -> channel -> plant

Time runs k = 1, 2, ..., horizon. At k = 0 the prior is the estimate, and the controller drives the first step on it.
So every measured step is a predict and an update. `sense` and `advance` are the two halves of a step; the attack decides between them.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.pytree import duplicate, frozen, lock, map_leaves, put_rows, widened
from tailgate.core import (
    Air,
    Array,
    Attack,
    Command,
    Controller,
    Defence,
    Estimate,
    Frame,
    Geared,
    Manoeuvre,
    Mode,
    Model,
    Paced,
    Plant,
    Received,
    Receiver,
    Recording,
    Sensor,
    View,
    WhiteBox,
    pair_of,
)  # fmt: skip
from tailgate.core.channel import INSIDER, Channel, ChannelPlan, ChannelState
from tailgate.core.draws import Keys, Role
from tailgate.core.lossy_link import Link, LinkState
from tailgate.core.nouns import P, S
from tailgate.core.score_threshold import Watched
from tailgate.core.threat import Brief, ThreatModel
from tailgate.engine.array import Traced

PERFECT = Link()
START = np.uint32(0xFFFFFFFF)  # the step under which start() draws: no episode reaches it


def check_estimate(estimate: Estimate, model: Model, k: Array, ended: Array) -> None:
    """Raise InputError when a defence's output at step k (B,) lacks the type, shape or finite values that the loop needs.

    Numbers of episodes that have `ended` (B,) may be anything: they belong to no row.
    """
    shape = (len(k), model.agents)
    wanted = {
        "x": ((*shape, model.states), "f"), "score": (shape, "f"), "alarm": (shape, "b"), "mode": (shape, "iu"), "probe": (shape, "b"),
    }  # fmt: skip
    for name, (size, kinds) in wanted.items():
        value = getattr(estimate, name, None)
        if not isinstance(value, (np.ndarray, Traced)) or value.shape != size or value.dtype.kind not in kinds:
            got = f"{value.dtype} {value.shape}" if isinstance(value, (np.ndarray, Traced)) else type(value).__name__
            raise InputError(f"defence output {name}", got, f"an array of shape {size}, kind {kinds!r}")
        if kinds == "f":
            num.demand(np.isfinite(value), f"defence output {name}", "NaN or infinity", "finite numbers", k, over=ended)
    if estimate.limits is not None:
        size = (*shape, len(model.actuators), 2)
        if estimate.limits.shape != size:
            raise InputError("defence output limits", estimate.limits.shape, f"an array of shape {size}, the lower limits first")
        fits = estimate.limits[..., 0] <= estimate.limits[..., 1]
        num.demand(fits, "defence output limits", "limits", "the lower limits first", k, over=ended)
    if estimate.offset is not None:
        size = (*shape, len(model.actuators))
        if estimate.offset.shape != size:
            raise InputError("defence output offset", estimate.offset.shape, f"an array of shape {size}")
        num.demand(np.isfinite(estimate.offset), "defence output offset", "NaN or infinity", "finite numbers", k, over=ended)
    known = ", ".join(f"{m.value} ({m.name})" for m in Mode)
    fits = (estimate.mode >= 0) & (estimate.mode < len(Mode))
    num.demand(fits, "defence output mode", "another number", f"one of {known}", k, estimate.mode, ended)


class LoopPlan(NamedTuple):
    """The plans of all components."""

    plant: object
    sensor: object
    controller: object
    manoeuvre: object
    defence: Any
    channel: ChannelPlan


class LoopState(NamedTuple):
    """Every leaf has B first. `received` and `sent` are this step's, before the attack."""

    keys: Keys
    k: Array  # (B,) int64
    plant: Any
    manoeuvre: object
    controller: object
    defence: Any
    channel: ChannelState
    estimate: Estimate
    probed: Array  # (B, N) bool: the sensor's probe was sent in the step before
    control: Array  # (B, N, m) what was commanded last
    known_u: Array  # (B, N, model inputs)
    sent: Array  # (B, N, q+p)
    received: Received
    ended: Array  # (B,) bool: collided
    link: LinkState | None = None  # where readings are lost or late


@dataclass(frozen=True, eq=False)
class Loop:
    """A closed loop of one plant under one defence, for B independent episodes.

    `told`: the model that defence, controller, channel and attacker use, where it differs from the model of plant and sensor.
    `load`: the vehicle's mass over the nominal one, which divides a commanded acceleration [-].
    `link`: readings that are lost or late.
    """

    plant: Plant
    sensor: Sensor
    controller: Controller
    manoeuvre: Manoeuvre
    threat: ThreatModel
    horizon: int
    defence: Defence
    uses: tuple[str, ...] = ("measurements",)
    ends_on_collision: bool = True
    told: Model | None = None
    load: float = 1.0
    link: Link = PERFECT

    @cached_property
    def bare(self) -> Loop:
        """The loop without a watch on the defence's score: it plays the same episodes, alarms apart."""
        return dataclasses.replace(self, defence=self.defence.defence) if isinstance(self.defence, Watched) else self

    @cached_property
    def model(self) -> Model:
        return self.told or self._own_model

    @cached_property
    def _own_model(self) -> Model:
        return self.plant.model(self.sensor, self.controller)

    @cached_property
    def brief(self) -> Brief:
        return Brief(self.model, self.threat, self.horizon)

    @cached_property
    def plan(self) -> LoopPlan:
        if self.threat.knowledge == "white" and (why := getattr(self.defence, "opaque", "")):
            raise NotApplicable("attack", "white box", f"a black or grey box: {why}")
        return LoopPlan(
            self.plant.prepare(self._own_model),
            self.sensor.prepare(self._own_model),
            self.controller.prepare(self.model),
            self.manoeuvre.prepare(self.model.dt),
            self.defence.prepare(self.model),
            Channel().prepare(self.brief),
        )

    @cached_property
    def shown(self) -> Any:
        """The defence's plan as a white-box attacker holds it: a copy, so that nothing it writes reaches the defence."""
        return lock(copy.deepcopy(self.plan.defence))

    def start(self, keys: Keys) -> LoopState:
        """Return the states of B fresh episodes at k = 1, measured."""
        plan, model = self.plan, self.model
        batch = len(keys.key)
        at_start = np.full(batch, START)
        plant = self.plant.start(plan.plant, keys.at(Role.PRIOR, at_start))
        manoeuvre = self.manoeuvre.start(plan.manoeuvre, keys.at(Role.MANOEUVRE, at_start))
        if isinstance(self.manoeuvre, Recording) and isinstance(self.plant, Paced):
            plant = self.plant.paced(plan.plant, plant, self.manoeuvre.first_speed(plan.manoeuvre, manoeuvre))
        controller = self.controller.start(plan.controller, batch)
        held = self.controller.held(plan.controller, controller, batch)
        prior = self.plant.prior(plan.plant, plant, held, keys.at(Role.PRIOR, at_start))
        shape = (batch, model.agents)
        estimate = Estimate(
            prior.mean, num.zeros(shape), num.zeros(shape, bool), num.full(shape, Mode.NORMAL, np.int8), num.full(shape, True, bool)
        )
        v2v = self.plant.v2v(plan.plant, plant)
        expected = np.concatenate([num.matvec(model.C, prior.mean), v2v], axis=-1)
        k = np.zeros(batch, np.int64)
        odometry = self.plant.odometry(plan.plant, plant)
        controller, u = self.controller.step(plan.controller, controller, estimate, v2v, odometry)
        manoeuvre, plant, known = self._move(keys, k, manoeuvre, plant, u)
        sent, received = self._measure(keys, k + 1, plant, controller, estimate)
        link = None if self.link.perfect else self.link.start(sent)
        return LoopState(
            keys, k + 1, plant, manoeuvre, controller, self.defence.start(plan.defence, prior),
            Channel().start(plan.channel, expected, u), estimate, estimate.probe.copy(order="K"), u, known, sent, received,
            np.zeros(batch, bool), link,
        )  # fmt: skip

    def restart(self, state: LoopState, mask: Array) -> LoopState:
        """Return the state with new episodes in the rows of `mask` (B,) bool, each with its next counter; the other rows keep every bit."""
        rows = np.flatnonzero(mask)
        if not len(rows):
            return state
        keys = Keys(state.keys.key[rows], state.keys.episode[rows] + np.uint32(1))
        return self.reseed(state, rows, keys)

    def reseed(self, state: LoopState, rows: Array, keys: Keys) -> LoopState:
        """Return the state with new episodes in `rows` (R,), from the given keys of R rows."""
        fresh = self.start(keys)
        out: LoopState = put_rows(state, rows, fresh)
        return out

    def sense(self, state: LoopState) -> View:
        """Return the part of the state that the threat model lets the attacker see now."""
        plan, channel = self.plan, state.channel
        threat = self.threat
        budget_left = Channel().budget_left(plan.channel, channel)
        budget = np.full(len(state.k), np.inf if threat.budget is None else threat.budget, np.float64)
        view = View(
            k=state.k,
            progress=state.k / self.horizon,
            scene=self.plant.scene(plan.plant, state.plant),
            budget_left=budget_left,
            budget=budget,
            burst=channel.burst,
            cooldown=channel.cooldown,
            allowed=Channel().allowed(plan.channel, channel, state.k),
            last=channel.last,
        )
        if self.model.air:  # a radio signal: everybody near hears it
            view = view._replace(probed=state.probed)
        if threat.knowledge in ("grey", "white"):
            view = view._replace(control=state.control)
        if threat.knowledge == "white":
            box = WhiteBox(self.defence, self.shown, duplicate(state.defence), frozen(state.known_u))
            view = view._replace(defence=box, estimate=state.estimate, truth=self._truth(state.plant, state.controller))
        if threat.sees_measurement or threat.knowledge == "white":
            view = view._replace(received=state.received)
        shown: View = frozen(view._replace(defence=None))  # an attack looks; the channel alone acts
        return shown._replace(defence=view.defence)

    def advance(self, state: LoopState, command: Command) -> tuple[LoopState, Frame]:
        """Play the rest of the step: channel, defence, controller, plant, and the next measurement."""
        plan = self.plan
        truth, odometry = self._truth(state.plant, state.controller), self.plant.odometry(plan.plant, state.plant)
        channel, received, arrived, refused = Channel().apply(
            plan.channel, state.channel, state.sent, state.received, command, state.k, self._again(state, truth)
        )
        heard = received._replace(
            v2v=received.v2v if "v2v" in self.uses else None,
            odometry=odometry if "odometry" in self.uses else None,
            attacked=received.attacked if "truth" in self.uses else None,
        )
        answer = self.defence.step(
            plan.defence, state.defence, frozen(heard), frozen(state.known_u), state.keys.at(Role.DEFENCE, state.k)
        )
        defence, estimate = pair_of(answer)
        check_estimate(estimate, self.model, state.k, state.ended)
        if "probe" not in self.uses:  # only a defence that declares `probe` may mute it
            estimate = estimate._replace(probe=num.full(estimate.probe.shape, True, bool))
        assert received.v2v is not None
        controller, u = self.controller.step(plan.controller, state.controller, estimate, received.v2v, odometry)
        if estimate.offset is not None:
            u = u + estimate.offset
            estimate = estimate._replace(offset=None)
        if estimate.limits is not None:
            u = np.clip(u, estimate.limits[..., 0], estimate.limits[..., 1])
            estimate = estimate._replace(limits=None)
        if plan.channel.kinds[INSIDER] and isinstance(self.controller, Geared) and self.model.gains:
            factors, inside = Channel().factors(plan.channel, channel)
            if num.some(inside):  # the car drives by its altered law, whatever its own defence asks for
                heard_by = state.controller, estimate, received.v2v, odometry
                altered, own = self.controller.scaled(plan.controller, *heard_by, factors)
                controller = map_leaves(lambda new, old: np.where(widened(inside, new), new, old), altered, controller)
                u = np.where(inside[..., None], own, u)
        channel, applied = Channel().actuate(plan.channel, channel, u)
        manoeuvre, plant, known = self._move(state.keys, state.k, state.manoeuvre, state.plant, applied, u)
        scene = self.plant.scene(plan.plant, plant)
        collided = np.any(scene.gap <= 0.0, axis=1)
        rear_collided = np.any(scene.rear_gap <= 0.0, axis=1)
        frame = Frame(
            state.k, truth, state.sent, arrived, channel.last, refused, estimate, u, applied, scene, received, collided,
            rear_collided,
        )
        sent, fresh = self._measure(state.keys, state.k + 1, plant, controller, estimate)
        link = state.link
        if link is not None:
            link, sent, fresh = self.link.step(link, sent, fresh, state.keys.at(Role.LINK, state.k + 1))
        ended = state.ended | ((collided | rear_collided) & self.ends_on_collision)
        state = LoopState(
            state.keys, state.k + 1, plant, manoeuvre, controller, defence, channel, estimate, state.estimate.probe, u, known, sent,
            fresh, ended, link,
        )  # fmt: skip
        return state, frame

    def later(self, state: LoopState, steps: Array) -> LoopState:
        """Return the state with its clock `steps` (B,) later, and with what is measured then: nothing drove in between."""
        k = state.k + steps
        sent, fresh = self._measure(state.keys, k, state.plant, state.controller, state.estimate)
        link = state.link
        if link is not None:
            link, sent, fresh = self.link.step(link, sent, fresh, state.keys.at(Role.LINK, k))
        return state._replace(k=k, sent=sent, received=fresh, link=link)

    def step(self, state: LoopState, attack: Attack[P, S], plan: P, memory: S) -> tuple[LoopState, S, Frame]:
        """Sense, decide and advance once. `plan` and `memory` are the attack's plan and state."""
        memory, command = attack.decide(plan, memory, self.sense(state), state.keys.at(Role.ATTACK, state.k))
        state, frame = self.advance(state, command)
        return state, memory, frame

    def _truth(self, plant: object, controller: object) -> Array:
        held = self.controller.held(self.plan.controller, controller, len(self.plant.lead_speed_of(plant)))
        return self.plant.truth(self.plan.plant, plant, held)

    def _again(self, state: LoopState, truth: Array) -> Callable[[Air], Received] | None:
        """Return this step's measurement as a function of what is radiated; None for sensors that receive nothing over the air."""
        if not self.model.air:
            return None
        sensor, draws = cast(Receiver, self.sensor), state.keys.at(Role.SENSOR, state.k)
        return lambda air: sensor.disturbed(self.plan.sensor, truth, state.estimate.probe, draws, air)

    def _measure(self, keys: Keys, k: Array, plant: object, controller: object, estimate: Estimate) -> tuple[Array, Received]:
        truth = self._truth(plant, controller)
        received = self.sensor.measure(self.plan.sensor, truth, estimate.probe, keys.at(Role.SENSOR, k))
        columns = [received.y[..., i] for i in range(received.y.shape[-1])]
        v2v = self.plant.v2v(self.plan.plant, plant)
        return num.stack(columns + [v2v[..., i] for i in range(v2v.shape[-1])]), received

    def _move(
        self, keys: Keys, k: Array, manoeuvre: object, plant: object, applied: Array, u: Array | None = None
    ) -> tuple[object, object, Array]:
        """Return the next states of manoeuvre and plant, and the known input; u is the command where it differs from what is applied."""
        plan = self.plan
        manoeuvre, exo = self.manoeuvre.accel(
            plan.manoeuvre, manoeuvre, k, self.plant.lead_speed_of(plant), keys.at(Role.MANOEUVRE, k)
        )
        driven = applied if self.load == 1.0 else applied / self.load
        plant = self.plant.step(plan.plant, plant, driven, exo, keys.at(Role.PROCESS, k))
        return manoeuvre, plant, self.plant.known(plan.plant, applied if u is None else u, exo, plant)
