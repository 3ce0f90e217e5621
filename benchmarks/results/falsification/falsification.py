"""Measures what falsification and splitting find, against plain episodes.

    python benchmarks/results/falsification/falsification.py [--part NAME ...] [--episodes 1000000] [--repeats 100] [--out FILE]

A fault is planted in a filter (planted.py). Random episodes without an attack do not show it; a search does, and its attack is shrunk.
Random attacks are played under four threat models, next to searches. The rare event is an AR(1) process that crosses a level: its
probability is known from an integral. Parts that are not asked for stay as they are in the file.
"""

import dataclasses
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from tailgate.base.reading import load_json
from tailgate.bench.study import arguments, made_by, write_record
from tailgate.core import draws
from tailgate.core.draws import Draws
from tailgate.core.registry import Spec
from tailgate.falsify.case import Case
from tailgate.falsify.run import falsify
from tailgate.falsify.search import EPISODES, GENERATION, Search, search
from tailgate.falsify.splitting import chance_of, plain_episodes, split
from tailgate.play.trace import rollout

sys.path.insert(0, str(Path(__file__).parent))
BIASED = (("kinds", ["fdi"]), ("targets", ["position"]), ("fdi_bound", 60))
FAULT = Case("", "stop-and-go-v0", 60, "planted:SignError", BIASED, "G[0,60] gap_error < 80")
TRIALS, SEEDS = 128, 5
LIMITS, DRAWN, TRIED = ((60, 60), (16, 10), (13, 10), (14, 6)), 1024, 512  # bound [m] and dose; random scripts; trials of a search
AT_ONCE = 2000
KEEP, STEPS, LEVEL = 0.9, 50, 12.2
PARTICLES, RUNS = 500, 10
LIBRARIES = "numpy", "scipy", "optuna", "cmaes"


def random_episodes(episodes: int) -> dict[str, Any]:
    """Return how many random episodes break the property without an attack, and how far the worst is from it."""
    case, attack = dataclasses.replace(FAULT, attack="none"), Spec("attack", "none").make()
    least, broken, started = math.inf, 0, time.perf_counter()
    for first in range(0, episodes, AT_ONCE):
        trace = rollout(case.own, attack, draws.keys("report", range(first, min(first + AT_ONCE, episodes))))
        values = case.claim.robustness(trace)
        least, broken = min(least, float(values.min())), broken + int((values < 0.0).sum())
    return {"episodes": episodes, "violations": broken, "least": least, "seconds": round(time.perf_counter() - started, 1)}


def searches() -> list[dict[str, Any]]:
    """Searches of the planted fault, and of the sound filter under the same seeds."""
    out = []
    for sampler in ("tpe", "cmaes"):
        for seed in range(SEEDS):
            job = Search(FAULT, sampler, TRIALS, seed)
            report = falsify(job)
            found = report["counterexample"]
            sound = search(dataclasses.replace(job, case=dataclasses.replace(FAULT, defence="kf")))
            out.append({
                "sampler": sampler, "seed": seed, "episodes": report["episodes"], "violations": report["violations"],
                "least": round(report["least"], 3), "attack": found["found"]["attack"], "steps": found["found"]["steps"],
                "shrunk": found["steps"], "robustness": round(found["robustness"], 3), "seconds": report["seconds"],
                "sound_least": round(sound.robustness, 3),
            })  # fmt: skip
            print(out[-1])
    return out


def attacks() -> list[dict[str, Any]]:
    """Random scripts, and a search of half as many, under several threat models: the episodes in which each shows the fault."""
    out = []
    for bound, dose in LIMITS:
        case = dataclasses.replace(FAULT, dose=dose, threat=(*BIASED[:2], ("fdi_bound", bound)))
        rng, broken = np.random.default_rng(0), 0
        for first in range(0, DRAWN, GENERATION):
            seeds = np.arange(first, first + GENERATION)[:, None] * EPISODES + np.arange(EPISODES)
            broken += int((case.robustness(rng.random((GENERATION, len(case.genes))), seeds) < 0.0).sum())
        found = search(Search(case, "tpe", TRIED, 0))
        out.append({
            "bound": bound, "dose": dose, "random": {"episodes": DRAWN * EPISODES, "violations": broken},
            "tpe": {"episodes": TRIED * EPISODES, "violations": found.violations, "least": round(found.robustness, 3)},
        })  # fmt: skip
        print(out[-1])
    return out


def walk(keys: Any) -> Any:
    """Margins (K, B) of x' = 0.9 x + w below the level."""
    batch = keys.shape[1]
    x, out, episode = np.zeros(batch), np.empty(keys.shape[:2]), np.zeros(batch, np.uint32)
    for k in range(len(keys)):
        x = KEEP * x + Draws(keys[k, :, 0], episode, np.full(batch, k, np.uint32), 1).normal()
        out[k] = LEVEL - x
    return out


def exact(points: int) -> float:
    """The probability that the walk crosses the level, by Gauss-Legendre integration of the density that has not crossed."""
    z, w = np.polynomial.legendre.leggauss(points)
    low = -20.0
    x, w = 0.5 * (LEVEL - low) * z + 0.5 * (LEVEL + low), 0.5 * (LEVEL - low) * w
    kernel, leaves = norm.pdf(x[:, None] - KEEP * x) * w, norm.sf(LEVEL - KEEP * x) * w
    density, out = norm.pdf(x), float(norm.sf(LEVEL))
    for _ in range(STEPS - 1):
        out, density = out + float(leaves @ density), kernel @ density
    return out


def rare(repeats: int) -> dict[str, Any]:
    """Estimates of the walk: how often the interval holds the exact value, and at which part of the cost of plain episodes."""
    value, held, cost, estimates = exact(2000), 0, [], []
    for number in range(repeats):
        runs = [split(walk, STEPS, PARTICLES, np.random.default_rng([number, i])) for i in range(RUNS)]
        chance = chance_of(runs, PARTICLES)
        held += chance.low < value < chance.high
        cost.append(plain_episodes(chance) / chance.episodes)
        estimates.append(chance.probability)
        if number == 0:
            first = chance._asdict()
    return {
        "exact": value, "exact_with_half_the_points": exact(1000), "particles": PARTICLES, "runs": RUNS, "repeats": repeats,
        "intervals_that_hold": held, "mean": float(np.mean(estimates)), "mean_error": float(np.std(estimates) / math.sqrt(repeats)),
        "cheaper_than_plain": {"least": round(min(cost), 1), "median": round(float(np.median(cost)), 1)}, "first": first,
    }  # fmt: skip


def main() -> None:
    parser = arguments(__file__, __doc__)
    parser.add_argument("--episodes", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=100)
    makers = {
        "rare": lambda: rare(options.repeats), "searches": searches,
        "random": lambda: random_episodes(options.episodes), "attacks": attacks,
    }  # fmt: skip
    parser.add_argument("--part", action="append", choices=list(makers), help="only this part (repeatable; default: all)")
    options = parser.parse_args()
    held = load_json(options.out) if options.part and options.out.is_file() else {}
    found = {name: make() if name in (options.part or makers) else held.get(name) for name, make in makers.items()}
    print(found["rare"], found["random"], sep="\n")
    case, made = {"scenario": FAULT.scenario, "dose": FAULT.dose, "property": FAULT.formula, "threat": dict(BIASED)}, made_by(*LIBRARIES)
    later = held.get("parts", {}) | {name: made for name in options.part or ()}
    write_record(options.out, (held or made) | {"case": case, "parts": later} | found)


if __name__ == "__main__":
    main()
