"""An NVIDIA card, by NVIDIA's own bindings of the driver and of its compiler (extra `cuda`).

Code is compiled for this card's instructions, so that the driver compiles nothing. The context is the one that PyTorch uses too.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from cuda.bindings import driver, nvrtc

from tailgate.engine.cards import Argument, DeviceError, OutOfMemory
from tailgate.engine.operations import Array

OPTIONS = ("--fmad=false", "--prec-div=true", "--prec-sqrt=true", "--ftz=false", "--std=c++17")
LEAST = (7, 0)  # compute capability
EXTRA = "pip install 'tailgate[cuda]'"


def _refused(expected: str) -> DeviceError:
    return DeviceError("device", "cuda", expected)


def _name(code: object) -> str:
    return str(getattr(code, "name", code))


def _ok(result: tuple[Any, ...]) -> Any:
    """Return the values of a call of the driver; raise what its code says."""
    code, *values = result
    if int(code) == int(driver.CUresult.CUDA_ERROR_OUT_OF_MEMORY):
        raise OutOfMemory
    if int(code):
        raise RuntimeError(f"the card's driver: {_name(code)}")
    return values[0] if len(values) == 1 else values


def _compiler(result: tuple[Any, ...]) -> Any:
    code, *values = result
    if int(code):
        raise RuntimeError(f"the card's compiler: {_name(code)}")
    return values[0] if values else None


def _begun() -> tuple[int, tuple[int, int]]:
    """Return the driver's version and the compiler's; raise DeviceError where no card can play."""
    try:
        found = driver.cuInit(0)[0]
        version = int(_ok(driver.cuDriverGetVersion()))
    except (RuntimeError, OSError, ImportError) as error:  # the bindings do not find the driver's library
        raise _refused(f"cpu, or a machine with NVIDIA's driver: {_first(error)}") from error
    if int(found) == int(driver.CUresult.CUDA_ERROR_NO_DEVICE):
        raise _refused("cpu: this machine has no NVIDIA card, or CUDA_VISIBLE_DEVICES hides it")
    if int(found):
        raise _refused(f"cpu, or a driver that starts: {_name(found)}")
    try:
        compiler = _compiler_version()
    except (RuntimeError, OSError, ImportError) as error:
        raise _refused(f"cpu, or NVIDIA's compiler: {EXTRA} ({_first(error)})") from error
    if version // 1000 < compiler[0]:
        raise _refused(f"a driver of CUDA {compiler[0]} or later; this one is of CUDA {version // 1000}.{version % 1000 // 10}: update it, "
                       f"or install the bindings and the compiler of CUDA {version // 1000}")  # fmt: skip
    return version, compiler


def _compiler_version() -> tuple[int, int]:
    code, major, minor = nvrtc.nvrtcVersion()
    _compiler((code,))
    return int(major), int(minor)


def _first(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:200]


class Nvidia:
    """The first visible card; see `tailgate.engine.cards.Card`."""

    tensors = "cuda:0"

    def __init__(self) -> None:
        _, compiler = _begun()
        device = _ok(driver.cuDeviceGet(0))
        part = driver.CUdevice_attribute
        read: Callable[[Any], int] = lambda what: int(_ok(driver.cuDeviceGetAttribute(what, device)))  # noqa: E731
        self.capability = (
            read(part.CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR), read(part.CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MINOR),
        )  # fmt: skip
        self.name = _ok(driver.cuDeviceGetName(128, device)).split(b"\0")[0].decode()
        known = [int(one) for one in _known()]
        architecture = self.capability[0] * 10 + self.capability[1]
        if self.capability < LEAST or architecture not in known:
            fit = f"{min(known) / 10:.1f} to {max(known) / 10:.1f}"
            raise _refused(f"a card of compute capability {fit}; {self.name} has {architecture / 10:.1f}")
        self._processors = read(part.CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT)
        self._options = [f"--gpu-architecture=sm_{architecture}", *OPTIONS]
        self.kind = f"sm_{architecture} nvrtc {compiler[0]}.{compiler[1]} {' '.join(OPTIONS)}"
        self._queues = threading.local()
        self._context = _ok(driver.cuDevicePrimaryCtxRetain(device))
        self._here()

    @property
    def stream(self) -> int:
        """The stream of this thread's work; 0 unless it was set."""
        return getattr(self._queues, "stream", 0)

    @stream.setter
    def stream(self, stream: int) -> None:
        self._queues.stream = stream

    def _here(self) -> None:
        _ok(driver.cuCtxSetCurrent(self._context))

    def compiled(self, text: str) -> bytes:
        """Return the machine code of CUDA C."""
        return compiled(text, self._options)

    def loaded(self, code: bytes, kernels: Sequence[str]) -> dict[str, Any]:
        """Return the kernels of machine code."""
        self._here()
        module = _ok(driver.cuModuleLoadData(code))
        return {name: _ok(driver.cuModuleGetFunction(module, name.encode())) for name in kernels}

    def at_once(self, kernel: object, threads: int) -> int:
        """Return how many warps of a kernel run at once."""
        self._here()
        blocks = int(_ok(driver.cuOccupancyMaxActiveBlocksPerMultiprocessor(kernel, threads, 0)))
        return max(1, self._processors * blocks * threads // 32)

    def facts(self, kernel: object) -> dict[str, int]:
        """Return a kernel's `registers`, and the bytes of a thread's `local` memory, spilled registers among them."""
        self._here()
        part = driver.CUfunction_attribute
        asked = {"registers": part.CU_FUNC_ATTRIBUTE_NUM_REGS, "local": part.CU_FUNC_ATTRIBUTE_LOCAL_SIZE_BYTES}
        return {name: int(_ok(driver.cuFuncGetAttribute(what, kernel))) for name, what in asked.items()}

    def copy(self, to: int, at: int, size: int) -> None:
        """Begin a copy from one place on the card to another."""
        self._here()
        _ok(driver.cuMemcpyDtoDAsync(to, at, size, self.stream))

    def wait(self) -> None:
        """Return when all work is done."""
        self._here()
        self._wait()

    def launch(self, kernel: object, grid: int, threads: int, arguments: Sequence[Argument]) -> None:
        """Begin a kernel; it runs after all work before it."""
        self._here()
        held = [argument if isinstance(argument, np.ndarray) else np.array([argument], np.int64) for argument in arguments]
        places = np.array([one.ctypes.data for one in held], np.uint64)
        _ok(driver.cuLaunchKernel(kernel, grid, 1, 1, threads, 1, 1, 0, self.stream, places.ctypes.data, 0))

    def taken(self, size: int) -> int:
        """Return the address of new memory [bytes], all zeros; raise OutOfMemory if there is none."""
        self._here()
        at = int(_ok(driver.cuMemAlloc(size)))
        _ok(driver.cuMemsetD8Async(at, 0, size, self.stream))
        self._wait()  # its user may queue work elsewhere
        return at

    def given_back(self, at: int) -> None:
        """Free memory."""
        driver.cuCtxSetCurrent(self._context)  # at the end of the process nobody hears of errors
        driver.cuMemFree(at)

    def free(self) -> int:
        """Return how many bytes are free."""
        self._here()
        return int(_ok(driver.cuMemGetInfo())[0])

    def send(self, at: int, held: Array) -> None:
        """Copy a contiguous array to the card."""
        self._here()
        _ok(driver.cuMemcpyHtoDAsync(at, held.ctypes.data, held.nbytes, self.stream))
        self._wait()

    def fetch(self, held: Array, at: int) -> None:
        """Copy from the card into a contiguous array."""
        self._here()
        _ok(driver.cuMemcpyDtoHAsync(held.ctypes.data, at, held.nbytes, self.stream))
        self._wait()

    def _wait(self) -> None:
        _ok(driver.cuStreamSynchronize(self.stream))

    def send_rows(self, at: int, pitch: int, held: Array) -> None:
        """Copy the rows (R, bytes) of a contiguous array to addresses `pitch` bytes apart."""
        self._copy(held, at, pitch, send=True)

    def fetch_rows(self, held: Array, at: int, pitch: int) -> None:
        """Copy rows that are `pitch` bytes apart on the card into a contiguous array (R, bytes)."""
        self._copy(held, at, pitch, send=False)

    def _copy(self, held: Array, at: int, pitch: int, send: bool) -> None:
        self._here()
        plan, kinds = driver.CUDA_MEMCPY2D(), driver.CUmemorytype
        host, card = kinds.CU_MEMORYTYPE_HOST, kinds.CU_MEMORYTYPE_DEVICE
        plan.WidthInBytes, plan.Height = held.shape[1], held.shape[0]
        if send:
            plan.srcMemoryType, plan.srcHost, plan.srcPitch = host, held.ctypes.data, held.shape[1]
            plan.dstMemoryType, plan.dstDevice, plan.dstPitch = card, at, pitch
        else:
            plan.dstMemoryType, plan.dstHost, plan.dstPitch = host, held.ctypes.data, held.shape[1]
            plan.srcMemoryType, plan.srcDevice, plan.srcPitch = card, at, pitch
        _ok(driver.cuMemcpy2DAsync(plan, self.stream))
        self._wait()


@functools.cache
def _known() -> tuple[int, ...]:
    """Return the architectures that the compiler knows."""
    code, found = nvrtc.nvrtcGetSupportedArchs()
    _compiler((code,))
    return tuple(found)


def compiled(text: str, options: Sequence[str]) -> bytes:
    """Return the machine code of CUDA C; no card is needed."""
    program = _compiler(nvrtc.nvrtcCreateProgram(text.encode(), b"step.cu", 0, [], []))
    try:
        given = [option.encode() for option in options]
        code = nvrtc.nvrtcCompileProgram(program, len(given), given)[0]
        if int(code):
            log = bytearray(_compiler(nvrtc.nvrtcGetProgramLogSize(program)))
            nvrtc.nvrtcGetProgramLog(program, log)
            raise RuntimeError(f"the card's compiler: {_name(code)}: {log.decode(errors='replace')[:1000]}")
        held = bytearray(_compiler(nvrtc.nvrtcGetCUBINSize(program)))
        _compiler(nvrtc.nvrtcGetCUBIN(program, held))
        return bytes(held)
    finally:
        nvrtc.nvrtcDestroyProgram(program)
