"""String stability (1.18) of a platoon: a disturbance of the leader's speed does not grow along the string.

    |V_i(jw) / V_0(jw)| <= 1 for every frequency w and every car i

`transfer` and `peak` compute with the public model of the closed loop in continuous time. `sweep` measures in the loop of a scenario, with
its sensors, its limits, a defence and an attack. These formulas are for readers and tests; they are not part of the scored path.

    python -m tailgate.thesis.string_stability --out docs/images/string-stability.png
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.files import write_atomic
from tailgate.base.plots import canvas, png
from tailgate.core import Array, draws
from tailgate.core.draws import Role
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.envs.controllers.cacc import PER_CAR, Column, Law
from tailgate.envs.manoeuvres import Sine
from tailgate.envs.plants.platoon import String, closed_loop

SLOWEST, FASTEST = 1e-3, 1e2  # [rad/s]
TOLERANCE = 1e-9  # by which a gain may be above 1: rounding


class Peak(NamedTuple):
    """The largest gain of each car (N,) and the frequency [rad/s] (N,) at which it is reached: 1 at 0 where none is larger."""

    gain: Array
    frequency: Array

    @property
    def stable(self) -> bool:
        """No car's gain is above 1."""
        return bool(self.gain.max() <= 1.0 + TOLERANCE)


class Sweep(NamedTuple):
    """The response of a loop to a leader that accelerates as a sine; (W,) frequencies, (W, N) RMS of each car over the leader's."""

    frequency: Array  # [rad/s], such that a period is a whole number of steps
    speed: Array  # RMS of the speed about its mean
    accel: Array  # RMS of the acceleration
    collided: Array  # (W,) share of the episodes


def transfer(plant: String, law: Law, frequency: Array, local: bool = False) -> Array:
    """Return V_i / V_0 (W, N), complex, at frequencies (W,) [rad/s]. `local`: without V2V messages."""
    A, B, _ = closed_loop(law.gains(plant.hears(), law.headway, local), plant.tau)
    s = 1j * np.asarray(frequency, np.float64)[:, None, None] * np.eye(len(A))
    x = np.linalg.solve(s - A, np.broadcast_to(B[:, None].astype(complex), (len(s), len(B), 1)))[..., 0]
    speeds = x[:, [Column.speed(i) for i in range(plant.size[0])]]
    return np.asarray(speeds / speeds[:, :1])


def growth(plant: String, law: Law, local: bool = False) -> float:
    """Return the largest real part [1/s] of the closed loop's eigenvalues without the leader's two integrators; below 0: stable."""
    A, _, _ = closed_loop(law.gains(plant.hears(), law.headway, local), plant.tau)
    cars = [slice(2, 3), *(slice(Column.gap(i), Column.gap(i) + PER_CAR) for i in range(1, plant.size[0]))]
    if any(A[car, car.stop :].any() for car in cars):
        return float(np.linalg.eigvals(A[2:, 2:]).real.max())
    # no car acts on those ahead: the whole matrix, of nearly equal eigenvalues, would give them with large errors
    return float(max(np.linalg.eigvals(A[car, car]).real.max() for car in cars))


def peak(plant: String, law: Law, local: bool = False) -> Peak:
    """Return the supremum over frequency of every car's gain. Raises InputError for a loop that is not stable."""
    if growth(plant, law, local) >= 0.0:
        raise InputError(f"law {type(law).__name__}", law, "gains with which the closed loop is stable")
    grid = np.geomspace(SLOWEST, FASTEST, 2000)
    coarse = np.abs(transfer(plant, law, grid, local))
    gain, where = np.ones(coarse.shape[1]), np.zeros(coarse.shape[1])  # the gain at frequency 0
    for i in range(1, len(gain)):
        best = int(np.argmax(coarse[:, i]))
        low, high = math.log(grid[max(best - 1, 0)]), math.log(grid[min(best + 1, len(grid) - 1)])

        def at(point: float, i: int = i) -> float:
            return float(np.abs(transfer(plant, law, np.array([math.exp(point)]), local))[0, i])

        point = _maximum(at, low, high)
        if at(point) > 1.0 + TOLERANCE:
            gain[i], where[i] = at(point), math.exp(point)
    return Peak(gain, where)


def _maximum(f: Callable[[float], float], low: float, high: float) -> float:
    """Return where f has its only maximum between low and high, by golden section."""
    ratio = (math.sqrt(5.0) - 1.0) / 2.0
    a, b = high - ratio * (high - low), low + ratio * (high - low)
    fa, fb = f(a), f(b)
    for _ in range(40):
        if fa > fb:
            high, b, fb = b, a, fa
            a = high - ratio * (high - low)
            fa = f(a)
        else:
            low, a, fa = a, b, fb
            b = low + ratio * (high - low)
            fb = f(b)
    return 0.5 * (low + high)


