"""The noise of a loop with a mean: every standard normal that the world draws in a step, shifted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tailgate.core import Array, Attack
from tailgate.core.draws import Draws, Keys, Role, first_episodes
from tailgate.core.loop import START, Loop
from tailgate.falsify.claim import Invariant
from tailgate.falsify.road import Given, Overheard, Slot
from tailgate.play.trace import rollout

WORLD = 16  # roles below are the world's; the draws of attacks and defences are not shifted


class Drawn(Given):
    """One role's draws at one step: the normals times a size, plus a mean, noted as they are drawn."""

    def __init__(self, base: Draws, keys: Shifted, k: int) -> None:
        super().__init__(base, {})
        self._keys, self._k = keys, k

    def _of(self, law: str, shape: tuple[int, ...], tag: int) -> Array:
        drawn, keys = super()._of(law, shape, tag), self._keys
        if law != "normal":
            return drawn if keys.size else np.full_like(drawn, 0.5)
        place = keys.places.get((self.stream, tag))
        if self._k < 0 or place is None:  # at the start: chance alone
            return drawn * keys.size
        noise = keys.mean[:, self._k, place].reshape(drawn.shape) + keys.size * drawn
        keys.noise[:, self._k, place] = noise.reshape(len(noise), -1)
        return noise


class Shifted(Keys):
    """Keys whose normal draws get a mean (B, K, d). The draws of step k are those that its state and measurement depend on."""

    mean: Array
    noise: Array
    size: float
    places: dict[tuple[int, int], slice]

    @staticmethod
    def of(keys: Keys, slots: Sequence[Slot], mean: Array, size: float) -> Shifted:
        """Return keys with this mean, in the order of the slots."""
        out, at = Shifted(*keys), 0
        out.mean, out.size, out.places = mean, size, {}
        idle = Keys(*keys).at(Role.POLICY, np.zeros(len(mean), np.int64))  # for what nobody draws: noise without effect
        out.noise = mean + size * idle.normal(mean.shape[1:])
        for slot in slots:
            out.places[slot.role, slot.tag] = slice(at, at + slot.size)
            at += slot.size
        return out

    def at(self, role: Role, step: Array) -> Draws:
        """Return the draws of one role at each row's own step (B,), which is the same in all."""
        base, k = super().at(role, step), int(step[0])
        if role >= WORLD:
            return base
        index = -1 if k == START else k
        return Drawn(base, self, index if index < self.mean.shape[1] else -1)  # type: ignore[return-value]


def noise_of(loop: Loop) -> tuple[Slot, ...]:
    """Return the normals that the world draws in a step."""
    keys = Overheard.of(Keys(np.zeros((1, 3), np.uint64), np.zeros(1, np.uint32)))
    from tailgate.core import no_command

    loop.advance(loop.start(keys), no_command(1, loop.model.agents, len(loop.model.wires)))
    return tuple(slot for slot in keys.later if slot.law == "normal" and slot.role < WORLD)


class NoisyLoop:
    """A loop as a process with normal noise: the least margin of an invariant, and the noise that was drawn."""

    def __init__(self, loop: Loop, attack: Attack, invariant: Invariant, at_once: int) -> None:
        self.loop, self.attack, self.invariant, self.at_once = loop, attack, invariant, at_once
        self.slots = noise_of(loop)
        self.width = sum(slot.size for slot in self.slots)
        self.steps = loop.horizon + 1  # step 0 leads to the first measurement

    def __call__(self, mean: Array, keys: Array, size: float) -> tuple[Array, Array]:
        """Return least margins (B,) and noise (B, K, d); see `tailgate.falsify.likeliest.Noisy`."""
        margins, noises = [], []
        for first in range(0, len(keys), self.at_once):
            part = slice(first, first + self.at_once)
            held = Keys(keys[part], first_episodes("report", len(keys[part])))
            shifted = Shifted.of(held, self.slots, mean[part], size)
            trace = rollout(self.loop, self.attack, shifted, plain=True)
            margins.append(self.invariant.margins(trace, self.loop.horizon).min(axis=0))
            noises.append(shifted.noise)
        return np.concatenate(margins), np.concatenate(noises)
