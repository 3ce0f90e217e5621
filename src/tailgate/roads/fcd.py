"""Floating car data of SUMO (fcd-export XML): a reader and a writer. A document type, and so any entity, is refused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.reading import read_bytes
from tailgate.core import Array
from tailgate.roads.recording import MOST, Raw

DEEPEST = 8  # nested elements


class _Reader:
    """Keeps time, lane, place and speed of every vehicle."""

    def __init__(self, name: str) -> None:
        self.name, self.time, self.depth, self.rows = name, float("nan"), 0, 0
        self.root = ""
        self.seen: dict[str, dict[float, tuple[str, float, float]]] = {}

    def refuse(self, *_: object) -> None:
        raise InputError(f"{self.name}: XML", "a document type", "none: entities could read files or grow without bound")

    def open(self, tag: str, given: dict[str, str]) -> None:
        self.depth += 1
        self.root = self.root or tag
        if self.root != "fcd-export":
            raise InputError(f"{self.name}: root element", tag, "fcd-export")
        if self.depth > DEEPEST:
            raise InputError(f"{self.name}: XML", f"{self.depth} nested elements", f"at most {DEEPEST}")
        if tag == "timestep":
            before, self.time = self.time, self.number(given, "time", tag)
            if self.time <= before:
                raise InputError(f"{self.name}: timestep.time", self.time, f"a time after {before:g} s")
        elif tag == "vehicle":
            if "id" not in given or "lane" not in given:
                raise InputError(f"{self.name}: vehicle at {self.time:g} s", sorted(given), "id, lane, pos and speed")
            self.rows += 1
            if self.rows > MOST:
                raise InputError(f"{self.name}: vehicles", self.rows, f"at most {MOST} rows")
            place = given["lane"], self.number(given, "pos", tag), self.number(given, "speed", tag)
            mine = self.seen.setdefault(given["id"], {})
            if self.time in mine:
                raise InputError(f"{self.name}: vehicle {given['id']}", f"twice at {self.time:g} s", "once in a time step")
            mine[self.time] = place

    def close(self, tag: str) -> None:
        self.depth -= 1

    def number(self, given: dict[str, str], key: str, tag: str) -> float:
        try:
            return float(given[key])
        except (KeyError, ValueError):
            raise InputError(f"{self.name}: {tag}.{key}", given.get(key), "a number") from None


def read_fcd(path: Path, vehicle: str | None, lead: str | None, length: float) -> list[Raw]:
    """Return the recording of a vehicle behind the one ahead in its lane.

    Parameters
    ----------
    vehicle, lead
        Their ids; without them the pair that was seen longest.
    length
        The length of the car ahead [m]: a position is that of the front bumper.
    """
    held = _Reader(path.name)
    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = held.open, held.close
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = held.refuse
    try:
        parser.Parse(read_bytes(path, 512 << 20), True)
    except (expat.ExpatError, LookupError) as error:  # the second: an encoding that nobody knows
        raise InputError(f"{path.name}: XML", str(error), "well-formed XML") from None
    for name in (vehicle, lead):
        if name is not None and name not in held.seen:
            raise InputError(f"{path.name}: vehicle", name, f"one of {', '.join(sorted(held.seen)[:9])}")
    ahead = _ahead(held)
    pairs = Counter(
        (me, other) for (me, _), other in ahead.items() if vehicle in (None, me) and lead in (None, other)
    )
    if not pairs:
        raise InputError(f"{path.name}: vehicles", len(held.seen), "a vehicle behind another in its lane")
    me, other = max(pairs, key=lambda pair: (pairs[pair], pair))
    times = sorted(held.seen[me])
    rows = []
    for t in times:
        _, place, speed = held.seen[me][t]
        if ahead.get((me, t)) != other:
            rows.append((t, np.nan, np.nan, speed))
        else:
            _, there, fast = held.seen[other][t]
            rows.append((t, there - length - place, fast - speed, speed))
    columns = np.array(rows).T
    return [Raw(f"vehicle {me} behind {other}", *columns)]


def _ahead(held: _Reader) -> dict[tuple[str, float], str]:
    """Return the next vehicle in the lane of each vehicle and time."""
    lanes: dict[tuple[float, str], list[tuple[float, str]]] = {}
    for name, places in held.seen.items():
        for t, (lane, place, _) in places.items():
            lanes.setdefault((t, lane), []).append((place, name))
    out = {}
    for (t, _), some in lanes.items():
        some.sort()
        for (_, me), (_, other) in pairwise(some):
            out[me, t] = other
    return out


def fcd(dt: float, names: Iterable[str], place: Array, speed: Array, accel: Array) -> bytes:
    """Return an fcd-export of cars in one lane.

    Parameters
    ----------
    place, speed, accel : (K, V)
        Place of the front bumper along the lane [m], speed [m/s] and acceleration [m/s^2] of each car; NaN where it is not there.
    """
    out = ['<?xml version="1.0" encoding="UTF-8"?>', "<fcd-export>"]
    ids = [quoteattr(name) for name in names]
    for k in range(len(place)):
        out.append(f'    <timestep time="{k * dt:.3f}">')
        for i, name in enumerate(ids):
            if np.isnan(place[k, i]):
                continue
            x = f"{place[k, i]:.3f}"
            out.append(
                f'        <vehicle id={name} x="{x}" y="0.00" angle="90.00" type="car" speed="{speed[k, i]:.4f}" pos="{x}" '
                f'lane="road_0" slope="0.00" acceleration="{accel[k, i]:.4f}"/>'
            )
        out.append("    </timestep>")
    return "\n".join([*out, "</fcd-export>", ""]).encode()
