"""Matrices of the plain loop as machine code: the bits of loops over single numbers, in every batch."""

import numpy as np
import pytest

import tailgate
from tailgate import num
from tailgate.estimators.filters import imm, kalman

RNG = np.random.default_rng(11)
BATCHES = (1, 2, 7, 8, 9, 31, 32, 33, 70)


def _ordered(x, y, first=0.0):
    """x (i, k) times y (k, j), summed from `first` in ascending order."""
    out = np.full((len(x), y.shape[1]), first)
    for k in range(x.shape[1]):
        for i, j in np.ndindex(out.shape):
            out[i, j] += float(x[i, k]) * float(y[k, j])
    return out


def _eliminated(s):
    """The inverse of one matrix by Gauss-Jordan, column after column."""
    left, right = s.copy(), np.eye(len(s))
    for p in range(len(s)):
        scale = 1.0 / left[p, p]
        left[p], right[p] = left[p] * scale, right[p] * scale
        for i in range(len(s)):
            if i != p:
                left[i], right[i] = left[i] - left[i, p] * left[p], right[i] - left[i, p] * right[p]
    return right


def _spd(*shape):
    x = RNG.normal(size=(*shape, shape[-1]))
    return x @ np.swapaxes(x, -1, -2) + np.eye(shape[-1])


@pytest.mark.parametrize("batch", BATCHES)
def test_products_and_inverses_are_plain_loops(batch, same_bits):
    """Constant matrices with zeros, one for each agent and one for all; inverses of odd and even size."""
    matrices, x = RNG.normal(size=(3, 5, 4)) * (RNG.uniform(size=(3, 5, 4)) < 0.6), RNG.normal(size=(batch, 3, 4))
    want = np.stack([[_ordered(matrices[n], x[b, n][:, None])[:, 0] for n in range(3)] for b in range(batch)])
    assert same_bits(num.apply(matrices, x), want)
    base = RNG.normal(size=want.shape)
    assert same_bits(num.apply(matrices, x, base), base + want)
    flat = matrices[:, :2]  # fewer rows than columns
    assert same_bits(num.apply(flat, x), want[..., :2])
    want = np.stack([[_ordered(matrices[0], x[b, n][:, None])[:, 0] for n in range(3)] for b in range(batch)])
    assert same_bits(num.apply(matrices[:1], x), want)
    wide = RNG.normal(size=(batch, 3, 4, 2))
    assert same_bits(num.matmul(matrices, wide), np.stack([[_ordered(matrices[n], wide[b, n]) for n in range(3)] for b in range(batch)]))
    for q in (3, 4, 7):
        s = _spd(batch, 2, q)
        assert same_bits(num.inverse(s), np.stack([[_eliminated(s[b, n]) for n in range(2)] for b in range(batch)]))


def test_zeros_of_a_matrix_count_for_nothing():
    """Whatever stands where a constant matrix is zero."""
    m, x = np.array([[[1.0, 0.0]]]), np.array([[[2.0, np.inf]], [[3.0, np.nan]]])
    np.testing.assert_array_equal(num.apply(m, x), [[[2.0]], [[3.0]]])
    np.testing.assert_array_equal(num.matmul(m, x[..., None])[..., 0], [[[2.0]], [[3.0]]])


@pytest.mark.parametrize("batch", BATCHES)
def test_a_covariance_is_carried_on_as_by_matrices(batch, same_bits):
    A, Q, P = RNG.normal(size=(5, 5)), _spd(5), _spd(batch, 3, 5)
    assert same_bits(num.congruent(A, P, Q), num.matmul(A, num.transpose(num.matmul(A, P))) + Q)


@pytest.mark.parametrize("n", [2, 5])
@pytest.mark.parametrize("batch", BATCHES)
def test_predictions_are_fused_as_by_matrices(n, batch, same_bits):
    """The filter of steady gain, and of covariances of each row or of one for all, with weights and without."""
    heard = np.array([[True, False, False], [True, True, False], [True, True, True]])
    A, B, c, L, merge = RNG.normal(size=(n, n)), RNG.normal(size=(n, 1)), RNG.normal(size=n), _spd(3, n), _spd(3, n)
    x, u, spread = RNG.normal(size=(batch, 3, n)), RNG.normal(size=(batch, 3, 1)), _spd(batch, 3, n)
    z = num.apply(L, num.apply(A[None], x) + num.apply(B[None], u) + c)
    total = np.zeros(z.shape)
    for i, j in zip(*np.nonzero(heard), strict=True):
        total[:, i] += z[:, j]
    assert same_bits(num.predicted(A, B, c, L, merge, heard, x, u), num.apply(merge, total))

    weight = np.where(RNG.uniform(size=(batch, 3, 3)) < 0.5, 1.0, RNG.uniform(size=(batch, 3, 3)))
    for M, w in ((spread, weight), (spread[:1], weight), (spread, np.ones((1, 3, 3)))):
        t = np.zeros((len(w), 3))
        for i, j in zip(*np.nonzero(heard), strict=True):
            t[:, i] += w[:, i, j]
        L = num.inverse(M)
        y, Qinv, mean = num.matvec(L, x), np.zeros((batch, 3, n, n)), np.zeros((batch, 3, n))
        for i in range(3):
            Q, total = np.zeros((batch, n, n)), np.zeros((batch, n))
            for j in np.flatnonzero(heard[i]):
                Q, total = Q + w[:, i, j, None, None] * L[:, j], total + w[:, i, j, None] * y[:, j]
            Qinv[:, i] = num.inverse(Q / t[:, i, None, None])
            mean[:, i] = num.matvec(Qinv[:, i], total / t[:, i, None])
        got = num.fused(heard, x, M, (w, t, np.zeros(t.shape)))
        assert same_bits(got[0], mean) and same_bits(got[1], Qinv)
    grown = num.fused(heard, x, num.congruent(A, spread, np.eye(n)))
    assert all(same_bits(a, b) for a, b in zip(num.fused(heard, x, spread, step=(A, np.eye(n))), grown, strict=True))
    assert same_bits(grown[0], num.fused(heard, x, num.congruent(A, spread, np.eye(n)), (np.ones((1, 3, 3)), heard.sum(axis=1)[None], np.zeros((1, 3))))[0])


