"""A card that is this processor: CUDA's text compiled as C++, thread by thread, in memory with guards."""

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tailgate.engine import cards
from tailgate.engine.cuda import KERNELS
from tailgate.engine.remembered import Remembered
from tailgate.envs.gym import programs
from tailgate.play import commanded, rollouts

HEADER = Path(__file__).with_name("cuda_on_host.h")
COMPILER = next((found for name in ("g++", "c++", "clang++") if (found := shutil.which(name))), None)
OPTIONS = ("-std=c++17", "-O1", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared", "-w", *os.environ.get("HOST_OPTIONS", "").split())
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler: CUDA's text cannot be compiled for this processor")
_KINDS = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, *(ctypes.c_int64,) * 4, ctypes.c_void_p)


class HostCard:
    """A card of some bytes; `warps` run at once."""

    tensors = "cpu"

    def __init__(self, size: int = 1 << 33, warps: int = 3) -> None:
        self.name, self.warps, self.size, self.stream = "this processor", warps, size, 0
        self.kind = f"host {' '.join(OPTIONS)} {hashlib.sha256(HEADER.read_bytes()).hexdigest()}"
        self.held: dict[int, tuple[int, Any]] = {}
        self.launches = 0

    def compiled(self, text: str) -> bytes:
        calls = ", ".join([*(f"*({kind}*)a[{i}]" for i, kind in enumerate(("char*", "const u64*", "char*", *("i64",) * 4, "i64*"))), "*(Shared*)a[8]"])
        ends = "".join(
            f'extern "C" void launch_{name}(unsigned grid, unsigned threads, void** a) {{ gridDim.x = grid; blockDim.x = threads; '
            f"for (blockIdx.x = 0; blockIdx.x < grid; blockIdx.x++) for (threadIdx.x = 0; threadIdx.x < threads; threadIdx.x++) {name}({calls}); }}\n"
            for i, name in enumerate(KERNELS)
            if not text.startswith("#define ONLY") or text.startswith(f"#define ONLY {i}")
        )
        with tempfile.TemporaryDirectory() as folder:
            source, out = Path(folder) / "text.cpp", Path(folder) / "text.so"
            source.write_text(HEADER.read_text() + text + ends)
            made = subprocess.run([COMPILER, *OPTIONS, str(source), "-o", str(out)], capture_output=True, text=True)
            assert made.returncode == 0, made.stderr[:3000]
            return out.read_bytes()

    def loaded(self, code: bytes, kernels: Sequence[str]) -> dict[str, Any]:
        place = Path(tempfile.gettempdir()) / f"tailgate-{os.getpid()}-{hashlib.sha256(code).hexdigest()[:16]}.so"
        place.write_bytes(code)
        library = ctypes.CDLL(str(place))
        place.unlink()
        return {name: library[f"launch_{name}"] for name in kernels}

    def at_once(self, kernel: Any, threads: int) -> int:
        return self.warps

    def facts(self, kernel: Any) -> dict[str, int]:
        return {"registers": 0, "local": 0}

    def wait(self) -> None: ...

    def copy(self, to: int, at: int, size: int) -> None:
        self._inside(to, size)
        self._inside(at, size)
        ctypes.memmove(to, at, size)

    def launch(self, kernel: Any, grid: int, threads: int, arguments: Sequence[Any]) -> None:
        self.launches += 1
        values = [kind(value) for kind, value in zip(_KINDS, arguments, strict=False)]
        places = (ctypes.c_void_p * 9)(*(ctypes.addressof(value) for value in values), arguments[8].ctypes.data)
        kernel(ctypes.c_uint(grid), ctypes.c_uint(threads), places)
        for at, (size, held) in self.held.items():
            assert held[:64] == b"\xa5" * 64 and held[64 + size :] == b"\xa5" * 64, f"written outside of {size} bytes at {at}"

    def taken(self, size: int) -> int:
        if size > self.free():
            raise cards.OutOfMemory
        held = ctypes.create_string_buffer(size + 191)
        begin = ctypes.addressof(held)
        skip = -begin % 64
        held = (ctypes.c_char * (size + 128)).from_buffer(held, skip)
        held[:64] = held[64 + size :] = b"\xa5" * 64
        at = ctypes.addressof(held) + 64
        self.held[at] = size, held
        return at

    def given_back(self, at: int) -> None:
        del self.held[at]

    def free(self) -> int:
        return self.size - sum(size for size, _ in self.held.values())

    def send(self, at: int, held: np.ndarray) -> None:
        assert held.flags.c_contiguous
        self._inside(at, held.nbytes)
        ctypes.memmove(at, held.ctypes.data, held.nbytes)

    def fetch(self, held: np.ndarray, at: int) -> None:
        assert held.flags.c_contiguous
        self._inside(at, held.nbytes)
        ctypes.memmove(held.ctypes.data, at, held.nbytes)

    def send_rows(self, at: int, pitch: int, held: np.ndarray) -> None:
        for i, row in enumerate(held):
            self.send(at + i * pitch, row)

    def fetch_rows(self, held: np.ndarray, at: int, pitch: int) -> None:
        for i, row in enumerate(held):
            self.fetch(row, at + i * pitch)

    def _inside(self, at: int, size: int) -> None:
        assert any(begin <= at and at + size <= begin + whole for begin, (whole, _) in self.held.items()), "outside of the card's memory"


def forget(monkeypatch):
    """No program of an earlier card is known."""
    for module in (programs, commanded, rollouts):
        monkeypatch.setattr(module, "_made", Remembered())


@pytest.fixture
def host_card(monkeypatch):
    """This processor in place of a card."""
    made = HostCard()
    forget(monkeypatch)
    monkeypatch.setattr(cards, "_found", lambda: made)
    cards.card.cache_clear()
    yield made
    cards.card.cache_clear()
