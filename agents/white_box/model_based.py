"""Attacks that are computed: from the public model of the plant, or from the defence itself."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.agents.scripts.aim import chosen, require
from tailgate.agents.scripts.scripted import Script, ScriptPlan
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Command, Count, Finite, Kind, Model, NonNegative, Positive, View, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Lag
from tailgate.core.registry import register
from tailgate.core.threat import Brief


class Schedule(NamedTuple):
    """The values added to the wires, step by step from the opening of the window."""

    value: Array  # (K, N, w); the last row holds from then on
    scale: float  # factor by which the bounds shrink the plan


def consistent(brief: Brief, inputs: Array, actuators: Array, lied: Array, steps: int) -> Array:
    """Return (steps, N, w): inputs (T, actuators) on the actuators, and -C x on the wires `lied` (w,), where x is what the inputs cause.

    x+ = A x + B a from x = 0: by linearity the readings with the lie are those of a plant that nobody touches.
    """
    model = brief.model
    B = model.B[:, actuators]
    out = np.zeros((steps, model.agents, len(model.wires)))
    q = len(model.sensors)
    first = q + len(model.v2v)
    x = np.zeros(model.states)
    for k in range(steps):
        a = inputs[k] if k < len(inputs) else np.zeros(len(actuators))
        for i in range(model.agents):
            out[k, i, :q] = np.where(lied[:q], -num.matvec(model.C[i], x), 0.0)
            out[k, i, first + actuators] = a
        x = num.matvec(model.A, x) + num.matvec(B, a)
    return out


def _driver(brief: Brief, where: str) -> None:
    """Raise NotApplicable unless what an agent commands is the model's input, and there is one agent."""
    model = brief.model
    if model.agents != 1 or model.inputs != len(model.actuators):
        raise NotApplicable(f"{where}: model", f"{model.agents} agents, of which each knows the closed loop", "one agent and its own input")


def _share_of_bounds(brief: Brief, value: Array) -> float:
    """Return the largest |value| (..., w) in units of its wire's bound."""
    return float(np.max(np.abs(value) / brief.bounds))


def _play(plan: ScriptPlan, on: Array, count: Array) -> Command:
    """Return the command of the schedule's present step."""
    schedule: Schedule = plan.extra
    value = num.take(schedule.value, np.minimum(count, len(schedule.value) - 1))
    return plan.brief.command(on, Kind.FDI, plan.target, np.clip(value, -plan.brief.bounds, plan.brief.bounds))


