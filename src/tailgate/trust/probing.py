"""The linear form of a controller, read off by probing it, and the limits at which it is cut."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tailgate.base.errors import NotApplicable
from tailgate.core import Array, Controller, Estimate, Model

FAR = 1e9  # beyond every limit of a controller
LINEAR = 1e-6  # by how much a controller may differ from its linear form, as a share of its range
POINTS = 512  # at which it is compared with it


class Law(NamedTuple):
    """The controller: u = F x^ + H h + u0 (m, .), cut at low and high; infinite where it has no limit."""

    F: Array  # (m, n)
    H: Array  # (m, p)
    u0: Array  # (m,)
    low: Array  # (m,)
    high: Array  # (m,)


def probed(controller: Controller, model: Model) -> Law:
    """Return the linear form of a controller, by probing it.

    Raises
    ------
    NotApplicable
        If it remembers something, or is not linear between its limits.
    """
    n, p = model.states, len(model.v2v)
    plan = controller.prepare(model)
    if (memory := controller.start(plan, 1)) is not None:
        raise NotApplicable("--prove: controller", type(controller).__name__, "one without memory")
    if (second := getattr(controller, "set_speed", None)) is not None:
        raise NotApplicable("--prove: controller.set_speed", second, "none: the smaller of two laws is not linear")

    def told(x: Array, heard: Array) -> Array:
        rows = len(x)
        flat = np.zeros((rows, 1))
        estimate = Estimate(x[:, None], flat, flat > 0.0, flat.astype(np.int8), flat == 0.0)
        return np.asarray(controller.step(plan, memory, estimate, heard[:, None], np.zeros((rows, 1, 0)))[1][:, 0])

    size, eye = n + p, np.eye(n + p)
    zero = np.zeros((1, size))
    ends = told(np.concatenate([sign * FAR * eye for sign in (1.0, -1.0)])[:, :n], np.concatenate([FAR * eye, -FAR * eye])[:, n:])
    low, high = ends.min(axis=0), ends.max(axis=0)
    low, high = np.where(low > -0.01 * FAR, low, -np.inf), np.where(high < 0.01 * FAR, high, np.inf)
    span = np.where(np.isfinite(high - low), high - low, 1.0)
    small = 1e-4 * float(np.min(span))
    base = _inside(told, zero, n, low, high, span)
    at = told(base[:, :n], base[:, n:])[0]
    moved = told((base + small * eye)[:, :n], (base + small * eye)[:, n:]) - at
    rows = moved.T / small
    reach = 2.0 * np.min(np.where(rows != 0.0, span[:, None] / np.where(rows != 0.0, np.abs(rows), 1.0), 1.0), axis=0)  # past the limits
    others = base + np.random.default_rng(0).uniform(-1.0, 1.0, (POINTS, size)) * reach
    linear = np.clip(at + (others - base) @ rows.T, low, high)
    if np.abs(told(others[:, :n], others[:, n:]) - linear).max() > LINEAR * float(np.max(span)):
        raise NotApplicable("--prove: controller", type(controller).__name__, "one that is linear between its limits")
    u0 = at - rows @ base[0]
    return Law(rows[:, :n], rows[:, n:], u0, low, high)


def _inside(told: Callable[[Array, Array], Array], zero: Array, n: int, low: Array, high: Array, span: Array) -> Array:
    """Return a point (1, n + p) at which the command lies well between its limits."""
    rng = np.linspace(-1.0, 1.0, 41)
    for size in (0.0, 1.0, 10.0, 100.0, 1000.0):
        for i in range(zero.shape[1]):
            tried = np.repeat(zero, len(rng), axis=0)
            tried[:, i] = size * rng
            u = told(tried[:, :n], tried[:, n:])
            room = np.min(np.minimum(u - low, high - u), axis=1)
            best = int(np.argmax(room))
            if room[best] > 0.05 * float(np.min(span)):
                return tried[best : best + 1]
    raise NotApplicable("--prove: controller", "no point between its limits", "a controller that is linear somewhere")
