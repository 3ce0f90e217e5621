"""Scripted attacks: fixed values, in a window that opens at a step or on a condition of the road."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from tailgate.agents.scripts.aim import chosen, require
from tailgate.agents.scripts.triggers import TAG, Closing, Fast, LeaderBraking, Near, Reading, Slow, Trigger, TriggerState, idle
from tailgate.agents.scripts.values import LAWS, TAGS, Constant, Gaussian, Law, Ramp, Uniform, check_wires, law_of
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Command, Count, Finite, Kind, NonNegative, PositiveCount, Probability, View, no_command, param
from tailgate.core.draws import Draws, constants
from tailgate.core.registry import register
from tailgate.core.threat import Brief, fit

CHANCE = TAG - 1  # tag of the draws of `chance`
_CONDITIONS = {"closing": Closing, "near": Near, "speed": Fast, "slow": Slow, "leader_braking": LeaderBraking}


@register("attack", "none")
@dataclass(frozen=True)
class NoAttack:
    """Does nothing."""

    def prepare(self, brief: Brief) -> Brief:
        return brief

    def start(self, plan: Brief, batch: int, draws: Draws) -> None:
        return None

    def decide(self, plan: Brief, state: None, view: View, draws: Draws) -> tuple[None, Command]:
        return None, no_command(len(view.k), plan.model.agents, len(plan.model.wires))


class ScriptPlan(NamedTuple):
    brief: Brief
    target: Array  # (N, w) bool
    extra: Any = None  # a script's results before the episode


@dataclass(frozen=True)
class Timed:
    """When: a window that opens at step `start`, or at the first later step at which a condition of the road holds."""

    targets: tuple[str, ...] = param((), "wires to attack; empty: all that are granted")
    agents: tuple[Count, ...] = param((), "agents to attack, by number from 0; empty: all that are granted")
    chance: Probability = param(1.0, "probability of an attack per step and agent, while the window is open [-]")
    start_step: PositiveCount = param(1, "first step of the window")
    length: PositiveCount | None = param(None, "steps in the window; none: to the end")
    trigger: Literal["time", "closing", "near", "speed", "slow", "leader_braking", "reading"] = param(
        "time",
        "time: open at start; closing: when the speed difference, near: when the gap passes the threshold; speed, slow: when the own speed "
        "is above or below it; leader_braking: when the leader's deceleration, reading: when the size of a reading is above it",
    )
    threshold: NonNegative = param(3.0, "what the trigger waits for: a speed [m/s], a gap [m], a deceleration [m/s^2] or a reading")
    latest: PositiveCount | None = param(None, "of the trigger reading: step at which the window opens whatever is read", if_any=True)
    burst: PositiveCount | None = param(None, "steps of a burst, in a window of bursts with pauses; none: one burst, the whole window")
    pause: Count = param(10, "steps between two bursts")

    @property
    def sees_measurement(self) -> bool:
        """True if it has to see the readings."""
        return self.when.sees_measurement

    @cached_property
    def when(self) -> Trigger:
        """The trigger that the fields describe."""
        if self.trigger == "time":
            return Trigger(start=self.start_step, window=self.length)
        if self.trigger == "reading":
            return Reading(start=self.start_step, window=self.length, threshold=self.threshold, latest=self.latest)
        return _CONDITIONS[self.trigger](start=self.start_step, window=self.length, threshold=self.threshold)

    def prepare(self, brief: Brief) -> ScriptPlan:
        return self.plan(brief, chosen(brief, self.targets, brief.granted, self.agents))

    def plan(self, brief: Brief, target: Array, extra: object = None) -> ScriptPlan:
        """Return a plan, where the threat model shows what the trigger looks at."""
        self.when.prepare(brief)
        return ScriptPlan(brief, target, extra)

    def timed(self, plan: ScriptPlan, state: TriggerState, view: View, draws: Draws) -> tuple[TriggerState, Command]:
        """Return the next state of the trigger, and the command of this step."""
        timing = self.when.prepare(plan.brief)
        after, on, count = self.when.step(timing, state, view, draws)
        on = on & view.allowed  # a script that knows its budget does not ask for more
        if self.burst is not None:
            on = on & (count % (self.burst + self.pause) < self.burst)
        command = self.command(plan, on, count, view, draws)
        if self.chance < 1.0:
            hit = command.target & (draws.uniform((plan.brief.model.agents,), CHANCE) < self.chance)[..., None]
            kind = np.where(hit.any(axis=(1, 2)), command.kind, 0).astype(np.int8)
            command = Command(kind, hit, np.where(hit, command.value, 0.0))
        return after, command

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        """Return the command in the rows `on` (B,), `count` (B,) steps after the window opened."""
        raise TypeError(f"{type(self).__name__} must define command()")


@dataclass(frozen=True)
class Script(Timed):
    """A timed attack that remembers nothing but its trigger."""

    def start(self, plan: ScriptPlan, batch: int, draws: Draws) -> TriggerState:
        return idle(batch, plan.brief.model.agents)

    def decide(self, plan: ScriptPlan, state: TriggerState, view: View, draws: Draws) -> tuple[TriggerState, Command]:
        return self.timed(plan, state, view, draws)


def inject(plan: ScriptPlan, on: Array, law: Law, count: Array, draws: Draws, tag: int = 0, hit: Array | None = None) -> Command:
    """Return false data of a law's values, cut at the bounds; with `hit` (B, N, w), on these of the targets only."""
    brief = plan.brief
    value = fit(brief, Kind.FDI, law.sample(brief, count, draws, tag))
    if hit is None:
        return brief.command(on, Kind.FDI, plan.target, value)
    target = plan.target & hit
    return brief.command(on & target.any(axis=(1, 2)), Kind.FDI, target, value)


