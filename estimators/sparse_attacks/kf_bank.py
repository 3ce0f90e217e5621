"""A bank of Kalman filters under a block residue test (Mishra, Shoukry, Karamchandani, Diggavi and Tabuada 2017; thesis, [30]).

For each subset K of q - s sensors a steady Kalman filter runs (bank.py). With its residues z_K and their covariance S_K,

    D_K = sum over a block of N steps of z_K' S_K^-1 z_K,       K is accepted if D_K <= h,       h = chi2.isf(alpha / number of K, N |K|)

D_K is chi-square with N |K| degrees of freedom where no sensor in K is attacked, all readings arrive and the filter has settled. A block
with fewer readings has fewer degrees: D_K is then scaled to h, by the quantiles of Wilson and Hilferty (1931). The paper compares each
diagonal entry of the residues' sample covariance with its expectation plus eta; this test is joint instead.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.core import Array, Count, Estimate, Innovation, Mode, Model, Positive, PositiveCount, Prior, Received, param
from tailgate.core.draws import Draws
from tailgate.core.registry import register
from tailgate.estimators.parts import Verdict, blame_all, normalised
from tailgate.estimators.sparse_attacks.bank import BankPlan, bank_plan, bank_start, bank_step, statistic
from tailgate.estimators.sparse_attacks.subsets import require, without

PAPER = (
    "S. Mishra, Y. Shoukry, N. Karamchandani, S. Diggavi, P. Tabuada, Secure State Estimation Against Sensor Attacks in the Presence of "
    "Noise, 2017"
)
Tail = Annotated[float, Field(gt=0, lt=1)]
ATTACKED = "sensors that may be attacked at the same time"


class KfBankPlan(NamedTuple):
    bank: BankPlan
    threshold: float  # h
    degrees: int  # N |K|
    tail: float  # the standard normal quantile at which `quantile` gives h
    first: int  # the filter that is believed before a block has ended


class KfBankState(NamedTuple):
    x: Array  # (B, N, n, K)
    sums: Array  # (B, N, K, L) of the block so far, L = 1; sliding: over the last 1, 2, ..., N - 1 steps
    counts: Array  # (B, N, K, L) likewise, of the readings that arrived
    steps: Array  # (B, N) int64: steps of the block so far
    chosen: Array  # (B, N) int64
    score: Array  # (B, N) of the last block
    alarm: Array  # (B, N) bool, likewise


def block_threshold(alpha: float, filters: int, block: int, sensors: int) -> float:
    """Return h for a probability alpha of a false rejection in a block, split over the filters."""
    from scipy import special  # not loaded where no threshold is made

    return float(special.chdtri(block * sensors, alpha / filters))


def quantile(degrees: Array, tail: float) -> Array:
    """Return the chi-square quantile of Wilson and Hilferty for degrees > 0, where the standard normal one is `tail`."""
    share = 2.0 / (9.0 * degrees)
    root = np.maximum(1.0 - share + tail * np.sqrt(share), 0.0)
    return np.asarray(degrees * (root * root * root))


def tail_of(h: float, degrees: int) -> float:
    """Return the standard normal quantile at which `quantile` gives h."""
    share = 2.0 / (9.0 * degrees)
    root = num.exp(num.log(np.array([h / degrees])) / 3.0)[0]
    return float((root - 1.0 + share) / np.sqrt(share))


@register("defence", "kf_bank", reference=PAPER)
@dataclass(frozen=True)
class KalmanBank:
    """Kalman filters on all subsets of the sensors; it believes one whose residues pass a test over a block of steps."""

    threshold_field: ClassVar[str] = "threshold"
    s: Count = param(1, ATTACKED)
    block: PositiveCount = param(10, "length N of a block [steps]")
    alpha: Tail = param(1e-4, "probability of an alarm in a block without an attack, at most: of any subset rejected [-]")
    threshold: Positive | None = param(None, "threshold h on the sum of z' S^-1 z over a block; none: by alpha [-]")
    sliding: bool = param(False, "judge the last N steps in each step, not block by block")
    choice: Literal["least", "first"] = param(
        "least", "least: the subset with the smallest sum; first: the chosen one while it passes, then the first that does, as in the paper"
    )

    def prepare(self, model: Model) -> KfBankPlan:
        require(model, self.s, "defence kf_bank")
        keep = without(len(model.sensors), self.s)
        bank = bank_plan(model, keep)
        kept, first = int(np.count_nonzero(keep[0])), int(np.argmin(np.max(bank.after.trace(axis1=-2, axis2=-1), axis=0)))
        h = block_threshold(self.alpha, len(keep), self.block, kept) if self.threshold is None else self.threshold
        return KfBankPlan(bank, h, self.block * kept, tail_of(h, self.block * kept), first)

    def start(self, plan: KfBankPlan, prior: Prior) -> KfBankState:
        shape = prior.mean.shape[:2]
        sums = num.zeros((*shape, len(plan.bank.keep), self.block - 1 if self.sliding else 1))
        chosen = num.full(shape, plan.first, np.int64)
        x, steps = bank_start(plan.bank, prior.mean), num.zeros(shape, np.int64)
        return KfBankState(x, sums, sums.copy(), steps, chosen, num.zeros(shape), num.zeros(shape, bool))

    def step(
        self, plan: KfBankPlan, state: KfBankState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[KfBankState, Estimate]:
        x, z = bank_step(plan.bank, state.x, received, known_u)
        arrived = num.matvec(plan.bank.keep.astype(np.float64), received.valid.astype(np.float64))
        steps = np.minimum(state.steps + 1, self.block) if self.sliding else state.steps + 1
        judged = steps >= self.block
        total, sums = self._summed(state.sums, statistic(plan.bank, z), judged)
        count, counts = self._summed(state.counts, arrived, judged)
        total = self._scaled(plan, total, count)
        best = np.argmin(total, axis=-1)
        if self.choice == "first":
            passed = total <= plan.threshold
            stays = num.pick(passed, state.chosen)
            best = np.where(stays, state.chosen, np.where(passed.any(axis=-1), np.argmax(passed, axis=-1), best))
        least = np.min(total, axis=-1)
        chosen = np.where(judged, best, state.chosen)
        score = np.where(judged, least, state.score)
        alarm = np.where(judged, least > plan.threshold, state.alarm)
        estimate = Estimate(
            num.pick(x, chosen[..., None]), score, alarm, num.full(score.shape, Mode.NORMAL, np.int8), np.ones_like(alarm)
        )
        steps = steps if self.sliding else np.where(judged, 0, steps)
        return KfBankState(x, sums, counts, steps, chosen, score, alarm), estimate

    def _summed(self, held: Array, new: Array, judged: Array) -> tuple[Array, Array]:
        """Return the sums (B, N, K) over a block that ends here, and the next ones (B, N, K, L)."""
        if not held.shape[-1]:
            return new, held
        total = held[..., -1] + new
        if not self.sliding:
            return total, np.where(judged[..., None], 0.0, total)[..., None]
        sums = num.full(held.shape, new[..., None])
        sums[..., 1:] += held[..., :-1]
        return total, sums

    def _scaled(self, plan: KfBankPlan, total: Array, count: Array) -> Array:
        """Return sums (B, N, K) of `count` readings as sums of a whole block; a filter without a reading passes as the last that does."""
        level = quantile(np.maximum(count, 1.0), plan.tail)
        part = np.where(count > 0.0, total * (plan.threshold / np.where(level > 0.0, level, 1.0)), plan.threshold)
        return np.where(count == plan.degrees, total, part)


class BlockPlan(NamedTuple):
    agents: int
    threshold: float


class BlockState(NamedTuple):
    total: Array  # (B, N)
    steps: Array  # (B, N) int64
    score: Array  # (B, N)
    alarm: Array  # (B, N) bool


@register("detector", "block_residue", reference=PAPER)
@dataclass(frozen=True)
class BlockResidue:
    """Alarms when the normalised innovation squared, summed over a block of steps, exceeds the threshold; judged at the block's end."""

    threshold_field: ClassVar[str] = "threshold"
    threshold: Positive | None = param(None, "threshold on the sum of r' S^-1 r over a block; none: by alpha [-]")
    block: PositiveCount = param(10, "length of a block [steps]")
    alpha: Tail = param(1e-4, "probability of an alarm in a block without an attack [-]")

    def prepare(self, model: Model) -> BlockPlan:
        h = self.threshold
        return BlockPlan(model.agents, block_threshold(self.alpha, 1, self.block, len(model.sensors)) if h is None else h)

    def start(self, plan: BlockPlan, batch: int) -> BlockState:
        shape = (batch, plan.agents)
        return BlockState(num.zeros(shape), num.zeros(shape, np.int64), num.zeros(shape), num.zeros(shape, bool))

    def step(self, plan: BlockPlan, state: BlockState, innovation: Innovation) -> tuple[BlockState, Verdict]:
        total, steps = state.total + normalised(innovation), state.steps + 1
        judged = steps >= self.block
        score, alarm = np.where(judged, total, state.score), np.where(judged, total > plan.threshold, state.alarm)
        state = BlockState(np.where(judged, 0.0, total), np.where(judged, 0, steps), score, alarm)
        return state, blame_all(score, alarm, innovation)

    def gate(self, plan: BlockPlan, state: BlockState) -> Array:
        """Return what is left of the threshold at a block's end; without a limit before it, as nothing is judged there."""
        return np.where(state.steps + 1 >= self.block, plan.threshold - state.total, np.inf)
