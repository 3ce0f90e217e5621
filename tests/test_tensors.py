"""Tensors in place of arrays: the values of make_vec, on the processor and, with this processor in its place, on a card."""

import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv

from .card import HostCard, host_card, needs_compiler
from .engines import short

torch = pytest.importorskip("torch")
from tailgate.envs.torch import TensorVecEnv  # noqa: E402

__all__ = ["host_card"]
FOLLOWING = {"scenario": "gusty-stop-and-go-v0", "defence": "chi2_kf", "action": "mode"}
KINDS: dict[str, dict[str, Any]] = {
    "next_step": {},
    "same_step": {"autoreset": "same_step"},
    "several steps": {"interval": 4, "autoreset": "same_step"},
    "frames": {"frames": 3},
    "frames, same_step": {"frames": 2, "autoreset": "same_step", "interval": 2},
    "limit": {"max_episode_steps": 17},
    "limit, same_step": {"max_episode_steps": 17, "autoreset": "same_step", "frames": 2},
    "values": {"action": "continuous"},
}


def alike(one: Any, two: Any) -> None:
    """A tensor, or a mapping of them, equals arrays."""
    if isinstance(one, dict):
        assert set(one) == {name for name in two if not name.startswith("_") or name in ("_final_obs", "_final_info")}
        for name, value in one.items():
            alike(value, two[name])
        return
    got = one.numpy()
    assert got.dtype == np.asarray(two).dtype and np.array_equal(got, two)


@pytest.mark.thin(4)
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=needs_compiler)])
@pytest.mark.parametrize("kind", KINDS)
def test_values_are_those_of_make_vec(kind: str, device: str, tmp_path: Any, host_card: HostCard) -> None:
    place = tmp_path / "short.yaml"
    place.write_text(short("gusty-stop-and-go-v0"))
    arguments = FOLLOWING | {"scenario": str(place)} | KINDS[kind]
    one, two = TensorVecEnv(37, device=device, **arguments), AdversaryVectorEnv(37, **arguments)
    assert one.env.device == device and (one.num_envs, one.autoreset_mode) == (37, two.autoreset_mode)
    for first, second in zip(one.reset(seed=3), two.reset(seed=3), strict=True):
        alike(first, second)
    chance, ended, kept = np.random.default_rng(0), 0, []
    for turn in range(130):
        if one.env.seat.action.discrete:
            actions = np.where(chance.random(37) < 0.6, 0, chance.integers(0, one.env.seat.action.size, 37))
        else:
            actions = chance.uniform(-1.0, 1.0, (37, one.env.seat.action.size)).astype(np.float32)
        got, wanted = one.step(torch.from_numpy(actions)), two.step(actions)
        for first, second in zip(got, wanted, strict=True):
            alike(first, second)
        kept.append((got[0], wanted[0].copy()))
        ended += int(got[2].sum() + got[3].sum())
        if one.env.seat.action.discrete:
            alike(one.action_masks(), two.action_masks())
        if turn == 40:
            mask = np.arange(37) % 3 == 0
            seeds = [int(i) if here and i % 2 == 0 else None for i, here in enumerate(mask)]
            for first, second in zip(one.reset(seed=seeds, mask=torch.from_numpy(mask)), two.reset(seed=seeds, options={"reset_mask": mask}), strict=True):
                alike(first, second)
    assert ended >= 37
    for first, second in kept:  # nothing is written twice
        alike(first, second)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=needs_compiler)])
def test_actions_that_are_refused(device: str, host_card: HostCard) -> None:
    env = TensorVecEnv(4, device=device, **FOLLOWING)
    env.reset(seed=0)
    for wrong in (torch.zeros(3, dtype=torch.int64), torch.full((4,), env.single_action_space.n), torch.full((4,), -1), torch.zeros(4)):
        with pytest.raises(InputError, match="actions"):
            env.step(wrong)
    box = TensorVecEnv(2, device=device, **(FOLLOWING | {"action": "continuous"}))
    box.reset(seed=0)
    size = box.single_action_space.shape
    box.step(torch.full((2, *size), 1.0 + 1e-7))
    for wrong in (torch.full((2, *size), 1.5), torch.full((2, *size), torch.nan)):
        with pytest.raises(InputError, match=r"actions: got .* finite numbers"):
            box.step(wrong)
    with pytest.raises(InputError, match="id: got 'nothing'"):
        TensorVecEnv(4, "nothing")


def test_nothing_is_copied(host_card: HostCard) -> None:
    """On the processor tensors share the engine's memory; on a card nothing but the flag of demands leaves it."""
    env = TensorVecEnv(64, **FOLLOWING)
    env.reset(seed=0)
    observation, *_ = env.step(torch.zeros(64, dtype=torch.int64))
    sheet = env.env.episodes.rows._decide.sheet
    assert sheet.ctypes.data <= observation.data_ptr() < sheet.ctypes.data + sheet.nbytes


@pytest.mark.long
@needs_compiler
def test_the_example_trains(host_card: HostCard, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """PPO in one file, on either device: the same lines but for the time."""
    lines, threads = [], torch.get_num_threads()
    for device in ("cpu", "cuda"):
        words = ["--device", device, "--envs", "64", "--rollout", "40", "--steps", "7680", "--epochs", "1"]
        monkeypatch.setattr(sys, "argv", ["ppo_on_device.py", *words])
        torch.set_num_threads(1)
        runpy.run_path(str(Path(__file__).parents[1] / "examples" / "ppo_on_device.py"))
        lines.append([line.split("steps/s")[1] for line in capsys.readouterr().out.splitlines()])
    torch.set_num_threads(threads)
    assert lines[0] == lines[1] and len(lines[0]) > 0 and host_card.launches > 0


@pytest.mark.long
def test_the_example_of_one_file_learns(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    threads = torch.get_num_threads()
    monkeypatch.setattr(sys, "argv", ["ppo_one_file.py"])
    runpy.run_path(str(Path(__file__).parents[1] / "examples" / "ppo_one_file.py"))
    torch.set_num_threads(threads)
    shares = [float(line.split("collisions in")[1].split("%")[0]) for line in capsys.readouterr().out.splitlines()]
    assert shares[0] < 20.0 < shares[-1]


@needs_compiler
def test_nothing_leaves_the_card(host_card: HostCard, monkeypatch: pytest.MonkeyPatch) -> None:
    env = TensorVecEnv(64, device="cuda", **FOLLOWING)
    env.reset(seed=0)
    env.step(torch.zeros(64, dtype=torch.int64))
    moved: list[int] = []
    monkeypatch.setattr(host_card, "send", lambda at, held: moved.append(held.nbytes))
    fetch = HostCard.fetch
    monkeypatch.setattr(host_card, "fetch", lambda held, at: (moved.append(held.nbytes), fetch(host_card, held, at)))
    env.step(torch.zeros(64, dtype=torch.int64))
    assert sum(moved) <= 8