def sweep(
    scenario: Scenario,
    frequencies: Sequence[float],
    defence: str = "dkf",
    attack: str = "none",
    *,
    amplitude: float = 0.5,
    settle: float = 60.0,
    periods: int = 4,
    seeds: int = 1,
) -> Sweep:
    """Measure gains in the loop of a scenario, whose manoeuvre a sine of each frequency [rad/s] replaces.

    The first `settle` seconds are left out, then `periods` whole periods are taken. Defence and attack act as they do in an evaluation,
    within the scenario's threat model.
    """
    driver, spec = Spec("defence", defence), Spec("attack", attack)
    out = []
    for wanted in frequencies:
        period = max(2, round(2.0 * math.pi / (wanted * scenario.plant.dt)))
        before, steps = round(settle / scenario.plant.dt), periods * period
        hertz = 1.0 / (period * scenario.plant.dt)
        here = dataclasses.replace(scenario, manoeuvre=Sine(amplitude, hertz), horizon=before + steps, ends_on_collision=False)
        loop, attacker = here.loop(driver.make(), driver.entry.uses), spec.make()
        state, plan = loop.start(draws.keys("tune", range(seeds))), attacker.prepare(loop.brief)
        memory = attacker.start(plan, seeds, state.keys.at(Role.ATTACK, np.zeros(seeds, np.int64)))
        speed, accel = (np.zeros((steps, seeds, loop.model.agents)) for _ in range(2))
        hit = np.zeros(seeds, bool)
        for k in range(before + steps):
            state, memory, frame = loop.step(state, attacker, plan, memory)
            hit |= frame.collided
            if k >= before:
                speed[k - before], accel[k - before] = frame.scene.speed, frame.scene.accel
        speed -= speed.mean(axis=0)
        power = [np.sqrt((x * x).mean(axis=(0, 1))) for x in (speed, accel)]
        out.append((2.0 * math.pi * hertz, power[0] / power[0][0], power[1] / power[1][0], hit.mean()))
    return Sweep(*(np.array(column) for column in zip(*out, strict=True)))


LAWS = ("cacc", "ploeg_cacc", "consensus_cacc", "cacc:weights=[1,1]", "cacc:kp=0.05,kd=0.3,weights=[1,1]")  # of the picture
LATE, LOST = "delay:age=20", "burst_loss:fail=0.05,recover=0.02"
SLIDING = "composed:filter=dkf,detector=score,mitigation=sliding_mode,mitigation.when=always"
CASES = (  # law, defence, attack, style
    ("cacc", "dkf", "none", "o-C0"), ("cacc", "dkf", LATE, "o--C0"), ("ploeg_cacc", "dkf", "none", "s-C1"),
    ("ploeg_cacc", "dkf", LATE, "s--C1"), ("ploeg_cacc", "dkf", LOST, "s:C1"), ("ploeg_cacc", SLIDING, LATE, "^-C2"),
)  # fmt: skip


def figure() -> bytes:
    """Draw gains over frequency: of the laws, with and without messages, and measured, under attack too."""
    scenario, w = load_scenario("platoon-v2v-v0"), np.geomspace(0.02, 5.0, 300)
    paper, axes = canvas(11.0, 4.8, 1, 2, sharey=True)
    left, right = axes[0]
    for colour, text in enumerate(LAWS):
        for line, local in (("-", False), (":", True)):
            if not local or ":" not in text:
                gains = np.abs(transfer(scenario.plant, Spec("controller", text).make(), w, local))
                left.plot(w, gains[:, 1:].max(axis=1), line, color=f"C{colour}", label=text + (", no messages" if local else ""))
    left.set(title="by the model: the largest gain of four followers", ylabel="$|V_i / V_0|$")
    granted = scenario.with_threat(onset=1, kinds=("dropout", "delay"))
    for law, defence, attack, style in CASES:
        driven = dataclasses.replace(granted, controller=Spec("controller", law).make())
        found = sweep(driven, np.geomspace(0.08, 1.5, 8).tolist(), defence, attack, amplitude=1.0, settle=40.0, periods=3)
        name = "sliding_mode always" if defence == SLIDING else defence
        right.plot(found.frequency, found.speed[:, -1], style, markersize=4, linewidth=1.0, label=f"{law}, {name}, {attack}")
    right.set(title="measured: the last car of platoon-v2v-v0")
    for ax in (left, right):
        ax.axhline(1.0, color="grey", linewidth=0.8)
        ax.set(xscale="log", xlabel="frequency [rad/s]", ylim=(0.0, 3.8))
        ax.grid(alpha=0.3, which="both")
        ax.legend(fontsize=7, loc="upper left" if ax is right else "upper right")
    return png(paper)


def main() -> None:
    """Write the picture of the gains over frequency."""
    parser = argparse.ArgumentParser(description="Writes the picture of the gains over frequency.")
    parser.add_argument("--out", type=Path, default=Path("docs/images/string-stability.png"))
    write_atomic(parser.parse_args().out, figure())


if __name__ == "__main__":
    main()
