"""Speed of the related systems in the traced engine, on one core: steps a second, and filter updates a second of the banks.

    python benchmarks/filter_banks.py [--episodes 512] [--out benchmarks/results/filter_banks.json]

One car has the seven sensors of `redundant` twice: a step of `kf_bank` updates 91 filters of three states, one of `observer_bank` 1092.
In the network each of ten agents has 14 sensors and 20 states. The others play `redundant-two-v0`. Writes the record.
"""

import argparse
import dataclasses
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.files import write_atomic
from tailgate.core import Array, Model, Sized
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.envs.sensors.odometry import OdometryPlan
from tailgate.envs.sensors.redundant import Redundant
from tailgate.evaluation.devices import untraced
from tailgate.play.trace import rollout

OTHERS = ("kf", "kf_bank:s=2", "observer_bank:s=2", "observer_bank:s=2,kind=gramian,window=10", "l1_decoder:s=2,window=10",
          "etpg:s=2,window=10", "etpl:s=2,window=10", "minimax:attacked=2", "bernoulli", "watermark")  # fmt: skip


@dataclass(frozen=True)
class Twice(Redundant):
    """Every device twice."""

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        names, C, R = super().matrices(plant)
        noise = np.tile(R[0].diagonal(), 2)
        return (*names, *(f"{name}_2" for name in names)), np.concatenate([C, C], axis=1), np.diag(noise)[None]

    def prepare(self, model: Model) -> OdometryPlan:
        return OdometryPlan(model.C[0], np.sqrt(model.R[0].diagonal()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=512, help="episodes played together")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/filter_banks.json"))
    options = parser.parse_args()
    load = os.getloadavg()[0]
    print(f"load {load:.1f} on {os.cpu_count()} cores")
    car = load_scenario("redundant-two-v0")
    twice = dataclasses.replace(car, sensor=Twice(), horizon=100)
    network = dataclasses.replace(load_scenario("network-restless-v0"), horizon=50)
    jobs = [("car, 14 sensors", twice, "kf_bank:s=2", 91), ("car, 14 sensors", twice, "observer_bank:s=2", 91 + 1001)]
    jobs += [("network, 14 sensors", network, "kf_bank:s=1", 10 * 14)]
    jobs += [("redundant-two-v0", dataclasses.replace(car, horizon=100), text, 0) for text in OTHERS]
    record = [timed(*job, options.episodes) | {"load": round(load, 1)} for job in jobs]
    write_atomic(options.out, (json.dumps(record, indent=1) + "\n").encode())


def timed(where: str, place: Scenario, text: str, filters: int, episodes: int) -> dict[str, Any]:
    """Play some episodes; return the best of three speeds."""
    held, attack = keys("report", range(episodes)), Spec("attack", "none").make()
    begun = time.perf_counter()
    loop = place.loop(Spec("defence", text).make())
    rollout(loop, attack, held)
    made, runs = time.perf_counter() - begun, []
    for _ in range(3):
        begun = time.perf_counter()
        rollout(loop, attack, held)
        runs.append(loop.horizon * episodes / (time.perf_counter() - begun))
    out = {
        "system": where, "defence": text, "why untraced": untraced(loop) or "", "first run [s]": round(made, 1),
        "steps/s": float(f"{max(runs):.3g}"), "filter updates/s": float(f"{filters * max(runs):.3g}"),
    }  # fmt: skip
    print(json.dumps(out), flush=True)
    return out


if __name__ == "__main__":
    main()
