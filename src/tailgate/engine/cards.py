"""Graphics cards: what the engine asks of one, which one plays, and the memory that is taken there."""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from functools import cache
from typing import Any, Protocol

from tailgate.base.errors import InputError, unknown
from tailgate.engine.operations import Array

DEVICES = ("cpu", "cuda")
Argument = Any  # of a kernel: a whole number, an address, or an array of 64-bit numbers passed by value


_device: ContextVar[str] = ContextVar("device", default="cpu")


class DeviceError(InputError):
    """A card that cannot play; it ends a run, where the error of a component costs its own rows only."""


class OutOfMemory(Exception):
    """The card has no room for what was asked."""


class Card(Protocol):
    """A card, or what takes its place in tests. Addresses are the card's; copies wait for all work before them."""

    name: str
    kind: str  # what compiled code depends on: the card's capability, the compiler and its options
    tensors: str  # where a library of tensors keeps what is on this card, in its own words
    stream: int  # the queue of this thread's work, of those that the library of tensors has; 0 is the usual one

    def compiled(self, text: str) -> bytes:
        """Return the machine code of CUDA C."""

    def loaded(self, code: bytes, kernels: Sequence[str]) -> dict[str, Any]:
        """Return the kernels of machine code."""

    def at_once(self, kernel: object, threads: int) -> int:
        """Return how many warps of a kernel run at once, in blocks of a number of threads."""

    def facts(self, kernel: object) -> dict[str, int]:
        """Return a kernel's `registers`, and the bytes of a thread's `local` memory, spilled registers among them."""

    def wait(self) -> None:
        """Return when all work is done."""

    def copy(self, to: int, at: int, size: int) -> None:
        """Begin a copy from one place on the card to another."""

    def launch(self, kernel: object, grid: int, threads: int, arguments: Sequence[Argument]) -> None:
        """Begin a kernel; it runs after all work before it."""

    def taken(self, size: int) -> int:
        """Return the address of new memory [bytes], all zeros; raise OutOfMemory if there is none."""

    def given_back(self, at: int) -> None:
        """Free memory."""

    def free(self) -> int:
        """Return how many bytes are free."""

    def send(self, at: int, held: Array) -> None:
        """Copy a contiguous array to the card."""

    def fetch(self, held: Array, at: int) -> None:
        """Copy from the card into a contiguous array."""

    def send_rows(self, at: int, pitch: int, held: Array) -> None:
        """Copy the rows (R, bytes) of a contiguous array to addresses `pitch` bytes apart."""

    def fetch_rows(self, held: Array, at: int, pitch: int) -> None:
        """Copy rows that are `pitch` bytes apart on the card into a contiguous array (R, bytes)."""


class Memory:
    """Memory on a card, freed with the last reference to it."""

    def __init__(self, card: Card, size: int) -> None:
        self.card, self.size = card, size
        self.at = card.taken(max(size, 8))
        weakref.finalize(self, card.given_back, self.at)


def checked(device: object) -> str:
    """Return the name of a device; raise InputError for others."""
    if device not in DEVICES:
        raise unknown("device", device, DEVICES)
    return str(device)


def device() -> str:
    """Return the name of the device that plays here, see `playing_on`."""
    return _device.get()


@contextlib.contextmanager
def playing_on(name: str) -> Iterator[None]:
    """Play episodes on a device: cpu or cuda. Rows are the same; raise InputError if the device cannot play."""
    if checked(name) == "cuda":
        card()
    before = _device.set(name)
    try:
        yield
    finally:
        _device.reset(before)


@cache
def card() -> Card:
    """Return this machine's card; raise DeviceError if there is none, or if its library or driver does not fit."""
    return _found()


def _nvidia() -> Card:
    try:
        from tailgate.engine.nvidia import Nvidia
    except ImportError as error:
        raise DeviceError("device", "cuda", "cpu, or NVIDIA's library: pip install 'tailgate[cuda]'") from error
    return Nvidia()


_found: Callable[[], Card] = _nvidia
