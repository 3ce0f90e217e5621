"""The Gymnasium faces: the loop with the attack's seat left open, under one id for each kind of system.

The core is a vector environment without autoreset; NEXT_STEP and SAME_STEP are thin faces over it, and the single environment is
a batch of one. reset(seed=s): row i equals gymnasium.make(...).reset(seed=s + i); each further episode of a row adds 1 to its
episode counter.
"""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from tailgate import draws
from tailgate.agents.codec import action_space
from tailgate.agents.observation import LIMIT
from tailgate.core import Array, Frame, View
from tailgate.errors import InputError, unknown
from tailgate.loop import LoopState

from .seat import FACES, Seat, Tally

_AUTORESET = {"next_step": AutoresetMode.NEXT_STEP, "same_step": AutoresetMode.SAME_STEP, "disabled": AutoresetMode.DISABLED}


class AdversaryVectorEnv(gymnasium.vector.VectorEnv[Array, Array, Array]):
    """B adversary environments stepped as one batch; see `Seat.make` for the arguments."""

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own annotation
        "render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.NEXT_STEP,
    }  # fmt: skip
    purpose: ClassVar[str] = "train"

    def __init__(self, num_envs: int = 1, *, render_mode: str | None = None, autoreset: str = "next_step", **arguments: Any) -> None:
        if not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise InputError("num_envs", num_envs, "a whole number not below 1")
        num_envs = int(num_envs)
        if autoreset not in _AUTORESET:
            raise unknown("autoreset", autoreset, _AUTORESET)
        if render_mode not in (None, "rgb_array"):
            why = "; a window shows one episode: gymnasium.make(..., render_mode='human')" if render_mode == "human" else ""
            raise InputError("render_mode", render_mode, f"None or 'rgb_array'{why}")
        self.seat = Seat.make(**arguments)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.autoreset = _AUTORESET[autoreset]
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset, "render_fps": round(1.0 / self.seat.loop.model.dt)}
        features = len(self.seat.observation.names)
        self.single_observation_space = gymnasium.spaces.Box(-LIMIT, LIMIT, (features,), np.float32)
        self.single_action_space = action_space(self.seat.action)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.state: LoopState | None = None
        self.tally: Tally | None = None
        self._done = np.zeros(num_envs, bool)
        self.observed = np.zeros((num_envs, features), np.float32)
        self.frame: Frame | None = None  # the last step, for rendering and curious readers

    def card(self) -> dict[str, Any]:
        """JSON data that names this environment completely, with a hash."""
        return self.seat.card()

    # -- episodes

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """seed s or one per row. options["reset_mask"] (B,) bool restarts those rows only."""
        mask = None if options is None else options.get("reset_mask")
        if isinstance(seed, (list, tuple, np.ndarray)):
            if len(seed) != self.num_envs:
                raise InputError("seed", seed, f"one seed per row ({self.num_envs})")
            seeds = [None if s is None else int(s) for s in seed]
            super().reset(seed=next((s for s in seeds if s is not None), None))
        else:
            super().reset(seed=seed)
            seeds = [None] * self.num_envs if seed is None else [int(seed) + i for i in range(self.num_envs)]
        if mask is None:
            rows = np.ones(self.num_envs, bool)
        else:
            rows = np.asarray(mask)
            if rows.dtype != bool or rows.shape != (self.num_envs,) or not rows.any():
                raise InputError("options.reset_mask", mask, f"a bool array of shape ({self.num_envs},) with at least one True")
        if self.state is None:
            fresh = [int(self.np_random.integers(2**31)) if s is None else s for s in seeds]
            self.state = self.seat.loop.start(draws.keys(self.purpose, fresh))
        else:
            again = rows & np.array([s is None for s in seeds])
            self.state = self.seat.loop.restart(self.state, again)
            named = np.flatnonzero(rows & ~again)
            if len(named):
                keys = draws.keys(self.purpose, [s for s in (seeds[i] for i in named) if s is not None])
                self.state = self.seat.loop.reseed(self.state, named, keys)
        self._done = self._done & ~rows
        self.frame = None
        view = self._begin(rows)
        quiet = np.zeros(self.num_envs, bool)
        return self.observed.copy(), self._info(view, quiet, quiet, quiet)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """actions (B,) for discrete spaces, (B, size) for Box -> the Gymnasium five."""
        if self.state is None or self.tally is None:
            raise InputError("step", "no episode", "reset() first")
        actions = self._checked(actions)
        over, resets = self._done, self.autoreset == AutoresetMode.NEXT_STEP
        if over.any() and self.autoreset == AutoresetMode.DISABLED:
            raise InputError("step", np.flatnonzero(over).tolist(), "rows that are over to be reset with options['reset_mask'] first")
        self.state, self.tally, outcome, self.frame = self.seat.step(self.state, self.tally, actions, over)
        terminated, truncated = outcome.terminated, outcome.truncated
        happened = (outcome.refused, outcome.collided, outcome.rear_collided)
        self._done = terminated | truncated
        view = self.seat.loop.sense(self.state)
        self.observed = self.seat.observation.observe(view, self.observed)
        if resets and over.any():  # these rows were over: this step is their reset
            view = self._restart(over)
        observation, info = self.observed.copy(), self._info(view, *happened)
        if self.autoreset == AutoresetMode.SAME_STEP and self._done.any():
            done, final, final_info = self._done, observation, info
            view = self._restart(done)
            observation, info = self.observed.copy(), self._info(view, *happened)
            info |= {"final_obs": final, "_final_obs": done.copy(), "final_info": final_info, "_final_info": done.copy()}
            self._done = np.zeros_like(done)
        return observation, outcome.reward, terminated, truncated, info

    def action_masks(self) -> Array:
        """(B, actions) bool: what the channel would accept now. Discrete action spaces only."""
        if self.state is None or not self.seat.action.discrete:
            raise InputError("action_masks", self.seat.action.spec.action, "a running episode with a discrete action space")
        return self.seat.action.mask(self.seat.loop.sense(self.state))

    def render(self) -> tuple[Array, ...] | None:
        """One (H, W, 3) uint8 picture per row: the road or the graph, what is believed, attack, alarm."""
        if self.render_mode is None or self.state is None:
            return None
        from .render import draw

        return tuple(draw(self.seat.loop, self.state, self.frame, row) for row in range(self.num_envs))

    # -- inside

    def _restart(self, rows: Array) -> View:
        """New episodes in `rows` (B,) bool."""
        assert self.state is not None
        self.state = self.seat.loop.restart(self.state, rows)
        return self._begin(rows)

    def _begin(self, rows: Array) -> View:
        """What belongs to an episode, of those that have just begun in `rows` (B,) bool."""
        assert self.state is not None
        fresh, view = self.seat.begin(self.state), self.seat.loop.sense(self.state)
        held = fresh if self.tally is None else self.tally
        self.tally = Tally(*(np.where(rows, new, old) for new, old in zip(fresh, held, strict=True)))
        self.observed = np.where(rows[:, None], self.seat.observation.observe(view), self.observed)
        return view

    def _checked(self, actions: Array) -> Array:
        actions = np.asarray(actions)
        shape = self.action_space.shape
        if actions.shape != shape:
            raise InputError("actions", f"shape {actions.shape}", f"shape {shape}")
        if self.seat.action.discrete:
            if actions.dtype.kind not in "iu" or ((actions < 0) | (actions >= self.seat.action.size)).any():
                raise InputError("actions", actions.tolist(), f"whole numbers from 0 to {self.seat.action.size - 1}")
        elif not np.isfinite(actions).all():
            raise InputError("actions", actions.tolist(), "finite numbers in [-1, 1]")
        return actions

    def _info(self, view: View, illegal: Array, collided: Array, rear: Array) -> dict[str, Any]:
        assert self.tally is not None
        info: dict[str, Any] = {
            "illegal": illegal.copy(), "collided": collided.copy(), "rear_collided": rear.copy(), "allowed": view.allowed.copy(),
            "step": view.k.copy(),
        }  # fmt: skip
        info |= {"gap": np.min(view.scene.gap, axis=1)} if self.seat.road else {"error": self.tally.error.copy()}
        if self.seat.action.discrete:
            info["action_mask"] = self.seat.action.mask(view).astype(np.int8)  # as Space.sample(mask) wants it
        everyone = np.ones(self.num_envs, bool)
        return info | {f"_{key}": everyone for key in info}


