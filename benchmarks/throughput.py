"""Steps per second of the plain batched loop and of its faces, medians of interleaved repeats; one core.

    python benchmarks/throughput.py [--out benchmarks/results/throughput.json]

A step is one episode's step: leader, two noisy measurements, attack, gated Kalman filter with its covariance, controller,
plant, driver behind, random numbers included. Absolute rates move with the machine; ratios taken in one run hold.
"""

import argparse
import json
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np

import tailgate
from tailgate import draws
from tailgate.core import Command
from tailgate.registry import Spec
from tailgate.scenario import load_scenario

EPISODES = 4096
SCENARIO = "stop-and-go-v0"


def plain_loop(defence: str, episodes: int, steps: int) -> Callable[[], int]:
    """The loop alone, with the scripted injection as attack."""
    spec = Spec("defence", defence)
    place = load_scenario(SCENARIO)
    loop = place.loop(spec.make(), spec.entry.uses)
    attack = Spec("attack", "fdi:value=-4").make()
    plan = attack.prepare(loop.brief)

    def go() -> int:
        state = loop.start(draws.keys("tune", range(episodes)))
        memory = attack.start(plan, episodes, state.keys.at(draws.Role.ATTACK, state.k))
        for _ in range(steps):
            state, memory, _ = loop.step(state, attack, plan, memory)
        return episodes * steps

    return go


def advance_only(episodes: int, steps: int) -> Callable[[], int]:
    """The loop without an attack's own computation."""
    loop = load_scenario(SCENARIO).loop(Spec("defence", "chi2_kf").make())
    state = loop.start(draws.keys("tune", range(episodes)))
    brief = loop.brief
    none = brief.command(np.zeros(episodes, bool), 0, np.zeros(len(brief.model.wires), bool), 0.0)
    command = Command(*none)

    def go() -> int:
        current = state
        for _ in range(steps):
            current, _ = loop.advance(current, command)
        return episodes * steps

    return go


def vector_env(episodes: int, steps: int) -> Callable[[], int]:
    env = gymnasium.make_vec("tailgate:tailgate/CarFollowing-v0", num_envs=episodes, scenario=SCENARIO, defence="chi2_kf")
    env.reset(seed=0)
    actions = np.random.default_rng(0).integers(env.single_action_space.n, size=(steps, episodes))

    def go() -> int:
        for row in actions:
            env.step(row)
        return episodes * steps

    return go


def single_env(steps: int) -> Callable[[], int]:
    env = gymnasium.make("tailgate:tailgate/CarFollowing-v0", scenario=SCENARIO, defence="chi2_kf")
    env.reset(seed=0)

    def go() -> int:
        for _ in range(steps):
            _, _, terminated, truncated, _ = env.step(0)
            if terminated or truncated:
                env.reset()
        return steps

    return go


def measure(repeats: int) -> dict[str, float]:
    """Median steps per second of each form, repeats interleaved."""
    forms = {
        f"advance, chi2_kf, {EPISODES} episodes": advance_only(EPISODES, 50),
        f"loop with attack, chi2_kf, {EPISODES} episodes": plain_loop("chi2_kf", EPISODES, 50),
        f"loop with attack, kf, {EPISODES} episodes": plain_loop("kf", EPISODES, 50),
        f"loop with attack, none, {EPISODES} episodes": plain_loop("none", EPISODES, 50),
        "loop with attack, chi2_kf, 256 episodes": plain_loop("chi2_kf", 256, 200),
        f"make_vec, chi2_kf, {EPISODES} environments": vector_env(EPISODES, 50),
        "make, chi2_kf": single_env(300),
    }  # fmt: skip
    rates: dict[str, list[float]] = {name: [] for name in forms}
    for _, go in forms.items():
        go()  # compile, fill caches
    for _ in range(repeats):
        for name, go in forms.items():
            started = time.perf_counter()
            steps = go()
            rates[name].append(steps / (time.perf_counter() - started))
    return {name: statistics.median(values) for name, values in rates.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=7, help="repeats of each form")
    parser.add_argument("--out", type=Path, help="also write the record to this file")
    options = parser.parse_args()
    figures = measure(options.repeats)
    for name, rate in figures.items():
        print(f"{name:<50} {rate / 1e6:8.3f} M steps/s")
    if options.out:
        commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
        record = {
            "steps_per_second": {name: round(rate) for name, rate in figures.items()}, "repeats": options.repeats, "commit": commit,
            "version": tailgate.__version__, "machine": platform.machine(), "python": platform.python_version(), "numpy": np.__version__,
        }  # fmt: skip
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
