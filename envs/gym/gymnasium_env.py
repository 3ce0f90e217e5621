"""The Gymnasium environments: the loop in which the agent is the attacker, under one id for each kind of system.

The core is a vector environment without autoreset; NEXT_STEP and SAME_STEP are thin layers over it, and the single environment is
a batch of one. reset(seed=s): row i equals gymnasium.make(...).reset(seed=s + i); each further episode of a row adds 1 to its
episode counter.
"""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from tailgate.base import sizes
from tailgate.base.errors import InputError, unknown
from tailgate.core import Array, Frame, draws
from tailgate.core.loop import LoopState
from tailgate.envs.gym.actions import action_space
from tailgate.envs.gym.attacker_mdp import FACES, Seat, Tally, without_autoreset
from tailgate.envs.gym.batches import PlainEpisodes, TracedEpisodes, framed, side_by_side
from tailgate.envs.gym.observations import LIMIT
from tailgate.envs.gym.shadow import Begun, Decided
from tailgate.envs.gym.specs import Specified, check_options, in_box, limit_of, shown
from tailgate.envs.render.viewer import Screen, Viewer

_WHOLE = (int, np.int64)  # an action's usual types
_BOOL = (np.False_, np.True_)
_GOES_ON = np.zeros(1, bool)  # `over` of a single running row
_AUTORESET = {"next_step": AutoresetMode.NEXT_STEP, "same_step": AutoresetMode.SAME_STEP, "disabled": AutoresetMode.DISABLED}


