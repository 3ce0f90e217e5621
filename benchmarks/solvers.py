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
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import tailgate
from tailgate.bench.problems import Case, Form, by_cvxpy, case, exactly, objective

Array = NDArray[Any]


def violation(c: Case, d: Array, form: Form) -> float:
    """The largest slope of the objective at d, relative to max(1, |r|, |Q||x|, lam), over the rows where y = C x does not hold exactly."""
    e = c.r - d @ c.C.T
    pull = np.clip(e / np.diag(c.R), -0.5 * c.lam, 0.5 * c.lam)
    rows = np.full(len(d), True)
    if form == "norm":
        pull = e @ np.linalg.inv(c.R)
        size = np.sqrt(np.sum(e * pull, axis=1))
        rows = size > 1e-3
        pull = 0.5 * c.lam * pull / np.where(rows, size, 1.0)[:, None]
    slope = 2.0 * np.linalg.norm(d @ c.Q - pull @ c.C, axis=1)
    scale = np.maximum(np.linalg.norm(c.r, axis=1), np.linalg.norm(c.Q, 2) * np.linalg.norm(d, axis=1))
    return float(np.max((slope / np.maximum(scale, max(1.0, c.lam)))[rows]))


def measure(c: Case, form: Form, batches: tuple[int, ...], repeats: int, rows: int) -> dict[str, Any]:
    """Medians over interleaved repeats."""
    solvers = {batch: exactly(c._replace(r=c.r[:batch]), form) for batch in batches}
    theirs, x = by_cvxpy(c._replace(r=c.r[:rows]), form), exactly(c, form)()
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
    some = c._replace(r=c.r[:rows])
    above = objective(some, form, x[:rows]) / objective(some, form, z) - 1.0
    return out | {"optimality_violation": violation(c, x, form), "objective_above_cvxpy": float(np.max(above))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=11, help="repeats of each solver")
    parser.add_argument("--batch", type=int, default=4096, help="problems solved at once")
    parser.add_argument("--rows", type=int, default=60, help="problems that cvxpy solves in a repeat")
    parser.add_argument("--out", type=Path, help="also write the record to this file")
    options = parser.parse_args()
    figures = {}
    forms: dict[str, Form] = {"(5.8), 14 sensors, 20 states": "norm", "(6.26), 3 sensors, 19 states": "lasso"}
    for name, form in forms.items():
        c = case(form, max(options.batch, options.rows))
        figures[name] = measure(c, form, (1, 64, options.batch), options.repeats, options.rows)
        print(name, json.dumps(figures[name], indent=1))
    if options.out:
        record = {
            "figures": figures, "repeats": options.repeats, "version": tailgate.__version__, "machine": platform.machine(),
            "cores": os.cpu_count(), "load": [round(x, 2) for x in os.getloadavg()], "python": platform.python_version(),
            "packages": {p: version(p) for p in ("numpy", "llvmlite", "cvxpy", "clarabel")},
        }  # fmt: skip
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