def wires_hit(plan: ScriptPlan, probability: float | Array, draws: Draws) -> Array:
    """Return (B, N, w) bool: each wire by itself with its probability."""
    return np.asarray(draws.uniform(plan.target.shape) < probability)


@register("attack", "dos_jam", reference="Dutta 2018, (4.3)")
@dataclass(frozen=True)
class Jam(Script):
    """Denial of service: the receiver reads uniform random values of the jammer."""

    low: Finite = param(-108.0, "smallest value [unit of the wire]", cut="jam_range")
    high: Finite = param(108.0, "largest value [unit of the wire]", cut="jam_range")

    def __post_init__(self) -> None:
        if self.low > self.high:
            raise InputError("attack dos_jam.low", self.low, f"at most high ({self.high})")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        value = fit(plan.brief, Kind.DOS_JAM, Uniform(self.low, self.high).sample(plan.brief, count, draws))
        return plan.brief.command(on, Kind.DOS_JAM, plan.target, value)


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

    probability: Probability = param(1.0, "probability of a loss per step and wire [-]")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        target = plan.target & wires_hit(plan, self.probability, draws)
        return plan.brief.command(on & target.any(axis=(1, 2)), Kind.DROPOUT, target, 0.0)


@register("attack", "fdi", reference="Dutta 2018, (4.4)")
@dataclass(frozen=True)
class Inject(Script):
    """False data injection: a constant bias, cut at the bound of the threat model."""

    value: Finite = param(-20.0, "bias [unit of the wire]", cut="fdi_bound")
    signs: Count | None = param(None, "seed of a random sign for each wire of each agent; none: the bias has one sign everywhere")

    def prepare(self, brief: Brief) -> ScriptPlan:
        plan = super().prepare(brief)
        if self.signs is None:
            return plan
        return plan._replace(extra=np.where(constants("fdi.signs", self.signs).uniform(brief.granted.shape)[0] < 0.5, -1.0, 1.0))

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        sent = inject(plan, on, Constant(self.value), count, draws)
        return sent if plan.extra is None else sent._replace(value=np.where(sent.target, sent.value * plan.extra, 0.0))


@register("attack", "fdi_gaussian", reference="Dutta 2018, (6.17)")
@dataclass(frozen=True)
class InjectGaussian(Script):
    """False data injection: Gaussian values, cut at the bound of the threat model."""

    mean: Finite = param(0.0, "mean [unit of the wire]")
    sd: NonNegative = param(10.0, "standard deviation [unit of the wire]")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return inject(plan, on, Gaussian(self.mean, self.sd), count, draws)


