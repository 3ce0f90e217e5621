"""The submission's process: it imports the class and answers each line of JSON with one line.

Run as `python -m tailgate.sandbox.child FOLDER LIMITS`. FOLDER holds the files `in`, which is only read here, and `out`.
LIMITS is JSON. What the submission prints goes to standard error; the real standard output carries the answers.
"""

from __future__ import annotations

import json
import mmap
import os
import resource
import sys
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.pytree import map_leaves
from tailgate.base.version import VERSION
from tailgate.core import Array, Estimate, Model, Prior, Received, pair_of
from tailgate.core.draws import Draws
from tailgate.core.registry import Spec
from tailgate.sandbox.wire import LINE, Header, Outputs, line, model_of, printable, unpack

KEPT = 8  # most recently used states from which a step can continue
RECEIVED = ("y", "valid", "energy", "v2v", "odometry", "attacked")

KINDS = {"x": "f", "score": "f", "alarm": "b", "mode": "iu", "probe": "b", "limits": "f"}  # of the arrays that a step returns


class Child:
    """The state of one submission's process: the defence, its plan and its last states."""

    def __init__(self, folder: Path) -> None:
        self.data = os.open(folder / "in", os.O_RDONLY)
        self.folder = folder
        self.defence: Any = None
        self.model: Model | None = None
        self.plan: object = None
        self.states: OrderedDict[int, tuple[int, Any]] = OrderedDict()  # first ticket -> (rows, state)
        self.outputs: Outputs | None = None
        self.views: dict[str, Array] = {}

    def arrays(self, header: Header, size: int) -> dict[str, Array]:
        """Return the arrays of this request, as read-only copies."""
        block = b""
        while len(block) < size and (part := os.pread(self.data, size - len(block), len(block))):
            block += part
        return unpack(header, block)

    def load(self, text: str, path: str | None) -> dict[str, Any]:
        if path is not None:
            sys.path.insert(0, path)
        spec = Spec("defence", text)
        try:
            entry, self.defence = spec.entry, spec.make()
        except InputError as error:
            if path is None or not isinstance(error.__context__, ImportError):
                raise
            raise InputError(error.field, error.value, f"{error.expected}; only the submitted file or folder can be imported") from None
        return {"uses": list(entry.uses), "version": entry.version, "reference": entry.reference, "tailgate": VERSION}

    def prepare(self, arrays: dict[str, Array], rest: dict[str, Any]) -> dict[str, Any]:
        self.model = model_of(arrays, rest)
        self.plan = self.defence.prepare(self.model)
        return {}

    def start(self, arrays: dict[str, Array], ticket: int) -> dict[str, Any]:
        prior = Prior(arrays["mean"], arrays["cov"])
        self._keep(ticket, len(prior.mean), self.defence.start(self.plan, prior))
        return {}

    def step(self, arrays: dict[str, Array], stream: int, ticket: int) -> dict[str, Any]:
        state = self._state(arrays["ticket"])
        received = Received(*(arrays.get(name) for name in RECEIVED))  # type: ignore[arg-type]
        draws = Draws(arrays["key"], arrays["episode"], arrays["step"], stream)
        state, estimate = pair_of(self.defence.step(self.plan, state, received, arrays["known_u"], draws))
        batch = len(received.y)
        self._keep(ticket, batch, state)
        return {"limits": self._write(estimate, batch)}

    def _write(self, estimate: Estimate, batch: int) -> bool:
        """Write an estimate to the file; return True if it has limits. The parent checks values; here only types and shapes."""
        assert self.model is not None
        model = self.model
        if self.outputs is None or self.outputs.batch != batch:
            self.outputs = Outputs(batch, model.agents, model.states, len(model.actuators))
            with open(self.folder / "out", "r+b") as file:
                self.views = self.outputs.views(mmap.mmap(file.fileno(), self.outputs.size))
        limited = getattr(estimate, "limits", None) is not None
        for name, kinds in KINDS.items():
            if name == "limits" and not limited:
                continue
            value, place = getattr(estimate, name, None), self.views[name]
            if type(value) is not np.ndarray or value.shape != place.shape or value.dtype.kind not in kinds:
                got = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
                raise InputError(f"defence output {name}", got, f"an array of shape {place.shape}, kind {kinds!r}")
            if name == "mode":
                value = np.clip(value, -1, 127)  # int8 must not wrap an invalid number to a valid one
            place[...] = value
        return limited

    def _keep(self, ticket: int, rows: int, state: object) -> None:
        self.states[ticket] = rows, state
        while len(self.states) > KEPT:
            self.states.popitem(last=False)

    def _state(self, tickets: Array) -> Any:
        """Return the state whose rows have these tickets: usually that of the last step, else combined from several."""
        first = int(tickets[0])
        if first in self.states and self.states[first][0] == len(tickets) and (tickets == first + np.arange(len(tickets))).all():
            self.states.move_to_end(first)
            return self.states[first][1]
        out: Any = None
        found = np.zeros(len(tickets), bool)
        for begin in list(self.states):
            rows, state = self.states[begin]
            here = (tickets >= begin) & (tickets < begin + rows)
            if here.any():
                self.states.move_to_end(begin)
                out = map_leaves(_empty(len(tickets)), state) if not found.any() else out
                map_leaves(_put(np.flatnonzero(here), tickets[here] - begin), out, state)
                found |= here
        if not found.all():
            raise InputError("state", "an old one", f"one of the {KEPT} most recently used states")
        return out


def _empty(batch: int) -> Any:
    def make(leaf: Array) -> Array:
        return np.moveaxis(np.zeros((*leaf.shape[1:], batch), leaf.dtype), -1, 0)

    return make


def _put(rows: Array, source: Array) -> Any:
    def put(leaf: Array, other: Array) -> None:
        leaf[rows] = other[source]

    return put


def _limit(limits: dict[str, int]) -> None:
    """Set resource limits for this process and those that it starts."""
    for name, value in (
        ("RLIMIT_DATA", limits["memory"]), ("RLIMIT_CPU", limits["cpu"]), ("RLIMIT_FSIZE", limits["file_size"]),
        ("RLIMIT_CORE", 0), ("RLIMIT_NOFILE", 256),
    ):  # fmt: skip
        number = getattr(resource, name)
        hard = resource.getrlimit(number)[1]
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(number, (value, value))


def _error(error: BaseException) -> dict[str, str]:
    """Return an error as text; a submission's error class may raise another error when it is printed."""
    try:
        out = {"kind": printable(type(error).__name__, 60), "text": printable(error)}
        if isinstance(error, InputError):
            shown = " ".join(repr(error.value).split())
            out |= {"field": printable(error.field), "value": printable(shown), "expected": printable(error.expected)}
    except BaseException:
        return {"kind": "Exception", "text": "one that cannot be shown"}
    return out


def main() -> None:
    """Answer the parent's requests until it closes the pipe."""
    _limit(json.loads(sys.argv[2]))
    requests, answers = os.fdopen(os.dup(0), "rb"), os.dup(1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)  # print() cannot reach the answers
    child = Child(Path(sys.argv[1]))
    while text := requests.readline(LINE):
        request = json.loads(text)
        number, done = request.pop("id"), request.pop("op")
        try:
            if "arrays" in request:
                request["arrays"] = child.arrays(request["arrays"], request.pop("size"))
            answer = {"id": number, "ok": getattr(child, done)(**request)}
        except BaseException as error:  # also SystemExit: an error is the answer to the step
            answer = {"id": number, "error": _error(error)}
        os.write(answers, line(answer))


if __name__ == "__main__":
    main()
