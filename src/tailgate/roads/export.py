"""An episode in the field's formats: CSV and Parquet (pandas, PlotJuggler), and SUMO's floating car data.

A row is one time, at which readings arrive. The last one is the road after the last step. `agent0/gap` is a column: a car, and its gap.
Cars are agent0, agent1, ...; where the manoeuvre's car is no agent, it is `leader`, and the driver behind `behind`. Where another car takes
that place, as in traffic, it is `leader1`, and so on. They have columns for the road alone.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.files import write_atomic
from tailgate.core import Array
from tailgate.core.kinds import Kind, Mode
from tailgate.play.trace import Trace
from tailgate.roads.fcd import fcd
from tailgate.studies.log import pyarrow

SUFFIXES = (".csv", ".xml", ".parquet")
JUMP = 2.0  # from one step to the next, beyond its own way: another car has taken the place [m]
LENGTH = 5.0  # of a car, which SUMO needs: positions of a plant are such that their differences are gaps [m]


class Cars(NamedTuple):
    """The road of one episode, (K + 1, V) each: the first car first, before each of its K steps and at its end."""

    names: tuple[str, ...]
    place: Array  # front bumper along the lane [m]; NaN where the car is not there
    speed: Array  # [m/s]
    accel: Array  # [m/s^2]
    gap: Array  # to the car ahead [m]; NaN where there is none


def check_path(path: Path) -> None:
    """Raise InputError for a file whose name ends otherwise than in SUFFIXES, or that needs a package which is missing."""
    if path.suffix not in SUFFIXES:
        raise InputError("--export", str(path), f"a file that ends in {', '.join(SUFFIXES)}")
    if path.suffix == ".parquet":
        pyarrow()


def _others(name: str, place: Array, speed: Array, dt: float) -> list[tuple[str, Array, Array, Array]]:
    """Return name, place, speed and acceleration (K,) of each car that takes a place on the road, NaN where another one has it."""
    accel = np.diff(speed, prepend=speed[:1]) / dt
    other = np.abs(np.diff(place) - 0.5 * dt * (speed[1:] + speed[:-1])) > JUMP
    number = np.concatenate([[0], np.cumsum(other)])
    accel[1:][other] = 0.0
    mine = [(f"{name}{i or ''}", number == i) for i in range(number[-1] + 1)]
    return [(car, *(np.where(here, column, np.nan) for column in (place, speed, accel))) for car, here in mine]  # type: ignore[misc]


def cars_of(trace: Trace, row: int = 0) -> Cars:
    """Return the road of an episode. Raise InputError for a system without one."""
    model = trace.model
    if model.lane:
        raise InputError("--export", "a car in a lane", "an episode of cars that follow each other; tailgate log writes the others")
    if not model.followers.any():
        raise InputError("--export", "a system without a road", "an episode of cars; tailgate log writes the others")
    x, v, a, gap, ahead = (trace.road(name, row) for name in ("position", "speed", "accel", "gap", "lead_speed"))
    place = x - LENGTH * np.arange(model.agents)
    gap = np.where(np.isfinite(gap), gap, np.nan)
    nobody = np.full(len(x), np.nan)
    cars = [(f"agent{i}", place[:, i], v[:, i], a[:, i], gap[:, i]) for i in range(model.agents)]
    if model.followers[0]:  # the car ahead of the first is no agent
        cars = [(*lead, nobody) for lead in _others("leader", x[:, 0] + gap[:, 0] + LENGTH, ahead[:, 0], model.dt)] + cars
    rear = trace.road("rear_gap", row)[:, -1]
    if np.isfinite(rear).all():
        behind = _others("behind", place[:, -1] - LENGTH - rear, trace.road("rear_speed", row)[:, -1], model.dt)
        cars += [(*last, np.where(np.isfinite(last[1]), rear, np.nan)) for last in behind]
    names, *columns = zip(*cars, strict=True)
    return Cars(names, *(np.stack(column, axis=1) for column in columns))


def table_of(trace: Trace, row: int = 0) -> dict[str, Array]:
    """Return columns of one length, a row for each step and one for the end. Numbers that a row does not have are NaN, texts empty."""
    cars, model, n = cars_of(trace, row), trace.model, int(trace.length[row])
    held = {name: trace.signals[name][:n, row] for name in ("wires", "valid", "estimate", "control", "applied", "score", "alarm", "mode")}
    hit = trace.target[:n, row] & (trace.kind[:n, row] != Kind.NONE)[:, None, None]
    kinds = np.where(hit.any(axis=2), np.array([kind.name.lower() for kind in Kind])[trace.kind[:n, row]][:, None], "none")
    modes = np.array([mode.name.lower() for mode in Mode])[held["mode"]]
    assert model.speed is not None
    believed = {"gap": trace.believed_gap(row), "speed": (model.speed[None] * held["estimate"]).sum(axis=2)}

    def numbers(values: Array) -> Array:
        return np.append(values.astype(float), np.nan)

    def words(values: Array) -> Array:
        return np.append(values.astype(object), "")

    out: dict[str, Array] = {"t": model.dt * np.arange(n + 1)}
    for i, name in enumerate(cars.names):
        road = {"position": cars.place, "speed": cars.speed, "acceleration": cars.accel, "gap": cars.gap}
        out |= {f"{name}/{what}": values[:, i] for what, values in road.items()}
    for i in range(model.agents):
        mine: dict[str, Array] = {}
        for w, name in enumerate(model.sensors + model.v2v):
            values = held["wires"][:, i, w]
            mine[f"received_{name}"] = np.where(held["valid"][:, i, w], values, np.nan) if w < len(model.sensors) else values
        mine |= {f"believed_{name}": values[:, i] for name, values in believed.items()}
        for w, name in enumerate(model.actuators):
            mine |= {f"command_{name}": held["control"][:, i, w], f"applied_{name}": held["applied"][:, i, w]}
        mine |= {"score": held["score"][:, i], "alarm": held["alarm"][:, i]}
        mine |= {f"attacked_{name}": hit[:, i, w] for w, name in enumerate(model.wires)}
        out |= {f"agent{i}/{name}": numbers(values) for name, values in mine.items()}
        out |= {f"agent{i}/mode": words(modes[:, i]), f"agent{i}/attack": words(kinds[:, i])}
    return out


def exported(trace: Trace, suffix: str, row: int = 0) -> bytes:
    """Return an episode as the content of a file with a suffix of SUFFIXES."""
    if suffix == ".xml":
        cars = cars_of(trace, row)
        return fcd(trace.model.dt, cars.names, cars.place - min(0.0, float(np.nanmin(cars.place))), cars.speed, cars.accel)
    columns = table_of(trace, row)
    if suffix == ".parquet":
        pa, pq = pyarrow()
        sink = pa.BufferOutputStream()
        made = {name: pa.array(x, pa.string() if x.dtype == object else pa.float64(), from_pandas=True) for name, x in columns.items()}
        pq.write_table(pa.table(made), sink, compression="zstd")
        return bytes(sink.getvalue().to_pybytes())
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    texts = [x if x.dtype == object else ["" if np.isnan(v) else repr(float(v)) for v in x] for x in columns.values()]
    writer.writerows(zip(*texts, strict=True))
    return out.getvalue().encode()


def write_episode(trace: Trace, path: Path, row: int = 0) -> Path:
    """Write an episode as CSV, SUMO's FCD XML or Parquet, as the name of the file ends; returns the path."""
    check_path(path)
    write_atomic(path, exported(trace, path.suffix, row), "--export")
    return path
