"""Thesis 5.4: attack-free and under attack, by the resilient estimator and without resilience, on a fresh system in every run."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

import tailgate
from tailgate import num
from tailgate.core import Array, draws
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.play.trace import rollout

from .ch4_cases import Tick
from .claims import Claim, Report, Spread, Table, verdict

SCENARIO = "thesis-ch5-v0"
ONSET = 20  # steps before the first attack
GUARDS = {"dkf": "non-resilient (5.9)", "norm": "resilient (5.8)"}
LAM = 0.4
COMPROMISED = (0, 1, 2, 4, 7, 9)  # the thesis's 1, 2, 3, 5, 8, 10
SD, CHANCE = 700.0, 0.9
# Errors (K, runs, N) of each estimator under attack, attack-free before the onset; and "size" (K, runs, 1), the norm of the state.
Runs = dict[str, Array]


def fresh(seed: int, **plant: Any) -> Scenario:
    """The thesis's scenario with matrices of its own."""
    place = load_scenario(SCENARIO)
    return dataclasses.replace(
        place, plant=dataclasses.replace(place.plant, system_seed=seed, **plant), sensor=dataclasses.replace(place.sensor, sensor_seed=seed)
    )


def defence(name: str, lam: float = LAM) -> Any:
    return tailgate.make_defence("norm_resilient", lam=lam) if name == "norm" else tailgate.make_defence(name)


def random_attack(agents: Sequence[int], **options: Any) -> Any:
    """The thesis's attack on some agents."""
    if not agents:
        return tailgate.make_attack("none")
    return tailgate.make_attack("fdi_gaussian", **{"sd": SD, "chance": CHANCE, "agents": tuple(agents)} | options)


def sizes(place: Scenario, seed: int) -> Array:
    """(K, 1, 1) |x|_2 of a run that nobody watches."""
    trace = rollout(place.loop(defence("dkf")), tailgate.make_attack("none"), draws.keys("report", [seed]), terminate=False)
    return np.sqrt(num.dot(trace.truth, trace.truth))[:, :, :1]


def errors(place: Scenario, guard: Any, attack: Any, seeds: Sequence[int]) -> Array:
    """(K, B, N) |xh_i - x|_2."""
    trace = rollout(place.loop(guard), attack, draws.keys("report", list(seeds)), terminate=False)
    return trace.model.error(trace.estimate, trace.truth)


def play(seeds: int, tick: Tick) -> Runs:
    tick(f"figures 5.2 to 5.4 on {seeds} systems")
    attack = random_attack(COMPROMISED)
    runs = {name: np.concatenate([errors(fresh(s), defence(name), attack, [s]) for s in range(seeds)], axis=1) for name in GUARDS}
    return runs | {"size": np.concatenate([sizes(fresh(s), s) for s in range(seeds)], axis=1)}


def report(runs: Runs) -> Report:
    out = Report("ch5", "", {})
    out.tables.append(_table(runs))
    out.claims += [_converges(runs), *_worst(runs), _neighbours(runs)]
    return out


def worst(error: Array) -> Array:
    """(runs,) the largest error of any agent after the onset."""
    return np.asarray(error[ONSET:].max(axis=(0, 2)))


def _table(runs: Runs) -> Table:
    rows = []
    for name, words in GUARDS.items():
        each = np.median(runs[name][ONSET:].max(axis=0), axis=0)
        rows.append((words, *(f"{v:.2f}" if v < 100.0 else f"{v:.0f}" for v in each)))
    heads = tuple(f"{i}{' (a)' if i in COMPROMISED else ''}" for i in range(len(each)))
    return Table("Largest error of each agent after step 20, median over runs; (a): attacked", ("estimator", *heads), tuple(rows))


def steps_to(error: Array, size: Array, share: float = 0.01) -> Array:
    """(runs,) steps until the largest error stays below a share of the state's norm, before the onset."""
    wrong = np.asarray((error[:ONSET] > share * size[:ONSET]).any(axis=2))
    return np.asarray(np.where(wrong.any(axis=0), ONSET - np.argmax(wrong[::-1], axis=0), 0) + 1)


def _converges(runs: Runs) -> Claim:
    steps = {words: Spread.of(steps_to(runs[name], runs["size"])).data() for name, words in GUARDS.items()}
    steps_norm = steps_to(runs["norm"], runs["size"])
    return Claim(
        "5.4-clean",
        "Attack-free, the estimation errors converge within 10 s",
        "within 10 s",
        {f"steps to 1 %, {k}": v for k, v in steps.items()},
        verdict(bool(np.quantile(steps_norm, 0.975) <= 10), bool(np.median(steps_norm) > 10)),
        "to 1 % of the state's norm, the largest of the agents; yes if 97.5 % of the runs are there by then",
    )


def _worst(runs: Runs) -> list[Claim]:
    spread = {name: Spread.of(worst(runs[name])) for name in GUARDS}
    return [
        Claim(
            "5.4-resilient",
            "Under attack the resilient estimator's error stays below 3",
            "< 3",
            {"largest error": spread["norm"].data()},
            verdict(spread["norm"].high < 3.0, spread["norm"].low > 3.0),
            "the largest of all agents and steps; yes if 97.5 % of the runs are below",
        ),
        Claim(
            "5.4-linear",
            "Without resilience the error is about 1400",
            "about 1400",
            {"largest error": spread["dkf"].data()},
            verdict(spread["dkf"].covers(1400.0) and abs(spread["dkf"].median / 1400.0 - 1.0) < 0.25, not spread["dkf"].covers(1400.0)),
            "the size follows that of the attack, 700 randn, which the thesis does not give",
        ),
    ]


def _neighbours(runs: Runs) -> Claim:
    """What the attack does to agents that are attacked, hear an attacked one, or neither."""
    graph = load_scenario(SCENARIO).plant.hears()
    attacked = np.isin(np.arange(len(graph)), COMPROMISED)
    near = ~attacked & (graph & attacked).any(axis=1)
    largest = runs["norm"][ONSET:].max(axis=0)
    groups = {"attacked": attacked, "neighbours of attacked": near, "others": ~attacked & ~near}
    medians = {k: float(np.median(largest[:, g].max(axis=1))) for k, g in groups.items() if g.any()}
    ratio = medians["neighbours of attacked"] / medians["attacked"]
    return Claim(
        "5.4-neighbours",
        "The errors are high for the neighbours of the compromised agents",
        "high",
        medians | {"agents without an attacked neighbour": int(groups["others"].sum())},
        verdict(ratio > 0.5, ratio < 0.1),
        "largest error after the onset, median: a neighbour that is not attacked itself hears only what its neighbours pass on",
    )
