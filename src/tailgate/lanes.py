"""Compiled kernels of matrices that take eight episodes at a time, each in a lane of a vector of the processor (`tailgate.vector`).

To vectorise a loop over a batch is otherwise left to the compiler, which does it along the wrong index, or not at all, where matrices are
small. What a row of a batch gets does not depend on the others; where eight does not divide a batch, the last lanes repeat its last row. As
in `tailgate.linear`, every sum has a fixed order and nothing is contracted.
"""

import numba
import numpy as np

from tailgate.vector import WIDTH, alike, get, put

_jit = numba.njit(cache=True, fastmath=False, error_model="numpy", nogil=True)
_part = numba.njit(cache=True, fastmath=False, error_model="numpy", forceinline=True)

# -- parts


@_part
def _room(size):
    """So many numbers, the first of them at the beginning of a cache line."""
    whole = np.empty(size + WIDTH)
    first = (-whole.ctypes.data // 8) % WIDTH
    return whole[first : first + size]


@_part
def _pack(flat, at, rows, batch, first, columns, room, u):
    """`rows` rows of so many columns of what stands at `at`, (rows, batch), from `first` on, side by side at u of a room.

    Of a batch of 1 the columns are alike.
    """
    if first + columns <= batch:
        for e in range(rows):
            for c in range(0, columns, WIDTH):
                put(room, u + e * columns + c, get(flat, at + e * batch + first + c))
    else:
        for e in range(rows):
            for c in range(columns):
                room[u + e * columns + c] = flat[at + e * batch + min(first + c, batch - 1)]


@_part
def _unpack(room, u, rows, flat, at, batch, first, columns):
    """The way back."""
    if first + columns <= batch:
        for e in range(rows):
            for c in range(0, columns, WIDTH):
                put(flat, at + e * batch + first + c, get(room, u + e * columns + c))
    else:
        for e in range(rows):
            for c in range(batch - first):
                flat[at + e * batch + first + c] = room[u + e * columns + c]


@_part
def _same(flat, at, rows, batch):
    """Whether what stands at `at`, (rows, batch), is the same in the whole batch to the last bit: what is computed of it is so too."""
    bits = flat.view(np.int64)
    for e in range(at, at + rows * batch, batch):
        for b in range(1, batch):
            if bits[e + b] != bits[e]:
                return False
    return True


@_part
def _entries(matrices):
    """What is not zero of matrices (M, i, k), row after row: values, their k, and where each row of each matrix begins."""
    values, places = np.empty(matrices.size), np.empty(matrices.size, np.intp)
    starts = np.empty(matrices.shape[0] * matrices.shape[1] + 1, np.intp)
    count = row = 0
    for m in range(matrices.shape[0]):
        for i in range(matrices.shape[1]):
            starts[row], row = count, row + 1
            for k in range(matrices.shape[2]):
                if matrices[m, i, k] != 0.0:
                    values[count], places[count], count = matrices[m, i, k], k, count + 1
    starts[row] = count
    return values, places, starts


@_part
def _constant(entries, line, rows, x, u, row, column, columns, y, v):
    """y (rows, columns) at v = the matrix whose entries begin at `line` times x (inner, columns) at u; all columns are lanes.

    In x a row is `row` numbers behind the one before, and lanes `column` behind those before. Sums run from 0.
    """
    values, places, starts = entries
    for i in range(rows):
        begin, end, to = starts[line + i], starts[line + i + 1], v + i * columns * WIDTH
        for step in range(0, columns if columns >= 4 else 0, 4):  # sums that wait for themselves, four at a time
            first = min(step, columns - 4)
            a = b = c = d = alike(0.0)
            for e in range(begin, end):
                w, o = alike(values[e]), u + places[e] * row + first * column
                a, b = a + w * get(x, o), b + w * get(x, o + column)
                c, d = c + w * get(x, o + 2 * column), d + w * get(x, o + 3 * column)
            put(y, to + first * WIDTH, a)
            put(y, to + first * WIDTH + WIDTH, b)
            put(y, to + first * WIDTH + 2 * WIDTH, c)
            put(y, to + first * WIDTH + 3 * WIDTH, d)
        for first in range(columns if columns < 4 else 0):
            a = alike(0.0)
            for e in range(begin, end):
                a = a + alike(values[e]) * get(x, u + places[e] * row + first * column)
            put(y, to + first * WIDTH, a)


@_part
def _grow(entries, noise, n, P, u, half):
    """A P A' + Q in the place of P (n, n), of lanes from u on, by the entries of A and Q (n n)."""
    _constant(entries, 0, n, P, u, n * WIDTH, WIDTH, n, half, 0)
    _constant(entries, 0, n, half, 0, WIDTH, n * WIDTH, n, P, u)  # of its transpose
    for e in range(n * n):
        put(P, u + e * WIDTH, get(P, u + e * WIDTH) + alike(noise[e]))


@_part
def _times(x, u, y, v, rows, inner, columns, z, w):
    """z (rows, columns) at w = x (rows, inner) at u times y (inner, columns) at v, all of lanes. Sums begin with their first product."""
    for i in range(rows):
        for j in range(columns):
            at, o = u + i * inner * WIDTH, v + j * WIDTH
            total = get(x, at) * get(y, o)
            for k in range(1, inner):
                total = total + get(x, at + k * WIDTH) * get(y, o + k * columns * WIDTH)
            put(z, w + (i * columns + j) * WIDTH, total)


@_part
def _scale(a, mine, at, row):
    """Divides a row by its pivot, whose place takes what the inverse has there."""
    scale = alike(1.0) / get(a, mine + at)
    put(a, mine + at, alike(1.0))
    for j in range(mine, mine + row, WIDTH):
        put(a, j, get(a, j) * scale)


@_part
def _clear(a, other, mine, at, row):
    """Takes a pivot's column out of another row."""
    factor = get(a, other + at)
    put(a, other + at, alike(0.0))
    for j in range(0, row, WIDTH):
        put(a, other + j, get(a, other + j) - factor * get(a, mine + j))


@_part
def _invert(a, u, q):
    """The inverse of a symmetric positive definite (q, q) of lanes from u on, in its place: as `num.inverse` has it.

    Columns are taken two at a time, each number by the same operations in the same order as one after the other: half the way to memory.
    """
    row = q * WIDTH
    if q == 2:
        one, both, other = get(a, u), get(a, u + WIDTH), get(a, u + 3 * WIDTH)
        scale = alike(1.0) / (one * other - both * both)
        both = alike(-1.0) * both * scale
        put(a, u, other * scale)
        put(a, u + WIDTH, both)
        put(a, u + 2 * WIDTH, both)
        put(a, u + 3 * WIDTH, one * scale)
        return
    for p in range(0, q - 1, 2):
        mine, at, near = u + p * row, p * WIDTH, p * WIDTH + WIDTH
        next = mine + row
        _scale(a, mine, at, row)
        _clear(a, next, mine, at, row)
        _scale(a, next, near, row)
        for other in range(u, u + q * row, row):
            if other != mine and other != next:
                f = get(a, other + at)
                g = get(a, other + near) - f * get(a, mine + near)
                put(a, other + at, alike(0.0))
                for j in range(0, row, WIDTH):
                    put(a, other + j, get(a, other + j) - f * get(a, mine + j) - g * get(a, next + j))
                put(a, other + near, alike(0.0) - g * get(a, next + near))
        _clear(a, mine, next, near, row)
    if q % 2:
        last = u + (q - 1) * row
        _scale(a, last, row - WIDTH, row)
        for other in range(u, last, row):
            _clear(a, other, last, row - WIDTH, row)


# -- kernels


@_jit
def apply_each(matrix, x, base, out):
    """out (N, i, B) = base + matrix[n] x[n], for matrix (N, i, k) or (1, i, k), x (N, k, B) and base (N, i, B), or of no size for none.

    Sums run from 0 over k in ascending order, and zeros of the matrix count for nothing.
    """
    (alone, rows, inner), (agents, _, batch) = matrix.shape, x.shape
    columns = 4 if batch > 2 * WIDTH else 1
    wide = columns * WIDTH
    room, result, more = _room(inner * wide), _room(rows * wide), _room(rows * wide)
    entries, source, target, under = _entries(matrix), x.reshape(-1), out.reshape(-1), base.reshape(-1)
    for first in range(0, batch, wide):
        for n in range(agents):
            line, at, to = n * rows if alone > 1 else 0, n * inner * batch, n * rows * batch
            if rows < inner and first + wide <= batch:  # little of x is read, and that not often
                _constant(entries, line, rows, source, at + first, batch, WIDTH, columns, result, 0)
            else:
                _pack(source, at, inner, batch, first, wide, room, 0)
                _constant(entries, line, rows, room, 0, wide, WIDTH, columns, result, 0)
            if base.size:
                _pack(under, to, rows, batch, first, wide, more, 0)
                for e in range(0, rows * wide, WIDTH):
                    put(result, e, get(more, e) + get(result, e))
            _unpack(result, 0, rows, target, to, batch, first, wide)


@_jit
def invert_each(s, out):
    """Inverses out (M, q, q, B) of symmetric positive definite s (M, q, q, B) by Gauss-Jordan without pivots."""
    q, batch = s.shape[1], s.shape[3]
    a, source, target = _room(q * q * WIDTH), s.reshape(-1), out.reshape(-1)
    for m in range(s.shape[0]):
        for first in range(0, batch, WIDTH):
            _pack(source, m * q * q * batch, q * q, batch, first, WIDTH, a, 0)
            _invert(a, 0, q)
            _unpack(a, 0, q * q, target, m * q * q * batch, batch, first, WIDTH)


# -- the distributed filter (estimators/distributed.py), each pass over a batch's covariances in one kernel


@_jit
def predict_each(A, B, c, L, merge, heard, x, u, out):
    """out (N, n, B) = merge_i sum_j L_j (A x_j + B u_j + c) over the j in heard (N, N) bool, for x (N, n, B) and u (N, m, B)."""
    (agents, n, batch), m = x.shape, u.shape[1]
    columns = 4 if batch > 2 * WIDTH else 1
    wide = columns * WIDTH
    line = n * wide
    a, b, d, z = _room(line), _room(m * wide), _room(line), _room(agents * line)
    drift, drive, send, gather = _entries(A[None]), _entries(B[None]), _entries(L), _entries(merge)
    source, known, target = x.reshape(-1), u.reshape(-1), out.reshape(-1)
    for first in range(0, batch, wide):
        for j in range(agents):
            _pack(source, j * n * batch, n, batch, first, wide, a, 0)
            _pack(known, j * m * batch, m, batch, first, wide, b, 0)
            _constant(drift, 0, n, a, 0, wide, WIDTH, columns, d, 0)
            _constant(drive, 0, n, b, 0, wide, WIDTH, columns, a, 0)
            for i in range(n):
                for e in range(i * wide, i * wide + wide, WIDTH):
                    put(a, e, get(d, e) + get(a, e) + alike(c[i]))
            _constant(send, j * n, n, a, 0, wide, WIDTH, columns, z, j * line)
        for i in range(agents):
            for e in range(0, line, WIDTH):
                total = alike(0.0)
                for j in range(agents):
                    if heard[i, j]:
                        total = total + get(z, j * line + e)
                put(a, e, total)
            _constant(gather, i * n, n, a, 0, wide, WIDTH, columns, d, 0)
            _unpack(d, 0, n, target, i * n * batch, batch, first, wide)


@_jit
def spread_each(A, P, Q, out):
    """out (N, n, n, B) = A P A' + Q for P (N, n, n, B)."""
    n, size, batch = A.shape[0], A.size, P.shape[3]
    a, half, entries = _room(size * WIDTH), _room(size * WIDTH), _entries(A[None])
    noise, source, target = Q.reshape(-1), P.reshape(-1), out.reshape(-1)
    for at in range(0, P.shape[0] * size * batch, size * batch):
        same = _same(source, at, size, batch)
        for first in range(0, batch, WIDTH):
            if first == 0 or not same:
                _pack(source, at, size, batch, first, WIDTH, a, 0)
                _grow(entries, noise, n, a, 0, half)
            _unpack(a, 0, size, target, at, batch, first, WIDTH)


@_jit
def fuse_each(A, Q, heard, M, x, weight, total, begin, P, out):
    """Q_i^-1 into P (N, n, n, B) and xb_i into out (N, n, B) of what is sent, x (N, n, B) with its covariances M (N, n, n, B or 1).

    M is what they are one step before where A and Q (n, n) are given, and of size.

    Q_i = sum_j w_ij L_j / t_i over the j in heard (N, N) bool, and xb_i with it; weight (N, N, B or 1) and total (N, as weight). The sum
    of the matrices begins with the zero `begin` (as total), of either sign: adding -0 changes no bit.
    """
    agents, n, batch = x.shape
    size = n * n
    L, inverses, y = _room(agents * size * WIDTH), _room(agents * size * WIDTH), _room(agents * n * WIDTH)
    z, mean, half = _room(n * WIDTH), _room(n * WIDTH), _room(size * WIDTH)
    w, t, start = _room(agents * agents * WIDTH), _room(agents * WIDTH), _room(agents * WIDTH)
    sent, spread, fused, covariance = x.reshape(-1), M.reshape(-1), out.reshape(-1), P.reshape(-1)
    entries, noise = _entries(A[None]), Q.reshape(-1)
    weights, totals, begins = weight.reshape(-1), total.reshape(-1), begin.reshape(-1)
    alone, shared = np.empty(agents, np.bool_), np.empty(agents, np.bool_)
    for j in range(agents):
        alone[j] = _same(spread, j * size * M.shape[3], size, M.shape[3])
    for i in range(agents):
        b = weight.shape[2]
        shared[i] = _same(weights, i * agents * b, agents, b) and _same(totals, i * b, 1, b) and _same(begins, i * b, 1, b)
        for j in range(agents):
            shared[i] &= alone[j] or not heard[i, j]
    for first in range(0, batch, WIDTH):
        _pack(weights, 0, agents * agents, weight.shape[2], first, WIDTH, w, 0)
        _pack(totals, 0, agents, weight.shape[2], first, WIDTH, t, 0)
        _pack(begins, 0, agents, weight.shape[2], first, WIDTH, start, 0)
        for j in range(agents):
            at = j * size * WIDTH
            if first == 0 or not alone[j]:
                _pack(spread, j * size * M.shape[3], size, M.shape[3], first, WIDTH, L, at)
                if A.size:
                    _grow(entries, noise, n, L, at, half)
                _invert(L, at, n)
            _pack(sent, j * n * batch, n, batch, first, WIDTH, z, 0)
            _times(L, at, z, 0, n, n, 1, y, j * n * WIDTH)
        for i in range(agents):
            at, fresh, whole = i * size * WIDTH, first == 0 or not shared[i], get(t, i * WIDTH)
            for e in range(at, at + size * WIDTH if fresh else at, WIDTH):
                put(inverses, e, get(start, i * WIDTH))
            for e in range(0, n * WIDTH, WIDTH):
                put(z, e, alike(0.0))
            for j in range(agents):
                if heard[i, j]:
                    share = get(w, (i * agents + j) * WIDTH)
                    for e in range(0, size * WIDTH if fresh else 0, WIDTH):
                        put(inverses, at + e, get(inverses, at + e) + share * get(L, j * size * WIDTH + e))
                    for e in range(0, n * WIDTH, WIDTH):
                        put(z, e, get(z, e) + share * get(y, j * n * WIDTH + e))
            for e in range(0, n * WIDTH, WIDTH):
                put(z, e, get(z, e) / whole)
            if fresh:
                for e in range(at, at + size * WIDTH, WIDTH):
                    put(inverses, e, get(inverses, e) / whole)
                _invert(inverses, at, n)
            _times(inverses, at, z, 0, n, n, 1, mean, 0)
            _unpack(inverses, at, size, covariance, i * size * batch, batch, first, WIDTH)
            _unpack(mean, 0, n, fused, i * n * batch, batch, first, WIDTH)


@_jit
def correct_each(C, W, x, P, r, keep, out, new):
    """The Kalman update of x (N, n, B) and P (N, n, n, B or 1) by r (N, q, B), whose covariance has the inverse W (N, q, q, B or 1).

    keep (N, q, B): 0 for the sensors that are left out, 1 for the others. Into out (N, n, B) and new (N, n, n, B).
    """
    (agents, q, n), batch = C.shape, x.shape[2]
    size, line = n * n, n * WIDTH
    p, w, off, mask, mean, step = _room(size * WIDTH), _room(q * q * WIDTH), _room(q * WIDTH), _room(q * WIDTH), _room(line), _room(line)
    cross, gain, turned, product = _room(q * line), _room(q * line), _room(q * line), _room(size * WIDTH)
    entries, was, known, residue, kept = _entries(C), x.reshape(-1), P.reshape(-1), r.reshape(-1), keep.reshape(-1)
    told, fused, target = W.reshape(-1), out.reshape(-1), new.reshape(-1)
    for i in range(agents):
        at, to, near = i * size * P.shape[3], i * q * q * W.shape[3], i * q * batch
        same = _same(known, at, size, P.shape[3]) and _same(told, to, q * q, W.shape[3]) and _same(kept, near, q, batch)
        for first in range(0, batch, WIDTH):
            fresh = first == 0 or not same
            if fresh:
                _pack(known, at, size, P.shape[3], first, WIDTH, p, 0)
                _pack(told, to, q * q, W.shape[3], first, WIDTH, w, 0)
                _pack(kept, near, q, batch, first, WIDTH, mask, 0)
                _constant(entries, i * q, q, p, 0, line, WIDTH, n, cross, 0)
                for m in range(q):
                    for e in range(m * line, m * line + line, WIDTH):
                        put(cross, e, get(cross, e) * get(mask, m * WIDTH))
                _times(w, 0, cross, 0, q, q, n, gain, 0)
                for m in range(q):
                    for e in range(n):
                        put(turned, (e * q + m) * WIDTH, get(gain, m * line + e * WIDTH))
                _times(turned, 0, cross, 0, n, q, n, product, 0)
                for e in range(0, size * WIDTH, WIDTH):
                    put(p, e, get(p, e) - get(product, e))
                for e in range(n):
                    for f in range(e, n):
                        one, other = e * line + f * WIDTH, f * line + e * WIDTH
                        both = alike(0.5) * (get(p, one) + get(p, other))
                        put(p, one, both)
                        put(p, other, both)
            _unpack(p, 0, size, target, i * size * batch, batch, first, WIDTH)
            _pack(residue, near, q, batch, first, WIDTH, off, 0)
            for m in range(0, q * WIDTH, WIDTH):
                put(off, m, get(off, m) * get(mask, m))
            _times(turned, 0, off, 0, n, q, 1, step, 0)
            _pack(was, i * n * batch, n, batch, first, WIDTH, mean, 0)
            for e in range(0, line, WIDTH):
                put(mean, e, get(mean, e) + get(step, e))
            _unpack(mean, 0, n, fused, i * n * batch, batch, first, WIDTH)
