"""An attacker who is one of several: each episode draws who."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tailgate.core import Array, Attack, Command, View
from tailgate.core.draws import Draws
from tailgate.core.threat import Brief

TAG = 255  # tag of the draw that picks the attacker: the attacks draw with others


class MixtureState(NamedTuple):
    """Every leaf has B first."""

    member: Array  # (B,) int64
    memories: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Mixture:
    """The uniform mixture of some attacks: the one that an episode draws plays it to its end."""

    attacks: tuple[Attack, ...]

    def prepare(self, brief: Brief) -> tuple[MixtureState, ...]:
        return tuple(attack.prepare(brief) for attack in self.attacks)

    def start(self, plan: tuple[Any, ...], batch: int, draws: Draws) -> MixtureState:
        some = len(self.attacks)
        member = np.minimum((draws.uniform((), TAG) * some).astype(np.int64), some - 1)
        return MixtureState(member, tuple(attack.start(part, batch, draws) for attack, part in zip(self.attacks, plan, strict=True)))

    def decide(self, plan: tuple[Any, ...], state: MixtureState, view: View, draws: Draws) -> tuple[MixtureState, Command]:
        decided = [a.decide(part, held, view, draws) for a, part, held in zip(self.attacks, plan, state.memories, strict=True)]
        kind, target, value = decided[0][1]
        for i, (_, command) in enumerate(decided[1:], 1):
            mine = state.member == i
            wide = mine[:, None, None]
            kind, target = np.where(mine, command.kind, kind), np.where(wide, command.target, target)
            value = np.where(wide, command.value, value)
        return MixtureState(state.member, tuple(memory for memory, _ in decided)), Command(kind, target, value)
