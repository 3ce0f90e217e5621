"""Each id whose name ends in -v1: random actions, the best listed script, and Stable-Baselines3's PPO with a recipe of ten lines.

    python benchmarks/teaching.py [--id tailgate/CarFollowing-v1] [--seeds 3] [--out benchmarks/results]

Damage is a collision or a left lane; in the network, where nothing drives, it is the return. All figures are of the same fresh episodes.
Writes teaching.json. Needs `pip install 'tailgate[train]'`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO

from tailgate.agents.learners.learning import SEED_STRIDE
from tailgate.base.errors import NotApplicable
from tailgate.base.files import write_atomic
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario, load_suite
from tailgate.envs.gym.attacker_mdp import FACES
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.envs.gym.sb3 import BatchVecEnv
from tailgate.play.metrics import measure
from tailgate.play.trace import rollout

EPISODES, FIRST = 400, 500_000  # fresh ones: no training begins there
DECISIONS = {"Platoon": 60_000, "SensorNetwork": 30_000, "RadarFollowing": 100_000}  # of a training; others: 150 000
SUITES = {"CarFollowing": "car-following-v0", "RadarFollowing": "radar-v0", "Platoon": "platoon-v0", "LaneKeeping": "lane-v0"}


def kind(name: str) -> str:
    """Return the kind of system of an id."""
    return name.removeprefix("tailgate/").removesuffix("-v1").removesuffix("Continuous")


def damage(name: str, act: Callable[[AdversaryVectorEnv, Any], Any]) -> float:
    """Play fresh episodes; return the share that is damaged, or the mean return where nothing drives."""
    env = AdversaryVectorEnv(EPISODES, autoreset="disabled", **FACES[name])
    env.action_space.seed(0)
    seen, _ = env.reset(seed=FIRST)
    total, damaged, over = np.zeros((3, EPISODES))
    for _ in range(env.horizon):
        seen, reward, terminated, truncated, _ = env.step(act(env, seen))
        total += reward * (over == 0)
        damaged += terminated & (over == 0)
        over += terminated | truncated
        env.over = np.zeros(EPISODES, bool)  # rows that are over play on, and count no more
    return float(total.mean() if kind(name) == "SensorNetwork" else damaged.mean())


def learned(name: str, seed: int) -> tuple[float, float]:
    """Train with Stable-Baselines3's defaults in batches that suit a vector environment; return the damage and the seconds."""
    begun = time.perf_counter()
    env = BatchVecEnv(64, name, horizon_ends=True)
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=1024, learning_rate=1e-3, seed=seed, device="cpu")
    env.seed(seed * SEED_STRIDE)  # else the rows of two trainings would share episodes
    model.learn(DECISIONS.get(kind(name), 150_000))
    took = time.perf_counter() - begun
    return damage(name, lambda _, seen: model.predict(seen, deterministic=True)[0]), took


def scripted(name: str) -> tuple[float, str]:
    """Return the damage of the best listed script under the id's threat model, and the script; the best on these very episodes."""
    face, best = FACES[name], (0.0, "none")
    if kind(name) not in SUITES:
        return best
    loop = load_scenario(face["scenario"]).with_threat(**face["threat"]).loop(Spec("defence", face["defence"]).make())
    for text in load_suite(SUITES[kind(name)]).attacks:
        spec = Spec("attack", text)
        if spec.entry.knowledge == "white" or text.startswith("zoo"):
            continue
        try:
            played = measure(rollout(loop, spec.make(), keys("train", [FIRST + i for i in range(EPISODES)])))
        except NotApplicable:
            continue
        best = max(best, (float(np.maximum(played["collided"], played["rear_collided"]).mean()), text))
    return best


def line(name: str, entry: dict[str, Any]) -> str:
    """Return the line of an id in docs/environment.md."""
    shown = "{:.1f}" if kind(name) == "SensorNetwork" else "{:.0%}"
    ppo = ", ".join(shown.format(share) for share in entry["ppo"])
    script = shown.format(entry["script"]) if kind(name) in SUITES else "-"
    face = FACES[name]
    task = f"`{face['scenario']}`, `{face['defence']}`, {', '.join(face['threat'].get('kinds', ['all kinds']))}"
    task += f", {face['threat']['budget']} steps; {face['interval']} a decision"
    return f"| `{name}` | {task} | {shown.format(entry['random'])} | {script} | {ppo} | {max(entry['seconds']):.0f} s |"


def main() -> None:
    """Measure, print a line for each id and write the record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = [name for name in FACES if name.endswith("-v1")]
    parser.add_argument("--id", choices=names, action="append", help="measure this id; may be repeated")
    parser.add_argument("--seeds", type=int, default=3, help="trainings for each id")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    asked = parser.parse_args()
    torch.set_num_threads(1)
    record = {}
    for name in asked.id or names:
        chance = damage(name, lambda env, _: env.action_space.sample())
        rest = damage(name, lambda env, _: np.zeros(env.action_space.shape, env.action_space.dtype) - (env.action_space.dtype.kind == "f"))
        share, text = scripted(name)
        runs = [learned(name, seed) for seed in range(asked.seeds)]
        record[name] = {
            "rest": rest, "random": chance, "script": share, "text": text, "ppo": [run[0] for run in runs],
            "seconds": [round(run[1], 1) for run in runs],
        }  # fmt: skip
        print(f"{name:36} {json.dumps(record[name])}", flush=True)
    write_atomic(asked.out / "teaching.json", (json.dumps(record, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
