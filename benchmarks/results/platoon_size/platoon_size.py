"""What a platoon costs by its number of cars: making the model, preparing a defence, a step, memory; one core, CPU time.

    python benchmarks/results/platoon_size/platoon_size.py [--cars 5 10 20 50 100] [--out FILE]

Writes the figures and a picture. `dkf` and `lasso_dkf` share their constants (5.5), which are made once. Attacked is car 2's
distance, half of the time.
"""

import argparse
import dataclasses
import json
import os
import resource
import statistics
import subprocess
import sys
import time

from matplotlib.ticker import NullLocator

from tailgate.base.files import write_atomic
from tailgate.base.plots import canvas, png
from tailgate.bench.study import arguments, made_by, write_record
from tailgate.core import draws
from tailgate.core.draws import Role
from tailgate.core.loop import Loop
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.estimators.distributed import distributed_kalman as distributed

EPISODES, STEPS, WARM = 4, 20, 3
GROUPS = (("none",), ("dkf", "lasso_dkf"))
ATTACK = "fdi:value=60,targets=[distance],agents=[2],chance=0.5"


def once(function):
    """The function of a model, computed once a model object."""
    held = []

    def remembered(model):
        for known, value in held:
            if known is model:
                return value
        held.append((model, function(model)))
        return held[-1][1]

    return remembered


def play(place, defence, model):
    """CPU seconds to prepare a defence, and of a step of EPISODES episodes, the median."""
    spec, attack = Spec("defence", defence), Spec("attack", ATTACK).make()
    loop = Loop(
        place.plant, place.sensor, place.controller, place.manoeuvre, place.threat_model, STEPS + WARM, spec.make(), spec.entry.uses
    )  # fmt: skip
    vars(loop)["model"] = model  # made once
    begun = time.process_time()
    _ = loop.plan
    prepare = time.process_time() - begun
    state, plan = loop.start(draws.keys("tune", range(EPISODES))), attack.prepare(loop.brief)
    memory = attack.start(plan, EPISODES, state.keys.at(Role.ATTACK, state.k))
    seconds = []
    for _ in range(STEPS + WARM):
        begun = time.process_time()
        state, memory, _ = loop.step(state, attack, plan, memory)
        seconds.append(time.process_time() - begun)
    return prepare, statistics.median(seconds[WARM:])


def measure(cars, defences):
    """The figures of one process, a mapping for each defence."""
    distributed.fixed_point = once(distributed.fixed_point)
    base = load_scenario("platoon-braking-v0").with_threat(onset=1)
    small, place = (dataclasses.replace(base, plant=dataclasses.replace(base.plant, followers=n - 1)) for n in (4, cars))
    for name in defences:  # import, compile
        play(small, name, small.brief().model)
    begun = time.process_time()
    model = place.plant.model(place.sensor, place.controller)
    made, out = time.process_time() - begun, []
    for i, name in enumerate(defences):
        prepare, step = play(place, name, model)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        out.append({
            "cars": cars, "states": model.states, "defence": name, "model_s": made, "prepare_s": prepare if i == 0 else None,
            "step_ms": 1e3 * step / EPISODES, "peak_mb": peak,
        })  # fmt: skip
    return out


def picture(rows):
    """Preparing, a step and memory against the number of cars."""
    panels = (("prepare_s", "model and prepare [s]"), ("step_ms", "one step of one episode [ms]"), ("peak_mb", "memory [MB]"))
    figure, axes = canvas(11.0, 3.8, 1, 3)
    for ax, (key, words) in zip(axes[0], panels, strict=True):
        for colour, name in enumerate(dict.fromkeys(row["defence"] for row in rows)):
            here = [row for row in rows if row["defence"] == name and row[key] is not None]
            values = [row[key] + (row["model_s"] if key == "prepare_s" else 0.0) for row in here]
            if here:
                ax.plot([row["cars"] for row in here], values, "o-", color=f"C{colour}", label=name)
        ax.set(xscale="log", yscale="log", xlabel="cars", title=words)
        ticks = sorted({row["cars"] for row in rows})
        ax.set_xticks(ticks, [str(tick) for tick in ticks], minor=False)
        ax.xaxis.set_minor_locator(NullLocator())
        ax.grid(alpha=0.3, which="both")
    axes[0, 1].legend()
    return png(figure)


def main():
    parser = arguments(__file__, __doc__)
    parser.add_argument("--cars", type=int, nargs="+", default=[5, 10, 20, 50, 100])
    parser.add_argument("--one", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(int(options.one[0]), options.one[1:])))
        return
    rows = []
    for cars in options.cars:
        for group in GROUPS:
            command = [sys.executable, __file__, "--one", str(cars), *group]
            done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"})
            rows += json.loads(done.stdout)
            for row in rows[-len(group) :]:
                print(row, file=sys.stderr, flush=True)
            write_record(options.out, made_by() | {"episodes": EPISODES, "steps": STEPS, "rows": rows})
    write_atomic(options.out.with_suffix(".png"), picture(rows))


if __name__ == "__main__":
    main()
