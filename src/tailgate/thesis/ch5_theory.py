"""The theorems of chapter 5 and their limits: fixed point, convergence, bound, and the number of compromised agents."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial

import numpy as np

from tailgate import num
from tailgate.core import Array, Defence, Model, Prior, Received, draws
from tailgate.core.registry import Spec, make
from tailgate.estimators.distributed.distributed_kalman import fixed_point, neighbours

from . import ch5_figures
from .ch5_cases import CHANCE, COMPROMISED, DEFENCES, LAM, ONSET, SD, defence, errors, figure, fresh, over, random_attack, worst
from .claims import Claim, Drawing, Part, Table, Tick, verdict
from .probe import DRAWS
from .resilience import norm_bound, norm_direction
from .runs import median

RADII = (0.5, 0.9, 1.0, 1.05, 1.1)
LONG = 320  # steps
BATCH = 5  # episodes in each system where the system is not the point


def parts(seeds: int, tick: Tick) -> Iterator[Part]:
    """Return claims and tables on the theorems, and the drawing of the number of compromised agents."""
    systems = range(max(4, seeds // 10))
    tick("theorems: fixed point, initial error, bound")
    yield from (_fixed_point(systems), initial("5.3.3", "(5.10)", "norm"), _bound(systems))
    tick("steps after the attack")
    yield _recovers(systems)
    tick("attacks that add up, and a gate")
    _, exact = _several(systems[:4], 0.0)
    found, noisy = _several(systems[:4], 1.0)
    yield from _others(found)
    tick("error against the number of compromised agents")
    claim, table, curves = _number(systems, found[SUDDEN, "resilient (5.8)"])
    around, near = _around(systems)
    yield from (claim, table, around, exact, noisy)
    caption = "Error after step 20 against the number of compromised agents, and of compromised neighbours of one honest agent."
    yield Drawing("figure-number", caption, partial(ch5_figures.number, curves | {"near": near}))
    tick("error against the spectral radius")
    yield _radius(systems)


def residual(model: Model, P: Array) -> float:
    """Return the largest change of P (N, n, n) by one more step of (5.5), relative to its size."""
    L = [num.inverse(num.product(num.product(model.A, one), model.A.T) + model.Q) for one in P]
    out = 0.0
    for i, near in enumerate(neighbours(model.graph)):
        Q = np.zeros_like(model.A)
        for j in near:
            Q = Q + L[j] / len(near)
        G = num.product(num.product(model.C[i].T, num.inverse(model.R[i])), model.C[i])
        out = max(out, float(np.max(np.abs(num.inverse(Q + G) - P[i])) / np.max(np.abs(P[i]))))
    return out


def _fixed_point(systems: range) -> Claim:
    largest = max(residual(model, fixed_point(model).P) for model in (fresh(s).brief().model for s in systems))
    return Claim(
        "5.3.1", "The covariances of the distributed filter have a fixed point", "exists", {"largest relative residual": largest},
        verdict(largest < 1e-12, largest > 1e-9), f"(5.5) with the sum over j of P_j, on {len(systems)} systems",
    )  # fmt: skip


def scalar_convergence(factor: float, kind: str, a: float = 1.5, c: float = 0.1, lam: float = 1.0) -> bool:
    """Return whether one agent with scalar a, c and Sw = Sv = 1, started with an error of factor lam / c, comes to the true state."""
    one = np.eye(1)
    model = Model(
        A=a * one, B=np.zeros((1, 0)), c=np.zeros(1), C=c * one[None], Q=one, R=one[None], graph=np.eye(1, dtype=bool), dt=1.0,
        sensors=("y",),
    )  # fmt: skip
    estimator = make("defence", "norm_resilient", lam=lam) if kind == "norm" else make("defence", "lasso_dkf", lam=lam, unit="sensor")
    plan = estimator.prepare(model)
    error = np.full((1, 1, 1), factor * lam / c)
    state = estimator.start(plan, Prior(error, np.ones((1, 1, 1, 1))))
    silent = Received(np.zeros((1, 1, 1)), np.ones((1, 1, 1), bool), np.zeros((1, 1)))
    for _ in range(400):
        state, estimate = estimator.step(plan, state, silent, np.zeros((1, 1, 0)), DRAWS)
        if abs(estimate.x[0, 0, 0]) > 1e3 * abs(error[0, 0, 0]):
            return False
    return bool(abs(estimate.x[0, 0, 0]) < 1e-6)


def initial(number: str, equation: str, kind: str) -> Claim:
    """Return the verdict of a scalar counter-example on Theorem 5.3.3 or 6.5.3 as printed."""
    factors = {f"e0 = {f} lam / c": "converges" if scalar_convergence(f, kind) else "diverges" for f in (1.0, 1.999)}
    diverges = [word == "diverges" for word in factors.values()]
    return Claim(
        number, f"Started with 2 lam as its bound {equation} on the initial error, the estimator converges", "converges", factors,
        verdict(not any(diverges), diverges[1]),
        "a = 1.5, c = 0.1, Sw = Sv = 1, lam = 1: the bound has to be lam, and a maximum over the agents",
    )  # fmt: skip


def parted(model: Model, estimator: Defence, direction: Array, factor: float = 1e6) -> Array:
    """Return (N,) by how much two opposite injections along `direction` (N, q) part the estimates of one step."""
    shape = (1, model.agents, model.states)
    plan, found = estimator.prepare(model), []
    for sign in (1.0, -1.0):
        state = estimator.start(plan, Prior(np.zeros(shape), np.broadcast_to(np.eye(model.states), (*shape, model.states))))
        y = sign * factor * direction[None]
        received = Received(y, np.ones_like(y, bool), np.zeros(y.shape[:2]))
        _, estimate = estimator.step(plan, state, received, np.zeros((1, model.agents, model.inputs)), DRAWS)
        found.append(estimate.x[0])
    return np.asarray(np.linalg.norm(found[0] - found[1], axis=1))


def _bound(systems: range) -> Claim:
    """Compare Theorem 5.3.4 with two huge attacks in opposite directions."""
    models = [fresh(s).brief().model for s in systems]
    largest = max(float(np.max(parted(model, defence("norm"), norm_direction(model)) / norm_bound(model, LAM))) for model in models)
    return Claim(
        "5.3.4", "Two attacks move the estimate apart by at most lam |Q^-1 C' Sv^-1/2|", "a bound",
        {"largest distance over the bound": largest}, verdict(largest <= 1.0 + 1e-9, largest > 1.0 + 1e-6),
        "between any two attacks of one step, and it is reached: the bound is tight. Errors of several steps add up",
    )  # fmt: skip


def _recovers(systems: range) -> Claim:
    """Attack for fifteen steps; compare the error 15 steps later with that of a run that was never attacked."""
    hit = random_attack(COMPROMISED, length=15, start_step=ONSET + 1)
    late, clean = (
        np.concatenate([errors(fresh(s), defence("norm"), attack, range(BATCH))[-1].max(axis=1) for s in systems])
        for attack in (hit, "none")
    )
    ratio = median(late / clean)
    return Claim(
        "5.4-other-steps", "After an attack it performs as well as in the attack-free case", "as well",
        {"attacked": median(late), "never attacked": median(clean), "median ratio": ratio},
        verdict(ratio < 1.05, ratio > 10.0),
        "errors 15 steps after the last attack: they go to zero again, but each hit starts the convergence anew",
    )  # fmt: skip


def _number(systems: range, directed: float) -> tuple[Claim, Table, dict[str, Array]]:
    counts = range(11)
    curves = {"count": np.array(counts)}
    for name in DEFENCES:
        line = []
        for count in counts:
            attacks = {s: random_attack(np.argsort(draws.constants("compromised", s).uniform((10,))[0])[:count].tolist()) for s in systems}
            line.append(over(worst(errors(fresh(s).with_threat(agents=()), defence(name), attacks[s], range(BATCH))) for s in systems))
        curves[name] = np.array(line)
    rows = tuple((words, *(figure(v, ".2g") for v in curves[name])) for name, words in DEFENCES.items())
    title = "Largest error after step 20, median, against the number of compromised agents (drawn at random)"
    norm = curves["norm"].tolist()
    ratio = norm[10] / norm[1]
    claim = Claim(
        "5.1-number", "There is no limit on the number of compromised agents", "no limit",
        {"random, 1": norm[1], "random, 5": norm[5], "random, 10": norm[10], "directed, 10": directed},
        verdict(ratio < 5.0 and directed < 5.0 * norm[10], ratio > 5.0 and directed > 5.0 * norm[10]),
        "largest error; yes: ten agents give less than five times the error of one, by random and by directed values alike",
    )  # fmt: skip
    return claim, Table(title, ("estimator", *map(str, counts)), rows), curves


def _around(systems: range) -> tuple[Table, Array]:
    """Measure the error of agent 7 (the thesis's 8), which is honest, against the number of its neighbours that are attacked."""
    near = [j for j in neighbours(fresh(0).plant.hears())[7] if j != 7]
    line = []
    for count in range(len(near) + 1):
        attack = random_attack(near[:count])
        each = (errors(fresh(s).with_threat(agents=()), defence("norm"), attack, range(BATCH)) for s in systems)
        line.append(over(error[ONSET:, :, 7].max(axis=0) for error in each))
    title = "The same of agent 7 alone, which is honest, against the number of its compromised neighbours"
    return Table(title, ("estimator", *map(str, range(len(line)))), ((DEFENCES["norm"], *(f"{v:.2f}" for v in line)),)), np.array(line)


SUDDEN = "a second state of norm 700, at once"
CASES = {
    "no attack": "none",
    "random, 700 randn": f"fdi_gaussian:start_step={ONSET + 1},sd={SD},chance={CHANCE}",
    "constant, +700": f"fdi:start_step={ONSET + 1},value=700.0",
    SUDDEN: f"ghost:start_step={ONSET + 1},size=700.0",
    "a second state, grown to 2000 in 300 steps": f"ghost:start_step={ONSET + 1},size=2000.0,grow=300.0",
}
BASELINES = {"non-resilient (5.9)": "dkf", "gate": "chi2_dkf", "resilient (5.8)": "norm"}
Found = dict[tuple[str, str], float]  # by case, estimator


def _several(systems: range, noise_var: float) -> tuple[Found, Table]:
    """Attack all agents, with noise in system and sensors; without any, prediction is exact and a shut gate costs nothing."""
    found: Found = {}
    scenarios = [
        dataclasses.replace(fresh(s, noise_var).with_threat(agents=(), fdi_bound=1e5), horizon=LONG) for s in systems
    ]
    for label, text in CASES.items():
        attack = Spec("attack", text).make()
        for words, name in BASELINES.items():
            found[label, words] = over(worst(errors(scenario, defence(name), attack, range(BATCH))) for scenario in scenarios)
    rows = tuple((label, *(f"{found[label, words]:.3g}" for words in BASELINES)) for label in CASES)
    noise = f"noise of variance {noise_var:g}, as the estimators are told" if noise_var else "no noise, as in the thesis"
    title = f"Largest error within {LONG} steps, median, all ten agents attacked from step {ONSET + 1}: {noise}"
    return found, Table(title, ("attack", *BASELINES), rows)


def _others(found: Found) -> tuple[Claim, Claim]:
    """Judge the claims on systems with noise."""
    sudden, random = found[SUDDEN, "resilient (5.8)"], found["random, 700 randn", "resilient (5.8)"]
    pairs = {label: {w: found[label, w] for w in ("gate", "resilient (5.8)")} for label in CASES}
    better = [pair["resilient (5.8)"] < pair["gate"] for pair in pairs.values()]
    return (
        Claim(
            "5.4-directed", "The error stays small whatever the attack, as it is bounded (Theorem 5.3.4)", "bounded",
            {"no attack": found["no attack", "resilient (5.8)"], "random values": random, "a second state of norm 700": sudden},
            verdict(sudden < 2.0 * random, sudden > 5.0 * random),
            "the theorem bounds a step; at a spectral radius of 1 steps in one direction add up (no: over 5 times that of random ones)",
        ),
        Claim(
            "5.4-gate", "The resilient estimator needs no detector beside it", "no detector", pairs,
            verdict(all(better), not any(better)),
            "largest error with noise as told; yes: (5.8) errs less than a chi-square gate in every case, no: in none",
        ),
    )  # fmt: skip


def _radius(systems: range) -> Table:
    rows, attack = [], random_attack(COMPROMISED)
    for name, words in DEFENCES.items():
        cells = [
            f"{over(worst(errors(fresh(s, spectral_radius=r), defence(name), attack, range(BATCH))) for s in systems):.3g}" for r in RADII
        ]
        rows.append((words, *cells))
    heads = ("estimator", *(f"{r:g}" for r in RADII))
    return Table("Largest error after step 20, median, against the spectral radius of A", heads, tuple(rows))
