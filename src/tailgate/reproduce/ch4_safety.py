"""What the thesis concludes of safety, on scenarios that are long enough for a collision: 60 s behind a leader with manoeuvres."""

from __future__ import annotations

from typing import Any

import numpy as np

import tailgate
from tailgate import draws
from tailgate.core import Array
from tailgate.metrics import measure
from tailgate.scenario import Scenario, load_scenario
from tailgate.trace import Trace, rollout

from .ch4_cases import Tick
from .claims import Claim, Report, Spread, Table

PLACES = ("stop-and-go-v0", "braking-v0")
GUARDS = {"kf": "Kalman filter", "chi2_kf": "Algorithm 3", "rkf": "robust KF"}
ONSET = 100


def _play(place: Scenario, guard: str, attack: Any, seeds: int, *, terminate: bool = True) -> Trace:
    return rollout(place.loop(tailgate.make_defence(guard)), attack, draws.keys("report", range(seeds)), terminate=terminate)


def report(seeds: int, tick: Tick) -> Report:
    out = Report("ch4", "", {})
    tick("random attacks at 9 % duty, 60 s")
    claim, table = _duty(seeds)
    out.claims.append(claim)
    out.tables.append(table)
    tick("sustained stealth, 60 s")
    out.claims.append(_stealth(seeds))
    tick("blind ramps, a lasting bias, replay")
    out.claims += [_ramps(seeds), _reopening(seeds), _replay(seeds)]
    tick("sparse attacks")
    out.claims.append(_sparse(seeds))
    return out


def _duty(seeds: int) -> tuple[Claim, Table]:
    """Random values on each sensor in 9 % of the steps, as often as in the thesis's cases, but for a minute."""
    rows, change, excess, crashes = [], {}, {}, {}
    laws = {"none": None, "U(0, 77)": (0.0, 77.0), "U(-77, 77)": (-77.0, 77.0)}
    for name in PLACES:
        place = load_scenario(name).with_threat(fdi_bound=77.0)
        for guard, words in GUARDS.items():
            clean = None
            for label, law in laws.items():
                attack: Any = tailgate.make_attack("none")
                if law is not None:
                    value = {"name": "uniform", "low": law[0], "high": law[1]}
                    attack = tailgate.make_attack("fdi_sparse", probability=0.09, value=value)
                m = measure(_play(place, guard, attack, seeds))
                clean = m if clean is None else clean
                spreads = [str(Spread.of(m[k])) for k in ("rmse_position", "min_gap")]
                rows.append((name, words, label, *spreads, f"{100 * m['crashed'].mean():.1f} %"))
                if law is not None:
                    key = f"{name}, {label}: {words}"
                    change[key] = float(np.median(m["min_gap"] - clean["min_gap"]))
                    excess[key] = float(np.median(m["rmse_position"] / clean["rmse_position"]))
                    crashes[key] = float(m["crashed"].mean())
    worst = {words: max(v for k, v in crashes.items() if words in k) for words in GUARDS.values()}
    ours = worst.pop(GUARDS["chi2_kf"])
    beaten = [words for words, share in worst.items() if share > ours + 0.05]
    claim = Claim(
        "4.6.2-collision", "With its smaller error Algorithm 3 is likelier to prevent a collision than the others", "likelier",
        {"share of runs that collide": crashes, "change of the smallest gap [m]": change, "position RMSE over the clean one": excess},
        "yes" if len(beaten) == len(worst) else "partly" if beaten else "no",
        f"by more than 5 points in the worst place than the {' and the '.join(beaten) or 'others nowhere'}. RMSE says little of it: values "
        "with a positive mean double the error of the Kalman filter and cost fewer collisions than values around zero",
    )  # fmt: skip
    columns = ("scenario", "filter", "attack", "position RMSE [m]", "smallest gap [m]", "collisions")
    return claim, Table("A minute under random attacks at 9 % duty: what RMSE says and what the gap says", columns, tuple(rows))


def _stealth(seeds: int) -> Claim:
    shares, delays = {}, {}
    for name in PLACES:
        place = load_scenario(name).with_threat(knowledge="white", onset=ONSET, end=None)
        for guard, words in GUARDS.items():
            trace = _play(place, guard, tailgate.make_attack("stealth"), seeds)
            hit = (trace.collided & trace.live).any(axis=0)
            shares[f"{name}: {words}"] = float(hit.mean())
            if hit.any():
                delays[f"{name}: {words}"] = round(float(np.median((trace.length[hit] - ONSET) * trace.dt)), 1)
    return Claim(
        "4.3-stealth", "A stealthy attack that passes the chi-square detector does not have any impact on the stability of the system",
        "no impact", {"share of runs that collide": shares, "median time from onset to collision [s]": delays},
        "no" if min(shares.values()) > 0.5 else "partly", "each step aims just inside of the gate (of 20 where the filter has none)",
    )  # fmt: skip


