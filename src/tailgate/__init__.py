"""Tailgate: defences for adaptive cruise control, scored against an adversary that learns when to attack.

    import gymnasium
    env = gymnasium.make("tailgate:tailgate/CarFollowing-v0", defence="chi2_kf")
"""

from typing import Any

from tailgate import moved as moved
from tailgate.base import interrupts as interrupts  # first: the imports below take half a second, in which a user may change his mind
from tailgate.base.errors import InputError
from tailgate.base.version import VERSION as __version__
from tailgate.core.registry import entries, make

__all__ = [
    "InputError", "__version__", "evaluate", "list_attacks", "list_defences", "make_attack", "make_defence", "parallel_env", "per_episode",
]  # fmt: skip


def make_defence(name: str, **params: Any) -> Any:
    """A registered defence by name; raises InputError for an unknown name or field."""
    return make("defence", name, **params)


def make_attack(name: str, **params: Any) -> Any:
    """A registered attack by name; raises InputError for an unknown name or field."""
    return make("attack", name, **params)


def list_defences() -> list[str]:
    """Names of every defence, plug-ins included."""
    return list(entries("defence"))


def list_attacks() -> list[str]:
    """Names of every attack, plug-ins included."""
    return list(entries("attack"))


def __getattr__(name: str) -> Any:
    if name == "per_episode":
        from tailgate.estimators import per_episode

        return per_episode
    if name == "evaluate":
        from tailgate.evaluation.cells import evaluate

        return evaluate
    if name == "parallel_env":
        from tailgate.envs.gym.parallel import parallel_env

        return parallel_env
    raise AttributeError(f"module 'tailgate' has no attribute {name!r}")


def _register() -> None:
    from tailgate.envs.gym.gymnasium_env import register_all

    register_all()


_register()
