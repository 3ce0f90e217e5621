"""What the theorems of chapter 5 bound, and what they do not: fixed point, convergence, bound, and the number of compromised agents."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

import tailgate
from tailgate import num
from tailgate.core import Array, Model, Prior, Received, draws
from tailgate.core.draws import Role
from tailgate.estimators.distributed.distributed_kalman import fixed_point, neighbours
from tailgate.thesis.resilience import norm_bound, norm_direction

from .ch4_cases import Tick
from .ch5_cases import CHANCE, COMPROMISED, GUARDS, LAM, ONSET, SD, defence, errors, fresh, random_attack, worst
from .claims import Claim, Report, Table, verdict

Curves = dict[str, Array]
RADII = (0.5, 0.9, 1.0, 1.05, 1.1)
LONG = 320  # steps
BATCH = 5  # episodes in each system where the system is not the point


def report(seeds: int, tick: Tick) -> tuple[Report, Curves]:
    out, systems = Report("ch5", "", {}), range(max(4, seeds // 10))
    tick("theorems: fixed point, initial error, bound")
    out.claims += [_fixed_point(systems), _initial(), _bound(systems)]
    tick("steps after the attack")
    out.claims.append(_recovers(systems))
    tick("attacks that add up, and a gate")
    _, exact = _beside_a_gate(systems[:4], 0.0)
    found, noisy = _beside_a_gate(systems[:4], 1.0)
    out.claims += _others(found)
    tick("error against the number of compromised agents")
    claim, table, curves = _number(systems, found[SUDDEN, "resilient (5.8)"])
    out.claims.append(claim)
    around, curves["near"] = _around(systems)
    out.tables += [table, around, exact, noisy]
    tick("error against the spectral radius")
    out.tables.append(_radius(systems))
    return out, curves


def residual(model: Model, P: Array) -> float:
    """The largest change of P (N, n, n) by one more step of (5.5), relative to its size."""
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
        "5.3.1",
        "The covariances of the distributed filter have a fixed point",
        "exists",
        {"largest relative residual": largest},
        verdict(largest < 1e-12, largest > 1e-9),
        f"(5.5) with the sum over j of P_j, on {len(systems)} systems",
    )


def scalar_convergence(factor: float, kind: str, a: float = 1.5, c: float = 0.1, lam: float = 1.0) -> bool:
    """Whether one agent with scalar a, c and Sw = Sv = 1, started with an error of factor lam / c, comes to the true state."""
    one = np.eye(1)
    model = Model(
        A=a * one,
        B=np.zeros((1, 0)),
        c=np.zeros(1),
        C=c * one[None],
        Q=one,
        R=one[None],
        graph=np.eye(1, dtype=bool),
        dt=1.0,
        sensors=("y",),
    )
    guard = tailgate.make_defence(
        "norm_resilient" if kind == "norm" else "lasso_dkf", lam=lam, **({"unit": "sensor"} if kind == "lasso" else {})
    )
    plan = guard.prepare(model)
    error = np.full((1, 1, 1), factor * lam / c)
    state = guard.start(plan, Prior(error, np.ones((1, 1, 1, 1))))
    silent = Received(np.zeros((1, 1, 1)), np.ones((1, 1, 1), bool), np.zeros((1, 1)))
    nothing = draws.keys("report", [0]).at(Role.DEFENCE, np.zeros(1, np.int64))
    for _ in range(400):
        state, estimate = guard.step(plan, state, silent, np.zeros((1, 1, 0)), nothing)
        if abs(estimate.x[0, 0, 0]) > 1e3 * abs(error[0, 0, 0]):
            return False
    return bool(abs(estimate.x[0, 0, 0]) < 1e-6)


def _initial() -> Claim:
    factors = {f"e0 = {f} lam / c": scalar_convergence(f, "norm") for f in (1.0, 1.999)}
    return Claim(
        "5.3.3",
        "Started with 2 lam as its bound (5.10) on the initial error, the estimator converges",
        "converges",
        {k: "converges" if v else "diverges" for k, v in factors.items()},
        verdict(all(factors.values()), not factors["e0 = 1.999 lam / c"]),
        "a = 1.5, c = 0.1, Sw = Sv = 1, lam = 1: the bound has to be lam, and a maximum over the agents",
    )


def parted(model: Model, guard: Any, direction: Array, factor: float = 1e6) -> Array:
    """(N,) by how much two opposite injections along `direction` (N, q) part the estimates of one step."""
    shape = (1, model.agents, model.states)
    plan, found = guard.prepare(model), []
    nothing = draws.keys("report", [0]).at(Role.DEFENCE, np.zeros(1, np.int64))
    for sign in (1.0, -1.0):
        state = guard.start(plan, Prior(np.zeros(shape), np.broadcast_to(np.eye(model.states), (*shape, model.states))))
        y = sign * factor * direction[None]
        received = Received(y, np.ones_like(y, bool), np.zeros(y.shape[:2]))
        _, estimate = guard.step(plan, state, received, np.zeros((1, model.agents, model.inputs)), nothing)
        found.append(estimate.x[0])
    return np.asarray(np.linalg.norm(found[0] - found[1], axis=1))


def _bound(systems: range) -> Claim:
    """Theorem 5.3.4 between two huge attacks in opposite directions."""
    ratios = []
    for s in systems:
        model = fresh(s).brief().model
        ratios.append(float(np.max(parted(model, defence("norm"), norm_direction(model)) / norm_bound(model, LAM))))
    return Claim(
        "5.3.4",
        "Two attacks move the estimate apart by at most lam |Q^-1 C' Sv^-1/2|",
        "a bound",
        {"largest distance over the bound": max(ratios)},
        verdict(max(ratios) <= 1.0 + 1e-9, max(ratios) > 1.0 + 1e-6),
        "between any two attacks of one step, and it is reached: the bound is tight. Errors of several steps add up",
    )


def _recovers(systems: range) -> Claim:
    """Fifteen steps of attack, then none: the error 15 steps later against that of a run that was never attacked."""
    late, clean = [], []
    for s in systems:
        hit = errors(fresh(s), defence("norm"), random_attack(COMPROMISED, length=15, start_step=ONSET + 1), range(BATCH))
        late.append(hit[-1].max(axis=1))
        clean.append(errors(fresh(s), defence("norm"), tailgate.make_attack("none"), range(BATCH))[-1].max(axis=1))
    shown = {"attacked": float(np.median(np.concatenate(late))), "never attacked": float(np.median(np.concatenate(clean)))}
    ratio = float(np.median(np.concatenate(late) / np.concatenate(clean)))
    return Claim(
        "5.4-other-steps",
        "After an attack it performs as well as in the attack-free case",
        "as well",
        shown | {"median ratio": ratio},
        verdict(ratio < 1.05, ratio > 10.0),
        "errors 15 steps after the last attack: they go to zero again, but each hit starts the convergence anew",
    )


def _number(systems: range, directed: float) -> tuple[Claim, Table, Curves]:
    counts = range(11)
    curves: Curves = {"count": np.array(counts)}
    rows = []
    for name, words in GUARDS.items():
        line = []
        for count in counts:
            values = []
            for s in systems:
                some = np.argsort(draws.constants("compromised", s).uniform((10,))[0])[:count].tolist()
                place = fresh(s).with_threat(agents=())
                values.append(worst(errors(place, defence(name), random_attack(some), range(BATCH))))
            line.append(float(np.median(np.concatenate(values))))
        curves[name] = np.array(line)
        rows.append((words, *(f"{v:.2g}" if v < 100.0 else f"{v:.0f}" for v in line)))
    table = Table(
        "Largest error after step 20, median, against the number of compromised agents (drawn at random)",
        ("estimator", *map(str, counts)),
        tuple(rows),
    )
    ratio = curves["norm"][10] / curves["norm"][1]
    claim = Claim(
        "5.1-number",
        "There is no limit on the number of compromised agents",
        "no limit",
        {"random, 1": curves["norm"][1], "random, 5": curves["norm"][5], "random, 10": curves["norm"][10], "directed, 10": directed},
        verdict(ratio < 5.0 and directed < 5.0 * curves["norm"][10], ratio > 5.0 and directed > 5.0 * curves["norm"][10]),
        "largest error; yes: ten agents give less than five times the error of one, by random and by directed values alike",
    )
    return claim, table, curves


def _around(systems: range) -> tuple[Table, Array]:
    """The error of agent 7 (the thesis's 8), which is honest, against the number of its neighbours that are attacked."""
    near = [j for j in neighbours(fresh(0).plant.hears())[7] if j != 7]
    line = []
    for count in range(len(near) + 1):
        values = [
            errors(fresh(s).with_threat(agents=()), defence("norm"), random_attack(near[:count]), range(BATCH))[ONSET:, :, 7].max(axis=0)
            for s in systems
        ]
        line.append(float(np.median(np.concatenate(values))))
    title = "The same of agent 7 alone, which is honest, against the number of its compromised neighbours"
    return Table(title, ("estimator", *map(str, range(len(line)))), ((GUARDS["norm"], *(f"{v:.2f}" for v in line)),)), np.array(line)


CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "no attack": ("none", {}),
    "random, 700 randn": ("fdi_gaussian", {"sd": SD, "chance": CHANCE}),
    "constant, +700": ("fdi", {"value": 700.0}),
    "a second state of norm 700, at once": ("ghost", {"size": 700.0}),
    "a second state, grown to 2000 in 300 steps": ("ghost", {"size": 2000.0, "grow": 300.0}),
}
SUDDEN = "a second state of norm 700, at once"
RIVALS = {"non-resilient (5.9)": "dkf", "gate": "chi2_dkf", "resilient (5.8)": "norm"}
Found = dict[tuple[str, str], float]  # by case, estimator


