"""The case study in the loop: a lidar that is made to see the car ahead farther away, the monitor of safe states, and the brake."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tailgate import draws
from tailgate.core import Array
from tailgate.registry import Spec
from tailgate.scenario import load_scenario
from tailgate.stats import proportion
from tailgate.trace import Trace, rollout
from tailgate.trust.cells import Outcome, outcome
from tailgate.trust.properties import Demands, Property, built_in
from tailgate.trust.properties import own as own_properties
from tailgate.trust.signals import SafeDistance

from .ch4_cases import Tick
from .ch7_trust import interval
from .claims import Claim, Report, Table, verdict

SCENARIO = "ch7-v0"
ABOUT = f"{SCENARIO}: 30 s of stop and go at dt = 0.05 s, a lidar accurate to 0.3 m, readings of its gap attacked"
NOTICE = 0.1  # within which the monitor has to be heard [s]; the automata's 100 time units
BELOW, DEADLINE = 20.0, 0.6  # the thesis's distance [m] and time [s]
ATTACKS = {
    "none": "none",
    "20 m farther, below 20 m": "fdi:trigger=near,threshold=20,value=-20",
    "20 m farther, from 5 s on": "fdi:start_step=100,value=-20",
    "0.3 m/s farther and farther": "fdi_ramp:start_step=100,rate=-0.015",
    "0.6 m/s farther and farther": "fdi_ramp:start_step=100,rate=-0.03",
}
JUMPS, RAMPS = list(ATTACKS)[1:3], list(ATTACKS)[3:]
GUARDS = {
    "no monitor": "kf",
    "chi-square gate": "chi2_kf",
    "monitor": "safe_state",
    "monitor and brake": "safe_state_brake",
    "monitor, brakes below 20 m": "safe_state_brake:distance=20",
}
BRAKES = list(GUARDS)[3:]


class Run(NamedTuple):
    """One attack and defence on all seeds."""

    collided: Array  # (B,)
    notice: Array  # (B,) from the first attacked step to the first alarm [s]; inf for none, NaN without an attack
    alarms: Array  # (B,) steps with an alarm
    gap: Array  # (B,) smallest [m]
    literal: Outcome  # below 20 m it brakes within 600 ms
    threat: Outcome  # the same once an attack has begun and the gap is unsafe


def literal() -> Property:
    """The thesis's demand, word for word."""
    place, asked = load_scenario(SCENARIO), Demands()
    last = (place.horizon - 1) * place.plant.dt - DEADLINE
    answer = f"(applied <= {-asked.braking:g} or speed <= {asked.stands:g})"
    return own_properties(place, [f"G[0,{last:g}] (gap < {BELOW:g} -> F[0,{DEADLINE:g}] {answer})"])[0]


def measured(trace: Trace) -> Run:
    live = trace.live
    attacked, alarm = (trace.kind != 0) & live, trace.alarm.any(axis=2) & live
    begin = np.where(attacked.any(axis=0), attacked.argmax(axis=0), 0)
    heard = alarm & (np.arange(len(alarm))[:, None] >= begin)
    notice = np.where(heard.any(axis=0), (heard.argmax(axis=0) - begin) * trace.dt, np.inf)
    threat = next(p for p in built_in(load_scenario(SCENARIO)) if p.name == "brakes")
    safe = SafeDistance()
    return Run(
        np.asarray((trace.collided & live).any(axis=0)), np.where(attacked.any(axis=0), notice, np.nan), alarm.sum(axis=0),
        np.where(live[:, :, None], trace.gap, np.inf).min(axis=(0, 2)), outcome(literal(), trace, safe), outcome(threat, trace, safe),
    )  # fmt: skip


Runs = dict[tuple[str, str], Run]


def play(seeds: int, tick: Tick) -> Runs:
    place, out = load_scenario(SCENARIO), {}
    for attack, text in ATTACKS.items():
        tick(f"in the loop: {attack}")
        for guard, name in GUARDS.items():
            spec = Spec("defence", name)
            keys = draws.keys("report", range(seeds))
            out[attack, guard] = measured(rollout(place.loop(spec.make(), spec.entry.uses), Spec("attack", text).make(), keys))
    return out


