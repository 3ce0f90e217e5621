"""Products and inverses of small matrices, written once for plain and for traced arrays: sums in a fixed order, element by element.

Arrays are (B, ..., rows, columns). An array that all episodes share has no B, or one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from tailgate.engine.array import Traced, lifted
from tailgate.engine.buffers import boxed, buffer_of, sides, swept, table_of, wide
from tailgate.engine.compiled import shaped
from tailgate.engine.functions import gathered
from tailgate.engine.loops import until
from tailgate.engine.operations import BOOL, FLOAT, Array

SMALL = 4000  # products of numbers up to which numpy is faster than a call of machine code
LOOPED = 64  # numbers of a dense matrix from which multiplication is a loop, because straight code takes long to compile
SPARSE = 100  # numbers of a sparse matrix from which multiplication is a loop
STRAIGHT = 600  # products of numbers in straight code
AT_ONCE = 600  # products of numbers up to which numpy is fastest if it holds all of them before it adds them


def _large(size: int, *arrays: Array) -> bool:
    """Return True if one of these is a buffer, or if an array of `size` made from them becomes one."""
    return any(isinstance(a, Traced) and wide(a.graph, a.nodes, size=size) for a in arrays)


def _size(x: Array, y: Array) -> int:
    """Return how many numbers the product of two arrays has."""
    return math.prod((*np.broadcast_shapes(x.shape[:-2], y.shape[:-2]), x.shape[-2], y.shape[-1])) if x.shape[-1] else 0


def _products(x: Array, y: Array) -> int:
    """Estimate how many scalar multiplications x y needs."""
    return int(max(x.size * y.shape[-1], x.shape[-2] * y.size))


def _over(function: Callable[..., Array], lead: Sequence[int], *arrays: Array) -> Traced:
    """Apply a function to arrays (B, ...) that broadcast to `lead`, for each index of these first axes."""
    graph = next(a.graph for a in arrays if isinstance(a, Traced))
    given = [lifted(graph, a).nodes for a in arrays]

    def body(*parts: Array) -> Array:
        return lifted(graph, function(*(Traced(graph, part, FLOAT) for part in parts))).nodes

    return Traced(graph, swept(graph, body, lead, given), FLOAT, 0)


def _looped(x: Array, y: Traced, base: Array, there: Array | None = None) -> Traced:
    """Return base + x y for a constant x, in a loop with the order of `constant_times` and `dense`."""
    graph = y.graph
    matrix, begin = lifted(graph, x), lifted(graph, base)
    shape, lead = begin.shape, begin.shape[:-2]
    matrices = np.broadcast_to(matrix.nodes, (*lead, *matrix.shape[-2:]))
    places = None if there is None else np.broadcast_to(there, matrices.shape)
    vectors = np.broadcast_to(y.nodes, (*lead, *y.shape[-2:]))
    out = np.empty(shape, object)
    for place in np.ndindex(*lead):
        for j in range(shape[-1]):
            under = begin.nodes[(*place, slice(None), j)]
            kept = None if places is None else places[place]
            out[(*place, slice(None), j)] = graph.matvec(matrices[place], list(vectors[place][:, j]), list(under), kept)
    return Traced(graph, out, FLOAT, None if y.batch is None else y.batch - y.ndim + len(shape))


def structure(x: Array) -> Array:
    """Return where a constant matrix is not zero."""
    return x.nonzero_places() if isinstance(x, Traced) else np.asarray(x) != 0.0


@shaped(lambda x, y: y.ndim > 2 and _products(x, y) > SMALL, "x")
def constant_times(x: Array, y: Array) -> Array:
    """Multiply a constant x (..., i, k) by y (B, ..., k, j): sums run from 0 and skip the zeros of x."""
    if not (isinstance(x, Traced) or isinstance(y, Traced)) and x.shape[-1] and np.isfinite(y).all():
        return _summed(x, y) + 0.0  # zeros of x add nothing, and a sum from 0 is never -0
    if _large(_size(x, y), y):
        if x.ndim > 2 and len(x) > 1:
            return np.stack([constant_times(x[i], y[:, i]) for i in range(len(x))], axis=1)
        one, turned = x.reshape(x.shape[-2:]), np.swapaxes(y, -1, -2)
        return np.swapaxes(_over(lambda column: constant_times(one, column[:, None])[:, 0], turned.shape[:-1], turned), -1, -2)
    there = structure(x)
    dense = there.all() and there.shape[-2] * there.shape[-1] >= LOOPED
    if isinstance(y, Traced) and (dense or np.count_nonzero(there) > SPARSE):
        zero = np.zeros((*np.broadcast_shapes(x.shape[:-2], y.shape[:-2]), x.shape[-2], y.shape[-1]))
        return _looped(x, y, zero, None if dense else there)
    out: Array = np.zeros((*np.broadcast_shapes(x.shape[:-2], y.shape[:-2]), x.shape[-2], y.shape[-1]))
    with np.errstate(all="ignore"):  # y may hold anything where x is zero
        for k in range(x.shape[-1]):
            out = np.where(there[..., k, None], out + x[..., k, None] * y[..., k, None, :], out)
    return out


def _summed(x: Array, y: Array) -> Array:
    """Sum x (..., i, k) times y (..., k, j) over k, beginning with the first product."""
    if not (isinstance(x, Traced) or isinstance(y, Traced)) and _products(x, y) <= AT_ONCE:
        return np.add.accumulate(x[..., None] * y[..., None, :, :], axis=-2)[..., -1, :]  # in ascending order, unlike np.sum
    out = x[..., :1] * y[..., :1, :]
    for k in range(1, x.shape[-1]):
        out = out + x[..., k : k + 1] * y[..., k : k + 1, :]
    return out


@shaped(lambda x, y: x.ndim == y.ndim > 2 and _products(x, y) > SMALL)
def product(x: Array, y: Array) -> Array:
    """Multiply x (..., i, k) by y (..., k, j): sums begin with their first product."""
    if _large(_size(x, y), x, y):
        lead = np.broadcast_shapes(x.shape[:-2], y.shape[:-2])
        if math.prod(lead) == 1:  # one place among much code: a loop over its numbers is shortest
            turned = np.swapaxes(y, -1, -2)[..., None, :, :]
            return _over(lambda row, column: _dot(row, column), (*lead, x.shape[-2], y.shape[-1]), x[..., None, :], turned)
        if x.shape[-2] * y.shape[-2] * y.shape[-1] <= STRAIGHT:
            return _over(product, lead, x, y)
        return _over(lambda row, y: product(row[None], y)[0], (*lead, x.shape[-2]), x, y[..., None, :, :])
    return _summed(x, y)


@shaped(lambda s: s.ndim > 2 < s.shape[-1] and s.size * s.shape[-1] > SMALL)
def inverse(s: Array) -> Array:
    """Invert symmetric positive definite (..., q, q): in closed form for q <= 2, else by Gauss-Jordan without pivots."""
    q = s.shape[-1]
    if q == 1:
        return 1.0 / s
    if q == 2:
        a, b, d = s[..., 0, 0], s[..., 0, 1], s[..., 1, 1]
        scale = 1.0 / (a * d - b * b)
        off = -b * scale
        return np.stack([np.stack([d * scale, off], axis=-1), np.stack([off, a * scale], axis=-1)], axis=-2)
    if isinstance(s, Traced) and any(sides(s.graph, one) for one in s.nodes.reshape(-1, q, q)):
        parts = [lifted(s.graph, _inverse_by_side(Traced(s.graph, one, FLOAT))) for one in s.nodes.reshape(-1, q, q)]
        return Traced(s.graph, np.stack([part.nodes for part in parts]).reshape(s.shape), FLOAT, s.batch)
    if isinstance(s, Traced) and (s.fixed or _large(s.size, s)):
        held = table_of(s.graph, s.nodes) if s.fixed else buffer_of(s.graph, s.nodes)
        return Traced(s.graph, s.graph.picks(s.graph.inverses(held, q)).copy().reshape(s.shape), FLOAT, s.batch)
    out = s.copy()
    for p in range(q):
        scale = 1.0 / out[..., p, p]
        out[..., p, p] = 1.0
        row, column = out[..., p, :] * scale[..., None], out[..., :, p].copy()
        out[..., :, p] = 0.0
        out = out - column[..., None] * row[..., None, :]
        out[..., p, :] = row
    return out


def _inverse_by_side(s: Traced) -> Array:
    """Invert one matrix; if episodes choose it from two matrices of which one is constant, invert both."""
    found = sides(s.graph, s.nodes)
    if found is None:
        return inverse(s)
    where, *both = found
    return np.where(Traced(s.graph, boxed(where), BOOL), *(inverse(Traced(s.graph, side, FLOAT)) for side in both))


def transposed(x: Array) -> Array:
    """Exchange the last two axes."""
    return np.swapaxes(x, -1, -2)


def times(x: Array, v: Array) -> Array:
    """Multiply x (..., i, k) by v (..., k), by `product`."""
    return product(x, v[..., None])[..., 0]


def constant_on(x: Array, v: Array) -> Array:
    """Multiply a constant x (..., i, k) by v (B, ..., k), by `constant_times`."""
    return constant_times(x, v[..., None])[..., 0]


@shaped(lambda A, P, Q: P.size * len(A) > SMALL, "A", "Q")
def congruent(A: Array, P: Array, Q: Array) -> Array:
    """Return A P A' + Q for one A and Q (n, n) and P (B, N, n, n)."""
    return constant_times(A, transposed(constant_times(A, P))) + Q


