"""The platoon in closed loop: the controllers act on the estimates, and the leader brakes to a stop (chapter 6, what collides)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from tailgate import num
from tailgate.core import Array
from tailgate.core.registry import Spec, make
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.envs.plants.platoon import Platoon
from tailgate.evaluation.stats import proportion
from tailgate.play.metrics import measure
from tailgate.play.trace import Trace

from . import ch6_figures
from .ch6_cases import LAM, LOOP_LAM
from .claims import Claim, Drawing, Part, Table, Tick, verdict
from .runs import collided, median, play
from .string_stability import peak

SCENARIO = "platoon-braking-v0"
LASSO = "lasso_dkf:unit=sensor,lam={}"
DEFENCES = {"none": "none", "DKF": "dkf", "lasso": LASSO.format(LOOP_LAM)}
LOW_LAM = 1.0  # a price at which a false reading in every step moves the estimate little
LOW = LASSO.format(LAM)  # at the price of the thesis's figures
ATTACKS = {
    "no attack": "none",
    "+60 m, p = 0.5": "fdi:value=60.0,chance=0.5,targets=[distance]",
    "hold d and v, p = 0.5": "dos_hold:chance=0.5,targets=[distance,velocity]",
    "+60 m, p = 1": "fdi:value=60.0,targets=[distance]",
    "20 randn m, p = 1": "fdi_gaussian:sd=20.0,targets=[distance]",
    "+8 m/s^2 on car 2's message": "fdi:value=8.0,targets=[predecessor_acceleration]",
}
EVERY = "+60 m, p = 1"
FLIP = 0.25  # change of a share that is one of a verdict
LAMS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
STRINGS = (
    ("kp = 0.1, kd = 0.5", 0.1, 0.5),
    ("kp = 0.5, kd = 1", 0.5, 1.0),
    ("kp = 0.05, kd = 0.3", 0.05, 0.3),
)
Safe = dict[tuple[str, str], int]  # runs without a collision, by attack and defence


def _play(scenario: Scenario, defence: str, attack: str, seeds: int) -> Trace:
    if "predecessor_acceleration" in attack:
        scenario = scenario.with_threat(targets=("distance", "velocity", "acceleration", "predecessor_acceleration"))
    return play(scenario, Spec("defence", defence).make(), attack, seeds)


def _safe(trace: Trace) -> int:
    return int((~collided(trace)).sum())


def _worst(trace: Trace) -> float:
    """Return the largest own-distance error of car 2 [m], the median over runs."""
    error = np.where(trace.live, trace.model.error(trace.estimate, trace.truth)[:, :, 2], 0.0)
    return median(error.max(axis=0))


def parts(seeds: int, tick: Tick) -> Iterator[Part]:
    """Return claims, tables and the drawing of the closed loop."""
    scenario, rows = load_scenario(SCENARIO), []
    safe: Safe = {}
    for label, attack in ATTACKS.items():
        tick(f"closed loop: {label}")
        traces = {name: _play(scenario, defence, attack, seeds) for name, defence in DEFENCES.items()}
        safe |= {(label, name): _safe(trace) for name, trace in traces.items()}
        rows.append((label, *(f"{_safe(trace)} ({np.median(measure(trace)['min_gap']):.1f} m)" for trace in traces.values())))
    title = f"Runs of {seeds} without a collision (median smallest gap), followers not told u_r"
    yield Table(title, ("attack on car 2 from 20 s", *DEFENCES), tuple(rows))
    cheap = {what: _play(scenario, LASSO.format(LOW_LAM), ATTACKS[what], seeds) for what in ("no attack", EVERY)}
    safe[EVERY, "low"] = _safe(cheap[EVERY])
    yield from (_collision(safe, seeds), _every_step(safe, seeds, _worst(cheap["no attack"])), _zero_mean(safe, seeds))
    tick("closed loop: the leader's input known, and at rest")
    yield from (_known(scenario, safe, seeds), _equilibrium(scenario, seeds))
    tick("closed loop: choice of lam")
    yield from _choice(scenario, seeds)
    yield from _string()


def _share(count: int, seeds: int) -> dict[str, float]:
    interval = proportion(count, seeds)
    return {"share": count / seeds, "low": interval.low, "high": interval.high}


def _collision(safe: Safe, seeds: int) -> Claim:
    hit = ("+60 m, p = 0.5", "hold d and v, p = 0.5")
    measured = {f"{label}: {name}": _share(safe[label, name], seeds) for label in hit for name in DEFENCES}
    ok = all(safe[label, "lasso"] == seeds and safe[label, "DKF"] < 0.1 * seeds for label in hit)
    return Claim(
        "6.6-no-collision", "With the resilient estimator a collision is unlikely, as the error stays below d_r = 5 m", "unlikely",
        measured, verdict(ok, any(safe[label, "lasso"] < 0.5 * seeds for label in hit)),
        "share of runs without a collision in closed loop, attacked in half of the steps",
    )  # fmt: skip


def _every_step(safe: Safe, seeds: int, clean: float) -> Claim:
    """Return the claim at two prices; clean: the error without an attack at the lower one [m]."""
    low = safe[EVERY, "low"]
    measured: dict[str, Any] = {name: _share(safe[EVERY, name], seeds) for name in DEFENCES}
    measured[f"lasso, lam = {LOW_LAM:g}"] = _share(low, seeds)
    measured[f"error without an attack, lam = {LOW_LAM:g} [m]"] = round(clean, 2)
    return Claim(
        "6.6-every-step", "As the error is bounded (Theorem 6.5.4), the platoon is safe however often the attack comes", "bounded",
        measured, verdict(safe[EVERY, "lasso"] == seeds, max(safe[EVERY, "lasso"], low) < 0.05 * seeds),
        f"share of runs without a collision when car 2's distance is 60 m too large in every step, lam = {LOOP_LAM:g} where none is given; "
        "the theorem bounds a step, not their sum, and a lower price trusts no reading much, honest ones included",
    )  # fmt: skip


def _zero_mean(safe: Safe, seeds: int) -> Claim:
    label = "20 randn m, p = 1"
    return Claim(
        "6.6-random", "Random false data of zero mean are an attack that endangers the platoon without the resilient estimator",
        "large errors", {name: _share(safe[label, name], seeds) for name in DEFENCES},
        verdict(safe[label, "DKF"] < 0.5 * seeds, safe[label, "DKF"] > 0.95 * seeds),
        "share of runs without a collision: the cars average it out",
    )  # fmt: skip


@dataclass(frozen=True)
class Untold(Platoon):
    """The platoon in which no filter knows any command, the leader's own included."""

    def known(self, plan: object, u: Array, exo: Array, state: object) -> Array:
        return num.zeros(u.shape)


