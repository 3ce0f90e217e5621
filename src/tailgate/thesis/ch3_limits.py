"""Limits of the challenge: its latency and cost, predictable lists, fast attackers."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from scipy.special import ndtri

from tailgate.core import Array
from tailgate.core.scenario import load_scenario

from . import ch3_figures
from .ch3_cases import ATTACKS, DETECTED, OURS, SCENARIOS
from .claims import Claim, Drawing, Part, Spread, Table, Tick, verdict
from .runs import collided, collisions, percent, play, share

SCENARIO = SCENARIOS["i"]
CHANCES = (0.02, 0.05, 0.1, 0.2, 0.5)
ONSETS = (16, 51, 100, 150)
LISTED, RANDOM = "cra:challenge=fixed,times=[15,50,175]", "cra:probability=0.3"
HOPPED = {
    "thesis's list, then in every step": "cra:challenge=fixed,watch=1,quiet=1",
    "random, p = 0.3, then in every step": "cra:probability=0.3,watch=1,quiet=1",
    "random, p = 0.3, as set": RANDOM,
    "random, p = 0.3, five quiet ones": "cra:probability=0.3,quiet=5",
}
REACTIONS = tuple(float(t) for t in 10.0 ** np.arange(-9.0, -2.9, 0.5))


def parts(seeds: int, tick: Tick) -> Iterator[Part]:
    """Return claims, tables and drawings on the limits of the challenge."""
    tick("random challenges: latency and cost")
    yield from _latency(seeds)
    tick("a list that the attacker knows")
    yield _predictable(seeds)
    tick("attackers that listen to the probe")
    yield _hopping(seeds)
    tick("attackers that hear the challenge")
    yield from _reaction(seeds)


def _latency(seeds: int) -> tuple[Claim, Table, Drawing]:
    """Measure the detection of a late echo from 180 s on by random challenges, and what these cost without an attack."""
    rows, found, inside = [], {}, []
    curve: dict[str, list[float]] = {"p": [], "mean": [], "low": [], "high": []}
    never = play(SCENARIO, "none", "none", seeds)
    for p in CHANCES:
        defence = f"cra:probability={p}"
        trace = play(SCENARIO, defence, ATTACKS["delay"], seeds, terminate=False)
        alarm = trace.alarm[179:, :, 0]
        late = np.where(alarm.any(axis=0), np.argmax(alarm, axis=0), len(alarm)).astype(float)
        expected = (1.0 - p) / p * (1.0 - (1.0 - p) ** len(alarm))  # who is not heard until the end counts with the steps to the end
        error = float(late.std() / np.sqrt(len(late)))
        mean, half = float(late.mean()), 1.96 * error
        clean = play(SCENARIO, defence, "none", seeds)
        muted = float((~clean.probe[:, :, 0]).mean())
        off = np.sqrt(np.mean((clean.gap - never.gap)[:, :, 0] ** 2, axis=0))
        inside.append(abs(mean - expected) <= -ndtri(0.025 / len(CHANCES)) * error)
        found[f"p = {p:g}"] = {"measured": round(mean, 2), "expected": round(expected, 2), "(1-p)/p": round((1.0 - p) / p, 2)}
        rows.append((f"{p:g}", f"{expected:.1f}", f"{mean:.1f} +- {half:.1f}", f"{100 * muted:.1f} %", str(Spread.of(off))))
        for name, value in (("p", p), ("mean", mean), ("low", mean - half), ("high", mean + half)):
            curve[name].append(value)
    claim = Claim(
        "3.4-latency", "Challenges at random times detect an attack when the next one comes", "at the next challenge",
        {"steps from onset to alarm": found}, verdict(all(inside), not any(inside)),
        "geometric, mean (1-p)/p, cut at the 121 steps from onset to end: every mean within its interval, jointly 95 %",
    )  # fmt: skip
    heads = ("p", "expected", "mean steps to the alarm", "steps muted without an attack", "change of the gap without an attack, RMS [m]")
    table = Table("Random challenges: latency, and what they cost", heads, tuple(rows))
    drawn = partial(ch3_figures.latency, {name: np.array(values) for name, values in curve.items()})
    return claim, table, Drawing("figure-latency", "Random challenges: mean latency of the detection.", drawn)


def _predictable(seeds: int) -> Claim:
    found, lost = {}, []
    for onset in ONSETS:
        cells = {}
        for words, defence in (("list 15, 50, 175", LISTED), ("random, p = 0.1", "cra"), ("random, p = 0.3", RANDOM)):
            cells[words] = collisions(play(SCENARIO, defence, f"radar_jam:start_step={onset}", seeds))
        found[f"DoS from {onset} s"] = cells
        lost.append(cells["list 15, 50, 175"])
    return Claim(
        "3.4-list", "A list T_c of challenge times detects attacks in time", "detects", found,
        verdict(max(lost) == 0.0, min(lost[1:3]) > 0.5),
        "share of runs that collide: who knows the list attacks right after one of its times. Random challenges leave no safe moment, but "
        "a jammer of such values needs only about seven seconds",
    )  # fmt: skip


def _hopping(seeds: int) -> Claim:
    """Play an attacker that radiates only after a step in which it heard the probe, without any reaction within a step."""
    found, easy = {}, []
    for words, defence in HOPPED.items():
        cells = {}
        for case, attack in ATTACKS.items():
            for how in ("", ",hop=true"):
                cells[f"{case}{', hopping' if how else ''}"] = collisions(play(SCENARIO, defence, attack + how, seeds))
        found[words] = cells
        if "quiet=1" in defence:
            easy += [value for name, value in cells.items() if "hopping" in name]
    return Claim(
        "3.4-end", "An attack is over when a challenge comes back quiet (Algorithm 2, line 14)", "over", found,
        verdict(max(easy) < 0.05, min(easy) > 0.5),
        "share of runs that collide: after an alarm the next challenge is certain; the attacker keeps still there, and goes on. Several "
        "quiet challenges at random times leave it less, and keep a car blind for longer that nobody attacks any more",
    )  # fmt: skip


def _reaction(seeds: int) -> tuple[Claim, Table, Drawing]:
    """Play attackers that fall silent a reaction time after the probe.

    The claim is about the challenge at 182 s: it hears them, and what they do.
    """
    curve: dict[str, list[float]] = {"reaction": list(REACTIONS)}
    rows = []
    for reaction in REACTIONS:
        quick, cells = load_scenario(SCENARIO).with_threat(reaction=reaction), []
        for case, attack in ATTACKS.items():
            listed = play(quick, OURS, attack, seeds)
            heard = float(listed.alarm[DETECTED - 1, :, 0].mean())
            cells.append(f"{100 * heard:.0f} %")
            curve.setdefault(f"{case}: heard", []).append(heard)
            for words, trace in (("list", listed), ("random", play(quick, RANDOM, attack, seeds))):
                interval = share(collided(trace))
                cells.append(percent(interval))
                curve.setdefault(f"{case}: collided, {words}", []).append(interval.value)
        rows.append((f"{reaction:.1e}", *cells))
    arrays = {name: np.array(values) for name, values in curve.items()}
    half = {case: _half(arrays["reaction"], arrays[f"{case}: heard"]) for case in ATTACKS}
    fastest, slowest = ({case: curve[f"{case}: heard"][end] for case in ATTACKS} for end in (0, -1))
    missed, caught = max(fastest.values()), min(slowest.values())
    claim = Claim(
        "3.6-fast", "The method fails when an adversary can sample the incoming signal faster than the defender", "fails",
        {
            "reaction time at which half of the challenges at 182 s hear it [s]": half,
            f"heard, {REACTIONS[0]:.0e} and {REACTIONS[-1]:.0e} s": {c: f"{fastest[c]:g}, {slowest[c]:g}" for c in ATTACKS},
        }, verdict(missed < 0.05 < 0.95 < caught, missed > 0.5),
        "a challenge lasts 0.1 s, of which the attacker is heard for its reaction time, at a gap of some 35 m",
    )  # fmt: skip
    heads = ["reaction time [s]"]
    for words in ("DoS", "+6 m"):
        heads += [f"{words}: heard at 182 s", "collisions, thesis's list [95 %]", "collisions, random, p = 0.3 [95 %]"]
    table = Table("Attackers that hear the challenge and fall silent, scenario (i)", tuple(heads), tuple(rows))
    caption = "Attackers that hear the challenge and fall silent, by their reaction time: when they are heard, and what they do in the end."
    return claim, table, Drawing("figure-reaction", caption, partial(ch3_figures.reaction, arrays))


def _half(reaction: Array, share: Array) -> float:
    """Return the reaction time [s] at which the share passes one half, on a logarithmic scale; the nearest end where it does not."""
    above = np.flatnonzero(share >= 0.5)
    if not len(above) or above[0] == 0:
        return float(reaction[-1 if not len(above) else 0])
    i = above[0]
    part = (0.5 - share[i - 1]) / (share[i] - share[i - 1])
    return float(f"{10 ** (np.log10(reaction[i - 1]) + part * np.log10(reaction[i] / reaction[i - 1])):.2g}")
