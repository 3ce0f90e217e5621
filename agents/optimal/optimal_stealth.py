"""The unnoticed injection that carries an estimate the farthest by the end of its window: a ceiling for attackers below a gate."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.agents.optimal.schedules import farthest
from tailgate.agents.scripts.aim import chosen, require
from tailgate.agents.scripts.scripted import Script, ScriptPlan
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Command, Finite, Kind, Positive, View, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.core.threat import Brief
from tailgate.estimators.filters.kalman import steady_state

MARGIN = 1e-9  # share of the gate that rounding is left
WIRES = 4  # wires of which every combination at its bound is tried


class Aim(NamedTuple):
    """The direction in which the estimate is pushed."""

    begin: int  # first step of the window
    last: int
    row: Array  # (last + 1, n): row k is e' A^(last - k): what an error at step k becomes along e


@register("attack", "optimal_stealth", knowledge="white", optimal=True, reference="Dutta 2018, Theorem 4.5.3, over several steps")
@dataclass(frozen=True)
class OptimalStealth(Script):
    """White box: makes the error along a direction e at the last step of its window as large as unnoticed injections can.

    Step k moves that error by e' A^(last - k) K r. The innovation is driven to the point inside of the gate that moves it farthest, away
    from where the error is already heading. While no bound of the threat model binds, this is optimal for the mean square of the error
    along e. Where one does, each step is the best one by itself. The window is one burst: all of it where the budget lasts, else its end.
    """

    direction: tuple[Finite, ...] = param((), "e, a number for each state; empty: in which the filter at rest can be moved farthest")
    gate: Positive | None = param(None, "gate to stay under; none: the defence's own [-]")

    def prepare(self, brief: Brief) -> ScriptPlan:
        model, threat, where = brief.model, brief.threat, "attack optimal_stealth"
        if model.agents != 1:
            raise NotApplicable(f"{where}: model", f"{model.agents} agents", "one agent")
        target = chosen(brief, self.targets, brief.granted & ~brief.is_actuator, self.agents)
        require(brief, where, ["fdi"], target)
        if not target[:, : len(model.sensors)].any() or target[:, len(model.sensors) :].any():
            raise NotApplicable(f"{where}: targets", list(self.targets), "sensors")
        if self.direction and (len(self.direction) != model.states or not np.any(self.direction)):
            raise InputError(f"{where}.direction", self.direction, f"{model.states} numbers, not all of them 0")
        last = brief.horizon if threat.end is None else min(threat.end, brief.horizon)
        steps = [n for n in (threat.budget, threat.duration) if n is not None]
        begin = max([threat.onset, self.start_step, *(last + 1 - n for n in steps)])
        e = np.array(self.direction) if self.direction else self._farthest(brief, max(last + 1 - begin, 1))
        rows = [e / np.sqrt(num.dot(e, e))]
        for _ in range(last):
            rows.append(num.matvec(model.A.T, rows[-1]))
        return ScriptPlan(brief, target, Aim(begin, last, np.array(rows[::-1])))

    def _farthest(self, brief: Brief, steps: int) -> Array:
        """Return the direction (n,) of the largest reach within `steps`."""
        model = brief.model
        return np.ones(1) if model.states == 1 else farthest(model, steady_state(model)[0], steps)

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        if view.defence is None or view.received is None or view.estimate is None or view.truth is None:
            raise InputError("threat_model.knowledge", plan.brief.threat.knowledge, "white: attack optimal_stealth needs it")
        box, model, aim = view.defence, plan.brief.model, plan.extra
        if not hasattr(box.defence, "look"):
            raise NotApplicable("attack optimal_stealth", type(box.defence).__name__, "a defence that shows its innovation (look)")
        look = box.defence.look(box.plan, box.state, view.received, box.known_u)
        gate = self.gate if self.gate is not None else look.gate
        if gate is None:
            raise NotApplicable("attack optimal_stealth", type(box.defence).__name__, "a defence with a gate, or the attack's own")
        row = num.take(aim.row, np.minimum(view.k, aim.last))[:, None]  # (B, 1, n)
        predicted = num.matvec(model.A, view.estimate.x) + num.matvec(model.B, box.known_u) + model.c
        heading = num.dot(row, predicted - view.truth)
        gain = num.stack([num.dot(row, look.gain[..., j]) for j in range(len(model.sensors))])
        gain = np.where(heading >= 0.0, 1.0, -1.0)[..., None] * gain
        wires = np.flatnonzero(plan.target[0])
        value, found = farthest_inside(
            look.innovation.r, num.inverse(look.innovation.S), gain, (1.0 - MARGIN) * gate, wires, plan.brief.threat.fdi_bound
        )
        full = num.zeros((len(view.k), *plan.target.shape))
        full[..., : value.shape[-1]] = value
        target = plan.target & found[..., None]
        return plan.brief.command(on & (view.k >= aim.begin) & found[:, 0], Kind.FDI, target, full)


def farthest_inside(r: Array, W: Array, gain: Array, gate: Array | float, wires: Array, bound: float) -> tuple[Array, Array]:
    """Return a (B, N, q), the largest gain' a with (r + a)' W (r + a) <= gate and |a| <= bound, and (B, N) bool if there is one.

    a is 0 off `wires`; r, gain (B, N, q), W (B, N, q, q). A wire of a solution is at its bound or free, and the free ones are in closed
    form: every combination is tried. Of more than WIRES wires the solution without bounds is shortened towards 0.
    """
    best, found, most = num.zeros(r.shape), num.zeros(r.shape[:2], bool), num.full(r.shape[:2], -np.inf)
    few = len(wires) <= WIRES
    for pattern in product((0.0, bound, -bound), repeat=len(wires)) if few else [(0.0,) * len(wires)]:
        fixed = np.array(pattern)
        base = num.zeros(r.shape)
        base[..., wires] = fixed
        free = wires[fixed == 0.0]
        a, ok = _free_inside(r + base, W, gain, gate, free)
        if not few:
            largest = np.max(np.abs(a), axis=-1)
            a = a * np.minimum(1.0, bound / np.maximum(largest, 1e-300))[..., None]
            shifted = r + a
            ok = ok & (num.quadratic(shifted, W) <= gate)
        ok = ok & (np.abs(a) <= bound).all(axis=-1)
        a = a + base
        gained = num.dot(gain, a)
        better = ok & (gained > most)
        best, most, found = np.where(better[..., None], a, best), np.where(better, gained, most), found | ok
    return best, found


def _free_inside(r: Array, W: Array, gain: Array, gate: Array | float, free: Array) -> tuple[Array, Array]:
    """Return what `farthest_inside` returns, without bounds."""
    a = num.zeros(r.shape)
    if not len(free):
        return a, np.asarray(num.quadratic(r, W) <= gate)
    part = num.inverse(W[..., free[:, None], free])
    pull = num.matvec(W, r)[..., free]
    # (r + a)' W (r + a) over the free wires is least at -centre, and there leaves `spent` of the gate
    centre = num.matvec(part, pull)
    room = gate - (num.dot(r, num.matvec(W, r)) - num.dot(pull, centre))
    row = gain[..., free]
    push = num.matvec(part, row)
    strength = num.dot(row, push)
    length = np.sqrt(np.maximum(room, 0.0) / np.where(strength > 0.0, strength, np.inf))
    a[..., free] = length[..., None] * push - centre
    return a, np.asarray(room >= 0.0)