def predicted(A: Array, B: Array, c: Array, L: Array, merge: Array, heard: Array, x: Array, u: Array) -> Array:
    """Return merge_i sum_j L_j (A x_j + B u_j + c) (B, N, n) over j in heard (N, N) bool, for x (B, N, n) and u (B, N, inputs)."""
    sent = constant_on(L, constant_on(A, x) + constant_on(B, u) + c)
    return constant_on(merge, np.stack([_heard(sent, 0.0, who) for who in structure(heard)], axis=1))


def _heard(sent: Array, begin: Array | float, who: Array) -> Array | float:
    """Sum what agents send (B, N, ...), in their order, over those that are heard (N,) bool."""
    out = begin
    for j in np.flatnonzero(who):
        out = out + sent[:, j]
    return out


def moment(weights: Sequence[Array], covariances: Sequence[Array], offsets: Sequence[Array]) -> Array:
    """Return sum_i w_i (P_i + d_i d_i') (B, N, n, n) in that order, for w_i (B, N), P_i (B, N, n, n) and d_i (B, N, n)."""
    out: Array | None = None
    for w, P, d in zip(weights, covariances, offsets, strict=True):
        term = w[..., None, None] * (P + d[..., :, None] * d[..., None, :])
        out = term if out is None else out + term
    assert out is not None
    return out


