"""Scripted attacks: what to inject is fixed, when is a window that opens at a step or on a condition of the road."""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.core import Array, Command, Finite, Kind, NonNegative, PositiveCount, Probability, View, no_command, param
from tailgate.draws import Draws
from tailgate.errors import InputError, NotApplicable, unknown
from tailgate.registry import register
from tailgate.threat import Brief


@register("attack", "none")
@dataclass(frozen=True)
class NoAttack:
    """Does nothing."""

    def prepare(self, brief: Brief) -> Brief:
        return brief

    def start(self, plan: Brief, batch: int, draws: Draws) -> Any:
        return None

    def decide(self, plan: Brief, state: Any, view: View, draws: Draws) -> tuple[Any, Command]:
        return None, no_command(len(view.k), plan.model.agents, len(plan.model.wires))


class ScriptPlan(NamedTuple):
    brief: Brief
    target: Array  # (w,) bool


class ScriptState(NamedTuple):
    opened: Array  # (B,) bool: the window has opened
    elapsed: Array  # (B,) int64: steps since it opened


@dataclass(frozen=True)
class Script:
    """When: a window that opens at step `start`, or at the first later step at which a condition of the road holds."""

    targets: tuple[str, ...] = param((), "wires to attack; empty: all that are granted")
    start_step: PositiveCount = param(1, "first step of the window")
    length: PositiveCount | None = param(None, "steps in the window; none: to the end")
    trigger: Literal["time", "closing", "near"] = param(
        "time", "time: open at start; closing: when the speed difference, near: when the gap passes the threshold"
    )
    threshold: NonNegative = param(3.0, "closing speed above [m/s], or gap below [m], which the trigger waits for")

    def prepare(self, brief: Brief) -> ScriptPlan:
        wires = brief.model.wires
        for name in self.targets:
            if name not in wires:
                raise unknown("attack targets", name, wires)
        target = np.array([w in self.targets for w in wires]) if self.targets else brief.granted
        return ScriptPlan(brief, target)

    def start(self, plan: ScriptPlan, batch: int, draws: Draws) -> ScriptState:
        return ScriptState(np.zeros(batch, bool), np.zeros(batch, np.int64))

    def decide(self, plan: ScriptPlan, state: ScriptState, view: View, draws: Draws) -> tuple[Any, Command]:
        ready = (view.k >= self.start_step) & (view.k >= plan.brief.threat.onset)
        if self.trigger == "closing":
            ready &= (view.scene.speed - view.scene.lead_speed > self.threshold).any(axis=1)
        elif self.trigger == "near":
            ready &= (view.scene.gap < self.threshold).any(axis=1)
        opened = state.opened | ready
        on = opened if self.length is None else opened & (state.elapsed < self.length)
        on = on & view.allowed  # a script that knows its budget does not ask for more
        command = self.command(plan, on, state.elapsed, view, draws)
        return ScriptState(opened, state.elapsed + opened), command

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        """What is sent in the rows `on` (B,), `count` (B,) steps after the window opened."""
        raise TypeError(f"{type(self).__name__} must define command()")


@register("attack", "dos_jam", reference="Dutta 2018, (4.3)")
@dataclass(frozen=True)
class Jam(Script):
    """Denial of service: the receiver reads uniform random values of the jammer."""

    low: Finite = param(-108.0, "smallest value [unit of the wire]")
    high: Finite = param(108.0, "largest value [unit of the wire]")

    def __post_init__(self) -> None:
        if self.low > self.high:
            raise InputError("attack dos_jam.low", self.low, f"at most high ({self.high})")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        shape = (plan.brief.model.agents, len(plan.target))
        return plan.brief.command(on, Kind.DOS_JAM, plan.target, self.low + (self.high - self.low) * draws.uniform(shape))


