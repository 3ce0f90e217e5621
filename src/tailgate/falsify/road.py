"""The start of an episode as a vector: the draws of the initial state and of the leader's manoeuvre, chosen instead of drawn.

A number u in (0, 1) is a quantile of a draw's distribution. So every choice lies within the scenario's distribution, and equal volumes
of the unit cube are equally likely. Later draws, such as the sensors' noise, belong to the episode's number, as always.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from tailgate.base.errors import InputError
from tailgate.core import Array
from tailgate.core.draws import Draws, Keys, Role
from tailgate.core.loop import START, Loop

ROLES = (Role.PRIOR, Role.MANOEUVRE)
EDGE = 1e-3  # quantiles that a search leaves out at either end
Numbers = Mapping[tuple[int, str, int], Array]  # role, law, tag -> (B, *shape)


class Slot(NamedTuple):
    """A draw at the start of an episode."""

    role: int
    law: str
    tag: int
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """The count of its numbers."""
        return math.prod(self.shape)


class Given:
    """One role's draws at one step, by choice."""

    def __init__(self, base: Draws, numbers: Numbers) -> None:
        self.key, self.episode, self.step, self.stream = base
        self._base, self._numbers = base, numbers

    def _of(self, law: str, shape: tuple[int, ...], tag: int) -> Array:
        held = self._numbers.get((self.stream, law, tag))
        return getattr(self._base, law)(shape, tag) if held is None else held.reshape(len(self.key), *shape)

    def normal(self, shape: tuple[int, ...] = (), tag: int = 0) -> Array:
        """Return the chosen standard normals (B, *shape)."""
        return self._of("normal", shape, tag)

    def uniform(self, shape: tuple[int, ...] = (), tag: int = 0) -> Array:
        """Return the chosen numbers in (0, 1), (B, *shape)."""
        return self._of("uniform", shape, tag)


class Steered(Keys):
    """Keys whose draws at the start are chosen; all later draws are those of the keys."""

    numbers: Numbers = {}  # noqa: RUF012

    @staticmethod
    def of(keys: Keys, numbers: Numbers) -> Steered:
        """Return keys with these draws at the start."""
        out = Steered(*keys)
        out.numbers = numbers
        return out

    def at(self, role: Role, step: Array) -> Draws:
        """Return the draws of one role at each row's own step (B,)."""
        base = super().at(role, step)
        chosen = role in ROLES and self.numbers and bool(np.all(np.asarray(step) == START))
        return Given(base, self.numbers) if chosen else base  # type: ignore[return-value]


class _Listening(Given):
    """Draws that note which numbers are asked for."""

    def __init__(self, base: Draws, heard: dict[Slot, None]) -> None:
        super().__init__(base, {})
        self._heard = heard

    def _of(self, law: str, shape: tuple[int, ...], tag: int) -> Array:
        self._heard[Slot(self.stream, law, tag, tuple(shape))] = None
        return super()._of(law, shape, tag)


class Overheard(Keys):
    """Keys that note the draws of the start and of each later step."""

    start: dict[Slot, None]
    later: dict[Slot, None]

    @staticmethod
    def of(keys: Keys) -> Overheard:
        """Return the same keys, with nothing noted so far."""
        out = Overheard(*keys)
        out.start, out.later = {}, {}
        return out

    def at(self, role: Role, step: Array) -> Draws:
        """Return the draws of one role at each row's own step (B,)."""
        heard = self.start if bool(np.all(np.asarray(step) == START)) else self.later
        return _Listening(super().at(role, step), heard)  # type: ignore[return-value]


def slots_of(loop: Loop) -> tuple[Slot, ...]:
    """Return the draws of a road at the start of an episode: those of the plant and of the manoeuvre."""
    keys, step = Overheard.of(Keys(np.zeros((1, 3), np.uint64), np.zeros(1, np.uint32))), np.full(1, START)
    loop.plant.start(loop.plan.plant, keys.at(Role.PRIOR, step))  # and not the prior: what a defence believes at first is chance
    loop.manoeuvre.start(loop.plan.manoeuvre, keys.at(Role.MANOEUVRE, step))
    return tuple(keys.start)


def numbers_of(slots: Sequence[Slot], genes: Array) -> Numbers:
    """Return the draws of genes (B, D) in [0, 1], in the order of the slots."""
    u, out, at = EDGE + (1.0 - 2.0 * EDGE) * genes, {}, 0
    for slot in slots:
        some = u[:, at : at + slot.size].reshape(len(u), *slot.shape)
        out[slot.role, slot.law, slot.tag] = np.asarray(ndtri(some) if slot.law == "normal" else some)
        at += slot.size
    return out


def as_data(numbers: Numbers, row: int) -> list[dict[str, object]]:
    """Return the draws of a row as JSON data."""
    return [
        {"role": Role(role).name.lower(), "law": law, "tag": tag, "values": held[row].ravel().tolist()}
        for (role, law, tag), held in numbers.items()
    ]


def from_data(slots: Sequence[Slot], data: object, where: str) -> Numbers:
    """Return the draws (1, *shape) that JSON data name, checked against the loop's.

    Raises
    ------
    InputError
        If these are not the draws of the loop's start, or a number cannot come from its distribution.
    """
    held = data if isinstance(data, list) else None
    if held is None or len(held) not in (0, len(slots)):
        raise InputError(where, data, f"the {len(slots)} draws of a start")
    out = {}
    for slot, one in zip(slots, held, strict=False):
        name = Role(slot.role).name.lower()
        same = isinstance(one, dict) and (one.get("role"), one.get("law"), one.get("tag")) == (name, slot.law, slot.tag)
        values = one.get("values") if same else None
        if not isinstance(values, list) or len(values) != slot.size or not all(_possible(slot.law, value) for value in values):
            raise InputError(where, one, f"role {name}, law {slot.law}, tag {slot.tag} with {slot.size} values of that law")
        out[slot.role, slot.law, slot.tag] = np.array(values, float).reshape(1, *slot.shape)
    return out


def _possible(law: str, value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return False
    return 0.0 < value < 1.0 if law == "uniform" else abs(value) < 40.0
