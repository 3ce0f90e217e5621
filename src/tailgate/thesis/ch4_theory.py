"""Theorems 4.5.1-4.5.3, Lemma 4.5.4, the choice of eta (4.7) and the cost of a step, on the matrices of the case study."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial

import numpy as np
from scipy import special

from tailgate.agents.optimal.schedules import updated
from tailgate.core import Array, Model, Received
from tailgate.core.scenario import load_scenario
from tailgate.estimators.compose import AcceptAll, compose
from tailgate.estimators.detectors.chi_square import ChiSquare, GatedKalman
from tailgate.estimators.filters.kalman import KalmanFilter
from tailgate.evaluation.stats import proportion
from tailgate.play.metrics import measure

from . import bounds, ch4_figures
from .ch4_cases import ATTACKS, HARMFUL, READINGS, Reading
from .claims import Claim, Drawing, Part, Tick, verdict
from .probe import DRAWS, feed, start
from .runs import median, play

ETA = 20.0
ETAS = (1.0, 3.0, 6.0, 9.0, 13.0, 20.0, 40.0, 100.0)
SIZES = (4, 8, 16, 32, 64)


def case_study() -> Model:
    """Return the model of 4.6.2 as printed, Q = R = I."""
    return load_scenario("thesis-ch4-v0").brief().model


def _sizes(e: Array, P: Array) -> Array:
    """Return e' P^-1 e of (..., n) and (..., n, n)."""
    return np.asarray(np.einsum("...i,...i->...", e, np.linalg.solve(P, e[..., None])[..., 0]))


def _on_edge(rng: np.random.Generator, count: int, S: Array, eta: float) -> Array:
    """Return (count, n) random vectors with r' S^-1 r = eta."""
    r = rng.normal(size=(count, len(S)))
    return np.asarray(r * np.sqrt(eta / _sizes(r, np.broadcast_to(S, (count, *S.shape))))[:, None])


def parts(seeds: int, tick: Tick) -> Iterator[Part]:
    """Return the claims on theorems, threshold and cost, and the drawings of the last two."""
    tick("theorems 4.5.1 to 4.5.3 and lemma 4.5.4")
    model, rng, runs = case_study(), np.random.default_rng(0), 2000
    yield from (_theorem_1(model, rng, runs), _theorem_2(model, rng, runs), *_theorem_3(model, rng, runs), _lemma(model, rng, runs))
    yield from _false_alarms(model, rng, runs)
    yield from _trade_off(seeds, tick)
    tick("time of a step against n and q")
    yield from _step_times()


def _theorem_1(model: Model, rng: np.random.Generator, runs: int) -> Claim:
    P0 = np.eye(model.states)
    e0 = _on_edge(rng, runs, P0, ETA * (1 - 1e-9))
    fed = feed(GatedKalman(eta=ETA), model, P0, readings=np.zeros((150, runs, len(model.sensors))), x=e0)
    size = np.concatenate([np.full((1, runs), ETA), _sizes(fed.x, fed.P)])
    rises = float(np.max(size[1:] / np.maximum(size[:-1], 1e-300) - 1.0))
    final = float(size[-1].max())
    return Claim(
        "theorem-4.5.1", "Without noise, e0' P0^-1 e0 < eta: the gate never fires, and e' P^-1 e falls to zero",
        "holds",
        {
            "runs": runs, "alarms": int(fed.alarm.sum()), "largest relative rise of e'P^-1e in a step": max(rises, 0.0),
            "e'P^-1e after 150 steps, worst run": final,
        }, verdict(not fed.alarm.any() and rises < 1e-9 and final < 0.01 * ETA, bool(fed.alarm.any()) or rises > 1e-6),
        "e0 on the edge of what the theorem allows; zero: below a hundredth of eta after 150 steps",
    )  # fmt: skip


def _simulate(model: Model, rng: np.random.Generator, e0: Array, steps: int) -> tuple[Array, Array]:
    """Return truth (K, B, n) from e0 (B, n) without input, and readings (K, B, q)."""
    truth, x = np.empty((steps, *e0.shape)), e0
    w, v = np.linalg.cholesky(model.Q), np.linalg.cholesky(model.R[0])
    for k in range(steps):
        x = x @ model.A.T + rng.normal(size=x.shape) @ w.T
        truth[k] = x
    return truth, truth @ model.C[0].T + rng.normal(size=(steps, len(e0), len(v))) @ v.T


