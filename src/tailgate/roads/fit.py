"""Fit of the production-like ACC to recorded cars, shown on windows that the fit did not see.

Each car is fitted behind the measured car ahead of it. It is then shown alone behind that car, and in a string where only the leader is
measured. In the string, errors of one car reach the next. The gap at standstill is measured, where the cars wait before the start.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.plots import canvas, drawn
from tailgate.core import Array
from tailgate.core.traces import trace
from tailgate.envs.controllers.production import Gains, ProductionCruise, commanded
from tailgate.envs.vehicle import drive, lag

SPEED, GAP = 0.3, 2.0  # errors that weigh alike [m/s], [m]: the targets on unseen windows
PARAMETERS = ("headway", "gap_gain", "speed_gain", "tau")
BOUNDS = ((0.3, 0.005, 0.01, 0.2), (2.2, 1.0, 2.0, 0.4))  # tau: what actuators of production cars take [s]
BEGINS = ((1.1, 0.1, 0.35, 0.3), (0.8, 0.3, 0.8, 0.35), (1.0, 0.2, 0.15, 0.35), (0.9, 0.05, 0.6, 0.25))  # the cost has more than one low
NEAR = 1.01  # times the best cost: a law that costs less fits about as well
DELAYS = (0.0, 0.2, 0.4, 0.6, 0.8)  # candidates of the time from a reading to its effect [s], one for all cars
MOST = 40  # evaluations of a fit


class Windows(NamedTuple):
    """W windows of K samples of a string of F + 1 cars, dt [s] apart."""

    speed: Array  # (K, W, F + 1) [m/s]
    gap: Array  # (K, W, F) [m]
    dt: float


class Played(NamedTuple):
    """Simulated cars."""

    speed: Array  # (K, W, F) [m/s]
    gap: Array  # (K, W, F) [m]


@dataclass(frozen=True)
class Settings:
    """Recordings by name, with the seconds left out at their start; the length of a window, and candidates of the delay [s]."""

    traces: tuple[tuple[str, float], ...] = (("asta-string", 100.0), ("asta-braking", 0.0))
    window: float = 50.0
    delays: tuple[float, ...] = DELAYS


def windows_of(settings: Settings) -> tuple[Windows, Windows]:
    """Return the windows to fit and the unseen ones: every other one each."""
    cut: list[tuple[Array, Array]] = []
    rates = set()
    names = [name for name, _ in settings.traces]
    if again := [name for i, name in enumerate(names) if name in names[:i]]:
        raise InputError("fit.traces", again[0], "each recording once, else an unseen window could be a fitted one")
    for name, begin in settings.traces:
        columns = trace(name, "fit.traces")
        cars = sum(key.startswith("speed") for key in columns)
        if cars < 2 or "gap1" not in columns:
            raise InputError("fit.traces", name, "a recording of a string: speeds of all cars and the gaps between them")
        dt = round(float(np.median(np.diff(columns["t"]))), 6)
        rates.add(dt)
        speed = np.stack([columns[f"speed{i}"] for i in range(1, cars + 1)], axis=1)
        gap = np.stack([columns[f"gap{i}"] for i in range(1, cars)], axis=1)
        size, first = round(settings.window / dt), round(begin / dt)
        cut += [(speed[at : at + size], gap[at : at + size]) for at in range(first, len(speed) - size + 1, size)]
    if len(rates) > 1 or len({speed.shape for speed, _ in cut}) > 1:
        raise InputError("fit.traces", names, "recordings of as many cars and of one rate")
    if len(cut) < 2:
        raise InputError("fit.window", settings.window, "at most half of the recording: windows to fit and to show")
    (rate,) = rates
    return _stacked(cut[::2], rate), _stacked(cut[1::2], rate)


def _stacked(cut: Sequence[tuple[Array, Array]], dt: float) -> Windows:
    return Windows(np.stack([speed for speed, _ in cut], axis=1), np.stack([gap for _, gap in cut], axis=1), dt)


def standing_gaps(name: str, still: float = 0.1) -> Array:
    """Return the gaps (F,) [m] before the start of a recording that begins at rest, at all speeds below `still` [m/s]."""
    columns = trace(name, "fit.traces")
    speeds = np.stack([values for key, values in columns.items() if key.startswith("speed")])
    if not (speeds[:, 0] < still).all():
        raise InputError("fit.traces", name, "a recording that begins at rest")
    return np.array([columns[f"gap{i}"][0] for i in range(1, len(speeds))])


def play(held: Windows, parameters: Array, standstill: Array, delay: float, alone: bool) -> Played:
    """Simulate the cars behind the leader, from their measured gaps and speeds at the start.

    Parameters
    ----------
    parameters : (F, 4)
        Those of PARAMETERS for each car.
    standstill : (F,)
        Gaps at standstill [m].
    delay
        From a reading to its effect [s].
    alone
        Each car is behind the measured one; else only the leader is measured.
    """
    K, W, cars = held.speed.shape[0], held.speed.shape[1], held.gap.shape[2]
    law = ProductionCruise()
    headway, gap_gain, speed_gain, tau = parameters.T
    gains = Gains(headway, standstill, gap_gain, speed_gain, law.set_gain, law.set_speed)
    plans = [lag(held.dt, float(t)) for t in tau]
    A, B = (np.stack([plan[i] for plan in plans], axis=-1) for i in range(2))
    speed, gap, last = held.speed[0, :, 1:].copy(), held.gap[0].copy(), np.zeros((W, cars))
    accel = (held.speed[1, :, 1:] - held.speed[0, :, 1:]) / held.dt
    out = Played(np.empty((K, W, cars)), np.empty((K, W, cars)))
    quiet = np.zeros((3, W, cars))
    before, way = held.speed[0, :, :-1], [last] * round(delay / held.dt)
    for k in range(K):
        ahead = held.speed[k, :, :-1].copy()
        if not alone:
            ahead[:, 1:] = speed[:, :-1]
        out.speed[k], out.gap[k] = speed, gap
        last = commanded(gains, gap, speed - ahead, speed, (ahead - before) / held.dt, last, held.dt)
        before = ahead
        way.append(last)
        moved, faster, accel = drive(A, B, np.zeros((W, cars)), speed, accel, way.pop(0), quiet)
        if k + 1 < K:
            after = held.speed[k + 1, :, :-1].copy()
            if not alone:
                after[:, 1:] = faster[:, :-1]
            gap = gap + 0.5 * held.dt * (ahead + after) - moved
        speed = faster
    return out


def _residuals(held: Windows, standstill: Array, delay: float, car: int | None) -> Callable[[Array], Array]:
    """Return the weighed errors of one car, or of one law for all, as a function of its parameters (4,)."""
    cars = range(held.gap.shape[2]) if car is None else [car]
    part = Windows(held.speed, held.gap, held.dt)

    def errors(x: Array) -> Array:
        found = play(part, np.tile(x, (held.gap.shape[2], 1)), standstill, delay, alone=True)
        off = [(found.speed[..., i] - held.speed[..., i + 1]) / SPEED for i in cars]
        off += [(found.gap[..., i] - held.gap[..., i]) / GAP for i in cars]
        return np.concatenate([part.ravel() for part in off])

    return errors


class Fitted(NamedTuple):
    """Parameters of one car, or of one law for all."""

    x: Array  # (4,)
    cost: float
    near: Array  # (2, 4) the least and the greatest parameters of the fits, from all beginnings, that cost at most 1 % more


def fitted(
    held: Windows, standstill: Array, delay: float, car: int | None, begins: Sequence[tuple[float, ...]] = BEGINS[:1]
) -> Fitted:  # fmt: skip
    """Return the parameters of one car, or of one law for all cars, by least squares: the best of the fits from several beginnings."""
    from scipy.optimize import least_squares

    errors = _residuals(held, standstill, delay, car)
    every = [least_squares(errors, begin, bounds=BOUNDS, x_scale=BEGINS[0], diff_step=1e-3, max_nfev=MOST) for begin in begins]
    best = min(every, key=lambda found: float(found.cost))
    near = np.array([found.x for found in every if found.cost <= NEAR * best.cost])
    return Fitted(np.asarray(best.x), float(best.cost), np.stack([near.min(axis=0), near.max(axis=0)]))


def rms(x: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(x * x)))


def errors_of(held: Windows, found: Played) -> dict[str, list[float]]:
    """Return the RMS errors of speed [m/s] and gap [m] of each car."""
    cars = range(held.gap.shape[2])
    return {
        "speed": [rms(found.speed[..., i] - held.speed[..., i + 1]) for i in cars],
        "gap": [rms(found.gap[..., i] - held.gap[..., i]) for i in cars],
    }


def amplified(speed: Array) -> list[float]:
    """Return by how much each car's speed varies more than the leader's, from speeds (K, W, F + 1): the string gain."""
    spread = np.sqrt(np.mean((speed - speed.mean(axis=0)) ** 2, axis=(0, 1)))
    return [float(x / spread[0]) for x in spread[1:]]


def _checked(settings: Settings) -> None:
    if not settings.traces:
        raise InputError("fit.traces", [], "a recording")
    if not 5.0 <= settings.window <= 1000.0:
        raise InputError("fit.window", settings.window, "5 to 1000 s")
    for delay in settings.delays or (-1.0,):
        if not 0.0 <= delay <= 3.0:
            raise InputError("fit.delays", list(settings.delays), "delays of 0 to 3 s")


def fit(settings: Settings = Settings(), progress: Callable[[int, int], None] | None = None) -> dict[str, Any]:
    """Fit each car and one law for all, and return parameters and errors as JSON data, fit windows and unseen ones apart."""
    _checked(settings)
    seen, unseen = windows_of(settings)
    standstill = standing_gaps(settings.traces[0][0])
    cars = seen.gap.shape[2]
    tried: list[tuple[float, float]] = []  # cost, delay
    for done, delay in enumerate(settings.delays, 1):
        tried.append((sum(fitted(seen, standstill, delay, car).cost for car in range(cars)), delay))
        if progress is not None:
            progress(done, len(settings.delays) + 2)
    _, delay = min(tried)
    each = [fitted(seen, standstill, delay, car, BEGINS) for car in range(cars)]
    if progress is not None:
        progress(len(settings.delays) + 1, len(settings.delays) + 2)
    mean = np.full(cars, standstill.mean())
    one = [fitted(seen, mean, delay, None, BEGINS)] * cars
    if progress is not None:
        progress(len(settings.delays) + 2, len(settings.delays) + 2)
    found = ("each", each, standstill), ("one", one, mean)
    laws = {name: (np.stack([part.x for part in parts]), gaps, parts) for name, parts, gaps in found}
    return {
        "format": "tailgate-fit-1", "traces": [list(part) for part in settings.traces], "window": settings.window, "dt": seen.dt,
        "delay": delay,
        "delays": [{"delay": at, "cost": cost} for cost, at in tried],
        "windows": {"fit": seen.speed.shape[1], "unseen": unseen.speed.shape[1]}, "targets": {"speed": SPEED, "gap": GAP},
        "laws": {
            name: {
                "cars": [
                    {
                        "car": i + 2, "standstill": float(gaps[i]), **dict(zip(PARAMETERS, map(float, rows[i]), strict=True)),
                        "near": dict(zip(PARAMETERS, parts[i].near.T.tolist(), strict=True)),
                    }
                    for i in range(cars)
                ],
                "cost": sum(part.cost for part in (parts if name == "each" else parts[:1])),
                **{
                    where: {
                        "alone": errors_of(held, play(held, rows, gaps, delay, alone=True)),
                        "string": errors_of(held, play(held, rows, gaps, delay, alone=False)),
                        "gain": amplified(_with_leader(held, play(held, rows, gaps, delay, alone=False))),
                    }
                    for where, held in (("fit", seen), ("unseen", unseen))
                },
            }
            for name, (rows, gaps, parts) in laws.items()
        },
        "measured": {where: {"gain": amplified(held.speed)} for where, held in (("fit", seen), ("unseen", unseen))},
    }  # fmt: skip


def _with_leader(held: Windows, found: Played) -> Array:
    return np.concatenate([held.speed[..., :1], found.speed], axis=2)


def draw(held: dict[str, Any], law: str = "each", form: str = "png") -> bytes:
    """Return a picture of speeds and gaps on an unseen window, measured and simulated; held: what `fit` returned."""
    settings = Settings(tuple((name, begin) for name, begin in held["traces"]), held["window"])
    _, unseen = windows_of(settings)
    cars = held["laws"][law]["cars"]
    rows = np.array([[car[name] for name in PARAMETERS] for car in cars])
    gaps = np.array([car["standstill"] for car in cars])
    alone, string = (play(unseen, rows, gaps, held["delay"], alone) for alone in (True, False))
    window = int(np.argmin(unseen.speed[..., 0].min(axis=0)))  # the one in which the leader is slowest
    t = unseen.dt * np.arange(len(unseen.speed))
    figure, axes = canvas(11.0, 6.5, 2, len(cars), sharex=True, sharey="row")
    for i, car in enumerate(cars):
        for ax, measured, name in ((axes[0, i], unseen.speed[:, window, i + 1], "speed"), (axes[1, i], unseen.gap[:, window, i], "gap")):
            ax.plot(t, measured, color="black", linewidth=1.4, label="measured")
            ax.plot(t, getattr(alone, name)[:, window, i], color="C0", label="model behind the measured car")
            ax.plot(t, getattr(string, name)[:, window, i], color="C1", linestyle="--", label="model of the whole string")
            ax.grid(alpha=0.3)
        axes[0, i].set_title(f"car {car['car']}", fontsize=10)
        axes[1, i].set_xlabel("time [s]")
    axes[0, 0].set_ylabel("speed [m/s]")
    axes[1, 0].set_ylabel("gap [m]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    return drawn(figure, form)
