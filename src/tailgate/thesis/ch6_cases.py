"""Thesis 6.6: attack-free, denial of service and false data injection on the sensors of car 2, in the linear platoon."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tailgate.core import Array, Attack, Defence
from tailgate.core.registry import make
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.envs.controllers.cacc import Column
from tailgate.estimators.distributed.distributed_kalman import fixed_point
from tailgate.play.trace import Trace

from .ch5_theory import initial, parted
from .claims import Claim, Part, Spread, Table, Tick, verdict
from .resilience import lasso_bound, lasso_direction
from .runs import median, play

SCENARIO = "thesis-ch6-v0"
ONSET = 20  # steps before the first attack
STANDSTILL = 5.0  # d_r [m]
VICTIM = 2
DEFENCES = {"dkf": "non-resilient (6.27)", "lasso": "resilient (6.26)"}
LAM = 0.1
LOOP_LAM = 5.0  # of the closed loop, whose sensors are ten times as accurate
DOS = "dos_hold:chance=0.5,targets=[distance,velocity]"
CASES = {  # title and attack
    "clean": ("attack-free", "none"),
    "dos": ("denial of service on distance and velocity", DOS),
    "dos_da": ("denial of service on distance and acceleration", "dos_hold:chance=0.5,targets=[distance,acceleration]"),
    "fdi": (
        "false data injection, 2.8 randn on distance and velocity", "fdi_gaussian:chance=0.5,targets=[distance,velocity],sd=2.8",
    ),
}  # fmt: skip
SENSORS = ("distance", "distance,velocity", "distance,velocity,acceleration")


def defence(name: str, lam: float = LAM) -> Defence:
    """Return the non-resilient estimator (`dkf`), or the resilient one at a price."""
    made: Defence = make("defence", "dkf") if name == "dkf" else make("defence", "lasso_dkf", lam=lam, unit="sensor")
    return made


@dataclass(frozen=True, eq=False)
class Played:
    """One case under one estimator."""

    trace: Trace

    @property
    def own(self) -> Array:
        """(K, B, N) own-distance errors [m]."""
        return self.trace.model.error(self.trace.estimate, self.trace.truth)

    @property
    def held(self) -> Array:
        """(K, B, N) errors of d_2 as each car holds it [m]."""
        column = Column.gap(VICTIM)
        return np.asarray(np.abs(self.trace.estimate[..., column] - self.trace.truth[..., column]))

    @property
    def worst(self) -> Array:
        """(B,) largest own-distance error of any car after the onset."""
        return np.asarray(self.own[ONSET:].max(axis=(0, 2)))

    @property
    def largest(self) -> tuple[Array, Array]:
        """(B, N) the largest of `own` and of `held` after the onset."""
        return self.own[ONSET:].max(axis=0), self.held[ONSET:].max(axis=0)


Runs = dict[tuple[str, str], Played]  # by case, estimator


def platoon(**threat: object) -> Scenario:
    """Return the thesis's platoon; denial of service keeps the reading of k = 20, tau in (6.18), whenever the first hit comes."""
    return load_scenario(SCENARIO).with_threat(hold_from_onset=True, **threat)


def run(estimator: Defence, attack: Attack | str, seeds: int, scenario: Scenario | None = None) -> Played:
    """Play one cell, on the thesis's platoon where no other is given."""
    return Played(play(scenario or platoon(), estimator, attack, seeds, terminate=False))


def play_all(seeds: int) -> Runs:
    """Play every case under both estimators."""
    return {(case, name): run(defence(name), attack, seeds) for case, (_, attack) in CASES.items() for name in DEFENCES}


def parts(runs: Runs, seeds: int, tick: Tick) -> Iterator[Part]:
    """Return tables and claims on the figures, the number of sensors and cars, and the bounds."""
    yield _table(runs)
    yield from (_converges(runs), *_worst(runs), _neighbours(runs), _milder(runs), _other_steps(runs))
    tick("sensors and cars that are attacked")
    yield from (_sensors(seeds), _known(runs, seeds))
    yield from _cars(seeds)
    tick("the bound (6.29)")
    yield from (initial("6.5.3", "(6.28)", "lasso"), _bound())


