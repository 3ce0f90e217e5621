"""The part of a training's page that shows the attack that was learned: its rules, and its times and values in some episodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array, Kind, draws
from tailgate.core.kinds import EFFECTS
from tailgate.evaluation.rows import Row
from tailgate.play.trace import Trace, rollout
from tailgate.studies.distil import distil
from tailgate.studies.policies import loop_for, trained

from .charts import nice

EPISODES, TRIED = 4, 32  # episodes that are shown, of the first ones
BEFORE, AFTER = 40, 20  # steps that are shown before the first attacked step and after the last
LOSS = 0.05  # share of the episodes that the rules may lose
Data = dict[str, Any]


def learned(policy: Path, scenario: str, defence: str, threat: dict[str, Any], rows: Sequence[Row], folder: Path) -> Data | None:
    """Return what a page shows of a learned policy. Rules are written to `folder`. None where nobody drives.

    Without scikit-learn there are no rules, and `without` says so.

    threat: changes of the scenario's threat model. rows: of the policy against the defence.
    """
    text = str(policy)
    who = trained(text)
    loop = loop_for(who, scenario, defence, threat)
    if not loop.model.followers.any():
        return None
    seeds = [row["seed"] for row in rows if row["status"] == "ok"][:TRIED]
    trace = rollout(loop, who.policy, draws.keys("report", seeds))
    shown = [i for i in range(len(seeds)) if (trace.kind[: trace.length[i], i] != 0).any()][:EPISODES]
    without = None
    try:
        file, episodes = folder / "rules.json", max(len(rows), 1)
        found: Data | None = distil(text, file, scenario=scenario, defence=defence, threat=threat, loss=LOSS, episodes=episodes)
    except InputError:  # a policy with a memory, or with values that it chooses freely
        found = None
    except ImportError as error:  # the policy is there, whatever else is installed
        found, without = None, str(error)
    return {
        "rules": found, "without": without, "episodes": [_episode(trace, i, seeds[i]) for i in shown], "of": len(seeds),
        "idle": sum(not (trace.kind[: trace.length[i], i] != 0).any() for i in range(len(seeds))),
    }  # fmt: skip


def _episode(trace: Trace, row: int, seed: int) -> Data:
    """Return one episode: the gap as a line, and the attacked steps."""
    length, dt = int(trace.length[row]), trace.dt
    on = trace.kind[:length, row] != 0
    at = np.flatnonzero(on)
    car = int(np.argmax(trace.target[:length, row].any(axis=2).sum(axis=0) * trace.model.followers))
    first, last = max(int(at[0]) - BEFORE, 0), min(int(at[-1]) + AFTER, length)
    gap = np.maximum(trace.gap[first:last, row, car], 0.0)
    top, width = nice(float(gap.max())), max(last - first - 1, 1)

    def x(step: float) -> float:
        return round(1000 * (step - first) / width, 1)

    ended = bool(trace.collided[:length, row].any() or trace.rear_collided[:length, row].any())
    end = f"collision at {length * dt:.1f} s" if ended else f"smallest gap {gap.min():.1f} m"
    return {
        "title": f"episode {seed}: {end}", "top": f"{top:g} m", "from": f"{(first + 1) * dt:.1f} s", "to": f"{last * dt:.1f} s",
        "points": " ".join(f"{x(first + i):.1f},{1000 - 1000 * y / top:.1f}" for i, y in enumerate(gap.tolist())),
        "marks": [{"x": x(step - 0.5), "width": round(1000 / width, 1)} for step in at.tolist()],
        "bursts": [_burst(trace, row, steps) for steps in _runs(at)],
    }  # fmt: skip


def _runs(at: Array) -> list[Array]:
    """Return the steps in runs without a pause."""
    return np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)


def _burst(trace: Trace, row: int, steps: Array) -> str:
    """Return a burst in words: when, what, on which wires, and with which values."""
    kinds = list(dict.fromkeys(Kind(int(kind)).name.lower() for kind in trace.kind[steps, row]))
    target = trace.target[steps, row]
    names = [name for name, hit in zip(trace.model.wires, target.any(axis=(0, 1)).tolist(), strict=True) if hit]
    values = trace.value[steps, row][target]
    valued = any(EFFECTS[int(kind)].valued for kind in trace.kind[steps, row])
    low, high = (f"{bound:.3g}" for bound in (values.min(), values.max()))
    size = "" if not valued else f", {low}" if low == high else f", {low} to {high}"
    units = {EFFECTS[int(kind)].unit for kind in trace.kind[steps, row]} if valued else {""}
    size += f" {units.pop()}" if len(units) == 1 and "" not in units else ""
    start, end = (int(steps[0]) + 1) * trace.dt, (int(steps[-1]) + 1) * trace.dt
    when = f"{start:.1f} s" if start == end else f"{start:.1f} to {end:.1f} s"
    return f"{when}: {' and '.join(kinds)} on {', '.join(names)}{size}"