@register("attack", "covert", reference="R. S. Smith, Covert Misappropriation of Networked Control Systems, 2015")
@dataclass(frozen=True)
class Covert(Script):
    """Drives the car away through the actuator and subtracts from every sensor what this causes: nobody hears a difference.

    The displacement is reached with the least energy of the input that brings the model there in `rise`, and kept. Bounds shrink the
    whole plan, so that it stays consistent. It is covert while it is allowed, and while the plant is linear: a car that stops is not.
    """

    displacement: Finite = param(10.0, "by how far the state is displaced, at most; the bounds may allow less [unit of the state]")
    rise: Lag = param(10.0, "time in which it gets there [s]")
    state_index: Count = param(0, "which state is displaced; it has to rest where it is put, as a position does")

    def prepare(self, brief: Brief) -> ScriptPlan:
        model, where = brief.model, "attack covert"
        sensors = np.arange(len(model.wires)) < len(model.sensors)
        _driver(brief, where)
        target = chosen(brief, self.targets, sensors | brief.is_actuator & brief.granted)[0]
        if not target[sensors].all() or not (target & brief.is_actuator).any() or (target & ~sensors & ~brief.is_actuator).any():
            wanted = f"a threat model and targets with every sensor ({', '.join(model.sensors)}) and an actuator"
            raise NotApplicable(f"{where}: targets", [n for n, m in zip(model.wires, target, strict=True) if m], wanted)
        require(brief, where, ["fdi"], target)
        actuators = np.flatnonzero(target[brief.is_actuator])
        goal = np.zeros(model.states)
        if self.state_index >= model.states:
            raise InputError(f"{where}.state_index", self.state_index, f"at most {model.states - 1}")
        goal[self.state_index] = self.displacement
        if not np.array_equal(num.matvec(model.A, goal), goal):
            raise NotApplicable(f"{where}.state_index", self.state_index, "a state that rests where it is put")
        inputs = self._cheapest(brief, actuators, goal)
        value = consistent(brief, inputs, actuators, target, brief.horizon + 1)
        share = _share_of_bounds(brief, value)
        scale = 1.0 if share <= 1.0 else (1.0 - 1e-12) / share
        return ScriptPlan(brief, target[None], Schedule(scale * value, scale))

    def _cheapest(self, brief: Brief, actuators: Array, goal: Array) -> Array:
        """Return inputs (T, actuators) of least energy from rest to `goal`: a = W' (W W')^-1 goal, with W = [.., A B, B]."""
        model = brief.model
        steps = max(round(self.rise / model.dt), model.states)
        columns = [np.array(model.B[:, actuators])]
        for _ in range(steps - 1):
            columns.append(num.matmul(model.A, columns[-1]))
        gramian = np.zeros((model.states, model.states))
        for column in columns:
            gramian += num.matmul(column, num.transpose(column))
        with np.errstate(all="ignore"):  # a state out of reach shows in the result
            multiplier = num.matvec(num.inverse(gramian), goal)
            inputs = np.array([num.matvec(num.transpose(column), multiplier) for column in reversed(columns)])
            reached = np.zeros(model.states)
            for a in inputs:
                reached = num.matvec(model.A, reached) + num.matvec(model.B[:, actuators], a)
            if not np.max(np.abs(reached - goal)) <= 1e-6 * np.max(np.abs(goal)):
                raise NotApplicable("attack covert.state_index", self.state_index, "a state that the granted actuators can reach")
        return inputs

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return _play(plan, on, count)


class Zero(NamedTuple):
    """An invariant zero z: inputs Re(z^k g) from the state Re(x) leave the trusted outputs at zero."""

    z: complex
    x: Array  # (n,) complex
    g: Array  # (m,) complex, largest entry of size 1


def invariant_zeros(A: Array, B: Array, C: Array) -> list[Zero]:
    """Return finite invariant zeros of (A, B, C) with |z| < 100; C (p, n) has at least as many rows as B (n, m) has columns.

    Where the Rosenbrock pencil [A - z I, B; C, 0] loses rank. With more outputs than inputs, zeros of m of them are candidates, and those
    that silence the others as well are kept.
    """
    from scipy import linalg  # takes long to import

    n, m = B.shape
    right = np.zeros((n + m, n + m))
    right[:n, :n] = np.eye(n)
    found: list[Zero] = []
    for rows in combinations(range(len(C)), m):
        left = np.zeros((n + m, n + m))
        left[:n, :n], left[:n, n:], left[n:, :n] = A, B, C[list(rows)]
        pairs, vectors = linalg.eig(left, right, homogeneous_eigvals=True)
        for (alpha, beta), vector in zip(pairs.T, vectors.T, strict=True):
            x, g = vector[:n], vector[n:]
            size = float(np.max(np.abs(vector)))
            if not np.isfinite(vector).all() or abs(alpha) >= 100.0 * abs(beta) or np.max(np.abs(g)) <= 1e-9 * size:
                continue  # at infinity, or a mode that no input drives
            if max(np.max(np.abs(num.matvec(C, part))) for part in (x.real, x.imag)) > 1e-8 * size:
                continue
            peak = g[np.argmax(np.abs(g))]
            zero = Zero(complex(alpha / beta), x / peak, g / peak)
            if all(abs(zero.z - other.z) > 1e-6 for other in found):
                found.append(zero)
    return sorted(found, key=lambda zero: abs(zero.z))


