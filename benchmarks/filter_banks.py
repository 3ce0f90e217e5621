"""Speed of banks of filters over 14 choose 2 subsets in the traced engine: filter updates a second, on one core.

    python benchmarks/filter_banks.py [--episodes 512]

The car has the seven sensors of `redundant` twice. A step of `kf_bank` updates 91 filters of three states, one of `observer_bank` 1092.
"""

import argparse
import dataclasses
import os
import time
from dataclasses import dataclass

import numpy as np

from tailgate.core import Array, Model, Sized
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.envs.sensors.odometry import OdometryPlan
from tailgate.envs.sensors.redundant import Redundant
from tailgate.evaluation.devices import untraced
from tailgate.play.trace import rollout

FILTERS = {"kf_bank:s=2": 91, "observer_bank:s=2": 91 + 1001}


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
    options = parser.parse_args()
    place = dataclasses.replace(load_scenario("redundant-two-v0"), sensor=Twice(), horizon=100)
    held, attack = keys("report", range(options.episodes)), Spec("attack", "none").make()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    for text, filters in FILTERS.items():
        begun = time.perf_counter()
        loop = place.loop(Spec("defence", text).make())
        rollout(loop, attack, held)
        made, runs = time.perf_counter() - begun, []
        for _ in range(3):
            begun = time.perf_counter()
            rollout(loop, attack, held)
            runs.append(loop.horizon * options.episodes / (time.perf_counter() - begun))
        why = untraced(loop)
        how = f"not traced: {why}" if why else "traced"
        print(f"{text}: {how}, first run {made:.0f} s; {max(runs):.3g} steps/s, {filters * max(runs) / 1e6:.3g} M updates/s", flush=True)


if __name__ == "__main__":
    main()
