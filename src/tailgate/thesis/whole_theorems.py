"""Theorems and lemmas of chapters 5 and 6 that no figure of theirs shows: convergence without an attack, fixed point, minimiser."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tailgate.core import Array, Model
from tailgate.core.scenario import load_scenario
from tailgate.estimators.distributed.distributed_kalman import fixed_point, neighbours

from . import ch5_cases, ch5_theory, ch6_cases
from .claims import Claim, verdict

RADII = (0.9, 1.0, 1.1)  # spectral radii of A: the theorems ask for none below 1
LAMBDA = 1.0
FAR = 1e6  # norm of a, by which the minimiser is at its farthest


def chapter_5(seeds: int) -> Iterator[Claim]:
    """Return what is added to chapter 5."""
    yield from (_networks(range(max(4, seeds // 10))), lemma("5.3.5"))


def chapter_6(seeds: int) -> Iterator[Claim]:
    """Return what is added to chapter 6."""
    yield from (_fixed_point(), _platoon(seeds), lemma("6.5.5"))


def contraction(model: Model) -> float:
    """Return the spectral radius of the errors' recursion e_i+ = P_i (1 / d_i) sum_j (A P_j A' + Sw)^-1 A e_j: below 1 they vanish."""
    P, n = fixed_point(model).P, model.states
    L = [np.linalg.inv(model.A @ one @ model.A.T + model.Q) @ model.A for one in P]
    out = np.zeros((len(P) * n, len(P) * n))
    for i, near in enumerate(neighbours(model.graph)):
        for j in near:
            out[i * n : (i + 1) * n, j * n : (j + 1) * n] = P[i] @ L[j] / len(near)
    return float(np.abs(np.linalg.eigvals(out)).max())


def _networks(systems: range) -> Claim:
    """Measure the error over the norm of the state on fresh systems, stable and not (Theorem 5.3.2)."""
    found, worst = {}, []
    for radius in RADII:
        end, radii = [], []
        for seed in systems:
            scenario = ch5_cases.fresh(seed, spectral_radius=radius)
            wrong = ch5_cases.errors(scenario, ch5_cases.defence("dkf"), "none", [seed])
            end.append(float(wrong[-1].max() / ch5_cases.sizes(scenario, seed)[-1, 0, 0]))
            radii.append(contraction(scenario.brief().model))
        found[f"spectral radius of A {radius:g}"] = {"of the errors' recursion": max(radii), "error after 50 steps": max(end)}
        worst += radii
    return Claim(
        "5.3.2", "Without an attack the linear estimator (5.9) converges to the true state at every agent", "converges", found,
        verdict(max(worst) < 1.0, max(worst) > 1.0),
        f"the worst of {len(systems)} systems each; errors are over the norm of the state. yes: a spectral radius below 1 in all",
    )  # fmt: skip


def _fixed_point() -> Claim:
    model = load_scenario(ch6_cases.SCENARIO).brief().model
    left = ch5_theory.residual(model, fixed_point(model).P)
    return Claim(
        "6.5.1", "The covariances of the distributed filter have a fixed point (6.23)", "exists", {"largest relative residual": left},
        verdict(left < 1e-12, left > 1e-9), "on the platoon of section 6.6, with the sum over j of P_j",
    )  # fmt: skip


def _platoon(seeds: int) -> Claim:
    radius = contraction(load_scenario(ch6_cases.SCENARIO).brief().model)
    error = ch6_cases.run(ch6_cases.defence("dkf"), "none", seeds).own
    found = {f"after {k} s [m]": float(error[k - 1].max()) for k in (1, 10, 50)}
    return Claim(
        "6.5.2", "Without an attack the linear estimator (6.27) converges to the true state at every car", "converges",
        {"spectral radius of the errors' recursion": radius, "largest own-distance error, worst run": found},
        verdict(radius < 1.0, radius > 1.0), "yes: the radius is below 1; the leader's input known",
    )  # fmt: skip


def minimiser(Q: Array, A: Array, a: Array, lam: float = LAMBDA, rounds: int = 30) -> Array:
    """Return argmin x' Q x + lam |A x - a| for an `a` far away: the fixed point of x = -lam / 2 Q^-1 A' (A x - a) / |A x - a|."""
    x = np.zeros(len(Q))
    for _ in range(rounds):
        rest = A @ x - a
        x = -0.5 * lam * np.linalg.solve(Q, A.T @ rest) / np.linalg.norm(rest)
    return x


def lemma(number: str, trials: int = 200) -> Claim:
    """Test |x| <= lam / 2 |Q^-1 A| as printed, and with A' in place of A; a in its worst direction."""
    rng = np.random.default_rng(0)
    printed, corrected = [], []
    for _ in range(trials):
        root, A = rng.standard_normal((3, 3)), rng.standard_normal((3, 3))
        Q = root @ root.T + 0.1 * np.eye(3)
        far = np.linalg.svd(np.linalg.solve(Q, A.T))[2][0]
        size = np.linalg.norm(minimiser(Q, A, FAR * far))
        printed.append(size / (0.5 * LAMBDA * np.linalg.norm(np.linalg.solve(Q, A), 2)))
        corrected.append(size / (0.5 * LAMBDA * np.linalg.norm(np.linalg.solve(Q, A.T), 2)))
    return Claim(
        number, "The minimiser of x' Q x + lam |A x - a| has a norm of at most lam / 2 |Q^-1 A|", "a bound",
        {"largest norm over the bound as printed": float(max(printed)), "over lam / 2 |Q^-1 A'|": float(max(corrected)),
         "random matrices": trials, "beyond the printed bound": int(np.sum(np.array(printed) > 1.0 + 1e-9))},
        verdict(bool(max(printed) <= 1.0 + 1e-9), bool(max(printed) > 1.0 + 1e-6)),
        "the gradient of |A x - a| has A' in front, which the printed bound has lost; with it the bound holds and is reached",
    )  # fmt: skip
