"""Laws of the values that are injected, the same for scripts and for programs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.agents.scripts.triggers import part
from tailgate.base.errors import InputError, unknown
from tailgate.core import Array, Finite, NonNegative, Positive, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Bounded
from tailgate.core.threat import Brief
from tailgate.engine.operations import Mask

TAGS = 4  # tags that one law may draw under
HalfInteger = Annotated[float, Field(gt=0, le=50, multiple_of=0.5)]


class Law:
    """Base class of the laws of the values that are sent."""

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        """Return values that broadcast to (B, N, w), `count` (B,) steps after the attack began; it draws under the tags from `tag` on."""
        raise TypeError(f"{type(self).__name__} must define sample()")

    def sends(self, brief: Brief, count: Array) -> Mask:
        """Return bool that broadcasts to (B, N, w): a value is sent `count` (B,) steps after the attack began."""
        return np.True_

    def check(self, brief: Brief, where: str) -> None:
        """Raise InputError that names `where` if the law does not fit a model."""


def _wires(brief: Brief) -> tuple[int, int]:
    return brief.model.agents, len(brief.model.wires)


@dataclass(frozen=True)
class Constant(Law):
    """Always the same value."""

    value: Finite = param(-4.0, "value [unit of the wire]")

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        return np.full((len(count), 1, 1), self.value)


@dataclass(frozen=True)
class Uniform(Law):
    """Uniform random values, independent in every step and on every wire."""

    low: Finite = param(-10.0, "smallest value [unit of the wire]")
    high: Finite = param(10.0, "largest value [unit of the wire]")

    def __post_init__(self) -> None:
        if self.low > self.high:
            raise InputError("low", self.low, f"at most high ({self.high})")

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        return np.asarray(self.low + (self.high - self.low) * draws.uniform(_wires(brief), tag))


@dataclass(frozen=True)
class Gaussian(Law):
    """Gaussian random values, independent in every step and on every wire."""

    mean: Finite = param(0.0, "mean [unit of the wire]")
    sd: NonNegative = param(10.0, "standard deviation [unit of the wire]")

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        return np.asarray(self.mean + self.sd * draws.normal(_wires(brief), tag))


@dataclass(frozen=True)
class Ramp(Law):
    """Grows by the same amount every step, up to a limit."""

    base: Finite = param(0.0, "value before the first growth [unit of the wire]")
    rate: Finite = param(-0.3, "growth a step [unit of the wire]")
    limit: NonNegative = param(50.0, "largest |value| [unit of the wire]")

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        return np.asarray(np.clip(self.base + self.rate * (count + 1), -self.limit, self.limit))[:, None, None]


@dataclass(frozen=True)
class Gamma(Law):
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


Entry = Bounded | None | Annotated[tuple[Bounded | None, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Table(Law):
    """Listed values, one a step; nothing is sent in a step without a value, and after the last one."""

    values: Annotated[tuple[Entry, ...], Field(min_length=1, max_length=10_000)] = param(
        (-4.0,), "value of each step, or a list with one value for each agent; null: nothing is sent [unit of the wire]"
    )

    @cached_property
    def held(self) -> tuple[Array, Array]:
        """The values (steps, 1 or N), and where there are some, bool; a row for what comes after is the last."""
        agents = max((len(entry) for entry in self.values if isinstance(entry, tuple)), default=1)
        rows = [entry if isinstance(entry, tuple) else (entry,) * agents for entry in self.values]
        given = np.array([[np.nan if value is None else value for value in row] for row in [*rows, (None,) * agents]], float)
        return np.where(np.isnan(given), 0.0, given), ~np.isnan(given)

    def _place(self, count: Array) -> Array:
        return np.minimum(count, len(self.values))

    def sample(self, brief: Brief, count: Array, draws: Draws, tag: int = 0) -> Array:
        return num.take(self.held[0], self._place(count))[..., None]

    def sends(self, brief: Brief, count: Array) -> Mask:
        """Return where a value is listed."""
        return num.take(self.held[1], self._place(count))[..., None]

    def check(self, brief: Brief, where: str) -> None:
        """Raise InputError if a list has not one value for each agent."""
        for i, entry in enumerate(self.values, start=1):
            if isinstance(entry, tuple) and len(entry) != brief.model.agents:
                raise InputError(f"{where}.values, step {i}", len(entry), f"one number, or one for each of {brief.model.agents} agents")


LAWS: dict[str, type[Any]] = {"constant": Constant, "uniform": Uniform, "gaussian": Gaussian, "ramp": Ramp, "gamma": Gamma, "table": Table}


@dataclass(frozen=True)
class PerWire(Law):
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

    def sends(self, brief: Brief, count: Array) -> Mask:
        """Return where the law of a wire sends a value."""
        if not any(isinstance(law, Table) for _, law in self.laws):
            return np.True_
        out = num.full((len(count), *_wires(brief)), True, bool)
        for name, law in self.laws:
            w = brief.model.wires.index(name)
            out[..., w] = np.broadcast_to(law.sends(brief, count), out.shape)[..., w]
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
    """Raise InputError where a law does not fit, names a wire that does not exist, or leaves out one of `target` (N, w)."""
    if not isinstance(law, PerWire):
        law.check(brief, where)
        return
    for name, held in law.laws:
        held.check(brief, f"{where}.{name}")
    wires = brief.model.wires
    for name in law.wires:
        if name not in wires:
            raise unknown(where, name, wires)
    for name, hit in zip(wires, np.any(target, axis=0).tolist(), strict=True):
        if hit and name not in law.wires:
            raise InputError(where, sorted(law.wires), f"a law for every target; {name!r} has none")
