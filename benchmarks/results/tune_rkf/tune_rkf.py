"""Tunes lam, the price of an outlier, of the robust Kalman filter: position error over a grid, on seeds and attacks kept for tuning.

    python benchmarks/results/tune_rkf/tune_rkf.py [--seeds 100] [--out FILE]

The attacks are not the reported ones (`thesis_times`), nor are their steps. Each scenario is played to its horizon, collisions or not.
lam is given in 1/sqrt(R_11) and, what decides, in 1/sqrt(S_11): S is the covariance of the innovation in steady state. The best lam has the
smallest geometric mean, over the clean runs and the attacks, of the median position error.
"""

import dataclasses
import math
from typing import Any

import numpy as np

import tailgate
from tailgate.bench.study import arguments, made_by, write_record
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.estimators import RobustKalman
from tailgate.estimators.filters.kalman import steady_state
from tailgate.play.metrics import rmse_position
from tailgate.play.trace import rollout

GRID = tuple(float(f"{x:.4g}") for x in np.geomspace(0.5, 16.0, 16))  # in 1/sqrt(R_11)
NOISY = 18.5  # variance of both noises, of which the thesis's figures speak
SHORT = (
    "none", "fdi_gaussian:start_step=60,length=12,sd=30", "fdi_bernoulli:start_step=76,length=20,value=-40",
    "dos_jam:start_step=130,length=12",
)  # fmt: skip
ROADS = ("gusty-stop-and-go-v0", "stop-and-go-v0")  # the default comes from these
LONG = (
    "none", "fdi_gaussian:start_step=120,length=60,sd=10", "fdi_bernoulli:start_step=220,length=80,value=-20",
    "dos_jam:start_step=350,length=40",
)  # fmt: skip


def settings() -> dict[str, tuple[Scenario, tuple[str, ...]]]:
    """What is tuned on: a scenario and its attacks, by name."""
    thesis = load_scenario("thesis-ch4-v0")
    plant = dataclasses.replace(thesis.plant, process_var=(NOISY,) * 3)
    noisy = dataclasses.replace(thesis, plant=plant, sensor=dataclasses.replace(thesis.sensor, noise_var=(NOISY,) * 2))
    roads = {name: (load_scenario(name), LONG) for name in ROADS}
    return {"thesis-ch4-v0": (thesis, SHORT), f"thesis-ch4-v0, Q = R = {NOISY} I": (noisy, SHORT), **roads}


def errors(place: Scenario, defence: Any, attack: str, seeds: int) -> dict[str, float]:
    """Median and quartiles of the position error [m] over episodes."""
    trace = rollout(place.loop(defence), Spec("attack", attack).make(), draws.keys("tune", range(seeds)), terminate=False)
    low, median, high = np.quantile(rmse_position(trace), [0.25, 0.5, 0.75])
    return {"q25": round(float(low), 5), "median": round(float(median), 5), "q75": round(float(high), 5)}


def tune(place: Scenario, attacks: tuple[str, ...], seeds: int) -> dict[str, Any]:
    """The grid of one setting, its best lam, and the Kalman filter and Algorithm 3 beside it."""
    model = place.brief().model
    sd = math.sqrt(model.R[0, 0, 0])
    sigma = math.sqrt((model.C[0] @ steady_state(model)[0] @ model.C[0].T + model.R[0])[0, 0])
    rows = []
    for x in GRID:
        cells = {attack: errors(place, RobustKalman(lam=x / sd, unit="sensor"), attack, seeds) for attack in attacks}
        score = math.exp(sum(math.log(cell["median"]) for cell in cells.values()) / len(cells))
        rows.append({"lam_sqrt_R": x, "lam": x / sd, "lam_sqrt_S": x * sigma / sd, "score": round(score, 5), "rmse": cells})
    beside = {name: {a: errors(place, tailgate.make_defence(name), a, seeds) for a in attacks} for name in ("kf", "chi2_kf")}
    return {"sqrt_R": sd, "sqrt_S": sigma, "grid": rows, "best": min(rows, key=lambda row: row["score"]), "beside": beside}


def report(name: str, found: dict[str, Any]) -> None:
    attacks = "".join(f"{a.partition(':')[0]:>16}" for a in found["best"]["rmse"])
    print(f"\n{name}: median position RMSE [m]\n{'lam sqrt(R)':>12}{'lam sqrt(S)':>12}{attacks}{'score':>10}")
    for row in found["grid"]:
        mark = "  <" if row is found["best"] else ""
        medians = "".join(f"{cell['median']:>16.3f}" for cell in row["rmse"].values())
        print(f"{row['lam_sqrt_R']:>12.3f}{row['lam_sqrt_S']:>12.3f}{medians}{row['score']:>10.3f}{mark}")
    for other, cells in found["beside"].items():
        print(f"{other:>24}" + "".join(f"{cell['median']:>16.3f}" for cell in cells.values()))


def shared(found: dict[str, Any]) -> dict[str, float]:
    """The lam in sigma whose scores have the smallest geometric mean over the roads; sqrt(S) differs little between them."""
    rows = list(zip(*(found[name]["grid"] for name in ROADS), strict=True))
    best = min(rows, key=lambda pair: math.prod(row["score"] for row in pair))
    return {"lam_sqrt_R": best[0]["lam_sqrt_R"], "lam_sqrt_S": round(sum(row["lam_sqrt_S"] for row in best) / len(best), 3)}


def main() -> None:
    parser = arguments(__file__, __doc__)
    parser.add_argument("--seeds", type=int, default=100, help="episodes per cell")
    options = parser.parse_args()
    found = {}
    for name, (place, attacks) in settings().items():
        found[name] = tune(place, attacks, options.seeds)
        report(name, found[name])
    default = shared(found)
    print(f"\nbest on {' and '.join(ROADS)} together: lam = {default['lam_sqrt_S']:.2f} / sqrt(S)")
    write_record(options.out, made_by() | {"purpose": "tune", "seeds": options.seeds, "default": default, "settings": found})


if __name__ == "__main__":
    main()
