"""Laws of the values that are injected, the same for scripts and for programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.agents.scripts.triggers import part
from tailgate.base.errors import InputError, unknown
from tailgate.core import Array, Finite, NonNegative, Positive, param
from tailgate.core.draws import Draws
from tailgate.core.threat import Brief

TAGS = 4  # tags that one law may draw under
HalfInteger = Annotated[float, Field(gt=0, le=50, multiple_of=0.5)]


class Law(Protocol):
    """A law of the values that are sent."""

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        """Return values that broadcast to (B, N, w), `count` (B,) steps after the attack began; it draws under the tags from `tag` on."""


def _wires(brief: Brief) -> tuple[int, int]:
    return brief.model.agents, len(brief.model.wires)


@dataclass(frozen=True)
class Constant:
    """Always the same value."""

    value: Finite = param(-4.0, "value [unit of the wire]")

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        return np.full((len(count), 1, 1), self.value)


@dataclass(frozen=True)
class Uniform:
    """Uniform random values, independent in every step and on every wire."""

    low: Finite = param(-10.0, "smallest value [unit of the wire]")
    high: Finite = param(10.0, "largest value [unit of the wire]")

    def __post_init__(self) -> None:
        if self.low > self.high:
            raise InputError("low", self.low, f"at most high ({self.high})")

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        return np.asarray(self.low + (self.high - self.low) * draws.uniform(_wires(brief), tag))


@dataclass(frozen=True)
class Gaussian:
    """Gaussian random values, independent in every step and on every wire."""

    mean: Finite = param(0.0, "mean [unit of the wire]")
    sd: NonNegative = param(10.0, "standard deviation [unit of the wire]")

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        return np.asarray(self.mean + self.sd * draws.normal(_wires(brief), tag))


@dataclass(frozen=True)
class Ramp:
    """Grows by the same amount every step, up to a limit."""

    base: Finite = param(0.0, "value before the first growth [unit of the wire]")
    rate: Finite = param(-0.3, "growth a step [unit of the wire]")
    limit: NonNegative = param(50.0, "largest |value| [unit of the wire]")

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        return np.asarray(np.clip(self.base + self.rate * (count + 1), -self.limit, self.limit))[:, None, None]


@dataclass(frozen=True)
class Gamma:
    """Gamma distributed magnitudes, independent in every step and on every wire: mean shape * scale, variance shape * scale^2.

    The shape is a multiple of 1/2, for which the variate is exact: Gamma(n + 1/2, 1) = -log u_1 - ... - log u_n + z^2 / 2.
    """

    shape: HalfInteger = param(2.0, "shape, a multiple of 1/2 [-]")
    scale: Positive = param(2.0, "scale [unit of the wire]")
    sign: Literal[-1, 0, 1] = param(-1, "sign of the values; 0: either with probability 1/2")

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        whole = int(self.shape)
        total = num.zeros((len(count), *_wires(brief)))
        if whole:
            u = draws.uniform((whole, *_wires(brief)), tag)
            for i in range(whole):
                total = total - num.log(u[:, i])
        if whole != self.shape:
            z = draws.normal(_wires(brief), tag + 1)
            total = total + 0.5 * z * z
        sign = np.where(draws.uniform(_wires(brief), tag + 2) < 0.5, -1.0, 1.0) if self.sign == 0 else float(self.sign)
        return np.asarray(sign * (self.scale * total))


LAWS: dict[str, type[Any]] = {"constant": Constant, "uniform": Uniform, "gaussian": Gaussian, "ramp": Ramp, "gamma": Gamma}


@dataclass(frozen=True)
class PerWire:
    """A law for each wire by name; independent of each other."""

    laws: tuple[tuple[str, Law], ...]

    @property
    def wires(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.laws)

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        out = num.zeros((len(count), *_wires(brief)))
        for i, (name, law) in enumerate(self.laws):
            w = brief.model.wires.index(name)
            values = np.broadcast_to(law.sample(brief, count, draws, tag + i * TAGS), out.shape)
            out[..., w] = values[..., w]
        return out


def law_of(data: object, where: str) -> Law:
    """Return a law from data: a number, a name, a mapping with `name` and parameters, or a mapping from wires to any of these."""
    if isinstance(data, (int, float)) and not isinstance(data, bool):
        data = {"name": "constant", "value": data}
    if isinstance(data, dict) and data and "name" not in data:
        for held in data.values():
            if isinstance(held, dict) and "name" not in held:
                raise InputError(where, held, f"one law per wire: a number, or one of {', '.join(LAWS)} with its parameters")
        return PerWire(tuple((str(wire), law_of(held, f"{where}.{wire}")) for wire, held in data.items()))
    if not isinstance(data, (str, dict)) or not data:
        raise InputError(where, data, f"a number, one of {', '.join(LAWS)} with its parameters, or a mapping from wires to these")
    law: Law = part(LAWS, data, where)
    return law


def check_wires(law: Law, target: Array, brief: Brief, where: str) -> None:
    """Raise InputError where a law per wire names a wire that does not exist, or leaves out one of `target` (N, w)."""
    if not isinstance(law, PerWire):
        return
    wires = brief.model.wires
    for name in law.wires:
        if name not in wires:
            raise unknown(where, name, wires)
    for name, hit in zip(wires, np.any(target, axis=0).tolist(), strict=True):
        if hit and name not in law.wires:
            raise InputError(where, sorted(law.wires), f"a law for every target; {name!r} has none")
