"""The worth of an attacker's timing: its outcome against that of the same policy at other times.

    timing advantage = P(damage | own schedule) - P(damage | yoked schedule)

Yoked: the steps at which another episode of the same policy attacked, recorded with termination off; values are still chosen in its own
state. Two more twins show the gain of attacking in bursts, which is not timing. Shuffled: as many steps of the episode at random times that
the threat model allows. Periodic: as many, evenly spread.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from tailgate.agents.policy.network_policy import PolicyAttack, Yoked
from tailgate.base.errors import InputError
from tailgate.core import Array, draws
from tailgate.core.draws import Draws, Keys, Role
from tailgate.core.loop import Loop
from tailgate.core.schema import as_data, canonical
from tailgate.evaluation.stats import Interval, paired_difference
from tailgate.play.metrics import METRICS, attack_steps, unit_in
from tailgate.play.trace import Trace, episodes_at_once, rollout

from .policies import BATCH, Trained, defence_of, distinct, is_share, loop_for, mean, outcome_for, scenario_of

TWINS = {  # each schedule, and what it is
    "own": "when the policy attacks",
    "yoked": "the times of another episode",
    "shuffled": "as many steps at random times",
    "periodic": "as many steps, evenly spread",
}
_SHUFFLE = 1  # tag of the draws in the policy's stream, at step 0


class Played(NamedTuple):
    """The results of one policy, (B,) under each schedule: its outcome and how many of its steps took effect."""

    outcome: dict[str, Array]
    steps: dict[str, Array]


def shuffled(recorded: Array, first: int, last: int, chance: Draws) -> Array:
    """Return as many steps of each episode as `recorded` (K, B) bool has, at random among the steps first..last, counted from 1."""
    order = np.ascontiguousarray(chance.uniform((len(recorded),), tag=_SHUFFLE).T)
    order[: first - 1], order[last:] = 2.0, 2.0  # behind every step that is allowed
    rank = np.argsort(np.argsort(order, axis=0, kind="stable"), axis=0, kind="stable")
    return np.asarray(rank < np.count_nonzero(recorded, axis=0))


def periodic(recorded: Array, first: int, last: int) -> Array:
    """Return as many steps of each episode as `recorded` (K, B) bool has, evenly spread over the steps first..last, counted from 1."""
    out = np.zeros_like(recorded)
    span = min(last, len(recorded)) - first + 1
    count, at = np.count_nonzero(recorded, axis=0), np.arange(span + 1)[:, None]
    passed = (2 * at * count + span) // (2 * span)
    out[first - 1 : first - 1 + span] = passed[1:] > passed[:-1]
    return out


def recorded(loop: Loop, policy: PolicyAttack, keys: Keys) -> Array:
    """Return (K, B) bool: the steps at which a policy attacks, to the horizon: an episode that ended early would have a short schedule."""
    out = np.zeros((loop.horizon, len(keys.key)), bool)
    for rows, part in _parts(loop, keys):
        out[:, rows] = rollout(loop, policy, part, terminate=False).kind != 0
    return out


def played(loop: Loop, policy: Any, keys: Keys, schedule: Array | None, counts: Sequence[Callable[[Trace], Array]]) -> list[Array]:
    """Play, and return metrics (B,) each of a policy at its own times, as of any attack, or where a `schedule` (K, B) is given at those."""
    out = [np.empty(len(keys.key)) for _ in counts]
    for rows, part in _parts(loop, keys):
        trace = rollout(loop, policy if schedule is None else Yoked(policy, schedule[:, rows]), part)
        for values, count in zip(out, counts, strict=True):
            values[rows] = count(trace)
    return out


def _parts(loop: Loop, keys: Keys) -> list[tuple[slice, Keys]]:
    """Return slices of as many episodes at a time as the memory for their traces allows."""
    size = episodes_at_once(loop.model, loop.horizon, BATCH)
    rows = [slice(start, start + size) for start in range(0, len(keys.key), size)]
    return [(part, Keys(keys.key[part], keys.episode[part])) for part in rows]


def yoked_to(schedule: Array) -> Array:
    """Return (K, B): each episode has the times of another one, the one before it."""
    return np.roll(schedule, 1, axis=1)


def timing_advantage(loop: Loop, policy: PolicyAttack, keys: Keys, outcome: str = "crashed") -> tuple[Array, Array]:
    """Return (own, yoked) outcomes (B,) of a policy, a metric: yoked plays the on and off runs of another episode of the same policy."""
    schedules = (None, yoked_to(recorded(loop, policy, keys)))
    own, yoked = (played(loop, policy, keys, schedule, [METRICS[outcome]])[0] for schedule in schedules)
    return own, yoked


def schedules(loop: Loop, policy: PolicyAttack, keys: Keys) -> dict[str, Array | None]:
    """Return (K, B) bool of each twin: when it attacks; none for the policy itself, which decides as it goes."""
    times = recorded(loop, policy, keys)
    first, last = loop.threat.onset, min(loop.threat.end or loop.horizon, loop.horizon)
    chance = keys.at(Role.POLICY, np.zeros(len(keys.key), np.int64))
    return {
        "own": None, "yoked": yoked_to(times), "shuffled": shuffled(times, first, last, chance), "periodic": periodic(times, first, last),
    }  # fmt: skip


def play(loop: Loop, policy: PolicyAttack, keys: Keys, outcome: str) -> Played:
    """Play a policy at its own times and at those of its twins, the same episodes each."""
    results = Played({}, {})
    for name, schedule in schedules(loop, policy, keys).items():
        results.outcome[name], results.steps[name] = played(loop, policy, keys, schedule, [METRICS[outcome], attack_steps])
    if any(np.isnan(values).any() for values in results.outcome.values()):
        raise InputError("outcome", outcome, "a metric that every episode has")
    return results


def timing(
    texts: Sequence[str], *, scenario: str | None = None, defence: str | None = None, threat: dict[str, Any] | None = None,
    dose: int | None = None, episodes: int = 1000, outcome: str | None = None, purpose: str = "report",
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Play, and return the report on policies by file or zoo name; those that differ in nothing but their training seed are one entry.

    Scenario, defence and threat model are those that each was trained in, where nothing else is given.
    """
    if episodes < 2:
        raise InputError("episodes", episodes, "at least 2: the schedule of another episode is needed")
    groups: dict[str, list[tuple[Trained, Loop, dict[str, Any]]]] = {}
    for who in distinct(texts):
        where, against = scenario_of(who, scenario), defence_of(who, defence)
        changed = who.threat | dict(threat or {})
        counted = outcome_for(outcome or who.outcome, where)
        loop = loop_for(who, where, against, changed, dose)
        facts = {
            "scenario": where, "defence": against, "learner": who.learner, "trained_on": who.defence, "outcome": counted,
            "unit": unit_in(counted, loop.model), "threat_model": as_data(loop.threat),
        }  # fmt: skip
        key = canonical(facts | {"action": who.header.action, "trained": [who.scenario, who.threat]})
        groups.setdefault(key, []).append((who, loop, facts))
    keys = draws.keys(purpose, range(episodes))
    total, done, entries = sum(map(len, groups.values())), 0, []
    for members in groups.values():
        runs = []
        for who, loop, facts in members:
            runs.append(play(loop, who.policy, keys, facts["outcome"]))
            done += 1
            if progress is not None:
                progress(done, total)
        entries.append(_entry([who for who, _, _ in members], members[0][2], runs, episodes))
    return {"measure": "timing advantage", "purpose": purpose, "episodes": episodes, "entries": entries}


