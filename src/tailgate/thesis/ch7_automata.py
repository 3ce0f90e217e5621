"""The three automata of the case study: what their queries give, and what the answers rest on."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from tailgate.core import Array
from tailgate.evaluation.stats import Interval, proportion
from tailgate.trust.automata import Atom, Network, Query, load_network
from tailgate.trust.simulate import Runs, simulate

from . import ch7_figures
from .ch7_trust import PRINTED, RUNS, THESIS, first, interval, judge
from .claims import Claim, Drawing, Part, Table, verdict
from .runs import share

NETWORK = "reactive-braking"
TEXTS = {
    "monitor": "Pr[<= 1000](<> clk_p > 1) of the monitor",
    "controller": "Pr[<= 1000](<> time < 100 and obs = 1) of the reactive controller",
    "actuator": "Pr[<= 1000](<> time < 500 and apply_break = 1) of the actuator",
}
LIMITS = {"Intermediate": (50.0, 100.0, 200.0, 400.0), "braking": (100.0, 250.0, 500.0, 900.0)}
DEADLINES = np.arange(0.0, 1001.0, 10.0)
MEAN_ALARM = 1.5 * math.log(2.0)  # of a delay between 1 / r and 2 / r, r drawn from [1, 2]


def closed_form(limit: float, deadline: float, before: float = 0.0) -> float:
    """Return P(alarm + U(0, before) + U(0, limit) < deadline) where all but the last are over by the deadline and it may not be.

    `before` is the limit of an earlier uniform delay; needs 2 + before <= deadline <= limit.
    """
    return (deadline - MEAN_ALARM - 0.5 * before) / limit


BELOW = closed_form(500.0, 500.0, 100.0)
WHY = {
    "monitor": "true by construction: the only way on is guarded by it, and the invariant forces the way on",
    "controller": f"by construction: with limits as invariants P is (100 - {MEAN_ALARM:.2f}) / 100 = {closed_form(100.0, 100.0):.4f}, "
    "the deadline less the mean time of the alarm over the invariant",
    "actuator": f"with limits as invariants P is (500 - 50 - {MEAN_ALARM:.2f}) / 500 = {BELOW:.4f}, and 36 of 36 have a chance of "
    f"{100.0 * BELOW**RUNS:.1f} %; as guards, with delays of rate 1, both delays are over almost at once",
}
Curves = dict[tuple[str, float], Array]  # share of runs by deadline, by the location whose limit is varied


class Played(NamedTuple):
    """Runs by reading of the limits: as invariants, or as guards. The first RUNS represent the thesis's."""

    many: int
    invariants: Runs
    guards: Runs

    def of(self, row: int) -> dict[str, Array]:
        """Return (many,) when a query is first met, by reading."""
        return {"invariants": self.invariants.hit[row], "guards": self.guards.hit[row]}


def as_guards(network: Network) -> Network:
    """Make the limits of 100 and 500 guards: the location is left after an exponential delay of rate 1."""
    out = network.with_location("controller", "Intermediate", invariant=())
    out = out.with_edge("controller", "Intermediate", "Command", guard=(Atom("react", "<=", 100.0),))
    out = out.with_location("actuator", "braking", invariant=())
    return out.with_edge("actuator", "braking", "break", guard=(Atom("press", "<=", 500.0),))


def play_all(seeds: int) -> Played:
    """Run both readings, a hundred times as often as a chapter has seeds."""
    network, many = load_network(NETWORK), 100 * seeds
    return Played(many, simulate(network, range(many)), simulate(as_guards(network), range(many)))


def parts(runs: Played, seeds: int) -> Iterator[Part]:
    """Return claims, tables and drawings of the automata."""
    network = load_network(NETWORK)
    yield from (_query(runs, i, name) for i, name in enumerate(TEXTS))
    curves = _curves(network, 10 * seeds)
    yield from (_construction(runs, curves, 10 * seeds), _in_time(network, 10 * seeds), *_long(network, seeds))
    yield from (_table(runs), _limits(curves))
    caption = "Figure 7.2 again, as read from section 7.4. Thick: where it begins; dashed: signals that table 7.1 does not trust."
    yield Drawing("figure-7-2", caption, partial(ch7_figures.automata, network))
    caption = (
        "The answer to a query is what its deadline and the location's limit make it. Band: the thesis's interval; line: its deadline; "
        "the thesis's limits are 100 and 500."
    )
    yield Drawing("figure-queries", caption, partial(ch7_figures.queries, DEADLINES, LIMITS, curves))


def met(hit: Array) -> Interval:
    """Return the share of the runs (n,) in which a query is met."""
    return share(np.isfinite(hit))


def _query(runs: Played, row: int, name: str) -> Claim:
    found, intervals = {}, []
    for reading, hit in runs.of(row).items():
        intervals.append(met(hit))
        found[reading] = {f"of {RUNS}": interval(met(first(hit))), f"of {runs.many}": interval(met(hit))}
    holds, note = judge(intervals, THESIS[0], THESIS[0])
    return Claim(f"7.4-{name}", TEXTS[name], PRINTED, found, holds, WHY[name] + note)


def _table(runs: Played) -> Table:
    rows = []
    for row, name in enumerate(TEXTS):
        for reading, hit in runs.of(row).items():
            few = int(np.isfinite(first(hit)).sum())
            chance = f"{met(hit).value ** RUNS:.3f}"
            rows.append((TEXTS[name], reading, f"{few} of {RUNS}", _words(proportion(few, RUNS)), _words(met(hit)), chance))
    heads = ("query", "limits are", "runs", "95 %", f"of {runs.many}, 95 %", "chance of 36 in 36")
    return Table("The three queries", heads, tuple(rows))