@register("attack", "fdi_bernoulli", reference="Dutta 2018, section 6.3: each sensor with its own Bernoulli variable")
@dataclass(frozen=True)
class InjectBernoulli(Script):
    """False data injection: at each step and on each wire with a probability, a constant bias."""

    probability: Probability = param(0.5, "probability of a hit per step and wire [-]")
    value: Finite = param(-20.0, "bias [unit of the wire]", cut="fdi_bound")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return inject(plan, on, Constant(self.value), count, draws, hit=wires_hit(plan, self.probability, draws))


@register("attack", "fdi_ramp")
@dataclass(frozen=True)
class InjectRamp(Script):
    """False data injection: a bias that grows at a constant rate up to a limit, slow enough to pass a gate."""

    base: Finite = param(0.0, "bias before the first growth [unit of the wire]")
    rate: Finite = param(-0.3, "growth a step [unit of the wire]")
    limit: NonNegative = param(50.0, "largest |bias|; the threat model's bound holds as well [unit of the wire]")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return inject(plan, on, Ramp(self.base, self.rate, self.limit), count, draws)


@register("attack", "fdi_then_jam")
@dataclass(frozen=True)
class InjectThenJam(Script):
    """A constant bias first, then jamming: what the gate has let in is kept in, as it now shuts out the honest samples."""

    value: Finite = param(-3.0, "bias, and the jammer's value [unit of the wire]", cut="fdi_bound")
    inject: PositiveCount = param(15, "steps of the bias before the jamming")

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        biased = count < self.inject
        value = Constant(self.value).sample(plan.brief, count, draws)
        value = np.where(biased[:, None, None], fit(plan.brief, Kind.FDI, value), fit(plan.brief, Kind.DOS_JAM, value))
        return plan.brief.command(on, np.where(biased, Kind.FDI, Kind.DOS_JAM), plan.target, value)


@register("attack", "fdi_uniform", reference="Dutta 2018, figure 4.5")
@dataclass(frozen=True)
class InjectUniform(Script):
    """False data injection: uniform random values, cut at the bound of the threat model."""

    low: Finite = param(-10.0, "smallest value [unit of the wire]", cut="fdi_bound")
    high: Finite = param(10.0, "largest value [unit of the wire]", cut="fdi_bound")

    def __post_init__(self) -> None:
        if self.low > self.high:
            raise InputError("attack fdi_uniform.low", self.low, f"at most high ({self.high})")

    def prepare(self, brief: Brief) -> ScriptPlan:
        require(brief, "attack fdi_uniform", kinds=["fdi"])
        return super().prepare(brief)

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return inject(plan, on, Uniform(self.low, self.high), count, draws)


@register("attack", "fdi_sparse", reference="Dutta 2018, section 4.7: y' = y + Gamma_k y_af, Gamma_k diagonal of Bernoulli variables")
@dataclass(frozen=True)
class InjectSparse(Script):
    """Sparse false data injection: each sensor has its own probability of a hit in a step; the values follow a law.

    `start_step` is the thesis's k_f, the step from which the probabilities hold.
    """

    probability: Probability | tuple[Probability, ...] = param(
        0.2, "probability of a hit per step: one number, or one for each of `targets` in their order [-]"
    )
    value: object = param(-4.0, f"law of the values: a number, or one of {', '.join(LAWS)}; value.mean=... and so on set its parameters")

    def __post_init__(self) -> None:
        _ = self.law  # a wrong law shall fail here

    @cached_property
    def law(self) -> Law:
        return law_of(self.value, "attack fdi_sparse.value")

    def prepare(self, brief: Brief) -> ScriptPlan:
        plan = super().prepare(brief)
        require(brief, "attack fdi_sparse", ["fdi"], plan.target)
        check_wires(self.law, plan.target, brief, "attack fdi_sparse.value")
        aimed = np.any(plan.target, axis=0).tolist()
        names = self.targets or tuple(name for name, hit in zip(brief.model.wires, aimed, strict=True) if hit)
        chances = (self.probability,) * len(names) if isinstance(self.probability, (int, float)) else self.probability
        if len(chances) != len(names):
            raise InputError("attack fdi_sparse.probability", self.probability, f"one number, or one for each of {', '.join(names)}")
        held = dict(zip(names, chances, strict=True))
        return plan._replace(extra=np.array([held.get(name, 0.0) for name in brief.model.wires]))

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return inject(plan, on, self.law, count, draws, TAGS, wires_hit(plan, plan.extra, draws) & self.law.sends(plan.brief, count))


