"""NVIDIA's own tools, where they are installed: the bindings over a driver made for the test, and compilers that need no card."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tailgate.engine.on_device import CudaProgram
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.programs import SeatPrograms

from .card import COMPILER, HostCard, host_card, needs_compiler

__all__ = ["host_card"]
HERE = Path(__file__).parent
try:
    BOUND = importlib.util.find_spec("cuda.bindings") is not None
except ModuleNotFoundError:
    BOUND = False
needs_bindings = pytest.mark.skipif(not BOUND, reason="NVIDIA's bindings are not installed: tailgate[cuda]")
PLAY = """
import struct, sys
import numpy as np
from tailgate.engine import cards, nvidia
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tests.card import HostCard

host = HostCard()
nvidia.compiled = lambda text, options: (lambda code: struct.pack("<Q", len(code)) + code)(host.compiled(text))
arguments = {"scenario": "gusty-stop-and-go-v0", "defence": "chi2_kf"}
one, two = AdversaryVectorEnv(40, device="cuda", **arguments), AdversaryVectorEnv(40, **arguments)
assert np.array_equal(one.reset(seed=5)[0], two.reset(seed=5)[0])
chance = np.random.default_rng(0)
for _ in range(20):
    actions = chance.integers(0, 2, 40)
    for first, second in zip(one.step(actions)[:4], two.step(actions)[:4], strict=True):
        assert np.array_equal(first, second)
kernel = one.episodes.programs.decide.code.kernel("play_step")
print(cards.card().name, cards.card().facts(kernel), cards.card().at_once(kernel, 128))
try:
    cards.Memory(cards.card(), 1 << 40)
except cards.OutOfMemory:
    print("out of memory")
"""


@needs_compiler
@needs_bindings
def test_the_bindings_over_a_driver(tmp_path: Path) -> None:
    """Arguments are converted as the driver wants them: a driver in C copies memory and launches kernels on this processor."""
    made = [shutil.which("gcc") or COMPILER, "-shared", "-fPIC", "-w", str(HERE / "cuda_driver.c"), "-o", str(tmp_path / "libcuda.so.1"), "-ldl"]
    subprocess.run([str(word) for word in made], check=True)
    places = [str(tmp_path), os.environ.get("LD_LIBRARY_PATH", "")]
    paths = [str(HERE.parent), os.environ.get("PYTHONPATH", "")]
    changed = {"LD_LIBRARY_PATH": ":".join(places), "PYTHONPATH": ":".join(paths), "TAILGATE_CACHE": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, "-c", PLAY], env=os.environ | changed, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.splitlines() == ["Driver's card {'registers': 4, 'local': 3} 16", "out of memory"]


def text_of(**arguments: Any) -> str:
    decide = SeatPrograms(Seat.make(**arguments), device="cuda").decide
    assert isinstance(decide, CudaProgram)
    return decide.text


PROGRAMS = [
    {"scenario": "gusty-stop-and-go-v0", "defence": "chi2_kf"},
    {"scenario": "platoon-gusty-v0", "defence": "chi2_dkf"},
    {"scenario": "network-noisy-v0", "defence": "dkf", "reward": "error"},
]
THOSE = [pytest.param(one, marks=[pytest.mark.long] if i else [], id=f"{one['scenario']}, {one['defence']}") for i, one in enumerate(PROGRAMS)]


@needs_compiler
@pytest.mark.parametrize("arguments", THOSE)
def test_nothing_is_contracted(arguments: dict[str, Any], host_card: HostCard, tmp_path: Path) -> None:
    """PTX has no fused multiply-add, no approximation, no flush to zero, and both kernels."""
    nvcc = shutil.which("nvcc")
    if nvcc is None:
        pytest.skip("no nvcc")
    source, out = tmp_path / "step.cu", tmp_path / "step.ptx"
    source.write_text(text_of(**arguments))
    options = ["--fmad=false", "--prec-div=true", "--prec-sqrt=true", "--ftz=false", "-arch=sm_80", "-w"]
    subprocess.run([nvcc, "-ptx", *options, str(source), "-o", str(out)], check=True)
    text = out.read_text()
    assert all(f".entry {name}" in text for name in ("play_step", "play_steps"))
    assert re.search(r"\bmul(\.rn)?\.f64", text) and not re.search(r"fma|mad\.f|\.approx|\.ftz", text)


@needs_bindings
@needs_compiler
@pytest.mark.parametrize("arguments", THOSE)
def test_the_compiler_of_the_bindings(arguments: dict[str, Any], host_card: HostCard) -> None:
    """Machine code for a card, without one."""
    from tailgate.engine import nvidia

    try:
        nvidia._compiler_version()
    except RuntimeError:
        pytest.skip("NVIDIA's compiler is not installed")
    code = nvidia.compiled(text_of(**arguments), ["--gpu-architecture=sm_90", *nvidia.OPTIONS])
    assert code[:4] == b"\x7fELF" and b"play_steps" in code
