"""Speed of the related systems in the traced engine, on one core: steps a second, and filter updates a second of the banks.

    python benchmarks/filter_banks.py [--episodes 512] [--out benchmarks/results/filter_banks.json]
    python benchmarks/filter_banks.py --caps

The second line counts in how many periods `rounds` ends the iteration of `etpg` and `etpl`, and writes nothing.

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
from tailgate.core import Array, Model, Prior, Received, Sized
from tailgate.core.draws import Role, keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.envs.sensors.odometry import OdometryPlan
from tailgate.envs.sensors.redundant import Redundant
from tailgate.estimators.sparse_attacks.projected import Etpg, Etpl, ProjectedGradient
from tailgate.estimators.sparse_attacks.window import centred
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
    parser.add_argument("--caps", action="store_true", help="only how often `rounds` ends the iteration of etpg and etpl")
    options = parser.parse_args()
    if options.caps:
        for defence in (Etpg(s=2), Etpg(s=2, window=10), Etpl(s=2), Etpl(s=2, window=10)):
            for lie in (0.0, -1.0, -30.0):
                print(json.dumps(capped(defence, lie)), flush=True)
        return
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


def capped(defence: ProjectedGradient, lie: float, episodes: int = 200, steps: int = 100) -> dict[str, Any]:
    """Return in which share of periods `rounds` ends the iteration: readings of the model, the two most accurate sensors with a lie."""
    model, rng = load_scenario("redundant-two-v0").brief().model, np.random.default_rng(0)
    plan, n, q = defence.prepare(model), model.states, len(model.sensors)
    state = defence.start(plan, Prior(np.zeros((episodes, 1, n)), np.tile(np.eye(n), (episodes, 1, 1, 1))))
    x, u, held = np.zeros((episodes, 1, n)), np.zeros((episodes, 1, model.inputs)), keys("tune", range(episodes))
    noise, sd = np.linalg.cholesky(model.Q), np.sqrt(model.R[0].diagonal())
    liars = np.argsort(sd)[:2]
    over: list[Array] = []
    for k in range(steps):
        x = x @ model.A.T + model.c + rng.standard_normal(x.shape) @ noise.T
        y = x @ model.C[0].T + sd * rng.standard_normal((episodes, 1, q)) + lie * np.isin(np.arange(q), liars)
        draws, before = held.at(Role.DEFENCE, np.full(episodes, k)), state.own
        state, _ = defence.step(plan, state, Received(y, np.ones(y.shape, bool), np.zeros((episodes, 1))), u, draws)
        window = centred(plan.window, state.window)
        over.append((defence.search(plan, before, window).energy > plan.own.eps)[window.full])
    name = f"{defence.name}:s={defence.s},window={plan.window.O.shape[2]}"
    return {"defence": name, "lie": lie, "rounds": defence.rounds, "ended by rounds": float(f"{np.concatenate(over).mean():.3g}")}


if __name__ == "__main__":
    main()