@register("attack", "dos_hold", reference="Dutta 2018, (6.18)")
@dataclass(frozen=True)
class Hold(Script):
    """Denial of service: the receiver keeps reading the last good sample before the attack."""

    fresh: bool = param(False, "hold the last good sample before each burst instead")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        kind = Kind.DOS_HOLD_FRESH if self.fresh else Kind.DOS_HOLD
        return plan.brief.command(on, kind, plan.target, 0.0)


@register("attack", "dropout")
@dataclass(frozen=True)
class Dropout(Script):
    """Denial of service: nothing is received, and the receiver knows it."""

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return plan.brief.command(on, Kind.DROPOUT, plan.target, 0.0)


@register("attack", "fdi", reference="Dutta 2018, (4.4)")
@dataclass(frozen=True)
class Inject(Script):
    """False data injection: a constant bias."""

    value: Finite = param(-20.0, "bias [unit of the wire]")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return plan.brief.command(on, Kind.FDI, plan.target, self.value)


@register("attack", "fdi_gaussian", reference="Dutta 2018, (6.17)")
@dataclass(frozen=True)
class InjectGaussian(Script):
    """False data injection: Gaussian values, cut at the bound of the threat model."""

    mean: Finite = param(0.0, "mean [unit of the wire]")
    sd: NonNegative = param(10.0, "standard deviation [unit of the wire]")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        bound = plan.brief.threat.fdi_bound
        value = self.mean + self.sd * draws.normal((plan.brief.model.agents, len(plan.target)))
        return plan.brief.command(on, Kind.FDI, plan.target, np.clip(value, -bound, bound))


@register("attack", "fdi_bernoulli", reference="Dutta 2018, section 6.3: each sensor with its own Bernoulli variable")
@dataclass(frozen=True)
class InjectBernoulli(Script):
    """False data injection: at each step and on each wire with a probability, a constant bias."""

    probability: Probability = param(0.5, "probability of a hit per step and wire [-]")
    value: Finite = param(-20.0, "bias [unit of the wire]")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        hit = draws.uniform((plan.brief.model.agents, len(plan.target))) < self.probability
        target = plan.target & hit
        return plan.brief.command(on & target.any(axis=(1, 2)), Kind.FDI, target, self.value)


@register("attack", "fdi_ramp")
@dataclass(frozen=True)
class InjectRamp(Script):
    """False data injection: a bias that grows at a constant rate up to a limit, slow enough to pass a gate."""

    base: Finite = param(0.0, "bias before the first growth [unit of the wire]")
    rate: Finite = param(-0.3, "growth a step [unit of the wire]")
    limit: NonNegative = param(50.0, "largest |bias|; the threat model's bound holds as well [unit of the wire]")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        limit = min(self.limit, plan.brief.threat.fdi_bound)
        value = np.clip(self.base + self.rate * (count + 1), -limit, limit)
        return plan.brief.command(on, Kind.FDI, plan.target, value[:, None, None])


@register("attack", "fdi_then_jam")
@dataclass(frozen=True)
class InjectThenJam(Script):
    """A constant bias first, then jamming: what the gate has let in is kept in, as it now shuts out the honest samples."""

    value: Finite = param(-3.0, "bias, and the jammer's value [unit of the wire]")
    inject: PositiveCount = param(15, "steps of the bias before the jamming")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        kind = np.where(count < self.inject, Kind.FDI, Kind.DOS_JAM)
        return plan.brief.command(on, kind, plan.target, self.value)


# Attack steps of the thesis's figures 4.5 and 4.6.
THESIS_FDI_STEPS = (5, 11, 23, 24, 25, 44, 50, 51, 52, 118, 119, 120, 146)
THESIS_DOS_STEPS = (10, 28, 29, 30, 55, 56, 57, 97, 98, 99, 100, 123, 124, 148)