def spreads(heard: Array, M: Array, weight: Array, total: Array, begin: Array, step: tuple[Array, Array] | None) -> tuple[Array, Array]:
    """Return L_j = M_j^-1 and Q_i^-1 (B, N, n, n) for sent covariances M (B, N, n, n), after a prediction (A, Q) if given.

    Q_i = (begin_i + sum_j w_ij L_j) / t_i over j in heard (N, N) bool, for w (B, N, N), t and begin (B, N).
    """
    L, out = inverse(M if step is None else congruent(step[0], M, step[1])), []
    for i, who in enumerate(structure(heard)):
        information = begin[:, i, None, None]
        for j in np.flatnonzero(who):
            information = information + weight[:, i, j, None, None] * L[:, j]
        out.append(information / total[:, i, None, None])
    return L, inverse(np.stack(out, axis=1))


def means(heard: Array, x: Array, L: Array, spread: Array, weight: Array, total: Array) -> Array:
    """Return xb_i = Q_i^-1 (sum_j w_ij L_j x_j) / t_i (B, N, n) over j in heard (N, N) bool, for x (B, N, n); see `spreads`."""
    y, out = times(L, x), []
    for i, who in enumerate(structure(heard)):
        mean: Array | float = 0.0
        for j in np.flatnonzero(who):
            mean = mean + weight[:, i, j, None] * y[:, j]
        out.append(mean / total[:, i, None])
    return times(spread, np.stack(out, axis=1))


def corrected(C: Array, W: Array, x: Array, P: Array, r: Array, keep: Array) -> tuple[Array, Array]:
    """Return x (B, N, n) and P (B, N, n, n) after a Kalman update by the innovation r (B, N, q).

    W is the inverse of the covariance of r; keep (B, N, q) selects the sensors that count.
    """
    there = keep.astype(np.float64)
    cross = constant_times(C, P) * there[..., None]
    gain = transposed(product(W, cross))
    left = P - product(gain, cross)
    return x + times(gain, r * there), 0.5 * (left + transposed(left))


def solve(m: Array, y: Array) -> Array:
    """Return m^-1 y for one m (n, n) and y (n, k), by Gauss-Jordan elimination with row pivots."""
    n = len(m)
    both = np.concatenate([m, y], axis=1)
    for p in range(n):
        best = p + int(np.argmax(np.abs(both[p:, p])))
        if best != p:
            both[[p, best]] = both[[best, p]]
        factor = both[:, p] / both[p, p]
        factor[p] = 0.0
        rest = both[:, p:]
        np.subtract(rest, factor[:, None] * rest[p], out=rest, where=(factor != 0.0)[:, None])
    solution: Array = both[:, n:] / np.diagonal(both)[:, None]
    return solution


PAIRS = 15  # pairs of rows that are rotated in straight code
SWEEPS = 60  # most sweeps of Jacobi's rotations; about ten suffice
ROUNDING = 1e-15