def _known(scenario: Scenario, safe: Safe, seeds: int) -> Claim:
    """Ask who has to know the leader's command, at the price of the closed loop and at that of the thesis's figures."""
    fields = {f.name: getattr(scenario.plant, f.name) for f in dataclasses.fields(scenario.plant)}
    scenarios = {
        "all": dataclasses.replace(scenario, plant=Platoon(**fields | {"leader_input_known": True})),
        "the leader": scenario,
        "nobody": dataclasses.replace(scenario, plant=Untold(**fields)),
    }
    measured: dict[str, dict[str, float]] = {}
    for label in ("+60 m, p = 0.5", "+60 m, p = 1"):
        for words, defence, known in (
            ("DKF", DEFENCES["DKF"], "DKF"), (f"lasso, lam = {LOOP_LAM:g}", DEFENCES["lasso"], "lasso"), (f"lasso, lam = {LAM:g}", LOW, ""),
        ):  # fmt: skip
            counts = {"the leader": safe[label, known]} if known else {}
            counts |= {who: _safe(_play(where, defence, ATTACKS[label], seeds)) for who, where in scenarios.items() if who not in counts}
            measured[f"{label}: {words}"] = {f"known to {who}": counts[who] / seeds for who in scenarios}
    flips = [max(row.values()) - min(row.values()) > FLIP for row in measured.values()]
    return Claim(
        "6.6-known-input-loop", "The same in closed loop", "known", measured, verdict(not any(flips), all(flips)),
        "share of runs without a collision, by whose filters know u_r; yes: no share changes by more than a quarter, no: all do. The "
        "leader's prediction carries its command to all who hear it, so that telling them as well changes nothing. Without it a filter at "
        "a low price cannot follow its brakes, and one at a high price can",
    )  # fmt: skip


def _equilibrium(scenario: Scenario, seeds: int) -> Claim:
    still = dataclasses.replace(scenario, manoeuvre=make("manoeuvre", "constant", value=0.0))
    errors = {
        label: _worst(_play(where, DEFENCES["DKF"], ATTACKS["hold d and v, p = 0.5"], seeds))
        for label, where in (("leader brakes", scenario), ("leader keeps its speed", still))
    }
    return Claim(
        "6.6-hold", "Replaying an old value harms whenever it is done", "harms", errors,
        verdict(errors["leader keeps its speed"] > 5.0, errors["leader keeps its speed"] < 1.0),
        "largest own-distance error of car 2 [m] with the non-resilient estimator: at equilibrium the old value is the right one",
    )  # fmt: skip


def _choice(scenario: Scenario, seeds: int) -> tuple[Table, Drawing]:
    """Set the price lam: error under attack against error without."""
    few = min(seeds, 60)
    rows, curves = [], {"lam": np.array(LAMS)}
    for label in ("no attack", "+60 m, p = 0.5", "hold d and v, p = 0.5"):
        traces = [_play(scenario, LASSO.format(lam), ATTACKS[label], few) for lam in LAMS]
        curves[label] = np.array([_worst(trace) for trace in traces])
        rows.append((label, *(f"{_worst(trace):.2f} m, {_safe(trace)}/{few}" for trace in traces)))
    heads = ("attack", *(f"lam = {lam:g}" for lam in LAMS))
    table = Table("The price lam: largest own-distance error of car 2, median, and runs without a collision", heads, tuple(rows))
    caption = "The price lam in closed loop: a low one distrusts honest news of a braking leader, a high one believes the attacker."
    return table, Drawing("figure-lam", caption, partial(ch6_figures.choice, curves))


def _string() -> tuple[Claim, Table]:
    plant, gains = load_scenario(SCENARIO).plant, {}
    for words, kp, kd in STRINGS:
        for weights in ((1.0, 1.0), (0.5, 0.5), (1.0, 0.0)):
            gains[words, str(weights)] = peak(plant, make("controller", "cacc", kp=kp, kd=kd, weights=weights))
    rows = tuple((*key, f"{found.gain.max():.3f}", "yes" if found.stable else "no") for key, found in gains.items())
    stable = [found.stable for found in gains.values()]
    claim = Claim(
        "6.2-string", "The platoon's law is string stable", "|V_i / V_0| <= 1", {f"{r[0]}, w = {r[1]}": float(r[2]) for r in rows},
        verdict(all(stable), not any(stable)),
        "largest gain over frequency and cars at tau_h = 3 s; the thesis gives no gains of the controller",
    )  # fmt: skip
    title = "String stability: largest |V_i / V_0| over frequency and cars"
    return claim, Table(title, ("gains", "(w1, w0)", "gain", "string stable"), rows)
