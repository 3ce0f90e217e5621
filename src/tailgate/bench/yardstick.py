"""The yardstick: car following with the gated Kalman filter in C, compiled on the spot, as the limit of what a step can do.

`whole` does what the loop does on stop-and-go-v0 with `chi2_kf`; `bare` leaves out process noise and the driver behind. Both are held to
the Python loop by a test. -fno-math-errno and -fno-trapping-math let the compiler vectorise and change no value; there is no fast-math.
"""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
import tempfile
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array
from tailgate.core.draws import Role, keys
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.envs.controllers import idm
from tailgate.envs.gym.rewards import NEAR, Reward

from .lines import Go, Missing, repeated

FLAGS = ("-O3", "-march=native", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")
SCENARIO, ETA = "stop-and-go-v0", 20.0
LANES, WORDS, REACTION = 64, 3, 10
ROW = {  # rows of a block that others read, by their place in `enum row`
    name: i for i, name in enumerate((
        "x", "v", "a", "lead_x", "lead_v", "phase", "clock", "est_x", "est_v", "est_a", "p00", "p01", "p02", "p11", "p12", "p22", "u", "y0",
        "y1", "least", "potential", "reward", "rear_x", "rear_v",
    ))
}  # fmt: skip
Form = Literal["whole", "bare"]


def compiler() -> str:
    """Return the first line of the compiler's version. Raises Missing where there is no compiler."""
    name = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if name is None:
        raise Missing("no C compiler: the yardstick needs cc, gcc or clang")
    done = subprocess.run([name, "--version"], capture_output=True, text=True, check=False)
    return (done.stdout.splitlines() or [Path(name).name])[0]


@cache
def library() -> ctypes.CDLL:
    """Compile the yardstick. Raises Missing where there is no compiler, or where it fails."""
    _ = compiler()
    name = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    assert name is not None
    with tempfile.TemporaryDirectory(prefix="tailgate-") as folder:
        source, out = Path(folder) / "yardstick.c", Path(folder) / "yardstick.so"
        source.write_bytes(files("tailgate.bench").joinpath("yardstick.c").read_bytes())
        done = subprocess.run([name, *FLAGS, str(source), "-o", str(out), "-lm"], capture_output=True, text=True, check=False)
        if done.returncode:
            raise Missing(f"the C compiler refuses the yardstick: {' '.join(done.stderr.split())[:200]}")
        held = ctypes.CDLL(str(out))  # stays loaded when the file is gone
    array, whole = ctypes.c_void_p, ctypes.c_int64
    for form in ("whole", "bare"):
        getattr(held, f"{form}_start").argtypes = [whole, array, array, array]
        getattr(held, f"{form}_start").restype = None
        getattr(held, form).argtypes = [whole, whole, whole, array, array, array, array]
        getattr(held, form).restype = whole
    held.rows.restype = held.constants.restype = whole
    return held


def constants(scenario: Scenario) -> Array:
    """Return the numbers of a scenario in the order of `enum constant`."""
    plant, acc, road = scenario.plant, scenario.controller, scenario.manoeuvre
    model, reward = scenario.brief().model, Reward()
    A, B = model.A, model.B
    out = [
        plant.dt, A[0, 2], A[1, 2], A[2, 2], B[0, 0], B[1, 0], B[2, 0], *np.sqrt(np.array(plant.process_var)), *model.Q.diagonal(),
        *model.R[0].diagonal(), *np.sqrt(np.array(scenario.sensor.noise_var)), *plant.prior_var, ETA,
        plant.position, plant.speed, plant.accel, plant.gap, plant.lead_speed,
        acc.headway, acc.standstill, acc.gamma, acc.set_speed, acc.accel_min, acc.accel_max, *road.cruise,
        *road.dwell, road.decel, road.accel_rate, road.low_speed, road.cruise_speed, idm.IDM_SPEED, idm.IDM_HEADWAY, idm.IDM_GAP,
        idm.IDM_ACCEL, 2.0 * math.sqrt(idm.IDM_ACCEL * idm.IDM_DECEL), idm.IDM_BRAKE, reward.gap_shaping, reward.error_shaping,
        reward.gamma, NEAR, scenario.horizon, *(role << 16 for role in (Role.PROCESS, Role.SENSOR, Role.MANOEUVRE)),
    ]  # fmt: skip
    return np.array(out, np.float64)


class Yardstick:
    """n episodes (a multiple of 64) of `whole` or `bare`; `bias` (2, horizon + 1) is added to the readings by step."""

    def __init__(self, form: Form, seeds: range, scenario: Scenario | None = None, bias: Array | None = None) -> None:
        scenario = load_scenario(SCENARIO) if scenario is None else scenario
        if len(seeds) % LANES or round(scenario.plant.rear_reaction / scenario.plant.dt) != REACTION:
            wanted = f"a multiple of {LANES} episodes, and a driver behind who reacts {REACTION} steps late"
            raise InputError("yardstick", scenario.name, wanted)
        self.form, self.blocks, self.constants, self._held = form, len(seeds) // LANES, constants(scenario), library()
        assert len(self.constants) == self._held.constants()
        self.state = np.zeros((self.blocks, self._held.rows(), LANES))
        self.words = np.zeros((self.blocks, WORDS, LANES), np.uint64)
        self.words[:, 0] = keys("tune", seeds).key[:, 0].reshape(self.blocks, LANES)
        self.table = np.ascontiguousarray(np.zeros((2, scenario.horizon + 1)) if bias is None else bias, np.float64)
        self.done = 0
        getattr(self._held, f"{form}_start")(self.blocks, *self._addresses()[:3])

    def _addresses(self) -> tuple[int, ...]:
        return tuple(part.ctypes.data for part in (self.state, self.words, self.constants, self.table))

    def run(self, steps: int) -> int:
        """Play `steps` of every episode; return how many episodes ended, and began again."""
        ended = getattr(self._held, self.form)(self.blocks, self.done, steps, *self._addresses())
        self.done += steps
        return int(ended)

    def row(self, name: str) -> Array:
        """Return (n,) a row of the state by its name in ROW."""
        return self.state[:, ROW[name]].reshape(-1)


def injection(scenario: Scenario, value: float, first: int, last: int) -> Array:
    """Return (2, horizon + 1) the bias of both readings by step."""
    bias = np.zeros((2, scenario.horizon + 1))
    bias[:, first : last + 1] = value
    return bias


def line(form: Form, episodes: int) -> Go:
    """Measure steps per second of the yardstick, under the injection that the loop is measured with."""
    scenario = load_scenario(SCENARIO)
    held = Yardstick(form, range(episodes), scenario, injection(scenario, -4.0, 50, 500))

    def chunk() -> int:
        held.run(20)
        return 20 * episodes

    return repeated(chunk)