def report(seeds: int, tick: Tick) -> Report:
    runs, out = play(max(10, seeds // 2), tick), Report("ch7", "", {})
    out.claims += [_collision(runs), _interval(runs), _notified(runs), _prevented(runs), _brakes(runs)]
    out.tables.append(_table(runs))
    return out


def _share(good: Array) -> dict[str, float]:
    return interval(proportion(int(np.count_nonzero(good)), len(good)))


def _collision(runs: Runs) -> Claim:
    found = {attack: _share(runs[attack, "no monitor"].collided) for attack in ATTACKS}
    jumps = [found[attack]["low"] for attack in JUMPS]
    return Claim(
        "7.4-collision", "With spoofed lidar signals the controller cannot brake in time, and the car collides", "a collision", found,
        verdict(min(jumps) > 0.9, max(jumps) < 0.5), "share of runs that collide without a monitor: a Kalman filter believes the lidar",
    )  # fmt: skip


def _interval(runs: Runs) -> Claim:
    alarms = runs["none", "monitor"].alarms
    hits = {attack: _share(runs[attack, "monitor"].alarms > 0) for attack in JUMPS + RAMPS}
    return Claim(
        "7.3.2-interval", "Anything outside the interval of the sensor's specification and the dynamics is an attack", "outside: bad",
        {"alarms without an attack": int(alarms.sum()), "in runs": len(alarms), "runs with an alarm under attack": hits},
        verdict(int(alarms.sum()) == 0, int(alarms.sum()) > 0),
        "no false alarm, as noise and disturbances are bounded; the converse, that what is inside is good, does not follow",
    )  # fmt: skip


def _notified(runs: Runs) -> Claim:
    found: dict[str, Any] = {}
    for attack in JUMPS + RAMPS:
        notice = runs[attack, "monitor"].notice
        notice = notice[~np.isnan(notice)]
        if not len(notice):  # in no run did it begin
            continue
        median = float(np.median(notice))
        found[attack] = {
            f"within {1000 * NOTICE:g} ms": _share(notice <= NOTICE + 1e-9),
            "median [s]": median if np.isfinite(median) else "never",
        }
    lows = [found[attack][f"within {1000 * NOTICE:g} ms"]["low"] for attack in found] or [0.0]
    return Claim(
        "7.4-notified", "Safe state estimation detects the fault and notifies the controller within the desired time", "notified", found,
        verdict(min(lows) > 0.9, max(lows) < 0.5),
        "from the first attacked step to the first alarm: a jump leaves the set at once, what grows slowly after seconds, or never",
    )  # fmt: skip


def _prevented(runs: Runs) -> Claim:
    guards = [guard for guard in GUARDS if guard != "no monitor"]
    found = {attack: {guard: _share(~runs[attack, guard].collided) for guard in guards} for attack in JUMPS + RAMPS}
    lows = {attack: found[attack]["monitor and brake"]["low"] for attack in found}
    return Claim(
        "7.4-prevented", "Monitor and reactive controller prevent the collision", "prevented", found,
        verdict(min(lows.values()) > 0.95, max(lows.values()) < 0.5),
        "share of runs without a collision; dropping what is outside the set is enough against a jump, a chi-square gate does the same",
    )  # fmt: skip


def _brakes(runs: Runs) -> Claim:
    found: dict[str, Any] = {}
    for attack, guard in (("none", "no monitor"), *((attack, guard) for attack in (JUMPS[0], RAMPS[-1]) for guard in BRAKES)):
        run = runs[attack, guard]
        found[f"{attack}; {guard}"] = {
            "as worded": _share(run.literal.holds), "if under attack and unsafe": _share(run.threat.holds),
            "runs in which that came about": float(run.threat.asked.mean()),
        }  # fmt: skip
    worded = [runs[attack, "monitor, brakes below 20 m"].literal.holds.mean() for attack in (JUMPS[0], RAMPS[-1])]
    healthy = runs["none", "no monitor"].literal.holds.mean()
    return Claim(
        "7.4-600-loop", "When the distance is below 20 m the controller brakes within 600 ms to avoid a collision", "600 ms", found,
        verdict(bool(min(*worded, healthy) > 0.95), bool(max(*worded, healthy) < 0.5)),
        "as worded it is the wrong demand: a healthy car that creeps at 10 m has no reason to brake. Beside it: of cars under attack and "
        "too close to stop behind a braking leader (RSS), with how often that came about",
    )  # fmt: skip


def _table(runs: Runs) -> Table:
    rows = []
    for (attack, guard), run in runs.items():
        told = run.notice[~np.isnan(run.notice)]
        heard = told[np.isfinite(told)]
        rows.append((
            attack, guard, f"{100 * run.collided.mean():.1f} %", f"{np.median(run.gap):.1f}",
            f"{100 * len(heard) / len(told):.0f} %" if len(told) else "", f"{np.median(heard):.2f}" if len(heard) else "",
            f"{100 * run.literal.holds.mean():.0f} %", f"{100 * run.threat.holds.mean():.0f} %", f"{100 * run.threat.asked.mean():.0f} %",
        ))  # fmt: skip
    heads = (
        "attack", "defence", "collisions", "smallest gap [m], median", "alarms", "after [s], median", "brakes in 600 ms below 20 m",
        "brakes in 600 ms if attacked and unsafe", "runs in which it was",
    )  # fmt: skip
    return Table("The lidar's gap spoofed, in the loop", heads, tuple(rows))
