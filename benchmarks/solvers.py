"""Problems per second of the exact solvers of (5.8) and (6.26), in a batch, against a parametrised cvxpy solve; one core.

    python benchmarks/solvers.py [--out benchmarks/results/solvers.json]

The problems are those of one agent of the thesis's network (14 sensors, 20 states) and of its platoon (3 sensors, 19 states), every second
one with the innovation of an attacked step. cvxpy compiles each problem once, and only the innovation differs between two solves, so that
it does the least work that it can (Clarabel, its own tolerances, no warm start, whitened constants). Both sides return xh - xb. Repeats are
interleaved, and the ratio is the median of the repeats' own: absolute rates move with the machine and its load.

Also measured: the largest violation of the optimality conditions of the exact solutions (relative to max(1, |r|, |Q||x|, lam)), and by how
much, relatively, an exact objective is above cvxpy's at most (negative where none is).
"""

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

import tailgate
from tailgate import num
from tailgate.estimators.distributed import fixed_point
from tailgate.estimators.norm_resilient import axes, moved
from tailgate.estimators.robust import believed
from tailgate.scenario import load_scenario

Array = NDArray[Any]


class Case(NamedTuple):
    """One agent: C (q, n), Sv (q, q), Q and Q^-1 (n, n), the price, and innovations r (B, q)."""

    C: Array
    R: Array
    Q: Array
    Qinv: Array
    lam: float
    r: Array


def case(scenario: str, agent: int, lam: float, sd: float, batch: int) -> Case:
    """Innovations as an honest step has them, to every second of which an injection of this standard deviation is added."""
    model = load_scenario(scenario).brief().model
    C, R, Qinv = model.C[agent], model.R[agent], fixed_point(model).Qinv[agent]
    rng = np.random.default_rng(0)
    honest = rng.normal(size=(batch, len(C))) @ np.linalg.cholesky(R + C @ Qinv @ C.T).T
    attacked = np.arange(batch)[:, None] % 2
    return Case(C, R, np.linalg.inv(Qinv), Qinv, lam, honest + sd * attacked * rng.normal(size=honest.shape))


def exactly(c: Case, norm: bool, batch: int) -> Callable[[], Array]:
    """The first `batch` problems as the filter solves them in a step: xh - xb (batch, n)."""
    r = num.batch_last(c.r[:batch, None])
    if norm:
        constants = axes(c.C[None], c.R[None], num.root(c.Qinv[None])[0])
        return lambda: moved(constants, r, c.lam)[0][:, 0]
    S = c.R + c.C @ c.Qinv @ c.C.T
    K = num.transposed((c.Qinv @ c.C.T @ np.linalg.inv(S))[None])
    wide, price = np.broadcast_to(S, (batch, 1, *S.shape)), np.full(r.shape, c.lam)
    return lambda: num.apply(K, believed(r, wide, price))[:, 0]


def by_cvxpy(c: Case, norm: bool, rows: int) -> Callable[[], Array]:
    """The first rows, one parametrised solve each."""
    white, root = np.linalg.inv(np.linalg.cholesky(c.R)), np.linalg.cholesky(c.Q).T
    d, a, r = cp.Variable(len(c.Q)), cp.Variable(len(c.C)), cp.Parameter(len(c.C))
    prior = cp.sum_squares(root @ d)
    if norm:
        price = c.lam * cp.norm(r - white @ c.C @ d, 2) + prior
    else:
        price = cp.sum_squares(r - white @ c.C @ d - white @ a) + c.lam * cp.norm1(a) + prior
    problem, whitened = cp.Problem(cp.Minimize(price)), c.r[:rows] @ white.T

    def go() -> Array:
        out = []
        for row in whitened:
            r.value = row
            problem.solve(solver="CLARABEL", warm_start=False)
            out.append(d.value)
        return np.array(out)

    return go


