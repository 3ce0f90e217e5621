"""A watermark against replay, behind another car and in a lane: the statistic, the alarms and what it costs.

    python benchmarks/watermark.py [--episodes 200]

On stop-and-go-v0 the attacker replays 20 recorded steps from step 300 on, for 50 steps. On lane-keeping-v0 it replays 50 steps of all three
sensors from step 200 on, for 50 steps. `raised`: mean score of these steps over that of the clean run. `informs`: share of episodes with an
alarm in these steps, less that of the clean run at the same steps. Cost: RMS jerk, and the largest offset in the lane, of clean runs.
"""

import argparse

import numpy as np

from tailgate.core import Array
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.play.metrics import rms_jerk
from tailgate.play.trace import Trace, rollout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=200, help="episodes of each run")
    options = parser.parse_args()
    held = keys("report", range(options.episodes))
    road = load_scenario("stop-and-go-v0").with_threat(kinds=("replay",))
    lane = load_scenario("lane-keeping-v0").with_threat(kinds=("replay",), budget=None, targets=("lane_offset", "lane_heading", "yaw_rate"))
    for place, attack, sizes, window, cost, unit in (
        (road, "replay:start_step=300,length=50", (0.0, 0.3, 1.0, 3.0), slice(300, 349), rms_jerk, "jerk [m/s^3]"),
        (lane, "replay:start_step=200,length=50,window=50", (0.0, 0.003, 0.01), slice(205, 249), largest_offset, "offset [m]"),
    ):
        print(f"\n{place.name}\n\n| sd | raised | informs | {unit} |\n| --- | --- | --- | --- |")
        for sd in sizes:
            loop = place.loop(Spec("defence", f"watermark:sd={sd}").make())
            clean, struck = (rollout(loop, Spec("attack", text).make(), held) for text in ("none", attack))
            raised = np.mean(struck.score[window][struck.live[window]]) / np.mean(clean.score[window])
            informs = np.mean(struck.alarm[window].any(axis=0)) - np.mean(clean.alarm[window].any(axis=0))
            print(f"| {sd:g} | {raised:.2f} | {100 * informs:.0f} % | {np.median(cost(clean)):.3g} |")


def largest_offset(trace: Trace) -> Array:
    """Return the largest distance from the middle of the lane in each episode (B,) [m]."""
    return np.asarray(np.abs(trace.truth[:, :, 0, 0]).max(axis=0))


if __name__ == "__main__":
    main()
