"""Recorded leaders: each episode drives another window of a recording, and no second serves two purposes of seeds.

A recording is cut into blocks, counted in steps: the rule holds for one step and one length of block. The purposes of seeds own the blocks
in turn: train, report, select, tune, calibrate, train, ... An episode's window begins at a random step of a block of its purpose and ends
in the same block.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, param
from tailgate.core.draws import PURPOSES, Draws, purpose_of
from tailgate.core.registry import register
from tailgate.core.traces import cards, trace
from tailgate.envs.manoeuvres import read_profile, resampled, towards

WHERE = "manoeuvre recorded"
TURNS = ("train", "report", "select", "tune", "calibrate")  # who owns the blocks, in this order over and over
Seconds = Annotated[float, Field(ge=1.0, le=1e5, allow_inf_nan=False)]


class RecordedPlan(NamedTuple):
    dt: float
    length: int  # steps of a window
    speed: Array  # (K,) [m/s] of all recordings, one after the other, dt apart
    begins: Array  # (S,) steps at which a window may begin, purpose by purpose
    first: Array  # (5,) place of each purpose's first step in `begins`
    sizes: Array  # (5,) float: how many it has


class RecordedState(NamedTuple):
    at: Array  # (B,) int64 step of `speed` at which the window begins


@dataclass(frozen=True)
class Block:
    """A part of a recording: steps [first, last] of the joined speeds, for one purpose."""

    recording: str
    purpose: str
    first: int
    last: int


@register("manoeuvre", "recorded", reference="Makridis et al., OpenACC, Transportation Research Part C 125, 2021")
@dataclass(frozen=True)
class Recorded:
    """Follows a window of a recorded drive, another one in each episode; constant speed after its end.

    Report seeds never meet a second of a recording that train, tune, select or calibrate seeds meet, nor these each other.
    """

    traces: tuple[str, ...] = param(("asta-leader",), "recordings of the package (tailgate list traces)")
    path: Path | None = param(None, "CSV file with times [s] and speeds [m/s], one more recording; none: none")
    window: Seconds = param(60.0, "length of a window [s]")
    block: Seconds = param(120.0, "length of a block, the windows of which serve one purpose [s]")

    def __post_init__(self) -> None:
        if self.window > self.block:
            raise InputError(f"{WHERE}.window", self.window, f"at most the block ({self.block:g} s)")
        if not self.traces and self.path is None:
            raise InputError(f"{WHERE}.traces", self.traces, "a recording")
        drives = [cards()[name].drive for name in self.traces if name in cards()]
        if len(set(drives)) < len(drives):  # two copies of a second could serve two purposes
            raise InputError(f"{WHERE}.traces", self.traces, "recordings of different drives")

    def recordings(self) -> list[tuple[str, Array, Array]]:
        """Return names, times [s] and speeds [m/s] of the recordings."""
        out = []
        for name in self.traces:
            columns = trace(name, f"{WHERE}.traces")
            if "speed1" not in columns:
                raise InputError(f"{WHERE}.traces", name, "a recording with the leader's speed")
            out.append((name, columns["t"], columns["speed1"]))
        if self.path is not None:
            out.append((self.path.name, *read_profile(self.path, f"{WHERE}.path")))
        return out

    def blocks(self, dt: float) -> tuple[Array, list[Block]]:
        """Return the joined speeds (K,) [m/s], dt [s] apart, and their blocks."""
        length, size = round(self.window / dt), round(self.block / dt)
        if length < 1:
            raise InputError(f"{WHERE}.window", self.window, f"at least one step ({dt:g} s)")
        parts: list[Array] = []
        out: list[Block] = []
        at = 0
        for name, times, speeds in self.recordings():
            steps = math.floor((times[-1] - times[0]) / dt * (1.0 + 1e-12)) + 1
            parts.append(resampled(times, speeds, dt, steps))
            for first in range(0, steps, size + 1):
                last = min(first + size, steps - 1)
                if last - first >= length:
                    out.append(Block(name, TURNS[len(out) % len(TURNS)], at + first, at + last))
            at += steps
        if len(out) < len(TURNS):
            wanted = f"recordings of at least {len(TURNS)} blocks, one for each purpose of seeds; these have {len(out)}"
            raise InputError(f"{WHERE}.block", self.block, wanted)
        return np.concatenate(parts), out

    def prepare(self, dt: float) -> RecordedPlan:
        speed, blocks = self.blocks(dt)
        length = round(self.window / dt)
        begins = [
            np.concatenate([np.arange(b.first, b.last - length + 1) for b in blocks if b.purpose == purpose]) for purpose in PURPOSES
        ]
        count = np.array([len(some) for some in begins])
        return RecordedPlan(
            dt, length, speed, np.concatenate(begins), np.add.accumulate(np.array([0, *count[:-1]])), count.astype(np.float64)
        )

    def start(self, plan: RecordedPlan, draws: Draws) -> RecordedState:
        purpose = purpose_of(draws)
        count = num.take(plan.sizes, purpose)
        chosen = np.minimum(np.floor(draws.uniform() * count), count - 1.0).astype(np.int64)
        return RecordedState(num.take(plan.begins, num.take(plan.first, purpose) + chosen))

    def first_speed(self, plan: RecordedPlan, state: RecordedState) -> Array:
        """Return the speed (B,) [m/s] at the beginning of the window."""
        return num.take(plan.speed, state.at)

    def accel(self, plan: RecordedPlan, state: RecordedState, k: Array, speed: Array, draws: Draws) -> tuple[RecordedState, Array]:
        wanted = num.take(plan.speed, state.at + np.minimum(k + 1, plan.length))
        return state, towards(wanted, speed, plan.dt)
