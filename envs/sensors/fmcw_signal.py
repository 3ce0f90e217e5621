"""The FMCW radar at the level of its signal: a chirp, its delayed echo, complex IF samples, and root-MUSIC on them.

Nothing here knows the beat frequencies in closed form. A sweep is transmit x conj(delayed echo), sample by sample, with the receiver's
noise, and the readings come out of the samples. The closed-form path of the sensor is held to this one by a test.

Root-MUSIC of one tone in M samples (Barabell 1983; Stoica and Moses, *Spectral Analysis of Signals*, 2005, section 4.5). With windows
w_k = (x_k, ..., x_{k+m-1})', a(z) = (1, z, ..., z^{m-1})' and J the exchange matrix,

    R = sum_k w_k w_k* + J (sum_k w_k w_k*)^c J        forward-backward average
    D(z) = a(1/z)' (I - s s*) a(z)                     s the first eigenvector of R, I - s s* the noise subspace

and the frequency is the angle of the root of D next to the unit circle. R is centro-Hermitian, so that a unitary matrix turns it into a
real one (Pesavento, Gershman and Haardt 2000): s is found there by power iteration. Cauchy's method finds the root, from the deepest point
of D on the circle. It solves a quadratic in each step and so meets the pair of roots z, 1/z^c of a strong tone.

Sums run in an order that the number of rows does not change, and sines are the engine's. So a row's result depends neither on its
companions nor on the machine's mathematical library.
"""

import math
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tailgate import num
from tailgate.core import Array
from tailgate.engine.compiled import shaped
from tailgate.engine.elementary import sincos_turn
from tailgate.envs.sensors.fmcw import LIGHT, Link

_SPLIT = 4  # a window of root-MUSIC is the fourth part of the samples: of 1/16 to 1/4 the one with the least variance and threshold
_ROWS = 16  # sweeps at once, so that a large batch takes no more memory than a small one
_STEPS, _ROOT_STEPS = 500, 50  # at most, of the power iteration and of Cauchy's method
_STILL = 1e-13  # a row whose step is shorter has arrived, and changes no more
_TURN = 2.0 * math.pi


def read(link: Link, d: Array, dv: Array, late: Array, snr: Array, noise: Array, normals: Array) -> tuple[Array, Array]:
    """Return distance [m] and relative speed [m/s] as the receiver estimates them from one up and one down sweep.

    d [m] and dv [m/s] of the target between the sweeps, the attacker's delay `late` as range [m], snr (echo over the receiver's noise) and
    noise (all noise over the receiver's): (B, N). normals (B, N, 2, M, 2): real and imaginary parts of the noise of the two sweeps.
    From the middle of one sweep to that of the other the target moves by dv Ts. (3.8) reads that as a speed of -dv Bs lam/(2 c), which
    the receiver takes out.
    """
    beats, low, sides = np.empty((*d.shape, 2)), link.lowest / link.bandwidth, np.array([1.0, -1.0])
    for part in _parts(beats.size):
        *row, sweep = np.unravel_index(part, beats.shape)
        at, side = tuple(row), sides[sweep]
        echo = _chirp(link, d[at] - 0.5 * side * link.sweep_time * dv[at], dv[at], late[at], side)
        x = np.sqrt(snr[at])[:, None, None] * echo + np.sqrt(0.5 * noise[at])[:, None, None] * np.swapaxes(normals[(*at, sweep)], 1, 2)
        f = _frequency(x)
        beats[(*at, sweep)] = link.bandwidth * (f - np.floor(f - low))  # within the receiver's band
    distance, speed = link.range_speed(beats[..., 0], beats[..., 1])
    return distance, speed / (1.0 - link.sweep * link.wavelength / (2.0 * LIGHT))


def samples(link: Link, d: float, dv: float, late: float = 0.0, side: float = 1.0) -> Array:
    """Return complex IF samples (M,) of one sweep without noise, of amplitude 1.

    Up is side 1; down is -1, conjugated, so that its beat is fb-. d [m] is the distance in the middle of the sweep, dv [m/s] its rate,
    `late` [m] the attacker's extra time of flight as range.
    """
    re, im = _chirp(link, *(np.array([v]) for v in (d, dv, late, side)))[0]
    return _complex(re, im)


def root_music(x: Array) -> Array:
    """Return the frequency (...) of the tone in x (..., M) complex, in cycles per sample, in [-1/2, 1/2)."""
    rows = x.reshape(-1, x.shape[-1])
    out = np.empty(len(rows))
    for part in _parts(len(rows)):
        out[part] = _frequency(np.stack([rows[part].real, rows[part].imag], axis=1))
    return out.reshape(x.shape[:-1])


