"""The batched environment with tensors of PyTorch (extra: train), on the processor or on a card.

On the processor tensors share the memory of the engine's results. On a card everything stays there: actions are read where they are, and
the engine writes into memory that PyTorch has taken. The engine's work is queued on PyTorch's present stream.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

try:
    import torch
except ImportError as error:
    raise ImportError("PyTorch is missing: pip install 'tailgate[train]'") from error

from tailgate.base.errors import InputError, unknown
from tailgate.engine.cards import Card
from tailgate.engine.on_device import CudaProgram, DeviceCall
from tailgate.envs.gym.attacker_mdp import CAR_FOLLOWING, FACES
from tailgate.envs.gym.batches import TracedEpisodes
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.envs.gym.specs import ROUNDING

Tensor = torch.Tensor
Tensors = dict[str, Any]  # by name; the last step's under same_step may hold such a mapping
Step = tuple[Tensor, Tensor, Tensor, Tensor, Tensors]


class TensorVecEnv:
    """`num_envs` environments of `AdversaryVectorEnv` with its arguments, values, seeds and autoreset; tensors in place of arrays.

    Results are never overwritten: results that are kept keep their values. id: its defaults hold for what `arguments` leaves open.
    """

    def __init__(self, num_envs: int, id: str = CAR_FOLLOWING, *, device: str | None = None, **arguments: Any) -> None:
        if id not in FACES:
            raise unknown("id", id, FACES)
        if "render_mode" in arguments and device not in (None, "cpu"):
            raise InputError("render_mode", arguments["render_mode"], "the device cpu")
        self.env = AdversaryVectorEnv(num_envs, device=device, **(FACES[id] | arguments))
        self.num_envs, self.horizon = num_envs, self.env.horizon
        self.single_observation_space = self.env.single_observation_space
        self.single_action_space = self.env.single_action_space
        self.autoreset_mode: AutoresetMode = self.env.autoreset_mode
        self._there: _OnCard | None = None
        self.device = torch.device("cpu")
        if self.env.device != "cpu":
            assert isinstance(self.env.episodes, TracedEpisodes)
            program = self.env.episodes.programs.decide
            assert isinstance(program, CudaProgram)
            self.device = torch.device(program.card.tensors)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.env!r}, device={str(self.device)!r})"

    def card(self) -> dict[str, Any]:
        """Return JSON data that names this environment completely, with a hash."""
        return self.env.card()

    def reset(self, *, seed: int | Sequence[int | None] | None = None, mask: Tensor | None = None) -> tuple[Tensor, Tensors]:
        """Begin episodes: seed s, or one per row; with a mask (B,) bool in these rows only. Returns observations and information."""
        if self._there is not None:
            self._there.tell(self.env)
        options = None if mask is None else {"reset_mask": mask.cpu().numpy()}
        observation, info = self.env.reset(seed=seed if seed is None or isinstance(seed, int) else list(seed), options=options)
        if self.device.type == "cpu" and self.env.device == "cpu":
            return _tensor(observation), _tensors(info)
        if self._there is None:
            self._there = _OnCard(self.env, self.device)
        self._there.take(self.env, observation)
        return _tensor(observation).to(self.device), {name: value.to(self.device) for name, value in _tensors(info).items()}

    def step(self, actions: Tensor) -> Step:
        """Play actions (B,) of discrete spaces, or (B, size); return observations, rewards, both ends, and information.

        Rewards are float64. With same_step the information of rows that end has `final_obs`, as Gymnasium gives it.
        """
        if self._there is not None:
            return self._there.step(self._checked(actions))
        observation, reward, terminated, truncated, info = self.env.step(actions.detach().cpu().numpy())
        return _tensor(observation), _tensor(reward), _tensor(terminated), _tensor(truncated), _tensors(info)

    def action_masks(self) -> Tensor:
        """Return (B, actions) bool: the actions that the channel would accept in a step of the next decision."""
        if self._there is not None:
            return self._there.mask.clone()
        return _tensor(self.env.action_masks())

    def _checked(self, actions: Tensor) -> Tensor:
        """Return actions of the right shape and kind, on the card. Numbers are checked there, by the bounds of the space."""
        shape = self.env.action_space.shape
        if tuple(actions.shape) != shape:
            raise InputError("actions", f"shape {tuple(actions.shape)}", f"shape {shape}")
        actions = actions.detach().to(self.device)
        if isinstance(self.single_action_space, gymnasium.spaces.Discrete):
            n = int(self.single_action_space.n)
            fits, wanted = not actions.is_floating_point() and actions.dtype != torch.bool, f"whole numbers from 0 to {n - 1}"
            fits = fits and bool(((actions >= 0) & (actions < n)).all())
        else:
            fits = actions.dtype != torch.bool and bool((actions.abs() <= 1.0 + ROUNDING).all())
            wanted = "finite numbers in [-1, 1]"
        if not fits:
            raise InputError("actions", actions.flatten()[:20].tolist(), wanted)
        return actions

    def close(self) -> None:
        """Give back what the environments hold."""
        self.env.close()
        self._there = None


def _tensor(held: Any) -> Tensor:
    """Return an array as a tensor of the same memory, or of a copy where nobody may write to it."""
    array = np.asarray(held)
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def _tensors(info: dict[str, Any]) -> Tensors:
    """Return information as tensors. Presences, which hold for all rows, are left out, those of final values apart."""
    out: Tensors = {}
    for name, value in info.items():
        if not name.startswith("_") or name in ("_final_obs", "_final_info"):
            out[name] = _tensors(value) if isinstance(value, dict) else _tensor(value)
    return out


class _Place(NamedTuple):
    """The place of a result on a sheet: its first byte, shape, type, and distances [numbers]."""

    at: int
    shape: tuple[int, ...]
    dtype: torch.dtype
    strides: tuple[int, ...]


class _OnCard:
    """The decisions of a batch on a card; what is over and observed is there too."""

    def __init__(self, env: AdversaryVectorEnv, device: torch.device) -> None:
        assert isinstance(env.episodes, TracedEpisodes) and env.episodes.rows is not None
        rows = self._rows = env.episodes.rows
        programs, self.env, self.device, self.batch = rows.programs, env, device, env.num_envs
        self.card: Card = programs.decide.card  # type: ignore[attr-defined]
        whole = rows.state.blocks * programs.decide.lanes
        made: DeviceCall = programs.decide.call(rows.state, values=programs.values)  # type: ignore[assignment]
        self._decide = made
        self._advance: DeviceCall | None = None
        if programs.advance is not None and programs.between:
            self._advance = programs.advance.call(rows.state, programs.between, programs.values, like=made)  # type: ignore[assignment]
        self._begin: DeviceCall = programs.begin.call(rows.state, values=programs.values)  # type: ignore[assignment]
        self._given = {name: self._taken(whole, held) for name, held in made.arguments.items()}
        self._again = torch.zeros(whole, dtype=torch.bool, device=device)
        addresses = {name: held.data_ptr() for name, held in self._given.items()}
        for call in (self._decide, self._advance):
            if call is not None:
                call.arguments_at = addresses
        self._begin.arguments_at = {"again": self._again.data_ptr()}
        self._places = {call: _places(call) for call in (self._decide, self._begin)}
        self.over = torch.zeros(self.batch, dtype=torch.bool, device=device)
        self.observed = torch.zeros(0)
        self.mask = torch.zeros(0)
        self._elapsed = torch.zeros(self.batch, dtype=torch.int64, device=device)
        self._step = torch.zeros(0)  # of each episode, before a decision

    def _taken(self, rows: int, like: Any) -> Tensor:
        return torch.zeros((rows, *like.shape[1:]), dtype=_type(like.dtype), device=self.device)

    def take(self, env: AdversaryVectorEnv, observation: Any) -> None:
        """Take over from a reset."""
        self.over = torch.from_numpy(env.over.copy()).to(self.device)
        self.observed = torch.from_numpy(observation.copy()).to(self.device)
        self._elapsed = torch.from_numpy(env._elapsed.copy()).to(self.device)
        brought = self._rows.brought
        self._step = torch.from_numpy(brought["k"].copy()).to(self.device)
        if "mask" in brought:
            self.mask = torch.from_numpy(brought["mask"].copy()).to(self.device)

    def tell(self, env: AdversaryVectorEnv) -> None:
        """Tell the environment what it has to know for a reset."""
        env.over = self.over.cpu().numpy()
        env._elapsed = self._elapsed.cpu().numpy()
        if env._frames > 1:
            env.observed = self.observed.cpu().numpy()

    def _played(self, call: DeviceCall) -> dict[str, Tensor]:
        """Play all steps of a call; return its results, in new memory."""
        if self.device.type == "cuda":
            self.card.stream = torch.cuda.current_stream(self.device).cuda_stream
        sheet = torch.empty(max(1, call.size), dtype=torch.uint8, device=self.device)
        call.sheet_at = sheet.data_ptr()
        call.begin()
        call.play(call.steps)
        results = {name: _read(sheet, place) for name, place in (self._places.get(call) or _places(call)).items()}
        if call.broken and not bool(results["demands"].all()):
            demands = results["demands"].reshape(call.steps, self.batch, -1).cpu().numpy()
            late = self._rows.programs.between if call is self._decide else 0
            for step in np.flatnonzero(~demands.all(axis=(1, 2))):
                raise call.program.broken(demands[step], self._step.cpu().numpy() + step + late)
        return results

    def step(self, actions: Tensor) -> Step:
        """Play a decision, as `AdversaryVectorEnv.step` does."""
        env, over, given, n = self.env, self.over, self._given, self.batch
        resets = env.autoreset_mode == AutoresetMode.NEXT_STEP
        if env.autoreset_mode == AutoresetMode.DISABLED and bool(over.any()):
            wanted = "rows that are over to be reset with a mask first"
            raise InputError("step", torch.nonzero(over).flatten().tolist(), wanted)
        given["action"][:n], given["over"][:n] = actions, over
        given["again"][:n] = over if resets else False
        if self._advance is not None:
            self._played(self._advance)
        found = self._played(self._decide)
        terminated, truncated = found["terminated"], found["truncated"]
        if env._limit:
            self._elapsed = torch.where(over, 0, self._elapsed + 1)
            truncated = truncated | (self._elapsed >= env._limit)
        happened = {name: found[name] for name in ("illegal", "collided", "rear_collided")}
        self.over = terminated | truncated
        observation = self._seen(found, over if resets else None)
        info = self._info(happened, found)
        if env.autoreset_mode == AutoresetMode.SAME_STEP:
            done, final = self.over, observation
            self._again[:n] = done
            fresh = self._played(self._begin)
            observation = self._seen(fresh, done, keep=True)
            final_info = info
            info = self._info(happened, fresh)
            if bool(done.any()):
                info |= {"final_obs": final, "_final_obs": done, "final_info": final_info, "_final_info": done}
            self.over = torch.zeros_like(done)
            self._elapsed = torch.where(done, 0, self._elapsed)
        return observation, found["reward"], terminated, truncated, info

    def _seen(self, found: dict[str, Tensor], begun: Tensor | None, keep: bool = False) -> Tensor:
        """Return the observation; of several frames the present one on top of earlier ones, and the first of rows that have begun.

        keep: the other rows are as they were.
        """
        now, frames = found["seen"], self.env._frames
        if frames > 1:
            old = self.observed if keep else torch.cat([now, self.observed[:, : -now.shape[1]]], dim=1)
            now = old if begun is None else torch.where(begun[:, None], now.repeat(1, frames), old)
        self.observed = now
        self._step = found["k"]
        if "mask" in found:
            self.mask = found["mask"]
        return now

    def _info(self, happened: dict[str, Tensor], found: dict[str, Tensor]) -> Tensors:
        info: Tensors = happened | {"allowed": found["allowed"], "step": found["k"], self.env._facts[-1]: found["damage"]}
        return info | ({"action_mask": found["mask"].to(torch.int8)} if self.env._modes else {})


def _type(dtype: np.dtype[Any]) -> torch.dtype:
    return torch.from_numpy(np.zeros(1, dtype)).dtype


def _places(call: DeviceCall) -> dict[str, _Place]:
    """Return where a call's results stand."""
    return {
        name: _Place(at, shape, _type(dtype), tuple(s // dtype.itemsize for s in strides))
        for name, (shape, dtype, at, strides) in call.places().items()
    }


def _read(sheet: Tensor, place: _Place) -> Tensor:
    """Return a result as a view of its sheet."""
    size = place.dtype.itemsize
    whole = sheet[place.at :]
    return whole[: whole.numel() // size * size].view(place.dtype).as_strided(place.shape, place.strides)
