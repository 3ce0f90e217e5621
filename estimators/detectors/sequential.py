"""Detectors with memory: they see attacks that no single step shows (docs/detectors.md).

With g = r' S^-1 r, which without an attack is chi-square with q degrees of freedom, and h the threshold:

    windowed chi-square      s = g(k) + g(k-1) + ... + g(k-w+1)                                  alarm: s > h
    CUSUM                    s = max(0, s + g - b)                                               alarm: s > h
    MEWMA                    z = l L^-1 r + (1 - l) z,   L L' = S,   s = z'z / c                 alarm: s > h

A reading that is missing has r = 0 and so adds nothing to g. No detector here can tell the sensors apart: all of them are suspected.
The default thresholds give one false alarm in an hour on car following with the Kalman filter (benchmarks/results/calibration.json).
"""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.core import Array, Innovation, Model, Positive, PositiveCount, param
from tailgate.core.registry import register
from tailgate.estimators.parts import Verdict, blame_all, normalised

Allowance = Annotated[float, Field(gt=1, le=1e30, allow_inf_nan=False)]
Weight = Annotated[float, Field(ge=1e-6, le=1)]
INSIDE = 1.0 - 1e-12  # factor on a bound: the rounding of square roots must not raise an alarm


def whiten(innovation: Innovation) -> Array:
    """Return L^-1 r (B, N, q) with the Cholesky factor L of S: uncorrelated, of unit variance, and of length r' S^-1 r.

    Another square root of S turns the result and changes no length. Over a time-varying S it changes the length of a sum of results; S
    settles within seconds.
    """
    r, S = innovation
    q = r.shape[-1]
    L: list[list[Any]] = [[None] * q for _ in range(q)]
    out: list[Any] = []
    for i in range(q):
        for j in range(i + 1):
            rest = S[..., i, j]
            for k in range(j):
                rest = rest - L[i][k] * L[j][k]
            L[i][j] = np.sqrt(rest) if i == j else rest / L[j][j]
        part = r[..., i]
        for k in range(i):
            part = part - L[i][k] * out[k]
        out.append(part / L[i][i])
    return num.stack(out)


class WindowState(NamedTuple):
    sums: Array  # (B, N, w - 1): g over the last 1, 2, ..., w - 1 steps


@register("detector", "windowed_chi2", reference="Tunga, Murguia, Ruths, Tuning windowed chi-squared detectors for sensor attacks, 2018")
@dataclass(frozen=True)
class WindowedChiSquare:
    """Alarms when the normalised innovation squared, summed over the last steps, exceeds the threshold."""

    threshold_field: ClassVar[str] = "threshold"
    threshold: Positive = param(54.25, "threshold on the sum of r' S^-1 r [-]")
    window: PositiveCount = param(10, "length of the window [steps]")

    def prepare(self, model: Model) -> int:
        return model.agents

    def start(self, plan: int, batch: int) -> WindowState:
        return WindowState(num.zeros((batch, plan, self.window - 1)))

    def step(self, plan: int, state: WindowState, innovation: Innovation) -> tuple[WindowState, Verdict]:
        g = normalised(innovation)
        score = self._older(state) + g
        if self.window > 1:
            sums = num.full(state.sums.shape, g[..., None])
            sums[..., 1:] += state.sums[..., :-1]
            state = WindowState(sums)
        return state, blame_all(score, score > self.threshold, innovation)

    def _older(self, state: WindowState) -> Array | float:
        """Return the part of the next sum that is known before the step."""
        return state.sums[..., -1] if self.window > 1 else 0.0

    def gate(self, plan: int, state: WindowState) -> Array | float:
        return self.threshold - self._older(state)


class CusumPlan(NamedTuple):
    agents: int
    drift: float  # b


class CusumState(NamedTuple):
    total: Array  # (B, N)


