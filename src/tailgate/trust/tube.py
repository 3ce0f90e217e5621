"""The tube of a linear loop with bounded inputs: the range of each output at each step, and the largest attack that keeps it safe.

The set of states is a zonotope (Girard, HSCC 2005). Its extent along a row r is the sum of |r Phi g| over the generators g of all
earlier steps. Rows are carried backwards, and no set is stored. The extent under an attack of at most B
steps takes the B largest of the attack's summands. The attack that reaches it has their signs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array
from tailgate.trust.affine import AffineLoop

ROUND = 1e-9  # share of all that is summed by which an extent is widened, far above what rounding adds
HALVINGS = 60


class Extent(NamedTuple):
    """The range of outputs at steps 1 .. K, or states 1 .. K + 1: (K, r) each, and the attack's summands by step, (K, r, K)."""

    centre: Array
    noise: Array  # all noise at its bound, in the worst order
    variance: Array  # of the same noise
    other: Array  # what the leader or the road adds at most
    attack: Array  # of one unit of a_max, zero after the output's own step


class Verdict(NamedTuple):
    """The loop under attacks of size `size`: the least gap, and the room that the command, the speed and the error keep."""

    size: float
    gap: float  # smallest lower bound of a gap [m]; of an error its bound less the error
    room: float  # of the linear range, of commands in units of their range and of speeds [m/s]; inf where there is neither

    @property
    def safe(self) -> bool:
        """True if no gap is lost, and the loop stays linear."""
        return self.gap > 0.0 and self.room >= 0.0


def extent(loop: AffineLoop, rows: Array, direct: tuple[Array, Array, Array] | None = None) -> Extent:
    """Return the range of rows (K, r, size) of the state, row k - 1 at step k, with what this step adds itself.

    One row more than there are steps is that of the state behind the last step.
    direct: constants (K, r), noise (K, r, g) and injected values (K, r, a) that enter the output at its own step.
    """
    burn, many = loop.burn, len(rows)
    carried = np.array(rows[burn:])  # only these are seen
    attack = np.zeros((*carried.shape[:2], len(loop.steps) - burn))
    centre, noise, variance, other, size = (np.zeros(carried.shape[:2]) for _ in range(5))

    lengths = np.array(loop.lengths) if loop.lengths else np.full(loop.chance, loop.spread)

    def add(at: slice, moved: Array, chance: int, long: Array | float) -> None:
        noise[at] += np.abs(moved[..., :chance]).sum(axis=2)
        variance[at] += ((moved[..., :chance] / long) ** 2).sum(axis=2)
        other[at] += np.abs(moved[..., chance:]).sum(axis=2)

    if direct is not None:
        centre += direct[0][burn:]
        size += np.abs(direct[0][burn:])
        add(slice(None), direct[1][burn:], loop.chance, lengths)
        for k in np.flatnonzero(loop.attacked):
            attack[k - burn, :, k - burn] = np.abs(direct[2][k]).sum(axis=1)
    for j in range(many - 2, -1, -1):
        step, behind = loop.steps[j], slice(max(j + 1 - burn, 0), None)
        later = carried[behind]
        centre[behind] += later @ step.m0
        size[behind] += np.abs(later) @ np.abs(step.m0)
        add(behind, later @ step.N, loop.chance, lengths)
        if loop.attacked[j]:
            attack[behind, :, j - burn] = np.abs(later @ step.W).sum(axis=2)
        carried[behind] = later @ step.M
    centre += carried @ loop.start
    size += np.abs(carried) @ np.abs(loop.start)
    add(slice(None), carried @ loop.box, loop.begun, loop.spread)
    wide = 1.0 + ROUND
    return Extent(centre, noise * wide, variance * wide * wide, other * wide + ROUND * size, attack * wide)


def quantile_of(tail: float, uniform: bool) -> float:
    """Return how many standard deviations noise passes, to one side, with a probability of `tail` at most.

    Uniform noise is no wider than Gaussian noise of its variance in its moment generating function, so Chernoff's bound holds for sums:
    exp(-q^2 / 2).
    """
    return float(np.sqrt(2.0 * np.log(1.0 / tail))) if uniform else float(-ndtri(tail))


def worst(held: Extent, budget: int) -> Array:
    """Return the extent (K, r) that the strongest attack of one unit adds, in at most `budget` steps."""
    if budget >= held.attack.shape[2]:
        return np.asarray(held.attack.sum(axis=2))
    kept = -np.partition(-held.attack, max(budget - 1, 0), axis=2)[:, :, :budget]
    return np.asarray(kept.sum(axis=2))