def _words(i: Interval) -> str:
    return f"{i.value:.4f} [{i.low:.4f}, {i.high:.4f}]"


def _curves(network: Network, count: int) -> Curves:
    """Return when the variable is first 1, as a distribution: its value at a deadline answers the query with that deadline."""
    out: Curves = {}
    for where, clock, component, variable in (
        ("Intermediate", "react", "controller", "obs"), ("braking", "press", "actuator", "apply_break"),
    ):  # fmt: skip
        query = Query(variable, DEADLINES[-1], (Atom(variable, "=", 1.0),))
        for limit in LIMITS[where]:
            changed = network.with_location(component, where, invariant=(Atom(clock, "<=", limit),))
            hit = simulate(changed, range(count), queries=[query]).hit[0]
            out[where, limit] = np.array([float(np.mean(hit < deadline)) for deadline in DEADLINES])
    return out


def _at(curves: Curves, where: str, limit: float, deadline: float) -> float:
    return float(curves[where, limit][int(np.searchsorted(DEADLINES, deadline))])


def _construction(runs: Played, curves: Curves, count: int) -> Claim:
    """Judge by the thesis's own limits, and show what other limits give."""
    own, sensitivity, off = {}, {}, []
    for row, name, form in ((1, "controller", closed_form(100.0, 100.0)), (2, "actuator", BELOW)):
        declared, guards = (met(hit) for hit in runs.of(row).values())
        own[name] = {"as invariants": interval(declared), "closed form": round(form, 4), "as guards": guards.value}
        off.append(abs(declared.value - form) / math.sqrt(form * (1.0 - form) / runs.many))
    for where, deadline, before in (("Intermediate", 100.0, 0.0), ("braking", 500.0, 100.0)):
        for limit in LIMITS[where]:
            found = _at(curves, where, limit, deadline)
            sensitivity[f"{where} <= {limit:g}, deadline {deadline:g}"] = found
            if limit >= deadline:
                form = closed_form(limit, deadline, before)
                off.append(abs(found - form) / math.sqrt(form * (1.0 - form) / count))
    forms, agree = [closed_form(100.0, 100.0), BELOW], max(off) < 4.0
    return Claim(
        "7.4-verified", "The queries verify that the reactive sub-system acts within its deadlines", "verified",
        {"the thesis's limits": own, "largest distance from the closed form in standard errors": max(off), "other limits": sensitivity},
        verdict(agree and min(forms) >= THESIS[0], agree and max(forms) < THESIS[0]),
        "at the thesis's limits the controller's closed form is above 0.9026 and the actuator's below (as guards both are 1); the answer "
        "is a deadline over a limit, both written into the model, so that nothing of a car decides it, as other limits show",
    )  # fmt: skip


def _limits(curves: Curves) -> Table:
    rows = []
    for where, deadlines in (("Intermediate", (50.0, 100.0, 200.0, 400.0)), ("braking", (100.0, 250.0, 500.0, 900.0))):
        rows += [
            (where, f"{limit:g}", *(f"before {d:g}: {_at(curves, where, limit, d):.3f}" for d in deadlines)) for limit in LIMITS[where]
        ]
    title = "What changes when limits and deadlines change: share of runs in which the command (the brake) comes in time"
    return Table(title, ("location", "its limit", *["share"] * 4), tuple(rows))


def _in_time(network: Network, count: int) -> Claim:
    """Measure from the alarm to the brake, not from the beginning of time."""
    alarm = Query("alarm", 1000.0, (Atom("clk_p", ">", 1.0),))
    brake = Query("brake", 1000.0, (Atom("apply_break", "=", 1.0),))
    hit = simulate(network, range(count), queries=[alarm, brake]).hit
    took = hit[1] - hit[0]
    within = share(took <= 600.0 + 1.0)
    holds, note = judge([within], 0.95, 0.9)
    return Claim(
        "7.4-600", "When the distance is below 20 m the reactive controller brakes within 600 ms", 600,
        {"automata: within 600 of clk_p > 1": interval(within), "median": float(np.median(took)), "longest": float(took.max())},
        holds,
        f"of the automata alone, time units as milliseconds: the limits 100 and 500 add up to it; one unit for the alarm itself{note}",
    )  # fmt: skip


def _long(network: Network, seeds: int) -> list[Claim]:
    """Run the whole 1000 time units, whatever has held."""
    runs = simulate(network, range(seeds), within=1000.0, queries=[])
    taken = {edge.sync: runs.taken[e] for e, (_, edge) in enumerate(network.edges()) if edge.sync}
    alarms = taken["obs_detect!"]
    heard = {name: float(taken[f"{name}?"].sum() / max(1, taken[f"{name}!"].sum())) for name in network.channels}
    return [
        Claim(
            "7.4-scenario", "The automata verify the scenario in which an adversary spoofs the lidar", "verify",
            {"alarms in 1000 time units without any attack": float(alarms.mean()), "fewest": int(alarms.min())},
            verdict(bool(alarms.max() == 0), bool(alarms.min() > 0)),
            "the model holds no distance, no lidar and no adversary; clk_p passes 1 in every round by itself, which is an alarm each time",
        ),
        Claim(
            "7.4-resume", "After signal_acc! the actuator returns to acc: the collision has been avoided and the vehicle resumes",
            "returns", {"share heard": {"signal_break": heard["signal_break"], "signal_acc": heard["signal_acc"]}},
            verdict(heard["signal_acc"] > 0.95, heard["signal_acc"] < 0.5),
            "share of the sent signals that the actuator is listening to: an alarm is over within a few time units, the brake takes up to "
            "500, so that it is mostly told to go on before it has begun to brake, and then brakes",
        ),
    ]  # fmt: skip
