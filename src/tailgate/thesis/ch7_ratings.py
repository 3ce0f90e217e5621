"""Trust as a sum of the controllers' ratings (thesis 7.1 and 7.3.5), against the probability that all of them do what they should."""

from __future__ import annotations

from typing import Any

import numpy as np

from tailgate.evaluation.stats import Interval, proportion
from tailgate.trust.automata import Atom, Network, load_network
from tailgate.trust.simulate import simulate

from .ch7_automata import NETWORK, TEXTS, Played, successes
from .ch7_trust import interval
from .claims import Claim, Report, verdict

PAIR = {"a slow brake": (100.0, 3000.0), "both slow": (220.0, 700.0)}  # limits of controller and actuator; deadlines stay


def report(runs: Played, seeds: int) -> Report:
    """Three ratings as they stand, and of two other systems which one the sum prefers."""
    network, count = load_network(NETWORK), 10 * seeds
    rates, every = _rated(runs.declared.hit)
    found: dict[str, Any] = {"as in the thesis": _words(rates, every)}
    sums, joint = {}, {}
    for name, limits in PAIR.items():
        parts, all_ = _rated(simulate(_slow(network, *limits), range(count)).hit)
        found[name] = _words(parts, all_)
        sums[name], joint[name] = sum(parts), all_.value
    mean = sum(rates) / len(rates)
    found |= {
        "the sum prefers": max(sums, key=lambda name: sums[name]),
        "all at once is likelier with": max(joint, key=lambda name: joint[name]),
    }
    out = Report("ch7", "", {})
    out.claims.append(Claim(
        "7.3.5-sum", "Trust in the system is quantified by adding the ratings of all its controllers", "sum of the ratings", found,
        verdict(every.low <= mean <= every.high, mean > every.high),
        "a sum of three probabilities is none, and divided by three it is not the chance that all three do what they should; nor does it "
        f"put two systems in the order of that chance ({count} runs each)",
    ))  # fmt: skip
    return out


def _slow(network: Network, controller: float, actuator: float) -> Network:
    out = network.with_location("controller", "Intermediate", invariant=(Atom("react", "<=", controller),))
    return out.with_location("actuator", "braking", invariant=(Atom("press", "<=", actuator),))


def _rated(hit: Any) -> tuple[list[float], Interval]:
    """Share of the runs in which each query (Q, B) holds, and in which all do."""
    many = hit.shape[1]
    return [successes(row) / many for row in hit], proportion(int(np.isfinite(hit).all(axis=0).sum()), many)


def _words(rates: list[float], every: Interval) -> dict[str, Any]:
    return {
        "ratings": dict(zip(TEXTS, (round(rate, 4) for rate in rates), strict=True)), "sum": round(sum(rates), 4),
        "mean": round(sum(rates) / len(rates), 4), "all at once": interval(every),
    }  # fmt: skip
