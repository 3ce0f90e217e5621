"""The vehicle that every plant drives: a first-order lag between command and acceleration, and a standstill from which nothing rolls back.

    x' = v          v' = a          tau a' + a = u                                                     (4.15), (6.4)

discretised exactly (zero-order hold of u) with E = exp(-dt/tau) and s1 = tau (1 - E):

    x+ = x + v dt + tau (dt - s1) a + (dt^2/2 - tau (dt - s1)) u
    v+ = v + s1 a + (dt - s1) u
    a+ = E a + (1 - E) u
"""

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array

SIGMAS = 6.0  # initial gaps leave room for that many standard deviations: one car in 10^9 begins in a collision
REACTION = 10_000  # most steps of the reaction of a driver behind


def check_reaction(field: str, reaction: float, dt: float) -> None:
    """Raise InputError for a reaction time [s] of more steps dt [s] than are remembered."""
    if reaction > REACTION * dt:
        raise InputError(field, reaction, f"at most {REACTION} steps ({REACTION * dt:g} s)")


def lag(dt: float, tau: float) -> tuple[Array, Array]:
    """Return A (3, 3) and B (3, 1) of one vehicle's [x m, v m/s, a m/s^2] for a step dt [s] and a lag tau [s]."""
    E = float(num.exp(-dt / tau))
    s1 = tau * (1.0 - E)
    A = np.array([[1.0, dt, tau * (dt - s1)], [0.0, 1.0, s1], [0.0, 0.0, E]])
    return A, np.array([[dt * dt / 2.0 - tau * (dt - s1)], [dt - s1], [1.0 - E]])


def drive(A: Array, B: Array, x: Array, v: Array, a: Array, u: Array, noise: Array) -> tuple[Array, Array, Array]:
    """Return x, v, a one step later, under u [m/s^2] and noise (3, ...), elementwise."""
    x_next = x + A[0][1] * v + A[0][2] * a + B[0][0] * u + noise[0]
    v_next = v + A[1][2] * a + B[1][0] * u + noise[1]
    a_next = A[2][2] * a + B[2][0] * u + noise[2]
    halted = v_next <= 0.0  # a stopped car neither rolls back nor decelerates
    v_next = np.maximum(v_next, 0.0)
    a_next = np.where(halted, np.maximum(a_next, 0.0), a_next)
    x_next = np.where(halted, np.maximum(x_next, x), x_next)
    return x_next, v_next, a_next


def roll(x: Array, v: Array, a: Array, dt: float) -> tuple[Array, Array]:
    """Return x and v one step later of a vehicle without lag, under its acceleration a [m/s^2], elementwise; it never reverses."""
    v_next = np.maximum(0.0, v + a * dt)
    return x + 0.5 * dt * (v + v_next), v_next
