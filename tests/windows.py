"""Random windows of readings for the decoders, and what they make of them."""

import numpy as np

from tailgate.estimators.sparse_attacks.l1_decoder import decoded, grouped
from tailgate.estimators.sparse_attacks.projected import ProjectedPlan, orthonormal, solved
from tailgate.estimators.sparse_attacks.window import Centred, pulled, weighed

KINDS = 8  # of windows in `problem`


def window(rng, s, T, size, q=7, n=3):
    """A noise-free window of a dense system, O (1, q, T, n), with `size` randn on s sensors; also x and which they are."""
    A, C = rng.normal(size=(n, n)), rng.normal(size=(q, n))
    A /= np.max(np.abs(np.linalg.eigvals(A)))
    O = np.stack([C @ np.linalg.matrix_power(A, t) for t in range(T)], axis=1)[None]
    x, K = rng.normal(size=n), np.sort(rng.choice(q, s, replace=False))
    Y = (O[0] @ x)[None, None]
    Y[0, 0, K] += size * rng.normal(size=(s, T))
    return O, x, Y, K


def problem(rng, trial):
    """A random window of one of KINDS: no noise, noise, one liar, two that lie alike.

    Degenerate ones: rounded data with two equal sensors; readings of 0; a sensor that sees one direction, with one that sees none;
    two states that nobody tells apart.
    """
    kind = trial % KINDS
    n, q, T = (int(rng.integers(*ends)) for ends in ((1 + (kind == 7), 4), (3, 9), (1, 6)))
    O = rng.normal(size=(1, q, T, n))
    Y = (O[0] @ rng.normal(size=n))[None, None]
    if kind:
        Y = Y + rng.normal(size=Y.shape)
    if kind == 2:
        Y[:, :, 0] += 100.0 * rng.normal(size=T)
    if kind == 3:
        Y[:, :, :2] += 1e5
    if kind == 4:
        O, Y = np.round(2.0 * O), np.round(Y)
        O[0, 1], Y[0, 0, 1] = O[0, 0], Y[0, 0, 0]
    if kind == 5:
        Y[:] = 0.0
    if kind == 6:
        O[0, 0], O[0, 1] = O[0, 0, :1], 0.0
    if kind == 7:
        O[..., -1] = O[..., 0]
    return (O, Y) if kind == 7 or np.linalg.matrix_rank(O[0].reshape(-1, n)) == n else problem(rng, trial)


def solve(O, Y, norm=2, rounds=2000):
    return decoded(grouped(O, Y, np.ones(Y.shape, bool), norm), rounds)[0, 0]


def objective(O, Y, x, norm):
    g = grouped(O, Y, np.ones(Y.shape, bool), norm)
    return np.linalg.norm(g.Y[0, 0] - g.O[0] @ x, axis=1).sum()


def projected(O, Y, s, eps, rounds=20_000):
    rows, turn = orthonormal(O)
    plan = ProjectedPlan(rows, turn, None, None, None, np.array([eps]), 0.0)
    held, pull = Centred(Y, np.ones(Y.shape, bool), None, None, None), pulled(rows, Y)
    found = solved(plan, held, weighed(np.ones(pull.shape[:3]), pull), np.zeros_like(Y), s, 0.3, rounds)
    return plan, held, found, np.linalg.solve(turn[0], found.x[0, 0])
