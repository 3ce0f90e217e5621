"""The two-player environment in PettingZoo's parallel API (extra: game): agents "attacker" and "defender" (docs/two-players.md)."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding

try:
    from pettingzoo import ParallelEnv  # type: ignore[import-untyped]
except ImportError as error:
    raise ImportError("PettingZoo is missing: pip install 'tailgate[game]'") from error

from tailgate.agents.codec import action_space
from tailgate.agents.observation import LIMIT
from tailgate.core import Array, Frame
from tailgate.errors import InputError

from .duel import Duel, DuelState, checked, next_game
from .render_viewer import Viewer
from .specs import check_options

ATTACKER, GUARD = "attacker", "defender"


class DuelEnv(ParallelEnv[str, Array, Any]):  # type: ignore[misc]
    """One game; see `Duel.make` for the arguments. Both agents end together."""

    metadata: dict[str, Any] = {"name": "tailgate_duel_v0", "render_modes": ["rgb_array"], "is_parallelizable": True}  # noqa: RUF012 - PettingZoo's own annotation

    def __init__(
        self, *, render_mode: str | None = None, viewer: str = "auto", size: tuple[int, int] | None = None, **arguments: Any
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise InputError("render_mode", render_mode, "None or 'rgb_array'")
        self.duel, self.render_mode, self.viewer = Duel.make(**arguments), render_mode, Viewer(viewer, size)
        self.possible_agents = [ATTACKER, GUARD]
        self.agents: list[str] = []
        sight, act = self.duel.defender_spaces()
        seen = gymnasium.spaces.Box(-LIMIT, LIMIT, (len(self.duel.seat.observation.names),), np.float32)
        self.observation_spaces = {ATTACKER: seen, GUARD: sight}
        self.action_spaces = {ATTACKER: action_space(self.duel.seat.action), GUARD: act}
        self.game: DuelState | None = None
        self.frame: Frame | None = None  # the last step, for rendering and curious readers
        self._rng, _ = seeding.np_random(None)

    def observation_space(self, agent: str) -> Any:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        return self.action_spaces[agent]

    def card(self) -> dict[str, Any]:
        """JSON data that names this game completely, with a hash."""
        return self.duel.card()

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        """The game of a seed; without one the next of the running row, or a random one at first."""
        check_options(options, ("options",))  # of no meaning: PettingZoo's own tests give it
        if seed is not None:
            self._rng, _ = seeding.np_random(seed)
        self.game, self.frame, self.agents = next_game(self.duel, self.game, seed, self._rng), None, list(self.possible_agents)
        return self._observed(), self._infos(False, False, False)

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """One decision of both: dictionaries of what each sees and is paid, and how the game stands."""
        if self.game is None or not self.agents:
            raise InputError("step", "no episode", "reset() first")
        if set(actions) != set(self.agents):
            raise InputError("actions", sorted(actions), f"one action each of {', '.join(self.agents)}")
        attack, defend = (checked(self.action_spaces[who], actions[who], who) for who in self.possible_agents)
        self.game, outcome, paid, self.frame = self.duel.step(self.game, attack, defend, np.zeros(1, bool))
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        infos = self._infos(*(bool(part[0]) for part in (outcome.illegal, outcome.collided, outcome.rear_collided)))
        rewards = {ATTACKER: float(outcome.reward[0]), GUARD: float(paid[0])}
        out = self._observed(), rewards, dict.fromkeys(self.agents, terminated), dict.fromkeys(self.agents, truncated), infos
        if terminated or truncated:
            self.agents = []
        return out

    def render(self) -> Any:
        """The picture (H, W, 3) uint8; None without `render_mode`."""
        if self.render_mode is None or self.game is None:
            return None
        from .render import draw

        return draw(self.duel.seat.loop, self.game.loop, self.frame, 0, self.viewer)

    def _observed(self) -> dict[str, Array]:
        assert self.game is not None
        return {ATTACKER: self.game.seen[0].copy(), GUARD: self.duel.defender_sees(self.game)[0].copy()}

    def _infos(self, illegal: bool, collided: bool, rear: bool) -> dict[str, dict[str, Any]]:
        """What happened is told to the attacker alone: the defender learns of it by its own means."""
        assert self.game is not None
        told: dict[str, Any] = {"illegal": illegal, "collided": collided, "rear_collided": rear, "step": int(self.game.loop.k[0])}
        if self.duel.seat.action.discrete:
            told["action_mask"] = self.duel.mask(self.game)[0].astype(np.int8)
        return {ATTACKER: told, GUARD: self.duel.told(self.game)}


def parallel_env(**arguments: Any) -> DuelEnv:
    """A game of attacker and defender as PettingZoo plays it: scenario, defence, menu and the other arguments of `Duel.make`."""
    return DuelEnv(**arguments)
