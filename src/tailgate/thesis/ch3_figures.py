"""Figures 3.2 and 3.3 of the thesis, with the velocities, and the limits of the challenge."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np

from tailgate.base.plots import canvas
from tailgate.core import Array
from tailgate.envs.controllers.radar_car import GAP, RELATIVE_SPEED
from tailgate.play.trace import Trace

from .ch3_cases import OURS, Runs
from .claims import Drawing
from .figures import BAND, Picture, panel

NUMBERS = {("i", "DoS"): "3.2a", ("i", "delay"): "3.2b", ("ii", "DoS"): "3.3a", ("ii", "delay"): "3.3b"}
WORDS = {"DoS": "denial of service from 182 s", "delay": "an echo 6 m late from 180 s"}
BLUE, RED = "#0072B2", "#D55E00"


def cases(runs: Runs, row: int = 0) -> Iterator[Drawing]:
    """Return figures 3.2 and 3.3 of one run."""
    for (number, case), printed in NUMBERS.items():
        caption = (
            f"Figure {printed} of the thesis again: scenario ({number}), {WORDS[case]}, seed {row}; challenges at 15, 50, 175 "
            "and 182 s. Below, what the cars do."
        )
        yield Drawing(f"figure-{printed.replace('.', '-')}", caption, partial(_case, runs, number, case, row))


def _case(runs: Runs, number: str, case: str, row: int) -> Picture:
    figure, axes = canvas(10.0, 8.4, 3, 1)
    clean, ours, bare = (runs[number, *key].trace for key in (("clean", OURS), (case, OURS), (case, "none")))
    for ax, wire, label in ((axes[0, 0], GAP, "distance [m]"), (axes[1, 0], RELATIVE_SPEED, "relative velocity [m/s]")):
        received = np.where(ours.valid[:, row, 0, wire], ours.wires[:, row, 0, wire], 0.0)
        ax.plot(*_shown(ours, received, row), color=RED, linewidth=0.7, label="radar data with attack")
        ax.plot(*_shown(clean, clean.clean[:, row, 0, wire], row), color=BLUE, linestyle="--", label="radar data without attack")
        ax.plot(*_shown(ours, ours.estimate[:, row, 0, wire], row), color="black", linewidth=1.4, label="estimated radar data")
        ax.set_ylabel(label)
    cars = {"no attack": (clean, "--", BLUE), "with the defence": (ours, "-", "black"), "without": (bare, "-.", RED)}
    for words, (trace, style, colour) in cars.items():
        t, speed = _shown(trace, trace.speed[:, row, 0], row)
        axes[2, 0].plot(t + 1, speed, linestyle=style, color=colour, label=f"follower, {words}")
        if trace.collided[len(t) - 1, row]:
            axes[2, 0].plot(t[-1] + 1, speed[-1], "x", color=colour, markersize=10, label="collision")
    t, speed = _shown(clean, clean.lead_speed[:, row, 0], row)
    axes[2, 0].plot(t + 1, speed, color="grey", linestyle=":", label="leader")
    axes[2, 0].set(ylabel="velocity [m/s]", xlabel="time [s]")
    for ax in axes[:, 0]:
        ax.axvspan(180.0 if case == "delay" else 182.0, 300.0, color=BAND, alpha=0.2, linewidth=0)
        panel(ax, xlim=(0, 300))
    return figure


def _shown(trace: Trace, values: Array, row: int) -> tuple[Array, Array]:
    """Return the steps of an episode from 1, and values (K,) of these steps."""
    length = int(trace.length[row])
    return np.arange(1, length + 1), values[:length]


def latency(curve: Mapping[str, Array]) -> Picture:
    """Draw the mean latency over the probability of a challenge."""
    figure, axes = canvas(6.0, 4.0)
    ax, p = axes[0, 0], np.geomspace(0.015, 0.6, 100)
    ax.plot(p, (1.0 - p) / p, color="grey", label="(1 - p)/p")
    errors = np.array([curve["mean"] - curve["low"], curve["high"] - curve["mean"]])
    ax.errorbar(curve["p"], curve["mean"], errors, fmt="o", color="black", capsize=3, label="measured, 95 %")
    ax.set(xscale="log", yscale="log", xlabel="probability p of a challenge a step", ylabel="steps from onset to alarm, mean")
    ax.xaxis.set_minor_formatter("")
    ax.set_xticks(curve["p"], [f"{v:g}" for v in curve["p"]])
    ax.yaxis.set_major_formatter("{x:g}")
    ax.grid(alpha=0.3, which="both")
    ax.legend()
    return figure


def reaction(curve: Mapping[str, Array]) -> Picture:
    """Draw what attackers are heard and what they do, by their reaction time."""
    figure, axes = canvas(10.0, 4.2, 1, 2)
    styles = {
        "heard": (BLUE, "-", "o", "heard at 182 s"),
        "collided, list": (RED, "--", "x", "collision, thesis's list"),
        "collided, random": ("black", ":", "+", "collision, random, p = 0.3"),
    }
    for ax, (case, title) in zip(axes[0], WORDS.items(), strict=True):
        for name, (colour, line, marker, words) in styles.items():
            ax.plot(curve["reaction"], 100.0 * curve[f"{case}: {name}"], linestyle=line, marker=marker, color=colour, label=words)
        panel(ax, grid="both", xscale="log", xlabel="reaction time of the attacker [s]", ylabel="runs [%]", ylim=(-4, 104), title=title)
    return figure


def denial(ranges: Array, share: Mapping[str, Array]) -> Picture:
    """Draw the share of readings that a jammer denies."""
    figure, axes = canvas(6.0, 3.8)
    ax = axes[0, 0]
    for (name, values), style, marker in zip(share.items(), ("-", "--"), "os", strict=True):
        ax.plot(ranges, 100.0 * values, linestyle=style, marker=marker, label=f"noise that {name}")
    ax.set(xlabel="range [m]", ylabel="readings off by more than 5 m [%]", ylim=(-4, 104))
    ax.grid(alpha=0.3)
    ax.legend()
    return figure
