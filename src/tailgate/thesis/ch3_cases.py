"""The thesis's two scenarios and two attacks (figures 3.2 and 3.3): who detects, when, and who collides."""

from __future__ import annotations

import dataclasses
import time
from typing import Any, NamedTuple

import numpy as np

from tailgate.core import Array, Defence, Estimate, Model, Prior, Received, draws
from tailgate.core.draws import Draws
from tailgate.core.registry import Spec, make
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.envs.controllers.radar_car import GAP
from tailgate.play.trace import Trace, rollout

from .ch4_cases import Tick
from .claims import Claim, Report, Spread, Table, verdict

DETECTED = 182  # step at which the thesis detects both attacks
PLACES = {"i": "thesis-ch3-v0", "ii": "thesis-ch3-switched-v0"}
ATTACKS = {
    "DoS": f"radar_jam:start_step={DETECTED}",
    "delay": "echo_delay:start_step=180,delay=6",
}
GUARDS = {
    "none": "no defence",
    "algorithm2": "Algorithms 1 and 2 as printed",
    "cra:filter=hold_last,challenge=fixed,watch=none": "challenge, last value held",
    "cra:filter=autoregressive,challenge=fixed,watch=none": "challenge, autoregression",
    "cra:filter=polynomial,challenge=fixed,watch=none": "challenge, polynomial",
    "cra:filter=kf,challenge=fixed,watch=none": "challenge, Kalman filter",
    "cra:challenge=fixed,watch=none": "challenge, joint RLS",
    "pycra:challenge=fixed,watch=none": "PyCRA, detection only",
    "chi2_kf": "chi-square gate, no challenge",
}
OURS = "cra:challenge=fixed,watch=none"
SWITCHES = (60.0, 100.0, 140.0, 150.0)


class Run(NamedTuple):
    """One scenario, attack and defence on all seeds; each figure (B,)."""

    trace: Trace
    collided: Array
    alarm: Array  # first step with an alarm, from 1; NaN for none
    error: Array  # RMSE of the gap from the attack's detection by the list to the end [m]

    @classmethod
    def of(cls, trace: Trace) -> Run:
        alarm = trace.alarm.any(axis=2) & trace.live
        first = np.where(alarm.any(axis=0), np.argmax(alarm, axis=0) + 1.0, np.nan)
        return cls(trace, np.asarray((trace.collided & trace.live).any(axis=0)), first, _rmse(trace))


Runs = dict[tuple[str, str, str], Run]


def _rmse(trace: Trace) -> Array:
    """(B,) RMSE of the gap from step 182 on [m], over the steps of the episode; NaN where it has ended before."""
    error = (trace.estimate - trace.truth)[DETECTED - 1 :, :, 0, GAP]
    live = trace.live[DETECTED - 1 :]
    count = live.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(np.where(live, error * error, 0.0).sum(axis=0) / np.where(count, count, np.nan)))


def play(place: Scenario, defence: str, attack: str, seeds: int, *, terminate: bool = True) -> Trace:
    """`seeds` report episodes of a defence under an attack, both as on the command line."""
    guard = Spec("defence", defence)
    keys = draws.keys("report", range(seeds))
    return rollout(place.loop(guard.make(), guard.entry.uses), Spec("attack", attack).make(), keys, terminate=terminate)


def play_all(seeds: int, tick: Tick) -> Runs:
    """Every scenario, attack (also none) and defence."""
    out: Runs = {}
    for number, name in PLACES.items():
        place = load_scenario(name)
        for case, attack in ({"clean": "none"} | ATTACKS).items():
            tick(f"scenario ({number}), {case}")
            for guard in GUARDS:
                out[number, case, guard] = Run.of(play(place, guard, attack, seeds))
    return out


def report(runs: Runs, seeds: int, tick: Tick) -> Report:
    out = Report("ch3", "", {})
    out.claims += [_detection(runs), _false_alarms(runs), _recovery(runs), _safety(runs), _algorithm1(runs)]
    out.tables += [_table(runs, number, case) for number in PLACES for case in ("clean", *ATTACKS)]
    tick("what the jammer leaves at the receiver")
    out.claims.append(_zeros(seeds))
    tick("scenario (ii): when the leader changes its acceleration")
    claim, table = _switches(seeds)
    out.claims.append(claim)
    out.tables.append(table)
    tick("run time")
    out.claims.append(_run_time())
    tick("the intelligent driver model in place of the cruise control")
    out.tables.append(_drivers(seeds))
    return out


def _detection(runs: Runs) -> Claim:
    found, share = {}, []
    for number in PLACES:
        for case in ATTACKS:
            at = runs[number, case, OURS].alarm
            found[f"({number}), {case}"] = {
                "median step": _median(at[np.isfinite(at)]),
                "runs with this step": float(np.mean(at == DETECTED)),
            }
            share.append(np.mean(at == DETECTED))
    return Claim(
        "3.5-detection", "Both attacks are detected at k = 182 s, in both scenarios", DETECTED, found,
        verdict(min(share) == 1.0, max(share) < 0.5), "challenges at 15, 50, 175 and 182; the delay begins at 180. The attacker does not "
        "listen: one that only repeats the probe is silent by itself when it is muted",
    )  # fmt: skip


