"""A watermark against replay on stop-and-go-v0: the statistic, the alarms and the comfort that it costs.

    python benchmarks/watermark.py [--episodes 200]

The attacker replays 20 recorded steps from step 300 on, for 50 steps. `raised`: mean score of these steps over that of the clean run.
`informs`: share of episodes with an alarm in these steps, less that of the clean run at the same steps. Jerk: RMS of the clean run.
"""

import argparse

import numpy as np

from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.play.metrics import rms_jerk
from tailgate.play.trace import rollout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=200, help="episodes of each run")
    options = parser.parse_args()
    place, held = load_scenario("stop-and-go-v0").with_threat(kinds=("replay",)), keys("report", range(options.episodes))
    print("| sd [m/s^2] | raised | informs | jerk [m/s^3] |\n| --- | --- | --- | --- |")
    for sd in (0.0, 0.3, 1.0, 3.0):
        loop = place.loop(Spec("defence", f"watermark:sd={sd}").make())
        clean, struck = (rollout(loop, Spec("attack", text).make(), held) for text in ("none", "replay:start_step=300,length=50"))
        window = slice(300, 349)
        raised = np.mean(struck.score[window][struck.live[window]]) / np.mean(clean.score[window])
        informs = np.mean(struck.alarm[window].any(axis=0)) - np.mean(clean.alarm[window].any(axis=0))
        print(f"| {sd:g} | {raised:.2f} | {100 * informs:.0f} % | {np.median(rms_jerk(clean)):.2f} |")


if __name__ == "__main__":
    main()
