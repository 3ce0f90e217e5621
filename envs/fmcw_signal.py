"""The FMCW radar at the level of its signal: a chirp, its delayed echo, complex IF samples, and root-MUSIC on them.

Nothing here knows the beat frequencies in closed form: a sweep is transmit x conj(delayed echo), sample by sample, with the receiver's
noise, and what is read comes out of the samples. The closed-form path of the sensor is held to this one by a test.

Root-MUSIC of one tone in M samples (Barabell 1983; Stoica and Moses, *Spectral Analysis of Signals*, 2005, section 4.5). With windows
w_k = (x_k, ..., x_{k+m-1})', a(z) = (1, z, ..., z^{m-1})' and J the exchange matrix,

    R = sum_k w_k w_k* + J (sum_k w_k w_k*)^c J        forward-backward average
    D(z) = a(1/z)' (I - s s*) a(z)                     s the first eigenvector of R, I - s s* the noise subspace

and the frequency is the angle of the root of D next to the unit circle. R is centro-Hermitian, so that a unitary matrix turns it into a
real one (Pesavento, Gershman and Haardt 2000): s is found there by power iteration. The root is found from the deepest point of D on the
circle by Cauchy's method, which solves a quadratic in each step and so meets the pair of roots z, 1/z^c of a strong tone.

Compiled, one row after the other in fixed order: a row's result does not depend on its companions. Sines are the mathematical library's,
so that other machines may differ in the last bits.
"""

import math

import numpy as np

from tailgate.core import Array
from tailgate.jit import jit

from .fmcw import LIGHT, Link

_SPLIT = 4  # a window of root-MUSIC is the fourth part of the samples: of 1/16 to 1/4 the one with the least variance and threshold
_TURN = 2.0 * math.pi
_jit = jit(cache=True)


def read(link: Link, d: Array, dv: Array, late: Array, snr: Array, noise: Array, normals: Array) -> tuple[Array, Array]:
    """Distance [m] and relative speed [m/s] as the receiver estimates them from one up and one down sweep.

    d [m] and dv [m/s] of the target between the sweeps, the attacker's delay `late` as range [m], snr (echo over the receiver's noise) and
    noise (all noise over the receiver's): (B, N). normals (B, N, 2, M, 2): real and imaginary parts of the noise of the two sweeps.
    From the middle of one sweep to that of the other the target moves by dv Ts, which (3.8) reads as a speed of -dv Bs lam/(2 c): the
    receiver takes that out.
    """
    half = 0.5 * link.sweep_time
    up = _beats(link, d - half * dv, dv, late, snr, noise, normals[:, :, 0], 1.0)
    down = _beats(link, d + half * dv, dv, late, snr, noise, normals[:, :, 1], -1.0)
    distance, speed = link.range_speed(up, down)
    return distance, speed / (1.0 - link.sweep * link.wavelength / (2.0 * LIGHT))


def samples(link: Link, d: float, dv: float, late: float = 0.0, side: float = 1.0) -> Array:
    """(M,) complex IF samples of one sweep without noise, of amplitude 1: up (side 1) or down (-1, conjugated, so that its beat is fb-).

    d [m] is the distance in the middle of the sweep, dv [m/s] its rate, `late` [m] the attacker's extra time of flight as range.
    """
    out = np.empty((link.samples, 2))
    _chirp(d, dv, late, side, LIGHT / link.wavelength, link.slope, link.bandwidth, out)
    return np.asarray(out[:, 0] + 1j * out[:, 1])


def root_music(x: Array) -> Array:
    """(...) frequency of the tone in x (..., M) complex, in cycles per sample, in [-1/2, 1/2)."""
    pairs = np.stack([x.real, x.imag], axis=-1).reshape(-1, x.shape[-1], 2)
    return np.asarray(np.array([_frequency(row, _window(x.shape[-1])) for row in pairs]).reshape(x.shape[:-1]))


