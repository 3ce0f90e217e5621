"""Recorded drives that come with the package, each with source, licence and digest (configs/traces/traces.yaml)."""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.errors import InputError, unknown
from tailgate.base.reading import load_yaml, read_bytes
from tailgate.core.nouns import Array

SCALE = 1000.0  # numbers of a file are whole thousandths of the unit
LARGEST = 16 << 20  # [bytes] of an unpacked column


@dataclass(frozen=True)
class Card:
    """The facts about a trace; `changes`: what differs from the source; `drive`: traces of one drive share seconds."""

    name: str
    about: str
    file: str
    drive: str
    sha256: str
    source: str
    licence: str
    attribution: str
    changes: str


def _folder() -> Path:
    return Path(str(files("tailgate.configs").joinpath("traces")))


@cache
def cards() -> dict[str, Card]:
    """Return the cards of all traces by name."""
    held: dict[str, dict[str, str]] = load_yaml(_folder() / "traces.yaml")
    return {name: Card(name, **fields) for name, fields in held.items()}


@cache
def _columns(name: str) -> dict[str, Array]:
    card = cards()[name]
    content = read_bytes(_folder() / card.file)
    if (found := hashlib.sha256(content).hexdigest()) != card.sha256:
        raise InputError(f"trace {name}", f"SHA-256 {found[:16]}", f"the file of its card ({card.sha256[:16]})")
    out = {column.removesuffix(".npy"): array / SCALE for column, array in npz(content).items()}
    for array in out.values():
        array.flags.writeable = False
    return out


def npy(content: bytes) -> Array:
    """Return the array of an npy file; nothing is unpickled. Raise ValueError for objects and for a damaged file."""
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = header(file)
    except Exception as error:  # its parser of headers raises many kinds
        raise ValueError(f"a damaged header ({type(error).__name__})") from None
    held = content[file.tell() :]
    if dtype.hasobject or fortran or len(shape) > 3 or math.prod(shape) * dtype.itemsize != len(held):
        raise ValueError(f"{dtype} of shape {shape} in {len(held)} bytes")
    return np.frombuffer(held, dtype).reshape(shape)


def npz(content: bytes) -> dict[str, Array]:
    """Return the arrays of an npz file by name. Raise ValueError for a damaged one, or for a column above 16 MB."""
    out: dict[str, Array] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for info in archive.infolist():
                if info.file_size > LARGEST:
                    raise ValueError(f"a column of {info.file_size} bytes")
                out[info.filename] = npy(archive.read(info))
    except (zipfile.BadZipFile, EOFError, NotImplementedError) as error:
        raise ValueError(str(error)) from None
    return out


def trace(name: str, where: str = "trace") -> dict[str, Array]:
    """Return the columns of a trace by name, read-only, each (K,).

    `t` [s] rises. `speed1` [m/s] is the first car's, `gap1` [m] lies between the first and the second car, and so on; `relative_speed1`
    [m/s] is positive where that gap grows.
    """
    if name not in cards():
        raise unknown(where, name, cards())
    return _columns(name)


def as_card(name: str) -> dict[str, Any]:
    """Return a trace's card as JSON data, with its columns, length and rate."""
    card, columns = cards()[name], trace(name)
    t = columns["t"]
    seconds = float(t[-1] - t[0])
    return {
        "name": name, "summary": card.about,
        **{key: getattr(card, key) for key in ("source", "licence", "attribution", "changes", "sha256")},
        "columns": [column for column in columns if column != "t"], "samples": len(t), "seconds": seconds,
        "rate": round((len(t) - 1) / seconds, 2),
    }  # fmt: skip