def _entry(members: list[Trained], facts: dict[str, Any], runs: list[Played], episodes: int) -> dict[str, Any]:
    outcome, share = facts["outcome"], is_share(facts["outcome"])
    values = {name: np.array([run.outcome[name] for run in runs]) for name in TWINS}

    def gain(rows: slice, twin: str) -> Interval:
        return paired_difference(values["own"][rows], values[twin][rows], share=share)

    every = slice(None)
    advantage = {twin: gain(every, twin) for twin in TWINS if twin != "own"}
    policies = [
        {
            "policy": who.name, "seed": who.seed, "sha256": who.header.sha256,
            **{name: mean(values[name][i : i + 1], outcome)._asdict() for name in TWINS},
            "advantage": gain(slice(i, i + 1), "yoked")._asdict(),
        }
        for i, who in enumerate(members)
    ]  # fmt: skip
    return facts | {
        "episodes": episodes, "policies": policies,
        "outcomes": {name: mean(values[name], outcome)._asdict() for name in TWINS},
        "attack_steps": {name: float(np.mean([run.steps[name] for run in runs])) for name in TWINS},
        "advantage": {name: interval._asdict() for name, interval in advantage.items()},
        "flags": [] if advantage["yoked"].low > 0.0 else ["timing not shown to matter"],
    }  # fmt: skip