def _median(values: Array) -> float | None:
    return float(np.median(values)) if len(values) else None


def _false_alarms(runs: Runs) -> Claim:
    positive = negative = challenges = attacked = 0
    for number in PLACES:
        clean = runs[number, "clean", OURS].trace
        muted = _muted(clean)
        positive += int((clean.alarm[:, :, 0] & muted & clean.live).sum())
        challenges += int((muted & clean.live).sum())
        for case in ATTACKS:
            trace = runs[number, case, OURS].trace
            hit = _muted(trace) & (trace.kind != 0) & trace.live
            attacked += int(hit.sum())
            negative += int((hit & ~trace.alarm[:, :, 0]).sum())
            challenges += int((_muted(trace) & trace.live).sum())
    return Claim(
        "3.5-errors", "The detection has no false positive and no false negative", "0 and 0",
        {"false positives": positive, "false negatives": negative, "of challenges": challenges, "of these under attack": attacked},
        verdict(positive + negative == 0 and attacked > 0, positive + negative > 0 or attacked == 0),
        "at challenges, of an attacker who does not hear them; between challenges nothing is tested, which the row on latency shows",
    )  # fmt: skip


def _muted(trace: Trace) -> Array:
    """(K, B) bool: the steps that were measured with a muted probe."""
    return np.concatenate([np.zeros_like(trace.probe[:1, :, 0]), ~trace.probe[:-1, :, 0]])


def _recovery(runs: Runs) -> Claim:
    found, good = {}, []
    for number in PLACES:
        for case in ATTACKS:
            spread = Spread.of(runs[number, case, OURS].error)
            found[f"({number}), {case}: RMSE of the gap [m]"] = spread.data()
            good.append(spread.median)
    return Claim(
        "3.4-recovery", "Recursive least squares predicts distance and relative velocity for the duration of the attack (182 to 300 s)",
        "estimates follow the data without attack", found, verdict(max(good) < 1.0, min(good) > 5.0),
        "the joint kinematic form with roll-back and reset, not Algorithm 1 as printed; yes: every median below 1 m",
    )  # fmt: skip


def _safety(runs: Runs) -> Claim:
    found, without, ours = {}, [], []
    for number in PLACES:
        for case in ATTACKS:
            shares = {guard: float(runs[number, case, guard].collided.mean()) for guard in ("none", OURS)}
            found[f"({number}), {case}"] = {"no defence": shares["none"], "with it": shares[OURS]}
            without.append(shares["none"])
            ours.append(shares[OURS])
    return Claim(
        "3.5-safety", "Without the defence the follower does not slow down as desired; with it it operates safely", "safe", found,
        verdict(max(ours) == 0.0 and min(without) > 0.5, max(ours) > 0.5),
        "share of runs that collide; in scenario (ii) the leader speeds up, and 6 m more do no harm: partly",
    )  # fmt: skip


def _algorithm1(runs: Runs) -> Claim:
    found, shares = {}, []
    for case in ATTACKS:
        run = runs["i", case, "algorithm2"]
        found[case] = {"collisions": float(run.collided.mean()), "RMSE of the gap [m]": Spread.of(run.error[np.isfinite(run.error)]).data()}
        shares.append(run.collided.mean())
    return Claim(
        "3.4-algorithm-1", "Algorithm 1 recovers the measurements from y', also under attack",
        "recovers", found, verdict(max(shares) == 0.0, min(shares) > 0.5),
        "as printed it goes on adapting to what the attacker sends; regressors [1, t/100], forgetting factor 0.95, delta = 1; scenario (i)",
    )  # fmt: skip


def _table(runs: Runs, number: str, case: str) -> Table:
    rows = []
    for guard, words in GUARDS.items():
        run = runs[number, case, guard]
        length = run.trace.length[run.collided]
        at = run.alarm[np.isfinite(run.alarm)]
        seen = np.isfinite(run.error)
        gap = run.trace.gap[-1, ~run.collided, 0]
        rows.append((
            words, f"{100 * run.collided.mean():.3g} %", f"{np.median(length) + 1:.0f}" if len(length) else "",
            f"{100 * len(at) / len(run.alarm):.0f} %", f"{np.median(at):.0f}" if len(at) else "",
            str(Spread.of(run.error[seen])) if seen.any() else "", f"{np.median(gap):.2f}" if len(gap) else "",
        ))  # fmt: skip
    heads = (
        "defence", "collisions", "at [s], median", "runs that alarm", "first alarm [s], median", "gap RMSE from 182 s [m]", "last gap [m]",
    )  # fmt: skip
    words = {"clean": "no attack", "DoS": "DoS from 182 s", "delay": "+6 m from 180 s"}[case]
    return Table(f"Scenario ({number}), {words}", heads, tuple(rows))


