"""Compiled kernels of matrices: products and small problems, each row of a batch by itself. `tailgate.lanes` has those of large matrices.

As in `tailgate.kernels`, every sum has a fixed order and nothing is contracted, so that a row has the same bits in every batch.
"""

import math

import numpy as np

from tailgate.jit import jit

_jit = jit(cache=True)


@_jit
def constant_times(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    """out (M, i, c) = x y[m] for one x (i, k) and y (M, k, c).

    Sums run from 0 over k in ascending order, and zeros of x count for nothing.
    """
    for m in range(y.shape[0]):
        for first in range(0, y.shape[2], 256):  # so many columns of y[m] stay in the cache
            last = min(first + 256, y.shape[2])
            for i in range(x.shape[0]):
                total = out[m, i, first:last]  # a slice is indexed from 0, which the compiler sees: it takes several at a time
                total[:] = 0.0
                for k in range(x.shape[1]):
                    v = x[i, k]
                    if v != 0.0:
                        row = y[m, k, first:last]
                        for c in range(len(total)):
                            total[c] += v * row[c]


@_jit
def times_each(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
    """out (M, i, j, B) = x (M, i, k, B) times y (M, k, j, B), summed over k in ascending order. M, B of x or y may be 1: alike for all."""
    for m in range(out.shape[0]):
        mx, my = m if x.shape[0] > 1 else 0, m if y.shape[0] > 1 else 0
        for i in range(out.shape[1]):
            for j in range(out.shape[2]):
                for k in range(x.shape[2]):
                    first, last = x[mx, i, k], y[my, k, j]
                    total = out[m, i, j]
                    if len(first) == 1:
                        v = first[0]
                        if len(last) == 1:
                            for b in range(len(total)):
                                total[b] = v * last[0] if k == 0 else total[b] + v * last[0]
                        else:
                            for b in range(len(total)):
                                total[b] = v * last[b] if k == 0 else total[b] + v * last[b]
                    elif len(last) == 1:
                        v = last[0]
                        for b in range(len(total)):
                            total[b] = first[b] * v if k == 0 else total[b] + first[b] * v
                    else:
                        for b in range(len(total)):
                            total[b] = first[b] * last[b] if k == 0 else total[b] + first[b] * last[b]


@_jit
def add_moment(weight: np.ndarray, P: np.ndarray, off: np.ndarray, out: np.ndarray, first: bool) -> None:
    """out (N, n, n, B) takes on weight (P + off off') for weight (N, B), P as out and off (N, n, B); the first is what it begins with."""
    for m in range(P.shape[0]):
        w = weight[m]
        for i in range(P.shape[1]):
            for j in range(P.shape[2]):
                p, x, y, total = P[m, i, j], off[m, i], off[m, j], out[m, i, j]
                if first:
                    for b in range(len(total)):
                        total[b] = w[b] * (p[b] + x[b] * y[b])
                else:
                    for b in range(len(total)):
                        total[b] = total[b] + w[b] * (p[b] + x[b] * y[b])


@_jit
def product(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """x (i, k) times y (k, j), summed over k in ascending order."""
    out = np.zeros((x.shape[0], y.shape[1]))
    for i in range(x.shape[0]):
        for k in range(x.shape[1]):
            v = x[i, k]
            if v != 0.0:
                for j in range(y.shape[1]):
                    out[i, j] += v * y[k, j]
    return out


@_jit
def solve(m: np.ndarray, y: np.ndarray) -> np.ndarray:
    """m^-1 y for m (n, n) and y (n, k), by Gauss-Jordan elimination with row pivots; both are used up."""
    n = m.shape[0]
    for p in range(n):
        best = p
        for i in range(p + 1, n):
            if abs(m[i, p]) > abs(m[best, p]):
                best = i
        if best != p:
            for j in range(n):
                m[p, j], m[best, j] = m[best, j], m[p, j]
            for j in range(y.shape[1]):
                y[p, j], y[best, j] = y[best, j], y[p, j]
        for i in range(n):
            if i != p:
                factor = m[i, p] / m[p, p]
                if factor != 0.0:
                    for j in range(p, n):
                        m[i, j] -= factor * m[p, j]
                    for j in range(y.shape[1]):
                        y[i, j] -= factor * y[p, j]
    for i in range(n):
        for j in range(y.shape[1]):
            y[i, j] /= m[i, i]
    return y


@_jit
def turn(x, q, p, n):
    """Rotates q rows of p numbers each, one after the other in x, until their first n entries are orthogonal.

    Jacobi's rotations from one side, pair by pair.
    """
    turned, sweep = True, 0
    while turned and sweep < 60:
        turned, sweep = False, sweep + 1
        for i in range(0, (q - 1) * p, p):
            for j in range(i + p, q * p, p):
                a = b = g = 0.0
                for k in range(n):
                    v, w = x[i + k], x[j + k]
                    a, b, g = a + v * v, b + w * w, g + v * w
                if abs(g) <= 1e-15 * math.sqrt(a * b):
                    continue
                turned, half = True, (b - a) / (2.0 * g)
                t = (1.0 if half >= 0.0 else -1.0) / (abs(half) + math.sqrt(half * half + 1.0))
                c = 1.0 / math.sqrt(t * t + 1.0)
                for k in range(p):
                    v, w = x[i + k], x[j + k]
                    x[i + k], x[j + k] = c * (v - t * w), c * (w + t * v)


@_jit
def turn_rows(x: np.ndarray, n: int) -> None:
    """`turn` of each x (M, q, p)."""
    for m in range(x.shape[0]):
        turn(x[m].reshape(-1), x.shape[1], x.shape[2], n)


@_jit
def ball(q, x, c, u):
    """u (q,): x_k / (c_k + mu) with the least mu >= 0 at which |u| <= 1, for x (q,) and c (q,) >= 0; 0/0 counts as 0."""
    mu = length = s = largest = 0.0
    for k in range(q):
        mu, length, largest = max(mu, abs(x[k]) - c[k]), length + x[k] * x[k], max(largest, c[k])
        s += (x[k] / c[k]) ** 2 if x[k] != 0.0 else 0.0
    mu, size = max(mu, math.sqrt(length) - largest) if s > 1.0 else 0.0, 1.0
    for _ in range(100 if s > 1.0 else 0):  # Newton on 1 / |u|, monotone from below
        s = t = 0.0
        for k in range(q):
            z = x[k] / (c[k] + mu) if x[k] != 0.0 else 0.0
            s, t = s + z * z, t + (z * z / (c[k] + mu) if z != 0.0 else 0.0)
        size = math.sqrt(s)
        step = s * (size - 1.0) / t
        if not step > 1e-15 * mu:
            break
        mu += step
    for k in range(q):
        u[k] = x[k] / (c[k] + mu) / size if x[k] != 0.0 else 0.0


@_jit
def ball_each(w: np.ndarray, c: np.ndarray, u: np.ndarray) -> None:
    """`ball` of w (P, q, B) and c (P, q) into u (P, q, B), each by itself."""
    x, y = np.empty(w.shape[1]), np.empty(w.shape[1])
    for p in range(w.shape[0]):
        for b in range(w.shape[2]):
            x[:] = w[p, :, b]
            ball(len(x), x, c[p], y)
            u[p, :, b] = y


@_jit
def pair(r0, r1, half0, half1, S00, S01, S10, S11, W00, W01, W10, W11):
    """The part of two readings that is believed (robust.py), in closed form; S and W = S^-1, and half of lam.

    Nothing is an outlier, or both are, with one of four pairs of signs s and y = S (s lam) / 2, or one is.
    """
    out0, out1, best = r0, r1, -np.inf
    if not (abs(W00 * r0 + W01 * r1) > half0 or abs(W10 * r0 + W11 * r1) > half1):
        return out0, out1
    for signs in range(4):
        s0, s1 = 1.0 if signs < 2 else -1.0, 1.0 if signs % 2 == 0 else -1.0
        price0, price1 = s0 * half0, s1 * half1
        y0, y1 = S00 * price0 + S01 * price1, S10 * price0 + S11 * price1
        left0, left1 = price0 - (W00 * y0 + W01 * y1), price1 - (W10 * y0 + W11 * y1)
        y0, y1 = y0 + (S00 * left0 + S01 * left1), y1 + (S10 * left0 + S11 * left1)  # mends the rounding
        least = np.minimum(s0 * (r0 - y0), s1 * (r1 - y1))  # negative where a sign is wrong
        if least > best:
            out0, out1 = y0, y1
        best = np.maximum(least, best)
    one = _within(r0, (-half0 - W01 * r1) / W00, (half0 - W01 * r1) / W00)
    if abs(W10 * one + W11 * r1) <= half1:
        out0, out1 = one, r1
    one = _within(r1, (-half1 - W10 * r0) / W11, (half1 - W10 * r0) / W11)
    if abs(W00 * r0 + W01 * one) <= half0:
        out0, out1 = r0, one
    return out0, out1


@_jit
def _within(x, low, high):
    x = low if x <= low else x
    return high if x >= high else x


@_jit
def pivot(q, r, w, half, size, limits, y, z, g, wrong, sign, L):
    """Block principal pivoting (robust.py) of r (q,) with w (q q,) into y (q,); -> how many presumptions are left wrong.

    limits: tolerance, rounding, patience, rounds. z, g, wrong, sign (q,) and L (q q,) are rooms to work in.
    """
    tolerance, rounding, patience, rounds = limits
    fewest, left, count = q + 1, patience, 1
    for i in range(q):  # what each sensor alone would say
        sign[i] = math.copysign(1.0, r[i]) if abs(r[i]) > half[i] * size[i] else 0.0
    for _ in range(rounds):
        for i in range(q):  # L L' = W of the outliers, 1 for the others
            y[i] = r[i] if sign[i] == 0.0 else 0.0
            for j in range(i + 1):
                both = sign[i] != 0.0 and sign[j] != 0.0
                L[i * q + j] = w[i * q + j] if both else (1.0 if i == j else 0.0)
                for k in range(j if both else 0):
                    L[i * q + j] -= L[i * q + k] * L[j * q + k]
                L[i * q + j] = L[i * q + j] / L[j * q + j] if i != j else math.sqrt(L[i * q + i])
        for _again in range(2):  # the second time mends the rounding of the first
            for i in range(q):
                z[i] = sign[i] * half[i]
                for j in range(q if sign[i] != 0.0 else 0):
                    z[i] -= w[i * q + j] * y[j] + (L[i * q + j] * z[j] if j < i else 0.0)
                z[i] /= L[i * q + i]
            for i in range(q - 1, -1, -1):
                for k in range(i + 1, q):
                    z[i] -= L[k * q + i] * z[k]
                z[i] /= L[i * q + i]
            for i in range(q):
                y[i] += z[i]
        last, count = -1, 0
        for i in range(q):
            g[i] = largest = 0.0
            for j in range(q):
                g[i], largest = g[i] + w[i * q + j] * y[j], max(largest, abs(w[i * q + j] * y[j]))
            beyond = abs(g[i]) > half[i] + (tolerance * half[i] + rounding * largest)
            slack = tolerance * half[i] * size[i] + rounding * (abs(r[i]) + abs(y[i]))
            wrong[i] = 1.0 if (beyond if sign[i] == 0.0 else sign[i] * (r[i] - y[i]) < -slack) else 0.0
            last, count = (i, count + 1) if wrong[i] != 0.0 else (last, count)
        if count == 0:
            break
        left, fewest = patience if count < fewest else left - 1, min(count, fewest)
        for i in range(0 if left >= 0 else last, q):
            if wrong[i] != 0.0:
                sign[i] = math.copysign(1.0, g[i]) if sign[i] == 0.0 else 0.0
    return count


@_jit
def pivot_each(r, W, which, half, size, limits, y):
    """`pivot` of r (M, q) with W (K, q q) at which (M,) into y (M, q); returns how many are left unsolved."""
    q, unsolved = r.shape[1], 0
    z, g, wrong, sign, L = np.empty(q), np.empty(q), np.empty(q), np.empty(q), np.empty(q * q)
    for m in range(r.shape[0]):
        unsolved += pivot(q, r[m], W[which[m]], half[m], size[m], limits, y[m], z, g, wrong, sign, L) > 0
    return unsolved