class AdversaryVectorEnv(Specified, gymnasium.vector.VectorEnv[Array, Array, Array]):
    """B adversary environments stepped as one batch; arguments as `Seat.make`, viewer, size as `Viewer`, engine as `batches`.

    autoreset: next_step (the default), same_step or disabled. autoreset_mode: the same, by Gymnasium's word.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own annotation
        "render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.NEXT_STEP,
    }  # fmt: skip
    purpose: ClassVar[str] = "train"

    def __init__(
        self, num_envs: int = 1, *, render_mode: str | None = None, autoreset: str | AutoresetMode | None = None,
        autoreset_mode: str | AutoresetMode | None = None, viewer: str = "auto",
        size: tuple[int, int] | None = None, engine: str = "auto", threads: int = 1, max_episode_steps: int | None = None,
        device: str | None = None, **arguments: Any,
    ) -> None:  # fmt: skip
        num_envs = sizes.check("num_envs", num_envs)
        if autoreset is not None and autoreset_mode is not None:
            raise InputError("autoreset_mode", autoreset_mode, f"none, as autoreset is {autoreset}")
        given = autoreset_mode if autoreset is None else autoreset
        resets = "next_step" if given is None else given.name.lower() if isinstance(given, AutoresetMode) else str(given)
        if resets not in _AUTORESET:
            raise unknown("autoreset" if autoreset_mode is None else "autoreset_mode", given, _AUTORESET)
        limit = limit_of("max_episode_steps", max_episode_steps)
        if render_mode not in (None, "rgb_array"):
            why = "; a window shows one episode: gymnasium.make(..., render_mode='human')" if render_mode == "human" else ""
            raise InputError("render_mode", render_mode, f"None or 'rgb_array'{why}")
        self.seat = Seat.make(**arguments)
        sizes.fits(num_envs * self.seat.memory, "num_envs", num_envs, f"{num_envs:,} environments")
        self.num_envs = num_envs
        self.render_mode, self.viewer = render_mode, Viewer(viewer, size)
        self.autoreset_mode = _AUTORESET[resets]
        self.horizon = min(self.seat.decisions, limit or self.seat.decisions)  # decisions of an episode that nothing ends early
        self._limit = limit if limit <= self.seat.decisions else 0
        self._elapsed = np.zeros(num_envs, np.int64)  # decisions of the present episode, where there is a limit
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset_mode, "render_fps": round(1.0 / self.seat.loop.model.dt)}
        features = len(self.seat.observation.names)
        self.single_observation_space = gymnasium.spaces.Box(-LIMIT, LIMIT, (features,), np.float32)
        self.single_action_space = action_space(self.seat.action)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.episodes = side_by_side(self.seat, engine, render_mode is not None, threads, device)
        self.episodes.check(num_envs)
        self.begun = False
        self.over = np.zeros(num_envs, bool)
        self._frames = self.seat.observation.frames
        self._modes = self.seat.action.size if self.seat.action.discrete else 0  # discrete actions, 0 where there are none
        self._facts = ("illegal", "collided", "rear_collided", "allowed", "step", "gap" if self.seat.road else "error")
        self._present = self._presence()
        self.observed = np.zeros((num_envs, features if self._frames > 1 else 0), np.float32)  # the last one, where it has several frames

    @property
    def engine(self) -> str:
        """The engine that plays: traced or plain. Both play the same episodes."""
        return self.episodes.engine

    @property
    def device(self) -> str:
        """The device that plays: cpu or cuda. Both play the same episodes."""
        return self.episodes.device

    @property
    def engine_why(self) -> str:
        """Why the plain loop plays although nobody asked for it: the line that cannot be traced, and how to write it. Else empty."""
        return self.episodes.why if isinstance(self.episodes, PlainEpisodes) else ""

    @property
    def direct(self) -> bool:
        """True if no plain loop plays, and the environment adds nothing to the engine's results."""
        return not isinstance(self.episodes, PlainEpisodes) and self._frames == 1 and not self._limit

    @property
    def episode(self) -> Array:
        """(B,) the number of each row's episode, from 0, under its seed."""
        return self.episodes.number

    @property
    def state(self) -> LoopState | None:
        """The plain loop's state, for rendering and curious readers; None before the first episode, and where a traced loop plays."""
        return self.episodes.state if isinstance(self.episodes, PlainEpisodes) else None

    @property
    def tally(self) -> Tally | None:
        """The memory of the plain loop's reward; None before the first episode, and where a traced loop plays."""
        return self.episodes.tally if isinstance(self.episodes, PlainEpisodes) else None

    @property
    def frame(self) -> Frame | None:
        """The plain loop's last step; None before it, and where a traced loop plays."""
        return self.episodes.frame if isinstance(self.episodes, PlainEpisodes) else None

    def card(self) -> dict[str, Any]:
        """Return JSON data that names this environment completely, with a hash."""
        return self.seat.card(self.horizon if self.horizon < self.seat.decisions else None)

    # -- episodes

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin episodes: seed s or one per row. options["reset_mask"] (B,) bool restarts those rows only."""
        check_options(options, ("reset_mask",))
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
        if not self.begun:
            fresh = [int(self.np_random.integers(2**31)) if s is None else s for s in seeds]
            self.episodes.begin(draws.keys(self.purpose, fresh))
            self.begun = True
        else:
            again = rows & np.array([s is None for s in seeds])
            if again.any():
                self.episodes.again(again, reset=True)
            if (named := rows & ~again).any():
                keys = draws.keys(self.purpose, [s for s in (seeds[i] for i in np.flatnonzero(named)) if s is not None])
                self.episodes.again(named, keys, reset=True)
        self.over = self.over & ~rows
        self._elapsed[rows] = 0
        self._begin(rows)
        return self._shown(), self._info(*np.zeros((3, self.num_envs), bool))

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Play actions (B,) for discrete spaces, (B, size) for Box; return the five values of Gymnasium."""
        if not self.begun:
            raise InputError("step", "no episode", "reset() first")
        actions = self.checked(actions)
        over, resets = self.over, self.autoreset_mode == AutoresetMode.NEXT_STEP
        if self.autoreset_mode == AutoresetMode.DISABLED and over.any():
            raise InputError("step", np.flatnonzero(over).tolist(), "rows that are over to be reset with options['reset_mask'] first")
        outcome = self.episodes.decide(actions, over, resets)
        terminated, truncated = outcome.terminated, outcome.truncated
        if self._limit:
            truncated = self._limited(truncated, over)
        happened = (outcome.illegal, outcome.collided, outcome.rear_collided)
        self.over = terminated | truncated
        if self._frames > 1:
            self.observed = framed(self.episodes.seen(), self.observed, self._frames)
            if resets and over.any():  # these rows were over: this step is their reset
                self._begin(over)
        observation, info = self._shown(), self._info(*happened)
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self.over.any():
            done, final, final_info = self.over, observation, info
            self.episodes.again(done)
            self._begin(done)
            observation, info = self._shown(), self._info(*happened)
            final_info |= {key: value.copy() for key, value in zip(self._facts, happened, strict=False)}
            info |= {"final_obs": final, "_final_obs": done.copy(), "final_info": final_info, "_final_info": done.copy()}
            self.over = np.zeros_like(done)
            self._elapsed[done] = 0
        return observation, outcome.reward, terminated, truncated, info

    def action_masks(self) -> Array:
        """Return (B, actions) bool: the actions that the channel would accept in a step of the next decision.

        Discrete action spaces only.
        """
        if not self.begun or not self.seat.action.discrete:
            raise InputError("action_masks", self.seat.action.spec.action, "a running episode with a discrete action space")
        return self.episodes.mask().copy()

    def render(self) -> tuple[Array, ...] | None:
        """Return one (H, W, 3) uint8 picture per row: the road or the graph, the beliefs, attack, alarm."""
        if self.render_mode is None or not self.begun:
            return None
        from tailgate.envs.render.picture import draw

        return tuple(draw(self.seat.loop, *self.episodes.drawn(row), self.viewer) for row in range(self.num_envs))

    # -- inside

    def _limited(self, truncated: Array, over: Array) -> Array:
        """Return truncated (B,) bool, also at `max_episode_steps`: as Gymnasium's TimeLimit, even in a step that ends in a collision."""
        self._elapsed = np.where(over, 0, self._elapsed + 1)
        late = self._elapsed >= self._limit
        return truncated | late

    def _presence(self) -> dict[str, Array]:
        """Return the rows that have each piece of information: all, in one array that nobody can change."""
        everyone = np.ones(self.num_envs, bool)
        everyone.flags.writeable = False
        return {f"_{key}": everyone for key in (*self._facts, *(("action_mask",) if self._modes else ()))}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state
        self._present = self._presence()  # a copied array can be changed

    def _begin(self, rows: Array) -> None:
        """Return the observation of episodes that have just begun in `rows` (B,) bool: every frame shows their first."""
        if self._frames > 1:
            self.observed = np.where(rows[:, None], framed(self.episodes.seen(), None, self._frames), self.observed)

    def _shown(self) -> Array:
        """Return the observation as its reader's own."""
        return self.episodes.seen() if self._frames == 1 else self.observed.copy()

    def checked(self, actions: Array) -> Array:
        """Return actions of the right shape, kind and size; raise InputError for others."""
        actions = np.asarray(actions)
        shape = self.action_space.shape
        if actions.shape != shape:
            raise InputError("actions", f"shape {actions.shape}", f"shape {shape}")
        if self._modes:
            if actions.dtype == np.int64:  # the usual kind: a number below 0 is among the largest without a sign
                wrong = np.maximum.reduce(actions.view(np.uint64)) >= self._modes
            else:
                wrong = actions.dtype.kind not in "iu" or actions.min() < 0 or actions.max() >= self._modes
            if wrong:
                raise InputError("actions", actions.tolist(), f"whole numbers from 0 to {self._modes - 1}")
        elif not in_box(actions):
            raise InputError("actions", actions.tolist(), "finite numbers in [-1, 1]")
        return actions

    def _info(self, illegal: Array, collided: Array, rear: Array) -> dict[str, Any]:
        info: dict[str, Any] = dict(zip(self._facts, (illegal, collided, rear, *self.episodes.facts()), strict=True))
        if self._modes:
            info["action_mask"] = self.episodes.mask().astype(np.int8)  # as Space.sample(mask) wants it, and the caller's own
        info |= self._present
        return info