def _theorem_2(model: Model, rng: np.random.Generator, runs: int) -> Claim:
    P0 = np.eye(model.states)
    e0 = rng.normal(size=(4 * runs, model.states))
    e0 = e0[_sizes(e0, np.broadcast_to(P0, (len(e0), *P0.shape))) < ETA / 4][:runs]  # the condition eta_0 < eta / 4
    truth, y = _simulate(model, rng, e0, 50)
    fed = feed(GatedKalman(eta=ETA), model, P0, readings=y)
    good = (fed.score < ETA) & (_sizes(fed.x - truth, fed.P) < ETA)
    shares = good.mean(axis=1)
    promised = float(special.chdtr(model.states, ETA / 4))
    return Claim(
        "theorem-4.5.2", "With eta_0 < eta/4: g_k < eta and e_k' P_k^-1 e_k < eta with Pr(chi2 < eta/4)",
        round(promised, 4), {"smallest share over 50 steps": float(shares.min()), "runs": len(e0)},
        verdict(shares.min() >= promised, shares.min() < promised),
        f"the smallest share is {shares.min() / promised:.2f} times the promised probability",
    )  # fmt: skip


def _theorem_3(model: Model, rng: np.random.Generator, runs: int) -> list[Claim]:
    rest = bounds.steady_state(model)
    c = bounds.accepted_jump(rest.before, rest.after, ETA)
    worst = bounds.stealth_innovations(model.A, [rest], ETA * (1 - 1e-9), np.linalg.eigh(rest.before - rest.after)[1][:, -1])
    gate = GatedKalman(eta=ETA)
    reached = float(np.linalg.norm(feed(gate, model, rest.after, innovations=worst[:, None]).x[0, 0]) / c)
    sizes = rng.uniform(0.0, 100.0, size=(1, runs, 1)) * rng.normal(size=(1, runs, len(rest.S)))
    others = feed(gate, model, rest.after, innovations=sizes)
    passed = int((np.linalg.norm(others.x[0], axis=1) > c * (1 + 1e-9)).sum())
    grown, P = {}, rest.after
    for k in range(1, 151):
        step = updated(model.A @ P @ model.A.T + model.Q, model.C[0], model.R[0])
        P = step.before
        if k in (1, 10, 50, 150):
            grown[f"after {k - 1} rejected samples"] = round(bounds.accepted_jump(step.before, step.after, ETA), 3)
    growth = max(grown.values()) / min(grown.values())
    jump = Claim(
        "theorem-4.5.3", "There is a constant c, independent of the attack, with |x_k+1 - x_k+1|k| <= c", "bounded",
        {
            "c = sqrt(eta lambda_max(P- - P+))": grown, "largest jump reached / c": reached,
            "random attacks that pass c": f"{passed} of {runs}",
        }, verdict(passed == 0 and growth < 1.01, passed > 0),
        f"the bound is reached to a part in {1.0 / max(abs(1.0 - reached), 1e-12):.0e} by the worst attack; it depends on P-, and grows to "
        f"{growth:.0f} times its value while the gate is shut for 149 steps, so that it is no constant",
    )  # fmt: skip
    e = np.eye(model.states)[0]
    reach = {f"{n} steps": round(bounds.stealth_bound(model.A, [rest] * n, ETA, e), 1) for n in (1, 10, 50, 150)}
    played = feed(gate, model, rest.after, innovations=bounds.stealth_innovations(model.A, [rest] * 150, ETA * (1 - 1e-9), e)[:, None])
    unnoticed = not played.alarm.any()
    error = Claim(
        "4.5.2-resilience", "The theorem shows resilience: an arbitrary attack causes a bounded error only", "bounded error",
        {
            "farthest unnoticed displacement of the position [m]": reach, "played, 150 steps [m]": round(float(played.x[-1, 0, 0]), 1),
            "alarms": int(played.alarm.sum()),
        }, verdict(reach["150 steps"] < 2.0 * reach["50 steps"], unnoticed and reach["150 steps"] >= 3.0 * reach["50 steps"]),
        "the theorem bounds one step's jump; the error is bounded if the displacement that unnoticed steps reach levels off, and not if "
        "it grows at least as the number of steps",
    )  # fmt: skip
    return [jump, error]