def _table(runs: Runs) -> Table:
    rows = []
    for case, (title, _) in CASES.items():
        for name, words in DEFENCES.items():
            own, held = runs[case, name].largest
            medians = [*np.median(own[:, 1:], axis=0), *np.median(held[:, 2:5], axis=0)]
            rows.append((title, words, *(f"{value:.3f}" for value in medians)))
    heads = (*(f"car {i}" for i in range(1, 5)), *(f"d_2 held by {i}" for i in (2, 3, 4)))
    title = "Largest |distance error| after 20 s [m], median: own distance of each car, and d_2"
    return Table(title, ("case", "estimator", *heads), tuple(rows))


def _converges(runs: Runs) -> Claim:
    error = runs["clean", "lasso"].own[9].max(axis=1)
    return Claim(
        "6.6-clean", "Attack-free, the estimation errors converge within 10 s", "about 0 at 10 s, from 0.1 m",
        {"largest own-distance error at 10 s [m]": Spread.of(error).data()},
        verdict(bool(np.quantile(error, 0.975) < 0.01), bool(np.median(error) > 0.05)),
        "converged means below 0.01 m in 97.5 % of the runs",
    )  # fmt: skip


def _worst(runs: Runs) -> Iterator[Claim]:
    for case, name, limit in (("dos", "lasso", 1.0), ("dos", "dkf", 10.0), ("fdi", "lasso", 1.0), ("fdi", "dkf", 4.5)):
        spread = Spread.of(runs[case, name].worst)
        if name == "lasso":
            text, thesis, holds = f"below {limit:g} m", f"< {limit:g} m", verdict(spread.high < limit, spread.low > limit)
            why = "97.5 % of the runs below"
        else:
            text = thesis = f"about {limit:g} m"
            holds = verdict(spread.covers(limit) and abs(spread.median / limit - 1.0) < 0.25, not spread.covers(limit))
            why = "among the central 95 % of the runs, the median within a quarter; the attack's size is not given"
        claim = f"{CASES[case][0].capitalize()}: the distance error of the {DEFENCES[name]} estimator is {text}"
        yield Claim(f"6.6-{case}-{name}", claim, thesis, {"largest own-distance error [m]": spread.data()}, holds, why)


def _neighbours(runs: Runs) -> Claim:
    own, held = runs["dos", "lasso"].largest
    ratios = {f"own distance of car {i} over car 2": median(own[:, i] / own[:, 2]) for i in (3, 4)}
    ratios |= {f"d_2 held by car {i} over car 2": median(held[:, i] / held[:, 2]) for i in (3, 4)}
    near, far = ratios["own distance of car 3 over car 2"], ratios["d_2 held by car 3 over car 2"]
    return Claim(
        "6.6-dos-neighbours", "The error is high at the neighbour, car 3, and propagates on to car 4",
        "curves of cars 2, 3 and 4 of one size", ratios, verdict(near > 0.3, far < 0.3),
        "so it is for what cars 3 and 4 believe of d_2; their own distances, which their own sensors see, hardly move",
    )  # fmt: skip


def _milder(runs: Runs) -> Claim:
    held = {case: runs[case, "lasso"].largest[1][:, 3] for case in ("dos", "fdi")}
    wins = float(np.mean(held["fdi"] < held["dos"]))
    return Claim(
        "6.6-fdi-milder", "False data injection has less influence on the neighbour's distance than denial of service", "less",
        {"d_2 held by car 3 [m]": {case: median(v) for case, v in held.items()}, "share of seeds": wins},
        verdict(wins > 0.95, wins < 0.5),
        "an affair of the sizes chosen: a replayed distance is off by as much as the platoon has moved on, 2.8 randn by 2.8 m",
    )  # fmt: skip


def _other_steps(runs: Runs) -> Claim:
    ratio = {}
    for case in ("dos", "fdi"):
        quiet = (runs[case, "lasso"].trace.kind == 0)[ONSET:]
        attacked, clean = (float(np.quantile(runs[c, "lasso"].own[ONSET:][quiet].max(axis=1), 0.5)) for c in (case, "clean"))
        ratio[case] = {"median [m]": attacked, "attack-free [m]": clean}
    worse = [v["median [m]"] > 10.0 * v["attack-free [m]"] for v in ratio.values()]
    return Claim(
        "6.6-other-steps", "At all other time points it performs as well as in the attack-free case", "as well", ratio,
        verdict(not any(worse), all(worse)),
        "own-distance errors at the steps without an attack: what a hit leaves decays over several steps",
    )  # fmt: skip


