"""A defender that learns: the cross-entropy method on the network that turns the knobs, against a pool of attackers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tailgate.agents.learners.cem import Config, Search, lean, outputs
from tailgate.core import Array, Attack
from tailgate.core.draws import Keys
from tailgate.core.neural import Network
from tailgate.core.schema import digest
from tailgate.envs.gym.duel import Attacker, Duel
from tailgate.envs.gym.mixture import Mixture
from tailgate.estimators.challenge.steered import save_defender
from tailgate.estimators.challenge.steering import nearest


class Played(NamedTuple):
    """The results of some games, (B,) each."""

    paid: Array  # discounted, to the defender
    crashed: Array  # bool
    cost: Array  # cost of care: mean costs of `safety`, whatever the payoff, undiscounted
    decisions: int  # decisions of all games together


def play(duel: Duel, attack: Attack, keys: Keys, choose: Callable[[Array], Array] | None = None, gamma: float = 1.0) -> Played:
    """Play a game per key. choose: from the defenders' view (B, d) to their actions; None leaves the knobs to the defence."""
    state, attacker = duel.begin(keys), Attacker(attack, duel.seat, keys)
    paid, cost, crashed = (np.zeros(len(keys.key)) for _ in range(3))
    decisions, weight = 0, 1.0
    for _ in range(duel.seat.decisions):
        over = state.loop.ended.copy()
        if over.all():
            break
        decisions += int(np.count_nonzero(~over))
        action = None if choose is None else choose(duel.defender_sees(state))
        before = state.loop
        state, outcome, gained, _ = duel.step(state, attacker, action, over)
        hit = (outcome.collided | outcome.rear_collided) & ~over
        paid += weight * gained
        cost += np.where(over, 0.0, duel.care(before, state.loop))
        crashed += hit
        weight *= gamma
    return Played(paid, crashed > 0.0, cost, decisions)


class Learner(Search):
    """One training run of one seed: the defender of a duel against the uniform mixture of some attacks."""

    def __init__(self, seed: int, gamma: float, config: Config, duel: Duel, attacks: tuple[Attack, ...]) -> None:
        self.duel, self.gamma, self.attack = duel, gamma, Mixture(attacks)
        self._card = digest([duel.card(), attacks])
        names, actions = duel.plan.sight.names, len(duel.settings)
        first = (nearest(duel.guard.hand.knobs), lean(config.rest, actions) if actions > 1 else 0.0)
        super().__init__(seed, gamma, config, (len(names), *config.hidden, actions), first)

    @property
    def card(self) -> str:
        return self._card

    @property
    def road(self) -> bool:
        return self.duel.seat.road

    def episodes(self, layers: list[tuple[Array, Array]], members: int, keys: Keys) -> tuple[Array, Array]:
        def choose(seen: Array) -> Array:
            return np.asarray(np.argmax(outputs(layers, seen.reshape(members, -1, seen.shape[1])), axis=1))

        out = play(self.duel, self.attack, keys, choose, self.gamma)
        self.steps += out.decisions
        return out.paid, out.crashed

    def export(self, path: Path, training: dict[str, Any]) -> Path:
        """Write the policy of the mean as safetensors + JSON."""
        return export(path, self.duel, self.network, training)


def export(path: Path, duel: Duel, network: Network, training: dict[str, Any]) -> Path:
    """Write a defender of this duel as safetensors + JSON."""
    guard = duel.guard
    header = {"defence": guard.described, "menu": guard.menu_used, "observation": duel.plan.sight.names, "training": training}
    return save_defender(path, network, header)


def constant(duel: Duel, setting: int) -> Network:
    """Return the network of a defender that always chooses one setting."""
    inputs, actions = len(duel.plan.sight.names), len(duel.settings)
    bias = np.zeros(actions)
    bias[setting] = 1.0
    return Network((np.zeros((inputs, actions)),), (bias,))