def _lemma(model: Model, rng: np.random.Generator, runs: int) -> Claim:
    S, P = bounds.steady_state(model).S, bounds.steady_state(model).after
    c1, c2 = bounds.innovation_norms(S, ETA)
    r = rng.normal(size=(1, runs, len(S)))
    r /= np.linalg.norm(r, axis=2)[..., None]
    gate = GatedKalman(eta=ETA)
    above = feed(gate, model, P, innovations=c1 * (1 + 1e-9) * r).alarm.mean()
    below = feed(gate, model, P, innovations=c2 * (1 - 1e-9) * r).alarm.mean()
    printed = float(np.sqrt(ETA * np.linalg.eigvalsh(P)[-1])), float(np.sqrt(np.linalg.eigvalsh(P)[0]))
    axes = np.linalg.eigh(S)[1].T[:, None, None]
    tight = {
        "just below c1 along its axis": feed(gate, model, P, innovations=c1 * (1 - 1e-9) * axes[-1]).alarm.any(),
        "just above c2 along its axis": feed(gate, model, P, innovations=c2 * (1 + 1e-9) * axes[0]).alarm.any(),
    }
    is_tight = not tight["just below c1 along its axis"] and tight["just above c2 along its axis"]
    return Claim(
        "lemma-4.5.4", "|r| >= c1 always alarms, |r| <= c2 never does", {"c1": "sqrt(lambda_max(P) eta)", "c2": "sqrt(lambda_min(P))"},
        {
            "c1, c2 from S": [round(c1, 4), round(c2, 4)], "share of alarms just above c1": float(above),
            "share of alarms just below c2": float(below), "alarm": {key: bool(value) for key, value in tight.items()},
            "c1, c2 as printed": [round(v, 4) for v in printed],
        }, verdict(above == 1.0 and below == 0.0 and abs(printed[0] / c1 - 1.0) < 0.01, above < 1.0 or below > 0.0),
        f"with c1 = sqrt(eta lambda_max(S)) and c2 = sqrt(eta lambda_min(S)), {'tight' if is_tight else 'not tight'}; the printed "
        f"ones take P, of another dimension, for S and leave eta out of c2: {printed[0] / c1:.1f} and {printed[1] / c2:.2f} times these",
    )  # fmt: skip


def _false_alarms(model: Model, rng: np.random.Generator, runs: int) -> list[Claim]:
    P0, measured, gated, fits = np.eye(model.states), {}, {}, []
    _, y = _simulate(model, rng, rng.normal(size=(runs, model.states)), 150)
    for eta in (4.0, 9.0, 13.0):
        watch = feed(compose(KalmanFilter(), ChiSquare(eta=eta), AcceptAll()), model, P0, readings=y).alarm
        interval = proportion(int(watch.sum()), watch.size, 0.999)
        theory = bounds.false_alarm_rate(eta)
        measured[f"eta = {eta:g}"] = {
            "theory": theory, "watching": float(watch.mean()), "99.9 %": [interval.low, interval.high]
        }
        fits.append(interval.low <= theory <= interval.high)
        gated[f"eta = {eta:g}"] = float(feed(GatedKalman(eta=eta), model, P0, readings=y).alarm.mean() / theory)
    return [
        Claim(
            "4.2-false-alarm-rate", "In normal operation the chance of an alarm is a constant: exp(-eta/2) with two sensors",
            "constant", measured, "yes" if all(fits) else "no", "for a filter that only watches",
        ),
        Claim(
            "4.5-false-alarm-rate-gated", "The same with Algorithm 3, which drops what it suspects", "constant", gated,
            verdict(min(gated.values()) > 0.9 and max(gated.values()) < 1.1, max(gated.values()) > 1.25),
            "rate over exp(-eta/2): a dropped sample would have told the filter of its error, so that one false alarm begets the next "
            "where they are frequent",
        ),
    ]