def _sensors(seeds: int) -> Claim:
    values = {
        f"{targets.count(',') + 1} of 3, p = {chance}": {
            name: median(run(defence(name), f"dos_hold:chance={chance},targets=[{targets}]", seeds).worst) for name in DEFENCES
        }
        for targets in SENSORS for chance in (0.5, 1.0)
    }  # fmt: skip
    lasso = [v["lasso"] for v in values.values()]
    return Claim(
        "6.1-sensors", "There is no limit on the number of sensors of a vehicle that may be compromised", "no limit", values,
        verdict(max(lasso) < 1.0, min(lasso) > STANDSTILL),
        "largest own-distance error under denial of service in half of the steps and in every step [m], median; yes: all below 1 m",
    )  # fmt: skip


def _known(runs: Runs, seeds: int) -> Claim:
    """Compare the figures with those of followers who do not know the leader's input, at both prices."""
    scenario = platoon()
    secret = dataclasses.replace(scenario, plant=dataclasses.replace(scenario.plant, leader_input_known=False))
    values: dict[str, dict[str, float]] = {}
    for case in ("clean", "dos"):
        title, attack = CASES[case]
        for label, estimator, told in (
            ("dkf", defence("dkf"), runs[case, "dkf"]),
            ("lasso", defence("lasso"), runs[case, "lasso"]),
            (f"lasso, lam = {LOOP_LAM:g}", defence("lasso", LOOP_LAM), None),
        ):
            told = told or run(estimator, attack, seeds)
            values[f"{title}, {label}"] = {"told": median(told.worst), "not told": median(run(estimator, attack, seeds, secret).worst)}
    change = max(v["not told"] / v["told"] for v in values.values())
    return Claim(
        "6.6-known-input", "The followers know the leader's input u_r (assumed in all figures)", "known", values,
        verdict(change < 2.0, change > 10.0),
        f"largest own-distance error [m], median, with and without, at lam = {LAM:g} where none is given; yes: less than twice as large "
        "without, no: more than ten times",
    )  # fmt: skip


def _cars(seeds: int) -> tuple[Claim, Table]:
    """Attack the first cars of the string, at p = 0.5 and in every step."""
    rows, worst, everybody = [], {}, platoon(agents=())
    for count in range(6):
        cells = []
        for chance in (0.5, 1.0):
            for name, options in (("dos_hold", {}), ("fdi", {"value": 20.0})):
                some = make("attack", name, chance=chance, targets=("distance", "velocity"), agents=tuple(range(count)), **options)
                for estimator in DEFENCES:
                    value = median(run(defence(estimator), some if count else "none", seeds, everybody).worst)
                    cells.append(f"{value:.2f}")
                    worst[count, chance, name, estimator] = value
        rows.append((str(count), *cells))
    heads = tuple(f"{a}, p = {p}, {g}" for p in (0.5, 1.0) for a in ("hold", "+20") for g in ("DKF", "lasso"))
    table = Table("Largest own-distance error after 20 s [m], median, against the number of cars attacked", ("cars", *heads), tuple(rows))
    measured = {f"{a}, p = {p}": worst[5, p, a, "lasso"] for p in (0.5, 1.0) for a in ("dos_hold", "fdi")}
    claim = Claim(
        "6.1-cars", "The error stays bounded whatever the number of compromised cars", "bounded", measured,
        verdict(max(measured.values()) < 1.0, min(measured.values()) > STANDSTILL),
        "all five cars attacked on distance and velocity [m]; yes: always below 1 m, no: always above d_r = 5 m",
    )  # fmt: skip
    return claim, table


def _bound() -> Claim:
    """Compare (6.29) with the largest difference between two attacks' estimates."""
    model = load_scenario(SCENARIO).brief().model
    Qinv = fixed_point(model).Qinv
    printed = LAM * np.linalg.norm(Qinv @ np.swapaxes(model.C, 1, 2) @ np.linalg.inv(np.linalg.cholesky(model.R)), 2, axis=(1, 2))
    reached = parted(model, defence("lasso"), lasso_direction(model, LAM))
    above, tight = float(np.max(reached / printed)), float(np.max(reached / lasso_bound(model, LAM)))
    return Claim(
        "6.5.4", "Two attacks move the estimate apart by at most (6.29)", "a bound",
        {"largest distance over (6.29)": above, "over the corrected bound": tight}, verdict(above <= 1.0 + 1e-9, above > 1.0 + 1e-6),
        "the tight bound is lam max |Q^-1 C' s| over signs s, between any two attacks of one step; errors of several steps add up",
    )  # fmt: skip