def _window(count: int) -> int:
    """An even number of samples."""
    return 2 * (count // (2 * _SPLIT))


def _beats(link: Link, d: Array, dv: Array, late: Array, snr: Array, noise: Array, normals: Array, side: float) -> Array:
    """(B, N) [Hz] one sweep's beats, within the receiver's band."""
    out, x = np.empty(d.shape), np.empty((link.samples, 2))
    low = link.lowest / link.bandwidth
    for row in np.ndindex(d.shape):
        _chirp(d[row], dv[row], late[row], side, LIGHT / link.wavelength, link.slope, link.bandwidth, x)
        x *= math.sqrt(snr[row])
        x += math.sqrt(0.5 * noise[row]) * normals[row]
        f = _frequency(x, _window(link.samples))
        out[row] = link.bandwidth * (f - math.floor(f - low))
    return out


@_jit
def _chirp(d: float, dv: float, late: float, side: float, carrier: float, slope: float, rate: float, out: Array) -> None:
    """Transmit x conj(delayed echo) into out (M, 2); the sweep's middle is t = 0 and the phase is counted in turns."""
    count = out.shape[0]
    for n in range(count):
        t = (n + 0.5 - 0.5 * count) / rate
        back = t - 2.0 * (d + dv * t + late) / LIGHT
        sent = carrier * t + 0.5 * side * slope * t * t
        echo = carrier * back + 0.5 * side * slope * back * back
        sent, echo = _TURN * (sent - math.floor(sent)), _TURN * (echo - math.floor(echo))
        a, b, c, s = math.cos(sent), math.sin(sent), math.cos(echo), math.sin(echo)
        out[n, 0] = a * c + b * s
        out[n, 1] = side * (b * c - a * s)


@_jit
def _covariance(x: Array, m: int) -> Array:
    """The real (m, m) matrix that the forward-backward covariance of the windows of x (M, 2) is unitarily similar to."""
    span, half = x.shape[0] - m + 1, m // 2
    re, im = np.empty((m, m)), np.empty((m, m))
    for j in range(m):  # sum over the windows of x_i conj(x_j): the first row, then along the diagonals
        a = b = 0.0
        for k in range(span):
            a += x[k, 0] * x[k + j, 0] + x[k, 1] * x[k + j, 1]
            b += x[k, 1] * x[k + j, 0] - x[k, 0] * x[k + j, 1]
        re[0, j], im[0, j], re[j, 0], im[j, 0] = a, b, a, -b
    for i in range(m - 1):
        for j in range(i, m - 1):
            p, q, r, s = x[i], x[j], x[span + i], x[span + j]
            a = re[i, j] + (r[0] * s[0] + r[1] * s[1]) - (p[0] * q[0] + p[1] * q[1])
            b = im[i, j] + (r[1] * s[0] - r[0] * s[1]) - (p[1] * q[0] - p[0] * q[1])
            re[i + 1, j + 1], im[i + 1, j + 1], re[j + 1, i + 1], im[j + 1, i + 1] = a, b, a, -b
    out = np.empty((m, m))
    for i in range(half):
        for j in range(half):
            a, b = re[i, j] + re[m - 1 - i, m - 1 - j], im[i, j] - im[m - 1 - i, m - 1 - j]
            c, d = re[i, m - 1 - j] + re[m - 1 - i, j], im[i, m - 1 - j] - im[m - 1 - i, j]
            out[i, j], out[half + i, half + j] = a + c, a - c
            out[i, half + j] = out[half + j, i] = d - b
    return out


@_jit
def _first_eigenvector(c: Array) -> Array:
    """Of a real symmetric, positive semidefinite (m, m); as far as 500 steps lead, where two eigenvalues nearly tie."""
    m, best, level = c.shape[0], 0, 0.0
    for i in range(m):
        level += c[i, i] / m
        best = i if c[i, i] > c[best, best] else best
    u, w = np.empty(m), np.empty(m)
    u[:] = c[best]
    for _ in range(500):
        for i in range(m):
            w[i] = -level * u[i]  # the mean of the eigenvalues taken off: the others' are then small
        for j in range(m):
            v = u[j]
            for i in range(m):
                w[i] += c[j, i] * v
        length = change = 0.0
        for i in range(m):
            length += w[i] * w[i]
        length = math.sqrt(length)
        if length == 0.0:
            break
        for i in range(m):
            v = w[i] / length
            change, u[i] = max(change, abs(v - u[i])), v
        if change < 1e-13:
            break
    return u


@_jit
def _frequency(x: Array, m: int) -> float:
    """Root-MUSIC's frequency of the tone in x (M, 2), in cycles per sample, with windows of m samples."""
    u, half, grid = _first_eigenvector(_covariance(x, m)), m // 2, 8 * m
    cosine, sine = np.empty(2 * grid), np.empty(2 * grid)
    for k in range(2 * grid):
        cosine[k], sine[k] = math.cos(math.pi * k / grid), math.sin(math.pi * k / grid)
    peak, place = -1.0, 0
    for k in range(grid):  # s* a(z) on the circle: real up to a phase, for s is conjugate symmetric
        v = 0.0
        for i in range(half):
            turn = ((2 * i - (m - 1)) * k) % (2 * grid)
            v += u[i] * cosine[turn] + u[half + i] * sine[turn]
        if v * v > peak:
            peak, place = v * v, k
    s = np.empty(m, np.complex128)
    for i in range(half):
        s[i], s[m - 1 - i] = complex(u[i], u[half + i]), complex(u[i], -u[half + i])
    lags = np.zeros(m, np.complex128)
    for lag in range(m):
        for j in range(m - lag):
            lags[lag] += s[j + lag].conjugate() * s[j]
    size = m * lags[0].real
    nu = complex(place / grid, 0.0)  # z = exp(2 pi i nu)
    for _ in range(50):
        big = math.exp(-_TURN * nu.imag)
        z = complex(big * math.cos(_TURN * nu.real), big * math.sin(_TURN * nu.real))
        back, left, right = 1.0 / z, complex(1.0, 0.0), complex(1.0, 0.0)
        g, g1, g2 = complex(size, 0.0) - lags[0], complex(0.0, 0.0), complex(0.0, 0.0)
        for lag in range(1, m):
            right, left = right * z, left * back
            a, b = lags[lag] * right, lags[lag].conjugate() * left
            g, g1, g2 = g - (a + b), g1 - lag * (a - b), g2 + (lag * lag) * (a + b)
        g1, g2 = g1 * complex(0.0, _TURN), g2 * (_TURN * _TURN)
        root = np.sqrt(g1 * g1 - 2.0 * g * g2)
        below = g1 + root if abs(g1 + root) > abs(g1 - root) else g1 - root
        if abs(below) == 0.0:
            break
        step = -2.0 * g / below
        nu = nu + step
        if abs(step) < 1e-13:
            break
    return nu.real - math.floor(nu.real + 0.5)
