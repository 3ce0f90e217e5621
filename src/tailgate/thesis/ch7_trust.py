"""Trust after 36 successes in 36 runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from tailgate.core import Array
from tailgate.evaluation.stats import Interval, proportion
from tailgate.trust.statistics import Sequential

from .claims import Claim, Holds, Part, Table, verdict
from .runs import share

if TYPE_CHECKING:
    from .ch7_automata import Played

RUNS = 36  # of the thesis
THESIS = [0.9026, 1.0]
PRINTED = "[0.9026, 1.0000]"
WIDTH = 0.1  # of the interval, UPPAAL's usual 2 epsilon
LEVELS = (0.9, 0.95, 0.99, 0.999)


def interval(i: Interval) -> dict[str, float]:
    """Return a share with its limits, as reports have them."""
    return {"share": round(i.value, 4), "low": round(i.low, 4), "high": round(i.high, 4)}


def judge(cells: Sequence[Interval], level: float, floor: float = 0.5) -> tuple[Holds, str]:
    """Return the verdict on shares that have to reach a level, and what to add to `why` where an interval does not decide it.

    A share that reaches the level counts for the claim even if its interval goes below. So neither the number of runs nor one failure
    decides. A share whose whole interval is below `floor` counts against the claim.
    """
    holds = verdict(all(i.value >= level for i in cells), all(i.high < floor for i in cells))
    open_ = sorted({bound for i in cells for bound in (level, floor) if i.low < bound <= i.high})
    note = f"; too few runs: a 95 % interval has {' and '.join(f'{bound:g}' for bound in open_)} inside" if open_ else ""
    return holds, note


def first(hit: Array) -> Array:
    """Return the runs that represent the thesis's."""
    return hit[:RUNS]


def frechet(lows: list[float]) -> float:
    """Return the least probability of all events together, given the least of each, for any dependence among them."""
    return max(0.0, 1.0 - sum(1.0 - low for low in lows))


def parts(runs: Played) -> Iterator[Part]:
    """Return claims and a table on what 36 runs say."""
    yield from (_interval(), _coverage(), _confidence(), _trust(), _all(runs), _levels())


def _interval() -> Claim:
    got = proportion(RUNS, RUNS)
    least = next(n for n in range(1, 1000) if proportion(n, n).low >= 1.0 - WIDTH)
    return Claim(
        "7.4-interval", "36 runs give the confidence interval [0.9026, 1.0000] with 95 % confidence", PRINTED,
        {"36 of 36": f"[{got.low:.4f}, {got.high:.4f}]", "first number of runs with an interval no wider than 0.1": least},
        verdict(round(got.low, 4) == THESIS[0] and least == RUNS, round(got.low, 4) != THESIS[0]),
        "Clopper-Pearson: arithmetic of the number 36, the same for every model in which nothing fails; both limits to four digits",
    )  # fmt: skip


def _coverage() -> Claim:
    """Judge the rule by which 36 comes about, where runs do fail."""
    worst, p = Sequential(WIDTH).worst_coverage()
    return Claim(
        "7.3.5-coverage", "The interval at which the runs stop has 95 % confidence", 0.95,
        {"least coverage": round(worst, 4), "at a probability of": round(p, 4)}, verdict(worst >= 0.95, worst < 0.95),
        "exact, if runs stop as soon as the interval is no wider than 0.1: looking after every run costs confidence; with a number of runs "
        "that is fixed beforehand it is kept",
    )  # fmt: skip


def _confidence() -> Claim:
    lows = {f"{100 * level:g} %": round(proportion(RUNS, RUNS, level).low, 4) for level in LEVELS}
    values = list(lows.values())
    falls = all(a > b for a, b in pairwise(values))
    return Claim(
        "7.3.5-confidence", "The higher the confidence, the likelier the vehicle satisfies the specification", "likelier",
        {"lower limit of the same 36 runs": lows}, verdict(not falls, falls),
        "confidence is chosen, not found: of the same runs a higher one only gives a wider interval",
    )  # fmt: skip


def _trust() -> Claim:
    """Show what 95 % can mean, and how often bad systems pass."""
    passes = {f"P = {p}": round(p**RUNS, 3) for p in (0.9, 0.95, 0.98)}
    one_sided = 0.05 ** (1.0 / RUNS)
    return Claim(
        "7.4-trust", "Trust in the vehicle is 95 % for a confidence interval of [0.9026, 1.00]", 0.95,
        {"at least, with 97.5 % one-sided confidence": round(proportion(RUNS, RUNS).low, 4), "at least, with 95 %": round(one_sided, 4),
         "chance that all 36 runs succeed, by their true probability": passes},
        verdict(one_sided >= 0.95, one_sided < 0.95),
        "95 % is the confidence of the procedure, which every result has; what is known of the vehicle is the lower limit",
    )  # fmt: skip


def _all(runs: Played) -> Claim:
    """Judge all three at once, as trust in the vehicle needs them."""
    hit = np.isfinite(runs.invariants.hit)
    every = share(hit.all(axis=0))
    holds, note = judge([every], THESIS[0], THESIS[0])
    split = (0.05 / len(hit)) ** (1.0 / RUNS)
    return Claim(
        "7.4-overall", "Based on the results of the three automata, the overall trust is that of each", PRINTED,
        {
            "three times 36 of 36, 5 % split over them": round(frechet([split] * len(hit)), 4),
            f"all three in one run, of {runs.many}": interval(every),
        }, holds,
        "of three statements only their joint probability counts: without independence 1 less the sum of what is missing (Frechet), or all "
        f"three counted run by run{note}",
    )  # fmt: skip


def _levels() -> Table:
    rows = []
    for n in (36, 73, 299, 1000, 20000):
        rows.append((str(n), *(f"{proportion(n, n, level).low:.4f}" for level in LEVELS), *(f"{p**n:.3g}" for p in (0.9, 0.95, 0.99))))
    heads = (*(f"at least, {100 * level:g} % interval" for level in LEVELS), *(f"passes with P = {p}" for p in (0.9, 0.95, 0.99)))
    return Table("What so many successes without a failure say", ("runs, all good", *heads), tuple(rows))
