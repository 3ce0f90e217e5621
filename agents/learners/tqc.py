"""Truncated quantile critics (Kuznetsov et al. 2020) from sb3-contrib (extra: train). Continuous actions only.

Soft actor-critic whose critics predict quantiles of the return; the largest are dropped, against overestimation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

try:
    from sb3_contrib import TQC
except ImportError as error:
    raise ImportError("torch or sb3-contrib is missing: pip install 'tailgate[train]'") from error

from tailgate.agents.learners import sac
from tailgate.agents.learners.exploring import Exploring
from tailgate.base.errors import InputError
from tailgate.base.sizes import Width
from tailgate.core import Count, param
from tailgate.core.registry import register


@dataclass(frozen=True)
class Config(sac.Config):
    """Hyper-parameters: those of soft actor-critic, and the quantiles."""

    name: ClassVar[str] = "tqc"

    quantiles: Width = param(10, "quantiles that each of the two critics predicts")
    drop: Count = param(1, "largest quantiles per critic that a target leaves out")

    def check(self) -> None:
        super().check()
        if self.drop >= self.quantiles:
            raise InputError(f"{self.name}.drop", self.drop, f"fewer than the quantiles ({self.quantiles})")


class _TQC(Exploring, TQC):
    """Rests more often than not before it learns."""


@register("learner", "tqc")
class Learner(sac.Learner):
    """One training run of one seed."""

    name = "tqc"
    packages = ("torch", "stable-baselines3", "sb3-contrib")
    algorithm: ClassVar[Any] = _TQC
    config: Config

    def architecture(self) -> dict[str, Any]:
        return {"n_quantiles": self.config.quantiles}

    def arguments(self) -> dict[str, Any]:
        return super().arguments() | {"top_quantiles_to_drop_per_net": self.config.drop}