@register("attack", "actuator_fdi")
@dataclass(frozen=True)
class InjectActuator(Script):
    """False data injection into the command on its way to the actuator: a constant bias that the defence does not know."""

    value: Finite = param(1.0, "bias, cut at actuator_bound [unit of the actuator]", cut="actuator_bound")

    def prepare(self, brief: Brief) -> ScriptPlan:
        if not brief.model.actuators:
            raise NotApplicable("attack actuator_fdi", "no actuator", "a plant whose agents command actuators")
        default = brief.is_actuator & brief.granted if (brief.is_actuator & brief.granted).any() else brief.is_actuator
        target = chosen(brief, self.targets, default, self.agents)
        for name, other in zip(brief.model.wires, np.any(target & ~brief.is_actuator, axis=0).tolist(), strict=True):
            if other:
                raise InputError("attack actuator_fdi.targets", name, f"actuators ({', '.join(brief.model.actuators)})")
        require(brief, "attack actuator_fdi", ["fdi"], target)
        return self.plan(brief, target)

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return inject(plan, on, Constant(self.value), count, draws)


@register("attack", "delay")
@dataclass(frozen=True)
class Delay(Script):
    """The receiver reads what was sent some steps ago."""

    age: PositiveCount = param(5, "age of what is read [steps]")

    def prepare(self, brief: Brief) -> ScriptPlan:
        return _old(super().prepare(brief), "delay", "age", self.age)

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return plan.brief.command(on, Kind.DELAY, plan.target, float(self.age))


@register("attack", "replay", reference="Y. Mo and B. Sinopoli, Secure Control against Replay Attacks, 2009; Dutta 2018, section 4.7")
@dataclass(frozen=True)
class Replay(Script):
    """The receiver reads the samples before the attack over and over again."""

    window: PositiveCount = param(20, "length of the recording that is repeated [steps]")

    def prepare(self, brief: Brief) -> ScriptPlan:
        return _old(super().prepare(brief), "replay", "window", self.window)

    def command(self, plan: ScriptPlan, on: Array, count: Array, view: View, draws: Draws) -> Command:
        return plan.brief.command(on, Kind.REPLAY, plan.target, float(self.window))


def _old(plan: ScriptPlan, kind: str, field: str, steps: int) -> ScriptPlan:
    """Return the plan of an attack with old samples, where the threat model grants them."""
    require(plan.brief, f"attack {kind}", [kind], plan.target)
    memory = plan.brief.threat.memory
    if steps > memory:
        raise NotApplicable(f"attack {kind}.{field}", steps, f"at most threat_model.memory ({memory} steps)")
    return plan


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

    def start(self, plan: ScriptPlan, batch: int, draws: Draws) -> None:
        return None

    def decide(self, plan: ScriptPlan, state: None, view: View, draws: Draws) -> tuple[None, Command]:
        u, brief = draws.uniform(plan.target.shape), plan.brief
        if self.kind == "fdi":
            on, value = np.isin(view.k, THESIS_FDI_STEPS) & view.allowed, fit(brief, Kind.FDI, self.fdi_max * u)
            return None, brief.command(on, Kind.FDI, plan.target, value)
        on, value = np.isin(view.k, THESIS_DOS_STEPS) & view.allowed, fit(brief, Kind.DOS_JAM, self.dos_max * (2.0 * u - 1.0))
        return None, brief.command(on, Kind.DOS_JAM, plan.target, value)