def _beside_a_gate(systems: range, noise_var: float) -> tuple[Found, Table]:
    """All agents attacked, with noise in system and sensors; without any, prediction is exact and a shut gate costs nothing."""
    found: Found = {}
    for label, (name, options) in CASES.items():
        attack = tailgate.make_attack(name, **({} if name == "none" else {"start_step": ONSET + 1} | options))
        for words, guard in RIVALS.items():
            values = []
            for s in systems:
                place = dataclasses.replace(fresh(s, noise_var=noise_var).with_threat(agents=(), fdi_bound=1e5), horizon=LONG)
                place = dataclasses.replace(place, sensor=dataclasses.replace(place.sensor, noise_var=noise_var))
                values.append(worst(errors(place, defence(guard), attack, range(BATCH))))
            found[label, words] = float(np.median(np.concatenate(values)))
    rows = tuple((label, *(f"{found[label, words]:.3g}" for words in RIVALS)) for label in CASES)
    noise = f"noise of variance {noise_var:g}, as the estimators are told" if noise_var else "no noise, as in the thesis"
    title = f"Largest error within {LONG} steps, median, all ten agents attacked from step {ONSET + 1}: {noise}"
    return found, Table(title, ("attack", *RIVALS), rows)


def _others(found: Found) -> list[Claim]:
    """On systems with noise."""
    sudden, random = found[SUDDEN, "resilient (5.8)"], found["random, 700 randn", "resilient (5.8)"]
    pairs = {label: {w: found[label, w] for w in ("gate", "resilient (5.8)")} for label in CASES}
    better = [pair["resilient (5.8)"] < pair["gate"] for pair in pairs.values()]
    return [
        Claim(
            "5.4-directed",
            "The error stays small whatever the attack, as it is bounded (Theorem 5.3.4)",
            "bounded",
            {"no attack": found["no attack", "resilient (5.8)"], "random values": random, "a second state of norm 700": sudden},
            verdict(sudden < 2.0 * random, sudden > 5.0 * random),
            "the theorem bounds a step; at a spectral radius of 1 steps in one direction add up (no: over 5 times that of random ones)",
        ),
        Claim(
            "5.4-gate",
            "The resilient estimator needs no detector beside it",
            "no detector",
            pairs,
            verdict(all(better), not any(better)),
            "largest error with noise as told; yes: (5.8) errs less than a chi-square gate in every case, no: in none",
        ),
    ]


def _radius(systems: range) -> Table:
    rows = []
    for name, words in GUARDS.items():
        cells = []
        for radius in RADII:
            values = [
                worst(errors(fresh(s, spectral_radius=radius), defence(name), random_attack(COMPROMISED), range(BATCH))) for s in systems
            ]
            cells.append(f"{np.median(np.concatenate(values)):.3g}")
        rows.append((words, *cells))
    heads = ("estimator", *(f"{r:g}" for r in RADII))
    return Table("Largest error after step 20, median, against the spectral radius of A", heads, tuple(rows))