def _ramps(seeds: int) -> Claim:
    place, rates = load_scenario("thesis-ch4-v0").with_threat(targets=("position",)), {}
    clean = float(_play(place, "chi2_kf", tailgate.make_attack("none"), seeds).alarm.mean())
    reached = {}
    for rate in (1.0, 2.0):
        attack = tailgate.make_attack("fdi_ramp", rate=-rate, start_step=50, limit=108.0)
        trace = _play(place, "chi2_kf", attack, seeds)
        rates[f"{rate:g} m a step"] = float(trace.alarm[49:99, :, 0].mean())
        reached[f"{rate:g} m a step"] = round(float(np.median(trace.estimate[98, :, 0, 0] - trace.truth[98, :, 0, 0])), 1)
    return Claim(
        "4.7-blind-ramp", "The attack vector must be stealthy by knowledge of the model to pass the detector (4.3)", "needs knowledge",
        {"alarms per step in 50 steps of a ramp": rates, "clean": clean, "error after 50 steps [m]": reached},
        "no" if max(rates.values()) < 0.02 else "partly", "a blind ramp on the position of the case study, Q = R = I",
    )  # fmt: skip


def _reopening(seeds: int) -> Claim:
    place = load_scenario("stop-and-go-v0").with_threat(targets=("position",), onset=ONSET, end=None)
    trace = _play(place, "chi2_kf", tailgate.make_attack("fdi", value=-20.0), seeds, terminate=False)
    alarm, error = trace.alarm[:, :, 0], trace.estimate[:, :, 0, 0] - trace.truth[:, :, 0, 0]
    late = slice(-100, None)
    shut = float(np.median(np.sum(alarm[ONSET - 1 :], axis=0)) * trace.dt)
    return Claim(
        "4.5-lasting-bias", "An attack that is detected is kept out: the filter runs open loop until it ends", "kept out",
        {
            "bias [m]": -20.0, "seconds of alarm in 50 s of bias": round(shut, 1),
            "alarms per step in the last 10 s": float(alarm[late].mean()),
            "error in the last 10 s [m]": round(float(np.median(error[late])), 1),
        },
        "no" if alarm[late].mean() < 0.05 and np.median(error[late]) < -15.0 else "partly",
        "open loop, P- grows until the bias is inside of the gate: the alarms stop, and the error is the bias",
    )  # fmt: skip


def _replay(seeds: int) -> Claim:
    found = {}
    for name in ("thesis-ch4-v0", "stop-and-go-v0"):
        place = load_scenario(name)
        place = place.with_threat(kinds=("replay",), onset=ONSET, end=None)
        trace = _play(place, "chi2_kf", tailgate.make_attack("replay", window=10, length=40), seeds, terminate=False)
        played = trace.kind != 0
        found[name] = {"alarms per replayed step": float(trace.alarm[:, :, 0][played].mean()), "runs detected": _detected(trace)}
    share = [v["runs detected"] for v in found.values()]
    return Claim(
        "4.7-replay", "The algorithm is not designed for replay, which is small and escapes the detector", "escapes", found,
        "yes" if max(share) < 0.1 else "partly" if min(share) < 0.5 else "no",
        "the last 10 samples, played four times; on the long scenario the replayed position falls behind the car, which is noticed",
    )  # fmt: skip


def _detected(trace: Trace) -> float:
    return float((trace.alarm[:, :, 0] & (trace.kind != 0)).any(axis=0).mean())


def _sparse(seeds: int) -> Claim:
    """Section 4.7: one of the sensors is attacked at a time."""
    place = load_scenario("thesis-ch4-fitted-v0")
    attack = tailgate.make_attack("fdi_bernoulli", probability=0.3, value=60.0)
    errors: dict[str, Array] = {}
    for guard in ("chi2_kf", "chi2_kf_sparse"):
        errors[guard] = measure(_play(place, guard, attack, seeds))["rmse_position"]
    wins = float(np.mean(errors["chi2_kf_sparse"] < errors["chi2_kf"]))
    return Claim(
        "4.7-sparse", "Against sparse attacks: find the attacked sensors and use the rest", "a good estimate",
        {name: Spread.of(e).data() for name, e in errors.items()} | {"share of seeds won by the gate per sensor": wins},
        "yes" if wins > 0.9 else "partly" if wins > 0.5 else "no",
        "position RMSE [m]; each sensor is hit with probability 0.3 a step, 60 on its reading, Q = R = 18.5 I",
    )  # fmt: skip
