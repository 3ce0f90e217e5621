# ruff: noqa: E501 - tables
"""Recordings of cars that follow others, in each format that is read."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

ROADS = (  # format, form, name of the file
    ("openacc", "csv", "a.csv"), ("ultra-av", "csv", "a.csv"), ("csv", "csv", "a.csv"), ("sumo-fcd", "text", "a.xml"), ("veremi", "jsonl", "a.jsonl"),
    ("comma2k19", "npy", "radar/value"),
)  # fmt: skip
MAPPED = ("t=time", "gap=distance:ft", "speed=own:km/h", "lead_speed=ahead:mph")


def recorded(kind: str) -> list[bytes]:
    """Return a car behind another for 9 s."""
    t = [round(0.1 * k, 1) for k in range(90)]
    if kind == "openacc":
        return [("Time,Speed1,Speed2,IVS1\n" + "\n".join(f"{x},20.0,20.0,{25 + 0.01 * i}" for i, x in enumerate(t))).encode()]
    if kind == "csv":
        return [("time,distance,own,ahead\n" + "\n".join(f"{x},{80 + 0.01 * i},72.0,45.0" for i, x in enumerate(t))).encode()]
    if kind == "comma2k19":
        return [_array(np.tile([25.0, 0.0, 0.1, 0.0, 0.0, 4.0, 0.0], (len(t), 1)))]
    if kind == "ultra-av":
        return [("Trajectory_ID,Time_Index,Speed_LV,Speed_FAV,Space_Gap\n" + "\n".join(f"1,{x},20.0,20.0,25.5" for x in t)).encode()]
    if kind == "sumo-fcd":
        place = '<vehicle id="{}" lane="a_0" pos="{}" speed="20.0"/>'
        steps = (f'<timestep time="{x}">{place.format("b", 40 + 20 * x)}{place.format("a", 20 * x)}</timestep>' for x in t)
        return [f'<?xml version="1.0"?><fcd-export>{"".join(steps)}</fcd-export>'.encode()]
    lines = [{"type": kind, "rcvTime": x, "sender": 7, "pos": [20.0 * x + at, 0.0, 0.0], "spd": [20.0, 0.0, 0.0]} for x in t for kind, at in ((2, 0.0), (3, 30.0))]
    return ["\n".join(json.dumps(line) for line in lines).encode()]


def read_recorded(kind: str, name: str, folder: Path) -> Any:
    """Read what lies in a folder, as `tailgate detect-log` does."""
    from tailgate.roads.readers import Choice, mapping_of, read

    at = folder if kind == "comma2k19" else folder / name
    return read(str(at), kind, Choice(mapping=mapping_of(MAPPED)) if kind == "csv" else Choice())


def beside_recorded(kind: str, folder: Path) -> None:
    """Write the other arrays of a segment."""
    if kind == "comma2k19":
        t = _array(0.1 * np.arange(90))
        for at in ("radar", "speed"):
            (folder / at).mkdir()
            (folder / at / "t").write_bytes(t)
        (folder / "speed" / "value").write_bytes(_array(np.full(90, 20.0)))


def _array(values: np.ndarray[Any, Any]) -> bytes:
    out = io.BytesIO()
    np.save(out, values)
    return out.getvalue()
