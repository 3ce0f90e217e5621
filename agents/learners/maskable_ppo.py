"""PPO that never chooses what the channel would refuse (Huang and Ontanon 2022), from sb3-contrib (extra: train).

The masks are those of `ActionCodec.mask`: rest always, every attack where budget, burst, cooldown, onset and end allow one in some step
of the decision. The exported policy chooses under the same masks. Discrete actions only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

try:
    from sb3_contrib import MaskablePPO
except ImportError as error:
    raise ImportError("torch or sb3-contrib is missing: pip install 'tailgate[train]'") from error

from tailgate.agents.learners import ppo
from tailgate.agents.learners.learning import DISCRETE
from tailgate.core.registry import register


@dataclass(frozen=True)
class Config(ppo.Config):
    """Hyper-parameters: those of PPO."""

    name: ClassVar[str] = "maskable_ppo"


@register("learner", "maskable_ppo")
class Learner(ppo.Learner):
    """One training run of one seed."""

    name = "maskable_ppo"
    actions = DISCRETE
    packages = ("torch", "stable-baselines3", "sb3-contrib")
    algorithm: ClassVar[Any] = MaskablePPO
    traits: ClassVar[dict[str, bool]] = {"masked": True}
