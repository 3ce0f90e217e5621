"""What each learner makes of a few seconds: decisions per second, and the return of its policy; one thread, processor time.

    python benchmarks/results/learners/learners.py [--seconds 12] [--learner cem ...]

Prints the table of docs/learners.md. The task: `gusty-stop-and-go-v0` against `kf`, injection of 6 m and 6 m/s for 30 steps, one decision
every 30 steps, reward `min_gap`, defaults of the learners, training seed 0.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from tailgate.agents.learners.learning import LEARNERS, check_action, learner_of
from tailgate.agents.policy.network_policy import PolicyAttack
from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.rewards import NEAR, small
from tailgate.play.metrics import METRICS
from tailgate.studies.timing import played

TASK = {
    "scenario": "gusty-stop-and-go-v0", "defence": "kf", "threat": {"kinds": ["fdi"], "budget": 30, "fdi_bound": 6.0}, "interval": 30,
    "value": -6.0, "reward": "min_gap", "gap_shaping": 0.0, "error_shaping": 0.0,
}  # fmt: skip
EPISODES = 400


class Enough(Exception):
    """The time is up."""


def earned(environment, attack):
    """Mean return of fresh episodes: a collision, and how far the smallest gap falls below NEAR."""
    keys = draws.keys("tune", range(EPISODES))
    crashed, gap = played(Seat.make(**environment).loop, attack, keys, None, [METRICS["crashed"], METRICS["min_gap"]])
    return float(np.mean(crashed + (NEAR - small(gap)) / NEAR))


def line(name, environment, seconds):
    """Decisions, processor seconds and the return of one training."""
    module = learner_of(name)
    learner = module.Learner(0, 0.995, module.Config(), environment | {"horizon_ends": True}, None)
    begun = time.process_time()

    def report(now):
        if time.process_time() - begun > seconds:
            raise Enough

    try:
        learner.learn(10**9, report)
    except Enough:
        spent = time.process_time() - begun
    with tempfile.TemporaryDirectory() as folder:
        attack = PolicyAttack(learner.export(Path(folder) / "policy", {}))
        return learner.steps, spent, earned(environment, attack)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=12.0, help="processor time of each training (default 12)")
    parser.add_argument("--learner", nargs="+", choices=LEARNERS, default=list(LEARNERS))
    options = parser.parse_args()
    print("| learner | action | decisions/s | decisions | return |\n|---|---|---|---|---|")
    print(f"| none | rest | | | {earned(TASK, Spec('attack', 'none').make()):.2f} |")
    for name in options.learner:
        for action in ("mode", "continuous"):
            environment = TASK | {"action": action}
            try:
                check_action(name, Seat.make(**environment))
            except InputError:
                continue
            steps, spent, value = line(name, environment, options.seconds)
            print(f"| `{name}` | `{action}` | {steps / spent:,.0f} | {steps:,} | {value:.2f} |", flush=True)


if __name__ == "__main__":
    main()
