"""Several rollouts at one table: each waits with its rows until all have handed in theirs, and one step of the defence serves them all.

Rollouts are ordinary ones, in threads of which only one ever runs. Nothing is computed side by side, so nothing depends on who is first.
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

_STOPPING = 60.0  # [s] that a rollout may take to notice that the table is closed


class _Stopped(BaseException):
    """The table is closed: unwinds a rollout, which catches every Exception."""


class _Hand(NamedTuple):
    """What a rollout hands in for one step."""

    received: Received
    known_u: Array
    draws: Draws


class Seat:
    """The defence as one rollout sees it."""

    untraced = "its steps wait for other rollouts"  # which would wait for the end of the tracing

    def __init__(self, model: Model, work: Callable[[Seat], Any]) -> None:
        self.model, self.work = model, work
        self.prior: Prior | None = None
        self.hand: _Hand | None = None
        self.answer: Estimate | BaseException | None = None
        self.result: Any = None
        self.done = False
        self.fault: BaseException | None = None
        self._go, self._back = threading.Semaphore(0), threading.Semaphore(0)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def prepare(self, model: Model) -> None:
        """Nothing: the process has its plan, of this very model."""
        if _fingerprint(model) != _fingerprint(self.model):
            raise InputError("cells", "cells of several models", "cells of one scenario")

    def start(self, plan: None, prior: Prior) -> None:
        """Keeps the prior until all are seated."""
        self.prior = prior

    def step(self, plan: None, state: None, received: Received, known_u: Array, draws: Draws) -> tuple[None, Estimate]:
        """Hands the rows in, and waits for the estimate."""
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
        """Let the rollout run with this answer to its next step, or to its end."""
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
    """What each piece of work returns, all played against one process of the defence, their rows in an order that `secret` decides.

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
    """Step after step, until every rollout is done."""
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
            state, estimate = defence.step_unchecked(plan, state, received, known_u, Draws(**fields, stream=parts[0].stream))
        except Exception as error:
            _dismiss(seats, error)
            return
        for seat, rows in zip(seats, places, strict=True):
            if not seat.done:
                seat.play_on(map_leaves(partial(_take, rows), estimate))


def _dismiss(seats: list[Seat], error: Exception) -> None:
    """The defence failed: each rollout that is not done gets the error as the answer to its step."""
    for seat in seats:
        if not seat.done:
            seat.play_on(error)


def order_of(secret: bytes, count: int) -> Array:
    """A permutation of `count` rows that only who has the secret can make."""
    keys = [hashlib.blake2b(row.to_bytes(8, "little"), key=secret, digest_size=16).digest() for row in range(count)]
    return np.array(sorted(range(count), key=keys.__getitem__), np.int64)


def _merge(parts: Sequence[Any], places: Sequence[Array]) -> Any:
    """One tree of the rows of several: those of part i go to places[i]. B is last in memory, as everywhere."""
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