def _zeros(seeds: int) -> Claim:
    place, shares = load_scenario(PLACES["i"]), {}
    for words, attack in (
        ("U(180, 250) m, U(0, 60) m/s", ATTACKS["DoS"]),
        ("zeros", f"dos_jam:start_step={DETECTED},low=0,high=0"),
        ("U(0, 250), both", f"dos_jam:start_step={DETECTED},low=0,high=250"),
    ):
        trace = play(place, "none", attack, seeds)
        shares[words] = float((trace.collided & trace.live).any(axis=0).mean())
    return Claim(
        "3.5-jammer", "A jammer that corrupts the measurements causes a collision", "very high values", shares,
        verdict(min(shares.values()) > 0.9, max(shares.values()) < 0.1),
        "undefended runs that collide: the value that the jammer leaves at the receiver decides, and the thesis gives none",
    )  # fmt: skip


def _switches(seeds: int) -> tuple[Claim, Table]:
    place, rows, found = load_scenario(PLACES["ii"]), [], {}
    median: dict[float, float] = {}
    for at in SWITCHES:
        moved = dataclasses.replace(place, manoeuvre=make("manoeuvre", "switched", at=at))
        cells = []
        for words, guard in (("with reset", OURS), ("without", OURS + ",filter.threshold=none")):
            trace = play(moved, guard, ATTACKS["DoS"], seeds, terminate=False)
            error = _rmse(trace)
            crashed = float(trace.collided.any(axis=0).mean())
            found[f"{at:g} s, {words}"] = {"RMSE of the gap [m]": Spread.of(error).data(), "collisions": crashed}
            cells += [str(Spread.of(error)), f"{100 * crashed:.0f} %"]
            if words == "with reset":
                median[at] = float(np.median(error))
        rows.append((f"{at:g}", *cells))
    claim = Claim(
        "3.5-scenario-ii", "In scenario (ii) the estimates recover as in scenario (i)", "recovers", found,
        verdict(max(median.values()) < 1.0, min(median.values()) > 1.0),
        "DoS from 182 s; the thesis does not say when the leader changes its acceleration: a late change leaves too few samples for 118 s",
    )  # fmt: skip
    heads = ("leader's change at [s]", "RMSE of the gap, with reset [m]", "collisions", "without reset [m]", "collisions")
    return claim, Table("Scenario (ii): the later the leader changes its acceleration, the worse the prediction", heads, tuple(rows))


class _Timed:
    """A defence that adds up the time of its steps [s]."""

    def __init__(self, inner: Defence) -> None:
        self.inner, self.total = inner, 0.0

    def prepare(self, model: Model) -> Any:
        return self.inner.prepare(model)

    def start(self, plan: Any, prior: Prior) -> Any:
        return self.inner.start(plan, prior)

    def step(self, plan: Any, state: Any, received: Received, known_u: Array, draws: Draws) -> tuple[Any, Estimate]:
        begin = time.perf_counter()
        out = self.inner.step(plan, state, received, known_u, draws)
        self.total += time.perf_counter() - begin
        return out


def _run_time() -> Claim:
    guard, times = Spec("defence", OURS), {}
    for words, batch in (("one episode", 1), ("each of 1000 side by side", 1000)):
        fastest = np.inf
        for _ in range(3):
            timed = _Timed(guard.make())
            loop = load_scenario(PLACES["i"]).loop(timed, guard.entry.uses)
            rollout(loop, Spec("attack", ATTACKS["DoS"]).make(), draws.keys("report", range(batch)))
            fastest = min(fastest, timed.total / batch)
        times[words] = float(f"{1e9 * fastest:.2g}")
    return Claim(
        "3.5-run-time", "The algorithm runs in 1.2e7 ns under jamming, 1.3e7 ns under delay", "1.2e7 ns", {"300 steps [ns]": times},
        verdict(times["one episode"] < 1.2e7, times["each of 1000 side by side"] > 1.2e7),
        "wall-clock of the defence's 300 steps on the machine at hand, best of 3; the thesis names neither machine nor steps",
    )  # fmt: skip


def _drivers(seeds: int) -> Table:
    rows = []
    for words, driver in (("the thesis's ACC, corrected", "acc_radar"), ("IDM", "idm")):
        place = dataclasses.replace(load_scenario(PLACES["i"]), controller=make("controller", driver))
        for case, attack in ({"no attack": "none"} | ATTACKS).items():
            cells = []
            for guard in ("none", OURS):
                trace = play(place, guard, attack, seeds)
                crash = (trace.collided & trace.live).any(axis=0)
                cells += [f"{100 * crash.mean():.0f} %", f"{np.median(trace.gap.min(axis=(0, 2))):.2f}"]
            rows.append((words, case, *cells))
    heads = ("controller", "attack", "collisions, no defence", "least gap [m]", "collisions, challenge + RLS", "least gap [m]")
    return Table("Scenario (i) with the published Intelligent Driver Model in place of the cruise control", heads, tuple(rows))
