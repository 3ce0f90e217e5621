"""The time of one gradient through whole episodes: by machine code, and by PyTorch.

    python benchmarks/gradients.py [--episodes 128]

Every step has false data of a fiftieth of the bound, but at most 0.05, so that few episodes end early.
One process; the best of three, or the first if it took more than 20 s.
A loop with operations that the engine cannot differentiate is played by PyTorch alone.
"""

import argparse
import time

import numpy as np

from tailgate.agents.scripts.triggers import Trigger
from tailgate.core import draws
from tailgate.core.loop import Loop
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.ensemble.gradient import gradient_of
from tailgate.ensemble.injection import Injection

CASES = (
    ("gusty-stop-and-go-v0", "kf"), ("gusty-stop-and-go-v0", "imm"), ("radar-braking-v0", "chi2_kf"), ("road-following-v0", "kf"),
    ("lane-keeping-v0", "chi2_kf"), ("redundant-two-v0", "chi2_kf"), ("platoon-gusty-v0", "dkf"),
    ("platoon-gusty-v0", "chi2_dkf"), ("network-restless-v0", "dkf"),
)  # fmt: skip
LONG = 20.0  # seconds of a gradient that is not taken again


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=128, help="episodes of each gradient")
    episodes = parser.parse_args().episodes
    print("| loop | steps | by PyTorch | by machine code |\n| --- | --- | --- | --- |")
    for scenario, defence in CASES:
        place, spec = load_scenario(scenario).with_threat(kinds=("fdi",), onset=2, end=None, budget=None), Spec("defence", defence)
        loop = place.loop(spec.make(), spec.entry.uses)
        own = Injection(loop, Trigger())
        fast = f"{seconds(loop, episodes, own):.2f} s" if own.compiled else "no rule"
        slow = seconds(loop, episodes, Injection(loop, Trigger(), compiled=False))
        print(f"| `{scenario}`, `{defence}` | {loop.horizon} | {slow:.2f} s | {fast} |", flush=True)


def seconds(loop: Loop, episodes: int, injection: Injection) -> float:
    brief = loop.brief
    value = np.where(brief.granted, np.minimum(0.02 * brief.bounds, 0.05), 0.0)
    sent, keys, took = np.broadcast_to(value, (loop.horizon, *value.shape)).copy(), draws.keys("tune", range(episodes)), []
    for _ in range(3):
        begin = time.perf_counter()
        gradient_of(injection, keys, sent, None)
        took.append(time.perf_counter() - begin)
        if took[0] > LONG:
            break
    return min(took)


if __name__ == "__main__":
    main()
