"""Elementary functions and small linear algebra: accurate, and the same bits for a row whatever its companions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tailgate import num
from tailgate.engine import elementary

RNG = np.random.default_rng(7)
ROWS = 4096
PARTS = (slice(0, 1), slice(5, 8), slice(0, 64), slice(4000, 4096), slice(1, None), slice(3, None, 2), slice(None, None, -1))


def _ulps(got, want):
    return np.max(np.abs(got - want) / np.spacing(np.abs(want)))


def test_exp_is_accurate_to_two_ulps_over_its_whole_range():
    """exp agrees with the library from the smallest normal result to the largest."""
    x = np.concatenate([np.linspace(-707.9, 709.6, 20001), RNG.normal(size=20000), RNG.normal(size=1000) * 1e-9])
    assert _ulps(num.exp(x), np.exp(x)) <= 2.0


def test_exp_specials():
    """exp of 0, infinities, NaN, and beyond the range."""
    x = np.array([0.0, -0.0, np.inf, -np.inf, 800.0, -800.0, -708.5])
    np.testing.assert_array_equal(num.exp(x), [1.0, 1.0, np.inf, 0.0, np.inf, 0.0, 0.0])
    assert math.isnan(num.exp(np.nan))
    assert num.exp(1.0) == pytest.approx(math.e, rel=3e-16)


def test_log_is_accurate_to_four_ulps_over_its_whole_range():
    """log agrees with the library from the smallest number (denormals too) to the largest, and close to 1."""
    x = np.concatenate([10.0 ** RNG.uniform(-307.0, 308.0, 20000), RNG.uniform(0.0, 3.0, 20000)])
    x = np.concatenate([x, 1.0 + RNG.normal(size=5000) * 1e-6, [5e-324, 2.3e-310, 1.7976931348623157e308, 0.5, 2.0]])
    assert _ulps(num.log(x), np.log(x)) <= 4.0


def test_log_specials():
    """log of 1 is exactly 0; of 0, negatives, infinity and NaN as in IEEE."""
    x = np.array([1.0, 0.0, -0.0, np.inf])
    np.testing.assert_array_equal(num.log(x), [0.0, -np.inf, -np.inf, np.inf])
    assert np.isnan(num.log(np.array([-1.0, -np.inf, np.nan]))).all()


def test_tanh_is_accurate_and_saturates():
    """tanh within 4e-16 (absolute), exactly +-1 at its ends."""
    x = np.concatenate([np.linspace(-25, 25, 40001), RNG.normal(size=10000) * 1e-3])
    assert np.max(np.abs(num.tanh(x) - np.tanh(x))) <= 4e-16
    np.testing.assert_array_equal(num.tanh(np.array([0.0, 30.0, -30.0, np.inf, -np.inf])), [0.0, 1.0, -1.0, 1.0, -1.0])
    assert math.isnan(num.tanh(np.nan))


def test_sine_and_cosine_of_turns():
    """Sine and cosine of 2 pi u within 1e-15, and exact at the quarters."""
    u = np.concatenate([np.linspace(0.0, 1.0, 5000, endpoint=False), RNG.uniform(size=5000)])
    pairs = np.stack(elementary.sincos_turn(u), axis=1)
    angle = 2.0 * np.pi * u
    assert np.max(np.abs(pairs - np.stack([np.sin(angle), np.cos(angle)], axis=1))) <= 1.2e-15
    assert np.array_equal(elementary.sincos_turn(np.array([0.0, 0.25, 0.5, 0.75])), [[0.0, 1.0, 0.0, -1.0], [1.0, 0.0, -1.0, 0.0]])


@pytest.mark.parametrize("size", [1, 20])
def test_no_floating_point_flags(size):
    """exp and tanh of anything and log of any positive number raise no warning, also in vectorised loops."""
    with np.errstate(all="raise"):
        for x in (0.0, 1.0, -1.0, 700.0, 1e5, -1e5, np.inf, -np.inf):
            num.exp(np.full(size, x))
            num.tanh(np.full(size, x))
        for x in (5e-324, 1e-310, 1.0, 1e300, 1.7976931348623157e308, np.inf):
            num.log(np.full(size, x))


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_compiled_functions_equal_their_source(x):
    """Compilation changes no bit of exp, log and tanh."""
    for function in (num.exp, num.log, num.tanh):
        assert np.array_equal(function(np.full(num.WORTH, x)), np.full(num.WORTH, function(x)), equal_nan=True)


def _spd(q, rows=ROWS):
    root = RNG.normal(size=(rows, q, q + 2))
    return root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(q)


@pytest.mark.parametrize("q", [1, 2, 3, 5])
def test_linear_algebra_agrees_with_numpy(q):
    """matmul, matvec, dot, quadratic and inverse against numpy.linalg."""
    s, t, v, w = _spd(q), RNG.normal(size=(ROWS, q, q)), RNG.normal(size=(ROWS, q)), RNG.normal(size=(ROWS, q))
    np.testing.assert_allclose(num.matmul(s, t), s @ t, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(num.matvec(t, v), (t @ v[..., None])[..., 0], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(num.dot(v, w), np.sum(v * w, axis=-1), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(num.quadratic(v, s), np.einsum("bi,bij,bj->b", v, s, v), rtol=1e-12, atol=1e-12)
    want = np.linalg.inv(s)
    np.testing.assert_allclose(num.inverse(s), want, rtol=1e-8, atol=1e-10 * np.max(np.abs(want)))
    np.testing.assert_allclose(num.inverse(s) @ s, np.broadcast_to(np.eye(q), s.shape), atol=1e-9)


def test_products_broadcast_and_are_not_square_only():
    """(1, i, k) times (B, 1, k, j): leading axes broadcast."""
    a, b = RNG.normal(size=(2, 3)), RNG.normal(size=(6, 1, 3, 4))
    np.testing.assert_allclose(num.matmul(a, b), a @ b, rtol=1e-13)
    np.testing.assert_allclose(num.matvec(a, b[..., 0]), (a @ b[..., 0][..., None])[..., 0], rtol=1e-13)
    np.testing.assert_allclose(num.matmul(a, b[0, 0]), a @ b[0, 0], rtol=1e-13)


FUNCTIONS = {
    "exp": lambda s, t, v: num.exp(v),
    "log": lambda s, t, v: num.log(np.abs(v)),
    "tanh": lambda s, t, v: num.tanh(v),
    "matmul": lambda s, t, v: num.matmul(t, s),
    "matmul, constant left": lambda s, t, v: num.matmul(CONSTANT[: s.shape[-1], : s.shape[-1]], s),
    "matvec": lambda s, t, v: num.matvec(t, v),
    "matvec, constant left": lambda s, t, v: num.matvec(CONSTANT[: s.shape[-1], : s.shape[-1]], v),
    "dot": lambda s, t, v: num.dot(v, t[..., 0]),
    "quadratic": lambda s, t, v: num.quadratic(v, s),
    "inverse": lambda s, t, v: num.inverse(s),
    "dense": lambda s, t, v: num.dense(v, WEIGHT[: v.shape[-1]], BIAS, True),
}
CONSTANT, WEIGHT, BIAS = RNG.normal(size=(5, 5)), RNG.normal(size=(5, 33)), RNG.normal(size=33)


@pytest.mark.parametrize("q", [1, 2, 3, 5])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_row_has_the_same_bits_in_every_batch_and_layout(name, q, same_bits):
    """Rows of batches of 1, 3, 64 and 4096, contiguous or strided, B first or last in memory."""
    data = _spd(q), RNG.normal(size=(ROWS, q, q)), RNG.normal(size=(ROWS, q))
    whole = FUNCTIONS[name](*data)
    for part in PARTS:
        for layout in (lambda x: x, np.ascontiguousarray, np.asfortranarray, num.batch_last):
            got = FUNCTIONS[name](*(layout(x[part]) for x in data))
            assert same_bits(got, whole[part]), (part, layout)


@pytest.mark.parametrize("squash", [True, False])
def test_dense_is_a_plain_loop(squash):
    """A layer is bias + sum over inputs in ascending order, then tanh: bit for bit."""
    x, w, b = RNG.normal(size=(5, 7)), RNG.normal(size=(7, 4)), RNG.normal(size=4)
    want = np.empty((5, 4))
    for r in range(5):
        for o in range(4):
            total = float(b[o])
            for i in range(7):
                total = total + float(x[r, i]) * float(w[i, o])
            want[r, o] = num.tanh(total) if squash else total
    got = num.dense(x, w, b, squash)
    np.testing.assert_array_equal(got, want)
    np.testing.assert_array_equal(num.dense(np.asfortranarray(x), w, b, squash), want)


def test_builders_keep_the_batch_contiguous():
    """zeros, full, stack and batch_last: B first by index, contiguous in memory."""
    column = np.arange(6.0).reshape(6, 1)
    made = [num.zeros((6, 2, 3)), num.full((6, 2, 3), np.arange(3.0)), num.stack([column, -column])]
    made.append(num.batch_last(np.ones((6, 2, 3))))
    assert [a.shape for a in made] == [(6, 2, 3), (6, 2, 3), (6, 1, 2), (6, 2, 3)]
    assert all(a.strides[0] == a.itemsize for a in made)
    np.testing.assert_array_equal(made[1][4, 1], [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(made[2][3, 0], [3.0, -3.0])
