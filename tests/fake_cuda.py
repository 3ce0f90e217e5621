"""NVIDIA's bindings as far as the engine uses them, over a `HostCard`: calls return codes and values as the real ones do."""

import ctypes
import enum
import sys
import types
from typing import Any

import numpy as np

from tailgate.engine.cards import OutOfMemory

from .card import HostCard


class Code(enum.IntEnum):
    CUDA_SUCCESS = 0
    CUDA_ERROR_INVALID_VALUE = 1
    CUDA_ERROR_OUT_OF_MEMORY = 2
    CUDA_ERROR_NO_DEVICE = 100
    CUDA_ERROR_SYSTEM_DRIVER_MISMATCH = 803


class Kinds(enum.IntEnum):
    CU_MEMORYTYPE_HOST = 1
    CU_MEMORYTYPE_DEVICE = 2


class Attributes(enum.IntEnum):
    CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT = 16
    CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR = 75
    CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MINOR = 76


class Functions(enum.IntEnum):
    CU_FUNC_ATTRIBUTE_LOCAL_SIZE_BYTES = 3
    CU_FUNC_ATTRIBUTE_NUM_REGS = 4


class Plan:
    """A copy of rows; what is not set is zero."""

    def __init__(self) -> None:
        for name in ("srcHost", "srcDevice", "srcPitch", "dstHost", "dstDevice", "dstPitch", "WidthInBytes", "Height"):
            setattr(self, name, 0)
        self.srcMemoryType = self.dstMemoryType = None


def _array(at: int, size: int) -> np.ndarray:
    return np.frombuffer((ctypes.c_char * size).from_address(int(at)), np.uint8)


class Driver(types.SimpleNamespace):
    """`cuda.bindings.driver` of a machine."""

    def __init__(self, card: HostCard, version: int = 13010, begin: Code = Code.CUDA_SUCCESS, capability: tuple[int, int] = (9, 0)) -> None:
        super().__init__(CUresult=Code, CUmemorytype=Kinds, CUdevice_attribute=Attributes, CUfunction_attribute=Functions, CUDA_MEMCPY2D=Plan)
        self.card, self.version, self.begin, self.capability = card, version, begin, capability
        self.current: Any = None
        self.streams: set[int] = set()

    def cuInit(self, flags: int) -> tuple[Code]:
        return (self.begin,)

    def cuDriverGetVersion(self) -> tuple[Code, int]:
        return Code(0), self.version

    def cuDeviceGet(self, number: int) -> tuple[Code, int]:
        return Code(0), number

    def cuDeviceGetAttribute(self, what: Attributes, device: int) -> tuple[Code, int]:
        found = {Attributes(16): 2, Attributes(75): self.capability[0], Attributes(76): self.capability[1]}
        return Code(0), found[what]

    def cuDeviceGetName(self, size: int, device: int) -> tuple[Code, bytes]:
        return Code(0), b"Fake 100" + b"\0" * (size - 8)

    def cuDevicePrimaryCtxRetain(self, device: int) -> tuple[Code, str]:
        return Code(0), "context"

    def cuCtxSetCurrent(self, context: Any) -> tuple[Code]:
        self.current = context
        return (Code(0),)

    def cuMemAlloc(self, size: int) -> tuple[Code, int]:
        assert self.current == "context"
        try:
            return Code(0), self.card.taken(size)
        except OutOfMemory:
            return Code.CUDA_ERROR_OUT_OF_MEMORY, 0

    def cuMemsetD8Async(self, at: int, value: int, size: int, stream: int) -> tuple[Code]:
        self.card.send(at, np.full(size, value, np.uint8))
        return (Code(0),)

    def cuMemFree(self, at: int) -> tuple[Code]:
        self.card.given_back(at)
        return (Code(0),)

    def cuMemGetInfo(self) -> tuple[Code, int, int]:
        return Code(0), self.card.free(), self.card.size

    def cuMemcpyHtoDAsync(self, at: int, host: int, size: int, stream: int) -> tuple[Code]:
        self.card.send(at, _array(host, size))
        return (Code(0),)

    def cuMemcpyDtoHAsync(self, host: int, at: int, size: int, stream: int) -> tuple[Code]:
        self.card.fetch(_array(host, size), at)
        return (Code(0),)

    def cuMemcpy2DAsync(self, plan: Plan, stream: int) -> tuple[Code]:
        send = plan.srcMemoryType == Kinds.CU_MEMORYTYPE_HOST
        assert {plan.srcMemoryType, plan.dstMemoryType} == set(Kinds)
        host, held = (plan.srcHost, plan.srcPitch) if send else (plan.dstHost, plan.dstPitch)
        at, pitch = (plan.dstDevice, plan.dstPitch) if send else (plan.srcDevice, plan.srcPitch)
        for row in range(plan.Height):
            part = _array(host + row * held, plan.WidthInBytes)
            (self.card.send(at + row * pitch, part) if send else self.card.fetch(part, at + row * pitch))
        return (Code(0),)

    def cuFuncGetAttribute(self, what: Functions, kernel: Any) -> tuple[Code, int]:
        return Code(0), {Functions(3): 40, Functions(4): 128}[what]

    def cuMemcpyDtoDAsync(self, to: int, at: int, size: int, stream: int) -> tuple[Code]:
        self.card.copy(to, at, size)
        return (Code(0),)

    def cuStreamSynchronize(self, stream: int) -> tuple[Code]:
        return (Code(0),)

    def cuModuleLoadData(self, code: bytes) -> tuple[Code, bytes]:
        return Code(0), code

    def cuModuleGetFunction(self, module: bytes, name: bytes) -> tuple[Code, Any]:
        return Code(0), self.card.loaded(module, [name.decode()])[name.decode()]

    def cuOccupancyMaxActiveBlocksPerMultiprocessor(self, kernel: Any, threads: int, shared: int) -> tuple[Code, int]:
        return Code(0), 1

    def cuLaunchKernel(self, kernel: Any, x: int, y: int, z: int, a: int, b: int, c: int, shared: int, stream: int, places: int, extra: int) -> tuple[Code]:  # fmt: skip
        assert (y, z, b, c, shared, extra) == (1, 1, 1, 1, 0, 0)
        self.streams.add(stream)
        at = (ctypes.c_void_p * 9).from_address(places)
        read = [ctypes.c_int64.from_address(place).value for place in at[:8]]
        self.card.launch(kernel, x, a, (*read, _array(at[8], 8)))
        return (Code(0),)