@register(
    "attack", "zero_dynamics",
    reference="A. Teixeira et al., Revealing Stealthy Attacks in Control Systems, 2012; F. Pasqualetti et al., Attack Detection, 2013",
)  # fmt: skip
@dataclass(frozen=True)
class ZeroDynamics(Script):
    """An input that grows along an invariant zero of the plant, as seen by the sensors that the attacker does not control.

    The trusted sensors show next to nothing, as the input begins small; from the granted ones the attacker subtracts what it causes. It
    ends at the last step before a bound is reached. Applies only where there is a growing zero.
    """

    first: Positive = param(1e-6, "size of the first input [unit of the actuator]")

    def prepare(self, brief: Brief) -> ScriptPlan:
        model, where = brief.model, "attack zero_dynamics"
        sensors = np.arange(len(model.wires)) < len(model.sensors)
        _driver(brief, where)
        target = chosen(brief, self.targets, brief.granted & (sensors | brief.is_actuator))[0]
        actuators = np.flatnonzero(target[brief.is_actuator])
        if not len(actuators):
            raise NotApplicable(f"{where}: threat_model.targets", list(brief.threat.targets), "a threat model that grants an actuator")
        require(brief, where, ["fdi"], target)
        trusted = np.flatnonzero(~target[: len(model.sensors)])
        names = [model.sensors[i] for i in trusted]
        C = model.C[:, trusted].reshape(-1, model.states)
        if len(C) < len(actuators) or not len(C):
            raise NotApplicable(f"{where}: trusted sensors", names, f"at least {len(actuators)}, as many as actuators (with none: covert)")
        zeros = invariant_zeros(model.A, model.B[:, actuators], C)
        growing = [zero for zero in zeros if abs(zero.z) > 1.0 + 1e-6]
        if not growing:
            shown = ", ".join(f"{zero.z:.3g}" for zero in zeros) or "none"
            raise NotApplicable(f"{where}: trusted sensors", names, f"an invariant zero that grows; the zeros are: {shown}")
        zero = growing[0]
        inputs, power = [], complex(self.first)
        for _ in range(brief.horizon):
            inputs.append(np.real(power * zero.g))
            if np.max(np.abs(inputs[-1])) > brief.threat.actuator_bound:
                break
            power *= zero.z
        value = consistent(brief, np.array(inputs), actuators, target, len(inputs))
        within = [_share_of_bounds(brief, step) <= 1.0 for step in value]
        last = within.index(False) if False in within else len(within)
        if last < 2:
            raise NotApplicable(f"{where}.first", self.first, "a first input far below the bounds of the threat model")
        return ScriptPlan(brief, target[None], Schedule(value[:last], 1.0))

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        schedule: Schedule = plan.extra
        return _play(plan, on & (count < len(schedule.value)), count)