def _parts(rows: int) -> Iterator[Array]:
    """Yield the indices of all rows, a few at a time."""
    return (np.arange(first, min(first + _ROWS, rows)) for first in range(0, rows, _ROWS))


def _chirp(link: Link, d: Array, dv: Array, late: Array, side: Array) -> Array:
    """Return real and imaginary part (R, 2, M) of transmit x conj(delayed echo), in turns; the sweep's middle is t = 0."""
    d, dv, late, side = (v[:, None] for v in (d, dv, late, side))
    sent = (np.arange(link.samples) + 0.5 - 0.5 * link.samples) / link.bandwidth
    t = np.stack([np.broadcast_to(sent, (len(d), link.samples)), sent - 2.0 * (d + dv * sent + late) / LIGHT])
    phase = LIGHT / link.wavelength * t + 0.5 * side * link.slope * t * t
    (b, s), (a, c) = sincos_turn(phase - np.floor(phase))
    return np.stack([a * c + b * s, side * (b * c - a * s)], axis=1)


@np.errstate(all="ignore")
def _frequency(x: Array) -> Array:
    """Return root-MUSIC's frequency (R,) of the tone in x (R, 2, M), in cycles per sample.

    Large tables are made row by row, for the cache.
    """
    m = 2 * (x.shape[-1] // (2 * _SPLIT))  # an even number
    u = _first_eigenvector(np.stack([_covariance(row, m) for row in x]))
    start = np.array([_deepest(row) for row in u])
    half, sign = u.reshape(len(u), 2, m // 2), np.array([[1.0], [-1.0]])
    s = np.concatenate([half, sign * half[..., ::-1]], axis=-1)  # conjugate symmetric
    return _root(np.stack([_in_order(_lagged(row, m)) for row in s]), start)


def _lagged(x: Array, m: int) -> Array:
    """Return (2, M, m): x_k conj(x_{k+l}) of x (2, M) and lags l < m, with zeros behind the last sample."""
    re, im = x[..., None]
    later_re, later_im = sliding_window_view(np.concatenate([x, np.zeros((2, m - 1))], axis=1), m, axis=1)
    out_re, out_im, other = out = np.empty((3, *later_re.shape))  # one piece of memory: several would be handed back and fetched again
    np.multiply(re, later_re, out=out_re)
    np.multiply(im, later_re, out=out_im)
    out_re += np.multiply(im, later_im, out=other)
    out_im -= np.multiply(re, later_im, out=other)
    return out[:2]


def _in_order(x: Array) -> Array:
    """Return (..., k, n) summed over k in ascending order: over an axis that is not the last, numpy adds one row after the other."""
    return np.asarray(np.add.reduce(x, axis=-2, initial=-0.0))


def _covariance(x: Array, m: int) -> Array:
    """Return the real (m, m) matrix to which the forward-backward covariance of the windows of x (2, M) is unitarily similar."""
    span, half = x.shape[-1] - m + 1, m // 2
    products = _lagged(x, m)
    sums = np.empty((m, 2, m))  # by i and l: x_{k+i} conj(x_{k+i+l}) over the windows k; from i to i + 1 one product comes and one goes
    sums[0] = _in_order(products[:, :span])
    sums[1:] = np.swapaxes(products[:, span:] - products[:, : m - 1], 0, 1)
    for before, now in pairwise(sums):
        now += before
    here, opposite, sign = _places(m)
    flat = np.swapaxes(sums, 0, 1).reshape(2, m * m)
    re, im = flat.take(here, axis=1) + flat.take(opposite, axis=1)  # R's upper half, but for the sign
    im *= sign
    a, b, c, d = re[:, :half], im[:, :half], re[:, : half - 1 : -1], im[:, : half - 1 : -1]
    return np.block([[a + c, d - b], [(d - b).T, a - c]])


@lru_cache(maxsize=4)
def _places(m: int) -> tuple[Array, Array, Array]:
    """Return the places of R's i, j and m-1-i, m-1-j in the sums (m, m) by i and l, for i < m/2.

    Below the diagonal the imaginary part has the sign that is returned with them.
    """
    i, j = np.indices((m // 2, m))
    lag = np.abs(i - j)
    return np.minimum(i, j) * m + lag, (m - 1 - np.maximum(i, j)) * m + lag, np.where(i > j, -1.0, 1.0)


def _first_eigenvector(c: Array) -> Array:
    """Return the first eigenvector (R, m) of real symmetric, positive semidefinite (R, m, m)."""
    diagonal = np.diagonal(c, axis1=1, axis2=2)
    level = np.cumsum(diagonal / c.shape[1], axis=1)[:, -1:]  # the mean of the eigenvalues
    return np.asarray(_powers(c, level, c[np.arange(len(c)), np.argmax(diagonal, axis=1)]))


@shaped(lambda c, level, u: len(c) > 1)  # the engine makes machine code of it
def _powers(c: Array, level: Array, u: Array) -> Any:
    """Iterate the power method from u (R, m), as far as 500 steps lead where two eigenvalues nearly tie.

    `level` (R, 1) is taken off the eigenvalues: most are then small.
    """

    def step(u: Array) -> tuple[Array, list[Array]]:
        w = (num.matvec(c, u) if num.tracing() else _in_order(u[..., None] * c)) - level * u
        length = np.sqrt(np.cumsum(w * w, axis=1)[:, -1:])
        new = np.where(length > 0.0, w / length, u)
        return ~(np.max(np.abs(new - u), axis=1) < _STILL), [new]

    return num.until(step, [u], np.ones(len(c), bool), _STEPS)[0]


def _deepest(u: Array) -> float:
    """Return the turns at which D is least, of 8 m points of the circle: s* a(z) is largest there."""
    circle = _circle(len(u))
    place = int(np.argmax(np.square(_in_order(u[:, None] * circle))))
    return place / int(circle.shape[1])


@lru_cache(maxsize=4)
def _circle(m: int) -> Array:
    """Return (m, 8 m): its rows times u, added up, are s* a(z) at 8 m points but for a phase.

    They are real, for s is conjugate symmetric.
    """
    grid = 8 * m
    halves = (2 * np.arange(m // 2) - (m - 1))[:, None] * np.arange(grid) % (2 * grid)
    sine, cosine = sincos_turn(halves / (2 * grid))
    return np.concatenate([cosine, sine])


def _root(lags: Array, start: Array) -> Array:
    """Return the turns (R,) of the root of D, by Cauchy's method from `start` (R,); r_l = sum_k s_k conj(s_{k+l}) are `lags` (R, 2, m).

    g(nu) = D(z) = (m - 1) r_0 - sum_l (r_l z^l + (r_l)^c z^-l) with z = exp(2 pi i nu), and g1 and g2 are its derivatives.
    """
    m = lags.shape[-1]
    l, re, im = np.arange(1.0, m), lags[:, 0, 1:], lags[:, 1, 1:]

    def step(nu: Array) -> tuple[Array, list[Array]]:
        turns = nu.real[:, None] * l
        sine, cosine = sincos_turn(turns - np.floor(turns))
        out = num.exp(-_TURN * nu.imag[:, None] * l)
        plus, minus = out + 1.0 / out, out - 1.0 / out
        x, y = re * cosine - im * sine, re * sine + im * cosine
        even, odd = _complex(plus * x, minus * y), _complex(minus * x, plus * y)  # r_l z^l plus and minus (r_l)^c z^-l
        sums = np.cumsum(np.stack([even, l * odd, l * l * even]), axis=-1)[..., -1]
        g, g1, g2 = (m - 1) * lags[:, 0, 0] - sums[0], -1j * _TURN * sums[1], _TURN * _TURN * sums[2]
        root = _sqrt(_times(g1, g1) - 2.0 * _times(g, g2))
        below = np.where(_square(g1 + root) > _square(g1 - root), g1 + root, g1 - root)
        size = _square(below)
        shift = -2.0 * _times(g, below.conj()) / np.where(size > 0.0, size, 1.0)
        return ~(_square(shift) < _STILL * _STILL), [nu + shift]

    nu = num.until(step, [start + 0j], np.ones(len(start), bool), _ROOT_STEPS)[0].real
    return np.asarray(nu - np.floor(nu + 0.5))


def _complex(re: Array, im: Array) -> Array:
    """Return re + i im."""
    out = np.empty(re.shape, np.complex128)
    out.real, out.imag = re, im
    return out


def _times(x: Array, y: Array) -> Array:
    """Return x y, without the fused products that numpy's own has on some processors."""
    return _complex(x.real * y.real - x.imag * y.imag, x.real * y.imag + x.imag * y.real)


def _square(x: Array) -> Array:
    """Return |x|^2."""
    return np.asarray(x.real * x.real + x.imag * x.imag)


def _sqrt(x: Array) -> Array:
    """Return the root of x with a real part that is not negative."""
    part = np.sqrt(0.5 * (np.abs(x.real) + np.sqrt(_square(x))))
    other = 0.5 * np.abs(x.imag) / np.where(part > 0.0, part, 1.0)
    right = x.real >= 0.0
    return _complex(np.where(right, part, other), np.copysign(np.where(right, other, part), x.imag))