@register("attack", "thesis_times", reference="Dutta 2018, figures 4.5 and 4.6; the magnitudes are not given there")
@dataclass(frozen=True)
class ThesisTimes:
    """The thesis's attack steps, with uniform random values on every granted wire."""

    kind: Literal["fdi", "dos"] = param("fdi", "fdi adds to the measurement, dos replaces it")
    fdi_max: NonNegative = param(77.0, "fdi values are uniform on [0, fdi_max] [unit of the wire]")
    dos_max: NonNegative = param(108.0, "dos values are uniform on [-dos_max, dos_max] [unit of the wire]")

    def prepare(self, brief: Brief) -> ScriptPlan:
        return ScriptPlan(brief, brief.granted)

    def start(self, plan: ScriptPlan, batch: int, draws: Draws) -> Any:
        return None

    def decide(self, plan: ScriptPlan, state: Any, view: View, draws: Draws) -> tuple[Any, Command]:
        u = draws.uniform((plan.brief.model.agents, len(plan.target)))
        if self.kind == "fdi":
            on = np.isin(view.k, THESIS_FDI_STEPS)
            return None, plan.brief.command(on, Kind.FDI, plan.target, self.fdi_max * u)
        on = np.isin(view.k, THESIS_DOS_STEPS)
        return None, plan.brief.command(on, Kind.DOS_JAM, plan.target, self.dos_max * (2.0 * u - 1.0))


@register("attack", "stealth", knowledge="white", reference="Dutta 2018, Theorem 4.5.3")
@dataclass(frozen=True)
class Stealth(Script):
    """White box: each step moves the estimate as far along one state as the gate lets through; no attacked step alarms.

    With e the direction and every sensor granted, the innovation is driven to r = s sqrt(g) S K' e / sqrt(e' K S K' e), just inside the
    gate g; with fewer wires, to the farthest point that those reach.
    """

    state_index: Literal[0, 1, 2] = param(0, "which state to push: 0 position, 1 velocity, 2 acceleration")
    sign: Literal[-1, 1] = param(-1, "-1 makes the car believe that it is further back")
    gate: NonNegative | None = param(None, "gate to stay under; none: the defence's own, or 20 where it has none [-]")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        if view.defence is None or view.received is None:
            raise InputError("threat_model.knowledge", plan.brief.threat.knowledge, "white, which attack stealth needs")
        box = view.defence
        if not hasattr(box.defence, "look"):
            raise NotApplicable("attack stealth", type(box.defence).__name__, "a defence that shows its innovation (look)")
        look = box.defence.look(box.plan, box.state, view.received, box.known_u)
        gate = self.gate if self.gate is not None else look.gate if look.gate is not None else 20.0
        r, S = look.innovation
        touched = np.flatnonzero(plan.target[: r.shape[-1]])
        row = look.gain[..., self.state_index, :][..., touched]  # K' e on the wires that are attacked
        W = num.inverse(S)
        part = num.inverse(W[..., touched[:, None], touched])
        pull = num.matvec(W, r)[..., touched]
        # (r + a)' W (r + a) over the attacked wires is least at -centre, and there leaves `spent` of the gate
        centre = num.matvec(part, pull)
        spent = num.dot(r, num.matvec(W, r)) - num.dot(pull, centre)
        room = (1.0 - 1e-9) * gate - spent
        push = num.matvec(part, row)
        reach = np.sqrt(np.maximum(room, 0.0) / num.dot(row, push))
        wanted = self.sign * reach[..., None] * push - centre
        # on the line from no injection to the wanted one the score stays convex: shrinking to the bound stays inside
        largest = np.max(np.abs(wanted), axis=-1)
        wanted = wanted * np.minimum(1.0, plan.brief.threat.fdi_bound / np.maximum(largest, 1e-300))[..., None]
        value = num.zeros((len(view.k), plan.brief.model.agents, len(plan.target)))
        value[..., touched] = wanted
        inside = num.quadratic(r + value[..., : r.shape[-1]], W) <= gate
        on = on & inside.all(axis=1)  # out of reach in this step, whatever is injected: keep still
        return plan.brief.command(on, Kind.FDI, plan.target, value)