def objective(c: Case, d: Array, norm: bool) -> Array:
    """(B,) the value of (5.8), or of (6.26) with the best a for this X (Huber's loss; Sv is diagonal here)."""
    e, prior = c.r[: len(d)] - d @ c.C.T, np.einsum("bn,nm,bm->b", d, c.Q, d)
    if norm:
        return np.asarray(c.lam * np.sqrt(np.einsum("bq,ql,bl->b", e, np.linalg.inv(c.R), e)) + prior)
    variance = np.diag(c.R)
    rest = np.clip(e, -0.5 * c.lam * variance, 0.5 * c.lam * variance)
    return np.asarray(np.sum(rest * rest / variance + c.lam * np.abs(e - rest), axis=1) + prior)


def violation(c: Case, d: Array, norm: bool) -> float:
    """The largest slope of the objective at d, relative to max(1, |r|, |Q||x|, lam), over the rows where y = C x does not hold exactly."""
    e = c.r - d @ c.C.T
    pull = np.clip(e / np.diag(c.R), -0.5 * c.lam, 0.5 * c.lam)
    rows = np.full(len(d), True)
    if norm:
        pull = e @ np.linalg.inv(c.R)
        size = np.sqrt(np.sum(e * pull, axis=1))
        rows = size > 1e-3
        pull = 0.5 * c.lam * pull / np.where(rows, size, 1.0)[:, None]
    slope = 2.0 * np.linalg.norm(d @ c.Q - pull @ c.C, axis=1)
    scale = np.maximum(np.linalg.norm(c.r, axis=1), np.linalg.norm(c.Q, 2) * np.linalg.norm(d, axis=1))
    return float(np.max((slope / np.maximum(scale, max(1.0, c.lam)))[rows]))


def measure(c: Case, norm: bool, batches: tuple[int, ...], repeats: int, rows: int) -> dict[str, Any]:
    """Medians over interleaved repeats."""
    solvers = {batch: exactly(c, norm, batch) for batch in batches}
    theirs, x = by_cvxpy(c, norm, rows), exactly(c, norm, len(c.r))()
    z = theirs()  # compiles, fills caches
    rates: dict[int, list[float]] = {batch: [] for batch in (0, *batches)}
    for _ in range(repeats):
        for batch, go in ((0, theirs), *solvers.items()):
            rounds = max(1, 256 // batch) if batch else 1
            started = time.perf_counter()
            for _ in range(rounds):
                go()
            rates[batch].append((batch * rounds or rows) / (time.perf_counter() - started))
    out: dict[str, Any] = {"cvxpy_per_second": round(statistics.median(rates[0]))}
    for batch in batches:
        ratios = [a / b for a, b in zip(rates[batch], rates[0], strict=True)]
        rate, ratio = statistics.median(rates[batch]), statistics.median(ratios)
        out[f"batch {batch}"] = {"per_second": round(rate), "ratio": round(ratio), "smallest_ratio": round(min(ratios))}
    above = objective(c, x[:rows], norm) / objective(c, z, norm) - 1.0
    return out | {"optimality_violation": violation(c, x, norm), "objective_above_cvxpy": float(np.max(above))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=11, help="repeats of each solver")
    parser.add_argument("--batch", type=int, default=4096, help="problems solved at once")
    parser.add_argument("--rows", type=int, default=60, help="problems that cvxpy solves in a repeat")
    parser.add_argument("--out", type=Path, help="also write the record to this file")
    options = parser.parse_args()
    figures = {}
    for name, norm, made in (
        ("(5.8), 14 sensors, 20 states", True, ("thesis-ch5-v0", 0, 0.4, 700.0)),
        ("(6.26), 3 sensors, 19 states", False, ("thesis-ch6-v0", 2, 0.1, 2.8)),
    ):
        c = case(*made, max(options.batch, options.rows))
        figures[name] = measure(c, norm, (1, 64, options.batch), options.repeats, options.rows)
        print(name, json.dumps(figures[name], indent=1))
    if options.out:
        record = {
            "figures": figures, "repeats": options.repeats, "version": tailgate.__version__, "machine": platform.machine(),
            "cores": os.cpu_count(), "load": [round(x, 2) for x in os.getloadavg()], "python": platform.python_version(),
            "packages": {p: version(p) for p in ("numpy", "numba", "cvxpy", "clarabel")},
        }  # fmt: skip
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
