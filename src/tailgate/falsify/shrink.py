"""The smallest attack that still breaks a property: fewest attacked steps, then fewest wires, then smallest values.

First comes the shortest window of attacked steps that is enough, with larger values if that makes it shorter. Then steps are left out by
delta debugging (Zeller and Hildebrandt 2002), in ever smaller pieces. At the end no single step can be left out. Candidates of a round
are played side by side.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tailgate.core import Array
from tailgate.core.kinds import EFFECTS
from tailgate.core.threat import Brief
from tailgate.falsify.schedule import Schedule

LOUDER = (1.0, 2.0, 4.0, 8.0, 16.0)  # times the values found, cut at the threat model's bounds
FACTORS = np.arange(1, 65) / 64  # of all values at once
HALVINGS = 6  # of the value of a step
Broken = Callable[[Schedule], Array]  # schedules in rows -> (B,) bool: the property is violated


def shrunk(found: Schedule, broken: Broken, brief: Brief) -> Schedule:
    """Return a smaller schedule of one row that breaks the property, as `found` (one row) does.

    Parameters
    ----------
    found
        Commands that break the property.
    broken
        Plays schedules, and says which break it. It decides alone: nothing is taken on trust.
    brief
        The threat model, which bounds the values.
    """
    out = found.masked(np.zeros_like(found.on))
    if broken(out)[0]:  # the road alone breaks it
        return out
    out = _finest(_window(found, broken, brief), broken)
    out = _steps(_values(_wires(out, broken), broken), broken)
    return _finest(out, broken)  # smaller values may have made a step idle


def _window(found: Schedule, broken: Broken, brief: Brief) -> Schedule:
    """Return the shortest run of attacked steps that is enough, among lengths 1, 2, 3, 4, 6, 8, ... and starts an eighth of them apart."""
    at, length = np.flatnonzero(found.on[:, 0]), 1
    loud = [_louder(found, factor, brief) for factor in (LOUDER if (found.value != 0.0).any() else LOUDER[:1])]
    while length < len(at):
        starts = np.unique(np.append(np.arange(0, len(at) - length, max(length // 8, 1)), len(at) - length))
        keep = np.zeros((len(found.kind), len(starts)), bool)
        for i, first in enumerate(starts):
            keep[at[first : first + length], i] = True
        for one in loud:
            tried = one.masked(keep)
            if (hits := np.flatnonzero(broken(tried))).size:
                return tried.take(hits[:1])
        length += max(length // 2, 1) if length.bit_count() == 1 else length // 3
    return found


def _louder(found: Schedule, factor: float, brief: Brief) -> Schedule:
    """Return the schedule with its values times a factor, as far as the threat model grants them."""
    out = found.scaled(np.full(found.kind.shape, factor))
    for kind in np.unique(found.kind[found.on]).tolist():
        here = (found.kind == kind)[:, :, None, None] & found.target
        out.value[...] = np.where(here, EFFECTS[kind].clip(brief.limits, out.value), out.value)
    return out


def _finest(found: Schedule, broken: Broken) -> Schedule:
    """Return the schedule without every piece that may be left out, down to single steps."""
    size = max(int(found.steps[0]) // 2, 1)
    while True:
        at = np.flatnonzero(found.on[:, 0])
        pieces = [at[i : i + size] for i in range(0, len(at), size)]
        keep = np.repeat(found.on, len(pieces), axis=1)
        for i, piece in enumerate(pieces):
            keep[piece, i] = False
        tried = found.masked(keep)
        hits = np.flatnonzero(broken(tried)) if len(pieces) > 1 else np.zeros(0, np.int64)
        if hits.size:
            found = tried.take(hits[:1])
        elif size == 1:
            return found
        else:
            size //= 2


def _wires(found: Schedule, broken: Broken) -> Schedule:
    """Return the schedule without every wire that may be left out."""
    for agent, wire in np.argwhere(found.target.any(axis=(0, 1))):
        keep = np.ones(found.target.shape, bool)
        keep[:, :, agent, wire] = False
        tried = found.masked(keep)
        if tried.on.any() and broken(tried)[0]:
            found = tried
    return found


def _values(found: Schedule, broken: Broken) -> Schedule:
    """Return the schedule with all values times the smallest factor that is enough."""
    tried = found.scaled(np.repeat(FACTORS[None], len(found.kind), axis=0))
    return tried.take(np.flatnonzero(broken(tried) | (FACTORS == 1.0))[:1])


def _steps(found: Schedule, broken: Broken) -> Schedule:
    """Return the schedule with the value of each step halved as often as it may be, the first step first."""
    for k in np.flatnonzero(found.on[:, 0] & (found.value != 0.0).any(axis=(1, 2, 3))):
        factor = np.ones((len(found.kind), HALVINGS + 1))
        factor[k] = 0.5 ** np.arange(HALVINGS, -1, -1)
        tried = found.scaled(factor)
        hits = broken(tried)
        hits[-1] = True
        found = tried.take(np.flatnonzero(hits)[:1])
    return found