class AdversaryEnv(gymnasium.Env[Array, Any]):
    """One adversary environment; see `Seat.make` for the arguments."""

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 10}  # noqa: RUF012 - Gymnasium's own annotation

    def __init__(self, *, render_mode: str | None = None, **arguments: Any) -> None:
        if "autoreset" in arguments:
            raise InputError("autoreset", arguments["autoreset"], "a vector environment (make_vec); a single one is reset by its user")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError("render_mode", render_mode, "None, 'rgb_array' or 'human'")
        drawn = None if render_mode is None else "rgb_array"
        self.batch = AdversaryVectorEnv(1, render_mode=drawn, autoreset="disabled", **arguments)
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": self.batch.metadata["render_fps"]}
        self._window: Any = None
        self._shown: LoopState | None = None  # in the window
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space

    def card(self) -> dict[str, Any]:
        """JSON data that names this environment completely, with a hash."""
        return self.batch.card()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        if self.batch.state is None and seed is None:
            seed = int(self.np_random.integers(2**31))
        observation, info = self.batch.reset(seed=seed)
        if self.render_mode == "human":
            self.render()
        return observation[0], self._row(info)

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.batch.step(np.asarray(action)[None])
        if self.render_mode == "human":
            self.render()
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._row(info)

    def action_masks(self) -> Array:
        """(actions,) bool: what the channel would accept now. Discrete action spaces only."""
        return np.asarray(self.batch.action_masks()[0])

    def render(self) -> Any:
        """The picture (H, W, 3) uint8; in human mode None: reset() and step() show it in a window by themselves."""
        if self.render_mode != "human":
            frames = self.batch.render()
            return None if frames is None else frames[0]
        if self.batch.state is None or self.batch.state is self._shown:
            return None
        if self._window is None:
            from .render import Window

            self._window = Window(self.metadata["render_fps"])
        if not self._window.dismissed:
            frames = self.batch.render()
            assert frames is not None
            self._window.show(frames[0])
        self._shown = self.batch.state
        return None

    def close(self) -> None:
        if self._window is not None:
            self._window.close()
            self._window = self._shown = None
        super().close()

    @staticmethod
    def _row(info: dict[str, Any]) -> dict[str, Any]:
        return {k: v[0].copy() if v[0].ndim else v[0].item() for k, v in info.items() if not k.startswith("_")}


def register_all() -> None:
    """Make the ids known to Gymnasium. Called on import of tailgate."""
    for name, defaults in FACES.items():
        gymnasium.register(
            id=name,
            entry_point="tailgate.envs.faces:AdversaryEnv",
            vector_entry_point="tailgate.envs.faces:AdversaryVectorEnv",
            order_enforce=True,
            kwargs=dict(defaults),
        )