class Tube:
    """The ranges of gaps, commands, speeds and errors of a loop.

    Without `alpha` every noise lies within the loop's spread, in the worst order. With it the noise is Gaussian. All ranges of all steps
    then hold together with a probability of 1 - alpha at least (Bonferroni). That is so against any attack: its share has a bound.
    Uniform noise of the readings has its own variance, and the wider quantile of a bound that holds for both laws.
    """

    def __init__(self, loop: AffineLoop, bound: float | None = None, alpha: float | None = None) -> None:
        if alpha is not None and not 0.0 < alpha < 1.0:
            raise InputError("--gaussian", alpha, "a number above 0 and below 1")
        if bound is not None and not 0.0 < bound < np.inf:
            raise InputError("--bound", bound, "a finite number above 0")
        self.loop, self.bound, self.alpha, many = loop, bound, alpha, len(loop.steps)
        self.gap = self._constant([row for row, _ in loop.gaps], many)
        self.gap_offset = np.array([offset for _, offset in loop.gaps])
        self.speed = self._constant([row for row, _ in loop.moving], many)
        self.error = self._output("error")
        self.command: Extent | None = None
        self.steady = 0.0
        if loop.law is not None:
            self.command, self.steady = self._command()
        parts = {"gap": self.gap, "speed": self.speed, "error": self.error, "command": self.command}
        found = {name: held for name, held in parts.items() if held is not None}
        self.pushed = {name: worst(held, loop.budget) for name, held in found.items()}
        ends = 2 * sum(held.centre.size for held in found.values())
        quantile = 0.0 if alpha is None else quantile_of(alpha / ends, loop.uniform)
        self.wide = {
            name: held.other + (held.noise if alpha is None else quantile * np.sqrt(held.variance)) for name, held in found.items()
        }  # fmt: skip

    def _constant(self, rows: list[Array], many: int) -> Extent | None:
        """Return the range of rows of the state, that behind the last step among them."""
        return extent(self.loop, np.broadcast_to(np.array(rows), (many + 1, len(rows), rows[0].size))) if rows else None

    def _command(self) -> tuple[Extent, float]:
        """Return the range of the command less its share of a steady bend, and the largest size of that share.

        The curvature may wander by its rate for ever, but never beyond its largest value; the rest of the command does not follow it.
        """
        if not self.loop.bend:
            return self._output("command"), 0.0
        last = self.loop.steps[-1]
        size = len(last.M)
        free = np.linalg.solve(np.eye(size - 1) - last.M[:-1, :-1], last.M[:-1, -1])
        share = float(last.command[0][0] @ np.append(free, 1.0))
        return self._output("command", np.append(np.zeros(size - 1), share)), abs(share) * self.loop.bend

    def _output(self, name: str, less: Array | float = 0.0) -> Extent:
        steps = self.loop.steps
        parts = [np.array([getattr(step, name)[i] for step in steps]) for i in range(4)]
        parts[0] = parts[0] - less
        return extent(self.loop, parts[0], (parts[1], parts[2], parts[3]))

    def lower_gap(self, size: float) -> Array:
        """Return the least gap (K + 1,) [m] at step 1 and behind each step under attacks of size a_max.

        Where nobody drives: the bound of the error less the norm of its box, (K,).
        """
        if self.gap is not None:
            low = self.gap_offset + self.gap.centre - self.wide["gap"] - size * self.pushed["gap"]
            return np.asarray(low.min(axis=1))
        if self.bound is None:
            raise InputError("--bound", None, "an error that counts as damage: nobody drives here")
        return np.asarray(self.bound - self.error_norm(size))

    def error_norm(self, size: float) -> Array:
        """Return the largest 2-norm (K,) of the estimate's error: that of the corner of its box, so exact for one state only."""
        box = np.abs(self.error.centre) + self.wide["error"] + size * self.pushed["error"]
        return np.asarray(np.sqrt((box * box).sum(axis=1)))

    def room(self, size: float) -> float:
        """Return how far command and speed stay within the range in which the loop is linear, at least."""
        left = [np.inf]
        law = self.loop.law
        if self.command is not None and law is not None:
            wide = self.steady + self.wide["command"] + size * self.pushed["command"]
            span = np.where(np.isfinite(law.high - law.low), law.high - law.low, 1.0)
            above, below = law.high - self.command.centre, self.command.centre - law.low
            left.append(float(((np.minimum(above, below) - wide) / span).min()))
        if self.speed is not None:
            left.append(float((self.speed.centre - self.wide["speed"] - size * self.pushed["speed"]).min()))
        return min(left)

    def under(self, size: float) -> Verdict:
        """Return the verdict on attacks of this size."""
        return Verdict(size, float(self.lower_gap(size).min()), self.room(size))

    def largest(self, most: float, limits: bool = True) -> float | None:
        """Return the largest a_max, up to `most`, that is proved safe, by bisection; None where even noise alone is not.

        Both sides of the verdict fall with the size, so that bisection finds the one border. Without `limits` the command is taken to have
        none: that is a statement about another car.
        """

        def safe(size: float) -> bool:
            held = self.under(size)
            return held.safe if limits else held.gap > 0.0

        if not safe(0.0):
            return None
        if safe(most):
            return most
        low, high = 0.0, most
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if safe(middle) else (low, middle)
        return low

    def strongest(self) -> tuple[int, Array]:
        """Return the number of the state, from 1, in which a unit attack takes most of the first gap, and its values (K, a) in [-1, 1].

        Raises
        ------
        NotApplicable
            Where no gap is at stake.
        """
        if self.gap is None:
            raise NotApplicable("--prove", "no gap", "a scenario in which somebody drives")
        share = self.pushed["gap"]
        k, row = np.unravel_index(int(np.argmax(share)), share.shape)
        out = np.zeros((len(self.loop.steps), self.loop.steps[0].W.shape[1]))
        chosen = np.argsort(-self.gap.attack[k, row], kind="stable")[: self.loop.budget]
        carried = np.array(self.loop.gaps[row][0])
        for j in range(self.loop.burn + int(k) - 1, -1, -1):
            if self.loop.attacked[j] and j in chosen:
                out[j] = -np.sign(carried @ self.loop.steps[j].W)
            carried = carried @ self.loop.steps[j].M
        return int(k) + 1, out[self.loop.burn :]
