"""A learner of the ensemble: a distribution of a policy's weights that moves towards what does more harm.

The method is CMA-ES with a diagonal covariance (Ros and Hansen 2008). One compiled program plays all: its parameters are the weights.
A defence that is not traced plays in the plain loop, where a whole generation is one batch.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tailgate.agents.learners.cem import Shape
from tailgate.agents.learners.learning import header_of
from tailgate.agents.policy.network_policy import PolicyAttack, PolicyPlan, save_policy
from tailgate.core import Array, draws
from tailgate.core.draws import Keys, Role
from tailgate.core.neural import Network
from tailgate.core.registry import Spec
from tailgate.core.schema import as_data, digest
from tailgate.engine.agreement import ROWS, Untraced
from tailgate.engine.parameters import Parameters
from tailgate.ensemble.battery import Episodes, Played, battery_of, played_plainly
from tailgate.ensemble.search import Arena
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.rewards import Reward

if TYPE_CHECKING:
    from cmaes import SepCMA

SPREAD = 0.3  # of the first generation: of the size of a network's weights, and by itself where they are 0
JUDGED = 1024  # episodes that decide which starts go on, for a system of one agent
FIRST = 1 << 30  # number of the first episode that starts are judged on: no search meets it before
ZOO = "published "  # how the names of published policies begin
SHORTER = 4  # a race in the plain loop has this part of its generations and judging episodes


class Start(NamedTuple):
    """A first network, and the actions that its outputs choose among."""

    name: str
    plan: PolicyPlan
    size: Array  # (d,) standard deviation of each observation: the less one varies, the larger are the changes of its weights
    script: str = ""  # that it imitates

    @property
    def rests(self) -> bool:
        """If all its weights but a bias are 0."""
        return not self.script and not self.name.startswith(ZOO)


@dataclass(frozen=True, eq=False)
class Several(Network):
    """Networks that decide for the same number of rows each, one after the other; the weights are those of the first."""

    networks: tuple[Network, ...] = ()

    def __call__(self, observation: Array) -> Array:
        rows = np.split(np.asarray(observation), len(self.networks))
        return np.concatenate([network(some) for network, some in zip(self.networks, rows, strict=True)])


class Evolution:
    """One start: a distribution of weights that moves towards what does more harm. `enter` begins its race."""

    method: SepCMA

    def __init__(self, arena: Arena, knowledge: str, start: Start) -> None:
        self.arena, self.start, self.attack, self.loop = arena, start, PolicyAttack(), arena.seat(knowledge)
        self.episode = 0
        network = start.plan.network
        parts = [part for pair in zip(network.weights, network.biases, strict=True) for part in pair]
        self.shape = Shape(tuple(itertools.pairwise((len(network.weights[0]), *map(len, network.biases)))))
        self.mean = self.first = np.concatenate([part.ravel() for part in parts])
        reads = [np.ones_like(part) for part in parts]
        reads[0] /= start.size[:, None]
        sizes = [np.sqrt(np.mean((part / read) ** 2)) or 1.0 for part, read in zip(parts, reads, strict=True)]
        if start.rests:
            sizes = [1.0] * len(parts)
        self.unit = SPREAD * np.concatenate([(size * read).ravel() for size, read in zip(sizes, reads, strict=True)])
        few = self._memory(draws.keys("tune", range(ROWS)))
        self.battery = battery_of(self.loop, self.attack, self.start.plan, few)
        held = Parameters((self.loop, self.attack, start.plan))
        self._values = held.values
        self._places = [
            next(i for i, leaf in enumerate(held.values) if np.shares_memory(leaf, part)) for part in (*network.weights, *network.biases)
        ]  # fmt: skip
        self.champion = (self.judged(), self.mean)

    @property
    def traced(self) -> bool:
        """If its game is one compiled program."""
        return not isinstance(self.battery, Untraced)

    def enter(self, population: int, seed: int) -> None:
        """Begin a race with this many policies in a generation."""
        from cmaes import SepCMA  # imports scipy's statistics

        self.method = SepCMA(np.zeros(self.first.size), 1.0, population_size=population, seed=seed)

    def _memory(self, keys: Keys) -> object:
        batch = len(keys.key)
        return self.attack.start(self.start.plan, batch, keys.at(Role.ATTACK, np.zeros(batch, np.int64)))

    def _network(self, theta: Array) -> Network:
        weights, biases = zip(*self.shape.layers(theta), strict=True)
        return Network(weights, biases)

    def played(self, thetas: Sequence[Array], purpose: str, first: int, count: int) -> list[Played]:
        """Return the outcome of the policy of each of the weights theta (length,), all on the same episodes from number `first` on."""
        keys = draws.keys(purpose, range(first, first + count))
        if isinstance(self.battery, Untraced):
            return self._plain(thetas, keys)
        episodes, out = Episodes(self.battery, keys, self._memory(keys)), []
        for theta in thetas:
            network, values = self._network(theta), list(self._values)
            for place, part in zip(self._places, (*network.weights, *network.biases), strict=True):
                values[place] = np.ascontiguousarray(part).ravel()
            out.append(episodes.play(values))
        return out

    def _plain(self, thetas: Sequence[Array], keys: Keys) -> list[Played]:
        """Return the same in the plain loop."""
        networks, count = tuple(map(self._network, thetas)), len(keys.key)
        plan = self.start.plan._replace(network=Several(networks[0].weights, networks[0].biases, networks=networks))
        many = Keys(np.tile(keys.key, (len(networks), 1)), np.tile(keys.episode, len(networks)))
        played = played_plainly(self.loop, self.attack, plan, many, self._memory(many))
        return [Played(*(part[i * count : (i + 1) * count] for part in played)) for i in range(len(networks))]

    def generation(self, count: int) -> float:
        """Play a generation, each member on the same fresh episodes, and move; return the mean payment of its better half."""
        reach = self.arena.reach("train", self.episode, count)
        asked = [self.method.ask() for _ in range(self.method.population_size)]
        played = self.played([self.first + self.unit * z for z in asked], "train", self.episode, count)
        paid = [float(np.mean(self.arena.payment(one, reach))) for one in played]
        self.episode += count
        self.method.tell([(z, -one) for z, one in zip(asked, paid, strict=True)])
        self.mean = self.first + self.unit * self.method.mean
        return float(np.mean(sorted(paid)[len(paid) // 2 :]))

    def judged(self) -> float:
        """Return the mean score of the mean policy on the episodes that judge all starts."""
        count = max(JUDGED // self.loop.model.agents // (1 if self.traced else SHORTER), ROWS)
        (played,) = self.played([self.mean], "tune", FIRST, count)
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
            "config": {"scenario": arena.scenario, "threat": dict(arena.threat)}, "threat_model": as_data(plan.action.brief.threat),
        }  # fmt: skip
        if not Spec("defence", arena.defence).imports:  # a file shall not name somebody's class
            training["config"]["defence"] = arena.defence
        header = header_of(Seat(self.loop, plan.action, plan.observation, Reward(), {}), training)
        knowledge, dose = self.loop.threat.knowledge, "own" if arena.dose is None else arena.dose
        name = f"{arena.name}-{dose}-{knowledge}-{digest([as_data(arena), self.start.name, seed])}"
        return f"policy:path={save_policy(folder / 'policies' / name, Network(weights, biases), header)}"