def _trade_off(seeds: int, tick: Tick) -> Iterator[Claim | Drawing]:
    """Return the claims of 4.7, and their drawing."""
    curves = {}
    for reading in READINGS[::2]:  # the corrected plant
        tick(f"eta trade-off, {reading.name}")
        curves[reading.name] = curve = _curve(reading, seeds)
        cleanest, small = min(curve["clean"]), curve["clean"][0]
        best = {case: ETAS[int(np.argmin(curve[case]))] for case in HARMFUL}
        yield Claim(
            f"4.7-eta-bound-{reading.name}", "A smaller eta gives a smaller bound, and an algorithm more resilient to attacks", "smaller",
            {"c over sqrt(eta)": round(curve["bound"][0] / ETAS[0] ** 0.5, 4), "eta of the least error": best},
            verdict(all(eta == ETAS[0] for eta in best.values()), False),
            f"the bound falls as sqrt(eta); the error under attack is least at the eta given, of {ETAS[0]:g} to {ETAS[-1]:g}",
        )  # fmt: skip
        yield Claim(
            f"4.7-eta-false-positives-{reading.name}", "With a very small eta there are many false positives and large errors",
            "bad at small eta",
            {"eta": ETAS[0], "false alarms per step": curve["alarms"][0], "clean error over the best": small / cleanest},
            verdict(small > 1.2 * cleanest and curve["alarms"][0] > 0.1, small < 1.05 * cleanest and curve["alarms"][0] < 0.01),
            "attack-free runs; yes: an alarm in more than a tenth of the steps, and an error 1.2 times the least",
        )  # fmt: skip
    caption = "Section 4.7, the choice of eta: error with and without attack, the bound of one step's jump, false alarms."
    yield Drawing("figure-eta", caption, partial(ch4_figures.eta, curves, ETAS))


def _curve(reading: Reading, seeds: int) -> dict[str, list[float]]:
    """Return the bound, the errors and the false alarms over ETAS."""
    rest = bounds.steady_state(load_scenario(reading.scenario).brief().model)
    out: dict[str, list[float]] = {"bound": [], "alarms": [], **{case: [] for case in ATTACKS}}
    for eta in ETAS:
        out["bound"].append(bounds.accepted_jump(rest.before, rest.after, eta))
        for case, attack in ATTACKS.items():
            trace = play(reading.scenario, GatedKalman(eta=eta), attack, seeds, terminate=False)
            out[case].append(median(measure(trace)["rmse_position"]))
            if case == "clean":
                out["alarms"].append(float(trace.alarm.mean()))
    return out


def _step_times(batch: int = 16, repeats: int = 5) -> Iterator[Claim | Drawing]:
    """Return the claim of 4.5.1 on the seconds of a step of Algorithm 3 against n and q, each alone and both, and its drawing."""
    times = {
        "n (q = 2)": {size: _step_time(size, 2, batch, repeats) for size in SIZES},
        "q (n = 2)": {size: _step_time(2, size, batch, repeats) for size in SIZES},
        "n = q": {size: _step_time(size, size, batch, repeats) for size in SIZES},
    }
    big = [size for size in SIZES if size >= 16]
    slopes = {name: round(float(np.polyfit(np.log(big), np.log([curve[s] for s in big]), 1)[0]), 2) for name, curve in times.items()}
    steepest = max(slopes.values())
    yield Claim(
        "4.5.1-complexity", "A step costs O(max(n, q)^3), as that of the Kalman filter", 3, {"exponent from 16 to 64": slopes},
        verdict(steepest <= 3.0, steepest > 3.5),
        f"least time of {repeats}, {batch} episodes side by side; an exponent of at most 3 agrees with the bound",
    )  # fmt: skip
    caption = "Time of a step against the number of states n and of sensors q; the claim is at most slope 3. Wall-clock: other load shows."
    yield Drawing("figure-cost", caption, partial(ch4_figures.cost, times))


def _step_time(n: int, q: int, batch: int, repeats: int) -> float:
    """Return the least seconds of a step of one episode."""
    rng = np.random.default_rng(n * 1000 + q)
    A = rng.normal(size=(n, n))
    A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
    model = Model(
        A, np.zeros((n, 1)), np.zeros(n), rng.normal(size=(1, q, n)), np.eye(n), np.eye(q)[None], np.eye(1, dtype=bool), 0.01,
        tuple(f"y{i}" for i in range(q)),
    )  # fmt: skip
    gate, best = GatedKalman(eta=1e9), np.inf
    plan, state = start(gate, model, np.zeros((batch, n)), np.eye(n))
    received = Received(rng.normal(size=(batch, 1, q)), np.ones((batch, 1, q), bool), np.zeros((batch, 1)))
    for _ in range(repeats):
        begun = time.perf_counter()
        gate.step(plan, state, received, np.zeros((batch, 1, 1)), DRAWS)
        best = min(best, time.perf_counter() - begun)
    return best / batch
