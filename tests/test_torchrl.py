"""TorchRL's environment: its specs, rollouts with resets, and the values of the tensors below it."""

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import pytest

from tailgate.base.errors import InputError

from .card import HostCard, host_card, needs_compiler
from .engines import short

torch = pytest.importorskip("torch")
if find_spec("torchrl") is None:
    pytest.skip("no torchrl", allow_module_level=True)

__all__ = ["host_card"]
FOLLOWING = {"scenario": "gusty-stop-and-go-v0", "defence": "chi2_kf"}


@pytest.fixture(scope="module")
def made() -> Callable[..., Any]:
    """Return the class of the environment; its library takes seconds to import, in the process that plays these tests alone."""
    from tailgate.envs.torch import TailgateEnv

    return TailgateEnv


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=needs_compiler)])
@pytest.mark.parametrize("action", ["mode", "continuous"])
def test_specs(action: str, device: str, host_card: HostCard, made: Callable[..., Any]) -> None:
    from torchrl.envs.utils import check_env_specs

    check_env_specs(made(8, device=device, action=action, **FOLLOWING))


def test_rollouts_reset_what_is_done(tmp_path: Any, made: Callable[..., Any]) -> None:
    from tailgate.envs.torch import TensorVecEnv

    place = tmp_path / "short.yaml"
    place.write_text(short("gusty-stop-and-go-v0"))
    arguments = FOLLOWING | {"scenario": str(place), "action": "mode"}
    env = made(8, **arguments)
    env.set_seed(3)
    torch.manual_seed(0)
    found = env.rollout(150, break_when_any_done=False)
    assert found["next", "done"].sum() >= 16 and found.batch_size == (8, 150)
    plain = TensorVecEnv(8, autoreset="disabled", **arguments)
    observation, _ = plain.reset(seed=3)
    for t in range(150):
        torch.testing.assert_close(found["observation"][:, t], observation, rtol=0, atol=0)
        observation, reward, terminated, truncated, _ = plain.step(found["action"][:, t])
        torch.testing.assert_close(found["next", "reward"][:, t, 0], reward.float(), rtol=0, atol=0)
        over = terminated | truncated
        assert torch.equal(found["next", "done"][:, t, 0], over)
        if over.any():
            observation, _ = plain.reset(mask=over)


def test_what_it_refuses(made: Callable[..., Any]) -> None:
    with pytest.raises(InputError, match="autoreset"):
        made(8, autoreset="same_step", **FOLLOWING)


def test_a_seed_counts_although_the_reset_names_all_rows(made: Callable[..., Any]) -> None:
    """TorchRL's own loops give a mask with every reset."""
    env, fresh = (made(4, "tailgate/CarFollowing-v1") for _ in range(2))
    begun = env.reset()
    for one in (env, fresh):
        one.set_seed(9)
    begun["_reset"] = torch.ones(4, 1, dtype=torch.bool)
    assert torch.equal(env.reset(begun)["observation"], fresh.reset()["observation"])
