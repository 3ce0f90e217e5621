"""The exchange with a submission's process: raw numbers in two files in memory, and one short line of JSON each way.

Nothing is unpickled. The parent alone decides the place, type and shape of each array in the files.
Of the child's answer it reads the expected bytes, and a few checked fields of the line.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from mmap import mmap
from typing import Any

import numpy as np

from tailgate.core import Array, Model

LINE = 1 << 14  # [bytes] of the longest line of JSON
_ALIGN = 64
_MODEL = ("A", "B", "c", "C", "Q", "R", "graph", "gap", "speed")
_NAMES = ("sensors", "v2v", "actuators")
Header = list[Any]


def pack(arrays: Mapping[str, Array]) -> tuple[Header, bytes]:
    """Return arrays as one block, and the header for `unpack`: name, type, shape and order of the axes in memory."""
    header, blocks, at = [], [], 0
    for name, array in arrays.items():
        order = sorted(range(array.ndim), key=lambda axis, a=array: -a.strides[axis])  # type: ignore[misc]
        block = np.ascontiguousarray(array.transpose(order)).tobytes()
        header.append([name, array.dtype.str, [array.shape[axis] for axis in order], order])
        pad = -len(block) % _ALIGN
        blocks += [block, bytes(pad)]
        at += len(block) + pad
    return header, b"".join(blocks)


def unpack(header: Header, block: bytes) -> dict[str, Array]:
    """Return the arrays of `pack`, permanently read-only."""
    out, at = {}, 0
    for name, kind, shape, order in header:
        dtype = np.dtype(kind)
        size = math.prod(shape)
        flat = np.frombuffer(block, dtype, size, at)
        out[name] = flat.reshape(shape).transpose(sorted(range(len(order)), key=order.__getitem__))
        at += size * dtype.itemsize + -(size * dtype.itemsize) % _ALIGN
    return out


def model_arrays(model: Model) -> tuple[dict[str, Array], dict[str, Any]]:
    """Return a model's arrays, and the rest of it as JSON."""
    arrays = {name: np.asarray(getattr(model, name)) for name in _MODEL}
    return arrays, {"dt": model.dt, "challenge": model.challenge} | {name: list(getattr(model, name)) for name in _NAMES}


def model_of(arrays: Mapping[str, Array], rest: Mapping[str, Any]) -> Model:
    """Return the model of `model_arrays`."""
    fields: dict[str, Any] = {name: arrays[name] for name in _MODEL} | {name: tuple(rest[name]) for name in _NAMES}
    return Model(**fields, dt=rest["dt"], challenge=rest["challenge"])


class Outputs:
    """The layout of a step's estimate in the child's file: fixed places for B rows, B last in memory."""

    def __init__(self, batch: int, agents: int, states: int, actuators: int) -> None:
        self.batch, self.agents = batch, agents
        self.fields: dict[str, tuple[tuple[int, ...], Any]] = {
            "x": ((agents, states, batch), np.float64), "score": ((agents, batch), np.float64),
            "limits": ((agents, actuators, 2, batch), np.float64), "alarm": ((agents, batch), np.uint8),
            "mode": ((agents, batch), np.int8), "probe": ((agents, batch), np.uint8),
        }  # fmt: skip

    @property
    def size(self) -> int:
        """Number of bytes."""
        return sum(math.prod(shape) * np.dtype(kind).itemsize for shape, kind in self.fields.values())

    def views(self, block: bytes | mmap) -> dict[str, Array]:
        """Return each field as (B, N, ...) on a buffer."""
        out, at = {}, 0
        for name, (shape, kind) in self.fields.items():  # eight-byte fields come first, so that all are aligned
            count = math.prod(shape)
            out[name] = np.moveaxis(np.frombuffer(block, kind, count, at).reshape(shape), -1, 0)
            at += count * np.dtype(kind).itemsize
        return out


def line(message: Mapping[str, Any]) -> bytes:
    """Return a message as one line."""
    return json.dumps(message, allow_nan=False).encode() + b"\n"


def printable(text: object, most: int = 400) -> str:
    """Return foreign text in one line, without control characters."""
    return "".join(ch if ch.isprintable() else " " for ch in str(text)[:most]).strip()
