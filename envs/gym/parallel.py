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

from tailgate.base.errors import InputError
from tailgate.core import Array, Frame
from tailgate.envs.gym.actions import action_space
from tailgate.envs.gym.duel import Duel, DuelState, checked, next_game
from tailgate.envs.gym.observations import LIMIT
from tailgate.envs.gym.specs import check_options, limit_of, shown
from tailgate.envs.render.viewer import Screen, Viewer

ATTACKER, DEFENDER = "attacker", "defender"


class DuelEnv(ParallelEnv[str, Array, Any]):  # type: ignore[misc]
    """One game; see `Duel.make` for the arguments. Both agents end together."""

    metadata: dict[str, Any] = {  # noqa: RUF012 - PettingZoo's own annotation
        "name": "tailgate_duel_v0", "render_modes": ["human", "rgb_array"], "is_parallelizable": True, "render_fps": 10,
    }  # fmt: skip

    def __init__(
        self, *, render_mode: str | None = None, viewer: str = "auto", size: tuple[int, int] | None = None,
        max_cycles: int | None = None, **arguments: Any,
    ) -> None:  # fmt: skip
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError("render_mode", render_mode, "None, 'rgb_array' or 'human'")
        self.max_cycles, self.cycles = limit_of("max_cycles", max_cycles), 0  # decisions of a game at most, and of the present one so far
        self.duel, self.render_mode, self.viewer = Duel.make(**arguments), render_mode, Viewer(viewer, size)
        self.possible_agents = [ATTACKER, DEFENDER]
        self.agents: list[str] = []
        sight, act = self.duel.defender_spaces()
        seen = gymnasium.spaces.Box(-LIMIT, LIMIT, (len(self.duel.seat.observation.names),), np.float32)
        self.observation_spaces = {ATTACKER: seen, DEFENDER: sight}
        self.action_spaces = {ATTACKER: action_space(self.duel.seat.action), DEFENDER: act}
        self.state_space = gymnasium.spaces.Box(-LIMIT, LIMIT, (seen.shape[0] + sight.shape[0],), np.float32)
        self.metadata = self.metadata | {"render_fps": round(1.0 / self.duel.seat.loop.model.dt)}
        self._screen, self._moves = Screen(), 0  # the second: resets and steps so far
        self.game: DuelState | None = None
        self.frame: Frame | None = None  # the last step, for rendering and curious readers
        self._rng, _ = seeding.np_random(None)

    def __repr__(self) -> str:
        return shown(self, None, self.duel.seat)

    def observation_space(self, agent: str) -> Any:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        return self.action_spaces[agent]

    def card(self) -> dict[str, Any]:
        """Return JSON data that names this game completely, with a hash."""
        return self.duel.card(**({"max_cycles": self.max_cycles} if 0 < self.max_cycles < self.duel.seat.decisions else {}))

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        """Begin the game of a seed; without one the next of the running row, or a random one at first."""
        check_options(options, ignored=("options",))  # PettingZoo's own tests give it
        if seed is not None:
            self._rng, _ = seeding.np_random(seed)
        self.game, self.frame, self.agents = next_game(self.duel, self.game, seed, self._rng), None, list(self.possible_agents)
        self.cycles = 0
        self._moved()
        return self._observed(), self._infos(*np.zeros(3, bool))

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Play one decision of both; return observations, rewards and ends by agent."""
        if self.game is None or not self.agents:
            raise InputError("step", "no episode", "reset() first")
        if set(actions) != set(self.agents):
            raise InputError("actions", sorted(actions), f"one action each of {', '.join(self.agents)}")
        attack, defend = (checked(self.action_spaces[who], actions[who], who) for who in self.possible_agents)
        self.game, outcome, paid, self.frame = self.duel.step(self.game, attack, defend, np.zeros(1, bool))
        self.cycles += 1
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0]) or self.cycles == self.max_cycles
        infos = self._infos(*(part[0] for part in (outcome.illegal, outcome.collided, outcome.rear_collided)))
        rewards = {ATTACKER: float(outcome.reward[0]), DEFENDER: float(paid[0])}
        out = self._observed(), rewards, dict.fromkeys(self.agents, terminated), dict.fromkeys(self.agents, truncated), infos
        if terminated or truncated:
            self.agents = []
        self._moved()
        return out

    def state(self) -> Array:
        """Return (d,) float32: the attacker's observation, then the defender's, for a critic that is trained on both."""
        if self.game is None:
            raise InputError("state", "no episode", "reset() first")
        return np.concatenate([seen for seen in self._observed().values()])

    def render(self) -> Any:
        """Return the picture (H, W, 3) uint8; None without `render_mode`, and in human mode: reset() and step() show it in a window."""
        if self.render_mode is None or self.game is None:
            return None
        if self.render_mode == "human":
            return self._screen.show(self._moves, self.metadata["render_fps"], self._picture)
        return self._picture()

    def close(self) -> None:
        """Close the window, if there is one."""
        self._screen.close()

    def _moved(self) -> None:
        self._moves += 1
        if self.render_mode == "human":
            self.render()

    def _picture(self) -> Array:
        from tailgate.envs.render.picture import draw

        assert self.game is not None
        return draw(self.duel.seat.loop, self.game.loop, self.frame, 0, self.viewer)

    def _observed(self) -> dict[str, Array]:
        assert self.game is not None
        return {ATTACKER: self.game.seen[0].copy(), DEFENDER: self.duel.defender_sees(self.game)[0].copy()}

    def _infos(self, illegal: np.bool_, collided: np.bool_, rear: np.bool_) -> dict[str, dict[str, Any]]:
        """Return the information by agent: the attacker learns what happened, the defender has only its own means."""
        assert self.game is not None
        view = self.duel.seat.loop.sense(self.game.loop)
        attacker: dict[str, Any] = {
            "illegal": illegal, "collided": collided, "rear_collided": rear, "allowed": view.allowed[0], "step": self.game.loop.k[0],
        }  # fmt: skip
        if self.duel.seat.road:
            attacker["gap"] = np.min(view.scene.gap[0])
        else:
            attacker["error"] = self.game.tally.error[0]
        defender = self.duel.told(self.game)
        if self.duel.seat.action.discrete:
            attacker["action_mask"] = self.duel.mask(self.game)[0].astype(np.int8)
        if self.duel.action == "menu":
            defender["action_mask"] = np.ones(len(self.duel.settings), np.int8)  # each setting may be chosen at any time
        return {ATTACKER: attacker, DEFENDER: defender}


def parallel_env(**arguments: Any) -> DuelEnv:
    """Return a game of attacker and defender as PettingZoo plays it; for the arguments see `Duel.make`."""
    return DuelEnv(**arguments)