@shaped(lambda x, y: x.shape[1] > 5)
@np.errstate(all="ignore")
def orthogonal(x: Array, y: Array) -> tuple[Array, Array]:
    """Return V'X, whose rows are orthogonal, and V'Y for X (M, q, n) and Y (M, q, p), each row to its own relative accuracy.

    V is orthogonal: one-sided Jacobi rotations in fixed order, pair by pair.
    The squared lengths of the rows of V'X are the eigenvalues of X X', in no order.
    """
    n, both = x.shape[-1], np.concatenate([x, y], axis=-1)
    count = both.shape[1]
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    rows, everyone = [both[:, i] for i in range(count)], np.ones(len(both), bool)
    if isinstance(both, Traced) and len(pairs) > PAIRS:
        rows = _one_by_one(rows, pairs, n, everyone)
    else:

        def sweep(*rows: Array) -> tuple[Array, list[Array]]:
            held, turned = list(rows), np.zeros(len(both), bool)
            for i, j in pairs:
                turn, held[i], held[j] = _rotated(held[i], held[j], n)
                turned = turned | turn
            return turned, held

        rows = until(sweep, rows, everyone, SWEEPS)
    both = np.stack(rows, axis=1)
    return both[..., :n], both[..., n:]


def _rotated(v: Array, w: Array, n: int) -> tuple[Array, Array, Array]:
    """Return whether two rows (M, k) rotate, and the rows after their first n numbers are orthogonal."""
    a, b, g = _dot(v[:, :n], v[:, :n]), _dot(w[:, :n], w[:, :n]), _dot(v[:, :n], w[:, :n])
    turn = ~(np.abs(g) <= ROUNDING * np.sqrt(a * b))
    half = (b - a) / (2.0 * np.where(turn, g, 1.0))
    t = np.where(half >= 0.0, 1.0, -1.0) / (np.abs(half) + np.sqrt(half * half + 1.0))
    c = 1.0 / np.sqrt(t * t + 1.0)
    there, t, c = turn[:, None], t[:, None], c[:, None]
    return turn, np.where(there, c * (v - t * w), v), np.where(there, c * (w + t * v), w)


def _one_by_one(rows: list[Array], pairs: list[tuple[int, int]], n: int, everyone: Array) -> list[Array]:
    """Apply the same rotations, one pair per round of a loop, because straight code of all pairs takes long to compile."""
    places = np.array(pairs)

    def row(rows: Sequence[Array], which: Array) -> Array:
        out = rows[0]
        for k in range(1, len(rows)):
            out = np.where(which == k, rows[k], out)
        return out

    def round_of(turned: Array, pair: Array, *rows: Array) -> tuple[Array, list[Array]]:
        which: list[Array] = [gathered(places[:, side], pair)[:, None] for side in (0, 1)]
        i, j = which
        turn, v, w = _rotated(row(rows, i), row(rows, j), n)
        held = [np.where(i == k, v, np.where(j == k, w, one)) for k, one in enumerate(rows)]
        turned, last = turned | turn, pair == len(pairs) - 1
        return ~last | turned, [turned & ~last, np.where(last, 0, pair + 1), *held]

    state = [~everyone, np.zeros(len(everyone), np.int64), *rows]
    return until(round_of, state, everyone, SWEEPS * len(pairs))[2:]


def root(s: Array) -> tuple[Array, Array]:
    """Return D^1/2 V' and D^-1/2 V' for symmetric positive definite S = V D V' (M, q, q): Y with Y'Y = S, and with Y'Y = S^-1."""
    rows, turn = orthogonal(s, np.broadcast_to(np.eye(s.shape[-1]), s.shape))
    half = np.sqrt(_dot(rows, turn))[..., None]  # V'S = D V'
    return turn * half, turn / half


def _dot(x: Array, y: Array) -> Array:
    """Sum products (..., k) in ascending order."""
    out = x[..., 0] * y[..., 0]
    for k in range(1, x.shape[-1]):
        out = out + x[..., k] * y[..., k]
    return out


def dense(x: Array, weight: Array, bias: Array) -> Array:
    """Return x (B, i) times weight (i, o) plus bias (o,): sums begin with the bias and run over i in ascending order."""
    if isinstance(x, Traced) and not x.fixed and weight.size >= LOOPED:
        return _looped(np.swapaxes(weight, 0, 1), x[..., None], np.broadcast_to(bias, (len(x), len(bias)))[..., None])[..., 0]
    out = bias
    for i in range(x.shape[1]):
        out = out + x[:, i, None] * weight[i]
    return out
