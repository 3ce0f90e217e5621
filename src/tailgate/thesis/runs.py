"""Episodes of a chapter: a scenario under a defence and an attack, and what is read off a trace."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from tailgate.core import Array, Attack, Defence, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.evaluation.stats import Interval, proportion
from tailgate.play.trace import Trace, rollout


def play(
    scenario: Scenario | str, defence: Defence | str, attack: Attack | str, seeds: int | Sequence[int], *, terminate: bool = True
) -> Trace:
    """Play report episodes.

    Parameters
    ----------
    defence, attack : texts as on the command line, or objects; a defence that is an object gets its own sensors only
    seeds : how many, or which
    terminate : whether an episode ends with its first collision
    """
    where = load_scenario(scenario) if isinstance(scenario, str) else scenario
    if isinstance(defence, str):
        spec = Spec("defence", defence)
        loop = where.loop(spec.make(), spec.entry.uses)
    else:
        loop = where.loop(defence)
    attacker = Spec("attack", attack).make() if isinstance(attack, str) else attack
    return rollout(loop, attacker, draws.keys("report", range(seeds) if isinstance(seeds, int) else list(seeds)), terminate=terminate)


def collided(trace: Trace) -> Array:
    """Return (B,) bool: episodes in which a car hit the one ahead."""
    return np.asarray((trace.collided & trace.live).any(axis=0))


def collisions(trace: Trace) -> float:
    """Return the share of the episodes with a collision."""
    return float(collided(trace).mean())


def share(good: ArrayLike) -> Interval:
    """Return the share of True in (n,) with its exact 95 % interval."""
    good = np.asarray(good)
    return proportion(int(np.count_nonzero(good)), len(good))


def percent(interval: Interval) -> str:
    """Write a share and its interval as whole percentages."""
    return f"{100 * interval.value:.0f} % [{100 * interval.low:.0f}, {100 * interval.high:.0f}]"


def median(values: Array) -> float:
    """Return the median as a number of Python."""
    return float(np.median(values))
