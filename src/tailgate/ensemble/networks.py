"""Learned policies for the ensemble: evolution of weights from several starts, of which fewer and fewer go on.

A start is a network that rests, one that imitates the best script found so far, or a published policy. All starts learn for some
generations; the better half of them goes on with more episodes a generation, so that the order of the members is less a matter of luck.
The method is CMA-ES with a diagonal covariance (Ros and Hansen 2008). One compiled program plays all: its parameters are the weights.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from cmaes import SepCMA

from tailgate.agents.learners.cem import Shape, imitation, lean
from tailgate.agents.learners.learning import header_of
from tailgate.agents.learners.teacher import demonstrate
from tailgate.agents.policy.network_policy import PolicyAttack, PolicyPlan, save_policy
from tailgate.agents.policy.zoo import ZooAttack, zoo_names
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, draws
from tailgate.core.draws import Keys, Role
from tailgate.core.neural import Network
from tailgate.core.registry import Spec
from tailgate.core.schema import as_data, digest
from tailgate.engine.agreement import ROWS, Untraced
from tailgate.engine.parameters import Parameters
from tailgate.ensemble.battery import Battery, Episodes, Played, battery_of
from tailgate.ensemble.search import Arena, Tell
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.observations import ObservationCodec
from tailgate.envs.gym.rewards import Reward

HIDDEN, REST = 16, 0.5  # width of the hidden layer; how much a network leans towards rest at first
SHOWN = 128  # episodes of the script that a network imitates, for a system of one agent
SPREAD = 0.3  # of the first generation: of the size of a network's weights, and by itself where they are 0
RAMP = (1, 3, 9)  # steps of a ramp whose sizes a policy may send
COPIED = 1024  # decisions of a script in a step of its imitation
JUDGED = 1024  # episodes that decide which starts go on, for a system of one agent
LEAST, FEWEST = 16, 8  # policies of a generation, and episodes that each plays, at least
FIRST = 1 << 30  # number of the first episode that starts are judged on: no search meets it before
PUBLISHED = 2  # policies of the zoo that join, at most


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

    def episodes(self, starts: int, agents: int) -> int:
        """Return the episodes that a race plays."""
        total, judged = starts * JUDGED // agents, JUDGED // agents
        for phase in self.phases:
            each = max(phase.episodes // agents, FEWEST)
            total += starts * (phase.generations * each * self.members(agents) + judged)
            starts = math.ceil(starts / 2)
        return total


class Start(NamedTuple):
    """A first network, and the actions that its outputs choose among."""

    name: str
    plan: PolicyPlan


class Evolution:
    """One start: a distribution of weights that moves towards what does more harm."""

    def __init__(self, arena: Arena, knowledge: str, start: Start, population: int, seed: int) -> None:
        self.arena, self.start, self.attack, self.loop = arena, start, PolicyAttack(), arena.seat(knowledge)
        self.episode = 0
        network = start.plan.network
        parts = [part for pair in zip(network.weights, network.biases, strict=True) for part in pair]
        self.shape = Shape(tuple(itertools.pairwise((len(network.weights[0]), *map(len, network.biases)))))
        self.mean = self.first = np.concatenate([part.ravel() for part in parts])
        sizes = [np.sqrt(np.mean(part**2)) if start.name != "rest" else 1.0 for part in parts]
        self.unit = np.concatenate([np.full(part.size, SPREAD * (size or 1.0)) for part, size in zip(parts, sizes, strict=True)])
        self.method = SepCMA(np.zeros(self.first.size), 1.0, population_size=population, seed=seed)
        self.battery = self._battery(population)
        held = Parameters((self.loop, self.attack, start.plan))
        self._values = held.values
        self._places = [
            next(i for i, leaf in enumerate(held.values) if np.shares_memory(leaf, part)) for part in (*network.weights, *network.biases)
        ]  # fmt: skip
        self.champion = (self.judged(), self.mean)

    def _battery(self, population: int) -> Battery:
        few = self._memory(draws.keys("tune", range(ROWS)))
        made = battery_of(self.loop, self.attack, self.start.plan, few)
        if isinstance(made, Untraced):
            raise NotApplicable("defence", self.arena.defence, f"one that the engine traces, to learn against it ({made.why})")
        return made

    def _memory(self, keys: Keys) -> object:
        batch = len(keys.key)
        return self.attack.start(self.start.plan, batch, keys.at(Role.ATTACK, np.zeros(batch, np.int64)))

    def episodes_of(self, purpose: str, first: int, count: int) -> Episodes:
        """Return episodes of this learner's game."""
        keys = draws.keys(purpose, range(first, first + count))
        return Episodes(self.battery, keys, self._memory(keys))

    def played(self, theta: Array, episodes: Episodes) -> Played:
        """Return the outcome of the policy with the weights theta (length,) on episodes."""
        weights, biases = zip(*self.shape.layers(theta), strict=True)
        values = list(self._values)
        for place, part in zip(self._places, (*weights, *biases), strict=True):
            values[place] = np.ascontiguousarray(part).ravel()
        return episodes.play(values)

    def generation(self, count: int) -> float:
        """Play a generation, each member on the same fresh episodes, and move; return the mean payment of its better half."""
        episodes, reach = self.episodes_of("train", self.episode, count), self.arena.reach("train", self.episode, count)
        self.episode += count
        asked = [self.method.ask() for _ in range(self.method.population_size)]
        paid = [float(np.mean(self.arena.payment(self.played(self.first + self.unit * z, episodes), reach))) for z in asked]
        self.method.tell([(z, -one) for z, one in zip(asked, paid, strict=True)])
        self.mean = self.first + self.unit * self.method.mean
        return float(np.mean(sorted(paid)[len(paid) // 2 :]))

    def judged(self) -> float:
        """Return the mean score of the mean policy on the episodes that judge all starts."""
        count = max(JUDGED // self.loop.model.agents, ROWS)
        played = self.played(self.mean, self.episodes_of("tune", FIRST, count))
        return float(np.mean(self.arena.score(played, self.arena.reach("tune", FIRST, count))))

    def compare(self) -> None:
        """Keep the mean policy as champion if it does better than the one that is held."""
        score = self.judged()
        if score > self.champion[0]:
            self.champion = (score, self.mean)

    def write(self, folder: Path, seed: int) -> str:
        """Write the champion below a folder; return it as an attack on the command line."""
        plan, arena = self.start.plan, self.arena
        weights, biases = zip(*self.shape.layers(self.champion[1]), strict=True)
        training: dict[str, Any] = {
            "summary": "learned by the standard attack ensemble", "start": self.start.name, "seed": seed, "episodes": self.episode,
            "config": {"scenario": arena.scenario, "threat": dict(arena.threat)},
        }  # fmt: skip
        if not Spec("defence", arena.defence).imports:  # a file shall not name somebody's class
            training["config"]["defence"] = arena.defence
        header = header_of(Seat(self.loop, plan.action, plan.observation, Reward(), {}), training)
        knowledge, dose = self.loop.threat.knowledge, "own" if arena.dose is None else arena.dose
        name = f"{arena.name}-{dose}-{knowledge}-{digest([as_data(arena), self.start.name, seed])}"
        return f"policy:path={save_policy(folder / 'policies' / name, Network(weights, biases), header)}"


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


def starts_of(arena: Arena, knowledge: str, scripts: Sequence[str], seed: int) -> list[Start]:
    """Return the starts of a race: rest, an imitation of each script, and published policies that fit.

    Raises NotApplicable where the threat model grants nothing that a policy could choose.
    """
    loop = arena.seat(knowledge)
    try:
        codec, seen = ActionCodec(action_of(arena, scripts), loop.brief), ObservationCodec(loop.brief)
    except InputError as error:
        raise NotApplicable(error.field, error.value, error.expected) from None
    if codec.size < 2:
        raise NotApplicable("threat_model.kinds", loop.threat.kinds, "a kind of attack to choose")
    shape = Shape(tuple(itertools.pairwise((len(seen.names), HIDDEN, codec.size))))

    def plan(theta: Array) -> PolicyPlan:
        weights, biases = zip(*((weight.copy(), bias.copy()) for weight, bias in shape.layers(theta)), strict=True)
        return PolicyPlan(Network(weights, biases), codec, seen)

    rest = np.zeros(shape.length)
    rest[shape.length - codec.size] = lean(REST, codec.size)
    out, seat = [Start("rest", plan(rest))], Seat(loop, codec, seen, Reward(), {})
    for script in scripts:
        shown = demonstrate(seat, Spec("attack", script).make(), seed, max(SHOWN // loop.model.agents, FEWEST))
        out.append(Start(f"as {script}", plan(imitation(shape, shown, np.random.default_rng([seed, len(shown.action)]), COPIED))))
    fit = [
        Start(f"zoo {policy.name}", held) for policy, held in transferred(arena)
        if policy.knowledge == knowledge and held.network.lstm is None and held.action.discrete
    ]  # fmt: skip
    return [*out, *fit[:PUBLISHED]]


def learned(
    arena: Arena, knowledge: str, scripts: Sequence[str], race: Race, seed: int, folder: Path, tell: Tell | None = None
) -> list[str]:  # fmt: skip
    """Learn policies against an arena's defence; return the two that did most harm as attacks on the command line.

    Parameters
    ----------
    knowledge
        What the policies know: black or grey.
    scripts
        Attacks that networks imitate at the start.
    folder
        The policies' files are written below it.

    Raises
    ------
    NotApplicable
        Where the defence is not traced, as a policy would be learned too slowly, and where there is nothing to choose.
    """
    members = race.members(arena.loop.model.agents)
    runs = [Evolution(arena, knowledge, start, members, seed) for start in starts_of(arena, knowledge, scripts, seed)]
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
    return [run.write(folder, seed) for run in sorted(runs, key=lambda run: -run.champion[0])[:2]]


def transferred(arena: Arena) -> list[tuple[ZooAttack, PolicyPlan]]:
    """Return the published policies that have a meaning in an arena, those for its defence first."""
    out: list[tuple[ZooAttack, Any]] = []
    for name in zoo_names():
        policy = ZooAttack(name)
        try:
            out.append((policy, policy.prepare(arena.seat(policy.knowledge, policy).brief)))
        except (NotApplicable, InputError):
            continue
    return sorted(out, key=lambda one: f"-{arena.defence}-" not in one[0].name)
