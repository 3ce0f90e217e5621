"""An episode in the field's formats: CSV and Parquet (PlotJuggler, pandas), and SUMO's floating car data.

A row is one car at one time: what it read, believed and did, and where it was. Cars are named agent0, agent1, ...; where the manoeuvre's
car is no agent, it is `leader`, and the driver behind `behind`. They have rows for the road alone.
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
LENGTH = 5.0  # of a car, which SUMO needs: positions of a plant are such that their differences are gaps [m]


class Cars(NamedTuple):
    """The road of one episode, (K, V) each: the first car first, at the times of its K steps."""

    names: tuple[str, ...]
    place: Array  # front bumper along the lane [m]
    speed: Array  # [m/s]
    accel: Array  # [m/s^2]
    gap: Array  # to the car ahead [m]; NaN where there is none


def check_path(path: Path) -> None:
    """Raise InputError for a file whose name ends otherwise than in SUFFIXES, or that needs a package which is missing."""
    if path.suffix not in SUFFIXES:
        raise InputError("--export", str(path), f"a file that ends in {', '.join(SUFFIXES)}")
    if path.suffix == ".parquet":
        pyarrow()


def _road(trace: Trace, name: str, row: int) -> Array:
    """Return a road signal (K, N) at the times of the steps."""
    n = int(trace.length[row])
    return np.concatenate([trace.first[name][row : row + 1], trace.signals[name][: n - 1, row]])


def cars_of(trace: Trace, row: int = 0) -> Cars:
    """Return the road of an episode. Raise InputError for a system without one."""
    model = trace.model
    if model.lane:
        raise InputError("--export", "a car in a lane", "an episode of cars that follow each other; tailgate log writes the others")
    if not model.followers.any():
        raise InputError("--export", "a system without a road", "an episode of cars; tailgate log writes the others")
    x, v, a, gap, ahead = (_road(trace, name, row) for name in ("position", "speed", "accel", "gap", "lead_speed"))
    names = [f"agent{i}" for i in range(model.agents)]
    place = x - LENGTH * np.arange(model.agents)
    gap = np.where(np.isfinite(gap), gap, np.nan)
    if model.followers[0]:  # the car ahead of the first is no agent
        lead = (x[:, 0] + gap[:, 0] + LENGTH, ahead[:, 0], np.gradient(ahead[:, 0], model.dt), np.full(len(x), np.nan))
        names = ["leader", *names]
        place, v, a, gap = (np.concatenate([first[:, None], rest], axis=1) for first, rest in zip(lead, (place, v, a, gap), strict=True))
    rear = _road(trace, "rear_gap", row)[:, -1]
    if np.isfinite(rear).all():
        last = (place[:, -1] - LENGTH - rear, _road(trace, "rear_speed", row)[:, -1])
        names.append("behind")
        columns = (last[0], last[1], np.gradient(last[1], model.dt), rear)
        place, v, a, gap = (np.concatenate([rest, one[:, None]], axis=1) for rest, one in zip((place, v, a, gap), columns, strict=True))
    return Cars(tuple(names), place, v, a, gap)


def table_of(trace: Trace, row: int = 0) -> dict[str, Array]:
    """Return columns of one length: step by step, in it car by car. Numbers that a car does not have are NaN, texts empty."""
    cars, model, n = cars_of(trace, row), trace.model, int(trace.length[row])
    count = len(cars.names)
    agents = np.array([int(name[5:]) if name.startswith("agent") else -1 for name in cars.names])

    def spread(values: Array) -> Array:
        """Return an agent's numbers (K, N) as those of all cars (K V,)."""
        out = np.full((n, count), np.nan)
        out[:, agents >= 0] = values[:, agents[agents >= 0]]
        return out.ravel()

    def words(values: Array) -> Array:
        out = np.full((n, count), "", dtype=object)
        out[:, agents >= 0] = values[:, agents[agents >= 0]]
        return out.ravel()

    held = {name: trace.signals[name][:n, row] for name in ("wires", "valid", "estimate", "control", "applied", "score", "alarm", "mode")}
    hit = trace.target[:n, row] & (trace.kind[:n, row] != Kind.NONE)[:, None, None]
    kinds = np.array([kind.name.lower() for kind in Kind])[trace.kind[:n, row]]
    t = model.dt * np.arange(n)
    out: dict[str, Array] = {
        "t": np.repeat(t, count), "vehicle": np.tile(np.array(cars.names, dtype=object), n), "position": cars.place.ravel(),
        "speed": cars.speed.ravel(), "acceleration": cars.accel.ravel(), "gap": cars.gap.ravel(),
    }  # fmt: skip
    for i, name in enumerate(model.sensors + model.v2v):
        values = held["wires"][..., i]
        out[f"received_{name}"] = spread(np.where(held["valid"][..., i], values, np.nan) if i < len(model.sensors) else values)
    assert model.gap is not None and model.speed is not None
    for name, rows in (("gap", model.gap), ("speed", model.speed)):
        out[f"believed_{name}"] = spread(_rowwise(rows, held["estimate"]))
    for i, name in enumerate(model.actuators):
        out[f"command_{name}"], out[f"applied_{name}"] = spread(held["control"][..., i]), spread(held["applied"][..., i])
    out |= {"score": spread(held["score"]), "alarm": spread(held["alarm"].astype(float))}
    out["mode"] = words(np.array([mode.name.lower() for mode in Mode])[held["mode"]])
    out["attack"] = words(np.where(hit.any(axis=2), kinds[:, None], "none"))
    for i, name in enumerate(model.wires):
        if hit[..., i].any():
            out[f"attacked_{name}"] = spread(hit[..., i].astype(float))
    return out


def _rowwise(rows: Array, x: Array) -> Array:
    """Return row i of `rows` (N, n) times x (K, N, n) of agent i: (K, N)."""
    out: Array = (rows[None] * x).sum(axis=2)
    return out


def exported(trace: Trace, suffix: str, row: int = 0) -> bytes:
    """Return an episode as the content of a file with a suffix of SUFFIXES."""
    if suffix == ".xml":
        cars = cars_of(trace, row)
        return fcd(trace.model.dt, cars.names, cars.place - min(0.0, float(cars.place.min())), cars.speed, cars.accel)
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
