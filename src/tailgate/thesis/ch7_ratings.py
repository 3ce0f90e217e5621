"""Trust as a sum of the controllers' ratings (thesis 7.1 and 7.3.5), against the probability that all of them do what they should."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tailgate.core import Array
from tailgate.evaluation.stats import Interval
from tailgate.trust.automata import Atom, Network, load_network
from tailgate.trust.simulate import simulate

from .ch7_automata import NETWORK, TEXTS, Played, met
from .ch7_trust import interval
from .claims import Claim, verdict
from .runs import share

PAIR = {"a slow brake": (100.0, 3000.0), "both slow": (220.0, 700.0)}  # limits of controller and actuator; deadlines stay


def parts(runs: Played, seeds: int) -> Iterator[Claim]:
    """Judge the sum of the three ratings, and which of two other systems it prefers."""
    network, count = load_network(NETWORK), 10 * seeds
    rates, every = _rated(runs.invariants.hit)
    found: dict[str, object] = {"as in the thesis": _words(rates, every)}
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
    yield Claim(
        "7.3.5-sum", "Trust in the system is quantified by adding the ratings of all its controllers", "sum of the ratings", found,
        verdict(every.low <= mean <= every.high, mean > every.high),
        "a sum of three probabilities is none, and divided by three it is not the chance that all three do what they should; nor does it "
        f"put two systems in the order of that chance ({count} runs each)",
    )  # fmt: skip


def _slow(network: Network, controller: float, actuator: float) -> Network:
    out = network.with_location("controller", "Intermediate", invariant=(Atom("react", "<=", controller),))
    return out.with_location("actuator", "braking", invariant=(Atom("press", "<=", actuator),))


def _rated(hit: Array) -> tuple[list[float], Interval]:
    """Return the share of the runs in which each query of `hit` (Q, B) holds, and in which all do."""
    return [met(row).value for row in hit], share(np.isfinite(hit).all(axis=0))


def _words(rates: list[float], every: Interval) -> dict[str, object]:
    return {
        "ratings": dict(zip(TEXTS, (round(rate, 4) for rate in rates), strict=True)), "sum": round(sum(rates), 4),
        "mean": round(sum(rates) / len(rates), 4), "all at once": interval(every),
    }  # fmt: skip
