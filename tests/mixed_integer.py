"""The smallest set of sensors that explains a window, by a mixed-integer program: an oracle of the search of `l0_robust`."""

from itertools import combinations
from math import comb

import numpy as np
from scipy.optimize import LinearConstraint, linprog, milp

from tailgate.core import Array

CORNERS = 50_000  # of which a mixed-integer program's constants are the largest
TOLERANCE = 1e-7  # that of HiGHS [bounds' unit]


def reach(rows: Array, y: Array, d: Array, sensor: Array) -> Array:
    """Return by how much a reading can be outside of its bound (M,), where its sensor is left out and the rest is explained.

    For readings y (M,) of `sensor` (M,), with rows (M, n) and bounds d (M,). A set of states that explains some sensors has a corner: n or
    fewer independent rows are at their bounds there. So the largest residual over all corners that leave a reading's sensor out is enough.
    """
    count, n = rows.shape
    assert sum(comb(count, k) for k in range(n + 1)) <= CORNERS, "a shorter window, or fewer sensors"
    most = np.abs(y) - d  # at x = 0, which nothing holds at a bound
    for k in range(1, n + 1):
        at = np.array(list(combinations(range(count), k))).reshape(-1, k)
        inverse, independent = np.linalg.pinv(rows[at]), np.linalg.matrix_rank(rows[at]) == k
        for m in range(count):
            free = independent & (sensor[at] != sensor[m]).all(axis=1)
            share = np.einsum("j,cjk->ck", rows[m], inverse[free])
            off = np.abs(y[m] - (share * y[at[free]]).sum(axis=1)) + (np.abs(share) * d[at[free]]).sum(axis=1)
            most[m] = max(most[m], float(np.max(off, initial=0.0)) - d[m])
    return np.asarray(np.maximum(most, 0.0))


def excess(rows: Array, y: Array, d: Array) -> float:
    """Return min over x of max |y - rows x| - d for rows (M, n), y and d (M,), by a linear program; 0 where that is negative."""
    n, slack = rows.shape[1], np.ones((len(rows), 1))
    answer = linprog(
        np.array([*np.zeros(n), 1.0]), A_ub=np.concatenate([np.hstack([rows, -slack]), np.hstack([-rows, -slack])]),
        b_ub=np.concatenate([y + d, d - y]), bounds=[(None, None)] * n + [(0.0, None)], method="highs",
    )  # fmt: skip
    assert answer.status == 0, answer.message
    return float(answer.x[n])


def solve_milp(O: Array, Y: Array, D: Array, there: Array) -> tuple[int, ...]:
    """Return a smallest set of sensors that explains a window, by a mixed-integer program (scipy, HiGHS).

        min sum_i z_i     s.t.  |Y_m - O_m x| <= D_m + M_m z_i  for each reading m of sensor i,     z_i 0 or 1

    The constants M are the smallest that `reach` proves enough. HiGHS takes a z_i of 1e-6 for 0, which leaves a slack of 1e-6 M. So a
    linear program checks the set that it finds. Where that has no state, the set and all of its parts are excluded, and it solves again.
    """
    q, T, n = O.shape
    sensor = np.repeat(np.arange(q), T)[there.ravel()]
    rows, y, d = O.reshape(-1, n)[there.ravel()], Y.ravel()[there.ravel()], D.ravel()[there.ravel()]
    on = np.eye(q)[sensor] * reach(rows, y, d, sensor)[:, None]
    held = [LinearConstraint(np.concatenate([np.hstack([rows, -on]), np.hstack([-rows, -on])]), -np.inf, np.concatenate([y + d, d - y]))]
    bounds = np.array([-np.inf] * n + [0.0] * q), np.array([np.inf] * n + [1.0] * q)
    while True:
        answer = milp(
            np.array([*np.zeros(n), *np.ones(q)]), integrality=np.array([0] * n + [1] * q), bounds=bounds, constraints=held,
            options={"presolve": False},  # with it HiGHS crashes on some programs with unbounded states and a row of zeros
        )  # fmt: skip
        assert answer.status == 0, answer.message
        attacked = answer.x[n:] > 0.5
        left = ~attacked[sensor]
        if excess(rows[left], y[left], d[left]) <= TOLERANCE:
            return tuple(np.flatnonzero(attacked).tolist())
        held.append(LinearConstraint(np.array([[*np.zeros(n), *np.where(attacked, 0.0, 1.0)]]), 1.0, np.inf))
