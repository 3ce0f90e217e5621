"""Bounds that a chi-square gate gives, and errors that it does not bound (thesis, Theorems 4.5.1-4.5.3 and Lemma 4.5.4, restated).

With gate g = r' S^-1 r <= eta and update x = x- + K r, for one agent: P- (n, n), S (q, q), K (n, q). These are formulas for a reader and
for tests, not part of the scored path.
"""

from itertools import combinations

import numpy as np

from tailgate.agents.optimal.schedules import Steady, updated
from tailgate.core import Array, Model


def steady_state(model: Model) -> Steady:
    """Return the steady-state filter of agent 0 on its own sensors. Raises LinAlgError where none exists."""
    from scipy.linalg import solve_discrete_are  # takes long to import

    C, R = model.C[0], model.R[0]
    return updated(solve_discrete_are(model.A.T, C.T, model.Q, R), C, R)


def accepted_jump(before: Array, after: Array, eta: float) -> float:
    """Return c = sqrt(eta lambda_max(P- - P+)): the farthest that one accepted sample moves the estimate. Tight.

    K S K' = P- - P+, so this is Theorem 4.5.3's constant. It bounds the jump of one step and not the error, and it grows while the gate
    is shut, as P- does.
    """
    return float(np.sqrt(eta * np.linalg.eigvalsh(before - after)[-1]))


def innovation_norms(S: Array, eta: float) -> tuple[float, float]:
    """Return (c1, c2) of Lemma 4.5.4: |r| > c1 always alarms, |r| <= c2 never does. Both tight.

    Erratum: the thesis takes the eigenvalues of P and leaves eta out of c2; r has the covariance S.
    """
    values = np.linalg.eigvalsh(S)
    return float(np.sqrt(eta * values[-1])), float(np.sqrt(eta * values[0]))


def stealth_bound(A: Array, filters: list[Steady], eta: float, direction: Array) -> float:
    """Return sqrt(eta) sum_j || S^(1/2) K' (A')^j e ||: how far N unnoticed samples move the estimate along e (n,). Tight.

    A is the filter's predictor, as the known input cancels; `filters` holds S and K of each of the N steps in their order. What is
    injected is counted as innovation: x_k = A x_k-1 + K_k r_k with every r_k inside of its gate.
    """
    total, reach = 0.0, np.asarray(direction, np.float64)
    for step in reversed(filters):
        total += float(np.sqrt(max(float(reach @ step.K @ step.S @ step.K.T @ reach), 0.0)))
        reach = A.T @ reach
    return float(np.sqrt(eta) * total)


def stealth_innovations(A: Array, filters: list[Steady], eta: float, direction: Array) -> Array:
    """Return (N, q) the innovations that reach `stealth_bound`: r_k along S K' (A')^j e, on the gate."""
    out, reach = [], np.asarray(direction, np.float64)
    for step in reversed(filters):
        push = step.S @ step.K.T @ reach
        length = np.sqrt(reach @ step.K @ push)
        out.append(np.sqrt(eta) * push / length if length > 0.0 else 0.0 * push)
        reach = A.T @ reach
    return np.array(out[::-1])


def block_bound(A: Array, steady: Steady, threshold: float, block: int, direction: Array) -> float:
    """Return sqrt(h sum_j |S^(1/2) K' (A')^j e|^2): how far a block that passes its test moves the estimate along e (n,). Tight.

    The test is that of `kf_bank`: sum r' S^-1 r <= h = `threshold` over `block` steps. Whitened residues w, |w|^2 <= h, move the estimate
    by a linear map; this is its norm times sqrt(h).
    """
    return float(np.sqrt(threshold * sum(float(push @ steady.S @ push) for push in _pushes(A, steady, block, direction))))


def block_residues(A: Array, steady: Steady, threshold: float, block: int, direction: Array) -> Array:
    """Return residues (N, q) of one block that reach `block_bound`."""
    pushes = _pushes(A, steady, block, direction)
    energy = sum(float(push @ steady.S @ push) for push in pushes)
    return np.array([np.sqrt(threshold / energy) * steady.S @ push for push in pushes])


def _pushes(A: Array, steady: Steady, block: int, direction: Array) -> list[Array]:
    """Return K' (A')^j e (q,) of each step of a block, the first step first."""
    out, reach = [], np.asarray(direction, np.float64)
    for _ in range(block):
        out.append(steady.K.T @ reach)
        reach = A.T @ reach
    return out[::-1]


def l0_bound(O: Array, D: Array, s: int) -> float:
    """Return max over sets S of q - 2s sensors of |O_S^+| 2 |D_S|: how far apart two explanations of a window can be.

    O (q, T, n) and D (q, T) in the same unit. At most s sensors are left out of each explanation; both hold on the others (`l0_robust`).
    Infinite where some S does not observe the state.
    """
    q, _, n = O.shape
    worst = 0.0
    for S in combinations(range(q), q - 2 * s):
        rows = O[list(S)].reshape(-1, n)
        if np.linalg.matrix_rank(rows) < n:
            return float("inf")
        worst = max(worst, float(np.linalg.norm(np.linalg.pinv(rows), 2) * 2.0 * np.linalg.norm(D[list(S)])))
    return worst


def restricted(O: Array, s: int) -> Array:
    """Return lambda_min of [O I]'[O I] over x and any 2s blocks, as a share of its lambda_max, for each agent (N,).

    Projected gradients (`etpg`) have a rate of convergence where it is above 4/9. O (N, q, T, n) has orthonormal columns. The eigenvalues
    are 1 less or plus the singular values of the rows in the blocks.
    """
    q, n = O.shape[1], O.shape[3]
    out = []
    for rows in O:
        chosen = combinations(range(q), min(2 * s, q))
        worst = max((float(np.linalg.norm(rows[list(some)].reshape(-1, n), 2)) for some in chosen if some), default=0.0)
        out.append((1.0 - worst) / 2.0)
    return np.array(out)


def replay_mean(A: Array, B: Array, C: Array, L: Array, K: Array, S: Array, Qu: Array) -> float:
    """Return E r' S^-1 r under replay of a loop at rest with the watermark Qu (`watermark`); infinite where the loop forgets nothing."""
    cal = (A + B @ L) @ (np.eye(len(A)) - K @ C)
    if float(np.max(np.abs(np.linalg.eigvals(cal)))) >= 1.0:
        return float("inf")
    U = added = B @ Qu @ B.T
    while np.abs(added).max() > 1e-16 * np.abs(U).max():
        added = cal @ added @ cal.T
        U = U + added
    return float(len(C) + 2.0 * np.trace(C.T @ np.linalg.solve(S, C @ U)))


def false_alarm_rate(eta: float) -> float:
    """Return Pr(chi2_2 > eta) = exp(-eta / 2), the rate per step with two sensors."""
    return float(np.exp(-0.5 * eta))