class AdversaryEnv(Specified, gymnasium.Env[Array, Any]):
    """One adversary environment; see `Seat.make` for the arguments, `Viewer` for viewer and size."""

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 10}  # noqa: RUF012 - Gymnasium's own annotation

    def __init__(self, *, render_mode: str | None = None, **arguments: Any) -> None:
        without_autoreset(arguments, "a vector environment (make_vec); a single one is reset by its user")
        if arguments.get("device") not in (None, "cpu"):
            raise InputError("device", arguments["device"], "cpu, or a vector environment (make_vec)")
        arguments["device"] = "cpu"  # a card plays many episodes, not one
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError("render_mode", render_mode, "None, 'rgb_array' or 'human'")
        drawn = None if render_mode is None else "rgb_array"
        self.batch = AdversaryVectorEnv(1, render_mode=drawn, autoreset="disabled", **arguments)
        self.render_mode = render_mode
        self.horizon = self.batch.horizon
        self.metadata = self.metadata | {"render_fps": self.batch.metadata["render_fps"]}
        self._alone: TracedEpisodes | None = None  # which steps a single row without a batch between
        self._direct = self.batch.direct and render_mode != "human"
        self._actions, self._over = self.batch._modes, False  # the second: the episode is over
        self._damage = self.batch._facts[-1]
        self._usual = frozenset(range(self._actions))
        self._screen, self._moves = Screen(), 0  # the second: resets and steps so far
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space

    def __repr__(self) -> str:
        return shown(self, self.spec, self.batch.seat)

    @property
    def engine(self) -> str:
        """The engine that plays: traced or plain."""
        return self.batch.engine

    @property
    def engine_why(self) -> str:
        """Why the plain loop plays although nobody asked for it; else empty."""
        return self.batch.engine_why

    def card(self) -> dict[str, Any]:
        """Return JSON data that names this environment completely, with a hash."""
        return self.batch.card()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        check_options(options)
        super().reset(seed=seed)
        if not self.batch.begun and seed is None:
            seed = int(self.np_random.integers(2**31))
        self._over, self._moves = False, self._moves + 1
        if seed is None and self._alone is not None:
            _, damage, step, _, _, illegal, collided, rear, allowed, seen, mask = self._alone.again_alone()
            if self._alone.shadow is not None:
                self._alone.shadow.add(Begun(np.ones(1, bool), None, True))
            return seen, self._told(illegal, collided, rear, allowed, step, damage, mask)
        observation, info = self.batch.reset(seed=seed)
        if self._direct:
            assert isinstance(self.batch.episodes, TracedEpisodes)
            self._alone = self.batch.episodes
        if self.render_mode == "human":
            self.render()
        return observation[0], self.row(info)

    def step(self, action: ArrayLike) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        if self._alone is None:
            return self._step_as_batch(action)
        if self._over:
            raise InputError("step", [0], "an episode that is not over: reset() first")
        if not (type(action) in _WHOLE and action in self._usual):
            action = self.batch.checked(np.asarray(action)[None])[0]
        self._moves += 1
        if (shadow := self._alone.shadow) is not None:
            shadow.add(Decided(np.array(action)[None], _GOES_ON, False))
        reward, damage, step, terminated, truncated, illegal, collided, rear, allowed, seen, mask = self._alone.decide_alone(action)
        self._over = terminated or truncated
        return seen, reward, terminated, truncated, self._told(illegal, collided, rear, allowed, step, damage, mask)

    def _told(self, illegal: bool, collided: bool, rear: bool, allowed: bool, step: int, damage: float, mask: Array) -> dict[str, Any]:
        info: dict[str, Any] = {  # types of a row of the batch's arrays
            "illegal": _BOOL[illegal], "collided": _BOOL[collided], "rear_collided": _BOOL[rear], "allowed": _BOOL[allowed],
            "step": np.int64(step), self._damage: np.float64(damage),
        }  # fmt: skip
        if self._actions:
            info["action_mask"] = mask
        return info

    def _step_as_batch(self, action: ArrayLike) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.batch.step(np.asarray(action)[None])
        self._moves += 1
        if self.render_mode == "human":
            self.render()
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), self.row(info)

    def action_masks(self) -> Array:
        """Return (actions,) bool: the actions that the channel would accept in a step of the next decision. Discrete action spaces only."""
        return np.asarray(self.batch.action_masks()[0])

    def render(self) -> Any:
        """Return the picture (H, W, 3) uint8; in human mode None: reset() and step() show it in a window by themselves."""
        if self.render_mode is None or not self.batch.begun:
            return None
        if self.render_mode == "human":
            return self._screen.show(self._moves, self.metadata["render_fps"], self._picture)
        return self._picture()

    def _picture(self) -> Array:
        frames = self.batch.render()
        assert frames is not None
        return frames[0]

    def close(self) -> None:
        self._screen.close()
        super().close()

    @staticmethod
    def row(info: dict[str, Any], i: int = 0) -> dict[str, Any]:
        """Return the info of row i of a batch's."""
        return {k: v[i].copy() for k, v in info.items() if not k.startswith("_")}


def register_all() -> None:
    """Make the ids known to Gymnasium. Called on import of tailgate."""
    for name, defaults in FACES.items():
        gymnasium.register(
            id=name,
            entry_point="tailgate.envs.gym.gymnasium_env:AdversaryEnv",
            vector_entry_point="tailgate.envs.gym.gymnasium_env:AdversaryVectorEnv",
            order_enforce=True,
            kwargs=dict(defaults),
        )
