"""Made-up rows and boards, whose answers are known by hand."""

import functools

from tailgate.board import score
from tailgate.board.damage import hashes_of
from tailgate.core.scenario import Suite, load_scenario
from tailgate.evaluation.rounds import seeds_of
from tailgate.play.metrics import METRICS

BEACON = "0123456789abcdef"
ROAD, OTHER, NETWORK = "stop-and-go-v0", "gusty-stop-and-go-v0", "thesis-ch5-v0"
CLEAN = {"distance_travelled": 1000.0, "rms_jerk": 2.0, "time_gap_inflation": 0.05, "alarm_rate": 0.0, "alarm_onsets": 0.0, "min_gap": 8.0,
         "attack_steps": 0.0, "max_error": 1.0, "rmse_position": 0.5}  # fmt: skip


@functools.cache
def _seeds(n):
    return seeds_of(BEACON, "s", "report", n)


@functools.cache
def hash_of(scenario, dose, knowledge):
    """Of a scenario under the threat model of a suite that changes nothing else."""
    return hashes_of(load_scenario(scenario), Suite("s"), dose, knowledge)[0]


def suite(**changes):
    given = {"name": "s", "scenarios": (ROAD,), "doses": (10, 20, 40), "attacks": ("none", "fdi"), "seeds": 20, "shown": {10: "a", 20: "b", 40: "c"}}
    return Suite(**(given | changes))


def cell(defence, attack="none", hits=0, n=20, scenario=ROAD, doses=(10, 20, 40), **changes):
    """Rows of a cell at each dose: the first `hits` episodes (a number, or one for each dose, or lists of their numbers) come to damage."""
    seeds = sorted(_seeds(n))
    hits = hits if isinstance(hits, (list, tuple)) else [hits] * len(doses)
    out = []
    for dose, hit in zip(doses, hits, strict=True):
        which = set(range(hit)) if isinstance(hit, int) else set(hit)
        for number, seed in enumerate(seeds):
            row = dict.fromkeys(METRICS) | CLEAN | {
                "suite": "s", "scenario": scenario, "dose": dose, "knowledge": "black", "defence": defence, "attack": attack, "purpose": "report",
                "config_hash": hash_of(scenario, dose, changes.get("knowledge", "black")), "version": "1", "defence_digest": "", "attack_digest": "",
                "beacon": BEACON, "submission": {"sandbox": "bwrap"}, "seed": seed, "number": number, "status": "ok", "reason": "",
                "uses": ["measurements"], "learned": False, "optimal": False, "crashed": float(number in which), "attack_steps": 0.0 if attack == "none" else float(dose),
            }  # fmt: skip
            out.append(row | changes)
    return out


def clean(*defences, **changes):
    return [row for defence in ("none", *defences) for row in cell(defence, **changes)]


def board(rows, where=None, **options):
    return score(rows, where or suite(), **({"require_adaptive": False} | options))


def entry(made, defence):
    return next(e for e in made["entries"] if e["defence"] == defence)


def rate(found, dose, knowledge="black"):
    return next(r for r in found["rates"] if r["dose"] == dose and r["knowledge"] == knowledge)