@register(
    "detector", "cusum",
    reference="Page 1954; Murguia, Ruths, CUSUM and chi-squared attack detection of compromised sensors, 2016",
)  # fmt: skip
@dataclass(frozen=True)
class Cusum:
    """Alarms when the normalised innovation squared has exceeded its allowance by more than the threshold in all (non-parametric CUSUM)."""

    threshold_field: ClassVar[str] = "threshold"
    threshold: Positive = param(27.72, "threshold on the cumulative sum [-]")
    drift: Allowance = param(1.5, "allowance a step, in multiples of the number of sensors (the mean of r' S^-1 r); above 1 [-]")
    reset: bool = param(True, "the sum starts at zero again after an alarm; else it winds up and takes its time to fall")

    def prepare(self, model: Model) -> CusumPlan:
        return CusumPlan(model.agents, self.drift * len(model.sensors))

    def start(self, plan: CusumPlan, batch: int) -> CusumState:
        return CusumState(num.zeros((batch, plan.agents)))

    def step(self, plan: CusumPlan, state: CusumState, innovation: Innovation) -> tuple[CusumState, Verdict]:
        score = np.maximum(0.0, (state.total - plan.drift) + normalised(innovation))
        alarm = score > self.threshold
        total = np.where(alarm, 0.0, score) if self.reset else score
        return CusumState(total), blame_all(score, alarm, innovation)

    def gate(self, plan: CusumPlan, state: CusumState) -> Array:
        return self.threshold - (state.total - plan.drift)


class MewmaState(NamedTuple):
    z: Array  # (B, N, q)
    faded: Array  # (B, N): (1 - l)^(2 k), k steps since the start or the last alarm


@register("detector", "mewma", reference="Lowry, Woodall, Champ, Rigdon, A multivariate EWMA control chart, Technometrics 34, 1992")
@dataclass(frozen=True)
class Mewma:
    """Alarms when the exponentially weighted moving average of the whitened innovation is too long for its covariance."""

    threshold_field: ClassVar[str] = "threshold"
    threshold: Positive = param(20.5, "threshold on z'z / c, which is chi-square in each step [-]")
    weight: Weight = param(0.2, "weight l of the newest innovation; 1: the chi-square detector [-]")
    exact: bool = param(True, "c is the exact variance of z, else its limit, which makes the first steps less sensitive")
    reset: bool = param(True, "the average starts at zero again after an alarm")

    def prepare(self, model: Model) -> tuple[int, int]:
        return model.agents, len(model.sensors)

    def start(self, plan: tuple[int, int], batch: int) -> MewmaState:
        return MewmaState(num.zeros((batch, *plan)), num.full((batch, plan[0]), 1.0))

    def step(self, plan: tuple[int, int], state: MewmaState, innovation: Innovation) -> tuple[MewmaState, Verdict]:
        z = self.weight * whiten(innovation) + (1.0 - self.weight) * state.z
        faded = self._fade(state)
        score = num.dot(z, z) / self._variance(faded)
        alarm = score > self.threshold
        if self.reset:
            z, faded = np.where(alarm[..., None], 0.0, z), np.where(alarm, 1.0, faded)
        return MewmaState(z, faded), blame_all(score, alarm, innovation)

    def gate(self, plan: tuple[int, int], state: MewmaState) -> Array:
        """Return the gate for any direction: |z+| <= l sqrt(g) + (1-l) |z|, with equality where the innovation points along z."""
        longest = np.sqrt(self.threshold * self._variance(self._fade(state))) * INSIDE
        room = (longest - (1.0 - self.weight) * np.sqrt(num.dot(state.z, state.z))) / self.weight
        return np.asarray(room * np.abs(room))

    def _fade(self, state: MewmaState) -> Array:
        return np.asarray(state.faded * ((1.0 - self.weight) * (1.0 - self.weight)))

    def _variance(self, faded: Array) -> Array | float:
        """Return c, the variance of each component of z."""
        limit = self.weight / (2.0 - self.weight)
        return limit * (1.0 - faded) if self.exact else limit