@pytest.mark.parametrize("moved", range(4))
def test_what_is_the_same_in_all_rows_is_computed_once_and_changes_no_bit(moved, same_bits):
    """A batch in which all rows have equal covariances but those of one agent, or of none: each row as by itself."""
    heard, A, C, Q = np.tril(np.ones((3, 3), bool)), RNG.normal(size=(5, 5)), RNG.normal(size=(3, 2, 5)), np.eye(5)
    heard[2, 1] = False
    x, r, P, W = RNG.normal(size=(20, 3, 5)), RNG.normal(size=(20, 3, 2)), np.repeat(_spd(1, 3, 5), 20, axis=0), np.repeat(_spd(1, 3, 2), 20, axis=0)
    keep, weight = np.ones((20, 3, 2)), np.ones((20, 3, 3))
    if moved < 3:
        P[17, moved, 0, 0] = np.nextafter(P[17, moved, 0, 0], 9e9)
        keep[18, moved, 1], weight[19, moved, 0] = 0.0, 0.5
    total = np.sum(weight * heard, axis=2)
    for rows in (slice(0, 20), slice(16, 20)):
        parts = x[rows], P[rows], (weight[rows], total[rows], np.zeros((20, 3))[rows]), (A, Q)
        grown, fused, corrected = num.congruent(A, P[rows], Q), num.fused(heard, *parts), num.corrected(C, W[rows], *parts[:2], r[rows], keep[rows])
        for b in range(len(x[rows])):
            one = slice(rows.start + b, rows.start + b + 1)
            alone = x[one], P[one], (weight[one], total[one], np.zeros((1, 3))), (A, Q)
            assert same_bits(grown[b : b + 1], num.congruent(A, P[one], Q))
            for many, single in ((fused, num.fused(heard, *alone)), (corrected, num.corrected(C, W[one], *alone[:2], r[one], keep[one]))):
                assert all(same_bits(got[b : b + 1], want) for got, want in zip(many, single, strict=True))


@pytest.mark.parametrize("q", [1, 2, 3, 7])
@pytest.mark.parametrize("batch", BATCHES)
def test_a_correction_is_that_of_matrices(q, batch, same_bits):
    C, inverse, x, before = RNG.normal(size=(3, q, 5)), _spd(batch, 3, q), RNG.normal(size=(batch, 3, 5)), _spd(batch, 3, 5)
    r, keep = RNG.normal(size=(batch, 3, q)), RNG.uniform(size=(batch, 3, q)) < 0.7
    for P, W in ((before, inverse), (before[:1], inverse), (before, inverse[:1])):
        cross = num.matmul(C, P) * keep[..., None]
        K = num.transpose(num.matmul(W, cross))
        after = P - num.matmul(K, cross)
        got = num.corrected(C, W, x, P, r, keep)
        assert same_bits(got[0], x + num.matvec(K, r * keep)) and same_bits(got[1], 0.5 * (after + num.transpose(after)))


@pytest.mark.thin(4)
@pytest.mark.parametrize("defence", ["kf", "chi2_kf", "chi2_kf_sparse", "imm"])
def test_filters_of_many_states_are_the_textbook_recursion(defence, monkeypatch, short, play, same_bits):
    """Functions of whole passes are products one after the other: five cars, each with 19 states, some of whose readings go missing."""
    place = short("platoon-lossy-v0", horizon=50)

    def played():
        return play(place, defence, tailgate.make_attack("fdi", start_step=20, value=-20.0), range(11), plain=True)

    fast = played()
    for module in (imm, kalman):
        monkeypatch.setattr(module, "SMALL", 100)
    slow = played()
    assert same_bits(fast.estimate, slow.estimate) and fast.estimate.shape[-1] == 19
    assert [fast.trace_hash(row) for row in range(11)] == [slow.trace_hash(row) for row in range(11)]
