"""Learned policies for the ensemble: evolution of weights from several starts, of which fewer and fewer go on.

A start is a network that rests, one that imitates the best script found so far, or a published policy. All starts learn for some
generations. The better half goes on with more episodes a generation, which leaves less of the members' order to chance.
A defence that is not traced has a shorter race (evolution.py).
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tailgate.agents.learners.cem import Shape, imitation, lean, scales
from tailgate.agents.learners.teacher import Demonstration, demonstrate
from tailgate.agents.policy.network_policy import PolicyAttack, PolicyPlan
from tailgate.agents.policy.zoo import ZooAttack, zoo_names
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core.kinds import Kind
from tailgate.core.loop import Loop
from tailgate.core.neural import Network
from tailgate.core.registry import Spec
from tailgate.engine.parameters import LARGE
from tailgate.ensemble.evolution import JUDGED, SHORTER, ZOO, Evolution, Start
from tailgate.ensemble.search import Arena, Meaningless, Tell
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.observations import ObservationCodec
from tailgate.envs.gym.rewards import Reward

HIDDEN, REST = 16, 0.5  # width of the hidden layer; how much a network leans towards rest at first
SEEN = 4  # steps that a linear policy sees, so that it can time bursts and pauses
FIRST_RATE = 0.2  # of the first value of a ramp that is made from a script of one size: its rate
SHOWN = 128  # episodes of the script that a network imitates, for a system of one agent
RAMP = (1, 3, 9)  # steps of a ramp whose sizes a policy may send
COPIED = 1024  # decisions of a script in a step of its imitation
LEAST, FEWEST = 16, 8  # policies of a generation, and episodes that each plays, at least
PUBLISHED = 2  # published policies that join, at most
SLOWEST = 1e-3  # of the bound: the slowest ramp


class Phase(NamedTuple):
    """A part of the race: generations of every start that is left, and episodes that each member plays."""

    generations: int
    episodes: int


@dataclass(frozen=True)
class Race:
    """The size of a search of policies."""

    population: int  # for a system of one agent
    phases: tuple[Phase, ...]

    def members(self, agents: int) -> int:
        """Return the policies of a generation."""
        return max(self.population // agents, min(LEAST, self.population))

    def shorter(self) -> Race:
        """Return the race in the plain loop."""
        phases = tuple(phase._replace(generations=max(phase.generations // SHORTER, 1)) for phase in self.phases)
        return Race(min(self.population, LEAST), phases)

    def episodes(self, starts: int, agents: int) -> int:
        """Return the episodes that a race plays."""
        total, judged = starts * JUDGED // agents, JUDGED // agents
        for phase in self.phases:
            each = max(phase.episodes // agents, FEWEST)
            total += starts * (phase.generations * each * self.members(agents) + judged)
            starts = math.ceil(starts / 2)
        return total


class Form(NamedTuple):
    """The form of a network: the steps that it sees, and the width of its hidden layer; 0: none."""

    frames: int
    hidden: int

    def __str__(self) -> str:
        return f"{f'hidden layer of {self.hidden}' if self.hidden else 'linear'}, {self.frames} frame{'s' * (self.frames > 1)}"


FORMS = (Form(1, HIDDEN), Form(SEEN, 0))  # of policies that choose among sizes
RAMPING = Form(1, 0)  # of policies that move a value


def action_of(arena: Arena, scripts: Sequence[str]) -> ActionSpec:
    """Return the actions of a policy: the kinds granted at their bounds, and at the sizes and on the wires of the best scripts.

    scripts: the best found so far, as on the command line.
    """
    threat = arena.loop.brief.threat
    low, high = threat.jam_range
    jam = min(threat.fdi_bound, high) if high > 0 else max(-threat.fdi_bound, low)
    value, delay = abs(jam) or threat.fdi_bound, threat.delay_bound
    shares, single = {1.0}, False
    for script in scripts:
        made = Spec("attack", script).make()
        bound, base, rate = delay if script.startswith("echo") else value, getattr(made, "base", None), getattr(made, "rate", 0.0)
        sizes = [abs(held) for name in ("value", "delay") if isinstance(held := getattr(made, name, None), float)]
        sizes += [] if base is None else [abs(base + rate * step) for step in RAMP]
        shares |= {float(f"{size / bound:.3g}") for size in sizes if bound and 0.01 < size / bound < 0.95}
        single = single or bool(made.targets)
    sized = {"fdi", "echo_delay"} & set(threat.kinds)
    return ActionSpec(
        action="mode", value=jam or threat.fdi_bound, power=threat.jam_power or ActionSpec.power, delay=delay or ActionSpec.delay,
        shares=tuple(sorted(shares)) if sized and len(shares) > 1 else (), steps=max(min(ActionSpec.steps, threat.memory), 1),
        per_sensor=single,
    )  # fmt: skip


def is_ramp(script: str) -> bool:
    """If the value of a script grows from step to step."""
    made = Spec("attack", script).make()
    return hasattr(made, "base") and hasattr(made, "rate")


def ramp_of(arena: Arena, script: str) -> ActionSpec | None:
    """Return the actions of a policy that raises, keeps or lowers a value step by step; None for a script without a value.

    A ramp says the first value and the rate. The ramp of another script begins at half of its value.
    """
    made, threat = Spec("attack", script).make(), arena.loop.brief.threat
    aired = script.startswith("echo")
    bound, sent = (threat.delay_bound, "delay") if aired else (threat.fdi_bound, "value")
    base = made.base if is_ramp(script) else 0.5 * getattr(made, sent, 0.0)
    if not bound or not base or not (aired or script.startswith("fdi")):
        return None
    rate = abs(made.rate) if is_ramp(script) else FIRST_RATE * abs(base)
    base, rate = np.clip([base, rate], (-bound, SLOWEST * bound), bound).tolist()
    fixed = replace(action_of(arena, [script]), action="ramp", shares=(), rate=rate)
    if aired:
        return replace(fixed, delay=max(abs(base), SLOWEST * bound))
    return replace(fixed, value=float(np.clip(base, *threat.jam_range)))


def _drawn(
    loop: Loop, action: ActionSpec, forms: Sequence[Form], scripts: Sequence[str], seed: int, only: Sequence[str]
) -> list[Start]:  # fmt: skip
    """Return, in each form, a policy with these actions that rests, and one that imitates each script. only: names that are made."""
    codec, deep = ActionCodec(action, loop.brief), ObservationCodec(loop.brief, SEEN)
    if codec.size < 2:
        raise Meaningless("threat_model.kinds", loop.threat.kinds, "a kind of attack to choose")
    seat, episodes = Seat(loop, codec, deep, Reward(), {}), max(SHOWN // loop.model.agents, FEWEST)

    @functools.cache
    def shown(script: str) -> Demonstration:
        return demonstrate(seat, Spec("attack", script).make(), seed, episodes)

    out, first = [], action.delay if Kind.ECHO_DELAY in codec.carried else action.value
    moved = f", a ramp from {first:.4g} by {action.rate:.4g}" if action.action == "ramp" else ""
    for form, script in itertools.product(_small(forms, codec, deep), ("", *scripts)):
        name = f"{f'as {script}' if script else 'rest'} ({form}{moved})"
        if only and name not in only:
            continue
        seen = ObservationCodec(loop.brief, form.frames)
        width = len(seen.names)  # the newest frame comes first
        shape = Shape(tuple(itertools.pairwise((width, *([form.hidden] if form.hidden else []), codec.size))))
        if script:
            one = shown(script)._replace(observation=shown(script).observation[:, :width])
            size, theta = scales(one.observation), imitation(shape, one, np.random.default_rng([seed, len(one.action)]), COPIED)
        else:
            size = scales(np.concatenate([shown(one).observation[:, :width] for one in scripts or ("none",)]))
            theta = np.zeros(shape.length)
            theta[shape.length - codec.size] = lean(REST, codec.size)
        weights, biases = zip(*((weight.copy(), bias.copy()) for weight, bias in shape.layers(theta)), strict=True)
        out.append(Start(name, PolicyPlan(Network(weights, biases), codec, seen), size, script))
    return out


def _small(forms: Sequence[Form], codec: ActionCodec, deep: ObservationCodec) -> list[Form]:
    """Return the forms with as many frames as one layer of LARGE weights can read: weights of a larger layer are constants of a program."""
    each = len(deep.names) // SEEN
    return [form._replace(frames=frames) for form in forms if (frames := min(form.frames, LARGE // (each * (form.hidden or codec.size))))]


def starts_of(
    arena: Arena, knowledge: str, scripts: Sequence[str], seed: int, only: Sequence[str] = (), published: Sequence[str] = (),
) -> list[Start]:  # fmt: skip
    """Return the starts of a race: rest and an imitation of each script in every form, and published policies that fit.

    Policies that move a value step by step begin from the first script of one size, and from the first ramp.
    only: names of those that are made, next to the published ones; empty: all. published: policies that come before those of the zoo.
    Raises Meaningless where the threat model grants nothing that a policy could choose.
    """
    loop, out = arena.seat(knowledge), []
    try:
        action = action_of(arena, scripts)
        moved = [(script, ramp) for script in scripts if (ramp := ramp_of(arena, script)) is not None]
        for one in (action, *(ramp for _, ramp in moved)):
            ActionCodec(one, loop.brief)
    except InputError as error:
        raise Meaningless(error.field, error.value, error.expected) from None
    out += _drawn(loop, action, FORMS, scripts, seed, only)
    for growing in (False, True):
        for script, raised in [one for one in moved if is_ramp(one[0]) == growing][:1]:
            out += _drawn(loop, raised, [RAMPING], [script], seed, only)
    return [*out, *_published(arena, knowledge, published)[:PUBLISHED]]


def _published(arena: Arena, knowledge: str, texts: Sequence[str]) -> list[Start]:
    """Return published policies, then those of the zoo, that a race of this knowledge can change."""
    out: dict[str, Start] = {}
    for text in (*texts, *transferred(arena)):
        attack = Spec("attack", text).make()
        if not isinstance(attack, ZooAttack | PolicyAttack) or attack.knowledge != knowledge:
            continue
        plan = attack.prepare(arena.seat(knowledge, attack).brief)
        if plan.network.lstm is None and plan.action.discrete:
            name = attack.name if isinstance(attack, ZooAttack) else attack.path.stem
            out.setdefault(name, Start(ZOO + name, plan, np.ones(len(plan.observation.names))))
    return list(out.values())


class Learned(NamedTuple):
    """The result of a race: attacks as on the command line, and the names of the starts, the best first."""

    attacks: list[str]
    starts: list[str]


def learned(
    arena: Arena, knowledge: str, scripts: Sequence[str], race: Race, seed: int, folder: Path, tell: Tell | None = None,
    only: Sequence[str] = (), published: Sequence[str] = (),
) -> Learned:  # fmt: skip
    """Learn policies against an arena's defence; return the two that did most harm.

    Parameters
    ----------
    knowledge
        What the policies know: black or grey.
    scripts
        Attacks that networks imitate at the start.
    folder
        The policies' files are written below it.
    only
        Names of the starts that take part, and published policies; empty: all.
    published
        Policies that take part before those of the zoo, as on the command line.

    Raises
    ------
    NotApplicable
        Where there is nothing to choose.
    """
    starts = starts_of(arena, knowledge, scripts, seed, only, published)
    runs = _without_copies([Evolution(arena, knowledge, start) for start in starts])
    race = race if all(run.traced for run in runs) else race.shorter()
    for run in runs:
        run.enter(race.members(arena.loop.model.agents), seed)
    left, total, done = list(runs), sum(phase.generations for phase in race.phases), 0
    for phase in race.phases:
        episodes = max(phase.episodes // arena.loop.model.agents, FEWEST)
        for _ in range(phase.generations):
            paid = [run.generation(episodes) for run in left]
            done += 1
            if tell is not None:
                best = int(np.argmax(paid))
                tell(done, total, f"a {knowledge}-box network, at first {left[best].start.name}", left[best].champion[0])
        for run in left:
            run.compare()
        left = sorted(left, key=lambda run: -run.champion[0])[: math.ceil(len(left) / 2)]
    order = sorted(runs, key=lambda run: -run.champion[0])
    return Learned([run.write(folder, seed) for run in order[:2]], [run.start.name for run in order])


def _without_copies(runs: list[Evolution]) -> list[Evolution]:
    """Return the runs, of those that imitate one script only that which does most harm: the forms differ in how well they imitate."""
    best = {run.start.script: run for run in sorted(runs, key=lambda run: run.champion[0])}
    return [run for run in runs if not run.start.script or best[run.start.script] is run]


def transferred(arena: Arena) -> list[str]:
    """Return the policies of the zoo that have a meaning in an arena, those for its defence first."""
    out = []
    for name in zoo_names():
        policy = ZooAttack(name)
        try:
            policy.prepare(arena.seat(policy.knowledge, policy).brief)
        except (NotApplicable, InputError):
            continue
        out.append(f"zoo:name={name}")
    return sorted(out, key=lambda one: f"-{arena.defence}-" not in one)