@register("attack", "stealth", knowledge="white", reference="Dutta 2018, Theorem 4.5.3")
@dataclass(frozen=True)
class Stealth(Script):
    """White box: each step moves the estimate as far along one state as the gate lets through; no attacked agent alarms in that step.

    Let e be the direction. With every sensor granted, the innovation is driven to r = s sqrt(g) S K' e / sqrt(e' K S K' e), just inside
    the gate g. With fewer wires, it goes to the farthest point that those reach. Among several agents each is pushed to its own gate; those
    that fuse its belief afterwards may alarm.
    """

    state_index: Count = param(0, "which state to push: 0 position, 1 velocity, 2 acceleration; among several cars 0 the gap, 1 the speed")
    sign: Literal[-1, 1] = param(-1, "-1 makes the car believe that it is further back, or has a larger gap")
    gate: NonNegative | None = param(None, "gate to stay under; none: the defence's own, or 20 where it has none [-]")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        if view.defence is None or view.received is None:
            raise InputError("threat_model.knowledge", plan.brief.threat.knowledge, "white: attack stealth needs it")
        box = view.defence
        if not hasattr(box.defence, "look"):
            raise NotApplicable("attack stealth", type(box.defence).__name__, "a defence that shows its innovation (look)")
        look = box.defence.look(box.plan, box.state, view.received, box.known_u)
        gate = self.gate if self.gate is not None else look.gate if look.gate is not None else 20.0
        r, S = look.innovation
        aimed = plan.target[:, : r.shape[-1]]
        touched = np.flatnonzero(aimed.any(axis=0))
        row = self._gain(plan.brief, look.gain)[..., touched]  # K' e on the wires that are attacked
        W = num.inverse(S)
        part = num.inverse(W[..., touched[:, None], touched])
        pull = num.matvec(W, r)[..., touched]
        # (r + a)' W (r + a) over the attacked wires is least at -centre, and there leaves `spent` of the gate
        centre = num.matvec(part, pull)
        spent = num.dot(r, num.matvec(W, r)) - num.dot(pull, centre)
        room = (1.0 - 1e-9) * gate - spent
        push = num.matvec(part, row)
        strength = num.dot(row, push)
        reach = np.sqrt(np.maximum(room, 0.0) / np.where(strength > 0.0, strength, np.inf))
        wanted = self.sign * reach[..., None] * push - centre
        # on the line from no injection to the wanted one the score stays convex: shrinking to the bound stays inside
        largest = np.max(np.abs(wanted), axis=-1)
        wanted = wanted * np.minimum(1.0, plan.brief.threat.fdi_bound / np.maximum(largest, 1e-300))[..., None]
        value = num.zeros((len(view.k), *plan.target.shape))
        value[..., touched] = np.where(aimed[:, touched], wanted, 0.0)
        inside = num.quadratic(r + value[..., : r.shape[-1]], W) <= gate
        target = plan.target & inside[..., None]  # out of reach in this step, whatever is injected: keep still
        return plan.brief.command(on & target.any(axis=(1, 2)), Kind.FDI, target, value)

    def prepare(self, brief: Brief) -> ScriptPlan:
        plan, model, where = super().prepare(brief), brief.model, "attack stealth"
        if self.state_index >= (2 if model.agents > 1 and model.followers.any() else model.states):
            raise NotApplicable(f"{where}.state_index", self.state_index, "a state of the model; among several cars 0 or 1")
        sensors = plan.target[:, : len(model.sensors)]
        if not sensors.any():
            raise NotApplicable(f"{where}: targets", list(self.targets), "a sensor")
        if (sensors.any(axis=1, keepdims=True) & (sensors != sensors.any(axis=0))).any():
            raise NotApplicable(f"{where}: targets", sensors.tolist(), "the same sensors of every attacked agent")
        rows = self._rows(model)
        if rows is not None and not (rows != 0.0)[sensors.any(axis=1)].any():
            raise NotApplicable(f"{where}: agents", list(self.agents or brief.threat.agents), "an agent that follows another")
        return plan

    def _rows(self, model: Model) -> Array | None:
        """Return the pushed direction (N, n): gap or speed of each car of a string; None where state `state_index` itself is pushed."""
        if model.agents == 1 or not model.followers.any():
            return None
        return model.speed if self.state_index else model.gap

    def _gain(self, brief: Brief, gain: Array) -> Array:
        """Return how much the pushed state moves with each sensor (B, N, q), from the gain (B, N, n, q)."""
        rows = self._rows(brief.model)
        if rows is None:
            return gain[..., self.state_index, :]
        out = num.zeros((*gain.shape[:2], gain.shape[-1]))
        for i, j in zip(*np.nonzero(rows), strict=True):
            out[:, i] += (1.0 if self.state_index else -1.0) * rows[i, j] * gain[:, i, j]
        return out