class Compiler(types.SimpleNamespace):
    """`cuda.bindings.nvrtc`; the code is this processor's."""

    def __init__(self, card: HostCard, version: tuple[int, int] = (13, 0)) -> None:
        super().__init__(card=card, version=version, texts={}, options=[], compiled=0, held=0)

    def nvrtcVersion(self) -> tuple[int, int, int]:
        return (0, *self.version)

    def nvrtcGetSupportedArchs(self) -> tuple[int, list[int]]:
        return 0, [75, 80, 90, 100]

    def nvrtcCreateProgram(self, text: bytes, name: bytes, headers: int, sources: list[bytes], names: list[bytes]) -> tuple[int, Any]:
        self.held += 1
        return 0, {"text": text.decode(), "code": b""}

    def nvrtcCompileProgram(self, program: Any, count: int, options: list[bytes]) -> tuple[int]:
        assert count == len(options)
        self.options, self.compiled = options, self.compiled + 1
        if "error" in program["text"][:20]:
            return (6,)
        program["code"] = self.card.compiled(program["text"])
        return (0,)

    def nvrtcGetProgramLogSize(self, program: Any) -> tuple[int, int]:
        return 0, 12

    def nvrtcGetProgramLog(self, program: Any, log: Any) -> tuple[int]:
        ctypes.memmove(ctypes.addressof(ctypes.c_char.from_buffer(log)) if isinstance(log, bytearray) else log, b"line 1: bad\0", 12)
        return (0,)

    def nvrtcGetCUBINSize(self, program: Any) -> tuple[int, int]:
        return 0, len(program["code"])

    def nvrtcGetCUBIN(self, program: Any, held: bytearray) -> tuple[int]:
        held[:] = program["code"]
        return (0,)

    def nvrtcDestroyProgram(self, program: Any) -> tuple[int]:
        self.held -= 1
        return (0,)


def install(monkeypatch: Any, driver: Any, compiler: Any) -> None:
    """Make these what `cuda.bindings` holds."""
    bindings = types.ModuleType("cuda.bindings")
    bindings.driver, bindings.nvrtc = driver, compiler  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "cuda", types.ModuleType("cuda"))
    monkeypatch.setitem(sys.modules, "cuda.bindings", bindings)
    monkeypatch.delitem(sys.modules, "tailgate.engine.nvidia", raising=False)
