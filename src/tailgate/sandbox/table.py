"""Several rollouts that share one defence: each waits until all have handed in their rows; one step of the defence serves all.

Rollouts run in threads, only one of them at a time, so that no result depends on timing.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.base.pytree import map_leaves
from tailgate.core import Array, Estimate, Model, Prior, Received
from tailgate.core.draws import Draws
from tailgate.sandbox.isolated import Isolated, IsolatedPlan

_STOPPING = 60.0  # [s] for a rollout to notice that it must stop


class _Stopped(BaseException):
    """Unwinds a rollout, which catches every Exception."""


class _Hand(NamedTuple):
    """The inputs of one step from one rollout."""

    received: Received
    known_u: Array
    draws: Draws


class Seat:
    """The defence as one rollout sees it."""

    untraced = "its steps wait for other rollouts"  # which would wait for the end of tracing

    def __init__(self, model: Model, work: Callable[[Seat], Any]) -> None:
        self.model, self.work = model, work
        self.prior: Prior | None = None
        self.hand: _Hand | None = None
        self.answer: Estimate | BaseException | None = None
        self.result: object = None
        self.done = False
        self.fault: BaseException | None = None
        self._go, self._back = threading.Semaphore(0), threading.Semaphore(0)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def prepare(self, model: Model) -> None:
        """Check the model; the process already has its plan."""
        if _fingerprint(model) != _fingerprint(self.model):
            raise InputError("cells", "cells of several models", "cells of one scenario")

    def start(self, plan: None, prior: Prior) -> None:
        """Keep the prior until all rollouts have started."""
        self.prior = prior

    def step(self, plan: None, state: None, received: Received, known_u: Array, draws: Draws) -> tuple[None, Estimate]:
        """Hand in the rows and wait for the estimate."""
        self.hand = _Hand(received, known_u, draws)
        self._back.release()
        self._go.acquire()
        if isinstance(self.answer, Estimate):
            return None, self.answer
        assert self.answer is not None
        raise self.answer

    def _run(self) -> None:
        self._go.acquire()
        try:
            if not isinstance(self.answer, _Stopped):
                self.result = self.work(self)
        except BaseException as error:
            self.fault = error
        self.done = True
        self._back.release()

    def play_on(self, answer: Estimate | BaseException | None) -> None:
        """Run the rollout with this answer to its next step or its end."""
        self.answer = answer
        self._go.release()
        self._back.acquire()

    def stop(self) -> None:
        """Unwind the rollout."""
        if not self.done:
            self.answer = _Stopped()
            self._go.release()
            self._thread.join(_STOPPING)


def play_together(defence: Isolated, plan: IsolatedPlan, works: Sequence[Callable[[Seat], Any]], secret: bytes) -> list[Any]:
    """Play all pieces of work against one process of the defence; return their results. `secret` decides the order of rows.

    A rollout that ends early stays with its last rows, so that the batch never changes; its answers are dropped.
    """
    seats = [Seat(plan.model, work) for work in works]
    try:
        for seat in seats:
            seat.play_on(None)
        seated = [seat for seat in seats if seat.hand is not None]  # the others failed before their first step
        if seated:
            _serve(defence, plan, seated, secret)
        for seat in seats:
            if seat.fault is not None:
                raise seat.fault
        return [seat.result for seat in seats]
    finally:
        for seat in seats:
            seat.stop()


def _serve(defence: Isolated, plan: IsolatedPlan, seats: list[Seat], secret: bytes) -> None:
    """Play steps until every rollout has ended."""
    sizes = [len(seat.hand.known_u) for seat in seats if seat.hand is not None]
    order = order_of(secret, sum(sizes))
    places = np.split(order, np.cumsum(sizes)[:-1])
    try:
        state = defence.start(plan, _merge([seat.prior for seat in seats], places))
    except Exception as error:
        _dismiss(seats, error)
        return
    while not all(seat.done for seat in seats):
        hands = [seat.hand for seat in seats]
        received = _merge([hand.received for hand in hands if hand is not None], places)
        known_u = _merge([hand.known_u for hand in hands if hand is not None], places)
        parts = [hand.draws for hand in hands if hand is not None]
        fields = {name: _merge([getattr(draws, name) for draws in parts], places) for name in ("key", "episode", "step")}
        try:
            state, estimate = defence.step(plan, state, received, known_u, Draws(**fields, stream=parts[0].stream))
        except Exception as error:
            _dismiss(seats, error)
            return
        for seat, rows in zip(seats, places, strict=True):
            if not seat.done:
                seat.play_on(map_leaves(partial(_take, rows), estimate))


def _dismiss(seats: list[Seat], error: Exception) -> None:
    """Answer the steps of all running rollouts with the error of the defence."""
    for seat in seats:
        if not seat.done:
            seat.play_on(error)


def order_of(secret: bytes, count: int) -> Array:
    """Return a permutation of `count` rows that only the owner of the secret can compute."""
    keys = [hashlib.blake2b(row.to_bytes(8, "little"), key=secret, digest_size=16).digest() for row in range(count)]
    return np.array(sorted(range(count), key=keys.__getitem__), np.int64)


def _merge(parts: Sequence[Any], places: Sequence[Array]) -> Any:
    """Merge the rows of several trees: those of part i go to places[i]. B is last in memory."""
    first = parts[0]
    if first is None:
        return None
    if isinstance(first, tuple):
        return type(first)(*(_merge(leaves, places) for leaves in zip(*parts, strict=True)))
    out = num.zeros((sum(len(part) for part in parts), *first.shape[1:]), first.dtype)
    for part, rows in zip(parts, places, strict=True):
        out[rows] = part
    return out


def _take(rows: Array, leaf: Array) -> Array:
    return num.batch_last(leaf[rows])


def _fingerprint(model: Model) -> str:
    out = hashlib.blake2b(repr((model.wires, model.dt, model.challenge)).encode())
    for name in ("A", "B", "c", "C", "Q", "R", "graph", "gap", "speed"):
        array = np.ascontiguousarray(getattr(model, name))
        out.update(repr((array.shape, array.dtype.str)).encode() + array.tobytes())
    return out.hexdigest()
